"""Files that are odd, and long ones."""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from numpy_infer import load_hand
from numpy_infer.cli import main
from numpy_infer.recordings import Recording, doubted_time, read, write, write_all

GLOVE = load_hand("glove9")

TRC = """PathFileType\t4\t(X/Y/Z)\ttake.trc
DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits
100\t100\t2\t1\tmm
Frame#\tTime\ta\t\t
\t\tX1\tY1\tZ1

1\t0\t1\t2\t3
2\t0.01\t4\t5\t6
"""

CSV = """# unit: mm
time,a.x,a.y,a.z,b.x,b.y,b.z
0,1,2,3,4,5,6
0.01,,,,4,5,7
"""


def test_trc_with_a_blank_unit_takes_the_one_that_is_given(put: Callable) -> None:
    path = put("take.trc", TRC.replace("\tmm", "\t"))
    with pytest.raises(ValueError, match=r"take\.trc:3: the header has no Units: pass --unit mm"):
        read(path)
    expected = read(put("stated.trc", TRC))
    np.testing.assert_array_equal(read(path, unit=1e-3).markers, expected.markers)


def test_plain_csv_may_be_in_quotes(put: Callable) -> None:
    quoted = [",".join(f'"{cell}"' for cell in line.split(",")) for line in CSV.splitlines()]
    expected, found = read(put("take.csv", CSV)), read(put("q.csv", "\n".join(quoted) + "\n"))
    assert found.names == expected.names
    np.testing.assert_array_equal(found.markers, expected.markers)
    np.testing.assert_array_equal(found.time, expected.time)


def test_plain_csv_may_be_saved_where_commas_are_decimal(put: Callable) -> None:
    saved = "# unit: mm;;;;;;\ntime;a.x;a.y;a.z;b.x;b.y;b.z\n0;1;2;3;4;5,25;6\n0,01;;;;4;5;7\n"
    expected = read(put("take.csv", CSV.replace("4,5,6", "4,5.25,6")))
    found = read(put("saved.csv", saved))
    assert found.names == expected.names
    np.testing.assert_array_equal(found.markers, expected.markers)
    np.testing.assert_array_equal(found.time, expected.time)


def test_a_time_that_does_not_go_with_the_stated_rate_is_noted(put: Callable) -> None:
    text = "# unit: m\n# rate: {}\ntime,a.x,a.y,a.z\n" + "".join(
        f"{time},1,2,3\n" for time in np.round(np.arange(200) / 120, 2)
    )
    assert doubted_time(read(put("take.csv", text.format(120)))) is None
    said = doubted_time(read(put("take.csv", text.format(60))))
    assert said is not None
    assert "states 60 Hz, but its time goes on by 10 ms a frame, 100 Hz: the time is" in said


@pytest.mark.parametrize("name", ["long.csv", "long.trc", "long.tsv"])
def test_writing_a_long_recording_takes_little_more_than_its_table(
    name: str, tmp_path: Path
) -> None:
    markers = np.random.default_rng(0).normal(size=(3000, 20, 3))
    recording = Recording([f"m{i}" for i in range(20)], markers, np.arange(3000) / 60, 60, "made")
    tracemalloc.start()
    try:
        write(recording, tmp_path / name)
        assert tracemalloc.get_traced_memory()[1] < 4 * markers.nbytes
    finally:
        tracemalloc.stop()


# -- as studios have them ---------------------------------------------------------------------


def a_take(path: Path, scale: float = 1.0, frames: int = 30) -> Path:
    """A hand that goes by, one marker of it hidden for a while."""
    time = np.arange(frames) / 60
    markers = scale * (GLOVE.template + time[:, None, None] * [0.1, 0, 0])
    markers[10:20, 4] = np.nan
    write(Recording(GLOVE.markers, markers, time, 60, "made"), path)
    return path


def test_a_masked_marker_was_not_measured() -> None:
    values = np.zeros((2, 3, 3))
    mask = np.zeros(values.shape, bool)
    mask[1, 2] = True
    found = Recording("abc", np.ma.array(values, mask=mask), np.arange(2.0), 60, "made")
    np.testing.assert_array_equal(found.visible, [[True] * 3, [True, True, False]])


def test_angles_of_another_shape_are_refused() -> None:
    with pytest.raises(ValueError, match=r"angles: expected shape \(2, 26\), got \(2, 5\)"):
        Recording("a", np.zeros((2, 1, 3)), np.arange(2.0), 60, "made", angles=np.zeros((2, 5)))


def test_one_hand_may_have_a_prefix_that_is_a_subject(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    take, out = a_take(tmp_path / "take.trc"), tmp_path / "out.csv"
    text = take.read_text()
    for name in GLOVE.markers:
        text = text.replace(f"\t{name}", f"\tRight:{name}")
    take.write_text(text)
    assert main(["track", str(take), "--right-prefix", "Right:", "-o", str(out)]) == 0
    assert "right hand?" not in capsys.readouterr().err
    by_prefix = out.read_bytes()
    assert main(["track", str(take), "--right", "-o", str(out), "--overwrite"]) == 0
    assert out.read_bytes() == by_prefix
    assert "labels begin with 'Right:': is it a right hand?" in capsys.readouterr().err
    assert read(take).names == GLOVE.markers


@pytest.mark.parametrize(
    ("scale", "unit", "told"),
    [
        (1 / 2.54, "0.01", "2.5 times too small for a hand: is the unit, 0.01 m by"),
        (2.54, "in", "2.5 times too large for a hand: is the unit, 0.0254 m by"),
        (1, "cm", None),
    ],
)
def test_inches_taken_for_centimetres_are_told_of_and_tracked(
    scale: float, unit: str, told: str | None, put: Callable, capsys: pytest.CaptureFixture[str]
) -> None:
    metres = {"0.01": 0.01, "cm": 0.01, "in": 0.0254}[unit]
    whole = a_take(put("x", "").parent / "whole.csv", scale=scale / metres).read_text()
    take = put("take.csv", whole.replace("# unit: m\n", ""))
    assert main(["track", str(take), "--unit", unit, "-o", str(take.parent / "out.csv")]) == 0
    said = capsys.readouterr().err
    assert (told is None) == ("times too" not in said)
    if told is not None:
        assert told in said
        assert f"right? {'0.0254' if unit == '0.01' else '0.01'} m would do" in said


def test_of_two_files_both_are_written_or_none(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    hand = read(a_take(tmp_path / "take.csv"))
    files = {tmp_path / name: hand for name in ("left.csv", "right.trc")}

    def stopped(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr("numpy_infer.formats.trc.write", stopped)
        with pytest.raises(KeyboardInterrupt):
            write_all(files)
    assert [path.name for path in tmp_path.iterdir()] == ["take.csv"]
    write_all(files)
    assert all(path.exists() for path in files)


@pytest.mark.parametrize(
    ("more", "told"),
    [
        (["--smooth", "--as-measured"], "--as-measured writes what --smooth would smooth"),
        (["--left-prefix", "a", "--right-prefix", "a"], "are the same: which hand is it?"),
    ],
)
def test_options_that_contradict_each_other_are_refused(
    more: list[str], told: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    take = a_take(tmp_path / "take.csv")
    assert main(["track", str(take), "-o", str(tmp_path / "out.csv"), *more]) == 2
    assert told in capsys.readouterr().err


def test_what_a_file_has_to_say_is_said_when_it_is_tracked(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, right in (("bright_light", False), ("right_hand", True), ("MyRightHand", True)):
        take = a_take(tmp_path / f"{name}.csv")
        take.write_text(take.read_text().rstrip("\n"))
        assert main(["track", str(take), "-o", str(tmp_path / f"{name}_out.csv")]) == 0
        said = capsys.readouterr()
        assert "the last line has no line end; is the file cut off?" in said.err
        assert ("the file's name says right" in said.out) == right


def test_c3d_of_many_points_without_a_unit_and_with_rounded_times(tmp_path: Path) -> None:
    ezc3d = pytest.importorskip("ezc3d")
    names = [f"m{i}" for i in range(300)]
    markers = np.random.default_rng(0).normal(size=(100, 300, 3))
    time = np.round(np.arange(100) / 60, 3)
    path = tmp_path / "many.c3d"
    write(Recording(names, markers, time, 60, "made"), path)
    found = read(path)
    assert list(found.names) == names
    np.testing.assert_allclose(found.markers, markers, atol=1e-6)
    contents = ezc3d.c3d(str(path))
    contents["parameters"]["POINT"]["UNITS"]["value"] = []
    bare = tmp_path / "bare.c3d"
    contents.write(str(bare))
    with pytest.raises(ValueError, match=r"does not state its unit; pass --unit mm"):
        read(bare)
    np.testing.assert_allclose(read(bare, unit=1e-3).markers, markers, atol=1e-6)
