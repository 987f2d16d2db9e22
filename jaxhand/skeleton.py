"""From joint angles to positions and back. Twin of `numpy_infer.skeleton`."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from jaxhand.geometry import apart, product
from numpy_infer.arrays import Array
from numpy_infer.hand import JOINTS, Hand
from numpy_infer.skeleton import CROSS, CROSS_SQUARED, EULER, JOINT_AXES, SIGNS, SLOTS


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
