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
from jaxhand.compiled import apart
from jaxhand.geometry import (
    kabsch,
    mean_point,
    product,
    second_extent,
    transform,
    untransform,
)
from jaxhand.output import leading
from jaxhand.predictors import PREDICTORS
from numpy_infer.arrays import Array
from numpy_infer.continuity import (
    DRIFT_UNSEEN,
    FARTHEST_CORRECTION,
    SAME_POSTURE,
    SHRINK_SPEED,
)
from numpy_infer.model import Model
from numpy_infer.output import HUGE
from numpy_infer.pose import DETERMINED_EXTENT, State


def advance(
    model: Model, state: State, markers: Array, visible: Array, dt: Array, late: Array
) -> State:
    """The state after a frame of clean input."""
    # But for the wrist's pose, which nothing here needs.
    own, accepted = state.gate, visible
    if model.gate:
        # What holds markers, or lets them fly on, says nothing of where one comes back.
        told = state.tracked & PREDICTORS[model.predictor].uses_frame
        own, accepted = gate.step(model, state.gate, markers, visible, state.output, told, dt)
        markers = jnp.where(accepted[..., None], markers, 0)
    frame = _frame(model, state, markers, accepted, dt)
    new_state = _blended(model, state, frame, markers, accepted, dt)
    new_state = new_state._replace(gate=own, rejected=visible & ~accepted)
    same = (accepted == state.visible).all(-1) & (markers == state.markers).all((-1, -2))
    return choose(late & state.known.any(-1) & same, state, new_state)


def _blended(
    model: Model, state: State, frame: _Frame, markers: Array, visible: Array, dt: Array
) -> State:
    """The state after a frame: the output, with corrections added."""
    correction, output = frame.correction, frame.raw
    change = _change(frame, visible)
    if model.continuity:
        correction, blend = _blend(model, frame, change, visible, dt)
        moved = transform(frame.rotation, frame.translation, frame.registered + blend)
        output = jnp.where((blend != 0).any(-1, keepdims=True), moved, output)
    return State(
        right=state.right,
        gate=state.gate,
        rejected=jnp.zeros_like(visible),
        predictor=frame.predictor,
        smoothing=state.smoothing,
        output=output,
        wrist_rotation=state.wrist_rotation,
        wrist_position=state.wrist_position,
        markers=markers,
        visible=visible,
        tracked=state.tracked | frame.tracking,
        tracking=frame.tracking,
        rotation=frame.rotation,
        translation=frame.translation,
        seen=jnp.where(visible[..., None], frame.registered, frame.seen),
        known=state.known | visible,
        correction=correction,
        anchor=frame.anchor,
        prior=frame.prior,
        drift=frame.drift,
        change=change,
    )


class _Frame(NamedTuple):
    """A frame before the blend; what has the name of a field of `State` will be that."""

    predictor: Any
    tracking: Array
    rotation: Array
    translation: Array
    seen: Array
    """As carried from the frame before."""
    correction: Array
    anchor: Array
    prior: Array
    drift: Array
    registered: Array
    """`[..., M, 3]` registered frame: measured where visible, else predicted or held."""
    raw: Array
    """`[..., M, 3]` the same in the world."""


def _frame(model: Model, state: State, markers: Array, visible: Array, dt: Array) -> _Frame:
    """Any frame. The one before is done again with this frame's visible set: a marker hidden then
    takes its position of now, carried back by the hand's motion since."""
    template = jnp.asarray(model.hand.template, markers.dtype)
    weight, known = visible.astype(markers.dtype), visible[..., None]
    tracking = second_extent(markers, weight) > DETERMINED_EXTENT
    changed = (visible != state.visible).any(-1) | (tracking != state.tracking)
    shift = mean_point(markers - state.markers, (visible & state.visible).astype(markers.dtype))

    was_seen = state.visible[..., None]
    before = transform(state.rotation, state.translation, state.seen)
    before = apart(jnp.where(was_seen, state.markers, before))
    turn, move = _motion(state, before, markers, visible, tracking, shift)
    returned = jnp.where(was_seen, state.markers, untransform(turn, move, markers))
    previous: Array = jnp.where(known, returned, 0)
    # The prior is that of now, carried back too: if only the set has changed, so has nothing else.
    followed = apart(product(turn.swapaxes(-1, -2), state.rotation))

    def priors() -> Array:
        carried = _carried_prior(state, markers, weight)
        return jnp.stack([jnp.where(changed[..., None, None], state.rotation, carried), followed])

    # Both frames at once, from here to the network.
    both = apart(jnp.stack([markers, previous]))
    rotations, translations = kabsch(template, both, weight, priors)
    sure, tracked = tracking[..., None, None], state.tracked[..., None, None]
    start = mean_point(markers, weight) - mean_point(template, weight)
    start = jnp.where(visible.any(-1, keepdims=True), start, state.translation)
    moved = jnp.where(state.tracked[..., None], state.translation + shift, start)
    moved = jnp.stack([moved, state.translation])
    rotations = jnp.where(sure, rotations, state.rotation)
    translations = jnp.where(tracking[..., None], translations, moved)
    rotations, translations = apart((rotations, translations))
    now, then = ((rotations[i], translations[i]) for i in (0, 1))
    # Before there was any output the template stands in for it.
    placed = transform(*now, template)
    last = jnp.where(tracked, state.output, placed)
    held = jnp.where(tracked, last + shift[..., None, :], placed)

    measured = apart(untransform(rotations, translations, both))
    if PREDICTORS[model.predictor].of_frame is not None:
        advance, filled, raw = _fill(
            model, state.predictor, measured, markers, visible, last, dt, now, now
        )
        registered, again = filled
    else:
        earlier = _registration_before(state, then, changed, now)
        advance, registered, raw = _fill(
            model, state.predictor, measured[0], markers, visible, last, dt, now, earlier
        )
        still = jnp.zeros_like(dt)
        _, again, _ = _fill(
            model, state.predictor, measured[1], previous, visible, last, still, then, then
        )
    registered = apart(jnp.where(sure | known, registered, untransform(*now, held)))
    raw = jnp.where(sure | known, raw, held)
    correction = jnp.where(sure | known, untransform(*then, last) - again, 0)

    length = jnp.sqrt((correction * correction).sum(-1, keepdims=True))
    no_hand = too_far_apart(measured[0], visible) | too_far_apart(state.seen, state.visible)
    near = (length < FARTHEST_CORRECTION) & ~no_hand[..., None, None]
    correction = jnp.where(near, correction, 0)
    seen = untransform(*now, transform(turn, move, before))
    drift = jnp.where(state.visible, 0, state.drift + state.change[..., None])
    # Hands whose set is the same go on as they were; those seen for the first time begin.
    restart, begin = (changed & state.tracked)[..., None, None], ~tracked
    correction = jnp.where(begin, 0, jnp.where(restart, correction, state.correction))
    anchor = jnp.where(begin, registered, jnp.where(restart, measured[1], state.anchor))
    seen = jnp.where(restart & sure, seen, jnp.where(begin & ~known, template, state.seen))
    at_first = product(now[0].swapaxes(-1, -2), state.rotation)
    prior = product(then[0].swapaxes(-1, -2), followed)
    prior = jnp.where(restart, prior, jnp.where(begin, at_first, state.prior))
    drift = jnp.where(changed[..., None], drift, state.drift)
    drift = drift + jnp.where(tracking, 0, DRIFT_UNSEEN * dt)[..., None]
    correction, anchor = apart((correction, anchor))
    return _Frame(
        advance,
        tracking,
        *now,
        seen,
        correction,
        anchor,
        prior,
        jnp.where(visible, 0, drift),
        registered,
        raw,
    )


def too_far_apart(registered: Array, visible: Array) -> Array:
    """`[...]` True where visible markers `[..., M, 3]` of the registered frame are no hand's."""
    return ((jnp.abs(registered) > HUGE).any(-1) & visible).any(-1)


def _carried_prior(state: State, markers: Array, weight: Array) -> Array:
    """`[..., 3, 3]` world_from_template that the registration follows where the template's visible
    markers are near a line, while the set stays the same. The previous rotation would not do: each
    frame would give it up a little more, and a hand that stands still would turn."""
    return product(kabsch(state.anchor, markers, weight, state.rotation)[0], state.prior)


def _fill(
    model: Model,
    predictor: Any,
    registered: Array,
    markers: Array,
    visible: Array,
    last: Array,
    dt: Array,
    registration: tuple[Array, Array],
    before: tuple[Array, Array],
) -> tuple[Any, Array, Array]:
    """One step of the model's predictor; one that looks at this frame alone is spared a second
    registration, and asked of `registered` frames of which the first is this.

    What a predictor that goes by the frame has nothing to say of moves with the hand: from the
    registration `before`, of the previous frame by the same markers, to that of this frame.

    Returns:
        The predictor's next state, and `registered` and `raw` as in `_Frame`.
    """
    chosen = PREDICTORS[model.predictor]
    if chosen.of_frame is not None:
        said = apart(chosen.of_frame(model, registered, visible))
        registered = jnp.where(visible[..., None], registered, said)
        moved = transform(*registration, registered[0])
        return predictor, registered, jnp.where(visible[..., None], markers, moved)
    if chosen.uses_frame:
        last = transform(*registration, untransform(*before, last))
    advance, raw = chosen.step(model, predictor, markers, visible, last, dt)
    return advance, untransform(*registration, raw), raw


def _registration_before(
    state: State, then: tuple[Array, Array], changed: Array, now: tuple[Array, Array]
) -> tuple[Array, Array]:
    """The previous frame's registration by the markers visible now; this frame's own for a hand
    that had not been tracked."""
    earlier = state.rotation, state.translation
    return choose(state.tracked, choose(changed, then, earlier), now)


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

    def believed() -> tuple[Array, Array]:
        eye = jnp.broadcast_to(jnp.eye(3, dtype=dtype), state.rotation.shape)
        earlier = (visible & state.known).astype(dtype)
        turn, move = kabsch(before, markers, earlier, eye)
        misfit = mean_point((transform(turn, move, before) - markers) ** 2, earlier).sum(-1)
        still = ~state.tracking | (misfit < SAME_POSTURE**2)
        believe = tracking & still & (earlier > 0).any(-1)
        turn = jnp.where(believe[..., None, None], turn, eye)
        return turn, jnp.where(believe[..., None], move, shift)

    decide = tracking & (both > 0).any(-1)
    turn, move = apart(kabsch(before, markers, both, lambda: believed()[0]))
    other = jax.lax.cond(decide.all(), lambda: (turn, move), believed)
    return choose(decide, (turn, move), other)


def _change(frame: _Frame, visible: Array) -> Array:
    """`[...]` metres, RMS: how far the visible markers have gone in the registered frame since the
    corrections were set; 0 where none is hidden."""
    difference = jnp.where(visible[..., None], frame.registered - frame.anchor, 0)
    seen = jnp.maximum(visible.sum(-1), 1).astype(difference.dtype)
    distance = jnp.sqrt((difference * difference).sum((-1, -2)) / seen)
    return jnp.where(visible.all(-1), 0, distance)


def _blend(
    model: Model, frame: _Frame, change: Array, visible: Array, dt: Array
) -> tuple[Array, Array]:
    """The corrections to keep, and those to add now; `[..., M, 3]`, registered frame."""
    correction = frame.correction
    length = jnp.sqrt((correction * correction).sum(-1))
    left = jnp.maximum(length - SHRINK_SPEED * dt[..., None], 0)
    share = jnp.where(visible & (length > 0), left / jnp.where(length > 0, length, 1), 1)
    correction = correction * share[..., None]
    fade = jnp.where(frame.tracking, jnp.exp(-change / model.fade), 0)
    faded = correction * fade[..., None, None]
    return correction, jnp.where(visible[..., None], correction, faded)


def choose(condition: Array, yes: Any, no: Any) -> Any:
    """`where` over equal trees; `condition [...]` is broadcast from the left."""
    return jax.tree.map(lambda a, b: jnp.where(leading(condition, a), a, b), yes, no)
