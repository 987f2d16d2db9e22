"""Simulated hands to try other things on, with little to compile."""

from __future__ import annotations

from functools import partial

import jax
import numpy as np

import jaxhand.motion
from jaxhand import arrow
from jaxhand.motion import Motion
from numpy_infer.arrays import Array
from numpy_infer.hand import Hand
from numpy_infer.skeleton import forward_kinematics, marker_positions, rotations_from_angles

quickly = partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})
"""`jax.jit` for what a test runs once or twice: whole, because operation by operation takes five
times as long, and without optimisation, because that takes longer than it saves."""

_motion = quickly(jaxhand.motion.motion, static_argnames=("frames", "rate", "batch"))


def motion(seed: int, frames: int, rate: float, batch: tuple[int, ...] = ()) -> Motion:
    """`motion.motion` of the mean person, as numpy arrays."""
    return jax.tree.map(np.asarray, _motion(jax.random.key(seed), frames, rate, batch))


def bones(seed: int, hand: Hand) -> Array:
    """`[21, 3]` metres: somebody out of the very priors that calibrations are given."""
    known = arrow.Priors()
    spread = np.repeat([known.size, known.bone, known.bone], arrow.WIDTHS)
    unlike = spread * np.random.default_rng(seed).normal(size=len(spread))
    return np.asarray(arrow.skeleton(np.float32(hand.skeleton), np.float32(unlike)))


def worn(hand: Hand, move: Motion) -> tuple[Array, Array, Array]:
    """Markers `[..., M, 3]`, points `[..., 21, 3]` and rotations `[..., 16, 3, 3]` of a hand that
    moves so: world, in float32, by way of numpy."""
    skeleton, local = np.float32(hand.skeleton), rotations_from_angles(move.angles)
    points, rotations = forward_kinematics(skeleton, local, *move[1:])
    return marker_positions(hand, points, rotations), points, rotations
