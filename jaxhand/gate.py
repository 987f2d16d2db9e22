"""Notices wrong measurements, which are then treated as hidden. Twin of `numpy_infer.gate`.

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

import jax
import jax.numpy as jnp

from jaxhand.compiled import apart
from jaxhand.geometry import kabsch, mean_point, second_extent, transform
from jaxhand.output import leading
from numpy_infer.arrays import Array
from numpy_infer.gate import (
    ASTRAY,
    BRIEFEST,
    CALM_SECONDS,
    FRAME,
    FRESH,
    GROWTH,
    HIDDEN,
    LONGEST,
    MOVED,
    ONWARD,
    QUIET,
    RESTLESS,
    RETURN,
    ROBUST_ROUNDS,
    ROBUST_SCALE,
    SWAP_FIT,
    SWAP_LEAST,
    SWAP_OFF,
    VOTES,
    GateState,
)
from numpy_infer.model import Model
from numpy_infer.pose import DETERMINED_EXTENT
from numpy_infer.reach import Reach, reach


def init(model: Model, batch: tuple[int, ...] = ()) -> GateState:
    """A gate that has seen nothing.

    Args:
        model: its hand is what is known of distances.
        batch: leading shape of everything.
    """
    shape, dtype = (*batch, len(model.hand)), jnp.asarray(model.hand.template).dtype
    never, nowhere = jnp.zeros(shape, bool), jnp.zeros((*shape, 3), dtype)
    return GateState(
        markers=nowhere,
        visible=never,
        accepted=never,
        place=nowhere,
        velocity=nowhere,
        followed=never,
        calm=jnp.zeros(batch, bool),
        age=jnp.zeros(shape, dtype),
        refused=jnp.zeros(shape, dtype),
        leap=nowhere,
        restless=jnp.zeros(batch, dtype),
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
    if isinstance(model.hand.skeleton, jax.core.Tracer):
        raise ValueError(
            "a model with a gate cannot be an argument of what JAX compiles: close over it"
        )
    moved = markers - state.markers
    off = moved - state.velocity * dt[..., None, None]
    off = off - off.sum(-2, keepdims=True) / markers.shape[-2]
    far = (off * off).sum(-1)
    # A coordinate that is the same again may be a frozen one.
    told = (moved != 0).sum((-1, -2)) == 3 * visible.sum(-1)
    alike = state.calm & (visible == state.visible).all(-1)
    quiet = told & alike & (far.max(-1) < QUIET**2) & (dt > BRIEFEST)
    repeated = ~(dt > 0) & (visible == state.visible).all(-1) & (moved == 0).all((-1, -2))
    careful = _carefully(model, state, markers, visible, last, tracked, dt)
    quick = _quietly(state, markers, moved, visible, jnp.maximum(dt, BRIEFEST))
    merged = GateState(
        *(
            jnp.where(leading(quiet, new), new, jnp.where(leading(repeated, old), old, other))
            for old, new, other in zip(state, quick, careful, strict=True)
        )
    )
    return merged, merged.accepted


def _quietly(
    state: GateState, markers: Array, moved: Array, visible: Array, dt: Array
) -> GateState:
    """The state after a frame that is like the one before: nothing is off, comes or goes."""
    time = dt[..., None]
    return state._replace(
        markers=markers,
        place=markers,
        velocity=moved / time[..., None],
        age=jnp.where(visible, 0, state.age + time),
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
    stay = jnp.where(follows, state.place, last)
    ahead = jnp.minimum(time, CALM_SECONDS)[..., None]
    going = stay + jnp.where(follows, state.velocity, drift) * ahead
    fresh = visible & state.followed
    motion = _motion(jnp.stack([stay, going]), markers, fresh)
    placed = apart(transform(*motion, jnp.stack([stay, going])))
    off = _least(placed - markers)
    restless = RESTLESS * state.restless[..., None]
    usual = jnp.maximum(FRESH * jnp.maximum(time / FRAME, 1), restless)
    trust = jnp.where(state.refused > 0, 1, HIDDEN)
    returning = jnp.maximum(trust * (RETURN + GROWTH * state.age), restless)
    tolerance = jnp.where(state.followed, usual, returning)
    # Fewer than three that are followed do not say where to expect the others.
    refers = (state.followed | tracked[..., None]) & (fresh.sum(-1) >= 3)[..., None] & ~excused
    suspect = visible & refers & (off > tolerance)
    # What jumped stays where it jumped to; a finger that was faster than expected goes on.
    leapt = (state.leap * state.leap).sum(-1)
    before = transform(motion[0][0], motion[1][0], state.markers)
    onward = ((markers - before) * state.leap).sum(-1) > ONWARD * leapt
    suspect = suspect & ~(onward & (leapt > 0))

    order = _labels(known, placed, markers, off, fresh & refers)
    swapped = order != jnp.arange(markers.shape[-2])
    frozen, same = _frozen(known, state, markers, visible)
    wrong = suspect | swapped | frozen | (same & ~state.accepted & ~excused)
    entering = visible & ~state.followed & ~excused
    wrong = wrong | (entering & _impossible(known, markers, visible & ~wrong))

    # Where most of a frame is wrong, or what is left would not do, it is the gate that is wrong.
    left = visible & ~wrong
    enough = _spread(markers, left) | ~_spread(markers, visible)
    believed = (2 * left.sum(-1) >= visible.sum(-1)) & enough
    wrong = wrong & believed[..., None]
    swapped = swapped & believed[..., None]
    accepted = visible & ~wrong
    followed = accepted | swapped
    own = jnp.take_along_axis(markers, order[..., None], -2)
    place = jnp.where(swapped[..., None], own, jnp.where(accepted[..., None], markers, 0))

    steadily = followed & state.followed & (swapped | ~suspect)
    brief = (time <= BRIEFEST)[..., None]
    speed = (place - state.place) / jnp.maximum(time, BRIEFEST)[..., None]
    speed = jnp.where(brief, state.velocity, speed)
    drift = mean_point(speed, steadily.astype(markers.dtype))[..., None, :]
    velocity = jnp.where(steadily[..., None], speed, jnp.where(followed[..., None], drift, 0))
    level = mean_point(off[..., None], (accepted & steadily).astype(markers.dtype))[..., 0]
    agrees = ~state.accepted & (off <= RETURN) & refers
    forgiven = jnp.where(agrees, 0, state.refused - jnp.where(state.accepted, time, 0))
    refused = jnp.where(accepted, forgiven, state.refused + jnp.where(visible & ~frozen, time, 0))
    refused = jnp.maximum(refused, 0)
    return GateState(
        markers=markers,
        visible=visible,
        accepted=accepted,
        place=place,
        velocity=velocity,
        followed=followed,
        calm=~(wrong | (refused > 0)).any(-1),
        age=jnp.where(accepted, 0, state.age + time),
        refused=refused,
        leap=jnp.where((suspect & wrong & state.followed)[..., None], markers - placed[0], 0),
        restless=jnp.maximum(state.restless / (1 + dt / CALM_SECONDS), level),
    )


def _motion(places: Array, markers: Array, fresh: Array) -> tuple[Array, Array]:
    """The rigid motion `[..., 3, 3]`, `[..., 3]` of the hand from `places` to `markers`, by those
    that are `fresh`, except what does not fit."""
    eye = jnp.broadcast_to(jnp.eye(3, dtype=markers.dtype), (*places.shape[:-2], 3, 3))
    markers = jnp.broadcast_to(markers, places.shape)
    use = jnp.broadcast_to(fresh.astype(markers.dtype), places.shape[:-1])
    # A marker's first say is by how many keep their distance from it: large errors would turn the
    # hand of a plain fit.
    both = use[..., :, None] * use[..., None, :]
    earlier, now = _distances(places) * both, _distances(markers) * both
    change = earlier - now
    # A few that are suddenly kilometres from most others have no say at all: the least would do.
    count = (use > 0).sum(-1, keepdims=True)
    astray = 2 * (jnp.abs(change) > ASTRAY).sum(-1) > count
    use = jnp.where(astray & (2 * astray.sum(-1, keepdims=True) < count), 0, use)
    votes = (use[..., None, :] / (1 + jnp.minimum(change * change, 1) / ROBUST_SCALE**2)).sum(-1)
    # Sizes that are no hand's would overflow in float32.
    both = use[..., :, None] * use[..., None, :]
    size = (jnp.maximum(earlier, now) * both).max((-1, -2))
    use = use / (1 + size * size)[..., None]
    first = use * (votes / markers.shape[-2]) ** VOTES

    def again(_: int, motion: tuple[Array, Array]) -> tuple[Array, Array]:
        off = apart(transform(*motion, places)) - markers
        far = jnp.minimum((off * off).sum(-1), 1) / ROBUST_SCALE**2
        return kabsch(places, markers, apart(use / (1 + far) ** 2), eye)

    return jax.lax.fori_loop(0, ROBUST_ROUNDS, again, kabsch(places, markers, apart(first), eye))


def _distances(points: Array) -> Array:
    """`[..., M, M]` metres, of all to all."""
    between = points[..., :, None, :] - points[..., None, :, :]
    return jnp.sqrt((between * between).sum(-1))


def _least(off: Array) -> Array:
    """`[2, ..., 3]` → `[...]` the lesser length."""
    return jnp.sqrt((off * off).sum(-1).min(0))


def _labels(known: Reach, placed: Array, markers: Array, off: Array, fresh: Array) -> Array:
    """`[..., M]` the label under which each marker is measured: its own, or a neighbour's."""
    order = jnp.broadcast_to(jnp.arange(markers.shape[-2]), fresh.shape)
    for (one, other), partner in zip(known.neighbours, known.partner, strict=True):
        crossed = _least(placed[..., one, :] - markers[..., other, :])
        crossed_back = _least(placed[..., other, :] - markers[..., one, :])
        fits = jnp.maximum(crossed, crossed_back) < SWAP_FIT
        better = off[..., one] + off[..., other] > SWAP_LEAST + SWAP_OFF * (crossed + crossed_back)
        swap = fresh[..., one] & fresh[..., other] & fits & better
        order = jnp.where(swap[..., None], jnp.asarray(partner, order.dtype), order)
    return order


def _frozen(known: Reach, state: GateState, markers: Array, visible: Array) -> tuple[Array, Array]:
    """`[..., M]` each: True where a marker is at the same place again although two of those on what
    carries it have moved; True where it is at the same place again."""
    again = visible & state.visible
    moved = markers - state.markers
    same = again & (moved == 0).all(-1)
    moving = again & ((moved * moved).sum(-1) > MOVED**2)
    return same & ((known.carriers & moving[..., None, :]).sum(-1) >= 2), same


def _impossible(known: Reach, markers: Array, candidates: Array) -> Array:
    """`[..., M]` True where a marker is too far from or too near to most of the other candidates
    for a hand."""
    between = _distances(markers)
    far = between > jnp.asarray(known.farthest, markers.dtype)
    near = between < jnp.asarray(known.nearest, markers.dtype)
    pair = candidates[..., :, None] & candidates[..., None, :]
    count = (pair & (far | near)).sum(-1)
    return candidates & (2 * count > candidates.sum(-1)[..., None] - 1)


def _spread(markers: Array, weight: Array) -> Array:
    """`[...]` True where the markers determine the hand's pose."""
    return second_extent(markers, weight.astype(markers.dtype)) > DETERMINED_EXTENT
