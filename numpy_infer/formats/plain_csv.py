"""Plain CSV: the format of our own that any spreadsheet opens.

    # unit: m
    # rate: 120
    # frames: 2
    time,thumb_tip.x,thumb_tip.y,thumb_tip.z
    0,0.1,0.2,0.3
    0.00833,,,

Comment lines come first; `unit` must be there or be given, `rate` and `frames` are optional. A
blank or NaN cell is a gap; so are three exact zeros in a file whose markers jump there, unless it
says `# gaps: blank`, as those that we write do. Quotes about cells are left out; semicolons between
columns, and decimal commas, are what spreadsheets make of it in half of the world. Of what tracking
adds `NAME.status` is read, where numbers other than 0 say that the marker was filled, and the rest
with a note alone: columns that end in `.deg` (joint angles) or `.pose`, and of each marker
`NAME.expected_error`, in the file's unit. The markers of a file that we write read back bit for
bit.
"""

from __future__ import annotations

from dataclasses import replace
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
    zeros_are_gaps,
)
from numpy_infer.formats.units import agreed, metres_per
from numpy_infer.hand import ANGLES
from numpy_infer.pose import Status
from numpy_infer.recordings import Recording, median_rate

TRACKED = (".deg", ".pose", ".status", ".expected_error")
"""Endings of columns that tracking adds."""
WRIST = tuple(f"wrist_{part}.pose" for part in ("x", "y", "z", "qx", "qy", "qz", "qw"))
"""Columns of `Recording.wrist`."""


def read(path: Path, *, unit: float | None = None, left_handed: bool = False) -> Recording:
    """Read a plain CSV file; ValueError names file and line."""
    file = read_text(path)
    file = replace(file, lines=[line.replace('"', "") for line in file.lines])
    first = next((line for line in file.lines if not line.startswith("#")), "")
    if ";" in first and "," not in first:
        swap = str.maketrans(",;", ".,")
        file = replace(file, lines=[line.translate(swap) for line in file.lines])
    comments, header = _comments(file)
    cells = _header(file, header)
    names, columns, notes = _columns(file, header, cells)
    stated = metres_per(*comments["unit"]) if "unit" in comments else None
    scale = agreed(path, stated, unit)
    status = {
        cell.removesuffix(".status"): i for i, cell in enumerate(cells) if cell.endswith(".status")
    }
    table = file.numbers(header + 1, len(cells), ",")
    time = table[:, 0]
    file.check_time(time, header + 1)
    if "frames" in comments:
        file.check_count("frames", int(positive(*comments["frames"], "frames")), len(table))
    if "rate" in comments:
        rate = hertz(positive(*comments["rate"], "rate"), comments["rate"][1], "rate")
    else:
        try:
            rate = median_rate(time, path)
        except ValueError as error:
            raise ValueError(f"{error}; a line '# rate: 60' before the header does") from None
    positions = table[:, columns] * scale
    blank = comments.get("gaps", ("", ""))[0].lower() == "blank"
    markers, gaps = hide_gaps(positions, zeros=not blank and zeros_are_gaps(positions))
    # A blank cell rests on nothing, whatever its status.
    seen = np.isfinite(markers).all(-1)
    told = np.full(seen.shape, np.nan)
    for i, name in enumerate(names):
        if name in status:
            told[:, i] = np.where(seen[:, i], table[:, status[name]], np.nan)
    filled = tuple(name for name, own in zip(names, told.T, strict=True) if (own > 0).any())
    recording = Recording(
        names=names,
        markers=markers,
        time=time,
        rate=rate,
        source=str(path),
        unit=scale,
        status=told if status else None,
        filled=filled,
        notes=file.notes + notes + gaps,
    )
    return recording.reflected() if left_handed else recording


def write(recording: Recording, path: Path) -> None:
    """Write metres with every digit, and what tracking says: angles in degrees, the wrist's pose to
    the nanometre, of each marker what it rests on, and to the micrometre how far off to expect it.
    Gaps are blank."""
    check_writable(recording.names)
    columns = [f"{name}.{axis}" for name in recording.names for axis in "xyz"]
    markers = np.where(recording.visible[..., None], recording.markers, np.nan)
    table = markers.reshape(len(markers), -1)
    if recording.angles is not None:
        columns += [f"{angle.name}.deg" for angle in ANGLES]
        table = np.concatenate([table, np.degrees(recording.angles)], -1)
    if recording.wrist is not None:
        columns += WRIST
        table = np.concatenate([table, recording.wrist.round(9)], -1)
    comments = [
        "# unit: m",
        f"# rate: {number(recording.rate)}",
        f"# frames: {len(recording.time)}",
        "# gaps: blank",
    ]
    if recording.status is not None:
        comments.append("# status: " + ", ".join(f"{s.value} {s.name.lower()}" for s in Status))
        columns += [f"{name}.status" for name in recording.names]
        status = np.where(recording.visible, recording.status, np.nan)
        table = np.concatenate([table, status], -1)
    if recording.expected_error is not None:
        columns += [f"{name}.expected_error" for name in recording.names]
        expected = np.where(recording.visible, recording.expected_error, np.nan)
        table = np.concatenate([table, expected.round(6)], -1)
    with path.open("w", encoding="utf-8", newline="\n") as file:
        file.writelines(line + "\n" for line in (*comments, ",".join(["time", *columns])))
        for time, row in zip(recording.time, table, strict=True):
            cells = ["" if value != value else number(value) for value in row.tolist()]
            file.write(",".join([number(time), *cells]) + "\n")


def _comments(file: TextFile) -> tuple[dict[str, tuple[str, str]], int]:
    """{key: (value, FILE:LINE)} of the leading comment lines, and the header's line index."""
    comments: dict[str, tuple[str, str]] = {}
    for index, line in enumerate(file.lines):
        if not line.startswith("#"):
            return comments, index
        key, colon, value = line[1:].partition(":")
        if colon:
            comments[key.strip().lower()] = (value.strip().rstrip(","), file.where(index))
    raise file.error(len(file.lines), "the file has comments and no header")


def _header(file: TextFile, index: int) -> tuple[str, ...]:
    """The names of all columns."""
    line = file.lines[index]
    if not line.strip():
        raise file.error(
            index, "the line is empty where the header should be; no empty line may stand between"
        )
    cells = file.cells(index, ",")
    if cells[0] != "time":
        tabs = "\t" in line and "," not in line
        found = "columns separated by tabs, not by commas" if tabs else repr(cells[0])
        raise file.error(
            index,
            f"expected the first column to be time, found {found}; the header is "
            "time,NAME.x,NAME.y,NAME.z,… for all markers",
        )
    return file.unique(index, cells, "column")


def _columns(
    file: TextFile, header: int, cells: tuple[str, ...]
) -> tuple[tuple[str, ...], np.ndarray, tuple[str, ...]]:
    """Marker names, the [M, 3] columns of their coordinates, and notes about skipped columns."""
    place = {cell: index for index, cell in enumerate(cells)}
    tracked = [cell for cell in cells[1:] if cell.endswith(TRACKED)]
    coordinates = [cell for cell in cells[1:] if not cell.endswith(TRACKED)]
    names = tuple(dict.fromkeys(cell.rpartition(".")[0] for cell in coordinates))
    for cell in coordinates:
        if not cell.endswith((".x", ".y", ".z")) or len(cell) < 3:
            raise file.error(header, f"unknown column {cell!r}; expected NAME.x, NAME.y, NAME.z")
    for name in names:
        for axis in "xyz":
            if f"{name}.{axis}" not in place:
                raise file.error(header, f"marker {name!r} has no column {name}.{axis}")
    if not names:
        raise file.error(header, "no marker columns; expected NAME.x, NAME.y, NAME.z")
    columns = np.array([[place[f"{name}.{axis}"] for axis in "xyz"] for name in names])
    kinds = [kind for kind in TRACKED if any(cell.endswith(kind) for cell in tracked)]
    notes = (f"{len(tracked)} columns of tracking ({', '.join(kinds)}) are not markers",)
    return names, columns, notes if tracked else ()
