"""From one frame to the next: registration, what fills hidden markers, and the blend that lets no
output jump. Twin of `jaxhand.continuity`.

Continuity is a blend at the output. `raw` is measured where visible and predicted from measured
markers where hidden; in the registered frame `output = raw + correction`. While the visible set is
unchanged the correction of a visible marker shrinks at 25 cm/s (paper, section 3.2.2) and that of
a hidden one fades with posture, `exp(−d/δ)`, d the RMS change of the registered visible markers.
When the set changes, the previous frame is done again with the new set, and what is missing to the
previous output becomes the correction; so the output goes on from where it was.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from numpy_infer import gate
from numpy_infer.arrays import Array, every, some
from numpy_infer.geometry import (
    PRIOR_STRENGTH,
    fit,
    kabsch,
    mean_point,
    pattern,
    refit,
    second_extent,
    squares,
    transform,
    untransform,
)
from numpy_infer.model import Model
from numpy_infer.output import HUGE, leading, wrist_pose
from numpy_infer.pose import DETERMINED_EXTENT, State
from numpy_infer.predictors import PREDICTORS
from numpy_infer.sight import Sight, sight

SHRINK_SPEED = 0.25
"""m/s at which the correction of a visible marker dies (paper, section 3.2.2)."""

FARTHEST_CORRECTION = 10.0
"""Metres: an output that is farther off comes of a frame that was no hand's (in millimetres, say),
and is given up at once rather than for a minute. Near or far, so is what a frame whose markers are
too far apart (`HUGE`) is missing, and what is missing to its output in the frame behind it."""

DRIFT_UNSEEN = 0.04
"""m/s: how fast the posture is taken to change while nothing determines the hand. In gaps like
real ones it is 0.02 on ManipNet, 0.04 on simulated people and 0.1 on SIG18."""

SAME_POSTURE = 1e-4
"""Metres, RMS: markers that fit this well where they were seen last tell how the hand turned."""


def advance(
    model: Model, state: State, markers: Array, visible: Array, dt: Array, late: Array
) -> State:
    """The state after a frame of clean input."""
    own, accepted = state.gate, visible
    if model.gate:
        # What holds markers, or lets them fly on, says nothing of where one comes back.
        told = state.tracked & PREDICTORS[model.predictor].uses_frame
        own, accepted = gate.step(model, state.gate, markers, visible, state.output, told, dt)
        if accepted is not visible:
            markers = np.where(accepted[..., None], markers, 0)
    seen = sight(model.hand, model.body, accepted, markers.dtype)
    frame = _steady(model, state, markers, accepted, seen, dt)
    if frame is None:
        frame = _unsteady(model, state, markers, accepted, seen, dt)
    new_state = blended(model, state, frame, markers, accepted, seen.weight, dt)
    if model.gate:
        new_state = new_state._replace(gate=own, rejected=visible & ~accepted)
    if some(late):
        same = (accepted == state.visible).all(-1) & (markers == state.markers).all((-1, -2))
        new_state = choose(late & state.known.any(-1) & same, state, new_state)
    return new_state


def blended(
    model: Model,
    state: State,
    frame: Frame,
    markers: Array,
    visible: Array,
    weight: Array,
    dt: Array,
) -> State:
    """The state after a frame: output and wrist, with corrections added."""
    correction, placed, exact = frame.correction, frame.registered, frame.exact
    if model.continuity and np.count_nonzero(correction):
        correction, added, stays = blend(
            model, correction, frame.tracking, frame.change, visible, weight, dt
        )
        placed = placed + added
        exact = exact & stays
    output = frame.raw
    if np.count_nonzero(exact) < exact.size:
        moved = transform(frame.rotation, frame.translation, placed)
        output = np.where(exact[..., None], output, moved)
    rotation, position = frame.wrist or wrist_pose(model, output, frame.rotation)
    return State(
        right=state.right,
        gate=state.gate,
        rejected=np.zeros(visible.shape, bool),
        predictor=frame.predictor,
        smoothing=state.smoothing,
        output=output,
        wrist_rotation=rotation,
        wrist_position=position,
        markers=markers,
        visible=visible,
        tracked=state.tracked | frame.tracking,
        tracking=frame.tracking,
        rotation=frame.rotation,
        translation=frame.translation,
        seen=np.where(visible[..., None], frame.registered, frame.seen),
        known=state.known | visible,
        correction=correction,
        anchor=frame.anchor,
        prior=frame.prior,
        drift=frame.drift,
        change=frame.change,
    )


class Frame(NamedTuple):
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
    change: Array
    registered: Array
    """`[..., M, 3]` registered frame: measured where visible, else predicted or held."""
    raw: Array
    """`[..., M, 3]` the same in the world, where `exact [..., M]` says that it is known there."""
    exact: Array
    wrist: tuple[Array, Array] | None
    """The wrist's rotation and position, where measured markers give it."""


def _steady(
    model: Model, state: State, markers: Array, visible: Array, seen: Sight, dt: Array
) -> Frame | None:
    """The frame if every hand is tracked and sees the markers of the frame before, as in most
    frames; else None."""
    tracking = state.tracking
    if np.count_nonzero(visible != state.visible) or not every(tracking):
        return None
    registration, sure, wrist = _registration(seen, markers)
    if not every(sure):
        return None
    before = state.rotation, state.translation
    own = untransform(*registration, markers)
    advance, registered, raw, exact = _fill(
        model, state.predictor, own, markers, visible, state.output, dt, registration, before
    )
    return Frame(
        advance,
        tracking,
        *registration,
        state.seen,
        state.correction,
        state.anchor,
        state.prior,
        state.drift,
        posture_change(own, state.anchor, seen.parts),
        registered,
        raw,
        exact,
        wrist if _measured(model, state.correction) else None,
    )


def _unsteady(
    model: Model, state: State, markers: Array, visible: Array, seen: Sight, dt: Array
) -> Frame:
    """Any frame. The one before is done again with this frame's visible set: a marker hidden then
    takes its position of now, carried back by the hand's motion since."""
    template, weight = model.hand.template.astype(markers.dtype, copy=False), seen.weight
    now, sure, wrist = _registration(seen, markers)
    plain = every(sure)
    tracking = sure if plain else second_extent(markers, weight) > DETERMINED_EXTENT
    changed = np.logical_or.reduce(visible != state.visible, -1) | (tracking != state.tracking)
    known = visible[..., None]

    def shift() -> Array:
        """What the markers seen in both frames have gone, on average."""
        both = (visible & state.visible).astype(markers.dtype)
        return mean_point(markers - state.markers, both)

    was_seen = state.visible[..., None]
    before = transform(state.rotation, state.translation, state.seen)
    before = np.where(was_seen, state.markers, before)
    turn, move = _motion(state, before, markers, visible, tracking, shift)
    returned = np.where(was_seen, state.markers, untransform(turn, move, markers))
    previous: Array = np.where(known, returned, 0)
    # The prior is that of now, carried back too: if only the set has changed, so has nothing else.
    followed = turn.swapaxes(-1, -2) @ state.rotation

    def priors() -> Array:
        carried = _carried_prior(state, markers, weight)
        return np.stack([np.where(changed[..., None, None], state.rotation, carried), followed])

    rotations, translations, second = refit(seen.template, previous)
    then = rotations[..., 0, :, :], translations[..., 0, :]
    if not plain or not every(second > 2 * PRIOR_STRENGTH):
        both = np.stack([markers, previous])
        rotations, translations, _ = fit(pattern(template, weight), both, priors)
        now, then = ((rotations[i], translations[i]) for i in (0, 1))
    determined, tracked = tracking[..., None, None], state.tracked[..., None, None]
    certain = every(tracking) and every(state.tracked)
    if not certain:
        start = mean_point(markers, weight) - mean_point(template, weight)
        start = np.where(visible.any(-1, keepdims=True), start, state.translation)
        moved = np.where(state.tracked[..., None], state.translation + shift(), start)
        now = choose(tracking, now, (state.rotation, moved))
        then = choose(tracking, then, (state.rotation, state.translation))
    last = held = state.output
    if not certain:
        # Before there was any output the template stands in for it.
        placed = transform(*now, template)
        last = np.where(tracked, last, placed)
        held = np.where(tracked, last + shift()[..., None, :], placed)

    measured = np.empty((2, *markers.shape), markers.dtype)
    measured[0], measured[1] = untransform(*now, markers), untransform(*then, previous)
    if PREDICTORS[model.predictor].of_frame is not None:
        # Both frames in one product per layer of the network.
        advance, both, raw, exact = _fill(
            model, state.predictor, measured, markers, visible, last, dt, now, now
        )
        registered, again = both[0], both[1]
    else:
        earlier = _registration_before(state, then, changed, now)
        advance, registered, raw, exact = _fill(
            model, state.predictor, measured[0], markers, visible, last, dt, now, earlier
        )
        still = np.zeros_like(dt)
        _, again, *_ = _fill(
            model, state.predictor, measured[1], previous, visible, last, still, then, then
        )
    correction = untransform(*then, last) - again
    if not certain:
        registered = np.where(determined | known, registered, untransform(*now, held))
        raw = np.where(determined | known, raw, held)
        correction = np.where(determined | known, correction, 0)

    near = squares(correction) < FARTHEST_CORRECTION**2
    no_hand = too_far_apart(measured[0], visible) | too_far_apart(state.seen, state.visible)
    if some(no_hand):
        near = near & ~no_hand[..., None]
    if np.count_nonzero(near) < near.size:
        correction = np.where(near[..., None], correction, 0)
    anchor, prior = measured[1], then[0].swapaxes(-1, -2) @ followed
    carried = untransform(*now, transform(turn, move, before))
    drift = np.where(state.visible, 0, state.drift + state.change[..., None])
    if not (certain and every(changed)):
        # Hands whose set is the same go on as they were; those seen for the first time begin.
        restart, begin = (changed & state.tracked)[..., None, None], ~tracked
        correction = np.where(begin, 0, np.where(restart, correction, state.correction))
        anchor = np.where(begin, registered, np.where(restart, anchor, state.anchor))
        carried = np.where(
            restart & determined, carried, np.where(begin & ~known, template, state.seen)
        )
        at_first = now[0].swapaxes(-1, -2) @ state.rotation
        prior = np.where(restart, prior, np.where(begin, at_first, state.prior))
        drift = np.where(changed[..., None], drift, state.drift)
    if not certain:
        drift = drift + np.where(tracking, 0, DRIFT_UNSEEN * dt)[..., None]
        exact = exact | ~tracking[..., None]
    drift = np.where(visible, 0, drift).astype(markers.dtype, copy=False)
    return Frame(
        advance,
        tracking,
        *now,
        carried,
        correction,
        anchor,
        prior,
        drift,
        posture_change(registered, anchor, seen.parts),
        registered,
        raw,
        exact,
        wrist if _measured(model, correction) else None,
    )


def too_far_apart(registered: Array, visible: Array) -> Array:
    """`[...]` True where visible markers `[..., M, 3]` of the registered frame are no hand's."""
    far = np.abs(registered) > HUGE
    return np.logical_or.reduce(np.logical_or.reduce(far, -1) & visible, -1)


def _registration(
    seen: Sight, markers: Array
) -> tuple[tuple[Array, Array], Array, tuple[Array, Array] | None]:
    """The template's rotation and translation by the visible markers; `[...]` True where those
    surely determine the hand: else a prior is missing. And the wrist's pose, if its markers are
    visible and determine it."""
    rotations, translations, second = refit(seen.both, markers)
    enough = second > seen.least[: second.shape[-1]]
    wrist = None
    if seen.direct and every(enough):
        wrist = rotations[..., 1, :, :], translations[..., 1, :]
    return (rotations[..., 0, :, :], translations[..., 0, :]), enough[..., 0], wrist


def _measured(model: Model, correction: Array) -> bool:
    """True if no alignment marker, where visible, is on its way to where it is measured."""
    return not (
        np.count_nonzero(correction) and np.count_nonzero(correction.take(model.hand.aligned, -2))
    )


def _carried_prior(state: State, markers: Array, weight: Array) -> Array:
    """`[..., 3, 3]` world_from_template that the registration follows where the template's visible
    markers are near a line, while the set stays the same. The previous rotation would not do: each
    frame would give it up a little more, and a hand that stands still would turn."""
    return kabsch(state.anchor, markers, weight, state.rotation)[0] @ state.prior


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
) -> tuple[Any, Array, Array, Array]:
    """One step of the model's predictor; one that looks at this frame alone is spared a second
    registration.

    What a predictor that goes by the frame has nothing to say of moves with the hand: from the
    registration `before`, of the previous frame by the same markers, to that of this frame.

    Returns:
        The predictor's next state, and `registered`, `raw` and `exact` as in `Frame`.
    """
    chosen = PREDICTORS[model.predictor]
    if chosen.of_frame is not None:
        return predictor, filled(model, registered, visible), markers, visible
    if chosen.uses_frame:
        last = transform(*registration, untransform(*before, last))
    advance, raw = chosen.step(model, predictor, markers, visible, last, dt)
    return advance, untransform(*registration, raw), raw, np.ones_like(visible)


def filled(model: Model, registered: Array, visible: Array) -> Array:
    """`[..., M, 3]` registered frame: the markers, and what a predictor that looks at one frame
    alone says of those that are hidden."""
    of_frame = PREDICTORS[model.predictor].of_frame
    if of_frame is None or every(visible):
        return registered
    return np.where(visible[..., None], registered, of_frame(model, registered, visible))


def _registration_before(
    state: State, then: tuple[Array, Array], changed: Array, now: tuple[Array, Array]
) -> tuple[Array, Array]:
    """The previous frame's registration by the markers visible now; this frame's own for a hand
    that had not been tracked."""
    earlier = state.rotation, state.translation
    return choose(state.tracked, choose(changed, then, earlier), now)


def _motion(
    state: State,
    before: Array,
    markers: Array,
    visible: Array,
    tracking: Array,
    shift: Callable[[], Array],
) -> tuple[Array, Array]:
    """The hand's rigid motion since the previous frame, from the markers seen in both.

    What those leave open follows where the visible markers were seen last (`before [..., M, 3]`,
    carried along with the hand since), if the hand had been lost or if they fit without a change of
    posture; a posture that has changed says nothing of a rotation, so otherwise there is none.
    """
    dtype = markers.dtype
    both = (visible & state.visible).astype(dtype)

    def believed() -> tuple[Array, Array]:
        eye = np.broadcast_to(np.eye(3, dtype=dtype), state.rotation.shape)
        earlier = (visible & state.known).astype(dtype)
        turn, move = kabsch(before, markers, earlier, eye)
        misfit = mean_point((transform(turn, move, before) - markers) ** 2, earlier).sum(-1)
        still = ~state.tracking | (misfit < SAME_POSTURE**2)
        believe = tracking & still & (earlier > 0).any(-1)
        turn = np.where(believe[..., None, None], turn, eye)
        return turn, np.where(believe[..., None], move, shift())

    decide = tracking & (np.add.reduce(both, -1) > 0)
    if every(decide):
        return kabsch(before, markers, both, lambda: believed()[0])
    turn, move = believed()
    seen_turn, seen_move = kabsch(before, markers, both, turn)
    return (
        np.where(decide[..., None, None], seen_turn, turn),
        np.where(decide[..., None], seen_move, move),
    )


def posture_change(registered: Array, anchor: Array, parts: Array) -> Array:
    """`[...]` metres, RMS: how far the visible markers have gone in the registered frame since the
    corrections were set, by their `parts`, see `sight.parts_of`; 0 where none is hidden."""
    gone = registered - anchor
    square = (gone * gone).reshape(*gone.shape[:-2], 1, -1) @ parts
    return np.sqrt(square[..., 0, 0])


def blend(
    model: Model,
    correction: Array,
    tracking: Array,
    change: Array,
    visible: Array,
    weight: Array,
    dt: Array,
) -> tuple[Array, Array, Array]:
    """The corrections to keep, and those to add now; `[..., M, 3]`, registered frame. And
    `[..., M]` True where a visible marker has none."""
    fade = np.exp(-change / model.fade)
    if not every(tracking):
        fade = np.where(tracking, fade, 0)
    fading = correction * fade[..., None, None]
    if not np.count_nonzero(correction * weight[..., None]):
        return correction, fading, visible
    length = np.sqrt(squares(correction))
    left = np.maximum(length - SHRINK_SPEED * dt[..., None], 0)
    share = np.where(visible, left / np.maximum(length, 1e-30), 1)
    correction = correction * share[..., None]
    added = np.where(visible[..., None], correction, fading)
    return correction, added, visible & (left == 0)


def choose(condition: Array, yes: Any, no: Any) -> Any:
    """`where` over equal trees; `condition [...]` is broadcast from the left."""
    if isinstance(yes, tuple):
        parts = [choose(condition, a, b) for a, b in zip(yes, no, strict=True)]
        return tuple(parts) if type(yes) is tuple else type(yes)(*parts)
    if yes is None:
        return None
    return np.where(leading(condition, yes), yes, no)


def each(function: Any, tree: Any) -> Any:
    """The function on all arrays of nested tuples."""
    if isinstance(tree, tuple):
        parts = [each(function, part) for part in tree]
        return tuple(parts) if type(tree) is tuple else type(tree)(*parts)
    return function(tree)
