"""What the tracker says of a frame: the wrist's pose, joints, status, and how far off it may be.
Twin of `numpy_infer.output`."""

from __future__ import annotations

from typing import Any

import jax.numpy as jnp

from jaxhand import one_euro
from jaxhand.geometry import kabsch, mirror, mirror_rotation
from jaxhand.joints import joint_stage
from jaxhand.predictors import PREDICTORS
from numpy_infer.arrays import Array
from numpy_infer.model import ERROR_CHANGES, Model
from numpy_infer.one_euro import Smoothing
from numpy_infer.output import HUGE
from numpy_infer.pose import HandPose, Notice, State, Status, TrackingState


def wrist_pose(model: Model, output: Array, prior: Array) -> tuple[Array, Array]:
    """The wrist's rotation `[..., 3, 3]` and position `[..., 3]`, from all markers."""
    template = jnp.asarray(model.body.template, output.dtype)
    alignment = jnp.asarray(model.hand.alignment_weight, output.dtype)
    return kabsch(template, output, jnp.broadcast_to(alignment, output.shape[:-1]), prior)


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
    uses_frame = PREDICTORS[model.predictor].uses_frame
    filled = jnp.where(state.tracking & uses_frame, int(Status.PREDICTED), int(Status.HELD))
    status = jnp.where(state.visible, int(Status.OBSERVED), filled[..., None])
    seen = state.visible.any(-1) & state.tracked
    degraded = jnp.where(seen, int(TrackingState.DEGRADED), int(TrackingState.LOST))
    huge = jnp.abs(state.seen).max((-1, -2)) > HUGE
    pose = HandPose(
        markers=state.output,
        status=jnp.where(state.rejected, int(Status.REJECTED), status),
        expected_error=_expected_error(model, state),
        wrist_rotation=state.wrist_rotation,
        wrist_position=state.wrist_position,
        **joint_stage(model, state.output, state.wrist_rotation, state.wrist_position),
        state=jnp.where(state.tracking, int(TrackingState.TRACKING), degraded),
        notice=jnp.where(huge, int(Notice.SUSPECTED_MILLIMETRES), 0)
        | jnp.where(late, int(Notice.NON_POSITIVE_DT), 0)
        | jnp.where(state.rejected.any(-1), int(Notice.REJECTED_MARKERS), 0),
    )
    return _to_side(pose, state.right)


def _expected_error(model: Model, state: State) -> Array:
    """`[..., M]` metres: the marker's share of the model's table by number hidden and change of
    posture, and what its correction has lost, both bent to where no marker is off further, beside
    the data's own noise; of a visible one what is left of its way back."""
    dtype = state.drift.dtype
    table = jnp.asarray(model.expected_error, dtype)
    hidden = (~state.visible).sum(-1)
    row = table[jnp.clip(hidden, 1, len(table)) - 1][..., None, :]
    changes = jnp.array(ERROR_CHANGES, dtype)
    gone = (state.drift + state.change[..., None])[..., None]
    share = jnp.clip((gone - changes[:-1]) / (changes[1:] - changes[:-1]), 0, 1)
    off = row[..., 0] + ((row[..., 1:] - row[..., :-1]) * share).sum(-1)
    off = off if model.marker_error is None else off * jnp.asarray(model.marker_error, dtype)
    faded = model.faded_error * (1 - jnp.exp(-state.change / model.fade))
    length = jnp.sqrt((state.correction * state.correction).sum(-1))
    returning = length if model.continuity else 0
    off = off + faded[..., None] * length
    error = model.least_error + off / (1 + model.error_saturation * off)
    return jnp.where(state.visible, returning, error)


def _to_side(pose: HandPose, right: Array) -> HandPose:
    """The output as the hand's own side has it."""
    fields: dict[str, Any] = pose._asdict()
    for name, reflect in _REFLECTED.items():
        value: Array = fields[name]
        if value is not None:
            fields[name] = jnp.where(leading(right, value), reflect(value), value)
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
