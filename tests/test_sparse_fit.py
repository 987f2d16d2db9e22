"""Laws of the sparse fit: it finds the likeliest posture, whatever is hidden."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from strategies import masks, motions, turn

pytest.importorskip("jax")

from conftest import x64

from jaxhand import datasets, sparse_fit
from jaxhand.ik import Solved, ccd
from jaxhand.sparse_fit import PosePrior, least_squares, prior_of
from jaxhand.tasks import JOINT_POINTS
from numpy_infer.arrays import Array
from numpy_infer.hand import ANGLES, HIGH, LOW, Hand, load_hand
from numpy_infer.skeleton import forward_kinematics, marker_positions, rotations_from_angles

GLOVE, DENSE = load_hand("glove9"), load_hand("dense19")
NAMES = [angle.name for angle in ANGLES]
COUNT = 40
_RANDOM = np.random.default_rng(1)
POSTURES = _RANDOM.normal(0.3, 0.25, (500, 1)) * (HIGH > 1)
POSTURES = POSTURES + _RANDOM.normal(0, 0.1, (500, len(ANGLES)))
"""`[500, 26]` radians: all fingers flex together, more or less."""
PRIOR = prior_of(POSTURES)


def placed(hand: Hand, angles: Array) -> tuple[Array, Array]:
    """`[..., M, 3]` markers and `[..., 21, 3]` points, metres, hand frame."""
    turns = rotations_from_angles(angles)
    points, rotations = forward_kinematics(hand.skeleton, turns, np.eye(3), np.zeros(3))
    return marker_positions(hand, points, rotations), points


def assert_same(one: Solved, other: Solved) -> None:
    for a, b in zip(one, other, strict=True):
        np.testing.assert_array_equal(a, b)


def test_exact_data_come_back_where_the_prior_is_right() -> None:
    markers, points = placed(GLOVE, POSTURES[:1])
    right = PosePrior(POSTURES[0].astype(np.float32), PRIOR.factor)
    found = least_squares(GLOVE, np.repeat(markers, COUNT, 0), right)
    np.testing.assert_allclose(found.positions[0], points[0], atol=2e-6)
    np.testing.assert_allclose(found.angles[0], POSTURES[0], atol=2e-5)


def test_exact_data_come_back_near_the_prior() -> None:
    near = POSTURES[:1] + np.random.default_rng(5).normal(0, 0.05, (COUNT, len(ANGLES)))
    markers, points = placed(GLOVE, near)
    found = least_squares(GLOVE, markers, PRIOR)
    error = np.linalg.norm(np.asarray(found.positions) - points, axis=-1)
    seen = [GLOVE.joints[m] for m, link in enumerate(GLOVE.links) if link]
    assert error[:, seen].max() < 1e-3
    assert error.mean() < 2e-3


def test_enough_markers_need_no_prior() -> None:
    markers, points = placed(DENSE, POSTURES[:COUNT])
    wide = PosePrior(np.zeros(len(ANGLES), np.float32), np.eye(len(ANGLES), dtype=np.float32))
    found = least_squares(DENSE, markers, wide)
    error = np.linalg.norm(np.asarray(found.positions) - points, axis=-1)
    assert error[:, JOINT_POINTS].mean() < 1e-3


def test_what_is_found_is_likelier_than_what_is_beside_it() -> None:
    markers, _ = placed(GLOVE, POSTURES[:COUNT])
    markers += np.random.default_rng(6).normal(0, 1e-3, markers.shape)
    found = least_squares(GLOVE, markers, PRIOR)

    def cost(angles: Array) -> Array:
        turns = rotations_from_angles(angles)
        pose = (np.asarray(part, float) for part in (found.wrist_rotation, found.wrist_position))
        off = marker_positions(GLOVE, *forward_kinematics(GLOVE.skeleton, turns, *pose)) - markers
        unlikely = np.linalg.solve(PRIOR.factor.astype(float), (angles - PRIOR.mean).T).T
        beyond = (angles - np.clip(angles, LOW, HIGH)) / sparse_fit.RANGE_PRIOR
        return sum((part**2).reshape(COUNT, -1).sum(-1) for part in (off / 1e-3, unlikely, beyond))

    angles = np.asarray(found.angles, float)
    least = cost(angles)
    for way in np.concatenate([np.eye(len(ANGLES)), -np.eye(len(ANGLES))]) * 0.03:
        assert (cost(angles + way) > least).all()


def test_the_prior_fills_in_from_the_other_fingers() -> None:
    names = [name for name in NAMES if name.startswith("ring") and name.endswith("flexion")]
    ring = [NAMES.index(name) for name in names]
    hidden = GLOVE.markers.index("ring_tip")
    for flexion in (0.1, 0.6):
        angles = PRIOR.mean + (flexion - 0.3) * (HIGH > 1)
        markers = np.repeat(placed(GLOVE, angles[None])[0], COUNT, 0)
        markers[:, hidden] = np.nan
        found = least_squares(GLOVE, markers, PRIOR)
        np.testing.assert_allclose(found.angles[0, ring], angles[ring], atol=0.08)


def test_nothing_seen_is_the_mean_posture_at_the_start() -> None:
    start = turn([1, 2, 3], 2.0).astype(np.float32), np.array([1.0, -2, 3], np.float32)
    nothing = np.full((COUNT, len(GLOVE), 3), np.nan)
    found = least_squares(GLOVE, nothing, PRIOR, start=start)
    np.testing.assert_allclose(found.angles[7], PRIOR.mean, atol=1e-6)
    np.testing.assert_allclose(found.wrist_rotation[7], start[0], atol=1e-6)
    np.testing.assert_allclose(found.wrist_position[7], start[1], atol=1e-6)


@given(masks(), st.sampled_from([np.nan, np.inf, 0.0, 7.0]))
def test_hidden_markers_cannot_matter(visible: Array, anything: float) -> None:
    markers, _ = placed(GLOVE, POSTURES[:COUNT])
    shown = np.broadcast_to(visible, markers.shape[:-1])
    whole = least_squares(GLOVE, markers, PRIOR, visible=shown)
    markers[:, ~visible] = anything
    found = least_squares(GLOVE, markers, PRIOR, visible=shown)
    assert all(np.isfinite(part).all() for part in found)
    assert_same(found, whole)
    markers[:, ~visible] = np.nan
    assert_same(least_squares(GLOVE, markers, PRIOR), whole)


def test_hidden_alignment_markers_are_made_up_for() -> None:
    markers, points = placed(GLOVE, POSTURES[:COUNT])
    for marker in GLOVE.alignment:
        shown = np.where((np.arange(len(GLOVE)) == marker)[:, None], np.nan, markers)
        found = least_squares(GLOVE, shown, PRIOR)
        assert np.linalg.norm(found.positions - points, axis=-1).mean() < 5e-3


@given(motions())
def test_a_rigid_motion_moves_all_and_turns_no_joint(motion: tuple[Array, Array]) -> None:
    rotation, translation = motion
    markers, _ = placed(GLOVE, POSTURES[:COUNT])
    markers[::2, GLOVE.markers.index("wrist")] = np.nan
    still = least_squares(GLOVE, markers, PRIOR)
    found = least_squares(GLOVE, markers @ rotation.T + translation, PRIOR)
    expected = np.asarray(still.positions) @ rotation.T + translation
    np.testing.assert_allclose(found.positions, expected, atol=1e-4)
    np.testing.assert_allclose(found.angles, still.angles, atol=2e-3)
    np.testing.assert_allclose(found.wrist_rotation, rotation @ still.wrist_rotation, atol=1e-3)


def test_frames_do_not_matter_to_each_other_and_nothing_is_random() -> None:
    markers, _ = placed(GLOVE, POSTURES[:COUNT])
    many = least_squares(GLOVE, markers, PRIOR)
    again = least_squares(GLOVE, markers.reshape(4, 10, *markers.shape[1:]), PRIOR)
    one = least_squares(GLOVE, markers[17], PRIOR)
    for of_many, of_again, of_one in zip(many, again, one, strict=True):
        assert of_again.shape == (4, 10, *of_one.shape)
        np.testing.assert_array_equal(of_again.reshape(of_many.shape), of_many)
        np.testing.assert_allclose(of_one, of_many[17], atol=1e-4)


def test_markers_that_no_hand_has_give_finite_postures() -> None:
    markers, _ = placed(GLOVE, POSTURES[:COUNT])
    markers[:10] = np.random.default_rng(7).normal(0, 1, (10, len(GLOVE), 3))
    markers[10:20] = 0
    markers[20:30, 5:] = 100
    found = least_squares(GLOVE, markers, PRIOR)
    assert all(np.isfinite(part).all() for part in found)


def test_no_frames_are_no_frames() -> None:
    nothing = np.zeros((0, len(GLOVE), 3))
    assert least_squares(GLOVE, nothing, PRIOR).angles.shape == (0, len(ANGLES))


def test_float32_is_as_good_as_float64() -> None:
    markers, _ = placed(GLOVE, POSTURES[:COUNT])
    markers = (markers + np.array([3, -2, 1])).astype(np.float32).astype(float)
    single = least_squares(GLOVE, markers, PRIOR)
    with x64():
        double = least_squares(GLOVE, markers, PRIOR)
    assert double.positions.dtype == np.float64
    np.testing.assert_allclose(single.positions, double.positions, atol=1e-4)


def test_the_prior_is_the_gaussian_of_its_angles() -> None:
    covariance = np.cov(POSTURES.T, bias=True) + sparse_fit.FLOOR**2 * np.eye(len(ANGLES))
    np.testing.assert_allclose(PRIOR.mean, POSTURES.mean(0), atol=1e-6)
    np.testing.assert_allclose(PRIOR.factor @ PRIOR.factor.T, covariance, atol=1e-6)
    still = prior_of(np.zeros((1, len(ANGLES))))
    np.testing.assert_allclose(still.factor, sparse_fit.FLOOR * np.eye(len(ANGLES)), atol=1e-7)


def test_a_wrong_argument_is_named() -> None:
    markers = np.zeros((2, len(GLOVE), 3))
    with pytest.raises(ValueError, match=r"markers: expected shape \[..., 9, 3\]"):
        least_squares(GLOVE, markers[..., :2], PRIOR)
    with pytest.raises(ValueError, match=r"visible: expected shape \[2, 9\]"):
        least_squares(GLOVE, markers, PRIOR, visible=np.ones(9, bool))
    with pytest.raises(ValueError, match="broadcast"):
        least_squares(GLOVE, markers, PRIOR, start=(np.eye(4), np.zeros(3)))
    with pytest.raises(ValueError, match=r"angles: expected shape \[N, 26\]"):
        prior_of(np.zeros((0, 26)))
    with pytest.raises(ValueError, match="angles: expected finite"):
        prior_of(np.full((3, 26), np.nan))


def test_the_rivals_keep_their_order_on_real_hands(data_root: Path) -> None:
    takes = ("mug1", "wineglass3")
    recorded = datasets.load(f"manipnet:{data_root / 'manipnet'}", "train", takes=takes)
    *others, _, sequence = recorded.sequences
    assert [s.take for s in (*others, sequence)] == ["mug1", "mug1", "wineglass3"]
    assert sequence.positions is not None
    markers, truth = sequence.markers[::10], sequence.positions[::10]
    error = []
    for found in (
        least_squares(recorded.hand, markers, prior_of(np.concatenate([s.angles for s in others]))),
        ccd(recorded.hand, markers, tuned=True),
        ccd(recorded.hand, markers, tuned=False),
    ):
        off = np.linalg.norm(np.asarray(found.positions) - truth, axis=-1)
        error.append(1e2 * off[:, JOINT_POINTS].mean())
    assert error == sorted(error)
    assert error[0] < 0.2
    assert error[2] < 0.7
