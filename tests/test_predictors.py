"""Laws of the predictors on their own, before the tracker blends what they say."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from strategies import any_points, masks, motions, spread_points, turn
from streams import a_model, motion, moved, postures, seeds

from numpy_infer import tracker
from numpy_infer.pose import Status
from numpy_infer.predictors import (
    AVERAGE_SECONDS,
    PREDICTORS,
    RIDGE,
    MovingAverageState,
    affine_combination,
)

Array = np.ndarray

EXACT = 2.0**-12
"""Metres. Multiples of it up to 8 m, and their sums, are exact in float32: what then differs is the
algebra's doing."""

every = pytest.mark.parametrize("predictor", PREDICTORS)


def play(
    predictor: str, markers: Array, visible: Array, dt: Array | float = 1 / 60
) -> tuple[Array, object]:
    """`[T, M, 3]` what is filled in, frame by frame, with its own output as the last one."""
    model = a_model(predictor)
    init, step, *_ = PREDICTORS[predictor]
    state, last = init(model), model.hand.template
    filled = []
    for measured, shown, elapsed in zip(
        markers, visible, np.broadcast_to(dt, len(markers)), strict=True
    ):
        state, last = step(
            model, state, np.where(shown[:, None], measured, np.nan), shown, last, elapsed
        )
        filled.append(last)
    return np.array(filled), state


# -- all of them --------------------------------------------------------------------------------


@every
@given(seed=seeds())
def test_visible_markers_are_passed_through_bit_for_bit_and_the_rest_is_finite(
    predictor: str, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    truth = motion(a_model(predictor).hand, rng, 12, 1)[:, 0]
    visible = rng.uniform(size=truth.shape[:-1]) < rng.choice([0.1, 0.5, 0.9])
    filled, _ = play(predictor, truth, visible)
    assert_array_equal(filled[visible], truth[visible])
    assert np.isfinite(filled).all()


@pytest.mark.parametrize("predictor", [p for p in PREDICTORS if p != "learned"])
@given(seed=seeds())
def test_a_marker_never_seen_stays_where_the_output_has_it(predictor: str, seed: int) -> None:
    model = a_model(predictor)
    init, step, *_ = PREDICTORS[predictor]
    rng = np.random.default_rng(seed)
    state, visible = init(model), np.arange(9) < 5
    for _ in range(4):
        last = rng.normal(size=(9, 3))
        measured = np.where(visible[:, None], rng.normal(size=(9, 3)), np.nan)
        state, filled = step(model, state, measured, visible, last, np.asarray(1 / 60))
        assert_array_equal(filled[~visible], last[~visible])


@every
@given(seed=seeds(), motion_of_all=motions())
def test_a_rigid_motion_of_all_frames_moves_what_is_filled_in(
    predictor: str, seed: int, motion_of_all: tuple[Array, Array]
) -> None:
    rng = np.random.default_rng(seed)
    truth = motion(a_model(predictor).hand, rng, 10, 1)[:, 0]
    visible = rng.uniform(size=truth.shape[:-1]) < 0.7
    visible[0] = True  # else `last` comes from the template, which stands still
    # Three or more off a line: else a network's registration turns with nothing.
    visible[:, :3] = True
    one, _ = play(predictor, truth, visible)
    other, _ = play(predictor, moved(truth, *motion_of_all), visible)
    assert_allclose(other, moved(one, *motion_of_all), rtol=0, atol=1e-5)


# -- the affine combination ---------------------------------------------------------------------


def rows(points: Array) -> Array:
    """The same frame for every row."""
    return np.broadcast_to(points, (len(points), *points.shape))


def as_rows(weight: Array) -> Array:
    return np.broadcast_to(weight, (len(weight), len(weight)))


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@given(
    then=any_points(),
    now=any_points(),
    weight=masks(),
    seed=seeds(),
)
def test_weights_sum_to_one_for_any_number_and_arrangement_of_markers(
    dtype: type[np.floating], then: Array, now: Array, weight: Array, seed: int
) -> None:
    """So what all visible markers move by, the filled one moves by: 28-75 mm a metre are missing
    in the plain form with 3 or fewer or coplanar ones."""
    assume(weight.any())
    shift = np.random.default_rng(seed).integers(-8192, 8193, 3) * EXACT
    then, now = (np.round(p / EXACT) * EXACT for p in (then, now))
    frame = rows(then.astype(dtype))
    here, possible = affine_combination(frame, as_rows(weight), now.astype(dtype))
    there, _ = affine_combination(frame, as_rows(weight), (now + shift).astype(dtype))
    assert possible.all()
    assert here.dtype == dtype
    # What rounding is left grows with the weights; 0.1 mm or, of 2 m, 0.005 %.
    tolerance = 1e-4 if dtype == np.float32 else 1e-9
    size = 1 + np.abs(here.astype(float)).max()
    moved_by = there.astype(float) - here
    assert_allclose(moved_by, np.broadcast_to(shift, (9, 3)), rtol=0, atol=tolerance * size)


@given(
    then=any_points(),
    now=any_points(),
    weight=masks(),
    before=motions(),
    after=motions(),
)
def test_the_affine_combination_is_equivariant(
    then: Array,
    now: Array,
    weight: Array,
    before: tuple[Array, Array],
    after: tuple[Array, Array],
) -> None:
    """The frame of then may be turned as a whole, and the frame of now: only shapes matter."""
    assume(weight.any())
    here, _ = affine_combination(rows(then), as_rows(weight), now)
    there, _ = affine_combination(rows(moved(then, *before)), as_rows(weight), moved(now, *after))
    assert_allclose(there, moved(here, *after), rtol=0, atol=1e-5)


@given(then=spread_points(), affine=seeds(), weight=masks())
def test_where_four_markers_span_space_it_is_equation_8_in_its_plain_form(
    then: Array, affine: int, weight: Array
) -> None:
    """W = Y Xᵀ (X Xᵀ + λI)⁻¹, N×N, with homogeneous coordinates, in float64."""
    assume(weight.sum() >= 4)
    seen = then[weight]
    third = np.linalg.svd(seen - seen.mean(0), compute_uv=False)[2]
    assume(third > 0.02)
    rng = np.random.default_rng(affine)
    now = then @ rng.normal(size=(3, 3)) + rng.normal(size=3) + rng.normal(size=then.shape) * 0.01
    x, y = (np.concatenate([p, np.ones((len(p), 1))], 1) for p in (seen, then))
    w = y @ x.T @ np.linalg.inv(x @ x.T + RIDGE * np.eye(len(x)))
    found, _ = affine_combination(rows(then), as_rows(weight), now)
    # λ weighs on the mean too in the plain form, and the two differ by λ / third² of a metre.
    assert_allclose(found, w @ now[weight], rtol=0, atol=1e-3)
    assert_allclose(w.sum(1), 1, rtol=0, atol=1e-3)


@given(seed=seeds(), motion_since=motions())
def test_a_posture_carried_rigidly_is_filled_exactly_by_four_markers_out_of_a_plane(
    seed: int, motion_since: tuple[Array, Array]
) -> None:
    rng = np.random.default_rng(seed)
    posture = postures(a_model("affine").hand, rng, 1, 1)[0, 0]
    weight = rng.permutation(9) < 5
    seen = posture[weight]
    third = np.linalg.svd(seen - seen.mean(0), compute_uv=False)[2]
    assume(third > 5e-3)
    found, _ = affine_combination(rows(posture), as_rows(weight), moved(posture, *motion_since))
    shortfall = 0.2 * RIDGE / third**2  # what λ takes off
    assert_allclose(found, moved(posture, *motion_since), rtol=0, atol=1e-9 + 2 * shortfall)


def test_with_nothing_to_combine_that_is_said() -> None:
    found, possible = affine_combination(
        np.zeros((9, 9, 3)), np.zeros((9, 9), bool), np.zeros((9, 3))
    )
    assert not possible.any()
    assert np.isfinite(found).all()


# -- the moving average -------------------------------------------------------------------------


@given(seed=seeds())
def test_a_constant_velocity_is_carried_on_at_any_and_at_irregular_frame_rates(seed: int) -> None:
    rng = np.random.default_rng(seed)
    dt = rng.choice([1 / 240, 1 / 60, 0.1, 0.0], 40)
    dt[1] = 1 / 60
    velocity = rng.normal(size=(9, 3))
    truth = np.cumsum(dt)[:, None, None] * velocity + rng.normal(size=(9, 3))
    visible = rng.uniform(size=truth.shape[:-1]) < 0.5
    visible[:2] = True
    filled, _ = play("moving_average", truth, visible, dt)
    assert_allclose(filled, truth, rtol=0, atol=1e-9)


@given(seed=seeds())
def test_the_same_motion_at_60_and_at_120_hertz_is_extrapolated_alike(seed: int) -> None:
    """In seconds, not frames. Counting 20 frames, a wave of 1 Hz and 5 cm, that moves at up to
    0.3 m/s, would be extrapolated by velocities that differ by some 0.15 m/s."""
    rng = np.random.default_rng(seed)
    phase, size = rng.uniform(0, 2 * np.pi, (9, 3)), rng.uniform(-0.05, 0.05, (9, 3))
    velocities = []
    for rate in (60, 120):
        time = np.arange(rate + 1)[:, None, None] / rate
        truth = size * np.sin(2 * np.pi * time + phase)
        _, state = play("moving_average", truth, np.ones(truth.shape[:-1], bool), 1 / rate)
        assert isinstance(state, MovingAverageState)
        velocities.append(state.path / state.span[:, None])
    assert_allclose(velocities[0], velocities[1], rtol=0, atol=0.02)


@given(seed=seeds())
def test_a_re_entry_does_not_pollute_the_velocity(seed: int) -> None:
    """Only pairs of measured frames speak of it: wherever a marker comes back, its velocity is
    what it had before it went."""
    rng = np.random.default_rng(seed)
    velocity = rng.normal(size=(9, 3))
    truth = np.arange(40)[:, None, None] / 60 * velocity
    truth[20:] += rng.normal(size=(9, 3))  # a jump, unseen
    visible = np.ones(truth.shape[:-1], bool)
    visible[15:20] = False
    _, state = play("moving_average", truth, visible)
    assert isinstance(state, MovingAverageState)
    assert_allclose(state.path / state.span[:, None], velocity, rtol=0, atol=1e-9)


def test_an_old_velocity_counts_1_over_e_after_the_average_time() -> None:
    frames = 120
    truth = np.zeros((frames, 9, 3))
    truth[:60] = np.arange(60)[:, None, None] / 60
    truth[60:] = truth[59]
    stop = 60 + round(AVERAGE_SECONDS * 60)
    _, state = play("moving_average", truth[:stop], np.ones((stop, 9), bool))
    assert isinstance(state, MovingAverageState)
    assert_allclose(state.path / state.span[:, None], np.exp(-1), rtol=0, atol=0.01)


# -- the learned one ----------------------------------------------------------------------------


@given(seed=seeds())
def test_what_the_network_says_of_visible_markers_is_not_used_and_turns_with_the_hand(
    seed: int,
) -> None:
    model = a_model("learned")
    step = PREDICTORS["learned"].step
    rng = np.random.default_rng(seed)
    posture = postures(model.hand, rng, 1, 1)[0, 0]
    visible = np.arange(9) < rng.integers(3, 9)
    elsewhere = (turn(rng.normal(size=3), rng.uniform(0, 3)), rng.normal(size=3))
    _, here = step(model, (), posture, visible, posture, np.zeros(()))
    _, there = step(model, (), moved(posture, *elsewhere), visible, posture, np.zeros(()))
    assert_allclose(there, moved(here, *elsewhere), rtol=0, atol=1e-5)
    assert np.linalg.norm(here - posture, axis=-1)[~visible].max() > 1e-4


@given(data=st.data())
def test_predictors_take_any_leading_axes(data: st.DataObject) -> None:
    rng = np.random.default_rng(data.draw(seeds()))
    shape = (2, 3)
    for name, (init, step, *_) in PREDICTORS.items():
        model = a_model(name)
        many, one = init(model, shape), init(model)
        last_many = np.broadcast_to(model.hand.template, (*shape, 9, 3))
        last_one = model.hand.template
        for _ in range(3):
            markers = motion(model.hand, rng, 1, 6).reshape(*shape, 9, 3)
            visible = rng.uniform(size=(*shape, 9)) < 0.7
            dt = rng.uniform(0, 0.1, shape)
            many, last_many = step(model, many, markers, visible, last_many, dt)
            one, last_one = step(model, one, markers[1, 2], visible[1, 2], last_one, dt[1, 2])
            assert_allclose(last_many[1, 2], last_one, rtol=0, atol=1e-5)


@every
def test_what_comes_back_is_believed_by_a_gate_that_cannot_know_better(predictor: str) -> None:
    """What holds a marker, or lets it fly on, does not say where the hand has carried it since."""
    model = replace(a_model(predictor), gate=True)
    rng, frames, hidden = np.random.default_rng(5), 90, slice(30, 50)
    time = np.arange(frames)[:, None, None] / 60
    truth = model.hand.template + time * [0.8, 0.3, 0] + 2e-4 * rng.standard_normal((frames, 9, 3))
    visible = np.ones((frames, 1, 9), bool)
    visible[hidden, :, 0] = False
    state = tracker.init(model, (1,))
    for markers, seen in zip(truth[:, None], visible, strict=True):
        state, pose = tracker.step(model, state, markers, seen, np.full(1, 1 / 60))
        assert not (pose.status == Status.REJECTED).any()
