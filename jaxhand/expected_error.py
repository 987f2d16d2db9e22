"""What `expected_error` of a model should say: measured in gaps like real ones, and fitted.

The error of a hidden marker grows with the change of posture since it was measured, not with time:
a still posture is carried exactly. What its correction has lost counts beside that, for the
correction's length is what the predictor was off when the marker was lost; so people whom a model
fits worse are told so. Both together end somewhere, for a finger is only so long, and begin where
the data's own noise does.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxhand import sequences as data
from jaxhand import simulation, tracker
from jaxhand.compiled import compiled
from jaxhand.evaluation import BLOCK_SECONDS, plain
from numpy_infer.arrays import Array
from numpy_infer.model import ERROR_CHANGES, Model
from numpy_infer.pose import State

PIECE = 600
"""Frames of the longest stream: ten seconds."""

STREAMS = 4096
"""The fewest: pieces are taken again, with other gaps. Large errors are rare: with a sixteenth of
it, those above 16 mm are a handful of gaps."""

AT_ONCE = 256
"""Streams side by side."""

EVERY = 4
"""Frames of which one is looked at: its neighbours are much the same."""

NUMBERS = 6
"""Rows of the table: 1, 2, … markers hidden, and so many or more."""

FEWEST = 500
"""Hidden markers: fewer say nothing of a table."""

ITERATIONS = 300


class Samples(NamedTuple):
    """Every hidden marker of every frame with a tracked hand `[N]`."""

    number: Array
    """How many were hidden at once."""
    marker: Array
    """Its index."""
    change: Array
    """Metres: `drift` and `change` of the tracker's state."""
    faded: Array
    """Metres that its correction has lost."""
    expected: Array
    """Metres: what the tracker said."""
    measured: Array
    """Metres: what it was off."""
    block: Array
    """Of the bootstrap: errors near in time are much the same, see `evaluation.BLOCK_SECONDS`, and
    so may be those of both hands of a take."""


def measure(model: Model, sequences: Sequence[data.Sequence], seed: int = 0) -> Samples:
    """Runs the tracker, without gate and output filter, through gaps (`simulation.gaps`) in the
    sequences."""
    model = plain(model)
    truth, blocks = _pieces(sequences)
    frames, pieces, markers = truth.shape[:3]
    key, found = jax.random.key(seed), []
    for first in range(0, max(STREAMS, pieces), AT_ONCE):
        of = (np.arange(AT_ONCE) + first) % pieces
        gap_key = jax.random.fold_in(key, first)
        seen = simulation.gaps(gap_key, frames, markers, data.RATE, (AT_ONCE,)).swapaxes(0, 1)
        points = truth[:, of]
        there = np.isfinite(points).all(-1)
        visible = there & np.asarray(seen)
        shown = map(np.asarray, _run(model, points, visible))
        tracking, drift, change, correction, output, expected = shown
        hidden = there & ~visible & tracking[..., None]
        hidden[np.arange(frames) % EVERY != 0] = False
        frame, hand, marker = np.nonzero(hidden)
        change = change[frame, hand]
        found.append(
            Samples(
                (~visible).sum(-1)[frame, hand],
                marker,
                drift[hidden] + change,
                (1 - np.exp(-change / model.fade)) * np.linalg.norm(correction[hidden], axis=-1),
                expected[hidden],
                np.linalg.norm(output[hidden] - points[hidden], axis=-1),
                blocks[frame, of[hand]],
            )
        )
    return Samples(*(np.concatenate(field) for field in zip(*found, strict=True)))


@compiled
def _run(model: Model, markers: Array, visible: Array) -> tuple[Array, ...]:
    """`[T, N, ...]` of every frame: whether the hand is tracked, `drift`, `change` and `correction`
    of the state, markers and expected error of the pose."""
    time = jnp.full(markers.shape[1], 1 / data.RATE)

    def frame(state: State, of: tuple[Array, Array]) -> tuple[State, tuple[Array, ...]]:
        state, pose = tracker.step(model, state, *of, time)
        own = state.tracking, state.drift, state.change, state.correction
        return state, (*own, pose.markers, pose.expected_error)

    return jax.lax.scan(frame, tracker.init(model, time.shape), (markers, visible))[1]


def _pieces(sequences: Sequence[data.Sequence]) -> tuple[Array, Array]:
    """`[T, N, M, 3]` pieces of the sequences side by side, NaN after their ends; and `[T, N]` the
    bootstrap's block of each frame."""
    parts = [
        (sequence, first)
        for sequence in sequences
        for first in range(0, len(sequence.markers), PIECE)
    ]
    pieces = [np.asarray(s.markers[first : first + PIECE], np.float32) for s, first in parts]
    longest = max(map(len, pieces))
    padded = np.full((longest, len(pieces), *pieces[0].shape[1:]), np.nan, np.float32)
    for i, piece in enumerate(pieces):
        padded[: len(piece), i] = piece
    number = {sequence.take: i for i, sequence in enumerate(sequences)}
    take = np.array([number[sequence.take] for sequence, _ in parts])
    frame = np.array([first for _, first in parts]) + np.arange(longest)[:, None]
    block = (frame / (data.RATE * BLOCK_SECONDS)).astype(int)
    return padded, block * len(sequences) + take


class Expected(NamedTuple):
    """What a model file holds of it; see `Model`."""

    expected_error: Array
    """`[K, 6]` metres."""
    marker_error: Array
    """`[M]` factors."""
    faded_error: float
    error_saturation: float
    """Per metre."""
    least_error: float
    """Metres."""


def fit(samples: Samples, markers: int) -> Expected:
    """The table, with rows that are multiples of each other and never fall, the factors and the
    numbers that fit best, all of them positive, if the variance of errors grows with their mean.

    The multiplicative steps of Lee and Seung (1999), each of which brings the sums of expected and
    measured errors closer: of every marker, of every number hidden, of every part of the table.
    What each sample counts for is how much it moves with what is fitted.
    """
    measured = samples.measured
    row = np.minimum(samples.number, NUMBERS) - 1
    changes = np.array(ERROR_CHANGES)
    ramps = np.clip((samples.change[:, None] - changes[:-1]) / np.diff(changes), 0, 1)
    parts = np.concatenate([np.ones((len(measured), 1)), ramps], -1)
    mean = max(measured.mean(), 1e-6)
    grow, share = np.full(parts.shape[1], mean / 3), 0.5
    rows, factors = np.ones(NUMBERS), np.ones(markers)
    hidden = np.bincount(samples.marker, minlength=markers) > 0
    least, most = mean / 4, 4 * mean

    def expected() -> tuple[Array, Array, Array, Array]:
        table = parts @ grow * rows[row] * factors[samples.marker]
        straight = table + share * samples.faded
        bent = straight / (1 + straight / most)
        slope = (1 + straight / most) ** -2
        # What is expected is never nothing, so that a ratio to it means something.
        return table * slope, slope, bent, measured / np.maximum(least + bent, 1e-6)

    for _ in range(ITERATIONS):
        _, slope, _, ratio = expected()
        lost = slope * samples.faded
        share *= (ratio @ lost) / max(lost.sum(), 1e-12)
        scale = slope * rows[row] * factors[samples.marker]
        grow = grow * (parts.T @ (scale * ratio)) / np.maximum(parts.T @ scale, 1e-12)
        weight, _, _, ratio = expected()
        factors = factors * _of_each(samples.marker, weight, ratio, markers)
        weight, _, _, ratio = expected()
        rows = rows * _of_each(row, weight, ratio, NUMBERS)
        _, _, bent, ratio = expected()
        least *= ratio.mean()
        most = max(most * (ratio @ bent**2) / max(bent @ bent, 1e-12), 1e-6)
        usual = factors[hidden].mean()
        # A marker never hidden is as the mean of those that were.
        grow, factors = grow * usual, np.where(hidden, factors / usual, 1)
    # A number never hidden at once is as the next smaller one.
    seen = np.bincount(row, minlength=NUMBERS) > 0
    rows = rows[np.maximum.accumulate(np.where(seen, np.arange(NUMBERS), seen.argmax()))]
    table = rows[:, None] * np.cumsum(grow)
    return Expected(table, factors, float(share), 1 / float(most), float(least))


def _of_each(group: Array, table: Array, ratio: Array, groups: int) -> Array:
    """`[groups]` mean ratio of each, weighted by what the table expects; 1 where there is none."""
    weight = np.bincount(group, table, groups)
    there = weight > 1e-12
    total = np.bincount(group, table * ratio, groups)
    return np.where(there, total / np.where(there, weight, 1), 1)
