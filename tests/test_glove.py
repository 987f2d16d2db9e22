"""The verbs that take a person's or a new glove's measure."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("jax")
pytest.importorskip("tyro")

from fitted import fitted_model
from rich.console import Console
from simulated import motion, worn

from jaxhand import cli, glove, occlusions, report
from jaxhand.calibration import Calibration
from jaxhand.datasets import SIG18_AS_GLOVE9
from jaxhand.hand_size import Size
from numpy_infer import HandTracker, load_hand, model, wearer
from numpy_infer.geometry import mirror
from numpy_infer.hand import ANGLES, POINTS
from numpy_infer.recordings import Recording, read, write

GLOVE = load_hand("glove9")
RATE, SECONDS, LARGER = 60.0, 6, 1.12


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A model on average bones, and six seconds of a hand that is 12 % larger, flat at first."""
    folder = tmp_path_factory.mktemp("glove")
    model.save(fitted_model(), folder / "model.npz")
    frames = round(RATE * SECONDS)
    move = motion(3, frames, RATE)
    ease = np.clip(np.arange(frames) / RATE - 1, 0, 1)[:, None].astype(np.float32)
    move = move._replace(angles=move.angles * ease)
    markers = worn(GLOVE.with_skeleton(LARGER * GLOVE.skeleton), move)[0]
    noise = 0.3e-3 * np.random.default_rng(0).standard_normal(markers.shape)
    markers = markers + noise
    time = np.arange(frames) / RATE
    write(Recording(GLOVE.markers, markers, time, RATE, source=""), folder / "left.csv")
    write(Recording(GLOVE.markers, mirror(markers), time, RATE, source=""), folder / "right.csv")
    names = [prefix + name for prefix in ("L_", "R_") for name in GLOVE.markers]
    both = np.concatenate([markers, mirror(markers) + 0.3], 1)
    write(Recording(names, both, time, RATE, source=""), folder / "both.csv")
    others = [*GLOVE.markers[2::-1], *GLOVE.markers[3:]]
    write(Recording(others, markers, time, RATE, source=""), folder / "mislabelled.csv")
    write(Recording(GLOVE.markers, 0.1 * markers, time, RATE, source=""), folder / "small.csv")
    return folder


@pytest.mark.parametrize("side", ["left", "right"])
def test_a_larger_hand_is_found_to_be_larger(side: str, folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "me.json"
    arguments = [str(folder / f"{side}.csv"), "--model", str(folder / "model.npz"), "-o", str(out)]
    right = ["--right"] if side == "right" else []
    assert cli.calibrate([*arguments, "--flat", "0", "0.8", *right]) == 0
    person = wearer.load(out)
    lengths, average = (np.array(list(h.bone_lengths.values())) for h in (person.hand, GLOVE))
    assert np.abs(lengths / average - LARGER).max() < 0.02
    assert person.flat is not None
    assert cli.calibrate(arguments) == 2, "nothing is overwritten unasked"


def test_a_larger_hand_held_as_it_was_when_flat_is_flat(folder: Path, tmp_path: Path) -> None:
    """What is taken off is what the model says that will run, on the person's own bones."""
    out = tmp_path / "me.json"
    held = read(folder / "left.csv").markers[: round(0.8 * RATE)]
    config = glove.CalibrateConfig(
        recording=folder / "left.csv", out=out, model=folder / "model.npz", flat=(0, 0.79)
    )
    glove.calibrate_person(config, Console(quiet=True))
    tracker = HandTracker.load(folder / "model.npz", calibration=out)
    angles = np.array([tracker.step(markers, 1 / RATE).angles for markers in held])
    assert np.degrees(np.abs(angles.mean(0)).max()) < 0.05


def test_a_hand_that_is_not_flat_is_told_of(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Flat until the first second is over; bent, or not flat to the end."""
    out = ["--model", str(folder / "model.npz"), "-o", str(tmp_path / "me.json"), "--overwrite"]
    for since, until, told in (("0", "0.9", False), ("2", "6", True), ("0", "6", True)):
        flat = ["--flat", since, until]
        assert cli.calibrate([str(folder / "left.csv"), *out, *flat]) == 0
        assert ("--flat: in those seconds the fingers" in capsys.readouterr().out) == told


@pytest.mark.parametrize("degrees", [-30, -10, 0, 10, 30])
def test_bent_is_what_the_fingers_are_together_and_seldom_one_frame(degrees: float) -> None:
    angles = np.zeros((100, len(ANGLES)))
    angles[:, :5], angles[:, 12] = 1.0, 0.5  # the thumb, and one joint of twelve
    assert glove._bent(angles) < 3
    flexions = [a.name.endswith("_flexion") for a in ANGLES]
    angles[:, flexions] = np.radians(degrees)
    assert glove._bent(angles) == pytest.approx(abs(degrees))
    angles[::30, flexions] = np.radians(80)
    assert glove._bent(angles) == pytest.approx(abs(degrees))


def test_a_glove_is_described_by_its_motion(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "mine.json"
    assert cli.hand([str(folder / "left.csv"), "--like", "glove9", "-o", str(out)]) == 0
    hand = load_hand(out)
    assert hand.name == "mine"
    assert hand.markers == GLOVE.markers
    palm = [POINTS.index(point) for point in ("index_mcp", "pinky_mcp")]
    apart = np.linalg.norm(np.subtract(*hand.template[[0, 2]]))
    wanted = LARGER * np.linalg.norm(np.subtract(*GLOVE.skeleton[palm]))
    assert abs(apart - wanted) < 3e-3


@pytest.mark.parametrize("side", ["left", "right"])
def test_either_hand_of_a_file_is_measured_as_if_it_were_alone(
    side: str, folder: Path, tmp_path: Path
) -> None:
    right = ["--right"] if side == "right" else []
    model = ["--model", str(folder / "model.npz")]
    prefix = [f"--{side}-prefix", side[0].upper() + "_"]
    for verb, options in ((cli.calibrate, model), (cli.hand, ["--name", "mine"])):
        for name, more in ((side, right), ("both", prefix)):
            out = ["-o", str(tmp_path / f"{name}.json"), "--overwrite"]
            assert verb([str(folder / f"{name}.csv"), *options, *out, *more]) == 0
        alone, one = (load_json(tmp_path / f"{name}.json") for name in (side, "both"))
        np.testing.assert_allclose(alone, one, rtol=0, atol=1e-4)


def load_json(path: Path) -> list[float]:
    """All numbers of a file."""
    return [float(number) for number in re.findall(r"-?\d+\.\d+", path.read_text("utf-8"))]


def test_a_fit_that_is_none_is_told_of(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Labels exchanged on the back of the hand, which then is much like one of the other side; and
    the wrong side."""
    model = ["--model", str(folder / "model.npz"), "-o", str(tmp_path / "me.json"), "--overwrite"]
    for name, right, poor, side in (
        ("left", [], False, ""),
        ("right", ["--right"], False, ""),
        ("mislabelled", [], True, None),
        ("right", [], None, "right"),
        ("left", ["--right"], None, "left"),
    ):
        assert cli.calibrate([str(folder / f"{name}.csv"), *model, *right]) == 0
        printed = capsys.readouterr().out
        assert "mm, root mean square (usual: 5 to 15 mm, and no marker" in printed
        if poor is not None:
            assert ("a poor fit" in printed) == poor
        if side is not None:
            assert ("hand they fit better" in printed) == bool(side)
            assert not side or f"as a {side} hand they fit better" in printed


def test_how_well_a_new_glove_fits_is_told(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Poor with labels exchanged on the back of the hand, and of the wrong side."""
    out = ["-o", str(tmp_path / "mine.json"), "--overwrite"]
    for name, right, poor in (
        ("left", [], False),
        ("right", ["--right"], False),
        ("mislabelled", [], True),
        ("right", [], True),
    ):
        assert cli.hand([str(folder / f"{name}.csv"), *out, *right]) == 0
        printed = capsys.readouterr().out
        (off,) = re.findall(r"fit within (.*) mm on average \(usual: up to 4 mm\)", printed)
        assert (float(off) > 10) == poor
        assert ("a poor fit" in printed) == poor
        assert ("is it a right hand (--right), did" in printed) == (poor and not right)
        assert "wrote" in printed


def test_a_marker_far_from_its_place_is_named() -> None:
    """However well it then fits; and so are fingers that did not move."""
    away = np.zeros((9, 3))
    away[5, 0], away[6, 0] = 0.05, 0.03
    found = Calibration(**dict.fromkeys(Calibration._fields))._replace(
        hand=replace(GLOVE, offsets=GLOVE.offsets + away).with_skeleton(GLOVE.skeleton),
        residual=np.full((3, 9), 1e-3),
        seen=np.array([True, True, False, True, True]),
    )
    config = glove.HandConfig(recording=Path("free.csv"), out=Path("mine.json"))
    said = glove._of_glove(found, GLOVE, config)
    assert any(f"harm; {GLOVE.markers[5]} far from where glove9 has them" in line for line in said)
    assert [line for line in said if line.startswith("not seen")] == [
        "not seen yet: the middle; bend and stretch it for a better fit"
    ]
    found = found._replace(hand=GLOVE)
    assert not any("a poor fit" in line for line in glove._of_glove(found, GLOVE, config))


@pytest.mark.parametrize("user", ["User1", "User2", "User3"])
def test_a_recorded_hand_is_of_its_own_side(
    user: str, data_root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of its markers the nine of the bundled model, which has never seen a recorded hand."""
    (folder, *_) = sorted((data_root / "sig18" / user).iterdir())
    takes = [read(path) for path in sorted(folder.glob("*_left.trc"))]
    markers = np.concatenate([take.rename(SIG18_AS_GLOVE9).markers for take in takes])
    names = takes[0].rename(SIG18_AS_GLOVE9).names
    time = np.arange(len(markers)) / takes[0].rate
    write(Recording(names, markers, time, takes[0].rate, source=""), tmp_path / "left.trc")
    for right in ([], ["--right"]):
        out = ["-o", str(tmp_path / "me.json"), "--overwrite"]
        assert cli.calibrate([str(tmp_path / "left.trc"), "--model", "glove9", *out, *right]) == 0
        printed = capsys.readouterr().out
        assert ("as a left hand they fit better" in printed) == bool(right)
        assert "a poor fit" not in printed or right


def test_a_size_that_nothing_tells_is_not_told() -> None:
    config = glove.CalibrateConfig(
        recording=Path("free.csv"), out=Path("me.json"), model=Path("m.npz")
    )
    larger = "the hand is 10.0 % larger than the model's (95 %: +9.0 to +11.0)"
    for factor, seen, told in (
        (1.1, True, larger),
        (1.0, True, f"{larger}: not surely 3 %"),
        (1.0, False, "no finger moved enough to tell the hand's size: the model's own is kept"),
    ):
        size = Size(factor, 1.1, (1.09, 1.11), 0.01, np.array([seen, *[False] * 4]))
        assert glove._of_size(size, config)[0].startswith(told)


@pytest.mark.parametrize(
    ("off", "size", "poor"),
    [(2e-3, 1.2, False), (5e-3, 1.0, True), (2e-3, 0.7, True), (2e-3, 1.4, True)],
)
def test_a_fit_of_all_bones_is_judged_too(off: float, size: float, poor: bool) -> None:
    found = Calibration(
        **dict.fromkeys(Calibration._fields),
    )._replace(hand=GLOVE.resized(size), residual=np.full((3, 9), off), tracked=np.ones(3, bool))
    for right, asked in (
        (False, "is it a right hand (--right)?"),
        (True, "is it a left hand (no --right, or --left-prefix)?"),
    ):
        config = glove.CalibrateConfig(
            recording=Path("free.csv"), out=Path("me.json"), model=Path("m.npz"), right=right
        )
        said = glove._bones(found, GLOVE, config)
        assert any(f"are the labels right, {asked}" in line for line in said) == poor


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"--model": "nothing.npz"}, "no model file nothing.npz"),
        ({"--flat": "20"}, "no frame with all markers"),
        ({"recording": "nothing.csv"}, "nothing.csv"),
        ({"out": "nodir/me.json"}, "nodir is no folder: make it first"),
        ({"out": "."}, "is a folder: choose another name"),
        ({"recording": "SMALL"}, "10 times too small for a hand: is the unit"),
        ({"--left-prefix": "Q_"}, "no label begins with 'Q_'; there are pinky_base, "),
        ({"--left-prefix": "L_", "--right-prefix": "R_"}, "one hand at a time"),
    ],
)
def test_a_mistake_is_one_clear_line_before_the_fit(
    change: dict[str, str],
    message: str,
    folder: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(glove, "hand_size", lambda *_: pytest.fail("fitted first"))
    given = {"--model": str(folder / "model.npz"), "--flat": "0", "out": "me.json", **change}
    recording = change.get("recording", str(folder / "left.csv"))
    recording = recording.replace("SMALL", str(folder / "small.csv"))
    arguments = [recording, "-o", str(tmp_path / given["out"]), "--model", given["--model"]]
    for option in ("--left-prefix", "--right-prefix"):
        arguments += [option, change[option]] if option in change else []
    assert cli.calibrate([*arguments, "--flat", given["--flat"], "30"]) == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1
    assert not (tmp_path / "me.json").exists()


@pytest.mark.parametrize(
    ("config", "arguments"),
    [
        (glove.CalibrateConfig, ["a.csv", "-o", "b.json", "--model", "glove9"]),
        (glove.HandConfig, ["a.csv", "-o", "b.json"]),
        (occlusions.OcclusionsConfig, ["a.csv"]),
        (report.EvaluationConfig, ["--data", "recordings:a"]),
    ],
)
def test_a_unit_may_be_named(
    config: type, arguments: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    for given, unit in (([], None), (["--unit", "mm"], 1e-3), (["--unit", "0.5"], 0.5)):
        assert cli._parsed(config, [*arguments, *given], "verb", "").unit == unit
    with pytest.raises(SystemExit):
        cli._parsed(config, [*arguments, "--unit", "furlong"], "verb", "")
    assert "expected mm, cm" in capsys.readouterr().err


@pytest.mark.parametrize("out", ["nodir/mine.json", "."])
def test_a_wrong_output_is_refused_before_the_glove_is_fitted(
    out: str,
    folder: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(glove, "calibrate", lambda *_, **__: pytest.fail("fitted first"))
    assert cli.hand([str(folder / "left.csv"), "-o", str(tmp_path / out)]) == 2
    assert "folder" in capsys.readouterr().err
