"""Two hands share a world, meet without passing through each other, and mirror each other."""

from __future__ import annotations

import functools

import numpy as np
import pytest

jax = pytest.importorskip("jax")

from simulated import quickly  # noqa: E402

from jaxhand import contact, motion, two_hands  # noqa: E402
from jaxhand.anthropometry import People, mean_person, people, placed  # noqa: E402
from jaxhand.geometry import mirror  # noqa: E402
from jaxhand.motion import Motion  # noqa: E402
from jaxhand.two_hands import SCENES  # noqa: E402
from numpy_infer.hand import ANGLES, load_hand  # noqa: E402

RATE, COUNT, LENGTH = 60.0, 16, 900
GLOVE = load_hand("glove9")
PERSON = mean_person(GLOVE)


@functools.cache
def compiled():
    def draw(key):
        group = people(key, GLOVE, (COUNT,))
        left, right = two_hands.two_hands(key, LENGTH, RATE, (COUNT,), group)
        sides = (left, False), (right, True)
        seen = [two_hands.marked(GLOVE, group.skeleton, move, side) for move, side in sides]
        depth = two_hands.penetration(seen[0][1], seen[1][1], group)
        return group, left, right, seen, depth

    return quickly(draw)


@functools.cache
def drawn():
    return jax.tree.map(np.asarray, compiled()(jax.random.key(0)))


@functools.cache
def stops() -> tuple[np.ndarray, np.ndarray]:
    draw = quickly(lambda d: two_hands.scenes(d, PERSON))
    draws = motion.uniform(jax.random.key(1), (200, two_hands.SCENE_DRAWS))
    return jax.tree.map(np.asarray, draw(draws))


@quickly
def depth_of(rows):
    """Between the hands of `[..., 2, 32]`, on the mean person."""
    turns = motion.from_pitch_yaw_roll(rows[..., 29:])
    points, _ = contact.posed(PERSON.skeleton, rows[..., :26], turns, rows[..., 26:29])
    left, right = points[..., 0, :, :], mirror(points[..., 1, :, :])
    whole = np.broadcast_to(PERSON.radii, (len(rows), 21))
    return two_hands.penetration(left[:, None], right[:, None], People(whole, whole))


def test_the_same_key_gives_the_same_hands() -> None:
    again = jax.tree.leaves(compiled()(jax.random.key(0)))
    for a, b in zip(jax.tree.leaves(drawn()), again, strict=True):
        np.testing.assert_array_equal(a, b)
        assert np.isfinite(a).all()
        assert a.dtype == np.float32


def test_shapes() -> None:
    _, left, right, _, _ = drawn()
    for move in (left, right):
        assert [a.shape[:2] for a in move] == [(COUNT, LENGTH)] * 3
    one = jax.eval_shape(lambda key: two_hands.two_hands(key, 30, RATE), jax.random.key(0))
    assert [a.shape for a in one[1]] == [(30, len(ANGLES)), (30, 3, 3), (30, 3)]


def test_a_right_hand_is_the_mirror_image_of_a_left_one() -> None:
    group, left, _, _, _ = drawn()
    flip = np.array([-1, 1, 1], np.float32)
    image = Motion(
        left.angles, left.wrist_rotation * flip[:, None] * flip, left.wrist_position * flip
    )
    for make in (two_hands.marked, two_hands.posed):
        hand = (GLOVE,) if make is two_hands.marked else ()
        a = quickly(lambda move, make=make, hand=hand: make(*hand, group.skeleton, move))(left)
        b = quickly(lambda move, make=make, hand=hand: make(*hand, group.skeleton, move, True))(
            image
        )
        np.testing.assert_array_equal(np.asarray(a[0]) * flip, b[0])
    turned = np.asarray(b[1])  # by `posed`
    np.testing.assert_allclose(turned[:, :, 0], image.wrist_rotation, atol=1e-6)


def test_markers_sit_where_they_are_placed() -> None:
    from dataclasses import replace

    group, left, _, _, _ = drawn()

    @quickly
    def wear(key):
        offsets = placed(key, GLOVE, group)
        own = replace(GLOVE, offsets=offsets)
        return offsets, *two_hands.marked(own, group.skeleton, left)

    offsets, markers, positions = map(np.asarray, wear(jax.random.key(4)))
    wrist = GLOVE.markers.index("wrist")
    off = np.einsum("ntij,nti->ntj", left.wrist_rotation, markers[:, :, wrist] - positions[:, :, 0])
    expected = np.broadcast_to(offsets[:, None, wrist], off.shape)
    np.testing.assert_allclose(off, expected, atol=1e-5)


def test_hands_that_meet_touch_and_do_not_pass_through_each_other() -> None:
    rows, scene = stops()
    depth = np.asarray(depth_of(rows[:, 2]))[:, 0]
    for number, of in enumerate(SCENES):
        own = depth[scene == number]
        assert len(own) > 3
        assert np.quantile(own, 0.8) < 2 * contact.YIELD, of.name
        if of.name in ("palms together", "clasp", "one over the other"):
            assert np.median(own) > 1e-3, of.name
    for stop in (0, 1, 4):
        assert np.quantile(depth_of(rows[:, stop]), 0.95) < contact.YIELD


def test_little_flesh_lies_in_flesh_on_the_way() -> None:
    depth = drawn()[-1]
    assert 0.05 < (depth > 1e-3).mean() < 0.6
    assert np.quantile(depth, 0.9) < 2 * contact.YIELD
    assert np.quantile(depth, 0.99) < 0.02


def test_palms_face_each_other_on_an_object() -> None:
    rows, scene = stops()
    number = [s.name for s in SCENES].index("object")
    held = rows[scene == number][:, 2]
    dorsal = np.asarray(motion.from_pitch_yaw_roll(held[..., 29:]))[..., 1]
    assert (dorsal[:, 0, 0] < -0.7).all()
    right = dorsal[:, 1] * [-1, 1, 1]
    assert (right[:, 0] > 0.7).all()
    width = -held[:, :, 26].sum(-1)
    assert width.min() > 0.02
    assert width.max() < 0.4


def test_nothing_jumps() -> None:
    _, left, right, seen, _ = drawn()
    for move, (markers, _) in zip((left, right), seen, strict=True):
        speed = np.linalg.norm(np.diff(markers, axis=1), axis=-1) * RATE
        assert speed.max() < 6
        assert np.abs(move.wrist_position - motion.HOME).max() < 1.5
