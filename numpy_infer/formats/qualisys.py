"""Qualisys Track Manager's TSV export: 3-D trajectories in millimetres, by definition.

`KEY<tab>value` lines, then perhaps a line of column names, then the frames, with or without the
columns Frame and Time. A gap is NaN, blank, or three exact zeros. A trajectory that is not
`Measured` (`Mixed`, `Gap-filled`, `Virtual`) is reported in `Recording.filled`.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from numpy_infer.formats.table import (
    TextFile,
    check_writable,
    hertz,
    hide_gaps,
    number,
    positive,
    read_text,
    write_rows,
)
from numpy_infer.formats.units import agreed
from numpy_infer.recordings import Recording

MILLIMETRE = 1e-3
_KEY = re.compile(r"(?!NAN\b)[A-Z][A-Z0-9_]*")


def read(path: Path, *, unit: float | None = None, left_handed: bool = False) -> Recording:
    """Read a QTM TSV file; ValueError names file and line."""
    scale = agreed(path, MILLIMETRE, unit)
    file = read_text(path)
    header, first = _header(file)
    names, types = _trajectories(file, header)
    leading, first = _leading_columns(file, first, len(names))
    table = file.numbers(first, len(leading) + 3 * len(names), "\t")
    file.check_count("frames", int(_number(file, header, "NO_OF_FRAMES")), len(table))
    rate = hertz(_number(file, header, "FREQUENCY"), file.where(0), "FREQUENCY")
    if "Time" in leading:
        time = table[:, leading.index("Time")]
        file.check_time(time, first)
    else:
        time = np.arange(len(table)) / rate
    positions = table[:, len(leading) :].reshape(len(table), -1, 3)
    markers, notes = hide_gaps(positions * scale, zeros=True)
    filled = tuple(name for name, kind in zip(names, types, strict=True) if kind != "Measured")
    if filled:
        notes += (f"not purely measured: {', '.join(filled)}",)
    recording = Recording(
        names=names,
        markers=markers,
        time=time,
        rate=rate,
        source=str(path),
        unit=scale,
        filled=filled,
        notes=file.notes + notes,
    )
    return recording.reflected() if left_handed else recording


def write(recording: Recording, path: Path) -> None:
    """Write millimetres with 6 decimals; gaps are NaN, filled markers are `Mixed`."""
    check_writable(recording.names)
    types = ["Mixed" if name in recording.filled else "Measured" for name in recording.names]
    columns = [f"{name} {axis}" for name in recording.names for axis in "XYZ"]
    rows = [
        ["NO_OF_FRAMES", str(len(recording.time))],
        ["NO_OF_MARKERS", str(len(recording.names))],
        ["FREQUENCY", number(recording.rate)],
        ["DATA_INCLUDED", "3D"],
        ["MARKER_NAMES", *recording.names],
        ["TRAJECTORY_TYPES", *types],
        ["Frame", "Time", *columns],
    ]
    write_rows(path, rows, recording, gap="NaN")


def _header(file: TextFile) -> tuple[dict[str, tuple[int, list[str]]], int]:
    """{key: (line index, values)}, and the index of the first line after them."""
    header: dict[str, tuple[int, list[str]]] = {}
    for index in range(len(file.lines)):
        key, *values = file.cells(index, "\t")
        if not _KEY.fullmatch(key):
            return header, index
        header[key] = (index, values)
    raise file.error(len(file.lines), "the file ends inside its header")


def _trajectories(
    file: TextFile, header: dict[str, tuple[int, list[str]]]
) -> tuple[tuple[str, ...], list[str]]:
    """Marker names and, for each, its trajectory type."""
    if "MARKER_NAMES" not in header:
        raise file.error(0, "the header has no MARKER_NAMES: expected a QTM file of 3-D data")
    included = header.get("DATA_INCLUDED", (0, ["3D"]))
    if included[1][:1] != ["3D"]:
        raise file.error(included[0], f"expected DATA_INCLUDED 3D, found {included[1]}")
    index, labels = header["MARKER_NAMES"]
    names = file.unique(index, _without_trailing(labels), "marker")
    count = int(_number(file, header, "NO_OF_MARKERS"))
    if len(names) != count:
        raise file.error(index, f"the header states {count} markers, found {len(names)} names")
    index, types = header.get("TRAJECTORY_TYPES", (index, ["Measured"] * count))
    types = _without_trailing(types)
    if len(types) != count:
        raise file.error(index, f"expected {count} trajectory types, found {len(types)}")
    return names, types


def _leading_columns(file: TextFile, first: int, markers: int) -> tuple[list[str], int]:
    """Which of Frame and Time stand before the positions, and the index of the first frame."""
    cells = file.cells(first, "\t")
    if cells[0] in ("Frame", "Time") or cells[0].endswith(" X"):
        return [cell for cell in cells[:2] if cell in ("Frame", "Time")], first + 1
    # Two cells more are both columns; one more is the empty cell after a trailing tab.
    return (["Frame", "Time"] if len(cells) - 3 * markers >= 2 else []), first


def _number(file: TextFile, header: dict[str, tuple[int, list[str]]], key: str) -> float:
    index, values = header.get(key, (0, []))
    if not values:
        raise file.error(index, f"the header has no {key}")
    return positive(values[0], file.where(index), key)


def _without_trailing(cells: list[str]) -> list[str]:
    named = next((i for i in reversed(range(len(cells))) if cells[i]), -1)
    return cells[: named + 1]
