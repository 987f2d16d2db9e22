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
from numpy_infer.cli import check_output, main
from numpy_infer.recordings import Recording, write

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
