"""From one frame to the next: registration, what fills hidden markers, and the blend that lets no
output jump. Twin of `numpy_infer.continuity`.

Continuity is a blend at the output. `raw` is measured where visible and predicted from measured
markers where hidden; in the registered frame `output = raw + correction`. While the visible set is
unchanged the correction of a visible marker shrinks at 25 cm/s (paper, section 3.2.2) and that of
a hidden one fades with posture, `exp(−d/δ)`, d the RMS change of the registered visible markers.
When the set changes, the previous frame is done again with the new set, and what is missing to the
previous output becomes the correction; so the output goes on from where it was.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxhand import gate
from jaxhand.geometry import (
    apart,
    kabsch,
    mean_point,
    product,
    second_extent,
    transform,
    untransform,
)
from jaxhand.output import leading, wrist_pose
from jaxhand.predictors import PREDICTORS
from numpy_infer.arrays import Array
from numpy_infer.continuity import (
    DRIFT_UNSEEN,
    FARTHEST_CORRECTION,
    SAME_POSTURE,
    SHRINK_SPEED,
)
from numpy_infer.model import Model
from numpy_infer.pose import DETERMINED_EXTENT, State


def advance(
    model: Model, state: State, markers: Array, visible: Array, dt: Array, late: Array
) -> State:
    """The state after a frame of clean input."""
    own, accepted = state.gate, visible
    if model.gate:
        own, accepted = gate.step(
            model, state.gate, markers, visible, state.output, state.tracked, dt
        )
        markers = jnp.where(accepted[..., None], markers, 0)
    new_state = _track(model, state, markers, accepted, dt)
    new_state = new_state._replace(gate=own, rejected=visible & ~accepted)
    same = (accepted == state.visible).all(-1) & (markers == state.markers).all((-1, -2))
    return choose(late & state.known.any(-1) & same, state, new_state)


def _track(model: Model, state: State, markers: Array, visible: Array, dt: Array) -> State:
    """The state after a frame of clean input of a left hand."""
    weight = visible.astype(markers.dtype)
    template = jnp.asarray(model.hand.template, markers.dtype)
    tracking = second_extent(markers, weight) > DETERMINED_EXTENT
    both = visible & state.visible
    shift = mean_point(markers - state.markers, both.astype(markers.dtype))
    changed = (visible != state.visible).any(-1) | (tracking != state.tracking)
    rotation, translation = apart(
        _register(state, template, markers, weight, changed, tracking, shift)
    )
    # Before there was any output the template stands in for it.
    placed = transform(rotation, translation, template)
    last = jnp.where(state.tracked[..., None, None], state.output, placed)
    redone = apart(
        _redo(model, state, markers, visible, tracking, shift, last, rotation, translation)
    )
    before = _registration_before(state, redone, changed, rotation, translation)
    advance, raw = apart(
        _fill(model, state.predictor, markers, visible, last, dt, (rotation, translation), before)
    )
    held = jnp.where(state.tracked[..., None, None], last + shift[..., None, :], placed)
    raw = jnp.where(tracking[..., None, None], raw, held)
    raw = jnp.where(visible[..., None], markers, raw)
    registered = apart(untransform(rotation, translation, raw))

    correction, anchor, seen = state.correction, state.anchor, state.seen
    restart = (changed & state.tracked)[..., None, None]
    correction = jnp.where(restart, redone.correction, correction)
    anchor = jnp.where(restart, redone.anchor, anchor)
    seen = jnp.where((changed & tracking & state.tracked)[..., None, None], redone.seen, seen)
    begin = ~state.tracked[..., None, None]
    prior = jnp.where(restart, redone.prior, state.prior)
    prior = jnp.where(begin, product(rotation.swapaxes(-1, -2), state.rotation), prior)
    correction = jnp.where(begin, 0, correction)
    anchor = jnp.where(begin, registered, anchor)
    seen = jnp.where(begin & ~visible[..., None], template, seen)
    seen = jnp.where(visible[..., None], registered, seen)
    correction, anchor, seen = apart((correction, anchor, seen))

    change = _change(anchor, registered, visible)
    if model.continuity:
        correction, blend = _blend(model, correction, change, visible, tracking, dt)
        blended = transform(rotation, translation, registered + blend)
        raw = jnp.where((blend != 0).any(-1, keepdims=True), blended, raw)

    wrist = apart(wrist_pose(model, raw, rotation))
    gone = jnp.where(state.visible, 0, state.drift + state.change[..., None])
    drift = jnp.where(changed[..., None], gone, state.drift)
    drift = drift + jnp.where(tracking, 0, DRIFT_UNSEEN * dt)[..., None]
    return State(
        right=state.right,
        gate=state.gate,
        rejected=jnp.zeros_like(visible),
        predictor=advance,
        smoothing=state.smoothing,
        output=raw,
        wrist_rotation=wrist[0],
        wrist_position=wrist[1],
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
        drift=jnp.where(visible, 0, drift),
        change=change,
    )


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
    start = jnp.where(seen_any, centred, state.translation)
    moved = jnp.where(state.tracked[..., None], state.translation + shift, start)
    rotation = jnp.where(tracking[..., None, None], found_rotation, state.rotation)
    return rotation, jnp.where(tracking[..., None], found_translation, moved)


def _carried_prior(state: State, markers: Array, weight: Array, changed: Array) -> Array:
    """`[..., 3, 3]` world_from_template that the registration follows where the template's visible
    markers are near a line. The previous rotation would not do while the set stays the same: each
    frame would give it up a little more, and a hand that stands still would turn."""
    turn, _ = kabsch(state.anchor, markers, weight, state.rotation)
    return jnp.where(changed[..., None, None], state.rotation, product(turn, state.prior))


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
    """One step of the model's predictor; one that looks at this frame alone is spared a second
    registration.

    What a predictor that goes by the frame has nothing to say of moves with the hand: from the
    registration `before`, of the previous frame by the same markers, to that of this frame.
    """
    chosen = PREDICTORS[model.predictor]
    if chosen.of_frame is not None:
        said = chosen.of_frame(model, untransform(*registration, markers), visible)
        moved = transform(*registration, said)
        return predictor, jnp.where(visible[..., None], markers, moved)
    if chosen.uses_frame:
        last = transform(*registration, untransform(*before, last))
    return chosen.step(model, predictor, markers, visible, last, dt)


def _registration_before(
    state: State, redone: _Redone, changed: Array, rotation: Array, translation: Array
) -> tuple[Array, Array]:
    """The previous frame's registration by the markers visible now; this frame's own for a hand
    that had not been tracked."""
    parts = (
        (redone.rotation, state.rotation, rotation),
        (redone.translation, state.translation, translation),
    )
    return tuple(
        choose(state.tracked, choose(changed, again, earlier), now) for again, earlier, now in parts
    )


class _Redone(NamedTuple):
    """The previous frame, done with this frame's visible set."""

    rotation: Array
    """`[..., 3, 3]` world_from_template."""
    translation: Array
    """`[..., 3]` its translation."""
    correction: Array
    anchor: Array
    seen: Array
    prior: Array
    """What `State` keeps under these names, but that `seen` is in this frame's registration."""


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
) -> _Redone:
    """The previous frame, done with this frame's visible set.

    A marker hidden then takes its position of now, carried back by the hand's motion since.
    """
    dtype = markers.dtype
    template = jnp.asarray(model.hand.template, dtype)
    before = transform(state.rotation, state.translation, state.seen)
    before = jnp.where(state.visible[..., None], state.markers, before)
    turn, move = apart(_motion(state, before, markers, visible, tracking, shift))
    returned = untransform(turn, move, markers)
    returned = jnp.where(state.visible[..., None], state.markers, returned)
    previous: Array = apart(jnp.where(visible[..., None], returned, 0))
    # The prior is that of now, carried back too: if only the set has changed, so has nothing else.
    prior = product(jnp.swapaxes(turn, -1, -2), state.rotation)
    found = kabsch(template, previous, visible.astype(dtype), prior)
    then_rotation = jnp.where(tracking[..., None, None], found[0], state.rotation)
    then_translation = jnp.where(tracking[..., None], found[1], state.translation)
    then = (then_rotation, then_translation)
    _, filled = _fill(
        model, state.predictor, previous, visible, last, jnp.zeros_like(shift[..., 0]), then, then
    )
    raw = jnp.where((tracking[..., None] | visible)[..., None], filled, last)
    correction = untransform(*then, last) - untransform(*then, raw)
    length = jnp.sqrt((correction * correction).sum(-1, keepdims=True))
    correction = jnp.where(length < FARTHEST_CORRECTION, correction, 0)
    seen = untransform(rotation, translation, transform(turn, move, before))
    followed = product(then_rotation.swapaxes(-1, -2), prior)
    return _Redone(*then, correction, untransform(*then, previous), seen, followed)


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
    eye = jnp.broadcast_to(jnp.eye(3, dtype=dtype), state.rotation.shape)
    earlier = (visible & state.known).astype(dtype)
    turn, move = kabsch(before, markers, earlier, eye)
    misfit = mean_point((transform(turn, move, before) - markers) ** 2, earlier).sum(-1)
    believed = tracking & (~state.tracking | (misfit < SAME_POSTURE**2)) & (earlier > 0).any(-1)
    turn = jnp.where(believed[..., None, None], turn, eye)
    move = jnp.where(believed[..., None], move, shift)
    seen_turn, seen_move = kabsch(before, markers, both, turn)
    decide = tracking & (both > 0).any(-1)
    return (
        jnp.where(decide[..., None, None], seen_turn, turn),
        jnp.where(decide[..., None], seen_move, move),
    )


def _change(anchor: Array, registered: Array, visible: Array) -> Array:
    """`[...]` metres, RMS: how far the visible markers have gone in the registered frame since the
    corrections were set; 0 where none is hidden."""
    difference = jnp.where(visible[..., None], registered - anchor, 0)
    seen = jnp.maximum(visible.sum(-1), 1).astype(registered.dtype)
    distance = jnp.sqrt((difference * difference).sum((-1, -2)) / seen)
    return jnp.where(visible.all(-1), 0, distance)


def _blend(
    model: Model,
    correction: Array,
    change: Array,
    visible: Array,
    tracking: Array,
    dt: Array,
) -> tuple[Array, Array]:
    """The corrections to keep, and those to add now; `[..., M, 3]`, registered frame."""
    length = jnp.sqrt((correction * correction).sum(-1))
    left = jnp.maximum(length - SHRINK_SPEED * dt[..., None], 0)
    share = jnp.where(visible & (length > 0), left / jnp.where(length > 0, length, 1), 1)
    correction = correction * share[..., None]
    fade = jnp.where(tracking, jnp.exp(-change / model.fade), 0)
    blend = jnp.where(visible[..., None], correction, correction * fade[..., None, None])
    return correction, blend


def choose(condition: Array, yes: Any, no: Any) -> Any:
    """`where` over equal trees; `condition [...]` is broadcast from the left."""
    return jax.tree.map(lambda a, b: jnp.where(leading(condition, a), a, b), yes, no)
