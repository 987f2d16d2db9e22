"""Postures that hands take, and how they get from one to the next. All of a canonical left hand.

A posture is one of `KEYFRAMES`, varied: fingers bend together along two synergies (Santello,
Flanders and Soechting, J. Neurosci. 18, 1998, find two of them behind more than 80 % of the
variance of grasps), neighbours are enslaved to each other (Zatsiorsky, Li and Latash, Exp. Brain
Res. 131, 2000; Häger-Ross and Schieber, J. Neurosci. 20, 2000), a DIP joint follows its PIP joint,
a flexed finger can hardly be spread. Pads that touch do so on the person's own bones, and what
would reach into other flesh is drawn back towards its keyframe.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxhand.anthropometry import People, mean_person
from jaxhand.compiled import apart
from jaxhand.contact import depth, first_clear, settled
from numpy_infer.arrays import Array
from numpy_infer.hand import (
    ANGLES,
    ANGLES_OF_FINGER,
    FINGER_OF_ANGLE,
    FINGERS,
    HIGH,
    LOW,
    load_hand,
)

DIP_SHARE, DIP_SPREAD = 2 / 3, 0.25
"""Of a PIP joint's flexion that its DIP joint takes on, one tendon bends both, and how much that
varies: objects press finger tips back."""

MOVE_SECONDS = (0.25, 2.5)
"""Shortest and longest move from one posture to the next."""
REST_SHARE, REST_SECONDS = 0.5, 0.6
"""Share of moves that a rest follows, and the mean of these rests."""
SAME_SHARE = 0.5
"""Of moves that go to another variation of the same keyframe: what is held is held differently."""
LAG = 0.2
"""Of a move's time that a finger may start later than the first."""

WRIST_MOVE_SECONDS = (0.8, 2.5)
"""Shortest and longest move of the wrist."""
HOME = (0.0, 1.0, 0.0)
"""Metres, world: where the wrist is about."""
WRIST_SPREAD = (0.15, 0.12, 0.15)
"""Metres: standard deviation of the places it goes to."""
TURN_SPREAD = (0.5, 0.4, 0.8)
"""Radians: standard deviation of its pitch, yaw and roll, beside the heading of the stream."""

TREMOR_HERTZ, TREMOR = (8.0, 12.0), 1.2e-3
"""An outstretched finger's tremor has its peak about 9 Hz (Marsden et al., EEG Clin. Neurophysiol.
27, 1969). Radians at a knuckle, so somewhat over 0.1 mm at the tip, chosen by eye: about as much as
with the arm held out, 4 to 5 times the 0.03 mm of a hand at rest (Growdon et al., Electromyogr.
Clin. Neurophysiol. 40, 2000)."""
SWAY_HERTZ, SWAY = (0.2, 1.0), 1.5e-2
"""What a hand drifts about while it holds a posture, radians."""


class Keyframe(NamedTuple):
    """A posture by name, degrees. Fingers are index to pinky."""

    name: str
    share: float
    """Of all postures, as parts of the sum."""
    mcp: tuple[float, float, float, float]
    pip: tuple[float, float, float, float]
    """Flexion of each finger."""
    fan: tuple[float, float, float, float]
    """Abduction of each."""
    thumb: tuple[float, float, float, float, float, float]
    """In the order of `hand.ANGLES`."""
    spread: float
    """Standard deviation of flexions."""
    touch: tuple[str, ...] = ()
    """Fingers that the thumb's pad meets."""
    object: float = 0.0
    """Millimetres: the largest thing that is held between them."""


_CLOSE, _EASY, _WIDE = (0, 0, 0, 0), (4, 1, -2, -5), (14, 3, -7, -16)
_SPLIT = (12, -4, -6, -4)
_TO_INDEX, _TO_MIDDLE = (41, 18, -37, -2, 1, -18), (42, 17, -46, 4, 3, -14)
_TO_RING, _TO_PINKY = (46, 16, -47, 12, 5, -12), (50, 11, -48, 21, 6, 2)
_REST, _ROUND, _OPPOSED = (
    (15, 5, -10, 10, -5, 15),
    (25, 15, -15, 15, -5, 20),
    (34, 20, -34, 8, 0, 4),
)
_IN, _OUT = (36, 20, -16, 37, -3, 45), (-14, 0, 0, -6, 0, -14)

_ROWS = (
    ("free", 24, (28, 30, 30, 28), (38, 40, 40, 40), _EASY, _REST, 30),
    ("rest", 4, (18, 22, 25, 28), (28, 33, 34, 34), _EASY, _REST, 9),
    ("flat", 3, _CLOSE, (2, 2, 2, 2), _EASY, (0, 0, 0, 0, 0, 0), 5),
    ("closed flat", 0.5, (2, 0, 0, 2), (3, 3, 3, 3), _CLOSE, (22, -8, 0, 4, 0, 0), 4),
    ("spread", 1, (-6, -4, -4, -6), (4, 4, 4, 6), _WIDE, (-22, 10, 0, -4, 4, -8), 5),
    ("fist", 3, (66, 82, 82, 82), (102, 101, 100, 96), _CLOSE, (41, 25, -22, 45, -9, 48), 7),
    ("thumb up", 0.5, (74, 78, 80, 80), (98, 100, 98, 94), _CLOSE, _OUT, 7),
    ("point", 1, (4, 71, 76, 78), (6, 95, 96, 92), _CLOSE, _IN, 7),
    ("gun", 0.5, (2, 72, 76, 78), (4, 94, 96, 92), _CLOSE, _OUT, 7),
    ("two", 0.5, (2, 0, 68, 70), (4, 4, 94, 90), (8, -5, 0, 0), _IN, 6),
    ("three", 0.5, (2, 0, 2, 56), (4, 3, 6, 86), (9, 1, -8, 0), (46, 16, -19, 40, -6, 44), 6),
    ("three with thumb", 0.5, (2, 0, 62, 66), (4, 6, 88, 86), (8, -4, 0, 0), _OUT, 6),
    ("four", 0.5, (0, 0, 0, 2), (3, 3, 3, 5), _EASY, (46, 2, -16, 48, -8, 30), 5),
    ("little finger", 1, (61, 68, 66, 12), (97, 93, 92, 8), _CLOSE, (39, 25, -16, 39, -2, 46), 6),
    ("horns", 0.5, (4, 72, 70, 4), (6, 96, 94, 8), _CLOSE, _IN, 6),
    ("call", 0.5, (66, 72, 68, 8), (90, 94, 90, 8), _CLOSE, _OUT, 6),
    ("crossed", 0.5, (26, 6, 66, 68), (14, 12, 92, 88), (-8, 12, 0, 0), _IN, 3),
    ("pinch index", 4, (58, 28, 22, 18), (44, 32, 28, 26), _EASY, _TO_INDEX, 7, FINGERS[1:2]),
    ("pinch middle", 2, (20, 61, 30, 26), (24, 34, 34, 28), _EASY, _TO_MIDDLE, 6, FINGERS[2:3]),
    ("pinch ring", 1, (16, 28, 56, 38), (22, 34, 30, 34), _EASY, _TO_RING, 6, FINGERS[3:4]),
    ("pinch pinky", 1, (12, 20, 36, 49), (18, 26, 38, 17), _EASY, _TO_PINKY, 6, FINGERS[4:5]),
    ("tripod", 4, (48, 50, 40, 38), (40, 40, 44, 44), _SPLIT, _OPPOSED, 7, FINGERS[1:3], 25),
    ("precision", 5, (40, 44, 42, 38), (34, 36, 36, 36), _EASY, _OPPOSED, 9, FINGERS[1:4], 60),
    ("cylinder", 5, (42, 46, 50, 52), (46, 50, 52, 52), _CLOSE, _ROUND, 11),
    ("thick cylinder", 4, (22, 24, 26, 26), (32, 34, 36, 36), _EASY, (15, 20, -15, 10, -5, 10), 9),
    ("thin cylinder", 2, (63, 74, 72, 74), (67, 88, 84, 80), _SPLIT, (39, 13, -15, 28, -4, 36), 8),
    ("sphere", 3, (22, 22, 24, 26), (36, 38, 38, 38), _WIDE, (15, 25, -20, 10, 0, 15), 9),
    ("disk", 2, (10, 8, 10, 12), (40, 40, 40, 42), _WIDE, (8, 16, -12, 8, 4, 24), 8),
    ("hook", 2, (12, 12, 14, 16), (78, 82, 82, 78), _CLOSE, _REST, 9),
    ("lateral", 3, (48, 58, 58, 60), (59, 65, 64, 60), (8, -6, -2, 0), (38, 3, 2, 17, -3, 17), 8),
    ("plate", 2, (34, 36, 38, 38), (10, 12, 12, 14), _EASY, (14, 20, -14, 8, 0, 10), 8),
    ("spoon", 2, (49, 61, 64, 68), (43, 68, 78, 80), (4, -3, 0, 0), (34, 14, -13, 23, -3, 29), 8),
)
KEYFRAMES = tuple(Keyframe(*row) for row in _ROWS)
"""Gestures and the usual grasps: some of the 33 types of Feix et al. (The GRASP taxonomy of human
grasp types, 2016), more coarsely named. Their angles and shares are our choice, by eye."""

TOGETHER, OPPOSITE, ALONG, ALONE = 0.75, 0.4, 0.3, 0.3
"""How a keyframe's flexions vary, as parts of its `spread`: all joints of all fingers together; MCP
against PIP joints, Santello's first and second synergy; from index to pinky; each for itself."""
ENSLAVED = (0.16, 0.05, 0.03), (0.22, 0.1), (0.35,)
"""Of one finger's flexion that others take on, index with middle, ring and pinky, middle with ring
and pinky, ring with pinky: our choice, by eye. Neighbours share more (Zatsiorsky et al.), and the
index finger less than middle and ring (Häger-Ross and Schieber, who say the same of the little
finger; here it shares more)."""

_SHARES = np.array([frame.share for frame in KEYFRAMES])
_LIMITS = np.cumsum(_SHARES)[:-1] / _SHARES.sum()
_TABLE = {
    field: np.radians([getattr(frame, field) for frame in KEYFRAMES]).astype(np.float32)
    for field in ("mcp", "pip", "fan", "thumb", "spread")
}
_TOUCH = np.array([[f in frame.touch for f in FINGERS] for frame in KEYFRAMES], np.float32)
_OBJECT = np.array([frame.object for frame in KEYFRAMES], np.float32) / 1e3
_MIXING = np.eye(4, dtype=np.float32)
for _i, _row in enumerate(ENSLAVED):
    _MIXING[_i, _i + 1 :] = _MIXING[_i + 1 :, _i] = _row
_MIXING /= np.linalg.norm(_MIXING, axis=1, keepdims=True)
"""`[4, 4]` makes independent commands the flexions of four fingers, of variance 1."""

FLAT_SPREAD = np.radians([6 if "twist" in a.name else 4 for a in ANGLES]).astype(np.float32)
"""`[26]` radians: how far from 0 one person's flat hand is from another's, who defines what is flat
included: no finger is as straight as a model's, and the metacarpals' arch twists the outer ones."""
RELEASE = np.radians(
    [2, 16, 0, 0, 0, 4] + [x for fan in (4, 1, -2, -5) for x in (16, fan, 0, 18, 12)]
).astype(np.float32)
"""`[26]` radians: open and clear of everything. A move that would lead through flesh goes by it."""


class Motion(NamedTuple):
    """A hand over time, without its bones."""

    angles: Array
    """`[..., T, 26]` radians."""
    wrist_rotation: Array
    """`[..., T, 3, 3]` world_from_wrist."""
    wrist_position: Array
    """`[..., T, 3]` metres, world."""


class Schedule(NamedTuple):
    """When a hand moves: from stop `move` to the next."""

    move: Array
    """`[..., T]` index of the stop that it comes from."""
    share: Array
    """`[..., T, 5]` of the way that each finger has gone, 0 to 1."""


def postures(key: Array, batch: tuple[int, ...] = (), people: People | None = None) -> Array:
    """`[..., 26]` radians: varied `KEYFRAMES`, within the angles' ranges.

    Args:
        key: what they are drawn from.
        batch: leading shape.
        people: `[...]` who takes them, broadcast to `batch`; by default the mean person.
    """
    kind_key, key = jax.random.split(key)
    kind = draw_kinds(jax.random.uniform(kind_key, batch))
    return varied(kind, jax.random.normal(key, (*batch, DRAWS)), people)


def draw_kinds(uniform: Array) -> Array:
    """Numbers in 0 to 1 → indices into `KEYFRAMES`, by their shares."""
    return (uniform[..., None] > jnp.asarray(_LIMITS, jnp.float32)).sum(-1)


FLAT = 33
DRAWS = FLAT + len(ANGLES)
"""Standard normal numbers that one posture is made of; from `FLAT` on they belong to the hand."""


def varied(kind: Array, normal: Array, people: People | None = None) -> Array:
    """`[..., 26]` radians: the keyframes `kind [...]`, varied by `normal [..., DRAWS]`, with their
    pads in touch and free of flesh in flesh, on `people [...]`."""
    people = mean_person(load_hand("glove9")) if people is None else people
    touching = jnp.asarray(_TOUCH)[kind]
    # A part of them holds next to nothing.
    held = jnp.asarray(_OBJECT)[kind] * jnp.clip(0.5 + 0.4 * normal[..., 32], 0, 1)
    return settled(people, angles_of(kind, normal), touching, held)


def angles_of(kind: Array, normal: Array) -> Array:
    """`[..., 26]` radians: what `varied` starts from."""
    synergy, thumb, own, flat = jnp.split(normal, (6, 12, 32), -1)
    first, second, along, wide, whole, follow = (synergy[..., i, None] for i in range(6))
    ramp = along * jnp.linspace(-1, 1, 4)
    own = jnp.moveaxis(own.reshape(*own.shape[:-1], 5, 4), -2, 0)
    of = {field: jnp.asarray(table)[kind] for field, table in _TABLE.items()}
    spread = of["spread"][..., None]
    mixing = jnp.asarray(_MIXING)

    def flexion(field: str, sign: float, commands: Array) -> Array:
        alone = (mixing * commands[..., None, :]).sum(-1)
        return of[field] + spread * (
            TOGETHER * first + sign * OPPOSITE * second + ALONG * ramp + ALONE * alone
        )

    mcp, pip = flexion("mcp", 1, own[0]), flexion("pip", -1, own[1])
    share = DIP_SHARE + DIP_SPREAD * (0.7 * follow + 0.7 * own[2])
    dip = share * pip + math.radians(5) * own[4]
    # Collateral ligaments are taut in a flexed MCP joint.
    slack = 1 - 0.8 * jnp.clip(mcp / math.radians(80), 0, 1)
    fan = of["fan"] * (1 + 0.4 * wide) + math.radians(4) * whole + math.radians(3) * own[3]
    fingers = jnp.stack([mcp, slack * fan, jnp.zeros_like(mcp), pip, dip], -1)
    easy = jnp.minimum(spread, math.radians(12)) * jnp.array([1, 1, 0.5, 1, 0.4, 1.2])
    thumb = of["thumb"] + easy * thumb
    angles = jnp.concatenate([thumb, fingers.reshape(*mcp.shape[:-1], -1)], -1)
    angles = angles + jnp.asarray(FLAT_SPREAD) * flat[..., 1:]
    return jnp.clip(angles, jnp.float32(LOW), jnp.float32(HIGH))


def motion(
    key: Array,
    frames: int,
    rate: float,
    batch: tuple[int, ...] = (),
    people: People | None = None,
    postures: Array | None = None,
) -> Motion:
    """Moves from posture to posture, with rests and tremor, while the wrist wanders and turns.

    Args:
        key: what it is drawn from.
        frames: T, the number of frames.
        rate: frames per second.
        batch: leading shape.
        people: `[...]` who moves, of shape `batch`; by default the mean person.
        postures: `[..., K, 26]` radians, two or more: what they move between, one after another; by
            default `stops`. After the last of them, for which `enough` has a number, they rest.
    """
    people = mean_person(load_hand("glove9")) if people is None else people
    people = jax.tree.map(lambda array, own: jnp.expand_dims(array, -own - 1), people, People(2, 1))
    time = jnp.arange(frames, dtype=jnp.float32) / rate
    count = enough(frames / rate, MOVE_SECONDS) if postures is None else postures.shape[-2]
    sizes = (count * STOP_DRAWS, 7 * (count - 1), wander_draws(frames / rate), 44)
    draws = uniform(key, (*batch, sum(sizes)))
    stopping, timing, wandering, shakes = jnp.split(draws, np.cumsum(sizes[:-1]), -1)
    plan = schedule(timing, time, MOVE_SECONDS)
    if postures is None:
        postures = stops(stopping.reshape(*batch, count, STOP_DRAWS), people)
    angles = bend(postures, plan, people)
    place, turn = wander(wandering, time)
    shake, drift, sway = shaking(shakes, time)
    return Motion(
        angles=jnp.clip(angles + shake, jnp.float32(LOW), jnp.float32(HIGH)),
        wrist_rotation=from_pitch_yaw_roll(turn + sway),
        wrist_position=jnp.array(HOME) + place + drift,
    )


def uniform(key: Array, shape: tuple[int, ...]) -> Array:
    """Numbers in 0 to 1, without the ends. All that a stream is made of comes out of one call: XLA
    takes half a second to compile each."""
    return jax.random.uniform(key, shape, minval=1e-6, maxval=1 - 1e-6)


def normal(uniform: Array) -> Array:
    """Numbers in 0 to 1 → standard normal ones."""
    return math.sqrt(2) * jax.scipy.special.erfinv(2 * uniform - 1)


STOP_DRAWS = 2 + 2 * DRAWS
"""Numbers that a stop is made of."""


def stops(draws: Array, people: People) -> Array:
    """`[..., K, 26]` radians: postures one after the other, out of `[..., K, STOP_DRAWS]` in 0 to
    1. `SAME_SHARE` of them are another variation of the one before, and near to it."""
    number = jnp.arange(draws.shape[-2])
    first = jnp.where(draws[..., 0] > SAME_SHARE, number, 0)
    first = jax.lax.cummax(first, first.ndim - 1)
    kind = jnp.take_along_axis(draw_kinds(draws[..., 1]), first, -1)
    kept, own = jnp.split(normal(draws[..., 2:]), 2, -1)
    varied_by = 0.8 * jnp.take_along_axis(kept, first[..., None], -2) + 0.6 * own
    # A hand's own flat posture stays the same.
    flat = jnp.broadcast_to(kept[..., :1, FLAT:], kept[..., FLAT:].shape)
    return varied(kind, jnp.concatenate([varied_by[..., :FLAT], flat], -1), people)


def enough(seconds: float, moves: tuple[float, float]) -> int:
    """Stops for so long: four standard deviations more than the moves on average ask for. Should
    they not do, the hand rests."""
    shortest, longest = moves
    mean = (longest - shortest) / math.log(longest / shortest) + REST_SHARE * REST_SECONDS
    number = seconds / mean
    return math.ceil(number + 4 * math.sqrt(number) + 2)


def schedule(draws: Array, time: Array, seconds: tuple[float, float]) -> Schedule:
    """Moves at the times `[T]`, of the shortest and the longest duration given, out of 7 numbers in
    0 to 1 each, `[..., 7 K]`; some are followed by a rest."""
    draws = jnp.moveaxis(draws.reshape(*draws.shape[:-1], 7, -1), -2, 0)
    shortest, longest = seconds
    length = shortest * (longest / shortest) ** draws[0]
    # What is left of the draw below REST_SHARE is again uniform, so its logarithm exponential.
    rest = REST_SECONDS * jnp.maximum(-jnp.log(draws[1] / REST_SHARE), 0)
    end = jnp.cumsum(length + rest, -1)
    start = jnp.concatenate([jnp.zeros_like(end[..., :1]), end[..., :-1]], -1)
    move = jnp.minimum((time[:, None] >= end[..., None, :]).sum(-1), end.shape[-1] - 1)
    of_move = jnp.stack([start, length, *(LAG * draws[2:])], -1)
    of_move = jnp.take_along_axis(of_move, move[..., None], -2)
    part = (time - of_move[..., 0]) / of_move[..., 1]
    part = (part[..., None] - of_move[..., 2:]) / (1 - LAG)
    return apart(Schedule(move, minimum_jerk(jnp.clip(part, 0, 1))))


def minimum_jerk(part: Array) -> Array:
    """Share of the way that is done after `part` of a move's time, 0 to 1 (Flash & Hogan 1985)."""
    return part**3 * (10 - 15 * part + 6 * part**2)


def between(stops: Array, move: Array, share: Array) -> Array:
    """`[..., T, D]`: the `share [..., T, D]` of the way from stop `move [..., T]` of `[..., K, D]`
    to the next."""
    before = jnp.take_along_axis(stops, move[..., None], -2)
    after = jnp.take_along_axis(stops, move[..., None] + 1, -2)
    return before + share * (after - before)


def bend(stops: Array, plan: Schedule, people: People) -> Array:
    """`[..., T, 26]` radians: from posture to posture `[..., K, 26]`. A move that would lead
    through flesh halfway goes by `RELEASE`, as far as is needed."""
    middle = (stops[..., 1:, :] + stops[..., :-1, :]) / 2
    part = jnp.array([0, 0.5, 1])[:, *[None] * middle.ndim]
    candidates = middle + part * (jnp.asarray(RELEASE) - middle)
    detour = first_clear(candidates, depth(people, candidates)) - middle
    share = plan.share[..., FINGER_OF_ANGLE]
    detour = jnp.take_along_axis(detour, plan.move[..., None], -2)
    return between(stops, plan.move, share) + (4 * share * (1 - share)) ** 2 * detour


def wander_draws(seconds: float) -> int:
    """Numbers that `wander` is made of for so long."""
    return 13 * enough(seconds, WRIST_MOVE_SECONDS) - 6


def wander(draws: Array, time: Array) -> tuple[Array, Array]:
    """`[..., T, 3]` each: metres about `HOME`, and pitch, yaw and roll of a wrist, radians, about a
    heading of its own; out of `wander_draws` numbers in 0 to 1."""
    count = (draws.shape[-1] + 6) // 13
    heading, places, timing = jnp.split(draws, (1, 1 + 6 * count), -1)
    spread = jnp.array((*WRIST_SPREAD, *TURN_SPREAD))
    places = normal(places).reshape(*places.shape[:-1], count, 6) * spread
    plan = schedule(timing, time, WRIST_MOVE_SECONDS)
    wrist = between(places, plan.move, plan.share[..., :1])
    heading = 2 * math.pi * (heading - 0.5)
    wrist = apart(wrist)
    return wrist[..., :3], wrist[..., 3:].at[..., 1].add(heading)


_SHAKEN = np.zeros((len(ANGLES),), np.float32)
_SHAKEN[[ANGLES_OF_FINGER[f][0] for f in range(5)]] = 1
_SHAKEN[[ANGLES_OF_FINGER[f][3] for f in range(5)]] = 0.5
"""`[26]` how much of a finger's tremor each angle takes: its first and its middle flexion."""


def shaking(draws: Array, time: Array) -> tuple[Array, Array, Array]:
    """Tremor and sway: of the angles `[..., T, 26]`, radians; of the wrist, `[..., T, 3]` metres
    and `[..., T, 3]` radians; out of `[..., 44]` numbers in 0 to 1."""
    *batch, _ = draws.shape
    draws = jnp.moveaxis(draws.reshape(*batch, 4, 1, 11), -3, 0)
    wave = jnp.zeros((*batch, len(time), 11))
    for (low, high), size, rate, phase in (
        (TREMOR_HERTZ, TREMOR, draws[0], draws[1]),
        (SWAY_HERTZ, SWAY, draws[2], draws[3]),
    ):
        turn = 2 * math.pi * ((low + (high - low) * rate) * time[:, None] + phase)
        wave = wave + size * jnp.sin(turn)
    wave = apart(wave)
    # A radian at the wrist is worth what a tenth of a metre is.
    angles = wave[..., FINGER_OF_ANGLE] * jnp.asarray(_SHAKEN)
    return angles, 0.1 * wave[..., 5:8], 0.5 * wave[..., 8:]


def from_pitch_yaw_roll(angles: Array) -> Array:
    """`[..., 3, 3]` world_from_wrist of `[..., 3]` radians: roll about the hand's z, then pitch
    about x, then yaw about y."""
    x, y, z = angles[..., 0], angles[..., 1], angles[..., 2]
    (a, b, c), (u, v, w) = (
        (jnp.cos(x), jnp.cos(y), jnp.cos(z)),
        (jnp.sin(x), jnp.sin(y), jnp.sin(z)),
    )
    rows = (
        (b * c + v * u * w, v * u * c - b * w, v * a),
        (a * w, a * c, -u),
        (b * u * w - v * c, v * w + b * u * c, b * a),
    )
    return jnp.stack([jnp.stack(row, -1) for row in rows], -2)
