"""The paper authors' `.bin` networks.

Little-endian, without a magic number: int32 number of layers; per layer int32 kind, int32
activation, then each tensor as an int32 per dimension and row-major float32. A dense layer has
kernel (in, out) and bias; the recurrent kinds have kernel, recurrent kernel and bias.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import prod
from pathlib import Path

import numpy as np

KINDS = ("dense", "simple_rnn", "lstm")
ACTIVATIONS = ("relu", "linear", "sigmoid", "tanh", "hard_sigmoid")
_RANKS = {"dense": (2, 1), "simple_rnn": (2, 2, 1), "lstm": (2, 2, 1)}


@dataclass(frozen=True, eq=False)
class BinLayer:
    """kind: one of KINDS. activation: one of ACTIVATIONS. tensors: float32, kernel first."""

    kind: str
    activation: str
    tensors: tuple[np.ndarray, ...]

    def __post_init__(self) -> None:
        if self.kind not in KINDS or self.activation not in ACTIVATIONS:
            raise ValueError(
                f"expected a kind of {KINDS} and an activation of {ACTIVATIONS}, "
                f"got {self.kind!r}, {self.activation!r}"
            )
        ranks = tuple(tensor.ndim for tensor in self.tensors)
        if ranks != _RANKS[self.kind]:
            raise ValueError(f"{self.kind}: expected ranks {_RANKS[self.kind]}, got {ranks}")
        if any(tensor.dtype != np.float32 for tensor in self.tensors):
            raise ValueError(f"{self.kind}: expected float32 tensors")
        gates = 4 if self.kind == "lstm" else 1
        kernel, *recurrent, bias = (tensor.shape for tensor in self.tensors)
        width = bias[0]
        if kernel[1] != width or any(shape != (width // gates, width) for shape in recurrent):
            raise ValueError(f"{self.kind}: shapes do not fit: {[kernel, *recurrent, bias]}")


def read_bin(path: Path) -> list[BinLayer]:
    """Read a network; ValueError for a truncated or otherwise damaged file.

    Every count is checked against the bytes that are left before memory is taken for it.
    """
    reader = _Reader(Path(path))
    # The smallest layer is kind, activation and one length per dimension: 20 bytes and its data.
    count = reader.integer("number of layers", low=1, high=reader.left() // 20)
    layers = []
    for index in range(count):
        kind = KINDS[reader.integer(f"layer {index}: kind", 0, len(KINDS) - 1)]
        activation = ACTIVATIONS[
            reader.integer(f"layer {index}: activation", 0, len(ACTIVATIONS) - 1)
        ]
        tensors = tuple(reader.tensor(f"layer {index}", rank) for rank in _RANKS[kind])
        try:
            layers.append(BinLayer(kind, activation, tensors))
        except ValueError as error:
            raise reader.error(f"layer {index}: {error}") from None
    if reader.left():
        raise reader.error(f"{reader.left()} bytes follow the last layer")
    return layers


def write_bin(layers: Sequence[BinLayer], path: Path) -> None:
    """Write a network; a file that was read comes back byte for byte."""
    parts = [_integers(len(layers))]
    for layer in layers:
        parts.append(_integers(KINDS.index(layer.kind), ACTIVATIONS.index(layer.activation)))
        for tensor in layer.tensors:
            parts += [_integers(*tensor.shape), tensor.astype("<f4").tobytes()]
    Path(path).write_bytes(b"".join(parts))


class _Reader:
    """The file's bytes and how far they have been read."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.data = path.read_bytes()
        self.position = 0

    def left(self) -> int:
        return len(self.data) - self.position

    def error(self, message: str) -> ValueError:
        return ValueError(f"{self.path}: byte {self.position}: {message}")

    def integer(self, what: str, low: int, high: int) -> int:
        if self.left() < 4:
            raise self.error(f"{what}: the file is cut off")
        value = int(np.frombuffer(self.data, "<i4", 1, self.position)[0])
        if not low <= value <= high:
            raise self.error(f"{what}: expected {low} to {high}, found {value}")
        self.position += 4
        return value

    def tensor(self, what: str, rank: int) -> np.ndarray:
        shape = [self.integer(f"{what}: dimension", 1, self.left() // 4) for _ in range(rank)]
        size = prod(shape)
        if 4 * size > self.left():
            raise self.error(f"{what}: shape {shape} needs {4 * size} bytes, {self.left()} left")
        values = np.frombuffer(self.data, "<f4", size, self.position)
        self.position += 4 * size
        return values.reshape(shape).astype(np.float32)


def _integers(*values: int) -> bytes:
    return np.array(values, "<i4").tobytes()
