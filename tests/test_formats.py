"""Each format as its programs write it: what is read, what is a gap, what is refused and where."""

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from numpy_infer.formats.authors import read_hand_csv
from numpy_infer.formats.bvh import read_bvh
from numpy_infer.formats.units import metres
from numpy_infer.recordings import read

TRC = """PathFileType\t4\t(X/Y/Z)\ttake.trc
DataRate\tCameraRate\tNumFrames\tNumMarkers\tUnits\tOrigDataRate\tOrigDataStartFrame\tOrigNumFrames
100\t100\t3\t2\tmm\t100\t1\t3
Frame#\tTime\tS:a\t\t\tb\t
\t\tX0\tY0\tZ0\tX1\tY1\tZ1\t
1\t0\t1\t2\t3\t4\t5\t6\t
2\t0.01\t\t\t\t4\t5\t7\t
3\t0.02\t0\t0.0\t-0\tnan\t5\t8\t
"""

TSV = """NO_OF_FRAMES\t3\r
NO_OF_CAMERAS\t7\r
NO_OF_MARKERS\t2\r
FREQUENCY\t100\r
DATA_INCLUDED\t3D\r
MARKER_NAMES\ta\tb\r
TRAJECTORY_TYPES\tMeasured\tMixed\r
Frame\tTime\ta X\ta Y\ta Z\tb X\tb Y\tb Z\r
1\t0.00000\t1\t2\t3\t4\t5\t6\r
2\t0.01000\t0\t0\t0\t4\t5\t7\r
3\t0.02000\tNaN\tNaN\tNaN\tnan\tnan\tnan\r
"""

CSV = """# unit: mm
time,a.x,a.y,a.z,b.z,b.y,b.x,thumb_flexion.deg
0,1,2,3,6,5,4,10
0.01,,,,7,5,4,11
0.02,nan,nan,nan,,,,12
"""

MOTIVE = """Format Version,1.23,Take Name,Take 1,Take Notes,,Export Frame Rate,100.000000,\
Total Exported Frames,3,Rotation Type,Quaternion,Length Units,Millimeters,Coordinate Space,Global

,Type,Rigid Body,Rigid Body,Rigid Body Marker,Rigid Body Marker,Rigid Body Marker,Marker,Marker,\
Marker,Marker,Marker,Marker
,Name,Hand,Hand,Hand:a,Hand:a,Hand:a,"Hand:a","Hand:a","Hand:a",b,b,b
,ID,1,1,2,2,2,3,3,3,4,4,4
,Parent,,,1,1,1,,,,,,
,,Rotation,Position,Position,Position,Position,Position,Position,Position,Position,Position,Position
Frame,Time (Seconds),X,X,X,Y,Z,X,Y,Z,X,Y,Z
0,0.000000,0.1,9,9,9,9,1,2,3,4,5,6
1,0.010000,0.1,9,9,9,9,,,,4,5,7
2,0.020000,0.1,9,9,9,9,,,,,,
"""

BVH = """HIERARCHY
ROOT Wrist
{
\tOFFSET 0 0 0
\tCHANNELS 6 Xposition Yposition Zposition Yrotation Xrotation Zrotation
\tJOINT Finger
\t{
\t\tOFFSET 10 0 0
\t\tCHANNELS 3 Zrotation Xrotation Yrotation
\t\tJOINT Tip
\t\t{
\t\t\tOFFSET 0 5 0
\t\t\tEnd Site
\t\t\t{
\t\t\t\tOFFSET 0 0 0
\t\t\t}
\t\t}
\t}
}
MOTION
Frames: 2
Frame Time: 0.01
1 2 3 0 0 0 0 0 0
1 2 3 90 0 0 90 0 90
"""

MOCAP = """time,a.pos.x,a.pos.y,a.pos.z,a.isValid,b.pos.x,b.pos.y,b.pos.z,b.isValid
0,0.001,0.002,0.003,1,0.004,0.005,0.006,True
0.01,NaN,NaN,NaN,0,0.004,0.005,0.007,1
0.02,0.5,0.5,0.5,0,0.5,0.5,0.5,False
"""

FUSED = """time,j.pos.x,j.pos.y,j.pos.z,j.rot.x,j.rot.y,j.rot.z,isValid
0,1,2,3,0,0,0,1
0.01,1,2,3,30,40,50,1
0.02,1,2,3,0,0,0,0
"""

HAND = """marker,marker.pos.x,marker.pos.y,marker.pos.z,\
joint,joint.pos.x,joint.pos.y,joint.pos.z,alignment
M1,-0.01,-0.08,-0.03,j1,0,-0.08,-0.03,1
M2,0.01,0.02,0.03,j2,0.01,0.02,0.03,0
"""

EXAMPLES = {
    "take.trc": TRC,
    "take.tsv": TSV,
    "take.csv": CSV,
    "motive.csv": MOTIVE,
    "out_mocap_1.csv": MOCAP,
}
# What all of them say, in metres: a is hidden in frames 1 and 2, b in frame 2.
MARKERS = np.full((3, 2, 3), np.nan)
MARKERS[0] = np.array([[1, 2, 3], [4, 5, 6]]) / 1000
MARKERS[1, 1] = np.array([4, 5, 7]) / 1000


def turned(axis: str, degrees: float) -> np.ndarray:
    """Right-hand rule about an axis, written out by hand."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array(
        {
            "x": [[1, 0, 0], [0, c, -s], [0, s, c]],
            "y": [[c, 0, s], [0, 1, 0], [-s, 0, c]],
            "z": [[c, -s, 0], [s, c, 0], [0, 0, 1]],
        }[axis]
    )


@pytest.mark.parametrize("name", EXAMPLES)
def test_every_format_tells_the_same_story(name: str, put: Callable) -> None:
    recording = read(put(name, EXAMPLES[name]))
    reflected = [1, 1, -1] if name.startswith("out_mocap") else [1, 1, 1]
    assert recording.names == ("a", "b")
    assert recording.rate == pytest.approx(100)
    np.testing.assert_allclose(recording.time, [0, 0.01, 0.02])
    np.testing.assert_allclose(recording.markers, MARKERS * reflected, rtol=1e-12)


@pytest.mark.parametrize("name", EXAMPLES)
def test_left_handed_is_told_except_where_the_format_knows(name: str, put: Callable) -> None:
    path = put(name, EXAMPLES[name])
    told = read(path, left_handed=True)
    np.testing.assert_allclose(told.markers, MARKERS * [1, 1, -1], rtol=1e-12)


@pytest.mark.parametrize("name", EXAMPLES)
@given(data=st.data())
def test_a_ragged_row_is_named_with_its_line(
    name: str, data: st.DataObject, tmp_path_factory: pytest.TempPathFactory
) -> None:
    lines = EXAMPLES[name].replace("\r", "").splitlines()
    row = data.draw(st.integers(len(lines) - 3, len(lines) - 1))
    delimiter = "," if name.endswith(".csv") else "\t"
    cells = lines[row].removesuffix("\t").split(delimiter)
    if data.draw(st.booleans()):
        del cells[data.draw(st.integers(0, len(cells) - 1))]
        found = len(cells)
    else:
        cells.append("1")
        found = len(cells)
    lines[row] = delimiter.join(cells)
    path = tmp_path_factory.mktemp("ragged") / name
    path.write_text("\n".join(lines) + "\n")
    with pytest.raises(ValueError, match=rf"{name}:{row + 1}: expected \d+ columns, found {found}"):
        read(path)


# (file, text to replace, replacement, line, message)
DAMAGE = [
    ("take.trc", "PathFileType", "Path", 1, "starts with PathFileType"),
    ("take.trc", "\tmm\t", "\tfurlong\t", 3, "unknown unit 'furlong'"),
    ("take.trc", "\tmm\t", "\t\t", 3, "no Units"),
    ("take.trc", "\t3\t2\tmm", "\tmany\t2\tmm", 3, "NumFrames: expected a positive number"),
    ("take.trc", "\t3\t2\tmm", "\t3\t3\tmm", 4, "states 3 markers, found 2"),
    ("take.trc", "\t3\t2\tmm", "\t4\t2\tmm", 8, "states 4 frames, found 3"),
    ("take.trc", "\t3\t2\tmm", "\t2\t2\tmm", 8, "states 2 frames, found 3"),
    ("take.trc", "\tb\t", "\tS:a\t", 4, "duplicate marker 'S:a'"),
    ("take.trc", "S:a\t\t\tb", "S:a\tc\t\tb", 4, "found 'c' between"),
    ("take.trc", "S:a\t\t\tb", "\t\t\tb", 4, "marker 1 has no name"),
    ("take.trc", "2\t0.01", "2\t", 7, "the time is missing"),
    ("take.trc", "5\t7", "5\tseven", 7, "column 8: expected a number, found 'seven'"),
    ("take.trc", TRC[TRC.index("1\t0\t1") :], "", 5, "no frames"),
    ("take.trc", TRC[TRC.index("Frame#") :], "", 3, "ends inside its header"),
    ("take.tsv", "MARKER_NAMES", "MARKERS", 1, "no MARKER_NAMES"),
    ("take.tsv", "\ta\tb", "\ta\ta", 6, "duplicate marker 'a'"),
    ("take.tsv", "MARKERS\t2", "MARKERS\t3", 6, "states 3 markers, found 2"),
    ("take.tsv", "FREQUENCY\t100", "FREQUENCY\t0", 4, "expected a positive number, found '0'"),
    ("take.tsv", "FREQUENCY\t100\r\n", "", 1, "no FREQUENCY"),
    ("take.tsv", "INCLUDED\t3D", "INCLUDED\t6D", 5, "expected DATA_INCLUDED 3D"),
    ("take.tsv", "\tMixed", "", 7, "expected 2 trajectory types, found 1"),
    ("take.tsv", "FRAMES\t3", "FRAMES\t9", 11, "states 9 frames, found 3"),
    ("take.tsv", "0.01000", "nan", 10, "the time is missing"),
    ("take.tsv", "5\t7", "5\t1_0", 10, "column 8: expected a number, found '1_0'"),
    ("take.tsv", TSV[TSV.index("Frame") :], "", 7, "ends inside its header"),
    ("take.csv", "time", "frame", 2, "expected the first column to be time"),
    (
        "take.csv",
        CSV[CSV.index("time") :],
        CSV[CSV.index("time") :].replace(",", "\t"),
        2,
        "by tabs, not by",
    ),
    ("take.csv", "time", "\ntime", 2, "the line is empty where the header should be"),
    ("take.csv", CSV, "a letter\n", 1, "expected the first column to be time, found 'a letter'"),
    (
        "take.trc",
        TRC[: TRC.index("Frame#")],
        TRC[: TRC.index("Frame#")].replace("\t", " "),
        3,
        "expected tabs",
    ),
    ("take.csv", "unit: mm", "unit: hand", 1, "unknown unit 'hand'"),
    ("take.csv", ".deg", ".angle", 2, "unknown column 'thumb_flexion.angle'"),
    ("take.csv", "b.z", "a.z", 2, "duplicate column 'a.z'"),
    ("take.csv", "b.z", "c.z", 2, "marker 'c' has no column c.x"),
    ("take.csv", "b.z", "b.w", 2, "unknown column 'b.w'"),
    ("take.csv", "\n0.01,", "\n,", 4, "the time is missing"),
    ("take.csv", ",7,", ",x,", 4, "column 5: expected a number, found 'x'"),
    ("take.csv", CSV[CSV.index("time") :], "", 1, "comments and no header"),
    ("motive.csv", "Millimeters", "Cubits", 1, "unknown unit 'Cubits'"),
    ("motive.csv", "Length Units", "Length", 1, "Length Units"),
    ("motive.csv", "Global", "Local", 1, "export it as Global"),
    ("motive.csv", "Export Frame Rate", "Rate", 1, "no Export Frame Rate"),
    ("motive.csv", "Frames,3", "Frames,4", 11, "states 4 frames, found 3"),
    ("motive.csv", ",b,b,b", ",Hand:a,Hand:a,Hand:a", 4, "duplicate marker 'Hand:a'"),
    ("motive.csv", ",b,b,b", ",,,", 4, "marker 2 has no name"),
    ("motive.csv", "X,Y,Z\n", "X,Y,W\n", 4, "marker 'b': expected axes X, Y, Z"),
    ("motive.csv", ",Type", ",Kind", 8, "no ['Type']"),
    ("motive.csv", "\n1,0.010000", "\n1,", 10, "the time is missing"),
    ("motive.csv", ",7\n", ",-\n", 10, "column 13: expected a number, found '-'"),
    ("motive.csv", MOTIVE[MOTIVE.index("Frame,Time") :], "", 7, "ends inside its header"),
    ("out_mocap_1.csv", "b.isValid", "b.valid", 1, "unknown: b.valid; missing: b.isValid"),
    ("out_mocap_1.csv", "b.pos.x", "a.pos.x", 1, "duplicate column 'a.pos.x'"),
    ("out_mocap_1.csv", "time,", "t,", 1, "unknown: t; missing: time"),
    ("out_mocap_1.csv", "0.007", "O.OO7", 3, "column 8: expected a number"),
    ("out_mocap_1.csv", "\n0.01", "\nNaN", 3, "the time is missing"),
    ("take.bvh", "HIERARCHY", "HIERARCHIE", 1, "starts with HIERARCHY"),
    ("take.bvh", "JOINT Tip", "JOINT Finger", 10, "duplicate joint 'Finger'"),
    ("take.bvh", "OFFSET 10 0 0", "OFFSET 10 0", 8, "expected 3 numbers, found '10 0'"),
    ("take.bvh", "OFFSET 10 0 0", "", 12, "one OFFSET per joint"),
    ("take.bvh", "CHANNELS 3", "CHANNELS 2", 9, "states 2, found 3"),
    ("take.bvh", "Xrotation Yrotation", "Xrotation Wrotation", 9, "unknown channel 'Wrotation'"),
    ("take.bvh", "Zrotation\n", "Zscale\n", 5, "unknown channel 'Zscale'"),
    ("take.bvh", "End Site", "Site", 13, "not expected here: 'Site'"),
    ("take.bvh", "}\nMOTION", "MOTION", 19, "not expected here: 'MOTION'"),
    ("take.bvh", BVH[BVH.index("MOTION") :], "", 19, "ends inside its HIERARCHY"),
    ("take.bvh", "Frames: 2", "Frames: 3", 24, "states 3 frames, found 2"),
    ("take.bvh", "Frames: 2", "Frame: 2", 21, "expected 'Frames:'"),
    ("take.bvh", "0.01", "-0.01", 22, "Frame Time:: expected a positive number"),
    ("take.bvh", "90 0 90\n", "90 0\n", 24, "expected 9 columns, found 8"),
    ("take.bvh", "90 0 90\n", "90 0 nan\n", 24, "not a finite number"),
    ("take.bvh", "90 0 90\n", "90 0 right\n", 24, "column 9: expected a number"),
]


@pytest.mark.parametrize(("name", "old", "new", "line", "message"), DAMAGE)
def test_damage_is_named_with_its_line(
    name: str, old: str, new: str, line: int, message: str, put: Callable
) -> None:
    text = {**EXAMPLES, "take.bvh": BVH}[name]
    assert old in text
    path = put(name, text.replace(old, new, 1))
    with pytest.raises(ValueError, match=r".") as caught:
        read(path, unit=0.01 if name.endswith(".bvh") else None)
    assert message in str(caught.value)
    assert str(caught.value).startswith(f"{path}:{line}: ")


@pytest.mark.parametrize("name", [*EXAMPLES, "take.bvh"])
def test_empty_and_foreign_files_are_refused(name: str, put: Callable) -> None:
    for content in ("", "\n \n", "hello", "\t\t\n,,\n"):
        with pytest.raises(ValueError, match=name.replace(".", r"\.")):
            read(put(name, content), unit=0.01)
    (path := put(name, "")).write_bytes(b"time\n\xff\xfe\x00")
    with pytest.raises(ValueError, match=r":2: not UTF-8 text"):
        read(path, unit=1e-3 if name.endswith(("trc", "tsv")) else 1.0)


@pytest.mark.parametrize(("unit", "metres"), [("m", 1.0), ("cm", 0.01), ("MM", 0.001)])
def test_trc_units(unit: str, metres: float, put: Callable) -> None:
    recording = read(put("take.trc", TRC.replace("\tmm\t", f"\t{unit}\t")))
    np.testing.assert_allclose(recording.markers[0, 0], np.array([1, 2, 3]) * metres)


def test_trc_and_tsv_count_the_zeros_that_they_take_as_gaps(put: Callable) -> None:
    for name in ("take.trc", "take.tsv"):
        assert (
            "1 positions of exactly 0 0 0 are taken as gaps"
            in read(put(name, EXAMPLES[name])).notes
        )


def test_trc_may_have_a_blank_line_before_its_frames(put: Callable) -> None:
    spaced = TRC.replace("Z1\t\n", "Z1\t\n\t\n")
    np.testing.assert_array_equal(read(put("b.trc", spaced)).time, read(put("a.trc", TRC)).time)


def test_trc_frames_that_are_left_out_are_noted(put: Callable) -> None:
    """SIG18 drops frames and states how many there were: a jump in Frame# is no truncation."""
    recording = read(put("take.trc", TRC.replace("\n2\t0.01\t\t\t\t4\t5\t7\t", "")))
    np.testing.assert_array_equal(recording.time, [0, 0.02])
    assert "1 of 3 frames are left out: time jumps" in recording.notes


def test_qualisys_flags_what_is_not_measured(put: Callable) -> None:
    recording = read(put("take.tsv", TSV))
    assert recording.filled == ("b",)
    assert "not purely measured: b" in recording.notes


def test_qualisys_may_lack_its_column_names_or_frame_and_time(put: Callable) -> None:
    whole = read(put("whole.tsv", TSV))
    lines = TSV.splitlines(keepends=True)
    bare = [line.split("\t", 2)[2] for line in lines[8:]]
    for name, text in {
        "untitled.tsv": lines[:7] + lines[8:],
        "bare.tsv": [*lines[:7], "a X\ta Y\ta Z\tb X\tb Y\tb Z\n", *bare],
        "both.tsv": lines[:7] + bare,
        "untyped.tsv": lines[:6] + lines[7:],
    }.items():
        recording = read(put(name, "".join(text)))
        np.testing.assert_array_equal(recording.markers, whole.markers)
        np.testing.assert_allclose(recording.time, whole.time)


def test_plain_csv_without_a_unit_asks_for_it(put: Callable) -> None:
    path = put("take.csv", CSV.removeprefix("# unit: mm\n"))
    with pytest.raises(ValueError, match="does not state its unit; pass --unit mm "):
        read(path)
    np.testing.assert_allclose(read(path, unit=1e-3).markers, MARKERS)


@given(
    st.sampled_from([("mm", 1e-3), ("cm", 1e-2), ("M", 1.0), (" in ", 0.0254), ("feet", 0.3048)])
    | st.floats(1e-9, 1e5).map(lambda number: (repr(number), number))
)
def test_a_user_names_a_unit_or_says_how_many_metres_it_is(said: tuple[str, float]) -> None:
    text, wanted = said
    assert metres(text) == wanted


@pytest.mark.parametrize("text", ["furlong", "", "0", "-1", "nan", "inf", "1e6", "1 mm"])
def test_what_is_no_unit_is_refused_with_what_would_be(text: str) -> None:
    with pytest.raises(ValueError, match=r"unit: expected mm, cm, m, in, .*, got '") as error:
        metres(text)
    assert repr(text) in str(error.value)


ZEROS = """# unit: mm
time,a.x,a.y,a.z,b.x,b.y,b.z,c.x,c.y,c.z
0,200,1,2,0,0,0,0,0,0
0.01,0,0.0,-0,1,0,500,0,0,0
0.02,201,1,2,0,0,501,0,0,0
"""


def test_plain_csv_takes_zeros_as_gaps_where_markers_jump_there(put: Callable) -> None:
    recording = read(put("take.csv", ZEROS))
    seen = [[True, False, False], [False, True, False], [True, True, False]]
    np.testing.assert_array_equal(recording.visible, seen)
    assert "5 positions of exactly 0 0 0 are taken as gaps" in recording.notes
    ours = read(put("ours.csv", f"# gaps: blank\n{ZEROS}"))
    assert ours.visible.all()
    assert not ours.notes
    for near in ("99", "-99"):  # millimetres: what a marker may go in a frame
        passing = ZEROS.replace("200", near).replace("201", near)
        passing = passing.replace("500", near).replace("501", near)
        recording = read(put("passing.csv", passing))
        assert recording.visible.all()
        assert not recording.notes


def test_plain_csv_notes_the_angles_that_it_skips(put: Callable) -> None:
    assert "1 columns of tracking (.deg) are not markers" in read(put("take.csv", CSV)).notes


def test_plain_csv_of_one_frame_needs_a_rate(put: Callable) -> None:
    one = "# unit: m\ntime,a.x,a.y,a.z\n0,1,2,3\n"
    with pytest.raises(ValueError, match=r"no rate: .* a line '# rate: 60' before the header"):
        read(put("take.csv", one))
    assert read(put("take.csv", "# rate: 50\n" + one)).rate == 50


def test_motive_takes_measured_markers_only(put: Callable) -> None:
    recording = read(put("take.csv", MOTIVE))
    assert recording.filled == ()
    assert recording.notes == (
        "2 columns of Type Rigid Body are solved, not measured, and left out",
        "3 columns of Type Rigid Body Marker are solved, not measured, and left out",
    )
    solved_only = MOTIVE.replace(",Marker", ",Bone Marker")
    with pytest.raises(ValueError, match=r"measured ones; there are .*Bone Marker"):
        read(put("take.csv", solved_only))


def test_bvh_needs_a_unit(put: Callable) -> None:
    with pytest.raises(ValueError, match=r"take\.bvh: the file does not state its unit"):
        read(put("take.bvh", BVH))


def test_bvh_rotations_apply_in_the_order_of_their_channels(put: Callable) -> None:
    recording = read(put("take.bvh", BVH), unit=0.01)
    assert recording.names == ("Wrist", "Finger", "Tip")
    assert recording.rate == pytest.approx(100)
    wrist = np.array([1, 2, 3]) / 100
    np.testing.assert_allclose(
        recording.markers[0], wrist + np.array([[0, 0, 0], [0.1, 0, 0], [0.1, 0.05, 0]])
    )
    wrist_turn = turned("y", 90)
    finger_turn = wrist_turn @ turned("z", 90) @ turned("x", 0) @ turned("y", 90)
    finger = wrist + wrist_turn @ [0.1, 0, 0]
    tip = finger + finger_turn @ [0, 0.05, 0]
    np.testing.assert_allclose(recording.markers[1], [wrist, finger, tip], atol=1e-15)
    assert recording.joints is not None
    np.testing.assert_array_equal(recording.joints.positions, recording.markers)
    np.testing.assert_allclose(recording.joints.rotations[1, 2], finger_turn, atol=1e-15)


def test_bvh_joints_hang_together(put: Callable) -> None:
    """Bone lengths never change, and each position follows from its parent's pose."""
    bvh = read_bvh(put("take.bvh", BVH))
    positions, rotations = bvh.forward()
    np.testing.assert_array_equal(bvh.parents, [-1, 0, 1])
    np.testing.assert_array_equal(bvh.end_parents, [2])
    np.testing.assert_array_equal(bvh.end_offsets, [[0, 0, 0]])
    for joint in (1, 2):
        parent = bvh.parents[joint]
        expected = positions[:, parent] + rotations[:, parent] @ bvh.offsets[joint]
        np.testing.assert_allclose(positions[:, joint], expected, atol=1e-12)


def test_authors_fused_rotations_are_local_truth(put: Callable) -> None:
    path = put("out_mocap_1.csv", MOCAP)
    assert read(path).joints is None
    put("out_fused_1.csv", FUSED)
    recording = read(path)
    joints = recording.joints
    assert joints is not None
    assert (joints.names, joints.frame) == (("j",), "local")
    assert "joints come from out_fused_1.csv" in recording.notes
    np.testing.assert_allclose(joints.positions[:2, 0], [[1, 2, -3]] * 2)
    assert np.isnan(joints.positions[2]).all()
    assert np.isnan(joints.rotations[2]).all()
    mirror = np.diag([1, 1, -1])
    expected = mirror @ turned("y", 40) @ turned("x", 30) @ turned("z", 50) @ mirror
    np.testing.assert_allclose(joints.rotations[1, 0], expected, atol=1e-15)


def test_authors_fused_file_at_other_times_is_ignored_and_noted(put: Callable) -> None:
    put("out_fused_1.csv", FUSED.replace("\n0.01", "\n0.015"))
    recording = read(put("out_mocap_1.csv", MOCAP))
    assert recording.joints is None
    assert any("out_fused_1.csv is ignored" in note for note in recording.notes)


def test_authors_fused_file_that_is_damaged_is_refused(put: Callable) -> None:
    path = put("out_mocap_1.csv", MOCAP)
    put("out_fused_1.csv", FUSED.replace("30,40", "30"))
    with pytest.raises(ValueError, match=r"out_fused_1\.csv:3: expected 8 columns, found 7"):
        read(path)


def test_hand_csv_is_reflected_and_otherwise_untouched(put: Callable) -> None:
    hand = read_hand_csv(put("hand.csv", HAND))
    assert (hand.marker_names, hand.joint_names) == (("M1", "M2"), ("j1", "j2"))
    np.testing.assert_array_equal(hand.markers, [[-0.01, -0.08, 0.03], [0.01, 0.02, -0.03]])
    np.testing.assert_array_equal(hand.joints, [[0, -0.08, 0.03], [0.01, 0.02, -0.03]])
    np.testing.assert_array_equal(hand.alignment, [True, False])


@pytest.mark.parametrize(
    ("old", "new", "line", "message"),
    [
        ("alignment", "align", 1, "expected the columns marker,"),
        ("M2", "M1", 1, "duplicate marker 'M1'"),
        ("j1,0,", "j1,", 2, "expected 9 columns, found 8"),
        ("j1,0,", "j1,zero,", 2, "expected numbers"),
        (",0.03,0\n", ",0.03,maybe\n", 3, "alignment: expected 0 or 1, found 'maybe'"),
        (HAND[HAND.index("M1") :], "", 1, "no markers"),
    ],
)
def test_a_damaged_hand_csv_is_refused(
    old: str, new: str, line: int, message: str, put: Callable
) -> None:
    assert old in HAND
    path = put("hand.csv", HAND.replace(old, new, 1))
    with pytest.raises(ValueError, match=message) as caught:
        read_hand_csv(path)
    assert str(caught.value).startswith(f"{path}:{line}: ")
