"""Recordings of labelled markers, and the one door through which marker files come in and go out.

Everything inside the project is in metres and right-handed, and a hidden marker is NaN. Units,
handedness and each format's way of writing a gap end here, at the file's edge.
"""

from __future__ import annotations

import importlib
import os
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from tempfile import TemporaryDirectory
from types import ModuleType

import numpy as np

from numpy_infer.arrays import floats
from numpy_infer.formats.json_text import read_json
from numpy_infer.formats.refusal import refusal, shortened
from numpy_infer.formats.units import LARGEST

BUILT_IN = {
    name: f"numpy_infer.formats.{name}"
    for name in ("trc", "qualisys", "plain_csv", "motive", "authors", "bvh")
}
READER_OF = {".trc": "trc", ".tsv": "qualisys", ".bvh": "bvh"}  # `.csv` is told by its first line
WRITER_OF = {".trc": "trc", ".tsv": "qualisys", ".csv": "plain_csv"}

SLOWEST = 5.0
"""Hz: nobody records hands at less, but in a file whose time is in milliseconds or counts frames it
looks like that."""

# diag(1, 1, −1): a left-handed frame's coordinates in the right-handed frame that shares x and y
_REFLECT_Z = np.array([1.0, 1.0, -1.0])


@dataclass(frozen=True, eq=False)
class JointTruth:
    """Joint positions and rotations that a file brings along with, or instead of, markers.

    names: J joint names.
    positions: [T, J, 3] metres; NaN where the file calls the frame invalid.
    rotations: [T, J, 3, 3], acting on columns.
    frame: "world": positions in the world, rotations world_from_joint;
        "local": positions in the hand's own frame, rotations parent_from_joint.
    """

    names: tuple[str, ...]
    positions: np.ndarray
    rotations: np.ndarray
    frame: str = "world"

    def __post_init__(self) -> None:
        object.__setattr__(self, "names", tuple(self.names))
        object.__setattr__(self, "positions", np.asarray(self.positions, np.float64))
        object.__setattr__(self, "rotations", np.asarray(self.rotations, np.float64))
        _check_unique(self.names, "joint name")
        frames = self.positions.shape[0] if self.positions.ndim else 0
        _check_shape("positions", self.positions, (frames, len(self.names), 3))
        _check_shape("rotations", self.rotations, (frames, len(self.names), 3, 3))
        if self.frame not in ("world", "local"):
            raise ValueError(f"frame: expected 'world' or 'local', got {self.frame!r}")

    def reflected(self) -> JointTruth:
        """The same joints with z negated: p → S p, R → S R S with S = diag(1, 1, −1)."""
        both_sides = _REFLECT_Z[:, None] * _REFLECT_Z
        return replace(
            self,
            positions=self.positions * _REFLECT_Z,
            rotations=self.rotations * both_sides,
        )


@dataclass(frozen=True, eq=False)
class Recording:
    """Labelled marker positions over time.

    names: M marker names, all different.
    markers: [T, M, 3] float64 metres, right-handed world frame; NaN where not measured, and
        where a masked array that is given is masked.
    time: [T] seconds, finite; it need not increase.
    rate: Hz, from the file, else the median of 1 / diff(time).
    source: the path that it came from.
    unit: metres in one unit of the file.
    joints: joint truth, if the file has any.
    angles: [T, 26] radians, in the order of `hand.ANGLES`: what tracking made of the markers.
    wrist: [T, 7] of the wrist joint metres, and the quaternion xyzw of its rotation: likewise.
    status: [T, M] a `pose.Status` each: what tracking says that a marker rests on; NaN unknown.
    expected_error: [T, M] metres: how far off tracking expects it to be.
    filled: names whose values are partly made up, by the recording software or by tracking.
    notes: one-line things that the reader wants the user to know.
    """

    names: tuple[str, ...]
    markers: np.ndarray
    time: np.ndarray
    rate: float
    source: str
    unit: float = 1.0
    joints: JointTruth | None = None
    angles: np.ndarray | None = None
    wrist: np.ndarray | None = None
    status: np.ndarray | None = None
    expected_error: np.ndarray | None = None
    filled: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for field in ("names", "filled", "notes"):
            object.__setattr__(self, field, tuple(getattr(self, field)))
        object.__setattr__(self, "markers", floats(self.markers))
        object.__setattr__(self, "time", np.asarray(self.time, np.float64))
        object.__setattr__(self, "rate", float(self.rate))
        _check_unique(self.names, "marker name")
        if self.time.ndim != 1 or not self.time.size or not self.names:
            raise ValueError(
                "expected at least one frame and one marker, got time of shape "
                f"{self.time.shape} and {len(self.names)} names"
            )
        _check_shape("markers", self.markers, (len(self.time), len(self.names), 3))
        if not np.isfinite(self.time).all():
            raise ValueError(f"time: frame {np.argmin(np.isfinite(self.time))} is not finite")
        if not (np.isfinite(self.rate) and self.rate > 0):
            raise ValueError(f"rate: expected a positive number of Hz, got {self.rate}")
        if self.joints is not None and len(self.joints.positions) != len(self.time):
            raise ValueError(
                f"joints: expected {len(self.time)} frames, got {len(self.joints.positions)}"
            )
        for field, width in (("angles", 26), ("wrist", 7)):
            if getattr(self, field) is not None:
                _check_shape(field, getattr(self, field), (len(self.time), width))
        for field in ("status", "expected_error"):
            if getattr(self, field) is not None:
                _check_shape(field, getattr(self, field), self.markers.shape[:2])
        _check_known(self.filled, self.names, "filled: ")

    @property
    def visible(self) -> np.ndarray:
        """[T, M] True where all three coordinates are finite."""
        return np.isfinite(self.markers).all(axis=-1)

    def measured(self) -> Recording:
        """What was measured alone: a marker that tracking filled is hidden, as `status` says."""
        if self.status is None:
            return self
        made = self.visible & (self.status > 0)
        note = f"{made.sum()} positions that tracking had filled (.status) are taken as gaps"
        return replace(
            self,
            markers=np.where(made[..., None], np.nan, self.markers),
            angles=None,
            wrist=None,
            status=None,
            expected_error=None,
            filled=tuple(name for name in self.filled if not made[:, self.names.index(name)].any()),
            notes=(*self.notes, note) if made.any() else self.notes,
        )

    def select(self, names: Sequence[str]) -> Recording:
        """The given markers only, in the given order; ValueError lists those that are missing."""
        _check_known(names, self.names, f"{self.source}: ")
        columns = [self.names.index(name) for name in names]
        return replace(
            self,
            names=tuple(names),
            markers=self.markers[:, columns],
            status=None if self.status is None else self.status[:, columns],
            expected_error=None if self.expected_error is None else self.expected_error[:, columns],
            filled=tuple(name for name in self.filled if name in names),
        )

    def rename(self, mapping: Mapping[str, str]) -> Recording:
        """Markers under new names {old: new}; others keep theirs. ValueError names unknown ones."""
        _check_known(mapping, self.names, f"{self.source}: ")
        return replace(
            self,
            names=tuple(mapping.get(name, name) for name in self.names),
            filled=tuple(mapping.get(name, name) for name in self.filled),
        )

    def reflected(self) -> Recording:
        """The recording with z negated: from a left-handed to a right-handed frame, or back."""
        joints = None if self.joints is None else self.joints.reflected()
        # Of a rotation the axis is mirrored, and turned about the other way.
        wrist = None if self.wrist is None else self.wrist * [1, 1, -1, -1, -1, 1, 1]
        return replace(self, markers=self.markers * _REFLECT_Z, joints=joints, wrist=wrist)


def read(
    path: str | os.PathLike[str],
    *,
    unit: float | None = None,
    left_handed: bool = False,
    label_map: Mapping[str, str] | None = None,
    prefixes: Collection[str] = (),
    format: str | None = None,
) -> Recording:
    """Read a marker file into metres and a right-handed frame.

    unit: metres per unit of the file, for files that do not say (BVH, bare CSV).
    left_handed: the file's frame is left-handed; z is negated. The authors' CSV always is, and
        needs no telling.
    label_map: {label in the file: our name}; other labels only lose a prefix such as `Subject:`,
        and keep it where it alone tells them apart, as those of two hands.
    prefixes: of labels that begin so nothing is left out.
    format: a reader's name, where the suffix and the first line would pick another.

    Raises ValueError, with file and line, for whatever is wrong inside the file; nothing is
    half read. A file that is not there is the usual FileNotFoundError.
    """
    path = Path(path)
    if unit is not None and not 0 < unit < LARGEST:
        raise ValueError(f"unit: expected metres per file unit, got {unit}")
    if path.is_dir():
        raise ValueError(f"{path} is a folder: name one of its files")
    reader = _reader(path, format)
    try:
        recording: Recording = reader.read(path, unit=unit, left_handed=left_handed)
        return _relabelled(recording, label_map or {}, tuple(filter(None, prefixes)))
    except ValueError as error:
        raise refusal(path, error) from None


def write(recording: Recording, path: str | os.PathLike[str], *, overwrite: bool = False) -> None:
    """Write markers (not joints) in the format that the suffix names.

    The file appears whole or not at all. Raises ValueError for a suffix without a writer or for
    names that the format cannot hold, FileExistsError for a file that is there already.
    """
    write_all({Path(path): recording}, overwrite=overwrite)


def write_all(recordings: Mapping[Path, Recording], *, overwrite: bool = False) -> None:
    """`write` of several files of one folder, which appear once all are written."""
    writers = {path: writer_of(path) for path in recordings}
    for path in recordings:
        if path.exists() and not overwrite:
            raise FileExistsError(f"{path} exists; pass overwrite=True to replace it")
    with TemporaryDirectory(dir=next(iter(recordings)).parent, prefix=".jaxhand-") as directory:
        for path, recording in recordings.items():
            writers[path].write(recording, Path(directory) / path.name)
        for path in recordings:
            os.replace(Path(directory) / path.name, path)


def load_label_map(path: str | os.PathLike[str]) -> dict[str, str]:
    """Read {"label in the file": "our name"} from JSON; ValueError says what is wrong in it."""

    path = Path(path)
    try:
        mapping = read_json(path)
    except ValueError as error:
        raise refusal(path, error) from None
    if not isinstance(mapping, dict):
        raise ValueError(f'{path}: expected an object {{"file label": "our name"}}')
    for label, name in mapping.items():
        if not isinstance(name, str):
            what = shortened(f"{label!r}: expected a name, got {name!r}")
            raise ValueError(f"{path}: {what}")
    _check_unique(list(mapping.values()), "name", f"{path}: ")
    return mapping


def median_rate(time: np.ndarray, source: object) -> float:
    """Hz from [T] seconds: the median of 1 / diff over the steps that go forward, by a nanosecond
    at least; where all steps are about alike their mean, for times may be rounded."""
    steps = np.diff(time)
    forward = steps[steps >= 1e-9]
    if not forward.size:
        raise ValueError(f"{source}: no rate: the file states none and its time never advances")
    median = np.median(1.0 / forward)
    if (np.abs(steps * median - 1) < 0.5).all():
        return float(len(steps) / (time[-1] - time[0]))
    return float(median)


def doubted_time(recording: Recording) -> str | None:
    """What is to be said of a recording whose frames are too far apart for seconds, or as no frames
    are at the rate that the file states; or None."""
    steps = np.diff(recording.time)
    step = float(np.median(steps)) if steps.size else 0.0
    # Rounded times spoil the median, frames left out the mean.
    ways = np.array([step, steps.mean()]) * recording.rate if steps.size else np.ones(2)
    if 0 < step <= 1 / SLOWEST and (np.abs(ways - 1) > 0.1).all():
        return (
            f"the file states {recording.rate:g} Hz, but its time goes on by {1e3 * step:.3g} ms a "
            f"frame, {1 / step:.4g} Hz: the time is believed"
        )
    if step <= 1 / SLOWEST:
        return None
    return (
        f"the frames are {step:.3g} s apart: is the file's time in milliseconds, or does it count "
        "frames? Seconds are expected"
    )


_SIDE = re.compile(
    r"[ _.-]?(?<![A-Za-z])(left|right|LEFT|RIGHT)([Hh]and|HAND)?(?![a-z])"
    r"|[ _.-]?(Left|Right)([Hh]and)?(?![a-z])"
)


def without_side(name: str) -> tuple[str, str]:
    """`cube_med2_leftHand` → (`cube_med2`, `left`); a file that does not say is a left hand."""
    found = _SIDE.search(name)
    if not found:
        return name, "left"
    return _SIDE.sub("", name, count=1), (found[1] or found[3]).lower()


def _reader(path: Path, format: str | None) -> ModuleType:
    plugins = _plugins()
    if format is not None:
        return _module(format, plugins)
    suffix = path.suffix.lower()
    if suffix == ".csv":
        return _module(_csv_format(path), plugins)
    if suffix in READER_OF:
        return _module(READER_OF[suffix], plugins)
    if suffix[1:] in plugins:
        return _module(suffix[1:], plugins)
    known = sorted({".csv", *READER_OF, *(f".{name}" for name in plugins)})
    raise ValueError(f"{path}: unknown suffix {suffix!r}; known: {', '.join(known)}")


def writer_of(path: Path) -> ModuleType:
    """What writes files with this suffix; ValueError if nothing does, or it lacks a library."""
    plugins = _plugins()
    suffix = path.suffix.lower()
    if suffix in WRITER_OF:
        return _module(WRITER_OF[suffix], plugins)
    if suffix[1:] in plugins:
        module = _module(suffix[1:], plugins)
        if hasattr(module, "check"):
            module.check()
        return module
    known = sorted({*WRITER_OF, *(f".{name}" for name in plugins)})
    raise ValueError(f"{path}: cannot write {suffix!r}; known: {', '.join(known)}")


def _plugins() -> dict[str, EntryPoint]:
    # Readers that need more than numpy announce themselves, so that nothing here imports jaxhand.
    return {point.name: point for point in entry_points(group="jaxhand.recordings")}


def _module(name: str, plugins: Mapping[str, EntryPoint]) -> ModuleType:
    if name in BUILT_IN:
        return importlib.import_module(BUILT_IN[name])
    if name in plugins:
        module: ModuleType = plugins[name].load()
        return module
    raise ValueError(f"format: unknown {name!r}; known: {', '.join([*BUILT_IN, *plugins])}")


def _csv_format(path: Path) -> str:
    with path.open("rb") as file:
        start = file.readline().decode("utf-8-sig", errors="replace")
    if start.startswith(("Format Version", '"Format Version')):
        return "motive"
    return "authors" if ".pos.x" in start else "plain_csv"


def _relabelled(
    recording: Recording, label_map: Mapping[str, str], prefixes: tuple[str, ...]
) -> Recording:
    """Our names for mapped labels; the others without their `Subject:` prefix, unless two of them
    would then be one, or it is among those to keep."""
    bare = {
        label: label if label.startswith(prefixes) else _without_prefix(label)
        for label in recording.names
    }
    there = dict.fromkeys((*bare, *bare.values()))
    _check_known(label_map, there, f"{recording.source}: label map: ")
    mapped = {label: label_map.get(label, label_map.get(bare[label])) for label in bare}
    left = [bare[label] for label, name in mapped.items() if name is None]
    kept = dict(zip(bare, bare, strict=True)) if len(set(left)) < len(left) else bare
    names = {label: kept[label] if name is None else name for label, name in mapped.items()}
    by_name: dict[str, str] = {}
    for label, name in names.items():
        if name in by_name:
            raise ValueError(
                f"{recording.source}: duplicate marker name {name!r}, from {by_name[name]!r} and "
                f"{label!r}; tell them apart with a label map"
            )
        by_name[name] = label
    left_out = {label.removesuffix(name) for label, name in names.items() if label.endswith(name)}
    right = sorted(prefix for prefix in left_out if without_side(prefix)[1] == "right")
    notes = tuple(f"labels begin with {prefix!r}: is it a right hand?" for prefix in right)
    recording = replace(recording, notes=(*recording.notes, *notes))
    joints = recording.joints
    if joints is not None:
        joints = replace(joints, names=tuple(_without_prefix(name) for name in joints.names))
    return replace(recording.rename(names), joints=joints)


def _without_prefix(label: str) -> str:
    return label.rpartition(":")[2].strip() or label


def _check_unique(names: Sequence[str], what: str, where: str = "") -> None:
    seen = set()
    for name in names:
        if name in seen:
            raise ValueError(f"{where}duplicate {what} {name!r}")
        seen.add(name)


def _check_known(asked: Iterable[str], names: Collection[str], where: str) -> None:
    known = set(names)
    missing = [name for name in asked if name not in known]
    if missing:
        raise ValueError(f"{where}no marker {', '.join(missing)}; there are {', '.join(names)}")


def _check_shape(what: str, array: np.ndarray, expected: tuple[int, ...]) -> None:
    if array.shape != expected:
        raise ValueError(f"{what}: expected shape {expected}, got {array.shape}")
