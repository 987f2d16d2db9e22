"""The bundled networks in numpy beside onnxruntime, torch and JAX: `python experiments/rivals.py`.

Both networks of a model, in float32 on one thread, from a numpy array to a numpy array: one frame,
as a live tracker has it, and many at once. The rivals are given the weights with the scaling folded
in, as `numpy_infer` runs them; `plain numpy` is the forward pass as anyone would write it. All run
in one process, by turns, and again each in a loop of its own, with all of the cache: read the
ratios. They need `pip install -e '.[bench]'`; onnxruntime and torch are left out where they are not
installed.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable
from typing import Any

# Before numpy and JAX are loaded: one thread, as an app that tracks beside its own work has it.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
os.environ.setdefault("NPROC", "1")  # of XLA's own

import jax
import jax.numpy as jnp
import numpy as np
from speed import interleaved, plain, spread

from numpy_infer.arrays import Array
from numpy_infer.model import load
from numpy_infer.networks import Network, predict

AGREE = 1e-4
"""Of an output's scale: float32 by another order of summation is no farther off."""

Run = Callable[[Array], Any]
"""`[N, in]` float32 → `[N, out]`, numpy arrays."""


def in_plain_numpy(network: Network) -> Run:
    return lambda inputs: plain(network, inputs)


def in_numpy(network: Network) -> Run:
    return lambda inputs: predict(network, inputs)


def in_onnxruntime(network: Network) -> Run:
    import onnxruntime
    from onnx import TensorProto, helper, numpy_helper

    arrays, value = {"mean": network.input_mean}, "centred"
    nodes = [helper.make_node("Sub", ["inputs", "mean"], [value])]
    for i, (kernel, bias, relu) in enumerate(network.folded):
        arrays |= {f"kernel{i}": kernel, f"bias{i}": bias}
        nodes.append(helper.make_node("Gemm", [value, f"kernel{i}", f"bias{i}"], [f"sum{i}"]))
        value = f"sum{i}"
        if relu:
            nodes.append(helper.make_node("Relu", [value], [f"relu{i}"]))
            value = f"relu{i}"
    ends = [("inputs", network.input_mean), (value, network.output_mean)]
    first, last = (
        helper.make_tensor_value_info(name, TensorProto.FLOAT, ["frames", len(like)])
        for name, like in ends
    )
    weights = [numpy_helper.from_array(array, name) for name, array in arrays.items()]
    graph = helper.make_graph(nodes, "network", [first], [last], weights)
    # An operator set and a file version that all releases of the last years read.
    opset = helper.make_opsetid("", 17)
    model = helper.make_model(graph, opset_imports=[opset], ir_version=8)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    session = onnxruntime.InferenceSession(
        model.SerializeToString(), options, providers=["CPUExecutionProvider"]
    )
    return lambda inputs: session.run(None, {"inputs": inputs})[0]


def in_torch(network: Network) -> Run:
    import torch

    torch.set_num_threads(1)
    mean = torch.tensor(network.input_mean)
    layers: list[torch.nn.Module] = []
    for kernel, bias, relu in network.folded:
        dense = torch.nn.Linear(*kernel.shape)
        dense.weight.data, dense.bias.data = torch.tensor(kernel.T.copy()), torch.tensor(bias)
        layers += [dense, torch.nn.ReLU()] if relu else [dense]
    module = torch.nn.Sequential(*layers).eval()

    def run(inputs: Array) -> Array:
        with torch.inference_mode():
            return module(torch.from_numpy(inputs) - mean).numpy()

    return run


def in_jax(network: Network) -> Run:
    mean, steps = jnp.asarray(network.input_mean), jax.device_put(network.folded)

    @jax.jit
    def layers(inputs: Array) -> Array:
        x = inputs - mean
        for kernel, bias, relu in steps:
            x = x @ kernel + bias
            x = jnp.maximum(x, 0) if relu else x
        return x

    return lambda inputs: np.asarray(jax.block_until_ready(layers(inputs)))


UNIT = "plain numpy"
RIVALS: dict[str, Callable[[Network], Run]] = {
    UNIT: in_plain_numpy,
    "numpy_infer": in_numpy,
    "onnxruntime": in_onnxruntime,
    "torch": in_torch,
    "jax.jit": in_jax,
}


def check(name: str, network: Network, run: Run, inputs: Array) -> None:
    """Raises ValueError if the outputs are not the network's."""
    expected, found = plain(network, inputs), run(inputs)
    off = np.abs((found - expected) / network.output_scale).max()
    if found.dtype != np.float32 or not off <= AGREE:
        raise ValueError(f"{name}: {found.dtype}, off by {off:g} of the outputs' scale")


def compare(networks: list[Network], built: dict[str, list[Run]], frames: int, rounds: int) -> None:
    """Checks and times all of them on as many frames at once."""
    rng = np.random.default_rng(0)
    inputs = [
        rng.normal(network.input_mean, network.input_scale, (frames, len(network.input_mean)))
        for network in networks
    ]
    arrays = [array.astype(np.float32) for array in inputs]
    for name, pair in built.items():
        for network, run, array in zip(networks, pair, arrays, strict=True):
            check(name, network, run, array)

    def both(pair: list[Run]) -> Callable[[], None]:
        def run() -> None:
            for one, array in zip(pair, arrays, strict=True):
                one(array)

        return run

    runs = {name: both(pair) for name, pair in built.items()}
    taken = interleaved(runs, rounds)
    alone = {name: interleaved({name: run}, rounds)[name] for name, run in runs.items()}
    print(f"\n{frames:,} at once: µs, by turns; beside plain numpy; µs, alone; beside plain numpy")
    for name, seconds in taken.items():
        own = np.median(alone[name]) / np.median(alone[UNIT])
        print(
            f"  {name:12} {spread(1e6 * seconds, 0):18} {spread(seconds / taken[UNIT]):18} "
            f"{spread(1e6 * alone[name], 0):18} {own:.2f}"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--model", default="glove9", help="a bundled model, or a model file")
    parser.add_argument("--rounds", type=int, default=3000, help="of one frame; a tenth of many")
    parser.add_argument("--frames", type=int, default=1024, help="at once, beside one")
    options = parser.parse_args()
    model = load(options.model)
    networks = [n for n in (model.marker_network, model.joint_network) if n is not None]
    built: dict[str, list[Run]] = {}
    for name, rival in RIVALS.items():
        try:
            built[name] = [rival(network) for network in networks]
        except ImportError as error:
            print(f"{name} is left out, {error.name} is missing: pip install -e '.[bench]'")
    compare(networks, built, 1, options.rounds)
    compare(networks, built, options.frames, max(options.rounds // 10, 1))


if __name__ == "__main__":
    main()
