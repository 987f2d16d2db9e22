"""Inverse kinematics by cyclic coordinate descent: the paper's rival (section 6.2.2, Table 4).

The skeleton is known, the markers are few. Frames are mapped, not vmapped, as in `jaxhand.fitting`:
all of this runs on the CPU.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxhand.geometry import cross, inner, kabsch, product, rotation_from_vector, untransform
from jaxhand.skeleton import (
    angles_from_rotations,
    forward_kinematics,
    marker_positions,
    rotations_from_angles,
)
from numpy_infer.arrays import Array
from numpy_infer.finger_forms import JOINT_AXES, SIGNS
from numpy_infer.hand import ANGLES, FINGERS, JOINTS, Hand

SWEEPS = 100
"""Markers within reach are then within 1 mm, and ten times as many change Table 4 by 1 to 2 %."""

ROOT_LIMIT, TWIST_LIMIT, HINGE_LIMITS = 45.0, 20.0, (-10.0, 90.0)
"""Degrees: the paper's limits of its fine-tuned rival."""


class Solved(NamedTuple):
    """Postures that were found for frames `[...]`."""

    rotations: Array
    """`[..., 15, 3, 3]` parent_from_joint of the finger joints."""
    angles: Array
    """`[..., 26]` radians, re-read from the rotations: a free ball joint turns in ways that the
    angles of a hinge lack."""
    positions: Array
    """`[..., 21, 3]` metres, world: joints and tips, by the rotations."""
    wrist_rotation: Array
    """`[..., 3, 3]` world_from_wrist."""
    wrist_position: Array
    """`[..., 3]` metres, world."""


def ccd(hand: Hand, markers: Array, *, tuned: bool, sweeps: int = SWEEPS) -> Solved:
    """Cyclic coordinate descent (Wang & Chen 1991), each frame by itself and from the flat hand.

    From the tips to the bases, and again, each joint turns so far that the markers it carries come
    as near to the measured ones as its turn alone can bring them: a hinge about its own axis and
    within its limits, a ball joint about the axis of the torque with which the measured markers
    would pull. With one marker, the finger's tip, that is the shortest arc. Both markers of the
    thumb pull at its base, its tip alone at the joints after it. The wrist's pose comes from the
    alignment markers. A marker exactly on the line of a straight finger leaves it straight.

    The paper names the solver and the limits. It is silent about order, start, number of sweeps and
    how limits act; these are the method's usual ones, with a root joint that has limits taken as
    three hinges, flexion first.

    Args:
        hand: the markers, on the bones of the person measured.
        markers: `[..., M, 3]` metres, world. One that is not finite does not pull.
        tuned: False for the paper's unconstrained rival: every joint is a free ball joint. True for
            the fine-tuned one: root joints, that is MCP and the thumb's CMC, turn by ±45° in
            flexion, ±45° in abduction and ±20° in twist; the joints after them are hinges, −90° to
            10° in the paper's sign, where flexion is negative, so −10° to 90° of flexion in ours.
        sweeps: how often all joints turn.

    Raises:
        ValueError: markers of another shape.
    """
    with jax.default_device(jax.local_devices(backend="cpu")[0]):
        markers, seen, batch = flat_frames(hand, markers, None)
        return shaped(_descend(hand, markers, seen, tuned, sweeps), batch)


def flat_frames(
    hand: Hand, markers: Array, visible: Array | None
) -> tuple[Array, Array, tuple[int, ...]]:
    """Checks shapes and lays `[..., M, 3]` markers out as N frames, so that a shape of another rank
    compiles nothing anew.

    Returns:
        markers `[N, M, 3]`, 0 where hidden; `[N, M]` True where they are not; the leading shape.
    """
    shape = list(np.shape(markers))
    if shape[-2:] != [len(hand), 3]:
        raise ValueError(f"markers: expected shape [..., {len(hand)}, 3], got {shape}")
    markers = jnp.asarray(markers)
    seen = jnp.isfinite(markers).all(-1)
    if visible is not None:
        if list(np.shape(visible)) != shape[:-1]:
            raise ValueError(f"visible: expected shape {shape[:-1]}, got {list(np.shape(visible))}")
        seen &= jnp.asarray(visible, bool)
    markers = jnp.where(seen[..., None], markers, 0)
    count = math.prod(shape[:-2])
    flat = markers.reshape(count, *shape[-2:]), seen.reshape(count, shape[-2])
    return *flat, tuple(shape[:-2])


def shaped(solved: Solved, batch: tuple[int, ...]) -> Solved:
    """N frames with their leading shape again."""
    return Solved(*(array.reshape(*batch, *array.shape[1:]) for array in solved))


def solved_from(hand: Hand, rotations: Array, rotation: Array, position: Array) -> Solved:
    """All there is of `rotations [..., 15, 3, 3]` and the wrist's pose."""
    skeleton = jnp.asarray(hand.skeleton).astype(rotations.dtype)
    positions, _ = forward_kinematics(skeleton, rotations, rotation, position)
    angles = angles_from_rotations(rotations)
    return Solved(rotations, angles, positions, rotation, position)


def in_hand_frame(hand: Hand, rotations: Array) -> tuple[Array, Array, Array]:
    """Markers `[..., M, 3]`, positions `[..., 21, 3]` and rotations `[..., 16, 3, 3]` in the hand
    frame."""
    dtype = rotations.dtype
    skeleton = jnp.asarray(hand.skeleton).astype(dtype)
    eye, zero = jnp.eye(3, dtype=dtype), jnp.zeros(3, dtype)
    positions, turns = forward_kinematics(skeleton, rotations, eye, zero)
    return marker_positions(hand, positions, turns), positions, turns


_TURNS = ((2, "x"), (1, "x"), (0, "x"), (0, "y"), (0, "z"))
"""In the order of a sweep: level of the joints, and the axis of their own that they turn about. The
twist of a root joint last: before it, it takes on what flexion is for."""


def _angles_at(level: int, axis: str) -> Array:
    """`[5]` the angle about the axis of each finger's joint of a level."""
    joints = JOINTS[1 + level :: 3]
    return np.array([[(a.joint, a.axis) for a in ANGLES].index((joint, axis)) for joint in joints])


def _limits() -> tuple[Array, Array]:
    """`[26]` radians each: the paper's limits; 0 for an angle that its hinges lack."""
    limits = np.zeros((len(ANGLES), 2))
    limits[_angles_at(0, "x")] = limits[_angles_at(0, "y")] = -ROOT_LIMIT, ROOT_LIMIT
    limits[_angles_at(0, "z")] = -TWIST_LIMIT, TWIST_LIMIT
    limits[_angles_at(1, "x")] = limits[_angles_at(2, "x")] = HINGE_LIMITS
    low, high = np.radians(limits).T
    return low, high


_LOW, _HIGH = _limits()


def _pulling(hand: Hand) -> tuple[Array, Array]:
    """The markers of each finger `[5, K]`, and `[3, 5, K]` 1 for those that its first, second and
    third joint carry."""
    own = hand.finger_markers
    width = max(map(len, own))
    index = np.array([(*markers, *[0] * (width - len(markers))) for markers in own])
    carried = np.zeros((3, len(FINGERS), width))
    for finger, markers in enumerate(own):
        for place, marker in enumerate(markers):
            carried[: (hand.links[marker] - 1) % 3 + 1, finger, place] = 1
    return index, carried


@partial(jax.jit, static_argnums=(0, 3))
def _descend(hand: Hand, markers: Array, seen: Array, tuned: bool, sweeps: Array) -> Solved:
    dtype = markers.dtype
    template = jnp.asarray(hand.template).astype(dtype)
    weight = seen.astype(dtype) * jnp.asarray(hand.alignment_weight).astype(dtype)
    rotation, position = kabsch(template, markers, weight, jnp.eye(3, dtype=dtype))
    targets = untransform(rotation, position, markers)
    descent = partial(_by_hinges if tuned else _by_balls, hand, sweeps)
    turns = jax.lax.map(lambda frame: descent(*frame), (targets, seen))
    return solved_from(hand, turns, rotation, position)


def _by_balls(hand: Hand, sweeps: Array, target: Array, seen: Array) -> Array:
    """`[15, 3, 3]` rotations for the targets `[M, 3]` of one frame, hand frame."""
    covariances = _covariances(hand, target, seen)
    flexion = jnp.asarray(JOINT_AXES[:, :, 0]).astype(target.dtype)

    def sweep(_: int, turns: Array) -> Array:
        for level in (2, 1, 0):
            covariance, rotations = covariances(turns, level)
            # Into the joint's own frame: a turn there comes after those that it has made.
            covariance = product(product(jnp.swapaxes(rotations, -1, -2), covariance), rotations)
            move = _turn(_torque_axis(covariance, flexion[level::3]), covariance)
            turns = turns.at[level::3].set(product(turns[level::3], move))
        return turns

    flat = jnp.broadcast_to(jnp.eye(3, dtype=target.dtype), (len(JOINTS) - 1, 3, 3))
    return jax.lax.fori_loop(0, sweeps, sweep, flat)


def _by_hinges(hand: Hand, sweeps: Array, target: Array, seen: Array) -> Array:
    """The same within the limits. A root joint is three hinges, one behind the other."""
    covariances = _covariances(hand, target, seen)
    x, y, z = jnp.moveaxis(jnp.asarray(JOINT_AXES).astype(target.dtype), -1, 0)
    low, high = (jnp.asarray(limit).astype(target.dtype) for limit in (_LOW, _HIGH))

    def sweep(_: int, angles: Array) -> Array:
        for level, about in _TURNS:
            which = _angles_at(level, about)
            turns = rotations_from_angles(angles)
            covariance, rotations = covariances(turns, level)
            own = jnp.swapaxes(turns[level::3], -1, -2)
            axis = {"x": product(own, x[level::3, :, None])[..., 0], "z": z[level::3]}
            # What is turned about last turns with the joint, what is first stays with its parent;
            # between them is what is square to both.
            axis["y"] = _unit(cross(axis["z"], axis["x"]), y[level::3])
            world = product(rotations, axis[about][..., None])[..., 0]
            move = jnp.arctan2(*_sine_and_cosine(world, covariance))
            sign = jnp.asarray(SIGNS[which]).astype(target.dtype)
            # Nearest on the circle: 250 degrees of flexion are -110, and nearer to -10 than to 90.
            middle = (low[which] + high[which]) / 2
            off = angles[which] + sign * move - middle
            off = off - 2 * np.pi * jnp.round(off / (2 * np.pi))
            reach = (high[which] - low[which]) / 2
            angles = angles.at[which].set(middle + jnp.clip(off, -reach, reach))
        return angles

    flat = jnp.zeros(len(ANGLES), target.dtype)
    return rotations_from_angles(jax.lax.fori_loop(0, sweeps, sweep, flat))


def _covariances(hand: Hand, target: Array, seen: Array) -> Callable[..., tuple[Array, Array]]:
    """A function of `turns [15, 3, 3]` and a level: for each finger's joint of that level the sum
    of `is wantedᵀ`, `[5, 3, 3]` m², over the markers that it carries, seen from it along the hand's
    axes; and hand_from_joint `[5, 3, 3]`."""
    index, carried = _pulling(hand)
    pull = jnp.asarray(carried).astype(target.dtype) * seen[index].astype(target.dtype)

    def covariances(turns: Array, level: int) -> tuple[Array, Array]:
        here = slice(1 + level, len(JOINTS), 3)
        markers, positions, rotations = in_hand_frame(hand, turns)
        pivots = positions[here, None]
        weighed = (markers[index] - pivots) * pull[level, ..., None]
        return inner(weighed, target[index] - pivots), rotations[here]

    return covariances


def _torque(covariance: Array) -> Array:
    """`[..., 3]` m²: the sum of `is × wanted`, out of that of `is wantedᵀ`, `[..., 3, 3]`."""
    c = covariance
    x, y, z = (c[..., i, j] - c[..., j, i] for i, j in ((1, 2), (2, 0), (0, 1)))
    return jnp.stack([x, y, z], -1)


def _torque_axis(covariance: Array, otherwise: Array) -> Array:
    """`[..., 3]` unit axis of the torque; `otherwise`, flexion's, where there is none: a marker
    straight behind the joint can be reached by any turn of π."""
    return _unit(_torque(covariance), otherwise)


def _unit(vector: Array, otherwise: Array) -> Array:
    size = jnp.sqrt((vector * vector).sum(-1, keepdims=True))
    return jnp.where(size > 0, vector / jnp.where(size > 0, size, 1), otherwise)


def _sine_and_cosine(axis: Array, covariance: Array) -> tuple[Array, Array]:
    """`[...]` each, times one number that is not negative: of the turn about a unit axis `[..., 3]`
    that brings the points nearest to where they are wanted. Both are 0 if any turn is as good."""
    along = (axis[..., :, None] * axis[..., None, :] * covariance).sum((-1, -2))
    cosine = jnp.trace(covariance, axis1=-2, axis2=-1) - along
    return (axis * _torque(covariance)).sum(-1), cosine


def _turn(axis: Array, covariance: Array) -> Array:
    """`[..., 3, 3]` that turn as a rotation."""
    angle = jnp.arctan2(*_sine_and_cosine(axis, covariance))
    return rotation_from_vector(axis * angle[..., None])
