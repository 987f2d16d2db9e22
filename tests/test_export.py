"""What is chosen on validation before a model is written."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
import pytest

from jaxhand import evaluation, simulation
from jaxhand.export import FADES, export, finish
from numpy_infer.model import Model, load

SEQUENCES = simulation.sequences(jax.random.key(3), load("glove9").hand, 2, 3)


def off(model: Model, amount: float) -> Model:
    """The model with every weight of its marker network off by about this."""
    rng, network = np.random.default_rng(0), model.marker_network
    arrays = {
        name: array + amount * rng.standard_normal(array.shape).astype(np.float32)
        for name, array in network.arrays.items()
    }
    return replace(model, marker_network=replace(network, arrays=arrays))


def error(model: Model) -> float:
    """cm: mean over the cells of Table 3."""
    alone = replace(model, joints="none")
    table = evaluation.table3({"": alone}, SEQUENCES, seeds=1)[""]
    return float(np.mean([cell["mean"] for row in table.values() for cell in row.values()]))


def test_of_a_refinement_as_much_is_kept_as_is_good_on_validation() -> None:
    good, told = load("glove9"), []
    worse = off(good, 0.1)

    kept = finish(worse, SEQUENCES, told.append, start=good)
    assert kept.training["kept"] == 0
    assert "0% of what was learned is taken" in told
    for name, array in kept.marker_network.arrays.items():
        np.testing.assert_array_equal(array, good.marker_network.arrays[name])

    kept = finish(good, SEQUENCES, start=worse)
    assert kept.training["kept"] == 1
    assert error(kept) < error(replace(worse, fade=kept.fade))

    # Half way between two that are off to either side lies the good one.
    arrays = {
        name: (2 * array - worse.marker_network.arrays[name])
        for name, array in good.marker_network.arrays.items()
    }
    beyond = replace(good, marker_network=replace(good.marker_network, arrays=arrays))
    kept = finish(beyond, SEQUENCES, start=worse)
    assert kept.training["kept"] == 0.5
    assert error(kept) < min(error(replace(m, fade=kept.fade)) for m in (worse, beyond))


def test_the_fade_is_the_best_of_those_tried_and_nothing_else_is_touched() -> None:
    model = replace(load("glove9"), fade=1.0)
    finished = finish(model, SEQUENCES)
    errors = {fade: error(replace(model, fade=fade)) for fade in FADES}
    assert finished.fade == min(errors, key=errors.__getitem__)
    assert finished.training == model.training
    assert finished.marker_network is model.marker_network


def test_sequences_too_short_choose_nothing() -> None:
    short = [replace(SEQUENCES[0], markers=SEQUENCES[0].markers[:20])]
    told: list[str] = []
    model = load("glove9")
    assert finish(model, short, told.append, start=off(model, 0.1)) is model
    assert "keep their defaults" in told[0]


def test_a_model_that_is_refused_leaves_the_one_that_was_there(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    path = tmp_path / "model.npz"
    export(load("glove9"), path)
    before = path.read_bytes()
    with pytest.raises(ValueError, match="exists: choose another name"):
        export(load("glove9"), path)
    monkeypatch.setattr("jaxhand.export.PARITY", -1.0)
    with pytest.raises(ValueError, match="numpy and JAX differ"):
        export(load("glove9"), path, overwrite=True)
    assert path.read_bytes() == before
    assert [file.name for file in tmp_path.iterdir()] == ["model.npz"]
