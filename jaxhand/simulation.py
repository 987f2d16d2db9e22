"""Hands, motion and gaps out of a random key: something to train on before there is a recording.

Everything is a canonical left hand in metres, seconds and radians, float32. The same key gives the
same result; every function is pure, and safe under jit and vmap.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxhand.anthropometry import people, placed
from jaxhand.contact import marked
from jaxhand.motion import (
    DIP_SHARE,
    HOME,
    TURN_SPREAD,
    WRIST_MOVE_SECONDS,
    WRIST_SPREAD,
    Motion,
    from_pitch_yaw_roll,
    minimum_jerk,
)
from jaxhand.skeleton import forward_kinematics, marker_positions, rotations_from_angles
from numpy_infer.arrays import Array
from numpy_infer.hand import ANGLES, POINTS, Hand

PERSON_SPREAD, BONE_SPREAD = 0.06, 0.03
"""Standard deviations of the logarithm of a hand's size (Garrett, *The adult human hand*, 1971),
and of a bone's length beside it."""

MOVE_SECONDS = (0.2, 1.5)
"""Shortest and longest move from one posture to the next."""
REST_SHARE, REST_SECONDS = 0.5, 0.5
"""Share of moves that a rest follows, and the mean of these rests."""

GAP_SECONDS, GAP_TAIL = 0.1, 0.6
"""Median length of a gap, and how heavy the tail is: 90 % are shorter than 0.37 s (paper, section
6.1: 0.36 s), one in fifty is longer than a second."""
SEEN_SECONDS = 3.0
"""Mean time from the end of a marker's gap to its next."""
CLEAR_SECONDS = 5.0
"""Mean time from the end of one obstacle, which hides several markers at once, to the next."""


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

_LOW, _HIGH = np.radians([angle.range_deg for angle in ANGLES]).astype(np.float32).T
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
    time: Array
    """`[T]` seconds."""


def bone_lengths(key: Array, hand: Hand, batch: tuple[int, ...] = ()) -> Array:
    """`[..., 21, 3]` metres: skeletons of people, each point from its parent in the flat hand.
    Bones keep their directions and differ in length."""
    normal = jax.random.normal(key, (*batch, 1 + len(POINTS), 1))
    scale = jnp.exp(PERSON_SPREAD * normal[..., :1, :] + BONE_SPREAD * normal[..., 1:, :])
    return jnp.asarray(hand.skeleton, jnp.float32) * scale


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
    return jnp.clip(angles, jnp.asarray(_LOW), jnp.asarray(_HIGH))


def motion(key: Array, frames: int, rate: float, batch: tuple[int, ...] = ()) -> Motion:
    """Moves from posture to posture, with rests, while the wrist wanders and turns by itself.

    Args:
        key: what it is drawn from.
        frames: T, the number of frames.
        rate: frames per second.
        batch: leading shape.
    """
    pose_key, hand_key, place_key, wrist_key, heading_key = jax.random.split(key, 5)
    time = jnp.arange(frames, dtype=jnp.float32) / rate
    stops = poses(pose_key, (*batch, _stops(frames, rate, MOVE_SECONDS)))
    angles = _travel(hand_key, stops, time, MOVE_SECONDS)

    count = _stops(frames, rate, WRIST_MOVE_SECONDS)
    spread = jnp.array((*WRIST_SPREAD, *TURN_SPREAD))
    places = jax.random.normal(place_key, (*batch, count, 6)) * spread
    wrist = _travel(wrist_key, places, time, WRIST_MOVE_SECONDS)
    heading = jax.random.uniform(heading_key, (*batch, 1), minval=-math.pi, maxval=math.pi)
    return Motion(
        angles=angles,
        wrist_rotation=from_pitch_yaw_roll(
            jnp.stack([wrist[..., 3], wrist[..., 4] + heading, wrist[..., 5]], -1)
        ),
        wrist_position=jnp.array(HOME) + wrist[..., :3],
    )


def gaps(key: Array, frames: int, markers: int, rate: float, batch: tuple[int, ...] = ()) -> Array:
    """`[..., T, M]` True where visible. Now and then each marker is lost by itself, and now and
    then an obstacle hides several at random. In the first frame all are seen."""
    draws = jax.random.uniform(key, (*batch, frames, 2 * markers + 2), minval=1e-6)
    own, obstacle, share, hides = jnp.split(draws, (markers, markers + 1, markers + 2), -1)
    lost, _ = _hidden(own, rate, SEEN_SECONDS)
    behind, began = _hidden(obstacle, rate, CLEAR_SECONDS)
    # An obstacle hides the same markers as long as it is there.
    hides = jnp.take_along_axis(hides < share, began, -2)
    return ~(lost | (behind & hides))


def markers(
    hand: Hand, skeleton: Array, angles: Array, wrist_rotation: Array, wrist_position: Array
) -> Array:
    """`[..., M, 3]` metres, world: the hand's markers on the bones `[..., 21, 3]` of somebody else,
    at `angles [..., 26]`, `wrist_rotation [..., 3, 3]` and `wrist_position [..., 3]`."""
    local = rotations_from_angles(angles)
    return marker_positions(
        hand, *forward_kinematics(skeleton, local, wrist_rotation, wrist_position)
    )


def streams(key: Array, hand: Hand, count: int, frames: int, rate: float = 60.0) -> Streams:
    """Recordings of `count` people, `frames` frames each at `rate` Hz."""
    bone_key, motion_key, gap_key = jax.random.split(key, 3)
    skeleton = bone_lengths(bone_key, hand, (count,))
    angles, rotation, position = motion(motion_key, frames, rate, (count,))
    local = rotations_from_angles(angles)
    positions, rotations = forward_kinematics(skeleton[:, None], local, rotation, position)
    return Streams(
        markers=marker_positions(hand, positions, rotations),
        visible=gaps(gap_key, frames, len(hand), rate, (count,)),
        angles=angles,
        positions=positions,
        wrist_rotation=rotation,
        wrist_position=position,
        skeleton=skeleton,
        time=jnp.arange(frames, dtype=jnp.float32) / rate,
    )


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
    eye = jnp.broadcast_to(jnp.eye(3), (len(angles), 3, 3))
    skeleton = jnp.asarray(skeleton, jnp.float32)
    return markers(hand, skeleton, angles, eye, jnp.zeros((len(angles), 3)))


def _stops(frames: int, rate: float, seconds: tuple[float, float]) -> int:
    """Enough stops even if all moves are of the shortest."""
    return math.ceil(frames / rate / seconds[0]) + 2


def _travel(key: Array, stops: Array, time: Array, seconds: tuple[float, float]) -> Array:
    """`[..., T, D]`: from stop to stop `[..., K, D]` in moves of random duration, some with a rest
    after them."""
    draws = jax.random.uniform(key, (2, *stops.shape[:-2], stops.shape[-2] - 1), minval=1e-6)
    shortest, longest = seconds
    length = shortest * (longest / shortest) ** draws[0]
    # What is left of the draw below REST_SHARE is again uniform, so its logarithm exponential.
    rest = REST_SECONDS * jnp.maximum(-jnp.log(draws[1] / REST_SHARE), 0)
    end = jnp.cumsum(length + rest, -1)
    start = jnp.concatenate([jnp.zeros_like(end[..., :1]), end[..., :-1]], -1)
    move = (time[:, None] >= end[..., None, :]).sum(-1)
    since = time - jnp.take_along_axis(start, move, -1)
    share = minimum_jerk(jnp.clip(since / jnp.take_along_axis(length, move, -1), 0, 1))[..., None]
    before = jnp.take_along_axis(stops, move[..., None], -2)
    after = jnp.take_along_axis(stops, move[..., None] + 1, -2)
    return before + share * (after - before)


def _hidden(draws: Array, rate: float, seen: float) -> tuple[Array, Array]:
    """Processes that wait, `seen` seconds on average, for gaps of log-logistic length, out of
    `draws [..., T, P]` in 0 to 1.

    Returns:
        `[..., T, P]` each: True in the gaps; the frame in which the last wait or gap began.
    """
    draws = jnp.moveaxis(draws, -2, 0)
    waits = -rate * seen * jnp.log(draws)
    lengths = rate * GAP_SECONDS * (draws / (1 - draws)) ** GAP_TAIL

    def frame(state: tuple[Array, Array, Array], now: Any) -> tuple[Any, tuple[Array, Array]]:
        number, wait, length = now
        hidden, left, began = state
        change = left < 1
        hidden = hidden ^ change
        drawn = jnp.maximum(jnp.where(hidden, length, wait), 1)
        left = jnp.where(change, drawn, left) - 1
        began = jnp.where(change, number, began)
        return (hidden, left, began), (hidden, began)

    none = jnp.zeros(draws.shape[1:], bool)
    start = (none, jnp.maximum(waits[0], 1), none.astype(int))
    _, (hidden, began) = jax.lax.scan(frame, start, (jnp.arange(len(draws)), waits, lengths))
    return jnp.moveaxis(hidden, 0, -2), jnp.moveaxis(began, 0, -2)
