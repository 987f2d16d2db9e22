"""From joint angles to positions and back. Twin of `jaxhand.skeleton`."""

from __future__ import annotations

import numpy as np

from numpy_infer.arrays import Array, every
from numpy_infer.finger_forms import (
    AXES_FORM,
    BASE_ANGLES,
    BASE_AXES,
    CROSS,
    CROSS_SQUARED,
    FINGER_ANGLES,
    FLEXIONS,
    JOINT_AXES,
    OUTER_ANGLES,
    SIGNS,
    FingerWaves,
    finger_waves,
    waves,
)
from numpy_infer.geometry import shortest_arc, squares, transform
from numpy_infer.hand import ANGLES, JOINTS, POINTS, Hand

_BY_JOINT = [[i for i, a in enumerate(ANGLES) if a.joint == joint] for joint in JOINTS[1:]]
SLOTS = np.array([[[*of, 26, 26][slot] for of in _BY_JOINT] for slot in range(3)])
"""`[3, 15]` which angle turns each finger joint first, second, third; 26 means none."""

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

BEND_NOISE, BEND_PRIOR = 2e-3, 0.1
"""Metres and radians: how far a marker may be off, and how far a joint."""
FARTHEST_BEND = 0.5
"""Radians: no more in a frame, whatever is said to be measured."""
NEAREST = 1e-6
"""Metres: no marker is taken to be nearer to its finger's base."""


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
    axes = JOINT_AXES.astype(dtype, copy=False)
    turns = axes.swapaxes(-1, -2) @ rotations @ axes
    return _euler(turns)[..., *EULER] * _SIGNS.astype(dtype, copy=False)


_OF_AXES = np.array([-1, 1, -1])
_SIGNS = SIGNS * _OF_AXES[EULER[1]]
"""`[26]` of what `_euler` gives."""
_SURELY_TOLD = 0.99
"""Sine of the middle angle: up to here the first and the last are told apart well."""
_OPPOSITE, _ADJACENT = np.array([5, 1]), np.array([8, 0])
"""Places in a flat rotation: less the sine, and the cosine, of its first and last angle, times the
cosine of the middle one."""


def _euler(rotations: Array) -> Array:
    """`[..., 3]` radians about −x, y and −z, in that order, of `[..., 3, 3]`."""
    euler = np.empty(rotations.shape[:-1], rotations.dtype)
    flat = rotations.reshape(*rotations.shape[:-2], 9)
    if every(np.abs(flat[..., 2]) < _SURELY_TOLD):
        np.arctan2(flat.take(_OPPOSITE, -1), flat.take(_ADJACENT, -1), out=euler[..., ::2])
        np.arcsin(flat[..., 2], out=euler[..., 1])
        return euler
    # The latter two of what the first leaves (Day 2012): near ±90° about y, where the first is
    # hardly known, they make up for it.
    m = rotations
    euler[..., 0] = about_x = np.arctan2(m[..., 1, 2], m[..., 2, 2])
    cosine, sine = np.cos(about_x), np.sin(about_x)
    left = cosine[..., None] * m[..., 1, :2] - sine[..., None] * m[..., 2, :2]
    euler[..., 1] = np.arctan2(m[..., 0, 2], cosine * m[..., 2, 2] + sine * m[..., 1, 2])
    euler[..., 2] = -np.arctan2(left[..., 0], left[..., 1])
    return euler


def forward_kinematics(
    skeleton: Array,
    rotations: Array,
    wrist_rotation: Array | None = None,
    wrist_position: Array | None = None,
) -> tuple[Array, Array]:
    """Places all points of a skeleton.

    Args:
        skeleton: `[..., 21, 3]` metres, each point from its parent in the flat hand.
        rotations: `[..., 15, 3, 3]` parent_from_joint of the finger joints.
        wrist_rotation: `[..., 3, 3]` world_from_wrist; without it all is in the hand frame.
        wrist_position: `[..., 3]` metres, world.

    Returns:
        positions `[..., 21, 3]` metres, world; rotations `[..., 16, 3, 3]` world_from_joint.
    """
    batch, dtype = rotations.shape[:-3], rotations.dtype
    # Rotation and place in one matrix: a finger's joints are then two products.
    links = np.zeros((*batch, 5, 3, 4, 4), dtype)
    links[..., :3, :3] = rotations.reshape(*batch, 5, 3, 3, 3)
    links[..., :3, 3] = skeleton[..., 1 : len(JOINTS), :].reshape(*skeleton.shape[:-2], 5, 3, 3)
    links[..., 3, 3] = 1
    for level in (1, 2):
        np.matmul(links[..., level - 1, :, :], links[..., level, :, :], links[..., level, :, :])
    positions = np.zeros((*batch, len(POINTS), 3), dtype)
    turns = np.empty((*batch, len(JOINTS), 3, 3), dtype)
    turns[..., 0, :, :] = _EYE
    turns[..., 1:, :, :] = links[..., :3, :3].reshape(*batch, 15, 3, 3)
    positions[..., 1 : len(JOINTS), :] = links[..., :3, 3].reshape(*batch, 15, 3)
    tips = (turns[..., 3::3, :, :] @ skeleton[..., len(JOINTS) :, :, None])[..., 0]
    positions[..., len(JOINTS) :, :] = positions[..., 3 : len(JOINTS) : 3, :] + tips
    if wrist_rotation is None or wrist_position is None:
        return positions, turns
    return in_world(positions, turns, wrist_rotation, wrist_position)


def in_world(
    positions: Array, rotations: Array, wrist_rotation: Array, wrist_position: Array
) -> tuple[Array, Array]:
    """Positions `[..., 21, 3]` and rotations `[..., 16, 3, 3]` of the hand frame as the wrist's
    pose `[..., 3, 3]`, `[..., 3]` has them in the world."""
    return (
        transform(wrist_rotation, wrist_position, positions),
        wrist_rotation[..., None, :, :] @ rotations,
    )


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


def bend_fingers(hand: Hand, angles: Array, markers: Array) -> Array:
    """Bends each finger's outer two joints until its outermost marker is as far from the finger's
    base as it was measured.

    One rotation at the base, as the paper has it, falls short in a pinch (section 8): the tip's
    distance from the base is wrong too. One damped step over the two flexions, with `BEND_NOISE`
    and `BEND_PRIOR`, is left to `place_fingers` to point.

    Args:
        hand: its markers and bones.
        angles: `[..., 26]` radians.
        markers: `[..., M, 3]` metres, hand frame.

    Returns:
        `[..., 26]` radians.
    """
    fingers, dtype = finger_waves(hand), angles.dtype
    beyond = waves(angles.take(OUTER_ANGLES, -1))
    form = (beyond[..., None, :] @ fingers.square.astype(dtype, copy=False))[..., 0, :]
    # Of squares, their slopes too, so that no distance is divided by. No marker: no slope.
    square, slopes = np.maximum(form[..., :1], NEAREST**2), form[..., 1:]
    target = _towards(fingers, markers)
    short = np.sqrt(square * squares(target)[..., None]) - square
    damped = (slopes * slopes) @ _HALF_SUM.astype(dtype, copy=False) + _DAMPING * square
    bend = np.minimum(np.maximum(slopes * (short / damped), -FARTHEST_BEND), FARTHEST_BEND)
    return angles + bend.reshape(*angles.shape[:-1], 10) @ _BENT.astype(dtype, copy=False)


_HALF_SUM = np.full((2, 1), 0.5)
_DAMPING = 2 * (BEND_NOISE / BEND_PRIOR) ** 2
_BENT = np.eye(len(ANGLES))[FLEXIONS.reshape(10)]
"""`[10, 26]` all angles from the flexions."""


def place_fingers(
    hand: Hand,
    angles: Array,
    markers: Array | None = None,
    wrist_rotation: Array | None = None,
    wrist_position: Array | None = None,
) -> tuple[Array, Array, Array]:
    """All points of a hand with its fingers at `angles`, and turned about their bases until their
    outermost markers point to where they were measured (paper, section 2.2: finger alignment).

    The paper's middle of the last phalanx is that for a marker placed there. Here the marker's own
    modelled point is taken, so that joints which are right stay as they are, wherever the marker
    sits. What that leaves, the distance from the base, is the matter of `bend_fingers`.

    What `rotations_from_angles` and `forward_kinematics` say of it, in few calls: whatever stands
    beyond a finger's base is linear in the sines of sums of three angles, see `finger_forms`.

    Args:
        hand: its markers and bones.
        angles: `[..., 26]` radians.
        markers: `[..., M, 3]` metres, hand frame; None turns nothing.
        wrist_rotation: `[..., 3, 3]` world_from_wrist; without it all is in the hand frame.
        wrist_position: `[..., 3]` metres, world.

    Returns:
        angles `[..., 26]` as they now are; positions `[..., 21, 3]` metres, world; rotations
        `[..., 16, 3, 3]` world_from_joint.
    """
    batch, dtype = angles.shape[:-1], angles.dtype
    fingers = finger_waves(hand)
    # Sums of angles that are no hand's would be rounded apart, and no rotation come of them.
    small = np.fmod(angles, _WHOLE_TURN.astype(dtype, copy=False))
    both = waves(small.take(FINGER_ANGLES, -1))
    turn = both[..., :1, :] @ AXES_FORM.astype(dtype, copy=False)
    own = both[..., 1:, :] @ fingers.beyond.astype(dtype, copy=False)
    turn, own = turn.reshape(*batch, 5, 3, 3), own.reshape(*batch, 5, 3, 14)
    if markers is not None:
        modelled = (turn @ own[..., 13:])[..., 0]
        # Of a finger without a marker the modelled way has no length, and turns nothing.
        turn = shortest_arc(modelled, _towards(fingers, markers)) @ turn
        base_angles = _euler(turn) * _BASE_SIGNS.astype(dtype, copy=False)
        angles = np.concatenate([angles, base_angles.reshape(*batch, 15)], -1)
        angles = angles.take(_WITH_BASE_ANGLES, -1)
    if wrist_rotation is None or wrist_position is None:
        wrist_rotation = np.broadcast_to(_EYE.astype(dtype, copy=False), (*batch, 3, 3))
        wrist_position = np.zeros((*batch, 3), dtype)
    axes = wrist_rotation[..., None, :, :] @ BASE_AXES.astype(dtype, copy=False)
    placed = turn @ own[..., :13] + fingers.bases.astype(dtype, copy=False)
    placed = (axes @ placed).reshape(*batch, 195)
    wrist = wrist_rotation.reshape(*batch, 9)
    everything = np.concatenate([np.zeros((*batch, 3), dtype), wrist, placed], -1)
    positions = everything.take(_POINTS, -1) + wrist_position[..., None, :]
    return angles, positions, everything.take(_ROTATIONS, -1)


def _towards(fingers: FingerWaves, markers: Array) -> Array:
    """`[..., 5, 3]` metres, each in its finger's own axes: from the base to where the outermost
    marker was measured, of `markers [..., M, 3]`, hand frame."""
    flat = markers.reshape(*markers.shape[:-2], -1)
    ends = flat @ fingers.ends.astype(markers.dtype, copy=False)
    ends -= fingers.base_by_axes.astype(markers.dtype, copy=False)
    return ends.reshape(*flat.shape[:-1], 5, 3)


_WHOLE_TURN = np.array(2 * np.pi)
_BASE_SIGNS = SIGNS[BASE_ANGLES] * _OF_AXES
_WITH_BASE_ANGLES = np.arange(len(ANGLES))
_WITH_BASE_ANGLES[BASE_ANGLES] = len(ANGLES) + np.arange(15).reshape(5, 3)
"""`[26]` places in all angles, with those of the bases as they are to be behind them."""
_PLACED = 12 + np.arange(5 * 3 * 13).reshape(5, 3, 13)
"""Places, behind the wrist's own and its rotation, of what `place_fingers` makes of
`FingerWaves.beyond`."""
_ROTATIONS = np.concatenate(
    [
        3 + np.arange(9).reshape(1, 3, 3),
        _PLACED[..., :9].reshape(5, 3, 3, 3).swapaxes(1, 2).reshape(15, 3, 3),
    ]
)
"""`[16, 3, 3]`, and of points `[21, 3]`, in the world but for the wrist's position."""
_POINTS = np.concatenate(
    [
        np.arange(3)[None],
        _PLACED[..., 9:12].swapaxes(1, 2).reshape(15, 3),
        _PLACED[..., 12],
    ]
)
