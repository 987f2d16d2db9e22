"""BVH: a skeleton and its joint rotations over time, in Euler degrees and a unit it never states.

A joint's rotation is the product of its rotation channels in the order listed. A position channel
replaces that coordinate of the joint's OFFSET, as Blender and MotionBuilder have it.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from numpy_infer.formats.euler import composed
from numpy_infer.formats.table import LARGEST, TextFile, hertz, positive, read_text
from numpy_infer.formats.units import agreed
from numpy_infer.recordings import JointTruth, Recording

_AXES = "XYZ"

MOST_JOINTS = 10
"""Per channel: a file of more stiff joints would take far more memory than its own size."""


@dataclass(frozen=True, eq=False)
class Bvh:
    """A BVH file as it stands: in its own unit and its own handedness.

    names: J joints, every parent before its children. parents: [J], −1 for a root.
    offsets: [J, 3] rest position in the parent's frame.
    end_parents: [E] the joint of each End Site. end_offsets: [E, 3] in that joint's frame.
    frame_time: seconds. translations: [T, J, 3] position in the parent's frame.
    local_rotations: [T, J, 3, 3] parent_from_joint, acting on columns.
    notes: what the reader wants the user to know.
    """

    names: tuple[str, ...]
    parents: np.ndarray
    offsets: np.ndarray
    end_parents: np.ndarray
    end_offsets: np.ndarray
    frame_time: float
    translations: np.ndarray
    local_rotations: np.ndarray
    notes: tuple[str, ...] = ()

    def forward(self) -> tuple[np.ndarray, np.ndarray]:
        """World positions [T, J, 3] and rotations world_from_joint [T, J, 3, 3]."""
        positions = self.translations.copy()
        rotations = self.local_rotations.copy()
        for joint, parent in enumerate(self.parents):
            if parent >= 0:
                world_from_parent = rotations[:, parent]
                moved = world_from_parent @ self.translations[:, joint, :, None]
                positions[:, joint] = positions[:, parent] + moved[..., 0]
                rotations[:, joint] = world_from_parent @ self.local_rotations[:, joint]
        return positions, rotations


def read(path: Path, *, unit: float | None = None, left_handed: bool = False) -> Recording:
    """Joint positions under the joints' names, with positions and rotations as joint truth."""
    scale = agreed(path, None, unit)
    bvh = read_bvh(path)
    positions, rotations = bvh.forward()
    recording = Recording(
        names=bvh.names,
        markers=positions * scale,
        time=np.arange(len(positions)) * bvh.frame_time,
        rate=hertz(1.0 / bvh.frame_time, str(path), "Frame Time"),
        source=str(path),
        unit=scale,
        joints=JointTruth(bvh.names, positions * scale, rotations),
        notes=bvh.notes,
    )
    return recording.reflected() if left_handed else recording


def read_bvh(path: Path) -> Bvh:
    """Read skeleton and motion as they stand; ValueError names file and line."""
    file = read_text(path)
    hierarchy = _read_hierarchy(file)
    first, frames, frame_time = _read_motion_header(file, hierarchy.end)
    table = file.numbers(first, len(hierarchy.channels), None)
    file.check_count("frames", frames, len(table))
    finite = np.isfinite(table).all(axis=1)
    if not finite.all():
        raise file.error(first + int(np.argmin(finite)), "a channel is not a finite number")
    translations, local_rotations = _channels_to_motion(hierarchy, table)
    return Bvh(
        names=tuple(hierarchy.names),
        parents=np.array(hierarchy.parents),
        offsets=np.array(hierarchy.offsets),
        end_parents=np.array(hierarchy.end_parents, int),
        end_offsets=np.array(hierarchy.end_offsets).reshape(-1, 3),
        frame_time=frame_time,
        translations=translations,
        local_rotations=local_rotations,
        notes=file.notes,
    )


class _Hierarchy:
    """What the HIERARCHY section says; `end` is the index of the line MOTION."""

    def __init__(self) -> None:
        self.names: dict[str, int] = {}
        self.parents: list[int] = []
        self.offsets: list[list[float]] = []
        self.end_parents: list[int] = []
        self.end_offsets: list[list[float]] = []
        self.channels: list[tuple[int, str, int]] = []  # (joint, "position"/"rotation", axis)
        self.end = 0


_END_SITE = -2


def _read_hierarchy(file: TextFile) -> _Hierarchy:
    hierarchy = _Hierarchy()
    open_nodes: list[int] = []  # joint indices, outermost first
    node: int | None = None  # named, and waiting for its brace
    if file.cells(0, None) != ["HIERARCHY"]:
        raise file.error(0, "expected a BVH file, which starts with HIERARCHY")
    for index in range(1, len(file.lines)):
        words = file.cells(index, None)
        match words:
            case []:
                pass
            case ["ROOT" | "JOINT", _, *_] if open_nodes[-1:] != [_END_SITE]:
                node = _add_joint(file, index, hierarchy, open_nodes)
            case ["End", "Site", *_] if open_nodes and open_nodes[-1] != _END_SITE:
                node = _END_SITE
            case ["{"] if node is not None:
                open_nodes.append(node)
                node = None
            case ["}"] if open_nodes:
                open_nodes.pop()
            case ["OFFSET", *values] if open_nodes:
                _add_offset(file, index, hierarchy, open_nodes, values)
            case ["CHANNELS", count, *channels] if open_nodes and open_nodes[-1] != _END_SITE:
                _add_channels(file, index, hierarchy, open_nodes[-1], count, channels)
            case ["MOTION"] if hierarchy.names and not open_nodes:
                if len(hierarchy.offsets) != len(hierarchy.names):
                    raise file.error(index, "a joint has no OFFSET")
                joints, moving = len(hierarchy.names), len(hierarchy.channels)
                if joints > MOST_JOINTS * moving:
                    raise file.error(index, f"{joints} joints and only {moving} channels")
                hierarchy.end = index
                return hierarchy
            case _:
                raise file.error(index, f"not expected here: {file.lines[index].strip()!r}")
    raise file.error(len(file.lines), "the file ends inside its HIERARCHY")


def _add_joint(file: TextFile, index: int, hierarchy: _Hierarchy, open_nodes: list[int]) -> int:
    name = file.lines[index].strip().split(None, 1)[1]
    if name in hierarchy.names:
        raise file.error(index, f"duplicate joint {name!r}")
    hierarchy.names[name] = len(hierarchy.names)
    hierarchy.parents.append(open_nodes[-1] if open_nodes else -1)
    return hierarchy.names[name]


def _add_offset(
    file: TextFile, index: int, hierarchy: _Hierarchy, open_nodes: list[int], values: list[str]
) -> None:
    try:
        offset = [float(value) for value in values]
    except ValueError:
        offset = []
    if len(offset) != 3 or not (np.abs(offset) < LARGEST).all():
        raise file.error(index, f"OFFSET: expected 3 numbers, found {' '.join(values)!r}")
    if open_nodes[-1] == _END_SITE:
        hierarchy.end_parents.append(open_nodes[-2])
        hierarchy.end_offsets.append(offset)
    elif len(hierarchy.offsets) == open_nodes[-1]:
        hierarchy.offsets.append(offset)
    else:
        raise file.error(index, "expected one OFFSET per joint, before its children")


def _add_channels(
    file: TextFile,
    index: int,
    hierarchy: _Hierarchy,
    joint: int,
    count: str,
    channels: list[str],
) -> None:
    if count != str(len(channels)):
        raise file.error(index, f"CHANNELS states {count}, found {len(channels)}")
    for channel in channels:
        axis, kind = channel[:1].upper(), channel[1:].lower()
        if not axis or axis not in _AXES or kind not in ("position", "rotation"):
            raise file.error(index, f"unknown channel {channel!r}")
        hierarchy.channels.append((joint, kind, _AXES.index(axis)))


def _read_motion_header(file: TextFile, motion: int) -> tuple[int, int, float]:
    """Index of the first frame's line, number of frames, seconds per frame."""
    values = []
    for index, key in ((motion + 1, "Frames:"), (motion + 2, "Frame Time:")):
        line = " ".join(file.cells(index, None))
        if not line.startswith(key):
            raise file.error(index, f"expected {key!r}, found {line!r}")
        values.append(positive(line.removeprefix(key).strip(), file.where(index), key))
    return motion + 3, int(values[0]), values[1]


def _channels_to_motion(hierarchy: _Hierarchy, table: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """[T, channels] → translations [T, J, 3] and rotations [T, J, 3, 3] in the parents' frames."""
    joints = len(hierarchy.names)
    translations = np.tile(np.array(hierarchy.offsets), (len(table), 1, 1))
    rotations = np.empty((len(table), joints, 3, 3))
    turns: list[list[tuple[int, int]]] = [[] for _ in range(joints)]  # (axis, column)
    for column, (joint, kind, axis) in enumerate(hierarchy.channels):
        if kind == "position":
            translations[:, joint, axis] = table[:, column]
        else:
            turns[joint].append((axis, column))
    for joint, turn in enumerate(turns):
        axes, columns = [axis for axis, _ in turn], [column for _, column in turn]
        rotations[:, joint] = composed(axes, table[:, columns])
    return translations, rotations
