"""Laws of recordings: what any reader gives, what any writer keeps, what any damage does."""

import sys
import tomllib
from dataclasses import replace
from importlib.metadata import EntryPoint
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxhand import c3d
from numpy_infer import recordings
from numpy_infer.formats import plain_csv, qualisys, trc
from numpy_infer.formats.authors import read_hand_csv
from numpy_infer.pose import Status
from numpy_infer.recordings import JointTruth, Recording, median_rate, read, write, writer_of

# Metres lost by writing and reading: CSV keeps every digit, TRC and TSV nanometres, C3D float32.
PRECISION = {".csv": 0.0, ".trc": 2e-9, ".tsv": 2e-9, ".c3d": 2e-6}
WRITERS = {".csv": plain_csv, ".trc": trc, ".tsv": qualisys}
NEEDS_EZC3D = pytest.mark.skipif(find_spec("ezc3d") is None, reason="needs the extra c3d")
ALL_WRITERS = [*WRITERS, pytest.param(".c3d", marks=NEEDS_EZC3D)]
NAMES = st.text("abcXYZ019_.-é ", min_size=1, max_size=8).filter(lambda name: name == name.strip())


@st.composite
def a_recording(
    draw: st.DrawFn, evenly: bool = False, names: st.SearchStrategy = NAMES
) -> Recording:
    """1-6 frames of 1-4 markers within 10 m, some of them hidden, perhaps at the origin."""
    frames, labels = (
        draw(st.integers(1, 6)),
        draw(st.lists(names, min_size=1, max_size=4, unique=True)),
    )
    coordinate = st.one_of(st.just(0.0), st.floats(-10, 10, allow_subnormal=False))
    size = frames * len(labels)
    flat = draw(st.lists(coordinate, min_size=3 * size, max_size=3 * size))
    hidden = draw(st.lists(st.booleans(), min_size=size, max_size=size))
    markers = np.array(flat).reshape(frames, len(labels), 3)
    markers[np.array(hidden).reshape(frames, -1)] = np.nan
    rate = draw(st.sampled_from([1.0, 59.94, 100.0, 120.0, 1000 / 3]))
    time = np.arange(frames) / rate
    if not evenly:
        time = time + draw(st.floats(0, 1e4))
        time[-1] += draw(st.sampled_from([0.0, 1 / 3, -0.25]))
    return Recording(tuple(labels), markers, time, rate, "drawn")


@pytest.fixture
def c3d_declared(monkeypatch: pytest.MonkeyPatch) -> None:
    """C3D as an installed jaxhand declares it, so that a bare checkout tests the same."""
    point = EntryPoint("c3d", "jaxhand.c3d", "jaxhand.recordings")
    monkeypatch.setattr(recordings, "entry_points", lambda group: [point])


def small(**changes: object) -> Recording:
    """Three frames of markers a, b at 100 Hz; b is hidden in the last."""
    markers = np.arange(18.0).reshape(3, 2, 3) / 8 + 1
    markers[2, 1] = np.nan
    values = {
        "names": ("a", "b"),
        "markers": markers,
        "time": np.arange(3) / 100,
        "rate": 100.0,
        "source": "small",
        **changes,
    }
    return Recording(**values)  # type: ignore[arg-type]


def assert_same(got: Recording, expected: Recording, tolerance: float) -> None:
    assert got.names == expected.names
    assert got.rate == pytest.approx(expected.rate, rel=1e-6 if tolerance > 1e-6 else 1e-15)
    np.testing.assert_array_equal(got.visible, expected.visible)
    np.testing.assert_array_equal(np.isnan(got.markers).all(-1), ~expected.visible)
    np.testing.assert_allclose(got.markers, expected.markers, rtol=0, atol=tolerance)


@pytest.mark.parametrize("suffix", WRITERS)
@given(data=st.data())
def test_what_is_written_reads_back(
    suffix: str, data: st.DataObject, tmp_path_factory: pytest.TempPathFactory
) -> None:
    recording = data.draw(a_recording())
    path = tmp_path_factory.mktemp("round") / f"take{suffix}"
    write(recording, path)
    got = read(path)
    assert_same(got, recording, PRECISION[suffix])
    np.testing.assert_array_equal(got.time, recording.time)
    assert list(path.parent.iterdir()) == [path]


@given(data=st.data())
def test_what_tracking_says_is_written_beside_the_markers(
    data: st.DataObject, tmp_path_factory: pytest.TempPathFactory
) -> None:
    """And read as what it is: other columns, in a file of the same markers."""
    recording = data.draw(a_recording())
    shape = recording.markers.shape[:2]
    rng = np.random.default_rng(data.draw(st.integers(0, 99)))
    status, off = rng.integers(len(Status), size=shape), rng.random(shape).round(6)
    status[:, 0] = 0
    wrist = rng.standard_normal((len(status), 7)).round(9)
    path = tmp_path_factory.mktemp("round") / "take.csv"
    write(replace(recording, wrist=wrist, status=status, expected_error=off), path)
    got = read(path)
    assert_same(got, recording, 0.0)
    np.testing.assert_array_equal(got.time, recording.time)
    made_up = (recording.visible & (status > 0)).any(0)
    assert got.filled == tuple(np.array(recording.names)[made_up])
    np.testing.assert_array_equal(got.status, np.where(recording.visible, status, np.nan))
    measured = got.measured()
    np.testing.assert_array_equal(measured.visible, recording.visible & (status == 0))
    np.testing.assert_array_equal(
        measured.markers, np.where(measured.visible[..., None], recording.markers, np.nan)
    )
    assert (measured.status, measured.filled) == (None, ())
    assert recording.measured() is recording
    lines = path.read_text("utf-8").splitlines()
    assert "# status: 0 observed, 1 predicted, 2 held, 3 rejected" in lines
    header, *rows = (line.split(",") for line in lines if not line.startswith("#"))
    first = header.index("wrist_x.pose")
    assert header[first + 6] == "wrist_qw.pose"
    np.testing.assert_array_equal(np.array([row[first : first + 7] for row in rows], float), wrist)
    for i, name in enumerate(recording.names):
        for wanted, kind in ((status, "status"), (off, "expected_error")):
            column = [row[header.index(f"{name}.{kind}")] for row in rows]
            blank = ~recording.visible[:, i]
            told = np.array([float(cell or "nan") for cell in column])
            np.testing.assert_array_equal(told, np.where(blank, np.nan, wanted[:, i]))
    chosen = replace(recording, status=status, expected_error=off).select(recording.names[::-1])
    np.testing.assert_array_equal(chosen.status, status[:, ::-1])
    np.testing.assert_array_equal(chosen.expected_error, off[:, ::-1])


@NEEDS_EZC3D
@given(recording=a_recording(evenly=True, names=st.text("abcXYZ019_.-", min_size=1, max_size=8)))
def test_c3d_reads_back(recording: Recording, tmp_path_factory: pytest.TempPathFactory) -> None:
    path = tmp_path_factory.mktemp("round") / "take.c3d"
    c3d.write(recording, path)
    got = c3d.read(path)
    assert_same(got, recording, PRECISION[".c3d"])
    np.testing.assert_allclose(got.time, recording.time, rtol=1e-6)


@pytest.mark.parametrize("suffix", WRITERS)
@given(data=st.data())
def test_a_file_cut_off_anywhere_is_refused_or_noted(
    suffix: str, data: st.DataObject, tmp_path_factory: pytest.TempPathFactory
) -> None:
    path = tmp_path_factory.mktemp("cut") / f"take{suffix}"
    write(data.draw(a_recording()), path)
    whole = path.read_bytes()
    path.write_bytes(whole[: data.draw(st.integers(0, len(whole) - 1))])
    try:
        outcome = read(path).notes
    except ValueError as error:
        outcome = (str(error),)
        told = str(path) in str(error)
    else:
        told = any("cut off" in note for note in outcome)
    assert told, outcome


@pytest.mark.parametrize("suffix", WRITERS)
def test_line_ends_bom_and_empty_last_lines_do_not_matter(suffix: str, tmp_path: Path) -> None:
    plain, dressed = tmp_path / f"plain{suffix}", tmp_path / f"dressed{suffix}"
    write(small(), plain)
    dressed.write_bytes(
        b"\xef\xbb\xbf" + plain.read_bytes().replace(b"\n", b"\r\n") + b"\r\n  \r\n"
    )
    assert_same(read(dressed), read(plain), 0.0)
    assert read(dressed).notes == read(plain).notes


@pytest.mark.parametrize("suffix", ALL_WRITERS)
def test_left_handed_negates_z_and_nothing_else(
    suffix: str, tmp_path: Path, c3d_declared: None
) -> None:
    path = tmp_path / f"take{suffix}"
    write(small(), path)
    as_is, reflected = read(path), read(path, left_handed=True)
    np.testing.assert_array_equal(reflected.markers, as_is.markers * [1, 1, -1])
    assert_same(reflected.reflected(), as_is, 0.0)


def test_reflected_rotations_turn_reflected_points() -> None:
    turn = np.array([[0.0, -1, 0], [0.6, 0, -0.8], [0.8, 0, 0.6]])
    point = np.array([1.0, 2, 3])
    truth = JointTruth(("j",), point[None, None], turn[None, None]).reflected()
    mirrored = truth.rotations[0, 0] @ truth.positions[0, 0]
    np.testing.assert_allclose(mirrored, (turn @ point) * [1, 1, -1])
    assert np.linalg.det(truth.rotations[0, 0]) == pytest.approx(1)


@pytest.mark.parametrize("suffix", ALL_WRITERS)
def test_units_may_be_confirmed_but_not_contradicted(
    suffix: str, tmp_path: Path, c3d_declared: None
) -> None:
    path = tmp_path / f"take{suffix}"
    write(small(), path)
    stated = 1.0 if suffix == ".csv" else 1e-3
    assert_same(read(path, unit=stated), read(path), 0.0)
    told = rf"take.* states {stated:g} m as its unit, and 0\.01 m was given: .*, correct it there"
    with pytest.raises(ValueError, match=told):
        read(path, unit=0.01)


@pytest.mark.parametrize("name", ["takes", "take.csv"])
def test_a_folder_is_no_recording(name: str, tmp_path: Path) -> None:
    (tmp_path / name).mkdir()
    with pytest.raises(ValueError, match=f"{name} is a folder: name one of its files"):
        read(tmp_path / name)


@pytest.mark.parametrize("unit", [0.0, -1.0, float("nan"), float("inf")])
def test_a_unit_is_a_positive_number(unit: float, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="unit: expected metres"):
        read(tmp_path / "any.trc", unit=unit)


def test_hidden_means_any_coordinate_is_not_finite() -> None:
    markers = np.ones((3, 2, 3))
    markers[0, 0, 1], markers[1, 1, 2] = np.nan, np.inf
    visible = small(markers=markers).visible
    np.testing.assert_array_equal(visible, [[False, True], [True, False], [True, True]])


@pytest.mark.parametrize("suffix", ALL_WRITERS)
def test_a_half_hidden_marker_is_written_as_a_gap(
    suffix: str, tmp_path: Path, c3d_declared: None
) -> None:
    markers = np.ones((3, 2, 3))
    markers[0, 0, 1], markers[1, 1, 2] = np.nan, np.inf
    recording = small(markers=markers)
    write(recording, tmp_path / f"take{suffix}")
    got = read(tmp_path / f"take{suffix}")
    assert np.isnan(got.markers[~recording.visible]).all()
    np.testing.assert_array_equal(got.visible, recording.visible)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"names": ("a", "a")}, "duplicate marker name 'a'"),
        ({"names": ("a",)}, r"markers: expected shape \(3, 1, 3\), got \(3, 2, 3\)"),
        ({"status": np.zeros((3, 1))}, r"status: expected shape \(3, 2\), got \(3, 1\)"),
        ({"wrist": np.zeros((3, 6))}, r"wrist: expected shape \(3, 7\), got \(3, 6\)"),
        ({"markers": np.zeros((3, 2))}, "markers: expected shape"),
        ({"time": [0.0, np.nan, 1.0]}, "time: frame 1"),
        ({"time": [0.0, 1.0]}, "markers: expected shape"),
        ({"time": [], "markers": np.zeros((0, 2, 3))}, "at least one frame"),
        ({"names": (), "markers": np.zeros((3, 0, 3))}, "at least one frame"),
        ({"rate": 0.0}, "rate"),
        ({"rate": float("nan")}, "rate"),
        ({"filled": ("c",)}, "filled: no marker c; there are a, b"),
        ({"joints": JointTruth(("j",), np.zeros((2, 1, 3)), np.zeros((2, 1, 3, 3)))}, "3 frames"),
    ],
)
def test_a_recording_refuses_what_does_not_fit(changes: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        small(**changes)


@pytest.mark.parametrize(
    ("names", "positions", "rotations", "frame", "message"),
    [
        (("j", "j"), (3, 2, 3), (3, 2, 3, 3), "world", "duplicate joint name 'j'"),
        (("j",), (3, 2, 3), (3, 1, 3, 3), "world", "positions: expected shape"),
        (("j",), (3, 1, 3), (3, 1, 3), "world", "rotations: expected shape"),
        (("j",), (3, 1, 3), (3, 1, 3, 3), "wrist", "frame: expected 'world' or 'local'"),
    ],
)
def test_joint_truth_refuses_what_does_not_fit(
    names: tuple, positions: tuple, rotations: tuple, frame: str, message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        JointTruth(names, np.zeros(positions), np.zeros(rotations), frame)


def test_select_reorders_and_lists_what_is_missing_and_what_is_there() -> None:
    recording = small(filled=("a",))
    chosen = recording.select(["b", "a"])
    assert (chosen.names, chosen.filled) == (("b", "a"), ("a",))
    np.testing.assert_array_equal(chosen.markers, recording.markers[:, ::-1])
    assert recording.select(["b"]).filled == ()
    with pytest.raises(ValueError, match="small: no marker c, d; there are a, b"):
        recording.select(["a", "c", "d"])


def test_rename_keeps_the_rest_and_refuses_unknown_names_and_collisions() -> None:
    renamed = small(filled=("a",)).rename({"a": "thumb"})
    assert (renamed.names, renamed.filled) == (("thumb", "b"), ("thumb",))
    with pytest.raises(ValueError, match="no marker c"):
        small().rename({"c": "thumb"})
    with pytest.raises(ValueError, match="duplicate marker name 'b'"):
        small().rename({"a": "b"})


def csv_with(path: Path, *labels: str) -> Path:
    columns = ",".join(f"{label}.{axis}" for label in labels for axis in "xyz")
    path.write_text(f"# unit: m\n# rate: 10\ntime,{columns}\n0{',1' * 3 * len(labels)}\n")
    return path


def test_prefixes_are_stripped_and_labels_mapped(tmp_path: Path) -> None:
    path = csv_with(tmp_path / "take.csv", "Hand:a", "Hand:b", "c")
    assert read(path).names == ("a", "b", "c")
    assert read(path, label_map={"Hand:a": "thumb", "b": "index"}).names == ("thumb", "index", "c")
    there = "Hand:a, Hand:b, c, a, b$"
    with pytest.raises(ValueError, match=f"label map: no marker Foot:a; there are {there}"):
        read(path, label_map={"Foot:a": "thumb"})


def test_prefixes_that_alone_tell_labels_apart_are_kept(tmp_path: Path) -> None:
    path = csv_with(tmp_path / "take.csv", "Left:a", "Right:a", "Right:b", "c")
    assert read(path).names == ("Left:a", "Right:a", "Right:b", "c")
    assert read(path, label_map={"Right:a": "other"}).names == ("a", "other", "b", "c")
    with pytest.raises(ValueError, match="duplicate marker name 'x', from 'Left:a' and 'Right:a'"):
        read(path, label_map={"a": "x"})


def test_writing_replaces_a_file_only_when_told(tmp_path: Path) -> None:
    path = tmp_path / "take.csv"
    path.write_text("precious")
    with pytest.raises(FileExistsError, match="overwrite=True"):
        write(small(), path)
    assert path.read_text() == "precious"
    write(small(), path, overwrite=True)
    assert_same(read(path), small(), 0.0)


def test_a_failed_write_leaves_what_was_there(tmp_path: Path) -> None:
    path = tmp_path / "take.trc"
    path.write_text("precious")
    with pytest.raises(ValueError, match="cannot be written"):
        write(small(names=("a", "b\tc")), path, overwrite=True)
    assert path.read_text() == "precious"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("suffix", WRITERS)
@pytest.mark.parametrize("name", ["", " a", "a\tb", "a\nb", "a,b", "S:a", 'a"', "#a"])
def test_names_that_would_not_come_back_are_not_written(
    suffix: str, name: str, tmp_path: Path
) -> None:
    with pytest.raises(ValueError, match="cannot be written"):
        write(small(names=("a", name)), tmp_path / f"take{suffix}")


def test_unknown_suffixes_and_formats_list_the_known_ones(
    tmp_path: Path, c3d_declared: None
) -> None:
    with pytest.raises(ValueError, match=r"'\.fbx'; known: \.bvh, \.c3d, \.csv, \.trc, \.tsv"):
        read(tmp_path / "take.fbx")
    with pytest.raises(ValueError, match=r"'\.bvh'; known: \.c3d, \.csv, \.trc, \.tsv"):
        write(small(), tmp_path / "take.bvh")
    with pytest.raises(ValueError, match=r"unknown 'xml'; known: trc, .*, c3d"):
        read(tmp_path / "take.trc", format="xml")


def test_a_format_may_be_named_where_the_suffix_misleads(tmp_path: Path) -> None:
    write(small(), tmp_path / "take.trc")
    path = (tmp_path / "take.trc").rename(tmp_path / "take.txt")
    assert_same(read(path, format="trc"), small(), PRECISION[".trc"])


@NEEDS_EZC3D
def test_readers_from_elsewhere_are_found_by_entry_point(
    tmp_path: Path, c3d_declared: None
) -> None:
    write(small(), tmp_path / "take.c3d")
    assert_same(read(tmp_path / "take.c3d"), small(), PRECISION[".c3d"])


def test_the_package_declares_its_c3d_reader() -> None:
    project = tomllib.loads((Path(__file__).parents[1] / "pyproject.toml").read_text())["project"]
    assert project["entry-points"]["jaxhand.recordings"]["c3d"] == "jaxhand.c3d"


@NEEDS_EZC3D
def test_a_missing_file_is_a_missing_file(tmp_path: Path, c3d_declared: None) -> None:
    for suffix in (".trc", ".tsv", ".csv", ".bvh", ".c3d"):
        with pytest.raises(FileNotFoundError):
            read(tmp_path / f"none{suffix}", unit=1e-3)


def test_rounded_times_give_the_rate_that_they_were_rounded_from() -> None:
    time = np.round(np.arange(500) / 120, 4)
    assert median_rate(time, "x") == pytest.approx(120, abs=0.01)
    # Where frames are lost the steps are not alike, and a mean would be too low.
    assert median_rate(np.delete(time, slice(100, 200)), "x") > 119


def test_the_rate_is_the_median_over_steps_that_advance() -> None:
    time = np.array([0.0, 0.01, 0.02, 0.02, 0.03, 5.0, 5.01])
    assert median_rate(time, "x") == pytest.approx(100)
    with pytest.raises(ValueError, match="x: no rate"):
        median_rate(np.zeros(3), "x")


@NEEDS_EZC3D
def test_a_damaged_c3d_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "take.c3d"
    c3d.write(Recording(("a",), np.ones((200, 1, 3)), np.arange(200) / 100, 100, "made"), path)
    whole = path.read_bytes()
    for damaged in (whole[:-1600], whole[:700], b"hello", b""):
        path.write_bytes(damaged)
        with pytest.raises(ValueError, match=r"take\.c3d"):
            c3d.read(path)


@NEEDS_EZC3D
def test_c3d_keeps_evenly_spaced_frames_only(tmp_path: Path) -> None:
    uneven = Recording(("a",), np.ones((3, 1, 3)), np.array([0, 0.01, 0.03]), 100, "made")
    with pytest.raises(ValueError, match="frame 2 is not 1/100 s after"):
        c3d.write(uneven, tmp_path / "take.c3d")


def test_c3d_without_ezc3d_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setitem(sys.modules, "ezc3d", None)
    with pytest.raises(ValueError, match=r"pip install 'jaxhand\[c3d\]'"):
        c3d.read(tmp_path / "take.c3d")


def test_c3d_without_ezc3d_is_refused_before_the_work(
    monkeypatch: pytest.MonkeyPatch, c3d_declared: None
) -> None:
    monkeypatch.setitem(sys.modules, "ezc3d", None)
    with pytest.raises(ValueError, match=r"pip install 'jaxhand\[c3d\]'"):
        writer_of(Path("filled.c3d"))


@NEEDS_EZC3D
def test_a_c3d_residual_below_zero_is_a_gap(tmp_path: Path) -> None:
    ezc3d = pytest.importorskip("ezc3d")
    contents = ezc3d.c3d()
    contents["parameters"]["POINT"]["RATE"]["value"] = [100.0]
    contents["parameters"]["POINT"]["LABELS"]["value"] = ["a"]
    contents["parameters"]["POINT"]["UNITS"]["value"] = ["cm"]
    contents["data"]["points"] = np.full((4, 1, 2), 5.0)
    contents["data"]["meta_points"]["residuals"] = np.array([[[0.0, -1.0]]])
    contents.write(str(tmp_path / "take.c3d"))
    recording = c3d.read(tmp_path / "take.c3d")
    np.testing.assert_allclose(recording.markers[:, 0], [[0.05] * 3, [np.nan] * 3])


def test_real_bvh(data_root: Path) -> None:
    """ManipNet: the stored rotations are rotations, and bones keep their length."""
    path = data_root / "manipnet" / "cube_med2_leftHand.bvh"
    recording = read(path, unit=0.1, left_handed=True)
    assert recording.markers.shape == (4611, 17, 3)
    assert recording.rate == pytest.approx(120, rel=1e-6)
    assert recording.visible.all()
    joints = recording.joints
    assert joints is not None
    products = joints.rotations @ joints.rotations.swapaxes(-1, -2)
    np.testing.assert_allclose(products, np.broadcast_to(np.eye(3), products.shape), atol=1e-9)
    assert np.linalg.det(joints.rotations[0]) == pytest.approx(1)
    thumb = recording.select(["THUMB_CMC_FE", "THUMB_MCP_FE"]).markers
    assert np.linalg.norm(thumb[:, 1] - thumb[:, 0], axis=-1).mean() == pytest.approx(
        0.0634, abs=0.02
    )


def test_real_trc(data_root: Path) -> None:
    """SIG18: 19 markers at 120 Hz in every file, also in those that leave out frames."""
    paths = sorted((data_root / "sig18").rglob("*.trc"))[:40]
    assert paths
    for path in paths:
        recording = read(path)
        assert (len(recording.names), recording.rate) == (19, 120)
        span = recording.markers[0].max(axis=0) - recording.markers[0].min(axis=0)
        assert 0.1 < np.linalg.norm(span) < 0.4


def test_real_qualisys(data_root: Path) -> None:
    recording = read(data_root / "qualisys" / "recording.tsv")
    assert recording.markers.shape == (6000, 21, 3)
    assert recording.rate == 100
    assert recording.filled == ("middle_tip",)
    assert recording.visible[:, recording.names.index("index_tip")].mean() > 0.5
    assert (~recording.visible).any()


def test_real_hand_csv(data_root: Path) -> None:
    hand = read_hand_csv(data_root / "reference" / "hand.csv")
    assert hand.marker_names[:3] == ("LEHAR", "LEHAL", "WHARHAR")
    np.testing.assert_array_equal(hand.alignment, [True] * 3 + [False] * 6)
    np.testing.assert_array_equal(hand.joints[hand.joint_names.index("l_wrist")], np.zeros(3))
