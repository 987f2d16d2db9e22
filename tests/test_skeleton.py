"""Laws of the skeleton, on both packages and in both precisions."""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np
import pytest
from conftest import REFERENCE, Side
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.testing import assert_allclose, assert_array_equal
from strategies import HIGH, LOW, Array, joint_angles, motions, turn, weights

from numpy_infer import hand as h

EYE = np.eye(3)
HAND = h.load_hand("dense19")
ORIGIN = np.zeros(3)
FLAT = np.zeros(len(h.ANGLES))
THUMB = h.POINTS.index("thumb_tip")


def radians(side: Side) -> float:
    return 1e-9 if side.dtype == np.float64 else 1e-5


def pose(side: Side, angles: Array, skeleton: Array = HAND.skeleton) -> Array:
    """`[21, 3]` points of a hand whose wrist stands at the origin."""
    rotations = side.skeleton.rotations_from_angles(angles)
    return side.skeleton.forward_kinematics(skeleton, rotations, EYE, ORIGIN)[0].astype(float)


def only(name: str, value: float) -> Array:
    """The flat hand but for one angle."""
    return np.where([angle.name == name for angle in h.ANGLES], value, 0.0)


@cache
def downstream(joint: str) -> frozenset[int]:
    """Indices of the points that hang on a joint, without itself."""
    start = h.POINTS.index(joint)
    found: set[int] = set()
    for _ in h.POINTS:
        found |= {i for i, p in enumerate(h.PARENTS) if p == start or p in found}
    return frozenset(found)


def reference(angles: Array) -> tuple[Array, Array]:
    """Forward kinematics as the tables of `hand` say it, one joint at a time."""
    positions, rotations = np.zeros((21, 3)), np.zeros((21, 3, 3))
    rotations[0] = EYE
    for i, parent in enumerate(h.PARENTS):
        if i == 0:
            continue
        positions[i] = positions[parent] + rotations[parent] @ HAND.skeleton[i]
        rotations[i] = rotations[parent]
        own = np.array(h.THUMB_AXES) if h.POINTS[i].startswith("thumb") else EYE
        for angle, value in zip(h.ANGLES, angles, strict=True):
            if angle.joint == h.POINTS[i]:
                axis = own[:, "xyz".index(angle.axis)]
                rotations[i] = rotations[i] @ turn(axis, angle.sign * value)
    return positions, rotations[:16]


def test_no_angles_give_the_flat_hand_and_its_template(side: Side) -> None:
    assert_allclose(pose(side, FLAT), h.flat_points(HAND.skeleton), atol=side.metres)
    rotations = side.skeleton.rotations_from_angles(FLAT)
    placed = side.skeleton.forward_kinematics(HAND.skeleton, rotations, EYE, ORIGIN)
    for name in h.bundled():
        hand = h.load_hand(name)
        flat = hand.with_skeleton(HAND.skeleton)
        markers = side.skeleton.marker_positions(flat, *placed)
        assert_allclose(markers, flat.template, atol=side.metres)


@given(angles=joint_angles())
def test_forward_kinematics_is_what_the_tables_say(side: Side, angles: Array) -> None:
    rotations = side.skeleton.rotations_from_angles(angles)
    found = side.skeleton.forward_kinematics(HAND.skeleton, rotations, EYE, ORIGIN)
    for a, b in zip(found, reference(angles), strict=True):
        assert_allclose(a, b, atol=side.metres)


@given(angles=joint_angles(), size=st.floats(0.5, 2, width=16))
def test_bones_keep_their_lengths_under_any_angles(side: Side, angles: Array, size: float) -> None:
    points = pose(side, angles, size * HAND.skeleton)
    lengths = np.linalg.norm(points[1:] - points[list(h.PARENTS[1:])], axis=-1)
    expected = [size * length for length in HAND.bone_lengths.values()]
    assert_allclose(lengths, expected, atol=side.metres)


@given(angles=joint_angles())
def test_angles_come_back_from_their_rotations(side: Side, angles: Array) -> None:
    rotations = side.skeleton.rotations_from_angles(angles)
    back = side.skeleton.angles_from_rotations(rotations)
    assert_allclose(back, angles, rtol=0, atol=radians(side))


@given(angles=hnp.arrays(float, 26, elements=st.floats(-7, 7, width=16), fill=st.nothing()))
def test_rotations_are_proper_under_any_angles(side: Side, angles: Array) -> None:
    rotations = side.skeleton.rotations_from_angles(angles).astype(float)
    assert_allclose(rotations @ np.swapaxes(rotations, -1, -2) - EYE, 0, atol=side.metres)
    assert_allclose(np.linalg.det(rotations), 1, atol=side.metres)


@given(angles=hnp.arrays(float, 26, elements=st.floats(-7, 7, width=16), fill=st.nothing()))
def test_rotations_come_back_from_their_angles(side: Side, angles: Array) -> None:
    # Out of range the angles may differ, not what they do.
    rotations = side.skeleton.rotations_from_angles(angles)
    full = [j for j in range(15) if sum(a.joint == h.JOINTS[j + 1] for a in h.ANGLES) == 3]
    again = side.skeleton.rotations_from_angles(side.skeleton.angles_from_rotations(rotations))
    assert_allclose(again[full], rotations[full], atol=2 * side.metres)


@given(angles=joint_angles(), motion=motions())
def test_the_hand_follows_its_wrist(side: Side, angles: Array, motion: tuple[Array, Array]) -> None:
    rotations = side.skeleton.rotations_from_angles(angles)
    still = side.skeleton.forward_kinematics(HAND.skeleton, rotations, EYE, ORIGIN)
    carried = side.skeleton.forward_kinematics(HAND.skeleton, rotations, *motion)
    rotation, translation = motion
    assert_allclose(carried[0], still[0] @ rotation.T + translation, rtol=0, atol=side.metres)
    assert_allclose(carried[1], rotation @ still[1], rtol=0, atol=side.metres)
    markers = side.skeleton.marker_positions(HAND, *still)
    assert_allclose(
        side.skeleton.marker_positions(HAND, *carried),
        markers @ rotation.T + translation,
        rtol=0,
        atol=side.metres,
    )


@given(angles=joint_angles())
def test_a_marker_stays_at_its_offset_from_its_joint_in_its_links_frame(
    side: Side, angles: Array
) -> None:
    positions, rotations = reference(angles)
    markers = side.skeleton.marker_positions(HAND, positions, rotations)
    for i in range(len(HAND)):
        offset = rotations[HAND.links[i]].T @ (markers[i] - positions[HAND.joints[i]])
        assert_allclose(offset, HAND.offsets[i], atol=side.metres)


@pytest.mark.parametrize("angle", h.ANGLES, ids=lambda angle: angle.name)
def test_an_angle_moves_only_what_hangs_on_its_joint(side: Side, angle: h.Angle) -> None:
    rng = np.random.default_rng(0)
    before = rng.uniform(LOW, HIGH) / 2
    after = before + only(angle.name, 0.2)
    change = np.linalg.norm(pose(side, after) - pose(side, before), axis=-1)
    hanging = sorted(downstream(angle.joint))
    others = sorted(set(range(21)) - downstream(angle.joint))
    assert_allclose(change[others], 0, atol=side.metres)
    # Twist moves nothing on a straight finger, but this one is bent.
    assert change[hanging].max() > 1e-3


@pytest.mark.parametrize("angle", h.ANGLES, ids=lambda angle: angle.name)
def test_positive_angles_move_the_tip_where_their_names_say(side: Side, angle: h.Angle) -> None:
    finger = angle.name.split("_")[0]
    tip = h.POINTS.index(f"{finger}_tip")
    step = (pose(side, only(angle.name, 0.2)) - pose(side, FLAT))[tip]
    if angle.name.endswith("twist"):
        return  # see below
    if finger != "thumb":
        wanted = {"x": [0, -1, 0], "y": [1, 0, 0]}[angle.axis]  # palmar; towards the thumb
        assert step @ wanted > 1e-3
    elif angle.axis == "x":
        assert step[0] < -1e-3, "thumb flexion goes towards the little finger"
        assert step[1] < -1e-3, "and towards the palm"
    else:
        index = h.flat_points(HAND.skeleton)[h.POINTS.index("index_mcp")]
        flat = h.flat_points(HAND.skeleton)[tip]
        away = np.linalg.norm(flat + step - index) - np.linalg.norm(flat - index)
        assert away > 1e-3, "thumb abduction goes away from the index finger"


@pytest.mark.parametrize("angle", [a for a in h.ANGLES if a.axis == "z"], ids=lambda a: a.name)
def test_twist_turns_about_the_bone(side: Side, angle: h.Angle) -> None:
    joint = h.JOINTS.index(angle.joint)
    rotation = side.skeleton.rotations_from_angles(only(angle.name, 0.3))[joint - 1].astype(float)
    bone = HAND.skeleton[h.PARENTS.index(joint)]
    bone = bone / np.linalg.norm(bone)
    assert np.degrees(np.arccos(min(1, (rotation @ bone) @ bone))) < 0.5
    assert_allclose(np.arccos((np.trace(rotation) - 1) / 2), 0.3, atol=1e-5)
    moved = pose(side, only(angle.name, 0.3)) - pose(side, FLAT)
    assert np.abs(moved).max() < 1e-3


@given(angles=st.lists(joint_angles(), min_size=2, max_size=2), motion=motions())
def test_leading_axes_are_free(
    side: Side, angles: list[Array], motion: tuple[Array, Array]
) -> None:
    batch = np.stack(angles)[:, None]
    rotations = side.skeleton.rotations_from_angles(batch)
    wrists, places = (np.broadcast_to(part, (2, 1, *part.shape)) for part in motion)
    positions, turns = side.skeleton.forward_kinematics(HAND.skeleton, rotations, wrists, places)
    markers = side.skeleton.marker_positions(HAND, positions, turns)
    back = side.skeleton.angles_from_rotations(rotations)
    assert markers.shape == (2, 1, len(HAND), 3)
    shared = side.skeleton.forward_kinematics(HAND.skeleton, rotations, *motion)  # one wrist
    for one, other in zip(shared, (positions, turns), strict=True):
        assert_allclose(one, other, rtol=0, atol=side.metres)
    for i, one in enumerate(angles):
        alone = side.skeleton.rotations_from_angles(one)
        placed = side.skeleton.forward_kinematics(HAND.skeleton, alone, *motion)
        assert_allclose(positions[i, 0], placed[0], rtol=0, atol=side.metres)
        assert_allclose(turns[i, 0], placed[1], rtol=0, atol=side.metres)
        expected = side.skeleton.marker_positions(HAND, *placed)
        assert_allclose(markers[i, 0], expected, rtol=0, atol=side.metres)
        assert_allclose(back[i, 0], one, rtol=0, atol=radians(side))


@given(angles=joint_angles(), motion=motions())
def test_all_sides_give_the_same_numbers(
    side: Side, angles: Array, motion: tuple[Array, Array]
) -> None:
    ours, theirs = REFERENCE.skeleton, side.skeleton
    metres = side.metres
    rotations = ours.rotations_from_angles(angles)
    assert_allclose(theirs.rotations_from_angles(angles), rotations, rtol=0, atol=metres)
    assert_allclose(
        theirs.angles_from_rotations(rotations),
        ours.angles_from_rotations(rotations),
        rtol=0,
        atol=metres,
    )
    placed = ours.forward_kinematics(HAND.skeleton, rotations, *motion)
    for a, b in zip(
        theirs.forward_kinematics(HAND.skeleton, rotations, *motion), placed, strict=True
    ):
        assert_allclose(a, b, rtol=0, atol=metres)
    assert_allclose(
        theirs.marker_positions(HAND, *placed),
        ours.marker_positions(HAND, *placed),
        rtol=0,
        atol=metres,
    )


# -- finger alignment ---------------------------------------------------------------------------

HANDS = {name: h.load_hand(name) for name in h.bundled()}  # once: JAX compiles for each object
GLOVE = HANDS["glove9"]


def with_markers_on_last_phalanges() -> h.Hand:
    """`glove9` with its tip markers in the middle of the last bones."""
    data = GLOVE.to_json()
    del data["template"]
    for marker in data["markers"]:
        if marker["name"].endswith("_tip"):
            bone = GLOVE.skeleton[h.POINTS.index(marker["name"])]
            marker["offset"] = (-bone / 2).tolist()
    return h.hand_from_json(data)


ON_PHALANGES = with_markers_on_last_phalanges()


class Posed(NamedTuple):
    """A hand as the pipeline has it before alignment, and its own markers."""

    local: Array
    positions: Array
    rotations: Array
    markers: Array


def posed(side: Side, hand: h.Hand, angles: Array, motion: tuple[Array, Array]) -> Posed:
    local = side.skeleton.rotations_from_angles(angles)
    placed = side.skeleton.forward_kinematics(hand.skeleton, local, *motion)
    return Posed(local, *placed, side.skeleton.marker_positions(hand, *placed))


def again(side: Side, hand: h.Hand, local: Array, motion: tuple[Array, Array]) -> Posed:
    placed = side.skeleton.forward_kinematics(hand.skeleton, local, *motion)
    return Posed(local, *placed, side.skeleton.marker_positions(hand, *placed))


def aligned(side: Side, hand: h.Hand, pose: Posed, markers: Array, weight: Array) -> Array:
    """Bent, then turned, each from forward kinematics of its own."""
    local = side.skeleton.bend_fingers(hand, *pose[:3], markers, weight)
    wrist = pose.rotations[..., 0, :, :], pose.positions[..., 0, :]
    bent = again(side, hand, local, wrist)
    return side.skeleton.align_fingers(hand, *bent[:3], markers, weight)


@pytest.mark.parametrize("name", h.bundled())
@given(angles=joint_angles(), motion=motions(), weight=weights(19))
def test_alignment_leaves_exact_joints_as_they_are(
    side: Side, name: str, angles: Array, motion: tuple[Array, Array], weight: Array
) -> None:
    hand = HANDS[name]
    pose = posed(side, hand, angles, motion)
    found = aligned(side, hand, pose, pose.markers, weight[: len(hand)] / 2)
    # float32: a metre or so from the origin, over a finger's length
    tolerance = 1e-9 if side.dtype == np.float64 else 1e-4
    assert_allclose(found, pose.local, rtol=0, atol=tolerance)


@given(angles=joint_angles(0.8), other=joint_angles(0.8), motion=motions())
def test_an_aligned_finger_points_to_its_marker_and_is_turned_as_little_as_can_be(
    side: Side, angles: Array, other: Array, motion: tuple[Array, Array]
) -> None:
    pose = posed(side, GLOVE, angles, motion)
    measured = posed(side, GLOVE, other, motion).markers
    local = side.skeleton.align_fingers(GLOVE, *pose[:3], measured, np.ones(len(GLOVE)))
    found = again(side, GLOVE, local, motion)
    for finger in range(5):
        base, end = pose.positions[1 + 3 * finger], GLOVE.finger_markers[finger][-1]
        want, have = measured[end] - base, found.markers[end] - base
        crossed = np.linalg.norm(np.cross(want, have))
        assert crossed / np.linalg.norm(want) < 10 * side.metres
        assert want @ have > 0
        before = pose.markers[end] - base
        angle = np.arctan2(np.linalg.norm(np.cross(before, want)), before @ want)
        turned = local[3 * finger].astype(float) @ pose.local[3 * finger].T.astype(float)
        assert_allclose(np.arccos(np.clip((np.trace(turned) - 1) / 2, -1, 1)), angle, atol=2e-3)
    # All else is as it was.
    rest = [j for j in range(15) if j % 3]
    assert_array_equal(local[rest], pose.local[rest])


@given(angles=joint_angles(0.8), other=joint_angles(0.8))
def test_the_papers_middle_of_the_last_phalanx_is_a_marker_placed_there(
    side: Side, angles: Array, other: Array
) -> None:
    """p_mr = (p3 + p2) / 2, about p0, by the shortest arc (paper, section 2.2)."""
    hand = ON_PHALANGES
    pose = posed(side, hand, angles, (EYE, ORIGIN))
    measured = posed(side, hand, other, (EYE, ORIGIN)).markers
    local = side.skeleton.align_fingers(hand, *pose[:3], measured, np.ones(len(hand)))
    for finger in range(1, 5):
        base, _, last, tip = h.CHAINS[finger]
        middle = (pose.positions[last] + pose.positions[tip]) / 2 - pose.positions[base]
        target = measured[hand.finger_markers[finger][-1]] - pose.positions[base]
        arc = side.geometry.shortest_arc(middle, target, np.ones(()))
        expected = arc @ pose.local[3 * finger]
        assert_allclose(local[3 * finger], expected, rtol=0, atol=20 * side.metres)


@given(angles=joint_angles(0.8), other=joint_angles(0.8), motion=motions())
def test_a_hidden_marker_pulls_nothing_and_cannot_matter(
    side: Side, angles: Array, other: Array, motion: tuple[Array, Array]
) -> None:
    pose = posed(side, GLOVE, angles, motion)
    measured = posed(side, GLOVE, other, motion).markers
    hidden = GLOVE.markers.index("index_tip")
    weight = np.ones(len(GLOVE))
    weight[hidden] = 0
    one = aligned(side, GLOVE, pose, measured, weight)
    holed = measured.copy()
    holed[hidden] = np.nan
    assert_array_equal(aligned(side, GLOVE, pose, holed, weight), one)
    assert_allclose(one[3:6], pose.local[3:6], rtol=0, atol=side.metres)
    assert np.isfinite(one).all()


def test_alignment_is_defined_for_opposite_and_for_no_directions(side: Side) -> None:
    pose = posed(side, GLOVE, FLAT, (EYE, ORIGIN))
    index, middle = (GLOVE.markers.index(f"{f}_tip") for f in ("index", "middle"))
    measured = np.array(pose.markers)
    base = pose.positions[h.POINTS.index("index_mcp")]
    measured[index] = 2 * base - measured[index]
    measured[middle] = pose.positions[h.POINTS.index("middle_mcp")]
    local = aligned(side, GLOVE, pose, measured, np.ones(len(GLOVE)))
    assert np.isfinite(local).all()
    found = again(side, GLOVE, local, (EYE, ORIGIN))
    assert_allclose(found.markers[index], measured[index], atol=10 * side.metres)
    assert_allclose(local[6:9], pose.local[6:9], rtol=0, atol=side.metres)


def test_a_bent_finger_comes_where_one_rotation_at_its_base_does_not_bring_it(side: Side) -> None:
    """From estimates that are off by some 10° at each joint."""
    rng = np.random.default_rng(0)
    middle, reach = (LOW + HIGH) / 2, 0.6 * (HIGH - LOW) / 2
    true = middle + rng.uniform(-1, 1, (200, 26)) * reach
    guess = true + np.radians(10) * rng.standard_normal(true.shape)
    still = np.broadcast_to(EYE, (200, 3, 3)), np.zeros((200, 3))
    pose, truth = posed(side, GLOVE, guess, still), posed(side, GLOVE, true, still)
    weight = np.ones((200, len(GLOVE)))
    turned = side.skeleton.align_fingers(GLOVE, *pose[:3], truth.markers, weight)
    stiff = again(side, GLOVE, turned, still)
    bent = again(side, GLOVE, aligned(side, GLOVE, pose, truth.markers, weight), still)
    ends = GLOVE.end_markers[0]
    before, after = (
        np.linalg.norm((p.markers - truth.markers)[:, ends], axis=-1).mean(0) for p in (stiff, bent)
    )
    assert (after < before / 2).all()
    assert_array_equal(
        side.skeleton.bend_fingers(GLOVE, *pose[:3], truth.markers, weight)[:, ::3],
        pose.local[:, ::3],
    )


@given(angles=joint_angles(0.8), other=joint_angles(0.8), motion=motions())
def test_alignment_turns_with_the_hand_and_is_the_same_on_all_sides(
    side: Side, angles: Array, other: Array, motion: tuple[Array, Array]
) -> None:
    def at(which: Side, motion: tuple[Array, Array]) -> Array:
        pose = posed(which, GLOVE, angles, motion)
        measured = posed(which, GLOVE, other, motion).markers
        return aligned(which, GLOVE, pose, measured, np.ones(len(GLOVE)))

    still = at(side, (EYE, ORIGIN))
    tolerance = 1e-7 if side.dtype == np.float64 else 1e-3
    assert_allclose(at(side, motion), still, rtol=0, atol=tolerance)
    assert_allclose(still, at(REFERENCE, (EYE, ORIGIN)), rtol=0, atol=tolerance)


@given(angles=joint_angles(), flat=joint_angles(0.3))
def test_calibrated_by_a_flat_hand_that_hand_is_flat(
    side: Side, angles: Array, flat: Array
) -> None:
    rotations, held = (side.skeleton.rotations_from_angles(a) for a in (angles, flat))
    calibrated = side.skeleton.flat_calibrated(held, held)
    assert_allclose(calibrated, np.broadcast_to(EYE, (15, 3, 3)), atol=side.metres)
    assert_allclose(held @ side.skeleton.flat_calibrated(rotations, held), rotations, atol=1e-5)
