"""From joint angles to positions and back. Twin of `numpy_infer.skeleton`."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from jaxhand.compiled import apart
from jaxhand.geometry import product, shortest_arc, transform
from numpy_infer.arrays import Array
from numpy_infer.finger_forms import (
    BASE_ANGLES,
    BASE_FORM,
    CROSS,
    CROSS_SQUARED,
    FINGER_ANGLES,
    FLEXIONS,
    JOINT_AXES,
    OUTER_ANGLES,
    SIGNS,
    FingerForms,
    finger_forms,
)
from numpy_infer.hand import CHAINS, JOINTS, Hand
from numpy_infer.skeleton import BEND_NOISE, BEND_PRIOR, EULER, FARTHEST_BEND, SLOTS


def rotations_from_angles(angles: Array) -> Array:
    """`[..., 26]` radians, in the order of `hand.ANGLES` → `[..., 15, 3, 3]` parent_from_joint of
    the finger joints (Rodrigues' formula, composed in table order)."""
    signed = (angles * jnp.asarray(SIGNS).astype(angles.dtype))[..., None, None]
    cross, squared = jnp.asarray(CROSS, angles.dtype), jnp.asarray(CROSS_SQUARED, angles.dtype)
    eye = jnp.eye(3, dtype=angles.dtype)
    single = eye + jnp.sin(signed) * cross + (1 - jnp.cos(signed)) * squared
    none = jnp.broadcast_to(eye, single[..., :1, :, :].shape)
    single = jnp.concatenate([single, none], -3)
    first, second, third = (apart(single)[..., slot, :, :] for slot in SLOTS)
    return product(product(first, second), third)


def angles_from_rotations(rotations: Array) -> Array:
    """`[..., 15, 3, 3]` parent_from_joint → `[..., 26]` radians, the inverse of
    `rotations_from_angles`.

    A rotation that a joint's angles cannot express loses the part they lack. The middle angle of
    the three, abduction, lies in ±π/2: there flexion and twist are one motion and not told apart.
    """
    signs = jnp.asarray(SIGNS).astype(rotations.dtype)
    return _euler(rotations, JOINT_AXES)[..., *EULER] * signs


def _euler(rotations: Array, axes: Array) -> Array:
    """`[..., 3]` radians about x, y and z of `axes`, in that order, of `[..., 3, 3]`. The latter
    two of what the first leaves (Day 2012): near ±90° about y, where the first is hardly known,
    they make up for it."""
    axes = jnp.asarray(axes).astype(rotations.dtype)
    m = product(product(jnp.swapaxes(axes, -1, -2), rotations), axes)
    about_x = jnp.arctan2(-m[..., 1, 2], m[..., 2, 2])
    cosine, sine = jnp.cos(about_x), jnp.sin(about_x)
    left = cosine[..., None] * m[..., 1, :2] + sine[..., None] * m[..., 2, :2]
    about_y = jnp.arctan2(m[..., 0, 2], cosine * m[..., 2, 2] - sine * m[..., 1, 2])
    about_z = jnp.arctan2(left[..., 0], left[..., 1])
    return jnp.stack([about_x, about_y, about_z], -1)


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
    if wrist_rotation is None or wrist_position is None:
        wrist_rotation, wrist_position = jnp.eye(3, dtype=dtype), jnp.zeros(3, dtype)
    wrist = jnp.broadcast_to(wrist_position[..., None, :], (*batch, 1, 3))
    wrist_turn = jnp.broadcast_to(wrist_rotation[..., None, :, :], (*batch, 1, 3, 3))
    turn, place = wrist_turn, wrist
    turns, places = [], []
    for level in range(3):
        # The fingers' joints of one level, all at once.
        here = slice(1 + level, len(JOINTS), 3)
        place = place + product(turn, skeleton[..., here, :, None])[..., 0]
        turn = apart(product(turn, rotations[..., level::3, :, :]))
        turns.append(turn)
        places.append(place)
    tips = place + product(turn, skeleton[..., len(JOINTS) :, :, None])[..., 0]
    joints = jnp.stack(places, -2).reshape(*batch, 15, 3)
    finger_turns = jnp.stack(turns, -3).reshape(*batch, 15, 3, 3)
    return (
        jnp.concatenate([wrist, joints, tips], -2),
        jnp.concatenate([wrist_turn, finger_turns], -3),
    )


def in_world(
    positions: Array, rotations: Array, wrist_rotation: Array, wrist_position: Array
) -> tuple[Array, Array]:
    """Positions `[..., 21, 3]` and rotations `[..., 16, 3, 3]` of the hand frame as the wrist's
    pose `[..., 3, 3]`, `[..., 3]` has them in the world."""
    return (
        transform(wrist_rotation, wrist_position, positions),
        product(wrist_rotation[..., None, :, :], rotations),
    )


def marker_positions(hand: Hand, positions: Array, rotations: Array) -> Array:
    """`[..., M, 3]` metres: the hand's markers on `positions [..., 21, 3]` and `rotations
    [..., 16, 3, 3]` as `forward_kinematics` gives them."""
    offsets = jnp.asarray(hand.offsets).astype(positions.dtype)[..., None]
    links = rotations[..., np.array(hand.links), :, :]
    return positions[..., np.array(hand.joints), :] + product(links, offsets)[..., 0]


def flat_calibrated(rotations: Array, flat: Array) -> Array:
    """`[..., 15, 3, 3]` parent_from_joint as the flat pose calibrates it (paper, section 2.2): the
    inverse of what is predicted while the user holds a flat hand, composed onto each prediction.

    Args:
        rotations: `[..., 15, 3, 3]` parent_from_joint as predicted.
        flat: `[15, 3, 3]` as predicted for the flat hand.
    """
    return product(flat.swapaxes(-1, -2), rotations)


def align_fingers(
    hand: Hand, positions: Array, rotations: Array, markers: Array, weight: Array | None = None
) -> tuple[Array, Array]:
    """Turns each finger about its base until its outermost marker points to where it was measured
    (paper, section 2.2: finger alignment).

    Args:
        hand: its markers and their offsets.
        positions: `[..., 21, 3]` metres, as `forward_kinematics` gives them, in any frame.
        rotations: `[..., 16, 3, 3]` frame_from_joint, likewise.
        markers: `[..., M, 3]` metres, in that frame; finite where the weight is not 0.
        weight: `[..., M]` in 0 to 1: the share of the arc that a marker is worth; else all of it.

    Returns:
        Positions and rotations, as given.
    """
    ends, has = hand.end_markers
    batch = positions.shape[:-2]
    base = positions[..., 1:16:3, :]
    modelled = marker_positions(hand, positions, rotations)[..., ends, :] - base
    share = has.astype(positions.dtype) * (1 if weight is None else weight[..., ends])
    measured = jnp.where(share[..., None] > 0, markers[..., ends, :] - base, modelled)
    turn = apart(shortest_arc(modelled, measured, share))
    fingers = rotations[..., 1:, :, :].reshape(*batch, 5, 3, 3, 3)
    turned = product(turn[..., None, :, :], fingers).reshape(*batch, 15, 3, 3)
    beyond = np.array(CHAINS)[:, 1:]
    arms = positions[..., beyond, :] - base[..., None, :]
    moved = product(arms, turn.swapaxes(-1, -2)) + base[..., None, :]
    return (
        positions.at[..., beyond, :].set(moved),
        jnp.concatenate([rotations[..., :1, :, :], turned], -3),
    )


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
    ends, has = hand.end_markers
    base = jnp.asarray(hand.skeleton, dtype)[1:16:3]
    waves = _waves(angles[..., FINGER_ANGLES])
    turn = _form(waves[..., 0, :, :], BASE_FORM).reshape(*batch, 5, 3, 3)
    own = _form(waves[..., 1, :, :], _forms_of(hand).beyond).reshape(*batch, 5, 3, 10)
    if markers is not None:
        modelled = product(turn, own[..., 9:])[..., 0]
        measured = jnp.where(has[:, None] > 0, markers[..., ends, :] - base, modelled)
        turn = apart(product(apart(shortest_arc(modelled, measured)), turn))
        signs = jnp.asarray(SIGNS[BASE_ANGLES]).astype(dtype)
        angles = angles.at[..., BASE_ANGLES].set(_euler(turn, JOINT_AXES[::3]) * signs)
    placed = apart(product(turn, own[..., :9]))
    points = jnp.swapaxes(placed[..., :3], -1, -2) + base[:, None, :]
    joints = jnp.concatenate([jnp.broadcast_to(base, (*batch, 5, 3))[..., None, :], points], -2)
    wrist = jnp.zeros((*batch, 1, 3), dtype)
    inner = joints[..., :3, :].reshape(*batch, 15, 3)
    positions = jnp.concatenate([wrist, inner, joints[..., 3, :]], -2)
    turns = jnp.stack([turn, placed[..., 3:6], placed[..., 6:]], -3).reshape(*batch, 15, 3, 3)
    eye = jnp.broadcast_to(jnp.eye(3, dtype=dtype), (*batch, 1, 3, 3))
    rotations = jnp.concatenate([eye, turns], -3)
    if wrist_rotation is None or wrist_position is None:
        return angles, positions, rotations
    return angles, *in_world(positions, rotations, wrist_rotation, wrist_position)


def _waves(angles: Array) -> Array:
    """`[..., 3]` 1, cosine and sine of `[...]`."""
    return jnp.stack([jnp.ones_like(angles), jnp.cos(angles), jnp.sin(angles)], -1)


def _forms_of(hand: Hand) -> FingerForms:
    """`finger_forms`, which may be asked of a traced hand."""
    with jax.default_matmul_precision("highest"):
        return finger_forms(hand, jnp)


def _form(waves: Array, form: Array) -> Array:
    """`[..., 5, K]` by each finger's `form [5, 27, K]`: linear in products of the 1, cosine and
    sine of its three angles, `waves [..., 5, 3, 3]`, the last one's running fastest."""
    table = jnp.asarray(form, waves.dtype).reshape(5, 3, 3, 3, -1)
    of_each = (waves[..., i, :] for i in range(3))
    return jnp.einsum(
        "...fi,...fj,...fk,fijko->...fo", *of_each, table, precision="highest", optimize="optimal"
    )


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
    dtype = angles.dtype
    value = _waves(angles[..., OUTER_ANGLES])
    zero = jnp.zeros_like(value[..., 0])
    slope = jnp.stack([zero, -value[..., 2], value[..., 1]], -1)
    by_first, by_last = (value.at[..., i, :].set(slope[..., i, :]) for i in (0, 2))
    form = _forms_of(hand).square
    square, *sloping = (_form(waves, form)[..., 0] for waves in (value, by_first, by_last))
    reach = jnp.sqrt(jnp.maximum(square, 0))
    slopes = jnp.stack(sloping, -1) / (2 * jnp.where(reach > 0, reach, 1))[..., None]
    target = markers[..., ends, :] - jnp.asarray(hand.skeleton, dtype)[1:16:3]
    short = has.astype(dtype) * (jnp.sqrt((target * target).sum(-1)) - reach)
    damped = (slopes * slopes).sum(-1) + (BEND_NOISE / BEND_PRIOR) ** 2
    bend = jnp.clip(slopes * (short / damped)[..., None], -FARTHEST_BEND, FARTHEST_BEND)
    return angles.at[..., FLEXIONS].add(bend)
