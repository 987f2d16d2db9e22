"""What each stage of a frame costs (paper, section 6.3): `python experiments/stages.py`.

Five minutes of two simulated hands before simulated cameras, with the gaps that these leave, go
through the bundled model with finger alignment: the left hand alone, and both; with the gate and
without. The paper's times, 1.2 ms for one hand and 2.2 ms for two, are means of a program in C# on
a machine of its own: they say what is fast enough, not who is faster.

Timers stand round the functions of a stage and stop while another stage runs inside of it. What
they cost themselves is the difference to the same frames without them, which come by turns.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from types import ModuleType
from typing import Any
from unittest.mock import patch

# Before numpy and JAX are loaded: one thread, as an app that tracks beside its own work has it.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import jax
import numpy as np
from speed import spread

from jaxhand.anthropometry import people
from jaxhand.cameras import Rig, film
from jaxhand.two_hands import marked, two_hands
from numpy_infer import continuity, gate, joints, output, predictors, skeleton, tracker
from numpy_infer.arrays import Array
from numpy_infer.hand import load_hand
from numpy_infer.model import load
from numpy_infer.tracker import HandTracker

RATE, SECONDS = 60.0, 300.0
BLOCK = 300
"""Frames after which another of the runs that are compared goes on."""
PAPER = {1: 1.2, 2: 2.2}
"""Milliseconds a frame, by number of hands (section 6.3: the mean of five minutes)."""

REST = "input checked, and the rest"
STAGES: dict[str, tuple[tuple[ModuleType, str], ...]] = {
    "gate": ((gate, "step"),),
    "registration, and wrist pose with it": (
        *((continuity, "sight"), (continuity, "refit")),
        *((continuity, "fit"), (continuity, "pattern"), (continuity, "kabsch")),
    ),
    "marker network": ((predictors, "predict"),),
    "continuity": ((tracker, "advance"),),
    "wrist pose by itself": ((continuity, "wrist_pose"),),
    "joint network": ((output, "joint_stage"),),
    "calibration": (
        *((joints, "_as_trained"), (joints, "rotations_from_angles")),
        *((joints, "flat_calibrated"), (joints, "angles_from_rotations")),
    ),
    "finger alignment": (
        *((joints, "bend_fingers"), (skeleton, "shortest_arc"), (skeleton, "_euler")),
    ),
    "forward kinematics": ((joints, "place_fingers"),),
    "status, expected errors": ((tracker, "hand_pose"),),
    REST: (),
}
"""The functions of each, where they are called from. What of finger alignment stands in
`place_fingers` itself, a fifth of that, counts as forward kinematics; calibration is for
`--calibration` alone."""


class Clock:
    """Nanoseconds of each stage, without those of other stages that it calls."""

    def __init__(self) -> None:
        self.begin()

    def begin(self) -> None:
        """A new frame."""
        self.spent = dict.fromkeys(STAGES, 0)
        self.stage, self.since = REST, time.perf_counter_ns()

    def switch(self, stage: str) -> str:
        """Now this stage runs; the one that did is given back."""
        before, now = self.stage, time.perf_counter_ns()
        self.spent[before] += now - self.since
        self.stage, self.since = stage, now
        return before

    @contextmanager
    def running(self) -> Iterator[None]:
        """Timers stand in the runtime meanwhile."""
        with ExitStack() as patches:
            for stage, functions in STAGES.items():
                for module, name in functions:
                    timed = self._timed(stage, getattr(module, name))
                    patches.enter_context(patch.object(module, name, timed))
            yield

    def _timed(self, stage: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def run(*arguments: Any) -> Any:
            before = self.switch(stage)
            result = function(*arguments)
            self.switch(before)
            return result

        return run


def filmed(frames: int, seed: int = 0) -> Array:
    """`[T, 2, M, 3]` metres, world: the left and the right hand of somebody, NaN where the
    cameras lose a marker."""
    hand = load_hand("glove9")

    @jax.jit
    def made(key: Array) -> tuple[list[Array], Array]:
        person_key, motion_key, key = jax.random.split(key, 3)
        person = people(person_key, hand)
        moves = two_hands(motion_key, frames, RATE, people=person)
        _, visible = film(key, hand, person, *moves, RATE, Rig())
        sides = zip(moves, (False, True), strict=True)
        return [marked(hand, person.skeleton, move, right)[0] for move, right in sides], visible

    markers, visible = made(jax.random.key(seed))
    markers = np.where(np.asarray(visible)[..., None], np.asarray(markers, np.float64), np.nan)
    return np.ascontiguousarray(np.swapaxes(markers, 0, 1))


def totals(tracker: HandTracker, frames: Array) -> Array:
    """`[T]` µs that each frame takes."""
    taken = np.empty(len(frames))
    for i, markers in enumerate(frames):
        began = time.perf_counter_ns()
        tracker.step(markers, 1 / RATE)
        taken[i] = time.perf_counter_ns() - began
    return taken / 1e3


def by_stage(tracker: HandTracker, frames: Array) -> Array:
    """`[T, stages]` µs; 0 where a stage is not needed."""
    clock, taken = Clock(), np.empty((len(frames), len(STAGES)))
    with clock.running():
        for i, markers in enumerate(frames):
            clock.begin()
            tracker.step(markers, 1 / RATE)
            clock.switch(REST)
            taken[i] = list(clock.spent.values())
    return taken / 1e3


def show(name: str, hands: int, whole: Array, stages: Array) -> None:
    """Prints a table of stages, and of whole frames without timers."""
    print(f"\n{name + ', µs':38} median where it runs   frames   of the time")
    for stage, taken in zip(STAGES, stages.T, strict=True):
        if taken.any():
            runs = taken > 0
            share = taken.sum() / stages.sum()
            print(
                f"  {stage:36} {spread(taken[runs], 1):22} {100 * runs.mean():4.0f} %"
                f"   {100 * share:6.1f} %"
            )
    print(f"  {'a frame, without timers':36} {spread(whole, 0)}")
    print(f"    99 % {np.quantile(whole, 0.99):.0f}")
    print(f"    mean {whole.mean():.0f}; the paper's, on another machine, {1e3 * PAPER[hands]:.0f}")
    print(f"    the timers would add {np.median(stages.sum(1) - whole):.0f}")


def progress(text: str) -> None:
    """A line that the next one overwrites, for whoever watches."""
    if sys.stderr.isatty():
        print(f"\r\033[K{text}", end="", file=sys.stderr, flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--seconds", type=float, default=SECONDS)
    parser.add_argument("--calibration", help="of `jaxhand calibrate`, as in `jaxhand track`")
    options = parser.parse_args()
    progress("simulating")
    both = filmed(round(RATE * options.seconds))
    hidden = np.isnan(both[..., 0])
    gaps, changes = hidden.any(-1).mean(), (hidden[1:] != hidden[:-1]).any(-1).mean()
    progress("")
    print(
        f"{len(both):,} frames at {RATE:.0f} Hz, two hands, {100 * hidden.mean():.1f} % of the "
        f"markers missing; of each hand some in\n{100 * gaps:.0f} % of the frames, and others than "
        f"in the frame before in {100 * changes:.1f} %"
    )
    for name in ("marker", "joint"):
        network = getattr(load("glove9"), f"{name}_network")
        size = sum(array.nbytes for array in network.arrays.values())
        print(f"{name} network {size / 1e3:.0f} kB (paper: 300 kB)")

    runs = {}
    for name, hands in (("one hand", 1), ("two hands", 2)):
        for gated in (True, False):

            def fresh(hands: int = hands, gated: bool = gated) -> HandTracker:
                return HandTracker.load(
                    calibration=options.calibration,
                    alignment=True,
                    gate=gated,
                    right=[False, True] if hands == 2 else False,
                )

            frames = both if hands == 2 else both[:, 0]
            runs[name + (", gate" if gated else ", no gate")] = hands, frames, fresh(), fresh()
    taken: dict[str, list[tuple[Array, Array]]] = {name: [] for name in runs}
    for start in range(0, len(both), BLOCK):
        progress(f"{start:,} of {len(both):,} frames")
        for name, (_, frames, bare, timed) in runs.items():
            block = frames[start : start + BLOCK]
            taken[name].append((totals(bare, block), by_stage(timed, block)))
    progress("")
    for name, (hands, *_) in runs.items():
        show(name, hands, *map(np.concatenate, zip(*taken[name], strict=True)))


if __name__ == "__main__":
    main()
