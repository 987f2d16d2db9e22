"""C3D files, through ezc3d (the extra `c3d`). `numpy_infer.recordings` finds it by entry point."""

from __future__ import annotations

import re
import struct
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from numpy_infer.formats.units import agreed, metres_per
from numpy_infer.recordings import Recording

_BLOCK = 512  # bytes


def read(path: Path, *, unit: float | None = None, left_handed: bool = False) -> Recording:
    """Read the points of a C3D file; a residual below 0 is a gap. Time starts at 0."""
    contents = _open(_ezc3d(), Path(path))
    parameters = contents["parameters"]["POINT"]
    stated = _text(parameters, "UNITS")
    scale = agreed(path, metres_per(stated, str(path)) if stated else None, unit)
    points = contents["data"]["points"][:3]  # [3, M, T]
    residuals = contents["data"]["meta_points"]["residuals"][0]  # [M, T]
    # A parameter holds 255 of them; LABELS2 goes on, and so forth.
    parts = [key for key in parameters if re.fullmatch("LABELS[0-9]*", key)]
    parts.sort(key=lambda key: int(key.removeprefix("LABELS") or 1))
    labels = [str(label).strip() for key in parts for label in parameters[key]["value"]]
    frames, rate = points.shape[2], float(parameters["RATE"]["value"][0])
    _check_labels(path, labels, points.shape)
    # ezc3d makes these NaN of its own accord; what the format promises is the residual.
    measured = (residuals >= 0) & np.isfinite(points).all(axis=0)
    recording = Recording(
        names=tuple(labels),
        markers=np.where(measured, points, np.nan).transpose(2, 1, 0) * scale,
        time=np.arange(frames) / rate,
        rate=rate,
        source=str(path),
        unit=scale,
    )
    return recording.reflected() if left_handed else recording


def check() -> None:
    """Raises, before any work, what `write` would raise after it: ezc3d is not installed."""
    _ezc3d()


def write(recording: Recording, path: Path) -> None:
    """Write float32 millimetres; gaps get residual −1.

    C3D keeps a rate and no times: ValueError if the recording's frames are not evenly spaced.
    """
    drift = np.diff(recording.time) * recording.rate - 1.0
    # Rounded times differ from step to step, and lead nowhere.
    frames = (recording.time - recording.time[0]) * recording.rate
    astray = np.abs(frames - np.arange(len(frames))) > 0.1
    if (np.abs(drift) > 0.01).any() and astray.any():
        raise ValueError(
            f"C3D holds evenly spaced frames only; frame {int(np.argmax(np.abs(drift))) + 1} is "
            f"not 1/{recording.rate:g} s after the one before: resample, or write TRC or CSV"
        )
    visible = recording.visible.T  # [M, T]
    millimetres = np.where(visible, recording.markers.transpose(2, 1, 0) * 1e3, 0.0)
    contents = _ezc3d().c3d()
    contents["parameters"]["POINT"]["RATE"]["value"] = [recording.rate]
    contents["parameters"]["POINT"]["LABELS"]["value"] = list(recording.names)
    contents["parameters"]["POINT"]["UNITS"]["value"] = ["mm"]
    contents["data"]["points"] = np.concatenate([millimetres, np.ones((1, *visible.shape))])
    contents["data"]["meta_points"]["residuals"] = np.where(visible, 0.0, -1.0)[None]
    contents.write(str(path))


def _ezc3d() -> ModuleType:
    try:
        import ezc3d
    except ImportError:
        raise ValueError("C3D files need ezc3d: pip install 'jaxhand[c3d]'") from None
    module: ModuleType = ezc3d
    return module


def _open(ezc3d: ModuleType, path: Path) -> Any:
    _check_length(path)
    try:
        return ezc3d.c3d(str(path))
    except (OSError, RuntimeError, ValueError, IndexError) as error:
        raise ValueError(f"{path}: not a whole C3D file: {error}") from None


def _check_length(path: Path) -> None:
    """ValueError unless the file is as long as its header says.

    Of a file that is cut off, ezc3d reads what is left, or loops for ever.
    """
    with path.open("rb") as file:
        header = file.read(_BLOCK)
        if len(header) < _BLOCK or header[1] != 0x50:
            raise ValueError(f"{path}: not a C3D file")
        file.seek(_BLOCK * (header[0] - 1))
        _, _, parameter_blocks, processor = file.read(4).ljust(4, b"\0")
    # Intel and DEC put the low byte first, MIPS the high one; the sign bit is elsewhere in each.
    order, sign_byte = {85: ("<", 1), 86: (">", 0)}.get(processor, ("<", 3))
    points, analog, first, last = struct.unpack(f"{order}4H", header[2:10])
    (data_block,) = struct.unpack(f"{order}H", header[16:18])
    in_floats = header[12 + sign_byte] & 0x80
    # Recordings longer than 16 bits can count keep their length elsewhere.
    frames = last - first + 1 if last < 0xFFFF else 0
    data = frames * (4 * points + analog) * (4 if in_floats else 2)
    needed = max(
        _BLOCK * (header[0] - 1 + max(parameter_blocks, 1)), _BLOCK * (data_block - 1) + data
    )
    if path.stat().st_size < needed:
        raise ValueError(
            f"{path}: the header needs {needed} bytes, found {path.stat().st_size}: cut off?"
        )


def _text(parameters: Any, key: str) -> str:
    values = parameters[key]["value"] if key in parameters else []
    return str(values[0]).strip() if values else ""


def _check_labels(path: Path, labels: list[str], shape: tuple[int, ...]) -> None:
    """ValueError unless every one of the points [3, M, T] has its own label."""
    if len(labels) != shape[1]:
        raise ValueError(f"{path}: expected {shape[1]} labels, found {len(labels)}")
    for index, label in enumerate(labels):
        if not label or label in labels[:index]:
            raise ValueError(f"{path}: point {index + 1}: empty or duplicate label {label!r}")
