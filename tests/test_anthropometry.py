"""Drawn people are as different as people are, and markers sit on their skin."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np
import pytest

jax = pytest.importorskip("jax")

from simulated import quickly  # noqa: E402

from jaxhand import anthropometry  # noqa: E402
from jaxhand.anthropometry import People, mean_person, people, placed  # noqa: E402
from numpy_infer.hand import CHAINS, POINTS, bundled, load_hand  # noqa: E402

GLOVE, DENSE = load_hand("glove9"), load_hand("dense19")
COUNT = 20000
BASES = [chain[0] for chain in CHAINS]
PHALANGES = [p for p in range(1, len(POINTS)) if p not in BASES]


@functools.cache
def many() -> People:
    drawn = quickly(lambda key: people(key, GLOVE, (COUNT,)))(jax.random.key(0))
    return jax.tree.map(np.asarray, drawn)


def lengths(skeleton: np.ndarray) -> np.ndarray:
    return np.linalg.norm(skeleton, axis=-1)


def hand_length() -> np.ndarray:
    """Wrist to the tip of the middle finger."""
    return -many().skeleton[:, list(CHAINS[2]), 2].sum(-1)


def hand_breadth() -> np.ndarray:
    x = many().skeleton[:, :, 0]
    return x[:, CHAINS[1][0]] - x[:, CHAINS[4][0]]


def test_the_mean_person_is_the_given_hand() -> None:
    error = 4 * many().skeleton.std(0) / np.sqrt(COUNT) + 1e-7
    assert (np.abs(many().skeleton.mean(0) - GLOVE.skeleton) < error).all()
    mean = np.array([anthropometry.RADII[point] for point in POINTS]) / 1e3
    np.testing.assert_allclose(many().radii.mean(0), mean, rtol=4e-3)


def test_all_bundled_hands_have_one_mean_person() -> None:
    for name in bundled():
        np.testing.assert_array_equal(load_hand(name).skeleton, GLOVE.skeleton)


def test_the_same_key_gives_the_same_people_in_any_batch() -> None:
    draw = quickly(lambda key: people(key, GLOVE, (2, 3)))
    first, again = (draw(jax.random.key(1)) for _ in range(2))
    for a, b in zip(first, again, strict=True):
        np.testing.assert_array_equal(a, b)
        assert a.dtype == np.float32
        assert np.isfinite(a).all()
    one = jax.eval_shape(lambda key: people(key, GLOVE), jax.random.key(1))
    assert one.skeleton.shape == (len(POINTS), 3)


def test_hands_vary_as_the_survey_says() -> None:
    """FAA: 187 mm and 7 %; 82.5 mm and 8.5 %. The wrist's point varies by itself."""
    along, aside = hand_length(), hand_breadth()
    size = np.hypot(anthropometry.SIZE_SPREAD, anthropometry.WRIST_SPREAD / along.mean())
    assert along.mean() == pytest.approx(0.187, abs=0.006)
    assert np.log(along).std() == pytest.approx(size, abs=0.01)
    assert np.log(aside).std() == pytest.approx(anthropometry.BREADTH_SPREAD, abs=0.012)
    assert np.corrcoef(along, aside)[0, 1] == pytest.approx(0.7, abs=0.07)


def test_a_finger_goes_with_the_hand_but_not_all_the_way() -> None:
    size = np.log(hand_length())
    bones = np.log(lengths(many().skeleton[:, PHALANGES])).T
    explained = [np.corrcoef(size, bone)[0, 1] ** 2 for bone in bones]
    assert min(explained) > 0.49  # Buchholz et al. 1992
    assert max(explained) < 0.99
    fingers = [lengths(many().skeleton[:, list(chain[1:])]).sum(-1) for chain in CHAINS[1:]]
    palm = -many().skeleton[:, CHAINS[2][0], 2]
    together = np.corrcoef(np.log(np.stack([*fingers, palm])))
    size, finger, digit, bone = (
        getattr(anthropometry, f"{name}_SPREAD") for name in ("SIZE", "FINGER", "DIGIT", "BONE")
    )
    wrist = anthropometry.WRIST_SPREAD / palm.mean()
    long = size**2 + finger**2 + digit**2 + bone**2 / 3
    short = size**2 + finger**2 + bone**2 + wrist**2
    expected = (size**2 - finger**2) / np.sqrt(long * short)
    assert together[1, -1] == pytest.approx(expected, abs=0.03)
    assert together[1, 2] == pytest.approx((size**2 + finger**2) / long, abs=0.03)


def test_thick_fingers_go_with_broad_hands_a_little() -> None:
    radii = np.log(many().radii[:, PHALANGES]).T
    explained = [np.corrcoef(np.log(hand_breadth()), r)[0, 1] ** 2 for r in radii]
    assert min(explained) > 0.12  # Buchholz and Armstrong 1991
    assert max(explained) < 0.47
    assert radii.std() > 0.05
    assert np.corrcoef(radii)[0, 1:].min() > 0.5


def test_phalanges_keep_their_directions() -> None:
    own = many().skeleton[:, PHALANGES]
    flat = GLOVE.skeleton[PHALANGES]
    directions = own / lengths(own)[..., None]
    expected = np.broadcast_to(flat / lengths(flat)[:, None], directions.shape)
    np.testing.assert_allclose(directions, expected, atol=1e-5)


@pytest.mark.parametrize("hand", [GLOVE, DENSE], ids=lambda hand: hand.name)
def test_without_error_the_mean_person_wears_the_hand_as_it_is(hand) -> None:
    offsets = placed(jax.random.key(0), hand, mean_person(hand), error=0)
    np.testing.assert_allclose(offsets, hand.offsets, atol=1e-7)


@pytest.mark.parametrize("hand", [GLOVE, DENSE], ids=lambda hand: hand.name)
def test_markers_keep_their_height_above_the_skin(hand) -> None:
    """Twice as thick and as long: twice as far from the joint."""
    mean = mean_person(hand)
    double = People(2 * mean.skeleton, 2 * mean.radii)
    offsets = placed(jax.random.key(0), hand, double, error=0)
    np.testing.assert_allclose(offsets, 2 * hand.offsets, atol=1e-7)
    thick = placed(jax.random.key(0), hand, mean._replace(radii=2 * mean.radii), error=0)
    # Fingers and palm lie along z: height is y, and x aside.
    flat = [i for i, joint in enumerate(hand.joints) if not POINTS[joint].startswith("thumb")]
    expected = hand.offsets[flat] * [2, 2, 1]
    np.testing.assert_allclose(np.asarray(thick)[flat], expected, atol=1e-7)


def test_a_marker_is_misplaced_along_the_skin() -> None:
    group = jax.tree.map(lambda a: np.broadcast_to(a, (COUNT, *a.shape)), mean_person(GLOVE))
    offsets = np.asarray(placed(jax.random.key(0), GLOVE, group))
    off = offsets - GLOVE.offsets
    for marker, link in enumerate(GLOVE.links):
        spread = off[:, marker].std(0)
        expected = anthropometry.PLACEMENT * (2 if link == 0 else 1)
        if link == 0:
            assert spread[1] < 1e-6  # the back of the hand looks along y
            np.testing.assert_allclose(spread[[0, 2]], expected, rtol=0.05)
        else:
            np.testing.assert_allclose(spread, expected, rtol=0.05)


def test_placed_offsets_are_worn_by_a_hand() -> None:
    from jaxhand.skeleton import marker_positions

    group = quickly(lambda key: people(key, DENSE, (4,)))(jax.random.key(3))
    offsets = quickly(lambda key: placed(key, DENSE, group))(jax.random.key(2))
    worn = replace(DENSE, offsets=offsets[:, None])
    positions = np.zeros((4, 7, len(POINTS), 3), np.float32)
    rotations = np.broadcast_to(np.eye(3, dtype=np.float32), (4, 7, 16, 3, 3))
    markers = quickly(lambda: marker_positions(worn, positions, rotations))()
    np.testing.assert_allclose(markers, np.broadcast_to(offsets[:, None], markers.shape))
