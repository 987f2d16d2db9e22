"""Models with random networks, and motion and gaps out of a seed, where a test needs long streams
of a kind; those that Hypothesis draws are `jaxhand.strategies`' own. Axes: `[T, hands, M, …]`."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from hypothesis import strategies as st

from jaxhand.strategies import HIGH, LOW, Stream, at_least, place, turn  # noqa: F401
from jaxhand.trial import leaves
from numpy_infer import tracker
from numpy_infer.continuity import SHRINK_SPEED
from numpy_infer.hand import ANGLES, Hand, load_hand
from numpy_infer.model import Model
from numpy_infer.networks import Dense, Dropout, Network, array_shapes

Array = np.ndarray

LAYOUTS = ("glove9", "dense19", "qualisys13")
SPEED = SHRINK_SPEED
"""m/s that continuity allows."""


def seeds() -> st.SearchStrategy[int]:
    """Where a number is random for the law to hold for all of them, a seed is drawn instead."""
    return st.integers(0, 2**20)


# -- models -------------------------------------------------------------------------------------


def a_network(hand: Hand, outputs: int, seed: int, scale: float) -> Network:
    """Random weights of a network 3M-32-`outputs` with the scaling of a trained one."""
    rng = np.random.default_rng(seed)
    spec = (Dense(32), Dropout(0.1), Dense(outputs, "linear"))
    inputs = 3 * len(hand)
    arrays = {}
    for name, shape in array_shapes(spec, inputs).items():
        reach = np.sqrt(6 / sum(shape)) if len(shape) == 2 else 0.1
        arrays[name] = rng.uniform(-reach, reach, shape).astype(np.float32)
    flat = hand.template.reshape(-1).astype(np.float32)
    return Network(
        spec,
        arrays,
        input_mean=flat,
        input_scale=np.full(inputs, 0.05, np.float32),
        output_mean=flat if outputs == inputs else np.zeros(outputs, np.float32),
        output_scale=np.full(outputs, scale, np.float32),
    )


def a_model(
    predictor: str,
    layout: str = "glove9",
    dtype: type[np.floating] = np.float64,
    *,
    joints: bool = False,
    seed: int = 0,
    **changes: Any,
) -> Model:
    """A model with random networks; its template's precision is that of the tracker's states."""
    hand = load_hand(layout)
    hand = replace(hand, template=hand.template.astype(dtype))
    marker_network = a_network(hand, 3 * len(hand), seed, 0.02)
    joint_network = a_network(hand, len(ANGLES), seed + 1, 0.1)
    return Model(
        hand,
        predictor,
        joints="learned" if joints else "none",
        marker_network=marker_network if predictor == "learned" else None,
        joint_network=joint_network if joints else None,
        **{"alignment": joints, **changes},  # the longest pipeline
    )


# -- motion -------------------------------------------------------------------------------------


def smooth(rng: np.random.Generator, frames: int, knots: int, shape: tuple[int, ...]) -> Array:
    """`[frames, *shape]` in ±1: random values, one every `knots` frames, joined by cosines."""
    values = rng.uniform(-1, 1, (frames // knots + 2, *shape))
    place = np.arange(frames) / knots
    left = place.astype(int)
    share = ((1 - np.cos(np.pi * (place - left))) / 2).reshape(-1, *[1] * len(shape))
    return values[left] * (1 - share) + values[left + 1] * share


def postures(hand: Hand, rng: np.random.Generator, frames: int, hands: int) -> Array:
    """`[T, H, M, 3]` metres, hand frame: fingers that bend and spread, about twice a second."""
    fractions = smooth(rng, frames, 15, (hands, len(ANGLES)))
    return place(hand, (LOW + HIGH) / 2 + fractions * (HIGH - LOW) / 2)


def paths(rng: np.random.Generator, frames: int, hands: int) -> tuple[Array, Array]:
    """Rotations `[T, H, 3, 3]` and places `[T, H, 3]` of wrists waved about: up to some 2 m/s and
    600 degrees a second."""
    axis_angle = smooth(rng, frames, 20, (hands, 3)) * 1.5
    angle = np.linalg.norm(axis_angle, axis=-1, keepdims=True)[..., None]
    x, y, z = np.moveaxis(axis_angle, -1, 0)
    none = np.zeros_like(x)
    cross = np.stack([none, -z, y, z, none, -x, -y, x, none], -1).reshape(*x.shape, 3, 3)
    safe = np.where(angle > 0, angle, 1)
    rotation = np.eye(3) + np.sin(angle) / safe * cross
    rotation = rotation + (1 - np.cos(angle)) / safe**2 * cross @ cross
    start = np.stack([turn(rng.normal(size=3), rng.uniform(0, 3)) for _ in range(hands)])
    places = smooth(rng, frames, 20, (hands, 3)) * 0.3 + rng.uniform(-1, 1, (hands, 3))
    return rotation @ start, places


def moved(points: Array, rotation: Array, translation: Array) -> Array:
    """`[..., M, 3]` points turned and shifted."""
    return points @ np.swapaxes(rotation, -1, -2) + translation[..., None, :]


def motion(hand: Hand, rng: np.random.Generator, frames: int, hands: int) -> Array:
    """`[T, H, M, 3]` metres, world: hands that move as a whole and in themselves."""
    return moved(postures(hand, rng, frames, hands), *paths(rng, frames, hands))


# -- visibility ---------------------------------------------------------------------------------


def markov(rng: np.random.Generator, shape: tuple[int, int, int]) -> Array:
    """Gaps of 5 frames in the mean, each marker on its own."""
    draws = rng.uniform(size=shape)
    visible = np.ones(shape, bool)
    for t in range(1, len(visible)):
        visible[t] = np.where(visible[t - 1], draws[t] > 0.06, draws[t] < 0.2)
    return visible


def blocks(rng: np.random.Generator, shape: tuple[int, int, int]) -> Array:
    """A new set every 1 to 10 frames, from nothing to everything, often few."""
    frames, hands, count = shape
    visible = np.ones(shape, bool)
    for hand in range(hands):
        t = 0
        while t < frames:
            length, seen = rng.integers(1, 11), rng.choice([0, 1, 2, 3, 3, 4, 5, count])
            visible[t : t + length, hand] = rng.permutation(count) < seen
            t += length
    return visible


def restless(rng: np.random.Generator, shape: tuple[int, int, int]) -> Array:
    """A new set in every frame, each marker as often hidden as not."""
    return rng.uniform(size=shape) < 0.5


def alternating(rng: np.random.Generator, shape: tuple[int, int, int]) -> Array:
    """Two disjoint sets that take turns: no marker is ever seen in two frames running."""
    one = rng.permutation(shape[-1]) % 2 == 0
    odd = (np.arange(shape[0]) % 2 == 1)[:, None, None]
    return np.broadcast_to(np.where(odd, one, ~one), shape).copy()


def fading(rng: np.random.Generator, shape: tuple[int, int, int]) -> Array:
    """All, then one fewer every other frame down to none, then one more up to all, over again."""
    frames, hands, count = shape
    order = np.stack([rng.permutation(count) for _ in range(hands)])
    level = np.abs(count - (np.arange(frames) // 2) % (2 * count))
    return order < level[:, None, None]


PATTERNS = {f.__name__: f for f in (markov, blocks, restless, alternating, fading)}


# -- running ------------------------------------------------------------------------------------


def run(
    model: Model,
    stream: Stream,
    *,
    right: Any = False,
    markers: Array | None = None,
    state: tracker.State | None = None,
) -> tuple[tracker.HandPose, tracker.State]:
    """All outputs, `[T, H, …]` each, and the last state. `markers` overrides the measured ones."""
    given = stream.markers if markers is None else markers
    hands = stream.visible.shape[1:-1]
    if state is None:
        state = tracker.init(model, hands, np.asarray(right))
    poses = []
    for measured, visible, dt in zip(given, stream.visible, stream.dt, strict=True):
        state, pose = tracker.step(model, state, measured, visible, dt)
        poses.append(pose)
    parts = zip(*poses, strict=True)
    stacked = [None if part[0] is None else np.stack(part) for part in parts]
    return tracker.HandPose(*stacked), state


def assert_same_bits(one: Any, other: Any) -> None:
    """Equal arrays, NaN and the sign of zero included."""
    for a, b in zip(leaves(one), leaves(other), strict=True):
        assert a.dtype == b.dtype
        assert a.shape == b.shape
        assert a.tobytes() == b.tobytes()
