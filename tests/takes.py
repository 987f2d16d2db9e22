"""Made hands in motion, and files of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from numpy_infer.arrays import Array
from numpy_infer.geometry import mirror, nearest_rotation
from numpy_infer.hand import ANGLES, load_hand
from numpy_infer.recordings import Recording, write
from numpy_infer.skeleton import forward_kinematics, marker_positions, rotations_from_angles

HAND = load_hand("glove9")


def simulated(frames: int = 61, seed: int = 0) -> tuple[Array, Array, Array, Array]:
    """A smooth motion of `glove9`: markers `[T, 9, 3]`, points `[T, 21, 3]` in the world, the
    points in the hand frame and the angles `[T, 26]`."""
    random = np.random.default_rng(seed)
    bend = np.array([0.6 if a.name.endswith("flexion") else 0 for a in ANGLES])
    angles = bend * (
        0.5 + 0.4 * np.sin(np.linspace(0, 3, frames)[:, None] + random.uniform(0, 3, 26))
    )
    turns = rotations_from_angles(angles)
    rotation = nearest_rotation(random.normal(size=(3, 3)))
    place = np.linspace([0.1, 1.0, 0.3], [0.4, 1.2, 0.1], frames)
    points, rotations = forward_kinematics(
        HAND.skeleton, turns, np.broadcast_to(rotation, (frames, 3, 3)), place
    )
    eye, zero = np.broadcast_to(np.eye(3), (frames, 3, 3)), np.zeros((frames, 3))
    local, _ = forward_kinematics(HAND.skeleton, turns, eye, zero)
    return marker_positions(HAND, points, rotations), points, local, angles


def write_takes(folder: Path, stems: list[str], rate: float = 120, names: object = None) -> None:
    """TRC files of the same motion; a stem with `right` holds its mirror image."""
    folder.mkdir(parents=True, exist_ok=True)
    markers = simulated(121)[0]
    labels = list(names) if isinstance(names, list) else list(HAND.markers)
    for stem in stems:
        moved = mirror(markers) if "right" in stem else markers
        time = np.arange(len(moved)) / rate
        write(Recording(tuple(labels), moved, time, rate, ""), folder / f"{stem}.trc")
