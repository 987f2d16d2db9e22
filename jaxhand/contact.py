"""Hands as capsules: how deep flesh would lie in flesh, within a hand and between two, and postures
in which pads touch and nothing lies in anything.

A capsule is what lies within a radius of a segment. A hand is one for each bone: four metacarpals
and the carpus to the thumb make the palm, the others thumb and fingers.

Inside, the batch is the last axis: XLA then runs each line as one loop over the batch, which on a
CPU is ten times as fast as matrices of 3×3 one after the other.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxhand.anthropometry import People
from jaxhand.compiled import apart
from numpy_infer.arrays import Array
from numpy_infer.finger_forms import JOINT_AXES, SIGNS
from numpy_infer.hand import (
    ANGLES,
    ANGLES_OF_FINGER,
    CHAINS,
    FINGER_OF_ANGLE,
    HIGH,
    JOINTS,
    LOW,
    PARENTS,
    POINTS,
    SLOT_OF_ANGLE,
    Hand,
)
from numpy_infer.skeleton import EULER

BONES = POINTS[1:]
"""The 20 capsules, each named for the point in which its bone ends."""

YIELD = 3e-3
"""Metres that flesh gives way, chosen by eye: a finger's pulp is soft up to about 1 N and stiffens
fast beyond (Serina, Mote and Rempel, J. Biomech. 30, 1997). What lies less deep is a touch."""
PRESS = 2e-3
"""Metres that pads in touch press into each other, and others may."""

STEPS, STEP = 6, 0.6
"""Steps of `settled`, and the part of the gap between two pads that each closes in one of them:
somewhat more than half."""
EASE = np.radians(
    [4 if "twist" in a.name else 8 if "abduction" in a.name else 14 for a in ANGLES]
).astype(np.float32)
"""`[26]` radians: how willingly each angle gives way."""
CHUNK = 256
"""Postures that are settled at once: what stays in a cache."""

_START, _END = np.array(PARENTS[1:]), np.arange(1, len(POINTS))
_CHAINS = np.array(CHAINS)
_LAST, _TIP = _CHAINS[:, 2], _CHAINS[:, 3]
_ANGLE = np.array([(own + own[:1])[:6] for own in ANGLES_OF_FINGER])
"""`[5, 6]` the angles of each finger; a finger's sixth is none, see `_USED`."""
_USED = np.array([[k < len(own) for k in range(6)] for own in ANGLES_OF_FINGER], np.float32)
_JOINT, _AXIS = EULER
_AXES = np.moveaxis(JOINT_AXES, 0, -1).astype(np.float32)[..., None]
"""`[3, 3, 15, 1]` the joints' own axes in the flat hand, as columns."""
_PARENT = np.array(PARENTS[1 : len(JOINTS)])
_ABOUT = np.full((3, 15), len(ANGLES))
_ABOUT[_AXIS, _JOINT] = np.arange(len(ANGLES))
"""`[3, 15]` the angle of each joint about its x, y, z; 26 means none."""


def _can_meet(a: int, b: int) -> bool:
    """Whether two of `BONES` can: not if they share a joint, nor through the palm's own flesh,
    which joins its bones, the first of the thumb and the roots of the fingers."""
    if {_START[a], _END[a]} & {_START[b], _END[b]}:
        return False
    # Steps from the palm: 0 for metacarpals and the carpus, 1 and more along a finger.
    steps = [int(np.argwhere(end == _CHAINS)[0, 1]) for end in (_END[a], _END[b])]
    roots = steps == [1, 1] and 1 not in (_START[a], _START[b])
    return sum(steps) > 1 and not roots


PAIRS = np.array(
    [(a, b) for a in range(len(BONES)) for b in range(a + 1, len(BONES)) if _can_meet(a, b)]
).T
"""`[2, P]` indices into `BONES`: the pairs within one hand that can meet."""
_INCIDENCE = np.eye(len(POINTS), dtype=np.float32)[
    np.concatenate([ends[bones] for bones in PAIRS for ends in (_START, _END)])
].T
"""`[21, 4 P]` 1 where a point is start or end of the first bone of a pair, or of the second."""


def capsules(positions: Array, radii: Array) -> tuple[Array, Array]:
    """The capsules of a hand.

    Args:
        positions: `[..., 21, 3]` metres, in the order of `hand.POINTS`; any frame, either hand.
        radii: `[..., 21]` metres, of the bone that ends in each point, see `People.radii`.

    Returns:
        segments `[..., 20, 2, 3]` metres, from start to end of each of `BONES`; radii `[..., 20]`.
    """
    segments = jnp.stack([positions[..., _START, :], positions[..., _END, :]], -2)
    return segments, radii[..., 1:]


def distance(one: Array, other: Array) -> Array:
    """`[...]` metres between segments `[..., 2, 3]`, which broadcast: 0 where they cross. A segment
    without length is a point."""
    ends = [[segment[..., i, k] for k in range(3)] for segment in (one, other) for i in range(2)]
    _, _, gap = _closest(*ends)
    return jnp.sqrt(_dot(gap, gap))


def penetration(segments: Array, radii: Array, others: Array, other_radii: Array) -> Array:
    """`[..., A, B]` metres that each of the capsules `[..., A, 2, 3]`, `[..., A]` reaches into each
    of `[..., B, 2, 3]`, `[..., B]`; 0 for those that are apart."""
    gap = distance(segments[..., :, None, :, :], others[..., None, :, :, :])
    return jnp.maximum(radii[..., :, None] + other_radii[..., None, :] - gap, 0)


def first_clear(candidates: Array, depth: Array) -> Array:
    """`[..., D]` the first of K candidates `[K, ..., D]` whose `depth [K, ...]` is no more than
    `YIELD`, or where there is none the one that is least deep."""
    number = jnp.arange(len(depth), dtype=depth.dtype).reshape(-1, *[1] * (depth.ndim - 1))
    rank = jnp.where(depth <= YIELD, number - len(depth), depth)
    return jnp.take_along_axis(candidates, jnp.argmin(rank, 0)[None, ..., None], 0)[0]


def depth(people: People, angles: Array) -> Array:
    """`[...]` metres: how deep the deepest of a hand's flesh lies in its own at `angles
    [..., 26]`, on `people [...]`."""
    axes = angles.ndim - 1
    points, _ = kinematics(last(people.skeleton, 2, axes), last(angles, 1, axes))
    radii = last(people.radii, 1, axes)
    return own_repulsion(points, radii, 0)[2]


def posed(
    skeleton: Array, angles: Array, wrist_rotation: Array, wrist_position: Array
) -> tuple[Array, Array]:
    """`forward_kinematics` of `rotations_from_angles`, ten times as fast on a CPU.

    Args:
        skeleton: `[..., 21, 3]` metres, each point from its parent in the flat hand.
        angles: `[..., 26]` radians.
        wrist_rotation: `[..., 3, 3]` world_from_wrist.
        wrist_position: `[..., 3]` metres, world.

    Returns:
        positions `[..., 21, 3]` metres, world; rotations `[..., 16, 3, 3]` world_from_joint.
    """
    arrays = ((skeleton, 2), (angles, 1), (wrist_rotation, 2), (wrist_position, 1))
    axes = max(array.ndim - own for array, own in arrays)
    points, turns = kinematics(*(last(array, own, axes) for array, own in arrays))
    return jnp.moveaxis(points, (1, 0), (-2, -1)), jnp.moveaxis(turns, (2, 0, 1), (-3, -2, -1))


def marked(
    hand: Hand, skeleton: Array, angles: Array, wrist_rotation: Array, wrist_position: Array
) -> tuple[Array, Array]:
    """The same, with the hand's markers `[..., M, 3]` metres, world, instead of the rotations:
    markers, then positions. The hand's offsets may be those of people, `[..., M, 3]`."""
    offsets = jnp.asarray(hand.offsets, jnp.float32)
    arrays = ((skeleton, 2), (angles, 1), (wrist_rotation, 2), (wrist_position, 1), (offsets, 2))
    axes = max(array.ndim - own for array, own in arrays)
    *bones, offsets = (last(array, own, axes) for array, own in arrays)
    points, turns = apart(kinematics(*bones))
    joints, links = hand.placing
    markers = points[:, joints] + _apply(turns[:, :, links], jnp.moveaxis(offsets, 1, 0))
    return jnp.moveaxis(markers, (1, 0), (-2, -1)), jnp.moveaxis(points, (1, 0), (-2, -1))


def kinematics(
    skeleton: Array, angles: Array, wrist: Array | None = None, place: Array | None = None
) -> tuple[Array, Array]:
    """The same, batch last: skeleton `[21, 3, ...]`, angles `[26, ...]`, wrist `[3, 3, ...]` and
    its place `[3, ...]`, by default the hand frame → points `[3, 21, ...]`, turns
    `[3, 3, 16, ...]`."""
    batch = angles.shape[1:]
    signed = angles * _column(SIGNS, angles)
    none = jnp.zeros_like(signed[:1])
    sines, cosines = apart((jnp.sin(signed), jnp.cos(signed)))
    sx, sy, sz = jnp.concatenate([sines, none])[_ABOUT]
    cx, cy, cz = jnp.concatenate([cosines, none + 1])[_ABOUT]
    local = jnp.stack(
        [
            jnp.stack([cy * cz, -cy * sz, sy]),
            jnp.stack([cx * sz + sx * sy * cz, cx * cz - sx * sy * sz, -sx * cy]),
            jnp.stack([sx * sz - cx * sy * cz, sx * cz + cx * sy * sz, cx * cy]),
        ]
    )
    thumb = _column(_AXES[:, :, :3, 0], angles)
    turned = _multiply(_multiply(thumb, local[:, :, :3]), jnp.swapaxes(thumb, 0, 1))
    local = apart(jnp.concatenate([turned, local[:, :, 3:]], 2))

    own = jnp.moveaxis(skeleton, 1, 0)
    still = wrist is None
    wrist = _column(np.eye(3), angles) if wrist is None else wrist
    place = jnp.zeros((3, *batch)) if place is None else jnp.broadcast_to(place, (3, *batch))
    turn, at = jnp.broadcast_to(wrist, (3, 3, *batch))[:, :, None], place[:, None]
    joints, turns = [], []
    for level in range(3):
        # The fingers' joints of one level, all at once.
        at = at + _apply(turn, own[:, 1 + level : len(JOINTS) : 3])
        inner = local[:, :, level::3]
        turn = apart(inner if still and level == 0 else _multiply(turn, inner))
        joints.append(at)
        turns.append(turn)
    tips = at + _apply(turn, own[:, len(JOINTS) :])
    middle = jnp.stack(joints, 2).reshape(3, 15, *batch)
    points = jnp.concatenate([place[:, None], middle, tips], 1)
    first = jnp.broadcast_to(wrist, (3, 3, *batch))[:, :, None]
    return points, jnp.concatenate([first, jnp.stack(turns, 3).reshape(3, 3, 15, *batch)], 2)


def settled(
    people: People, angles: Array, touching: Array, held: Array, steps: int = STEPS
) -> Array:
    """Bends fingers until pads meet, and no flesh lies in flesh, on the person's own bones.

    Each step is one of Gauss and Newton of least length, weighed by `EASE`, on what parts the last
    bones from where their pads meet each other or an object; and one down the sum of squared
    depths, as long as if its root were linear (Polyak 1969).

    Args:
        people: `[...]`.
        angles: `[..., 26]` radians, near to a touch.
        touching: `[..., 5]` 1 for the fingers that meet the thumb's pad, else 0.
        held: `[...]` metres between the pads.
        steps: how many.
    """
    batch = angles.shape[:-1]
    skeleton = jnp.broadcast_to(people.skeleton, (*batch, len(POINTS), 3))
    radii = jnp.broadcast_to(people.radii, (*batch, len(POINTS)))

    def chunk(skeleton: Array, radii: Array, touching: Array, held: Array, angles: Array) -> Array:
        def step(_: int, angles: Array) -> Array:
            points, turns = kinematics(skeleton, angles)
            axes, normals = apart(turning(turns, angles))
            bend = _touch_step(points, normals, radii, axes, touching, held)
            force, square, _ = own_repulsion(points, radii, PRESS)
            down = generalised(points, axes, force)
            bend = bend + down * (square / jnp.maximum((down * down).sum(0), 1e-12))
            return bent(angles, bend)

        return jax.lax.fori_loop(0, steps, step, angles)

    return in_chunks(chunk, (skeleton, radii, touching, held, angles), batch)


def bent(angles: Array, bend: Array) -> Array:
    """`[26, ...]` radians, in their ranges: angles after a step in units of `EASE`."""
    moved = angles + bend * _column(EASE, angles)
    return apart(jnp.clip(moved, _column(LOW, angles), _column(HIGH, angles)))


def in_chunks(
    function: Callable[..., Array], arrays: Sequence[Array], batch: tuple[int, ...]
) -> Array:
    """A function of arrays with the batch last, over arrays with the batch first, `CHUNK` at a
    time; the result `[D, ...]` comes back as `[..., D]`."""
    count = int(np.prod(batch))
    size = min(count, CHUNK)
    padded = -(-count // size) * size
    flat = []
    for array in arrays:
        own = array.shape[len(batch) :]
        rows = jnp.broadcast_to(array, (*batch, *own)).reshape(count, *own)
        rows = jnp.concatenate([rows, jnp.broadcast_to(rows[:1], (padded - count, *own))])
        rows = rows.reshape(-1, size, *own)
        flat.append(jnp.moveaxis(rows, 1, -1))
    result = jax.lax.map(lambda rows: function(*rows), tuple(flat))
    return jnp.moveaxis(result, -1, 1).reshape(padded, -1)[:count].reshape(*batch, -1)


def turning(turns: Array, angles: Array) -> tuple[Array, Array]:
    """`[3, 26, ...]` the axis about which each angle turns what lies beyond its joint, times
    `EASE`; `[3, 5, ...]` unit vectors out of the pads."""
    axes = _column(_AXES[..., 0], angles)
    x, y, z = jnp.moveaxis(_multiply(turns[:, :, 1:], axes), 1, 0)
    first = _apply(turns[:, :, _PARENT], axes[:, 0])
    # A joint turns about x of what carries it, then about y as that left it, then about its own z.
    twist = jnp.concatenate([angles * _column(SIGNS, angles), jnp.zeros_like(angles[:1])])[
        _ABOUT[2]
    ]
    second = jnp.sin(twist) * x + jnp.cos(twist) * y
    turning = jnp.stack([first, second, z], 1)[:, _AXIS, _JOINT]
    return turning * _column(SIGNS * EASE, angles), -y[:, _LAST - 1]


def _touch_step(
    points: Array, normals: Array, radii: Array, axes: Array, touching: Array, held: Array
) -> Array:
    """`[26, ...]` in units of `EASE`: a Gauss-Newton step that brings pads together."""
    begin, end = points[:, _LAST], points[:, _TIP]
    on_thumb, on_finger, back = _closest(begin[:, :1], end[:, :1], begin, end)
    way = -jnp.stack(back)
    count = touching.sum(0)
    share = touching / jnp.maximum(count, 1)
    across = _unit(_unit(way) + 0.5 * _unit(normals[:, :1] - normals))
    # Several fingers lie on one face of what is held, the thumb on the other.
    face = _unit((share * across).sum(1, keepdims=True))
    across = jnp.where(count > 1, face, across)
    reach = radii[_TIP]
    gap = (reach[:1] + reach - PRESS + held) * across - way
    gap = jnp.where(count > 1, _dot(gap, across) * across, gap) * touching
    gap = gap.at[:, 0].set(-(share * gap).sum(1))
    part = on_finger.at[0].set((share * on_thumb).sum(0))
    pad = begin + part * (end - begin)

    arms = pad[:, :, None] - points[:, 1 + _JOINT[_ANGLE]]
    slopes = jnp.stack(_cross(axes[:, _ANGLE], arms)) * _column(_USED, pad[0, 0][None])
    rows = [slopes[:, :, k] for k in range(6)]
    square = sum(row[:, None] * row[None] for row in rows)
    square = square + 1e-6 * _column(np.eye(3), pad[0])[:, :, None]
    one, two, three = square[0], square[1], square[2]
    crosses = [jnp.stack(_cross(*pair)) for pair in ((two, three), (three, one), (one, two))]
    pull = jnp.stack([_dot(gap, crossed) for crossed in crosses]) / _dot(one, crosses[0])
    return STEP * _dot(slopes, pull[:, :, None])[FINGER_OF_ANGLE, SLOT_OF_ANGLE]


def generalised(points: Array, axes: Array, force: Array) -> Array:
    """`[26, ...]` what forces `[3, 21, ...]` on the points do to each angle, in units of `EASE`."""
    torque = jnp.stack(_cross(points, force))
    beyond = []
    for of_point in (force, torque):
        # Over all points beyond each of a finger's three joints.
        first, second, third = (of_point[:, _CHAINS[:, i]] for i in (1, 2, 3))
        sums = jnp.stack([first + second + third, second + third, third], 2)
        beyond.append(sums.reshape(3, 15, *sums.shape[3:]))
    force, torque = beyond
    own = torque - jnp.stack(_cross(points[:, 1 : len(JOINTS)], force))
    return _dot(axes, own[:, _JOINT])


def own_repulsion(points: Array, radii: Array, allowed: float) -> tuple[Array, Array, Array]:
    """Pushes capsules of one hand out of each other, batch last: points `[3, 21, ...]`, radii
    `[21, ...]`.

    Returns:
        `[3, 21, ...]` metres: for each point the sum over `PAIRS` of their depth below `allowed`,
        along the way out, times the point's part in the bone: minus half the gradient of the sum of
        squares, the second result `[...]`; and the depth of the deepest `[...]`.
    """
    a, b = PAIRS
    ends = (points[:, _START[a]], points[:, _END[a]], points[:, _START[b]], points[:, _END[b]])
    part, opposite, force, deep = _depth(*ends, radii[_END[a]] + radii[_END[b]] - allowed)
    parts = (1 - part, part, opposite - 1, -opposite)
    pushed = jnp.concatenate([force * part for part in parts], 1)
    # One product with a table for all pairs: adding up by index is slow.
    points = jnp.tensordot(jnp.asarray(_INCIDENCE), pushed, (1, 1), precision="highest")
    return jnp.moveaxis(points, 1, 0), (deep * deep).sum(0), deep.max(0)


def repulsion(
    points: Array, radii: Array, others: Array, other_radii: Array, allowed: float
) -> tuple[Array, Array, Array, Array]:
    """The same between two hands, each bone of the one and each of the other: what it does to the
    points of the one, and to those of the other; the sum of squares; the depth of the deepest."""
    begin, end = points[:, _START][:, :, None], points[:, _END][:, :, None]
    start, stop = others[:, _START][:, None], others[:, _END][:, None]
    reach = radii[1:, None] + other_radii[None, 1:] - allowed
    part, opposite, force, deep = apart(_depth(begin, end, start, stop, reach))
    starting = jnp.asarray(np.eye(len(POINTS), dtype=np.float32)[_START].T)
    sides = []
    for share, axis, sign in ((part, 2, 1), (opposite, 1, -1)):
        at_end, whole = apart((sign * (force * share).sum(axis), sign * force.sum(axis)))
        at_start = jnp.tensordot(starting, whole - at_end, (1, 1), precision="highest")
        at_start = jnp.moveaxis(at_start, 1, 0)
        sides.append(at_start.at[:, 1:].add(at_end))
    return sides[0], sides[1], (deep * deep).sum((0, 1)), deep.max((0, 1))


def _depth(
    begin: Array, end: Array, start: Array, stop: Array, reach: Array
) -> tuple[Array, Array, Array, Array]:
    """Of pairs of segments from and to `[3, ...]`: the parts of `_closest`; by how much they are
    closer than `reach`, along the way from the second to the first, `[3, ...]`; and its length."""
    part, opposite, gap = _closest(begin, end, start, stop)
    length = jnp.sqrt(jnp.maximum(_dot(gap, gap), 1e-12))
    deep = jnp.maximum(reach - length, 0)
    return part, opposite, jnp.stack(gap) * (deep / length), deep


def _closest(begin: Any, end: Any, start: Any, stop: Any) -> tuple[Array, Array, list[Array]]:
    """Where two segments are closest to each other (Ericson, *Real-Time Collision Detection*, 2005,
    section 5.1.9). Of each end the three coordinates `[...]` are given.

    Returns:
        `[...]` each: the parts of both from begin to end, 0 to 1, at which that is; the three
        coordinates, metres, of the way from the second point to the first.
    """
    along, across = _minus(end, begin), _minus(stop, start)
    offset = _minus(begin, start)
    a, e, b = _dot(along, along), _dot(across, across), _dot(along, across)
    c, f = _dot(along, offset), _dot(across, offset)
    # Where the two are parallel every start is as good as another: there rounding decides.
    crossing = a * e - b * b
    part = jnp.clip((b * f - c * e) / jnp.where(crossing > 0, crossing, 1), 0, 1)
    opposite = jnp.clip((b * part + f) / jnp.where(e > 0, e, 1), 0, 1)
    part = jnp.clip((b * opposite - c) / jnp.where(a > 0, a, 1), 0, 1)
    gap = [o + part * u - opposite * v for o, u, v in zip(offset, along, across, strict=True)]
    return part, opposite, gap


def last(array: Array, own: int, axes: int) -> Array:
    """With its `own` last axes first, and behind them `axes` of the batch, some of them 1."""
    array = array.reshape(*[1] * (axes + own - array.ndim), *array.shape)
    return jnp.moveaxis(array, range(-own, 0), range(own))


def _column(constant: Array, like: Array) -> Array:
    """A constant `[...]` that broadcasts to arrays with the batch of `like [D, ...]` behind."""
    constant = jnp.asarray(constant, jnp.float32)
    return constant.reshape(*constant.shape, *[1] * (like.ndim - 1))


def _multiply(a: Array, b: Array) -> Array:
    """`[3, 3, ...]` times `[3, 3, ...]`; as a sum over an axis it would not fuse."""
    return a[:, 0, None] * b[0] + a[:, 1, None] * b[1] + a[:, 2, None] * b[2]


def _apply(a: Array, v: Array) -> Array:
    return a[:, 0] * v[0] + a[:, 1] * v[1] + a[:, 2] * v[2]


def _minus(a: Any, b: Any) -> list[Array]:
    return [a[i] - b[i] for i in range(3)]


def _dot(a: Any, b: Any) -> Array:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


def _cross(a: Any, b: Any) -> list[Array]:
    return [a[i - 2] * b[i - 1] - a[i - 1] * b[i - 2] for i in range(3)]


def _unit(vector: Array) -> Array:
    return vector / jnp.sqrt(_dot(vector, vector) + 1e-12)
