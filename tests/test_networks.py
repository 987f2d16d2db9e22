"""One spec, two readers: whatever flax.nnx trains numpy runs, and nothing else is accepted."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from streams import seeds

from numpy_infer.networks import (
    Dense,
    Dropout,
    Network,
    Spec,
    apply,
    array_shapes,
    predict,
    read_spec,
    write_spec,
)

Array = np.ndarray

ROUNDING = 2e-5
"""float32 sums of up to 32 terms of size 1, in another order."""

INPUTS = 6


@st.composite
def specs(draw: st.DrawFn, widths: tuple[int, ...] = (1, 8, 32)) -> Spec:
    """One to four dense layers with dropout anywhere before the last."""
    layers: list[Any] = []
    for _ in range(draw(st.integers(0, 3))):
        if draw(st.booleans()):
            layers.append(Dropout(draw(st.sampled_from([0.0, 0.1, 0.5, 0.9]))))
        units = draw(st.sampled_from(widths))
        layers.append(Dense(units, draw(st.sampled_from(["relu", "linear"]))))
    return (*layers, Dense(5, draw(st.sampled_from(["relu", "linear"]))))


def random_arrays(spec: Spec, seed: int) -> dict[str, Array]:
    rng = np.random.default_rng(seed)
    return {
        name: rng.normal(size=shape).astype(np.float32) / np.float32(np.sqrt(shape[0]))
        for name, shape in array_shapes(spec, INPUTS).items()
    }


def random_network(spec: Spec, seed: int) -> Network:
    rng = np.random.default_rng(seed)
    scaling = [rng.normal(size=n).astype(np.float32) for n in (INPUTS, INPUTS)]
    outputs = spec[-1].units  # type: ignore[union-attr]
    scaling += [rng.normal(size=outputs).astype(np.float32) for _ in range(2)]
    mean, scale, output_mean, output_scale = scaling
    return Network(
        spec, random_arrays(spec, seed), mean, np.abs(scale) + 0.5, output_mean, output_scale
    )


# -- the spec as plain data ---------------------------------------------------------------------


@given(spec=specs())
def test_a_spec_written_reads_back_as_itself(spec: Spec) -> None:
    assert read_spec(write_spec(spec)) == spec


DENSE = {"type": "dense", "units": 3, "activation": "relu"}


@pytest.mark.parametrize(
    ("layer", "message"),
    [
        ({"type": "conv", "units": 3}, "expected a layer of type dense, dropout"),
        ({"type": "gru", "units": 3}, "expected a layer of type dense, dropout"),
        ({"units": 3}, "expected a layer of type"),
        ("dense", "expected a layer of type"),
        (None, "expected a layer of type"),
        ({"type": ["dense"]}, "expected a layer of type"),
        ({"type": "dense"}, "expected entries"),
        ({**DENSE, "bias": False}, "expected entries"),
        ({"type": "dropout", "units": 3}, "expected entries"),
        ({"type": "dropout", "rate": 0.1, 7: 1}, "expected entries"),
        ({**DENSE, "units": 0}, "expected 1 to 65536 units"),
        ({**DENSE, "units": -3}, "expected 1 to 65536 units"),
        ({**DENSE, "units": 3.0}, "expected 1 to 65536 units"),
        ({**DENSE, "units": True}, "expected 1 to 65536 units"),
        ({**DENSE, "units": "3"}, "expected 1 to 65536 units"),
        ({**DENSE, "units": 10**9}, "expected 1 to 65536 units"),
        ({**DENSE, "activation": "tanh"}, "expected activation relu or linear"),
        ({**DENSE, "activation": None}, "expected activation"),
        ({**DENSE, "activation": ["relu"]}, "expected activation"),
        ({"type": "dropout", "rate": 1.0}, "expected a rate"),
        ({"type": "dropout", "rate": -0.1}, "expected a rate"),
        ({"type": "dropout", "rate": float("nan")}, "expected a rate"),
        ({"type": "dropout", "rate": "0.1"}, "expected a rate"),
    ],
)
def test_a_layer_that_numpy_cannot_run_is_refused_by_its_place_in_the_list(
    layer: Any, message: str
) -> None:
    with pytest.raises(ValueError, match=f"layer 1: {message}"):
        read_spec([DENSE, layer, DENSE])


@pytest.mark.parametrize("data", [None, [], "dense", 3, {}, DENSE])
def test_what_is_no_list_of_layers_is_refused(data: Any) -> None:
    with pytest.raises(ValueError, match="expected a list of layers"):
        read_spec(data)


def test_a_network_must_end_in_a_dense_layer() -> None:
    with pytest.raises(ValueError, match="last layer must be dense"):
        read_spec([DENSE, {"type": "dropout", "rate": 0.1}])


# -- numpy --------------------------------------------------------------------------------------


@given(spec=specs(), seed=seeds())
def test_a_network_is_its_layers_one_after_the_other(spec: Spec, seed: int) -> None:
    network = random_network(spec, seed)
    inputs = np.random.default_rng(seed + 1).normal(size=(2, 3, INPUTS))
    x = ((inputs - network.input_mean) / network.input_scale).reshape(-1, INPUTS)
    for i, layer in enumerate(spec):
        if isinstance(layer, Dense):
            x = np.einsum("ni,io->no", x, network.arrays[f"{i}.kernel"].astype(float))
            x = x + network.arrays[f"{i}.bias"]
            x = np.where(x > 0, x, 0) if layer.activation == "relu" else x
    expected = (x * network.output_scale + network.output_mean).reshape(2, 3, -1)
    for dtype in (np.float32, np.float64):
        found = predict(network, inputs.astype(dtype), np.ones(inputs.shape, bool))
        assert found.dtype == dtype
        assert_allclose(found, expected, rtol=0, atol=10 * ROUNDING)


@pytest.mark.filterwarnings("error")
@given(
    spec=specs(),
    seed=seeds(),
    garbage=st.sampled_from([np.nan, np.inf, -np.inf, 1e30, 0.0, -0.0]),
)
def test_inputs_that_are_not_known_cannot_matter_bit_for_bit(
    spec: Spec, seed: int, garbage: float
) -> None:
    network, rng = random_network(spec, seed), np.random.default_rng(seed)
    inputs = rng.normal(size=(4, INPUTS)).astype(np.float32)
    known = rng.uniform(size=inputs.shape) < 0.5
    found = predict(network, np.where(known, inputs, np.float32(garbage)), known)
    assert found.tobytes() == predict(network, inputs, known).tobytes()
    # An input that is not known counts as its mean.
    mean = predict(network, np.where(known, inputs, network.input_mean), np.ones_like(known))
    assert_array_equal(found, mean)


# -- the twin -----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def twin() -> Any:
    pytest.importorskip("jax")
    return importlib.import_module("jaxhand.networks")


@pytest.fixture(scope="module")
def key() -> Callable[[int], Any]:
    return pytest.importorskip("jax").random.key


WIDTH = (8,)
"""Each new shape of a layer is a compilation, so here there is one."""


@settings(max_examples=10)
@given(spec=specs(WIDTH), seed=seeds())
def test_flax_and_numpy_agree_on_any_spec(twin: Any, spec: Spec, seed: int) -> None:
    network, rng = random_network(spec, seed), np.random.default_rng(seed)
    inputs = rng.normal(size=(4, INPUTS)).astype(np.float32)
    known = rng.uniform(size=inputs.shape) < 0.7
    expected = predict(network, inputs, known)
    found = twin.predict(network, np.where(known, inputs, np.nan), known)
    assert found.dtype == expected.dtype
    assert_allclose(found, expected, rtol=0, atol=ROUNDING)


@settings(max_examples=3)
@given(spec=specs(WIDTH), seed=seeds())
def test_a_module_is_its_arrays_and_back(
    twin: Any, key: Callable[[int], Any], spec: Spec, seed: int
) -> None:
    module = twin.build(spec, INPUTS, key(seed))
    arrays = {name: np.asarray(a) for name, a in twin.arrays_of(module).items()}
    assert {name: a.shape for name, a in arrays.items()} == array_shapes(spec, INPUTS)
    again = twin.arrays_of(twin.from_arrays(spec, arrays))
    assert arrays.keys() == again.keys()
    for name, array in arrays.items():
        assert_array_equal(again[name], array)
    inputs = np.random.default_rng(seed).normal(size=(3, INPUTS)).astype(np.float32)
    assert_allclose(module(inputs), apply(spec, arrays, inputs), rtol=0, atol=ROUNDING)
    repeated = twin.arrays_of(twin.build(spec, INPUTS, key(seed)))
    for name, array in arrays.items():
        assert_array_equal(repeated[name], array)


def test_dropout_is_off_at_run_time_and_drawn_from_its_key_in_training(
    twin: Any, key: Callable[[int], Any]
) -> None:
    spec = (Dense(32), Dropout(0.5), Dense(32, "linear"), Dropout(0.5), Dense(4, "linear"))
    module = twin.build(spec, INPUTS, key(0))
    inputs = np.ones((200, INPUTS), np.float32)
    plain = np.asarray(module(inputs))
    assert_array_equal(plain, np.asarray(module(inputs)))
    one, other = (np.asarray(module(inputs, key(k))) for k in (1, 2))
    assert_array_equal(one, np.asarray(module(inputs, key(1))))
    assert not np.array_equal(one, other)
    assert not np.array_equal(one[0], one[1])  # drawn for each row
    # What is kept is scaled up, so that the mean stays: 200 rows of spread about 0.5 each.
    assert_allclose(one.mean(0), plain[0], rtol=0, atol=6 * one.std(0).max() / np.sqrt(200))
    assert_allclose(plain, apply(spec, twin.arrays_of(module), inputs), rtol=0, atol=ROUNDING)
