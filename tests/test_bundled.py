"""The models in the box: made of simulated hands alone, small, and of use on real ones."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from jaxhand import laws
from numpy_infer import HandTracker, TrackingState, load_hand
from numpy_infer.cli import main
from numpy_infer.hand import ANGLES
from numpy_infer.hand import bundled as bundled_hands
from numpy_infer.model import bundled, load
from numpy_infer.recordings import Recording, read, write

LARGEST = 400_000
"""Bytes of a network's numbers, as float32."""


def test_there_is_a_model_for_every_bundled_hand() -> None:
    assert bundled() == bundled_hands()


@pytest.mark.parametrize("name", bundled())
def test_it_is_for_that_hand_and_says_how_it_was_made(name: str) -> None:
    model, hand = load(name), load_hand(name)
    assert model.hand.markers == hand.markers
    np.testing.assert_array_equal(model.hand.template, hand.template)
    np.testing.assert_array_equal(model.hand.skeleton, hand.skeleton)
    assert model.training["config"]["data"] == ["simulated"]
    assert model.training["config"]["start"] is None
    for network in (model.marker_network, model.joint_network):
        assert network is not None
        numbers = [*network.arrays.values(), network.input_mean, network.output_mean]
        assert sum(array.nbytes for array in numbers) < LARGEST
        assert all(array.dtype == np.float32 for array in numbers)


@pytest.mark.parametrize("name", bundled())
def test_hands_in_a_batch_are_as_good_as_alone_with_fingers_turned(name: str) -> None:
    """A nearly straight finger turns a network's rounding a hundredfold."""
    tracker = laws.tracker(replace(load(name), alignment=True))
    laws.check_all(tracker, laws=["batch"], examples=30, seed=0)


def test_a_tracker_needs_no_file() -> None:
    tracker = HandTracker.load()
    pose = tracker.step(tracker.hand.template, 1 / 60)
    assert pose.state == TrackingState.TRACKING
    assert pose.angles is not None
    # Flat, but for what a network does not know exactly.
    assert np.abs(np.degrees(pose.angles)).mean() < 8
    hidden = np.array(tracker.hand.template)
    hidden[5] = np.nan
    assert np.linalg.norm(tracker.step(hidden, 1 / 60).markers[5] - pose.markers[5]) < 5e-3


def test_the_command_takes_the_model_that_fits_the_labels(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    hand = load_hand("qualisys13")
    markers = np.repeat(hand.template[None], 5, 0)
    markers[3, 2] = np.nan
    write(Recording(hand.markers, markers, np.arange(5) / 60, 60.0, ""), tmp_path / "a.csv")
    assert main(["track", str(tmp_path / "a.csv"), "-o", str(tmp_path / "b.csv")]) == 0
    assert "bundled model qualisys13" in capsys.readouterr().out
    assert np.isfinite(read(tmp_path / "b.csv").markers).all()


@pytest.mark.parametrize("data", ["manipnet", "sig18"])
def test_on_hands_it_never_saw_it_beats_the_affine_combination(data: str, data_root: Path) -> None:
    """Two counts and two durations of the paper's Table 3, on validation."""
    pytest.importorskip("jax")
    from jaxhand import datasets, evaluation

    dataset = datasets.load(f"{data}:{data_root / data}", "validation")
    methods = evaluation.methods(load(dataset.hand.name))
    starts = evaluation.find_starts(dataset.sequences)
    starts = evaluation.Starts(starts.frames, *(array[::5] for array in starts[1:]))
    learned, affine = (
        evaluation.table_of(methods[name], starts, 1, counts=(1, 4), durations=(0.1, 1.0))
        for name in ("learned", "affine")
    )
    for count, row in learned.items():
        for duration, cell in row.items():
            assert cell["mean"] < affine[count][duration]["mean"]


@pytest.mark.parametrize(
    ("name", "file", "right"),
    [
        ("qualisys13", "qualisys/recording.tsv", True),
        ("dense19", "sig18/User3/capture4/sequence.8_training_dense_left.trc", False),
        ("dense19", "sig18/User3/capture4/sequence.8_training_dense_right.trc", True),
    ],
)
def test_the_joints_of_real_hands_are_such_as_hands_can_take(
    name: str, file: str, right: bool, data_root: Path
) -> None:
    """A marker on the wrong side of the hand, or the wrong hand, turns joints out of all range."""
    tracker = HandTracker.load(name, right=right, alignment=True)
    markers = read(data_root / file).select(tracker.hand.markers).markers[::20]
    poses = [tracker.step(frame, 1 / 6) for frame in markers]
    angles = np.degrees(np.array([pose.angles for pose in poses]))
    low, high = np.transpose([angle.range_deg for angle in ANGLES])
    beyond = np.maximum(low - angles, angles - high)
    assert (beyond < 10).mean() > 0.95
    mirrored = HandTracker.load(name, right=not right, alignment=True)
    wrong = [mirrored.step(frame, 1 / 6) for frame in markers]
    angles = np.degrees(np.array([pose.angles for pose in wrong]))
    assert np.maximum(low - angles, angles - high).mean() > beyond.mean()
