"""Simulated hands behave like hands, and the same key gives the same hand."""

from __future__ import annotations

import functools

import numpy as np
import pytest

jax = pytest.importorskip("jax")

from simulated import quickly  # noqa: E402

from jaxhand import simulation  # noqa: E402
from jaxhand.motion import HOME  # noqa: E402
from jaxhand.simulation import Streams  # noqa: E402
from numpy_infer.hand import ANGLES, JOINTS, PARENTS, POINTS, TIPS, load_hand  # noqa: E402

RATE, COUNT, LENGTH = 60.0, 32, 900
GLOVE = load_hand("glove9")
NAMES = [angle.name for angle in ANGLES]
TIP_POINTS = [POINTS.index(tip) for tip in TIPS]


@functools.cache
def compiled(name: str):
    """Compiled once for the whole file: that takes longer than all of the rest."""
    calls = {
        "streams": lambda key: simulation.streams(key, GLOVE, COUNT, LENGTH, RATE),
        "frames": lambda key: simulation.frames(key, GLOVE, 20000),
    }
    return quickly(calls[name])


@functools.cache
def streams(seed: int = 0) -> Streams:
    return jax.tree.map(np.asarray, compiled("streams")(jax.random.key(seed)))


@functools.cache
def frames() -> tuple[np.ndarray, np.ndarray]:
    return jax.tree.map(np.asarray, compiled("frames")(jax.random.key(0)))


def in_hand_frame(points: np.ndarray) -> np.ndarray:
    s = streams()
    return np.einsum("ntmi,ntij->ntmj", points - s.wrist_position[:, :, None], s.wrist_rotation)


def gap_seconds(visible: np.ndarray) -> np.ndarray:
    """Lengths of all gaps of `[N, T, M]`."""
    rows = np.pad(~np.moveaxis(visible, 1, -1), [(0, 0), (0, 0), (1, 1)]).astype(int)
    change = np.diff(rows.reshape(-1, rows.shape[-1]))
    begin, end = np.argwhere(change == 1), np.argwhere(change == -1)
    return (end - begin)[:, 1] / RATE


def test_the_same_key_gives_the_same_hand_and_another_key_another() -> None:
    again = compiled("streams")(jax.random.key(0))
    other = compiled("streams")(jax.random.key(1))
    for name, value in streams()._asdict().items():
        np.testing.assert_array_equal(value, getattr(again, name))
        if name != "time":
            assert (value != np.asarray(getattr(other, name))).any()


def test_shapes_and_precision() -> None:
    s, markers = streams(), len(GLOVE)
    assert s.markers.shape == (COUNT, LENGTH, markers, 3)
    assert s.visible.shape == (COUNT, LENGTH, markers)
    assert s.visible.dtype == bool
    assert s.angles.shape == (COUNT, LENGTH, len(ANGLES))
    assert s.positions.shape == (COUNT, LENGTH, len(POINTS), 3)
    assert s.time[-1] == pytest.approx((LENGTH - 1) / RATE)
    assert {a.dtype for a in s if a.dtype != bool} == {np.dtype(np.float32)}
    assert frames()[0].shape == (20000, markers, 3)
    assert all(np.isfinite(array).all() for array in (*s, *frames()))


def test_bones_keep_their_length() -> None:
    s = streams()
    bones = np.linalg.norm(s.positions[:, :, 1:] - s.positions[:, :, PARENTS[1:]], axis=-1)
    own = np.linalg.norm(s.skeleton[:, 1:], axis=-1)
    np.testing.assert_allclose(bones, np.broadcast_to(own[:, None], bones.shape), atol=2e-6)


def test_people_differ_in_size_and_a_little_in_proportion() -> None:
    draw = quickly(lambda key: simulation.bone_lengths(key, GLOVE, (4000,)))
    skeletons = np.asarray(draw(jax.random.key(0)))
    scale = np.log(np.linalg.norm(skeletons[:, 1:], axis=-1) / np.array([*_lengths()]))
    assert scale.mean(1).std() == pytest.approx(simulation.PERSON_SPREAD, rel=0.1)
    single = (scale - scale.mean(1, keepdims=True)).std()
    assert single == pytest.approx(simulation.BONE_SPREAD, rel=0.1)
    directions = skeletons[:, 1:] / np.linalg.norm(skeletons[:, 1:], axis=-1, keepdims=True)
    flat = GLOVE.skeleton[1:] / np.array([*_lengths()])[:, None]
    np.testing.assert_allclose(directions, np.broadcast_to(flat, directions.shape), atol=1e-5)


def _lengths() -> list[float]:
    return list(GLOVE.bone_lengths.values())


def test_angles_stay_in_their_ranges() -> None:
    low, high = np.radians([angle.range_deg for angle in ANGLES]).T
    for angles in (streams().angles, frames()[1]):
        assert (angles >= low - 1e-5).all()
        assert (angles <= high + 1e-5).all()


def test_postures_are_those_of_a_hand() -> None:
    angles = frames()[1]
    column = dict(zip(NAMES, angles.T, strict=True))
    pip, dip = column["middle_pip_flexion"], column["middle_dip_flexion"]
    inside = dip < np.radians(75)
    assert np.polyfit(pip[inside], dip[inside], 1)[0] == pytest.approx(2 / 3, abs=0.1)
    index, middle, pinky = (column[f"{f}_mcp_flexion"] for f in ("index", "middle", "pinky"))
    assert np.corrcoef(index, middle)[0, 1] > np.corrcoef(index, pinky)[0, 1] > 0.3
    flexed, spread = index > np.radians(60), column["index_mcp_abduction"]
    assert spread[flexed].std() < 0.7 * spread[index < np.radians(20)].std()
    twists = angles[:, [name.endswith("mcp_twist") for name in NAMES]]
    assert np.degrees(twists).std() < 4


def test_flat_hands_fists_and_pinches_occur() -> None:
    s = streams()
    column = dict(zip(NAMES, np.degrees(s.angles).reshape(-1, len(ANGLES)).T, strict=True))
    flexions = [column[f"{f}_pip_flexion"] for f in ("index", "middle", "ring", "pinky")]
    flat, fist = np.max(flexions, 0) < 20, np.min(flexions, 0) > 85
    thumb, index = (s.positions[:, :, POINTS.index(f"{f}_tip")] for f in ("thumb", "index"))
    pinch = np.linalg.norm(thumb - index, axis=-1) < 0.02
    for share in (flat.mean(), fist.mean(), pinch.mean()):
        assert 0.02 < share < 0.4


def test_nothing_jumps_and_nothing_is_faster_than_a_hand() -> None:
    s = streams()
    tips = in_hand_frame(s.positions[:, :, TIP_POINTS])
    tip_speed = np.linalg.norm(np.diff(tips, axis=1), axis=-1) * RATE
    assert tip_speed.max() < 3.2
    assert np.median(tip_speed) > 0.01
    wrist_speed = np.linalg.norm(np.diff(s.wrist_position, axis=1), axis=-1) * RATE
    assert wrist_speed.max() < 3
    turn = np.einsum("ntij,ntij->nt", s.wrist_rotation[:, 1:], s.wrist_rotation[:, :-1])
    assert (np.arccos(np.clip((turn - 1) / 2, -1, 1)) * RATE).max() < 12
    # The fastest move takes 12 frames: its speed changes by less than a third from one to the next.
    assert np.abs(np.diff(tip_speed, axis=1)).max() < 1.0


def test_the_wrist_stays_in_the_room() -> None:
    s = streams()
    assert np.abs(s.wrist_position.mean((0, 1)) - HOME).max() < 0.1
    assert np.abs(s.wrist_position - np.array(HOME)).max() < 1
    turned = np.swapaxes(s.wrist_rotation, -1, -2) @ s.wrist_rotation
    np.testing.assert_allclose(turned, np.broadcast_to(np.eye(3), turned.shape), atol=1e-5)


def test_markers_on_the_wrist_follow_it_rigidly() -> None:
    s = streams()
    rigid = [JOINTS[link] == "wrist" for link in GLOVE.links]
    local = in_hand_frame(s.markers[:, :, rigid])
    np.testing.assert_allclose(local, np.broadcast_to(local[:, :1], local.shape), atol=5e-6)


def test_gaps_are_short_with_a_heavy_tail() -> None:
    seconds = gap_seconds(streams().visible)
    assert len(seconds) > 500
    assert 0.05 < np.median(seconds) < 0.2
    assert 0.25 < np.quantile(seconds, 0.9) < 0.7
    assert 0.003 < (seconds > 1).mean() < 0.08
    assert seconds.min() <= 2 / RATE


def test_several_markers_are_hidden_at_once_now_and_then() -> None:
    visible = streams().visible
    hidden = (~visible).sum(-1)
    share = np.bincount(hidden.ravel(), minlength=len(GLOVE) + 1) / hidden.size
    assert visible[:, 0].all()
    assert 0.4 < share[0] < 0.9
    assert share[1] > share[2] > share[3] > 0
    assert 0.001 < share[4:].sum() < 0.1
    assert ((~visible).mean((0, 1)) > 0.01).all()
    assert (hidden.max(1) < len(GLOVE)).any()


def test_vmap_draws_one_hand_for_each_key() -> None:
    keys = jax.random.split(jax.random.key(3), 3)
    many = quickly(jax.vmap(simulation.poses))(keys)
    np.testing.assert_allclose(many[1], quickly(simulation.poses)(keys[1]), atol=1e-5)

    # Traced only: compiling them takes longer than they are worth.
    def shape(function) -> list[tuple[int, ...]]:
        return [a.shape for a in jax.tree.leaves(jax.eval_shape(jax.vmap(function), keys))]

    assert shape(lambda key: simulation.motion(key, 30, RATE)) == [
        (3, 30, len(ANGLES)),
        (3, 30, 3, 3),
        (3, 30, 3),
    ]
    assert shape(lambda key: simulation.gaps(key, 30, 9, RATE)) == [(3, 30, 9)]
    assert shape(lambda key: simulation.bone_lengths(key, GLOVE)) == [(3, len(POINTS), 3)]
    assert shape(lambda key: simulation.frames(key, GLOVE, 5))[0] == (3, 5, len(GLOVE), 3)
