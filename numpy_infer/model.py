"""The model and its file: one `.npz` with a JSON header, never a pickle, every part checked."""

from __future__ import annotations

import hashlib
import io
import json
import os
import re
import struct
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from importlib import resources
from math import inf, prod
from pathlib import Path
from typing import IO, Any

import numpy as np

from numpy_infer.arrays import Array
from numpy_infer.formats.json_text import parse_json
from numpy_infer.formats.refusal import refusal
from numpy_infer.hand import ANGLES, Hand, hand_from_json
from numpy_infer.networks import Network, array_shapes, read_spec, write_spec
from numpy_infer.one_euro import Smoothing

WEIGHTS = resources.files("numpy_infer") / "weights"
"""Where the bundled models lie."""

FORMAT, VERSION = "jaxhand-model", 1

SIZE_LIMIT = 64 << 20
"""Bytes: more than this, unpacked, is no model of ours and is not read."""

HEADER_LIMIT = 1 << 20
"""Bytes: more than this is no header of ours."""

ERROR_CHANGES = (0.0, 0.001, 0.002, 0.004, 0.008, 0.016)
"""Metres: changes of posture, RMS of the visible markers, at which `Model.expected_error` stands;
between them it is linear."""

ERROR_NUMBERS = ("faded_error", "error_saturation", "least_error")
"""Fields of `Model` that say, beside its tables, what error to expect."""

_APART = 2 * ERROR_CHANGES[-1]
"""Metres from row to row where they stand one behind the other."""

AFFINE_ERROR = (
    (0.0002, 0.0018, 0.0033, 0.0061, 0.0075, 0.0404),
    (0.0002, 0.0018, 0.0034, 0.0062, 0.0077, 0.0414),
    (0.0002, 0.0019, 0.0035, 0.0064, 0.0080, 0.0427),
    (0.0008, 0.0066, 0.0122, 0.0226, 0.0280, 0.1498),
)
"""Metres: what is expected of a model nobody has measured, the predictor `affine` on simulated
people."""


@dataclass(frozen=True, eq=False)
class Model:
    """Everything the tracker needs to run."""

    hand: Hand
    predictor: str = "affine"
    """A name in `predictors.PREDICTORS`: what fills hidden markers."""
    joints: str = "none"
    """`learned`: the joint network makes the joint angles; `none`: there are none."""
    marker_network: Network | None = None
    """`[3M]` registered markers, metres → the same; needed by the predictor `learned`."""
    joint_network: Network | None = None
    """`[3M]` markers in the hand frame, metres → `[26]` radians; needed by the stage `learned`."""
    alignment: bool = False
    """Turn the fingers towards their markers after the joint network, see `skeleton`: nearer joints
    for a third as much time again, so a choice of whoever runs the model, not of its file."""
    gate: bool = False
    """Notice wrong measurements and treat them as hidden, see `gate`. Likewise a choice."""
    smoothing: Smoothing | None = None
    """Low-pass what is given out, see `one_euro`: less jitter, more lag. Likewise a choice."""
    wearer: Hand | None = None
    """The same markers on the bones of whoever wears the glove: what joints and wrist pose are made
    with; None stands for `hand`. Comes from a calibration, not from the model file."""
    flat: Array | None = None
    """`[15, 3, 3]` parent_from_joint as predicted of the wearer's flat hand, or None. Likewise."""
    fade: float = 0.03
    """Metres: δ of the continuity blend, see `tracker`."""
    continuity: bool = True
    """Blend the output; without it predictors stand bare, as in the authors' program."""
    expected_error: Array = field(default_factory=lambda: np.array(AFFINE_ERROR))
    """`[K, 6]` metres: mean error with 1…K markers hidden, once the posture has changed by
    `ERROR_CHANGES` since the marker was measured."""
    marker_error: Array | None = None
    """`[M]` each marker's error as a multiple of that; None: all alike."""
    faded_error: float = 0.0
    """Metres of error to expect for each metre by which the marker's correction has faded: its
    length is what the predictor was off when the marker was lost."""
    error_saturation: float = 0.0
    """Per metre: where the two together say x, x / (1 + saturation · x) is expected, for nothing is
    off by more than a finger is long."""
    least_error: float = 0.0
    """Metres to expect beside that of every hidden marker: the noise of the data."""
    training: Mapping[str, Any] = field(default_factory=dict)
    """Plain data about how the model was made and measured."""

    @cached_property
    def error_line(self) -> tuple[Array, Array]:
        """`[6K]` changes of posture and what is expected there, the rows of `expected_error` one
        behind the other: a row's changes count from its own of `error_rows`."""
        rows = _APART * np.arange(len(self.expected_error))[:, None]
        return (rows + ERROR_CHANGES).reshape(-1), self.expected_error.reshape(-1)

    @cached_property
    def error_rows(self) -> Array:
        """`[M + 1]` where on `error_line` the row stands for 0…M markers hidden."""
        hidden = np.clip(np.arange(len(self.hand) + 1), 1, len(self.expected_error))
        return _APART * (hidden - 1)

    @cached_property
    def error_factors(self) -> Array:
        """`[M]` what `marker_error` is or stands for."""
        return np.ones(len(self.hand)) if self.marker_error is None else self.marker_error

    @property
    def body(self) -> Hand:
        """The hand that joints and wrist pose are made with."""
        return self.hand if self.wearer is None else self.wearer

    def __post_init__(self) -> None:
        if self.wearer is not None and self.wearer.markers != self.hand.markers:
            raise ValueError(
                f"the wearer's markers {', '.join(self.wearer.markers)} are not the model's: "
                f"{', '.join(self.hand.markers)}"
            )
        if self.smoothing is not None:
            if not isinstance(self.smoothing, Smoothing):
                raise ValueError(
                    f"smoothing: expected a Smoothing or None, received {self.smoothing!r}"
                )
            least, beta, derivative = self.smoothing
            if not (0 < least < inf and 0 <= beta < inf and 0 < derivative < inf):
                raise ValueError(f"smoothing: expected positive cutoffs, received {self.smoothing}")
        if self.joints not in ("learned", "none"):
            raise ValueError(f"unknown joint stage {self.joints!r}: expected 'learned' or 'none'")
        if isinstance(self.fade, int | float) and not 0 < self.fade < inf:
            raise ValueError(f"'fade' must be positive metres, found {self.fade}")
        for name in ERROR_NUMBERS:
            value = getattr(self, name)
            if isinstance(value, int | float) and not 0 <= value < inf:
                raise ValueError(f"{name!r} must be finite and not negative, found {value}")
        if isinstance(self.expected_error, np.ndarray):
            _check_errors(self.expected_error, self.error_factors, len(self.hand))
        inputs = 3 * len(self.hand)
        for name, network, needed, outputs in (
            ("marker_network", self.marker_network, self.predictor == "learned", inputs),
            ("joint_network", self.joint_network, self.joints == "learned", len(ANGLES)),
        ):
            if network is None and needed:
                raise ValueError(f"the stage 'learned' needs a {name}, and the model has none")
            if network is not None and isinstance(network.input_mean, np.ndarray):
                _check_network(name, network, inputs, outputs)


def save(model: Model, path: str | Path, *, overwrite: bool = False) -> None:
    """Writes a model file. It appears whole or not at all.

    Raises:
        ValueError: the file exists and `overwrite` is False; or the model holds what could not be
            read back, or a calibration, which has a file of its own (`wearer.save`).
    """
    if model.wearer is not None or model.flat is not None:
        raise ValueError("a calibrated model is no model file: save the model, and the calibration")
    path = Path(path)
    if path.exists() and not overwrite:
        raise ValueError(f"{path} exists: choose another name, or ask to overwrite it")
    arrays = {
        "expected_error": np.asarray(model.expected_error, np.float64),
        "marker_error": np.asarray(model.error_factors, np.float64),
    }
    networks = {}
    for name in ("marker_network", "joint_network"):
        network = getattr(model, name)
        if network is not None:
            networks[name] = write_spec(network.spec)
            arrays.update({f"{name}/{key}": value for key, value in _parts(network).items()})
    header = {
        "format": FORMAT,
        "version": VERSION,
        "hand": model.hand.to_json(),
        "predictor": model.predictor,
        "joints": model.joints,
        "networks": networks,
        "fade": float(model.fade),
        **{name: float(getattr(model, name)) for name in ERROR_NUMBERS},
        "continuity": bool(model.continuity),
        "training": dict(model.training),
    }
    try:  # as it will be read: keys are strings, tuples are lists
        header = json.loads(json.dumps(header, allow_nan=False))
    except TypeError as error:
        raise ValueError(f"'training' must be plain data: {error}") from None
    _check_header(header)
    header["checksum"] = _checksum(header, arrays)
    text = json.dumps(header, indent=1).encode()
    buffer = io.BytesIO()
    np.savez(buffer, allow_pickle=False, header=np.frombuffer(text, np.uint8), **arrays)
    # What could not be read back is not written.
    _check_directory(buffer)
    with zipfile.ZipFile(buffer) as archive:
        _read(archive)
    part = path.with_name(path.name + ".part")
    part.write_bytes(buffer.getvalue())
    os.replace(part, path)


def bundled() -> tuple[str, ...]:
    """Names of the models that come with the package, each for the bundled hand of that name."""
    return tuple(sorted(f.name[:-4] for f in WEIGHTS.iterdir() if f.name.endswith(".npz")))


def load(path: str | Path) -> Model:
    """Reads a model file, or a bundled model by its name (`glove9`).

    Raises:
        ValueError: not a model file, another version, a missing, extra, misshapen or corrupted
            array; the message names the file and the culprit.
    """
    try:
        file = WEIGHTS / f"{path}.npz" if str(path) in bundled() else Path(path)
        with file.open("rb") as stream:
            _check_directory(stream)
            with zipfile.ZipFile(stream) as archive:
                return _read(archive)
    except FileNotFoundError:
        raise ValueError(
            f"no model file {path}, and none of the bundled: {', '.join(bundled())}"
        ) from None
    except ValueError as error:
        raise refusal(path, error) from None
    except _DAMAGE as error:
        damage = ValueError(f"not a model file, or a damaged one: {error}")
        raise refusal(path, damage) from None


_DAMAGE = (zipfile.BadZipFile, zlib.error, EOFError, KeyError, OSError, RuntimeError, OverflowError)
"""What `zipfile` raises for damaged archives. A RuntimeError is one that says it is encrypted, or
packed in a way that there is none of; an OverflowError, a place that no file has."""

_END = struct.Struct("<4s4H2LH")
"""The archive's last bytes: signature, two numbers of disks, two of parts, size and place of the
directory, length of a comment."""

_DIRECTORY_LIMIT = 256 << 10
"""Bytes: `zipfile` makes an object of each of its entries before any can be refused."""


def _check_directory(stream: IO[bytes]) -> None:
    size = stream.seek(0, os.SEEK_END)
    if size > SIZE_LIMIT:
        raise ValueError(f"larger than {SIZE_LIMIT >> 20} MB, which no model is")
    stream.seek(max(0, size - _END.size - 20))
    before, tail = stream.read(min(20, max(0, size - _END.size))), stream.read()
    if len(tail) < _END.size or not tail.startswith(b"PK\5\6"):
        raise ValueError("not a model file, or a damaged one: it does not end as one")
    _, *disks, parts, all_parts, length, place, comment = _END.unpack(tail)
    if before.startswith(b"PK\6\7"):
        raise ValueError("has a second directory, for archives larger than any model")
    if any(disks) or parts != all_parts or comment or place + length + _END.size != size:
        raise ValueError("not a model file, or a damaged one: its directory is not where it says")
    if length > _DIRECTORY_LIMIT:
        raise ValueError(f"lists {parts} parts in {length} bytes, which no model has")


_PACKED = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)


def _read(archive: zipfile.ZipFile) -> Model:
    sizes = {info.filename: info.file_size for info in archive.infolist()}
    if len(sizes) != len(archive.infolist()):
        raise ValueError("a part stands twice")
    if any(info.compress_type not in _PACKED for info in archive.infolist()):
        raise ValueError("not a model file, or a damaged one: packed in another way than zip's own")
    if sum(sizes.values()) > SIZE_LIMIT:
        raise ValueError(f"unpacks to more than {SIZE_LIMIT >> 20} MB, which no model does")
    if "header.npy" not in sizes:
        raise ValueError("not a model file: it has no header")
    header = parse_json(
        _array(archive, "header", (None,), HEADER_LIMIT, "|u1").tobytes(), finite=True
    )
    if not isinstance(header, dict) or header.get("format") != FORMAT:
        raise ValueError("not a model file: its header says nothing of " + FORMAT)
    if header.get("version") != VERSION:
        raise ValueError(
            f"written in version {header.get('version')!r}, this program reads version {VERSION}"
        )
    expected = {"format", "version", "hand", "predictor", "joints", "networks", "fade"}
    expected |= {*ERROR_NUMBERS, "continuity", "training", "checksum"}
    if set(header) != expected or not isinstance(header["networks"], dict):
        raise ValueError(f"damaged header: expected {sorted(expected)}, found {sorted(header)}")
    for name in sorted(set(header["networks"]) - {"marker_network", "joint_network"}):
        raise ValueError(f"damaged header: unknown network {name!r}")
    _check_header(header)
    hand = hand_from_json(header["hand"])
    shapes: dict[str, tuple[int, ...]] = {}
    specs = {name: read_spec(layers) for name, layers in header["networks"].items()}
    for name, outputs in (("marker_network", 3 * len(hand)), ("joint_network", len(ANGLES))):
        if name in specs:
            inputs = 3 * len(hand)
            scaling = {"input_mean": (inputs,), "input_scale": (inputs,)}
            scaling |= {"output_mean": (outputs,), "output_scale": (outputs,)}
            wanted = array_shapes(specs[name], inputs) | scaling
            shapes |= {f"{name}/{key}": shape for key, shape in wanted.items()}
    shapes["marker_error"] = (len(hand),)
    names = {f"{name}.npy" for name in (*shapes, "expected_error", "header")}
    for part in sorted(names ^ set(sizes)):
        raise ValueError(f"array {part[:-4]!r} is {'missing' if part in names else 'unexpected'}")
    arrays = {name: _array(archive, name, shape) for name, shape in shapes.items()}
    table = (None, len(ERROR_CHANGES))
    arrays["expected_error"] = _array(archive, "expected_error", table, HEADER_LIMIT)
    _check_errors(arrays["expected_error"], arrays["marker_error"], len(hand))
    checksum = header.pop("checksum")
    if _checksum(header, arrays) != checksum:
        raise ValueError("the checksum does not fit: the file is damaged")
    networks: dict[str, Any] = {
        name: Network(spec, **_gather(arrays, name, array_shapes(spec, 3 * len(hand))))
        for name, spec in specs.items()
    }
    return Model(
        hand=hand,
        predictor=header["predictor"],
        joints=header["joints"],
        fade=header["fade"],
        continuity=header["continuity"],
        expected_error=arrays["expected_error"],
        marker_error=arrays["marker_error"],
        training=header["training"],
        **{name: header[name] for name in ERROR_NUMBERS},
        **networks,
    )


def _check_header(header: Mapping[str, Any]) -> None:
    kinds: dict[str, type] = {"predictor": str, "joints": str, "fade": float, "training": dict}
    kinds |= {"continuity": bool, **dict.fromkeys(ERROR_NUMBERS, float)}
    for key, kind in kinds.items():
        if not isinstance(header[key], kind):
            raise ValueError(f"header: expected {key!r} as {kind.__name__}, found {header[key]!r}")


def _check_errors(table: Array, factors: Array, markers: int) -> None:
    fits = table.ndim == 2 and len(table) and table.shape[1] == len(ERROR_CHANGES)
    if not fits or not (np.isfinite(table) & (table >= 0)).all():
        raise ValueError(
            f"array 'expected_error': expected finite [K, {len(ERROR_CHANGES)}], none negative, "
            f"found {table.shape}"
        )
    if factors.shape != (markers,) or not (np.isfinite(factors) & (factors >= 0)).all():
        raise ValueError(
            f"array 'marker_error': expected [{markers}], none negative, found {factors.shape}"
        )


def _array(
    archive: zipfile.ZipFile,
    name: str,
    shape: tuple[int | None, ...],
    limit: int | None = None,
    *dtypes: str,
) -> Array:
    """One part of the file. What it says of itself is held against what is expected before memory
    is spent on it; a None in `shape` stands for any length, within `limit` bytes."""
    info = archive.getinfo(f"{name}.npy")
    if limit is None:
        limit = 8 * prod(n or 1 for n in shape) + 1024
    if info.file_size > limit:
        raise ValueError(f"array {name!r}: {info.file_size} bytes, expected at most {limit}")
    with archive.open(info) as part:
        # One byte more, so that its checksum is looked at; never all, for a part may be longer than
        # it says.
        content = part.read(info.file_size + 1)
    stated = _NPY.match(content)
    if stated is None or stated.end() != 10 + int.from_bytes(content[8:10], "little"):
        raise ValueError(f"array {name!r}: expected an npy of version (1, 0) with a plain header")
    dtype, order, numbers = (text.decode() for text in stated.groups())
    found = tuple(int(n) for n in numbers.split(",") if n)
    fits = len(found) == len(shape) and all(
        n is None or m == n for m, n in zip(found, shape, strict=True)
    )
    if not fits:
        raise ValueError(f"array {name!r}: expected shape {shape}, found {found}")
    if dtype not in (dtypes or _FLOATS):
        raise ValueError(f"array {name!r}: expected {dtypes or _FLOATS}, found {dtype}")
    if prod(found) * np.dtype(dtype).itemsize != len(content) - stated.end():
        raise ValueError(f"array {name!r}: its shape {found} does not fit its size")
    array = np.frombuffer(content, dtype, offset=stated.end())
    return array.reshape(found, order="F" if order == "True" else "C").copy("K")


_NPY = re.compile(
    rb"\x93NUMPY\x01\x00(?s:..)\{'descr': '([<>|=]?\w{1,9})', 'fortran_order': (True|False), "
    rb"'shape': \((|\d{1,18},|\d{1,18}(?:, \d{1,18}){1,3})\), \} *\n"
)
"""What `numpy.save` writes before an array, and nothing else that Python could evaluate: no pickle,
no expression, no depth."""

_FLOATS = ("<f4", "<f8")


def _gather(
    arrays: Mapping[str, Array], network: str, weights: Mapping[str, Any]
) -> dict[str, Any]:
    scaling = ("input_mean", "input_scale", "output_mean", "output_scale")
    return {
        "arrays": {key: arrays[f"{network}/{key}"] for key in weights},
        **{key: arrays[f"{network}/{key}"] for key in scaling},
    }


def _parts(network: Network) -> dict[str, Array]:
    return {
        **{name: np.asarray(array) for name, array in network.arrays.items()},
        "input_mean": np.asarray(network.input_mean),
        "input_scale": np.asarray(network.input_scale),
        "output_mean": np.asarray(network.output_mean),
        "output_scale": np.asarray(network.output_scale),
    }


def _checksum(header: Mapping[str, Any], arrays: Mapping[str, Array]) -> str:
    digest = hashlib.sha256(json.dumps(header, sort_keys=True).encode())
    for name in sorted(arrays):
        array = arrays[name]
        digest.update(f"{name} {array.dtype.str} {array.shape}".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def _check_network(name: str, network: Network, inputs: int, outputs: int) -> None:
    parts = _parts(network)
    wanted = array_shapes(network.spec, inputs)
    for key in sorted(set(network.arrays) ^ set(wanted)):
        raise ValueError(f"{name}: array {key!r} is {'missing' if key in wanted else 'unexpected'}")
    wanted |= {"input_mean": (inputs,), "input_scale": (inputs,)}
    wanted |= {"output_mean": (outputs,), "output_scale": (outputs,)}
    for key, shape in wanted.items():
        array = parts[key]
        if array.shape != shape:
            raise ValueError(f"{name}: {key!r}: expected shape {shape}, found {array.shape}")
        if array.dtype not in (np.float32, np.float64) or not np.isfinite(array).all():
            raise ValueError(f"{name}: {key!r} is not an array of finite floats")
