"""A whole recording through the tracker, frame by frame as it would be live."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from numpy_infer.arrays import Array
from numpy_infer.hand import ANGLES
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
    """Runs the tracker over a recording.

    Args:
        recording: holds at least the model's markers, by name.
        model: what to run.
        right: True for a right hand.
        report: is told the share of the frames done.

    Raises:
        ValueError: a marker of the model's hand is not in the recording.
    """
    recording = recording.select(model.hand.markers)
    tracker = HandTracker(model, right=right)
    steps = np.diff(recording.time, prepend=recording.time[0] - 1 / recording.rate)
    frames = len(recording.time)
    markers = np.full(recording.markers.shape, np.nan)
    angles = np.full((frames, len(ANGLES)), np.nan)
    status = np.full(recording.markers.shape[:2], int(Status.HELD))
    expected_error = np.zeros(status.shape)
    state = np.full(frames, int(TrackingState.LOST))
    notice = np.zeros(frames, int)
    begun = False
    for i in range(frames):
        pose = tracker.step(recording.markers[i], steps[i])
        begun = begun or pose.state == TrackingState.TRACKING
        status[i], state[i], notice[i] = pose.status, pose.state, pose.notice
        if begun:
            markers[i], expected_error[i] = pose.markers, pose.expected_error
            if pose.angles is not None:
                angles[i] = pose.angles
        if i % 256 == 0:
            report(i / frames)
    report(1.0)
    if model.predictor == "none":
        markers = np.where((status == Status.OBSERVED)[..., None], markers, np.nan)
    filled = replace(
        recording,
        markers=markers,
        angles=None if model.joints == "none" else angles,
        joints=None,
        filled=recording.names,
    )
    return Tracked(filled, status, expected_error, state, notice)
