"""Laws of the data sets: one hand, one rate, one frame, whatever the files look like."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("jax")

from takes import HAND, simulated, write_takes

from jaxhand.datasets import (
    MANIPNET_POINTS,
    PAVLLO_AXES,
    PAVLLO_MARKERS,
    SIG18_AS_GLOVE9,
    SOURCES,
    load,
    parse_spec,
)
from jaxhand.sequences import Dataset, Sequence, complete_frames, smooth
from numpy_infer.arrays import Array
from numpy_infer.geometry import kabsch, mirror, transform
from numpy_infer.hand import ANGLES, FINGERS, POINTS, TIPS, load_hand
from numpy_infer.recordings import Recording, write
from numpy_infer.skeleton import forward_kinematics, rotations_from_angles

# --- specs and errors


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("sig18", ("sig18", None, 1.0)),
        ("sig18@0.5", ("sig18", None, 0.5)),
        ("sig18:a/b", ("sig18", Path("a/b"), 1.0)),
        ("sig18:C:/a@home/b@2", ("sig18", Path("C:/a@home/b"), 2.0)),
        ("sig18:a@home", ("sig18", Path("a@home"), 1.0)),
    ],
)
def test_a_spec_says_name_path_and_weight(text: str, expected: tuple[object, ...]) -> None:
    assert tuple(parse_spec(text)) == expected


@pytest.mark.parametrize("text", ["", ":a", "@1", "sig18@0", "sig18@-1", "sig18@inf", "sig18@nan"])
def test_a_bad_spec_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match=r"NAME\[:PATH\]\[@WEIGHT\]"):
        parse_spec(text)


def test_an_unknown_data_set_lists_the_known_ones() -> None:
    with pytest.raises(ValueError, match=r"(?s)sig81.*manipnet, sig18, qualisys.*simulated$"):
        load("sig81:x", "train")


@pytest.mark.parametrize("name", SOURCES)
def test_a_missing_path_says_what_to_pass(name: str, tmp_path: Path) -> None:
    for text in (name, f"{name}:{tmp_path / 'nowhere'}", f"{name}:{tmp_path}"):
        with pytest.raises(ValueError, match=f"pass {name}:PATH"):
            load(text, "train")


def test_an_unknown_take_is_named_beside_those_there_are(tmp_path: Path) -> None:
    write_takes(tmp_path, ["a", "b"])
    with pytest.raises(ValueError, match=r"no take c; name takes with --test, out of: a, b"):
        load(f"recordings:{tmp_path}", "test", takes=("a", "c"))


def test_only_the_split_asked_for_must_be_there(tmp_path: Path) -> None:
    folder = tmp_path / "User4" / "capture1"
    write_takes(folder, ["sequence.1_training_dense_left"])
    assert len(load(f"sig18:{tmp_path}", "test").sequences) == 1
    with pytest.raises(ValueError, match="no take User1, User2; name takes with --train"):
        load(f"sig18:{tmp_path}", "train")


def test_one_file_is_read_where_its_folder_says_what_it_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stem = "sequence.1_training_dense_left"
    write_takes(tmp_path / "User4" / "capture1", [stem])
    file = Path("User4", "capture1", f"{stem}.trc")
    for path in (tmp_path / file, file):
        monkeypatch.chdir(tmp_path)
        (sequence,) = load(f"sig18:{path}", "test").sequences
        assert sequence.take == "User4/capture1/sequence.1"
    for folder in ("nowhere", "User4", "User4/session1"):
        write_takes(tmp_path / folder, [stem])
        monkeypatch.chdir(tmp_path / folder)
        for split in ("train", "test"):
            with pytest.raises(ValueError, match=f"{stem}.* holds no takes: pass sig18:PATH, the"):
                load(f"sig18:{stem}.trc", split)


def test_complete_frames_are_those_with_every_marker() -> None:
    markers = np.random.default_rng(0).normal(size=(5, 9, 3)).astype(np.float32)
    holed = markers.copy()
    holed[[1, 3], [0, 8], 0] = np.nan
    whole = Sequence("a/left", "a", 60, markers)
    frames = complete_frames(Dataset("", HAND, (Sequence("b/left", "b", 60, holed), whole)))
    np.testing.assert_array_equal(frames.markers, np.concatenate([holed[[0, 2, 4]], markers]))
    np.testing.assert_array_equal(frames.sequence, [0, 0, 0, 1, 1, 1, 1, 1])
    assert frames.angles is None


# --- SIG18


def test_sig18_is_smoothed_halved_and_read_as_glove9(tmp_path: Path) -> None:
    folder = tmp_path / "User3" / "capture2"
    names = list(SIG18_AS_GLOVE9)
    stems = [f"sequence.7_training_dense_{side}" for side in ("left", "right")]
    write_takes(folder, stems, names=names)
    short = Recording(tuple(names), simulated(46)[0], np.arange(46) / 120, 120, "")
    write(short, folder / "sequence.8_training_dense_left.trc")
    left, right = load(f"sig18:{tmp_path}", "validation").sequences
    assert left.name == "User3/capture2/sequence.7/left"
    assert left.take == right.take == "User3/capture2/sequence.7"
    np.testing.assert_allclose(left.markers, smooth(simulated(121)[0])[::2], atol=1e-6)
    np.testing.assert_array_equal(left.markers, right.markers)


# --- Qualisys


def test_qualisys_is_a_right_hand_and_all_of_it_is_test(tmp_path: Path) -> None:
    hand = load_hand("qualisys13")
    markers = mirror(np.tile(hand.template, (11, 1, 1))) + np.arange(11)[:, None, None] * 0.01
    markers[4, 2] = np.nan
    recording = Recording(hand.markers, markers, np.arange(11) / 100, 100, "")
    write(recording, tmp_path / "recording.tsv")
    dataset = load(f"qualisys:{tmp_path}", "test")
    (sequence,) = dataset.sequences
    assert dataset.hand.name == "qualisys13"
    assert sequence.markers.shape == (7, 13, 3)
    np.testing.assert_allclose(sequence.markers[0], hand.template, atol=1e-6)
    # 100 → 60 Hz: frame 4 lies beside the samples at 3.33 and at 5.0 is not.
    np.testing.assert_array_equal(np.isfinite(sequence.markers[:, 2, 0]), [1, 1, 0, 1, 1, 1, 1])
    with pytest.raises(ValueError, match=r"no default 'train' split; .*out of: recording"):
        load(f"qualisys:{tmp_path}", "train")
    load(f"qualisys:{tmp_path}", "train", takes=("recording",))


# --- the authors' CSV pairs


def write_pair(folder: Path, take: str, *, joints: bool = True) -> None:
    """One take as the authors write it: left-handed, joints in the hand's own frame."""
    markers, _, local, _ = simulated(seed=3)
    flip = np.array([1, 1, -1])
    time = np.arange(len(markers)) / 60
    valid = np.ones((len(markers), 1))
    table, columns = [time[:, None]], ["time"]
    for i, name in enumerate(PAVLLO_MARKERS):
        columns += [f"{name}.{field}" for field in ("pos.x", "pos.y", "pos.z", "isValid")]
        table += [markers[:, i] * flip, valid]
    save(folder / f"out_mocap_{take}.csv", columns, table)
    names = [f"l_{finger}{i}" for finger in FINGERS for i in (1, 2, 3)] + [f"l_{t}" for t in TIPS]
    table, columns = [time[:, None]], ["time"]
    for i, name in enumerate(names if joints else names[:-1], start=1):
        columns += [f"{name}.{kind}.{axis}" for kind in ("pos", "rot") for axis in "xyz"]
        table += [local[:, i] @ PAVLLO_AXES.T * flip, np.zeros((len(time), 3))]
    save(folder / f"out_fused_{take}.csv", [*columns, "isValid"], [*table, valid])


def save(path: Path, columns: list[str], table: list[Array]) -> None:
    rows = np.concatenate(table, 1)
    np.savetxt(path, rows, "%.9g", ",", header=",".join(columns), comments="")


def test_the_authors_pairs_bring_markers_joints_and_angles(tmp_path: Path) -> None:
    write_pair(tmp_path, "one")
    dataset = load(f"pavllo:{tmp_path}", "test")
    (sequence,) = dataset.sequences
    markers, points, _, angles = simulated(seed=3)
    assert sequence.take == "one"
    np.testing.assert_allclose(sequence.markers, markers, atol=1e-6)
    np.testing.assert_allclose(sequence.positions, points, atol=2e-5)
    flexion = [a.name.endswith("flexion") and not a.name.startswith("thumb") for a in ANGLES]
    np.testing.assert_allclose(sequence.angles[:, flexion], angles[:, flexion], atol=np.radians(1))
    assert complete_frames(dataset).angles.shape == (61, 26)


def test_without_all_joints_the_authors_pairs_are_markers_alone(tmp_path: Path) -> None:
    write_pair(tmp_path, "one", joints=False)
    dataset = load(f"pavllo:{tmp_path}", "test")
    assert dataset.sequences[0].angles is None
    assert dataset.sequences[0].positions is None
    assert dataset.observed_angles is None


# --- ManipNet

MANIPNET_OFFSETS = {
    "THUMB_CMC_FE": ("WRIST", (0.2, 0.1, -0.06)),
    "THUMB_CMC_AA": ("THUMB_CMC_FE", (0.2, 0.2, -0.05)),
    "THUMB_MCP_FE": ("THUMB_CMC_AA", (0.2, 0.2, -0.05)),
    "THUMB_IP_FE": ("THUMB_MCP_FE", (0.2, 0.2, -0.05)),
    "INDEX_MCP": ("WRIST", (1.0, 0.3, 0.0)),
    "MIDDLE_MCP": ("WRIST", (1.0, 0.0, 0.04)),
    "RING_MCP": ("WRIST", (0.95, -0.2, 0.0)),
    "PINKY_MCP": ("WRIST", (0.85, -0.4, -0.08)),
    **{f"{f.upper()}_PIP_FE": (f"{f.upper()}_MCP", (0.4, 0.0, 0.0)) for f in FINGERS[1:]},
    **{f"{f.upper()}_DIP_FE": (f"{f.upper()}_PIP_FE", (0.2, 0.0, 0.0)) for f in FINGERS[1:]},
}
PIP_DEGREES = np.linspace(10, 80, 25)


def write_bvh(path: Path) -> None:
    """A hand of straight fingers that bends its PIP joints, at 120 Hz; `right` in the name gives
    the mirror image in x."""
    side = np.array([-1, 1, 1]) if "right" in path.name else np.ones(3)
    names: list[str] = []

    def node(name: str, offset: Array, channels: str) -> list[str]:
        names.append(name)
        children = [
            line
            for child, (parent, at) in MANIPNET_OFFSETS.items()
            if parent == name
            for line in node(child, np.array(at) * side, "3 ")
        ]
        motion = "6 Xposition Yposition Zposition " if channels == "6 " else "3 "
        end = [] if children else ["End Site", "{", "OFFSET 0 0 0", "}"]
        return [
            f"{'ROOT' if channels == '6 ' else 'JOINT'} {name}",
            "{",
            "OFFSET " + " ".join(map(str, offset)),
            f"CHANNELS {motion}Yrotation Xrotation Zrotation",
            *children,
            *end,
            "}",
        ]

    lines = ["HIERARCHY", *node("WRIST", np.zeros(3), "6 "), "MOTION"]
    lines += [f"Frames: {len(PIP_DEGREES)}", "Frame Time: 0.008333334"]
    for frame, pip in enumerate(PIP_DEGREES):
        row = [3 + 0.01 * frame, 10, 5]
        for name in names:
            y_x_z = (30, -20, 10) if name == "WRIST" else (pip * name.endswith("PIP_FE"), 0, 0)
            row += [y_x_z[0], y_x_z[1], y_x_z[2]]
        mirrored = np.array([side[0], 1, 1, *[side[0], 1, side[0]] * len(names)])
        lines.append(" ".join(f"{value:.6f}" for value in np.array(row) * mirrored))
    path.write_text("\n".join(lines) + "\n")


@pytest.fixture(scope="module")
def small_manipnet(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    folder = tmp_path_factory.mktemp("manipnet")
    for side in ("left", "right"):
        write_bvh(folder / f"cube_med2_{side}Hand.bvh")
    return load(f"manipnet:{folder}", "test")


def test_manipnet_has_the_skeleton_and_the_angles_of_its_files(small_manipnet: Dataset) -> None:
    lengths = small_manipnet.hand.bone_lengths
    assert lengths["index_pip"] == pytest.approx(0.04)
    assert lengths["index_tip"] == pytest.approx(0.02 * 0.95)
    assert lengths["thumb_mcp"] == pytest.approx(np.linalg.norm([0.04, 0.04, 0.01]))
    mcp = small_manipnet.hand.skeleton[POINTS.index("index_mcp")]
    np.testing.assert_allclose(mcp, [0.03, 0, -0.1], atol=1e-6)
    left, _ = small_manipnet.sequences
    pip = [a.name.endswith("pip_flexion") for a in ANGLES]
    expected = np.radians(PIP_DEGREES[::2])[:, None].repeat(4, 1)
    np.testing.assert_allclose(left.angles[:, pip], expected, atol=1e-4)
    others = [not p and not a.name.startswith("thumb") for p, a in zip(pip, ANGLES, strict=True)]
    np.testing.assert_allclose(left.angles[:, others], 0, atol=1e-4)
    np.testing.assert_allclose(
        forward_kinematics(
            small_manipnet.hand.skeleton,
            rotations_from_angles(left.angles.astype(float)),
            left.rotations[:, 0],
            left.positions[:, 0],
        )[0],
        left.positions,
        atol=1e-4,
    )


def test_manipnets_right_hand_is_the_mirror_image_of_its_left(small_manipnet: Dataset) -> None:
    left, right = small_manipnet.sequences
    assert (left.name, right.name) == ("cube_med2/left", "cube_med2/right")
    for field in ("markers", "positions", "rotations", "angles"):
        one, other = getattr(left, field), getattr(right, field)
        np.testing.assert_allclose(one, other, atol=1e-5, err_msg=field)


def test_markers_stand_where_the_hand_says(small_manipnet: Dataset) -> None:
    sequence = small_manipnet.sequences[0]
    dorsal = sequence.rotations[:, 0, :, 1]
    wrist = sequence.markers[:, HAND.markers.index("wrist")]
    np.testing.assert_allclose(wrist, sequence.positions[:, 0] + 0.03 * dorsal, atol=1e-6)
    tip = sequence.markers[:, HAND.markers.index("ring_tip")]
    np.testing.assert_allclose(tip, sequence.positions[:, POINTS.index("ring_tip")], atol=1e-6)


def test_a_bvh_of_other_joints_is_refused(tmp_path: Path) -> None:
    write_bvh(tmp_path / "cube_med2_leftHand.bvh")
    text = (tmp_path / "cube_med2_leftHand.bvh").read_text()
    missing = MANIPNET_POINTS["ring_dip"]
    (tmp_path / "cube_med2_leftHand.bvh").write_text(text.replace(missing, "ELBOW"))
    with pytest.raises(ValueError, match=f"expected the joints .*{missing}"):
        load(f"manipnet:{tmp_path}", "test")


# --- handedness: on a left hand the template fits better than its mirror image


def registration_errors(dataset: Dataset) -> Array:
    """`[S, 2]` metres RMS: template, mirrored template, each registered to every sequence."""
    errors = []
    for sequence in dataset.sequences:
        markers = sequence.markers[np.isfinite(sequence.markers).all((1, 2))].astype(float)
        row = []
        for template in (dataset.hand.template, mirror(dataset.hand.template)):
            source = np.broadcast_to(template, markers.shape)
            weight = np.ones(markers.shape[:2])
            rotation, translation = kabsch(source, markers, weight, np.eye(3))
            off = transform(rotation, translation, source) - markers
            row.append(np.sqrt((off**2).sum(-1).mean()))
        errors.append(row)
    return np.array(errors)


def test_made_hands_are_left_hands(small_manipnet: Dataset, tmp_path: Path) -> None:
    write_takes(tmp_path, ["a_left", "a_right"])
    for dataset in (small_manipnet, load(f"recordings:{tmp_path}", "test")):
        left, mirrored = registration_errors(dataset).T
        assert (left < mirrored).all()


@pytest.fixture(scope="module")
def real_manipnet(data_root: Path, tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """The first 600 frames of a take."""
    folder = tmp_path_factory.mktemp("manipnet")
    for path in (data_root / "manipnet").glob("mug1_*.bvh"):
        text = path.read_text().splitlines()
        motion = text.index("MOTION")
        text[motion + 1] = "Frames: 600"
        (folder / path.name).write_text("\n".join(text[: motion + 603]) + "\n")
    return load(f"manipnet:{folder}", "train", takes=("mug1",))


def test_manipnet_is_left_after_reflection_and_mirroring(real_manipnet: Dataset) -> None:
    left, mirrored = registration_errors(real_manipnet).T
    assert len(left) == 2
    assert (left < mirrored).all()


def test_manipnets_angles_reach_its_joints(real_manipnet: Dataset) -> None:
    hand = real_manipnet.hand
    assert hand.bone_lengths["thumb_mcp"] == pytest.approx(0.0634, abs=5e-4)
    for s in real_manipnet.sequences:
        turns = rotations_from_angles(s.angles)
        reached, _ = forward_kinematics(hand.skeleton, turns, s.rotations[:, 0], s.positions[:, 0])
        off = np.linalg.norm(reached - s.positions, axis=-1).mean(0)
        # Hinges at right angles to the bones are not what the recorded skeleton has.
        assert off.max() < 1.5e-3
        assert off.mean() < 0.4e-3
    assert 18 <= real_manipnet.observed_angles.sum() <= 21
    assert not real_manipnet.observed_angles[[a.axis == "z" for a in ANGLES]].any()


@pytest.mark.parametrize("layout", ["glove9", "dense19"])
def test_sig18_is_right_handed_as_it_stands(data_root: Path, tmp_path: Path, layout: str) -> None:
    for path in sorted((data_root / "sig18" / "User4" / "capture1").glob("*.trc"))[:24]:
        link = tmp_path / "User4" / "capture1" / path.name
        link.parent.mkdir(parents=True, exist_ok=True)
        link.symlink_to(path.resolve())
    dataset = load(f"sig18:{tmp_path}", "test", hand=load_hand(layout))
    errors = registration_errors(dataset)
    assert {s.name.rpartition("/")[2] for s in dataset.sequences} == {"left", "right"}
    assert errors[:, 0].mean() < errors[:, 1].mean()
    assert (errors[:, 0] < errors[:, 1]).mean() > 0.8


def test_the_qualisys_glove_is_a_left_hand_once_mirrored(data_root: Path) -> None:
    dataset = load(f"qualisys:{data_root / 'qualisys'}", "test")
    assert len(dataset.sequences[0].markers) == 3600
    assert np.isnan(dataset.sequences[0].markers).any()
    left, mirrored = registration_errors(dataset).T
    assert (left < mirrored).all()
