"""From joint angles to positions and back. Twin of `jaxhand.skeleton`."""

from __future__ import annotations

import numpy as np

from numpy_infer.arrays import Array
from numpy_infer.geometry import cross, shortest_arc
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

HINGES = np.array([[3 * finger + 1, 3 * finger + 2] for finger in range(5)])
"""`[5, 2]` the outer two joints of each finger, of the fifteen finger joints."""
HINGE_AXES = JOINT_AXES[HINGES][..., :1]
"""`[5, 2, 3, 1]` about which they flex, in their parent's frame."""
HINGE_CROSS = np.stack([_cross_matrix(axis) for axis in HINGE_AXES.reshape(-1, 3)])
HINGE_CROSS = HINGE_CROSS.reshape(5, 2, 3, 3)
HINGE_SQUARED = HINGE_CROSS @ HINGE_CROSS

BEND_NOISE, BEND_PRIOR = 2e-3, 0.1
"""Metres and radians: how far a marker may be off, and how far a joint."""
FARTHEST_BEND = 0.5
"""Radians: no more in a frame, whatever is said to be measured."""


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
    offsets = hand.offsets.astype(positions.dtype, copy=False)[..., None]
    joints, links = hand.placing
    return positions[..., joints, :] + (rotations[..., links, :, :] @ offsets)[..., 0]


def flat_calibrated(rotations: Array, flat: Array) -> Array:
    """`[..., 15, 3, 3]` parent_from_joint as the flat pose calibrates it (paper, section 2.2): the
    inverse of what is predicted while the user holds a flat hand, composed onto each prediction.

    Args:
        rotations: `[..., 15, 3, 3]` parent_from_joint as predicted.
        flat: `[15, 3, 3]` as predicted for the flat hand.
    """
    return flat.swapaxes(-1, -2) @ rotations


def align_fingers(
    hand: Hand, local: Array, positions: Array, rotations: Array, markers: Array, weight: Array
) -> Array:
    """Turns each finger about its base until its outermost marker points to where it was measured
    (paper, section 2.2: finger alignment).

    The paper's middle of the last phalanx is that for a marker placed there. Here the marker's own
    modelled point is taken, so that joints which are right stay as they are, wherever the marker
    sits. What that leaves, the distance from the base, is the matter of `bend_fingers`.

    Args:
        hand: its markers and their offsets.
        local: `[..., 15, 3, 3]` parent_from_joint of the finger joints.
        positions: `[..., 21, 3]` metres, world, as `forward_kinematics` makes them of `local`.
        rotations: `[..., 16, 3, 3]` world_from_joint, likewise.
        markers: `[..., M, 3]` metres, world; finite where the weight is not 0.
        weight: `[..., M]` in 0 to 1: the share of the arc that a marker is worth.

    Returns:
        `[..., 15, 3, 3]` parent_from_joint.
    """
    ends, has = hand.end_markers
    base = positions[..., 1:16:3, :]
    modelled = marker_positions(hand, positions, rotations)[..., ends, :] - base
    share = weight[..., ends] * has.astype(weight.dtype)
    measured = np.where(share[..., None] > 0, markers[..., ends, :] - base, modelled)
    turn = shortest_arc(modelled, measured, share)
    wrist = rotations[..., :1, :, :]
    turn = wrist.swapaxes(-1, -2) @ turn @ wrist
    local = local.copy()
    local[..., ::3, :, :] = turn @ local[..., ::3, :, :]
    return local


def bend_fingers(
    hand: Hand, local: Array, positions: Array, rotations: Array, markers: Array, weight: Array
) -> Array:
    """Bends each finger's outer two joints until its outermost marker is as far from the finger's
    base as it was measured.

    One rotation at the base, as the paper has it, falls short in a pinch (section 8): the tip's
    distance from the base is wrong too. One damped step over the two flexions, with `BEND_NOISE`
    and `BEND_PRIOR`, is left to `align_fingers` to point. Takes and gives what that does.
    """
    ends, has = hand.end_markers
    base = positions[..., 1:16:3, :]
    modelled = marker_positions(hand, positions, rotations)[..., ends, :]
    share = weight[..., ends] * has.astype(weight.dtype)
    way = modelled - base
    reach = np.sqrt((way * way).sum(-1))
    target = np.where(share[..., None] > 0, markers[..., ends, :] - base, way)
    short = share * (np.sqrt((target * target).sum(-1)) - reach)
    direction = way / np.where(reach > 0, reach, 1)[..., None]
    axes = (rotations[..., HINGES, :, :] @ HINGE_AXES.astype(local.dtype, copy=False))[..., 0]
    arms = modelled[..., None, :] - positions[..., 1 + HINGES, :]
    carried = (hand.placing[1][ends][:, None] > HINGES).astype(local.dtype)
    slopes = (cross(axes, arms) * direction[..., None, :]).sum(-1) * carried
    damped = (slopes * slopes).sum(-1) + (BEND_NOISE / BEND_PRIOR) ** 2
    bend = slopes * (short / damped)[..., None]
    bend = np.minimum(np.maximum(bend, -FARTHEST_BEND), FARTHEST_BEND)[..., None, None]
    turn = np.sin(bend) * HINGE_CROSS.astype(local.dtype, copy=False)
    turn += (1 - np.cos(bend)) * HINGE_SQUARED.astype(local.dtype, copy=False)
    turn += _EYE.astype(local.dtype, copy=False)
    local = local.copy()
    local[..., HINGES, :, :] = turn @ local[..., HINGES, :, :]
    return local
