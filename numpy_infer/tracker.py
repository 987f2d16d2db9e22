"""The pipeline of one frame, as pure `init` and `step`. Twin of `jaxhand.tracker`.

Register the visible markers → fill the hidden ones → continuity → hand pose from the alignment
markers → joint angles → calibration → forward kinematics → finger alignment. (The
gate before is the identity as yet.)

Continuity is a blend at the output. `raw` is measured where visible and predicted from measured
markers where hidden; in the registered frame `output = raw + correction`. While the visible set is
unchanged the correction of a visible marker shrinks at 25 cm/s (paper, section 3.2.2) and that of
a hidden one fades with posture, `exp(−d/δ)`, d the RMS change of the registered visible markers.
When the set changes, the previous frame is done again with the new set, and what is missing to the
previous output becomes the correction; so the output goes on from where it was.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from numpy_infer import wearer
from numpy_infer.arrays import Array
from numpy_infer.geometry import (
    kabsch,
    mean_point,
    mirror,
    mirror_rotation,
    second_extent,
    transform,
    untransform,
)
from numpy_infer.hand import Hand
from numpy_infer.joints import joint_stage
from numpy_infer.model import ERROR_AGES, Model, load
from numpy_infer.pose import HandPose, Notice, Redone, State, Status, TrackingState
from numpy_infer.predictors import PREDICTORS, learned_step

SHRINK_SPEED = 0.25
"""m/s at which the correction of a visible marker dies (paper, section 3.2.2)."""

DETERMINED_EXTENT = 5e-3
"""Metres: visible markers whose second extent is smaller are as good as collinear."""

SAME_POSTURE = 1e-4
"""Metres, RMS: markers that fit this well where they were seen last tell how the hand turned."""

FARTHEST = 1e5
"""Metres: no coordinate is larger; one that is would overflow where it is squared."""

LONGEST = 3600.0
"""Seconds: a longer pause counts as this one, so that nothing extrapolated overflows."""

HUGE = 1.0
"""Metres in the registered frame: no hand is this big; coordinates that say so are millimetres."""


def init(model: Model, batch: tuple[int, ...] = (), right: Array = False) -> State:
    """A tracker that has seen nothing.

    Args:
        model: what to run.
        batch: leading shape of everything: () for one hand, (hands,) for several.
        right: True for a right hand; broadcast to `batch`.

    Raises:
        ValueError: the model's predictor is not known.
    """
    if model.predictor not in PREDICTORS:
        raise ValueError(
            f"unknown predictor {model.predictor!r}: expected one of {', '.join(PREDICTORS)}"
        )
    template = np.broadcast_to(model.hand.template, (*batch, *model.hand.template.shape))
    dtype, count = template.dtype, len(model.hand)
    eye = np.broadcast_to(np.eye(3, dtype=dtype), (*batch, 3, 3))
    origin = np.zeros((*batch, 3), dtype)
    lost = np.full(batch, int(TrackingState.LOST))
    never = np.zeros((*batch, count), bool)
    pose = HandPose(
        markers=template,
        status=np.full((*batch, count), int(Status.HELD)),
        expected_error=np.zeros((*batch, count), dtype),
        wrist_rotation=eye,
        wrist_position=origin,
        **joint_stage(model, template, eye, origin),
        state=lost,
        notice=np.zeros(batch, int),
    )
    return State(
        right=np.broadcast_to(np.asarray(right, bool), batch),
        predictor=PREDICTORS[model.predictor].init(model, batch),
        pose=pose,
        markers=np.zeros_like(template),
        visible=never,
        tracked=np.zeros(batch, bool),
        tracking=np.zeros(batch, bool),
        rotation=eye,
        translation=origin,
        seen=template,
        known=never,
        correction=np.zeros_like(template),
        anchor=template,
        prior=eye,
        age=np.full((*batch, count), ERROR_AGES[-1], dtype),
    )


def step(
    model: Model, state: State, markers: Array, visible: Array, dt: Array
) -> tuple[State, HandPose]:
    """Takes in one frame.

    Args:
        model: what to run.
        state: from `init` or the previous `step`.
        markers: `[..., M, 3]` metres, world; a marker with a coordinate that is not finite, or
            beyond all measure (`FARTHEST`), is hidden.
        visible: `[..., M]` True where measured; hidden coordinates are never read.
        dt: `[...]` seconds since the previous frame. If it is not positive nothing that runs on
            time moves, and the same markers again change nothing.
    """
    dtype = state.markers.dtype
    visible = visible & (np.abs(markers) < FARTHEST).all(-1)
    markers = np.where(visible[..., None], markers, 0).astype(dtype, copy=False)
    if state.right.any():
        markers = np.where(state.right[..., None, None], mirror(markers), markers)
    late = ~(dt > 0)
    elapsed = np.where(late, 0, np.minimum(dt, LONGEST)).astype(dtype, copy=False)
    new_state = _track(model, state, markers, visible, elapsed)
    if late.any():
        same = (visible == state.visible).all(-1) & (markers == state.markers).all((-1, -2))
        new_state = _where(late & state.known.any(-1) & same, state, new_state)
    return new_state, _to_side(new_state, _notice(new_state, late))


def _track(model: Model, state: State, markers: Array, visible: Array, dt: Array) -> State:
    """The state after a frame of clean input of a left hand; its `pose` is the output."""
    weight = visible.astype(markers.dtype)
    template = model.hand.template.astype(markers.dtype, copy=False)
    tracking = second_extent(markers, weight) > DETERMINED_EXTENT
    changed = (visible != state.visible).any(-1) | (tracking != state.tracking)
    correction, anchor, seen = state.correction, state.anchor, state.seen
    prior = state.prior
    # In most frames all hands are tracked as in the frame before, and need none of the rest.
    steady = bool(tracking.all()) and not changed.any()
    if steady:
        rotation, translation = kabsch(
            template, markers, weight, lambda: _carried_prior(state, markers, weight, changed)
        )
        last, before = state.pose.markers, (state.rotation, state.translation)
    else:
        both = (visible & state.visible).astype(markers.dtype)
        shift = mean_point(markers - state.markers, both)
        rotation, translation = _register(
            state, template, markers, weight, changed, tracking, shift
        )
        # Before there was any output the template stands in for it.
        placed = transform(rotation, translation, template)
        last = np.where(state.tracked[..., None, None], state.pose.markers, placed)
        redone = _redo(model, state, markers, visible, tracking, shift, last, rotation, translation)
        before = _registration_before(state, redone, changed, rotation, translation)
    advance, raw = _fill(
        model, state.predictor, markers, visible, last, dt, (rotation, translation), before
    )
    if not steady:
        held = np.where(state.tracked[..., None, None], last + shift[..., None, :], placed)
        raw = np.where(tracking[..., None, None], raw, held)
        raw = np.where(visible[..., None], markers, raw)
    registered = untransform(rotation, translation, raw)
    if not steady:
        restart = (changed & state.tracked)[..., None, None]
        correction = np.where(restart, redone.correction, correction)
        anchor = np.where(restart, redone.anchor, anchor)
        seen = np.where((changed & tracking & state.tracked)[..., None, None], redone.seen, seen)
        begin = ~state.tracked[..., None, None]
        prior = np.where(restart, redone.prior, prior)
        prior = np.where(begin, rotation.swapaxes(-1, -2) @ state.rotation, prior)
        correction = np.where(begin, 0, correction)
        anchor = np.where(begin, registered, anchor)
        seen = np.where(begin & ~visible[..., None], template, seen)
    seen = np.where(visible[..., None], registered, seen)

    if model.continuity:
        correction, blend = _blend(model, correction, anchor, registered, visible, tracking, dt)
        blended = transform(rotation, translation, registered + blend)
        raw = np.where((blend != 0).any(-1, keepdims=True), blended, raw)

    age = np.where(visible, 0, state.age + dt[..., None])
    new_state = State(
        right=state.right,
        predictor=advance,
        pose=state.pose,
        markers=markers,
        visible=visible,
        tracked=state.tracked | tracking,
        tracking=tracking,
        rotation=rotation,
        translation=translation,
        seen=seen,
        known=state.known | visible,
        correction=correction,
        anchor=anchor,
        prior=prior,
        age=age,
    )
    return new_state._replace(pose=_pose(model, new_state, raw))


def _register(
    state: State,
    template: Array,
    markers: Array,
    weight: Array,
    changed: Array,
    tracking: Array,
    shift: Array,
) -> tuple[Array, Array]:
    """`world_from_template` of the visible markers; where they do not determine it, the previous
    one moved along with them, and before there was one, the template at their mean."""
    found_rotation, found_translation = kabsch(
        template, markers, weight, lambda: _carried_prior(state, markers, weight, changed)
    )
    seen_any = (weight > 0).any(-1)[..., None]
    centred = mean_point(markers, weight) - mean_point(template, weight)
    start = np.where(seen_any, centred, state.translation)
    moved = np.where(state.tracked[..., None], state.translation + shift, start)
    rotation = np.where(tracking[..., None, None], found_rotation, state.rotation)
    return rotation, np.where(tracking[..., None], found_translation, moved)


def _carried_prior(state: State, markers: Array, weight: Array, changed: Array) -> Array:
    """`[..., 3, 3]` world_from_template that the registration follows where the template's visible
    markers are near a line. The previous rotation would not do while the set stays the same: each
    frame would give it up a little more, and a hand that stands still would turn."""
    turn, _ = kabsch(state.anchor, markers, weight, state.rotation)
    return np.where(changed[..., None, None], state.rotation, turn @ state.prior)


def _fill(
    model: Model,
    predictor: Any,
    markers: Array,
    visible: Array,
    last: Array,
    dt: Array,
    registration: tuple[Array, Array],
    before: tuple[Array, Array],
) -> tuple[Any, Array]:
    """One step of the model's predictor; the learned one is spared a second registration.

    What a predictor that goes by the frame has nothing to say of moves with the hand: from the
    registration `before`, of the previous frame by the same markers, to that of this frame.
    """
    chosen = PREDICTORS[model.predictor]
    if chosen.step is learned_step:
        return learned_step(model, predictor, markers, visible, last, dt, registration)
    if chosen.uses_frame:
        last = transform(*registration, untransform(*before, last))
    return chosen.step(model, predictor, markers, visible, last, dt)


def _registration_before(
    state: State, redone: Redone, changed: Array, rotation: Array, translation: Array
) -> tuple[Array, Array]:
    """The previous frame's registration by the markers visible now; this frame's own for a hand
    that had not been tracked."""
    parts = (
        (redone.rotation, state.rotation, rotation),
        (redone.translation, state.translation, translation),
    )
    return tuple(
        _where(state.tracked, _where(changed, again, earlier), now) for again, earlier, now in parts
    )


def _redo(
    model: Model,
    state: State,
    markers: Array,
    visible: Array,
    tracking: Array,
    shift: Array,
    last: Array,
    rotation: Array,
    translation: Array,
) -> Redone:
    """The previous frame, done with this frame's visible set.

    A marker hidden then takes its position of now, carried back by the hand's motion since.
    """
    dtype = markers.dtype
    template = model.hand.template.astype(dtype, copy=False)
    before = transform(state.rotation, state.translation, state.seen)
    before = np.where(state.visible[..., None], state.markers, before)
    turn, move = _motion(state, before, markers, visible, tracking, shift)
    returned = untransform(turn, move, markers)
    returned = np.where(state.visible[..., None], state.markers, returned)
    previous: Array = np.where(visible[..., None], returned, 0)
    # The prior is that of now, carried back too: if only the set has changed, so has nothing else.
    prior = np.swapaxes(turn, -1, -2) @ state.rotation
    found = kabsch(template, previous, visible.astype(dtype), prior)
    then_rotation: Array = np.where(tracking[..., None, None], found[0], state.rotation)
    then_translation = np.where(tracking[..., None], found[1], state.translation)
    then = (then_rotation, then_translation)
    _, filled = _fill(
        model, state.predictor, previous, visible, last, np.zeros_like(shift[..., 0]), then, then
    )
    raw = np.where((tracking[..., None] | visible)[..., None], filled, last)
    correction = untransform(*then, last) - untransform(*then, raw)
    seen = untransform(rotation, translation, transform(turn, move, before))
    followed = then_rotation.swapaxes(-1, -2) @ prior
    return Redone(*then, correction, untransform(*then, previous), seen, followed)


def _motion(
    state: State, before: Array, markers: Array, visible: Array, tracking: Array, shift: Array
) -> tuple[Array, Array]:
    """The hand's rigid motion since the previous frame, from the markers seen in both.

    What those leave open follows where the visible markers were seen last (`before [..., M, 3]`,
    carried along with the hand since), if the hand had been lost or if they fit without a change of
    posture; a posture that has changed says nothing of a rotation, so otherwise there is none.
    """
    dtype = markers.dtype
    both = (visible & state.visible).astype(dtype)
    eye = np.broadcast_to(np.eye(3, dtype=dtype), state.rotation.shape)
    earlier = (visible & state.known).astype(dtype)
    turn, move = kabsch(before, markers, earlier, eye)
    misfit = mean_point((transform(turn, move, before) - markers) ** 2, earlier).sum(-1)
    believed = tracking & (~state.tracking | (misfit < SAME_POSTURE**2)) & (earlier > 0).any(-1)
    turn = np.where(believed[..., None, None], turn, eye)
    move = np.where(believed[..., None], move, shift)
    seen_turn, seen_move = kabsch(before, markers, both, turn)
    decide = tracking & (both > 0).any(-1)
    return (
        np.where(decide[..., None, None], seen_turn, turn),
        np.where(decide[..., None], seen_move, move),
    )


def _blend(
    model: Model,
    correction: Array,
    anchor: Array,
    registered: Array,
    visible: Array,
    tracking: Array,
    dt: Array,
) -> tuple[Array, Array]:
    """The corrections to keep, and those to add now; `[..., M, 3]`, registered frame."""
    length = np.sqrt((correction * correction).sum(-1))
    left = np.maximum(length - SHRINK_SPEED * dt[..., None], 0)
    share = np.where(visible & (length > 0), left / np.where(length > 0, length, 1), 1)
    correction = correction * share[..., None]
    difference = np.where(visible[..., None], registered - anchor, 0)
    seen = np.maximum(visible.sum(-1), 1).astype(registered.dtype)
    distance = np.sqrt((difference * difference).sum((-1, -2)) / seen)
    fade = np.where(tracking, np.exp(-distance / model.fade), 0)
    blend = np.where(visible[..., None], correction, correction * fade[..., None, None])
    return correction, blend


def _pose(model: Model, state: State, output: Array) -> HandPose:
    """The output of a frame, for a left hand, from its markers `[..., M, 3]`."""
    template = model.body.template.astype(output.dtype, copy=False)
    alignment = model.hand.alignment_weight.astype(output.dtype, copy=False)
    rotation, position = kabsch(template, output, alignment, state.rotation)
    uses_frame = PREDICTORS[model.predictor].uses_frame
    filled = np.where(state.tracking & uses_frame, int(Status.PREDICTED), int(Status.HELD))
    status = np.where(state.visible, int(Status.OBSERVED), filled[..., None])
    seen_any = state.visible.any(-1)
    degraded = np.where(
        seen_any & state.tracked, int(TrackingState.DEGRADED), int(TrackingState.LOST)
    )
    return HandPose(
        markers=output,
        status=status,
        expected_error=_expected_error(model, state.visible, state.age),
        wrist_rotation=rotation,
        wrist_position=position,
        **joint_stage(model, output, rotation, position),
        state=np.where(state.tracking, int(TrackingState.TRACKING), degraded),
        notice=np.zeros(seen_any.shape, int),
    )


def _expected_error(model: Model, visible: Array, age: Array) -> Array:
    """`[..., M]` metres, from the model's table by number hidden and age."""
    if visible.all():
        return np.zeros_like(age)
    table = model.expected_error.astype(age.dtype, copy=False)
    row = table[np.minimum(np.maximum((~visible).sum(-1), 1), len(table)) - 1][..., None, :]
    share = (age[..., None] - _AGES[:-1].astype(age.dtype, copy=False)) / _AGE_STEPS
    share = np.minimum(np.maximum(share, 0), 1).astype(age.dtype, copy=False)
    error = row[..., 0] + ((row[..., 1:] - row[..., :-1]) * share).sum(-1)
    return np.where(visible, 0, error)


_AGES = np.array(ERROR_AGES)
_AGE_STEPS = np.diff(_AGES)


def _notice(state: State, late: Array) -> Array:
    huge = np.abs(state.seen).max((-1, -2)) > HUGE
    flags = np.where(huge, int(Notice.SUSPECTED_MILLIMETRES), 0)
    return flags | np.where(late, int(Notice.NON_POSITIVE_DT), 0)


def _to_side(state: State, notice: Array) -> HandPose:
    """The output as the hand's own side has it, in arrays of the caller's own."""
    fields = {k: None if v is None else v.copy() for k, v in state.pose._asdict().items()}
    if state.right.any():
        for name, reflect in _REFLECTED.items():
            value: Array = fields[name]
            if value is not None:
                fields[name] = np.where(_leading(state.right, value), reflect(value), value)
    return HandPose(**fields | {"notice": notice})


_REFLECTED = {
    "markers": mirror,
    "wrist_rotation": mirror_rotation,
    "wrist_position": mirror,
    "rotations": mirror_rotation,
    "positions": mirror,
}


def _where(condition: Array, yes: Any, no: Any) -> Any:
    """`np.where` over equal nested tuples; `condition [...]` is broadcast from the left."""
    if isinstance(yes, tuple):
        parts = [_where(condition, a, b) for a, b in zip(yes, no, strict=True)]
        return type(yes)(*parts) if parts else yes
    if yes is None:
        return None
    return np.where(_leading(condition, yes), yes, no)


def _leading(condition: Array, values: Array) -> Array:
    """`condition [...]` with axes of 1 behind, to go with `values [..., …]`."""
    return condition.reshape(condition.shape + (1,) * (values.ndim - condition.ndim))


class HandTracker:
    """One hand, or several of one model, frame by frame: `init` and `step` with the state inside.

    `tracker = HandTracker.load("glove9"); pose = tracker.step(markers, dt)`
    """

    def __init__(self, model: Model, *, right: bool | Sequence[bool] = False) -> None:
        """`right`: True for a right hand; a sequence, one entry a hand, for several hands.

        Raises:
            ValueError: the model's predictor is not known.
        """
        self.model = model
        self._right = np.asarray(right, bool)
        self._state = init(model, self._right.shape, self._right)

    @classmethod
    def load(
        cls,
        path: str | Path = "glove9",
        *,
        calibration: str | Path | None = None,
        alignment: bool = False,
        right: bool | Sequence[bool] = False,
    ) -> HandTracker:
        """A tracker that runs a model file or, by its name, a bundled model (`model.bundled`), for
        whoever a calibration file describes; with `alignment` fingers are turned towards their
        markers, which takes half as long again.

        Raises:
            ValueError: a file is not what it should be, or damaged; see `model.load` and
                `wearer.load`.
        """
        model = replace(load(path), alignment=alignment)
        if calibration is not None:
            model = wearer.calibrated(model, wearer.load(calibration))
        return cls(model, right=right)

    @property
    def hand(self) -> Hand:
        """The model's hand: marker names in their order, template, skeleton."""
        return self.model.hand

    def reset(self) -> None:
        """Forgets all that was seen."""
        self._state = init(self.model, self._right.shape, self._right)

    def step(self, markers: Array, dt: Array, visible: Array | None = None) -> HandPose:
        """Takes in one frame and gives back the whole hand.

        Args:
            markers: `[M, 3]` (several hands: `[hands, M, 3]`) metres, world, in the order of
                `hand.markers`; NaN where a marker is hidden.
            dt: seconds since the previous frame.
            visible: `[M]` True where measured, if NaN is not to say it.

        Raises:
            ValueError: a wrong shape. Wrong data never raise; they show in the output's `state`,
                `status` and `notice`.
        """
        markers = np.asarray(markers, np.float64)
        expected = (*self._right.shape, len(self.hand), 3)
        if markers.shape != expected:
            raise ValueError(f"markers: expected shape {expected}, received {markers.shape}")
        shown = np.ones(expected[:-1], bool) if visible is None else np.asarray(visible, bool)
        if shown.shape != expected[:-1]:
            raise ValueError(f"visible: expected shape {expected[:-1]}, received {shown.shape}")
        elapsed = np.asarray(dt, np.float64)
        if elapsed.shape != self._right.shape:
            elapsed = np.broadcast_to(elapsed, self._right.shape)
        self._state, pose = step(self.model, self._state, markers, shown, elapsed)
        return pose
