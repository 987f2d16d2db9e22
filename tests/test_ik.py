"""Laws of coordinate descent: what can be reached is reached, and the paper's limits hold."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from strategies import directions, motions, turn

pytest.importorskip("jax")

from jaxhand.ik import Solved, ccd
from numpy_infer.arrays import Array
from numpy_infer.hand import ANGLES, CHAINS, HIGH, JOINTS, LOW, POINTS, Hand, load_hand
from numpy_infer.skeleton import forward_kinematics, marker_positions, rotations_from_angles

GLOVE = load_hand("glove9")
NAMES = [angle.name for angle in ANGLES]
FINGER_MARKERS = [m for m, link in enumerate(GLOVE.links) if JOINTS[link] != "wrist"]
COUNT = 40
BOTH = pytest.mark.parametrize("tuned", [False, True])


def placed(hand: Hand, angles: Array) -> tuple[Array, Array]:
    """`[..., M, 3]` markers and `[..., 21, 3]` points, metres, hand frame."""
    turns = rotations_from_angles(angles)
    points, rotations = forward_kinematics(hand.skeleton, turns, np.eye(3), np.zeros(3))
    return marker_positions(hand, points, rotations), points


def anywhere(seed: int = 0) -> Array:
    """`[40, 26]` radians, each angle anywhere in its range."""
    return np.random.default_rng(seed).uniform(LOW, HIGH, (COUNT, len(ANGLES)))


def misses(solved: Solved, markers: Array) -> Array:
    """`[..., 6]` metres: how far the markers on the fingers are from the measured ones."""
    pose = (solved.rotations, solved.wrist_rotation, solved.wrist_position)
    points, rotations = forward_kinematics(GLOVE.skeleton, *(np.asarray(p, float) for p in pose))
    own = marker_positions(GLOVE, points, rotations)
    return np.linalg.norm(own - markers, axis=-1)[..., FINGER_MARKERS]


def test_reachable_markers_are_reached() -> None:
    for seed in range(10):
        markers, _ = placed(GLOVE, anywhere(seed))
        assert misses(ccd(GLOVE, markers, tuned=False), markers).max() < 1e-3


@BOTH
def test_no_sweep_makes_it_worse(tuned: bool) -> None:
    markers, _ = placed(GLOVE, anywhere())
    # The thumb's two markers pull together: one may yield to the other.
    finger = np.array([(GLOVE.links[m] - 1) // 3 for m in FINGER_MARKERS])
    squares = [
        misses(ccd(GLOVE, markers, tuned=tuned, sweeps=n), markers) ** 2 @ np.eye(5)[finger]
        for n in (0, 1, 2, 5, 20, 100)
    ]
    assert (np.diff(squares, axis=0) < 1e-9).all()
    assert (squares[1] < squares[0]).all()


@given(directions())
def test_a_joint_turns_by_the_shortest_arc(direction: Array) -> None:
    aside = np.cross(direction, [0, 0, 1])
    if np.linalg.norm(aside) < 1e-6:
        aside = np.array([1.0, 0, 0])
    turns = np.broadcast_to(np.eye(3), (len(JOINTS) - 1, 3, 3)).copy()
    turns[JOINTS.index("ring_dip") - 1] = turn(aside, 0.5)
    points, rotations = forward_kinematics(GLOVE.skeleton, turns, np.eye(3), np.zeros(3))
    markers = np.repeat(marker_positions(GLOVE, points, rotations)[None], COUNT, 0)
    found = ccd(GLOVE, markers, tuned=False, sweeps=1)
    np.testing.assert_allclose(found.rotations[0], turns, atol=1e-4)


def test_the_papers_limits_hold_whatever_is_asked() -> None:
    expected = {}
    for name in NAMES:
        joint, motion = name.rsplit("_", 1)
        if joint.endswith("cmc") or (joint.endswith("mcp") and not joint.startswith("thumb")):
            expected[name] = (-20, 20) if motion == "twist" else (-45, 45)
        else:
            expected[name] = (-10, 90) if motion == "flexion" else (0, 0)
    low, high = np.radians([expected[name] for name in NAMES]).T
    markers = np.random.default_rng(3).normal(0, 0.15, (COUNT, len(GLOVE), 3))
    markers[:, list(GLOVE.alignment)] = GLOVE.template[list(GLOVE.alignment)]
    for targets in (markers, placed(GLOVE, anywhere())[0]):
        found = ccd(GLOVE, targets, tuned=True)
        angles = np.asarray(found.angles)
        assert (angles >= low - 2e-6).all()
        assert (angles <= high + 2e-6).all()
        # A hinge has nothing that its one angle does not say.
        again = rotations_from_angles(angles)
        np.testing.assert_allclose(found.rotations, again, atol=2e-6)


@pytest.mark.parametrize(("asked", "nearest"), [(120, 90), (-20, -10), (-110, -10), (-150, 90)])
def test_a_hinge_stops_at_the_nearer_end(asked: float, nearest: float) -> None:
    angles = np.zeros((COUNT, len(ANGLES)))
    dip = NAMES.index("index_dip_flexion")
    angles[:, dip] = np.radians(asked)
    # The first joint to turn, and not to turn again.
    found = ccd(GLOVE, placed(GLOVE, angles)[0], tuned=True, sweeps=1)
    np.testing.assert_allclose(np.degrees(found.angles[:, dip]), nearest, atol=1e-3)


def test_postures_within_the_limits_are_followed_by_hinges() -> None:
    angles = np.zeros((COUNT, len(ANGLES)))
    flexions = [i for i, name in enumerate(NAMES) if name.endswith("flexion")]
    angles[:, flexions] = np.random.default_rng(4).uniform(0.2, 0.7, (COUNT, len(flexions)))
    markers, _ = placed(GLOVE, angles)
    found = ccd(GLOVE, markers, tuned=True)
    assert misses(found, markers).mean() < 1e-3
    aside = [
        i for i, name in enumerate(NAMES) if not name.endswith("flexion") and "thumb" not in name
    ]
    assert np.abs(np.asarray(found.angles)[:, aside]).max() < 1e-3


@BOTH
def test_what_cannot_be_reached_gives_finite_postures(tuned: bool) -> None:
    flat, points = placed(GLOVE, np.zeros((COUNT, len(ANGLES))))
    for m in FINGER_MARKERS:
        base = points[0, CHAINS[(GLOVE.links[m] - 1) // 3][0]]
        last = points[0, JOINTS.index(JOINTS[GLOVE.links[m]])]
        along = flat[0, m] - base
        for frame, target in enumerate(
            (base, last, flat[0, m], base - along, last - along, base + 1e3 * along, base + 1e-9)
        ):
            flat[frame, m] = target
    flat[20:, FINGER_MARKERS] = 0
    found = ccd(GLOVE, flat, tuned=tuned)
    assert all(np.isfinite(part).all() for part in found)
    turns = np.asarray(found.rotations, float)
    product = turns @ np.swapaxes(turns, -1, -2)
    np.testing.assert_allclose(product, np.broadcast_to(np.eye(3), product.shape), atol=1e-4)
    assert (np.linalg.det(turns) > 0).all()


def test_a_marker_straight_behind_is_reached_by_flexion() -> None:
    markers, points = placed(GLOVE, np.zeros((COUNT, len(ANGLES))))
    tip, base = POINTS.index("index_tip"), POINTS.index("index_mcp")
    marker = GLOVE.markers.index("index_tip")
    markers[:, marker] = 2 * points[:, base] - points[:, tip]
    found = ccd(GLOVE, markers, tuned=False)
    np.testing.assert_allclose(found.positions[:, tip], markers[:, marker], atol=1e-3)


@BOTH
def test_a_marker_not_seen_leaves_the_other_fingers_alone(tuned: bool) -> None:
    markers, _ = placed(GLOVE, anywhere())
    whole = ccd(GLOVE, markers, tuned=tuned)
    markers[:, GLOVE.markers.index("index_tip"), 1] = np.nan
    found = ccd(GLOVE, markers, tuned=tuned)
    index = np.array([name.startswith("index") for name in JOINTS[1:]])
    np.testing.assert_allclose(found.rotations[:, ~index], whole.rotations[:, ~index], atol=1e-6)
    flat = np.broadcast_to(np.eye(3, dtype=np.float32), (COUNT, 3, 3, 3))
    np.testing.assert_array_equal(found.rotations[:, index], flat)


@BOTH
@given(motions())
def test_a_rigid_motion_moves_all_and_turns_no_joint(
    tuned: bool, motion: tuple[Array, Array]
) -> None:
    rotation, translation = motion
    markers, _ = placed(GLOVE, anywhere())
    still = ccd(GLOVE, markers, tuned=tuned)
    found = ccd(GLOVE, markers @ rotation.T + translation, tuned=tuned)
    expected = np.asarray(still.positions) @ rotation.T + translation
    # Descent is no contraction: rounding of 1e-7 m in the markers grows on the way.
    np.testing.assert_allclose(found.positions, expected, atol=2e-4)
    np.testing.assert_allclose(
        found.wrist_rotation, rotation @ np.asarray(still.wrist_rotation), atol=1e-5
    )


@BOTH
def test_frames_do_not_matter_to_each_other_and_nothing_is_random(tuned: bool) -> None:
    markers, _ = placed(GLOVE, anywhere())
    many = ccd(GLOVE, markers, tuned=tuned)
    again = ccd(GLOVE, markers.reshape(4, 10, *markers.shape[1:]), tuned=tuned)
    one = ccd(GLOVE, markers[17], tuned=tuned)
    for of_many, of_again, of_one in zip(many, again, one, strict=True):
        assert of_again.shape == (4, 10, *of_one.shape)
        np.testing.assert_array_equal(of_again.reshape(of_many.shape), of_many)
        np.testing.assert_allclose(of_one, of_many[17], atol=1e-4)


def test_no_frames_are_no_frames() -> None:
    nothing = np.zeros((0, len(GLOVE), 3))
    assert ccd(GLOVE, nothing, tuned=True).positions.shape == (0, len(POINTS), 3)


def test_a_wrong_shape_is_named() -> None:
    with pytest.raises(ValueError, match=r"markers: expected shape \[..., 9, 3\], got \[2, 8, 3\]"):
        ccd(GLOVE, np.zeros((2, 8, 3)), tuned=True)
