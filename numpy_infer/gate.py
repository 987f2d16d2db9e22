"""Notices wrong measurements, which are then treated as hidden. Twin of `jaxhand.gate`.

A marker that jumped to a reflection, neighbours that carry each other's label, a marker that stays
in place while the hand goes on: `step` says which of the visible markers to accept. All tests are
about the markers among each other, so a rigid motion of the whole stream changes nothing:

- *motion*: where a marker was and its velocity, moved as the hand moves since, tell where it is
  to be expected; one not accepted before is expected where the tracker put it;
- *labels*: two neighbours that are both off, and each where the other is expected, are swapped;
- *freezing*: a coordinate-exact repetition while what carries the marker moved;
- *geometry*: no two markers are farther apart, or nearer, than a hand can bring them.

What is refused is expected again with a tolerance that grows, so that no marker but a frozen one is
refused for longer than `LONGEST` seconds; what comes back that way is in doubt, and may leap, for
as long as it had been refused. Where most of a frame would be refused the gate gives way.

Most frames are quiet: no marker leaves its uniform motion, compared with the others, by `QUIET`
metres. They are accepted without any of these tests.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from numpy_infer.arrays import Array, every
from numpy_infer.geometry import kabsch, mean_point, second_extent, squares, transform
from numpy_infer.model import Model
from numpy_infer.output import leading
from numpy_infer.pose import DETERMINED_EXTENT
from numpy_infer.reach import Reach, distances, reach

QUIET = 5e-3
"""Metres that a marker of a quiet frame is off its uniform motion at most."""

FRAME = 1 / 60
"""Seconds: tolerances hold for frames up to this long, and grow in proportion beyond."""

FRESH = 12e-3
"""Metres that a marker accepted in the previous frame may be off what is expected of it, at least.
Of recorded ones and simulated ones, one in 100,000 is."""
RESTLESS = 8.0
"""The same as a multiple of `GateState.restless`, where that is more."""
CALM_SECONDS = 0.5
"""Time in which that fades to half."""

RETURN, GROWTH = 25e-3, 50e-3
"""Metres, and metres a second since it was accepted last: how far a marker that was hidden or
refused may be off when it is accepted."""
HIDDEN = 3.0
"""How many times farther one may be that was hidden: nothing yet speaks against it."""
ONWARD = 0.25
"""A marker refused for a step that goes on in the same direction, by this part of it, is right."""
LONGEST = 2.0
"""Seconds after which a marker is accepted wherever it is."""

SWAP_FIT = 8e-3
"""Metres that neighbours with each other's labels are off at most."""
SWAP_LEAST, SWAP_OFF = 6e-3, 3.0
"""Metres, and how many times farther, both together are off with their own at least."""

MOVED = 0.2e-3
"""Metres: what moves by more in a frame does move."""

ROBUST_SCALE, ROBUST_ROUNDS = 8e-3, 3
"""Metres at which a marker loses three quarters of its say in the hand's motion (Geman, McClure
1987), and rounds of reweighting."""
VOTES = 4
"""To which power goes the part of the markers that keep their distance from one."""
ASTRAY = 1.0
"""Metres: no marker comes or goes so far from another between two frames."""

BRIEFEST = 1e-4
"""Seconds: a shorter frame tells no velocity."""


class GateState(NamedTuple):
    """What the gate carries from frame to frame. Everything in it is a left hand's."""

    markers: Array
    """`[..., M, 3]` the previous measurements; 0 where hidden."""
    visible: Array
    """`[..., M]` True where the previous frame was measured."""
    accepted: Array
    """`[..., M]` True where it was accepted."""
    place: Array
    """`[..., M, 3]` metres, world: where each marker that is followed was; else 0."""
    velocity: Array
    """`[..., M, 3]` m/s of it; else 0."""
    followed: Array
    """`[..., M]` True where accepted, or refused because its neighbour carried its label."""
    calm: Array
    """`[...]` True where no marker was refused, and none is in doubt."""
    age: Array
    """`[..., M]` seconds since the marker was accepted, or since the beginning."""
    refused: Array
    """`[..., M]` seconds for which it was measured in vain since then; of an accepted marker, for
    which it is still in doubt."""
    leap: Array
    """`[..., M, 3]` metres, world: the step, beside the hand's, with which a marker left where it
    was followed in the previous frame; else 0."""
    restless: Array
    """`[...]` metres: how far markers of late were off what was expected of them."""


def init(model: Model, batch: tuple[int, ...] = ()) -> GateState:
    """A gate that has seen nothing.

    Args:
        model: its hand is what is known of distances.
        batch: leading shape of everything.
    """
    reach(model.hand)  # takes a frame and a half, so not in the first one that needs it
    shape, dtype = (*batch, len(model.hand)), model.hand.template.dtype
    never, nowhere = np.zeros(shape, bool), np.zeros((*shape, 3), dtype)
    return GateState(
        markers=nowhere,
        visible=never,
        accepted=never,
        place=nowhere,
        velocity=nowhere,
        followed=never,
        calm=np.zeros(batch, bool),
        age=np.zeros(shape, dtype),
        refused=np.zeros(shape, dtype),
        leap=nowhere,
        restless=np.zeros(batch, dtype),
    )


def step(
    model: Model,
    state: GateState,
    markers: Array,
    visible: Array,
    last: Array,
    tracked: Array,
    dt: Array,
) -> tuple[GateState, Array]:
    """Takes in one frame and says what of it to believe.

    Args:
        model: its hand is what is known of distances.
        state: from `init` or the previous `step`.
        markers: `[..., M, 3]` metres, world, of a left hand; 0 where hidden.
        visible: `[..., M]` True where measured.
        last: `[..., M, 3]` metres, world: the tracker's previous output.
        tracked: `[...]` True once the hand has been tracked by a predictor that goes by the frame,
            so that `last` means something.
        dt: `[...]` seconds since the previous frame, not negative. At 0 nothing that runs on time
            moves, and the same markers again change nothing.

    Returns:
        The new state; `[..., M]` True where visible and accepted.
    """
    moved = markers - state.markers
    far = _off(moved, state.velocity, dt)
    # A coordinate that is the same again may be a frozen one.
    told = np.count_nonzero(moved) == 3 * np.count_nonzero(visible)
    alike = every(state.calm) and not np.count_nonzero(visible != state.visible)
    if told and alike and every(far < QUIET**2) and every(dt > BRIEFEST):
        return _quietly(state, markers, moved, visible, dt), visible
    quiet = state.calm & _quiet(moved, state.velocity, visible, state.visible, dt)
    repeated = ~(dt > 0) & (visible == state.visible).all(-1) & (moved == 0).all((-1, -2))
    careful = _carefully(model, state, markers, visible, last, tracked, dt)
    quick = _quietly(state, markers, moved, visible, np.maximum(dt, BRIEFEST))
    merged = GateState(
        *(
            np.where(leading(quiet, new), new, np.where(leading(repeated, old), old, other))
            for old, new, other in zip(state, quick, careful, strict=True)
        )
    )
    return merged, merged.accepted


def ahead(
    model: Model, state: GateState, tracked: Array, markers: Array, visible: Array, dt: Array
) -> tuple[GateState, int]:
    """The state after as many of several frames as pass whole without the tracker's output having
    a say, and how many those are: up to one in which a marker comes back, or is refused. Arguments
    as of `step`, with T in front."""
    if not state.calm.all():
        return state, 0
    # What each frame would find if all before it pass.
    earlier, seen = (
        np.concatenate([own[None], rest[:-1]])
        for own, rest in ((state.markers, markers), (state.visible, visible))
    )
    moved, time = markers - earlier, dt[..., None]
    speed = np.where(visible[..., None], moved, 0) / np.maximum(time, BRIEFEST)[..., None]
    velocity = np.concatenate([state.velocity[None], speed[:-1]])
    count = _until((visible & ~seen).any(-1) | (dt <= BRIEFEST))
    restless = ~_quiet(moved, velocity, visible, seen, dt)
    level = np.zeros_like(dt)
    at = np.flatnonzero(_any(restless[:count]))
    if len(at):
        nothing = np.zeros_like(velocity[at])
        found = GateState(
            markers=earlier[at],
            visible=seen[at],
            accepted=seen[at],
            place=earlier[at],
            velocity=velocity[at],
            followed=seen[at],
            calm=np.ones_like(restless[at]),
            age=nothing[..., 0],
            refused=nothing[..., 0],
            leap=nothing,
            restless=nothing[..., 0, 0],  # what passes like that passes where more is allowed
        )
        found = _carefully(model, found, markers[at], visible[at], markers[at], tracked, dt[at])
        level[at] = np.where(restless[at], found.restless, 0)
        # Where the gate gave way it has no velocity of its own for a marker.
        otherwise = (found.velocity != speed[at]).any((-1, -2))
        passed = _until((found.accepted != visible[at]).any(-1) | otherwise)
        count = int(at[passed]) if passed < len(at) else count
    if not count:
        return state, 0
    last, done = count - 1, slice(count)
    fade = np.cumsum(np.log1p(dt[done] / CALM_SECONDS), 0)
    lasting = np.logical_or.accumulate(visible[done][::-1], 0)[::-1]
    unseen = (time[done] * ~lasting).sum(0)
    state = GateState(
        markers=markers[last],
        visible=visible[last],
        accepted=visible[last],
        place=markers[last],
        velocity=speed[last],
        followed=visible[last],
        calm=state.calm,
        age=np.where(lasting[0], unseen, state.age + unseen),
        refused=state.refused,
        leap=np.zeros_like(state.leap),
        restless=np.maximum(
            state.restless * np.exp(-fade[last]),
            (level[done] * np.exp(fade - fade[last])).max(0),
        ),
    )
    return state, count


def _any(of_frames: Array) -> Array:
    """`[T]` of `[T, ...]`."""
    return of_frames.any(tuple(range(1, of_frames.ndim)))


def _until(stop: Array) -> int:
    """How many frames `[T, ...]` come before one in which any hand stops."""
    stops = np.flatnonzero(_any(stop))
    return int(stops[0]) if len(stops) else len(stop)


def _quiet(moved: Array, velocity: Array, visible: Array, before: Array, dt: Array) -> Array:
    """`[...]` True where a frame goes on as the one before, in which `before` was visible."""
    # A coordinate that is the same again may be a frozen one.
    told = (moved != 0).sum((-1, -2)) == 3 * visible.sum(-1)
    alike = (visible == before).all(-1)
    return told & alike & (_off(moved, velocity, dt).max(-1) < QUIET**2) & (dt > BRIEFEST)


def _off(moved: Array, velocity: Array, dt: Array) -> Array:
    """`[..., M]` m²: the square of how far markers left their uniform motion, beside the others."""
    centring = _centring(moved.shape[-2]).astype(moved.dtype, copy=False)
    return squares(centring @ (moved - velocity * dt[..., None, None]))


@lru_cache(maxsize=16)
def _centring(count: int) -> Array:
    """`[M, M]` takes so many points to where they are from their mean."""
    return np.eye(count) - 1 / count


def _quietly(
    state: GateState, markers: Array, moved: Array, visible: Array, dt: Array
) -> GateState:
    """The state after a frame that is like the one before: nothing is off, comes or goes."""
    time = dt[..., None]
    return state._replace(
        markers=markers,
        place=markers,
        velocity=moved / time[..., None],
        age=np.where(visible, 0, state.age + time),
        restless=state.restless / (1 + dt / CALM_SECONDS),
    )


def _carefully(
    model: Model,
    state: GateState,
    markers: Array,
    visible: Array,
    last: Array,
    tracked: Array,
    dt: Array,
) -> GateState:
    """The state after any other frame."""
    time, known = dt[..., None], reach(model.hand)
    # Of what was accepted in spite of what was expected, nothing is expected for as long again.
    excused = (state.refused >= LONGEST) | (state.accepted & (state.refused > 0))
    follows = state.followed[..., None]
    drift = mean_point(state.velocity, state.followed.astype(markers.dtype))[..., None, :]
    stay = np.where(follows, state.place, last)
    ahead = np.minimum(time, CALM_SECONDS)[..., None]
    going = stay + np.where(follows, state.velocity, drift) * ahead
    fresh = visible & state.followed
    motion = _motion(np.stack([stay, going]), markers, fresh)
    placed = transform(*motion, np.stack([stay, going]))
    off = _least(placed - markers)
    restless = RESTLESS * state.restless[..., None]
    usual = np.maximum(FRESH * np.maximum(time / FRAME, 1), restless)
    trust = np.where(state.refused > 0, 1, HIDDEN)
    returning = np.maximum(trust * (RETURN + GROWTH * state.age), restless)
    tolerance = np.where(state.followed, usual, returning)
    # Fewer than three that are followed do not say where to expect the others.
    refers = (state.followed | tracked[..., None]) & (fresh.sum(-1) >= 3)[..., None] & ~excused
    suspect = visible & refers & (off > tolerance)
    # What jumped stays where it jumped to; a finger that was faster than expected goes on.
    leapt = (state.leap * state.leap).sum(-1)
    before = transform(motion[0][0], motion[1][0], state.markers)
    onward = ((markers - before) * state.leap).sum(-1) > ONWARD * leapt
    suspect = suspect & ~(onward & (leapt > 0))

    order = _labels(known, placed, markers, off, fresh & refers)
    swapped = order != np.arange(markers.shape[-2])
    frozen, same = _frozen(known, state, markers, visible)
    wrong = suspect | swapped | frozen | (same & ~state.accepted & ~excused)
    entering = visible & ~state.followed & ~excused
    if np.count_nonzero(entering):
        wrong = wrong | (entering & _impossible(known, markers, visible & ~wrong))

    if np.count_nonzero(wrong):
        # Where most of a frame is wrong, or what is left would not do, it is the gate that is
        # wrong.
        left = visible & ~wrong
        enough = _spread(markers, left) | ~_spread(markers, visible)
        believed = (2 * left.sum(-1) >= visible.sum(-1)) & enough
        wrong = wrong & believed[..., None]
        swapped = swapped & believed[..., None]
    accepted = visible & ~wrong
    followed = accepted | swapped
    own = np.take_along_axis(markers, order[..., None], -2)
    place = np.where(swapped[..., None], own, np.where(accepted[..., None], markers, 0))

    steadily = followed & state.followed & (swapped | ~suspect)
    brief = (time <= BRIEFEST)[..., None]
    speed = (place - state.place) / np.maximum(time, BRIEFEST)[..., None]
    speed = np.where(brief, state.velocity, speed)
    drift = mean_point(speed, steadily.astype(markers.dtype))[..., None, :]
    velocity = np.where(steadily[..., None], speed, np.where(followed[..., None], drift, 0))
    level = mean_point(off[..., None], (accepted & steadily).astype(markers.dtype))[..., 0]
    agrees = ~state.accepted & (off <= RETURN) & refers
    forgiven = np.where(agrees, 0, state.refused - np.where(state.accepted, time, 0))
    refused = np.where(accepted, forgiven, state.refused + np.where(visible & ~frozen, time, 0))
    refused = np.maximum(refused, 0)
    return GateState(
        markers=markers,
        visible=visible,
        accepted=accepted,
        place=place,
        velocity=velocity,
        followed=followed,
        calm=~(wrong | (refused > 0)).any(-1),
        age=np.where(accepted, 0, state.age + time),
        refused=refused,
        leap=np.where((suspect & wrong & state.followed)[..., None], markers - placed[0], 0),
        restless=np.maximum(state.restless / (1 + dt / CALM_SECONDS), level),
    )


def _motion(places: Array, markers: Array, fresh: Array) -> tuple[Array, Array]:
    """The rigid motion `[..., 3, 3]`, `[..., 3]` of the hand from `places` to `markers`, by those
    that are `fresh`, except what does not fit."""
    eye = np.broadcast_to(np.eye(3, dtype=markers.dtype), (*places.shape[:-2], 3, 3))
    markers = np.broadcast_to(markers, places.shape)
    use = np.broadcast_to(fresh.astype(markers.dtype), places.shape[:-1])
    # A marker's first say is by how many keep their distance from it: large errors would turn the
    # hand of a plain fit.
    both = use[..., :, None] * use[..., None, :]
    earlier, now = distances(places) * both, distances(markers) * both
    change = earlier - now
    # A few that are suddenly kilometres from most others have no say at all: the least would do.
    count = (use > 0).sum(-1, keepdims=True)
    astray = 2 * (np.abs(change) > ASTRAY).sum(-1) > count
    use = np.where(astray & (2 * astray.sum(-1, keepdims=True) < count), 0, use)
    votes = (use[..., None, :] / (1 + np.minimum(change * change, 1) / ROBUST_SCALE**2)).sum(-1)
    # Sizes that are no hand's would overflow in float32.
    both = use[..., :, None] * use[..., None, :]
    size = (np.maximum(earlier, now) * both).max((-1, -2))
    use = use / (1 + size * size)[..., None]
    motion = kabsch(places, markers, use * (votes / markers.shape[-2]) ** VOTES, eye)
    for _ in range(ROBUST_ROUNDS):
        off = transform(*motion, places) - markers
        far = np.minimum((off * off).sum(-1), 1) / ROBUST_SCALE**2
        motion = kabsch(places, markers, use / (1 + far) ** 2, eye)
    return motion


def _least(off: Array) -> Array:
    """`[2, ..., 3]` → `[...]` the lesser length."""
    return np.sqrt((off * off).sum(-1).min(0))


def _labels(known: Reach, placed: Array, markers: Array, off: Array, fresh: Array) -> Array:
    """`[..., M]` the label under which each marker is measured: its own, or a neighbour's."""
    order = np.broadcast_to(np.arange(markers.shape[-2]), fresh.shape)
    # One of two that are swapped is at least half as far off as both.
    if not np.count_nonzero(fresh & (off > SWAP_LEAST / 2)):
        return order
    for (one, other), partner in zip(known.neighbours, known.partner, strict=True):
        crossed = _least(placed[..., one, :] - markers[..., other, :])
        crossed_back = _least(placed[..., other, :] - markers[..., one, :])
        fits = np.maximum(crossed, crossed_back) < SWAP_FIT
        better = off[..., one] + off[..., other] > SWAP_LEAST + SWAP_OFF * (crossed + crossed_back)
        swap = fresh[..., one] & fresh[..., other] & fits & better
        order = np.where(swap[..., None], partner, order)
    return order


def _frozen(known: Reach, state: GateState, markers: Array, visible: Array) -> tuple[Array, Array]:
    """`[..., M]` each: True where a marker is at the same place again although two of those on what
    carries it have moved; True where it is at the same place again."""
    again = visible & state.visible
    moved = markers - state.markers
    same = again & (moved == 0).all(-1)
    if not np.count_nonzero(same):
        return same, same
    moving = again & ((moved * moved).sum(-1) > MOVED**2)
    return same & ((known.carriers & moving[..., None, :]).sum(-1) >= 2), same


def _impossible(known: Reach, markers: Array, candidates: Array) -> Array:
    """`[..., M]` True where a marker is too far from or too near to most of the other candidates
    for a hand."""
    apart = distances(markers)
    far = apart > known.farthest.astype(markers.dtype)
    near = apart < known.nearest.astype(markers.dtype)
    pair = candidates[..., :, None] & candidates[..., None, :]
    count = (pair & (far | near)).sum(-1)
    return candidates & (2 * count > candidates.sum(-1)[..., None] - 1)


def _spread(markers: Array, weight: Array) -> Array:
    """`[...]` True where the markers determine the hand's pose."""
    return second_extent(markers, weight.astype(markers.dtype)) > DETERMINED_EXTENT
