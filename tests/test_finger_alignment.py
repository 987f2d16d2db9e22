"""Laws of finger alignment, on both packages and in both precisions."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest
from conftest import REFERENCE, Side
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from strategies import HIGH, LOW, Array, joint_angles, motions, weights

from numpy_infer import hand as h

GLOVE = h.load_hand("glove9")
EYE, ORIGIN = np.eye(3), np.zeros(3)
FLAT = np.zeros(len(h.ANGLES))


def with_markers_on_last_phalanges() -> h.Hand:
    """The bundled glove, its tip markers in the middle of the last phalanges."""
    data = GLOVE.to_json()
    del data["template"]
    for marker in data["markers"]:
        if marker["name"].endswith("_tip"):
            bone = GLOVE.skeleton[h.POINTS.index(marker["name"])]
            marker["offset"] = (-bone / 2).tolist()
    return h.hand_from_json(data)


def with_bare_fingers() -> h.Hand:
    """The bundled glove without markers on thumb and ring finger, and the middle finger's on its
    middle phalanx."""
    data = GLOVE.to_json()
    del data["template"]
    data["markers"] = [
        marker for marker in data["markers"] if marker["name"] not in ("thumb_tip", "ring_tip")
    ]
    for marker in data["markers"]:
        if marker["name"] == "middle_tip":
            marker.update(joint="middle_pip", link="middle_pip", offset=[0.002, 0.008, -0.012])
    return h.hand_from_json(data)


HANDS = {
    **{name: h.load_hand(name) for name in h.bundled()},
    "phalanges": with_markers_on_last_phalanges(),
    "bare": with_bare_fingers(),
}


class Placed(NamedTuple):
    """A hand at rest, and its own markers."""

    angles: Array
    positions: Array
    rotations: Array
    markers: Array


def placed(side: Side, hand: h.Hand, angles: Array, markers: Array | None = None) -> Placed:
    """At angles, with fingers turned towards `markers`; its markers on what came of it."""
    arguments = (hand, angles) if markers is None else (hand, angles, markers)
    found = side.skeleton.place_fingers(*arguments)
    return Placed(*found, side.skeleton.marker_positions(hand, *found[1:]))


def aligned(side: Side, hand: h.Hand, angles: Array, markers: Array) -> Placed:
    """Bent, then turned, as the pipeline has it."""
    return placed(side, hand, side.skeleton.bend_fingers(hand, angles, markers), markers)


@pytest.mark.parametrize("name", HANDS)
@given(angles=joint_angles())
def test_placed_fingers_are_what_forward_kinematics_makes_of_their_angles(
    side: Side, name: str, angles: Array
) -> None:
    hand = HANDS[name]
    found = placed(side, hand, angles)
    rotations = side.skeleton.rotations_from_angles(angles)
    positions, turns = side.skeleton.forward_kinematics(hand.skeleton, rotations)
    assert_array_equal(found.angles, side.cast(angles))
    assert_allclose(found.positions, positions, rtol=0, atol=side.metres)
    assert_allclose(found.rotations, turns, rtol=0, atol=side.metres)


@given(angles=joint_angles(), other=joint_angles(), far=st.floats(1, 1e7))
def test_angles_that_are_no_hands_make_rotations(
    side: Side, angles: Array, other: Array, far: float
) -> None:
    """As a network may give them that was shown no hand."""
    exact = placed(side, GLOVE, other)
    for markers in (None, exact.markers):
        turns = placed(side, GLOVE, far * angles, markers).rotations.astype(float)
        assert_allclose(turns @ turns.swapaxes(-1, -2), EYE + 0 * turns, rtol=0, atol=side.metres)


@pytest.mark.parametrize("name", HANDS)
@given(angles=joint_angles())
def test_alignment_leaves_exact_joints_as_they_are(side: Side, name: str, angles: Array) -> None:
    hand = HANDS[name]
    exact = placed(side, hand, angles)
    found = aligned(side, hand, angles, exact.markers)
    # float32: of a straight finger the distance says little of its flexion
    tolerance = 1e-7 if side.dtype == np.float64 else 1e-4
    assert_allclose(found.rotations, exact.rotations, rtol=0, atol=tolerance)
    assert_allclose(found.positions, exact.positions, rtol=0, atol=tolerance)


@pytest.mark.parametrize("name", HANDS)
@given(angles=joint_angles(0.8), other=joint_angles(0.8))
def test_an_aligned_finger_points_to_its_marker_and_is_turned_as_little_as_can_be(
    side: Side, name: str, angles: Array, other: Array
) -> None:
    hand = HANDS[name]
    before = placed(side, hand, angles)
    measured = placed(side, hand, other).markers
    found = placed(side, hand, angles, measured)
    back = side.skeleton.rotations_from_angles(found.angles)
    for finger in range(5):
        base, joint = before.positions[1 + 3 * finger], 1 + 3 * finger
        own = slice(joint, joint + 3)
        if not hand.finger_markers[finger]:
            assert_allclose(found.rotations[own], before.rotations[own], rtol=0, atol=side.metres)
            continue
        end = hand.finger_markers[finger][-1]
        want, have = measured[end] - base, found.markers[end] - base
        crossed = np.linalg.norm(np.cross(want, have))
        assert crossed / np.linalg.norm(want) < 10 * side.metres
        assert want @ have > 0
        was = before.markers[end] - base
        angle = np.arctan2(np.linalg.norm(np.cross(was, want)), was @ want)
        turned = found.rotations[joint].astype(float) @ before.rotations[joint].T.astype(float)
        assert_allclose(np.arccos(np.clip((np.trace(turned) - 1) / 2, -1, 1)), angle, atol=2e-3)
        # All else is as it was, beyond the base.
        for beyond in (joint + 1, joint + 2):
            was_local, is_local = (
                p.rotations[joint].T @ p.rotations[beyond] for p in (before, found)
            )
            assert_allclose(is_local, was_local, rtol=0, atol=side.metres)
        assert_allclose(back[joint - 1], found.rotations[joint], rtol=0, atol=1e-3)


@given(angles=joint_angles(0.8), other=joint_angles(0.8))
def test_the_papers_middle_of_the_last_phalanx_is_a_marker_placed_there(
    side: Side, angles: Array, other: Array
) -> None:
    """p_mr = (p3 + p2) / 2, about p0, by the shortest arc (paper, section 2.2)."""
    hand = HANDS["phalanges"]
    before, measured = placed(side, hand, angles), placed(side, hand, other).markers
    found = placed(side, hand, angles, measured)
    for finger in range(1, 5):
        base, _, last, tip = h.CHAINS[finger]
        middle = (before.positions[last] + before.positions[tip]) / 2 - before.positions[base]
        target = measured[hand.finger_markers[finger][-1]] - before.positions[base]
        arc = side.geometry.shortest_arc(middle, target)
        expected = arc @ before.rotations[base]
        assert_allclose(found.rotations[base], expected, rtol=0, atol=20 * side.metres)


def test_alignment_is_defined_for_opposite_and_for_no_directions(side: Side) -> None:
    before = placed(side, GLOVE, FLAT)
    index, middle = (GLOVE.markers.index(f"{f}_tip") for f in ("index", "middle"))
    measured = np.array(before.markers)
    base = before.positions[h.POINTS.index("index_mcp")]
    measured[index] = 2 * base - measured[index]
    measured[middle] = before.positions[h.POINTS.index("middle_mcp")]
    found = placed(side, GLOVE, FLAT, measured)
    assert np.isfinite(found.rotations).all()
    assert_allclose(found.markers[index], measured[index], atol=10 * side.metres)
    assert_allclose(found.rotations[7:10], before.rotations[7:10], rtol=0, atol=side.metres)
    assert np.isfinite(aligned(side, GLOVE, FLAT, measured).rotations).all()


def test_a_bent_finger_comes_where_one_rotation_at_its_base_does_not_bring_it(side: Side) -> None:
    """From estimates that are off by some 10° at each joint."""
    rng = np.random.default_rng(0)
    middle, reach = (LOW + HIGH) / 2, 0.6 * (HIGH - LOW) / 2
    true = middle + rng.uniform(-1, 1, (200, 26)) * reach
    guess = true + np.radians(10) * rng.standard_normal(true.shape)
    truth = placed(side, GLOVE, true).markers
    ends = GLOVE.end_markers[0]
    before, after = (
        np.linalg.norm((align(side, GLOVE, guess, truth).markers - truth)[:, ends], axis=-1).mean(0)
        for align in (placed, aligned)
    )
    assert (after < before / 2).all()
    bent = side.skeleton.bend_fingers(GLOVE, guess, truth)
    flexed = [angle.name.endswith(("pip_flexion", "dip_flexion")) for angle in h.ANGLES]
    flexed = np.array(flexed) | np.isin(
        [angle.name for angle in h.ANGLES], ["thumb_mcp_flexion", "thumb_ip_flexion"]
    )
    assert_array_equal(bent[:, ~flexed], side.cast(guess)[:, ~flexed])
    assert (bent[:, flexed] != side.cast(guess)[:, flexed]).mean() > 0.99


@pytest.mark.parametrize("name", HANDS)
@given(angles=joint_angles(0.8), other=joint_angles(0.8))
def test_alignment_is_the_same_on_all_sides(
    side: Side, name: str, angles: Array, other: Array
) -> None:
    hand = HANDS[name]
    measured = placed(REFERENCE, hand, other).markers
    found, expected = (aligned(s, hand, angles, measured) for s in (side, REFERENCE))
    tolerance = 1e-7 if side.dtype == np.float64 else 1e-3
    assert_allclose(found.rotations, expected.rotations, rtol=0, atol=tolerance)
    assert_allclose(found.positions, expected.positions, rtol=0, atol=tolerance)


# -- of rotations that are no angles, in any frame: JAX only --------------------------------------


@pytest.fixture(params=[np.float32, np.float64], scope="session")
def jax_side(request: pytest.FixtureRequest) -> Side:
    pytest.importorskip("jax")
    return Side("jaxhand", request.param)


def in_world(side: Side, pose: Placed, motion: tuple[Array, Array]) -> tuple[Array, Array, Array]:
    """Positions, rotations and markers of a pose, carried somewhere."""
    positions, rotations = side.skeleton.in_world(pose.positions, pose.rotations, *motion)
    return positions, rotations, side.skeleton.marker_positions(GLOVE, positions, rotations)


@given(angles=joint_angles(0.8), other=joint_angles(0.8), motion=motions(), weight=weights(9))
def test_rotations_are_aligned_alike_in_any_frame_and_a_hidden_marker_cannot_matter(
    jax_side: Side, angles: Array, other: Array, motion: tuple[Array, Array], weight: Array
) -> None:
    align = jax_side.skeleton.align_fingers
    before, target = placed(jax_side, GLOVE, angles), placed(jax_side, GLOVE, other)
    still = align(GLOVE, before.positions, before.rotations, target.markers, np.ones(9))
    expected = placed(jax_side, GLOVE, angles, target.markers)
    assert_allclose(still[1], expected.rotations, rtol=0, atol=10 * jax_side.metres)
    weight = np.where(weight < 0.3, 0, weight / max(weight.max(), 0.3))
    still = align(GLOVE, before.positions, before.rotations, target.markers, weight)
    positions, rotations, _ = in_world(jax_side, before, motion)
    measured = np.where(weight[:, None] > 0, in_world(jax_side, target, motion)[2], np.nan)
    found = align(GLOVE, positions, rotations, measured, weight)
    back = motion[0].T @ found[1]
    tolerance = 1e-7 if jax_side.dtype == np.float64 else 1e-3
    assert_allclose(back, still[1], rtol=0, atol=tolerance)
    for finger, own in enumerate(GLOVE.finger_markers):
        if weight[own[-1]] == 0:
            joints = slice(1 + 3 * finger, 4 + 3 * finger)
            assert_allclose(still[1][joints], before.rotations[joints], rtol=0, atol=1e-5)
