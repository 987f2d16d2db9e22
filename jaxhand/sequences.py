"""Sequences of one hand as arrays to train and evaluate on, and how they get to one rate."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from numpy_infer.arrays import Array
from numpy_infer.hand import Hand

RATE = 60.0
"""Hz of every sequence."""
_HIT = 0.01
"""Part of a source step within which a wanted time is taken for a sample's own: printed times are
rounded."""


@dataclass(frozen=True, eq=False)
class Sequence:
    """One hand over time, as a canonical left hand.

    name: such as `cube_med2/left`. take: sequences of one take stay together in the bootstrap.
    rate: Hz. markers: `[T, M, 3]` metres, world, order of the data set's hand; NaN where hidden.
    Joint truth, or None: positions `[T, 21, 3]` metres, world; rotations `[T, 16, 3, 3]`
    world_from_joint, the wrist's measured and the others those of the angles; angles `[T, 26]`
    radians. NaN where the recording has none. All float32.
    """

    name: str
    take: str
    rate: float
    markers: Array
    positions: Array | None = None
    rotations: Array | None = None
    angles: Array | None = None


@dataclass(frozen=True, eq=False)
class Dataset:
    """Sequences of one hand. hand: with the data's own skeleton where that is known. weight: its
    share in training. observed_angles: `[26]` True where the recordings determine the angle, None
    without joint truth. noise_floor: where that truth is a fit, take → how far it is off by itself,
    `[N]` metres (see `dense_truth.noise_floor`). notes: one line each."""

    name: str
    hand: Hand
    sequences: tuple[Sequence, ...]
    weight: float = 1.0
    observed_angles: Array | None = None
    noise_floor: Mapping[str, Array] | None = None
    notes: tuple[str, ...] = ()


class CompleteFrames(NamedTuple):
    """Frames of a data set in which every marker is seen and, where it has joint truth, that is
    known. sequence: `[N]` index of each frame's sequence. index: `[N]` its place there. The others
    as in `Sequence`, with N frames; the last three are None without joint truth."""

    sequence: Array
    index: Array
    markers: Array
    positions: Array | None = None
    rotations: Array | None = None
    angles: Array | None = None


def complete_frames(dataset: Dataset) -> CompleteFrames:
    """Gathers the frames to train on from all sequences."""
    fields = ["markers"]
    if all(s.angles is not None for s in dataset.sequences):
        fields += ["positions", "rotations", "angles"]
    keep = [_all_finite([getattr(s, field) for field in fields]) for s in dataset.sequences]
    arrays = {
        field: np.concatenate(
            [getattr(s, field)[k] for s, k in zip(dataset.sequences, keep, strict=True)]
        )
        for field in fields
    }
    sequence = np.repeat(np.arange(len(keep)), [k.sum() for k in keep])
    return CompleteFrames(sequence, np.concatenate([*map(np.flatnonzero, keep)]), **arrays)


def _all_finite(arrays: list[Array]) -> Array:
    """`[T]` True where nothing in any of the `[T, ...]` arrays is missing."""
    return np.all([np.isfinite(a).all(tuple(range(1, a.ndim))) for a in arrays], axis=0)


def resample(time: Array, values: Array, rate: float = RATE) -> Array:
    """`[T, ...]` values at `[T]` seconds → values at steps of 1 / rate from the first time on.

    Linear between two neighbours, NaN if either is, or if frames were lost between them. A sample
    that is hit needs only itself. Samples whose time does not advance are left out.
    """
    time, values = np.asarray(time, np.float64), np.asarray(values, np.float64)
    advances = np.diff(np.maximum.accumulate(time), prepend=-np.inf) > 0
    time, values = time[advances], values[advances]
    if len(time) < 2:
        return values
    steps = np.diff(time)
    count = int((time[-1] - time[0]) * rate + _HIT) + 1
    wanted = time[0] + np.arange(count) / rate
    right = np.clip(np.searchsorted(time, wanted), 1, len(time) - 1)
    left = right - 1
    part = (wanted - time[left]) / steps[left]
    part = np.where(part < _HIT, 0, np.where(part > 1 - _HIT, 1, part))
    lost = (steps[left] > 2.5 * np.median(steps)) & (part > 0) & (part < 1)
    part = np.where(lost, np.nan, part).reshape(-1, *[1] * (values.ndim - 1))
    between = values[left] * (1 - part) + values[right] * part
    # A product with 0 would still pass on the other neighbour's NaN.
    return np.where(part == 0, values[left], np.where(part == 1, values[right], between))


def smooth(values: Array, window: int = 9, order: int = 2) -> Array:
    """Savitzky-Golay filter (1964) along the first axis of `[T, ...]`, T ≥ window, odd: the value
    of the polynomial fitted to each window at its middle, at both ends of the first and the last
    window's polynomial. NaN wherever the window holds one."""
    powers = np.arange(window)[:, None] ** np.arange(order + 1.0)
    fitted = powers @ np.linalg.pinv(powers)
    half = window // 2
    windows = np.lib.stride_tricks.sliding_window_view(values, window, axis=0)
    middle = windows @ fitted[half]
    first = np.tensordot(fitted[:half], values[:window], 1)
    last = np.tensordot(fitted[half + 1 :], values[-window:], 1)
    return np.concatenate([first, middle, last])
