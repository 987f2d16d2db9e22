"""What the tracker says of a frame: the wrist's pose, joints, status, and how far off it may be.
Twin of `jaxhand.output`."""

from __future__ import annotations

from typing import Any

import numpy as np

from numpy_infer import one_euro
from numpy_infer.arrays import Array, every, some
from numpy_infer.geometry import PRIOR_STRENGTH, kabsch, mirror, mirror_rotation, refit, squares
from numpy_infer.joints import joint_stage
from numpy_infer.model import ERROR_CHANGES, Model
from numpy_infer.one_euro import Smoothing
from numpy_infer.pose import HandPose, Notice, State, Status, TrackingState
from numpy_infer.predictors import PREDICTORS
from numpy_infer.sight import aligned

# As numbers: an enumeration's members are slow to reckon with.
_PREDICTED, _HELD, _REJECTED = map(int, (Status.PREDICTED, Status.HELD, Status.REJECTED))
_TRACKING, _DEGRADED, _LOST = map(int, TrackingState)
_NON_POSITIVE_DT, _SUSPECTED_MILLIMETRES, _REJECTED_MARKERS = map(
    int, (Notice.NON_POSITIVE_DT, Notice.SUSPECTED_MILLIMETRES, Notice.REJECTED_MARKERS)
)

HUGE = 1.0
"""Metres in the registered frame: no hand is this big; coordinates that say so are millimetres."""


def wrist_pose(model: Model, output: Array, prior: Array) -> tuple[Array, Array]:
    """The wrist's rotation `[..., 3, 3]` and position `[..., 3]`, from all markers."""
    rotation, position, second = refit(aligned(model.hand, model.body, output.dtype.char), output)
    if second.min() < 2 * PRIOR_STRENGTH:
        template = model.body.template.astype(output.dtype, copy=False)
        alignment = model.hand.alignment_weight.astype(output.dtype, copy=False)
        return kabsch(template, output, alignment, prior)
    return rotation[..., 0, :, :], position[..., 0, :]


def smoothed(model: Model, smoothing: Smoothing, state: State, dt: Array) -> tuple[State, State]:
    """The state after the output filter's frame, and the same with what is to be shown in it."""
    # What the template stands in for is no past of the hand's.
    own = state.smoothing._replace(begun=state.smoothing.begun & state.tracked)
    own, output = one_euro.step(smoothing, own, state.output, dt)
    rotation, position = wrist_pose(model, output, state.wrist_rotation)
    state = state._replace(smoothing=own)
    return state, state._replace(output=output, wrist_rotation=rotation, wrist_position=position)


def hand_pose(model: Model, state: State, late: Array) -> HandPose:
    """The output of a frame as the hand's own side has it, in arrays of the caller's own."""
    visible, tracking = state.visible, state.tracking
    filled: Array | int = _PREDICTED if PREDICTORS[model.predictor].uses_frame else _HELD
    found = np.zeros(tracking.shape, int)
    if not every(tracking):
        filled = np.where(tracking, filled, _HELD)[..., None]
        seen = visible.any(-1) & state.tracked
        found = np.where(tracking, _TRACKING, np.where(seen, _DEGRADED, _LOST))
    status, notice = ~visible * filled, np.zeros(late.shape, int)
    if some(late):
        notice = late * _NON_POSITIVE_DT
    if np.count_nonzero(state.rejected):
        status = np.where(state.rejected, _REJECTED, status)
        notice = notice | state.rejected.any(-1) * _REJECTED_MARKERS
    size = np.abs(state.seen)
    if np.count_nonzero(size > HUGE):
        notice = notice | (size.max((-1, -2)) > HUGE) * _SUSPECTED_MILLIMETRES
    pose = HandPose(
        markers=state.output.copy(),
        status=status,
        expected_error=_expected_error(model, state),
        wrist_rotation=state.wrist_rotation.copy(),
        wrist_position=state.wrist_position.copy(),
        **joint_stage(model, state.output, state.wrist_rotation, state.wrist_position),
        state=found,
        notice=notice,
    )
    return _to_side(pose, state.right) if some(state.right) else pose


def _expected_error(model: Model, state: State) -> Array:
    """`[..., M]` metres: the marker's share of the model's table by number hidden and change of
    posture, and what its correction has lost, both bent to where no marker is off further, beside
    the data's own noise; of a visible one what is left of its way back."""
    hidden, dtype = ~state.visible, state.drift.dtype
    some_hidden = np.count_nonzero(hidden)
    if not (some_hidden or np.count_nonzero(state.correction)):
        return np.zeros_like(state.drift)
    length = np.sqrt(squares(state.correction))
    returning = length if model.continuity else np.zeros_like(length)
    if not some_hidden:
        return returning
    row, (changes, errors) = model.error_rows.take(np.add.reduce(hidden, -1)), model.error_line
    gone = np.minimum(state.drift + state.change[..., None], ERROR_CHANGES[-1])
    error = np.interp(gone + row[..., None], changes, errors) * model.error_factors
    if model.faded_error:
        faded = model.faded_error * (1 - np.exp(-state.change / model.fade))
        error += faded[..., None] * length
    error = model.least_error + error / (1 + model.error_saturation * error)
    return np.where(hidden, error, returning).astype(dtype, copy=False)


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
