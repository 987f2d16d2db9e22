"""Laws of weighted Kabsch with a prior, on both packages and in both precisions."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import REFERENCE, Side
from hypothesis import assume, given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from strategies import (
    SPREAD,
    Array,
    Registration,
    any_points,
    directions,
    extents,
    flat_points,
    line_points,
    masks,
    motions,
    noise,
    registrations,
    rotations,
    spread_points,
    turn,
    weights,
)

from numpy_infer.geometry import PRIOR_STRENGTH, fit, folded, pattern, refit

EYE = np.eye(3)
MIRROR = np.diag([-1.0, 1.0, 1.0])
BATCH = (300, 1)
"""The one shape of leading axes in this file: each costs a compilation."""


def moved(motion: tuple[Array, Array], points: Array) -> Array:
    """Points moved by the answer of `kabsch`, in float64: what every comparison is about."""
    rotation, translation = (part.astype(float) for part in motion)
    return points @ rotation.T + translation


def first(count: int) -> Array:
    """Weights that leave the first few of nine points."""
    return (np.arange(9) < count).astype(float)


def assert_proper(rotation: Array, tolerance: float) -> None:
    rotation = rotation.astype(float)
    assert_allclose(rotation @ np.swapaxes(rotation, -1, -2) - EYE, 0, atol=tolerance)
    assert_allclose(np.linalg.det(rotation), 1, atol=tolerance)


def angle_between(a: Array, b: Array) -> float:
    """Radians between two rotations, well conditioned at 0 (the chord, not the trace)."""
    chord = np.linalg.norm(a.astype(float) - b.astype(float), axis=(-2, -1)) / np.sqrt(8)
    return 2 * np.arcsin(np.clip(chord, 0, 1))


# -- what the points determine -----------------------------------------------------------------


@given(
    source=st.one_of(spread_points(), flat_points()),
    count=st.sampled_from([3, 4, 9]),
    motion=motions(),
    prior=rotations(),
)
def test_kabsch_recovers_any_rigid_motion(
    side: Side, source: Array, count: int, motion: tuple[Array, Array], prior: Array
) -> None:
    extent = extents(source[:count])[1]
    assume(extent > SPREAD)
    target = moved(motion, source)
    found = side.geometry.kabsch(source, target, first(count), prior)
    assert_allclose(moved(found, source[:count]), target[:count], rtol=0, atol=side.metres)
    # All of space moves, not only the points: a reflected answer fits coplanar ones as well.
    corners = np.concatenate([EYE, -EYE]) * 0.1
    atol = side.metres * max(1, 0.1 / extent)
    assert_allclose(moved(found, corners), moved(motion, corners), rtol=0, atol=atol)


@given(asked=registrations(), motion=motions())
def test_kabsch_turns_with_its_target(
    side: Side, asked: Registration, motion: tuple[Array, Array]
) -> None:
    before = side.geometry.kabsch(*asked.question)
    target, prior = moved(motion, asked.target), motion[0] @ asked.prior
    after = side.geometry.kabsch(asked.source, target, asked.weight, prior)
    assert_allclose(
        moved(after, asked.source),
        moved(motion, moved(before, asked.source)),
        rtol=0,
        atol=2 * side.metres,
    )


@given(asked=registrations(), motion=motions())
def test_kabsch_turns_against_its_source(
    side: Side, asked: Registration, motion: tuple[Array, Array]
) -> None:
    before = side.geometry.kabsch(*asked.question)
    source, prior = moved(motion, asked.source), asked.prior @ motion[0].T
    after = side.geometry.kabsch(source, asked.target, asked.weight, prior)
    assert_allclose(moved(after, source), moved(before, asked.source), rtol=0, atol=2 * side.metres)


@given(source=any_points(), target=any_points(), weight=weights(), prior=rotations())
def test_kabsch_answers_with_a_proper_rotation_whatever_is_asked(
    side: Side, source: Array, target: Array, weight: Array, prior: Array
) -> None:
    rotation, translation = side.geometry.kabsch(source, target, weight, prior)
    assert_proper(rotation, side.metres)
    assert np.isfinite(translation).all()


@given(source=st.one_of(any_points(), spread_points(), flat_points()), motion=motions())
def test_kabsch_answers_a_mirror_image_with_a_proper_rotation(
    side: Side, source: Array, motion: tuple[Array, Array]
) -> None:
    target = moved(motion, source @ MIRROR)
    rotation, _ = side.geometry.kabsch(source, target, np.ones(len(source)), motion[0])
    assert_proper(rotation, side.metres)


@given(
    asked=registrations(spread=True),
    other=st.one_of(rotations(), rotations(0.1)),
    reflected=st.booleans(),
)
def test_no_other_rotation_fits_better(
    side: Side, asked: Registration, other: Array, reflected: bool
) -> None:
    source = asked.source @ MIRROR if reflected else asked.source
    target = asked.target
    covariance = (target - target.mean(0)).T @ (source - source.mean(0))
    # Where the prior speaks, it is not the squared error alone that is least.
    assume(side.geometry.prior_weight(covariance) == 0)
    rotation, translation = side.geometry.kabsch(source, target, asked.weight, asked.prior)

    def squared_error(rotation: Array) -> float:
        residual = (target - target.mean(0)) - (source - source.mean(0)) @ rotation.T
        return float((residual**2).sum())

    best = float(((target - moved((rotation, translation), source)) ** 2).sum())
    slack = (1e-12 if side.dtype == np.float64 else 1e-5) * float((source**2).sum())
    assert best <= squared_error(rotation.astype(float) @ other) + slack
    assert best <= squared_error(other) + slack


# -- the prior ---------------------------------------------------------------------------------


@given(asked=registrations(spread=True), another=rotations())
def test_spread_points_leave_the_prior_no_say_bit_for_bit(
    side: Side, asked: Registration, another: Array
) -> None:
    one = side.geometry.kabsch(*asked.question)
    other = side.geometry.kabsch(*asked.question[:3], another)
    assert_array_equal(one[0], other[0])
    assert_array_equal(one[1], other[1])


@given(source=any_points(), target=any_points(), prior=rotations())
def test_without_points_the_answer_is_the_prior(
    side: Side, source: Array, target: Array, prior: Array
) -> None:
    rotation, translation = side.geometry.kabsch(source, target, np.zeros(len(source)), prior)
    assert_allclose(rotation, prior, atol=side.metres)
    assert_array_equal(translation, 0)


@given(points=any_points(), motion=motions(), prior=rotations())
def test_one_point_is_met_and_the_rotation_is_the_prior(
    side: Side, points: Array, motion: tuple[Array, Array], prior: Array
) -> None:
    target = moved(motion, points)
    found = side.geometry.kabsch(points, target, first(1), prior)
    assert_allclose(found[0], prior, atol=side.metres)
    assert_allclose(moved(found, points[0]), target[0], rtol=0, atol=side.metres)


@given(
    source=line_points(),
    count=st.sampled_from([2, 3, 9]),
    motion=motions(),
    prior=rotations(),
)
def test_a_line_is_met_and_the_twist_about_it_is_the_priors(
    side: Side, source: Array, count: int, motion: tuple[Array, Array], prior: Array
) -> None:
    target = moved(motion, source)
    line = source[:count] - source[:count].mean(0)
    axis = np.linalg.svd(line)[2][0]
    carried, wanted = prior @ axis, motion[0] @ axis
    # Opposite to the line, every twist is equally near to the prior.
    assume(carried @ wanted > -0.9)
    swing_axis = np.cross(carried, wanted)
    swing = np.linalg.norm(swing_axis)
    shortest = turn(swing_axis, np.arctan2(swing, carried @ wanted)) if swing > 1e-12 else EYE
    rotation, _ = found = side.geometry.kabsch(source, target, first(count), prior)
    # The prior pulls at the line too, weaker than the points by `pull`; and rounding of the
    # covariance, whose only large entry is the line's, reads as a twist.
    pull = PRIOR_STRENGTH / float((line**2).sum())
    rounding = np.finfo(side.dtype).eps / pull
    assert angle_between(rotation, shortest @ prior) < 10 * (pull + rounding)
    reach = float(np.linalg.norm(line, axis=-1).max())
    offset = np.abs(moved(found, source) - target)[:count].max()
    assert offset < side.metres + 2 * pull * (swing + 2 * pull) * reach


@given(axis=directions(), motion=motions(), twist=st.sampled_from([-1.0, -0.3, 0.3, 1.0]))
def test_as_points_close_up_to_a_line_the_rotation_goes_over_to_the_prior_without_a_jump(
    side: Side, axis: Array, motion: tuple[Array, Array], twist: float
) -> None:
    rng = np.random.default_rng(0)
    along = rng.uniform(-0.1, 0.1, (9, 1)) * axis
    aside = rng.uniform(-1, 1, (9, 3))
    width = np.linspace(3e-3, 0, BATCH[0])[:, None, None, None]
    source = along + width * aside
    target = moved(motion, source)
    prior = motion[0] @ turn(axis, twist)
    weight, priors = np.ones((*BATCH, 9)), np.broadcast_to(prior, (*BATCH, 3, 3))
    rotation = side.geometry.kabsch(source, target, weight, priors)[0][:, 0]
    assert angle_between(rotation[:1], motion[0])[0] < 1e-3
    assert angle_between(rotation[-1:], prior)[0] < 1e-2
    assert angle_between(rotation[1:], rotation[:-1]).max() < 0.1


@given(axis=directions(), motion=motions(), seed=st.integers(0, 99))
def test_with_the_last_rotation_as_prior_nothing_turns_when_the_points_close_up(
    side: Side, axis: Array, motion: tuple[Array, Array], seed: int
) -> None:
    rng = np.random.default_rng(seed)
    along = rng.uniform(-0.1, 0.1, (9, 1)) * axis
    aside, wrong = rng.uniform(-1, 1, (9, 3)), rng.uniform(-0.2, 0.2, (9, 3))
    last = None
    for width in (*np.linspace(5e-3, 0, 21), 0, 0):
        source = along + width * aside
        target = moved(motion, along + width * (aside + wrong))
        prior = motion[0] if last is None else last
        rotation, _ = side.geometry.kabsch(source, target, np.ones(9), prior)
        assert last is None or angle_between(rotation, last) < 0.02
        last = rotation.astype(float)


# -- weights, mirrors, batches -----------------------------------------------------------------


@given(asked=registrations(), seen=masks(), elsewhere=noise((9, 3)))
def test_points_of_weight_zero_cannot_matter_bit_for_bit(
    side: Side, asked: Registration, seen: Array, elsewhere: Array
) -> None:
    weight = seen.astype(float)
    one = side.geometry.kabsch(asked.source, asked.target, weight, asked.prior)
    hidden = ~seen[:, None]
    other = side.geometry.kabsch(
        np.where(hidden, elsewhere, asked.source),
        np.where(hidden, elsewhere[::-1] * 100, asked.target),
        weight,
        asked.prior,
    )
    assert_array_equal(one[0], other[0])
    assert_array_equal(one[1], other[1])


@given(asked=registrations(spread=True))
def test_weight_zero_is_the_same_as_absence(side: Side, asked: Registration) -> None:
    assume(extents(asked.source[:3])[1] > 2e-2)
    weighted = side.geometry.kabsch(asked.source, asked.target, first(3), asked.prior)
    # By the reference: a shape more would be a compilation more.
    alone = REFERENCE.geometry.kabsch(asked.source[:3], asked.target[:3], np.ones(3), asked.prior)
    assert_allclose(
        moved(weighted, asked.source[:3]),
        moved(alone, asked.source[:3]),
        rtol=0,
        atol=side.metres,
    )


@given(asked=registrations())
def test_a_weight_of_two_is_the_same_point_twice(side: Side, asked: Registration) -> None:
    twice = [0, 1, 2, 3, 4, 5, 0, 1, 2]
    weighted = side.geometry.kabsch(
        asked.source, asked.target, np.array([2.0, 2, 2, 1, 1, 1, 0, 0, 0]), asked.prior
    )
    repeated = side.geometry.kabsch(
        asked.source[twice], asked.target[twice], np.ones(9), asked.prior
    )
    points = asked.source[:6]
    assert_allclose(moved(weighted, points), moved(repeated, points), rtol=0, atol=2 * side.metres)


@given(asked=registrations())
def test_kabsch_of_mirrored_sets_is_the_mirrored_motion(side: Side, asked: Registration) -> None:
    found = side.geometry.kabsch(*asked.question)
    mirrored = side.geometry.kabsch(
        asked.source @ MIRROR, asked.target @ MIRROR, asked.weight, MIRROR @ asked.prior @ MIRROR
    )
    assert_allclose(
        moved(mirrored, asked.source @ MIRROR),
        moved(found, asked.source) @ MIRROR,
        rtol=0,
        atol=2 * side.metres,
    )


@given(asked=st.lists(registrations(), min_size=2, max_size=2))
def test_a_batch_is_the_same_as_one_at_a_time(side: Side, asked: list[Registration]) -> None:
    parts = [np.stack(part) for part in zip(*(one.question for one in asked), strict=True)]
    batch = [np.resize(part, (*BATCH, *part.shape[1:])) for part in parts]
    rotation, translation = side.geometry.kabsch(*batch)
    for i, one in enumerate(asked):
        alone = side.geometry.kabsch(*one.question)
        together = (rotation[i, 0], translation[i, 0])
        assert_allclose(
            moved(together, one.source), moved(alone, one.source), rtol=0, atol=side.metres
        )


# -- the same numbers --------------------------------------------------------------------------


@given(asked=registrations(), weight=weights())
def test_all_sides_give_the_same_motion(side: Side, asked: Registration, weight: Array) -> None:
    ours, theirs = side.geometry, REFERENCE.geometry
    question = (asked.source, asked.target, weight, asked.prior)
    assert_allclose(
        moved(ours.kabsch(*question), asked.source)[weight > 0],
        moved(theirs.kabsch(*question), asked.source)[weight > 0],
        rtol=0,
        atol=2 * side.metres,
    )


def test_jax_kabsch_is_safe_under_vmap() -> None:
    jax = pytest.importorskip("jax")
    from jaxhand import geometry as ours
    from numpy_infer import geometry as theirs

    rng = np.random.default_rng(0)
    source = rng.uniform(-0.1, 0.1, (3, 9, 3))
    question = (source, source + 1, np.ones((3, 9)), np.broadcast_to(EYE, (3, 3, 3)))
    question = tuple(part.astype(np.float32) for part in question)
    found = jax.jit(jax.vmap(ours.kabsch))(*question)
    for a, b in zip(found, theirs.kabsch(*question), strict=True):
        assert_allclose(a, b, rtol=0, atol=1e-5)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@given(points=spread_points(), mask=masks(), rotation=rotations(), away=noise((2, 3, 9, 3)))
def test_several_patterns_at_once_are_fitted_as_one_by_one(
    dtype: type, points: Array, mask: Array, rotation: Array, away: Array
) -> None:
    assume(mask.sum() > 2 and extents(points[mask])[1] > SPREAD)
    sources = (points + 1e-3 * away[:, 0]).astype(dtype)
    weights = np.ones((3, 2, 9), dtype)
    weights[1, 1] = mask
    targets = ((points + 1e-3 * away[0]) @ rotation.T + away[1, 0, 0]).astype(dtype)
    for batch in (np.s_[:], 1):
        found = refit(folded(sources, weights[batch]), targets[batch])
        for k, source in enumerate(sources):
            one = fit(pattern(source, weights[batch][..., k, :]), targets[batch], EYE)
            for several, alone, axes in zip(found, one, (2, 1, 0), strict=True):
                own = several.take(k, -1 - axes)
                assert own.dtype == dtype
                assert_allclose(own, alone, rtol=0, atol=1e-10 if dtype == np.float64 else 1e-4)
