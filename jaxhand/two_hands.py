"""Two hands of one person in one world: apart, at work on one object, clasped, interlaced.

The right hand's angles are those of the canonical left hand. Its wrist's pose in the world is that
of a hand that is the mirror image in x of the canonical one, as `tracker` has it. In the common
frame of a scene, x goes to the right, y up, −z away from the person. A scene is five stops: the
hands are apart, come near with their fingers open, meet, shift, and part; what meets is settled so
that flesh of the one does not lie in flesh of the other.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxhand import contact, motion
from jaxhand.anthropometry import People, mean_person
from jaxhand.compiled import apart
from jaxhand.geometry import mirror, mirror_rotation, product
from jaxhand.motion import KEYFRAMES, Motion
from numpy_infer.arrays import Array
from numpy_infer.hand import FINGER_OF_ANGLE, HIGH, LOW, Hand, load_hand

MOVE_SECONDS = (0.4, 1.6)
"""Shortest and longest move from stop to stop."""
PLACE_SPREAD, TURN_SPREAD = 0.007, 0.12
"""Metres and radians: standard deviation of each hand's pose where the two meet."""
APART, APART_SPREAD = (-0.2, 0.0, 0.05), (0.07, 0.1, 0.08)
"""Metres: where the left wrist is, and by how much it varies, while the hands are apart."""
APART_TURN = (0.5, 0.4, 0.8)
"""Radians: standard deviation of its pitch, yaw and roll."""
SHIFT = 0.06
"""Of the way to another meeting of the same kind that they shift while they meet."""
OPEN = 0.7
"""Of the way to `motion.RELEASE` that fingers open before hands meet and part."""
EASE = 0.008
"""Metres: how willingly two hands move away from each other, against `contact.EASE`."""
STOPS = 5
"""Of a scene."""


class Pose(NamedTuple):
    """Of a hand where two meet, in the common frame; of the right hand its mirror image."""

    place: tuple[float, float, float]
    """Millimetres: the wrist."""
    turn: tuple[float, float, float]
    """Degrees: pitch, yaw and roll; 0 has the palm down and the fingers away from the person."""
    away: tuple[float, float, float]
    """Millimetres that the hand comes from and goes to."""
    keyframes: tuple[str, ...]
    """What it does then."""


class Scene(NamedTuple):
    """What two hands do together."""

    name: str
    share: float
    left: Pose
    right: Pose
    width: float = 0.0
    """Millimetres: the largest thing between them."""


_HOLDING = ("sphere", "thick cylinder", "plate", "disk")
_SIDE = Pose((-14, 0, 60), (20, 0, 90), (-110, 0, 0), ("closed flat",))
_FREE = Pose((-200, 0, 50), (0, 0, 30), (-30, 0, 0), ("free", "rest"))
_HOLD = Pose((-30, 0, 60), (10, 0, 80), (-90, 0, 20), _HOLDING)
SCENES = (
    Scene("apart", 3, _FREE, _FREE),
    Scene("object", 4, _HOLD, _HOLD, 240),
    Scene("palms together", 1, _SIDE, _SIDE),
    Scene(
        "clasp",
        1.5,
        Pose((-50, -20, 40), (0, -45, 165), (-90, -60, 30), ("thick cylinder",)),
        Pose((-50, 20, 40), (0, -45, 15), (-90, 60, 30), ("thick cylinder",)),
    ),
    Scene(
        "interlaced",
        1.5,
        Pose((-72, 0, 72), (0, -42, 90), (-80, 0, 88), ("spread",)),
        Pose((-72, 11, 72), (0, -42, 90), (-80, 0, 88), ("spread",)),
    ),
    Scene(
        "one over the other",
        1.5,
        Pose((-30, -14, 60), (0, -25, 0), (-100, -60, 20), ("rest", "flat")),
        Pose((-30, 14, 40), (0, -25, 0), (-100, 60, 20), ("rest", "plate")),
    ),
    Scene(
        "one works on what the other holds",
        2,
        Pose((-70, -20, 60), (10, -25, 120), (-80, -40, 30), ("cylinder", "sphere", "tripod")),
        Pose((-100, 30, 60), (-10, -40, 30), (-70, 40, 30), ("precision", "pinch index", "point")),
    ),
)

_NAMES = [frame.name for frame in KEYFRAMES]
_SHARES = np.array([scene.share for scene in SCENES])
_LIMITS = np.cumsum(_SHARES)[:-1] / _SHARES.sum()
_PLACES, _TURNS, _AWAYS = (
    np.array([[getattr(pose, field) for pose in (s.left, s.right)] for s in SCENES], np.float32)
    for field in ("place", "turn", "away")
)
_WIDTHS = np.array([scene.width for scene in SCENES], np.float32) / 1e3
_KINDS = np.array(
    [
        [
            [_NAMES.index(pose.keyframes[i % len(pose.keyframes)]) for i in range(12)]
            for pose in (scene.left, scene.right)
        ]
        for scene in SCENES
    ]
)
"""`[scene, hand, 12]` indices into `KEYFRAMES`, to draw from."""


def two_hands(
    key: Array,
    frames: int,
    rate: float,
    batch: tuple[int, ...] = (),
    people: People | None = None,
) -> tuple[Motion, Motion]:
    """Left and right hand over time, in one world.

    Args:
        key: what it is drawn from.
        frames: T, the number of frames.
        rate: frames per second.
        batch: leading shape.
        people: `[...]` whose two hands they are, of shape `batch`; by default the mean person's.
    """
    people = mean_person(load_hand("glove9")) if people is None else people
    time = jnp.arange(frames, dtype=jnp.float32) / rate
    count = motion.enough(frames / rate, MOVE_SECONDS)
    number = math.ceil(count / STOPS)
    sizes = (number * SCENE_DRAWS, 7 * (STOPS * number - 1), motion.wander_draws(frames / rate), 88)
    draws = motion.uniform(key, (*batch, sum(sizes)))
    draws, timing, wandering, shakes = jnp.split(draws, np.cumsum(sizes[:-1]), -1)
    stops, _ = scenes(draws.reshape(*batch, number, SCENE_DRAWS), people)
    rows = stops.reshape(*batch, -1, 2 * stops.shape[-1])
    plan = motion.schedule(timing, time, MOVE_SECONDS)
    columns = np.tile([*FINGER_OF_ANGLE, *[2] * 6], 2)
    hands = apart(motion.between(rows, plan.move, plan.share[..., columns]))
    hands = hands.reshape(*batch, frames, 2, -1)
    place, turn = motion.wander(wandering, time)
    # Tremor is each hand's own; the arms, which brace each other, sway together.
    shake, drift, sway = motion.shaking(shakes.reshape(*batch, 2, 44), time)
    common = apart(motion.from_pitch_yaw_roll(turn + sway[..., 0, :, :]))
    angles = jnp.clip(
        hands[..., :26] + jnp.moveaxis(shake, -3, -2),
        jnp.float32(LOW),
        jnp.float32(HIGH),
    )
    own, at = apart(motion.from_pitch_yaw_roll(hands[..., 29:])), hands[..., 26:29]
    home = jnp.array(motion.HOME) + place + drift[..., 0, :, :]
    both = []
    for side in range(2):
        rotation, position = own[..., side, :, :], at[..., side, :]
        if side:
            rotation, position = mirror_rotation(rotation), mirror(position)
        position = home + product(common, position[..., None])[..., 0]
        both.append(Motion(angles[..., side, :], product(common, rotation), position))
    return both[0], both[1]


SCENE_DRAWS = 4 + 2 * STOPS * (1 + motion.DRAWS + 6)
"""Numbers that a scene is made of."""


def scenes(draws: Array, people: People) -> tuple[Array, Array]:
    """The stops of scenes, one after the other.

    Args:
        draws: `[..., S, SCENE_DRAWS]` uniform in 0 to 1.
        people: `[...]` whose hands they are.

    Returns:
        `[..., S, 5, 2, 32]`: for each stop and hand its 26 angles, radians, its wrist's place,
        metres, and its pitch, yaw and roll, radians; the right hand's mirrored;
        `[..., S]` indices into `SCENES`.
    """
    *batch, count, _ = draws.shape
    draws, normal = jnp.split(draws, (4 + 2 * STOPS,), -1)
    normal = motion.normal(normal).reshape(*batch, count, STOPS, 2, -1)
    scene = (draws[..., :1] > jnp.asarray(_LIMITS, jnp.float32)).sum(-1)

    # Postures: one keyframe for the two stops where hands meet, any where they are apart.
    free = motion.draw_kinds(draws[..., 4:]).reshape(*batch, count, STOPS, 2)
    chosen = (draws[..., 1:3] * _KINDS.shape[-1]).astype(int)
    met = jnp.asarray(_KINDS)[scene[..., None], jnp.arange(2), chosen]
    first = (jnp.arange(STOPS) == 0)[:, None]
    kind = jnp.where(first, free, met[..., None, :])
    varied = normal[..., : motion.DRAWS]
    # A person's own flat hand is one.
    flat = jnp.broadcast_to(
        varied[..., :1, :1, :1, motion.FLAT :], varied[..., motion.FLAT :].shape
    )
    varied = jnp.concatenate([varied[..., : motion.FLAT], flat], -1)
    owners = People(
        people.skeleton[..., None, None, None, :, :], people.radii[..., None, None, None, :]
    )
    angles = motion.varied(kind, varied, owners)

    off = normal[..., motion.DRAWS :]
    width = jnp.asarray(_WIDTHS)[scene] * draws[..., 3]
    aside = jnp.stack([-width / 2, jnp.zeros_like(width), jnp.zeros_like(width)], -1)
    place = jnp.asarray(_PLACES)[scene] / 1e3 + aside[..., None, :]
    turn = jnp.radians(jnp.asarray(_TURNS)[scene])
    place = place[..., None, :, :] + PLACE_SPREAD * off[..., :3]
    turn = turn[..., None, :, :] + TURN_SPREAD * off[..., 3:]
    rows = jnp.concatenate([angles, place, turn], -1)
    meet = parted(
        rows[..., 2, :, :],
        owners._replace(
            skeleton=owners.skeleton[..., 0, :, :, :], radii=owners.radii[..., 0, :, :]
        ),
    )[..., None, :, :]
    # What touches moves little while it does.
    little = SHIFT * (rows[..., 3:4, :, :] - rows[..., 2:3, :, :])
    meet = jnp.concatenate([meet, meet + little], -3)

    near = meet.at[..., 26:29].add(jnp.asarray(_AWAYS)[scene][..., None, :, :] / 1e3)
    opened = meet[..., :26] + OPEN * (jnp.asarray(motion.RELEASE) - meet[..., :26])
    near = near.at[..., :26].set(opened)
    away = jnp.array(APART) + jnp.array(APART_SPREAD) * off[..., :1, :, :3]
    away_turn = jnp.array(APART_TURN) * off[..., :1, :, 3:]
    away = jnp.concatenate([angles[..., :1, :, :], away, away_turn], -1)
    stops = [away, near[..., :1, :, :], meet, near[..., 1:, :, :]]
    return jnp.concatenate(stops, -3), scene


def parted(hands: Array, people: People, steps: int = 16) -> Array:
    """Bends the fingers of two hands, and moves the two away from each other, until neither's flesh
    lies in the other's or its own; steps as in `contact.settled`.

    Args:
        hands: `[..., 2, 32]` as in `scenes`.
        people: `[...]` whose hands they are, with an axis of 1 for the two.
        steps: how many.
    """
    batch = hands.shape[:-2]
    skeleton = jnp.broadcast_to(people.skeleton, (*batch, 1, 21, 3))[..., 0, :, :]
    radii = jnp.broadcast_to(people.radii, (*batch, 1, 21))[..., 0, :]

    def chunk(skeleton: Array, radii: Array, wrists: Array, hands: Array) -> Array:
        # Both hands side by side, before the batch.
        hands, wrists = jnp.moveaxis(hands, 0, -2), jnp.moveaxis(wrists, 0, -2)
        skeleton, radii = skeleton[..., None, :], radii[..., None, :]
        places, halves = (
            hands[26:29],
            jnp.array([[[-0.5], [-0.5]], [[-0.5], [0.5]], [[-0.5], [0.5]]]),
        )

        def step(_: int, state: tuple[Array, Array]) -> tuple[Array, Array]:
            angles, shift = state
            points, turns = contact.kinematics(
                skeleton, angles, wrists, places + shift[:, None] * halves
            )
            axes, _ = contact.turning(turns, angles)
            left, right, thick = points[..., 0, :], _flip(points[..., 1, :]), radii[..., 0, :]
            push, back, square, _ = contact.repulsion(left, thick, right, thick, contact.PRESS)
            own, other, _ = contact.own_repulsion(points, radii, contact.PRESS)
            away = EASE * (back.sum(1) - push.sum(1)) / 2
            down = contact.generalised(points, axes, own + jnp.stack([push, _flip(back)], -2))
            long = (down * down).sum((0, 1)) + (away * away).sum(0)
            length = (square + other.sum(0)) / jnp.maximum(long, 1e-12)
            return contact.bent(angles, down * length), shift + EASE * away * length

        start = (hands[:26], jnp.zeros_like(places[:, 0]))
        angles, shift = jax.lax.fori_loop(0, steps, step, start)
        moved = jnp.concatenate([angles, places + shift[:, None] * halves, hands[29:]])
        return jnp.moveaxis(moved, -2, 0).reshape(2 * len(moved), -1)

    wrists = motion.from_pitch_yaw_roll(hands[..., 29:])
    settled = contact.in_chunks(chunk, (skeleton, radii, wrists, hands), batch)
    return settled.reshape(hands.shape)


def _flip(points: Array) -> Array:
    """`mirror`, of `[3, ...]`."""
    return points * jnp.array([-1, 1, 1], points.dtype).reshape(3, *[1] * (points.ndim - 1))


def posed(skeleton: Array, move: Motion, right: bool = False) -> tuple[Array, Array]:
    """Positions `[..., T, 21, 3]` metres and rotations `[..., T, 16, 3, 3]` of one of two hands in
    the world, on bones `[..., 21, 3]`, as `HandPose` has them."""
    wrist = _own(move, right)
    positions, rotations = contact.posed(skeleton[..., None, :, :], move.angles, *wrist)
    return (mirror(positions), mirror_rotation(rotations)) if right else (positions, rotations)


def marked(hand: Hand, skeleton: Array, move: Motion, right: bool = False) -> tuple[Array, Array]:
    """Markers `[..., T, M, 3]` and positions `[..., T, 21, 3]`, metres, of one of two hands in the
    world, on bones `[..., 21, 3]`. The hand's offsets may be `anthropometry.placed` ones,
    `[..., M, 3]`."""
    offsets = jnp.expand_dims(jnp.asarray(hand.offsets, jnp.float32), -3)
    worn = replace(hand, offsets=offsets)
    points = contact.marked(worn, skeleton[..., None, :, :], move.angles, *_own(move, right))
    return (mirror(points[0]), mirror(points[1])) if right else points


def _own(move: Motion, right: bool) -> tuple[Array, Array]:
    """The wrist's pose, of a right hand the one whose mirror image it is."""
    rotation, position = move.wrist_rotation, move.wrist_position
    return (mirror_rotation(rotation), mirror(position)) if right else (rotation, position)


def penetration(left: Array, right: Array, people: People) -> Array:
    """`[..., T]` metres: how deep the deepest flesh of one hand lies in that of the other, at
    positions `[..., T, 21, 3]`."""
    radii = people.radii[..., None, :]
    arrays = [contact.last(positions, 2, left.ndim - 2) for positions in (left, right)]
    one, other = (jnp.moveaxis(array, 0, 1) for array in arrays)
    radii = contact.last(jnp.broadcast_to(radii, left.shape[:-1]), 1, left.ndim - 2)
    return contact.repulsion(one, radii, other, radii, 0)[3]
