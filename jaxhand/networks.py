"""Networks as data, built as flax.nnx modules. Twin of `numpy_infer.networks`."""

from __future__ import annotations

from collections.abc import Mapping

import jax
import jax.numpy as jnp
from flax import nnx

from numpy_infer.arrays import Array
from numpy_infer.hand import Hand
from numpy_infer.model import ERROR_NUMBERS, Model
from numpy_infer.networks import Dense, Dropout, Network, Spec

for _kind, _data, _meta in (
    (Network, ("arrays", "input_mean", "input_scale", "output_mean", "output_scale"), ("spec",)),
    (
        Hand,
        ("offsets", "skeleton", "template"),
        ("name", "markers", "joints", "links", "alignment", "sources"),
    ),
    (
        Model,
        (
            *("hand", "wearer", "flat", "marker_network", "joint_network", "fade"),
            *("expected_error", "marker_error", *ERROR_NUMBERS),
        ),
        ("predictor", "joints", "alignment", "gate", "smoothing", "continuity"),
    ),
):
    jax.tree_util.register_dataclass(_kind, _data, _meta, drop_fields=["training"])


class Layers(nnx.Module):
    """The trainable module of a spec. Weights start as Keras' do: Glorot uniform, biases 0.

    Products are those of float32 on every device: by default a GPU's are off by a thousandth, and
    what is trained there would not be what numpy runs."""

    def __init__(self, spec: Spec, inputs: int, *, rngs: nnx.Rngs) -> None:
        self.spec = spec
        self.layers: nnx.List = nnx.List()
        for layer in spec:
            if isinstance(layer, Dense):
                linear = nnx.Linear(
                    inputs,
                    layer.units,
                    kernel_init=nnx.initializers.glorot_uniform(),
                    precision="highest",
                    rngs=rngs,
                )
                self.layers.append(linear)
                inputs = layer.units
            elif isinstance(layer, Dropout):
                self.layers.append(nnx.Dropout(layer.rate))

    def __call__(self, inputs: Array, dropout_key: Array | None = None) -> Array:
        """`[..., in]` → `[..., out]`; without a key there is no dropout."""
        x = inputs
        for i, (layer, module) in enumerate(zip(self.spec, self.layers, strict=True)):
            if isinstance(layer, Dense):
                x = module(x)
                x = nnx.relu(x) if layer.activation == "relu" else x
            elif dropout_key is not None:
                key = jax.random.fold_in(dropout_key, i)
                x = module(x, deterministic=False, rngs=nnx.Rngs(dropout=key))
        return x


def build(spec: Spec, inputs: int, key: Array) -> Layers:
    """A new module with random weights drawn from `key`."""
    return Layers(spec, inputs, rngs=nnx.Rngs(params=key))


def arrays_of(module: Layers) -> dict[str, Array]:
    """The module's weights under the names that the runtime uses."""
    arrays = {}
    for i, (layer, linear) in enumerate(zip(module.spec, module.layers, strict=True)):
        if isinstance(layer, Dense):
            arrays[f"{i}.kernel"] = linear.kernel[...]
            arrays[f"{i}.bias"] = linear.bias[...]
    return arrays


def from_arrays(spec: Spec, arrays: Mapping[str, Array]) -> Layers:
    """The module that `arrays_of` took the weights from."""
    first = next(i for i, layer in enumerate(spec) if isinstance(layer, Dense))
    inputs = arrays[f"{first}.kernel"].shape[0]
    module = nnx.eval_shape(lambda: build(spec, inputs, jax.random.key(0)))
    for i, (layer, linear) in enumerate(zip(spec, module.layers, strict=True)):
        if isinstance(layer, Dense):
            linear.kernel = nnx.Param(arrays[f"{i}.kernel"])
            linear.bias = nnx.Param(arrays[f"{i}.bias"])
    return module


def apply(spec: Spec, arrays: Mapping[str, Array], inputs: Array) -> Array:
    """`[..., in]` → `[..., out]`: the layers one after the other, as at run time (no dropout)."""
    return from_arrays(spec, arrays)(inputs)


def predict(network: Network, inputs: Array, known: Array | None = None) -> Array:
    """Runs a network in the units of its data.

    Args:
        inputs: `[..., in]`, finite where known.
        known: `[..., in]` True where the input may be read; elsewhere it enters as 0 after scaling
            (paper, section 3.2.2), that is, as its mean. None: everywhere.

    Returns:
        `[..., out]` in the dtype of `inputs`; the layers themselves run in that of the weights.
    """
    dtype = network.input_mean.dtype
    scaled = (inputs.astype(dtype) - network.input_mean) / network.input_scale
    if known is not None:
        scaled = jnp.where(known, scaled, 0)
    outputs = apply(network.spec, network.arrays, scaled)
    return (network.output_mean + network.output_scale * outputs).astype(inputs.dtype)
