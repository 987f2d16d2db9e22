"""Networks as data, run from named arrays. Twin of `jaxhand.networks`.

Whatever is in the list can be trained and exported; a layer that numpy cannot run is refused when
the list is made.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np

from numpy_infer.arrays import Array

ACTIVATIONS = ("relu", "linear")


class Dense(NamedTuple):
    """`activation(x @ kernel + bias)`."""

    units: int
    activation: str = "relu"


class Dropout(NamedTuple):
    """Hides a fraction `rate` of its inputs in training; nothing at run time."""

    rate: float


Layer = Dense | Dropout
Spec = tuple[Layer, ...]
Step = tuple[Array, Array, bool]
"""Kernel `[in, out]`, bias `[out]`, and whether a rectifier follows."""
LAYERS: dict[str, type[Dense] | type[Dropout]] = {"dense": Dense, "dropout": Dropout}


@dataclass(frozen=True, eq=False)
class Network:
    """A spec, its arrays, and the scaling of what goes in and comes out."""

    spec: Spec
    arrays: Mapping[str, Array]
    """`"<layer>.kernel" [in, out]`, `"<layer>.bias" [out]` for each dense layer of the spec."""
    input_mean: Array
    """`[in]` what an input is when it is not known; subtracted before the first layer."""
    input_scale: Array
    """`[in]` divides the inputs."""
    output_mean: Array
    """`[out]` added to the outputs."""
    output_scale: Array
    """`[out]` multiplies the outputs."""

    @cached_property
    def folded(self) -> tuple[Step, ...]:
        """The layers with the scaling in their first and last weights, in the weights' dtype: from
        inputs less their mean to outputs."""
        steps = _steps(
            self.spec, {k: np.asarray(array, np.float64) for k, array in self.arrays.items()}
        )
        kernel, bias, relu = steps[0]
        steps = ((kernel / self.input_scale[:, None], bias, relu), *steps[1:])
        kernel, bias, relu = steps[-1]
        if relu:  # a scale of any sign, and a shift, only pass through what is linear
            steps = (*steps, (np.eye(len(bias)), np.zeros(len(bias)), False))
            kernel, bias, relu = steps[-1]
        last = (kernel * self.output_scale, bias * self.output_scale + self.output_mean, False)
        dtype = self.input_mean.dtype
        return tuple((k.astype(dtype), b.astype(dtype), r) for k, b, r in (*steps[:-1], last))


def read_spec(data: Any) -> Spec:
    """Layers from plain data such as `[{"type": "dense", "units": 200, "activation": "relu"}]`.

    Raises:
        ValueError: an unknown layer or activation, a missing or surplus entry, a number out of
            range; the message names the layer.
    """
    if not isinstance(data, Sequence) or isinstance(data, str) or not data:
        raise ValueError(f"expected a list of layers, found {data!r}")
    spec = tuple(_read_layer(i, layer) for i, layer in enumerate(data))
    if not isinstance(spec[-1], Dense):
        raise ValueError(f"the last layer must be dense, found {data[-1]!r}")
    return spec


def write_spec(spec: Spec) -> list[dict[str, Any]]:
    """Plain data that `read_spec` reads back."""
    names = {kind: name for name, kind in LAYERS.items()}
    return [{"type": names[type(layer)], **layer._asdict()} for layer in spec]


def array_shapes(spec: Spec, inputs: int) -> dict[str, tuple[int, ...]]:
    """Name and shape of every array that a network of this spec needs."""
    shapes: dict[str, tuple[int, ...]] = {}
    for i, layer in enumerate(spec):
        if isinstance(layer, Dense):
            shapes[f"{i}.kernel"] = (inputs, layer.units)
            shapes[f"{i}.bias"] = (layer.units,)
            inputs = layer.units
    return shapes


def apply(spec: Spec, arrays: Mapping[str, Array], inputs: Array) -> Array:
    """`[..., in]` → `[..., out]`: the layers one after the other, as at run time (no dropout)."""
    return _run(_steps(spec, arrays), inputs)


def _steps(spec: Spec, arrays: Mapping[str, Array]) -> tuple[Step, ...]:
    return tuple(
        (arrays[f"{i}.kernel"], arrays[f"{i}.bias"], layer.activation == "relu")
        for i, layer in enumerate(spec)
        if isinstance(layer, Dense)
    )


def _run(steps: tuple[Step, ...], x: Array) -> Array:
    zero = np.zeros((), x.dtype)  # a number would be made one each time
    for kernel, bias, relu in steps:
        x = x @ kernel + bias
        if relu:
            x = np.maximum(x, zero)
    return x


def predict(network: Network, inputs: Array, known: Array | None = None) -> Array:
    """Runs a network in the units of its data.

    Args:
        inputs: `[..., in]`, finite where known.
        known: `[..., in]` True where the input may be read; elsewhere it enters as 0 after scaling
            (paper, section 3.2.2), that is, as its mean. None: everywhere.

    Returns:
        `[..., out]` in the dtype of `inputs`; the layers themselves run in that of the weights.
    """
    mean = network.input_mean
    centred = inputs.astype(mean.dtype, copy=False) - mean
    if known is not None:
        centred = np.where(known, centred, np.zeros((), mean.dtype))
    return _run(network.folded, centred).astype(inputs.dtype)


def _read_layer(i: int, data: Any) -> Layer:
    where = f"layer {i}"
    if not isinstance(data, Mapping) or data.get("type") not in list(LAYERS):
        raise ValueError(f"{where}: expected a layer of type {', '.join(LAYERS)}, found {data!r}")
    kind = LAYERS[data["type"]]
    entries = {key: value for key, value in data.items() if key != "type"}
    try:
        layer = kind(**entries)
    except TypeError:
        raise ValueError(f"{where}: expected entries {kind._fields}, found {data!r}") from None
    if isinstance(layer, Dense):
        if type(layer.units) is not int or not 1 <= layer.units <= 1 << 16:
            raise ValueError(f"{where}: expected 1 to 65536 units, found {layer.units!r}")
        if layer.activation not in ACTIVATIONS:
            raise ValueError(
                f"{where}: expected activation {' or '.join(ACTIVATIONS)}, "
                f"found {layer.activation!r}"
            )
    elif type(layer.rate) not in (int, float) or not 0 <= layer.rate < 1:
        raise ValueError(f"{where}: expected a rate in [0, 1), found {layer.rate!r}")
    return layer
