"""The paper authors' CSV files: a pair per take, and their hand template.

`out_mocap_TAKE.csv`: time, then per marker NAME.pos.x, .y, .z and NAME.isValid.
`out_fused_TAKE.csv`: time, then per joint NAME.pos.x, .y, .z and NAME.rot.x, .y, .z, then isValid.
`hand.csv`: marker, its position, its joint, the joint's position, 1 if it is an alignment marker.

Metres, Unity's left-handed frame with y up (z is negated here), Euler degrees applied z, x, y.
Their program applies the fused rotations to Unity's `localRotation`, and calls the fused
positions object space: they are local truth, not world truth.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from numpy_infer.formats.euler import composed
from numpy_infer.formats.table import TextFile, hide_gaps, read_text
from numpy_infer.formats.units import agreed
from numpy_infer.recordings import JointTruth, Recording, median_rate

_POSITION = ("pos.x", "pos.y", "pos.z")
_ROTATION = ("rot.x", "rot.y", "rot.z")
_Y_X_Z = [1, 0, 2]  # q = qy · qx · qz
_REFLECT_Z = np.array([1.0, 1.0, -1.0])


@dataclass(frozen=True, eq=False)
class HandCsv:
    """The authors' template at rest: right-handed metres, otherwise in their own axes.

    marker_names: M. markers: [M, 3]. alignment: [M] True for alignment markers.
    joint_names: M, the joint that each marker belongs to. joints: [M, 3].
    """

    marker_names: tuple[str, ...]
    markers: np.ndarray
    joint_names: tuple[str, ...]
    joints: np.ndarray
    alignment: np.ndarray


def read(path: Path, *, unit: float | None = None, left_handed: bool = False) -> Recording:
    """Read `out_mocap_*.csv`, with its `out_fused_*` sibling as joint truth if it fits.

    left_handed changes nothing: this format always is. ValueError names file and line.
    """
    agreed(path, 1.0, unit)
    file = read_text(path)
    columns = _columns(file)
    _check_fields(file, columns, (*_POSITION, "isValid"), alone=("time",))
    names = _owners(columns, "pos.x")
    table = _numbers(file, columns)
    time = table[:, columns["time"]]
    file.check_time(time, 1)
    positions = table[:, [[columns[f"{name}.{field}"] for field in _POSITION] for name in names]]
    valid = table[:, [columns[f"{name}.isValid"] for name in names]] == 1
    markers, _ = hide_gaps(np.where(valid[..., None], positions, np.nan), zeros=False)
    joints, notes = _fused(path, time)
    recording = Recording(
        names=names,
        markers=markers,
        time=time,
        rate=median_rate(time, path),
        source=str(path),
        joints=joints,
        notes=file.notes + notes,
    )
    return recording.reflected()


def read_hand_csv(path: Path) -> HandCsv:
    """Read the authors' `hand.csv`, with z negated; ValueError names file and line."""
    file = read_text(path)
    expected = ["marker", *(f"marker.{field}" for field in _POSITION)]
    expected += ["joint", *(f"joint.{field}" for field in _POSITION), "alignment"]
    if file.cells(0, ",") != expected:
        raise file.error(0, f"expected the columns {','.join(expected)}")
    rows = [file.cells(index, ",") for index in range(1, len(file.lines))]
    positions = np.empty((len(rows), 2, 3))
    for index, row in enumerate(rows, start=1):
        if len(row) != len(expected):
            raise file.error(index, f"expected {len(expected)} columns, found {len(row)}")
        try:
            positions[index - 1] = np.array([row[1:4], row[5:8]], dtype=float)
        except ValueError:
            raise file.error(index, "expected numbers in the columns of positions") from None
        if row[8] not in ("0", "1"):
            raise file.error(index, f"alignment: expected 0 or 1, found {row[8]!r}")
    if not rows:
        raise file.error(0, "the file has a header and no markers")
    if not np.isfinite(positions).all():
        raise file.error(1, "a position is not a finite number")
    return HandCsv(
        marker_names=file.unique(0, [row[0] for row in rows], "marker"),
        markers=positions[:, 0] * _REFLECT_Z,
        joint_names=tuple(row[4] for row in rows),
        joints=positions[:, 1] * _REFLECT_Z,
        alignment=np.array([row[8] == "1" for row in rows]),
    )


def _fused(path: Path, time: np.ndarray) -> tuple[JointTruth | None, tuple[str, ...]]:
    """The sibling's joints, still left-handed, or a note that says why there are none."""
    sibling = path.with_name(path.name.replace("out_mocap_", "out_fused_", 1))
    if sibling == path or not sibling.exists():
        return None, ()
    file = read_text(sibling)
    columns = _columns(file)
    _check_fields(file, columns, (*_POSITION, *_ROTATION), alone=("time", "isValid"))
    names = _owners(columns, "rot.x")
    table = _numbers(file, columns)
    fused_time = table[:, columns["time"]]
    if len(fused_time) != len(time) or not np.allclose(fused_time, time, rtol=0, atol=1e-6):
        return None, (f"{sibling.name} is ignored: its frames are at other times",)
    valid = (table[:, columns["isValid"]] == 1)[:, None, None]
    positions = table[:, [[columns[f"{name}.{field}"] for field in _POSITION] for name in names]]
    x_y_z = table[:, [[columns[f"{name}.{field}"] for field in _ROTATION] for name in names]]
    rotations = composed(_Y_X_Z, x_y_z[..., _Y_X_Z])
    joints = JointTruth(
        names=names,
        positions=np.where(valid, positions, np.nan),
        rotations=np.where(valid[..., None], rotations, np.nan),
        frame="local",
    )
    return joints, (f"joints come from {sibling.name}", *file.notes)


def _columns(file: TextFile) -> dict[str, int]:
    cells = list(file.cells(0, ","))
    return {name: index for index, name in enumerate(file.unique(0, cells, "column"))}


def _owners(columns: dict[str, int], field: str) -> tuple[str, ...]:
    return tuple(name.removesuffix("." + field) for name in columns if name.endswith("." + field))


def _check_fields(
    file: TextFile, columns: dict[str, int], fields: tuple[str, ...], alone: tuple[str, ...]
) -> None:
    """ValueError unless the columns are `alone` and NAME.field for every name and field."""
    owners = _owners(columns, fields[0])
    expected = {*alone, *(f"{owner}.{field}" for owner in owners for field in fields)}
    unknown = [column for column in columns if column not in expected]
    missing = sorted(column for column in expected if column not in columns)
    if unknown or missing or not owners:
        raise file.error(
            0,
            f"expected {', '.join(alone)} and NAME.{', NAME.'.join(fields)}; "
            f"unknown: {', '.join(unknown) or 'none'}; missing: {', '.join(missing) or 'none'}",
        )


def _numbers(file: TextFile, columns: dict[str, int]) -> np.ndarray:
    # C# writes 1 and 0; pandas, which others use on these files, writes True and False.
    lines = [line.lower().replace("true", "1").replace("false", "0") for line in file.lines]
    return TextFile(file.path, lines, ()).numbers(1, len(columns), ",")
