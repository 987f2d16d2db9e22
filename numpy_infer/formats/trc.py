"""TRC: tab-separated marker trajectories (Motion Analysis, OpenSim).

Five header lines: file type, names of the settings, their values, marker labels (one per three
columns), axis labels. The unit is in the header, or is given where it is blank there. A gap is
blank, NaN, or three exact zeros.
Some files leave out whole frames: their rows stay as they are, and frame numbers and times jump.
"""

from __future__ import annotations

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
from numpy_infer.formats.units import agreed, metres_per
from numpy_infer.recordings import Recording


def read(path: Path, *, unit: float | None = None, left_handed: bool = False) -> Recording:
    """Read a TRC file; ValueError names file and line."""
    file = read_text(path)
    if not file.lines[0].startswith("PathFileType"):
        raise file.error(0, "expected a TRC file, which starts with PathFileType")
    settings = _settings(file)
    stated = metres_per(settings["Units"], file.where(2)) if settings.get("Units") else None
    if stated is None and unit is None:
        raise file.error(2, "the header has no Units: pass --unit mm (cm, m, in)")
    scale = agreed(path, stated, unit)
    names = _names(file, int(positive(settings["NumMarkers"], file.where(2), "NumMarkers")))
    file.cells(4, "\t")
    first = 6 if len(file.lines) > 5 and not file.lines[5].strip() else 5
    table = file.numbers(first, 2 + 3 * len(names), "\t")
    count = int(positive(settings["NumFrames"], file.where(2), "NumFrames"))
    left_out = _frames_left_out(file, count, table[:, 0])
    file.check_time(table[:, 1], first)
    rate = hertz(
        positive(settings["DataRate"], file.where(2), "DataRate"), file.where(2), "DataRate"
    )
    markers, notes = hide_gaps(table[:, 2:].reshape(len(table), -1, 3) * scale, zeros=True)
    recording = Recording(
        names=names,
        markers=markers,
        time=table[:, 1],
        rate=rate,
        source=str(path),
        unit=scale,
        notes=file.notes + left_out + notes,
    )
    return recording.reflected() if left_handed else recording


def write(recording: Recording, path: Path) -> None:
    """Write millimetres with 6 decimals; gaps are blank."""
    check_writable(recording.names)
    frames, rate = len(recording.time), number(recording.rate)
    settings = {
        "DataRate": rate,
        "CameraRate": rate,
        "NumFrames": str(frames),
        "NumMarkers": str(len(recording.names)),
        "Units": "mm",
        "OrigDataRate": rate,
        "OrigDataStartFrame": "1",
        "OrigNumFrames": str(frames),
    }
    labels = [cell for name in recording.names for cell in (name, "", "")]
    axes = [f"{axis}{index + 1}" for index in range(len(recording.names)) for axis in "XYZ"]
    rows = [
        ["PathFileType", "4", "(X/Y/Z)", path.name],
        list(settings),
        list(settings.values()),
        ["Frame#", "Time", *labels],
        ["", "", *axes],
        [],
    ]
    write_rows(path, rows, recording, gap="")


def _settings(file: TextFile) -> dict[str, str]:
    keys, values = file.cells(1, "\t"), file.cells(2, "\t")
    settings = dict(zip(keys, values, strict=False))
    for key in ("DataRate", "NumFrames", "NumMarkers"):
        if not settings.get(key):
            tabs = "" if "\t" in file.lines[1] else ": expected tabs between its columns"
            raise file.error(2, f"the header has no {key}{tabs}")
    return settings


def _frames_left_out(file: TextFile, stated: int, numbers: np.ndarray) -> tuple[str, ...]:
    """A note if frame numbers [T] jump; ValueError if rows are missing without a jump."""
    jumps = numbers[0] > 1 or (np.diff(numbers) != 1).any()
    if not jumps or len(numbers) > stated:
        file.check_count("frames", stated, len(numbers))
        return ()
    return (f"{stated - len(numbers)} of {stated} frames are left out: time jumps",)


def _names(file: TextFile, count: int) -> tuple[str, ...]:
    cells = file.cells(3, "\t")[2:]
    names = cells[::3]
    while names and not names[-1]:
        names.pop()
    stray = [cell for index, cell in enumerate(cells) if index % 3 and cell]
    if stray:
        raise file.error(3, f"expected one label per three columns, found {stray[0]!r} between")
    if len(names) != count:
        raise file.error(3, f"the header states {count} markers, found {len(names)} labels")
    return file.unique(3, names, "marker")
