"""How often markers are lost, how many at once and for how long (paper, section 6.1): counted, in
files, and as the input drop-out of training. The verb `occlusions`."""

from __future__ import annotations

import json
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from jaxhand.anthropometry import people
from jaxhand.cameras import Rig, film
from jaxhand.compiled import compiled
from jaxhand.datasets import SIMULATED
from jaxhand.options import Unit
from jaxhand.pictures import check_picture, occlusions_picture
from jaxhand.two_hands import two_hands
from numpy_infer.arrays import Array
from numpy_infer.cli import check_output
from numpy_infer.formats.json_text import read_json
from numpy_infer.hand import Hand, bundled, load_hand
from numpy_infer.labels import advice
from numpy_infer.recordings import Recording, load_label_map, read

QUANTILES = (0.05, 0.1, 0.25, 0.5, 0.75, 0.9, 0.95, 0.99)
"""Of gap lengths."""

FEWEST_LEFT = 3
"""Markers that are never hidden: fewer do not determine a registration."""

SAME_RATE = 0.01
"""Rates that differ by a smaller part are taken for one."""

LARGEST = 1e15
"""No number in a file of gaps is larger."""

ONE, TWO = "one hand", "two hands"
"""Names of tables: of recordings with one hand, and with two."""

RATE, RECORDINGS = 120.0, 8
"""Frames per second of simulated recordings, and their number."""


@dataclass(frozen=True)
class Occlusions:
    """Statistics of the gaps of one layout of M markers, over hands and recordings.

    A gap is a run of frames without a marker; one that a recording begins or ends with counts as
    far as it is there. All checks of a table stand here: ValueError names what is wrong.
    """

    markers: tuple[str, ...]
    """Their names."""
    rate: float
    """Frames per second."""
    frames: int
    """Frames of all hands."""
    hidden: tuple[float, ...]
    """`[M + 1]` share of frames in which 0, 1, … M markers are hidden at once."""
    missing: tuple[float, ...]
    """`[M]` share of frames without each marker."""
    gaps: int
    """Their number."""
    lengths: tuple[int, ...]
    """Frames: the `QUANTILES` of gap lengths; 0 where there is no gap."""
    weighted: tuple[int, ...]
    """Frames: the gap length up to which gaps hold these shares of all missing frames."""
    histogram: tuple[int, ...]
    """Number of gaps of 1, of 2 and 3, of 4 to 7, of 8 to 15, … frames."""

    def __post_init__(self) -> None:
        count = len(self.markers)
        _check("markers", len(set(self.markers)) == count > 0, "different names", self.markers)
        _check("rate", 0 < self.rate < np.inf, "a positive number of Hz", self.rate)
        _check("frames", self.frames > 0, "1 or more", self.frames)
        for name, length in (("hidden", count + 1), ("missing", count)):
            values = getattr(self, name)
            fits = len(values) == length and all(0 <= value <= 1 for value in values)
            _check(name, fits, f"{length} numbers from 0 to 1", values)
        _check("hidden", abs(sum(self.hidden) - 1) < 1e-6, "parts that sum to 1", self.hidden)
        mean = sum(number * share for number, share in enumerate(self.hidden))
        same = abs(mean - sum(self.missing)) < 1e-6
        _check("missing", same, f"rates that sum to the mean number hidden, {mean:g}", self.missing)
        for name in ("lengths", "weighted"):
            values = getattr(self, name)
            fits = len(values) == len(QUANTILES) and list(values) == sorted(values)
            fits = fits and all((value > 0) == (self.gaps > 0) for value in values)
            _check(name, fits, f"{len(QUANTILES)} growing numbers of frames", values)
        fits = sum(self.histogram) == self.gaps and min(self.histogram, default=0) >= 0
        _check("histogram", fits, f"numbers that sum to {self.gaps} gaps", self.histogram)

    def to_json(self) -> dict[str, Any]:
        """Plain data that `occlusions_from_json` reads back to the same statistics."""
        data: dict[str, Any] = {name: getattr(self, name) for name in KINDS}
        for name, (kind, _) in KINDS.items():
            if kind is list:
                data[name] = list(data[name])
            elif kind is dict:
                data[name] = dict(zip(_keys(name, len(data[name])), data[name], strict=True))
        return data


KINDS: dict[str, tuple[type | None, type]] = {
    "markers": (list, str),
    "rate": (None, float),
    "frames": (None, int),
    "hidden": (list, float),
    "missing": (list, float),
    "gaps": (None, int),
    "lengths": (dict, int),
    "weighted": (dict, int),
    "histogram": (dict, int),
}
"""What each field is in a file: a list, an object by quantile or bin, or one value; and of what."""


def occlusions_from_json(data: Any) -> Occlusions:
    """Reads what `Occlusions.to_json` gives.

    Raises:
        ValueError: an entry that is missing or unknown, or numbers that contradict each other.
    """
    _check_keys("statistics of occlusions", data, KINDS)
    values = {}
    for name, (kind, of) in KINDS.items():
        value = data[name]
        if kind is None:
            values[name] = _number(name, value, of)
            continue
        _check(name, isinstance(value, kind), "a list" if kind is list else "an object", value)
        if kind is dict:
            keys = _keys(name, len(value))
            _check(name, list(value) == keys, f"the entries {', '.join(keys)}", list(value))
            value = value.values()
        values[name] = tuple(_number(name, each, of) for each in value)
    return Occlusions(**values)


def save(tables: Mapping[str, Occlusions], path: str | Path, *, overwrite: bool = False) -> None:
    """Writes tables by name, such as `ONE` and `TWO`. ValueError if the file exists."""
    if Path(path).exists() and not overwrite:
        raise ValueError(f"{path} exists: choose another name, or ask to overwrite it")
    rows = {name: table.to_json() for name, table in tables.items()}
    data = {"format": "jaxhand-occlusions", "version": 1, "tables": rows}
    Path(path).write_text(json.dumps(data, indent=1) + "\n", "utf-8")


def load(path: str | Path) -> dict[str, Occlusions]:
    """What `save` wrote.

    Raises:
        ValueError: the file is none; the message names the culprit.
    """
    tables, at = {}, ""
    try:
        data = read_json(Path(path))
        _check_keys("a file of occlusions", data, ("format", "version", "tables"))
        kind = [data["format"], data["version"]]
        _check("format, version", kind == ["jaxhand-occlusions", 1], "jaxhand-occlusions 1", kind)
        rows = data["tables"]
        _check("tables", isinstance(rows, dict) and len(rows) > 0, "an object of tables", rows)
        for name, row in rows.items():
            at = f"{name}: "
            tables[name] = occlusions_from_json(row)
    except FileNotFoundError:
        raise ValueError(f"no file of gaps {path}: jaxhand occlusions --json writes one") from None
    except ValueError as error:
        raise ValueError(f"{path}: {at}{error}") from None
    return tables


def statistics(
    markers: Sequence[str], rate: float, hands: Sequence[Array], longest: int | None = None
) -> Occlusions:
    """Counts.

    Args:
        markers: M names.
        rate: frames per second.
        hands: `[T, M]` each, True where visible; one for each hand of each recording.
        longest: frames at which longer gaps are cut, in their lengths only.

    Raises:
        ValueError: no frames, or another number of markers.
    """
    for visible in hands:
        if np.ndim(visible) != 2 or np.shape(visible)[1] != len(markers):
            raise ValueError(
                f"hands: expected [T, {len(markers)}] each, found {list(np.shape(visible))}"
            )
    frames = sum(len(visible) for visible in hands)
    if not frames:
        raise ValueError("hands: expected at least one frame")
    hidden = [~np.asarray(visible, bool) for visible in hands]
    at_once = sum(np.bincount(one.sum(1), minlength=len(markers) + 1) for one in hidden)
    lengths = np.sort(np.concatenate([gap_lengths(visible) for visible in hands]))
    lengths = lengths if longest is None else np.minimum(lengths, longest)
    edges = 2 ** np.arange(int(lengths.max(initial=1)).bit_length() + 1)
    return Occlusions(
        markers=tuple(markers),
        rate=float(rate),
        frames=frames,
        hidden=tuple((np.asarray(at_once) / frames).tolist()),
        missing=tuple((np.sum([one.sum(0) for one in hidden], 0) / frames).tolist()),
        gaps=len(lengths),
        lengths=_quantiles(lengths, np.ones_like(lengths)),
        weighted=_quantiles(lengths, lengths),
        histogram=tuple(np.histogram(lengths, edges - 0.5)[0].tolist()),
    )


def gap_lengths(visible: Array) -> Array:
    """`[G]` frames: lengths of all gaps of `[T, M]`."""
    edge = np.zeros((1, np.shape(visible)[1]), np.int8)
    change = np.diff(np.concatenate([edge, ~np.asarray(visible, bool), edge]).T)
    begin, end = (np.argwhere(change == step)[:, 1] for step in (1, -1))
    return np.asarray(end - begin, int)


def _quantiles(ordered: Array, weight: Array) -> tuple[int, ...]:
    """The least lengths up to which there are at least `QUANTILES` of the weight."""
    if not len(ordered):
        return (0,) * len(QUANTILES)
    below = np.cumsum(weight)
    # The products are rounded: 0.05 of 100 may come out a little above 5.
    at = np.searchsorted(below, np.array(QUANTILES) * below[-1] - 1e-6)
    return tuple(ordered[at].tolist())


def numbers_hidden(stats: Occlusions) -> Array:
    """`[M - 3]` probabilities that 1, 2, … markers are hidden, where any is and three are left.
    ValueError if that never happened."""
    shares = np.array(stats.hidden[1:-FEWEST_LEFT])
    if not shares.sum() > 0:
        raise ValueError(
            f"no frame with a hidden marker and {FEWEST_LEFT} visible ones to draw from"
        )
    return np.asarray(shares / shares.sum(), np.float32)


@partial(jax.jit, static_argnames=("stats", "shape"))
def draw(key: Array, stats: Occlusions, shape: tuple[int, int]) -> Array:
    """`[N, M]` False at the markers to hide: as many as were hidden at once, see `numbers_hidden`,
    and one rather than another by how often it was missing.

    One after another without replacement, in proportion to their missing rates: the first of
    exponential waiting times at these rates (Efraimidis and Spirakis 2006).
    """
    number_key, order_key = jax.random.split(key)
    limits = jnp.cumsum(jnp.asarray(numbers_hidden(stats)))[:-1]
    number = 1 + (jax.random.uniform(number_key, (shape[0], 1)) >= limits).sum(-1)
    rates = jnp.maximum(jnp.array(stats.missing, jnp.float32), 1e-9)
    order = jax.random.exponential(order_key, shape) / rates
    # Ranks by comparison: sorting is slow on a CPU.
    rank = (order[:, :, None] > order[:, None, :]).sum(-1)
    return rank >= number[:, None]


def of_layout(path: str | Path, markers: Sequence[str]) -> Occlusions:
    """What training draws from: a file's table of two hands where it has one, else its first, with
    the M markers in this order. ValueError if it is of others, or nothing was hidden."""
    tables = load(path)
    table = tables.get(TWO) or next(iter(tables.values()))
    if sorted(table.markers) != sorted(markers):
        names = ", ".join(table.markers)
        raise ValueError(f"{path}: expected the markers {', '.join(markers)}, found {names}")
    numbers_hidden(table)
    missing = dict(zip(table.markers, table.missing, strict=True))
    return replace(table, markers=tuple(markers), missing=tuple(missing[name] for name in markers))


@dataclass(frozen=True, kw_only=True)
class OcclusionsConfig:
    """The command line of `jaxhand occlusions`."""

    files: tyro.conf.Positional[tuple[str, ...]]
    """Marker files (TRC, TSV, CSV, C3D, …) with one hand or two in each; or the word simulated."""
    hand: str | None = None
    """A bundled hand, or a hand file, whose markers are counted; by default the largest bundled one
    that fits the labels, for simulated glove9."""
    left_prefix: str = ""
    """What stands before the markers' names in the labels of a left hand, or of the only one."""
    right_prefix: str = ""
    """The same of a right hand."""
    map: Path | None = None
    """JSON file {"label in the file": "marker"}."""
    unit: Unit = None
    """The file's unit, where it does not say."""
    left_handed: bool = False
    """The file's coordinates are left-handed."""
    json: Path | None = None
    """Write all figures here; jaxhand train --occlusions draws from them what it hides."""
    picture: Path | None = None
    """Draw them here, like the paper's Fig. 13 and 14; needs the extra `plot`."""
    overwrite: bool = False
    """Replace files that exist."""
    seconds: float = 60.0
    """Simulated: length of each recording."""
    cameras: int = Rig().cameras
    """Simulated: number of cameras."""
    seed: int = 0
    """Simulated: the same seed gives the same numbers on the same machine."""


def occlusions(config: OcclusionsConfig, console: Console | None = None) -> dict[str, Occlusions]:
    """Counts, prints, writes.

    Returns:
        Tables by name: `"one hand"` of the recordings with one, `"two hands"` of those with two.

    Raises:
        ValueError: a file that is none, exists already or would stand in no folder, or labels that
            fit no hand.
    """
    console = console or Console(soft_wrap=True, highlight=False)
    if config.json is not None:
        inputs = list(map(Path, config.files))
        check_output(config.json, overwrite=config.overwrite, inputs=inputs)
    if config.picture is not None:
        check_picture(config.picture, overwrite=config.overwrite)
    if not config.files:
        raise ValueError(f"expected marker files, or the word {SIMULATED}")
    tables = _simulated(config) if config.files == (SIMULATED,) else _recorded(config, console)
    print_tables(tables, console)
    if config.json is not None:
        save(tables, config.json, overwrite=config.overwrite)
        console.print(f"wrote {config.json}")
    if config.picture is not None:
        occlusions_picture(tables, config.picture, overwrite=config.overwrite)
        console.print(f"wrote {config.picture}")
    return tables


def _simulated(config: OcclusionsConfig) -> dict[str, Occlusions]:
    hand = load_hand(config.hand or "glove9")
    frames, rig = round(config.seconds * RATE), Rig(cameras=config.cameras)
    if min(frames, rig.cameras) < 1:
        raise ValueError("seconds, cameras: expected at least one frame and one camera")

    @compiled
    def seen(key: Array) -> tuple[Array, Array]:
        person_key, motion_key, key = jax.random.split(key, 3)
        person = people(person_key, hand, (RECORDINGS,))
        motions = two_hands(motion_key, frames, RATE, (RECORDINGS,), person)
        return film(key, hand, person, *motions, RATE, rig)

    return {
        name: statistics(hand.markers, RATE, [*np.concatenate(np.asarray(hands))])
        for name, hands in zip((ONE, TWO), seen(jax.random.key(config.seed)), strict=True)
    }


def _recorded(config: OcclusionsConfig, console: Console) -> dict[str, Occlusions]:
    label_map = load_label_map(config.map) if config.map else None
    seen: dict[str, list[Array]] = {}
    markers: tuple[str, ...] = ()
    first: Recording | None = None
    for file in config.files:
        recording = read(
            file,
            unit=config.unit,
            left_handed=config.left_handed,
            label_map=label_map,
            prefixes=(config.left_prefix, config.right_prefix),
        ).measured()
        hand, hands = hands_in(recording, config.hand, config.left_prefix, config.right_prefix)
        first, markers = first or recording, markers or hand.markers
        if hand.markers != markers:
            raise ValueError(f"{file}: other markers than in the files before")
        # Rounded times make rates that differ in their third digit.
        if abs(recording.rate / first.rate - 1) > SAME_RATE:
            raise ValueError(
                f"{file}: {recording.rate:g} Hz, and {first.rate:g} in the files before: gaps are "
                "counted in frames, so count files of one rate at a time"
            )
        console.print(f"{file}: {len(hands)} × {hand.name}, {recording.rate:g} Hz")
        for note in recording.notes:
            console.print(f"note: {note}")
        seen.setdefault(ONE if len(hands) == 1 else TWO, []).extend(hands)
    assert first is not None  # there is a file
    return {name: statistics(markers, first.rate, hands) for name, hands in sorted(seen.items())}


def hands_in(
    recording: Recording, name: str | None = None, left_prefix: str = "", right_prefix: str = ""
) -> tuple[Hand, list[Array]]:
    """The hand of that name or file, by default the largest bundled one that fits the labels behind
    their prefixes, and `[T, M]` visible of each side that is there.

    Raises:
        ValueError: no hand is there, or not all of the one that was named.
    """
    known = set(recording.names)
    candidates = [load_hand(name)] if name else sorted(map(load_hand, bundled()), key=len)[::-1]
    for hand in candidates:
        sides = [[p + m for m in hand.markers] for p in dict.fromkeys((left_prefix, right_prefix))]
        # `select` says what is missing of a hand that was named and is there in part.
        there = [own for own in sides if known >= set(own) or (name and known & set(own))]
        if there:
            return hand, [recording.select(own).visible for own in there]
    text = (
        f"{recording.source}: no hand fits the labels {', '.join(recording.names)}: name one with "
        "--hand, its prefixes with --left-prefix and --right-prefix, or rename with --map"
    )
    raise ValueError("; ".join([text, *advice(recording.names)]))


def print_tables(tables: Mapping[str, Occlusions], console: Console) -> None:
    """All figures, a column for each table."""
    some = next(iter(tables.values()))
    longest = max(len(table.histogram) for table in tables.values())
    parts: list[tuple[str, Iterable[object], str]] = [
        ("markers hidden at once", range(len(some.hidden)), "hidden"),
        ("marker missing", some.markers, "missing"),
        ("gaps: quantile", QUANTILES, "lengths"),
        ("missing frames: gap quantile", QUANTILES, "weighted"),
        ("gaps of so many frames", bins(longest), "histogram"),
    ]
    for title, names, field in parts:
        printed = Table(title, box=SIMPLE_HEAD, padding=(0, 1), show_edge=False)
        for name in tables:
            printed.add_column(name, justify="right")
        for i, row in enumerate(names):
            printed.add_row(str(row), *(_cell(table, field, i) for table in tables.values()))
        console.print(printed)
    for name, table in tables.items():
        mean, seconds = sum(table.missing) / len(table.missing), table.frames / table.rate
        console.print(f"{name}: {seconds:.0f} s, {table.gaps} gaps, {100 * mean:.2f} % missing")


def _cell(table: Occlusions, field: str, index: int) -> str:
    value = (*getattr(table, field), 0)[min(index, len(getattr(table, field)))]
    if field == "histogram":
        return str(value)
    return (
        f"{100 * value:.2f} %" if field in ("hidden", "missing") else f"{value / table.rate:.3f} s"
    )


def bins(count: int) -> list[str]:
    """Names of the first bins of `Occlusions.histogram`: `1-1`, `2-3`, `4-7`, …"""
    return [f"{2**i}-{2 ** (i + 1) - 1}" for i in range(count)]


def _keys(name: str, count: int) -> list[str]:
    return bins(count) if name == "histogram" else [str(quantile) for quantile in QUANTILES]


def _check(name: str, fits: bool, expected: str, found: object) -> None:
    if not fits:
        raise ValueError(f"{name}: expected {expected}, found {found!r}")


def _check_keys(what: str, data: Any, known: Collection[str]) -> None:
    _check(what, isinstance(data, dict), "a JSON object", data)
    lacking, surplus = sorted(set(known) - set(data)), sorted(set(data) - set(known))
    _check(what, not lacking + surplus, f"the entries {', '.join(known)}", sorted(data))


def _number(name: str, value: Any, of: type) -> Any:
    """One value of a kind; in Python true is an integer."""
    fits = isinstance(value, (int, float) if of is float else of) and not isinstance(value, bool)
    fits = fits and (isinstance(value, str) or abs(value) <= LARGEST)  # of NaN false
    _check(name, fits, {str: "a string", int: "a whole number"}.get(of, "a number"), value)
    return of(value)
