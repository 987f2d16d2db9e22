"""A hand as data: what is bundled, what is refused, and the tables."""

from __future__ import annotations

import copy
import json
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from numpy_infer import hand as h

GLOVE9 = h.load_hand("glove9")
FLAT = dict(zip(h.POINTS, h.flat_points(GLOVE9.skeleton), strict=True))


def as_json() -> dict[str, Any]:
    return copy.deepcopy(GLOVE9.to_json())


# -- what is bundled ---------------------------------------------------------------------------


def test_the_bundled_hands_are_there() -> None:
    assert {"glove9", "dense19", "qualisys13"} <= set(h.bundled())


@pytest.mark.parametrize("name", h.bundled())
def test_a_hand_comes_back_from_json_bit_for_bit(name: str, tmp_path: Path) -> None:
    hand = h.load_hand(name)
    file = tmp_path / "hand.json"
    file.write_text(json.dumps(hand.to_json()), "utf-8")
    back = h.load_hand(file)
    assert hand.name == name
    for field in ("name", "markers", "joints", "links", "alignment", "sources"):
        assert getattr(back, field) == getattr(hand, field)
    for field in ("offsets", "skeleton", "template"):
        assert_array_equal(getattr(back, field), getattr(hand, field), strict=True)


@pytest.mark.parametrize("name", h.bundled())
def test_a_bundled_hand_is_whole(name: str) -> None:
    hand = h.load_hand(name)
    count = len(hand)
    assert len(hand.markers) == len(set(hand.markers)) == count
    assert hand.offsets.shape == hand.template.shape == (count, 3)
    assert hand.skeleton.shape == (21, 3)
    assert hand.sources
    assert_array_equal(np.flatnonzero(hand.alignment_weight), sorted(hand.alignment))
    # Metres: nothing of a hand is farther than 30 cm from its wrist, no marker 8 cm off its joint.
    assert np.abs(hand.template).max() < 0.3
    assert np.linalg.norm(hand.offsets, axis=-1).max() < 0.08


def test_glove9_has_the_papers_markers_in_the_papers_order() -> None:
    assert GLOVE9.markers == (
        "pinky_base",
        "wrist",
        "index_base",
        "ring_tip",
        "pinky_tip",
        "index_tip",
        "middle_tip",
        "thumb_joint2",
        "thumb_tip",
    )
    assert [GLOVE9.markers[i] for i in GLOVE9.alignment] == ["pinky_base", "wrist", "index_base"]


# -- what is refused ---------------------------------------------------------------------------

REFUSALS = {
    "format": (lambda d: d.update(format="other"), "'other'"),
    "version": (lambda d: d.update(version=2), "version 2"),
    "missing key": (lambda d: d.pop("skeleton"), "lacks 'skeleton'"),
    "missing name": (lambda d: d.pop("name"), "lacks 'name'"),
    "unknown key": (lambda d: d.update(colour="red"), "'colour'"),
    "marker's missing key": (lambda d: d["markers"][0].pop("offset"), "lacks 'offset'"),
    "marker's unknown key": (lambda d: d["markers"][0].update(size=1), "'size'"),
    "marker not an object": (lambda d: d["markers"].append(3), "int"),
    "markers not a list": (lambda d: d.update(markers={}), "'markers'"),
    "markers none": (lambda d: d.update(markers=None), "'markers'"),
    "unknown joint": (lambda d: d["markers"][2].update(joint="elbow"), "index_base.*'elbow'"),
    "joint a list": (lambda d: d["markers"][2].update(joint=["wrist"]), "index_base"),
    "unknown link": (lambda d: d["markers"][2].update(link="elbow"), "index_base.*'elbow'"),
    "link of another finger": (
        lambda d: d["markers"][2].update(link="pinky_mcp"),
        "index_base.*not on the finger of its link 'pinky_mcp'",
    ),
    "joint of no finger on a finger's link": (
        lambda d: d["markers"][2].update(joint="wrist", link="index_mcp"),
        "index_base.*'wrist' is not on the finger",
    ),
    "link a tip": (lambda d: d["markers"][2].update(link="index_tip"), "index_base.*'index_tip'"),
    "duplicate marker": (lambda d: d["markers"][1].update(name="index_base"), "'index_base'"),
    "offset short": (lambda d: d["markers"][3].update(offset=[0, 0]), "'ring_tip'.*3 numbers"),
    "offset words": (lambda d: d["markers"][3].update(offset=["a", 0, 0]), "'ring_tip'"),
    "offset missing": (lambda d: d["markers"][3].update(offset=None), "'ring_tip'"),
    "offset ragged": (lambda d: d["markers"][3].update(offset=[[0], 0, 0]), "'ring_tip'"),
    "offset nan": (lambda d: d["markers"][3].update(offset=[0, np.nan, 0]), "'ring_tip'.*finite"),
    "offset text": (lambda d: d["markers"][3].update(offset=["0", 0, 0]), "'ring_tip'"),
    "offset bool": (lambda d: d["markers"][3].update(offset=[True, 0, 0]), "'ring_tip'"),
    "offset huge": (lambda d: d["markers"][3].update(offset=[10**400, 0, 0]), "'ring_tip'"),
    "millimetres": (lambda d: d["markers"][3].update(offset=[0, 12.5, 0]), "'ring_tip'.*metres"),
    "skeleton inf": (lambda d: d["skeleton"].update(ring_pip=[0, np.inf, 0]), "'ring_pip'"),
    "skeleton short": (lambda d: d["skeleton"].update(ring_pip=[0]), "'ring_pip'.*3 numbers"),
    "skeleton lacks": (lambda d: d["skeleton"].pop("ring_pip"), "lacks 'ring_pip'"),
    "skeleton surplus": (lambda d: d["skeleton"].update(elbow=[0, 0, 0]), "'elbow'"),
    "skeleton unknown": (lambda d: d.update(skeleton="giant"), "'giant'"),
    "skeleton escapes": (lambda d: d.update(skeleton="../glove9"), "glove9"),
    "skeleton a list": (lambda d: d.update(skeleton=[]), "list"),
    "template short": (lambda d: d["template"].pop(), "9 points"),
    "template nan": (lambda d: d["template"].__setitem__(4, [0, 0, np.nan]), "'pinky_tip'"),
    "template a number": (lambda d: d.update(template=3), "template"),
    "alignment unknown": (lambda d: d["alignment"].append("thumb"), "'thumb'"),
    "alignment short": (lambda d: d["alignment"].pop(), "3 or more"),
    "alignment duplicate": (lambda d: d["alignment"].append("wrist"), "3 or more.*'wrist'"),
    "alignment a number": (lambda d: d.update(alignment=3), "'alignment'"),
    "alignment of lists": (lambda d: d.update(alignment=[["wrist"]] * 3), "wrist"),
    "sources a number": (lambda d: d.update(sources=3), "'sources'"),
    "name a number": (lambda d: d.update(name=3), "'name'"),
    "marker's name a number": (lambda d: d["markers"][0].update(name=3), "3"),
    "collinear": (
        lambda d: d.update(template=[[0, 0, 0.01 * i] for i in range(9)]),
        "pinky_base.*collinear",
    ),
}


@pytest.mark.parametrize("case", REFUSALS)
def test_a_refusal_names_the_culprit(case: str) -> None:
    spoil, culprit = REFUSALS[case]
    data = as_json()
    spoil(data)
    with pytest.raises(ValueError, match=rf"(?s){culprit}"):
        h.hand_from_json(data)


@pytest.mark.parametrize("number", ["NaN", "Infinity", "-Infinity", "1e999"])
def test_a_number_that_is_not_finite_is_refused_with_the_files_name(
    number: str, tmp_path: Path
) -> None:
    file = tmp_path / "mine.json"
    data = as_json()
    data["markers"][5]["offset"] = ["NUMBER", 0, 0]
    file.write_text(json.dumps(data).replace('"NUMBER"', number), "utf-8")
    with pytest.raises(ValueError, match=r"mine\.json.*'index_tip'.*finite"):
        h.load_hand(file)


def test_an_unknown_hand_is_refused_with_the_names_there_are() -> None:
    with pytest.raises(ValueError, match=r"'glove10'.*glove9"):
        h.load_hand("glove10")


@pytest.mark.parametrize("content", [b"", b"{", b"[1, 2", b"\xff\xfe\x00", b"null", b"[" * 5000])
def test_a_file_that_is_no_hand_is_a_value_error(content: bytes, tmp_path: Path) -> None:
    file = tmp_path / "broken.json"
    file.write_bytes(content)
    with pytest.raises(ValueError, match=r"broken\.json"):
        h.load_hand(file)


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: (
        st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=4)
    ),
    max_leaves=8,
)


@given(data=JSON)
def test_any_json_that_is_no_hand_is_a_value_error(data: Any) -> None:
    with pytest.raises(ValueError, match=r"\w"):
        h.hand_from_json(data)


@given(data=st.data(), value=JSON)
def test_a_hand_with_any_json_in_any_place_is_read_or_a_value_error(
    data: st.DataObject, value: Any
) -> None:
    spoiled = as_json()
    where: Any = spoiled
    while True:
        keys = list(where) if isinstance(where, dict) else list(range(len(where)))
        key = data.draw(st.sampled_from(keys))
        deeper = isinstance(where[key], dict | list) and where[key] and data.draw(st.booleans())
        if not deeper:
            where[key] = value
            break
        where = where[key]
    try:
        hand = h.hand_from_json(spoiled)
    except ValueError:
        return
    assert np.isfinite(hand.template).all()
    assert json.dumps(hand.to_json())


# -- bones -------------------------------------------------------------------------------------


@given(size=st.floats(0.5, 2, width=16))
def test_the_template_follows_the_skeleton(size: float) -> None:
    hand = GLOVE9.with_skeleton(size * GLOVE9.skeleton)
    joints = h.flat_points(size * GLOVE9.skeleton)[list(GLOVE9.joints)]
    assert_allclose(hand.template - hand.offsets, joints, atol=1e-12)
    for bone, length in hand.bone_lengths.items():
        assert_allclose(length, size * GLOVE9.bone_lengths[bone])
    assert hand.markers == GLOVE9.markers


def test_bones_that_are_not_finite_are_refused() -> None:
    skeleton = GLOVE9.skeleton.copy()
    skeleton[4, 1] = np.nan
    with pytest.raises(ValueError, match="index_mcp"):
        GLOVE9.with_skeleton(skeleton)


@pytest.mark.parametrize("shape", [(20, 3), (21, 2), (63,), (22, 3)])
def test_bones_of_a_wrong_shape_are_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match=r"21"):
        GLOVE9.with_skeleton(np.zeros(shape))


def test_the_flat_hand_is_a_left_hand_from_above() -> None:
    assert_array_equal(FLAT["wrist"], 0)
    across = [FLAT[f"{finger}_mcp"][0] for finger in h.FINGERS]
    assert across == sorted(across, reverse=True), "thumb at +x, then index to little finger"
    for finger in h.FINGERS:
        chain = [FLAT[h.POINTS[i]] for i in h.CHAINS[h.FINGERS.index(finger)]]
        forward = [point[2] for point in chain]
        assert forward == sorted(forward, reverse=True), "fingers point to -z"
    assert np.argmin([FLAT[tip][2] for tip in h.TIPS]) == h.FINGERS.index("middle")
    # Markers glued on the back of the hand stand at +y.
    assert GLOVE9.template[GLOVE9.markers.index("wrist")][1] > 0
    assert max(abs(point[1]) for point in FLAT.values()) < 0.03, "it is flat"


# -- tables ------------------------------------------------------------------------------------


def test_the_skeletons_tables_agree() -> None:
    assert (len(h.JOINTS), len(h.TIPS), len(h.POINTS), len(h.PARENTS)) == (16, 5, 21, 21)
    assert len(set(h.POINTS)) == 21
    assert h.PARENTS[0] == -1
    assert all(parent < i for i, parent in enumerate(h.PARENTS)), "parents come first"
    for finger, chain in zip(h.FINGERS, h.CHAINS, strict=True):
        assert all(h.POINTS[i].startswith(finger) for i in chain)
        assert h.POINTS[chain[3]] == f"{finger}_tip"
        assert [h.PARENTS[i] for i in chain] == [0, *chain[:3]]


def test_the_26_angles_are_distinct_and_in_range() -> None:
    assert len(h.ANGLES) == len({angle.name for angle in h.ANGLES}) == 26
    assert len({(angle.joint, angle.axis) for angle in h.ANGLES}) == 26
    for angle in h.ANGLES:
        assert angle.name.startswith(angle.joint)
        assert angle.joint in h.JOINTS[1:]
        assert angle.sign in (-1, 1)
        low, high = angle.range_deg
        assert -90 < low < 0 < high < 180
        # Only flexion may pass a right angle: the middle one of three angles must not.
        assert angle.axis == "x" or high < 90
    # The paper: 3 + 1 + 1 for each finger, 3 + 2 + 1 for the thumb.
    counts = [sum(angle.joint == joint for angle in h.ANGLES) for joint in h.JOINTS[1:]]
    assert counts == [3, 2, 1] + [3, 1, 1] * 4
    # Angles are read back as those of Rx Ry Rz: each joint's must stand in that order.
    for joint in h.JOINTS[1:]:
        axes = [angle.axis for angle in h.ANGLES if angle.joint == joint]
        assert axes == sorted(axes)


def test_the_thumbs_axes_are_a_rotation() -> None:
    axes = np.array(h.THUMB_AXES)
    assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(axes) > 0


# -- OpenXR ------------------------------------------------------------------------------------

# XrHandJointEXT, OpenXR 1.0, section XR_EXT_hand_tracking.
OPENXR_ENUM = {
    "PALM": 0,
    "WRIST": 1,
    "THUMB_METACARPAL": 2,
    "THUMB_PROXIMAL": 3,
    "THUMB_DISTAL": 4,
    "THUMB_TIP": 5,
    "INDEX_METACARPAL": 6,
    "INDEX_PROXIMAL": 7,
    "INDEX_INTERMEDIATE": 8,
    "INDEX_DISTAL": 9,
    "INDEX_TIP": 10,
    "MIDDLE_METACARPAL": 11,
    "MIDDLE_PROXIMAL": 12,
    "MIDDLE_INTERMEDIATE": 13,
    "MIDDLE_DISTAL": 14,
    "MIDDLE_TIP": 15,
    "RING_METACARPAL": 16,
    "RING_PROXIMAL": 17,
    "RING_INTERMEDIATE": 18,
    "RING_DISTAL": 19,
    "RING_TIP": 20,
    "LITTLE_METACARPAL": 21,
    "LITTLE_PROXIMAL": 22,
    "LITTLE_INTERMEDIATE": 23,
    "LITTLE_DISTAL": 24,
    "LITTLE_TIP": 25,
}


def test_openxrs_joints_stand_in_the_order_of_its_enum() -> None:
    names = [f"XR_HAND_JOINT_{name}_EXT" for name in sorted(OPENXR_ENUM, key=OPENXR_ENUM.get)]
    assert list(h.OPENXR_ORDER) == names


def test_each_of_our_points_is_an_openxr_joint() -> None:
    assert set(h.OPENXR) == set(h.POINTS)
    assert len(set(h.OPENXR.values())) == 21
    left_out = {f"XR_HAND_JOINT_{f}_METACARPAL_EXT" for f in ("INDEX", "MIDDLE", "RING", "LITTLE")}
    assert set(h.OPENXR_ORDER) - set(h.OPENXR.values()) == left_out | {"XR_HAND_JOINT_PALM_EXT"}
    # Along a finger, OpenXR's numbers grow as ours do.
    for chain in h.CHAINS:
        values = [h.OPENXR_ORDER.index(h.OPENXR[h.POINTS[i]]) for i in chain]
        assert values == list(range(values[0], values[0] + 4))


@pytest.mark.parametrize("finger", h.FINGERS)
def test_openxrs_axes_lie_along_the_bones_with_y_dorsal(finger: str) -> None:
    chain = h.CHAINS[h.FINGERS.index(finger)]
    for joint, child in pairwise(chain):
        axes = h.openxr_axes(h.POINTS[joint])
        bone = GLOVE9.skeleton[child] / np.linalg.norm(GLOVE9.skeleton[child])
        assert np.degrees(np.arccos(min(1.0, -axes[:, 2] @ bone))) < 1
        assert axes[1, 1] > 0.5, "y points out of the back of the hand"
        assert_allclose(axes.T @ axes, np.eye(3), atol=1e-12)
        assert np.linalg.det(axes) > 0


def test_openxrs_wrist_is_the_hand_frame() -> None:
    assert_array_equal(h.openxr_axes("wrist"), np.eye(3))
