"""A calibration changes bones, wrist and flat pose of the joints, and the size of the markers."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from streams import Stream, a_model, motion, restless, run

from numpy_infer import HandTracker, load_hand, model, tracker, wearer
from numpy_infer.geometry import kabsch, rotation_from_vector, transform
from numpy_infer.hand import ANGLES
from numpy_infer.skeleton import rotations_from_angles
from numpy_infer.wearer import Wearer

GLOVE = load_hand("glove9")
LARGER = GLOVE.with_skeleton(1.1 * GLOVE.skeleton)
FLAT = np.linspace(-0.3, 0.4, len(ANGLES))


@pytest.mark.parametrize("flat", [None, FLAT])
def test_a_calibration_reads_back(flat: Any, tmp_path: Path) -> None:
    wearer.save(Wearer(LARGER, flat, ("ring", "pinky")), tmp_path / "me.json")
    back = wearer.load(tmp_path / "me.json")
    assert_array_equal(back.hand.skeleton, LARGER.skeleton)
    assert_array_equal(back.hand.offsets, LARGER.offsets)
    assert_array_equal(back.hand.template, LARGER.template)
    assert back.unseen == ("ring", "pinky")
    assert (back.flat is None) == (flat is None)
    if flat is not None:
        assert_array_equal(back.flat, flat)
    with pytest.raises(ValueError, match="overwrite"):
        wearer.save(back, tmp_path / "me.json")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda d: d.pop("flat"), "expected an object with"),
        (lambda d: d.update(version=2), "version 1, found"),
        (lambda d: d.update(flat={"index_mcp_flexion": 0.1}), "'flat': expected the 26 angles"),
        (lambda d: d["flat"].update(index_mcp_twist=float("nan")), "'flat': expected radians"),
        (lambda d: d["flat"].update(index_mcp_twist="1"), "'flat': expected radians"),
        (lambda d: d.update(unseen=["nose"]), "'unseen': expected fingers"),
        (lambda d: d["hand"]["markers"].pop(), "alignment marker|template"),
    ],
)
def test_what_is_wrong_in_a_file_is_named(change: Any, message: str, tmp_path: Path) -> None:
    path = tmp_path / "me.json"
    wearer.save(Wearer(LARGER, FLAT), path)
    data = json.loads(path.read_text())
    change(data)
    path.write_text(json.dumps(data))
    with pytest.raises(ValueError, match=message) as error:
        wearer.load(path)
    assert str(error.value).startswith(str(path))


@pytest.mark.parametrize("content", ["", "[]", "{", '"x"', "[" * 100_000])
def test_what_is_no_calibration_is_a_value_error(content: str, tmp_path: Path) -> None:
    (tmp_path / "me.json").write_text(content)
    with pytest.raises(ValueError, match=r"me\.json") as error:
        wearer.load(tmp_path / "me.json")
    assert ("me.json:1: not JSON: Expecting" in str(error.value)) == (content in ("", "{"))
    with pytest.raises(ValueError, match="no calibration file"):
        wearer.load(tmp_path / "nobody.json")


def test_another_gloves_calibration_is_refused() -> None:
    with pytest.raises(ValueError, match="wearer's markers"):
        wearer.calibrated(a_model("affine"), Wearer(load_hand("dense19")))


def test_a_calibrated_model_is_not_saved_as_a_model(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="save the model, and the calibration"):
        model.save(wearer.calibrated(a_model("affine"), Wearer(LARGER)), tmp_path / "m.npz")


def stream() -> Stream:
    rng = np.random.default_rng(2)
    truth = motion(LARGER, rng, 40, 2)
    return Stream(truth, restless(rng, truth.shape[:-1]), np.full(truth.shape[:2], 1 / 60))


def test_markers_do_not_change_with_the_wearers_proportions() -> None:
    plain = a_model("learned", joints=True)
    lengths = np.random.default_rng(3).uniform(0.9, 1.1, (len(GLOVE.skeleton), 1))
    other = GLOVE.with_skeleton(lengths * GLOVE.skeleton)
    same_size = other.with_skeleton(other.skeleton * GLOVE.size / other.size)
    own = wearer.calibrated(plain, Wearer(same_size, FLAT))
    one, other = run(plain, stream())[0], run(own, stream())[0]
    assert_allclose(one.markers, other.markers, rtol=0, atol=1e-6)
    assert_array_equal(one.status, other.status)
    assert np.abs(one.positions - other.positions).max() > 1e-3


def test_a_larger_hand_that_is_known_to_be_is_the_same_hand() -> None:
    # Without what knows of metres: the blend and its speed, the alignment and its doubt of the
    # thumb's marker; and with enough markers seen, for what is too near a line is a matter of mm.
    model = replace(a_model("learned", joints=True), continuity=False, alignment=False)
    one, rng = stream(), np.random.default_rng(7)
    hidden = rng.permuted(np.arange(len(GLOVE)) < 2, axis=-1)
    one = one._replace(visible=np.broadcast_to(~hidden, one.visible.shape))
    factor = 1.2
    larger = wearer.worn_by(model, GLOVE.resized(factor))
    pose, _ = run(model, one)
    scaled, _ = run(larger, one._replace(truth=factor * one.truth))
    assert_allclose(scaled.markers, factor * pose.markers, rtol=0, atol=1e-5)
    assert_allclose(scaled.positions, factor * pose.positions, rtol=0, atol=1e-5)
    assert_allclose(scaled.angles, pose.angles, rtol=0, atol=1e-4)
    assert_allclose(scaled.wrist_position, factor * pose.wrist_position, rtol=0, atol=1e-5)


@pytest.mark.parametrize("hidden", [(), ("thumb_tip",), ("wrist",)])
def test_the_wrist_is_where_the_wearers_markers_have_it(hidden: tuple[str, ...]) -> None:
    """Whichever way it is found: beside the registration, or by itself once all is filled."""
    lengths = np.random.default_rng(3).uniform(0.7, 1.3, (len(GLOVE.skeleton), 1))
    model = wearer.worn_by(a_model("last_known"), GLOVE.with_skeleton(lengths * GLOVE.skeleton))
    assert np.abs(model.body.template - model.hand.template)[GLOVE.aligned].max() > 2e-3
    rotation, position = rotation_from_vector(np.array([0.3, -0.5, 0.8])), np.array([1, 2, 3.0])
    live = HandTracker(model)
    markers = transform(rotation, position, model.body.template)
    live.step(markers, 1 / 60)
    pose = live.step(markers, 1 / 60, ~np.isin(GLOVE.markers, hidden))
    assert_allclose(pose.wrist_rotation, rotation, rtol=0, atol=1e-7)
    assert_allclose(pose.wrist_position, position, rtol=0, atol=1e-7)


def test_what_alignment_markers_near_a_line_leave_open_of_the_wrist_follows_the_others() -> None:
    model, markers = wearer.worn_by(a_model("last_known"), LARGER), LARGER.template.copy()
    first, second, *others = GLOVE.aligned
    along = markers[second] - markers[first]
    for i in others:
        markers[i] = markers[first] + along * 0.4 + 1e-5
    state = tracker.init(model)
    dt, seen = np.array(1 / 60), np.ones(len(GLOVE), bool)
    for _ in range(2):
        state, pose = tracker.step(model, state, markers, seen, dt)
        wanted = kabsch(LARGER.template, markers, GLOVE.alignment_weight, state.rotation)
        assert_allclose(pose.wrist_rotation, wanted[0], rtol=0, atol=1e-6)
        assert_allclose(pose.wrist_position, wanted[1], rtol=0, atol=1e-6)


def test_one_wearer_after_another_is_the_other_alone() -> None:
    plain = a_model("learned", joints=True)
    both = wearer.worn_by(wearer.worn_by(plain, GLOVE.resized(0.8)), LARGER)
    one, other = run(wearer.worn_by(plain, LARGER), stream())[0], run(both, stream())[0]
    assert_allclose(other.markers, one.markers, rtol=0, atol=1e-5)
    assert_allclose(other.positions, one.positions, rtol=0, atol=1e-5)


def test_joints_stand_on_the_wearers_bones() -> None:
    own = wearer.calibrated(a_model("learned", joints=True), Wearer(LARGER))
    pose, _ = run(own, stream())
    bone = np.linalg.norm(pose.positions[..., 5, :] - pose.positions[..., 4, :], axis=-1)
    assert_allclose(bone, LARGER.bone_lengths["index_pip"], rtol=1e-6)


def test_the_same_bones_change_nothing() -> None:
    plain = a_model("learned", joints=True)
    same = wearer.calibrated(plain, Wearer(plain.hand))
    one, other = run(plain, stream())[0], run(same, stream())[0]
    assert_allclose(other.positions, one.positions, rtol=0, atol=1e-6)
    assert_allclose(other.rotations, one.rotations, rtol=0, atol=1e-6)


def test_a_hand_held_as_it_was_when_flat_is_flat(tmp_path: Path) -> None:
    plain = replace(a_model("learned", joints=True), alignment=False)
    markers = motion(GLOVE, np.random.default_rng(4), 1, 1)[0, 0]
    held = HandTracker(plain).step(markers, 1 / 60)
    model.save(plain, tmp_path / "m.npz")
    wearer.save(Wearer(GLOVE, held.angles), tmp_path / "me.json")
    tracker = HandTracker.load(tmp_path / "m.npz", calibration=tmp_path / "me.json")
    pose = tracker.step(markers, 1 / 60)
    assert_allclose(pose.angles, 0, atol=1e-4)
    # In the parent's frame: the inverse of the flat rotation, composed onto what is predicted.
    assert_allclose(
        rotations_from_angles(pose.angles), np.broadcast_to(np.eye(3), (15, 3, 3)), atol=1e-4
    )
