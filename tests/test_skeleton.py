"""Laws of the skeleton, on both packages and in both precisions."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from conftest import REFERENCE, Side
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.testing import assert_allclose
from strategies import HIGH, LOW, Array, joint_angles, motions, turn

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


NEAR_RIGHT_ANGLES = st.builds(
    lambda quarter, exponent, off: quarter * np.pi / 2 + off * 10.0**exponent,
    *(st.integers(-4, 4), st.integers(-9, -1), st.floats(-1, 1)),
)


@given(
    angles=hnp.arrays(
        float, 26, elements=st.floats(-7, 7, width=16) | NEAR_RIGHT_ANGLES, fill=st.nothing()
    )
)
def test_rotations_come_back_from_their_angles(side: Side, angles: Array) -> None:
    # Out of range, and at and near ±90° of abduction, the angles may differ, not what they do.
    rotations = side.skeleton.rotations_from_angles(angles)
    full = [j for j in range(15) if sum(a.joint == h.JOINTS[j + 1] for a in h.ANGLES) == 3]
    again = side.skeleton.rotations_from_angles(side.skeleton.angles_from_rotations(rotations))
    assert_allclose(again[full], rotations[full], rtol=0, atol=16 * np.finfo(again.dtype).eps)


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


@given(angles=joint_angles(), flat=joint_angles(0.3))
def test_calibrated_by_a_flat_hand_that_hand_is_flat(
    side: Side, angles: Array, flat: Array
) -> None:
    rotations, held = (side.skeleton.rotations_from_angles(a) for a in (angles, flat))
    calibrated = side.skeleton.flat_calibrated(held, held)
    assert_allclose(calibrated, np.broadcast_to(EYE, (15, 3, 3)), atol=side.metres)
    assert_allclose(held @ side.skeleton.flat_calibrated(rotations, held), rotations, atol=1e-5)


def test_where_angles_put_the_points_has_a_gradient_flat_hand_included() -> None:
    jax = pytest.importorskip("jax")
    from jaxhand import skeleton

    dtype = np.float32
    bones, still = HAND.skeleton.astype(dtype), (EYE.astype(dtype), np.zeros(3, dtype))

    def reach(angles: Array) -> Array:
        rotations = skeleton.rotations_from_angles(angles)
        return (skeleton.forward_kinematics(bones, rotations, *still)[0] ** 2).sum()

    for angles in (np.zeros(26, dtype), (0.3 * HIGH).astype(dtype)):
        slope = np.asarray(jax.grad(reach)(angles))
        step = 1e-2 * np.eye(26, dtype=dtype)
        measured = [float(reach(angles + s) - reach(angles - s)) / 2e-2 for s in step]
        assert_allclose(slope, measured, atol=1e-4)
