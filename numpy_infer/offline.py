"""Many frames of a hand that is seen well, done together.

While markers determine the hand, frames hang together by little: which position a marker has that
comes or goes, and what was missing to the output there, the correction. Registration and network
see all frames at once, and so does the blend; from one change of the visible set to the next go
the corrections alone.
"""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np

from numpy_infer.arrays import Array, some
from numpy_infer.continuity import (
    FARTHEST_CORRECTION,
    Frame,
    blend,
    blended,
    choose,
    each,
    filled,
    posture_change,
    too_far_apart,
)
from numpy_infer.geometry import PRIOR_STRENGTH, fit, kabsch, pattern, transform, untransform
from numpy_infer.model import Model
from numpy_infer.pose import State
from numpy_infer.sight import parts_of


def together(model: Model, state: State, markers: Array, visible: Array, dt: Array) -> State | None:
    """The states, an axis in front or 1 in its place, after each of several frames `[T, ..., M, 3]`
    of clean input; None if a hand's motion is not plain in all of them. For a predictor that looks
    at one frame alone, for frames whose visible markers determine the hand, and that pass the gate,
    which the caller sees to: the gate's state is as before.
    """
    if np.count_nonzero(state.tracking) < state.tracking.size:
        return None
    weight = visible.astype(markers.dtype)
    template = model.hand.template.astype(markers.dtype, copy=False)
    *registration, second = fit(pattern(template, weight), markers, state.rotation)
    if second.min() <= 2 * PRIOR_STRENGTH:
        return None
    rotation, translation = registration
    registered = untransform(rotation, translation, markers)
    # What is no hand leaves no correction behind, see `continuity.FARTHEST_CORRECTION`.
    if some(too_far_apart(registered, visible)) or some(too_far_apart(state.seen, state.visible)):
        return None
    registered = filled(model, registered, visible)
    state = each(lambda leaf: leaf[None], state)
    frames = Frame(
        state.predictor,
        state.tracking,
        rotation,
        translation,
        state.seen,
        state.correction,
        state.anchor,
        state.prior,
        state.drift,
        state.change,
        registered,
        markers,
        visible,
        None,
    )
    elapsed = np.cumsum(dt, 0)
    changed = (visible != np.concatenate([state.visible, visible[:-1]])).any(-1)
    at = np.flatnonzero(changed.any(tuple(range(1, changed.ndim))))
    changes = None
    if len(at):
        changes = _changes(model, state, frames, markers, visible, at)
        if changes is None:
            return None
        frames = frames._replace(**_since(frames, changes, changed, at))
        for begin, end in pairwise([*at, len(dt)]):
            elapsed[begin:end] = np.cumsum(dt[begin:end], 0)
    change = posture_change(registered, frames.anchor, parts_of(visible, markers.dtype))
    frames = frames._replace(change=change)
    if changes is not None:
        frames = frames._replace(
            **_chained(model, state, frames, changes, visible, elapsed, changed, at)
        )
    state = state._replace(known=state.known | np.logical_or.accumulate(visible, 0))
    return blended(model, state, frames, markers, visible, weight, elapsed)


class _Changes(NamedTuple):
    """Of the `K` frames in which a visible set changes: the frame before, done again with the new
    set, as `continuity` does it."""

    missing: Array
    """`[K, ..., M, 3]` registered frame: what was missing to the output, its blend left out."""
    anchor: Array
    prior: Array
    turn: Array
    """`[K, ..., 3, 3]` takes that blend, as rows, into the registered frame of doing it again."""
    carry: tuple[Array, Array]
    """`[K, ..., 3, 3]`, `[K, ..., 3]` from the registered frame of the frame before to this one's,
    along with the hand."""


def _changes(
    model: Model, state: State, frames: Frame, markers: Array, visible: Array, at: Array
) -> _Changes | None:
    """None where the markers seen in both frames do not tell how the hand has moved."""

    def before(first: Array, rest: Array) -> Array:
        return np.concatenate([first, rest[:-1]])[at]

    plain = transform(frames.rotation, frames.translation, frames.registered)
    plain = np.where(visible[..., None], markers, plain)
    rotation = before(state.rotation, frames.rotation)
    translation = before(state.translation, frames.translation)
    last, was = before(state.output, plain), before(state.markers, markers)
    was_seen, seen, markers = before(state.visible, visible), visible[at], markers[at]
    both = (was_seen & seen).astype(markers.dtype)
    turn, move, second = fit(pattern(was, both), markers, rotation)
    if second.min() <= 2 * PRIOR_STRENGTH:
        return None
    returned = np.where(was_seen[..., None], was, untransform(turn, move, markers))
    previous: Array = np.where(seen[..., None], returned, 0)
    followed = turn.swapaxes(-1, -2) @ rotation
    template = model.hand.template.astype(markers.dtype, copy=False)
    then = kabsch(template, previous, seen.astype(markers.dtype), followed)
    anchor = untransform(*then, previous)
    again = filled(model, anchor, seen)
    now = frames.rotation[at], frames.translation[at]
    origin = untransform(*now, transform(turn, move, translation[..., None, :]))
    back = now[0].swapaxes(-1, -2)
    return _Changes(
        untransform(*then, last) - again,
        anchor,
        then[0].swapaxes(-1, -2) @ followed,
        rotation.swapaxes(-1, -2) @ then[0],
        (back @ turn @ rotation, origin[..., 0, :]),
    )


def _since(frames: Frame, changes: _Changes, changed: Array, at: Array) -> dict[str, Array]:
    """What each frame has of its hand's last change."""
    number = np.zeros(changed.shape, int)
    number[at] = changed[at] * np.arange(1, len(at) + 1).reshape(-1, *(1,) * (changed.ndim - 1))
    number = np.maximum.accumulate(number, 0)[..., None, None]
    return {
        name: np.take_along_axis(np.concatenate([getattr(frames, name), new]), number, 0)
        for name, new in (("anchor", changes.anchor), ("prior", changes.prior))
    }


def _chained(
    model: Model,
    state: State,
    frames: Frame,
    changes: _Changes,
    visible: Array,
    elapsed: Array,
    changed: Array,
    at: Array,
) -> dict[str, Array]:
    """What each frame has by way of all changes before: where markers were seen last, corrections,
    and how far the posture had gone."""
    weight, change = visible.astype(elapsed.dtype), frames.change
    was_visible = np.concatenate([state.visible, visible[:-1]])
    gone = np.concatenate([state.change, change[:-1]])[..., None]
    seen, correction, drift = state.seen[0], state.correction[0], state.drift[0]
    count = len(visible)
    every = [np.empty((count, *leaf.shape), leaf.dtype) for leaf in (seen, correction, drift)]
    for k, (begin, end) in enumerate(pairwise([0, *at, count])):
        if k:
            last, here, missing = begin - 1, changed[begin], changes.missing[k - 1]
            if begin:
                seen = np.where(visible[last][..., None], frames.registered[last], seen)
            if begin and model.continuity:
                correction, added, _ = blend(
                    model,
                    correction,
                    frames.tracking[0],
                    change[last],
                    visible[last],
                    weight[last],
                    elapsed[last],
                )
                missing = missing + added @ changes.turn[k - 1]
            far = np.sqrt((missing * missing).sum(-1, keepdims=True))
            missing = np.where(far < FARTHEST_CORRECTION, missing, 0)
            turn, move = changes.carry
            moved = transform(turn[k - 1], move[k - 1], seen)
            further = np.where(was_visible[begin], 0, drift + gone[begin])
            seen, correction, drift = choose(
                here, (moved, missing, further), (seen, correction, drift)
            )
            drift = np.where(visible[begin], 0, drift)
        for whole, own in zip(every, (seen, correction, drift), strict=True):
            whole[begin:end] = own
    return dict(zip(("seen", "correction", "drift"), every, strict=True))
