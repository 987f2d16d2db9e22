"""What the tracker promises of its output's motion: no jump, whatever the visible set does."""

from __future__ import annotations

import numpy as np
import pytest
from cases import FEW, Case, each
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from strategies import turn
from streams import PATTERNS, SPEED, a_model, motion, moved, postures, seeds

from jaxhand import laws
from jaxhand.strategies import Motion, Stream, rigid_motions
from jaxhand.trial import run
from numpy_infer.geometry import kabsch
from numpy_infer.pose import DETERMINED_EXTENT
from numpy_infer.predictors import PREDICTORS


@each
@settings(max_examples=4)
@given(
    seed=seeds(),
    before=st.sampled_from(sorted(PATTERNS)),
    after=st.sampled_from(sorted(PATTERNS)),
    first=st.sampled_from(["complete", "drawn", "empty"]),
)
def test_once_the_true_hand_stands_still_no_output_marker_is_faster_than_a_quarter_metre_a_second(
    case: Case, seed: int, before: str, after: str, first: str
) -> None:
    """The visible sets: any of `PATTERNS` in motion and any at rest, so any set can follow any
    other in any frame: disjoint ones, none, one, two, all; the first frame complete or not."""
    tracker = case.tracker()
    rng = np.random.default_rng(seed)
    frames, rest, hands = 44, 20, 4
    shape = (frames, hands, len(tracker.hand))
    visible = PATTERNS[before](rng, shape)
    visible[rest:] = PATTERNS[after](rng, shape)[rest:]
    visible[0] = {"complete": True, "empty": False}.get(first, visible[0])
    truth = motion(tracker.hand, rng, frames, hands)
    truth[rest:] = truth[rest - 1]
    dt = rng.choice([1 / 60, 1 / 120, 0.003, 0.1], (frames, hands))
    laws.check_continuity(tracker, Stream(truth, visible, dt), metres=case.metres)


@each
@settings(max_examples=2)
@given(data=st.data())
def test_so_it_is_after_pressed_postures_and_in_no_time(case: Case, data: st.DataObject) -> None:
    tracker = case.tracker()
    stream = data.draw(case.streams(60, 3))
    laws.check_continuity(tracker, stream, metres=case.metres)


@each
@settings(max_examples=4)
@given(data=st.data(), most=st.sampled_from([0, 1, 2, 2, None, None]), tracked=st.booleans())
def test_with_few_visible_hidden_markers_move_by_the_mean_displacement_of_those_seen_twice(
    case: Case, data: st.DataObject, most: int | None, tracked: bool
) -> None:
    """None, one or two visible, or any number on a line; never tracked before, or complete in the
    first frame and again after some."""
    tracker = case.tracker()
    stream = data.draw(case.streams(24, 3, most=most, pressed=True))
    if tracked:
        stream.visible[0] = True
        stream.visible[len(stream.dt) // 2] |= np.arange(len(tracker.hand)) < 5
    laws.check_few_visible(tracker, stream, metres=case.metres)


@each
@FEW
@given(data=st.data(), motion=rigid_motions(1))
def test_a_hand_that_was_gone_comes_back_where_it_is_now_and_continuous_in_its_own_frame(
    case: Case, data: st.DataObject, motion: Motion
) -> None:
    """Hidden markers of predictors that hold them in the world (last known, moving average, none)
    are not taken along; the measured ones are, under all."""
    tracker = case.tracker()
    stream = data.draw(case.streams(30, 4, least=3))
    follow = PREDICTORS[case.predictor].uses_frame
    laws.check_return(tracker, stream, motion, all_markers=follow, metres=case.metres)


@each
@settings(max_examples=4)
@given(seed=seeds(), motion=rigid_motions(1))
def test_so_does_one_whose_posture_has_changed_meanwhile(
    case: Case, seed: int, motion: Motion
) -> None:
    """What is measured is then taken for the hand's motion as well as it can be."""
    tracker, gone, dt = case.tracker(), 3, 1 / 60
    before, after = postures(tracker.hand, np.random.default_rng(seed), 40, 1)[[0, -1]]
    truth = np.stack([before] * (1 + gone) + [motion(after)])
    visible = np.ones(truth.shape[:-1], bool)
    visible[1:-1] = False
    markers = run(tracker, Stream(truth, visible, np.full(visible.shape[:2], dt))).poses["markers"]
    eye = np.broadcast_to(np.eye(3), (1, 3, 3))
    rotation, shift = kabsch(before, truth[-1], np.ones(visible.shape[1:]), eye)
    steps = np.linalg.norm(markers[-1] - moved(before, rotation, shift), axis=-1)
    assert steps.max() < SPEED * dt + 2 * case.metres


@pytest.mark.parametrize("predictor", [n for n, p in PREDICTORS.items() if p.uses_frame])
@settings(max_examples=20)
@given(seed=seeds(), finger=st.sampled_from(["Index", "Middle", "Ring", "Pinky"]))
def test_a_bent_finger_left_alone_carries_the_hand_with_it(
    predictor: str, seed: int, finger: str
) -> None:
    """Three markers, in one line in the flat hand: what they leave open follows the hand's own
    motion since the frame before, however fast it turns."""
    rng, model = np.random.default_rng(seed), a_model(predictor, "dense19")
    tracker = laws.tracker(model)
    posture = postures(tracker.hand, rng, 1, 1)[0]
    rotation, shift = turn(rng.normal(size=3), rng.uniform(0.2, 1)), rng.uniform(-0.1, 0.1, 3)
    truth = np.stack([posture, moved(posture, rotation, shift)])
    visible = np.ones(truth.shape[:-1], bool)
    visible[1] = [marker.startswith(finger) for marker in tracker.hand.markers]
    found = run(tracker, Stream(truth, visible, np.full((2, 1), 1 / 60))).poses
    bent = np.linalg.svd(posture[visible[1]] - posture[visible[1]].mean(0), compute_uv=False)[1]
    assume(bent > 2 * DETERMINED_EXTENT)
    assert_allclose(found["markers"], truth, rtol=0, atol=1e-6)
