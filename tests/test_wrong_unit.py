"""Frames in millimetres are told of, and nothing of them is left once they are over."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from streams import Stream, a_model, at_least, blocks, motion, run

from numpy_infer import tracker
from numpy_infer.model import Model
from numpy_infer.pose import Notice

Array = np.ndarray

FRAMES, WRONG = 60, slice(20, 32)
GIVEN_UP = 0.5
"""Metres: no hidden marker is said to be farther off."""


def a_stream(model: Model, seed: int, hands: int = 2) -> tuple[Array, Array, Array, Array]:
    """The truth `[T, hands, M, 3]`; the same with frames in millimetres; what is visible, four
    markers at least, never the same set for long; and time."""
    rng = np.random.default_rng(seed)
    truth = motion(model.hand, rng, FRAMES, hands)
    markers, visible = truth.copy(), at_least(blocks(rng, truth.shape[:-1]), 4, rng)
    markers[WRONG] *= 1000
    return truth, markers, visible, np.full(visible.shape[:2], 1 / 60)


@pytest.mark.parametrize("gate", [False, True])
@settings(max_examples=20)
@example(seed=812)  # one marker alone is seen before and after the last of them
@given(seed=st.integers(0, 2**32 - 1))
def test_frames_in_millimetres_leave_nothing_behind(gate: bool, seed: int) -> None:
    # The baselines go on from their last output, whatever that was.
    model = a_model("learned", gate=gate)
    truth, *frames = a_stream(model, seed)
    pose, _ = run(model, Stream(*frames))
    off = np.linalg.norm(pose.markers - truth, axis=-1)
    assert (pose.notice[WRONG] & Notice.SUSPECTED_MILLIMETRES).any()
    assert off[WRONG.stop :].max() < off[: WRONG.start].max() + GIVEN_UP
    _, at_once = tracker.run(model, tracker.init(model, (2,)), *frames)
    apart = np.abs(at_once.markers - pose.markers).max((1, 2, 3))
    assert apart[: WRONG.start].max() < 1e-6
    assert apart[WRONG.stop :].max() < 1e-6


def test_in_jax_too() -> None:
    jax = pytest.importorskip("jax")
    import jaxhand.tracker

    model = a_model("learned", dtype=np.float32)

    @jax.jit
    def filled(*frames: Array) -> Any:
        return jaxhand.tracker.run(model, jaxhand.tracker.init(model, (2,)), *frames)[1].markers

    for seed in (*range(5), 812):
        truth, markers, visible, dt = a_stream(model, seed)
        found = filled(markers.astype(np.float32), visible, dt.astype(np.float32))
        off = np.linalg.norm(np.asarray(found) - truth, axis=-1)
        assert off[WRONG.stop :].max() < off[: WRONG.start].max() + GIVEN_UP
