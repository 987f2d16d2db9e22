"""How good the filled markers are: Table 3 by the paper's protocol, and its intervals.

Table 3 (paper, section 6.2.1): everything is visible up to a frame, then k random markers are
hidden for a duration; the error is the mean distance of the hidden markers to the truth on the last
hidden frame. Every admissible start is taken, with several seeds.

The tracker's real `step` runs: through the 20 visible frames one by one, then at once to the last
hidden frame. Nothing in tracker or predictors moves in the frames between, because the visible set
stays as it is; a test holds this shortcut against the frame-by-frame run.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

from jaxhand import sequences as data
from jaxhand import tracker
from jaxhand.compiled import compiled
from jaxhand.predictors import PREDICTORS
from numpy_infer.arrays import Array
from numpy_infer.model import Model
from numpy_infer.pose import HandPose

COUNTS = (1, 2, 3, 4)
"""Markers hidden at once."""

DURATIONS = (0.1, 0.2, 0.5, 1.0, 2.0)
"""Seconds hidden."""

VISIBLE_BEFORE = 20
"""Frames that are visible before the gap."""

SEEDS = 5

BLOCK_SECONDS = 4.0
"""Length of a block of the bootstrap; both hands of a take are in one block."""

RESAMPLINGS, FEWEST_BLOCKS = 1000, 10

CHUNK = 4096
"""The most trials run at once. All chunks have one size, to compile once."""
FILLED_TO = 64
"""Chunks are filled up to a multiple of it: so small data sets share what was compiled."""

Cell = dict[str, Any]
Report = Callable[[str, float], None]
Errors = Callable[..., tuple[Array, Array]]


class Starts(NamedTuple):
    """Where trials may begin, among the frames of all sequences put end to end."""

    frames: Array
    """`[F, M, 3]` metres: all sequences, one after the other."""
    start: Array
    """`[N]` index of the last visible frame of each start."""
    room: Array
    """`[N]` how many complete frames of the same sequence follow it."""
    block: Array
    """`[N]` bootstrap block that it lies in."""


def methods(model: Model) -> dict[str, Model]:
    """The rows of Table 3 for a model: every registered predictor on its hand, and what it has
    learned with and without continuity."""
    rows = {
        name: replace(model, predictor=name, joints="none")
        for name in PREDICTORS
        if name not in ("learned", "none")
    }
    if model.marker_network is not None:
        learned = replace(model, predictor="learned", joints="none")
        rows |= {"learned": learned, "learned_no_offset": replace(learned, continuity=False)}
    return rows


def table3(
    models: Mapping[str, Model],
    sequences: Sequence[data.Sequence],
    *,
    seeds: int = SEEDS,
    report: Report = lambda name, share: None,
) -> dict[str, dict[str, dict[str, Cell]]]:
    """Marker error of each model, `{METHOD: {"1".."4": {"0.1".."2.0": CELL}}}`.

    Args:
        models: name → model; all for the same markers. See `plain`.
        sequences: what to test on, at 60 Hz.
        seeds: how many times every start is taken, with other markers hidden.
        report: is told the method at work and the share of its trials done.

    Returns:
        CELL is `mean`, `low`, `high` in cm (95 % block bootstrap; None with fewer than 10 blocks)
        and `n`, the number of trials.

    Raises:
        ValueError: no sequence has 20 complete frames and the shortest gap after them.
    """
    starts = find_starts(sequences)
    return {
        name: table_of(model, starts, seeds, partial(report, name))
        for name, model in models.items()
    }


def find_starts(sequences: Sequence[data.Sequence]) -> Starts:
    """Every frame with 20 complete frames up to it and room for the shortest gap after it."""
    frames, start, room, block, offset = [], [], [], [], 0
    takes: dict[tuple[str, int], int] = {}
    for sequence in sequences:
        complete = np.isfinite(sequence.markers).all((-1, -2))
        before, after = _runs(complete), _runs(complete[::-1])[::-1]
        shortest = round(sequence.rate * DURATIONS[0])
        good = np.flatnonzero((before >= VISIBLE_BEFORE) & (after - 1 >= shortest))
        frames.append(np.nan_to_num(np.asarray(sequence.markers, np.float32)))
        start.append(good + offset)
        room.append(after[good] - 1)
        blocks = (good / (sequence.rate * BLOCK_SECONDS)).astype(int)
        keys = [(sequence.take, int(b)) for b in blocks]
        block.append(np.array([takes.setdefault(key, len(takes)) for key in keys], int))
        offset += len(complete)
    if not sum(map(len, start)):
        raise ValueError(
            f"nothing to test on: expected at least {VISIBLE_BEFORE} frames with all markers "
            f"and {DURATIONS[0]} s after them, in one of {len(sequences)} sequences"
        )
    return Starts(*(np.concatenate(arrays) for arrays in (frames, start, room, block)))


def hide(rng: np.random.Generator, trials: int, markers: int, count: int) -> Array:
    """`[trials, markers]` True at `count` random markers of each trial."""
    rank = rng.random((trials, markers)).argsort(-1).argsort(-1)
    return rank < count


def interval(total: Array, count: Array) -> Cell:
    """Mean with its 95 % interval by block bootstrap.

    Args:
        total: `[blocks]` sum of the samples in each block.
        count: `[blocks]` their number.
    """
    total, count = total[count > 0], count[count > 0]
    cell: Cell = {"mean": None, "low": None, "high": None, "n": int(count.sum())}
    if len(count):
        cell["mean"] = float(total.sum() / count.sum())
    if len(count) >= FEWEST_BLOCKS:
        drawn = np.random.default_rng(0).integers(len(count), size=(RESAMPLINGS, len(count)))
        means = total[drawn].sum(-1) / count[drawn].sum(-1)
        cell["low"], cell["high"] = (float(q) for q in np.quantile(means, (0.025, 0.975)))
    return cell


def mean_ratio(table: Mapping[str, Any], method: str, rival: str) -> float:
    """Mean over the cells of Table 3 of one method's error over another's."""
    ratios = [
        cell["mean"] / table[rival][count][duration]["mean"]
        for count, row in table[method].items()
        for duration, cell in row.items()
        if cell["mean"] is not None
    ]
    return float(np.mean(ratios))


def _runs(complete: Array) -> Array:
    """`[T]` length of the run of True that ends at each frame."""
    count = np.cumsum(complete)
    broken = np.maximum.accumulate(np.where(complete, 0, count))
    return np.where(complete, count - broken, 0)


def table_of(
    model: Model,
    starts: Starts,
    seeds: int,
    report: Callable[[float], None] = lambda share: None,
    *,
    errors: Errors | None = None,
    counts: Sequence[int] = COUNTS,
    durations: Sequence[float] = DURATIONS,
) -> dict[str, dict[str, Cell]]:
    """One method's part of a table, `{COUNT: {DURATION: CELL}}`.

    Args:
        model: what runs until the gap begins; without its gate and its output filter.
        starts: where to begin.
        seeds: how many times every start is taken.
        report: is told the share of the trials done.
        errors: (state, starts, count, duration, generator) → error and block of each admissible
            trial; by default that of Table 3.
        counts, durations: the cells.
    """
    errors = partial(marker_errors, model) if errors is None else errors
    blocks = int(starts.block.max()) + 1
    total = np.zeros((len(counts), len(durations), blocks))
    number = np.zeros(total.shape, int)
    chunks, size = chunked(len(starts.start))
    for done, chunk in enumerate(chunks):
        report(done / len(chunks))
        part = Starts(starts.frames, *(array[chunk] for array in starts[1:]))
        state = _visible_until(model, part, size)
        for i, count in enumerate(counts):
            for j, duration in enumerate(durations):
                for seed in range(seeds):
                    rng = np.random.default_rng([seed, count, j, chunk.start])
                    error, block = errors(state, part, count, duration, rng)
                    total[i, j] += np.bincount(block, error, blocks)
                    number[i, j] += np.bincount(block, minlength=blocks)
    report(1.0)
    return {
        str(count): {
            f"{duration:.1f}": interval(total[i, j], number[i, j])
            for j, duration in enumerate(durations)
        }
        for i, count in enumerate(counts)
    }


def chunked(count: int) -> tuple[list[slice], int]:
    """The chunks of `count` trials, and the size that each is filled up to."""
    step = -(-count // -(-count // CHUNK))
    chunks = [slice(first, first + step) for first in range(0, count, step)]
    return chunks, -(-step // FILLED_TO) * FILLED_TO


def plain(model: Model) -> Model:
    """The model without gate and output filter, the choices of whoever runs it that go by time:
    trials leap over that, and nothing in them is measured wrongly."""
    return replace(model, gate=False, smoothing=None)


def _visible_until(model: Model, starts: Starts, size: int) -> Any:
    """The tracker's state `[size]` at each start, after 20 visible frames."""
    model = plain(model)
    state = tracker.init(model, (size,))
    visible = jnp.ones((size, len(model.hand)), bool)
    for back in range(VISIBLE_BEFORE - 1, -1, -1):
        markers = starts.frames[padded(starts.start, size) - back]
        state, _ = _step(model, state, markers, visible, jnp.full(size, 1 / data.RATE))
    return state


class Trials(NamedTuple):
    """The last hidden frame of trials `[n]`."""

    hidden: Array
    """`[n, M]` True at the markers that were hidden."""
    last: Array
    """`[n]` index of the frame among `Starts.frames`."""
    pose: HandPose
    """What the tracker made of it."""


def run_trials(
    model: Model, state: Any, starts: Starts, hidden: Array, duration: float
) -> tuple[Trials, Array]:
    """Hides `hidden [N, M]` for a duration from each start on. Gives the admissible trials, and
    their bootstrap blocks `[n]`."""
    frames = round(data.RATE * duration)
    admissible = starts.room >= frames
    last = starts.start + np.where(admissible, frames, 0)
    size = len(state.tracked)
    truth = starts.frames[padded(last, size)]
    visible = ~padded(hidden, size)
    _, pose = _step(plain(model), state, truth, visible, jnp.full(size, duration))
    fields = (None if f is None else np.asarray(f)[: len(last)][admissible] for f in pose)
    trials = Trials(hidden[admissible], last[admissible], HandPose(*fields))
    return trials, starts.block[admissible]


def marker_errors(
    model: Model, state: Any, starts: Starts, count: int, duration: float, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Mean error of the hidden markers in cm, and the block, of each admissible trial."""
    hidden = hide(rng, len(starts.start), len(model.hand), count)
    trials, block = run_trials(model, state, starts, hidden, duration)
    distance = np.linalg.norm(trials.pose.markers - starts.frames[trials.last], axis=-1)
    return 1e2 * (distance * trials.hidden).sum(-1) / count, block


def padded(values: Array, size: int) -> Array:
    """`[n, ...]` → `[size, ...]`, the last one repeated."""
    return values[np.minimum(np.arange(size), len(values) - 1)]


@compiled
def _step(
    model: Model, state: Any, markers: Array, visible: Array, dt: Array
) -> tuple[Any, HandPose]:
    # What is hidden does not get as far as the tracker, so no predictor can read it.
    markers = jnp.where(visible[..., None], markers, jnp.nan)
    return tracker.step(model, state, markers, visible, dt)
