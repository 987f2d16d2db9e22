"""A low-pass filter that lets go as a marker speeds up. Twin of `numpy_infer.one_euro`.

Casiez, Roussel and Vogel, *1 € Filter*, CHI 2012: one pole, whose cutoff grows with the speed. The
speed here is the length of a marker's low-passed velocity, not one for each coordinate: so the
filter does not know how the world's axes lie. The velocity is that of the measurements, as in the
authors' own program until August 2023; taken from the last output, as printed in the paper and in
their program since, it would count the lag.
"""

from __future__ import annotations

from math import pi

import jax.numpy as jnp

from numpy_infer.arrays import Array
from numpy_infer.one_euro import Filter, Smoothing


def init(markers: Array) -> Filter:
    """A filter that has seen nothing, for markers of this shape `[..., M, 3]` and precision."""
    nothing = jnp.zeros_like(markers)
    return Filter(jnp.zeros(markers.shape[:-2], bool), nothing, nothing, nothing)


def step(smoothing: Smoothing, state: Filter, markers: Array, dt: Array) -> tuple[Filter, Array]:
    """Filters one frame. The first passes unchanged.

    Args:
        smoothing: what to do.
        state: from `init` or the previous `step`.
        markers: `[..., M, 3]` metres, any frame that stands still.
        dt: `[...]` seconds since the previous frame; if it is not positive nothing changes, and
            the last output comes again.
    """
    begun, moves = state.begun[..., None, None], (dt > 0)[..., None, None]
    elapsed = jnp.where(moves, dt[..., None, None], 1).astype(markers.dtype)
    velocity = (markers - state.markers) / elapsed
    share = _share(elapsed, smoothing.derivative_cutoff)
    velocity = state.velocity + share * (velocity - state.velocity)
    speed = jnp.sqrt((velocity * velocity).sum(-1, keepdims=True))
    share = _share(elapsed, smoothing.min_cutoff + smoothing.beta * speed)
    smoothed = state.smoothed + share * (markers - state.smoothed)
    fresh = Filter(
        jnp.ones_like(state.begun),
        jnp.where(begun & ~moves, state.markers, markers),
        jnp.where(begun, jnp.where(moves, smoothed, state.smoothed), markers),
        jnp.where(begun, jnp.where(moves, velocity, state.velocity), 0),
    )
    return fresh, fresh.smoothed


def _share(elapsed: Array, cutoff: Array) -> Array:
    """How far the one pole goes towards its input, the backward Euler step of the paper."""
    turn = 2 * pi * cutoff * elapsed
    return turn / (1 + turn)
