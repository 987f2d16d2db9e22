"""Damaged files and what reading them must do: see `fuzz.py`.

A damage is a name and two numbers, so that a search can shrink it. Files to begin with lie in
`tests/corpus`, called `READER.WHAT.SUFFIX`; those called `valid` are whole.
"""

from __future__ import annotations

import hashlib
import json
import re
import resource
import sys
import time
import warnings
import zipfile
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from numpy_infer import model as models
from numpy_infer import wearer
from numpy_infer.formats.authors import HandCsv, read_hand_csv
from numpy_infer.formats.authors_nets import read_bin
from numpy_infer.formats.table import LARGEST, RATES
from numpy_infer.hand import Hand, load_hand
from numpy_infer.model import Model
from numpy_infer.recordings import Recording, load_label_map, read

CORPUS = Path(__file__).resolve().parents[1] / "tests" / "corpus"

READERS: dict[str, Callable[[Path], Any]] = {
    "trc": lambda path: read(path, format="trc"),
    "qualisys": lambda path: read(path, format="qualisys"),
    "plain_csv": lambda path: read(path, format="plain_csv"),
    "motive": lambda path: read(path, format="motive"),
    "authors": lambda path: read(path, format="authors"),
    "bvh": lambda path: read(path, format="bvh", unit=0.01),
    "by_suffix": read,
    "hand_csv": read_hand_csv,
    "net": read_bin,
    "hand": load_hand,
    "calibration": wearer.load,
    "labels": load_label_map,
    "model": models.load,
}

SLOW = 2.0
"""Seconds: no small file takes longer, unless it makes its reader do more than its size."""

MEMORY = 2 << 30
"""Bytes of address space beyond what is taken: more is a promise that was believed."""


# -- laws ---------------------------------------------------------------------------------------


def outcome(reader: str, path: Path) -> str:
    """What is said of a file: the refusal, or nothing where it is read.

    Raises:
        AssertionError: it is not refused as files are, or what was read is not consistent.
    """
    began = time.perf_counter()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            found = READERS[reader](path)
    except ValueError as error:
        message = str(error)
        if path.name not in message or len(message) > 4000:
            raise AssertionError(f"names no file, or is endless: {message[:200]!r}") from error
    except Exception as error:
        raise AssertionError(f"{type(error).__name__}: {error}"[:300]) from error
    else:
        message = ""
        check(found)
    if time.perf_counter() - began > SLOW:
        raise AssertionError(f"took {time.perf_counter() - began:.1f} s")
    return message


def check(found: Any) -> None:
    """What holds of whatever was read.

    Raises:
        AssertionError: it does not.
    """
    if isinstance(found, Recording):
        assert RATES[0] <= found.rate <= RATES[1], "rate"
        assert (np.abs(found.time) <= max(LARGEST, 1 / RATES[0])).all(), "time"
        assert len(set(found.names)) == len(found.names), "names"
        hidden = np.isnan(found.markers)
        assert (hidden.all(-1) == hidden.any(-1)).all(), "a marker half hidden"
        assert np.isfinite(found.markers[~hidden]).all(), "markers"
        if found.joints is not None:
            turns = found.joints.rotations[np.isfinite(found.joints.positions).all(-1)]
            # An angle of 10¹⁵ degrees is a rotation still.
            assert np.abs(turns @ turns.swapaxes(-1, -2) - np.eye(3)).max(initial=0) < 1e-6
    elif isinstance(found, wearer.Wearer):
        assert found.flat is None or np.isfinite(found.flat).all(), "flat"
        check(found.hand)
    elif isinstance(found, Hand):
        assert np.isfinite(found.template).all(), "template"
        json.dumps(found.to_json(), allow_nan=False)
    elif isinstance(found, HandCsv):
        assert np.isfinite(found.markers).all(), "markers"
        assert np.isfinite(found.joints).all(), "joints"
    elif isinstance(found, Model):
        json.dumps(dict(found.training), allow_nan=False)
        check(found.hand)


def fingerprint(model: Model) -> str:
    """Of every field that a file holds, bit for bit."""
    plain = [model.hand.to_json(), model.predictor, model.joints, model.fade, model.continuity]
    plain.extend(getattr(model, name) for name in models.ERROR_NUMBERS)
    digest = hashlib.sha256(json.dumps([*plain, dict(model.training)], sort_keys=True).encode())
    arrays = {"expected_error": np.asarray(model.expected_error), "factors": model.error_factors}
    for name in ("marker_network", "joint_network"):
        network = getattr(model, name)
        if network is not None:
            digest.update(repr((name, network.spec)).encode())
            arrays |= {f"{name}/{k}": v for k, v in models._parts(network).items()}
    for name in sorted(arrays):
        array = arrays[name]
        digest.update(f"{name} {array.dtype.str} {array.shape}".encode() + array.tobytes())
    return digest.hexdigest()


# -- damage -------------------------------------------------------------------------------------

NUMBERS = (
    *(b"nan", b"inf", b"-Infinity", b"NaN", b"1e400", b"-1e400", b"1e300", b"5e-324", b"1e-320"),
    *(b"", b"-0", b"-1", b"0.5", b"1000000000", b"1_0", b"0x10", b"1e", b"--1", b"\xc2\xb2"),
    *(b"9" * 400, b"9" * 5000, b"0." + b"0" * 5000 + b"1", b"null", b"true", b"[]", b'"1"'),
)

Damage = tuple[str, int, int]
"""A name in `DAMAGES` and two numbers, 0 to 65535: where, and what."""


def _at(content: bytes, where: int) -> int:
    return where * len(content) >> 16


def _lines(change: Callable[[list[bytes], int, int], Any]) -> Callable[[bytes, int, int], bytes]:
    def run(content: bytes, where: int, what: int) -> bytes:
        lines = content.split(b"\n")
        change(lines, where * len(lines) >> 16, what * len(lines) >> 16)
        return b"\n".join(lines)

    return run


def _swap(lines: list[bytes], one: int, other: int) -> None:
    lines[one], lines[other] = lines[other], lines[one]


def _flip(content: bytes, where: int, what: int) -> bytes:
    damaged = bytearray(content)
    if damaged:
        damaged[_at(content, where)] ^= 1 + what % 255
    return bytes(damaged)


def _number(content: bytes, where: int, what: int) -> bytes:
    spans = [m.span() for m in re.finditer(rb"-?\d+(\.\d*)?", content)]
    if not spans:
        return content
    begin, end = spans[where * len(spans) >> 16]
    return content[:begin] + NUMBERS[what % len(NUMBERS)] + content[end:]


def _word(content: bytes, where: int, what: int) -> bytes:
    """One word where another stood: names, keys and delimiters change places."""
    words = [m.span() for m in re.finditer(rb"\w+|\W", content)]
    if not words:
        return content
    begin, end = words[where * len(words) >> 16]
    other = slice(*words[what * len(words) >> 16])
    return content[:begin] + content[other] + content[end:]


ODD = (
    *(b"\x00", b"\xff", b"\xe9", b"\xef\xbb\xbf", b"\r", b"\r\n", b'"', b"#", b":", b"_", b"\x1a"),
    *(b"\xc2\x85", b"\xe2\x80\xa8", b",", b"\t", b" ", b"{", b"}", b"[", b"\\", b"\xed\xa0\x80"),
    *(b"," * 3000, b"\t" * 3000, b"[" * 3000, b'{"a":' * 3000, b"\n" * 3000, b"\xd9\xa3"),
    *(b"JOINT a\n{\n", b"ROOT b\n{\n", b"End Site\n{\n", b"}\n", b"CHANNELS 1 Xrotation\n"),
)

DAMAGES: dict[str, Callable[[bytes, int, int], bytes]] = {
    "flip": _flip,
    "insert": lambda c, a, b: c[: _at(c, a)] + ODD[b % len(ODD)] + c[_at(c, a) :],
    "cut": lambda c, a, b: c[: _at(c, a)],
    "cut out": lambda c, a, b: c[: _at(c, a)] + c[_at(c, a) + 1 + b % 40 :],
    "double": lambda c, a, b: c[: _at(c, a)] + c[max(0, _at(c, a) - b % 400) :],
    "number": _number,
    "word": _word,
    "drop line": _lines(lambda lines, one, other: lines.pop(one)),
    "double line": _lines(lambda lines, one, other: lines.insert(other, lines[one])),
    "many lines": _lines(lambda lines, one, other: lines.extend([lines[one]] * 1000)),
    "swap lines": _lines(_swap),
    "BOM": lambda c, a, b: b"\xef\xbb\xbf" + c,
    "CRLF": lambda c, a, b: c.replace(b"\n", b"\r\n"),
    "no line ends": lambda c, a, b: c.replace(b"\n", b" "),
    "other delimiter": lambda c, a, b: c.replace(b"\t", b",") if a % 2 else c.replace(b",", b"\t"),
    "UTF-16": lambda c, a, b: c.decode("latin-1").encode("utf-16"),
}


LONGEST = 200_000
"""Bytes: damage that multiplies a file stops here."""


def damaged(content: bytes, damages: Iterable[Damage]) -> bytes:
    """The content with one damage after the other."""
    for name, where, what in damages:
        content = DAMAGES[name](content, where, what)[:LONGEST]
    return content


def some_damages(rng: np.random.Generator) -> list[Damage]:
    names = list(DAMAGES)
    count = rng.integers(1, 5)
    return [
        (names[rng.integers(len(names))], *(int(n) for n in rng.integers(0, 1 << 16, 2)))
        for _ in range(count)
    ]


def whole_files() -> dict[str, Path]:
    """For each reader a whole file, the smallest that has everything."""
    return {path.name.partition(".")[0]: path for path in sorted(CORPUS.glob("*.valid.*"))}


# -- model files --------------------------------------------------------------------------------


def places(path: Path) -> tuple[list[range], list[range]]:
    """Bytes where a model file keeps its books: the archive's own, local headers first; and the
    headers of its arrays."""
    with zipfile.ZipFile(path) as archive:
        starts = [info.header_offset for info in archive.infolist()]
        books, headers = [], []
        content = path.read_bytes()
        for start in starts:
            name, extra = (
                int.from_bytes(content[start + i : start + i + 2], "little") for i in (26, 28)
            )
            begin = start + 30 + name + extra
            books.append(range(start, begin))
            headers.append(range(begin, begin + 128))
        books.append(range(archive.start_dir, len(content)))
    return books, headers


def structural(content: bytes, books: list[range], headers: list[range]) -> Iterator[bytes]:
    """A file of stored parts damaged at every place that has a meaning: each byte changed in four
    ways, everything cut and doubled at each border, parts in another order."""
    for spot in (i for part in (*books, *headers) for i in part):
        for value in (content[spot] ^ 1, content[spot] ^ 128, 0, 255):
            yield content[:spot] + bytes([value]) + content[spot + 1 :]
    borders = sorted({i for part in (*books, *headers) for i in (part.start, part.stop)})
    for border in borders:
        for shift in (-1, 0, 1):
            yield content[: border + shift]
            yield content[border + shift :]
            yield content[: border + shift] + b"\x00" + content[border + shift :]
            yield content[: border + shift] + content[border + shift + 1 :]
    for one, two, three in zip(borders, borders[1:], borders[2:], strict=False):
        yield content[:one] + content[two:three] + content[one:two] + content[three:]
        yield content[:two] + content[one:]
    for tail in (b"\x00", b"PK\x05\x06", content[books[-1].start :], content):
        yield content + tail
        yield tail + content


def repacked(path: Path, members: dict[str, bytes]) -> None:
    """An archive of these parts, with checksums that fit."""
    with zipfile.ZipFile(path, "w") as archive:
        for name, part in members.items():
            archive.writestr(name, part)


def refused_or_same(path: Path, original: str) -> bool:
    """True if a model file is refused.

    Raises:
        AssertionError: it is read as another model, or as `outcome`.
    """
    if outcome("model", path):
        return True
    if fingerprint(models.load(path)) != original:
        raise AssertionError("another model")
    return False


def damaged_models(name: str, count: int, seed: int, folder: Path) -> bool:
    """A bundled model with one byte after the other changed, a small one damaged at every place
    that has a meaning, and one whose parts are damaged in an archive that is whole."""
    limit_memory()
    rng = np.random.default_rng(seed)
    bundled = Path(str(models.WEIGHTS / f"{name}.npz"))
    small = whole_files()["model"]
    with zipfile.ZipFile(small) as archive:
        members = {part: archive.read(part) for part in archive.namelist()}

    def bytes_changed() -> Iterator[None]:
        content = bundled.read_bytes()
        path.write_bytes(content)
        with path.open("r+b") as file:
            for spot in rng.integers(0, len(content), count):
                for value in (content[spot] ^ int(rng.integers(1, 256)), content[spot]):
                    file.seek(int(spot))
                    file.write(bytes([value]))
                    file.flush()
                    if value != content[spot]:
                        yield

    def at_every_place() -> Iterator[None]:
        for content in structural(small.read_bytes(), *places(small)):
            path.write_bytes(content)
            yield

    def parts_damaged() -> Iterator[None]:
        for _ in range(count):
            chosen = list(members)[rng.integers(len(members))]
            repacked(path, members | {chosen: damaged(members[chosen], some_damages(rng))})
            yield

    whole, path = True, folder / "model.npz"
    for what, source, cases in (
        ("bytes changed", bundled, bytes_changed()),
        ("at every place", small, at_every_place()),
        ("parts damaged", small, parts_damaged()),
    ):
        original = fingerprint(models.load(source))
        began, refused, done = time.perf_counter(), 0, 0
        broken = ""
        for done, _ in enumerate(cases, 1):
            try:
                refused += refused_or_same(path, original)
            except AssertionError as error:
                broken, whole = f"  BROKEN in case {done}: {error}", False
                break
        seconds = time.perf_counter() - began
        print(
            f"model files, {what}: {done:,} damaged, {refused:,} refused, {done - refused:,} read "
            f"as before, {seconds:.0f} s, {peak():.0f} MB{broken}",
            flush=True,
        )
    return whole


# -- readers ------------------------------------------------------------------------------------


def damaged_readers(count: int, seed: int, folder: Path) -> bool:
    """Each reader's whole file, damaged over and over."""
    limit_memory()
    whole = True
    for reader, source in whole_files().items():
        rng, content = np.random.default_rng(seed), source.read_bytes()
        began, refused, broken, i = time.perf_counter(), 0, "", 0
        path = folder / f"take{source.suffix}"
        while i < count:
            i, damages = i + 1, some_damages(rng)
            path.write_bytes(damaged(content, damages))
            try:
                refused += bool(outcome(reader, path))
            except AssertionError as error:
                broken, whole = f"  BROKEN by {damages}: {error}", False
                break
        print(
            f"{reader:12} {i:,} damaged, {refused:,} refused, {i - refused:,} read, "
            f"{time.perf_counter() - began:.0f} s, {peak():.0f} MB{broken}",
            flush=True,
        )
    return whole


def steered_readers(count: int, seed: int, folder: Path) -> None:
    """All readers under atheris (libFuzzer), from the corpus on; a file's first byte tells which
    reader gets the rest. Ends the process."""
    import atheris

    atheris.instrument_all()
    names = list(READERS)
    start = folder / "start"
    start.mkdir()
    for i, path in enumerate(sorted(CORPUS.iterdir())):
        index = names.index(path.name.partition(".")[0])
        if path.stat().st_size < 20_000:
            (start / str(i)).write_bytes(bytes([index]) + path.read_bytes())
    suffixes = {reader: path.suffix for reader, path in whole_files().items()}

    def one(data: bytes) -> None:
        reader = names[data[0] % len(names)] if data else names[0]
        path = folder / f"take{suffixes[reader]}"
        path.write_bytes(data[1:])
        outcome(reader, path)

    options = [f"-runs={count}", f"-seed={seed + 1}", "-max_len=20000", "-timeout=20"]
    options += ["-rss_limit_mb=4096", "-print_final_stats=1"]
    atheris.Setup([sys.argv[0], *options, str(start)], one)
    atheris.Fuzz()


def limit_memory() -> None:
    """From here on a promise of gigabytes that is believed is a MemoryError."""
    taken = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (taken + MEMORY, resource.RLIM_INFINITY))


def peak() -> float:
    """MB: the most memory that this process has had."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
