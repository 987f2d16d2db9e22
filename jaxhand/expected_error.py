"""What `expected_error` of a model should say: measured in gaps like real ones, and fitted.

The error of a hidden marker grows with the change of posture since it was measured, not with time:
a still posture is carried exactly. What its correction has lost counts beside that, for the
correction's length is what the predictor was off when the marker was lost; so people whom a model
fits worse are told so.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np

from jaxhand import sequences as data
from jaxhand import simulation
from jaxhand.evaluation import BLOCK_SECONDS
from numpy_infer import tracker
from numpy_infer.arrays import Array
from numpy_infer.model import ERROR_CHANGES, Model

PIECE = 600
"""Frames of the longest stream: ten seconds."""

STREAMS = 256
"""The fewest that run at once: pieces are taken again, with other gaps."""

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
    """Of the bootstrap: errors near in time are much the same, see `evaluation.BLOCK_SECONDS`."""


def measure(model: Model, sequences: Sequence[data.Sequence], seed: int = 0) -> Samples:
    """Runs the numpy tracker through gaps (`simulation.gaps`) in the sequences."""
    truth, pieces = _streams(sequences)
    frames, hands, markers = truth.shape[:3]
    key = jax.random.key(seed)
    seen = np.asarray(simulation.gaps(key, frames, markers, data.RATE, (hands,))).swapaxes(0, 1)
    known = np.isfinite(truth).all(-1)
    state = tracker.init(model, (hands,))
    time, found = np.full(hands, 1 / data.RATE), []
    blocks = (np.arange(frames) / (data.RATE * BLOCK_SECONDS)).astype(int)
    for frame, (points, there, visible) in enumerate(zip(truth, known, seen & known, strict=True)):
        state, pose = tracker.step(
            model, state, np.where(visible[..., None], points, np.nan), visible, time
        )
        hidden = there & ~visible & state.tracking[:, None]
        hand, marker = np.nonzero(hidden)
        length = np.linalg.norm(state.correction, axis=-1)[hidden]
        change = state.change[hand]
        found.append(
            Samples(
                (~visible).sum(-1)[hand],
                marker,
                state.drift[hidden] + change,
                (1 - np.exp(-change / model.fade)) * length,
                pose.expected_error[hidden],
                np.linalg.norm(pose.markers - points, axis=-1)[hidden],
                blocks[frame] * pieces + hand % pieces,
            )
        )
    return Samples(*(np.concatenate(field) for field in zip(*found, strict=True)))


def _streams(sequences: Sequence[data.Sequence]) -> tuple[Array, int]:
    """`[T, N, M, 3]` pieces of the sequences side by side, NaN after their ends; and how many, from
    where on they come again."""
    pieces = [
        np.asarray(sequence.markers[first : first + PIECE], np.float64)
        for sequence in sequences
        for first in range(0, len(sequence.markers), PIECE)
    ]
    longest = max(map(len, pieces))
    padded = np.full((longest, len(pieces), *pieces[0].shape[1:]), np.nan)
    for i, piece in enumerate(pieces):
        padded[: len(piece), i] = piece
    return np.tile(padded, (1, -(-STREAMS // len(pieces)), 1, 1)), len(pieces)


class Expected(NamedTuple):
    """What a model file holds of it; see `Model`."""

    expected_error: Array
    """`[K, 6]` metres."""
    marker_error: Array
    """`[M]` factors."""
    faded_error: float


def fit(samples: Samples, markers: int) -> Expected:
    """The table, with rows that are multiples of each other and never fall, the factors and the
    share that fit best, all of them positive, if errors scatter in proportion to their means.

    The multiplicative steps of Lee and Seung (1999), each of which brings the sums of expected and
    measured errors closer: of every marker, of every number hidden, of every part of the table.
    """
    measured = samples.measured
    row = np.minimum(samples.number, NUMBERS) - 1
    changes = np.array(ERROR_CHANGES)
    ramps = np.clip((samples.change[:, None] - changes[:-1]) / np.diff(changes), 0, 1)
    parts = np.concatenate([np.ones((len(measured), 1)), ramps], -1)
    grow, share = np.full(parts.shape[1], measured.mean() / 3), 0.5
    rows, factors = np.ones(NUMBERS), np.ones(markers)

    def expected() -> tuple[Array, Array]:
        table = parts @ grow * rows[row] * factors[samples.marker]
        # What is expected is never nothing, so that a ratio to it means something.
        total = np.maximum(table + share * samples.faded, 1e-6)
        return table, measured / total

    for _ in range(ITERATIONS):
        _, ratio = expected()
        share *= (ratio @ samples.faded) / max(samples.faded.sum(), 1e-12)
        scale = rows[row] * factors[samples.marker]
        grow = grow * (parts.T @ (scale * ratio)) / np.maximum(parts.T @ scale, 1e-12)
        table, ratio = expected()
        factors = factors * _of_each(samples.marker, table, ratio, markers)
        table, ratio = expected()
        rows = rows * _of_each(row, table, ratio, NUMBERS)
        grow, factors = grow * factors.mean(), factors / factors.mean()
    # A number never hidden at once is as the next smaller one.
    seen = np.bincount(row, minlength=NUMBERS) > 0
    rows = rows[np.maximum.accumulate(np.where(seen, np.arange(NUMBERS), seen.argmax()))]
    return Expected(rows[:, None] * np.cumsum(grow), factors, float(share))


def _of_each(group: Array, table: Array, ratio: Array, groups: int) -> Array:
    """`[groups]` mean ratio of each, weighted by what the table expects; 1 where there is none."""
    weight = np.bincount(group, table, groups)
    there = weight > 1e-12
    total = np.bincount(group, table * ratio, groups)
    return np.where(there, total / np.where(there, weight, 1), 1)
