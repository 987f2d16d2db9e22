"""A whole recording through the tracker, with what it would say live."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from numpy_infer.arrays import Array
from numpy_infer.geometry import quaternion
from numpy_infer.model import Model
from numpy_infer.pose import HandPose, Status, TrackingState
from numpy_infer.recordings import Recording
from numpy_infer.tracker import init, run

CHUNK = 1024
"""Frames done at once, between two reports."""


@dataclass(frozen=True, eq=False)
class Tracked:
    """A recording with its holes filled, and what that rests on."""

    recording: Recording
    """Markers `[T, M, 3]` metres and, with a joint stage, angles `[T, 26]` radians; NaN before the
    hand was first tracked, and with the predictor `none` wherever nothing was measured. The wrist's
    pose, and of every marker its status and expected error."""
    state: Array
    """`[T]` a `TrackingState` for each frame."""
    notice: Array
    """`[T]` flags of `Notice`."""

    @property
    def status(self) -> Array:
        """`[T, M]` a `Status` for each marker."""
        return self.recording.status

    @property
    def expected_error(self) -> Array:
        """`[T, M]` metres."""
        return self.recording.expected_error


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
    visible = np.isfinite(recording.markers).all(-1)
    steps = np.diff(recording.time, prepend=recording.time[0] - 1 / recording.rate)
    state, poses = init(model, (), right), []
    for first in range(0, len(steps), CHUNK):
        frames = slice(first, first + CHUNK)
        state, pose = run(model, state, recording.markers[frames], visible[frames], steps[frames])
        poses.append(pose._replace(rotations=None, positions=None))  # a kilobyte and a half a frame
        report(min(1.0, frames.stop / len(steps)))
    return _tracked(recording, model, poses)


def track_hands(
    recordings: Sequence[Recording],
    model: Model,
    *,
    right: Sequence[bool],
    report: Callable[[float], None] = lambda share: None,
) -> list[Tracked]:
    """Runs a tracker over each of several hands.

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
    return [
        track(hand, model, right=side, report=partial(_part, report, number, len(hands)))
        for number, (hand, side) in enumerate(zip(hands, right, strict=True))
    ]


def as_measured(result: Tracked, recording: Recording) -> Tracked:
    """The same with what was measured, and believed, as it was: a marker that comes back then jumps
    to where it is instead of being led there."""
    own = recording.select(result.recording.names)
    seen = result.status == Status.OBSERVED
    markers = np.where(seen[..., None], own.markers, result.recording.markers)
    off = np.where(seen, 0, result.expected_error)
    own = replace(result.recording, markers=markers, expected_error=off)
    return replace(result, recording=own)


def _part(report: Callable[[float], None], number: int, of: int, share: float) -> None:
    report((number + share) / of)


def _tracked(recording: Recording, model: Model, poses: Sequence[HandPose]) -> Tracked:
    def of(name: str) -> Any:
        parts = [getattr(pose, name) for pose in poses]
        return None if parts[0] is None else np.concatenate(parts)

    markers, angles, status, state = (of(name) for name in ("markers", "angles", "status", "state"))
    begun = np.logical_or.accumulate(state == TrackingState.TRACKING)
    if model.predictor == "none":
        markers = np.where((status == Status.OBSERVED)[..., None], markers, np.nan)
    markers = np.where(begun[:, None, None], markers, np.nan)
    some = ((status != Status.OBSERVED) & np.isfinite(markers).all(-1)).any(0)
    wrist = np.concatenate([of("wrist_position"), quaternion(of("wrist_rotation"))], -1)
    filled = replace(
        recording,
        markers=markers,
        angles=None if angles is None else np.where(begun[:, None], angles, np.nan),
        joints=None,
        wrist=np.where(begun[:, None], wrist, np.nan),
        status=status,
        expected_error=np.where(begun[:, None], of("expected_error"), 0),
        filled=tuple(np.array(recording.names)[some].tolist()),
    )
    return Tracked(filled, state, of("notice"))
