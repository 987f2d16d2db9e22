"""What a calibration is worth: `python experiments/person.py demo/model.npz`.

Simulated people in the model's glove, each with bones of their own and markers not quite in place,
or with `--data` the hands of recorded takes. Twenty seconds of free motion calibrate, what comes
after them is measured: mean error of the joints through the whole pipeline for the model's hand,
for one of the size found and, of simulated people, on the true bones. The 95 % interval of the
difference, by seconds, says who is worse off beyond chance.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from typing import NamedTuple

import jax
import numpy as np

from jaxhand import datasets, simulation
from jaxhand.evaluation import interval
from jaxhand.hand_size import hand_size
from jaxhand.joint_evaluation import POINTS, evaluate_poses
from numpy_infer.arrays import Array
from numpy_infer.hand import Hand
from numpy_infer.model import Model, load
from numpy_infer.wearer import worn_by

RATE, SECONDS, CALIBRATED = 60, 30, 20
"""Hz, that of data sets; seconds of a simulated person, and of those that calibrate."""
NOISE = 0.5e-3
"""Metres per axis."""


class Person(NamedTuple):
    """One hand, measured first to calibrate and then to see what that is worth."""

    name: str
    calibrating: Array
    """`[T, M, 3]` metres."""
    markers: Array
    """`[N, M, 3]` metres."""
    truth: Array
    """`[N, 21, 3]` metres: its joints."""
    bones: Hand | None
    """The true ones, where they are known."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("model", help="a model with a joint network")
    parser.add_argument("--data", help="NAME:PATH of recordings with joint truth: all their takes")
    parser.add_argument("--people", type=int, default=8, help="simulated")
    parser.add_argument("--seed", type=int, default=1, help="the method was chosen on 97 to 99")
    options = parser.parse_args()
    model = load(options.model)
    if options.data is None:
        people = simulated(model, options.people, options.seed)
    else:
        people = recorded(model, options.data)
    rows, off, beyond = [], [], 0
    for person in people:
        size = hand_size(model, person.calibrating)
        found = model.hand.resized(size.factor)
        before, after = (errors(model, hand, person) for hand in (model.hand, found))
        rows.append([before.mean(), after.mean()])
        seconds = np.array_split(after - before, len(before) // RATE)
        sums, counts = zip(*((part.sum(), len(part)) for part in seconds), strict=True)
        worse = interval(np.array(sums), np.array(counts))
        beyond += worse["low"] is not None and worse["low"] > 0
        print(
            "{}: {:.2f} → {:.2f} cm, ".format(person.name, *rows[-1])
            + "difference {mean:.3f} ({low:.3f} to {high:.3f})".format(**worse),
            end="",
        )
        if person.bones is not None:
            rows[-1].append(errors(model, person.bones, person).mean())
            off.append(np.log(size.likeliest * model.hand.size / person.bones.size))
            print(f", {rows[-1][2]:.2f} on true bones", end="")
        print(flush=True)
    means = np.mean(rows, 0)
    text = ("{:.3f} uncalibrated", "{:.3f} calibrated", "{:.3f} on true bones")
    print("joints, cm:", ", ".join(text[: len(means)]).format(*means))
    if off:
        print(f"sizes found are off by {100 * np.std(off):.1f} % (standard deviation)")
    worse_off = sum(row[1] > row[0] for row in rows)
    print(f"{worse_off} of {len(rows)} are worse off, {beyond} beyond chance")


def simulated(model: Model, people: int, seed: int) -> Iterator[Person]:
    frames, split = RATE * SECONDS, RATE * CALIBRATED
    streams = simulation.streams(jax.random.key(seed), model.hand, people, frames, float(RATE))
    noise = NOISE * np.random.default_rng(0).standard_normal(streams.markers.shape)
    markers = np.asarray(streams.markers, np.float64) + noise
    for number, own in enumerate(markers):
        bones = model.hand.with_skeleton(np.asarray(streams.skeleton[number]))
        truth = np.asarray(streams.positions[number, split:])
        yield Person(f"person {number}", own[:split], own[split:], truth, bones)


def recorded(model: Model, data: str) -> Iterator[Person]:
    splits: tuple[datasets.Split, ...] = ("train", "validation", "test")
    for split in splits:
        for own in datasets.load(data, split, hand=model.hand).sequences:
            markers, truth = own.markers, own.positions
            if truth is None:
                raise SystemExit(f"{data} has no joint truth to measure by")
            known = np.isfinite(markers).all((-1, -2)) & np.isfinite(truth).all((-1, -2))
            frames = np.flatnonzero(known)
            # Half of a take that is short.
            count = min(RATE * CALIBRATED, len(frames) // 2)
            then = frames[count:]
            yield Person(
                f"{split}, {own.take}", markers[frames[:count]], markers[then], truth[then], None
            )


def errors(model: Model, hand: Hand, person: Person) -> Array:
    """`[N]` cm."""
    poses = evaluate_poses(worn_by(model, hand), person.markers.astype(np.float32))
    off: Array = np.linalg.norm(poses.positions - person.truth, axis=-1)
    return 1e2 * off[:, POINTS].mean(-1)


if __name__ == "__main__":
    main()
