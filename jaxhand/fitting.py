"""Joint angles that bring a skeleton to given joint positions: damped least squares.

The fingers share no angle, so each is a problem of its own with at most 6 unknowns: one tangent
moves the k-th angle of all five at once, which makes the Jacobian six columns wide instead of 26.
Frames are mapped, not vmapped, on the CPU: there that is ten times as fast, because XLA fuses a
batch into loops that compute the same sines again and again, and each frame stops when it is done.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxhand.geometry import product, solve
from jaxhand.skeleton import forward_kinematics, rotations_from_angles
from numpy_infer.arrays import Array
from numpy_infer.finger_forms import JOINT_AXES
from numpy_infer.hand import (
    ANGLE_AT,
    ANGLES,
    CHAINS,
    FINGER_OF_ANGLE,
    FINGERS,
    HIGH,
    JOINTS,
    LOW,
    PARENTS,
    POINTS,
    SLOT_OF_ANGLE,
)

ITERATIONS = 100
TOLERANCE = 1e-4
"""Radians: a frame is done when no step is larger. Steps shrink quadratically."""
CHUNK = 512
"""Frames in one call: a fixed number, so that one compilation serves recordings of any length."""

NOISE = 1e-3
"""Metres per axis. The scale of a residual: what one standard deviation of a position is."""
TWIST_PRIOR = 0.5
"""Radians: the standard deviation of a twist about 0. `NOISE` / `TWIST_PRIOR`, 2 mm, weigh as much
as a radian. A straight thumb leaves its twist open, and with a weaker prior it jumps between ±50°
from frame to frame, the thumb's other angles with it; this one costs 0.1 to 0.2 mm at the thumb."""
RANGE_PRIOR = 0.1
"""Radians. The same for the part of an angle outside of its range. It keeps a straight finger whose
tip lies aside, which hinges cannot express, from being twisted by 70°."""

REST_EVERY, REST_ROUNDS = 10, 2
"""Every how many-th frame the bones' rest directions are taken from, and rounds of it."""

_WIDTH = ANGLE_AT.shape[1]
_POINT = np.array(CHAINS)[:, 1:]
"""`[5, 3]` the points of each finger that its angles move."""

_LOW, _HIGH = np.float32(LOW), np.float32(HIGH)
_TWIST = np.array([a.name.endswith("_twist") for a in ANGLES], np.float32)


class FitResult(NamedTuple):
    """angles: `[T, 26]` radians, order of `hand.ANGLES`. residual: `[T, 21]` metres, distance of
    each fitted point from the given one; NaN where none was given. Both float32."""

    angles: Array
    residual: Array


def fit_angles(skeleton: Array, points: Array, weight: Array | None = None) -> FitResult:
    """Fits the joint angles of every frame by itself (Levenberg 1944, Marquardt 1963).

    Twists that the points do not determine come out as 0, and angles outside of their range are
    drawn back weakly, see `TWIST_PRIOR` and `RANGE_PRIOR`. Frames do not influence each other.

    Args:
        skeleton: `[21, 3]` metres, each point from its parent in the flat hand.
        points: `[T, 21, 3]` metres, hand frame. A point that is not finite counts for nothing.
        weight: `[21]`, not negative; default 1 each. The wrist and the fingers' bases do not move
            with any angle: their weights have no effect.

    Raises:
        ValueError: an argument of another shape.
    """
    weight = np.ones(len(POINTS)) if weight is None else np.asarray(weight)
    for name, array, shape in (
        ("skeleton", np.asarray(skeleton), (len(POINTS), 3)),
        ("points", np.asarray(points), (*np.shape(points)[:1], len(POINTS), 3)),
        ("weight", weight, (len(POINTS),)),
    ):
        if array.shape != shape:
            raise ValueError(f"{name}: expected shape {list(shape)}, got {list(array.shape)}")
    points = np.asarray(points, np.float32)
    fitted = [FitResult(np.zeros((0, len(ANGLES))), np.zeros((0, len(POINTS))))]
    with jax.default_device(jax.local_devices(backend="cpu")[0]):
        for start in range(0, len(points), CHUNK):
            chunk = points[start : start + CHUNK]
            padded = np.concatenate([chunk, np.repeat(chunk[-1:], CHUNK - len(chunk), 0)])
            result = _fit_chunk(np.float32(skeleton), padded, np.float32(weight))
            fitted.append(FitResult(*(np.asarray(array)[: len(chunk)] for array in result)))
    return FitResult(
        *(np.concatenate(arrays, dtype=np.float32) for arrays in zip(*fitted, strict=True))
    )


def rest_directions(skeleton: Array, points: Array) -> Array:
    """`[21, 3]` metres: the skeleton with every bone beyond a finger's base laid as the joint that
    carries it has it on average, lengths kept: no hinge is quite square to its bones. What the
    angles' ranges hold back goes into the bones, too, so the recording should not be out of them.

    Args:
        skeleton: `[21, 3]` metres, each point from its parent in the flat hand.
        points: `[T, 21, 3]` metres, hand frame; frames with a point that is not finite are left
            out.
    """
    points = np.asarray(points, np.float32)
    points = points[np.isfinite(points).all((-1, -2))][::REST_EVERY]
    carried = [i for i, parent in enumerate(PARENTS) if parent > 0]
    carriers = [PARENTS[i] for i in carried]
    bones = points[:, carried] - points[:, carriers]
    laid = np.array(skeleton)
    for _ in range(REST_ROUNDS if len(points) else 0):
        angles = fit_angles(laid, points).angles
        with jax.default_device(jax.local_devices(backend="cpu")[0]):
            turns = rotations_from_angles(jnp.asarray(angles))
            _, rotations = forward_kinematics(jnp.asarray(laid, jnp.float32), turns)
        own = (bones[..., None, :] @ np.asarray(rotations)[:, carriers])[..., 0, :].mean(0)
        lengths = np.linalg.norm(laid[carried], axis=-1) / np.linalg.norm(own, axis=-1)
        laid[carried] = own * lengths[:, None]
    return laid


def angle_deviation(skeleton: Array, angles: Array) -> Array:
    """`[26]` radians: how well points known to `NOISE` determine each angle, root mean square over
    the frames of `angles [T, 26]`.

    In a frame it is the standard deviation that linearised least squares give, the diagonal of the
    inverse Gauss-Newton matrix, with `TWIST_PRIOR`: a straight finger leaves its twist open.
    """
    with jax.default_device(jax.local_devices(backend="cpu")[0]):
        matrices = np.asarray(_information(np.float32(skeleton), np.float32(angles)), np.float64)
    variance = np.diagonal(np.linalg.inv(matrices), axis1=-2, axis2=-1)
    return np.sqrt(variance.mean(0)[FINGER_OF_ANGLE, SLOT_OF_ANGLE])


class _State(NamedTuple):
    """angles `[26]`; cost and damping `[5]`, one for each finger; the number of steps made; the
    largest angle that the last one asked for."""

    angles: Array
    cost: Array
    damping: Array
    steps: Array
    move: Array


@jax.jit
def _fit_chunk(skeleton: Array, points: Array, weight: Array) -> FitResult:
    return jax.lax.map(lambda frame: _fit_frame(skeleton, frame, weight), points)


def _fit_frame(skeleton: Array, points: Array, weight: Array) -> FitResult:
    seen = jnp.isfinite(points).all(-1)
    points = jnp.where(seen[:, None], points, 0)
    scale = jnp.sqrt(jnp.where(seen, weight, 0)) / NOISE

    def residuals(angles: Array) -> Array:
        """`[5, 9 + 12]` in standard deviations: the fingers' points, then the priors."""
        off = (_pose(skeleton, angles)[0] - points) * scale[:, None]
        return jnp.concatenate([_by_finger(off), _priors(angles)], -1)

    def step(state: _State) -> _State:
        rows = _jacobian(residuals, state.angles)
        gradient = (rows * residuals(state.angles)[:, None]).sum(-1)
        matrix = product(rows, jnp.swapaxes(rows, -1, -2))
        move = solve(matrix + state.damping[:, None, None] * jnp.eye(_WIDTH), gradient)
        angles = state.angles - move[FINGER_OF_ANGLE, SLOT_OF_ANGLE]
        cost = (residuals(angles) ** 2).sum(-1)
        better = cost < state.cost
        return _State(
            jnp.where(better[FINGER_OF_ANGLE], angles, state.angles),
            jnp.where(better, cost, state.cost),
            jnp.clip(state.damping * jnp.where(better, 0.1, 10), 1e-6, 1e8),
            state.steps + 1,
            jnp.abs(move).max(),
        )

    def unfinished(state: _State) -> Array:
        return (state.steps < ITERATIONS) & (state.move > TOLERANCE)

    angles = _start(points)
    cost = (residuals(angles) ** 2).sum(-1)
    first = _State(angles, cost, jnp.full_like(cost, 1e-3), jnp.array(0), jnp.array(jnp.inf))
    angles = jax.lax.while_loop(unfinished, step, first).angles
    residual = jnp.linalg.norm(_pose(skeleton, angles)[0] - points, axis=-1)
    return FitResult(angles, jnp.where(seen, residual, jnp.nan))


def _start(points: Array) -> Array:
    """`[26]` angles that turn straight fingers along the given bones, without any twist. From afar
    the least squares would fall for a finger that bends backwards and is twisted by π."""
    angles = jnp.zeros(len(ANGLES), points.dtype)
    for level in range(3):
        joints, ends = np.array(CHAINS)[:, level], np.array(CHAINS)[:, level + 1]
        turns = _pose(jnp.zeros_like(points), angles)[1][joints]
        axes = product(turns, jnp.asarray(JOINT_AXES[joints - 1], points.dtype))
        x, y, z = ((points[ends] - points[joints])[..., None] * axes).sum(-2).T
        about = {"x": jnp.arctan2(y, -z), "y": jnp.arctan2(-x, jnp.hypot(y, z))}
        for i, angle in enumerate(ANGLES):
            if JOINTS.index(angle.joint) in joints and angle.axis in about:
                angles = angles.at[i].set(angle.sign * about[angle.axis][FINGER_OF_ANGLE[i]])
    return angles


@jax.jit
def _information(skeleton: Array, angles: Array) -> Array:
    """`[T, 5, 6, 6]` the fingers' Gauss-Newton matrices, with 1 for a slot that is not used."""

    def residuals(angles: Array) -> Array:
        points = _by_finger(_pose(skeleton, angles)[0]) / NOISE
        return jnp.concatenate([points, _priors(angles)], -1)

    def information(angles: Array) -> Array:
        rows = _jacobian(residuals, jnp.clip(angles, _LOW, _HIGH))
        return product(rows, jnp.swapaxes(rows, -1, -2))

    unused = jnp.asarray(len(ANGLES) == ANGLE_AT, jnp.float32)
    return jax.lax.map(information, angles) + unused[..., None] * jnp.eye(_WIDTH)


def _pose(skeleton: Array, angles: Array) -> tuple[Array, Array]:
    """Points `[21, 3]` metres, hand frame, and rotations `[16, 3, 3]` hand_from_joint."""
    eye, zero = jnp.eye(3, dtype=angles.dtype), jnp.zeros(3, angles.dtype)
    return forward_kinematics(skeleton, rotations_from_angles(angles), eye, zero)


def _by_finger(of_points: Array) -> Array:
    """`[21, 3]` → `[5, 9]`, without wrist and bases."""
    return of_points[_POINT].reshape(len(FINGERS), -1)


def _priors(angles: Array) -> Array:
    """`[5, 12]` twists and trespasses, in standard deviations; 0 in a slot that is not used."""
    beyond = angles - jnp.clip(angles, _LOW, _HIGH)
    both = jnp.stack([angles * _TWIST / TWIST_PRIOR, beyond / RANGE_PRIOR])
    both = jnp.concatenate([both, jnp.zeros((2, 1))], -1)[:, ANGLE_AT]
    return jnp.concatenate([both[0], both[1]], -1)


def _jacobian(residuals: Callable[[Array], Array], angles: Array) -> Array:
    """`[5, 6, N]` derivative of each finger's N residuals by each of its 6 slots."""

    def moved(slots: Array) -> Array:
        return residuals(angles + slots[SLOT_OF_ANGLE])

    return jnp.swapaxes(jax.jacfwd(moved)(jnp.zeros(_WIDTH, angles.dtype)), -1, -2)
