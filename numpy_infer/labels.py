"""A file's labels beside a hand's markers: which hand they are of, what it lacks, what was meant,
and whether that hand is as large as hands are."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import replace
from difflib import SequenceMatcher
from math import log10
from shlex import quote

import numpy as np

from numpy_infer.arrays import Array
from numpy_infer.formats.units import METRES
from numpy_infer.geometry import second_extent
from numpy_infer.hand import Hand, bundled, load_hand
from numpy_infer.pose import DETERMINED_EXTENT
from numpy_infer.recordings import Recording, doubted_time

DISPENSABLE = 1 / 3
"""Share of a hand's markers that a file may have no label of. With so many never seen, the bundled
networks fill those to 2 or 3 cm, simulated hands or recorded ones; with more, worse."""
CLOSE = 0.8
"""A label that is so much like a marker's name (`difflib`'s ratio) may be meant for it: one letter
of five may be wrong. Names of the bundled hands, such as ThumbIP and ThumbTip, are as near each
other, so a label that is one of them is meant for no other."""
USUAL = 0.45, 1.7
"""Median distance of a hand's markers in parts of the template's, see `doubted_unit`, with room."""
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


def meant(hand: Hand, labels: Collection[str]) -> dict[str, str]:
    """{label: marker} of those that are no marker's name, but nearly that of one that is lacking:
    cases, spaces, hyphens and the like do not count, nor a letter or two."""
    absent = {_plain(name): name for name in lacking(hand, labels)}
    names = {name for known in bundled() for name in load_hand(known).markers} | set(hand.markers)
    found: dict[str, str] = {}
    for likeness, others in ((1.0, hand.markers), (CLOSE, names)):
        for label in labels:
            alike = [name for name in absent if _digits(name) == _digits(label)]
            told = [(_likeness(name, _plain(label)), name) for name in alike]
            near = [one for one in told if one[0] >= likeness]
            if near and label not in others and label not in found:
                found[label] = absent.pop(max(near)[1])
    return found


def _likeness(one: str, other: str) -> float:
    """`difflib`'s ratio, read from whichever end says more: of a repeated part it takes the first,
    and so finds little of middle_middle in middl_middle."""
    return max(SequenceMatcher(None, one[::way], other[::way]).ratio() for way in (1, -1))


def _plain(label: str) -> str:
    return "".join(filter(str.isalnum, label.lower()))


def _digits(label: str) -> str:
    return "".join(filter(str.isdigit, label))


def beginnings(labels: Collection[str]) -> dict[str, Hand]:
    """{prefix: hand} of the bundled hands whose labels all begin with something."""
    names = [name for known in bundled() for name in load_hand(known).markers]
    ends = [label.removesuffix(name) for label in labels for name in names if label.endswith(name)]
    hands = {
        prefix: fitting_hand([one.removeprefix(prefix) for one in labels if one.startswith(prefix)])
        for prefix in dict.fromkeys(filter(None, ends))
    }
    return {prefix: hand for prefix, hand in hands.items() if hand is not None}


def advice(labels: Collection[str], hand: Hand | None = None, prefix: str = "") -> list[str]:
    """What may be wrong with labels of which a hand lacks some.

    Args:
        labels: all that there are, or with a prefix those that begin with it, without it.
        hand: the hand; by default the bundled one that then lacks fewest.
        prefix: what they begin with in the file.
    """
    hands = [hand] if hand else list(map(load_hand, bundled()))
    begun = beginnings(labels)
    if begun and all(len(lacking(one, labels)) == len(one) for one in hands):
        return [prefixes_told([prefix + more for more in begun])]
    own = [label for label in labels if not label.startswith(tuple(begun))]
    left = [len(lacking(one, own)) - len(meant(one, own)) for one in hands]
    found = meant(hands[left.index(min(left))], own)
    pairs = [f"{prefix}{name} by {prefix}{label}" for label, name in found.items()]
    return [f"did you mean {', '.join(pairs)}? (--map renames)"] if pairs else []


def prefixes_told(begun: Collection[str]) -> str:
    """What is said of labels that begin with these."""
    sides = [{"l": "left", "r": "right"}.get(_plain(prefix)[:1]) for prefix in begun]
    if len(sides) == 1 and None in sides:
        options = " or ".join(f"--{side}-prefix {quote(*begun)}" for side in ("left", "right"))
    elif None in sides or len(set(sides)) < len(sides):
        options = "--left-prefix and --right-prefix"
    else:
        told = zip(sides, begun, strict=True)
        options = " ".join(f"--{side}-prefix {quote(prefix)}" for side, prefix in told)
    return f"labels of a hand begin with {' and '.join(begun)}: see {options}"


def of_hand(recording: Recording, prefix: str, hand: Hand) -> Recording:
    """The markers of one hand whose labels all begin with `prefix`, in the hand's own order.

    Raises:
        ValueError: some are lacking; with the labels that there are, and what may help.
    """
    labels = labels_of(recording, prefix)
    try:
        return recording.select([prefix + name for name in hand.markers])
    except ValueError as error:
        raise ValueError("; ".join([str(error), *advice(labels, hand, prefix)])) from None


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
        of_hand(recording, prefix, hand)
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


def unfitting(labels: Collection[str], instead: str, prefix: str = "") -> str:
    """What is said of labels that fit no bundled hand, and what could be done.

    Args:
        labels: all that there are, or with a prefix those that begin with it, without it.
        instead: the options that name what to take.
        prefix: what they begin with in the file.
    """
    text = (
        f"no bundled hand fits the labels {', '.join(prefix + label for label in labels)}: rename "
        f"them with --map, or pass {instead}"
    )
    nearest = _by_fit(labels)[0]
    absent = lacking(nearest, labels)
    if len(absent) < len(nearest):
        text += f"; {nearest.name} lacks {', '.join(prefix + name for name in absent)}"
        return "; ".join([text, *advice(labels, nearest, prefix)])
    return "; ".join([text, *advice(labels, None, prefix)])


def without(hand: Hand, labels: Collection[str], prefix: str = "") -> str | None:
    """What is said of labels that a file lacks, and which of those it has might be them.

    Args:
        labels: those that begin with the prefix, without it.
        prefix: what they begin with in the file.
    """
    absent = [prefix + name for name in lacking(hand, labels)]
    if not absent:
        return None
    text = f"no label {', '.join(absent)}: tracked as never seen"
    surplus = [prefix + label for label in labels if label not in hand.markers]
    advised = advice(labels, hand, prefix)
    if surplus:
        text += f"; labels not used: {', '.join(surplus)}{'' if advised else ' (--map renames)'}"
    return "; ".join([text, *advised])


def doubts(recording: Recording) -> list[str]:
    """What `jaxhand inspect` has to say of a recording's labels, its hands' size and its time."""
    labels = recording.names
    begun, hand = beginnings(labels), fitting_hand(labels)
    found = [*begun.items(), *([("", hand)] if hand else [])]
    said = [prefixes_told(begun)] if begun else []
    if not begun or hand:
        said += advice(labels, hand)
    hands = [(prefixed(recording, *one), one[1]) for one in found]
    sizes = [doubt(*one) for one in hands for doubt in (doubted_unit, unusual_size)]
    return [*said, *dict.fromkeys(filter(None, [*sizes, doubted_time(recording)]))]


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
    ratio = _ratio(recording, hand)
    power = round(log10(ratio))
    # Of an inch no tenth is a unit: the power of ten nearest to what would do.
    likely = 10.0 ** round(log10(recording.unit / ratio))
    return _doubt(recording, 10.0**power, likely) if power else None


def unusual_size(recording: Recording, hand: Hand) -> str | None:
    """What is to be said, likewise, of one that is of another size than hands are by less: inches
    may have been taken for centimetres, but it may be a child's fist, too."""
    ratio = _ratio(recording, hand)
    if USUAL[0] < ratio < USUAL[1] or round(log10(ratio)):
        return None
    middle = (USUAL[0] * USUAL[1]) ** 0.5
    units = sorted(set(METRES.values()))
    likely = min(units, key=lambda unit: abs(log10(unit * ratio / middle / recording.unit)))
    return _doubt(recording, ratio, likely)


def _doubt(recording: Recording, ratio: float, likely: float) -> str:
    much, times = "large" if ratio > 1 else "small", float(f"{max(ratio, 1 / ratio):.2g}")
    return (
        f"the markers are {times:g} times too {much} for a hand: is the unit, "
        f"{recording.unit:g} m by the file or by --unit, right? {likely:g} m would do"
    )


def _ratio(recording: Recording, hand: Hand) -> float:
    """The median, over pairs of markers and frames, of their distance in parts of the template's; 1
    if no two are seen at once."""
    one, other = np.nonzero(np.triu(_distances(hand.template, *np.indices((len(hand),) * 2)) > 0))
    chosen = np.linspace(0, len(recording.time) - 1, min(FRAMES, len(recording.time))).astype(int)
    markers = recording.select(hand.markers).markers[chosen]
    ratio = _distances(markers, one, other) / _distances(hand.template, one, other)
    known = ratio[np.isfinite(ratio) & (ratio > 0)]
    return float(np.median(known)) if known.size else 1.0


def _distances(points: Array, one: Array, other: Array) -> Array:
    """`[..., P]` metres between pairs of `[..., M, 3]` points."""
    distances: Array = np.linalg.norm(points[..., one, :] - points[..., other, :], axis=-1)
    return distances
