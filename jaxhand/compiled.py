"""What XLA must be told of small matrices, or it computes them again and again."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, wraps
from typing import Any

import jax

KEEP_BARRIERS = {"xla_disable_hlo_passes": "cse_barrier_expander"}
"""For XLA on the CPU, which takes barriers away before it fuses what stands between them."""


def apart(values: Any) -> Any:
    """The same values, computed once. XLA's fusion on the CPU would otherwise compute what leads to
    a small matrix again for each use of each of its entries, ten to fifty times over. Only where
    `compiled` has the last word: plain `jax.jit` is right, and slower.
    """
    return jax.lax.optimization_barrier(values)


def compiled(function: Callable[..., Any], **options: Any) -> Callable[..., Any]:
    """`jax.jit` that keeps what is `apart`, for whatever calls trackers or the simulator: a
    tenth to a third less time. Not within another `jit`: on the CPU JAX refuses that.

    Args:
        function: as `jax.jit` takes it.
        options: further ones of `jax.jit`.
    """

    @lru_cache(1)
    def program() -> Any:
        own = KEEP_BARRIERS if jax.default_backend() == "cpu" else None
        return jax.jit(function, compiler_options=own, **options)

    @wraps(function)
    def call(*args: Any, **named: Any) -> Any:
        return program()(*args, **named)

    return call
