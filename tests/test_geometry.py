"""Laws of rigid motions and rotations, on both packages and in both precisions. Those of `kabsch`
have a file of their own."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import REFERENCE, Side
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from strategies import (
    Array,
    any_points,
    extents,
    flat_points,
    grid,
    line_points,
    motions,
    rotations,
    spread_points,
    translations,
    turn,
    weights,
)

EYE = np.eye(3)
MIRROR = np.diag([-1.0, 1.0, 1.0])


# -- mirror images -------------------------------------------------------------------------------


@given(points=grid((9, 3), 3), rotation=rotations())
def test_mirror_undoes_itself_bit_for_bit(side: Side, points: Array, rotation: Array) -> None:
    g = side.geometry
    assert_array_equal(g.mirror(g.mirror(points)), side.cast(points))
    assert_array_equal(g.mirror_rotation(g.mirror_rotation(rotation)), side.cast(rotation))
    assert_array_equal(g.mirror(points), side.cast(points) @ side.cast(MIRROR))


@given(points=grid((9, 3), 0.1), motion=motions())
def test_mirror_of_a_moved_point_is_the_mirrored_motion_of_its_mirror(
    side: Side, points: Array, motion: tuple[Array, Array]
) -> None:
    g = side.geometry
    rotation, translation = motion
    mirrored = g.transform(g.mirror_rotation(rotation), g.mirror(translation), g.mirror(points))
    assert_allclose(mirrored, g.mirror(g.transform(*motion, points)), rtol=0, atol=side.metres)
    turned = g.mirror_rotation(rotation).astype(float)
    assert_allclose(turned @ turned.T, EYE, atol=side.metres)
    assert_allclose(np.linalg.det(turned), 1, atol=side.metres)


# -- moving, means, extents --------------------------------------------------------------------


@given(points=any_points(), motion=motions())
def test_transform_turns_then_shifts_each_row(
    side: Side, points: Array, motion: tuple[Array, Array]
) -> None:
    rotation, translation = motion
    expected = [rotation @ point + translation for point in points]
    assert_allclose(side.geometry.transform(*motion, points), expected, rtol=0, atol=side.metres)


@given(points=any_points(), motion=motions())
def test_untransform_undoes_transform(
    side: Side, points: Array, motion: tuple[Array, Array]
) -> None:
    g = side.geometry
    assert_allclose(
        g.untransform(*motion, g.transform(*motion, points)), points, rtol=0, atol=side.metres
    )
    assert_allclose(
        g.transform(*motion, g.untransform(*motion, points)), points, rtol=0, atol=side.metres
    )


@given(points=grid((9, 3), 3), weight=weights())
def test_mean_point_is_the_weighted_mean_and_the_origin_without_weight(
    side: Side, points: Array, weight: Array
) -> None:
    expected = np.average(points, 0, weight) if weight.any() else np.zeros(3)
    assert_allclose(side.geometry.mean_point(points, weight), expected, rtol=0, atol=side.metres)


@given(points=st.one_of(any_points(), flat_points()), weight=weights())
def test_second_extent_is_the_second_singular_value(
    side: Side, points: Array, weight: Array
) -> None:
    centred = points - np.average(points, 0, weight) if weight.any() else points
    longest, second, _ = np.linalg.svd(centred * np.sqrt(weight)[:, None], compute_uv=False)
    # It comes out of a square and a root: half the digits; on a slender set a little less.
    tolerance = (1e-6 if side.dtype == np.float64 else 1e-2) * longest
    found = side.geometry.second_extent(points, weight)
    assert abs(found - second) <= tolerance + side.metres


@given(points=line_points(), shift=translations())
def test_second_extent_of_a_line_is_zero_where_ever_it_stands(
    side: Side, points: Array, shift: Array
) -> None:
    found = side.geometry.second_extent(points + shift, np.ones(9))
    assert found < (1e-6 if side.dtype == np.float64 else 5e-4)


@given(points=any_points(), motion=motions(), weight=weights())
def test_second_extent_does_not_change_under_motion(
    side: Side, points: Array, motion: tuple[Array, Array], weight: Array
) -> None:
    before = side.geometry.second_extent(points, weight)
    after = side.geometry.second_extent(points @ motion[0].T + motion[1], weight)
    longest = extents(points)[0] * np.sqrt(2)
    tolerance = (1e-6 if side.dtype == np.float64 else 1e-2) * longest
    assert abs(before - after) <= tolerance + side.metres


@given(matrix=grid((3, 3), 1))
def test_determinant_is_the_determinant(side: Side, matrix: Array) -> None:
    found = side.geometry.determinant(matrix)
    assert_allclose(found, np.linalg.det(matrix), atol=side.metres)


@given(half=grid((3, 3), 1), vector=grid(3, 1))
def test_solve_undoes_a_symmetric_positive_matrix(side: Side, half: Array, vector: Array) -> None:
    matrix = half @ half.T + EYE
    found = side.geometry.solve(matrix, matrix @ vector)
    assert_allclose(found, vector, rtol=0, atol=2 * side.metres)


# -- rotations ---------------------------------------------------------------------------------


@given(rotation=rotations())
def test_nearest_rotation_of_a_rotation_is_itself(side: Side, rotation: Array) -> None:
    assert_allclose(side.geometry.nearest_rotation(rotation), rotation, atol=side.metres)


@given(rotation=rotations(), size=st.sampled_from([1e-6, 1e-2, 1, 1e3]), matrix=grid((3, 3), 0.1))
def test_nearest_rotation_ignores_stretch(
    side: Side, rotation: Array, size: float, matrix: Array
) -> None:
    stretch = EYE + (matrix + matrix.T)  # positive definite: |matrix| ≤ 0.1
    found = side.geometry.nearest_rotation(size * rotation @ stretch)
    assert_allclose(found, rotation, atol=side.metres)


@given(rotation=rotations(), vector=grid(3, 1))
def test_quaternion_is_unit_with_w_not_negative_and_rotates_like_its_matrix(
    side: Side, rotation: Array, vector: Array
) -> None:
    q = side.geometry.quaternion(rotation).astype(float)
    assert_allclose(q @ q, 1, atol=side.metres)
    assert q[3] >= 0
    twice = 2 * np.cross(q[:3], vector)
    rotated = vector + q[3] * twice + np.cross(q[:3], twice)
    assert_allclose(rotated, rotation @ vector, atol=side.metres)


@pytest.mark.parametrize("axis", [(1, 0, 0), (0, 1, 0), (0, 0, 1), (1, -1, 0), (1, 1, 1)])
def test_quaternion_of_half_a_turn_is_its_axis(side: Side, axis: tuple[int, ...]) -> None:
    q = side.geometry.quaternion(turn(axis, np.pi)).astype(float)
    assert_allclose(abs(q[:3] @ axis) / np.linalg.norm(axis), 1, atol=side.metres)
    assert_allclose(q[3], 0, atol=side.metres)


@pytest.mark.parametrize("angle", [-3.0, 3.0])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_quaternion_beyond_a_right_angle_keeps_w_positive(
    side: Side, axis: int, angle: float
) -> None:
    expected = np.append(np.sin(angle / 2) * EYE[axis], np.cos(angle / 2))
    found = side.geometry.quaternion(turn(EYE[axis], angle))
    assert_allclose(found, expected, atol=side.metres)


# -- the same numbers ---------------------------------------------------------------------------


@given(points=spread_points(), motion=motions(), weight=weights())
def test_all_sides_give_the_same_numbers(
    side: Side, points: Array, motion: tuple[Array, Array], weight: Array
) -> None:
    ours, theirs = side.geometry, REFERENCE.geometry
    questions: dict[str, tuple[Array, ...]] = {
        "mirror": (points,),
        "mirror_rotation": (motion[0],),
        "transform": (*motion, points),
        "untransform": (*motion, points),
        "mean_point": (points, weight),
        "determinant": (motion[0],),
        "nearest_rotation": (motion[0] + 0.1,),
        "prior_weight": (np.outer(points[0], points[1]) + 1e-6 * motion[0],),
        "quaternion": (turn([1, 2, 3], 1.0) @ motion[0],),
    }
    for name, question in questions.items():
        a, b = getattr(ours, name)(*question), getattr(theirs, name)(*question)
        if name == "quaternion" and abs(a[3]) < side.metres:
            continue  # at half a turn rounding decides the sign
        assert_allclose(a, b, rtol=0, atol=side.metres, err_msg=name)
