"""Simulated hands to try other things on, with little to compile."""

from __future__ import annotations

from functools import partial

import jax
import numpy as np

from jaxhand import simulation
from jaxhand.motion import Motion
from numpy_infer.arrays import Array
from numpy_infer.hand import Hand
from numpy_infer.skeleton import forward_kinematics, marker_positions, rotations_from_angles

quickly = partial(jax.jit, compiler_options={"xla_backend_optimization_level": 0})
"""`jax.jit` for what a test runs once or twice: whole, because operation by operation takes five
times as long, and without optimisation, because that takes longer than it saves."""

_motion = quickly(simulation.motion, static_argnames=("frames", "rate", "batch"))


def motion(seed: int, frames: int, rate: float, batch: tuple[int, ...] = ()) -> Motion:
    """`simulation.motion` as numpy arrays."""
    return jax.tree.map(np.asarray, _motion(jax.random.key(seed), frames, rate, batch))


def worn(hand: Hand, move: Motion) -> tuple[Array, Array, Array]:
    """Markers `[..., M, 3]`, points `[..., 21, 3]` and rotations `[..., 16, 3, 3]` of a hand that
    moves so: world, in float32, by way of numpy."""
    skeleton, local = np.float32(hand.skeleton), rotations_from_angles(move.angles)
    points, rotations = forward_kinematics(skeleton, local, *move[1:])
    return marker_positions(hand, points, rotations), points, rotations
