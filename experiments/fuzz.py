"""What no sane world sends: frames, model files and recordings that are broken on purpose.

`python experiments/fuzz.py --frames 1000000` runs that many adversarial frames through each
predictor, a crowd of hands at a time, and now and then lets the crowd recover. `--files 10000`
damages a model file byte by byte, `--readers 10000` damages small recordings, hands, calibrations
and label maps; `--readers 100000 --atheris` lets coverage steer (extra `fuzz`).
What it finds is printed with the seed that finds it again; Ctrl-C ends it early, with its figures.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from fuzz_files import damaged_models, damaged_readers, steered_readers

from numpy_infer import continuity, tracker
from numpy_infer.arrays import Array
from numpy_infer.hand import ANGLES, HIGH, LOW, Hand
from numpy_infer.model import Model, load
from numpy_infer.pose import HandPose
from numpy_infer.predictors import PREDICTORS
from numpy_infer.skeleton import forward_kinematics, marker_positions, rotations_from_angles

BAD, GOOD, HIDING = 400, 50, 8
"""Frames of a round: adversarial; complete again; with markers hidden."""

HANDS, RECOVERING = 250, 50
"""Of a round; only some of them recover, for that takes as many frames again."""

DTS = np.array(
    [1 / 60] * 8
    + [1 / 120, 0.003, 0.1, 1, 1e4, 0, 0, -1 / 60, -1e300, 1e300, 5e-324, np.nan, np.inf, -np.inf]
)
GARBAGE = np.array([np.nan, np.inf, -np.inf, 1e300, -1e30, 0.0, 5e-324, 1e4])


# -- frames -------------------------------------------------------------------------------------


def somewhere(rng: np.random.Generator, markers: Array, values: Array, share: float) -> Array:
    """Some coordinates replaced by values that are no measurement."""
    bad = rng.choice(values, markers.shape)
    return np.where(rng.uniform(size=markers.shape) < share, bad, markers)


def swapped(rng: np.random.Generator, markers: Array) -> Array:
    order = np.argsort(rng.uniform(size=markers.shape[:2]), -1)
    return np.take_along_axis(markers, order[..., None], 1)


def flattened(rng: np.random.Generator, markers: Array, axes: int) -> Array:
    """All on a line or in a plane, or within very little of it."""
    off = rng.choice([0, 1e-12, 1e-6, 1e-4, 3e-3], (len(markers), 1, 3))
    return markers * np.where(np.arange(3) < axes, 1, off)


KINDS: dict[str, Callable[[np.random.Generator, Array], Array]] = {
    "NaN": lambda r, m: somewhere(r, m, np.array([np.nan]), 0.2),
    "infinite": lambda r, m: somewhere(r, m, np.array([np.inf, -np.inf]), 0.2),
    "beyond measure": lambda r, m: somewhere(r, m, np.array([1e30, -1e300, 1.7e308, 1e5]), 0.2),
    "far": lambda r, m: somewhere(r, m, np.array([9.9e4, -5e3, 400.0]), 0.05),
    "all far": lambda r, m: m + r.choice([-9.9e4, 1e4, 50.0], (len(m), 1, 3)),
    "denormal": lambda r, m: somewhere(r, m * 1e-310, np.array([5e-324, -0.0]), 0.5),
    "in one place": lambda r, m: np.repeat(m[:, :1], m.shape[1], 1),
    "at the origin": lambda r, m: np.zeros_like(m),
    "swapped": swapped,
    "on a line": lambda r, m: flattened(r, m, 1),
    "in a plane": lambda r, m: flattened(r, m, 2),
    "in millimetres": lambda r, m: m * 1000,
    "mirrored": lambda r, m: m * np.array([-1, 1, 1]),
    "noisy": lambda r, m: m + r.normal(size=m.shape) * r.choice([1e-9, 1e-3, 1.0], (len(m), 1, 1)),
    "elsewhere": lambda r, m: m + r.normal(size=(len(m), 1, 3)),
}


def motion(rng: np.random.Generator, hand: Hand, frames: int, hands: int) -> Array:
    """`[T, H, M, 3]` metres: hands that bend, spread and are carried about."""
    clock = np.arange(frames)[:, None, None] / 60

    def waves(width: int, speed: float) -> Array:
        pace, phase = rng.uniform(0, speed, (2, hands, width))
        return np.sin(pace * clock + 2 * np.pi * phase / speed)

    angles = (LOW + HIGH) / 2 + waves(len(ANGLES), 6) * (HIGH - LOW) / 2
    turn = rotations_from_angles(np.pi * waves(len(ANGLES), 2))[..., 0, :, :]
    points = forward_kinematics(
        hand.skeleton, rotations_from_angles(angles), turn, 0.5 * waves(3, 3)
    )
    return marker_positions(hand, *points)


def adversarial(rng: np.random.Generator, truth: Array) -> Iterator[tuple[Array, Array, Array]]:
    """Markers, mask and dt of one frame after the other, for `[T, H, M, 3]` hands."""
    _, hands, count, _ = truth.shape
    kinds = list(KINDS.values())
    level, order = np.full(hands, count), np.zeros((hands, count))
    before = None
    for frame in truth:
        markers = frame.copy()
        chosen = rng.integers(-len(kinds), len(kinds), hands)  # every other one is as it should be
        for i, kind in enumerate(kinds):
            markers[chosen == i] = kind(rng, frame[chosen == i])
        anew = rng.uniform(size=hands) < 0.3
        level = np.where(anew, rng.choice([0, 1, 2, 3, 3, 4, 5, count, count], hands), level)
        order = np.where(anew[:, None], np.argsort(rng.uniform(size=(hands, count)), -1), order)
        visible = order < level[:, None]
        garbage = rng.choice(GARBAGE, (hands, 1, 1))
        hide = ~visible[..., None] & (rng.uniform(size=(hands, 1, 1)) < 0.5)
        markers = np.where(hide, garbage, markers)
        if before is not None:
            again = rng.uniform(size=hands) < 0.1
            markers = np.where(again[:, None, None], before[0], markers)
            visible = np.where(again[:, None], before[1], visible)
        before = markers, visible
        yield markers, visible, rng.choice(DTS, hands)


# -- laws ---------------------------------------------------------------------------------------


@dataclass
class Worst:
    """The worst figures so far."""

    skew: float = 0.0
    """How far a rotation is from being one."""
    far: float = 0.0
    """Metres: the farthest output."""
    pauses: int = 0
    """Frames of an hour until no correction was left."""
    astray: float = 0.0
    """Metres: how far a tracker that has recovered is from a fresh one."""


def leaves(name: str, tree: Any) -> Iterator[tuple[str, Array]]:
    """The arrays of a state or an output, with their names."""
    if isinstance(tree, tuple):
        names = getattr(tree, "_fields", [str(i) for i in range(len(tree))])
        for part, value in zip(names, tree, strict=True):
            yield from leaves(f"{name}.{part}", value)
    elif tree is not None:
        yield name, np.asarray(tree)


def check(state: tracker.State, pose: HandPose, worst: Worst) -> None:
    """What holds in every frame, whatever came in.

    Raises:
        AssertionError: it does not; names the array and the first hand.
    """
    for name, array in (*leaves("state", state), *leaves("pose", pose)):
        if not np.isfinite(array).all():
            raise AssertionError(f"{name} of hand {np.argwhere(~np.isfinite(array))[0][0]}")
        if name.endswith("expected_error") and (array < 0).any():
            raise AssertionError(f"{name} of hand {np.argwhere(array < 0)[0][0]} is negative")
    turns = [state.rotation, state.prior, pose.wrist_rotation]
    turns += [] if pose.rotations is None else [pose.rotations]
    tolerance = 1e-4 if state.rotation.dtype == np.float32 else 1e-9
    for turn in turns:
        skew = np.abs(turn @ turn.swapaxes(-1, -2) - np.eye(3)).max((-1, -2))
        worst.skew = max(worst.skew, float(skew.max()))
        if (skew > tolerance).any() or (np.linalg.det(turn) < 0).any():
            raise AssertionError(f"no rotation, off by {skew.max():.1e}: hand {skew.argmax()}")
    worst.far = max(worst.far, float(np.abs(pose.markers).max()))


def first(tree: Any, hands: int) -> Any:
    """The state of the first few hands."""
    if isinstance(tree, tuple):
        parts = [first(part, hands) for part in tree]
        return type(tree)(*parts) if parts else tree
    return None if tree is None else tree[:hands]


def recover(
    model: Model, rng: np.random.Generator, state: tracker.State, truth: Array, worst: Worst
) -> None:
    """Complete frames again: what is measured comes back bit for bit once the corrections have
    died, and nothing of the past is left then, also in what is predicted.

    Raises:
        AssertionError: it does not.
    """
    hands, count = truth.shape[1:3]
    every, right = np.ones((hands, count), bool), state.right
    hour = np.full(hands, tracker.LONGEST)
    most = int(8 * tracker.FARTHEST / (continuity.SHRINK_SPEED * tracker.LONGEST))
    for pauses in range(1, most):
        state, pose = tracker.step(model, state, truth[0], every, hour)
        check(state, pose, worst)
        worst.pauses = max(worst.pauses, pauses)
        if pauses > 1 and not state.correction.any():  # the first has come from anywhere
            break
    else:
        raise AssertionError(f"a correction is left: {np.abs(state.correction).max():.3g} m")
    fresh = tracker.init(model, (hands,), right)
    tenth = np.full(hands, 0.1)
    hidden = np.argsort(rng.uniform(size=(hands, count)), -1) < rng.integers(0, 4, (hands, 1))
    for t in range(GOOD + HIDING):
        visible = every if t < GOOD else ~hidden
        state, pose = tracker.step(model, state, truth[t], visible, tenth)
        fresh, other = tracker.step(model, fresh, truth[t], visible, tenth)
        check(state, pose, worst)
        seen = truth[t].astype(pose.markers.dtype)
        if t < GOOD and pose.markers.tobytes() != seen.tobytes():
            raise AssertionError("a marker that is measured does not come back bit for bit")
        if t >= GOOD - 1:
            for (name, one), (_, two) in zip(leaves("pose", pose), leaves("", other), strict=True):
                off = np.abs(one - two).max()
                worst.astray = max(worst.astray, float(off))
                if off > (1e-4 if "angles" in name or "rotation" in name else 1e-5):
                    raise AssertionError(f"{name} is {off:.2g} from that of a fresh tracker")


def round_of(
    model: Model, seed: tuple[int, ...], worst: Worst, bad: int = BAD, hands: int = HANDS
) -> int:
    """One crowd through adversarial frames and back; gives the number of adversarial frames.

    Raises:
        AssertionError: a law does not hold; whatever else the tracker raises or warns of.
    """
    rng = np.random.default_rng(seed)
    truth = motion(rng, model.hand, bad + GOOD + HIDING, hands)
    state = tracker.init(model, (hands,), rng.uniform(size=hands) < 0.5)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for t, (markers, visible, dt) in enumerate(adversarial(rng, truth[:bad])):
            try:
                state, pose = tracker.step(model, state, markers, visible, dt)
                check(state, pose, worst)
            except Exception as error:
                raise AssertionError(f"seed {seed}, frame {t}: {error!r}") from error
        try:
            few = min(hands, RECOVERING)
            recover(model, rng, first(state, few), truth[bad:, :few], worst)
        except Exception as error:
            raise AssertionError(f"seed {seed}, recovery: {error!r}") from error
    return bad * hands


def models(name: str, precision: str, predictors: Iterable[str]) -> dict[str, Model]:
    """A bundled model under each predictor, with and without finger alignment."""
    bundled = load(name)
    hand = replace(bundled.hand, template=bundled.hand.template.astype(precision))
    return {
        f"{predictor}{', aligned' if on else ''}": replace(
            bundled, hand=hand, predictor=predictor, alignment=on
        )
        for predictor in predictors
        for on in (False, True)
    }


def progress(text: str) -> None:
    """A line that the next one overwrites, for whoever watches."""
    if sys.stderr.isatty():
        print(f"\r\033[K{text}", end="", file=sys.stderr, flush=True)


def frames(options: argparse.Namespace) -> bool:
    """Runs them; True if every law held."""
    whole, chosen = True, options.predictor or PREDICTORS
    print(f"{'':24}{'frames':>10} {'s':>6}  skew     farthest m  hours  astray")
    for name, model in models(options.model, options.precision, chosen).items():
        worst, done, began, round_ = Worst(), 0, time.perf_counter(), 0
        broken = ""
        try:
            while done < options.frames and not broken:
                try:
                    done += round_of(model, (options.seed, round_), worst)
                except AssertionError as error:
                    broken, whole = f"  BROKEN: {error}", False
                round_ += 1
                progress(f"{name}: {done:,} of {options.frames:,}")
        finally:  # Ctrl-C too
            progress("")
            print(
                f"{name:24}{done:10,} {time.perf_counter() - began:6.1f}  {worst.skew:.0e}  "
                f"{worst.far:10.3g}  {worst.pauses:5}  {worst.astray:.0e}{broken}",
                flush=True,
            )
    return whole


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=0, help="adversarial ones per predictor")
    parser.add_argument("--files", type=int, default=0, help="damaged copies of the model file")
    parser.add_argument("--readers", type=int, default=0, help="damaged files for each reader")
    parser.add_argument("--atheris", action="store_true", help="steered by coverage")
    parser.add_argument("--model", default="glove9", help="a bundled model")
    parser.add_argument("--predictor", nargs="+", choices=PREDICTORS, help="not all of them")
    parser.add_argument("--precision", choices=("float32", "float64"), default="float64")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    whole = True
    try:
        if options.frames:
            whole &= frames(options)
        with tempfile.TemporaryDirectory() as folder:
            if options.files:
                whole &= damaged_models(options.model, options.files, options.seed, Path(folder))
            if options.readers and options.atheris:
                steered_readers(options.readers, options.seed, Path(folder))  # does not come back
            elif options.readers:
                whole &= damaged_readers(options.readers, options.seed, Path(folder))
    except KeyboardInterrupt:
        sys.exit(130)
    sys.exit(0 if whole else 1)


if __name__ == "__main__":
    main()
