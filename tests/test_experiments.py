"""The experiments run; what they find out stands in the README, beside their commands."""

from __future__ import annotations

import re
import runpy
import sys
from pathlib import Path

import pytest

pytest.importorskip("jax")

EXPERIMENTS = Path(__file__).resolve().parents[1] / "experiments"


def run(name: str, *arguments: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "argv", [name, *arguments])
    runpy.run_path(str(EXPERIMENTS / name), run_name="__main__")


def test_a_fused_glove_is_nearer_than_the_glove_and_than_the_papers_route(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    plot = tmp_path / "glove.png"
    short = ["--people", "1", "--seconds", "20", "--plot", str(plot)]
    run("fused_glove.py", *short, monkeypatch=monkeypatch)
    printed = capsys.readouterr().out
    mean = {
        name: float(re.findall(rf"^  {name} +([\d.]+)", printed, re.MULTILINE)[0])
        for name in ("glove alone", "the paper's route", "fused")
    }
    assert 3 * mean["fused"] < mean["glove alone"]
    assert mean["fused"] < mean["the paper's route"]
    assert plot.read_bytes().startswith(b"\x89PNG")
