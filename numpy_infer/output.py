"""What the tracker says of a frame: the wrist's pose, joints, status, and how far off it may be.
Twin of `jaxhand.output`."""

from __future__ import annotations

from typing import Any

import numpy as np

from numpy_infer.arrays import Array
from numpy_infer.geometry import kabsch, mirror, mirror_rotation
from numpy_infer.joints import joint_stage
from numpy_infer.model import ERROR_AGES, Model
from numpy_infer.pose import HandPose, Notice, State, Status, TrackingState
from numpy_infer.predictors import PREDICTORS

HUGE = 1.0
"""Metres in the registered frame: no hand is this big; coordinates that say so are millimetres."""


def wrist_pose(model: Model, output: Array, prior: Array) -> tuple[Array, Array]:
    """The wrist's rotation `[..., 3, 3]` and position `[..., 3]`, from all markers."""
    template = model.body.template.astype(output.dtype, copy=False)
    alignment = model.hand.alignment_weight.astype(output.dtype, copy=False)
    return kabsch(template, output, alignment, prior)


def hand_pose(model: Model, state: State, late: Array) -> HandPose:
    """The output of a frame as the hand's own side has it, in arrays of the caller's own."""
    visible, tracking = state.visible, state.tracking
    filled = np.full(tracking.shape, int(Status.HELD))
    if PREDICTORS[model.predictor].uses_frame:
        filled[tracking] = Status.PREDICTED
    status = ~visible * filled[..., None]
    notice = late * int(Notice.NON_POSITIVE_DT)
    if np.count_nonzero(state.rejected):
        status = np.where(state.rejected, int(Status.REJECTED), status)
        notice = notice | state.rejected.any(-1) * int(Notice.REJECTED_MARKERS)
    found = np.zeros_like(filled)
    if np.count_nonzero(tracking) < tracking.size:
        seen = visible.any(-1) & state.tracked
        found = np.where(seen, int(TrackingState.DEGRADED), int(TrackingState.LOST))
        found[tracking] = TrackingState.TRACKING
    size = np.abs(state.seen)
    if size.max() > HUGE:
        notice = notice | (size.max((-1, -2)) > HUGE) * int(Notice.SUSPECTED_MILLIMETRES)
    pose = HandPose(
        markers=state.output.copy(),
        status=status,
        expected_error=_expected_error(model, visible, state.age),
        wrist_rotation=state.wrist_rotation.copy(),
        wrist_position=state.wrist_position.copy(),
        **joint_stage(model, state.output, state.wrist_rotation, state.wrist_position),
        state=found,
        notice=notice,
    )
    return _to_side(pose, state.right) if np.count_nonzero(state.right) else pose


def _expected_error(model: Model, visible: Array, age: Array) -> Array:
    """`[..., M]` metres, from the model's table by number hidden and age."""
    hidden = ~visible
    if not np.count_nonzero(hidden):
        return np.zeros_like(age)
    table = model.expected_error.astype(age.dtype, copy=False)
    row = np.minimum(np.maximum(hidden.sum(-1), 1), len(table)) - 1
    spent = np.minimum(np.maximum(age[..., None] - _AGES, 0), _AGE_STEPS).astype(age.dtype)
    grown = (spent @ model.error_growth.astype(age.dtype, copy=False)[row][..., None])[..., 0]
    return (table[row, 0][..., None] + grown) * hidden


_AGES = np.array(ERROR_AGES[:-1])
_AGE_STEPS = np.diff(ERROR_AGES)


def _to_side(pose: HandPose, right: Array) -> HandPose:
    """The output as the hand's own side has it."""
    fields: dict[str, Any] = pose._asdict()
    for name, reflect in _REFLECTED.items():
        value: Array = fields[name]
        if value is not None:
            fields[name] = np.where(leading(right, value), reflect(value), value)
    return HandPose(**fields)


_REFLECTED = {
    "markers": mirror,
    "wrist_rotation": mirror_rotation,
    "wrist_position": mirror,
    "rotations": mirror_rotation,
    "positions": mirror,
}


def leading(condition: Array, values: Array) -> Array:
    """`condition [...]` with axes of 1 behind, to go with `values [..., …]`."""
    return condition.reshape(condition.shape + (1,) * (values.ndim - condition.ndim))
