"""From joint angles to positions and back. Twin of `jaxhand.skeleton`."""

from __future__ import annotations

import numpy as np

from numpy_infer.arrays import Array
from numpy_infer.hand import ANGLES, JOINTS, POINTS, THUMB_AXES, Hand


def _axis(letter: str, joint: str) -> list[float]:
    axes = np.array(THUMB_AXES) if joint.startswith("thumb") else np.eye(3)
    return list(axes[:, "xyz".index(letter)])


def _cross_matrix(axis: list[float]) -> Array:
    x, y, z = axis
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])


SIGNS = np.array([angle.sign for angle in ANGLES])
CROSS = np.stack([_cross_matrix(_axis(angle.axis, angle.joint)) for angle in ANGLES])
"""`[26, 3, 3]` cross-product matrices of the angles' axes in the flat hand's frame."""

CROSS_SQUARED = CROSS @ CROSS

_BY_JOINT = [[i for i, a in enumerate(ANGLES) if a.joint == joint] for joint in JOINTS[1:]]
SLOTS = np.array([[[*of, 26, 26][slot] for of in _BY_JOINT] for slot in range(3)])
"""`[3, 15]` which angle turns each finger joint first, second, third; 26 means none."""

JOINT_AXES = np.stack(
    [np.array(THUMB_AXES) if joint.startswith("thumb") else np.eye(3) for joint in JOINTS[1:]]
)
"""`[15, 3, 3]` the joints' own axes in the flat hand, as columns."""

EULER = (
    np.array([JOINTS.index(angle.joint) - 1 for angle in ANGLES]),
    np.array(["xyz".index(angle.axis) for angle in ANGLES]),
)
"""`[26]` each: the finger joint of each angle, and its axis."""

# Gathered once for all frames; no angle, slot 26, turns about nothing.
_NONE = np.zeros((1, 3, 3))
_SLOT_CROSS = np.concatenate([CROSS, _NONE])[SLOTS]
_SLOT_SQUARED = np.concatenate([CROSS_SQUARED, _NONE])[SLOTS]
_SLOT_SIGNS = np.append(SIGNS, 0)[SLOTS]
_SLOT_ANGLES = np.minimum(SLOTS, len(ANGLES) - 1)
_EYE = np.eye(3)
_AXES_BACK = np.swapaxes(JOINT_AXES, -1, -2)


def rotations_from_angles(angles: Array) -> Array:
    """`[..., 26]` radians, in the order of `hand.ANGLES` → `[..., 15, 3, 3]` parent_from_joint of
    the finger joints (Rodrigues' formula, composed in table order)."""
    dtype = angles.dtype
    signed = angles[..., _SLOT_ANGLES] * _SLOT_SIGNS.astype(dtype)
    signed = signed[..., None, None]
    single = np.sin(signed) * _SLOT_CROSS.astype(dtype, copy=False)
    single += (1 - np.cos(signed)) * _SLOT_SQUARED.astype(dtype, copy=False)
    single += _EYE.astype(dtype, copy=False)
    first, second, third = (single[..., slot, :, :, :] for slot in range(3))
    return first @ second @ third


def angles_from_rotations(rotations: Array) -> Array:
    """`[..., 15, 3, 3]` parent_from_joint → `[..., 26]` radians, the inverse of
    `rotations_from_angles`.

    A rotation that a joint's angles cannot express loses the part they lack. The middle angle of
    the three, abduction, lies in ±π/2: there flexion and twist are one motion and not told apart.
    """
    dtype = rotations.dtype
    m = _AXES_BACK.astype(dtype, copy=False) @ rotations @ JOINT_AXES.astype(dtype, copy=False)
    euler = np.empty(m.shape[:-1], dtype)
    euler[..., 0] = np.arctan2(-m[..., 1, 2], m[..., 2, 2])
    euler[..., 1] = np.arctan2(m[..., 0, 2], np.sqrt(m[..., 0, 0] ** 2 + m[..., 0, 1] ** 2))
    euler[..., 2] = np.arctan2(-m[..., 0, 1], m[..., 0, 0])
    return euler[..., *EULER] * SIGNS.astype(dtype)


def forward_kinematics(
    skeleton: Array, rotations: Array, wrist_rotation: Array, wrist_position: Array
) -> tuple[Array, Array]:
    """Places all points of a skeleton.

    Args:
        skeleton: `[..., 21, 3]` metres, each point from its parent in the flat hand.
        rotations: `[..., 15, 3, 3]` parent_from_joint of the finger joints.
        wrist_rotation: `[..., 3, 3]` world_from_wrist.
        wrist_position: `[..., 3]` metres, world.

    Returns:
        positions `[..., 21, 3]` metres, world; rotations `[..., 16, 3, 3]` world_from_joint.
    """
    batch, dtype = rotations.shape[:-3], rotations.dtype
    positions = np.empty((*batch, len(POINTS), 3), dtype)
    turns = np.empty((*batch, len(JOINTS), 3, 3), dtype)
    positions[..., 0, :], turns[..., 0, :, :] = wrist_position, wrist_rotation
    turn, place = turns[..., :1, :, :], positions[..., :1, :]
    for level in range(3):
        # The fingers' joints of one level, all at once.
        here = slice(1 + level, len(JOINTS), 3)
        place = place + (turn @ skeleton[..., here, :, None])[..., 0]
        turn = turn @ rotations[..., level::3, :, :]
        positions[..., here, :], turns[..., here, :, :] = place, turn
    tips = slice(len(JOINTS), len(POINTS))
    positions[..., tips, :] = place + (turn @ skeleton[..., tips, :, None])[..., 0]
    return positions, turns


def marker_positions(hand: Hand, positions: Array, rotations: Array) -> Array:
    """`[..., M, 3]` metres: the hand's markers on `positions [..., 21, 3]` and `rotations
    [..., 16, 3, 3]` as `forward_kinematics` gives them."""
    offsets = hand.offsets.astype(positions.dtype)[..., None]
    links = rotations[..., list(hand.links), :, :]
    return positions[..., list(hand.joints), :] + (links @ offsets)[..., 0]
