"""Laws of joint truth that is fitted to dense markers, on simulated people whose truth is known."""

from __future__ import annotations

import functools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

jax = pytest.importorskip("jax")

from simulated import bones, motion, worn  # noqa: E402

from jaxhand import dense_truth  # noqa: E402
from jaxhand.datasets import load  # noqa: E402
from jaxhand.dense_truth import PersonTruth  # noqa: E402
from jaxhand.sequences import Dataset, Sequence  # noqa: E402
from jaxhand.tasks import JOINT_POINTS  # noqa: E402
from numpy_infer.arrays import Array  # noqa: E402
from numpy_infer.geometry import kabsch, mirror  # noqa: E402
from numpy_infer.hand import Hand, load_hand  # noqa: E402
from numpy_infer.recordings import Recording, write  # noqa: E402
from numpy_infer.skeleton import (  # noqa: E402
    forward_kinematics,
    marker_positions,
    rotations_from_angles,
)

DENSE, GLOVE = load_hand("dense19"), load_hand("glove9")
FRAMES, TAKES, NOISE, OFFSET = 150, 9, 0.8e-3, 2e-3
NAMES = ("PinkyMCP", "BackHand2", "IndexMCP", "RingTip", "PinkyTip", "IndexTip", "MiddleTip")
COLUMNS = [DENSE.markers.index(name) for name in (*NAMES, "ThumbMCP", "ThumbTip")]
"""Of the dense markers the nine that SIG18 is read as."""


@functools.cache
def person() -> tuple[Hand, Array, Array]:
    """Somebody's hand, what it measures `[TAKES, FRAMES, 19, 3]` in some takes, and the true points
    `[TAKES, FRAMES, 21, 3]`."""
    random = np.random.default_rng(0)
    offsets = DENSE.offsets + OFFSET * random.normal(size=DENSE.offsets.shape)
    own = replace(DENSE, offsets=offsets).with_skeleton(bones(3, DENSE))
    move = motion(4, FRAMES, 60.0, (TAKES,))
    angles, rotation, position = (array.astype(np.float64) for array in move)
    turns = rotations_from_angles(angles)
    points, rotations = forward_kinematics(own.skeleton, turns, rotation, position)
    markers = marker_positions(own, points, rotations)
    noise = [dense_truth.smoothed_noise(random, markers[0].shape) for _ in range(TAKES)]
    markers = markers + NOISE * np.stack(noise)
    markers[1, 40:50] = np.nan
    return own, markers, points


@functools.cache
def fitted() -> PersonTruth:
    return dense_truth.fit(DENSE, list(person()[1]))


def off(found: Array) -> Array:
    """`[TAKES, FRAMES]` metres: mean distance of the points that Table 4 counts."""
    apart = found.reshape(person()[2].shape) - person()[2]
    return np.linalg.norm(apart[:, :, list(JOINT_POINTS)], axis=-1).mean(-1)


def test_the_joints_come_back_on_bones_that_all_takes_share() -> None:
    own, _, _ = person()
    truth = fitted()
    points, rotations = truth.joints()
    assert points.shape == (TAKES * FRAMES, 21, 3)
    assert rotations.shape == (TAKES * FRAMES, 16, 3, 3)
    lengths = np.linalg.norm(truth.hand.skeleton, axis=-1)
    assert np.abs(lengths - np.linalg.norm(own.skeleton, axis=-1))[1:].mean() < 2e-3
    assert np.nanmean(off(points)) < 3e-3
    assert truth.noise == pytest.approx(NOISE, rel=0.15)
    assert truth.observed.sum() > 15


def test_a_frame_that_nothing_determines_has_no_truth() -> None:
    lost = np.zeros((TAKES, FRAMES), bool)
    lost[1, 40:50] = True
    missing = np.isnan(fitted().joints()[0]).all((-1, -2)).reshape(lost.shape)
    np.testing.assert_array_equal(missing, lost)
    np.testing.assert_array_equal(np.isnan(fitted().angles).all(-1).reshape(lost.shape), lost)


def test_a_frame_that_the_hand_does_not_fit_has_no_truth() -> None:
    own, markers, _ = person()
    spoiled = markers[0].copy()
    spoiled[70, DENSE.markers.index("RingPIP")] += 0.03
    truth = dense_truth._followed(own, NOISE, [spoiled], lambda share: None)
    np.testing.assert_array_equal(np.flatnonzero(np.isnan(truth.angles).all(-1)), [70])


def test_the_noise_floor_is_what_the_truth_is_really_off() -> None:
    _, markers, _ = person()
    shares: list[float] = []
    floor = dense_truth.noise_floor(DENSE, fitted(), list(markers), report=shares.append)
    assert [len(part) for part in floor] == [FRAMES] * -(-TAKES // dense_truth.FLOOR_SHARE)
    really = np.nanmean(off(fitted().joints()[0]))
    assert 0.5 * really < np.nanmean(np.concatenate(floor)) < 2 * really
    assert shares == sorted(shares)
    assert (shares[0], shares[-1]) == (0, 1)


def test_smoothed_noise_is_of_unit_size_and_like_its_neighbour() -> None:
    noise = dense_truth.smoothed_noise(np.random.default_rng(0), (200, 300, 3))
    assert noise.std() == pytest.approx(1, abs=0.01)
    # Windows of nine weights that lie two samples apart.
    weights = dense_truth.smooth(np.eye(9))[4]
    expected = (weights[2:] * weights[:-2]).sum() / (weights**2).sum()
    assert (noise[1:] * noise[:-1]).mean() == pytest.approx(expected, abs=0.02)


def test_what_was_kept_comes_back_bit_for_bit_and_only_for_its_own_recordings(
    tmp_path: Path,
) -> None:
    path, floor = tmp_path / "new" / "one.npz", [np.arange(3.0), np.arange(5.0)]
    origin = dense_truth.fingerprint(DENSE, list(person()[1]))
    dense_truth.save(path, fitted(), floor, origin)
    truth, again = dense_truth.load(path, origin)
    assert truth.hand.to_json() == fitted().hand.to_json()
    for name, array in fitted()._asdict().items():
        if name != "hand":
            np.testing.assert_array_equal(getattr(truth, name), array)
    for part, other in zip(floor, again, strict=True):
        np.testing.assert_array_equal(part, other)
    others = dense_truth.fingerprint(GLOVE, list(person()[1]))
    assert others != origin
    assert dense_truth.fingerprint(DENSE, list(person()[1][1:])) != origin
    with pytest.raises(ValueError, match=r"one\.npz was fitted to other recordings"):
        dense_truth.load(path, others)


def test_a_data_set_gets_truth_for_its_sequences_and_the_hand_as_it_is_worn(
    tmp_path: Path,
) -> None:
    _, markers, _ = person()
    floor = [np.full(FRAMES, 1e-3)] * 2
    for name in ("Ann", "Bob"):
        origin = dense_truth.fingerprint(DENSE, list(markers))
        dense_truth.save(tmp_path / f"{name}.npz", fitted(), floor, origin)
    sequences = tuple(
        Sequence(f"{name}/{i}/left", f"{name}/{i}", 60.0, markers[i][:, COLUMNS])
        for name in ("Ann", "Bob")
        for i in range(TAKES)
    )
    plain = Dataset("sig18", GLOVE, sequences)
    people = {"Ann": list(markers), "Bob": list(markers)}
    found = dense_truth.with_truth(plain, DENSE, people, COLUMNS, tmp_path)
    points, _ = fitted().joints()
    assert found.hand.markers == GLOVE.markers
    assert found.hand.alignment == GLOVE.alignment
    for marker, column in enumerate(COLUMNS):
        np.testing.assert_allclose(found.hand.offsets[marker], fitted().hand.offsets[column])
        assert found.hand.links[marker] == DENSE.links[column]
    np.testing.assert_allclose(found.hand.skeleton, fitted().hand.skeleton)
    for number, sequence in enumerate(found.sequences):
        first = FRAMES * (number % TAKES)
        np.testing.assert_allclose(sequence.positions, points[first : first + FRAMES], atol=1e-6)
        assert sequence.angles.shape == (FRAMES, 26)
        assert sequence.positions.dtype == sequence.rotations.dtype == np.float32
    assert found.noise_floor is not None
    assert list(found.noise_floor) == ["Ann/0", "Ann/8", "Bob/0", "Bob/8"]
    placed = marker_positions(
        found.hand, found.sequences[0].positions, found.sequences[0].rotations
    )
    assert np.abs(placed - sequences[0].markers).mean() < 2 * NOISE


def kept_truth(folder: Path, hand: Hand, columns: list[int]) -> Dataset:
    """One person's first take read as `hand`, with the truth of all."""
    markers = person()[1]
    origin = dense_truth.fingerprint(DENSE, list(markers))
    dense_truth.save(folder / "Ann.npz", fitted(), [np.zeros(FRAMES)] * 2, origin)
    sequences = (
        Sequence(f"{i}/left", f"{i}", 60.0, own[:, columns]) for i, own in enumerate(markers)
    )
    plain = Dataset("sig18", hand, tuple(sequences))
    return dense_truth.with_truth(plain, DENSE, {"Ann": list(markers)}, columns, folder)


def reached(dataset: Dataset) -> float:
    """Metres: how far forward kinematics of the angles, from the wrist that the alignment markers
    give, is off the joints, on average."""
    hand, apart = dataset.hand, []
    for sequence in dataset.sequences:
        weight = np.broadcast_to(hand.alignment_weight, sequence.markers.shape[:-1])
        prior = np.broadcast_to(np.eye(3), (len(weight), 3, 3))
        pose = kabsch(hand.template, np.nan_to_num(sequence.markers), weight, prior)
        turns = rotations_from_angles(np.float64(sequence.angles))
        found, _ = forward_kinematics(hand.skeleton, turns, *pose)
        apart.append(np.linalg.norm(found - sequence.positions, axis=-1)[:, list(JOINT_POINTS)])
    return float(np.nanmean(np.concatenate(apart)))


def test_angles_are_the_persons_where_the_alignment_markers_sit_on_the_wrist(
    tmp_path: Path,
) -> None:
    dataset = kept_truth(tmp_path, DENSE, list(range(len(DENSE))))
    np.testing.assert_array_equal(dataset.sequences[0].angles, np.float32(fitted().angles[:FRAMES]))


def test_angles_reach_the_joints_from_a_wrist_that_fingers_tilt(tmp_path: Path) -> None:
    dataset = kept_truth(tmp_path, GLOVE, COLUMNS)
    angles = np.split(np.float32(fitted().angles), TAKES)
    own = [replace(s, angles=a) for s, a in zip(dataset.sequences, angles, strict=True)]
    persons = replace(dataset, sequences=tuple(own))
    assert reached(dataset) < reached(persons) / 3


def test_sig18s_joint_truth_is_fitted_where_it_is_asked_for(tmp_path: Path) -> None:
    move = motion(0, 240, 120.0)
    markers, true, _ = worn(DENSE, move)
    markers = markers + 1.6e-3 * np.random.default_rng(0).normal(size=markers.shape)
    left = Recording(DENSE.markers, markers, np.arange(240) / 120, 120, "")
    right = replace(left, markers=mirror(left.markers))
    folder = tmp_path / "data" / "User4" / "capture1"
    folder.mkdir(parents=True)
    write(left, folder / "sequence.1_training_dense_left.trc")
    write(right, folder / "sequence.1_training_dense_right.trc")
    spec = f"sig18:{tmp_path / 'data'}"
    assert load(spec, "test").sequences[0].angles is None
    dataset = load(spec, "test", truth=tmp_path / "truth")
    assert [path.name for path in (tmp_path / "truth").iterdir()] == ["User4.npz"]
    for sequence in dataset.sequences:
        assert sequence.markers.shape == (120, 9, 3)
        assert np.isfinite(sequence.positions).mean() > 0.95
        assert np.nanmean(np.linalg.norm(sequence.positions - true[::2], axis=-1)) < 5e-3
    assert dataset.hand.markers == GLOVE.markers
    wrist, tip = dataset.hand.markers.index("wrist"), dataset.hand.markers.index("thumb_tip")
    theirs = [DENSE.markers.index(name) for name in ("BackHand2", "ThumbTip")]
    assert [dataset.hand.joints[i] for i in (wrist, tip)] == [DENSE.joints[i] for i in theirs]
    assert dataset.noise_floor is not None
    again = load(spec, "test", truth=tmp_path / "truth")
    np.testing.assert_array_equal(again.sequences[1].angles, dataset.sequences[1].angles)
