"""Laws of sensor fusion: glove and markers together are better than each, and nothing jumps."""

from __future__ import annotations

import functools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

jax = pytest.importorskip("jax")

from hypothesis import given  # noqa: E402
from simulated import quickly  # noqa: E402
from strategies import motions, noise, turn  # noqa: E402

from jaxhand import simulation  # noqa: E402
from jaxhand.datasets import MANIPNET_POINTS, PAVLLO_AXES, load  # noqa: E402
from jaxhand.fusion import (  # noqa: E402
    AUTHORS_JOINTS,
    SLEW,
    Fused,
    fuse,
    imu_from_recording,
    kalman_update,
    paper_fuse,
    simulate_imu,
)
from numpy_infer.arrays import Array  # noqa: E402
from numpy_infer.geometry import PRIOR_STRENGTH  # noqa: E402
from numpy_infer.hand import ANGLES, FINGERS, JOINTS, PARENTS, POINTS, Hand, load_hand  # noqa: E402
from numpy_infer.recordings import JointTruth, Recording, read  # noqa: E402
from numpy_infer.skeleton import (  # noqa: E402
    angles_from_rotations,
    forward_kinematics,
    marker_positions,
    rotations_from_angles,
)

RATE = 60.0
GLOVE = load_hand("glove9")
NAMES = [angle.name for angle in ANGLES]
FLEXION = np.array([name.endswith("flexion") for name in NAMES])
MOVED = [i for i, point in enumerate(POINTS) if i and PARENTS[i] > 0]
"""PIP, DIP, tip; the thumb's MCP, IP, tip."""
METHODS = {"fuse": fuse, "paper_fuse": paper_fuse}


def still(frames: int, **degrees: float) -> Array:
    """`[T, 26]` radians: a flat hand with the given angles."""
    return np.tile([np.radians(degrees.get(name, 0)) for name in NAMES], (frames, 1))


def world(hand: Hand, turns: Array, rotation: Array, position: Array) -> tuple[Array, Array]:
    """Points `[T, 21, 3]` and markers `[T, M, 3]`, metres."""
    points, links = forward_kinematics(hand.skeleton, turns, rotation, position)
    return points, marker_positions(hand, points, links)


def at_origin(hand: Hand, turns: Array) -> tuple[Array, Array]:
    return world(hand, np.asarray(turns, np.float64), np.eye(3), np.zeros(3))


def errors(hand: Hand, fused: Array, truth: Array) -> Array:
    """`[T, 15]` metres between the moved joints of two hands, each parent_from_joint."""
    off = at_origin(hand, fused)[0] - at_origin(hand, truth)[0]
    return np.linalg.norm(off, axis=-1)[:, MOVED]


@functools.cache
def recorded(frames: int = 240, seed: int = 0) -> tuple[Hand, Array, Array, Array, Array]:
    """The first frames of one minute: a person's hand, angles `[T, 26]`, a glove's rotations, all
    markers `[T, 9, 3]` and which are seen `[T, 9]`."""
    s = jax.tree.map(lambda array: np.asarray(array)[0], minute()(jax.random.key(seed)))
    hand = replace(GLOVE, offsets=s.offsets).with_skeleton(s.skeleton)
    angles, *pose = (array[:frames] for array in (s.angles, s.wrist_rotation, s.wrist_position))
    markers = world(hand, rotations_from_angles(angles.astype(np.float64)), *pose)[1]
    return hand, angles, gloved(angles, 0.5, 5), markers, s.visible[:frames]


@functools.cache
def minute():
    """Compiled once for the whole file."""
    return quickly(lambda key: simulation.streams(key, GLOVE, 1, 3600, RATE))


def gloved(angles: Array, drift: float, offset: float, seed: int = 0) -> Array:
    key = jax.random.key(seed)
    return np.array(simulate_imu(key, angles, RATE, np.radians(drift), np.radians(offset)))


# --- the glove


def test_a_simulated_glove_feels_flexions_alone() -> None:
    _, angles, *_ = recorded()
    np.testing.assert_array_equal(gloved(angles, 0.5, 5), gloved(angles, 0.5, 5))
    read_back = angles_from_rotations(gloved(angles, 0, 0))
    np.testing.assert_allclose(read_back[:, FLEXION], angles[:, FLEXION], atol=1e-5)
    np.testing.assert_allclose(read_back[:, ~FLEXION], 0, atol=1e-6)


def test_a_simulated_glove_starts_off_and_drifts() -> None:
    gloves = [gloved(still(601), 0.5, 5, hand) for hand in range(30)]
    error = np.degrees([angles_from_rotations(glove) for glove in gloves])
    drift = error[:, -1, FLEXION] - error[:, 0, FLEXION]
    np.testing.assert_allclose(np.abs(drift), 0.5 * 10, atol=1e-3)
    assert np.abs(drift.mean()) < 1
    assert error[:, 0, FLEXION].std() == pytest.approx(5, rel=0.1)


# --- what fusion is for


@pytest.mark.parametrize("drift", [0.5, 0.0])
@pytest.mark.parametrize("seed", [0, 1])
def test_joints_are_three_times_closer_than_the_gloves(drift: float, seed: int) -> None:
    """One minute at 60 Hz, 0.5 mm of noise on the markers, and gaps."""
    hand, angles, _, markers, visible = recorded(3600, seed)
    truth = rotations_from_angles(angles.astype(np.float64))
    jitter = np.random.default_rng(seed).normal(0, 0.5e-3, markers.shape)
    glove = gloved(angles, drift, 5, seed)
    seen = np.where(visible[..., None], markers + jitter, np.nan)
    alone = errors(hand, glove, truth).mean()
    fused, plain = (
        errors(hand, method(hand, glove, seen, 1 / RATE).rotations, truth)
        for method in METHODS.values()
    )
    assert fused.mean() < alone / 3
    assert fused.mean() < 2e-3
    assert fused.mean() < plain.mean()
    assert np.quantile(fused, 0.99) < np.quantile(plain, 0.99)


@pytest.mark.parametrize("spread", [20.0, -20.0])
@pytest.mark.parametrize("flexion", [5.0, 35.0])
def test_spread_and_crossed_fingers_are_found(spread: float, flexion: float) -> None:
    """What the glove cannot feel at all, while its flexions are off."""
    bend = {f"{f}_{joint}_flexion": flexion for f in FINGERS[1:] for joint in ("mcp", "pip", "dip")}
    angles = still(240, **bend, index_mcp_abduction=spread, middle_mcp_abduction=-0.75 * spread)
    markers = at_origin(GLOVE, rotations_from_angles(angles))[1]
    fused = fuse(GLOVE, gloved(angles, 0.5, 5), markers, 1 / RATE)
    off = np.degrees(fused.angles - angles)[60:]
    aside = [NAMES.index(f"{finger}_mcp_abduction") for finger in ("index", "middle")]
    assert np.abs(off[:, aside]).max() < 3
    assert errors(GLOVE, fused.rotations, rotations_from_angles(angles))[60:].mean() < 3e-3


def test_other_gloves_are_fused_too() -> None:
    hand = load_hand("dense19")
    _, angles, glove, *_ = recorded()
    truth = rotations_from_angles(angles.astype(np.float64))
    markers = at_origin(hand, truth)[1]
    fused = fuse(hand, glove, markers, 1 / RATE)
    assert errors(hand, fused.rotations, truth).mean() < errors(hand, glove, truth).mean() / 3


# --- laws


@pytest.mark.parametrize("method", METHODS)
def test_an_exact_glove_is_left_unchanged(method: str) -> None:
    """Also where its joints turn as none of our angles does."""
    hand, angles, _, _, visible = recorded()
    truth = rotations_from_angles(angles.astype(np.float64))
    truth[:, 4] = truth[:, 4] @ turn([0, 1, 0.5], 0.2)
    points, markers = world(hand, truth, turn([1, 2, 3], 1.0), np.array([0.3, 1.2, -0.4]))
    seen = np.where(visible[..., None], markers, np.nan)
    fused = METHODS[method](hand, truth, seen, 1 / RATE)
    assert errors(hand, fused.rotations, truth).max() < 1e-5
    again, _ = world(hand, fused.rotations, fused.wrist_rotation, fused.wrist_position)
    np.testing.assert_allclose(again, points, atol=1e-5)
    np.testing.assert_array_equal(np.isnan(fused.residual), ~fused.corrected)
    assert fused.residual[fused.corrected].max() < 2e-5
    np.testing.assert_allclose(fused.angles, angles_from_rotations(fused.rotations), atol=1e-5)


@given(motions())
def test_a_rigid_motion_of_the_markers_moves_the_wrist_alone(motion: tuple[Array, Array]) -> None:
    """Also where few markers are seen, from the first frame on, or none."""
    hand, _, glove, markers, visible = recorded()
    rotation, translation = motion
    seen = np.where(visible[..., None], markers, np.nan)
    seen[:5, 2:] = seen[60:70, 2:] = seen[100:110] = np.nan
    aligned = np.isfinite(seen[:, list(hand.alignment)]).all((-1, -2))
    # Two markers leave the turn about their line to the frame before, by way of a prior that is a
    # few thousand times weaker than they are: float32's rounding counts that often, and adds up.
    frame = np.arange(len(seen))
    since = frame - np.maximum.accumulate(np.where(aligned, frame, -1))
    size = ((hand.template[0] - hand.template[1]) ** 2).sum() / 2
    rounding = np.finfo(np.float32).eps / 2 * size / PRIOR_STRENGTH
    for method in METHODS.values():
        here = method(hand, glove, seen, 1 / RATE)
        there = method(hand, glove, seen @ rotation.T + translation, 1 / RATE)
        np.testing.assert_allclose(there.rotations, here.rotations, atol=3e-4)
        wrist = rotation @ here.wrist_rotation
        origin = here.wrist_position @ rotation.T + translation
        turned = np.abs(there.wrist_rotation - wrist).max((-1, -2))
        assert (turned < 2e-4 + rounding * since).all()
        shifted = np.abs(there.wrist_position - origin).max(-1)
        assert (shifted < 2e-5 + 0.1 * rounding * since).all()


def gap() -> tuple[Fused, Array, Array]:
    """The index crosses over behind an obstacle, two seconds long; the glove stands still. Also the
    frames of the gap, and all angles of the index over time."""
    angles = still(240, index_pip_flexion=30, index_mcp_flexion=20, index_mcp_abduction=15)
    hidden = np.zeros(240, bool)
    hidden[60:180] = True
    angles[120:, NAMES.index("index_mcp_abduction")] = np.radians(-15)
    markers = at_origin(GLOVE, rotations_from_angles(angles))[1]
    markers[hidden, GLOVE.markers.index("index_tip")] = np.nan
    fused = fuse(GLOVE, gloved(angles[:1].repeat(240, 0), 0, 5), markers, 1 / RATE)
    return fused, hidden, fused.angles[:, [n.startswith("index") for n in NAMES]]


def test_a_hidden_finger_keeps_its_correction() -> None:
    fused, hidden, index = gap()
    np.testing.assert_array_equal(fused.corrected[:, 1], ~hidden)
    np.testing.assert_array_equal(np.isnan(fused.residual[:, 1]), hidden)
    settled = index[hidden][1:]
    np.testing.assert_allclose(settled, settled[:1].repeat(len(settled), 0), atol=1e-6)


def test_a_finger_that_comes_back_does_not_jump() -> None:
    _, hidden, index = gap()
    moves, back = np.abs(np.diff(index, axis=0)).max(1), np.flatnonzero(hidden)[-1] + 1
    assert moves.max() <= SLEW / RATE * 1.01
    assert moves[back - 1] > SLEW / RATE / 2  # it had to go somewhere
    assert np.abs(np.degrees(index[back + 15 :, 1]) + 15).max() < 3


@pytest.mark.parametrize("seed", [0, 1])
def test_no_correction_changes_faster_than_the_slew_whatever_is_hidden(seed: int) -> None:
    hand, _, glove, markers, _ = recorded()
    random = np.random.default_rng(seed)
    markers = np.where(random.random((240, 9, 1)) < 0.6, markers, np.nan)
    markers[100:140] = np.nan
    fused = fuse(hand, glove, markers, 1 / RATE)
    assert all(np.isfinite(array).all() for array in fused[:4])
    correction = fused.angles - angles_from_rotations(glove)
    assert np.abs(np.diff(correction, axis=0)).max() <= SLEW / RATE * 1.01


def test_hidden_coordinates_do_not_matter() -> None:
    hand, _, glove, markers, visible = recorded()
    first = fuse(hand, glove, np.where(visible[..., None], markers, np.nan), 1 / RATE)
    junk = markers.copy()
    junk[~visible] = [7e3, np.inf, -1]
    for one, other in zip(first, fuse(hand, glove, junk, 1 / RATE), strict=True):
        np.testing.assert_array_equal(one, other)


def test_what_is_yet_to_come_does_not_matter() -> None:
    hand, _, glove, markers, visible = recorded()
    now = np.where(visible[..., None], markers, np.nan)
    later = now + 0.3 * (np.arange(240) >= 120)[:, None, None]
    for one, other in zip(*(fuse(hand, glove, m, 1 / RATE) for m in (now, later)), strict=True):
        np.testing.assert_array_equal(one[:120], other[:120])


def test_without_markers_the_glove_is_what_there_is() -> None:
    hand, _, glove, markers, _ = recorded()
    for method in METHODS.values():
        fused = method(hand, glove, np.full_like(markers, np.nan), 1 / RATE)
        np.testing.assert_allclose(fused.rotations, glove, atol=1e-5)
        assert not fused.corrected.any()
        assert np.isfinite(fused.wrist_position).all()


def test_the_papers_route_points_a_finger_at_its_marker_and_holds_the_turn() -> None:
    """From the wrist, turns about the bases; what the glove feels meanwhile goes on beneath."""
    hand, _, glove, markers, _ = recorded()
    tips = [hand.markers.index(f"{finger}_tip") for finger in FINGERS]
    seen = markers.copy()
    hidden = np.isin(np.arange(240), [*range(20), *range(100, 140)])
    seen[hidden, hand.markers.index("middle_tip")] = np.nan
    fused = paper_fuse(hand, glove, seen, 1 / RATE)
    points, placed = world(hand, fused.rotations, fused.wrist_rotation, fused.wrist_position)
    measured, modelled = (m[:, tips] - points[:, 1:16:3] for m in (seen, placed))
    aside = np.linalg.norm(np.cross(measured, modelled), axis=-1)
    assert np.nanmax(aside / np.linalg.norm(measured, axis=-1)) < 1e-5
    assert np.nanmin((measured * modelled).sum(-1)) > 0
    middle = JOINTS.index("middle_mcp") - 1
    turns = fused.rotations[:, middle] @ np.swapaxes(glove[:, middle], -1, -2)
    for frames, known in ((slice(20), 20), (slice(100, 140), 99)):
        np.testing.assert_allclose(turns[frames] - turns[known], 0, atol=1e-6)
    np.testing.assert_array_equal(
        np.delete(fused.rotations, np.s_[::3], 1), np.delete(glove, np.s_[::3], 1)
    )


def test_a_glove_that_drops_out_is_held() -> None:
    hand, _, glove, markers, _ = recorded()
    held, glove = glove.copy(), glove.copy()
    held[:3] = np.eye(3)
    held[50:90, 6] = held[49, 6]
    glove[:3], glove[50:90, 6, 1] = np.nan, np.inf
    for one, other in zip(*(fuse(hand, g, markers, 1 / RATE) for g in (held, glove)), strict=True):
        np.testing.assert_array_equal(one, other)


def test_a_masked_marker_is_a_hidden_one() -> None:
    hand, _, glove, markers, _ = recorded()
    mask = np.zeros(markers.shape, bool)
    mask[50:90, 4] = True
    hidden = np.where(mask, np.nan, markers)
    masked = np.ma.array(np.where(mask, 0, markers), mask=mask)
    for one, other in zip(
        *(fuse(hand, glove, seen, 1 / RATE) for seen in (hidden, masked)), strict=True
    ):
        np.testing.assert_array_equal(one, other)


def test_time_stands_still_where_dt_is_not_positive() -> None:
    hand, _, glove, markers, _ = recorded()
    dt = np.full(240, 1 / RATE)
    dt[100:110], dt[110:120] = 0, -1
    correction = fuse(hand, glove, markers, dt).angles - angles_from_rotations(glove)
    change = np.abs(np.diff(correction, axis=0))
    assert change[99:119].max() < 1e-5
    assert change[119:].max() > 1e-4


def test_a_wrong_argument_is_named() -> None:
    glove, markers = np.tile(np.eye(3), (4, 15, 1, 1)), np.zeros((4, 9, 3))
    with pytest.raises(ValueError, match=r"markers: expected shape \[4, 9, 3\]"):
        fuse(GLOVE, glove, markers[:, 1:], 0.01)
    with pytest.raises(ValueError, match=r"imu_rotations: expected shape \[4, 15, 3, 3\]"):
        fuse(GLOVE, glove[1:], markers, 0.01)
    with pytest.raises(ValueError, match=r"dt: expected shape \[4\]"):
        paper_fuse(GLOVE, glove, markers, np.ones(3))
    with pytest.raises(ValueError, match=r"markers: expected shape \[0, 9, 3\]"):
        fuse(GLOVE, glove[:0], markers[:0], 0.01)
    with pytest.raises(ValueError, match="dt: expected finite"):
        paper_fuse(GLOVE, glove, markers, np.nan)


# --- the parts


@given(noise((3, 5, 4)), noise((3, 4, 4)), noise((3, 9)))
def test_one_measurement_after_the_other_is_all_at_once(
    rows: Array, root: Array, values: Array
) -> None:
    before, away = values[:, :4], values[:, 4:]
    covariance = root @ np.swapaxes(root, -1, -2) + 0.1 * np.eye(4)
    arguments = (np.float32(a) for a in (before, covariance, away, rows, 0.5))
    mean, after = kalman_update(*arguments)
    transposed = np.swapaxes(rows, -1, -2)
    gain = (
        covariance @ transposed @ np.linalg.inv(rows @ covariance @ transposed + 0.25 * np.eye(5))
    )
    np.testing.assert_allclose(mean, before + (gain @ away[..., None])[..., 0], atol=1e-4)
    np.testing.assert_allclose(after, covariance - gain @ rows @ covariance, atol=1e-4)


# --- recordings of gloves

MAP = {f"file_{joint}": joint for joint in JOINTS}
OURS = np.tile(np.eye(3), (len(JOINTS), 1, 1))
FINGERS_ONLY = np.array([not name.startswith("thumb") for name in NAMES])


def gestures(frames: int = 240) -> Array:
    """`[T, 26]` radians: flat at first, then all bend and spread."""
    most = np.random.default_rng(1).uniform(0.3, 1, len(NAMES))
    return np.linspace(0, 1, frames)[:, None] * np.where(FLEXION, most, 0.3 * most - 0.15)


def some_axes() -> Array:
    random = np.random.default_rng(0)
    return np.array([PAVLLO_AXES.T, *(turn(random.normal(size=3), 2.0) for _ in JOINTS[1:])])


def recording(turns: Array, axes: Array, frame: str) -> Recording:
    """A file of parent_from_joint `turns [T, 15, 3, 3]`, each of its joints `axes [16, 3, 3]` off
    ours, in the world or as the paper's authors have it."""
    world_from_wrist = axes[0].T if frame == "local" else turn([3, 1, 2], 2.0)
    place = np.zeros((len(turns), 3))
    if frame == "world":
        place += np.linspace([0.1, 1, 0.3], [0.3, 1.1, 0.2], len(turns))
    points, links = forward_kinematics(GLOVE.skeleton, turns, world_from_wrist, place)
    links = links @ axes
    if frame == "world":
        truth = JointTruth(tuple(MAP), points[:, :16], links)
    else:
        own = np.swapaxes(links[:, PARENTS[1:16]], -1, -2) @ links[:, 1:]
        truth = JointTruth(tuple(AUTHORS_JOINTS), points[:, 1:16], own, "local")
    time = np.arange(len(turns)) / RATE
    return Recording(("none",), np.zeros((len(time), 1, 3)), time, RATE, "glove", joints=truth)


@pytest.mark.parametrize(("frame", "joint_map"), [("world", MAP), ("local", None)])
def test_a_flat_pose_undoes_any_constant_axes(frame: str, joint_map: dict[str, str]) -> None:
    truth = rotations_from_angles(gestures())
    found = imu_from_recording(recording(truth, some_axes(), frame), GLOVE, joint_map, flat=[0])
    np.testing.assert_allclose(found, truth, atol=1e-6)


@pytest.mark.parametrize(("frame", "joint_map"), [("world", MAP), ("local", None)])
def test_without_a_flat_pose_bones_tell_the_bends(frame: str, joint_map: dict[str, str]) -> None:
    """Whatever the axes, if fingers do nothing but bend. A last joint's are those of the joint
    before: its own bone is in no file."""
    angles = np.where(FLEXION & FINGERS_ONLY, gestures(), 0)
    axes = some_axes()
    axes[3::3] = axes[2::3]
    glove = recording(rotations_from_angles(angles), axes, frame)
    found = angles_from_rotations(imu_from_recording(glove, GLOVE, joint_map))
    np.testing.assert_allclose(found[:, FINGERS_ONLY], angles[:, FINGERS_ONLY], atol=2e-3)


def test_a_right_glove_is_mirrored() -> None:
    left = recording(rotations_from_angles(gestures()), OURS, "world")
    assert left.joints is not None
    sign = np.array([-1.0, 1, 1])
    positions = left.joints.positions * sign
    mirrored = left.joints.rotations * sign[:, None] * sign
    right = replace(left, joints=JointTruth(tuple(MAP), positions, mirrored))
    found = imu_from_recording(right, GLOVE, MAP, right=True)
    np.testing.assert_allclose(found, imu_from_recording(left, GLOVE, MAP), atol=1e-5)


def test_invalid_frames_stay_invalid_and_align_nothing() -> None:
    truth = rotations_from_angles(gestures())
    glove = recording(truth, OURS, "world")
    assert glove.joints is not None
    glove.joints.rotations[7, 5] = np.nan
    found = imu_from_recording(glove, GLOVE, MAP, flat=np.arange(240) < 1)
    assert set(np.argwhere(np.isnan(found))[:, 0]) == {7}
    np.testing.assert_allclose(np.delete(found, 7, 0), np.delete(truth, 7, 0), atol=1e-6)
    with pytest.raises(ValueError, match="glove: no complete frame"):
        imu_from_recording(glove, GLOVE, MAP, flat=[7])


def test_joints_that_are_missing_or_unknown_are_named() -> None:
    glove = recording(rotations_from_angles(gestures()), OURS, "world")
    with pytest.raises(ValueError, match="unknown: l_index1"):
        imu_from_recording(glove, GLOVE)
    few = {name: joint for name, joint in MAP.items() if joint != "ring_pip"}
    with pytest.raises(ValueError, match="missing: ring_pip; the file has file_wrist"):
        imu_from_recording(glove, GLOVE, few)
    with pytest.raises(ValueError, match="no joint rotations"):
        imu_from_recording(replace(glove, joints=None), GLOVE, MAP)


def test_real_joint_rotations_have_the_flexions_of_their_positions(data_root: Path) -> None:
    """Against angles fitted to joint positions alone; index and middle finger, of both hands."""
    data = load(f"manipnet:{data_root / 'manipnet'}", "test", takes=("cube_med2",))
    joint_map = {theirs: ours for ours, theirs in MANIPNET_POINTS.items()}
    own = FLEXION & [name.startswith(("index", "middle")) for name in NAMES]
    for sequence in data.sequences:
        side = sequence.name.split("/")[1]
        path = data_root / "manipnet" / f"cube_med2_{side}Hand.bvh"
        glove = read(path, unit=0.1, left_handed=True)
        found = imu_from_recording(glove, data.hand, joint_map, right=side == "right")[::2]
        off = np.degrees(angles_from_rotations(found) - sequence.angles[: len(found)])
        assert np.abs(off[:, own]).max() < 3
        assert np.abs(off[:, own]).mean() < 0.5
