"""The likeliest posture for a few markers, some of them hidden: least squares with a prior.

A rival of the joint network that has the bones, which the network has not, and a Gaussian for what
hands do. Frames are mapped, not vmapped, as in `jaxhand.fitting`: all of this runs on the CPU.
"""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxhand.geometry import cross, kabsch, product, transform, untransform
from jaxhand.ik import Solved, flat_frames, in_hand_frame, shaped, solved_from
from jaxhand.skeleton import rotations_from_angles
from numpy_infer.arrays import Array
from numpy_infer.hand import ANGLES, FINGER_OF_ANGLE, HIGH, LOW, SLOT_OF_ANGLE, Hand

NOISE = 1e-3
"""Metres per axis: what one standard deviation of a marker is."""
RANGE_PRIOR = 0.1
"""Radians. The same for the part of an angle outside of its range."""
FLOOR = np.radians(3)
"""Radians: widens every angle's spread (in squares), for training hands are never all there is.
Validation is best with 3 degrees under noise and with markers hidden; 1 and 5 differ by 2 %."""
WRIST_PRIOR = (0.5, 0.1)
"""Radians and metres: standard deviations of the wrist from where it starts. Wide, so that they
only speak where fewer than three markers are seen."""
OTHERS = 0.01
"""Weight, for the start, of a marker that does not give the hand's pose, beside 1 of one that does:
a finger is not where the mean posture has it, but better than nothing if alignment markers hide."""
STEPS = 30
TOLERANCE = 3e-3
"""Radians: a frame is done when no angle's step is larger. Steps shrink quadratically."""


class PosePrior(NamedTuple):
    """Angles as a Gaussian: `mean + factor @ z` with standard normal z."""

    mean: Array
    """`[26]` radians."""
    factor: Array
    """`[26, 26]` radians: Cholesky factor of the covariance, which joins the fingers."""


def prior_of(angles: Array) -> PosePrior:
    """The Gaussian of training angles `[N, 26]` (radians), widened by `FLOOR`; float32.

    Raises:
        ValueError: another shape, no frame, or an angle that is not finite.
    """
    angles = np.asarray(angles, np.float64)
    if angles.ndim != 2 or angles.shape[1] != len(ANGLES) or not len(angles):
        raise ValueError(f"angles: expected shape [N, {len(ANGLES)}], got {list(angles.shape)}")
    if not np.isfinite(angles).all():
        raise ValueError("angles: expected finite numbers")
    covariance = np.cov(angles.T, bias=True) + FLOOR**2 * np.eye(len(ANGLES))
    factor = np.linalg.cholesky(covariance)
    return PosePrior(angles.mean(0).astype(np.float32), factor.astype(np.float32))


def least_squares(
    hand: Hand,
    markers: Array,
    prior: PosePrior,
    *,
    visible: Array | None = None,
    start: tuple[Array, Array] | None = None,
) -> Solved:
    """The likeliest posture: markers known to `NOISE`, angles out of `prior` and hardly out of
    their ranges; each frame by itself (Levenberg 1944, Marquardt 1963).

    All 26 angles and the wrist's pose are free: with 1 mm of noise that is a little better than a
    wrist held where the alignment markers have it, and with one of those hidden far better. What
    is hidden counts for nothing: the prior fills it in, from the other fingers too. Where fewer
    than three markers are seen, the wrist stays near its start.

    Args:
        hand: the markers, on the bones of the person measured.
        markers: `[..., M, 3]` metres, world. One that is not finite is hidden.
        prior: of the angles.
        visible: `[..., M]` True where measured; default all.
        start: where to begin, world_from_wrist `[..., 3, 3]` and `[..., 3]` metres, or one for all
            frames; default: where the markers have the mean posture, see `OTHERS`.

    Raises:
        ValueError: an argument of another shape.
    """
    with jax.default_device(jax.local_devices(backend="cpu")[0]):
        markers, seen, batch = flat_frames(hand, markers, visible)
        if start is not None:
            rotation, position = start
            start = (
                jnp.broadcast_to(rotation, (*batch, 3, 3)).reshape(-1, 3, 3),
                jnp.broadcast_to(position, (*batch, 3)).reshape(-1, 3),
            )
        return shaped(_fit(hand, markers, seen, prior, start), batch)


class _State(NamedTuple):
    """unknowns `[32]`, in standard deviations of their prior: angles by its factor, then the
    wrist's turn and shift. Cost and damping; the number of steps made; the largest turn, in
    radians, that the last one asked for."""

    unknowns: Array
    cost: Array
    damping: Array
    steps: Array
    move: Array


@partial(jax.jit, static_argnums=0)
def _fit(
    hand: Hand, markers: Array, seen: Array, prior: PosePrior, start: tuple[Array, Array] | None
) -> Solved:
    dtype = markers.dtype
    prior = PosePrior(*(jnp.asarray(array).astype(dtype) for array in prior))
    if start is None:
        alignment = jnp.asarray(hand.alignment_weight).astype(dtype)
        weight = seen.astype(dtype) * jnp.maximum(alignment, OTHERS)
        template = in_hand_frame(hand, rotations_from_angles(prior.mean))[0]
        start = kabsch(template, markers, weight, jnp.eye(3, dtype=dtype))
    rotation, position = (jnp.asarray(array).astype(dtype) for array in start)
    targets = untransform(rotation, position, markers)
    posture = partial(_posture, hand, prior)
    angles, turn, shift = jax.lax.map(lambda frame: posture(*frame), (targets, seen))
    position = position + product(rotation, shift[..., None])[..., 0]
    return solved_from(hand, rotations_from_angles(angles), product(rotation, turn), position)


def _posture(
    hand: Hand, prior: PosePrior, target: Array, seen: Array
) -> tuple[Array, Array, Array]:
    """Angles `[26]`, and turn `[3, 3]` and shift `[3]` of the wrist from its start, for the targets
    `[M, 3]` of one frame, as seen from that start."""
    dtype, count = target.dtype, len(ANGLES)
    # A finger's angles move none of the others' markers, and no tangent tells the fingers apart.
    own = np.array(
        [[m in hand.finger_markers[f] for f in FINGER_OF_ANGLE] for m in range(len(hand))]
    )
    low, high = (jnp.asarray(end).astype(dtype) for end in (LOW, HIGH))
    wrist_scale = jnp.asarray(np.repeat(WRIST_PRIOR, 3)).astype(dtype)
    scale = seen[:, None].astype(dtype) / NOISE

    def unpacked(unknowns: Array) -> tuple[Array, Array]:
        angles = prior.mean + _matmul(prior.factor, unknowns[:count])
        return angles, wrist_scale * unknowns[count:]

    def placed(angles: Array) -> Array:
        return in_hand_frame(hand, rotations_from_angles(angles))[0]

    def moved(wrist: Array, markers: Array) -> Array:
        return transform(_small_turn(wrist[:3]), wrist[3:], markers)

    def residuals(unknowns: Array) -> Array:
        """`[3 M + 26 + 32]` in standard deviations: markers, trespasses, priors."""
        angles, wrist = unpacked(unknowns)
        off = (moved(wrist, placed(angles)) - target) * scale
        beyond = (angles - jnp.clip(angles, low, high)) / RANGE_PRIOR
        return jnp.concatenate([off.ravel(), beyond, unknowns])

    def slopes(unknowns: Array) -> Array:
        """`[3 M + 26, 32]` derivative of the residuals, without the priors' own, which is 1."""
        angles, wrist = unpacked(unknowns)
        by_slot = jax.jacfwd(lambda slots: placed(angles + slots[SLOT_OF_ANGLE]))
        by_slot = by_slot(jnp.zeros(SLOT_OF_ANGLE.max() + 1, dtype))
        by_angle = jnp.where(own[:, None], by_slot[..., SLOT_OF_ANGLE], 0)
        by_angle = product(_small_turn(wrist[:3]), by_angle)
        by_wrist = jax.jacfwd(moved)(wrist, placed(angles)) * wrist_scale
        by_angle, by_wrist = (
            (rows * scale[..., None]).reshape(scale.size * 3, -1) for rows in (by_angle, by_wrist)
        )
        beyond = jnp.diag((angles != jnp.clip(angles, low, high)).astype(dtype) / RANGE_PRIOR)
        rows = _matmul(jnp.concatenate([by_angle, beyond]), prior.factor)
        return jnp.concatenate([rows, jnp.pad(by_wrist, ((0, count), (0, 0)))], -1)

    def step(state: _State) -> _State:
        rows, off = slopes(state.unknowns), residuals(state.unknowns)
        gradient = _matmul(off[: len(rows)], rows) + state.unknowns
        matrix = _matmul(rows.T, rows) + (1 + state.damping) * jnp.eye(len(gradient), dtype=dtype)
        move = jax.scipy.linalg.cho_solve((jnp.linalg.cholesky(matrix), True), gradient)
        unknowns = state.unknowns - move
        cost = (residuals(unknowns) ** 2).sum()
        better = cost < state.cost
        turn = jnp.concatenate(
            [_matmul(prior.factor, move[:count]), (wrist_scale * move[count:])[:3]]
        )
        return _State(
            jnp.where(better, unknowns, state.unknowns),
            jnp.where(better, cost, state.cost),
            jnp.clip(state.damping * jnp.where(better, 0.1, 10), 1e-6, 1e8),
            state.steps + 1,
            jnp.abs(turn).max(),
        )

    def unfinished(state: _State) -> Array:
        return (state.steps < STEPS) & (state.move > TOLERANCE)

    zero = jnp.zeros(count + len(wrist_scale), dtype)
    damping, far = jnp.array(1e-3, dtype), jnp.array(jnp.inf, dtype)
    first = _State(zero, (residuals(zero) ** 2).sum(), damping, jnp.array(0), far)
    angles, wrist = unpacked(jax.lax.while_loop(unfinished, step, first).unknowns)
    return angles, _small_turn(wrist[:3]), wrist[3:]


def _small_turn(vector: Array) -> Array:
    """`[3, 3]` rotation by 2 atan(|vector| / 2) about `[3]` (Rodrigues' parameters, doubled): to
    first order that of the rotation vector, and smooth at 0 without a branch."""
    half = vector / 2
    about = jnp.swapaxes(cross(half, jnp.eye(3, dtype=vector.dtype)), -1, -2)
    share = 2 / (1 + (half * half).sum())
    return jnp.eye(3, dtype=vector.dtype) + share * (about + product(about, about))


def _matmul(a: Array, b: Array) -> Array:
    """One product of two larger matrices is what `dot` is good at."""
    return jnp.matmul(a, b, precision="highest")
