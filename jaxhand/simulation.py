"""Frames and recordings of hands out of a random key, to train on before there are real ones.

Everything is a canonical left hand in metres, seconds and radians, float32. The same key gives the
same result; every function is pure, and but for `sequences` safe under jit and vmap.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxhand.anthropometry import people, placed
from jaxhand.cameras import Spells, spells
from jaxhand.contact import marked
from jaxhand.motion import DIP_SHARE, minimum_jerk, motion, uniform
from jaxhand.sequences import RATE, Sequence
from numpy_infer.arrays import Array
from numpy_infer.hand import ANGLES, HIGH, LOW, Hand

GAPS = Spells(1 / 3, 0.1, 0.6)
"""Of each marker by itself. 90 % are shorter than 0.37 s (paper, section 6.1: 0.36 s), one in fifty
is longer than a second."""
OBSTACLES = Spells(1 / 5, 0.1, 0.6)
"""Of what hides several markers at once."""


class PoseKind(NamedTuple):
    """A family of postures, in degrees. Fingers are index to pinky."""

    share: float
    """Of all postures."""
    mcp: tuple[float, float, float, float]
    pip: tuple[float, float, float, float]
    """Mean flexion of each finger."""
    finger_spread: float
    """Standard deviation of both."""
    thumb: tuple[float, float, float, float, float, float]
    """Means of the thumb's angles, in the order of `hand.ANGLES`."""
    thumb_spread: float
    """Their standard deviation; twist and abduction of the MCP joint have a third of it."""


POSE_KINDS = (
    PoseKind(0.60, (30, 30, 30, 30), (42, 42, 42, 42), 34, (12, 5, 0, 10, 0, 15), 18),
    PoseKind(0.14, (0, 0, 0, 0), (3, 3, 3, 3), 6, (0, 0, 0, 0, 0, 0), 8),
    PoseKind(0.12, (80, 82, 82, 80), (100, 103, 102, 98), 8, (33, 6, 2, 18, 1, 25), 8),
    PoseKind(0.14, (45, 48, 40, 35), (45, 42, 35, 30), 10, (34, 10, -5, 15, 2, 15), 6),
)
"""Free, flat, fist, and the thumb's tip by those of index and middle finger."""

NEIGHBOUR_CORRELATION = 0.8
"""Of the flexions of neighbouring fingers, beside what their kind of posture has in common."""

_DISTANCE = np.abs(np.subtract.outer(np.arange(4), np.arange(4)))
_NEIGHBOURS = np.linalg.cholesky(NEIGHBOUR_CORRELATION**_DISTANCE).astype(np.float32)
"""`[4, 4]` makes independent numbers of four fingers correlated ones."""
_FAN = np.array([1, 0.2, -0.4, -1], np.float32)
"""How far each finger goes towards the thumb as the hand spreads: the middle one hardly."""


class Streams(NamedTuple):
    """Recordings of N hands, with the truth behind them."""

    markers: Array
    """`[N, T, M, 3]` metres, world, all of them."""
    visible: Array
    """`[N, T, M]` False in the gaps."""
    angles: Array
    """`[N, T, 26]` radians."""
    positions: Array
    """`[N, T, 21, 3]` metres, world: joints and tips."""
    wrist_rotation: Array
    """`[N, T, 3, 3]` world_from_wrist."""
    wrist_position: Array
    """`[N, T, 3]` metres, world."""
    skeleton: Array
    """`[N, 21, 3]` metres: each person's own bones, constant in time."""
    offsets: Array
    """`[N, M, 3]` metres: where each marker really sits, as `Hand.offsets`, constant in time."""
    time: Array
    """`[T]` seconds."""

    def sequences(self) -> list[Sequence]:
        """Without their gaps, as evaluations take them; the streams are at 60 Hz."""
        return [
            Sequence(f"person {i}", f"person {i}", RATE, markers)
            for i, markers in enumerate(np.asarray(self.markers))
        ]


def poses(key: Array, batch: tuple[int, ...] = ()) -> Array:
    """`[..., 26]` radians: postures as `POSE_KINDS` describes them, inside of the angles' ranges.

    The four fingers' flexions are correlated from neighbour to neighbour, DIP follows PIP, a flexed
    finger can hardly be spread (its collateral ligaments are taut), and twists are small.
    """
    kind_key, key = jax.random.split(key)
    shares = jnp.array([kind.share for kind in POSE_KINDS[:-1]])
    # One call draws all there is of a kind of number: XLA takes a second to compile each.
    kind = (jax.random.uniform(kind_key, (*batch, 1)) > jnp.cumsum(shares)).sum(-1)
    normal = jax.random.normal(key, (*batch, 1 + len(ANGLES)))

    def of_kind(field: str) -> Array:
        table = np.radians([getattr(kind, field) for kind in POSE_KINDS]).astype(np.float32)
        return jnp.asarray(table)[kind]

    relative = jnp.array([1, 1, 1 / 3, 1, 1 / 3, 1])
    thumb = of_kind("thumb") + of_kind("thumb_spread")[..., None] * relative * normal[..., 1:7]

    own = jnp.moveaxis(normal[..., 7:].reshape(*batch, 5, 4), -2, 0)
    spread = of_kind("finger_spread")[..., None]
    mcp = of_kind("mcp") + spread * (jnp.asarray(_NEIGHBOURS) * own[0][..., None, :]).sum(-1)
    pip = of_kind("pip") + spread * (jnp.asarray(_NEIGHBOURS) * own[1][..., None, :]).sum(-1)
    dip = DIP_SHARE * pip + math.radians(6) * own[2]
    straight = 1 - 0.8 * jnp.clip(mcp / math.radians(80), 0, 1)
    fan = math.radians(8) * normal[..., :1] * jnp.asarray(_FAN)
    abduction = straight * (fan + math.radians(4) * own[3])
    twist = math.radians(3) * own[4]
    fingers = jnp.stack([mcp, abduction, twist, pip, dip], -1)
    angles = jnp.concatenate([thumb, fingers.reshape(*batch, -1)], -1)
    return jnp.clip(angles, jnp.float32(LOW), jnp.float32(HIGH))


def gaps(key: Array, frames: int, markers: int, rate: float, batch: tuple[int, ...] = ()) -> Array:
    """`[..., T, M]` True where visible. Now and then each marker is lost by itself, and now and
    then an obstacle hides several at random. In the first frame all are seen."""
    draws = uniform(key, (*batch, frames, 2 * markers + 2))
    own, obstacle, share, hides = jnp.split(draws, (markers, markers + 1, markers + 2), -1)
    lost, _ = spells(own, GAPS, rate)
    behind, began = spells(obstacle, OBSTACLES, rate)
    # An obstacle hides the same markers until it is gone or the next one comes.
    hides = jnp.take_along_axis(hides < share, began, -2)
    return ~(lost | (behind & hides))


# As a whole: operation by operation it is compiled for three times as long.
@partial(jax.jit, static_argnames=("hand", "count", "frames", "rate"))
def streams(key: Array, hand: Hand, count: int, frames: int, rate: float = RATE) -> Streams:
    """Recordings of `count` people, `frames` frames each at `rate` Hz, with markers on the skin and
    not quite where they should be."""
    who, place, move_key, gap_key = jax.random.split(key, 4)
    group = people(who, hand, (count,))
    offsets = placed(place, hand, group)
    move = motion(move_key, frames, rate, (count,), group)
    worn = replace(hand, offsets=offsets[:, None])
    markers, positions = marked(worn, group.skeleton[:, None], *move)
    return Streams(
        markers=markers,
        visible=gaps(gap_key, frames, len(hand), rate, (count,)),
        angles=move.angles,
        positions=positions,
        wrist_rotation=move.wrist_rotation,
        wrist_position=move.wrist_position,
        skeleton=group.skeleton,
        offsets=offsets,
        time=jnp.arange(frames, dtype=jnp.float32) / rate,
    )


def sequences(key: Array, hand: Hand, count: int = 64, seconds: float = 10) -> list[Sequence]:
    """People in motion without gaps, to validate and measure on. Each has bones of their own and
    markers not quite in place: on gloves put on by the millimetre a network looks better than it
    will be. As many as by default are enough to measure what error to expect."""
    return streams(key, hand, count, round(seconds * RATE)).sequences()


def frames(key: Array, hand: Hand, count: int) -> tuple[Array, Array]:
    """Frames that have nothing to do with each other, to train on: markers `[N, M, 3]` metres, hand
    frame, and angles `[N, 26]` radians. Each is of a person of its own, with markers on the skin
    and not quite where they should be, in a posture or on the way from one to another."""
    who, pose_key, time_key, place = jax.random.split(key, 4)
    before, after = poses(pose_key, (2, count))
    angles = before + minimum_jerk(jax.random.uniform(time_key, (count, 1))) * (after - before)
    group = people(who, hand, (count,))
    worn = replace(hand, offsets=placed(place, hand, group))
    return marked(worn, group.skeleton, angles, jnp.eye(3), jnp.zeros(3))[0], angles


def still_markers(hand: Hand, skeleton: Array, angles: Array) -> Array:
    """`[N, M, 3]` metres, hand frame: the hand's markers on the bones `[..., 21, 3]` at `angles
    [N, 26]`."""
    skeleton = jnp.asarray(skeleton, jnp.float32)
    return marked(hand, skeleton, angles, jnp.eye(3), jnp.zeros(3))[0]
