"""Files that are odd, and long ones."""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from numpy_infer.recordings import Recording, doubted_time, read, write

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
