"""The model and its file: refused where it does not fit, bit for bit there and back."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from model_files import assert_same, header_of
from streams import a_model

from numpy_infer.model import Model, load, save

Array = np.ndarray


# -- there and back -----------------------------------------------------------------------------


def test_a_model_reads_back_bit_for_bit(model: Model, path: Path) -> None:
    assert_same(load(path), model)
    assert_same(load(str(path)), model)


@pytest.mark.parametrize("predictor", ["none", "affine", "last_known"])
def test_a_model_without_networks_reads_back(predictor: str, tmp_path: Path) -> None:
    model = a_model(predictor, "dense19")
    save(model, tmp_path / "m.npz")
    assert_same(load(tmp_path / "m.npz"), model)


def test_the_same_model_is_the_same_file(model: Model, path: Path, tmp_path: Path) -> None:
    save(load(path), tmp_path / "again.npz")
    assert header_of(tmp_path / "again.npz") == header_of(path)


def test_arrays_in_fortran_order_and_what_json_turns_into_something_else_read_back(
    model: Model, tmp_path: Path
) -> None:
    network = model.marker_network
    assert network is not None
    arrays = {name: np.asfortranarray(array) for name, array in network.arrays.items()}
    changed = replace(
        model,
        marker_network=replace(network, arrays=arrays),
        fade=1,
        training={2: "two", 10: ("ten",)},
    )
    save(changed, tmp_path / "m.npz")
    back = load(tmp_path / "m.npz")
    assert back.fade == 1.0
    assert back.training == {"2": "two", "10": ["ten"]}
    assert back.marker_network is not None
    for name, array in arrays.items():
        assert np.array_equal(back.marker_network.arrays[name], array)


# -- writing ------------------------------------------------------------------------------------


def test_a_file_is_overwritten_only_on_request(model: Model, path: Path) -> None:
    before = path.read_bytes()
    with pytest.raises(ValueError, match="exists: choose another name, or ask to overwrite"):
        save(a_model("none"), path)
    assert path.read_bytes() == before
    save(a_model("none"), path, overwrite=True)
    assert load(path).predictor == "none"


def test_a_model_appears_whole_or_not_at_all(
    model: Model, path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = path.read_bytes()

    def cut_off(*_: Any) -> None:
        raise OSError("the power fails")

    monkeypatch.setattr(os, "replace", cut_off)
    with pytest.raises(OSError, match="the power fails"):
        save(a_model("none"), path, overwrite=True)
    assert path.read_bytes() == before


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"training": {"loss": float("nan")}}, "JSON compliant"),
        ({"training": {"loss": np.float32(1)}}, "'training' must be plain data"),
        ({"training": {"path": Path("x")}}, "'training' must be plain data"),
    ],
)
def test_what_could_not_be_read_back_is_not_written(
    changes: dict[str, Any], message: str, tmp_path: Path
) -> None:
    with pytest.raises(ValueError, match=message):
        save(replace(a_model("none"), **changes), tmp_path / "m.npz")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"fade": 0.0}, "'fade' must be positive"),
        ({"fade": float("inf")}, "'fade' must be positive"),
        ({"expected_error": np.zeros((4, 5))}, "expected_error"),
        ({"expected_error": np.full((4, 6), np.nan)}, "expected_error"),
        ({"expected_error": np.full((4, 6), -1e-4)}, "expected_error"),
        ({"expected_error": np.zeros((0, 6))}, "expected_error"),
        ({"marker_error": np.ones(8)}, "marker_error"),
        ({"marker_error": np.full(9, np.nan)}, "marker_error"),
        ({"marker_error": np.full(9, -1.0)}, "marker_error"),
        ({"faded_error": -0.5}, "'faded_error' must be finite and not negative"),
        ({"error_saturation": float("inf")}, "'error_saturation' must be finite and not negative"),
        ({"least_error": float("nan")}, "'least_error' must be finite and not negative"),
    ],
)
def test_what_a_live_frame_would_fail_on_is_refused_when_the_model_is_made(
    changes: dict[str, Any], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        replace(a_model("none"), **changes)


def test_a_model_whose_parts_do_not_fit_is_refused_when_it_is_made(model: Model) -> None:
    network = model.marker_network
    assert network is not None
    good = dict(network.arrays)
    for arrays, message in [
        ({**good, "0.kernel": good["0.kernel"].T}, r"'0.kernel': expected shape \(27, 32\)"),
        ({**good, "0.bias": good["0.bias"] * np.nan}, "not an array of finite floats"),
        ({**good, "0.bias": good["0.bias"].astype(int)}, "not an array of finite floats"),
        ({k: a for k, a in good.items() if k != "0.bias"}, "'0.bias' is missing"),
        ({**good, "7.bias": good["0.bias"]}, "'7.bias' is unexpected"),
    ]:
        with pytest.raises(ValueError, match=f"marker_network: .*{message}"):
            replace(model, marker_network=replace(network, arrays=arrays))
    with pytest.raises(ValueError, match="needs a marker_network"):
        replace(model, marker_network=None)
    with pytest.raises(ValueError, match="needs a joint_network"):
        replace(model, joint_network=None)
    with pytest.raises(ValueError, match="unknown joint stage 'ik'"):
        replace(model, joints="ik")
    with pytest.raises(ValueError, match="joint_network: 'output_mean': expected shape"):
        replace(model, joint_network=network)
