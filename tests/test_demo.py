"""The demo runs from nothing to a tracked stream, and replaces nothing unasked."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("jax")
pytest.importorskip("matplotlib")

from jaxhand import cli, demo
from numpy_infer.model import load
from numpy_infer.recordings import read
from numpy_infer.tracking import track


def test_the_short_demo_makes_all_it_promises(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "demo"
    assert cli.demo(["--short", "--out", str(out)]) == 0
    printed = capsys.readouterr().out
    assert sorted(path.name for path in out.iterdir()) == sorted(demo.FILES)
    for words in ("1 marker hidden", "cm", "ms per frame", "What next", "jaxhand track"):
        assert words in printed
    table = json.loads((out / "table3.json").read_text("utf-8"))["table3"]
    assert table["learned"]["1"]["0.5"]["mean"] > 0

    # What it names as the next step works.
    filled = track(read(out / "stream.csv"), load(out / "model.npz"))
    assert np.isfinite(filled.recording.markers).all()

    # A second demo leaves the first alone.
    before = (out / "model.npz").read_bytes()
    assert cli.demo(["--short", "--out", str(out)]) == 2
    assert "--overwrite" in capsys.readouterr().err
    assert (out / "model.npz").read_bytes() == before


def test_stream_errors_are_told_apart_by_the_number_hidden() -> None:
    truth = np.zeros((3, 6, 3))
    visible = np.ones((3, 6), bool)
    visible[0, 0], visible[1, :2], visible[2, :5] = False, False, False
    output = truth + np.where(visible, 0, [[1], [2], [5]])[..., None] * [0.01, 0, 0]
    assert demo.stream_errors(output, truth, visible) == pytest.approx({1: 1, 2: 2, 4: 5})
