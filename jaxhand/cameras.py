"""Gaps as cameras make them: who sees a marker past two hands, and what they get wrong.

Cameras stand round a room. Every marker shines out of the skin within a cone, and bones are
capsules. A marker is measured while enough cameras see it. Everything is in metres, seconds and
radians, in the world frame with y up, float32. The same key gives the same result; every function
is pure, and safe under jit and vmap.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxhand.anthropometry import People, placed
from jaxhand.compiled import apart
from jaxhand.contact import capsules
from jaxhand.geometry import mirror, mirror_rotation, product
from jaxhand.motion import HOME, Motion, uniform
from jaxhand.skeleton import forward_kinematics, rotations_from_angles
from numpy_infer.arrays import Array
from numpy_infer.hand import JOINTS, PARENTS, THUMB_AXES, Hand, flat_points

ON_SKIN, ON_AXIS = 0.9, 1e-3
"""A marker sits on the outside of whatever it is near. An occluder is no thicker for it than this
part of its distance from the occluder's axis, so that none hides a marker from the outside because
the marker was modelled inside of it. On the axis, within these metres, its cone alone decides."""

TINY = 1e-12
"""Square metres: a segment that is shorter, or seen end on, is a point."""

AT_ONCE = 512
"""Frames whose tests lie in the cache together."""

PATTERN = 0.2, 0.25
"""How far a camera may be off its place: part of the angle between two, and metres of height."""


class Surface(NamedTuple):
    """What cameras see of a hand: markers that shine, and capsules that hide."""

    markers: Array
    """`[..., M, 3]` metres, world."""
    normals: Array
    """`[..., M, 3]` unit vectors, world: where each marker shines."""
    segments: Array
    """`[..., K, 2, 3]` metres, world: both ends of each capsule's axis."""
    radii: Array
    """`[..., K]` metres."""


LONGEST = 10.0
"""Seconds: the longest spell. Gaps were measured up to 8."""


class Spells(NamedTuple):
    """Times that come at random, with lengths of a log-logistic distribution."""

    per_second: float
    """How many of them begin, on average."""
    seconds: float
    """Their median length."""
    tail: float
    """How heavy the tail is: 90 % are shorter than `seconds · 9 ** tail`."""


class Rig(NamedTuple):
    """Cameras round a room, and how well they see. The defaults make gaps of the lengths, and miss
    as much, as was measured of five markers a hand in a studio: `experiments/camera_gaps.py`."""

    cameras: int = 16
    """Their number; under jit a constant."""
    needed: int = 2
    """Cameras that must see a marker for it to be measured."""
    start: int = 3
    """Cameras that must see it for it to be found again once it was lost."""
    low: float = 0.4
    high: float = 2.4
    """Metres: heights between which they alternate."""
    distance: float = 2.5
    """Metres from the middle of the room."""
    cone: float = 1.95
    """Radians: half the angle within which a marker shines. A ball that stands off the skin is seen
    from all sides but that of the finger."""
    thickness: float = 1.0
    """How thick hands are, beside their capsules' radii."""
    fade: float = 0.05
    """Radians: standard deviation of the cone's border, from frame to frame."""
    blur: float = 0.4e-3
    """Metres: the same of the borders of what hides a marker."""
    dropouts: Spells = Spells(0.12, 0.02, 1.0)
    """Of each marker, when no camera finds it although they should."""


class Faults(NamedTuple):
    """Wrong positions. By default there are none."""

    jumps: Spells = Spells(0.0, 0.05, 0.6)
    """Of each marker: it is measured elsewhere, at a constant distance."""
    jump: float = 0.05
    """Metres: standard deviation of that, along each axis."""
    frozen: Spells = Spells(0.0, 0.1, 0.6)
    """Of each marker: it stays where it was last seen."""
    swaps: Spells = Spells(0.0, 0.2, 0.6)
    """Of each pair of neighbours: they carry each other's label."""


def place_cameras(key: Array, rig: Rig, batch: tuple[int, ...] = ()) -> Array:
    """`[..., C, 3]` metres: the rig's cameras on a ring round `motion.HOME`, by turns low and
    high, each a little off its place."""
    draws = jax.random.uniform(key, (*batch, 2 * rig.cameras + 1), minval=-1, maxval=1)
    first, off, raised = jnp.split(draws, (1, 1 + rig.cameras), -1)
    places = jnp.arange(rig.cameras, dtype=draws.dtype) + PATTERN[0] * off + rig.cameras * first
    angle = 2 * math.pi / rig.cameras * places
    height = jnp.where(jnp.arange(rig.cameras) % 2 == 0, rig.low, rig.high) + PATTERN[1] * raised
    x, z = HOME[0] + rig.distance * jnp.cos(angle), HOME[2] + rig.distance * jnp.sin(angle)
    return jnp.stack([x, height, z], -1)


def emission_axes(hand: Hand) -> Array:
    """`[M, 3]` unit vectors in the frame of each marker's link: where it shines.

    Away from the axis of the nearest bone of its link; a marker on that axis, such as one on a tip,
    shines out of the finger's back.
    """
    points = flat_points(hand.skeleton)
    axes = np.empty((len(hand), 3), np.float32)
    for i, (joint, link) in enumerate(zip(hand.joints, hand.links, strict=True)):
        marker = points[joint] + hand.offsets[i] - points[link]
        bones = points[np.array(PARENTS) == link] - points[link]
        share = (marker * bones).sum(-1) / (bones * bones).sum(-1)
        away = marker - np.clip(share, 0, 1)[:, None] * bones
        distance = np.linalg.norm(away, axis=-1)
        nearest = np.argmin(distance)
        back = np.array(THUMB_AXES) if JOINTS[link].startswith("thumb") else np.eye(3)
        on_axis = distance[nearest] <= ON_AXIS
        axes[i] = back[:, 1] if on_axis else away[nearest] / distance[nearest]
    return axes


def surface(
    hand: Hand, markers: Array, positions: Array, rotations: Array, radii: Array
) -> Surface:
    """A hand as cameras see it.

    Args:
        hand: which link carries each marker.
        markers: `[..., M, 3]` metres, world.
        positions: `[..., 21, 3]` metres, world, as `forward_kinematics` gives them.
        rotations: `[..., 16, 3, 3]` world_from_joint, likewise.
        radii: `[..., 21]` metres, see `anthropometry.People`.
    """
    segments, radii = capsules(positions, radii)
    links = rotations[..., hand.placing[1], :, :]
    normals = product(links, jnp.asarray(emission_axes(hand))[..., None])[..., 0]
    return Surface(markers, normals, segments, jnp.broadcast_to(radii, segments.shape[:-2]))


def reflected(what: Surface) -> Surface:
    """All of it reflected in x = 0: simulated hands are canonical left hands, and the mirror image
    of one is a right hand."""
    markers, normals, segments = map(mirror, what[:3])
    return Surface(markers, normals, segments, what.radii)


def worn(key: Array, hand: Hand, person: People, motion: Motion) -> Surface:
    """A person's hand in motion, with markers stuck on by hand.

    Args:
        key: what the markers' places are drawn from, see `anthropometry.placed`.
        hand: the layout of the markers, on the mean person.
        person: `[...]` people.
        motion: `[..., T]` frames of each.
    """
    positions, rotations = forward_kinematics(
        person.skeleton[..., None, :, :],
        rotations_from_angles(motion.angles),
        motion.wrist_rotation,
        motion.wrist_position,
    )
    joints, links = hand.placing
    offsets = placed(key, hand, person)[..., None, :, :, None]
    markers = positions[..., joints, :] + product(rotations[..., links, :, :], offsets)[..., 0]
    return surface(hand, markers, positions, rotations, person.radii[..., None, :])


def together(first: Surface, *others: Surface) -> Surface:
    """Several hands, or objects, in one world: `[..., M1 + M2 + …, 3]` and so on."""
    parts = zip(zip(first, *others, strict=True), (-2, -2, -3, -1), strict=True)
    return Surface(*(jnp.concatenate(arrays, axis) for arrays, axis in parts))


def obstacle(ends: Array, radius: Array) -> Surface:
    """A capsule without markers, such as a thing in the hands or a person's trunk: its `ends
    [..., 2, 3]` and `radius [...]` in metres. A sphere has both ends in one place."""
    none = jnp.zeros((*ends.shape[:-2], 0, 3), ends.dtype)
    return Surface(none, none, ends[..., None, :, :], radius[..., None])


def seeing(
    what: Surface, cameras: Array, cone: float | Array, margin: float | Array = 0.0
) -> Array:
    """`[..., M]` the number of cameras that see each marker.

    A camera sees a marker that shines its way, when no capsule comes between. Between a ray and a
    segment that is the least of a convex function: it suffices to look at the line's point, because
    neither the marker (see `ON_SKIN`) nor the camera is inside of a capsule.

    Args:
        what: markers, and capsules that hide them, `[...]` frames.
        cameras: `[..., C, 3]` metres, world.
        cone: `[..., M]` radians, half the angle of the cone within which a marker shines.
        margin: `[..., M]` metres by which all capsules are thicker for a marker.
    """
    batch = jnp.broadcast_shapes(what.markers.shape[:-2], cameras.shape[:-2])
    count, chunk = math.prod(batch), min(AT_ONCE, math.prod(batch))
    if not count or not cameras.shape[-2]:
        return jnp.zeros((*batch, what.markers.shape[-2]), jnp.int32)

    def frames_last(array: Array, axes: int) -> Array:
        """`[chunks, …, frames]`: tests of neighbouring frames share a vector register."""
        array = jnp.broadcast_to(array, (*batch, *array.shape[array.ndim - axes :]))
        array = array.reshape(count, *array.shape[len(batch) :])
        padding = [(0, -count % chunk)] + [(0, 0)] * axes
        array = jnp.pad(array, padding, mode="edge")
        return jnp.moveaxis(array.reshape(-1, chunk, *array.shape[1:]), 1, -1)

    each = what.markers.shape[-2:-1]
    inputs = (
        Surface(*map(frames_last, what, (2, 2, 3, 1))),
        frames_last(cameras, 2),
        frames_last(jnp.broadcast_to(jnp.cos(cone), (*batch, *each)), 1),
        frames_last(jnp.broadcast_to(jnp.asarray(margin), (*batch, *each)), 1),
    )
    seen = jax.lax.map(lambda chunk: _seeing(*chunk), inputs)
    return jnp.moveaxis(seen, -1, 1).reshape(-1, *each)[:count].reshape(*batch, *each)


def _seeing(what: Surface, cameras: Array, cosine: Array, margin: Array) -> Array:
    """`[M, F]` of arrays whose last axis is that of F frames."""
    markers, normals, segments, radii = what
    away = cameras - markers[:, None]
    length = jnp.sqrt((away * away).sum(-2))
    rays = away / length[:, :, None]
    shone_on = (rays * normals[:, None]).sum(-2) >= cosine[:, None]
    rays, length, shone_on = apart((jnp.moveaxis(rays, -2, 0), length, shone_on))
    markers = jnp.moveaxis(markers, 1, 0)

    def capsule(clear: Array, its: tuple[Array, Array, Array]) -> tuple[Array, None]:
        start, along, radius = its
        from_marker = start[:, None] - markers
        squared, slope = _dot(from_marker, from_marker), _dot(from_marker, along[:, None])
        size = _dot(along, along)
        share = jnp.clip(-slope / jnp.maximum(size, TINY), 0, 1)
        distance = jnp.sqrt(jnp.maximum(squared + share * (2 * slope + share * size), 0))
        skin = jnp.where(distance > ON_AXIS, ON_SKIN * distance, 0)
        thick = apart(jnp.clip(radius + margin, 0, skin))
        # The same with what points along the ray taken away: the segment as seen along it.
        ahead = _dot(rays, from_marker[:, :, None])
        speed = _dot(rays, along[:, None, None])
        slope = slope[:, None] - ahead * speed
        size = size - speed * speed
        share = jnp.clip(-slope / jnp.maximum(size, TINY), 0, 1)
        gap = squared[:, None] - ahead * ahead + share * (2 * slope + share * size)
        ahead = ahead + share * speed
        # Rounding can make the square negative; thickness 0 hides nothing.
        hidden = (jnp.maximum(gap, 0) < (thick * thick)[:, None]) & (ahead > 0) & (ahead < length)
        return clear & ~hidden, None

    axes = segments[:, 0], segments[:, 1] - segments[:, 0], radii
    return jax.lax.scan(capsule, shone_on, axes)[0].sum(1)


def _dot(a: Array, b: Array) -> Array:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


class Conditions(NamedTuple):
    """What is drawn at random."""

    cameras: Array
    """`[..., 1, C, 3]` metres, world."""
    flicker: Array
    """`[..., T, M]` standard normal: how well the marker is seen by all cameras."""
    lost: Array
    """`[..., T, M]` True in a drop-out."""


def conditions(
    key: Array, rig: Rig, frames: int, markers: int, rate: float, batch: tuple[int, ...] = ()
) -> Conditions:
    """Draws them."""
    camera_key, noise_key, dropout_key = jax.random.split(key, 3)
    lost, _ = spells(uniform(dropout_key, (*batch, frames, markers)), rig.dropouts, rate)
    cameras = place_cameras(camera_key, rig, batch)[..., None, :, :]
    return Conditions(cameras, jax.random.normal(noise_key, lost.shape), lost)


def observe(key: Array, what: Surface, rate: float, rig: Rig) -> Array:
    """`[..., T, M]` True where the markers of `[..., T]` frames at `rate` Hz are measured. Every
    recording, that is what stands before the frames, has cameras of its own."""
    *batch, frames, markers, _ = what.markers.shape
    return under(conditions(key, rig, frames, markers, rate, tuple(batch)), what, rig)


def under(given: Conditions, what: Surface, rig: Rig) -> Array:
    """`[..., T, M]` True where measured under these conditions."""
    thick = what._replace(radii=rig.thickness * what.radii)
    cone, margin = rig.cone + rig.fade * given.flicker, -rig.blur * given.flicker
    seen = seeing(thick, given.cameras, cone, margin)
    return followed(jnp.where(given.lost, 0, seen), rig)


def followed(seen: Array, rig: Rig) -> Array:
    """`[..., T, M]` True while a marker is followed: from the first frame, or from when `start`
    cameras see it, until fewer than `needed` do. `seen [..., T, M]` is their number."""
    now = jnp.arange(seen.shape[-2])[:, None]
    enough = seen >= jnp.where(now == 0, rig.needed, jnp.maximum(rig.start, rig.needed))
    decided = enough | (seen < rig.needed)
    last = jax.lax.cummax(jnp.where(decided, now, 0), seen.ndim - 2)
    return jnp.take_along_axis(enough, last, -2)


def film(
    key: Array, hand: Hand, person: People, left: Motion, right: Motion, rate: float, rig: Rig
) -> tuple[Array, Array]:
    """Two hands of simulated people before cameras, each alone and both together.

    Args:
        key: what markers' places, cameras and drop-outs are drawn from.
        hand: the layout of both.
        person: `[...]` whose hands these are.
        left: `[..., T]` frames.
        right: `[..., T]` frames, see `two_hands`: world_from_wrist is that of a right hand.
        rate: frames per second.
        rig: the cameras.

    Returns:
        `[2, ..., T, M]` each, left and right: True where measured alone; beside the other hand.
    """
    place_key, key = jax.random.split(key)
    right = Motion(
        right.angles, mirror_rotation(right.wrist_rotation), mirror(right.wrist_position)
    )
    owner = jax.tree.map(lambda x: jnp.stack([x, x]), person)
    motions = jax.tree.map(lambda *sides: jnp.stack(sides), left, right)
    both = worn(place_key, hand, owner, motions)
    one, other = (Surface(*(x[side] for x in both)) for side in range(2))
    other = reflected(other)
    *batch, frames, markers, _ = one.markers.shape
    given = conditions(key, rig, frames, 2 * markers, rate, tuple(batch))

    beside = under(given, together(one, other), rig)
    flicker, lost, beside = (
        jnp.stack(jnp.split(x, 2, -1)) for x in (given.flicker, given.lost, beside)
    )
    # Alone a marker has the same cameras, flicker and drop-outs as beside the other hand.
    each = Surface(*map(jnp.stack, zip(one, other, strict=True)))
    return under(Conditions(given.cameras, flicker, lost), each, rig), beside


def spells(draws: Array, what: Spells, rate: float) -> tuple[Array, Array]:
    """Times that begin at random in frames at `rate` Hz, out of `draws [..., T, B]` in 0 to 1, each
    of the B by itself; none in the first frame.

    Returns:
        `[..., T, B]` each: True inside of a spell; the frame in which the last of them began, 0
        before the first.
    """
    now = jnp.arange(draws.shape[-2])[:, None]
    chance = what.per_second / rate
    begins = (draws < chance) & (now > 0)
    # What is left of a draw below the chance is again uniform.
    part = jnp.clip(draws / jnp.maximum(chance, 1e-12), 1e-6, 1 - 1e-6)
    length = jnp.round(rate * what.seconds * (part / (1 - part)) ** what.tail)
    length = jnp.clip(length, 1, rate * LONGEST).astype(now.dtype)
    ends = jax.lax.cummax(jnp.where(begins, now + length, 0), draws.ndim - 2)
    return now < ends, jax.lax.cummax(jnp.where(begins, now, 0), draws.ndim - 2)


def misplace(
    key: Array, markers: Array, visible: Array, rate: float, pairs: Array, faults: Faults
) -> tuple[Array, Array, Array]:
    """Puts wrong positions among measured ones: jumps, frozen markers, swapped labels.

    Args:
        key: what they are drawn from.
        markers: `[..., T, M, 3]` metres, world: the truth, finite also where hidden.
        visible: `[..., T, M]` True where measured.
        rate: frames per second.
        pairs: `[P, 2]` markers whose labels may be swapped, see `reach.neighbours`.
        faults: how many there are of each kind.

    Returns:
        Markers; visible (labels that are swapped take it along); `[..., T, M]` True where a
        measured position is not the truth.
    """
    *batch, frames, count, _ = markers.shape
    jump_key, offset_key, frozen_key, swap_key = jax.random.split(key, 4)
    jumped, began = spells(uniform(jump_key, visible.shape), faults.jumps, rate)
    offsets = faults.jump * jax.random.normal(offset_key, markers.shape)
    offsets = jnp.take_along_axis(offsets, began[..., None], -3)
    measured = jnp.where(jumped[..., None], markers + offsets, markers)

    frozen, began = spells(uniform(frozen_key, visible.shape), faults.frozen, rate)
    now = jnp.arange(frames)[:, None]
    last = jax.lax.cummax(jnp.where(visible, now, -1), len(batch))
    last = jnp.take_along_axis(last, began, -2)
    held = jnp.take_along_axis(measured, jnp.maximum(last, 0)[..., None], -3)
    measured = jnp.where((frozen & (last >= 0))[..., None], held, measured)

    swapped, _ = spells(uniform(swap_key, (*batch, frames, len(pairs))), faults.swaps, rate)
    order = jnp.broadcast_to(jnp.arange(count), visible.shape)
    for index, (one, other) in enumerate(np.asarray(pairs)):
        swap = swapped[..., index]
        first, second = order[..., one], order[..., other]
        order = order.at[..., one].set(jnp.where(swap, second, first))
        order = order.at[..., other].set(jnp.where(swap, first, second))
    measured = jnp.take_along_axis(measured, order[..., None], -2)
    visible = jnp.take_along_axis(visible, order, -1)
    return measured, visible, visible & (measured != markers).any(-1)
