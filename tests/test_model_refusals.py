"""Model files that are none: nothing is believed that a file states."""

from __future__ import annotations

import io
import json
import os
import tracemalloc
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from model_files import array_of, assert_same, unpack
from numpy.lib.format import write_array_header_1_0
from streams import a_model

from numpy_infer import model as module
from numpy_infer.model import Model, load, save
from numpy_infer.networks import Dense

Array = np.ndarray


# -- refusals: a file taken apart, changed and put together again --------------------------------


def pack(path: Path, members: dict[str, bytes], method: int = zipfile.ZIP_STORED) -> None:
    with zipfile.ZipFile(path, "w", method) as archive:
        for name, content in members.items():
            archive.writestr(name, content)


def npy(array: Array, *, pickled: bool = False) -> bytes:
    stream = io.BytesIO()
    np.lib.format.write_array(stream, array, allow_pickle=pickled)
    return stream.getvalue()


def with_header(members: dict[str, bytes], change: Callable[[dict[str, Any]], Any]) -> None:
    """Changes the header in place, and its checksum with it: the checksum is no signature."""
    header = json.loads(array_of(members["header.npy"]).tobytes())
    change(header)
    header.pop("checksum", None)
    arrays = {n[:-4]: array_of(c) for n, c in members.items() if n != "header.npy"}
    header["checksum"] = module._checksum(header, arrays)
    members["header.npy"] = npy(np.frombuffer(json.dumps(header).encode(), np.uint8))


KERNEL, BIAS = "marker_network/0.kernel.npy", "marker_network/0.bias.npy"


def drop(name: str) -> Callable[[dict[str, bytes]], Any]:
    return lambda m: m.pop(name)


def put(name: str, array: Array) -> Callable[[dict[str, bytes]], Any]:
    return lambda m: m.update({name: npy(array)})


def change(name: str, function: Callable[[Array], Array]) -> Callable[[dict[str, bytes]], Any]:
    return lambda m: m.update({name: npy(function(array_of(m[name])))})


def head(function: Callable[[dict[str, Any]], Any]) -> Callable[[dict[str, bytes]], Any]:
    return lambda m: with_header(m, function)


def nested(depth: int) -> bytes:
    return npy(np.frombuffer(b"[" * depth, np.uint8))


def layer(**entries: Any) -> Callable[[dict[str, bytes]], Any]:
    return head(lambda h: h["networks"]["marker_network"][0].update(entries))


REFUSED: dict[str, tuple[Callable[[dict[str, bytes]], Any], str]] = {
    "another version": (
        head(lambda h: h.update(version=2)),
        "written in version 2, this program reads version 1",
    ),
    "no version": (head(lambda h: h.pop("version")), "written in version None"),
    "another format": (head(lambda h: h.update(format="zip")), "its header says nothing of"),
    "no header": (drop("header.npy"), "it has no header"),
    "header is no text": (put("header.npy", np.full(9, 255, np.uint8)), "not UTF-8 text"),
    "header is no JSON": (put("header.npy", np.zeros(9, np.uint8)), "not JSON: Expecting"),
    "header is a list": (put("header.npy", np.frombuffer(b"[]", np.uint8)), "not a model file"),
    "header is floats": (put("header.npy", np.zeros(9)), "'header': expected"),
    "header is a scalar": (put("header.npy", np.uint8(3)), "'header': expected shape"),
    "header too deep": (lambda m: m.update({"header.npy": nested(10**5)}), ""),
    "header lacks an entry": (head(lambda h: h.pop("fade")), "damaged header"),
    "header says more": (head(lambda h: h.update(more=1)), "damaged header"),
    "fade is text": (head(lambda h: h.update(fade="1")), "expected 'fade' as float"),
    "fade is nothing": (head(lambda h: h.update(fade=0.0)), "'fade' must be positive"),
    "fade is NaN": (head(lambda h: h.update(fade=float("nan"))), "NaN is no finite number"),
    "predictor is a list": (head(lambda h: h.update(predictor=[])), "expected 'predictor' as str"),
    "training is a list": (head(lambda h: h.update(training=[])), "expected 'training' as dict"),
    "no such joint stage": (head(lambda h: h.update(joints="ik")), "unknown joint stage 'ik'"),
    "networks is a list": (head(lambda h: h.update(networks=[])), "damaged header"),
    "unknown network": (
        head(lambda h: h["networks"].update(pose_network=[{"type": "dense", "units": 1}])),
        "unknown network 'pose_network'",
    ),
    "hand is damaged": (head(lambda h: h["hand"]["markers"].pop()), ""),
    "hand is none": (head(lambda h: h.update(hand=None)), "expected a hand as a JSON object"),
    "unknown layer": (layer(type="gru"), "layer 0: expected a layer of type"),
    "layer of a strange type": (layer(type=["dense"]), "layer 0: expected a layer of type"),
    "a billion units": (layer(units=10**9), "layer 0: expected 1 to 65536 units"),
    "too many units": (layer(units=65536), "expected shape"),
    "missing array": (drop(BIAS), "'marker_network/0.bias' is missing"),
    "extra array": (put("extra.npy", np.zeros(3)), "'extra' is unexpected"),
    "a path outside": (put("../../evil.npy", np.zeros(3)), "evil' is unexpected"),
    "an absolute path": (put("/tmp/evil.npy", np.zeros(3)), "evil' is unexpected"),
    "a folder": (lambda m: m.update({"folder/": b""}), "is unexpected"),
    "transposed": (change(KERNEL, np.transpose), r"0.kernel': expected shape \(27, 32\)"),
    "one axis more": (change(BIAS, lambda a: a[None]), r"0.bias': expected shape \(32,\)"),
    "one number changed": (change(KERNEL, lambda a: a + (a == a[0, 0])), "checksum"),
    "the precision changed": (change(KERNEL, lambda a: a.astype(np.float64)), "checksum"),
    "complex": (change(BIAS, lambda a: a.astype(np.complex64)), "0.bias': expected"),
    "big-endian": (change(BIAS, lambda a: a.astype(">f4")), "0.bias': expected"),
    "no npy": (lambda m: m.update({BIAS: b"bias"}), ""),
    "empty part": (lambda m: m.update({BIAS: b""}), ""),
    "table of no rows": (put("expected_error.npy", np.zeros((0, 6))), "expected_error"),
    "table of other changes": (put("expected_error.npy", np.zeros((4, 5))), "expected_error"),
    "table of NaN": (put("expected_error.npy", np.full((4, 6), np.nan)), "expected_error"),
    "a factor too few": (put("marker_error.npy", np.ones(8)), "marker_error"),
    "a negative factor": (put("marker_error.npy", np.full(9, -1.0)), "marker_error"),
}


@pytest.mark.parametrize("what", REFUSED)
def test_what_is_wrong_in_a_file_is_named(what: str, path: Path) -> None:
    alter, message = REFUSED[what]
    members = unpack(path)
    alter(members)
    pack(path, members)
    with pytest.raises(ValueError, match=r"model\.npz: .*" + message):
        load(path)


def test_arrays_that_are_not_finite_are_refused_even_if_the_checksum_fits(path: Path) -> None:
    members = unpack(path)
    members[BIAS] = npy(np.full(32, np.nan, np.float32))
    with_header(members, lambda h: None)
    pack(path, members)
    with pytest.raises(ValueError, match=r"'0\.bias' is not an array of finite floats"):
        load(path)


class Mischief:
    """Unpickled, it would leave a trace."""

    def __reduce__(self) -> Any:
        return os.mkdir, ("trace-of-a-pickle",)


@pytest.mark.parametrize("name", [BIAS, "header.npy", "expected_error.npy"])
def test_an_object_array_is_refused_and_nothing_in_it_runs(
    name: str, path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(path.parent)
    members = unpack(path)
    shape = array_of(members[name]).shape
    objects = np.full(shape, Mischief(), object)
    members[name] = npy(objects, pickled=True)
    pack(path, members)
    with pytest.raises(ValueError, match=r"model\.npz"):
        load(path)
    assert not Path("trace-of-a-pickle").exists()


@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_a_part_that_stands_twice_is_refused(path: Path) -> None:
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr(BIAS, npy(np.zeros(32, np.float32)))
    with pytest.raises(ValueError, match="a part stands twice"):
        load(path)


def test_a_packed_file_is_read_like_any_other(model: Model, path: Path) -> None:
    pack(path, unpack(path), zipfile.ZIP_DEFLATED)
    assert_same(load(path), model)


@pytest.mark.parametrize("method", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_other_ways_of_packing_are_refused(method: int, path: Path) -> None:
    pack(path, unpack(path), method)
    with pytest.raises(ValueError, match="packed in another way"):
        load(path)


# -- no memory for what a file only claims --------------------------------------------------------


def refused_cheaply(path: Path, message: str) -> None:
    """Refused with less than 8 MB taken."""
    tracemalloc.start()
    try:
        with pytest.raises(ValueError, match=message):
            load(path)
        assert tracemalloc.get_traced_memory()[1] < 8 << 20
    finally:
        tracemalloc.stop()


def claim(shape: tuple[int, ...], dtype: str = "<f4", body: bytes = b"") -> bytes:
    """An npy of this shape, says its header."""
    stream = io.BytesIO()
    write_array_header_1_0(stream, {"descr": dtype, "fortran_order": False, "shape": shape})
    return stream.getvalue() + body


@pytest.mark.parametrize("name", [BIAS, "header.npy", "expected_error.npy"])
@pytest.mark.parametrize("shape", [(10**12,), (2**40, 6), (2**62, 4), (0, 10**15)])
def test_a_shape_is_not_believed(name: str, shape: tuple[int, ...], path: Path) -> None:
    members = unpack(path)
    members[name] = claim(shape, "|u1" if name == "header.npy" else "<f4")
    pack(path, members)
    refused_cheaply(path, r"model\.npz")


@pytest.mark.parametrize("name", [BIAS, KERNEL, "header.npy", "expected_error.npy"])
@pytest.mark.parametrize("megabytes", [5, 80])
def test_a_zip_bomb_is_refused_before_memory_is_spent(
    name: str, megabytes: int, path: Path
) -> None:
    members = unpack(path)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for other, content in members.items():
            if other != name:
                archive.writestr(other, content)
        with archive.open(name, "w") as member:
            member.write(claim((megabytes << 18,)))
            for _ in range(megabytes):
                member.write(bytes(1 << 20))
    refused_cheaply(path, r"model\.npz")


def test_a_hand_and_layers_that_ask_for_too_much_are_refused_cheaply(path: Path) -> None:
    members = unpack(path)
    wide = {"type": "dense", "units": 65536, "activation": "relu"}
    with_header(members, lambda h: h["networks"]["marker_network"].insert(0, wide))
    pack(path, members)
    refused_cheaply(path, "missing|expected shape|unexpected")


# -- no file of ours ----------------------------------------------------------------------------


@pytest.mark.parametrize("content", [b"", b"PK", b"no model", bytes(1000), b"PK\5\6" + bytes(18)])
def test_what_is_no_model_file_is_refused(content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "model.npz"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=r"model\.npz: not a model file"):
        load(path)


def test_a_missing_file_and_a_folder_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no model file"):
        load(tmp_path / "model.npz")
    with pytest.raises(ValueError, match="not a model file"):
        load(tmp_path)


def test_an_npz_of_something_else_is_refused(tmp_path: Path) -> None:
    np.savez(tmp_path / "model.npz", x=np.zeros(3))
    with pytest.raises(ValueError, match="it has no header"):
        load(tmp_path / "model.npz")


# -- damage -------------------------------------------------------------------------------------


def small(tmp_path: Path) -> tuple[Model, Path]:
    """The shortest file that has a network: damage then falls on every kind of byte."""
    model = a_model("learned")
    old = model.marker_network
    assert old is not None
    arrays = {"0.kernel": np.ones((27, 27), np.float32), "0.bias": np.ones(27, np.float32)}
    network = replace(old, spec=(Dense(27, "linear"),), arrays=arrays)
    model = replace(model, marker_network=network)
    save(model, tmp_path / "model.npz")
    return model, tmp_path / "model.npz"


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("packed", [False, True], ids=["stored", "deflated"])
def test_a_flipped_byte_anywhere_is_refused_or_does_not_matter(
    packed: bool, tmp_path: Path
) -> None:
    model, path = small(tmp_path)
    if packed:
        pack(path, unpack(path), zipfile.ZIP_DEFLATED)
    whole = path.read_bytes()
    rng = np.random.default_rng(0)
    # Anywhere, and as often where an archive keeps its own books: local headers and directory.
    books = [i for i in range(len(whole) - 1) if whole[i : i + 2] == b"PK"]
    spots = [int(i) for i in rng.integers(0, len(whole), 100)]
    spots += [min(int(rng.choice(books) + rng.integers(0, 80)), len(whole) - 1) for _ in range(200)]
    survived = 0
    for spot in spots:
        damaged = bytearray(whole)
        damaged[spot] ^= int(rng.choice([1, 2, 4, 8, 16, 32, 64, 128, 255]))
        path.write_bytes(damaged)
        try:
            found = load(path)
        except ValueError:
            continue
        survived += 1
        assert_same(found, model)
    assert survived < len(spots) / 2


def test_a_file_cut_anywhere_is_refused(tmp_path: Path) -> None:
    _, path = small(tmp_path)
    whole = path.read_bytes()
    for length in np.random.default_rng(1).integers(0, len(whole), 100):
        path.write_bytes(whole[:length])
        with pytest.raises(ValueError, match=r"model\.npz: not a model file"):
            load(path)
