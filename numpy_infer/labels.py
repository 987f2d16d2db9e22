"""A file's labels beside a hand's markers: which hand they are of, what it lacks, and whether that
hand is as large as hands are."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from math import log10

import numpy as np

from numpy_infer.arrays import Array
from numpy_infer.geometry import second_extent
from numpy_infer.hand import Hand, bundled, load_hand
from numpy_infer.pose import DETERMINED_EXTENT
from numpy_infer.recordings import Recording

DISPENSABLE = 1 / 3
"""Share of a hand's markers that a file may have no label of. With so many never seen, the bundled
networks fill those to 2 or 3 cm, simulated hands or recorded ones; with more, worse."""
FRAMES = 600
"""At most so many frames tell a hand's size, evenly spread."""


def labels_of(recording: Recording, prefix: str) -> list[str]:
    """Those that begin with the prefix, without it.

    Raises:
        ValueError: none does; with those that there are.
    """
    labels = [name.removeprefix(prefix) for name in recording.names if name.startswith(prefix)]
    if not labels:
        raise ValueError(f"no label begins with {prefix!r}; there are {', '.join(recording.names)}")
    return labels


def lacking(hand: Hand, labels: Collection[str]) -> list[str]:
    """The markers of a hand that are not among the labels."""
    return [name for name in hand.markers if name not in labels]


def tracked_without(hand: Hand, absent: Collection[str]) -> bool:
    """Whether a hand can be tracked of which these markers are never seen: at most `DISPENSABLE` of
    all, and those left determine where it is."""
    left = np.array([name not in absent for name in hand.markers])
    few = (~left).sum() <= DISPENSABLE * len(hand)
    return bool(few and second_extent(hand.template, left.astype(float)) > DETERMINED_EXTENT)


def prefixed(recording: Recording, prefix: str, hand: Hand) -> Recording:
    """The markers of one hand whose labels all begin with `prefix`, under the hand's own names. A
    marker that the file has no label of is never seen.

    Raises:
        ValueError: the file lacks too many, see `tracked_without`; with the labels that there are.
    """
    absent = [prefix + name for name in lacking(hand, labels_of(recording, prefix))]
    wanted = [prefix + name for name in hand.markers]
    if not tracked_without(hand, [name.removeprefix(prefix) for name in absent]):
        absent = []
    own = recording.select([name for name in wanted if name not in absent])
    markers = np.full((len(own.time), len(hand), 3), np.nan)
    markers[:, [wanted.index(name) for name in own.names]] = own.markers
    filled = tuple(name.removeprefix(prefix) for name in own.filled)
    # What tracking said was of other markers.
    own = replace(own, angles=None, wrist=None, status=None, expected_error=None)
    return replace(own, names=hand.markers, markers=markers, filled=filled)


def fitting_hand(labels: Collection[str]) -> Hand | None:
    """The bundled hand that fewest labels are missing of, and of such the largest; None if none
    could be tracked, see `tracked_without`."""
    for hand in _by_fit(labels):
        if tracked_without(hand, lacking(hand, labels)):
            return hand
    return None


def unfitting(labels: Collection[str], instead: str) -> str:
    """What is said of labels that fit no bundled hand, and what could be done.

    Args:
        labels: all that there are.
        instead: the options that name what to take.
    """
    text = (
        f"no bundled hand fits the labels {', '.join(labels)}: rename them with --map, or pass "
        f"{instead}"
    )
    nearest = _by_fit(labels)[0]
    absent = lacking(nearest, labels)
    if len(absent) < len(nearest):
        return f"{text}; {nearest.name} lacks {', '.join(absent)}"
    own = [name for hand in bundled() for name in load_hand(hand).markers]
    if any(label.endswith(f"_{name}") for label in labels for name in own):
        return f"{text}; --left-prefix or --right-prefix says what labels of a hand begin with"
    return text


def _by_fit(labels: Collection[str]) -> list[Hand]:
    hands = map(load_hand, bundled())
    return sorted(hands, key=lambda hand: (len(lacking(hand, labels)), -len(hand)))


def doubted_unit(recording: Recording, hand: Hand) -> str | None:
    """What is to be said of a hand that is too large or too small by a power of ten; or None.

    Of any two markers that are seen at once the distance is set beside the template's: over pairs
    and frames, the median is 0.5 to 1.4 in postures simulated or recorded.

    Args:
        recording: holds the hand's markers, under its own names.
        hand: whose size is expected.
    """
    one, other = np.nonzero(np.triu(_distances(hand.template, *np.indices((len(hand),) * 2)) > 0))
    chosen = np.linspace(0, len(recording.time) - 1, min(FRAMES, len(recording.time))).astype(int)
    markers = recording.select(hand.markers).markers[chosen]
    ratio = _distances(markers, one, other) / _distances(hand.template, one, other)
    known = ratio[np.isfinite(ratio) & (ratio > 0)]
    power = round(log10(np.median(known))) if known.size else 0
    if power == 0:
        return None
    much = "large" if power > 0 else "small"
    return (
        f"the markers are {10 ** abs(power)} times too {much} for a hand: is the unit, "
        f"{recording.unit:g} m by the file or by --unit, right? {recording.unit / 10**power:g} m "
        "would do"
    )


def _distances(points: Array, one: Array, other: Array) -> Array:
    """`[..., P]` metres between pairs of `[..., M, 3]` points."""
    distances: Array = np.linalg.norm(points[..., one, :] - points[..., other, :], axis=-1)
    return distances
