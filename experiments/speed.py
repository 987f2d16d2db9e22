"""What a frame and an epoch cost: `python experiments/speed.py`.

Everything that is compared runs in one process, interleaved, because machines are noisy: read the
ratios, with their spread, rather than the times.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

# Before numpy and JAX are loaded: one thread, as an app that tracks beside its own work has it.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import jax
import numpy as np

from jaxhand import simulation, tasks, training
from jaxhand import tracker as jax_tracker
from jaxhand.anthropometry import people
from jaxhand.cameras import Rig, film
from jaxhand.compiled import compiled
from jaxhand.joints import joint_stage
from jaxhand.networks import predict
from jaxhand.sparse_fit import least_squares, prior_of
from jaxhand.tasks import Frames
from jaxhand.training import TrainingConfig, fit_networks
from jaxhand.two_hands import marked, two_hands
from numpy_infer import tracker
from numpy_infer.arrays import Array
from numpy_infer.hand import load_hand
from numpy_infer.model import Model
from numpy_infer.networks import Dense, Network
from numpy_infer.tracker import HandTracker

FRAMES = 20_000


def interleaved(functions: Mapping[str, Callable[[], Any]], rounds: int) -> dict[str, Array]:
    """Seconds `[rounds]` that each function took. In every round the order is another: whoever
    comes behind its like finds code and weights in the cache. The first round, which compiles, is
    left out."""
    rng, names = np.random.default_rng(0), list(functions)
    taken = {name: np.empty(rounds + 1) for name in names}
    for i in range(rounds + 1):
        for name in rng.permutation(names):
            began = time.perf_counter()
            functions[name]()
            taken[name][i] = time.perf_counter() - began
    return {name: seconds[1:] for name, seconds in taken.items()}


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
        "without": (as_is, task.prepare(key, task.frames)),
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


def as_is(key: Array, frames: tuple[Array, Array]) -> tuple[Array, Array]:
    """The `Task.prepare` of frames that are inputs and targets already."""
    return frames


def print_tracking(model: Model, rounds: int) -> None:
    """The whole pipeline, finger alignment and pose included, in units of its two networks."""
    hand = model.hand
    streams = simulation.streams(jax.random.key(2), hand, 4, rounds + 1)
    markers = np.array(np.swapaxes(streams.markers, 0, 1), np.float64)

    def track(hands: int | None, hidden: Callable[[int], list[int]], **changes: Any) -> Any:
        tracker = HandTracker(replace(model, **changes), right=[False] * hands if hands else False)
        frames = markers[:, :hands].copy() if hands else markers[:, 0].copy()
        for i, frame in enumerate(frames):
            frame[..., hidden(i), :] = np.nan
        ahead = iter(frames)
        return lambda: tracker.step(next(ahead), 1 / 60)

    aligned = {"alignment": True}
    runs = {
        "its two networks alone: the unit": unit_of(model),
        "one hand, one marker hidden": track(None, lambda i: [4][: i > 0], **aligned),
        "  without finger alignment": track(None, lambda i: [4][: i > 0]),
        "  with the gate": track(None, lambda i: [4][: i > 0], gate=True, **aligned),
        "  nothing hidden": track(None, lambda i: [], **aligned),
        "  another marker hidden each frame": track(None, lambda i: [4 + i % 4], **aligned),
        "two hands": track(2, lambda i: [4][: i > 0], **aligned),
        "four hands": track(4, lambda i: [4][: i > 0], **aligned),
    }
    taken = interleaved(runs, rounds)
    print("\nnumpy, HandTracker.step, µs a frame; in units; 99 % over median")
    first = taken["its two networks alone: the unit"]
    for name, seconds in taken.items():
        tail = np.quantile(seconds, 0.99) / np.median(seconds)
        print(
            f"  {name:36} {spread(1e6 * seconds, 0):18} {spread(seconds / first, 1):18} {tail:.2f}"
        )


def print_alone(model: Model, rounds: int) -> None:
    """The unit and the pipeline, each in a loop of its own, with all of the cache."""
    streams = simulation.streams(jax.random.key(2), model.hand, 1, rounds + 1)
    frames = np.array(streams.markers[0], np.float64)
    frames[1:, 4] = np.nan
    tracker, ahead = HandTracker(replace(model, alignment=True)), iter(frames)

    def step() -> None:
        tracker.step(next(ahead), 1 / 60)

    print("\neach in a loop of its own, µs a frame")
    medians = []
    for name, run in (("unit", unit_of(model)), ("one hand", step)):
        taken = 1e6 * interleaved({name: run}, rounds)[name]
        medians.append(np.median(taken))
        print(f"  {name:28} {spread(taken, 0)}")
    print(f"  {'ratio':28} {medians[1] / medians[0]:.1f}")


def unit_of(model: Model) -> Callable[[], None]:
    """The plain forward pass of a model's two networks, of one frame."""
    features = np.zeros(3 * len(model.hand), np.float32)

    def unit() -> None:
        for network in (model.marker_network, model.joint_network):
            assert network is not None
            plain(network, features)

    return unit


def plain(network: Network, inputs: Array) -> Array:
    """The forward pass as anyone would write it."""
    x = (inputs - network.input_mean) / network.input_scale
    for i, layer in enumerate(network.spec):
        if isinstance(layer, Dense):
            x = x @ network.arrays[f"{i}.kernel"] + network.arrays[f"{i}.bias"]
            if layer.activation == "relu":
                x = np.maximum(x, 0)
    return x * network.output_scale + network.output_mean


def print_offline(model: Model, rounds: int, frames: int = 2048, hands: int = 64) -> None:
    """Whole recordings at once: numpy, of one hand; JAX, of many, beside the networks alone."""
    model = replace(model, alignment=True)
    streams = simulation.streams(jax.random.key(4), model.hand, hands, frames)
    whole = (np.swapaxes(streams.markers, 0, 1), np.swapaxes(streams.visible, 0, 1))
    markers, visible = (np.asarray(array) for array in whole)
    dt = np.full((frames, hands), 1 / 60, np.float32)
    some = slice(frames // 8)

    def networks(inputs: Array) -> Any:
        return [predict(network, inputs) for network in (model.marker_network, model.joint_network)]

    one = np.array(markers[:, 0], np.float64), visible[:, 0], np.full(frames, 1 / 60)
    full = one[0], np.ones_like(one[1]), one[2]
    features = markers[some].reshape(-1, hands, 3 * len(model.hand))
    run = compiled(lambda state, *arrays: jax_tracker.run(model, state, *arrays)[1])
    start, both = jax_tracker.init(model, (hands,)), jax.jit(networks)
    gated = replace(model, gate=True)
    runs: dict[str, Callable[[], Any]] = {
        "numpy, gaps": lambda: tracker.run(model, tracker.init(model), *one),
        "numpy, no gaps": lambda: tracker.run(model, tracker.init(model), *full),
        "numpy, gaps, gate": lambda: tracker.run(gated, tracker.init(gated), *one),
        "numpy, no gaps, gate": lambda: tracker.run(gated, tracker.init(gated), *full),
        "JAX": lambda: jax.block_until_ready(run(start, markers[some], visible[some], dt[some])),
        "JAX, two networks": lambda: jax.block_until_ready(both(features)),
    }
    taken = interleaved(runs, rounds)
    done = {name: frames if name.startswith("numpy") else frames // 8 * hands for name in runs}
    print("\nwhole recordings, with finger alignment, 1,000 frames a second")
    for name, seconds in taken.items():
        print(f"  {name:28} {spread(done[name] / seconds / 1e3, 1)}")
    print(f"  {'ratio':28} {spread(taken['JAX, two networks'] / taken['JAX'])}")
    changes = (one[1][1:] != one[1][:-1]).any(-1).mean()
    print(f"  (the visible set changes in {100 * changes:.0f} % of these frames)")


def print_simulator(rounds: int, frames: int = 600, scenes: int = 16) -> None:
    """Two simulated hands, without gaps and before eight cameras."""
    hand = load_hand("glove9")
    person = people(jax.random.key(5), hand, (scenes,))

    @compiled
    def bare(key: Array) -> Any:
        moves = two_hands(key, frames, 60.0, (scenes,), person)
        return [
            marked(hand, person.skeleton, move, right)
            for move, right in zip(moves, (False, True), strict=True)
        ]

    @compiled
    def filmed(key: Array) -> Any:
        moves = two_hands(key, frames, 60.0, (scenes,), person)
        return film(key, hand, person, *moves, 60.0, Rig(cameras=8))

    runs = {
        name: lambda made=made: jax.block_until_ready(made(jax.random.key(6)))
        for name, made in (("no gaps", bare), ("eight cameras", filmed))
    }
    taken = interleaved(runs, rounds)
    print("\nJAX, two simulated hands, 1,000 frames a second")
    for name, seconds in taken.items():
        print(f"  {name:28} {spread(frames * scenes / seconds / 1e3, 1)}")


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
    print_alone(model, options.frames)
    print_offline(model, options.rounds)
    print_joints(model, options.rounds)
    print_simulator(min(options.rounds, 5))


if __name__ == "__main__":
    main()
