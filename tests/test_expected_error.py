"""What error to expect: 0 where observed, no more while the posture stays, and fitted in sums."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from streams import a_model, motion, moved, paths, seeds

from numpy_infer import tracker
from numpy_infer.model import ERROR_CHANGES

Array = np.ndarray

TABLE = np.array([[0.001, 0.002, 0.003, 0.004, 0.005, 0.006]] * 2) * [[1], [2]]
LEAST, SATURATION = 0.0007, 20.0
NUMBERS = {"faded_error": 0.5, "error_saturation": SATURATION, "least_error": LEAST}


def bent(error: Array) -> Array:
    return LEAST + error / (1 + SATURATION * error)


@given(seeds())
def test_a_posture_that_stays_expects_no_more_error_however_long(seed: int) -> None:
    factors = np.linspace(0.5, 2, 9)
    model = a_model("learned", expected_error=TABLE, marker_error=factors, seed=seed, **NUMBERS)
    rng = np.random.default_rng(seed)
    markers = moved(motion(model.hand, rng, 1, 1)[0], *paths(rng, 30, 1))
    hidden = rng.permutation(9) < rng.integers(1, 4)
    visible = np.broadcast_to(~hidden, (30, 1, 9)).copy()
    visible[:5] = True
    state = tracker.init(model, (1,))
    _, pose = tracker.run(model, state, markers, visible, np.full((30, 1), 1 / 60))
    assert not pose.expected_error[:5].any()
    expected = np.where(hidden, bent(TABLE[min(hidden.sum(), 2) - 1, 0] * factors), 0)
    np.testing.assert_allclose(pose.expected_error[5:, 0] - expected, 0, atol=1e-6)


def test_it_grows_as_the_posture_goes_on_and_with_what_the_correction_has_lost() -> None:
    model = a_model("learned", expected_error=TABLE, **NUMBERS)
    rng = np.random.default_rng(0)
    markers = motion(model.hand, rng, 40, 1)
    visible = np.ones((40, 1, 9), bool)
    visible[5:, :, [3, 6]] = False
    visible[20:, :, 7] = False  # another set: what was gone before is not forgotten
    state = tracker.init(model, (1,))
    for points, seen in zip(markers, visible, strict=True):
        state, pose = tracker.step(model, state, points, seen, np.full(1, 1 / 60))
        hidden = ~seen[0]
        gone = state.drift[0] + state.change
        row = TABLE[min(max(hidden.sum(), 1), 2) - 1]
        lost = np.linalg.norm(state.correction[0], axis=-1) * (1 - np.exp(-state.change / 0.03))
        expected = bent(np.interp(gone, ERROR_CHANGES, row) + 0.5 * lost)
        np.testing.assert_allclose(pose.expected_error[0], np.where(hidden, expected, 0), atol=1e-9)
    assert state.drift[0, 3] > 0.001
    assert state.drift[0, 7] == 0
    assert state.change > 0.001


@pytest.mark.parametrize("continuity", [True, False])
def test_what_is_on_its_way_back_is_off_by_what_is_left_of_it(continuity: bool) -> None:
    model = replace(a_model("learned", expected_error=TABLE), continuity=continuity)
    rng = np.random.default_rng(2)
    markers = motion(model.hand, rng, 60, 1)
    visible = np.ones((60, 1, 9), bool)
    visible[5:40, :, [3, 6]] = False
    state = tracker.init(model, (1,))
    _, pose = tracker.run(model, state, markers, visible, np.full((60, 1), 1 / 60))
    off = np.linalg.norm(pose.markers - markers, axis=-1)
    np.testing.assert_allclose(pose.expected_error[visible], off[visible], atol=1e-9)
    assert (off[40:, 0, 3] > 1e-3).any() == continuity


def test_both_hands_of_a_take_share_their_blocks_of_four_seconds() -> None:
    pytest.importorskip("jax")
    from jaxhand.expected_error import PIECE, _pieces
    from jaxhand.sequences import Sequence

    def of(take: str, frames: int) -> Sequence:
        return Sequence(take, take, 60.0, np.zeros((frames, 9, 3), np.float32))

    # The first take's pieces are cut in the middle of a block.
    sequences = [of("a", PIECE + 300), of("b", 50), of("a", PIECE + 300)]
    truth, block = _pieces(sequences)
    assert block.shape == truth.shape[:2] == (PIECE, 5)
    left, right = (np.concatenate([block[:, i], block[:300, i + 1]]) for i in (0, 3))
    np.testing.assert_array_equal(left, right)
    assert (np.diff(left) != 0).nonzero()[0].tolist() == [239, 479, 719]
    assert not set(block[:50, 2]) & set(left)


def some_samples(seed: int) -> tuple[object, Array]:
    """Samples whose errors scatter about known means, and these."""
    from jaxhand.expected_error import Samples

    rng = np.random.default_rng(seed)
    count = 60_000
    number, marker = rng.integers(1, 9, count), rng.integers(0, 9, count)
    change, faded = rng.gamma(1, 0.005, count), rng.gamma(1, 0.002, count)
    rows, factors = np.array([1, 1.1, 1.3, 1.5, 2, 3]), np.linspace(0.5, 1.5, 9)
    table = np.interp(change, ERROR_CHANGES, TABLE[0])
    means = bent(rows[np.minimum(number, 6) - 1] * factors[marker] * table + 0.7 * faded)
    measured = means * rng.gamma(2, 0.5, count)
    return Samples(number, marker, change, faded, means, measured, number), means


def test_what_is_fitted_is_what_the_errors_were_drawn_from() -> None:
    pytest.importorskip("jax")
    from jaxhand.expected_error import fit

    samples, means = some_samples(0)
    found = fit(samples, 9)
    rows = np.minimum(samples.number, len(found.expected_error)) - 1
    table = np.array(
        [np.interp(samples.change, ERROR_CHANGES, row) for row in found.expected_error]
    )
    error = table[rows, np.arange(len(rows))] * found.marker_error[samples.marker]
    error += found.faded_error * samples.faded
    said = found.least_error + error / (1 + found.error_saturation * error)
    np.testing.assert_allclose(said, means, rtol=0.12)
    np.testing.assert_allclose(found.marker_error, np.linspace(0.5, 1.5, 9), rtol=0.1)
    np.testing.assert_allclose(found.faded_error, 0.7, rtol=0.1)
    # A floor and a table that begins above 0 are nearly one; so are an end and a table that bends.
    np.testing.assert_allclose(found.least_error, LEAST, atol=3e-4)
    np.testing.assert_allclose(found.error_saturation, SATURATION, rtol=0.4)
    assert (np.diff(found.expected_error) >= 0).all()


def test_a_number_never_hidden_is_as_the_next_smaller_and_a_marker_as_the_mean() -> None:
    pytest.importorskip("jax")
    from jaxhand.expected_error import fit

    samples, _ = some_samples(1)
    there = (samples.marker != 4) & (samples.number < 4)
    found = fit(type(samples)(*(field[there] for field in samples)), 9)
    assert np.isfinite(found.expected_error).all()
    np.testing.assert_array_equal(found.expected_error[3:], found.expected_error[[2, 2, 2]])
    assert (found.expected_error[2] > found.expected_error[0]).all()
    assert np.isfinite(found.marker_error).all()
    assert found.marker_error[4] == pytest.approx(1)
