"""What Hypothesis draws: float64 arrays, bounded, on a grid of 0.1 mm (so without subnormals),
in few shapes (each new one is a compilation). Laws cast them to the precision under test."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from jaxhand.strategies import HIGH, LOW, directions, joint_angles, rotations, turn, vectors  # noqa: F401
from jaxhand.strategies import rigid_motions as motions

Array = np.ndarray

SPREAD = 6e-3
"""Metres: what counts as spread out here; the library promises from 5 mm on."""


def extents(points: Array) -> Array:
    """`[..., 3]` singular values of the centred `[..., N, 3]` points."""
    return np.linalg.svd(points - points.mean(-2, keepdims=True), compute_uv=False)


def grid(shape: tuple[int, ...] | int, reach: float) -> st.SearchStrategy[Array]:
    """Arrays of multiples of 0.1 mm within ±`reach` metres."""
    steps = round(reach * 1e4)
    elements = st.integers(-steps, steps)
    return hnp.arrays(np.int64, shape, elements=elements, fill=st.nothing()).map(lambda a: a / 1e4)


def noise(shape: tuple[int, ...]) -> st.SearchStrategy[Array]:
    """Arrays in ±1 out of a seed: where no single number matters, much faster than `grid`."""
    seeds = st.integers(0, 2**16)
    return seeds.map(lambda seed: np.random.default_rng(seed).uniform(-1, 1, shape))


def translations() -> st.SearchStrategy[Array]:
    """Up to 3 m along each axis."""
    return vectors(3)


def spread_points(count: int = 9) -> st.SearchStrategy[Array]:
    """`[count, 3]` points within ±0.1 m that determine a rotation."""
    return grid((count, 3), 0.1).filter(lambda p: extents(p)[1] > SPREAD)


@st.composite
def flat_points(draw: st.DrawFn, count: int = 9) -> Array:
    """`[count, 3]` coplanar points that determine a rotation."""
    flat = draw(spread_points(count)) * [1, 1, 0]
    return (flat + np.array([0, 0, draw(st.integers(-9, 9)) / 100])) @ draw(rotations()).T


@st.composite
def line_points(draw: st.DrawFn, count: int = 9, off: float = 0.0) -> Array:
    """`[count, 3]` points within `off` metres of a line, the first two at least 2 cm apart."""
    along = draw(grid((count, 1), 0.1).filter(lambda x: np.ptp(x[:2]) > 0.02))
    aside = draw(noise((count, 3))) * off
    return along * draw(directions()) + aside + draw(grid(3, 0.1))


def any_points(count: int = 9) -> st.SearchStrategy[Array]:
    """`[count, 3]` points of every kind: spread, coplanar, (nearly) collinear, in one place."""
    return st.one_of(
        grid((count, 3), 0.1),
        spread_points(count).map(lambda p: p * [1, 1, 0]),
        line_points(count),
        line_points(count, off=1e-3),
        grid(3, 0.1).map(lambda p: np.repeat(p[None], count, 0)),
    )


def masks(count: int = 9) -> st.SearchStrategy[Array]:
    """`[count]` bool: which markers are visible."""
    return hnp.arrays(bool, count)


def weights(count: int = 9) -> st.SearchStrategy[Array]:
    """`[count]` weights, many of them 0."""
    return hnp.arrays(np.int64, count, elements=st.integers(0, 4)).map(lambda w: w / 2)


class Registration(NamedTuple):
    """A question for `kabsch`, in the order of its arguments, and the motion behind it."""

    source: Array
    target: Array
    weight: Array
    prior: Array
    rotation: Array
    translation: Array

    @property
    def question(self) -> tuple[Array, Array, Array, Array]:
        return self[:4]


@st.composite
def registrations(draw: st.DrawFn, spread: bool = False) -> Registration:
    """Point sets of every kind, or only `spread` ones, the target moved and, where the set is
    spread, up to 1 mm off; the prior within 1 rad of the truth, as one frame's is of the next."""
    source = draw(st.one_of(spread_points(), flat_points()) if spread else any_points())
    rotation, translation = draw(motions())
    target = source @ rotation.T + translation
    if extents(source)[1] > 2 * SPREAD:
        target = target + draw(noise(target.shape)) * 1e-3
    prior = rotation @ draw(rotations(1.0))
    return Registration(source, target, np.ones(len(source)), prior, rotation, translation)
