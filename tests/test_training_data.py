"""Laws of the data of a training: data sets are joined, and share one hand."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("jax")
pytest.importorskip("tyro")

from small_training import (
    CONFIG,
    HAND,
    TRAINING,
    VALIDATION,
    make_dataset,
    with_gaps,
)

from jaxhand import training, training_data
from jaxhand.datasets import parse_spec
from jaxhand.occlusions import save, statistics
from jaxhand.tasks import Frames
from jaxhand.training import fit_networks
from numpy_infer import model as model_file
from numpy_infer.hand import load_hand
from numpy_infer.networks import Dense


def test_data_sets_are_joined_frame_by_frame() -> None:
    known = make_dataset("a", Frames(TRAINING.markers[:40], TRAINING.angles[:40]), 2.0, 1.1)
    bare = make_dataset("b", Frames(VALIDATION.markers[:20]), 1.0, None)
    frames = training_data.gather([known, bare])
    np.testing.assert_array_equal(frames.markers[:40], TRAINING.markers[:40])
    np.testing.assert_array_equal(frames.angles[:40], TRAINING.angles[:40])
    assert np.isnan(frames.angles[40:]).all()
    np.testing.assert_array_equal(frames.weight, [2.0] * 40 + [1.0] * 20)
    assert training_data.gather([bare, bare])[1:3] == (None, None)
    # Bones are those of the data set that knows them.
    hand = training_data.mean_hand([bare, known])
    np.testing.assert_allclose(hand.skeleton, HAND.skeleton * 1.1)


def test_hands_are_averaged_over_frames() -> None:
    few, many = Frames(TRAINING.markers[:80], TRAINING.angles[:80]), TRAINING
    hand = training_data.mean_hand(
        [make_dataset("few", few, 1.0, 1.5), make_dataset("many", many, 1.0, 1.0)]
    )
    np.testing.assert_allclose(hand.skeleton, HAND.skeleton * 1.1)
    assert training_data.mean_hand([make_dataset("bare", few, 1.0, None)]).name == HAND.name


def test_data_sets_of_different_markers_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    other = replace(make_dataset("b", VALIDATION, 1.0, None), hand=load_hand("dense19"))
    datasets = {"a": make_dataset("a", TRAINING, 1.0, None), "b": other}
    monkeypatch.setattr(training_data, "load", lambda spec, split, **_: datasets[spec])
    with pytest.raises(ValueError, match=r"b has markers .* pass one --hand"):
        training.train(replace(CONFIG, data=("a", "b")))


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> None:
    """20,000 simulated frames, without the wait."""
    frames = Frames(np.zeros((20_000, len(HAND), 3), np.float32), simulated=1.0)
    monkeypatch.setattr(training_data, "simulated_frames", lambda hand, seed: (frames, frames))


@pytest.mark.usefixtures("made")
@pytest.mark.parametrize(
    ("data", "share"),
    [
        (("simulated", "recordings:a@3"), 20 / 23),
        (("simulated", "recordings:a@1"), 20 / 21),
        (("simulated@2", "recordings:a@3"), 40 / 43),
        (("recordings:a@3", "recordings:b@3", "simulated"), 20 / 26),
        (("recordings:a@3", "recordings:b@0.5", "simulated"), 20 / 23.5),
        (("recordings:a@3", "recordings:b@1"), 0),
    ],
)
def test_simulated_frames_have_the_share_that_the_weights_say(
    data: tuple[str, ...], share: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of 20,000 simulated frames beside 1,000 of each folder."""
    frames = Frames(np.resize(TRAINING.markers, (1000, len(HAND), 3)))
    monkeypatch.setattr(
        training_data,
        "load",
        lambda spec, split, **_: make_dataset("own", frames, parse_spec(spec).weight, None),
    )
    given = training_data.collect(replace(CONFIG, data=data))
    assert given.training.simulated == pytest.approx(share)
    assert len(given.training.markers) == 1000 * sum(spec[0] == "r" for spec in data)


@pytest.mark.usefixtures("made")
def test_unit_and_side_are_said_of_recordings_and_takes_of_what_is_not_simulated(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    told: dict[str, list[dict[str, Any]]] = {}

    def load(spec: str, split: str, **options: Any) -> Any:
        told.setdefault(spec, []).append(options)
        named = {"train": "a", "validation": "b"}[split]
        return make_dataset(named, TRAINING, 1.0, 1.0)

    monkeypatch.setattr(training_data, "load", load)
    unnamed = {"hand": None, "takes": None, "truth": False}
    said = {"unit": 7.0, "left_handed": True}
    training_data.collect(replace(CONFIG, data=("manipnet:x", "recordings:y"), **said))
    assert told == {"manipnet:x": 2 * [unnamed], "recordings:y": 2 * [unnamed | said]}
    told.clear()
    takes = {"train": ("a",), "validation": ("b",)}
    given = training_data.collect(
        replace(CONFIG, data=("simulated", "recordings:y@3"), **takes, **said)
    )
    assert given.notes[0] == "a: 16 takes (5 s) to train, 16 takes (5 s) to validate"
    expected = [unnamed | said | {"takes": named} for named in takes.values()]
    assert told == {"recordings:y@3": expected}


@pytest.mark.usefixtures("made")
@pytest.mark.parametrize(
    ("used", "said"),
    [
        (("a", "b", "c", "d"), "; e left to test on"),
        (("a", "e"), "; `jaxhand evaluate` would test on e, too: name others by its --test"),
    ],
)
def test_what_is_left_to_test_on_is_said(
    used: tuple[str, ...], said: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    for take in "abcde":
        (tmp_path / f"{take}_left.csv").touch()
    dataset = make_dataset("own", TRAINING, 1.0, 1.0)
    sequences = [
        replace(sequence, take=take)
        for sequence, take in zip(dataset.sequences, used, strict=False)
    ]
    parts = {"train": sequences[:-1], "validation": sequences[-1:]}

    def load(_: str, split: str, **__: Any) -> Any:
        return replace(dataset, sequences=tuple(parts[split]))

    monkeypatch.setattr(training_data, "load", load)
    given = training_data.collect(replace(CONFIG, data=(f"recordings:{tmp_path}",)))
    assert given.notes[0].endswith(f" to validate{said}")


@pytest.mark.usefixtures("made")
def test_other_files_under_the_same_paths_are_noticed(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    start, gaps, glove = (tmp_path / name for name in ("start.npz", "gaps.json", "glove.json"))
    held = {"dataset": make_dataset("own", TRAINING, 1.0, 1.0)}
    monkeypatch.setattr(training_data, "load", lambda *_, **__: held["dataset"])
    model_file.save(model_file.Model(HAND, "affine"), start)
    gaps.write_text("one")
    glove.write_text(json.dumps(HAND.to_json()))
    paths = {"hand": str(glove), "start": start, "occlusions": str(gaps)}
    config = replace(CONFIG, data=("recordings:x",), **paths)

    def digest() -> str:
        return training_data.collect(config).digest

    before = digest()
    assert digest() == before
    gaps.write_text("two")
    other_gaps = digest()
    model_file.save(model_file.Model(HAND, "last_known"), start, overwrite=True)
    other_start = digest()
    glove.write_text(json.dumps(HAND.with_skeleton(1.1 * HAND.skeleton).to_json()))
    other_bones = digest()
    first = held["dataset"].sequences[0]
    blind = first.markers.copy()
    blind[3, 2] = np.nan
    sequences = (replace(first, markers=blind), *held["dataset"].sequences[1:])
    held["dataset"] = replace(held["dataset"], sequences=sequences)
    blinded = digest()
    exchanged = blind[:, [1, 0, *range(2, len(HAND))]]
    sequences = (replace(first, markers=exchanged), *sequences[1:])
    held["dataset"] = replace(held["dataset"], sequences=sequences)
    assert len({before, other_gaps, other_start, other_bones, blinded, digest()}) == 6


@pytest.mark.usefixtures("made")
def test_takes_to_train_and_to_validate_on_are_pointed_out(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    sequences = make_dataset("a", TRAINING, 1.0, 1.0).sequences
    parts = {"train": sequences[:3], "validation": sequences[2:4]}

    def load(_: str, split: str, **__: Any) -> Any:
        return replace(make_dataset("a", TRAINING, 1.0, 1.0), sequences=parts[split])

    monkeypatch.setattr(training_data, "load", load)
    given = training_data.collect(replace(CONFIG, data=("recordings:takes",)))
    assert "(a40 in both: the validation says nothing of other takes)" in given.notes[0]


@pytest.mark.usefixtures("made")
def test_layers_beside_a_model_that_has_its_own_are_refused(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(
        training_data, "load", lambda *_, **__: make_dataset("a", TRAINING, 1.0, 1.0)
    )
    start = tmp_path / "model.npz"
    short = replace(CONFIG, data=("recordings:takes",), epochs=1, joints=False)
    model_file.save(fit_networks(TRAINING, VALIDATION, HAND, short), start)
    own, other = CONFIG.marker_layers, (Dense(25),)
    for layers in (own, training.TrainingConfig.marker_layers):
        training_data.collect(replace(short, start=start, marker_layers=layers))
    with pytest.raises(ValueError, match=r"marker_layers: .*model\.npz has its own"):
        training_data.collect(replace(short, start=start, marker_layers=other))


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"data": ("simulated",), "train": ("a",)}, "one data set, found simulated"),
        ({"data": ("simulated",), "validation": ("a",)}, "one data set, found simulated"),
        ({"data": ("sig18:x", "recordings:y", "simulated"), "train": ("a",)}, "found sig18, reco"),
        ({"data": ("simulated",), "unit": 7.0}, "are for recordings, found simulated"),
        ({"data": ("simulated",), "left_handed": True}, "are for recordings, found simulated"),
        ({"data": ("manipnet:x",), "unit": 7.0}, "are for recordings, found manipnet"),
        ({"data": ("manipnet:x", "sig18:y"), "unit": 7.0}, "recordings, found manipnet, sig18"),
        ({"data": (), "unit": 7.0}, "are for recordings, found none"),
    ],
)
def test_what_is_said_of_data_that_are_not_there_is_refused(
    wrong: dict[str, Any], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        replace(CONFIG, **wrong)


@pytest.mark.parametrize("split", ["training", "validation"])
@pytest.mark.parametrize("apart", [False, True], ids=["of the data", "of their own"])
def test_joint_truth_without_complete_frames_is_refused_before_anything_is_trained(
    split: str, apart: bool
) -> None:
    least = {"training": CONFIG.batch, "validation": 1}

    class Begun(Exception):
        pass

    def trained(*_: Any) -> None:
        raise Begun

    def fit(complete: int) -> Any:
        one_missing = np.where(
            np.eye(len(HAND), dtype=bool)[np.arange(len(TRAINING.markers)) % len(HAND)][..., None],
            np.nan,
            TRAINING.markers,
        )
        one_missing[:complete] = TRAINING.markers[:complete]
        frames = {"training": TRAINING, "validation": VALIDATION}
        frames[split] = TRAINING._replace(markers=one_missing)
        joint_frames = tuple(frames.values()) if apart else None
        main = (TRAINING, VALIDATION) if apart else tuple(frames.values())
        config = replace(CONFIG, epochs=1)
        return fit_networks(*main, HAND, config, trained, joint_frames=joint_frames)

    for complete in {0, least[split] - 1}:
        message = rf"{split}.* {least[split]} or more .*all markers and angles.* found {complete}"
        with pytest.raises(ValueError, match=message):
            fit(complete)
    with pytest.raises(Begun):  # one more will do
        fit(least[split])


def test_misshapen_joint_frames_are_refused() -> None:
    for wrong, message in (
        (VALIDATION._replace(markers=VALIDATION.markers[:, :8]), r"markers \[N, 9, 3\], found"),
        (VALIDATION._replace(angles=VALIDATION.angles[:, :25]), r"angles \[320, 26\], found"),
        (VALIDATION._replace(angles=VALIDATION.angles[:300]), r"angles \[320, 26\], found"),
        (VALIDATION._replace(angles=None), r"angles \[N, 26\], found none"),
    ):
        with pytest.raises(ValueError, match=f"validation of the joint network: .*{message}"):
            fit_networks(TRAINING, VALIDATION, HAND, CONFIG, joint_frames=(TRAINING, wrong))


def test_a_frame_with_too_little_to_see_is_left_out() -> None:
    frames = with_gaps().markers.copy()
    frames[3, :6] = np.nan
    found = training_data.gather([make_dataset("a", Frames(frames), 1.0, None)])
    np.testing.assert_array_equal(found.markers, np.delete(frames, 3, 0))
    assert fit_networks(found, VALIDATION, HAND, replace(CONFIG, joints=False)).marker_network


def test_a_marker_that_no_frame_has_is_refused_before_anything_is_trained() -> None:
    """And goes on as it was in a model that knows it; simulated frames have all."""
    lacking = np.array(TRAINING.markers)
    lacking[:, [4, 7]] = np.nan
    frames, short = Frames(lacking), replace(CONFIG, joints=False, epochs=1)
    trained: list[Any] = []
    names = f"{HAND.markers[4]}, {HAND.markers[7]} in none"
    with pytest.raises(ValueError, match=f"training: expected every marker .* {names}"):
        fit_networks(frames, VALIDATION, HAND, short, trained.append)
    assert not trained
    first = fit_networks(TRAINING, VALIDATION, HAND, short)
    assert fit_networks(frames, VALIDATION, HAND, short, start=first).marker_network
    mixed = fit_networks(frames._replace(simulated=0.5), VALIDATION, HAND, short).marker_network
    assert mixed is not None
    assert all(np.isfinite(array).all() for array in mixed.arrays.values())


def test_a_validation_that_has_nothing_to_hide_costs_no_model(tmp_path: Path) -> None:
    seen = np.ones((len(TRAINING.markers), 9), bool)
    seen[:, 4] = False
    save({"one hand": statistics(HAND.markers, 60.0, [seen])}, tmp_path / "gaps.json")
    lacking = np.array(VALIDATION.markers)
    lacking[:, 4] = np.nan
    config = replace(CONFIG, occlusions=str(tmp_path / "gaps.json"), joints=False, epochs=1)
    model = fit_networks(TRAINING, Frames(lacking), HAND, config)
    assert model.training["marker_network"]["validation_cm"] is None
    model_file.save(model, tmp_path / "model.npz")
