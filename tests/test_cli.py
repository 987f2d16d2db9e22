"""What the command says before it has worked in vain, and that a closed pipe is no mistake."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import numpy_infer.cli
from numpy_infer import load_hand
from numpy_infer.cli import _summary, check_output, main
from numpy_infer.formats.plain_csv import WRIST
from numpy_infer.hand import ANGLES
from numpy_infer.model import load
from numpy_infer.pose import Status, TrackingState
from numpy_infer.recordings import Recording, read, write
from numpy_infer.tracking import Tracked, track

HAND = load_hand("glove9")


def a_recording(path: Path, prefix: str = "", names: tuple[str, ...] = HAND.markers) -> str:
    time = np.arange(30) / 60
    markers = np.repeat(HAND.template[None, : len(names)], len(time), 0)
    labels = tuple(prefix + name for name in names)
    write(Recording(labels, markers, time, 60.0, source=""), path)
    return str(path)


@pytest.fixture
def take(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    monkeypatch.chdir(tmp_path)
    return a_recording(tmp_path / "take.csv")


@pytest.mark.parametrize("arguments", [["hands"], ["hands", "glove9"]])
def test_a_reader_who_has_read_enough_is_no_error(arguments: list[str]) -> None:
    """Less than a buffer, and more than one."""
    read, write = os.pipe()
    os.close(read)
    run = subprocess.run(
        [sys.executable, "-m", "numpy_infer.cli", *arguments],
        cwd=Path(numpy_infer.__file__).parents[1],  # the checkout may not be installed
        stdout=write,
        stderr=subprocess.PIPE,
        env={**os.environ, "PYTHONUNBUFFERED": ""},
        text=True,
        check=False,
    )
    os.close(write)
    assert run.stderr == ""
    assert run.returncode == 1, "not all was said"


@pytest.mark.parametrize("prefixes", [[], ["--left-prefix", "L_", "--right-prefix", "R_"]])
@pytest.mark.parametrize(
    ("out", "message"),
    [
        ("b.xyz", "cannot write '.xyz'; known: "),
        ("nodir/b.csv", "nodir is no folder: make it first"),
        ("take.csv/b.csv", "take.csv is no folder: make it first"),
        ("folder.csv", "is a folder: choose another name"),
    ],
)
def test_a_wrong_output_is_refused_before_the_work(
    prefixes: list[str],
    out: str,
    message: str,
    take: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    for name in ("folder.csv", "folder_left.csv"):
        Path(name).mkdir()
    monkeypatch.setattr(numpy_infer.cli, "read", lambda *_, **__: pytest.fail("worked first"))
    arguments = ["track", take, "--model", "affine", "-o", out, "--overwrite", *prefixes]
    assert main(arguments) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


def test_an_output_is_refused_if_it_exists_unless_it_may_be_replaced(tmp_path: Path) -> None:
    path = tmp_path / "out.json"
    check_output(path, overwrite=False)
    path.write_text("{}")
    check_output(path, overwrite=True)
    with pytest.raises(ValueError, match=r"out\.json exists: choose another name, or pass --over"):
        check_output(path, overwrite=False)
    check_output(Path("here.json"), overwrite=False)


def test_a_folder_that_may_not_be_written_to_is_refused_before_the_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = []
    monkeypatch.setattr(os, "access", lambda path, mode: asked.append(path))
    with pytest.raises(ValueError, match="is a folder that nothing may be written to"):
        check_output(tmp_path / "out.csv", overwrite=False)
    assert asked == [tmp_path]


def refused(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    assert main(arguments) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    return error


def test_what_an_error_advises_is_no_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Labels that no bundled hand has: a model is to be named, or a baseline and its hand."""
    monkeypatch.chdir(tmp_path)
    labels = tuple(name.upper() for name in HAND.markers)
    take = a_recording(tmp_path / "take.csv", names=labels)
    mine = replace(HAND, markers=labels).to_json()
    Path("mine.json").write_text(json.dumps(mine))

    track = ["track", take, "-o", "out.csv"]
    error = refused(track, capsys)
    assert f"no bundled hand fits the labels {', '.join(labels)}: " in error
    assert "--model FILE" in error
    assert "--model affine --hand FILE" in error
    assert "--map" in error
    error = refused([*track, "--model", "affine"], capsys)
    assert "--hand FILE" in error
    assert "--model" not in error, "it is named already"
    error = refused([*track, "--hand", "mine.json"], capsys)
    assert "--hand goes with a baseline (--model " in error
    assert main([*track, "--model", "affine", "--hand", "mine.json"]) == 0


@pytest.mark.parametrize("model", [[], ["--model", "affine"], ["--model", "glove9"]])
@pytest.mark.parametrize("side", ["left", "right"])
def test_a_prefix_that_no_label_has_is_named(
    model: list[str], side: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    take = a_recording(tmp_path / "take.csv", "L_")
    out = ["-o", str(tmp_path / "out.csv")]
    error = refused(["track", take, *out, *model, f"--{side}-prefix", "Q_"], capsys)
    assert f"no label begins with 'Q_'; there are L_{HAND.markers[0]}, " in error
    both = ["--left-prefix", "L_", "--right-prefix", "R_"]
    assert "no label begins with 'R_'; there are" in refused(
        ["track", take, *out, *model, *both], capsys
    )


def test_what_was_measured_stays_if_it_is_asked_for(take: str, tmp_path: Path) -> None:
    """Also where a marker comes back, to which the output would lead it."""
    recording = read(take)
    markers = recording.markers + 1e-3 * np.random.default_rng(0).normal(size=(30, 1, 3))
    markers[10:20, 3] = np.nan
    markers[20:, 3] += 5e-3
    write(replace(recording, markers=markers), tmp_path / "gap.csv")
    seen = np.isfinite(markers)
    for option, same in ((["--as-measured"], True), ([], False)):
        assert main(["track", "gap.csv", "-o", "out.csv", "--overwrite", *option]) == 0
        found = read("out.csv").markers
        assert np.isfinite(found).all()
        assert np.allclose(found[seen], markers[seen], rtol=0, atol=2e-6) == same


def test_only_what_has_been_filled_is_said_to_be(take: str, tmp_path: Path) -> None:
    recording = read(take)
    markers = recording.markers.copy()
    markers[10:20, 3] = np.nan
    write(replace(recording, markers=markers), tmp_path / "gap.csv")
    assert main(["track", "gap.csv", "-o", "out.tsv"]) == 0
    assert read("out.tsv").filled == (HAND.markers[3],)


def test_a_filled_table_says_what_was_measured_and_how_far_off_the_rest_may_be(
    take: str, tmp_path: Path
) -> None:
    """As the tracker says it live, `--as-measured` or not."""
    recording = read(take)
    markers = recording.markers.copy()
    markers[:5] = markers[10:20, 3] = markers[15:, 7] = np.nan
    write(replace(recording, markers=markers), tmp_path / "gap.csv")
    result = track(read("gap.csv"), load("glove9"))
    assert not result.expected_error[:5].any()
    for option in ([], ["--as-measured"]):
        assert main(["track", "gap.csv", "-o", "out.csv", "--overwrite", *option]) == 0
        lines = Path("out.csv").read_text().splitlines()
        header, *rows = (line.split(",") for line in lines if not line.startswith("#"))
        for kind, wanted in (("status", result.status), ("expected_error", result.expected_error)):
            columns = [header.index(f"{name}.{kind}") for name in HAND.markers]
            told = np.array([[float(row[i] or "nan") for i in columns] for row in rows])
            np.testing.assert_allclose(told[5:], wanted[5:], rtol=0, atol=1e-6)
            assert told[5:].any()
            assert np.isnan(told[:5]).all(), "of what is blank nothing is known"
        wrist = [[float(row[header.index(c)] or "nan") for c in WRIST] for row in rows]
        np.testing.assert_allclose(wrist, result.recording.wrist, rtol=0, atol=1e-9)
        assert np.isfinite(wrist[5:]).all()
        assert read("out.csv").names == HAND.markers
        assert (
            read("out.csv").filled == result.recording.filled == (HAND.markers[3], HAND.markers[7])
        )


def test_what_was_filled_once_is_hidden_when_it_is_tracked_again(
    take: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recording = read(take)
    markers = recording.markers + 1e-3 * np.random.default_rng(0).normal(size=(30, 9, 3))
    markers[10:20, 3] = markers[15:, 7] = markers[22:24] = np.nan
    write(replace(recording, markers=markers), tmp_path / "0.csv")
    for once, again in (("0", "1"), ("1", "2")):
        assert main(["track", f"{once}.csv", "-o", f"{again}.csv", "--as-measured"]) == 0
    assert Path("1.csv").read_bytes() == Path("2.csv").read_bytes()
    capsys.readouterr()
    gaps = []
    for name in ("0.csv", "1.csv"):
        assert main(["inspect", name, "--json"]) == 0
        gaps.append(json.loads(capsys.readouterr().out))
    assert gaps[0]["markers"] == gaps[1]["markers"]
    hidden = np.isnan(markers).all(-1).sum()
    note = f"{hidden} positions that tracking had filled (.status) are taken as gaps"
    assert note in gaps[1]["notes"]


def test_hands_say_where_their_markers_sit(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["hands"]) == 0
    lines = capsys.readouterr().out.splitlines()
    own = lines[lines.index(next(line for line in lines if line.startswith("glove9:"))) + 1 :][:9]
    found = {line.split()[0].rstrip("*"): line for line in own}
    assert set(found) == set(HAND.markers)
    assert found["wrist"].split() == ["wrist", "*", "at", "wrist,", "30", "mm", "dorsal"]
    assert found["index_tip"].split() == ["index_tip", "at", "index_tip"]


def test_knuckles_out_of_their_range_are_told_of(capsys: pytest.CaptureFixture[str]) -> None:
    recording = Recording(HAND.markers, np.zeros((4, 9, 3)), np.arange(4) / 60, 60.0, source="")
    for degrees, told in ((-45, True), (10, False)):
        angles = np.zeros((4, len(ANGLES)))
        angles[:, [a.name.endswith("mcp_flexion") for a in ANGLES]] = np.radians(degrees)
        nothing = np.zeros((4, 9))
        recording = replace(recording, status=nothing, expected_error=nothing)
        notice = nothing[:, 0].astype(int)
        result = Tracked(replace(recording, angles=angles), nothing[:, 0], notice)
        assert ("out of their range" in _summary(result)) == told
    never = replace(recording, angles=np.full((4, len(ANGLES)), np.nan))
    lost = nothing[:, 0] + TrackingState.LOST
    assert "out of their range" not in _summary(replace(result, recording=never, state=lost))
    assert "no joint angles" in _summary(replace(result, recording=recording))


def test_a_name_that_says_right_is_heard(take: str, capsys: pytest.CaptureFixture[str]) -> None:
    Path(take).rename("a_right.csv")
    assert main(["track", "a_right.csv", "-o", "out.csv"]) == 0
    assert "name says right" in capsys.readouterr().out
    assert main(["track", "a_right.csv", "-o", "other.csv", "--right"]) == 0
    assert "name says right" not in capsys.readouterr().out


def test_a_label_that_the_file_lacks_is_as_an_empty_column_and_told_of(
    take: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    whole = read(take)
    markers = whole.markers + 1e-3 * np.random.default_rng(0).normal(size=(30, 9, 3))
    for name, names in (("without.csv", HAND.markers[:-1]), ("misspelt.csv", HAND.markers)):
        part = replace(whole, markers=markers).select(names)
        write(part.rename({n: f"{n}?" for n in names[8:]}), tmp_path / name)
    markers[:, 8] = np.nan
    write(replace(whole, markers=markers), tmp_path / "empty.csv")
    assert main(["track", "empty.csv", "-o", "expected.csv"]) == 0
    printed = capsys.readouterr()
    assert f"never seen: {HAND.markers[8]}; filled" in printed.out
    assert printed.err == ""
    for model in ([], ["--model", "glove9"]):
        for name in ("without.csv", "misspelt.csv"):
            assert main(["track", name, "-o", "out.csv", "--overwrite", *model]) == 0
            assert Path("out.csv").read_bytes() == Path("expected.csv").read_bytes()
            error = capsys.readouterr().err
            assert f"no label {HAND.markers[8]}: tracked as never seen" in error
            used = f"labels not used: {HAND.markers[8]}?; did you mean {HAND.markers[8]} by "
            assert (used in error) == (name == "misspelt.csv")
            assert ("--map" in error) == (name == "misspelt.csv")
            assert error.count("\n") == 1


@pytest.mark.parametrize("predictor", ["none", "affine"])
def test_what_is_left_blank_is_not_said_to_be_filled(
    predictor: str, take: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Never seen, hidden, at a wrong place; and, whatever fills, all before the first frame."""
    recording = read(take).select(HAND.markers[:-1])
    markers = recording.markers + 1e-3 * np.random.default_rng(0).normal(size=(30, 8, 3))
    markers[:3] = markers[10:20, 3] = np.nan
    markers[15:, 5] += 0.3
    write(replace(recording, markers=markers), tmp_path / "gap.csv")
    assert main(["track", "gap.csv", "--predictor", predictor, "-o", "out.csv"]) == 0
    printed = capsys.readouterr().out
    assert ("filled" in printed) == (predictor != "none")
    told = [
        line.split(" % of the markers ") for line in printed.splitlines() if "% of the m" in line
    ]
    shares = {text: float(share) for share, text in told}
    seen = np.isfinite(read("out.csv").markers).all(-1)
    assert sum(shares.values()) == pytest.approx(100, abs=0.05)
    (blank,) = (share for text, share in shares.items() if text.startswith("left blank: "))
    assert blank == pytest.approx(100 * (1 - seen.mean()), abs=0.01)


def test_what_to_expect_is_said_of_markers_that_were_seen() -> None:
    """What a marker never seen is off is known to nobody."""
    shape = (4, 9)
    status = np.full(shape, Status.PREDICTED)
    status[0, :2] = status[2, 2] = Status.OBSERVED
    off = np.full(shape, 0.9)
    off[1:, :2] = off[3, 2] = 0.005
    time, markers = np.arange(4) / 60, np.zeros((*shape, 3))
    made = Recording(
        HAND.markers, markers, time, 60.0, source="", status=status, expected_error=off
    )
    said = _summary(Tracked(made, np.zeros(4), np.zeros(4, int)))
    assert "filled ones, seen before, are expected to be 5 mm off" in said
    assert f"never seen: {', '.join(HAND.markers[3:])}; filled" in said


def test_a_label_that_is_nearly_a_markers_name_is_asked_about(
    take: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    asked = "did you mean index_tip by index_tp? (--map renames)"
    write(read(take).rename({"index_tip": "index_tp"}), tmp_path / "tp.csv")
    assert main(["inspect", "tp.csv"]) == 0
    assert f"note: {asked}\n" in capsys.readouterr().out
    assert main(["track", "tp.csv", "-o", "out.csv"]) == 0
    assert asked in capsys.readouterr().err
    write(read(take).rename({name: name.title() for name in HAND.markers}), tmp_path / "all.csv")
    pairs = ", ".join(f"{name} by {name.title()}" for name in HAND.markers)
    for model in ([], ["--model", "glove9"]):
        error = refused(["track", "all.csv", "-o", "out.csv", "--overwrite", *model], capsys)
        assert f"; did you mean {pairs}? (--map renames)" in error


def test_prefixes_of_two_hands_are_pointed_out(
    take: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    names = [prefix + name for prefix in ("R_", "L_") for name in HAND.markers]
    whole = read(take)
    both = np.concatenate([whole.markers, 1000 * whole.markers], 1)
    write(replace(whole, names=names, markers=both, filled=()), tmp_path / "both.csv")
    begun = "labels of a hand begin with R_ and L_: see --right-prefix R_ --left-prefix L_"
    assert main(["inspect", "both.csv"]) == 0
    printed = capsys.readouterr().out
    assert f"note: {begun}\n" in printed
    assert "1000 times too large" in printed, "the left one is looked at, too"
    assert begun in refused(["track", "both.csv", "-o", "out.csv"], capsys)
    assert begun in refused(["track", "both.csv", "--model", "glove9", "-o", "out.csv"], capsys)
    short = refused(["track", "both.csv", "--left-prefix", "L", "-o", "out.csv"], capsys)
    assert short.endswith("labels of a hand begin with L_: see --left-prefix L_\n")


def test_two_subjects_of_one_file_are_two_hands(
    take: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    whole = read(take)
    names = [prefix + name for prefix in ("L_", "R_") for name in HAND.markers]
    both = np.concatenate([whole.markers, whole.markers], 1)
    write(replace(whole, names=names, markers=both, filled=()), tmp_path / "both.csv")
    text = (tmp_path / "both.csv").read_text()
    (tmp_path / "both.csv").write_text(text.replace("L_", "Left:").replace("R_", "Right:"))
    options = ["--left-prefix", "Left:", "--right-prefix", "Right:"]
    assert f"see {' '.join(options)}\n" in refused(["track", "both.csv", "-o", "out.csv"], capsys)
    asked = ["track", "both.csv", "-o", "out.csv", *options]
    assert "--right says nothing beside" in refused([*asked, "--right"], capsys)
    assert main(asked) == 0
    assert main(["track", take, "-o", "one.csv"]) == 0
    assert (tmp_path / "out_left.csv").read_text() == (tmp_path / "one.csv").read_text()


def test_too_few_labels_are_refused_with_what_is_lacking(
    take: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    a_recording(tmp_path / "five.csv", names=HAND.markers[:5])
    error = refused(["track", "five.csv", "-o", "out.csv"], capsys)
    assert f"glove9 lacks {', '.join(HAND.markers[5:])}" in error
    error = refused(["track", "five.csv", "-o", "out.csv", "--model", "glove9"], capsys)
    assert f"no marker {', '.join(HAND.markers[5:])}; there are {HAND.markers[0]}, " in error
    a_recording(tmp_path / "left.csv", prefix="L_")
    assert "--left-prefix" in refused(["track", "left.csv", "-o", "out.csv"], capsys)


@pytest.mark.parametrize("hertz", ["0", "-1", "nan", "inf"])
def test_a_cutoff_that_is_none_is_refused_before_the_work(
    hertz: str, take: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(numpy_infer.cli, "read", lambda *_, **__: pytest.fail("worked first"))
    error = refused(["track", take, "-o", "out.csv", "--smooth", hertz], capsys)
    assert error == f"jaxhand track: --smooth: expected a cutoff above 0 Hz, got {hertz}\n"


@pytest.mark.parametrize(
    ("factor", "said"),
    [
        (0.1, ("10 times too small for a hand: is the unit, 1 m by", "right? 10 m would do")),
        (1000, ("1000 times too large for a hand", "right? 0.001 m would do")),
        (1, ()),
    ],
)
def test_a_wrong_unit_is_told_of_and_not_tracked(
    factor: float,
    said: tuple[str, ...],
    take: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    recording = read(take)
    write(replace(recording, markers=factor * recording.markers), tmp_path / "other.csv")
    assert main(["inspect", "other.csv"]) == 0
    told = capsys.readouterr().out
    assert main(["track", "other.csv", "-o", "out.csv"]) == (2 if said else 0)
    refusal = capsys.readouterr().err
    assert Path("out.csv").exists() == (not said), "nothing that may be taken for the hand"
    for printed in (told, refusal):
        assert all(part in printed for part in said)
        assert ("for a hand" in printed) == bool(said)
    assert refusal.count("\n") == bool(said)


@pytest.mark.parametrize("verb", [["inspect"], ["track", "-o", "out.csv"]])
@pytest.mark.parametrize(("hertz", "said"), [(0.06, True), (1, True), (10, False), (1e3, False)])
def test_a_time_that_cannot_be_in_seconds_is_told_of(
    verb: list[str], hertz: float, said: bool, take: str, capsys: pytest.CaptureFixture[str]
) -> None:
    """In milliseconds, or frame numbers, also where the file states a rate."""
    recording = read(take)
    write(replace(recording, time=np.arange(30) / hertz), Path(take), overwrite=True)
    assert main([verb[0], take, *verb[1:]]) == 0
    told = "".join(capsys.readouterr())
    assert (f"the frames are {1 / hertz:.3g} s apart: is the file's time in mill" in told) == said
    assert ("s apart" in told) == said


@pytest.mark.parametrize("order", [(3, 4), (4, 3), (3, 3)], ids=str)
def test_frames_that_are_not_in_order_are_told_of(
    order: tuple[int, int], take: str, capsys: pytest.CaptureFixture[str]
) -> None:
    recording = read(take)
    time = recording.time.copy()
    time[[3, 4]] = time[list(order)]
    write(replace(recording, time=time), Path(take), overwrite=True)
    assert main(["track", take, "-o", "out.csv"]) == 0
    told = f"{100 / 30:6.2f} % of the frames come no later than the one before"
    assert (told in capsys.readouterr().out) == (order != (3, 4))


@pytest.mark.parametrize("verb", [["inspect"], ["track", "-o", "out.csv", "--overwrite"]])
def test_a_unit_may_be_named(
    verb: list[str], take: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recording = read(take)
    write(replace(recording, markers=1e3 * recording.markers), tmp_path / "bare.csv")
    text = Path("bare.csv").read_text()
    Path("bare.csv").write_text(text.replace("# unit: m\n", ""))
    assert "--unit mm" in refused([*verb, "bare.csv"], capsys)
    assert "got 'furlong'" in refused([*verb, "bare.csv", "--unit", "furlong"], capsys)
    for unit in ("mm", "0.001"):
        assert main([*verb, "bare.csv", "--unit", unit]) == 0
        assert "for a hand" not in capsys.readouterr().out


def test_one_marker_far_away_is_no_matter_of_units(
    take: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recording = read(take)
    markers = recording.markers.copy()
    markers[15:, 3] += [5, 0, 0]
    write(replace(recording, markers=markers), tmp_path / "far.csv")
    assert main(["track", "far.csv", "--no-gate", "-o", "out.csv"]) == 0
    printed = capsys.readouterr().out
    assert " 50.00 % of the frames have a marker over a metre from the others" in printed
    assert "for a hand" not in printed
