"""What is apart stays apart, and comes out the same."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from streams import a_model

from jaxhand import tracker
from jaxhand.compiled import KEEP_BARRIERS, apart, compiled
from numpy_infer.arrays import Array


def twice(values: Array, count: int = 1) -> Array:
    return apart(jnp.sin(values)) * count + apart(jnp.cos(values))


def test_xla_on_the_cpu_leaves_barriers_where_they_are() -> None:
    values = jax.device_put(jnp.arange(4.0), jax.devices("cpu")[0])
    program = jax.jit(twice, compiler_options=KEEP_BARRIERS).lower(values)
    assert "opt-barrier" in program.compile().as_text()


def test_the_program_is_jit_s() -> None:
    values = jnp.linspace(-3, 3, 100)
    run = compiled(twice, static_argnames="count")
    np.testing.assert_allclose(run(values, count=3), jax.jit(twice)(values, 3), atol=1e-6)
    assert run.__name__ == "twice"


def test_in_jax_a_gate_is_told_its_hand_before_it_is_compiled() -> None:
    model = a_model("learned", dtype=np.float32, gate=True)
    frame = np.zeros((9, 3), np.float32), np.ones(9, bool), np.float32(1)
    with pytest.raises(ValueError, match="close over it"):
        jax.jit(tracker.step)(model, tracker.init(model), *frame)
    assert jax.jit(lambda state: tracker.step(model, state, *frame)[1])(tracker.init(model))
