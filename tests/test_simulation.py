"""Simulated hands behave like hands, and the same key gives the same hand."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np
import pytest

jax = pytest.importorskip("jax")

from simulated import quickly  # noqa: E402

from jaxhand import simulation  # noqa: E402
from jaxhand.anthropometry import PLACEMENT  # noqa: E402
from jaxhand.simulation import Streams  # noqa: E402
from numpy_infer.hand import ANGLES, HIGH, LOW, PARENTS, POINTS, load_hand  # noqa: E402
from numpy_infer.skeleton import (  # noqa: E402
    forward_kinematics,
    marker_positions,
    rotations_from_angles,
)

RATE, COUNT, LENGTH = 60.0, 32, 900
GLOVE = load_hand("glove9")
NAMES = [angle.name for angle in ANGLES]


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


def of_both(name: str) -> tuple[np.ndarray, np.ndarray]:
    """Markers `[N, M, 3]` and angles `[N, 26]` of all streams, or of the frames."""
    if name == "frames":
        return frames()
    return streams().markers.reshape(-1, len(GLOVE), 3), streams().angles.reshape(-1, len(ANGLES))


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
    assert s.offsets.shape == (COUNT, markers, 3)
    assert s.time[-1] == pytest.approx((LENGTH - 1) / RATE)
    assert {a.dtype for a in s if a.dtype != bool} == {np.dtype(np.float32)}
    assert frames()[0].shape == (20000, markers, 3)
    assert all(np.isfinite(array).all() for array in (*s, *frames()))


def test_bones_keep_their_length() -> None:
    s = streams()
    bones = np.linalg.norm(s.positions[:, :, 1:] - s.positions[:, :, PARENTS[1:]], axis=-1)
    own = np.linalg.norm(s.skeleton[:, 1:], axis=-1)
    np.testing.assert_allclose(bones, np.broadcast_to(own[:, None], bones.shape), atol=2e-6)


def test_markers_and_joints_are_those_of_the_bones_places_and_angles() -> None:
    s = streams()
    for person in (0, COUNT - 1):
        hand = replace(GLOVE, offsets=s.offsets[person])
        turns = rotations_from_angles(s.angles[person])
        wrist = s.wrist_rotation[person], s.wrist_position[person]
        points, rotations = forward_kinematics(s.skeleton[person], turns, *wrist)
        np.testing.assert_allclose(s.positions[person], points, atol=3e-6)
        markers = marker_positions(hand, points, rotations)
        np.testing.assert_allclose(s.markers[person], markers, atol=3e-6)


def test_everybody_has_bones_and_marker_places_of_their_own() -> None:
    s = streams()
    assert len(np.unique(s.skeleton[:, 1], axis=0)) == COUNT
    off = np.linalg.norm(s.offsets - GLOVE.offsets, axis=-1)
    assert 0.5 * PLACEMENT < off.mean(0).min() < off.mean(0).max() < 5 * PLACEMENT


@pytest.mark.parametrize("name", ["streams", "frames"])
def test_angles_stay_in_their_ranges(name: str) -> None:
    _, angles = of_both(name)
    assert (angles >= LOW - 1e-5).all()
    assert (angles <= HIGH + 1e-5).all()


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


@pytest.mark.parametrize("name", ["streams", "frames"])
def test_flat_hands_fists_and_pinches_occur(name: str) -> None:
    markers, angles = of_both(name)
    column = dict(zip(NAMES, np.degrees(angles).T, strict=True))
    flexions = [column[f"{f}_pip_flexion"] for f in ("index", "middle", "ring", "pinky")]
    flat, fist = np.max(flexions, 0) < 20, np.min(flexions, 0) > 85
    thumb, index = (markers[:, GLOVE.markers.index(f"{f}_tip")] for f in ("thumb", "index"))
    pinch = np.linalg.norm(thumb - index, axis=-1) < 0.02
    for share in (flat.mean(), fist.mean(), pinch.mean()):
        assert 0.02 < share < 0.4


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


def test_sequences_are_the_streams_without_their_gaps() -> None:
    found = streams().sequences()
    assert len({s.take for s in found}) == COUNT
    for sequence, markers in zip(found, streams().markers, strict=True):
        assert sequence.rate == RATE
        np.testing.assert_array_equal(sequence.markers, markers)


def test_sequences_of_a_key_are_those_of_its_streams(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn = functools.partial(jax.random.key, 0)

    def made(key: jax.Array, *asked: object) -> Streams:
        assert (key, *asked) == (drawn(), GLOVE, COUNT, LENGTH)
        return streams()

    monkeypatch.setattr(simulation, "streams", made)
    found = simulation.sequences(drawn(), GLOVE, COUNT, LENGTH / RATE)
    for one, other in zip(found, streams().sequences(), strict=True):
        assert one.name == other.name
        np.testing.assert_array_equal(one.markers, other.markers)


def test_still_markers_are_the_hands_own_at_rest() -> None:
    angles = frames()[1][:50]
    found = quickly(lambda angles: simulation.still_markers(GLOVE, GLOVE.skeleton, angles))(angles)
    turns = rotations_from_angles(np.float64(angles))
    points = forward_kinematics(GLOVE.skeleton, turns, np.eye(3), np.zeros(3))
    np.testing.assert_allclose(found, marker_positions(GLOVE, *points), atol=1e-6)


def test_vmap_draws_one_hand_for_each_key() -> None:
    keys = jax.random.split(jax.random.key(3), 3)
    many = quickly(jax.vmap(simulation.poses))(keys)
    np.testing.assert_allclose(many[1], quickly(simulation.poses)(keys[1]), atol=1e-5)

    # Traced only: compiling them takes longer than they are worth.
    def shape(function) -> list[tuple[int, ...]]:
        return [a.shape for a in jax.tree.leaves(jax.eval_shape(jax.vmap(function), keys))]

    assert shape(lambda key: simulation.gaps(key, 30, 9, RATE)) == [(3, 30, 9)]
    assert shape(lambda key: simulation.frames(key, GLOVE, 5))[0] == (3, 5, len(GLOVE), 3)
    assert shape(lambda key: simulation.streams(key, GLOVE, 5, 7))[0] == (3, 5, 7, len(GLOVE), 3)
