"""Joint truth of a person out of recordings with many markers: bones and marker places that all of
them share, then the angles and the wrist's pose of every frame.

It is a fit, with an error of its own: `noise_floor` measures it, and a table that counts this truth
as exact should show it as a row.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from jaxhand import sequences as data
from jaxhand.calibration import Priors, calibrate
from jaxhand.fitting import fit_angles
from jaxhand.sequences import RATE, Dataset, smooth
from jaxhand.tasks import JOINT_POINTS
from numpy_infer.arrays import Array
from numpy_infer.geometry import kabsch, untransform
from numpy_infer.hand import ANGLES, Hand, hand_from_json
from numpy_infer.skeleton import forward_kinematics, marker_positions, rotations_from_angles

OFFSET = 2e-3
"""Metres per axis: how far markers are from where the dense hand has them. With 3 mm and more the
thumb's markers move by up to 2 cm along bones that shrink, while the fit gains 1 % (users 1-3)."""
THINNED = 6
"""Bones and marker places are fitted to every sixth frame, 10 Hz: closer ones say the same."""
GROUP = 1200
"""Frames that are fitted at once after that, at least, in whole sequences."""
MISFIT = 10e-3
"""Metres: a frame in which a marker is farther from the fit has no truth. In 2 to 5 % of SIG18's
frames the posture ended elsewhere than where the markers are."""
FLOOR_SHARE = 8
"""Every eighth sequence is fitted again for the noise floor."""

Report = Callable[[float], None]


class PersonTruth(NamedTuple):
    """What was fitted to the sequences of one person. Frames of all sequences end to end."""

    hand: Hand
    """The dense markers where they sit on the person's bones."""
    angles: Array
    """`[F, 26]` radians; NaN, like all of the frame, where too few markers determine the hand, or
    one is `MISFIT` off."""
    rotation: Array
    """`[F, 3, 3]` world_from_wrist."""
    position: Array
    """`[F, 3]` metres, world."""
    observed: Array
    """`[26]` True where the markers determine the angle in most frames."""
    noise: float
    """Metres per axis: standard deviation of the markers about the fit, as estimated."""

    def joints(self) -> tuple[Array, Array]:
        """`[F, 21, 3]` metres and `[F, 16, 3, 3]`, world: points of the skeleton and joints."""
        local = rotations_from_angles(self.angles)
        return forward_kinematics(self.hand.skeleton, local, self.rotation, self.position)


def fit(
    hand: Hand, recordings: Sequence[Array], *, report: Report = lambda share: None
) -> PersonTruth:
    """Fits one person's recordings, both hands alike.

    Bones and marker places are one for all of them: the person is the same, and the distances of
    SIG18's rigid markers are the same in all captures and on both hands within 0.5 mm.

    Args:
        hand: the dense markers; the means of the priors.
        recordings: `[T, M, 3]` metres each, canonical left hand at 60 Hz, NaN where hidden.
        report: is told the share done.

    Raises:
        ValueError: as `calibration.calibrate`.
    """
    return _followed(*_person(hand, recordings, report), recordings, report)


def noise_floor(
    hand: Hand,
    truth: PersonTruth,
    recordings: Sequence[Array],
    *,
    seed: int = 0,
    report: Report = lambda share: None,
) -> list[Array]:
    """How far such a truth is off: the whole fit again, on markers whose truth is known.

    The fitted motion is taken for true, its markers get independent noise of the estimated size
    (before smoothing at twice the rate, as the recordings are), and all is fitted anew, bones and
    marker places too. What markers leave open is in it, and what priors and smoothing do; that a
    hand is not what the model says it is (skin that slides, a palm that bends) only as far as the
    estimated noise holds it. Most of it is bones and marker places: a method that is given those of
    `truth` shares that part, and can be nearer to `truth` than this.

    Args:
        hand, recordings: as given to `fit`.
        truth: what that made of them.
        seed: of the noise.
        report: is told the share done.

    Returns:
        For every `FLOOR_SHARE`-th recording `[T]` metres, the mean distance of `tasks.JOINT_POINTS`
        in each frame; NaN where the truth is.
    """
    points, rotations = truth.joints()
    random, ends = np.random.default_rng(seed), np.cumsum([len(r) for r in recordings])[:-1]
    noisy = [
        markers + truth.noise * smoothed_noise(random, markers.shape)
        for markers in np.split(marker_positions(truth.hand, points, rotations), ends)
    ]
    person = _person(hand, noisy, report)
    found = _followed(*person, noisy[::FLOOR_SHARE], report).joints()[0]
    off = np.concatenate(np.split(points, ends)[::FLOOR_SHARE]) - found
    distance = np.linalg.norm(off[:, list(JOINT_POINTS)], axis=-1).mean(-1)
    return np.split(distance, np.cumsum([len(part) for part in noisy[::FLOOR_SHARE]])[:-1])


def smoothed_noise(random: np.random.Generator, shape: tuple[int, ...]) -> Array:
    """`shape [T, …]` standard normal noise that is as like from frame to frame as white noise is
    once it was smoothed at twice the rate."""
    white = random.normal(size=(2 * shape[0] + 8, *shape[1:]))
    noise = smooth(white)[4:-4:2]
    return noise / np.sqrt((smooth(np.eye(9))[4] ** 2).sum())


def fingerprint(hand: Hand, recordings: Sequence[Array]) -> str:
    """Tells one set of recordings, or one hand, from another."""
    digest = hashlib.sha256(json.dumps(hand.to_json()).encode())
    for recording in recordings:
        digest.update(np.ascontiguousarray(recording, np.float32).tobytes())
    return digest.hexdigest()


def save(path: Path, truth: PersonTruth, floor: Sequence[Array], origin: str) -> None:
    """Keeps a truth, its noise floor and the `fingerprint` of what both were made of, as `.npz`."""
    path.parent.mkdir(parents=True, exist_ok=True)
    arrays = {name: array for name, array in truth._asdict().items() if name != "hand"}
    lengths = [len(part) for part in floor]
    text = json.dumps({"hand": truth.hand.to_json(), "origin": origin})
    with path.open("wb") as file:
        np.savez_compressed(
            file, **arrays, floor=np.concatenate(floor), lengths=lengths, text=np.array(text)
        )


def load(path: Path, origin: str) -> tuple[PersonTruth, list[Array]]:
    """What `save` has kept.

    Raises:
        ValueError: it was made of something else.
    """
    with np.load(path, allow_pickle=False) as file:
        arrays = dict(file)
    text = json.loads(str(arrays.pop("text")))
    if text["origin"] != origin:
        raise ValueError(
            f"{path} was fitted to other recordings or with another hand: remove it, or name "
            "another folder"
        )
    floor = np.split(arrays.pop("floor"), np.cumsum(arrays.pop("lengths"))[:-1])
    arrays["noise"] = float(arrays["noise"])
    return PersonTruth(hand_from_json(text["hand"]), **arrays), floor


def with_truth(
    dataset: Dataset,
    hand: Hand,
    people: Mapping[str, Sequence[Array]],
    columns: Sequence[int],
    keep: Path | None = None,
) -> Dataset:
    """Joint truth for a data set of markers, and its hand as people wear it: on their mean bones,
    with markers at the mean of the places that were found.

    Positions and rotations are those of the person. So are the angles, unless a finger carries one
    of the alignment markers (SIG18 as `glove9`: two of three sit on first phalanges). The wrist
    that they give then tilts with the knuckles, by 12 degrees on average, and the angles are those
    that reach the joints from there.

    Shows a bar on stderr while it fits.

    Args:
        dataset: of some of the markers.
        hand: all markers.
        people: each person's recordings of all markers, `[T, M, 3]` metres; together they are the
            data set's sequences, in order.
        columns: the place of each of the data set's markers among all.
        keep: folder of fits that are made once.
    """
    kept = [_kept(hand, *person, keep) for person in people.items()]
    truths, measured = [truth for truth, _ in kept], iter(dataset.sequences)
    sequences: list[data.Sequence] = []
    for truth, recordings in zip(truths, people.values(), strict=True):
        own = [next(measured) for _ in recordings]
        ends = np.cumsum([len(sequence.markers) for sequence in own])[:-1]
        points, rotations = truth.joints()
        glove = worn(dataset.hand, [truth.hand], columns, [1])
        angles = truth.angles
        if any(glove.links[i] for i in glove.alignment):
            angles = _seen_from(glove, np.concatenate([s.markers for s in own]), points)
        whole = (np.float32(array) for array in (points, rotations, angles))
        parts = zip(*(np.split(array, ends) for array in whole), strict=True)
        sequences += [
            replace(sequence, positions=position, rotations=rotation, angles=angle)
            for sequence, (position, rotation, angle) in zip(own, parts, strict=True)
        ]
    frames = [len(truth.angles) for truth in truths]
    noise = ", ".join(f"{p} {1e3 * t.noise:.1f} mm" for p, t in zip(people, truths, strict=True))
    note = f"joint truth fitted to {len(hand)} markers, which are off it per axis by: {noise}"
    return replace(
        dataset,
        hand=worn(dataset.hand, [truth.hand for truth in truths], columns, frames),
        sequences=tuple(sequences),
        observed_angles=np.average([t.observed for t in truths], axis=0, weights=frames) > 0.5,
        noise_floor=_by_take(dataset, people, [off for _, floor in kept for off in floor]),
        notes=(*dataset.notes, note),
    )


def worn(hand: Hand, dense: Sequence[Hand], columns: Sequence[int], weight: Sequence[int]) -> Hand:
    """The markers of `hand` as they sit on people, in the mean.

    Args:
        hand: their names and which give the hand's pose.
        dense: each person's, of the same joints and links.
        columns: `[M]` the place of each marker of `hand` among the dense ones.
        weight: of each person.
    """
    offsets = np.average([own.offsets for own in dense], axis=0, weights=weight)
    return replace(
        hand,
        joints=tuple(dense[0].joints[i] for i in columns),
        links=tuple(dense[0].links[i] for i in columns),
        offsets=offsets[list(columns)],
    ).with_skeleton(np.average([own.skeleton for own in dense], axis=0, weights=weight))


def _seen_from(glove: Hand, markers: Array, points: Array) -> Array:
    """`[F, 26]` radians: the angles that reach `points [F, 21, 3]` from the wrist that the
    alignment markers among `markers [F, M, 3]` give; NaN where one of either is missing."""
    known = np.isfinite(markers[:, list(glove.alignment)]).all((-1, -2))
    known &= np.isfinite(points).all((-1, -2))
    weight = np.broadcast_to(glove.alignment_weight, (known.sum(), len(glove)))
    prior = np.broadcast_to(np.eye(3), (len(weight), 3, 3))
    pose = kabsch(glove.template, np.nan_to_num(np.float64(markers[known])), weight, prior)
    angles = np.full((len(points), len(ANGLES)), np.nan)
    angles[known] = fit_angles(glove.skeleton, untransform(*pose, points[known])).angles
    return angles


def _person(hand: Hand, recordings: Sequence[Array], report: Report) -> tuple[Hand, float]:
    """The markers where they sit on a person's bones, and their noise."""
    report(0.0)
    thinned = [recording[::THINNED] for recording in recordings]
    found = calibrate(
        hand,
        np.concatenate(thinned),
        rate=RATE / THINNED,
        starts=_starts(thinned),
        priors=Priors(offset=OFFSET),
    )
    report(0.3)
    return found.hand, found.noise


def _followed(
    person: Hand, noise: float, recordings: Sequence[Array], report: Report
) -> PersonTruth:
    """Angles and wrist of every frame, on bones that are known."""
    parts, done, total = [], 0, sum(map(len, recordings))
    for group in _groups(recordings):
        found = calibrate(
            person,
            np.concatenate(group),
            rate=RATE,
            starts=_starts(group),
            fixed=("bones", "offsets"),
            noise=noise,
        )
        lost = ~found.tracked | (np.nan_to_num(found.residual) > MISFIT).any(-1)
        motion = found.angles, found.wrist_rotation, found.wrist_position
        for array in motion:
            array[lost] = np.nan
        parts.append((*motion, found.observed.angles))
        done += len(lost)
        report(0.3 + 0.7 * done / total)
    angles, rotation, position, observed = map(np.concatenate, zip(*parts, strict=True))
    return PersonTruth(person, angles, rotation, position, observed.mean(0) > 0.5, noise)


def _starts(recordings: Sequence[Array]) -> list[int]:
    """Where each begins, once they stand end to end."""
    return np.cumsum([0, *map(len, recordings[:-1])]).tolist()


def _groups(recordings: Sequence[Array]) -> list[list[Array]]:
    """Recordings in order, in groups of `GROUP` frames or more; the last may be shorter."""
    groups: list[list[Array]] = [[]]
    for recording in recordings:
        if sum(map(len, groups[-1])) >= GROUP:
            groups.append([])
        groups[-1].append(recording)
    return groups


def _kept(
    hand: Hand, person: str, recordings: Sequence[Array], folder: Path | None
) -> tuple[PersonTruth, list[Array]]:
    origin = fingerprint(hand, recordings)
    path = None if folder is None else folder / f"{person}.npz"
    if path is not None and path.exists():
        return load(path, origin)
    frames = sum(map(len, recordings))
    columns = (TextColumn("{task.description}"), BarColumn(), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True)) as progress:
        bar = progress.add_task(f"joint truth of {person}, {frames} frames", total=1.0)
        again = progress.add_task("its noise floor", total=1.0)
        truth = fit(hand, recordings, report=lambda share: progress.update(bar, completed=share))
        floor = noise_floor(
            hand, truth, recordings, report=lambda share: progress.update(again, completed=share)
        )
    if path is not None:
        save(path, truth, floor, origin)
    return truth, floor


def _by_take(
    dataset: Dataset, people: Mapping[str, Sequence[Array]], floors: Sequence[Array]
) -> dict[str, Array]:
    """The noise floor's recordings by the take that they belong to."""
    numbers: list[int] = []
    first = 0
    for recordings in people.values():
        numbers += range(first, first + len(recordings), FLOOR_SHARE)
        first += len(recordings)
    found: dict[str, list[Array]] = {}
    for number, off in zip(numbers, floors, strict=True):
        found.setdefault(dataset.sequences[number].take, []).append(off)
    return {take: np.concatenate(parts) for take, parts in found.items()}
