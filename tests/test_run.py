"""Many frames at once are the frames one after the other."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from cases import Case
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from streams import a_model, at_least, blocks, leaves, motion

from numpy_infer import tracker
from numpy_infer.model import Model
from numpy_infer.pose import HandPose, State
from numpy_infer.predictors import PREDICTORS

Array = np.ndarray


def one_by_one(model: Model, frames: tuple[Array, ...], right: Array) -> tuple[State, HandPose]:
    """What `run` gives, from `step`."""
    state, poses = tracker.init(model, right.shape, right), []
    for frame in zip(*frames, strict=True):
        state, pose = tracker.step(model, state, *frame)
        poses.append(pose)
    return state, HandPose(*(np.array(field) for field in zip(*poses, strict=True)))


def assert_same(one: Any, other: Any, within: float) -> None:
    for a, b in zip(leaves(one), leaves(other), strict=True):
        assert a.shape == b.shape
        assert a.dtype == b.dtype
        assert_allclose(a, b, rtol=0, atol=within)


@pytest.mark.parametrize("predictor", sorted(PREDICTORS))
@settings(max_examples=8)
@given(data=st.data(), hands=st.integers(1, 2))
def test_frames_at_once_are_frames_one_after_the_other(
    predictor: str, data: st.DataObject, hands: int
) -> None:
    """Whatever is hidden, whenever; and a state can be taken up again anywhere."""
    case = Case(predictor)
    model = case.model(joints=True)
    stream = data.draw(case.streams(40, hands))
    cut = data.draw(st.integers(1, len(stream.dt)))
    right = np.arange(hands) % 2 == 1
    frames = stream.markers, stream.visible, stream.dt
    expected_state, expected = one_by_one(model, frames, right)
    state, parts = tracker.init(model, right.shape, right), []
    for part in (slice(cut), slice(cut, None)):
        if len(stream.dt[part]):
            state, pose = tracker.run(model, state, *(array[part] for array in frames))
            parts.append(leaves(pose))
    assert_same(state, expected_state, 1e-6)
    for *found, whole in zip(*parts, leaves(expected), strict=True):
        # Not the angles: near 90° of abduction they are no function of the rotations.
        if whole.shape[-1] != 26:
            assert_allclose(np.concatenate(found), whole, rtol=0, atol=1e-6)


def a_recording() -> tuple[Array, ...]:
    """Gaps that last, and frames in no time."""
    rng = np.random.default_rng(4)
    markers = motion(a_model("learned").hand, rng, 120, 2)
    visible = at_least(blocks(rng, markers.shape[:-1]), 4, rng)
    dt = np.full(visible.shape[:2], 1 / 60)
    dt[[30, 31, 80]] = 0
    markers[31], visible[31] = markers[30], visible[30]
    return markers, visible, dt


def test_a_frame_in_no_time_is_the_same_at_once() -> None:
    model = a_model("learned", joints=True)
    right = np.array([False, True])
    frames = a_recording()
    state, expected = one_by_one(model, frames, right)
    found = tracker.run(model, tracker.init(model, (2,), right), *frames)
    assert_same(found[0], state, 1e-9)
    assert_allclose(found[1].markers, expected.markers, rtol=0, atol=1e-9)
    assert_allclose(found[1].positions, expected.positions, rtol=0, atol=1e-9)


def test_in_jax_too() -> None:
    jax = pytest.importorskip("jax")
    import jaxhand.tracker

    model = a_model("learned", dtype=np.float32, joints=True)
    right = np.array([False, True])
    frames = a_recording()
    markers, visible, dt = frames[0].astype(np.float32), frames[1], frames[2].astype(np.float32)

    @jax.jit
    def both(model: Model) -> Any:
        start = jaxhand.tracker.init(model, (2,), right)
        frames = markers, visible, dt
        stepped = jax.lax.scan(lambda s, f: jaxhand.tracker.step(model, s, *f), start, frames)
        return stepped, jaxhand.tracker.run(model, start, *frames)

    stepped, ran = jax.tree.map(np.asarray, both(model))
    assert_same(ran[1].positions, stepped[1].positions, 1e-5)
    assert_same(ran[1].markers, stepped[1].markers, 1e-6)
    ours = tracker.run(model, tracker.init(model, (2,), right), markers, visible, dt)
    assert_allclose(ran[1].markers, ours[1].markers, rtol=0, atol=1e-4)
    assert_allclose(ran[0].drift, ours[0].drift, rtol=0, atol=1e-4)
    assert_allclose(ran[1].expected_error, ours[1].expected_error, rtol=0, atol=1e-4)


@pytest.mark.parametrize("seen", [0, 2, 9])
def test_a_recording_is_not_gone_through_again_and_again(
    seen: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whether a hand is there, hardly or not at all: each frame is asked of a few times at most."""
    model = a_model("learned", gate=True)
    markers = motion(model.hand, np.random.default_rng(0), 300, 2) / 3
    visible = np.ones(markers.shape[:-1], bool)
    visible[20:, 1, seen:] = False
    asked, together = [], tracker.together

    def counted(model: Model, state: State, markers: Array, *rest: Array) -> State | None:
        asked.append(len(markers))
        return together(model, state, markers, *rest)

    monkeypatch.setattr(tracker, "together", counted)
    tracker.run(model, tracker.init(model, (2,)), markers, visible, np.full((300, 2), 1 / 60))
    assert sum(asked) < 4 * len(markers)
