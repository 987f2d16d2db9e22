"""A small training: a few hundred frames, narrow layers, four epochs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from strategies import HIGH, LOW, turn

from jaxhand.sequences import Dataset, Sequence
from jaxhand.tasks import Frames
from jaxhand.training import TrainingConfig
from numpy_infer.hand import load_hand
from numpy_infer.networks import Dense, Dropout
from numpy_infer.skeleton import forward_kinematics, marker_positions, rotations_from_angles

HAND = load_hand("glove9")
CONFIG = TrainingConfig(
    data=(),
    out=Path("nowhere"),
    marker_layers=(Dense(24),),
    joint_layers=(Dense(24), Dropout(0.1), Dense(16)),
    epochs=4,
)


def make_frames(count: int, seed: int) -> Frames:
    """Hands that open and close by one number each, somewhere in the world."""
    rng = np.random.default_rng(seed)
    share = rng.uniform(0, 0.6, (count, 5))[:, [0] * 6 + [1] * 5 + [2] * 5 + [3] * 5 + [4] * 5]
    angles = (share * HIGH + 0.02 * rng.standard_normal((count, 26))).clip(LOW, HIGH)
    angles = angles.astype(np.float32)
    pose = np.broadcast_to(turn((1, 2, 3), 1.0).astype(np.float32), (count, 3, 3))
    place = rng.uniform(-1, 1, (count, 3)).astype(np.float32)
    skeleton = HAND.skeleton.astype(np.float32)
    points = forward_kinematics(skeleton, rotations_from_angles(angles), pose, place)
    return Frames(np.asarray(marker_positions(HAND, *points)), angles)


TRAINING, VALIDATION = make_frames(320, 0), make_frames(320, 1)


def with_gaps(seed: int = 0) -> Frames:
    """The training frames with up to four markers of each not measured."""
    missing = np.random.default_rng(seed).permuted(
        np.arange(9) < np.arange(len(TRAINING.markers))[:, None] % 5, axis=-1
    )
    return Frames(np.where(missing[..., None], np.nan, TRAINING.markers))


def make_dataset(name: str, frames: Frames, weight: float, stretch: float | None) -> Dataset:
    """Sequences of 20 frames, too short to be evaluated; with joint truth if `stretch` says how
    long the bones are."""
    parts, unused = range(0, len(frames.markers), 20), np.zeros((20, 1, 3))
    sequences = tuple(
        Sequence(
            f"{name}{i}/left",
            f"{name}{i}",
            60.0,
            frames.markers[i : i + 20],
            *(() if stretch is None else (unused, unused, frames.angles[i : i + 20])),
        )
        for i in parts
    )
    hand = HAND.with_skeleton(HAND.skeleton * (stretch or 1))
    return Dataset(name, hand, sequences, weight, None if stretch is None else np.ones(26, bool))
