"""What a calibration is worth: `python experiments/person.py demo/model.npz`.

Simulated people in the model's glove, each with bones of their own and markers not quite in place.
Twenty seconds of free motion calibrate, the ten after them are measured: mean error of the joints
through the whole pipeline for the model's hand, for one of the size found, and on the true bones.
The 95 % interval of the difference, by seconds, says who is worse off beyond chance.
"""

from __future__ import annotations

import argparse

import jax
import numpy as np

from jaxhand import simulation
from jaxhand.evaluation import interval
from jaxhand.hand_size import hand_size
from jaxhand.joint_evaluation import POINTS, evaluate_poses
from numpy_infer.arrays import Array
from numpy_infer.hand import Hand
from numpy_infer.model import Model, load
from numpy_infer.wearer import worn_by

RATE, SECONDS, CALIBRATED = 60.0, 30, 20
NOISE = 0.5e-3
"""Metres per axis."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("model", help="a model with a joint network")
    parser.add_argument("--people", type=int, default=8)
    parser.add_argument("--seed", type=int, default=1, help="the method was chosen on 99")
    options = parser.parse_args()
    model = load(options.model)
    frames, split = round(RATE * SECONDS), round(RATE * CALIBRATED)
    key = jax.random.key(options.seed)
    streams = simulation.streams(key, model.hand, options.people, frames, RATE)
    noise = NOISE * np.random.default_rng(0).standard_normal(streams.markers.shape)
    markers = np.asarray(streams.markers, np.float64) + noise
    rows, beyond = [], 0
    for person in range(options.people):
        true = model.hand.with_skeleton(np.asarray(streams.skeleton[person]))
        found = model.hand.resized(hand_size(model, markers[person, :split]).factor)
        truth = np.asarray(streams.positions[person, split:])
        before, after, best = (
            errors(model, on, markers[person, split:], truth) for on in (model.hand, found, true)
        )
        rows.append([each.mean() for each in (before, after, best)])
        seconds = (after - before).reshape(-1, round(RATE))
        worse = interval(seconds.sum(-1), np.full(len(seconds), seconds.shape[1]))
        beyond += worse["low"] is not None and worse["low"] > 0
        print(
            "person {}: {:.2f} → {:.2f} cm, {:.2f} on true bones, ".format(person, *rows[-1])
            + "difference {mean:.3f} ({low:.3f} to {high:.3f})".format(**worse),
            flush=True,
        )
    means = np.mean(rows, 0)
    worse = sum(row[1] > row[0] for row in rows)
    print("joints, cm: {:.3f} uncalibrated, {:.3f} calibrated, {:.3f} on true bones".format(*means))
    print(f"{worse} of {len(rows)} people are worse off, {beyond} beyond chance")


def errors(model: Model, hand: Hand, markers: Array, truth: Array) -> Array:
    """`[T]` cm."""
    poses = evaluate_poses(worn_by(model, hand), markers.astype(np.float32))
    off: Array = 1e2 * np.linalg.norm(poses.positions - truth, axis=-1)[:, POINTS].mean(-1)
    return off


if __name__ == "__main__":
    main()
