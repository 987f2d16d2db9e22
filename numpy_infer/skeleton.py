"""From joint angles to positions and back. Twin of `jaxhand.skeleton`."""

from __future__ import annotations

from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from numpy_infer.arrays import Array
from numpy_infer.geometry import shortest_arc, transform
from numpy_infer.hand import ANGLES, CHAINS, FINGERS, JOINTS, POINTS, THUMB_AXES, Hand


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

BASE_ANGLES = np.array([[i for i, a in enumerate(ANGLES) if a.joint == j] for j in JOINTS[1::3]])
"""`[5, 3]` the angles of each finger's base: about its x, y and z."""

_OUTER = (
    ("thumb_mcp_flexion", "thumb_mcp_abduction", "thumb_ip_flexion"),
    *((f"{finger}_pip_flexion", None, f"{finger}_dip_flexion") for finger in FINGERS[1:]),
)
_NAMES = [angle.name for angle in ANGLES]
OUTER_ANGLES = np.array([[_NAMES.index(name or row[0]) for name in row] for row in _OUTER])
"""`[5, 3]` the angles beyond each finger's base: of its middle joint flexion and abduction, which
only a thumb has, and flexion of its last joint."""
FLEXIONS = OUTER_ANGLES[:, [0, 2]]

_TURNING = SIGNS[OUTER_ANGLES] * np.array([[name is not None for name in row] for row in _OUTER])
_SIGNED_CROSS = np.stack(
    [
        (SIGNS[:, None, None] * CROSS)[BASE_ANGLES],
        _TURNING[..., None, None] * CROSS[OUTER_ANGLES],
    ],
    1,
)
_SIGNED_SQUARED = _SIGNED_CROSS @ _SIGNED_CROSS
WAVES = np.stack([np.eye(3) + _SIGNED_SQUARED, -_SIGNED_SQUARED, _SIGNED_CROSS], 3)
"""`[5, 2, 3, 3, 3, 3]` of the angles at each finger's base, and beyond it: what 1, cosine and sine
of the angle are worth in its rotation."""

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
    return _euler(rotations, JOINT_AXES)[..., *EULER] * SIGNS.astype(rotations.dtype)


def _euler(rotations: Array, axes: Array) -> Array:
    """`[..., 3]` radians about x, y and z of `axes`, in that order, of `[..., 3, 3]`. The latter
    two of what the first leaves (Day 2012): near ±90° about y, where the first is hardly known,
    they make up for it."""
    axes = axes.astype(rotations.dtype, copy=False)
    m = axes.swapaxes(-1, -2) @ rotations @ axes
    euler = np.empty(m.shape[:-1], rotations.dtype)
    euler[..., 0] = about_x = np.arctan2(-m[..., 1, 2], m[..., 2, 2])
    cosine, sine = np.cos(about_x), np.sin(about_x)
    left = cosine[..., None] * m[..., 1, :2] + sine[..., None] * m[..., 2, :2]
    euler[..., 1] = np.arctan2(m[..., 0, 2], cosine * m[..., 2, 2] - sine * m[..., 1, 2])
    euler[..., 2] = np.arctan2(left[..., 0], left[..., 1])
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
    ends, has = hand.end_markers
    forms, dtype = _forms(hand), angles.dtype
    value = _waves(angles.take(OUTER_ANGLES, -1))
    waves = (value @ _AND_SLOPE.astype(dtype, copy=False)).reshape(*value.shape[:-1], 2, 3)
    # Value and slope by the middle joint, times the abduction's value; then by the last joint.
    first = waves[..., 0, :, :, None] * value[..., 1, None, None, :]
    form = first.reshape(*first.shape[:-2], 9) @ forms.square.astype(dtype, copy=False)
    form = form @ waves[..., 2, :, :].swapaxes(-1, -2)
    reach = np.sqrt(np.maximum(form[..., :1, 0], 0))
    slopes = form.reshape(*form.shape[:-2], 4)[..., 2:0:-1] / (2 * np.where(reach > 0, reach, 1))
    target = markers.take(ends, -2) - hand.skeleton[1:16:3].astype(dtype, copy=False)
    short = np.sqrt((target[..., None, :] @ target[..., None])[..., 0]) - reach
    if np.count_nonzero(has) < has.size:
        short = short * has.astype(dtype)[:, None]
    damped = (slopes[..., None, :] @ slopes[..., None])[..., 0] + (BEND_NOISE / BEND_PRIOR) ** 2
    bend = np.minimum(np.maximum(slopes * (short / damped), -FARTHEST_BEND), FARTHEST_BEND)
    return angles + bend.reshape(*angles.shape[:-1], 10) @ _BENT.astype(dtype, copy=False)


_AND_SLOPE = np.array([[1, 0, 0, 0, 0, 0], [0, 1, 0, 0, 0, 1], [0, 0, 1, 0, -1, 0]])
"""`[3, 6]` 1, cosine and sine, and their slopes, of such three."""
_BENT = np.eye(len(ANGLES))[FLEXIONS.reshape(10)]
"""`[10, 26]` all angles from the flexions."""


def _waves(angles: Array) -> Array:
    """`[..., 3]` 1, cosine and sine of `[...]`."""
    waves = np.ones((*angles.shape, 3), angles.dtype)
    np.cos(angles, waves[..., 1])
    np.sin(angles, waves[..., 2])
    return waves


def place_fingers(
    hand: Hand, angles: Array, markers: Array | None = None
) -> tuple[Array, Array, Array]:
    """All points of a hand with its fingers at `angles`, and turned about their bases until their
    outermost markers point to where they were measured (paper, section 2.2: finger alignment).

    The paper's middle of the last phalanx is that for a marker placed there. Here the marker's own
    modelled point is taken, so that joints which are right stay as they are, wherever the marker
    sits. What that leaves, the distance from the base, is the matter of `bend_fingers`.

    What `rotations_from_angles` and `forward_kinematics` say of it, in few calls: whatever stands
    beyond a finger's base is linear in the products of 1, cosine and sine of three angles.

    Args:
        hand: its markers and bones.
        angles: `[..., 26]` radians.
        markers: `[..., M, 3]` metres, hand frame; None turns nothing.

    Returns:
        angles `[..., 26]` as they now are; positions `[..., 21, 3]` metres and rotations
        `[..., 16, 3, 3]`, hand frame.
    """
    batch, dtype = angles.shape[:-1], angles.dtype
    forms, (ends, has) = _forms(hand), hand.end_markers
    waves = _waves(angles.take(FINGER_ANGLES, -1))
    products = waves[..., 0, :, None] * waves[..., 1, None, :]
    products = (products[..., None] * waves[..., 2, None, None, :]).reshape(*batch, 5, 2, 1, 27)
    turn = (products[..., 0, :, :] @ BASE_FORM.astype(dtype, copy=False)).reshape(*batch, 5, 3, 3)
    own = products[..., 1, :, :] @ forms.beyond.astype(dtype, copy=False)
    own = own.reshape(*batch, 5, 3, 10)
    base = hand.skeleton[1:16:3].astype(dtype, copy=False)
    if markers is not None:
        modelled = (turn @ own[..., 9:])[..., 0]
        measured = markers.take(ends, -2) - base
        if np.count_nonzero(has) < has.size:
            measured = np.where(has[:, None] > 0, measured, modelled)
        turn = shortest_arc(modelled, measured) @ turn
        angles = angles.copy()
        angles[..., BASE_ANGLES] = _euler(turn, JOINT_AXES[::3]) * _BASE_SIGNS.astype(dtype)
    placed = turn @ own[..., :9]
    positions = np.zeros((*batch, len(POINTS), 3), dtype)
    positions[..., 1:16:3, :] = base
    beyond = placed[..., :3].swapaxes(-1, -2) + base[:, None]
    positions[..., 2:16:3, :], positions[..., 3:16:3, :] = beyond[..., 0, :], beyond[..., 1, :]
    positions[..., 16:, :] = beyond[..., 2, :]
    rotations = np.empty((*batch, len(JOINTS), 3, 3), dtype)
    rotations[..., 0, :, :] = _EYE
    rotations[..., 1::3, :, :] = turn
    rotations[..., 2::3, :, :] = placed[..., 3:6]
    rotations[..., 3::3, :, :] = placed[..., 6:]
    return angles, positions, rotations


FINGER_ANGLES = np.stack([BASE_ANGLES, OUTER_ANGLES], 1)
"""`[5, 2, 3]` of each finger those of its base, and those beyond."""
_BASE_SIGNS = SIGNS[BASE_ANGLES]
BEYOND = np.array(CHAINS)[:, 1:]
"""`[5, 3]` the points of each finger after its base."""
_TURN = "fiab,fjbc,fkcd->fijkad"
BASE_FORM = np.einsum(_TURN, *np.moveaxis(WAVES[:, 0], 1, 0)).reshape(5, 27, 9)
"""The rotation of a finger's base, linear in such products of its angles."""


class FingerForms(NamedTuple):
    """What stands beyond the fingers' bases, linear in products of 1, cosine and sine of the angles
    `OUTER_ANGLES`, the last one's running fastest."""

    beyond: Array
    """`[5, 27, 30]` in the base joint's frame, as `[3, 10]`: the points after the base, metres; the
    rotations of the two joints; the outermost marker, metres."""
    square: Array
    """`[5, 9, 3]` m²: the square of that marker's distance from the base."""


_FIRST, _SIDE, _LAST = np.moveaxis(WAVES[:, 1], 1, 0)
_MIDDLE = np.einsum("fiab,fjbc->fijac", _FIRST, _SIDE)
_OUTER = np.einsum(_TURN, _FIRST, _SIDE, _LAST)


def finger_forms(hand: Hand, xp: Any = np) -> FingerForms:
    """The forms of a hand's bones and markers; `xp` is numpy, or `jax.numpy` for traced ones."""
    arms = end_arms(hand, xp)
    # Of 1, cosine and sine: 1 alone.
    one, middle, outer, last = (
        xp.asarray(part, arms.dtype) for part in (np.eye(3)[0], _MIDDLE, _OUTER, _LAST)
    )

    def point(parts: Array) -> Array:
        """`[5, 3, 3, 3, 3]` of three parts `[5, 3, 3]`, each carried by a further joint."""
        near = xp.einsum("i,j,k,fa->fijka", one, one, one, parts[:, 0])
        between = xp.einsum("fijac,fc,k->fijka", middle, parts[:, 1], one)
        return near + between + xp.einsum("fijkad,fd->fijka", outer, parts[:, 2])

    bones = xp.asarray(hand.skeleton)[BEYOND]
    points = [point(xp.where(np.arange(3)[:, None] <= n, bones, 0)) for n in range(3)]
    turns = xp.einsum("fijac,k->fijkac", middle, one), outer
    columns = [xp.stack(points, -1), *turns, point(arms)[..., None]]
    out = xp.einsum("fkcd,fd->fkc", last, arms[:, 2])
    inner = xp.einsum("fijac,fc,k->fijka", middle, arms[:, 1], one)
    inner = inner + xp.einsum("fijac,fkc->fijka", middle, out)
    square = 2 * xp.einsum("fa,fijka->fijk", arms[:, 0], inner)
    square = square + 2 * xp.einsum("i,j,fc,fkc->fijk", one, one, arms[:, 1], out)
    length = (arms * arms).sum((-1, -2))
    square = square + xp.einsum("i,j,k,f->fijk", one, one, one, length)
    beyond = xp.concatenate(columns, -1).reshape(5, 27, 30)
    return FingerForms(beyond, square.reshape(5, 9, 3))


_forms = lru_cache(maxsize=16)(finger_forms)


def end_arms(hand: Hand, xp: Any = np) -> Array:
    """`[5, 3, 3]` metres: the way from each finger's base to its outermost marker, in the three
    parts that its joints carry, from the base out; 0 where it has none. `xp` as above."""
    ends, has = hand.end_markers
    joints, links = (places[ends, None] for places in hand.placing)
    level = np.arange(3)
    between = (np.array(CHAINS) == joints).argmax(-1)[:, None] > level
    skeleton, offsets = xp.asarray(hand.skeleton), xp.asarray(hand.offsets)
    carries = has[:, None] > 0
    bones = xp.where((carries & between)[..., None], skeleton[BEYOND], 0)
    own = (carries & ((links - 1) % 3 == level))[..., None]
    return bones + xp.where(own, offsets[ends, None].astype(skeleton.dtype), 0)
