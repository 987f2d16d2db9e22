"""Beside the authors' program: the same where it is right, better where it is wrong.

Its networks, template and outputs are real data, found through `data_root`; without it: skipped."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from streams import Stream, run

from numpy_infer.formats import authors_model
from numpy_infer.formats.authors_nets import read_bin
from numpy_infer.model import Model
from numpy_infer.networks import Dense, Network, array_shapes, predict
from numpy_infer.predictors import PREDICTORS

Array = np.ndarray

NUMBERS = (0, 1, 2, 5, 6, 7)
REFLECTED = np.array([1, 1, -1], np.float32)
"""The streams are left-handed: z is turned round at this edge, exactly."""


@pytest.fixture(scope="module")
def folder(data_root: Path) -> Path:
    return data_root / "reference"


@pytest.fixture(scope="module")
def theirs(folder: Path) -> Mapping[str, Array]:
    with np.load(folder / "reference_streams.npz") as file:
        return {
            name: array * REFLECTED if array.shape[1:] == (9, 3) else array
            for name, array in file.items()
        }


@pytest.fixture(scope="module")
def model(folder: Path) -> Model:
    return authors_model.read_model(folder / "marker_model.bin", folder / "hand.csv")


# -- the networks -------------------------------------------------------------------------------


def test_their_joint_network_gives_what_it_gives_them(
    folder: Path, theirs: Mapping[str, Array]
) -> None:
    network = authors_model.read_joint_network(folder / "joint_model.bin")
    for number in NUMBERS:
        # Features are in their template's axes; ours are the hand frame's.
        features = theirs[f"s{number}_joint_features"].reshape(-1, 9, 3)
        features = (features @ authors_model.HAND_FROM_AUTHORS.T).reshape(-1, 27)
        raw = predict(network, features.astype(np.float32), np.ones(features.shape, bool))
        assert_allclose(raw, theirs[f"s{number}_joint_raw"], rtol=0, atol=1e-5)


@pytest.mark.parametrize("which", ["marker", "joint"])
def test_their_networks_written_again_are_the_same(
    which: str, folder: Path, model: Model, tmp_path: Path
) -> None:
    path, copy = folder / f"{which}_model.bin", tmp_path / "copy.bin"
    if which == "marker":
        assert model.marker_network is not None
        authors_model.write_marker_network(model.marker_network, copy)
    else:
        authors_model.write_joint_network(authors_model.read_joint_network(path), copy)
    for one, other in zip(read_bin(copy), read_bin(path), strict=True):
        assert (one.kind, one.activation) == (other.kind, other.activation)
        for tensor, expected in zip(one.tensors, other.tensors, strict=True):
            assert_allclose(tensor, expected, rtol=0, atol=1e-6)


def scaled_network(outputs: int, mean: float) -> Network:
    """Random weights and a scaling that is none of 0 and 1."""
    rng = np.random.default_rng(0)
    spec = (Dense(16), Dense(8, "linear"), Dense(outputs, "linear"))
    arrays = {
        name: rng.normal(size=shape).astype(np.float32) / 4
        for name, shape in array_shapes(spec, 27).items()
    }
    scaling = (
        mean * rng.normal(size=27),
        rng.uniform(0.5, 2, 27),
        rng.normal(size=outputs),
        rng.uniform(0.5, 2, outputs),
    )
    return Network(spec, arrays, *(np.float32(part) for part in scaling))


def test_a_network_of_ours_gives_the_same_after_a_trip_through_their_format(
    folder: Path, tmp_path: Path
) -> None:
    """Scaling is folded into the kernels on the way."""
    rng = np.random.default_rng(1)
    inputs = rng.normal(size=(20, 27)).astype(np.float32)
    known = np.repeat(rng.uniform(size=(20, 9)) < 0.6, 3, -1)

    joint = scaled_network(26, mean=1)
    authors_model.write_joint_network(joint, tmp_path / "joint.bin")
    back = authors_model.read_joint_network(tmp_path / "joint.bin")
    every = np.ones_like(known)
    assert_allclose(predict(back, inputs, every), predict(joint, inputs, every), rtol=0, atol=1e-5)

    marker = scaled_network(27, mean=0)
    authors_model.write_marker_network(marker, tmp_path / "marker.bin")
    again = authors_model.read_model(tmp_path / "marker.bin", folder / "hand.csv").marker_network
    assert again is not None
    assert_allclose(
        predict(again, inputs, known), predict(marker, inputs, known), rtol=0, atol=1e-5
    )


def test_a_network_with_a_mean_cannot_be_written_in_their_format(tmp_path: Path) -> None:
    """Theirs sets hidden coordinates to 0."""
    with pytest.raises(ValueError, match="expects the mean of its training data"):
        authors_model.write_marker_network(scaled_network(27, mean=1), tmp_path / "no.bin")
    assert not (tmp_path / "no.bin").exists()


# -- the baselines, bare ------------------------------------------------------------------------


def bare(model: Model, predictor: str, markers: Array, dt: Array) -> Array:
    """`[T, M, 3]` what a predictor fills in on its own: frame 0 is passed through, and its last
    output is all it knows of what it said."""
    model = replace(model, predictor=predictor, continuity=False)
    init, step, *_ = PREDICTORS[predictor]
    state, outputs = init(model), [markers[0]]
    visible = np.isfinite(markers).all(-1)
    assert visible[0].all()
    state, _ = step(model, state, markers[0], visible[0], markers[0], np.zeros(()))
    for measured, shown, elapsed in zip(markers[1:], visible[1:], dt[1:], strict=True):
        state, filled = step(model, state, measured, shown, outputs[-1], np.asarray(elapsed))
        outputs.append(filled)
    return np.array(outputs)


@pytest.mark.parametrize("number", NUMBERS)
def test_bare_last_known_is_theirs_bit_for_bit(
    number: int, model: Model, theirs: Mapping[str, Array]
) -> None:
    expected = theirs[f"s{number}_naive"]
    found = bare(model, "last_known", theirs[f"s{number}_x"].astype(float), theirs[f"s{number}_dt"])
    assert_array_equal(found.astype(expected.dtype), expected)


@pytest.mark.parametrize("number", [0, 5, 7])
def test_bare_affine_is_theirs_within_a_tenth_of_a_millimetre(
    number: int, model: Model, theirs: Mapping[str, Array]
) -> None:
    """On the streams whose visible sets always determine the map; on the others theirs is up to
    metres off, for it does not centre."""
    found = bare(model, "affine", theirs[f"s{number}_x"].astype(float), theirs[f"s{number}_dt"])
    assert_allclose(found, theirs[f"s{number}_affine"], rtol=0, atol=1e-4)


# -- the whole tracker --------------------------------------------------------------------------


def figures(output: Array, truth: Array, visible: Array) -> tuple[float, float, float]:
    """Metres: mean error of hidden markers; 99 % and worst jump against the true motion."""
    off = output - truth
    jumps = np.linalg.norm(np.diff(off, axis=0), axis=-1)
    return (
        float(np.linalg.norm(off, axis=-1)[~visible].mean()),
        float(np.quantile(jumps, 0.99)),
        float(jumps.max()),
    )


@pytest.mark.parametrize("number", NUMBERS)
def test_with_their_network_the_tracker_is_better_and_smoother_than_their_program(
    number: int, model: Model, theirs: Mapping[str, Array]
) -> None:
    get: Any = lambda name: theirs[f"s{number}_{name}"].astype(float)  # noqa: E731
    markers, truth = get("x"), get("truth")
    visible = np.isfinite(markers).all(-1)
    pose, _ = run(model, Stream(truth, visible, get("dt")), markers=markers)
    mean, usual, worst = figures(pose.markers, truth, visible)
    their_mean, their_usual, _ = figures(get("neural"), truth, visible)
    assert mean <= 0.95 * their_mean
    assert usual <= their_usual
    assert worst <= 0.040
