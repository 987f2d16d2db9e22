"""Trackers share nothing: not in two threads, not with their copies, not through a pickle."""

from __future__ import annotations

import copy
import pickle
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest
from streams import Stream, a_model, assert_same_bits, markov, motion

from numpy_infer import HandTracker
from numpy_infer.model import Model
from numpy_infer.pose import HandPose
from numpy_infer.predictors import PREDICTORS

Array = np.ndarray

each = pytest.mark.parametrize("predictor", PREDICTORS)


def stream(model: Model, seed: int, frames: int = 30, hands: int = 2) -> Stream:
    rng = np.random.default_rng(seed)
    truth = motion(model.hand, rng, frames, hands)
    return Stream(truth, markov(rng, truth.shape[:-1]), np.full(truth.shape[:2], 1 / 60))


def run(tracker: HandTracker, stream: Stream) -> list[HandPose]:
    return [tracker.step(m, dt) for m, dt in zip(stream.markers, stream.dt, strict=True)]


@pytest.fixture
def restless_threads() -> Iterator[None]:
    """Threads take turns as often as Python can make them."""
    usual = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    yield
    sys.setswitchinterval(usual)


@each
def test_trackers_in_threads_are_as_one_after_the_other(
    predictor: str, restless_threads: None
) -> None:
    model = a_model(predictor, joints=True)
    streams = [stream(model, seed) for seed in range(4)]
    sides = [(False, True), (True, True), (False, False), (True, False)]

    def alone(i: int) -> list[HandPose]:
        return run(HandTracker(model, right=sides[i]), streams[i])

    expected = [alone(i) for i in range(4)]
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(alone, range(4)))
    for one, other in zip(found, expected, strict=True):
        assert_same_bits(tuple(one), tuple(other))


COPIES: dict[str, Callable[[HandTracker], HandTracker]] = {
    "copy": copy.copy,
    "deepcopy": copy.deepcopy,
    "pickle": lambda tracker: pickle.loads(pickle.dumps(tracker)),
}


@each
@pytest.mark.parametrize("way", COPIES)
def test_a_copy_goes_on_bit_for_bit_and_on_its_own(predictor: str, way: str) -> None:
    model = a_model(predictor, joints=True)
    past, one, two = (stream(model, seed) for seed in range(3))
    tracker = HandTracker(model, right=(False, True))
    expected_one = run_after(model, past, one)
    expected_two = run_after(model, past, two)
    run(tracker, past)
    twin = COPIES[way](tracker)
    # In turns, each on its own stream: what one does must not be seen by the other.
    found: tuple[list[Any], list[Any]] = ([], [])
    for t in range(len(one.dt)):
        for poses, runs, frames in ((found[0], tracker, one), (found[1], twin, two)):
            poses.append(runs.step(frames.markers[t], frames.dt[t]))
    assert_same_bits(tuple(found[0]), expected_one)
    assert_same_bits(tuple(found[1]), expected_two)


def run_after(model: Model, past: Stream, stream: Stream) -> tuple[HandPose, ...]:
    tracker = HandTracker(model, right=(False, True))
    run(tracker, past)
    return tuple(run(tracker, stream))


@pytest.mark.parametrize("way", COPIES)
def test_a_copy_is_not_reset_with_its_original(way: str) -> None:
    model = a_model("affine")
    past, one = stream(model, 0), stream(model, 1)
    tracker = HandTracker(model, right=(False, True))
    expected = run_after(model, past, one)
    run(tracker, past)
    twin = COPIES[way](tracker)
    tracker.reset()
    assert_same_bits(tuple(run(twin, one)), expected)


def test_what_step_gave_is_no_longer_the_trackers() -> None:
    """Whoever writes into an output, at any time, changes nothing that comes later."""
    model = a_model("learned", joints=True)
    frames = stream(model, 3)
    expected = run(HandTracker(model, right=(False, True)), frames)
    tracker, before = HandTracker(model, right=(False, True)), copy.deepcopy(expected)
    for markers, dt, pose in zip(frames.markers, frames.dt, before, strict=True):
        given = tracker.step(markers, dt)
        assert_same_bits(given, pose)
        for array in given:
            if array is not None:
                array[...] = 0
        markers[...] = 7


def test_a_copied_or_pickled_model_is_the_same_model() -> None:
    model = a_model("learned", joints=True)
    frames = stream(model, 4)
    for way in (copy.copy, copy.deepcopy, lambda m: pickle.loads(pickle.dumps(m))):
        one = run(HandTracker(way(model), right=(False, True)), frames)
        assert_same_bits(tuple(one), tuple(run(HandTracker(model, right=(False, True)), frames)))
