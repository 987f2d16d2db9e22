"""Capsules meet where flesh would, and what is settled touches without lying in anything."""

from __future__ import annotations

import functools

import numpy as np
import pytest
from hypothesis import given
from strategies import grid, joint_angles, motions

jax = pytest.importorskip("jax")

from simulated import quickly  # noqa: E402

from jaxhand import contact, motion  # noqa: E402
from jaxhand.anthropometry import mean_person, people  # noqa: E402
from jaxhand.contact import BONES, PAIRS, YIELD, capsules, distance, penetration  # noqa: E402
from numpy_infer.hand import PARENTS, POINTS, load_hand  # noqa: E402
from numpy_infer.skeleton import (  # noqa: E402
    forward_kinematics,
    marker_positions,
    rotations_from_angles,
)

GLOVE = load_hand("glove9")
PERSON = mean_person(GLOVE)
NAMES = [frame.name for frame in motion.KEYFRAMES]
COUNT = 2000


def single(array) -> np.ndarray:
    return np.asarray(array, np.float32)


@functools.cache
def drawn():
    """Postures of many people, before and after they are settled."""

    def draw(key):
        group = people(key, GLOVE, (COUNT,))
        kind = jax.numpy.arange(COUNT) % len(NAMES)
        normal = jax.random.normal(key, (COUNT, motion.DRAWS))
        rough, settled = motion.angles_of(kind, normal), motion.varied(kind, normal, group)
        return kind, contact.depth(group, rough), contact.depth(group, settled), settled, group

    return jax.tree.map(np.asarray, quickly(draw)(jax.random.key(0)))


@given(grid((2, 2, 3), 0.1))
def test_distance_is_the_least_over_both_segments(ends) -> None:
    one, other = ends
    along = np.linspace(0, 1, 101)[:, None]
    points, others = (s[0] + along * (s[1] - s[0]) for s in (one, other))
    sampled = np.linalg.norm(points[:, None] - others, axis=-1).min()
    found = float(distance(single(one), single(other)))
    step = sum(np.linalg.norm(s[1] - s[0]) for s in (one, other)) / 100
    assert sampled - step - 1e-5 <= found <= sampled + 1e-5
    assert float(distance(single(other), single(one))) == pytest.approx(found, abs=2e-5)


@pytest.mark.parametrize(
    ("other", "expected"),
    [
        ([[0, 0, 1], [1, 0, 1]], 1),  # parallel
        ([[2, 0, 0], [3, 0, 0]], 1),  # on one line
        ([[0.5, -1, 0], [0.5, 1, 0]], 0),  # crossing
        ([[0.5, 2, 0], [0.5, 2, 0]], 2),  # a point
    ],
)
def test_distance_of_singular_segments(other, expected: float) -> None:
    one = single([[0, 0, 0], [1, 0, 0]])
    assert float(distance(one, single(other))) == pytest.approx(expected, abs=1e-6)


def test_capsules_are_bones_with_their_radii() -> None:
    positions = np.arange(63, dtype=np.float32).reshape(21, 3)
    segments, radii = capsules(positions, np.arange(21, dtype=np.float32))
    for bone, name in enumerate(BONES):
        end = POINTS.index(name)
        np.testing.assert_array_equal(segments[bone], positions[[PARENTS[end], end]])
        assert radii[bone] == end


def test_penetration_is_the_overlap_of_two_capsules() -> None:
    one = single([[[0, 0, 0], [1, 0, 0]]])
    others = single([[[0, 0.5, 0], [1, 0.5, 0]], [[0, 2, 0], [1, 2, 0]]])
    depth = penetration(one, single([0.4]), others, single([0.3, 0.3]))
    np.testing.assert_allclose(depth, [[0.2, 0]], atol=1e-6)


def test_joined_bones_and_the_palm_do_not_meet() -> None:
    pairs = {frozenset((BONES[a], BONES[b])) for a, b in PAIRS.T}
    for apart in (("index_pip", "index_dip"), ("index_mcp", "ring_mcp"), ("index_pip", "ring_mcp")):
        assert frozenset(apart) not in pairs
    for meeting in (
        ("thumb_tip", "index_tip"),
        ("ring_tip", "ring_mcp"),
        ("index_dip", "ring_dip"),
    ):
        assert frozenset(meeting) in pairs
    assert quickly(contact.depth)(PERSON, np.zeros(26, np.float32)) == 0


posed = quickly(lambda *pose: contact.posed(PERSON.skeleton, *pose))
marked = quickly(lambda *pose: contact.marked(GLOVE, PERSON.skeleton, *pose))


@given(joint_angles(), motions())
def test_posed_is_forward_kinematics(angles, wrist) -> None:
    angles, rotation, position = single(angles), *map(single, wrist)
    local = rotations_from_angles(angles)
    expected = forward_kinematics(PERSON.skeleton, local, rotation, position)
    found = posed(angles, rotation, position)
    for a, b in zip(found, expected, strict=True):
        np.testing.assert_allclose(a, b, atol=3e-6)
    markers, positions = marked(angles, rotation, position)
    np.testing.assert_allclose(markers, marker_positions(GLOVE, *expected), atol=3e-6)
    np.testing.assert_array_equal(positions, found[0])


def test_the_push_is_half_the_gradient_of_the_squared_depths() -> None:
    kind = np.array([NAMES.index("fist")] * 4)
    normal = jax.random.normal(jax.random.key(1), (4, motion.DRAWS))
    angles = quickly(motion.angles_of)(kind, normal).T
    radii = single(PERSON.radii)[:, None] * 1.3
    skeleton = single(PERSON.skeleton)[..., None]

    def square(angles):
        points, _ = contact.kinematics(skeleton, angles)
        return contact.own_repulsion(points, radii, 0)[1].sum()

    def push(angles):
        points, turns = contact.kinematics(skeleton, angles)
        force, total, _ = contact.own_repulsion(points, radii, 0)
        return contact.generalised(points, contact.turning(turns, angles)[0], force), total

    down, total = quickly(push)(angles)
    slope = np.asarray(quickly(jax.grad(square))(angles)) * contact.EASE[:, None]
    assert float(total.min()) > 0
    np.testing.assert_allclose(down, -slope / 2, atol=2e-3 * np.abs(slope).max())


def test_settling_frees_flesh_from_flesh() -> None:
    _, rough, settled, _, _ = drawn()
    assert (rough > 2 * YIELD).mean() > 0.1
    assert (settled > YIELD + 1e-4).mean() < 0.1
    assert np.quantile(settled, 0.99) < 0.01


def test_pads_touch_on_everybodys_own_bones() -> None:
    kind, _, _, angles, group = drawn()
    eye, origin = np.eye(3, dtype=np.float32), np.zeros(3, np.float32)
    positions, _ = quickly(contact.posed)(group.skeleton, angles, eye, origin)
    segments, radii = capsules(positions, group.radii)
    thumb = BONES.index("thumb_tip")
    for finger in ("index", "middle", "ring", "pinky"):
        of = kind == NAMES.index(f"pinch {finger}")
        bone = BONES.index(f"{finger}_tip")
        gap = np.asarray(distance(segments[of, thumb], segments[of, bone]))
        gap = gap - np.asarray(radii[of, thumb] + radii[of, bone])
        assert np.median(np.abs(gap + contact.PRESS)) < 1e-3
        assert np.quantile(np.abs(gap + contact.PRESS), 0.9) < 4e-3


def test_the_first_clear_candidate_is_taken_else_the_least_deep() -> None:
    candidates = np.arange(6, dtype=np.float32).reshape(3, 2, 1)
    depth = single([[0.01, 0.02], [0.001, 0.015], [0, 0.03]])
    np.testing.assert_array_equal(contact.first_clear(candidates, depth), [[2], [3]])
