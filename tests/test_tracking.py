"""Laws of the offline tracker and of the commands that need numpy alone."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from numpy_infer import (
    HandTracker,
    Model,
    Notice,
    Status,
    TrackingState,
    load_hand,
    tracking,
    wearer,
)
from numpy_infer.cli import describe, main, parser
from numpy_infer.geometry import mirror
from numpy_infer.labels import prefixed
from numpy_infer.model import load
from numpy_infer.recordings import Recording, read, write
from numpy_infer.tracking import track, track_hands

Array = np.ndarray

HAND = load_hand("glove9")


FRAMES = 120
TIME = np.arange(FRAMES) / 60


def true_markers() -> np.ndarray:
    """`[T, M, 3]` a rigid hand that moves and turns."""
    zero, one = 0 * TIME, 1 + 0 * TIME
    rows = (
        (np.cos(TIME), zero, np.sin(TIME)),
        (zero, one, zero),
        (-np.sin(TIME), zero, np.cos(TIME)),
    )
    turn = np.stack([np.stack(row, -1) for row in rows], -2)
    return HAND.template @ np.swapaxes(turn, -1, -2) + np.stack([TIME, one, -TIME], -1)[:, None]


def recording_with_gaps() -> Recording:
    markers = true_markers()
    markers[40:60, 3] = np.nan
    markers[50:90, 5:7] = np.nan
    return Recording(HAND.markers, markers, TIME, 60.0, "made up")


def test_offline_equals_live() -> None:
    recording = recording_with_gaps()
    tracked = track(recording, Model(HAND))
    tracker = HandTracker(Model(HAND))
    live = [
        tracker.step(m, 1 / 60 if i == 0 else recording.time[i] - recording.time[i - 1])
        for i, m in enumerate(recording.markers)
    ]
    assert np.abs(tracked.recording.markers - [pose.markers for pose in live]).max() < 1e-9
    assert (tracked.status == np.array([pose.status for pose in live])).all()


def test_a_long_recording_is_tracked_without_keeping_what_is_not_asked_for(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    kept = []
    monkeypatch.setattr(tracking, "_tracked", lambda recording, model, poses: kept.extend(poses))
    track(recording_with_gaps(), load("glove9"))
    assert all(pose.rotations is None and pose.positions is None for pose in kept)
    assert all(pose.angles is not None for pose in kept)


def test_a_rigid_hand_is_filled_exactly_by_the_affine_baseline() -> None:
    recording = recording_with_gaps()
    tracked = track(recording, Model(HAND))
    assert np.abs(tracked.recording.markers - true_markers()).max() < 1e-5
    assert (tracked.state == TrackingState.TRACKING).all()
    hidden = ~recording.visible
    assert (tracked.status[hidden] == Status.PREDICTED).all()
    assert (tracked.expected_error[hidden] > 0).all()
    assert (tracked.expected_error[~hidden] == 0).all()


def test_predictor_none_leaves_gaps_as_they_are() -> None:
    recording = recording_with_gaps()
    tracked = track(recording, Model(HAND, predictor="none"))
    assert (np.isnan(tracked.recording.markers).any(-1) == ~recording.visible).all()


def test_frames_before_the_hand_was_tracked_stay_empty() -> None:
    recording = recording_with_gaps()
    recording.markers[:7] = np.nan
    tracked = track(recording, Model(HAND))
    assert np.isnan(tracked.recording.markers[:7]).all()
    assert np.isfinite(tracked.recording.markers[7:]).all()
    assert (tracked.state[:7] == TrackingState.LOST).all()


def both_hands() -> Recording:
    """A left hand and, beside it, a right one that comes later and goes earlier."""
    left = recording_with_gaps()
    right = mirror(left.markers[::-1]) + np.array([0.4, 0, 0])
    right[:20] = right[100:] = np.nan
    names = [f"{side}_{name}" for side in "LR" for name in HAND.markers]
    both = np.concatenate([left.markers, right], 1)
    return Recording(names, both, TIME, 60.0, "made up", filled=("L_wrist",))


def test_two_hands_are_tracked_as_each_alone() -> None:
    hands = [prefixed(both_hands(), prefix, HAND) for prefix in ("L_", "R_")]
    assert hands[0].filled == ("wrist",)
    together = track_hands(hands, Model(HAND), right=[False, True])
    for one, hand, right in zip(together, hands, (False, True), strict=True):
        alone = track(hand, Model(HAND), right=right)
        np.testing.assert_allclose(one.recording.markers, alone.recording.markers, atol=1e-9)
        np.testing.assert_array_equal(one.status, alone.status)
        np.testing.assert_array_equal(one.state, alone.state)
    assert np.isnan(together[1].recording.markers[:20]).all()
    with pytest.raises(ValueError, match="a side for each hand"):
        track_hands(hands, Model(HAND), right=[True])
    with pytest.raises(ValueError, match="same time"):
        track_hands([hands[0], replace(hands[1], time=TIME + 1)], Model(HAND), right=[False, True])


def test_the_command_tracks_both_hands_of_a_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write(both_hands(), tmp_path / "both.csv")
    arguments = ["track", str(tmp_path / "both.csv"), "--model", "affine"]
    out = ["-o", str(tmp_path / "out.csv")]
    both = ["--left-prefix", "L_", "--right-prefix", "R_"]
    assert main([*arguments, *out, *both]) == 0
    assert "right hand" in capsys.readouterr().out
    for side, right in (("left", False), ("right", True)):
        prefix = side[0].upper() + "_"
        alone = track(prefixed(both_hands(), prefix, HAND), Model(HAND), right=right)
        written = read(tmp_path / f"out_{side}.csv")
        assert written.names == HAND.markers
        np.testing.assert_allclose(written.markers, alone.recording.markers, atol=1e-5)
    assert main([*arguments, *out, *both]) == 2, "nothing is overwritten unasked"
    one = ["-o", str(tmp_path / "one.csv"), "--right-prefix", "R_"]
    assert main([*arguments, *one]) == 0
    assert (
        read(tmp_path / "one.csv").markers[50] == read(tmp_path / "out_right.csv").markers[50]
    ).all()
    assert (
        main([*arguments, *one[:1], str(tmp_path / "x.csv"), "--right", "--left-prefix", "L_"]) == 2
    )
    assert main([*arguments, *one[:1], str(tmp_path / "x.csv"), "--left-prefix", "Q_"]) == 2


def test_a_wrong_shape_raises_and_wrong_data_do_not() -> None:
    tracker = HandTracker(Model(HAND))
    with pytest.raises(ValueError, match=r"expected shape \(9, 3\), received \(8, 3\)"):
        tracker.step(HAND.template[:8], 1 / 60)
    with pytest.raises(ValueError, match="visible"):
        tracker.step(HAND.template, 1 / 60, visible=np.ones(8, bool))
    pose = tracker.step(np.full((9, 3), np.nan), float("nan"))
    assert np.isfinite(pose.markers).all()
    assert pose.state == TrackingState.LOST


@pytest.mark.parametrize(
    "markers",
    [[None, *HAND.template[1:].tolist()], "nine markers", {"wrist": [0, 0, 0]}, [[0, 0, "x"]] * 9],
    ids=["a hole in a list", "text", "names", "a word"],
)
def test_what_is_no_array_of_numbers_is_refused_by_name(markers: Any) -> None:
    with pytest.raises(ValueError, match=r"markers: expected numbers of shape \(9, 3\), .*hidden"):
        HandTracker(Model(HAND)).step(markers, 1 / 60)


@pytest.mark.parametrize(
    "given",
    [
        lambda x: x.tolist(),
        lambda x: [[v if v == v else None for v in row] for row in x.tolist()],
        np.asfortranarray,
        lambda x: x.astype(">f8"),
        lambda x: x.astype(object),
        lambda x: np.ma.masked_array(np.nan_to_num(x), np.isnan(x)),
        lambda x: np.ma.masked_array(np.where(np.isnan(x), 7, x), np.isnan(x)),
    ],
    ids=["list", "None", "Fortran", "big-endian", "objects", "masked zeros", "masked values"],
)
def test_markers_may_come_in_any_array(given: Callable[[Array], Any]) -> None:
    plain, other = HandTracker(Model(HAND)), HandTracker(Model(HAND))
    for markers in recording_with_gaps().markers[30:70]:
        expected, found = plain.step(markers, 1 / 60), other.step(given(markers), 1 / 60)
        assert np.allclose(found.markers, expected.markers, rtol=0, atol=1e-12)  # Fortran's order
        assert (found.status == expected.status).all()


@pytest.mark.parametrize("right", ["left", ["left", "right"], None, 2, []])
def test_a_side_is_true_or_false(right: Any) -> None:
    with pytest.raises(ValueError, match=r"right: expected True or False.*received"):
        HandTracker(Model(HAND), right=right)


def test_a_tracker_is_made_of_a_model() -> None:
    with pytest.raises(ValueError, match=r"expected a Model, received a str; HandTracker\.load"):
        HandTracker("glove9")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="smoothing: expected a Smoothing or None, received True"):
        HandTracker.load(smoothing=True)  # type: ignore[arg-type]


def test_a_passing_fault_in_the_unit_is_told_of_and_forgotten() -> None:
    tracker = HandTracker.load()
    # So shaky a hand is one whose markers the gate refuses if it is a thousand times as large.
    walk = np.random.default_rng(0).normal(size=(65, 1, 3)).cumsum(0) * 2e-3
    size = 1 + 0.1 * np.sin(np.arange(65) / 30)[:, None, None]
    for i, frame in enumerate(size * HAND.template + walk + [0, 1, 0]):
        wrong = 50 <= i < 60
        pose = tracker.step(frame * (1000 if wrong else 1), 1 / 60)
        assert bool(pose.notice & Notice.SUSPECTED_MILLIMETRES) == wrong
        assert wrong or (pose.markers == frame).all()


def test_a_state_is_compared_and_named_as_it_says() -> None:
    pose = HandTracker(Model(HAND)).step(HAND.template, 1 / 60)
    assert pose.state == TrackingState.TRACKING
    assert TrackingState(pose.state).name == "TRACKING"
    assert not pose.notice & Notice.REJECTED_MARKERS


def test_several_hands_are_several_trackers() -> None:
    markers = recording_with_gaps().markers
    pair = HandTracker(Model(HAND), right=[False, True])
    left, right = HandTracker(Model(HAND)), HandTracker(Model(HAND), right=True)
    for m in markers:
        both = pair.step(np.stack([m, m]), np.full(2, 1 / 60))
        for i, tracker in enumerate((left, right)):
            one = tracker.step(m, 1 / 60)
            assert np.allclose(both.markers[i], one.markers, atol=1e-9)


def test_track_writes_every_marker_and_leaves_the_input_alone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    source, filled = tmp_path / "take.trc", tmp_path / "filled.trc"
    write(recording_with_gaps(), source)
    before = source.read_bytes()
    assert main(["track", str(source), "--model", "affine", "-o", str(filled)]) == 0
    assert "% of the markers measured" in capsys.readouterr().out
    assert np.abs(read(filled).markers - true_markers()).max() < 2e-5
    assert source.read_bytes() == before
    assert main(["track", str(source), "--model", "affine", "-o", str(filled)]) == 2
    assert "pass --overwrite" in capsys.readouterr().err
    assert main(["track", str(source), "--model", "affine", "-o", str(filled), "--overwrite"]) == 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["track", "FILE", "--model", "nothing.npz", "-o", "OUT"], "no model file nothing.npz"),
        (["track", "FILE", "--model", "affine", "--hand", "dense19", "-o", "OUT"], "ThumbCMC"),
        (["track", "FILE", "--model", "affine", "--hand", "nobody", "-o", "OUT"], "nobody"),
        (["track", "none.trc", "--model", "affine", "-o", "OUT"], "none.trc"),
        (["track", "FILE", "--model", "affine", "-o", "out.xyz"], ".trc"),
        (["inspect", "none.trc"], "none.trc"),
        (["hands", "nobody"], "nobody"),
    ],
)
def test_a_mistake_is_one_clear_line(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    arguments: list[str],
    message: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    write(recording_with_gaps(), tmp_path / "take.csv")
    names = {"FILE": "take.csv", "OUT": "out.trc"}
    assert main([names.get(a, a) for a in arguments]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert not (tmp_path / "out.trc").exists()


def test_inspect_counts_gaps_and_finds_the_hand(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recording = recording_with_gaps()
    report = describe(recording)
    assert report["markers"]["ring_tip"] == {
        "missing": pytest.approx(20 / 120),
        "gaps": 1,
        "longest_s": pytest.approx(20 / 60),
        "filled": False,
    }
    assert report["hands"]["glove9"] == []
    assert "ThumbCMC" in report["hands"]["dense19"]
    file = tmp_path / "take.csv"
    write(recording, file)
    assert main(["inspect", str(file)]) == 0
    assert "hand glove9: fits" in capsys.readouterr().out
    assert main(["inspect", str(file), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["rate"] == 60


def test_a_label_map_renames(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    recording = recording_with_gaps().rename({"wrist": "WR"})
    file, labels, out = tmp_path / "take.csv", tmp_path / "labels.json", tmp_path / "out.csv"
    write(recording, file)
    labels.write_text(json.dumps({"WR": "wrist"}))
    arguments = ["track", str(file), "--model", "affine", "-o", str(out)]
    assert main([*arguments, "--map", str(labels)]) == 0
    assert capsys.readouterr().err == ""
    assert read(out).names == HAND.markers
    assert "wrist" not in read(out).filled
    assert main([*arguments, "--overwrite"]) == 0
    assert "no label wrist: tracked as never seen" in capsys.readouterr().err
    assert "wrist" in read(out).filled


def test_a_calibration_is_for_the_same_glove(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write(recording_with_gaps(), tmp_path / "in.csv")
    track_it = ["track", str(tmp_path / "in.csv"), "--model", "affine", "--calibration"]
    for name, status in (("glove9", 0), ("dense19", 2)):
        wearer.save(wearer.Wearer(load_hand(name)), tmp_path / f"{name}.json")
        out = tmp_path / f"{name}.trc"
        assert main([*track_it, str(tmp_path / f"{name}.json"), "-o", str(out)]) == status
        assert out.exists() == (status == 0)
    assert "the wearer's markers" in capsys.readouterr().err


def test_every_verb_explains_itself(capsys: pytest.CaptureFixture[str]) -> None:
    for verb in ("inspect", "track", "hands"):
        with pytest.raises(SystemExit) as stop:
            parser().parse_args([verb, "--help"])
        assert stop.value.code == 0
        assert f"jaxhand {verb}" in capsys.readouterr().out


def test_qualisys_gaps_are_filled(data_root: Path, tmp_path: Path) -> None:
    """The real recording of the command in the README; every fourth frame keeps it short."""
    whole = read(data_root / "qualisys" / "recording.tsv")
    hand = load_hand("qualisys13")
    part = Recording(whole.names, whole.markers[::4], whole.time[::4], whole.rate / 4, whole.source)
    tracked = track(part, Model(hand), right=True)
    seen = part.select(hand.markers).visible
    assert np.isfinite(tracked.recording.markers).all()
    assert not seen.all()
    assert (tracked.status == np.where(seen, Status.OBSERVED, Status.PREDICTED)).all()
    # A gap is filled near where the marker was when it was seen: within a hand's reach.
    jump = np.linalg.norm(np.diff(tracked.recording.markers, axis=0), axis=-1)
    assert jump.max() < 0.2
