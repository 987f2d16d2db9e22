"""A folder of one's own marker files as a data set: takes, sides, labels, and what is refused."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("jax")

from takes import HAND, simulated, write_takes

from jaxhand.datasets import load, without_side
from numpy_infer.hand import load_hand
from numpy_infer.recordings import Recording, read, write


def test_a_mirrored_right_hand_is_the_left_hand(tmp_path: Path) -> None:
    write_takes(tmp_path, ["walk_left", "walk_right"])
    left, right = load(f"recordings:{tmp_path}", "test").sequences
    assert (left.name, right.name) == ("walk/left", "walk/right")
    assert left.take == right.take == "walk"
    assert left.rate == 60
    assert left.markers.shape == (61, 9, 3)
    np.testing.assert_array_equal(left.markers, right.markers)
    np.testing.assert_allclose(left.markers, simulated(121)[0][::2], atol=1e-6)


@pytest.mark.parametrize(
    ("stem", "take", "side"),
    [
        ("cube_med2_leftHand", "cube_med2", "left"),
        ("sequence.35_training_dense_right", "sequence.35_training_dense", "right"),
        ("takeRight01", "take01", "right"),
        ("LEFT-walk", "-walk", "left"),
        ("rightHand", "", "right"),
        ("bright_take", "bright_take", "left"),
        ("upright", "upright", "left"),
        ("Righteous", "Righteous", "left"),
        ("take1", "take1", "left"),
    ],
)
def test_a_files_name_tells_its_side(stem: str, take: str, side: str) -> None:
    assert without_side(stem) == (take, side)


def test_both_hands_of_a_take_fall_into_one_split(tmp_path: Path) -> None:
    write_takes(tmp_path, [f"{take}_{side}" for take in "abcde" for side in ("left", "right")])
    found = {
        split: [s.name for s in load(f"recordings:{tmp_path}", split).sequences]
        for split in ("train", "validation", "test")
    }
    assert found == {
        "train": [f"{take}/{side}" for take in "abc" for side in ("left", "right")],
        "validation": ["d/left", "d/right"],
        "test": ["e/left", "e/right"],
    }


def test_a_folder_of_folders_holds_no_takes_and_that_is_said(tmp_path: Path) -> None:
    write_takes(tmp_path / "session", ["a"])
    with pytest.raises(ValueError, match=r"holds no takes: .* folders in it are not looked into"):
        load(f"recordings:{tmp_path}", "test")


def test_labels_beside_the_recordings_are_used(tmp_path: Path) -> None:
    write_takes(tmp_path, ["a"], names=[f"m{i}" for i in range(9)])
    labels = {f"m{i}": name for i, name in enumerate(HAND.markers)}
    (tmp_path / "labels.json").write_text(json.dumps(labels))
    assert load(f"recordings:{tmp_path / 'a.trc'}@3", "test").weight == 3


def test_what_tracking_filled_is_no_recording_to_learn_from(tmp_path: Path) -> None:
    glove = load_hand("glove9")
    status = np.zeros((60, 9))
    status[20:40, 3] = 1
    markers = np.repeat(glove.template[None], 60, 0)
    take = Recording(glove.markers, markers, np.arange(60) / 60, 60.0, "", status=status)
    write(take, tmp_path / "a.csv")
    (sequence,) = load(f"recordings:{tmp_path / 'a.csv'}", "test").sequences
    np.testing.assert_array_equal(np.isnan(sequence.markers).all(-1), status > 0)


@pytest.mark.parametrize(
    ("size", "slow", "told"), [(1000, 1, "1000 times too large"), (1, 1000, "8.33 s apart")]
)
def test_a_unit_or_a_time_that_cannot_be_right_is_refused(
    size: float, slow: float, told: str, tmp_path: Path
) -> None:
    write_takes(tmp_path, ["a"])
    take = read(tmp_path / "a.trc")
    wrong = replace(take, markers=size * take.markers, time=slow * take.time)
    write(wrong, tmp_path / "a.trc", overwrite=True)
    with pytest.raises(ValueError, match=rf"a\.trc: the .* {told}"):
        load(f"recordings:{tmp_path}", "test")
