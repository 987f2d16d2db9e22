"""Pictures are written, show what they should, and replace nothing unasked."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("matplotlib")

from jaxhand import pictures
from jaxhand.occlusions import Occlusions, statistics
from numpy_infer.hand import POINTS, flat_points, load_hand
from numpy_infer.model import Model
from numpy_infer.pose import HandPose
from numpy_infer.tracker import HandTracker

GLOVE = load_hand("glove9")
FRAMES = 90
DURATIONS = ("0.1", "0.2", "0.5", "1.0", "2.0")


def table(**means: float) -> dict[str, Any]:
    """A table whose errors grow from `means`, without an interval in its last column."""

    def cell(mean: float, last: bool) -> dict[str, Any]:
        low, high = (None, None) if last else (0.9 * mean, 1.1 * mean)
        return {"mean": mean, "low": low, "high": high, "n": 100}

    return {
        method: {
            count: {d: cell(mean * (i + 1), d == "2.0") for i, d in enumerate(DURATIONS)}
            for count in "1234"
        }
        for method, mean in means.items()
    }


def stream() -> dict[str, Any]:
    """A hand that moves along, with two gaps."""
    time = np.arange(FRAMES) / 60
    markers = GLOVE.template + np.stack([time, 1 + 0 * time, 0 * time], -1)[:, None]
    seen = markers.copy()
    seen[20:40, 5], seen[50:70, 4:7] = np.nan, np.nan
    tracker = HandTracker(Model(GLOVE))
    steps = [tracker.step(frame, 1 / 60) for frame in seen]
    poses = HandPose(*(None if f[0] is None else np.stack(f) for f in zip(*steps, strict=True)))
    joints = flat_points(GLOVE.skeleton) + poses.wrist_position[:, None]
    assert joints.shape == (FRAMES, len(POINTS), 3)
    poses = poses._replace(positions=joints)
    return {"hand": GLOVE, "markers": markers, "seen": seen, "poses": poses, "time": time}


def is_png(path: Path) -> bool:
    return path.read_bytes()[:8] == b"\x89PNG\r\n\x1a\n" and path.stat().st_size > 10_000


def test_table_3_is_drawn(tmp_path: Path) -> None:
    pictures.table_picture(
        table(affine=1.0, learned=0.5, last_known=2.0, moving_average=30.0), tmp_path / "t.png"
    )
    assert is_png(tmp_path / "t.png")


def test_a_baseline_alone_and_missing_cells_are_drawn(tmp_path: Path) -> None:
    alone = table(moving_average=30.0)
    pictures.table_picture(alone, tmp_path / "alone.png")
    assert is_png(tmp_path / "alone.png")
    holes = table(affine=1.0)
    holes["affine"]["4"]["2.0"] = {"mean": None, "low": None, "high": None, "n": 0}
    pictures.table_picture(holes, tmp_path / "holes.png")
    assert is_png(tmp_path / "holes.png")


def test_what_is_off_the_scale_is_said(tmp_path: Path) -> None:
    pictures.table_picture(table(affine=1.0, moving_average=30.0), tmp_path / "t.svg")
    text = (tmp_path / "t.svg").read_text("utf-8")
    assert "off scale" in text
    assert "hidden for (s)" in text
    assert "(cm)" in text


def test_a_stream_is_drawn(tmp_path: Path) -> None:
    pictures.stream_picture(**stream(), path=tmp_path / "s.png")
    assert is_png(tmp_path / "s.png")


def test_a_stream_without_joints_is_refused(tmp_path: Path) -> None:
    given = stream()
    given["poses"] = given["poses"]._replace(positions=None)
    with pytest.raises(ValueError, match="no joint stage"):
        pictures.stream_picture(**given, path=tmp_path / "s.png")


def gaps() -> dict[str, Occlusions]:
    """Every tenth frame of a marker missing, of one hand and of two."""
    seen = np.arange(300)[:, None] % 10 > np.arange(3)
    return {
        "one hand": statistics(("a", "b", "c"), 60.0, [seen]),
        "none": statistics(("a", "b", "c"), 60.0, [np.ones_like(seen)]),
    }


def test_gaps_are_drawn_and_so_is_their_absence(tmp_path: Path) -> None:
    pictures.occlusions_picture(gaps(), tmp_path / "g.svg")
    text = (tmp_path / "g.svg").read_text("utf-8")
    assert "markers hidden at once" in text
    assert "one hand: 90 % within" in text


@pytest.mark.parametrize("which", ["table3", "stream", "gaps"])
def test_nothing_is_replaced_unasked(tmp_path: Path, which: str) -> None:
    path = tmp_path / "p.png"
    path.write_text("precious")

    def draw(**options: Any) -> None:
        if which == "table3":
            pictures.table_picture(table(affine=1.0), path, **options)
        elif which == "gaps":
            pictures.occlusions_picture(gaps(), path, **options)
        else:
            pictures.stream_picture(**stream(), path=path, **options)

    with pytest.raises(ValueError, match="exists"):
        draw()
    assert path.read_text() == "precious"
    draw(overwrite=True)
    assert is_png(path)


@pytest.mark.parametrize("name", ["p.xyz", "p", "p.png.gz", "png"])
def test_an_ending_that_is_no_picture_is_refused_before_the_work(name: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"cannot draw '.*'; known: .*\.png, "):
        pictures.check_picture(tmp_path / name, overwrite=True)
    for known in ("p.png", "P.SVG", "a.b.pdf"):
        pictures.check_picture(tmp_path / known, overwrite=False)


def test_curves_of_table_4_begin_at_nothing_hidden(tmp_path: Path) -> None:
    joints = table(learned=1.0, ik=2.0, of_mine=3.0)
    for rows in joints.values():
        rows["0"] = {"mean": 0.5, "low": 0.4, "high": 0.6, "n": 9}
    pictures.table_picture(joints, tmp_path / "t4.svg")
    text = (tmp_path / "t4.svg").read_text("utf-8")
    assert "<!-- 1 marker hidden -->" in text  # matplotlib notes every text beside its outlines
    assert "0 marker" not in text
    assert is_png_of(joints, tmp_path / "t4.png")


def is_png_of(rows: dict[str, Any], path: Path) -> bool:
    pictures.table_picture(rows, path)
    return is_png(path)


def test_pyplot_is_left_alone(tmp_path: Path) -> None:
    code = (
        "import sys; from tests.test_pictures import *; "
        f"pictures.table_picture(table(affine=1.0), {str(tmp_path / 'p.png')!r}); "
        "assert 'matplotlib.figure' in sys.modules; sys.exit('matplotlib.pyplot' in sys.modules)"
    )
    root = Path(__file__).resolve().parents[1]
    assert subprocess.run([sys.executable, "-c", code], cwd=root, check=False).returncode == 0


def test_without_matplotlib_it_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(ValueError, match=r"pip install 'jaxhand\[plot\]'"):
        pictures.table_picture(table(affine=1.0), tmp_path / "p.png")
