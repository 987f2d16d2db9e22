"""The paper authors' published template and networks as a `Model`, and back.

Their networks see left-handed coordinates in axes of their own: fingers along −y, the back of the
hand along −x, the thumb along +z. That linear map is folded into the first and last kernel, so that
an imported network runs like any other.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from numpy_infer.arrays import Array
from numpy_infer.formats.authors import read_hand_csv
from numpy_infer.formats.authors_nets import BinLayer, read_bin, write_bin
from numpy_infer.hand import Hand, hand_from_json, load_hand
from numpy_infer.model import Model
from numpy_infer.networks import Dense, Dropout, Network

HAND_FROM_AUTHORS = np.array([[0.0, 0, 1], [-1, 0, 0], [0, 1, 0]])
"""`[3, 3]` their template's axes → the hand frame. Its determinant is −1: theirs is left-handed."""

_REFLECTED = np.diag([1.0, 1, -1])
_JOINTS = {
    "l_wrist": "wrist",
    "l_thumb2": "thumb_mcp",
    "l_index1": "index_mcp",
    "l_pinky1": "pinky_mcp",
}


def read_hand(path: str | Path) -> Hand:
    """Their `hand.csv` as a `Hand`: markers and template theirs, the other bones adult ones.

    Raises:
        ValueError: the file is damaged, or names a joint that their template has not.
    """
    file = read_hand_csv(Path(path))
    bones = load_hand("glove9").to_json()
    turn = HAND_FROM_AUTHORS @ _REFLECTED
    markers = []
    for name, joint, position, origin, fixed in zip(
        file.marker_names, file.joint_names, file.markers, file.joints, file.alignment, strict=True
    ):
        point = _JOINTS.get(joint, joint.removeprefix("l_"))
        marker = {"name": name, "joint": point, "offset": (turn @ (position - origin)).tolist()}
        # Alignment markers at the base of a finger do not move with it.
        markers.append(marker | ({"link": "wrist"} if fixed else {}))
    return hand_from_json(
        bones
        | {
            "name": Path(path).stem,
            "sources": [],
            "markers": markers,
            "alignment": [n for n, a in zip(file.marker_names, file.alignment, strict=True) if a],
            "template": (file.markers @ turn.T).tolist(),
        }
    )


def read_model(marker_net: str | Path, hand_csv: str | Path) -> Model:
    """Their marker network on their template, with no joint stage: their joint network gives
    angles of another skeleton, see `read_joint_network`."""
    hand = read_hand(hand_csv)
    network = _network(read_bin(Path(marker_net)), len(hand))
    kernel, bias = _last(network)
    arrays = dict(network.arrays)
    arrays[kernel] = _turn_columns(arrays[kernel], HAND_FROM_AUTHORS.T)
    arrays[bias] = _turn_columns(arrays[bias], HAND_FROM_AUTHORS.T)
    return Model(hand, "learned", marker_network=replace(network, arrays=arrays))


def read_joint_network(joint_net: str | Path, markers: int = 9) -> Network:
    """Their joint network: `[3M]` markers in the hand frame, metres → their `[26]` raw outputs, in
    units of 180 degrees of their own skeleton's angles."""
    return _network(read_bin(Path(joint_net)), markers)


def write_marker_network(network: Network, path: str | Path) -> None:
    """A marker network in their format; scaling is folded into the kernels.

    Raises:
        ValueError: the network has inputs that are not 0 when hidden, which their program, that
            sets hidden coordinates themselves to 0, cannot run.
    """
    if np.any(network.input_mean != 0):
        raise ValueError(
            "their program hides a marker by setting its coordinates to 0; this network expects "
            "the mean of its training data instead"
        )
    kernel, bias = _last(network)
    arrays = dict(network.arrays)
    scaled = network.output_scale * arrays[kernel]
    arrays[kernel] = _turn_columns(scaled, HAND_FROM_AUTHORS)
    shifted = network.output_mean + network.output_scale * arrays[bias]
    arrays[bias] = _turn_columns(shifted, HAND_FROM_AUTHORS)
    _write(replace(network, arrays=arrays), path)


def write_joint_network(network: Network, path: str | Path) -> None:
    """A joint network in their format; its outputs are written as they are."""
    kernel, bias = _last(network)
    arrays = dict(network.arrays)
    arrays[kernel] = network.output_scale * arrays[kernel]
    arrays[bias] = network.output_mean + network.output_scale * arrays[bias]
    _write(replace(network, arrays=arrays), path)


def _network(layers: Sequence[BinLayer], markers: int) -> Network:
    for i, layer in enumerate(layers):
        if layer.kind != "dense" or layer.activation not in ("relu", "linear"):
            raise ValueError(f"layer {i}: cannot run {layer.kind} with {layer.activation}")
    spec = tuple(Dense(len(layer.tensors[1]), layer.activation) for layer in layers)
    arrays = {}
    for i, layer in enumerate(layers):
        arrays[f"{i}.kernel"], arrays[f"{i}.bias"] = layer.tensors
    inputs, outputs = 3 * markers, spec[-1].units
    if arrays["0.kernel"].shape[0] != inputs:
        raise ValueError(
            f"expected a network for {markers} markers ({inputs} inputs), "
            f"found {arrays['0.kernel'].shape[0]} inputs"
        )
    arrays["0.kernel"] = _turn_rows(arrays["0.kernel"], HAND_FROM_AUTHORS)
    zeros, ones = np.zeros(inputs, np.float32), np.ones(inputs, np.float32)
    return Network(
        spec, arrays, zeros, ones, np.zeros(outputs, np.float32), np.ones(outputs, np.float32)
    )


def _write(network: Network, path: str | Path) -> None:
    first = next(i for i, layer in enumerate(network.spec) if isinstance(layer, Dense))
    arrays = dict(network.arrays)
    kernel = arrays[f"{first}.kernel"] / network.input_scale[:, None]
    arrays[f"{first}.bias"] = arrays[f"{first}.bias"] - network.input_mean @ kernel
    arrays[f"{first}.kernel"] = _turn_rows(kernel, HAND_FROM_AUTHORS.T)
    layers = []
    for i, layer in enumerate(network.spec):
        if isinstance(layer, Dropout):
            continue  # nothing at run time
        tensors = tuple(arrays[f"{i}.{part}"].astype(np.float32) for part in ("kernel", "bias"))
        layers.append(BinLayer("dense", layer.activation, tensors))
    write_bin(layers, Path(path))


def _last(network: Network) -> tuple[str, str]:
    i = len(network.spec) - 1
    return f"{i}.kernel", f"{i}.bias"


def _turn_rows(kernel: Array, turn: Array) -> Array:
    """A kernel for row triples `x` made one for `x @ turn`'s triples: blockdiag(turn) @ kernel."""
    triples = kernel.reshape(-1, 3, kernel.shape[-1])
    return np.einsum("ij,mjn->min", turn, triples).reshape(kernel.shape).astype(kernel.dtype)


def _turn_columns(values: Array, turn: Array) -> Array:
    """Output triples, last axis, times `turn` from the right."""
    triples = values.reshape(*values.shape[:-1], -1, 3)
    return (triples @ turn).reshape(values.shape).astype(values.dtype)
