"""Frames that no sane world sends: no exception, no warning, nothing that is not finite, and no
trace of them once the frames are sane again. `experiments/fuzz.py` does a million of them."""

from __future__ import annotations

import importlib
import math
import sys
import warnings
from typing import Any

import numpy as np
import pytest
from conftest import REPOSITORY
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from streams import a_model, seeds

from numpy_infer import HandTracker, Status, TrackingState
from numpy_infer.model import Model
from numpy_infer.predictors import PREDICTORS

sys.path.append(str(REPOSITORY / "experiments"))
fuzz = importlib.import_module("fuzz")

each = pytest.mark.parametrize("predictor", PREDICTORS)

MODELS: dict[str, Model] = {
    f"{name}-{precision}": model
    for precision in ("float32", "float64")
    for name, model in fuzz.models("glove9", precision, PREDICTORS).items()
}


@pytest.mark.parametrize("name", MODELS)
@settings(max_examples=1)
@given(seed=seeds())
def test_a_crowd_survives_what_no_sane_world_sends_and_recovers(name: str, seed: int) -> None:
    worst = fuzz.Worst()
    fuzz.round_of(MODELS[name], (seed,), worst, bad=25, hands=12)
    assert worst.pauses >= 2


def odd_numbers() -> st.SearchStrategy[float]:
    special = [0.0, -0.0, 5e-324, 1e-310, 1e-30, 0.1, 1.0, 1e3, 9.9e4, 1e5, 1e30, 1.7e308]
    signed = st.sampled_from([*special, *(-x for x in special), math.inf, -math.inf, math.nan])
    return signed | st.floats(-1, 1)


@each
@settings(max_examples=25)
@given(data=st.data())
def test_one_hand_survives_any_numbers(predictor: str, data: st.DataObject) -> None:
    tracker = HandTracker(a_model(predictor, joints=True), right=data.draw(st.booleans()))
    worst = fuzz.Worst()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for _ in range(data.draw(st.integers(1, 5))):
            odd = data.draw(hnp.arrays(float, (9, 3), elements=odd_numbers(), fill=odd_numbers()))
            sane = data.draw(hnp.arrays(bool, 9))[:, None]
            markers = np.where(sane, tracker.hand.template, odd)
            visible = data.draw(st.none() | hnp.arrays(bool, 9))
            pose = tracker.step(markers, data.draw(odd_numbers()), visible)
            fuzz.check(tracker._state, pose, worst)
            measured = np.isfinite(markers).all(-1) & (True if visible is None else visible)
            assert not (measured < (pose.status == Status.OBSERVED)).any()


@each
def test_a_hand_that_leaves_and_comes_back_is_the_hand(predictor: str) -> None:
    tracker = HandTracker(a_model(predictor, joints=True))
    here = tracker.hand.template
    for _ in range(5):
        first = tracker.step(here, 1 / 60)
    for _ in range(3):
        for _ in range(20):
            gone = tracker.step(np.full((9, 3), np.nan), 1 / 60)
            assert gone.state == TrackingState.LOST
        for _ in range(5):
            back = tracker.step(here, 1 / 60)
    for one, other in zip(back, first, strict=True):
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-9)


def test_the_laws_can_fail() -> None:
    """What each check looks at, spoiled."""
    model = MODELS["affine-float64"]
    markers, visible = np.stack([model.hand.template] * 3), np.ones((3, 9), bool)
    state = fuzz.tracker.init(model, (3,))
    state, pose = fuzz.tracker.step(model, state, markers, visible, np.full(3, 1 / 60))

    def spoiled(array: Any, value: Any) -> Any:
        copy = np.array(array)
        copy.flat[-1] = value
        return copy

    worst = fuzz.Worst()
    fuzz.check(state, pose, worst)
    for bad_state, bad_pose, message in (
        (state._replace(drift=spoiled(state.drift, np.inf)), pose, "state.drift of hand 2"),
        (state, pose._replace(markers=spoiled(pose.markers, np.nan)), "pose.markers of hand 2"),
        (state, pose._replace(expected_error=spoiled(pose.expected_error, -1)), "is negative"),
        (state._replace(rotation=spoiled(state.rotation, 1.01)), pose, "no rotation"),
        (state, pose._replace(wrist_rotation=-pose.wrist_rotation), "no rotation"),
    ):
        with pytest.raises(AssertionError, match=message):
            fuzz.check(bad_state, bad_pose, worst)


def test_a_tracker_that_keeps_something_of_the_past_is_seen(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    step, calls = fuzz.tracker.step, iter(range(1000))

    def resentful(*arguments: Any) -> Any:
        state, pose = step(*arguments)
        # After two pauses the old one and the fresh one take turns.
        grudge = 1e-3 if next(calls) % 2 == 0 else 0
        return state, pose._replace(expected_error=pose.expected_error + grudge)

    monkeypatch.setattr(fuzz.tracker, "step", resentful)
    model = MODELS["none-float64"]
    truth = fuzz.motion(np.random.default_rng(0), model.hand, fuzz.GOOD + fuzz.HIDING, 4)
    state = fuzz.tracker.init(model, (4,))
    with pytest.raises(AssertionError, match=r"expected_error is 0\.001 from that of a fresh"):
        fuzz.recover(model, np.random.default_rng(0), state, truth, fuzz.Worst())
