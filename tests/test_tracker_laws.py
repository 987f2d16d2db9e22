"""The tracker's promises, crossed over predictors, layouts and precisions; continuity is in
`test_continuity`, JAX = numpy in `test_tracker_parity`."""

from __future__ import annotations

import importlib
import pickle
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cases import CASES, FEW, Case, crossed, each
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from streams import a_model, assert_same_bits, blocks, leaves, motion, moved, restless, run, seeds

from jaxhand import laws
from jaxhand.strategies import Motion, Stream, rigid_motions, turn
from jaxhand.trial import SOLID_EXTENT
from numpy_infer import tracker
from numpy_infer.geometry import mirror
from numpy_infer.model import load, save
from numpy_infer.pose import HandPose, Notice
from numpy_infer.predictors import PREDICTORS, RIDGE
from numpy_infer.tracker import HandTracker

Array = np.ndarray


# -- rigid, mirror, hidden ----------------------------------------------------------------------


@each
@FEW
@given(data=st.data(), motion=rigid_motions(1))
def test_a_rigid_motion_of_the_stream_moves_every_output_by_it_and_changes_no_angle(
    case: Case, data: st.DataObject, motion: Motion
) -> None:
    tracker = case.tracker(joints=True)
    stream = data.draw(case.streams(40, 3))
    laws.check_rigid(tracker, stream, motion, metres=case.metres, radians=case.radians)


@each
@FEW
@given(data=st.data())
def test_a_mirrored_stream_of_a_right_hand_comes_back_mirrored_bit_for_bit(
    case: Case, data: st.DataObject
) -> None:
    tracker = case.tracker(joints=True)
    stream = data.draw(case.streams(30, 2))
    laws.check_mirror(tracker, stream)


@FEW
@given(data=st.data())
def test_what_is_carried_along_is_a_left_hand_s_of_either(data: st.DataObject) -> None:
    model = Case("affine").model(joints=True)
    stream = data.draw(Case("affine").streams(30, 2))
    _, left = run(model, stream)
    _, right = run(model, stream._replace(truth=mirror(stream.truth)), right=True)
    for one, other in zip(leaves(right._replace(right=left.right)), leaves(left), strict=True):
        assert_array_equal(one, other)  # but for the sign of a zero


@each
@FEW
@given(
    data=st.data(),
    garbage=st.sampled_from([0.0, -0.0, np.inf, -np.inf, 1e30, 1e300, "noise", "mixed"]),
)
def test_what_stands_in_a_hidden_coordinate_cannot_matter_bit_for_bit(
    case: Case, data: st.DataObject, garbage: float | str
) -> None:
    tracker = case.tracker()
    stream = data.draw(case.streams(30, 2))
    rng = np.random.default_rng(data.draw(seeds()))
    shape = stream.truth.shape
    rubbish = garbage if isinstance(garbage, float) else rng.normal(size=shape)
    if garbage == "mixed":  # a hole in one coordinate, the other two as if measured
        rubbish = np.where(rng.uniform(size=shape) < 0.5, stream.truth, np.nan)
    laws.check_hidden_cannot_matter(tracker, stream, rubbish)


# -- what is measured comes back ----------------------------------------------------------------


@each
@FEW
@given(data=st.data())
def test_what_is_measured_comes_back_bit_for_bit_after_a_re_entry_once_its_correction_has_died(
    case: Case, data: st.DataObject
) -> None:
    tracker = case.tracker()
    stream = data.draw(case.streams(60, 3))
    laws.check_unchanged(tracker, stream, metres=case.metres)


# -- carried ------------------------------------------------------------------------------------


@crossed([case for case in CASES if case.predictor in ("affine", "learned")])
@FEW
@given(data=st.data())
def test_a_fixed_posture_carried_along_any_path_is_filled_exactly(
    case: Case, data: st.DataObject
) -> None:
    tracker = case.tracker()
    stream = data.draw(case.streams(40, 4))
    flat = case.predictor == "learned"
    # λ of equation 8 leaves out λ / σ² of what stands out of the plane.
    ridge = 0 if flat else 0.1 * RIDGE / SOLID_EXTENT**2
    laws.check_carried(tracker, stream, flat=flat, metres=case.metres + ridge)


# -- prefix, state, batch -----------------------------------------------------------------------


@each
@FEW
@given(data=st.data())
def test_outputs_are_causal_and_a_state_can_be_taken_up_again_bit_for_bit(
    case: Case, data: st.DataObject
) -> None:
    tracker = case.tracker(joints=True)
    stream = data.draw(case.streams(16, 2))
    laws.check_prefix(tracker, stream)
    ran = laws.run(tracker, stream)
    half = len(stream.dt) // 2
    tail = Stream(*(a[half + 1 :] for a in stream))
    if len(tail.dt):
        again = laws.run(tracker, tail, state=pickle.loads(pickle.dumps(ran.states[half])))
        assert_same_bits(again.states[-1], ran.states[-1])


@each
@FEW
@given(data=st.data())
def test_any_number_of_hands_equals_one_at_a_time_left_and_right_mixed(
    case: Case, data: st.DataObject
) -> None:
    tracker = case.tracker(joints=True)
    stream = data.draw(case.streams(12, 3))
    laws.check_batch(tracker, stream, np.array([False, True, True]), metres=case.metres)


# -- time ---------------------------------------------------------------------------------------


@each
@FEW
@given(data=st.data(), motion=rigid_motions(1), late=st.sampled_from([0.0, -0.0, *laws.LATE[1:]]))
def test_in_no_time_the_same_markers_change_nothing_and_others_no_correction(
    case: Case, data: st.DataObject, motion: Motion, late: float
) -> None:
    tracker = case.tracker(joints=True)
    stream = data.draw(case.streams(14, 3))
    laws.check_time(tracker, stream, motion, late, metres=case.metres)


@each
@FEW
@given(data=st.data(), late=st.sampled_from([-1 / 60, -np.inf, np.nan]))
def test_in_no_time_nothing_that_runs_on_time_moves(
    case: Case, data: st.DataObject, late: float
) -> None:
    model = case.model()
    stream = data.draw(case.streams(20, 3, least=3))
    _, state = run(model, stream)
    last = Stream(*(a[-1:] for a in stream))
    turned = moved(last.truth, turn([1, 2, 3], 0.3), np.array([0.1, 0.2, 0]))
    elsewhere = last._replace(truth=turned, dt=np.full((1, 3), late))
    pose, after = run(model, elsewhere, state=state)
    assert (pose.notice & Notice.NON_POSITIVE_DT).all()
    _, same = run(model, elsewhere._replace(dt=np.zeros((1, 3))), state=state)
    assert_same_bits(after, same)
    # The drift of hidden markers stands still, and the correction of a re-entered one is as large
    # as it was.
    assert_array_equal(after.drift, state.drift)
    length = np.linalg.norm(state.correction, axis=-1)
    assert_array_equal(np.linalg.norm(after.correction, axis=-1), length)
    if case.predictor == "moving_average":
        assert_array_equal(after.predictor.age, state.predictor.age)
        assert_array_equal(after.predictor.span, state.predictor.span)
        assert_array_equal(after.predictor.path, state.predictor.path)


# -- save, load ---------------------------------------------------------------------------------


@pytest.mark.parametrize("predictor", sorted(PREDICTORS))
def test_a_saved_model_tracks_alike_bit_for_bit(predictor: str, tmp_path: Path) -> None:
    model = a_model(predictor, joints=True)
    save(model, tmp_path / "m.npz")
    rng = np.random.default_rng(1)
    truth = motion(model.hand, rng, 20, 2)
    stream = Stream(truth, blocks(rng, truth.shape[:-1]), np.full((20, 2), 1 / 60))
    back = replace(load(tmp_path / "m.npz"), alignment=model.alignment)  # whoever runs it chooses
    assert_same_bits(run(back, stream), run(model, stream))


# -- the live object ----------------------------------------------------------------------------


@pytest.mark.parametrize("predictor", sorted(PREDICTORS))
@pytest.mark.filterwarnings("error")
@FEW
@given(data=st.data())
def test_on_data_a_live_step_never_raises_and_its_output_is_finite(
    predictor: str, data: st.DataObject
) -> None:
    hand_tracker = HandTracker(a_model(predictor, joints=True))
    rng = np.random.default_rng(data.draw(seeds()))
    wild = np.array([0, 1e-300, 1e-9, 0.1, 1, 1e3, 1e5, 1e8, 1e30, 1e200, 1.7e308, np.inf, np.nan])
    for _ in range(25):
        size = rng.choice(wild, rng.choice([1, 27])) if rng.uniform() < 0.7 else np.ones(1)
        markers = (rng.normal(size=27).clip(-1, 1) * size).reshape(9, 3)
        if rng.uniform() < 0.2:
            markers[:] = markers[0]  # all in one place
        dt = rng.choice([0, -1, 1e-5, 1 / 60, 1e9, 1e300, np.inf, np.nan])
        pose = hand_tracker.step(markers, dt)
        assert all(np.isfinite(leaf).all() for leaf in leaves(pose))


def test_a_wrong_shape_is_refused_with_what_was_expected_and_received() -> None:
    hand_tracker = HandTracker(a_model("affine"), right=[False, True])
    good = np.zeros((2, 9, 3))
    for markers, visible, message in [
        (good[0], None, r"markers: expected shape \(2, 9, 3\), received \(9, 3\)"),
        (np.zeros((2, 10, 3)), None, r"received \(2, 10, 3\)"),
        (good, np.ones(9, bool), r"visible: expected shape \(2, 9\), received \(9,\)"),
    ]:
        with pytest.raises(ValueError, match=message):
            hand_tracker.step(markers, 0.01, visible)
    with pytest.raises(ValueError, match=r"dt: expected shape \(\) or \(2,\), received \(3,\)"):
        hand_tracker.step(good, [0.01] * 3)
    with pytest.raises(ValueError, match=r"dt: expected shape \(\), received \(2,\)"):
        HandTracker(a_model("affine")).step(good[0], [0.01] * 2)
    with pytest.raises(ValueError, match="unknown predictor 'kalman'"):
        HandTracker(a_model("kalman"))


@pytest.mark.parametrize("package", ["numpy_infer", "jaxhand"])
def test_time_may_be_any_number(package: str) -> None:
    """A Python float is one: its `~` is not that of an array."""
    jitted = pytest.importorskip("jax").jit if package == "jaxhand" else None
    side = importlib.import_module(f"{package}.tracker")
    model = a_model("moving_average", dtype=np.float32)
    step = partial(side.step, model)
    if jitted is not None:  # uncompiled, five hundred operations would each be compiled
        step = jitted(step)
    markers = motion(model.hand, np.random.default_rng(0), 12, 1)[:, 0].astype(np.float32)
    visible = np.ones(markers.shape[:-1], bool)
    visible[6:, 4] = False

    def last(number: Callable[[float], Any]) -> Any:
        state = side.init(model)
        for frame, seen in zip(markers, visible, strict=True):
            state, pose = step(state, frame, seen, number(1 / 60))
        return pose

    expected = last(lambda dt: np.array(dt, np.float32))
    assert expected.notice == 0
    for number in (float, np.float64, np.float32, lambda dt: np.array(dt)):
        pose = last(number)
        assert pose.notice == 0
        assert_allclose(pose.markers, expected.markers, rtol=0, atol=1e-6)


def test_the_live_object_is_the_pure_pair_and_reset_forgets_all() -> None:
    model = a_model("learned", joints=True)
    rng = np.random.default_rng(3)
    truth = motion(model.hand, rng, 12, 2)
    stream = Stream(truth, restless(rng, truth.shape[:-1]), np.full((12, 2), 1 / 60))
    right = np.array([True, False])
    expected, _ = run(model, stream, right=right)
    hand_tracker = HandTracker(model, right=[True, False])
    for _ in range(2):
        for t, markers in enumerate(stream.markers):
            pose = hand_tracker.step(markers, 1 / 60)
            assert_same_bits(pose, HandPose(*[part[t] for part in expected]))
        hand_tracker.reset()


def test_quaternions_are_the_rotations_also_where_angles_lock() -> None:
    pose = HandTracker(a_model("affine", joints=True)).step(a_model("affine").hand.template, 0.01)
    locked = np.array(turn([0, 1, 0], np.pi / 2) @ turn([1, 0, 0], 0.7))
    pose = pose._replace(rotations=np.concatenate([pose.rotations[:-1], locked[None]]))
    assert pose.quaternions is not None
    x, y, z, w = np.moveaxis(pose.quaternions, -1, 0)
    assert_allclose(x * x + y * y + z * z + w * w, 1, atol=1e-6)
    assert (w >= 0).all()
    for rotation, vector, angle in zip(
        pose.rotations, np.stack([x, y, z], -1), 2 * np.arccos(np.clip(w, -1, 1)), strict=True
    ):
        if angle > 1e-3:
            assert_allclose(turn(vector, angle), rotation, atol=1e-5)
    assert HandTracker(a_model("affine")).step(np.zeros((9, 3)), 0.01).quaternions is None


def test_a_hand_seen_in_millimetres_is_suspected() -> None:
    model = a_model("none")
    _, pose = tracker.step(
        model,
        tracker.init(model),
        model.hand.template * 1000,
        np.ones(9, bool),
        np.array(1 / 60),
    )
    assert pose.notice == Notice.SUSPECTED_MILLIMETRES
