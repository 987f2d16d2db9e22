"""OptiTrack Motive's CSV export, format versions 1.2x (Motive 1.10 to 3).

Line 1 holds key, value pairs; then come rows of column headings (Type, Name, ID, in newer files
Parent; Rotation or Position; axis), then the frames. Blank cells are gaps.

Only columns of Type `Marker` are measurements. `Rigid Body Marker` and `Bone Marker` are where the
solved body or skeleton says that its markers should be, present even while nothing is seen: they
are left out.
"""

from __future__ import annotations

import csv
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from numpy_infer.formats.table import TextFile, hertz, hide_gaps, positive, read_text
from numpy_infer.formats.units import agreed, metres_per
from numpy_infer.recordings import Recording

_MEASURED = "Marker"


@dataclass(frozen=True)
class _Headings:
    """One entry per column: what its headings say; `first` is the index of the first frame."""

    types: list[str]
    names: list[str]
    quantities: list[str]
    axes: list[str]
    names_line: int
    first: int


def read(path: Path, *, unit: float | None = None, left_handed: bool = False) -> Recording:
    """Read the measured markers of a Motive CSV; ValueError names file and line."""
    file = read_text(path)
    settings = _settings(file)
    scale = agreed(path, metres_per(settings["Length Units"], file.where(0)), unit)
    headings = _headings(file)
    names, columns = _marker_columns(file, headings)
    table = file.numbers(headings.first, len(headings.axes), ",")
    if "Total Exported Frames" in settings:
        frames = positive(settings["Total Exported Frames"], file.where(0), "Total Exported Frames")
        file.check_count("frames", int(frames), len(table))
    time = table[:, 1]
    file.check_time(time, headings.first)
    markers, _ = hide_gaps(table[:, columns] * scale, zeros=False)
    recording = Recording(
        names=names,
        markers=markers,
        time=time,
        rate=_rate(file, settings),
        source=str(path),
        unit=scale,
        notes=file.notes + _left_out(headings),
    )
    return recording.reflected() if left_handed else recording


def _settings(file: TextFile) -> dict[str, str]:
    cells = _row(file, 0)
    settings = dict(zip(cells[::2], cells[1::2], strict=False))
    if cells[:1] != ["Format Version"] or not settings.get("Length Units"):
        raise file.error(
            0, "expected a Motive export with its header: Format Version, ..., Length Units, ..."
        )
    if settings.get("Coordinate Space", "Global") != "Global":
        raise file.error(
            0, f"Coordinate Space is {settings['Coordinate Space']}; export it as Global"
        )
    return settings


def _rate(file: TextFile, settings: dict[str, str]) -> float:
    for key in ("Export Frame Rate", "Capture Frame Rate"):
        if settings.get(key):
            return hertz(positive(settings[key], file.where(0), key), file.where(0), key)
    raise file.error(0, "the header has no Export Frame Rate")


def _headings(file: TextFile) -> _Headings:
    rows: dict[str, list[str]] = {}
    names_line = 0
    for index in range(1, len(file.lines)):
        cells = _row(file, index)
        if cells and cells[0] == "Frame":
            missing = [label for label in ("Type", "Name", "Position") if label not in rows]
            if missing or not cells[1:2] or not cells[1].startswith("Time"):
                raise file.error(index, f"expected rows Type, Name, Position above; no {missing}")
            types, names, quantities = (
                rows[label] + [""] * (len(cells) - len(rows[label]))
                for label in ("Type", "Name", "Position")
            )
            return _Headings(types, names, quantities, cells, names_line, index + 1)
        # Rows say what they are in their second cell, except the one of Rotation and Position.
        label = "Position" if "Position" in cells else "".join(cells[1:2])
        if label:
            rows[label] = cells
        if label == "Name":
            names_line = index
    raise file.error(len(file.lines), "the file ends inside its header")


def _marker_columns(file: TextFile, headings: _Headings) -> tuple[tuple[str, ...], np.ndarray]:
    """Names of the measured markers and the [M, 3] columns of their coordinates."""
    found: dict[str, dict[str, int]] = {}
    for column, axis in enumerate(headings.axes):
        if (headings.types[column], headings.quantities[column]) != (_MEASURED, "Position"):
            continue
        axes = found.setdefault(headings.names[column], {})
        if axis in axes:
            name = headings.names[column]
            raise file.error(headings.names_line, f"duplicate marker {name!r}")
        axes[axis] = column
    if not found:
        raise file.error(
            headings.names_line,
            "no columns of Type Marker, which are the measured ones; there are "
            + ", ".join(dict.fromkeys(filter(None, headings.types[2:]))),
        )
    for name, axes in found.items():
        if set(axes) != set("XYZ"):
            raise file.error(headings.names_line, f"marker {name!r}: expected axes X, Y, Z")
    columns = np.array([[axes[axis] for axis in "XYZ"] for axes in found.values()])
    return file.unique(headings.names_line, list(found), "marker"), columns


def _left_out(headings: _Headings) -> tuple[str, ...]:
    solved = Counter(kind for kind in headings.types[2:] if kind not in ("", _MEASURED))
    return tuple(
        f"{count} columns of Type {kind} are solved, not measured, and left out"
        for kind, count in solved.items()
    )


def _row(file: TextFile, index: int) -> list[str]:
    try:
        return [cell.strip() for cell in next(csv.reader([file.lines[index]]), [])]
    except csv.Error as error:
        raise file.error(index, f"not CSV: {error}") from None
