"""Data sets by name: where their files are, how they are split, and what is true in them.

Every sequence is a canonical left hand at 60 Hz in metres; right hands are mirrored in x. What a
data set's files mean (units, handedness, names, axes) stands here once, beside where to get them.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from math import isfinite
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from jaxhand.sequences import RATE, Dataset, Sequence, resample, smooth
from numpy_infer.arrays import Array
from numpy_infer.geometry import (
    kabsch,
    mirror,
    mirror_rotation,
    nearest_rotation,
    transform,
    untransform,
)
from numpy_infer.hand import (
    ANGLES,
    CHAINS,
    FINGERS,
    JOINTS,
    PARENTS,
    POINTS,
    THUMB_AXES,
    TIPS,
    Hand,
    load_hand,
)
from numpy_infer.labels import doubted_unit, of_hand
from numpy_infer.recordings import (
    READER_OF,
    Recording,
    doubted_time,
    load_label_map,
    read,
    without_side,
)
from numpy_infer.skeleton import forward_kinematics, marker_positions, rotations_from_angles

Split = Literal["train", "validation", "test"]
OWN = "recordings"
"""The data set that is whoever's own files."""
SIMULATED = "simulated"
"""The name of what has no files: hands that are made while they are asked for."""
MIN_FRAMES = 24
"""SIG18's shorter sequences are dropped."""
OBSERVED = np.radians(10)
"""An angle other than a twist counts as observed if points known to 1 mm determine it better."""
TWISTS = np.array([angle.name.endswith("_twist") for angle in ANGLES])


class DatasetSpec(NamedTuple):
    """What `NAME[:PATH][@WEIGHT]` says."""

    name: str
    path: Path | None = None
    weight: float = 1.0


class Reading(NamedTuple):
    """How files that do not say it themselves are to be read, see `recordings.read`."""

    unit: float | None = None
    left_handed: bool = False
    truth: Path | bool = False
    """See `load`."""


@dataclass(frozen=True)
class Source:
    """How one data set is found, split and read.

    hand: name of the hand that its markers are read as. files: folder → {take: its files}.
    splits: takes found → {split: takes}. read: the chosen files → a Dataset yet without its name
    and weight. where: what the path should be, and where it can be had.
    """

    hand: str
    files: Callable[[Path], dict[str, list[Path]]]
    splits: Callable[[tuple[str, ...]], dict[str, tuple[str, ...]]]
    read: Callable[[tuple[Path, ...], Hand, Reading], Dataset]
    where: str


def parse_spec(text: str) -> DatasetSpec:
    """Reads `NAME[:PATH][@WEIGHT]`; what follows the last `@` is a weight only if it is a number.

    Raises:
        ValueError: no name, or a weight that is not above 0.
    """
    rest, weight = text, 1.0
    if "@" in text:
        head, _, tail = text.rpartition("@")
        with suppress(ValueError):
            rest, weight = head, float(tail)
    name, _, path = rest.partition(":")
    if not name or not (isfinite(weight) and weight > 0):
        raise ValueError(f"{text!r}: expected NAME[:PATH][@WEIGHT] with a weight above 0")
    return DatasetSpec(name, Path(path) if path else None, weight)


def load(
    spec: DatasetSpec | str,
    split: Split,
    *,
    hand: Hand | None = None,
    takes: tuple[str, ...] | None = None,
    unit: float | None = None,
    left_handed: bool = False,
    truth: Path | bool = False,
) -> Dataset:
    """Reads one split of a data set. Only that split's files need to be there.

    Args:
        spec: which data set and where it lies, see `parse_spec`.
        split: which of the default splits; without effect where `takes` are named.
        hand: the markers wanted; default the data set's own, see `SOURCES`.
        takes: instead of the split: takes (ManipNet), users (SIG18), file stems (the others).
        unit, left_handed: for `recordings` alone, where files do not say, see `recordings.read`.
        truth: fit joint truth to recordings that hold none but have the markers for it (SIG18;
            minutes for each user); a folder: and keep it there, or take it from there.

    Raises:
        ValueError: an unknown data set, split, take or user, with those that there are; a path that
            is missing or holds nothing, with where the data can be had.
    """
    spec = parse_spec(spec) if isinstance(spec, str) else spec
    if spec.name not in SOURCES:
        raise ValueError(
            f"no data set {spec.name!r}: expected one of {', '.join(SOURCES)}, or, to train on, "
            f"{SIMULATED}"
        )
    source = SOURCES[spec.name]
    if (unit is not None or left_handed) and spec.name != OWN:
        raise ValueError(f"unit and left_handed are for {OWN}: files of {spec.name} are known")
    if spec.path is None or not spec.path.exists():
        missing = "no path given" if spec.path is None else f"{spec.path} does not exist"
        raise ValueError(f"{missing}: pass {spec.name}:PATH, {source.where}")
    files = source.files(spec.path)
    if not files:
        raise ValueError(f"{spec.path} holds no takes: pass {spec.name}:PATH, {source.where}")
    chosen = source.splits(tuple(files)).get(split, ()) if takes is None else takes
    unknown = [take for take in chosen if take not in files]
    if unknown or not chosen:
        few = "fewer than three takes have " if spec.name == OWN else ""
        lacks = f"no take {', '.join(unknown)}" if unknown else f"{few}no default {split!r} split"
        raise ValueError(
            f"{spec.path}: {lacks}; name takes with --{split}, out of: {', '.join(sorted(files))}"
        )
    hand = load_hand(source.hand) if hand is None else hand
    paths = tuple(path for take in dict.fromkeys(chosen) for path in files[take])
    dataset = source.read(paths, hand, Reading(unit, left_handed, truth))
    return replace(dataset, name=spec.name, weight=spec.weight)


def default_takes(spec: DatasetSpec, split: Split) -> tuple[str, ...]:
    """The takes of a default split, without their side; none if the data set is not found."""
    if spec.name not in SOURCES or spec.path is None:
        return ()
    source = SOURCES[spec.name]
    stems = source.splits(tuple(source.files(spec.path))).get(split, ())
    return tuple(dict.fromkeys(without_side(stem)[0] for stem in stems))


def _measured(
    paths: tuple[Path, ...], hand: Hand, reading: Reading, side: str | None = None
) -> Dataset:
    """Markers alone. The side is the one given, or the one in the file's name.

    Raises:
        ValueError: a unit or a time that cannot be right.
    """
    sequences = []
    for path in paths:
        labels = path.parent / LABELS
        label_map = load_label_map(labels) if labels.exists() else None
        recording = read(
            path, label_map=label_map, unit=reading.unit, left_handed=reading.left_handed
        ).measured()
        own = of_hand(recording, "", hand)
        for doubt in filter(None, (doubted_unit(own, hand), doubted_time(own))):
            raise ValueError(f"{path}: {doubt}")
        take, named = without_side(path.stem)
        sequences.append(_sequence(own, hand, take, side or named))
    return Dataset("", hand, tuple(sequences))


def _sequence(recording: Recording, hand: Hand, take: str, side: str) -> Sequence:
    markers = resample(recording.time, of_hand(recording, "", hand).markers)
    markers = (mirror(markers) if side == "right" else markers).astype(np.float32)
    return Sequence(f"{take}/{side}", take, RATE, markers)


SIG18_AS_GLOVE9 = {
    "PinkyMCP": "pinky_base",
    "BackHand2": "wrist",
    "IndexMCP": "index_base",
    "RingTip": "ring_tip",
    "PinkyTip": "pinky_tip",
    "IndexTip": "index_tip",
    "MiddleTip": "middle_tip",
    "ThumbMCP": "thumb_joint2",
    "ThumbTip": "thumb_tip",
}


def _sig18(paths: tuple[Path, ...], hand: Hand, reading: Reading) -> Dataset:
    """Its authors added white noise of 1.5-1.8 mm, so it is smoothed at its own 120 Hz."""
    dense, names = load_hand("dense19"), list(hand.markers)
    sequences: list[Sequence] = []
    people: dict[str, list[Array]] = {}
    for path in paths:
        recording = read(path)
        if (len(recording.time) + 1) // 2 < MIN_FRAMES:
            continue
        recording = replace(recording, markers=smooth(recording.markers))
        stem, side = without_side(path.stem)
        take = "/".join((*path.parts[-3:-1], stem.removesuffix("_training_dense")))
        if reading.truth is not False:
            everything = _sequence(recording, dense, take, side)
            people.setdefault(path.parts[-3], []).append(everything.markers)
        if not set(names) <= set(recording.names):
            recording = recording.rename(SIG18_AS_GLOVE9)
        sequences.append(_sequence(recording, hand, take, side))
    note = f"Savitzky-Golay 9, order 2; shorter than {MIN_FRAMES} frames at {RATE:g} Hz left out"
    dataset = Dataset("", hand, tuple(sequences), notes=(note,))
    if reading.truth is False:
        return dataset
    from jaxhand.dense_truth import with_truth  # not before it is needed: loads jax

    if set(names) <= set(dense.markers):
        read_as = list(dense.markers)
    else:
        read_as = [SIG18_AS_GLOVE9.get(name, name) for name in dense.markers]
    columns = [read_as.index(name) for name in names]
    keep = reading.truth if isinstance(reading.truth, Path) else None
    return with_truth(dataset, dense, people, columns, keep)


class _Posed(NamedTuple):
    """A left hand with joint truth: points `[T, 21, 3]` metres, hand frame; world_from_wrist
    `[T, 3, 3]`, `[T, 3]`; markers `[T, M, 3]` metres, world, None to place them on the points."""

    take: str
    side: str
    points: Array
    rotation: Array
    translation: Array
    markers: Array | None = None


MANIPNET_POINTS = {
    "wrist": "WRIST",
    "thumb_cmc": "THUMB_CMC_FE",
    "thumb_mcp": "THUMB_MCP_FE",
    "thumb_ip": "THUMB_IP_FE",
    **{
        f"{finger}_{ours}": f"{finger.upper()}_{theirs}"
        for finger in FINGERS[1:]
        for ours, theirs in (("mcp", "MCP"), ("pip", "PIP_FE"), ("dip", "DIP_FE"))
    },
}
MANIPNET_TIPS = {"thumb": 0.8, "index": 0.95, "middle": 0.9, "ring": 0.9, "pinky": 0.95}
"""Length of the last bone as a part of the one before: the files end at the last joint."""
MANIPNET_AXES = np.array([[0.0, 0, -1], [1, 0, 0], [0, -1, 0]])
"""`file_from_hand`: the file's wrist has x to the fingers, y to the thumb, z out of the palm."""


def _manipnet(paths: tuple[Path, ...], hand: Hand, _: Reading) -> Dataset:
    """Left-handed, y up, one unit is 0.1 m; a right hand's wrist has the mirrored axes."""
    posed = []
    for path in paths:
        recording = read(path, unit=0.1, left_handed=True)
        take, side = without_side(path.stem)
        world, rotation = _manipnet_points(recording)
        if side == "right":
            world, rotation = mirror(world), mirror_rotation(rotation)
        world = resample(recording.time, world)
        # Between two samples the blend of rotations is none: the nearest one is taken.
        rotation = nearest_rotation(resample(recording.time, rotation @ MANIPNET_AXES))
        points = untransform(rotation, world[:, 0], world)
        posed.append(_Posed(take, side, points, rotation, world[:, 0]))
    return _with_angles(hand, posed)


def _manipnet_points(recording: Recording) -> tuple[Array, Array]:
    """`[T, 21, 3]` metres, world, and `[T, 3, 3]` world_from_wrist in the file's axes."""
    joints = recording.joints
    if joints is None or set(MANIPNET_POINTS.values()) - set(joints.names):
        expected = ", ".join(MANIPNET_POINTS.values())
        raise ValueError(f"{recording.source}: expected the joints {expected}")
    columns = [joints.names.index(MANIPNET_POINTS[joint]) for joint in JOINTS]
    positions, rotations = joints.positions[:, columns], joints.rotations[:, columns]
    before, last = np.array(CHAINS)[:, 1], np.array(CHAINS)[:, 2]
    bone = positions[:, last] - positions[:, before]
    at_rest = np.swapaxes(rotations[:, before], -1, -2) @ bone[..., None]
    ratio = np.array(list(MANIPNET_TIPS.values()))[:, None]
    tips = positions[:, last] + (rotations[:, last] @ at_rest)[..., 0] * ratio
    return np.concatenate([positions, tips], 1), rotations[:, 0]


_PAVLLO = ("LEHAR", "LEHAL", "WHARHAR", "LRIF", "LBAF", "LMIF", "LINF", "LPAL", "LTHF")
PAVLLO_MARKERS = dict(zip(_PAVLLO, SIG18_AS_GLOVE9.values(), strict=True))
PAVLLO_AXES = np.array([[0.0, -1, 0], [0, 0, 1], [-1, 0, 0]])
"""`file_from_hand`, once read right-handed: −y to the fingers, −x out of the back of the hand."""


def _pavllo(paths: tuple[Path, ...], hand: Hand, _: Reading) -> Dataset:
    """The authors' pairs of files; the joints are in the hand's frame, the wrist is its origin."""
    recordings = [read(path, label_map=PAVLLO_MARKERS) for path in paths]
    takes = [path.stem.removeprefix(_MOCAP) for path in paths]
    points = [p for r in recordings if (p := _pavllo_points(r)) is not None]
    if len(points) < len(recordings):
        sequences = [_sequence(r, hand, t, "left") for r, t in zip(recordings, takes, strict=True)]
        return Dataset("", hand, tuple(sequences), notes=("not every take has all joints",))
    hand = hand.with_skeleton(_skeleton(np.concatenate(points)))
    posed = []
    for recording, take, local in zip(recordings, takes, points, strict=True):
        markers = resample(recording.time, recording.select(hand.markers).markers)
        seen = np.isfinite(markers).all(-1)
        weight = seen * hand.alignment_weight
        target = np.where(seen[..., None], markers, 0)
        rotation, translation = kabsch(hand.template, target, weight, np.eye(3))
        known = seen[:, list(hand.alignment)].all(-1)
        rotation = np.where(known[:, None, None], rotation, np.nan)
        translation = np.where(known[:, None], translation, np.nan)
        local = resample(recording.time, local)
        posed.append(_Posed(take, "left", local, rotation, translation, markers))
    return _with_angles(hand, posed)


def _pavllo_points(recording: Recording) -> Array | None:
    """`[T, 21, 3]` metres, hand frame, or None where a joint is missing."""
    joints = recording.joints
    names = [f"l_{finger}{i}" for finger in FINGERS for i in (1, 2, 3)] + [f"l_{t}" for t in TIPS]
    if joints is None or set(names) - set(joints.names):
        return None
    columns = [joints.names.index(name) for name in names]
    finger_points = joints.positions[:, columns] @ PAVLLO_AXES
    return np.concatenate([np.zeros_like(finger_points[:, :1]), finger_points], 1)


def _with_angles(hand: Hand, posed: list[_Posed]) -> Dataset:
    """Fits skeleton and angles to joint truth, and places the markers that were not measured."""
    # Not before they are needed: they load jax.
    from jaxhand.fitting import angle_deviation, fit_angles, rest_directions

    points = np.concatenate([p.points for p in posed])
    hand = hand.with_skeleton(rest_directions(_skeleton(points), points))
    known = np.isfinite(points).all((-1, -2))
    fit = fit_angles(hand.skeleton, points)
    angles = np.where(known[:, None], fit.angles, np.nan)
    sequences, first = [], 0
    for p in posed:
        own = angles[first : first + len(p.points)]
        first += len(p.points)
        sequences.append(_placed(hand, p, own))
    off = fit.residual[known].mean(0) * 1e3
    moved = ", ".join(f"{POINTS[i]} {off[i]:.2f}" for chain in CHAINS for i in chain)
    return Dataset(
        "",
        hand,
        tuple(sequences),
        observed_angles=~TWISTS & (angle_deviation(hand.skeleton, angles[known]) < OBSERVED),
        notes=(f"the angles miss the joints by (mean, mm): {moved}",),
    )


def _placed(hand: Hand, posed: _Posed, angles: Array) -> Sequence:
    positions = transform(posed.rotation, posed.translation, posed.points)
    turns = rotations_from_angles(angles)
    _, rotations = forward_kinematics(hand.skeleton, turns, posed.rotation, posed.translation)
    markers = posed.markers
    if markers is None:
        markers = marker_positions(hand, positions, rotations)
    arrays = (markers, positions, rotations, angles)
    name = f"{posed.take}/{posed.side}"
    return Sequence(name, posed.take, RATE, *(np.asarray(array, np.float32) for array in arrays))


def _skeleton(points: Array) -> Array:
    """`[21, 3]` metres: the mean bones of `[T, 21, 3]` in the hand frame, laid flat. The fingers'
    bases keep their place, fingers go along −z, the thumb along its own."""
    points = points[np.isfinite(points).all((-1, -2))]
    bones = points - points[:, PARENTS]
    straight = np.where(
        [[name.startswith("thumb")] for name in POINTS], -np.array(THUMB_AXES)[:, 2], [0, 0, -1]
    )
    skeleton = np.linalg.norm(bones, axis=-1).mean(0)[:, None] * straight
    bases = [chain[0] for chain in CHAINS]
    skeleton[bases] = bones[:, bases].mean(0)
    skeleton[0] = 0
    return skeleton


def _files(pattern: str, take: Callable[[Path], str]) -> Callable[[Path], dict[str, list[Path]]]:
    """Finds the files of a folder that match, or the one file given if it does, by take."""

    def found(path: Path) -> dict[str, list[Path]]:
        files: dict[str, list[Path]] = {}
        one = [path] if path.match(pattern) else []
        for file in sorted(path.glob(pattern)) if path.is_dir() else one:
            if file.name.startswith("."):
                continue
            if file.suffix.lower() in SUFFIXES and not file.name.startswith("out_fused_"):
                files.setdefault(take(file), []).append(file)
        return files

    return found


def _in_order(stems: tuple[str, ...]) -> dict[str, tuple[str, ...]]:
    """The first 60 % of the takes for training, 20 % each for the others, both hands together."""
    takes = sorted({without_side(stem)[0] for stem in stems})
    share = max(1, len(takes) // 5)
    first, second = max(0, len(takes) - 2 * share), max(0, len(takes) - share)
    parts = {"train": takes[:first], "validation": takes[first:second], "test": takes[second:]}
    return {
        split: tuple(stem for stem in stems if without_side(stem)[0] in part)
        for split, part in parts.items()
    }


LABELS = "labels.json"
"""A label map, see `recordings.load_label_map`, for all files of its folder."""
SUFFIXES = (*READER_OF, ".csv", ".c3d")
_MOCAP = "out_mocap_"

SOURCES = {
    "manipnet": Source(
        hand="glove9",
        files=_files("*.bvh", lambda path: without_side(path.stem)[0]),
        splits=lambda _: {
            "train": ("cyl_med3", "teapot3", "mug1"),
            "validation": ("wineglass3",),
            "test": ("cube_med2",),
        },
        read=_manipnet,
        where="a folder of TAKE_leftHand.bvh and TAKE_rightHand.bvh from "
        "github.com/cghezhang/ManipNet (CC BY-NC 4.0)",
    ),
    "sig18": Source(
        hand="glove9",
        files=_files("User*/*/*.trc", lambda path: path.parts[-3]),
        splits=lambda _: {
            "train": ("User1", "User2"),
            "validation": ("User3",),
            "test": ("User4",),
        },
        read=_sig18,
        where="the folder that holds User1 to User4 from github.com/Beibei88/Mocap_SIG18_Data "
        "(CC BY-NC 4.0)",
    ),
    "qualisys": Source(
        hand="qualisys13",
        files=_files("*.tsv", lambda path: path.stem),
        splits=lambda takes: {"test": takes},
        read=lambda paths, hand, _: _measured(paths, hand, Reading(), "right"),
        where="recording.tsv of a right hand from github.com/dfki-ric/hand_embodiment (BSD-3)",
    ),
    "pavllo": Source(
        hand="glove9",
        files=_files(f"{_MOCAP}*.csv", lambda path: path.stem.removeprefix(_MOCAP)),
        splits=_in_order,
        read=_pavllo,
        where="a folder of out_mocap_TAKE.csv and out_fused_TAKE.csv as the paper's authors "
        "record them (github.com/dariopavllo/robust-finger-tracking)",
    ),
    OWN: Source(
        hand="glove9",
        files=_files("*", lambda path: path.stem),
        splits=_in_order,
        read=_measured,
        where=f"your own marker files ({', '.join(SUFFIXES)}), a file or a folder; "
        "folders in it are not looked into",
    ),
}
"""The data sets by name."""
