"""A marker that is suddenly very far away, as a gap written as 9999999, moves nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from streams import a_model

from numpy_infer import tracker
from numpy_infer.model import load
from numpy_infer.pose import HandPose, Status
from numpy_infer.tracker import FARTHEST

Array = np.ndarray

MODEL = replace(load("glove9"), gate=True, joints="none")
TIME = np.array(1 / 60)
SEEN = np.ones(9, bool)


def frames(seed: int, count: int) -> Array:
    """`[T, 9, 3]` metres: a hand that goes somewhere, its markers a little noisy."""
    rng = np.random.default_rng(seed)
    way = np.cumsum(rng.normal(0, 0.002, (count, 1, 3)), 0)
    return MODEL.hand.template + way + rng.normal(0, 2e-4, (count, 9, 3))


def last_pose(markers: Array) -> HandPose:
    state = tracker.init(MODEL)
    for points in markers:
        state, pose = tracker.step(MODEL, state, points, SEEN, TIME)
    return pose


@given(
    st.integers(0, 2**32 - 1),
    st.floats(1, 0.99 * FARTHEST),
    st.sets(st.integers(0, 8), min_size=1, max_size=3),
    st.booleans(),
)
def test_few_that_go_astray_are_refused_at_once(
    seed: int, distance: float, which: set[int], together: bool
) -> None:
    markers, lost = frames(seed, 12), sorted(which)
    truth = markers[-1].copy()
    directions = np.random.default_rng(seed).normal(size=(len(lost), 3))
    if together:
        directions[:] = directions[0]
    markers[-1, lost] = distance * directions / np.abs(directions).max(-1, keepdims=True)
    pose = last_pose(markers)
    assert (pose.status[lost] == Status.REJECTED).all()
    assert np.abs(pose.markers - truth).max() < 0.02


def test_in_jax_too() -> None:
    jax = pytest.importorskip("jax")
    from jaxhand import tracker as twin

    model = a_model("learned", dtype=np.float32, gate=True)
    step = jax.jit(lambda state, points: twin.step(model, state, points, SEEN, np.float32(TIME)))
    for distance in (1e1, 1e3, 5e3, 9e4):
        markers = frames(0, 12).astype(np.float32)
        markers[-1, [2, 5]] = distance
        ours, theirs = tracker.init(model), twin.init(model)
        for points in markers:
            ours, pose = tracker.step(model, ours, points, SEEN, np.float32(TIME))
            theirs, other = step(theirs, points)
        np.testing.assert_array_equal(np.asarray(other.status), pose.status)
        assert (pose.status[[2, 5]] == Status.REJECTED).all()
