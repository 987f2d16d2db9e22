"""From joint angles to positions and back. Twin of `jaxhand.skeleton`."""

from __future__ import annotations

import numpy as np

from numpy_infer.arrays import Array
from numpy_infer.hand import ANGLES, FINGERS, JOINTS, THUMB_AXES, Hand


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


def rotations_from_angles(angles: Array) -> Array:
    """`[..., 26]` radians, in the order of `hand.ANGLES` → `[..., 15, 3, 3]` parent_from_joint of
    the finger joints (Rodrigues' formula, composed in table order)."""
    signed = (angles * SIGNS.astype(angles.dtype))[..., None, None]
    cross = CROSS.astype(angles.dtype, copy=False)
    squared = CROSS_SQUARED.astype(angles.dtype, copy=False)
    eye = np.eye(3, dtype=angles.dtype)
    single = eye + np.sin(signed) * cross + (1 - np.cos(signed)) * squared
    none = np.broadcast_to(eye, single[..., :1, :, :].shape)
    single = np.concatenate([single, none], -3)
    first, second, third = (single[..., slot, :, :] for slot in SLOTS)
    return first @ second @ third


def angles_from_rotations(rotations: Array) -> Array:
    """`[..., 15, 3, 3]` parent_from_joint → `[..., 26]` radians, the inverse of
    `rotations_from_angles`.

    A rotation that a joint's angles cannot express loses the part they lack. The middle angle of
    the three, abduction, lies in ±π/2: there flexion and twist are one motion and not told apart.
    """
    axes = JOINT_AXES.astype(rotations.dtype)
    m = np.swapaxes(axes, -1, -2) @ rotations @ axes
    about_x = np.arctan2(-m[..., 1, 2], m[..., 2, 2])
    about_y = np.arctan2(m[..., 0, 2], np.sqrt(m[..., 0, 0] ** 2 + m[..., 0, 1] ** 2))
    about_z = np.arctan2(-m[..., 0, 1], m[..., 0, 0])
    euler = np.stack([about_x, about_y, about_z], -1)
    joints = [JOINTS.index(angle.joint) - 1 for angle in ANGLES]
    axis = ["xyz".index(angle.axis) for angle in ANGLES]
    return euler[..., joints, axis] * SIGNS.astype(rotations.dtype)


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
    batch = rotations.shape[:-3]
    fingers = len(FINGERS)
    local = rotations.reshape(*batch, fingers, 3, 3, 3)
    bones = np.concatenate(
        [
            skeleton[..., 1:16, :].reshape(*skeleton.shape[:-2], fingers, 3, 3),
            skeleton[..., 16:, None, :],
        ],
        -2,
    )
    wrist = np.broadcast_to(wrist_position[..., None, :], (*batch, 1, 3))
    wrist_turn = np.broadcast_to(wrist_rotation[..., None, :, :], (*batch, 1, 3, 3))
    turn, place = wrist_turn, wrist
    turns, places = [], []
    for level in range(3):
        place = place + (turn @ bones[..., level, :, None])[..., 0]
        turn = turn @ local[..., level, :, :]
        turns.append(turn)
        places.append(place)
    tips = place + (turn @ bones[..., 3, :, None])[..., 0]
    joints = np.stack(places, -2).reshape(*batch, 15, 3)
    finger_turns = np.stack(turns, -3).reshape(*batch, 15, 3, 3)
    return (
        np.concatenate([wrist, joints, tips], -2),
        np.concatenate([wrist_turn, finger_turns], -3),
    )


def marker_positions(hand: Hand, positions: Array, rotations: Array) -> Array:
    """`[..., M, 3]` metres: the hand's markers on `positions [..., 21, 3]` and `rotations
    [..., 16, 3, 3]` as `forward_kinematics` gives them."""
    offsets = hand.offsets.astype(positions.dtype)[..., None]
    links = rotations[..., list(hand.links), :, :]
    return positions[..., list(hand.joints), :] + (links @ offsets)[..., 0]
