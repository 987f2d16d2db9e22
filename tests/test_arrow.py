"""Laws of the block-arrow solver: it is the dense one, and derivatives are those of the cost."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("jax")

from jaxhand import arrow
from jaxhand.arrow import Arrow, Priors, Problem, State
from numpy_infer.arrays import Array
from numpy_infer.hand import POINTS, load_hand

HAND = load_hand("glove9")


def drawn(frames: int, own: int, shared: int) -> tuple[Arrow, Array]:
    """An arrow and the dense matrix that it stands for."""
    random = np.random.default_rng(frames + shared)
    size = frames * own + shared
    chain = np.kron(np.eye(frames) + np.eye(frames, k=1), np.ones((own, own)))
    rows = random.normal(size=(size, size))
    rows[: frames * own, : frames * own] *= chain
    rows[frames * own :, : frames * own] = 0
    dense = rows.T @ rows + np.eye(size)
    # The product of a bidiagonal matrix with its own transpose is tridiagonal.
    blocks = dense[: frames * own, : frames * own].reshape(frames, own, frames, own)
    each = np.arange(frames)
    return Arrow(
        blocks[each, :, each],
        blocks[each[:-1], :, each[1:]],
        dense[: frames * own, frames * own :].reshape(frames, own, shared),
        dense[frames * own :, frames * own :],
    ), dense


SHAPES = [(1, 3, 2), (2, 3, 0), (6, 3, 4), (5, 1, 7)]


@pytest.mark.parametrize("shape", SHAPES)
def test_the_solution_is_that_of_the_dense_matrix(shape: tuple[int, int, int]) -> None:
    matrix, dense = drawn(*shape)
    right = np.random.default_rng(1).normal(size=len(dense))
    split = shape[0] * shape[1]
    frames, shared = arrow.solve(matrix, right[:split].reshape(shape[:2]), right[split:])
    expected = np.linalg.solve(dense, right)
    np.testing.assert_allclose(np.append(frames, shared), expected, atol=1e-9)


@pytest.mark.parametrize("shape", SHAPES)
def test_the_covariance_is_the_inverse(shape: tuple[int, int, int]) -> None:
    matrix, dense = drawn(*shape)
    inverse, (count, own, _), split = np.linalg.inv(dense), shape, shape[0] * shape[1]
    found = arrow.covariance(matrix)
    blocks = inverse[:split, :split].reshape(count, own, count, own)
    np.testing.assert_allclose(found.frames, blocks[np.arange(count), :, np.arange(count)])
    np.testing.assert_allclose(found.border.reshape(split, -1), inverse[:split, split:], atol=1e-9)
    np.testing.assert_allclose(found.shared, inverse[split:, split:], atol=1e-9)


def test_shared_unknowns_known_better_make_frames_better_known() -> None:
    matrix, dense = drawn(6, 3, 4)
    split = 18
    found = arrow.covariance(matrix, np.zeros((4, 4)))
    blocks = np.linalg.inv(dense[:split, :split]).reshape(6, 3, 6, 3)
    np.testing.assert_allclose(found.frames, blocks[range(6), :, range(6)], atol=1e-9)


def posed(frames: int = 7) -> tuple[Problem, State]:
    """A hand some way from the markers, one of which is a ghost and one hidden."""
    random = np.random.default_rng(0)
    width = int(arrow.WIDTHS.sum())
    state = State(
        0.02 * random.normal(size=width),
        HAND.offsets + 2e-3 * random.normal(size=(9, 3)),
        random.uniform(-0.2, 1.0, (frames, 26)),
        np.repeat(np.eye(3)[None], frames, 0),
        0.01 * random.normal(size=(frames, 3)),
    )
    free = np.ones(width + 27, bool)
    empty = np.zeros((frames, 9, 3))
    problem = Problem(HAND, empty, np.arange(frames) / 10, free, Priors(), 1.0)
    markers = arrow.evaluate(problem, state, 1.0).residual + 3e-3 * random.normal(size=empty.shape)
    markers[1, 2], markers[2, 5] = np.nan, 0.5
    return problem._replace(markers=markers), state


@pytest.mark.parametrize("part", ["bones", "offsets", "angles", "turn", "shift"])
@pytest.mark.parametrize("smoothness", [0.0, 1.0])
def test_the_gradient_is_that_of_the_cost(part: str, smoothness: float) -> None:
    problem, state = posed()
    problem = problem._replace(smoothness=smoothness)
    point, random = arrow.evaluate(problem, state, 2e-3), np.random.default_rng(1)
    frames, shared = np.zeros((7, 32)), np.zeros(len(problem.free))
    width = int(arrow.WIDTHS.sum())
    where = {
        "bones": shared[:width],
        "offsets": shared[width:],
        "angles": frames[:, :26],
        "turn": frames[:, arrow.TURN],
        "shift": frames[:, arrow.SHIFT],
    }[part]
    where[:] = 1e-4 * random.normal(size=where.shape) * (0.02 if part == "offsets" else 1)
    costs = [
        arrow.evaluate(problem, arrow.moved(problem, state, s * frames, s * shared), 2e-3).cost
        for s in (1, -1)
    ]
    expected = 4 * ((point.frames * frames).sum() + (point.shared * shared).sum())
    assert costs[0] - costs[1] == pytest.approx(expected, rel=2e-2, abs=1e-2)


def test_nothing_follows_on_what_was_before_a_cut() -> None:
    problem, state = posed()
    problem = problem._replace(time=problem.time + 1e6 * (np.arange(7) > 3))
    links = np.abs(arrow.evaluate(problem, state, 2e-3).arrow.links).max((-1, -2))
    assert links[3] < 1e-9
    assert np.delete(links, 3).min() > 1


def test_a_descent_goes_down_and_leaves_alone_what_is_not_free() -> None:
    problem, state = posed()
    problem.free[:] = False
    found = arrow.descend(problem, state, 2e-3)
    assert found.cost < arrow.evaluate(problem, state, 2e-3).cost
    np.testing.assert_array_equal(found.state.bones, state.bones)
    np.testing.assert_array_equal(found.state.offsets, state.offsets)
    assert found.weight[2, 5] < 1e-6
    assert found.weight[1, 2] == 0
    turned = found.state.rotation.swapaxes(-1, -2) @ found.state.rotation
    np.testing.assert_allclose(turned, np.broadcast_to(np.eye(3), turned.shape), atol=1e-12)


def test_bones_of_nought_are_the_given_hand() -> None:
    flat = np.float32(HAND.skeleton)
    none = np.zeros(int(arrow.WIDTHS.sum()), np.float32)
    np.testing.assert_array_equal(arrow.skeleton(flat, none), flat)
    size = none.copy()
    size[0] = np.log(2)
    np.testing.assert_allclose(arrow.skeleton(flat, size), 2 * flat, rtol=1e-6)
    assert len(flat) == len(POINTS)


def test_an_axis_comes_back_from_its_matrix() -> None:
    vectors = np.random.default_rng(0).normal(size=(5, 3))
    np.testing.assert_allclose(arrow.axial(arrow.cross_matrix(vectors)), vectors)
    np.testing.assert_allclose(
        (arrow.cross_matrix(vectors) @ vectors[::-1, :, None])[..., 0],
        np.cross(vectors, vectors[::-1]),
        atol=1e-12,
    )
