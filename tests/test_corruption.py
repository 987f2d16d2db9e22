"""Damaged files: refused in one sentence that names them, at no cost, or read as what they are."""

from __future__ import annotations

import importlib
import json
import struct
import sys
import time
import tracemalloc
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import REPOSITORY
from hypothesis import given, settings
from hypothesis import strategies as st

from numpy_infer import hand, recordings
from numpy_infer import model as models
from numpy_infer.recordings import read

sys.path.append(str(REPOSITORY / "experiments"))
files = importlib.import_module("fuzz_files")

WHOLE: dict[str, Path] = files.whole_files()
CORPUS = sorted(files.CORPUS.iterdir())


def damages() -> st.SearchStrategy[list[Any]]:
    number = st.integers(0, (1 << 16) - 1)
    return st.lists(st.tuples(st.sampled_from(sorted(files.DAMAGES)), number, number), max_size=4)


@contextmanager
def cheaply(megabytes: float = 16, seconds: float = 3) -> Iterator[None]:
    """Less memory and time than this."""
    began = time.perf_counter()
    tracemalloc.start()
    try:
        yield
        assert tracemalloc.get_traced_memory()[1] < megabytes * (1 << 20)
    finally:
        tracemalloc.stop()
    assert time.perf_counter() - began < seconds


# -- every reader -------------------------------------------------------------------------------


def test_there_is_a_whole_file_for_every_reader() -> None:
    assert WHOLE.keys() == files.READERS.keys()
    assert sum(path.stat().st_size for path in CORPUS) < 100_000


@pytest.mark.parametrize("path", CORPUS, ids=lambda path: path.name)
def test_whole_files_are_read_and_broken_ones_refused(path: Path) -> None:
    """What once went wrong in another way stays among these."""
    reader, what, _ = path.name.split(".")
    with cheaply():
        refusal = files.outcome(reader, path)
    assert (refusal == "") == (what == "valid"), refusal


@pytest.mark.parametrize("reader", WHOLE)
@settings(max_examples=60)
@given(damages=damages())
def test_a_damaged_file_is_refused_or_consistent(
    reader: str, damages: list[Any], tmp_path_factory: pytest.TempPathFactory
) -> None:
    source = WHOLE[reader]
    path = tmp_path_factory.getbasetemp() / f"take{source.suffix}"
    path.write_bytes(files.damaged(source.read_bytes(), damages))
    files.outcome(reader, path)


def test_the_laws_can_fail(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(path: Path) -> None:
        raise ValueError("something is wrong")

    def broken(path: Path) -> None:
        raise KeyError(path.name)

    for name, reader in (("refused", refused), ("broken", broken)):
        monkeypatch.setitem(files.READERS, name, reader)
        with pytest.raises(AssertionError, match=r"names no file|KeyError"):
            files.outcome(name, tmp_path / "take.trc")
    half = read(WHOLE["trc"])
    half.markers[0, 0, 0] = np.nan
    with pytest.raises(AssertionError, match="half hidden"):
        files.check(half)


# -- promises -----------------------------------------------------------------------------------


def a_wide_table(suffix: str, columns: int) -> tuple[str, str]:
    """Head of a file of this many markers, and a line that has no cells for them."""
    names = [f"m{i}" for i in range(columns)]
    if suffix == "trc":
        keys = "DataRate\tNumFrames\tNumMarkers\tUnits"
        labels = "Frame#\tTime\t" + "\t\t\t".join(names)
        return f"PathFileType\n{keys}\n100\t9\t{columns}\tmm\n{labels}\n\t\n", "1\t0\n"
    if suffix == "tsv":
        head = f"NO_OF_FRAMES\t9\nNO_OF_MARKERS\t{columns}\nFREQUENCY\t100\n"
        return head + "\t".join(["MARKER_NAMES", *names]) + "\nFrame\tTime\n", "1\t0\n"
    cells = [f"{name}.{axis}" for name in names for axis in "xyz"]
    return "# unit: m\n" + ",".join(["time", *cells]) + "\n", "0\n"


@pytest.mark.parametrize("suffix", ["trc", "tsv", "csv"])
def test_a_table_of_a_billion_cells_is_not_believed(suffix: str, tmp_path: Path) -> None:
    head, row = a_wide_table(suffix, 20_000)
    path = tmp_path / f"take.{suffix}"
    path.write_text(head + row * 20_000)
    with (
        cheaply(64, 5),
        pytest.raises(ValueError, match=r"take\.\w+:\d+: expected \d+ columns, found"),
    ):
        read(path)


@pytest.mark.parametrize("suffix", ["trc", "tsv", "csv"])
def test_a_wide_table_is_read_in_the_time_of_its_size(suffix: str, tmp_path: Path) -> None:
    head, row = a_wide_table(suffix, 20_000)
    delimiter = "," if suffix == "csv" else "\t"
    path = tmp_path / f"take.{suffix}"
    rows = [f"{row[:-1]}{f'{delimiter}1' * 60_000}\n", f"1{f'{delimiter}1' * 60_000}"]
    if suffix != "csv":
        rows[1] += "\t1"
    head = head.replace("\t9\t", "\t2\t").replace("FRAMES\t9", "FRAMES\t2")
    path.write_text(head + "".join(rows) + "\n")
    with cheaply(256, 5):
        assert len(read(path).names) == 20_000


def test_a_million_trailing_tabs_are_nothing(tmp_path: Path) -> None:
    text = WHOLE["qualisys"].read_text().replace("\ta\tb", "\ta\tb" + "\t" * 1_000_000)
    (tmp_path / "take.tsv").write_text(text)
    with cheaply(256, 5):
        assert read(tmp_path / "take.tsv").names == ("a", "b")


def test_a_bvh_of_stiff_joints_takes_no_more_memory_than_it_is_long(tmp_path: Path) -> None:
    joints = "".join(f"ROOT j{i}\n{{\nOFFSET 0 0 0\n}}\n" for i in range(5000))
    one = "ROOT a\n{\nOFFSET 0 0 0\nCHANNELS 1 Xrotation\n}\n"
    motion = "MOTION\nFrames: 5000\nFrame Time: 0.01\n" + "0\n" * 5000
    path = tmp_path / "take.bvh"
    path.write_text(f"HIERARCHY\n{one}{joints}{motion}")
    with cheaply(64, 5), pytest.raises(ValueError, match="5001 joints and only 1 channels"):
        read(path, unit=0.01)


def test_a_deep_bvh_is_read_in_the_time_of_its_size(tmp_path: Path) -> None:
    depth = 2000
    inner = "".join(
        f"JOINT j{i}\n{{\nOFFSET 0 0 1\nCHANNELS 1 Xrotation\n" for i in range(1, depth)
    )
    head = f"HIERARCHY\nROOT j0\n{{\nOFFSET 0 0 0\nCHANNELS 1 Xrotation\n{inner}" + "}\n" * depth
    path = tmp_path / "take.bvh"
    path.write_text(f"{head}MOTION\nFrames: 1\nFrame Time: 0.01\n{'1 ' * depth}\n")
    with cheaply(64, 5):
        assert len(read(path, unit=0.01).names) == depth


@pytest.mark.parametrize("reader", ["hand", "calibration", "labels"])
@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"[" * 100_000, "nested too deep"),
        (b"[" + b"[]," * 500_000 + b"[]]", "more than 1 MB"),
        (b'{"a": "b", "a": "c"}', "duplicate entry 'a'"),
        (b'{"a": "\xff"}', "not UTF-8 text"),
        (b'{"a": ' + b"9" * 5000 + b"}", "digits"),
    ],
)
def test_json_that_is_not_ours(reader: str, content: bytes, message: str, tmp_path: Path) -> None:
    path = tmp_path / "mine.json"
    path.write_bytes(content)
    with cheaply(), pytest.raises(ValueError, match=rf"mine\.json.*{message}"):
        files.READERS[reader](path)


def test_json_may_have_a_byte_order_mark(tmp_path: Path) -> None:
    path = tmp_path / "mine.json"
    path.write_bytes(b"\xef\xbb\xbf" + WHOLE["hand"].read_bytes())
    assert hand.load_hand(path).to_json() == hand.load_hand(WHOLE["hand"]).to_json()


def test_a_refusal_is_short_whatever_stands_in_the_file(tmp_path: Path) -> None:
    path = tmp_path / "take.trc"
    path.write_text(WHOLE["trc"].read_text().replace("mm", "m" * 100_000))
    with pytest.raises(ValueError, match="unknown unit") as caught:
        read(path)
    assert len(str(caught.value)) < 2000


@pytest.mark.parametrize(
    ("old", "new"), [("\t100\t", "\t1e-300\t"), ("\t100\t", "\t1e300\t"), ("0.01\t", "1e300\t")]
)
def test_rates_and_times_that_would_overflow_are_refused(
    old: str, new: str, tmp_path: Path
) -> None:
    path = tmp_path / "take.trc"
    path.write_text(WHOLE["trc"].read_text().replace("100\t100", "\t100\t"[1:] + "100"))
    path.write_text(path.read_text().replace(old.lstrip("\t"), new.lstrip("\t"), 1))
    assert "no frame rate" in files.outcome("trc", path) or "time is" in files.outcome("trc", path)


def test_steps_of_no_time_make_no_rate() -> None:
    assert recordings.median_rate(np.array([0, 1e-320, 0.01, 0.01 + 1e-12]), "x") < 101


# -- model files --------------------------------------------------------------------------------


@pytest.fixture
def path(tmp_path: Path) -> Path:
    path = tmp_path / "model.npz"
    path.write_bytes(WHOLE["model"].read_bytes())
    return path


ORIGINAL = files.fingerprint(models.load(WHOLE["model"]))


def test_the_bundled_models_are_told_apart_by_their_fingerprints() -> None:
    prints = {files.fingerprint(models.load(name)) for name in models.bundled()}
    assert len(prints | {ORIGINAL}) == len(models.bundled()) + 1


def test_damage_at_a_place_that_means_something_is_refused_or_means_nothing(path: Path) -> None:
    """A share of all such places; the whole takes a minute (`experiments/fuzz.py --files`)."""
    cases = files.structural(path.read_bytes(), *files.places(path))
    refused = []
    for content in islice(cases, 0, None, 9):
        path.write_bytes(content)
        refused.append(files.refused_or_same(path, ORIGINAL))
    assert len(refused) > 1000
    assert len(refused) / 2 < sum(refused) < len(refused)


@settings(max_examples=100)
@given(data=st.data(), damages=damages())
def test_damaged_parts_in_a_whole_archive_are_refused_or_the_same(
    data: st.DataObject, damages: list[Any], tmp_path_factory: pytest.TempPathFactory
) -> None:
    members = parts(WHOLE["model"])
    chosen = data.draw(st.sampled_from(sorted(members)))
    path = tmp_path_factory.getbasetemp() / "model.npz"
    files.repacked(path, members | {chosen: files.damaged(members[chosen], damages)})
    files.refused_or_same(path, ORIGINAL)


def parts(path: Path) -> dict[str, bytes]:
    with zipfile.ZipFile(path) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def test_the_order_of_the_parts_does_not_matter(path: Path) -> None:
    members = parts(path)
    files.repacked(path, dict(reversed(members.items())))
    assert files.refused_or_same(path, ORIGINAL) is False


def test_a_part_that_unpacks_to_more_than_it_says_is_not_unpacked(path: Path) -> None:
    """The honest bomb is refused by its size; this one's books say that it is small."""
    members = parts(path)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members.items():
            bomb = name == "marker_network/0.bias.npy"
            archive.writestr(name, content + bytes(64 << 20 if bomb else 0))
    content = path.read_bytes()
    long = len(members["marker_network/0.bias.npy"])
    size = (long + (64 << 20)).to_bytes(4, "little")
    assert content.count(size) == 2  # in the local header and in the directory
    path.write_bytes(content.replace(size, long.to_bytes(4, "little")))
    with cheaply(8), pytest.raises(ValueError, match=r"model\.npz: not a model file"):
        models.load(path)


def test_a_directory_of_a_million_parts_is_not_made_into_objects(path: Path) -> None:
    with zipfile.ZipFile(path, "a") as archive:
        for i in range(5000):
            archive.writestr(f"{i:050}.npy", b"")
    with cheaply(2), pytest.raises(ValueError, match=r"lists 50\d\d parts in"):
        models.load(path)


def test_a_second_directory_is_not_followed(path: Path) -> None:
    content = path.read_bytes()
    end = content[-22:]
    place = int.from_bytes(end[16:20], "little")
    second = struct.pack("<4sQ2H2L4Q", b"PK\6\6", 44, 45, 45, 0, 0, 9, 9, 1 << 40, 0)
    locator = struct.pack("<4sLQL", b"PK\6\7", 0, len(content) - 22, 1)
    longer = len(content) - 22 + len(second) + len(locator) - place
    path.write_bytes(
        content[:-22] + second + locator + end[:12] + longer.to_bytes(4, "little") + end[16:]
    )
    with cheaply(1), pytest.raises(ValueError, match="has a second directory"):
        models.load(path)


def test_a_header_too_long_to_be_read_back_is_not_written(path: Path) -> None:
    model = replace(models.load(path), training={"notes": "x" * models.HEADER_LIMIT})
    with pytest.raises(ValueError, match="expected at most"):
        models.save(model, path.with_name("other.npz"))
    assert not path.with_name("other.npz").exists()


@pytest.mark.parametrize("size", [65 << 20, 1 << 40])
def test_a_file_too_large_is_not_read(size: int, path: Path) -> None:
    with path.open("r+b") as file:
        file.truncate(size)  # sparse: it takes no room
    with cheaply(1), pytest.raises(ValueError, match="larger than 64 MB"):
        models.load(path)


EVIL = {
    "an expression": b"__import__('os').getcwd()",
    "deep": b"(" * 5000,
    "Python 2": b"{'descr': '<f4', 'fortran_order': False, 'shape': (2L,), }",
    "strange keys": b"{1: 2, 'descr': '<f4'}",
    "strange escape": b"{'descr': '<f4\\d', 'fortran_order': False, 'shape': (2,), }",
    "a shape twice": b"{'descr': '<f4', 'shape': (3,), 'fortran_order': False, 'shape': (2,), }",
    "a pickle": b"{'descr': '|O', 'fortran_order': False, 'shape': (2,), }",
    "a record": b"{'descr': [('a', '<f4')], 'fortran_order': False, 'shape': (2,), }",
    "a huge number": b"{'descr': '<f4', 'fortran_order': False, 'shape': ("
    + b"9" * 5000
    + b",), }",
    "a negative number": b"{'descr': '<f4', 'fortran_order': False, 'shape': (-2,), }",
    "a number of no type": b"{'descr': '<f99', 'fortran_order': False, 'shape': (2,), }",
    "one byte too few": b"{'descr': '<f4', 'fortran_order': False, 'shape': (2,), } ",
}


@pytest.mark.parametrize("what", EVIL)
@pytest.mark.parametrize("part", ["marker_network/0.bias.npy", "header.npy", "expected_error.npy"])
def test_an_arrays_header_is_read_and_never_run(what: str, part: str, path: Path) -> None:
    header = EVIL[what] + b"\n"
    magic = b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little")
    body = bytes(7 if what == "one byte too few" else 8)
    files.repacked(path, parts(path) | {part: magic + header + body})
    with cheaply(4):
        assert files.refused_or_same(path, ORIGINAL)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (b'"seed": 0', b'"seed": NaN', "NaN is no finite number"),
        (b'"seed": 0', b'"seed": -Infinity', "-Infinity is no finite number"),
        (b'"seed": 0', b'"seed": 1e400', "1e400 is no finite number"),
        (b'"seed": 0', b'"seed": ' + b"9" * 5000, "digits"),
        (b'"seed": 0', b'"seed": 1, "seed": 0', "duplicate entry 'seed'"),
        (b'"seed": 0', b'"seed": ' + b"[" * 50_000, "nested too deep"),
        (b'"seed": 0', b'"seed": "' + b"x" * (1 << 20) + b'"', "expected at most"),
        (b'"units": 2,', b'"units": 1000000000,', "expected 1 to 65536 units"),
        (b'"units": 2,', b'"units": 1e9,', "expected 1 to 65536 units"),
        (b'"units": 2,', b'"units": true,', "expected 1 to 65536 units"),
    ],
)
def test_json_that_no_model_has(old: bytes, new: bytes, message: str, path: Path) -> None:
    members = parts(path)
    text = np.frombuffer(members["header.npy"], np.uint8, offset=128).tobytes()
    assert text.count(old) == 1
    text = text.replace(old, new)
    header = f"{{'descr': '|u1', 'fortran_order': False, 'shape': ({len(text)},), }}"
    padded = header.encode().ljust(117) + b"\n"
    npy = b"\x93NUMPY\x01\x00" + len(padded).to_bytes(2, "little") + padded + text
    files.repacked(path, members | {"header.npy": npy})
    with cheaply(24), pytest.raises(ValueError, match=rf"model\.npz: .*{message}"):
        models.load(path)


def test_white_space_in_the_header_means_nothing(path: Path) -> None:
    members = parts(path)
    text = json.dumps(json.loads(members["header.npy"][128:])).encode()
    header = f"{{'descr': '|u1', 'fortran_order': False, 'shape': ({len(text)},), }}\n".encode()
    npy = b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header + text
    files.repacked(path, members | {"header.npy": npy})
    assert files.refused_or_same(path, ORIGINAL) is False
