"""A whole recording through the tracker, frame by frame as it would be live."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from numpy_infer.arrays import Array
from numpy_infer.hand import Hand
from numpy_infer.model import Model
from numpy_infer.pose import Status, TrackingState
from numpy_infer.recordings import Recording
from numpy_infer.tracker import HandTracker


@dataclass(frozen=True, eq=False)
class Tracked:
    """A recording with its holes filled, and what that rests on."""

    recording: Recording
    """Markers `[T, M, 3]` metres and, with a joint stage, angles `[T, 26]` radians; NaN before the
    hand was first tracked, and with the predictor `none` wherever nothing was measured."""
    status: Array
    """`[T, M]` a `Status` for each marker."""
    expected_error: Array
    """`[T, M]` metres."""
    state: Array
    """`[T]` a `TrackingState` for each frame."""
    notice: Array
    """`[T]` flags of `Notice`."""


def track(
    recording: Recording,
    model: Model,
    *,
    right: bool = False,
    report: Callable[[float], None] = lambda share: None,
) -> Tracked:
    """Runs the tracker over a recording of one hand.

    Args:
        recording: holds at least the model's markers, by name.
        model: what to run.
        right: True for a right hand.
        report: is told the share of the frames done.

    Raises:
        ValueError: a marker of the model's hand is not in the recording.
    """
    recording = recording.select(model.hand.markers)
    frames = _run(HandTracker(model, right=right), recording, recording.markers, report)
    return _tracked(recording, model, *frames)


def track_hands(
    recordings: Sequence[Recording],
    model: Model,
    *,
    right: Sequence[bool],
    report: Callable[[float], None] = lambda share: None,
) -> list[Tracked]:
    """Runs one tracker over several hands at once: all in one product per layer of the networks.

    Args:
        recordings: of one hand each, over the same time; see `track`.
        model: what to run, for all of them.
        right: for each, True for a right hand.
        report: is told the share of the frames done.

    Raises:
        ValueError: no hand, as many sides as hands, another time, or as `track`.
    """
    if not recordings or len(recordings) != len(right):
        raise ValueError(f"expected a side for each hand, got {len(right)} for {len(recordings)}")
    hands = [recording.select(model.hand.markers) for recording in recordings]
    if any(not np.array_equal(hand.time, hands[0].time) for hand in hands):
        raise ValueError("expected recordings of the same frames at the same time")
    markers = np.stack([hand.markers for hand in hands], 1)
    frames = _run(HandTracker(model, right=right), hands[0], markers, report)
    return [
        _tracked(hand, model, *(None if array is None else array[:, i] for array in frames))
        for i, hand in enumerate(hands)
    ]


def prefixed(recording: Recording, prefix: str, hand: Hand) -> Recording:
    """The markers of one hand whose labels all begin with `prefix`, under the hand's own names.

    Raises:
        ValueError: one of them is not in the recording.
    """
    own = recording.select([prefix + name for name in hand.markers])
    filled = tuple(name.removeprefix(prefix) for name in own.filled)
    return replace(own, names=hand.markers, filled=filled)


def _run(
    tracker: HandTracker,
    recording: Recording,
    markers: Array,
    report: Callable[[float], None],
) -> tuple[Any, ...]:
    """`[T, …]` markers, angles, status, expected error, state and notice, as live."""
    steps = np.diff(recording.time, prepend=recording.time[0] - 1 / recording.rate)
    poses = []
    for i, frame in enumerate(markers):
        pose = tracker.step(frame, steps[i])
        kept = pose.markers, pose.angles, pose.status, pose.expected_error, pose.state, pose.notice
        poses.append(kept)
        if i % 256 == 0:
            report(i / len(markers))
    report(1.0)
    return tuple(None if f[0] is None else np.array(f) for f in zip(*poses, strict=True))


def _tracked(
    recording: Recording,
    model: Model,
    markers: Array,
    angles: Array | None,
    status: Array,
    expected_error: Array,
    state: Array,
    notice: Array,
) -> Tracked:
    begun = np.logical_or.accumulate(state == TrackingState.TRACKING)
    if model.predictor == "none":
        markers = np.where((status == Status.OBSERVED)[..., None], markers, np.nan)
    filled = replace(
        recording,
        markers=np.where(begun[:, None, None], markers, np.nan),
        angles=None if angles is None else np.where(begun[:, None], angles, np.nan),
        joints=None,
        filled=recording.names,
    )
    return Tracked(filled, status, np.where(begun[:, None], expected_error, 0), state, notice)
