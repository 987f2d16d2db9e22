"""Hypothesis strategies: hands, poses, rigid motions, gaps, streams. Needs no JAX.

The simplest value of every draw is the plainest case: nothing hidden, nothing moving, no turn, the
middle of every angle's range. So what fails shrinks to a few frames, a hidden marker, a motion.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from numpy_infer.arrays import Array
from numpy_infer.geometry import kabsch
from numpy_infer.hand import ANGLES, HIGH, LOW, POINTS, Hand, bundled, hand_from_json, load_hand
from numpy_infer.skeleton import forward_kinematics, marker_positions, rotations_from_angles

DURATIONS = (1 / 60, 1 / 120, 0.1, 0.003, 0.0)
"""Seconds between frames that are drawn; 0 is a time stamp given twice."""

PRESSES = (
    *[(1.0, 1.0, 1.0)] * 6,
    *[(1.0, rest, 1.0) for rest in (0.0, 1e-3, 0.05)],
    *[(rest, rest, 1.0) for rest in (0.0, 1e-3, 0.05)],
    *[(1.0, rest, rest) for rest in (0.0, 1e-3, 0.05)],
)
"""What is left of a posture's x, y and z: half of them are as they are, others pressed to a plane
or a line, or nearly, so that any markers of it are coplanar or collinear."""

AXES = tuple(
    np.array(v) / np.linalg.norm(v) for v in itertools.product([0, 1, -1], repeat=3) if any(v)
)
"""26 unit vectors."""


class Motion(NamedTuple):
    """A rigid motion of the world."""

    rotation: Array
    """`[3, 3]`."""
    translation: Array
    """`[3]` metres."""

    def __call__(self, points: Array) -> Array:
        """`[..., 3]` points turned and shifted."""
        return points @ self.rotation.T + self.translation

    def __repr__(self) -> str:
        angle, axis = _angle_axis(self.rotation)
        about = "" if angle < 1e-12 else f" about {_vector(axis)}"
        return f"turned {np.degrees(angle):.6g}°{about}, shifted by {_vector(self.translation)} m"


class Stream(NamedTuple):
    """Hands in time."""

    truth: Array
    """`[T, ..., M, 3]` metres, world: where the markers are."""
    visible: Array
    """`[T, ..., M]` True where measured."""
    dt: Array
    """`[T, ...]` seconds since the previous frame."""

    @property
    def markers(self) -> Array:
        """`[T, ..., M, 3]` what is measured, NaN where hidden."""
        return np.where(self.visible[..., None], self.truth, np.nan)

    def __repr__(self) -> str:
        return f"<stream: {describe(self)}>"


def describe(stream: Stream, names: Sequence[str] = (), longest: int = 8) -> str:
    """A stream in words, hand by hand: what is hidden in each frame, and how the hand has moved
    since the frame before. Markers by `names`, or by number. Of many changes the last `longest` are
    told."""
    frames, *batch, count = stream.visible.shape
    if batch:
        hands = [
            f"hand {', '.join(map(str, i))}: "
            + describe(Stream(*(part[:, *i] for part in stream)), names, longest)
            for i in np.ndindex(*batch)
        ]
        return " | ".join(hands)
    words: list[tuple[int, str]] = []
    for t in range(frames):
        shown = stream.visible[t]
        said = [str(names[m] if names else m) for m in np.flatnonzero(~shown).tolist()]
        if len(said) > count / 2:
            said = [
                "all but",
                *(str(names[m] if names else m) for m in np.flatnonzero(shown).tolist()),
            ]
        text = "all visible" if shown.all() else f"{' '.join(said)} hidden"
        text = "all hidden" if not shown.any() else text
        if t:
            text += _moved_by(stream.truth[t - 1], stream.truth[t])
        text += f", dt {stream.dt[t]:.3g} s"
        if not words or words[-1][1] != text:
            words.append((t, text))
    starts = [t for t, _ in words[1:]] + [frames]
    lines = [
        f"frame{f' {t}' if end == t + 1 else f's {t}-{end - 1}'}: {text}"
        for (t, text), end in zip(words, starts, strict=True)
    ]
    told = lines[-longest:]
    before = [f"… {len(lines) - len(told)} changes before"] if len(told) < len(lines) else []
    return f"{frames} frame{'s' * (frames > 1)}; " + "; ".join([*before, *told])


def _moved_by(before: Array, after: Array) -> str:
    if np.array_equal(before, after):
        return ""
    rotation, _ = kabsch(before, after, np.ones(len(before)), np.eye(3))
    shift = 1000 * np.linalg.norm((after - before).mean(0))
    return f", moved {shift:.3g} mm and turned {np.degrees(_angle_axis(rotation)[0]):.3g}°"


def _angle_axis(rotation: Array) -> tuple[float, Array]:
    """Radians in 0 to π, and the `[3]` axis, of a rotation; right near both ends of the range."""
    skew = rotation - rotation.T
    sine = np.array([skew[2, 1], skew[0, 2], skew[1, 0]]) / 2
    cosine = (np.trace(rotation) - 1) / 2
    angle = float(np.arctan2(np.linalg.norm(sine), cosine))
    if np.linalg.norm(sine) > 1e-6 or cosine > 0:
        return angle, sine / max(float(np.linalg.norm(sine)), 1e-300)
    column = (rotation + np.eye(3))[:, np.argmax(np.diag(rotation))]
    return angle, column / np.linalg.norm(column)


def _vector(values: Array) -> str:
    return f"({', '.join(f'{value:.4g}' for value in values)})"


# -- rigid motions ------------------------------------------------------------------------------


def turn(axis: Any, angle: float) -> Array:
    """`[3, 3]` rotation by `angle` radians about `axis [3]`, of any length (Rodrigues)."""
    x, y, z = np.asarray(axis, float) / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def vectors(reach: float) -> st.SearchStrategy[Array]:
    """`[3]` multiples of 0.1 mm within ±`reach` metres."""
    steps = round(reach * 1e4)
    return st.tuples(*[st.integers(-steps, steps)] * 3).map(lambda v: np.array(v) / 1e4)


def directions() -> st.SearchStrategy[Array]:
    """Unit vectors."""
    vectors = st.tuples(*[st.integers(-9, 9)] * 3).filter(any)
    return vectors.map(lambda v: np.array(v) / np.linalg.norm(v))


def rotations(largest: float = np.pi) -> st.SearchStrategy[Array]:
    """Rotations by up to `largest` radians, often near the identity or near `largest`."""
    return st.builds(turn, directions(), _turns(largest))


def _turns(largest: float) -> st.SearchStrategy[float]:
    tiny = st.sampled_from([0, 1e-9, 1e-5, 1e-3])
    some = st.integers(0, 1000).map(lambda x: x / 1000 * largest)
    return st.one_of(tiny, tiny.map(lambda x: largest - x), some)


def rigid_motions(reach: float = 3) -> st.SearchStrategy[Motion]:
    """Any turn, tiny and half turns often among them, and a shift of up to `reach` metres along
    each axis."""
    return st.builds(Motion, rotations(), vectors(reach))


# -- hands and their poses ----------------------------------------------------------------------


def hands() -> st.SearchStrategy[Hand]:
    """The bundled gloves, and hands of other proportions with other markers: three or more for
    alignment on the back of the hand, and up to nine anywhere."""
    return st.one_of(st.sampled_from(bundled()).map(load_hand), random_hands())


@st.composite
def random_hands(draw: st.DrawFn) -> Hand:
    """A skeleton with each bone at 75 to 130 % of the bundled adult's, and markers of its own."""
    start = load_hand("glove9")
    percent = draw(hnp.arrays(np.int64, len(POINTS), elements=st.integers(75, 130)))
    skeleton = start.skeleton * percent[:, None] / 100
    knuckles = draw(
        st.sampled_from([("index_mcp", "pinky_mcp"), ("index_mcp", "ring_mcp", "pinky_mcp")])
    )
    placed = [(joint, "wrist") for joint in ("wrist", *knuckles)]
    free = draw(st.lists(st.sampled_from(POINTS), max_size=9))
    markers = [
        {
            "name": f"{joint}_{number}",
            "joint": joint,
            "offset": draw(vectors(0.015)).tolist(),
            **({"link": link} if link else {}),
        }
        for number, (joint, link) in enumerate([*placed, *((joint, None) for joint in free)])
    ]
    return hand_from_json(
        {
            "format": "jaxhand-hand",
            "version": 1,
            "name": "drawn",
            "alignment": [marker["name"] for marker in markers[: len(placed)]],
            "markers": markers,
            "skeleton": {point: skeleton[i].tolist() for i, point in enumerate(POINTS)},
        }
    )


def joint_angles(inside: float = 1.0) -> st.SearchStrategy[Array]:
    """`[26]` radians in the ranges of `hand.ANGLES`, shrunk about their middles by `inside`; often
    some of them at the limits."""
    percent = st.one_of(st.integers(-100, 100), st.sampled_from([-100, 100]))
    fractions = hnp.arrays(np.int64, len(ANGLES), elements=percent)
    return fractions.map(lambda x: (LOW + HIGH) / 2 + x / 100 * inside * (HIGH - LOW) / 2)


def poses(hand: Hand) -> st.SearchStrategy[Array]:
    """`[M, 3]` metres, hand frame: the markers of any `joint_angles`."""
    return joint_angles().map(lambda angles: place(hand, angles))


def place(hand: Hand, angles: Array) -> Array:
    """`[..., M, 3]` metres, hand frame: the markers of `[..., 26]` radians."""
    eye = np.broadcast_to(np.eye(3), (*angles.shape[:-1], 3, 3))
    origin = np.zeros((*angles.shape[:-1], 3))
    positions = forward_kinematics(hand.skeleton, rotations_from_angles(angles), eye, origin)
    return marker_positions(hand, *positions)


# -- visibility ---------------------------------------------------------------------------------


COURSES = ("steady", "alternating", "fading", "restless")
"""How hidden markers go on: the same ones; by turns those at either end of the order; from one of
them to all, one more in each frame; in each frame other ones of them at random."""


RANDOM = 1 << 11
"""The seed from which on hidden markers are any, not neighbours in the hand's order."""


class Spell(NamedTuple):
    """Frames in which visibility follows one rule."""

    rule: tuple[int, str]
    """How many frames, and one of `COURSES`."""
    number: int
    """How many markers are hidden."""
    seed: int
    """Which: below `RANDOM` those that follow marker `seed % M`, itself first; else any."""

    def rows(self, count: int) -> Array:
        """`[frames, count]` True where visible."""
        (frames, course), rng = self.rule, np.random.default_rng(self.seed)
        t = np.arange(frames)[:, None]
        order = rng.permutation(count)
        rank = (np.arange(count) - self.seed) % count if self.seed < RANDOM else order
        if course == "alternating":
            rank = np.where(t % 2 == 0, rank, count - 1 - rank)
        hidden = (rank < self.number) & (t >= 0)
        if course == "fading":
            hidden &= rank <= t
        elif course == "restless":
            hidden &= rng.uniform(size=hidden.shape) < 0.5
        return ~hidden


@functools.cache
def spells(count: int) -> st.SearchStrategy[Spell]:
    """One rule of visibility for `count` markers, of which as often none as one, two, … or all are
    hidden. In few draws, so that Hypothesis takes out a spell whole."""
    rules = st.sampled_from(list(itertools.product([1, 2, 3, 5, 8, 20], COURSES)))
    return st.builds(Spell, rules, st.integers(0, count), st.integers(0, 2 * RANDOM))


@st.composite
def visibility(
    draw: st.DrawFn, count: int, frames: int, least: int = 0, most: int | None = None
) -> Array:
    """`[frames, count]` True where a marker is visible, `least` to `most` in every frame: random
    sets, new in every frame or kept for some; two that take turns; markers that go, and come back,
    one after the other; all, one, two, or none left."""
    drawn = draw(st.lists(spells(count), max_size=frames))
    return _between(
        np.concatenate([_rows(drawn, count), np.ones((frames, count), bool)])[:frames], least, most
    )


def _rows(drawn: list[Spell], count: int) -> Array:
    return np.concatenate([np.ones((0, count), bool), *(spell.rows(count) for spell in drawn)])


def _between(visible: Array, least: int, most: int | None) -> Array:
    """`[T, M]` the same with at least and at most so many visible."""
    count, rng = visible.shape[-1], np.random.default_rng(0)
    if most is not None:
        visible = visible & ~at_least(~visible, count - most, rng)
    return at_least(visible, least, rng) if least else visible


def at_least(visible: Array, number: int, rng: np.random.Generator) -> Array:
    """`[..., M]` the same with markers added, where fewer than `number` were visible, until they
    are."""
    rank = np.argsort(np.argsort(rng.uniform(size=visible.shape) - visible, -1), -1)
    return visible | (rank < number)


# -- streams ------------------------------------------------------------------------------------


class Move(NamedTuple):
    """What a hand does in some frames, from rest to rest."""

    frames: int
    axis: Array
    angle: float
    """Radians about the axis `[3]`."""
    direction: Array
    length: float
    """Metres along the direction `[3]`."""
    posture: int
    """Seed of the joint angles at the end; 0: the middle of their ranges."""
    press: tuple[float, float, float]
    """What is left of the hand's x, y and z in the end, see `PRESSES`."""


@st.composite
def streams(
    draw: st.DrawFn,
    hand: Hand,
    frames: int = 16,
    hands: int | None = None,
    least: int = 0,
    most: int | None = None,
    pressed: bool = True,
) -> Stream:
    """A hand that moves as a whole and in itself and then stands still, its markers visible now
    and then, at any frame rate.

    Args:
        hand: whose markers.
        frames: how many there may be.
        hands: None for arrays without an axis of hands; or their number.
        least: how many markers are visible at least in each frame.
        most: and at most, if not all.
        pressed: with postures pressed to a plane or a line, or nearly, among them.
    """
    count = 1 if hands is None else hands
    rules = st.lists(spells(len(hand)), max_size=frames)
    rows = [_rows(draw(rules), len(hand)) for _ in range(count)]
    # As long as the gaps and a little more: a shorter gap is then a shorter stream.
    length = max(1, min(frames, max(map(len, rows)) + draw(st.integers(0, 8))))
    full = np.ones((length, len(hand)), bool)
    each = [
        Stream(
            draw(trajectories(hand, length, pressed)),
            _between(np.concatenate([shown, full])[:length], least, most),
            draw(_durations(length)),
        )
        for shown in rows
    ]
    several = Stream(*(np.stack(parts, 1) for parts in zip(*each, strict=True)))
    return each[0] if hands is None else several


def complete_first(stream: Stream) -> Stream:
    """The same, with all markers visible in the first frame."""
    stream.visible[0] = True
    return stream


@st.composite
def _durations(draw: st.DrawFn, frames: int) -> Array:
    """`[frames]` seconds: a steady rate, but for some frames."""
    dt = np.full(frames, draw(st.sampled_from(DURATIONS[:4])))
    irregular = st.tuples(st.integers(0, frames - 1), st.sampled_from(DURATIONS))
    for t, duration in draw(st.lists(irregular, max_size=3)):
        dt[t] = duration
    return dt


@functools.cache
def moves(pressed: bool = True) -> st.SearchStrategy[Move]:
    """One motion. In few draws, as `spells` are."""
    return st.builds(
        Move,
        st.sampled_from([1, 3, 6, 12]),
        st.sampled_from(AXES),
        st.sampled_from([0, 1e-9, 1e-5, 1e-3, *np.linspace(0.1, np.pi, 32), np.pi - 1e-9]),
        st.sampled_from(AXES),
        st.integers(0, 400).map(lambda x: x / 1e3),
        st.integers(0, 2**12),
        st.sampled_from(PRESSES if pressed else PRESSES[:1]),
    )


@st.composite
def trajectories(draw: st.DrawFn, hand: Hand, frames: int, pressed: bool = True) -> Array:
    """`[frames, M, 3]` metres, world: some moves, then the hand stands still, bit for bit."""
    first = draw(moves(pressed))
    rotation, shift = (
        turn(first.axis, first.angle),
        draw(vectors(1)) + first.length * first.direction,
    )
    angles, kept = _end(first)
    course = [(angles[None], kept[None], rotation[None], shift[None])]
    for move in draw(st.lists(moves(pressed), max_size=max(1, frames // 4))):
        share = (1 - np.cos(np.pi * np.arange(1, move.frames + 1) / move.frames))[:, None] / 2
        turned = np.stack([turn(move.axis, s * move.angle) for s in share[:, 0]])
        end = _end(move)
        course.append(
            (
                angles + share * (end[0] - angles),
                kept + share * (end[1] - kept),
                turned @ rotation,
                shift + share * move.length * move.direction,
            )
        )
        (angles, kept), rotation, shift = (
            end,
            turned[-1] @ rotation,
            shift + move.length * move.direction,
        )
    parts = [np.concatenate(part)[:frames] for part in zip(*course, strict=True)]
    own = place(hand, parts[0]) * parts[1][:, None]
    moving = own @ np.swapaxes(parts[2], -1, -2) + parts[3][:, None]
    still = np.broadcast_to(moving[-1], (frames - len(moving), *moving.shape[1:]))
    return np.concatenate([moving, still])


def _end(move: Move) -> tuple[Array, Array]:
    """`[26]` radians and `[3]` shares of the hand's axes that a move ends with."""
    rng = np.random.default_rng(move.posture)
    fraction = rng.uniform(-1, 1, len(ANGLES)) if move.posture else np.zeros(len(ANGLES))
    return (LOW + HIGH) / 2 + fraction * (HIGH - LOW) / 2, np.array(move.press)
