"""What the tracker gives back and what it carries from frame to frame."""

from __future__ import annotations

from enum import IntEnum, IntFlag
from typing import Any, NamedTuple

from numpy_infer.arrays import Array
from numpy_infer.geometry import quaternion

DETERMINED_EXTENT = 5e-3
"""Metres: markers whose second extent is smaller are as good as collinear: they do not determine
the hand's pose."""


class Status(IntEnum):
    """What an output marker rests on."""

    OBSERVED = 0
    """Measured and accepted now, also while its correction shrinks."""
    PREDICTED = 1
    """Filled from this frame's measurements."""
    HELD = 2
    """Nothing in this frame determines it."""
    REJECTED = 3
    """Measured but refused; shown as predicted."""


class TrackingState(IntEnum):
    """How well the frame determines the hand."""

    TRACKING = 0
    """At least 3 non-collinear markers are measured."""
    DEGRADED = 1
    """Fewer; the hand is carried along by what is seen."""
    LOST = 2
    """None, or never yet tracked; before that the template stands in."""


class Notice(IntFlag):
    """What was wrong with a frame's input."""

    NONE = 0
    NON_POSITIVE_DT = 1
    """No time has passed, by `dt`: nothing that runs on time moves."""
    SUSPECTED_MILLIMETRES = 2
    """Markers lie too far apart for metres. They are measurements all the same. Once they are over
    and markers determine the hand again, a learned model fills without a trace of them; a baseline
    goes on from what it made of them, until `HandTracker.reset`."""
    REJECTED_MARKERS = 4
    """The gate refused some; `Status.REJECTED` says which."""


class HandPose(NamedTuple):
    """What `step` gives back; metres and radians, world frame. Arrays belong to the caller."""

    markers: Array
    """`[..., M, 3]` all markers."""
    status: Array
    """`[..., M]` a `Status` for each marker."""
    expected_error: Array
    """`[..., M]` metres: mean error to expect of the marker; of an observed one how far it still is
    from there, on its way back."""
    wrist_rotation: Array
    """`[..., 3, 3]` world_from_wrist of the hand given; a right hand's is its mirror image's."""
    wrist_position: Array
    """`[..., 3]` the wrist joint."""
    angles: Array | None
    """`[..., 26]` joint angles in the order of `hand.ANGLES`; None without a joint stage."""
    rotations: Array | None
    """`[..., 16, 3, 3]` world_from_joint; None without a joint stage."""
    positions: Array | None
    """`[..., 21, 3]` joints and tips; None without a joint stage."""
    state: Array
    """`[...]` a `TrackingState`, as a number in an array: compare it by `==`, or name that of one
    hand by `TrackingState(pose.state)`."""
    notice: Array
    """`[...]` flags of `Notice`, likewise: `pose.notice & Notice.REJECTED_MARKERS`."""

    @property
    def quaternions(self) -> Array | None:
        """`[..., 16, 4]` xyzw, world_from_joint, w not negative: what `rotations` are, made when
        asked for. Unlike the angles they know no gimbal lock (at ±90° of abduction flexion and
        twist are one motion, see `skeleton.angles_from_rotations`)."""
        return None if self.rotations is None else quaternion(self.rotations)


class State(NamedTuple):
    """What is carried from frame to frame. Everything in it is a left hand's."""

    right: Array
    """`[...]` True for a right hand."""
    gate: Any
    """State of the gate; () without one."""
    rejected: Array
    """`[..., M]` True where measured but refused."""
    predictor: Any
    """State of the model's predictor."""
    smoothing: Any
    """State of the output filter; () without one."""
    output: Array
    """`[..., M, 3]` all markers as the previous frame gave them, before the output filter."""
    wrist_rotation: Array
    """`[..., 3, 3]` world_from_wrist, likewise."""
    wrist_position: Array
    """`[..., 3]` likewise."""
    markers: Array
    """`[..., M, 3]` the previous measurements; 0 where hidden or refused."""
    visible: Array
    """`[..., M]` True where the previous frame was measured, and accepted."""
    tracked: Array
    """`[...]` True once the hand has been tracked."""
    tracking: Array
    """`[...]` True if it was tracked in the previous frame."""
    rotation: Array
    """`[..., 3, 3]` world_from_template of the previous frame."""
    translation: Array
    """`[..., 3]` its translation."""
    seen: Array
    """`[..., M, 3]` registered frame: where each marker was measured last, carried rigidly."""
    known: Array
    """`[..., M]` True once the marker has been measured."""
    correction: Array
    """`[..., M, 3]` registered frame: of a visible marker as it is now, of a hidden one as it was
    set."""
    anchor: Array
    """`[..., M, 3]` registered markers when the corrections were set."""
    prior: Array
    """`[..., 3, 3]` anchor_from_template before the corrections were set: what the registration
    follows as long as the visible set is the same, where markers do not determine it."""
    drift: Array
    """`[..., M]` metres: how far the posture had gone, when the corrections were set, since the
    marker was measured; as far as the table of expected errors goes for one that never was."""
    change: Array
    """`[...]` metres, RMS of the visible markers: how far it has gone since; 0 with none hidden."""
