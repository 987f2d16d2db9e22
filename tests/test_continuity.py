"""What the tracker promises of its output's motion: no jump, whatever the visible set does."""

from __future__ import annotations

import numpy as np
from cases import FEW, Case, each
from hypothesis import given, settings
from hypothesis import strategies as st
from streams import PATTERNS, motion, seeds

from jaxhand import laws
from jaxhand.strategies import Motion, Stream, rigid_motions
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
