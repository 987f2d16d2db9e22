"""Laws of rotation vectors, shortest arcs and small linear systems, on both packages."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import REFERENCE, Side
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from strategies import Array, directions, grid, noise, rotations, turn

EYE = np.eye(3)


def angle_of(rotation: Array) -> float:
    """Radians, also right near none."""
    rotation = rotation.astype(float)
    skew = rotation - rotation.T
    return float(np.arctan2(np.linalg.norm(skew) / np.sqrt(2), np.trace(rotation) - 1))


@given(axis=directions(), angle=st.one_of(st.sampled_from([0.0, 1e-12, 1e-6]), st.floats(0, 3.1)))
def test_a_rotation_vector_turns_about_itself_by_its_length(
    side: Side, axis: Array, angle: float
) -> None:
    found = side.geometry.rotation_from_vector(angle * axis)
    assert_allclose(found, turn(axis, angle), rtol=0, atol=side.metres)


@given(source=grid(3, 0.2), target=grid(3, 0.2))
def test_the_shortest_arc_brings_one_direction_to_the_other_and_is_shortest(
    side: Side, source: Array, target: Array
) -> None:
    lengths = np.linalg.norm(source), np.linalg.norm(target)
    arc = side.geometry.shortest_arc(source, target, np.ones(()))
    assert_allclose(arc @ arc.T, EYE, rtol=0, atol=side.metres)
    assert np.linalg.det(arc.astype(float)) > 0
    if min(lengths) < 1e-3:
        assert min(lengths) > 0 or (arc == EYE).all()
        return
    assert_allclose(arc @ source / lengths[0], target / lengths[1], rtol=0, atol=10 * side.metres)
    crossed = np.linalg.norm(np.cross(source, target))
    least = np.arctan2(crossed, source @ target)
    assert_allclose(angle_of(arc), least, rtol=0, atol=2e-3 if side.dtype == np.float32 else 1e-7)


@given(source=directions(), size=st.sampled_from([1e-3, 0.1, 3.0]))
def test_between_opposite_directions_there_is_a_half_turn(
    side: Side, source: Array, size: float
) -> None:
    arc = side.geometry.shortest_arc(source * 0.1, -source * size, np.ones(()))
    assert_allclose(arc @ source, -source, rtol=0, atol=10 * side.metres)
    assert np.linalg.det(arc.astype(float)) > 0


@given(source=directions(), target=directions(), share=st.sampled_from([0.0, 0.25, 0.5, 1.0]))
def test_a_share_of_the_arc_is_that_share_of_its_angle(
    side: Side, source: Array, target: Array, share: float
) -> None:
    whole = side.geometry.shortest_arc(source, target, np.ones(()))
    part = side.geometry.shortest_arc(source, target, np.array(share))
    assert_allclose(angle_of(part), share * angle_of(whole), rtol=0, atol=2e-3)
    if share == 0.5:
        assert_allclose(part @ part, whole, rtol=0, atol=10 * side.metres)


@given(source=directions(), target=directions(), rotation=rotations())
def test_the_arc_turns_with_its_directions(
    side: Side, source: Array, target: Array, rotation: Array
) -> None:
    if source @ target < -0.99:
        return  # near a half turn there are many
    arc = side.geometry.shortest_arc(source, target, np.ones(()))
    moved = side.geometry.shortest_arc(rotation @ source, rotation @ target, np.ones(()))
    assert_allclose(moved, rotation @ arc @ rotation.T, rtol=0, atol=100 * side.metres)


@pytest.mark.parametrize("size", [3, 6])
@given(seed=st.integers(0, 999), condition=st.sampled_from([0, 2, 4]))
def test_a_positive_system_is_solved(side: Side, size: int, seed: int, condition: int) -> None:
    rng = np.random.default_rng(seed)
    basis, _ = np.linalg.qr(rng.standard_normal((4, size, size)))
    extents = 10.0 ** -np.linspace(0, condition, size)
    matrix = basis * extents @ np.swapaxes(basis, -1, -2)
    vector = rng.standard_normal((4, size))
    found = side.geometry.solve(matrix, vector)
    back = (matrix @ found[..., None].astype(float))[..., 0]
    assert_allclose(back, vector, rtol=0, atol=side.metres * 10 * 10**condition)


@given(source=noise((5, 3)), target=noise((5, 3)))
def test_all_sides_draw_the_same_arc(side: Side, source: Array, target: Array) -> None:
    share = np.linspace(0, 1, 5)
    found = side.geometry.shortest_arc(source, target, share)
    expected = REFERENCE.geometry.shortest_arc(source, target, share)
    assert_allclose(found, expected, rtol=0, atol=1e-9 if side.dtype == np.float64 else 1e-4)
