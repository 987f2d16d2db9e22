"""What is apart stays apart, and comes out the same."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from jaxhand.compiled import KEEP_BARRIERS, apart, compiled
from numpy_infer.arrays import Array


def twice(values: Array, count: int = 1) -> Array:
    return apart(jnp.sin(values)) * count + apart(jnp.cos(values))


def test_xla_on_the_cpu_leaves_barriers_where_they_are() -> None:
    values = jnp.arange(4.0)
    program = jax.jit(twice, compiler_options=KEEP_BARRIERS).lower(values)
    assert "opt-barrier" in program.compile().as_text()


def test_the_program_is_jit_s() -> None:
    values = jnp.linspace(-3, 3, 100)
    run = compiled(twice, static_argnames="count")
    np.testing.assert_allclose(run(values, count=3), jax.jit(twice)(values, 3), atol=1e-6)
    assert run.__name__ == "twice"
