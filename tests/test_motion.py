"""Simulated hands take the postures of hands, and move as hands do."""

from __future__ import annotations

import functools

import numpy as np
import pytest

jax = pytest.importorskip("jax")

from simulated import quickly  # noqa: E402

from jaxhand import contact, motion  # noqa: E402
from jaxhand.anthropometry import mean_person, people  # noqa: E402
from jaxhand.motion import KEYFRAMES, Motion  # noqa: E402
from numpy_infer.hand import ANGLES, FINGERS, HIGH, LOW, TIPS, load_hand  # noqa: E402

RATE, COUNT, LENGTH = 60.0, 32, 900
GLOVE = load_hand("glove9")
PERSON = mean_person(GLOVE)
NAMES = [angle.name for angle in ANGLES]


@functools.cache
def moved(seed: int = 0) -> tuple[Motion, np.ndarray]:
    return jax.tree.map(np.asarray, compiled()(jax.random.key(seed)))


@functools.cache
def compiled():
    def draw(key):
        move = motion.motion(key, LENGTH, RATE, (COUNT,))
        eye, origin = jax.numpy.eye(3), jax.numpy.zeros(3)
        return move, contact.posed(PERSON.skeleton, move.angles, eye, origin)[0]

    return quickly(draw)


@functools.cache
def postures() -> np.ndarray:
    draw = jax.jit(lambda key: motion.postures(key, (20000,)))
    return np.asarray(draw(jax.random.key(0)))


def column(name: str) -> np.ndarray:
    return postures()[:, NAMES.index(name)]


def test_the_same_key_gives_the_same_motion_and_another_key_another() -> None:
    again, other = compiled()(jax.random.key(0))[0], compiled()(jax.random.key(1))[0]
    for name, value in moved()[0]._asdict().items():
        np.testing.assert_array_equal(value, getattr(again, name))
        assert (value != np.asarray(getattr(other, name))).any()
        assert value.dtype == np.float32
        assert np.isfinite(value).all()


def test_shapes() -> None:
    def shape(batch):
        def draw(key):
            return motion.motion(key, 7, RATE, batch, people(key, GLOVE, batch))

        return [a.shape for a in jax.eval_shape(draw, jax.random.key(0))]

    for batch in ((), (2, 3)):
        assert shape(batch) == [(*batch, 7, 26), (*batch, 7, 3, 3), (*batch, 7, 3)]


def test_it_goes_through_the_postures_that_it_is_given_and_rests_in_the_last() -> None:
    flat, open_hand = np.zeros(26), 0.4 * motion.RELEASE  # nothing is in the way between these
    postures = np.array([[flat, open_hand, flat], [open_hand, flat, open_hand], [flat] * 3])
    postures = postures.astype(np.float32)
    draw = quickly(lambda key: motion.motion(key, 900, RATE, (3,), postures=postures).angles)
    angles = np.asarray(draw(jax.random.key(0)))
    shaken = motion.TREMOR + motion.SWAY
    assert (angles > postures.min(1, keepdims=True) - shaken).all()
    assert (angles < postures.max(1, keepdims=True) + shaken).all()
    for each, given in zip(angles, postures, strict=True):
        np.testing.assert_allclose(each[[0, -1]], given[[0, -1]], atol=shaken)
        assert np.abs(each - given[1]).max(-1).min() < shaken


def test_angles_stay_in_their_ranges() -> None:
    for angles in (moved()[0].angles, postures()):
        assert (angles >= LOW - 1e-5).all()
        assert (angles <= HIGH + 1e-5).all()


def test_every_keyframe_can_be_taken() -> None:
    """Settled, it is clear of itself, and near to what it says."""
    kind = np.arange(len(KEYFRAMES))
    still = np.zeros((len(kind), motion.DRAWS), np.float32)
    angles = np.asarray(quickly(motion.varied)(kind, still))
    depth = np.asarray(quickly(contact.depth)(PERSON, angles))
    assert {KEYFRAMES[i].name for i in np.flatnonzero(depth > contact.YIELD + 2e-3)} == set()
    off = np.abs(angles - np.asarray(quickly(motion.angles_of)(kind, still)))
    fingers = [i for i, name in enumerate(NAMES) if "thumb" not in name]
    assert np.degrees(off[:, fingers]).max() < 20


def test_fingers_go_together_and_least_the_outer_ones() -> None:
    flexions = [column(f"{finger}_mcp_flexion") for finger in FINGERS[1:]]
    together = np.corrcoef(flexions)
    assert together[0, 1] > together[0, 3] > 0.3
    assert together[2, 3] > 0.7


def test_dip_follows_pip_and_flexed_fingers_are_not_spread() -> None:
    pip, dip = column("middle_pip_flexion"), column("middle_dip_flexion")
    inside = (pip > np.radians(10)) & (pip < np.radians(80))  # where dip is not at its limit
    assert np.polyfit(pip[inside], dip[inside], 1)[0] == pytest.approx(2 / 3, abs=0.12)
    index, spread = column("index_mcp_flexion"), column("index_mcp_abduction")
    assert spread[index > np.radians(60)].std() < spread[index < np.radians(20)].std()


def test_hands_pass_through_themselves_little() -> None:
    depth = np.asarray(quickly(contact.depth)(PERSON, moved()[0].angles))
    assert np.quantile(depth, 0.9) < contact.YIELD + 1e-3
    assert np.quantile(depth, 0.99) < 0.012


def test_nothing_jumps_and_nothing_is_faster_than_a_hand() -> None:
    move, positions = moved()
    tips = positions[:, :, -len(TIPS) :]
    speed = np.linalg.norm(np.diff(tips, axis=1), axis=-1) * RATE
    assert np.quantile(speed, 0.999) < 2.5
    assert speed.max() < 4.5
    assert 0.005 < np.median(speed) < 0.05
    change = np.abs(np.diff(speed, axis=1))
    assert np.quantile(change, 0.9999) < 1.0
    assert change.max() < 2.0
    wrist = np.linalg.norm(np.diff(move.wrist_position, axis=1), axis=-1) * RATE
    assert wrist.max() < 3
    turn = np.einsum("ntij,ntij->nt", move.wrist_rotation[:, 1:], move.wrist_rotation[:, :-1])
    assert (np.arccos(np.clip((turn - 1) / 2, -1, 1)) * RATE).max() < 12


def test_the_wrist_stays_in_the_room() -> None:
    move, _ = moved()
    assert np.abs(move.wrist_position.mean((0, 1)) - motion.HOME).max() < 0.1
    assert np.abs(move.wrist_position - np.array(motion.HOME)).max() < 1
    turned = np.swapaxes(move.wrist_rotation, -1, -2) @ move.wrist_rotation
    np.testing.assert_allclose(turned, np.broadcast_to(np.eye(3), turned.shape), atol=1e-5)


def test_tremor_is_a_tenth_of_a_millimetre_about_ten_hertz() -> None:
    draws = motion.uniform(jax.random.key(0), (200, 44))
    time = np.arange(600, dtype=np.float32) / RATE
    angles, drift, _ = quickly(motion.shaking)(draws, time)
    index = np.asarray(angles)[..., NAMES.index("index_mcp_flexion")]
    power = np.abs(np.fft.rfft(index - index.mean(-1, keepdims=True), axis=-1)) ** 2
    hertz = np.fft.rfftfreq(600, 1 / RATE)
    fast = (hertz > 5) & (hertz < 15)
    size = np.sqrt(2 * power[:, fast].sum(-1)) / 600 * 0.09
    assert 0.05e-3 < np.median(size) < 0.3e-3
    peak = hertz[fast][power[:, fast].argmax(-1)]
    assert 7 < peak.min() < peak.max() < 13
    assert np.asarray(drift).std() < 3e-3


@pytest.mark.parametrize("seconds", [1, 20])
def test_a_schedule_has_stops_enough(seconds: int) -> None:
    count = motion.enough(seconds, motion.MOVE_SECONDS)
    draws = motion.uniform(jax.random.key(0), (500, 7 * (count - 1)))
    time = np.arange(seconds * 60, dtype=np.float32) / 60
    plan = quickly(lambda draws: motion.schedule(draws, time, motion.MOVE_SECONDS))(draws)
    assert (np.diff(np.asarray(plan.move)) >= 0).all()
    assert (np.asarray(plan.move)[:, -1] == count - 2).mean() < 0.02
    assert (np.asarray(plan.share) >= 0).all()
    assert (np.asarray(plan.share) <= 1 + 1e-6).all()


def test_pitch_yaw_roll_of_none_turns_nothing_and_all_are_rotations() -> None:
    angles = np.random.default_rng(0).normal(size=(50, 3)).astype(np.float32)
    turns = np.asarray(motion.from_pitch_yaw_roll(angles))
    np.testing.assert_allclose(turns @ np.swapaxes(turns, -1, -2), [np.eye(3)] * 50, atol=1e-5)
    assert np.linalg.det(turns).min() > 0
    np.testing.assert_array_equal(motion.from_pitch_yaw_roll(np.zeros(3, np.float32)), np.eye(3))
