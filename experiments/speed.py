"""What a frame and an epoch cost: `python experiments/speed.py`.

Everything that is compared runs in one process, interleaved, because machines are noisy: read the
ratios, with their spread, rather than the times.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

# Before numpy and JAX are loaded: one thread, as an app that tracks beside its own work has it.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import jax
import numpy as np

from jaxhand import simulation, tasks, training
from jaxhand.joints import joint_stage
from jaxhand.sparse_fit import least_squares, prior_of
from jaxhand.tasks import Frames
from jaxhand.training import TrainingConfig, fit_networks
from numpy_infer.arrays import Array
from numpy_infer.hand import load_hand
from numpy_infer.model import Model
from numpy_infer.networks import predict
from numpy_infer.tracker import HandTracker

FRAMES = 20_000


def interleaved(functions: Mapping[str, Callable[[], Any]], rounds: int) -> dict[str, Array]:
    """Seconds `[rounds]` that each function took; the first round, which compiles, is left out."""
    taken: dict[str, list[float]] = {name: [] for name in functions}
    for _ in range(rounds + 1):
        for name, run in functions.items():
            began = time.perf_counter()
            run()
            taken[name].append(time.perf_counter() - began)
    return {name: np.array(seconds[1:]) for name, seconds in taken.items()}


def spread(values: Array, digits: int = 2) -> str:
    """Median, and the middle half."""
    low, middle, high = np.quantile(values, (0.25, 0.5, 0.75))
    return f"{middle:.{digits}f} ({low:.{digits}f}-{high:.{digits}f})"


def print_training(rounds: int) -> Model:
    """An epoch of the marker network, beside the same scan over frames that are registered and
    masked already. Gives a model to track with."""
    hand, config = load_hand("glove9"), TrainingConfig(data=(), out=training.Path(), epochs=1)
    markers, angles = simulation.frames(jax.random.key(0), hand, FRAMES)
    frames = Frames(markers, angles)
    key = jax.random.key(1)
    task = tasks.marker_task(frames, frames, hand, key, config.marker_layers, config.occlusions)
    weights = task.network.arrays
    moments = training.ADAM.init(weights)
    runs = {
        "with masks and registration": (task.prepare, task.frames),
        "without": (tasks.as_is, task.prepare(key, task.frames)),
    }

    def epoch(name: str) -> Callable[[], float]:
        prepare, data = runs[name]
        run = training.epoch_function(task.network.spec, config.batch, prepare)
        return lambda: float(run(weights, moments, config.learning_rate, key, data, None)[2])

    taken = interleaved({name: epoch(name) for name in runs}, rounds)
    print(f"training the marker network, batch {config.batch}, ms per 1,000 frames and epoch")
    for name, seconds in taken.items():
        print(f"  {name:28} {spread(1e6 * seconds / FRAMES)}")
    print(f"  {'ratio':28} {spread(taken['with masks and registration'] / taken['without'])}")
    return fit_networks(frames, frames, hand, config)


def print_tracking(model: Model, rounds: int) -> None:
    """One hand, one marker hidden, the whole pipeline with joints, beside the plain forward pass of
    the two networks."""
    hand = model.hand
    streams = simulation.streams(jax.random.key(2), hand, 1, rounds + 1)
    markers = np.array(streams.markers[0], np.float64)
    markers[1:, 4] = np.nan
    trackers = (HandTracker(replace(model, alignment=on)) for on in (False, True))
    plain, aligned = ((tracker, iter(markers)) for tracker in trackers)
    inputs, every = np.zeros(3 * len(hand), np.float32), np.ones(3 * len(hand), bool)

    def networks() -> None:
        for network in (model.marker_network, model.joint_network):
            assert network is not None
            predict(network, inputs, every)

    def step(tracker: HandTracker, frames: Iterator[Array]) -> None:
        tracker.step(next(frames), 1 / 60)

    runs = {"step": partial(step, *plain), "aligned": partial(step, *aligned), "networks": networks}
    taken = interleaved(runs, rounds)
    print("\nnumpy, one hand, one marker hidden, µs a frame")
    for name, text in (
        ("step", "HandTracker.step"),
        ("aligned", "with finger alignment"),
        ("networks", "its two networks alone"),
    ):
        seconds = 1e6 * taken[name]
        print(f"  {text:28} {spread(seconds, 0)}, 99 % {np.quantile(seconds, 0.99):.0f}")
    print(f"  {'ratio':28} {spread(taken['step'] / taken['networks'])}")


def print_joints(model: Model, rounds: int, frames: int = 1000) -> None:
    """Joints of complete frames in JAX: the learned stage beside the likeliest posture."""
    hand = model.hand
    markers, angles = simulation.frames(jax.random.key(3), hand, frames)
    prior = prior_of(np.asarray(angles))
    wrist = np.broadcast_to(np.eye(3, dtype=np.float32), (frames, 3, 3)), np.zeros((frames, 3))
    stage = jax.jit(joint_stage)
    still = tuple(np.asarray(part, np.float32) for part in wrist)
    runs = {
        "learned": lambda: jax.block_until_ready(stage(model, markers, *still)),
        "least_squares": lambda: jax.block_until_ready(least_squares(hand, markers, prior)),
    }
    taken = interleaved(runs, rounds)
    print("\nJAX, joints of 1,000 complete frames at once, µs a frame")
    for name, seconds in taken.items():
        print(f"  {name:28} {spread(1e6 * seconds / frames, 1)}")
    print(f"  {'ratio':28} {spread(taken['least_squares'] / taken['learned'], 0)}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=21, help="epochs of each kind")
    parser.add_argument("--frames", type=int, default=3000, help="frames tracked")
    options = parser.parse_args()
    model = print_training(options.rounds)
    print_tracking(model, options.frames)
    print_joints(model, options.rounds)


if __name__ == "__main__":
    main()
