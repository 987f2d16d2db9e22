"""From joint angles to positions and back. Twin of `numpy_infer.skeleton`."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from jaxhand.geometry import apart, cross, product, shortest_arc
from numpy_infer.arrays import Array
from numpy_infer.hand import JOINTS, Hand
from numpy_infer.skeleton import (
    BEND_NOISE,
    BEND_PRIOR,
    CROSS,
    CROSS_SQUARED,
    EULER,
    FARTHEST_BEND,
    HINGE_AXES,
    HINGE_CROSS,
    HINGE_SQUARED,
    HINGES,
    JOINT_AXES,
    SIGNS,
    SLOTS,
)


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
    axes = jnp.asarray(JOINT_AXES).astype(rotations.dtype)
    m = product(product(jnp.swapaxes(axes, -1, -2), rotations), axes)
    about_x = jnp.arctan2(-m[..., 1, 2], m[..., 2, 2])
    about_y = jnp.arctan2(m[..., 0, 2], jnp.sqrt(m[..., 0, 0] ** 2 + m[..., 0, 1] ** 2))
    about_z = jnp.arctan2(-m[..., 0, 1], m[..., 0, 0])
    euler = jnp.stack([about_x, about_y, about_z], -1)
    return euler[..., *EULER] * jnp.asarray(SIGNS).astype(rotations.dtype)


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
    measured = jnp.where(share[..., None] > 0, markers[..., ends, :] - base, modelled)
    turn = shortest_arc(modelled, measured, share)
    wrist = rotations[..., :1, :, :]
    turn = product(product(wrist.swapaxes(-1, -2), turn), wrist)
    return local.at[..., ::3, :, :].set(product(turn, local[..., ::3, :, :]))


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
    reach = jnp.sqrt((way * way).sum(-1))
    target = jnp.where(share[..., None] > 0, markers[..., ends, :] - base, way)
    short = share * (jnp.sqrt((target * target).sum(-1)) - reach)
    direction = way / jnp.where(reach > 0, reach, 1)[..., None]
    axes = product(rotations[..., HINGES, :, :], jnp.asarray(HINGE_AXES, local.dtype))[..., 0]
    arms = modelled[..., None, :] - positions[..., 1 + HINGES, :]
    carried = jnp.asarray(hand.placing[1][ends][:, None] > HINGES, local.dtype)
    slopes = (cross(axes, arms) * direction[..., None, :]).sum(-1) * carried
    damped = (slopes * slopes).sum(-1) + (BEND_NOISE / BEND_PRIOR) ** 2
    bend = jnp.clip(slopes * (short / damped)[..., None], -FARTHEST_BEND, FARTHEST_BEND)
    bend = bend[..., None, None]
    turn = jnp.sin(bend) * jnp.asarray(HINGE_CROSS, local.dtype)
    turn += (1 - jnp.cos(bend)) * jnp.asarray(HINGE_SQUARED, local.dtype)
    turn += jnp.eye(3, dtype=local.dtype)
    return local.at[..., HINGES, :, :].set(product(turn, local[..., HINGES, :, :]))
