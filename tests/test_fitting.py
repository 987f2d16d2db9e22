"""Laws of the angle fit: what forward kinematics made, it finds again."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("jax")

from jaxhand.fitting import angle_deviation, fit_angles, rest_directions
from numpy_infer.arrays import Array
from numpy_infer.hand import ANGLES, HIGH, LOW, POINTS, load_hand
from numpy_infer.skeleton import forward_kinematics, rotations_from_angles

SKELETON = load_hand("glove9").skeleton
TWISTS = np.array([angle.name.endswith("_twist") for angle in ANGLES])


def simulated(frames: int, seed: int = 0) -> Array:
    """`[T, 26]` radians, each angle anywhere in its range."""
    return np.random.default_rng(seed).uniform(LOW, HIGH, (frames, len(ANGLES)))


def pose(angles: Array) -> Array:
    """`[T, 21, 3]` metres, hand frame."""
    return forward_kinematics(SKELETON, rotations_from_angles(angles), np.eye(3), np.zeros(3))[0]


def test_untwisted_hands_come_back_whole() -> None:
    angles = np.where(TWISTS, 0, simulated(300))
    fit = fit_angles(SKELETON, pose(angles))
    assert fit.residual.max() < 1e-6
    assert np.abs(np.degrees(fit.angles - angles)).max() < 0.5


def test_twisted_hands_come_back_in_place() -> None:
    points = pose(simulated(1500))
    fit = fit_angles(SKELETON, points)
    # A twist is drawn back with 2 mm per radian and bounded by 50 degrees.
    assert fit.residual.max() < 1e-3
    assert fit.residual.mean() < 0.2e-3
    again = np.linalg.norm(pose(fit.angles.astype(np.float64)) - points, axis=-1)
    np.testing.assert_allclose(fit.residual, again, atol=1e-6)


def test_a_twist_that_cannot_be_seen_is_zero() -> None:
    angles = np.where([a.axis == "z" for a in ANGLES], 0.3, np.zeros((1, len(ANGLES))))
    fit = fit_angles(SKELETON, pose(angles))
    fingers = TWISTS & [not a.joint.startswith("thumb") for a in ANGLES]
    assert np.abs(fit.angles[0, fingers]).max() < 1e-4


def test_fitting_is_deterministic_and_frames_do_not_matter_to_each_other() -> None:
    points = pose(simulated(40))
    first, second = fit_angles(SKELETON, points), fit_angles(SKELETON, points)
    np.testing.assert_array_equal(first.angles, second.angles)
    np.testing.assert_array_equal(first.angles[17:18], fit_angles(SKELETON, points[17:18]).angles)


def test_unreachable_points_give_finite_angles() -> None:
    random = np.random.default_rng(1)
    points = np.stack([random.normal(0, 1, (21, 3)), np.zeros((21, 3)), np.full((21, 3), 100.0)])
    fit = fit_angles(SKELETON, points)
    assert np.isfinite(fit.angles).all()
    assert np.isfinite(fit.residual).all()


@pytest.mark.parametrize("hidden", ["nan", "weight"])
def test_a_hidden_tip_leaves_the_other_fingers_alone(hidden: str) -> None:
    points, weight = pose(simulated(20)), np.ones(len(POINTS))
    whole = fit_angles(SKELETON, points)
    tip = POINTS.index("index_tip")
    if hidden == "nan":
        points[:, tip] = np.nan
    else:
        points[:, tip], weight[tip] = 7.0, 0
    fit = fit_angles(SKELETON, points, weight)
    others = [not a.joint.startswith("index") for a in ANGLES]
    np.testing.assert_allclose(fit.angles[:, others], whole.angles[:, others], atol=1e-3)
    assert np.isfinite(fit.angles).all()


def test_angles_beyond_their_range_are_still_followed() -> None:
    angles = np.zeros((1, len(ANGLES)))
    pip = [a.name for a in ANGLES].index("index_pip_flexion")
    angles[0, pip] = HIGH[pip] + np.radians(10)
    assert fit_angles(SKELETON, pose(angles)).residual.max() < 1e-3


def test_no_frames_are_no_frames() -> None:
    fit = fit_angles(SKELETON, np.zeros((0, 21, 3)))
    assert fit.angles.shape == (0, 26)
    assert fit.residual.shape == (0, 21)


def test_a_wrong_shape_is_named() -> None:
    with pytest.raises(ValueError, match=r"points: expected shape \[4, 21, 3\]"):
        fit_angles(SKELETON, np.zeros((4, 20, 3)))
    with pytest.raises(ValueError, match="skeleton"):
        fit_angles(SKELETON[1:], np.zeros((4, 21, 3)))


def test_bent_fingers_show_their_twist_and_straight_ones_do_not() -> None:
    straight = np.zeros((1, len(ANGLES)))
    bent = np.where([a.name.endswith("pip_flexion") for a in ANGLES], 1.0, straight)
    twist = [a.name for a in ANGLES].index("ring_mcp_twist")
    flexion = [a.name for a in ANGLES].index("ring_mcp_flexion")
    assert angle_deviation(SKELETON, straight)[twist] > np.radians(25)
    assert angle_deviation(SKELETON, bent)[twist] < np.radians(5)
    assert angle_deviation(SKELETON, straight)[flexion] < np.radians(2)


def test_bones_aside_of_their_hinges_are_found_and_lengths_kept() -> None:
    angles, aside = np.where(TWISTS, 0, simulated(400)), np.array(SKELETON, np.float64)
    for name in ("middle_dip", "pinky_pip", "pinky_dip"):
        bone = aside[POINTS.index(name)]
        length = np.linalg.norm(bone)
        moved = bone + 0.05 * length * np.array([1, 0, 0])
        aside[POINTS.index(name)] = moved * length / np.linalg.norm(moved)
    for true in (aside, SKELETON):
        turns = rotations_from_angles(angles)
        points = forward_kinematics(true, turns, np.eye(3), np.zeros(3))[0]
        found = rest_directions(SKELETON, points)
        lengths = np.linalg.norm(SKELETON, axis=-1)
        np.testing.assert_allclose(np.linalg.norm(found, axis=-1), lengths, rtol=1e-5)
        before, after = (fit_angles(s, points).residual.mean() for s in (SKELETON, found))
        assert after < max(0.7 * before, 1e-6)
