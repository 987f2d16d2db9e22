"""Laws of the data of a training: data sets are joined, and share one hand."""

from __future__ import annotations

from dataclasses import replace

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
from jaxhand.tasks import Frames
from jaxhand.training import fit_networks
from numpy_infer.hand import load_hand


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


def test_a_frame_with_too_little_to_see_is_left_out() -> None:
    frames = with_gaps().markers.copy()
    frames[3, :6] = np.nan
    found = training_data.gather([make_dataset("a", Frames(frames), 1.0, None)])
    np.testing.assert_array_equal(found.markers, np.delete(frames, 3, 0))
    assert fit_networks(found, VALIDATION, HAND, replace(CONFIG, joints=False)).marker_network
