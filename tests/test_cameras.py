"""Cameras see what nothing hides, and what they get wrong is known."""

from __future__ import annotations

import functools
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

jax = pytest.importorskip("jax")

import strategies as own  # noqa: E402

from jaxhand import cameras, motion  # noqa: E402
from jaxhand.anthropometry import mean_person  # noqa: E402
from jaxhand.cameras import Faults, Rig, Spells, Surface  # noqa: E402
from numpy_infer.hand import FINGERS, TIPS, load_hand  # noqa: E402
from numpy_infer.reach import reach  # noqa: E402
from numpy_infer.skeleton import (  # noqa: E402
    forward_kinematics,
    marker_positions,
    rotations_from_angles,
)

GLOVE = load_hand("glove9")
RATE, FRAMES, RECORDINGS = 120.0, 240, 4
CLEAR = 2e-3
"""Metres and cosines: cases nearer to a border than this are not asked about; rounding moves it."""


def scene(seed: int, frames: int = 5, markers: int = 6, capsules: int = 5, count: int = 6) -> Any:
    """Markers, capsules and cameras anywhere, so near each other that about half are seen; float32
    as all of it."""
    random = np.random.default_rng(seed)

    def spread(*shape: int, by: float) -> np.ndarray:
        return (by * random.standard_normal((frames, *shape, 3))).astype(np.float32)

    normals = spread(markers, by=1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    segments = spread(capsules, 1, by=0.1) + spread(capsules, 2, by=0.03)
    radii = random.uniform(0.005, 0.04, (frames, capsules)).astype(np.float32)
    # Cameras are never inside of a capsule.
    places = spread(count, by=1)
    places *= 2 / np.linalg.norm(places, axis=-1, keepdims=True)
    return Surface(spread(markers, by=0.1), normals, segments, radii), places


@functools.cache
def compiled(name: str) -> Any:
    return jax.jit(getattr(cameras, name))


def seeing(what: Surface, places: np.ndarray, cone: float = 1.2, margin: float = 0.0) -> np.ndarray:
    return np.asarray(compiled("seeing")(what, places, np.float32(cone), np.float32(margin)))


def seen_slowly(what: Surface, places: np.ndarray, cone: float) -> tuple[np.ndarray, np.ndarray]:
    """`[F, M, C]` whether each camera sees each marker, by looking at many points of each ray, and
    whether that is clear: float64, and nothing shared with the code under test."""
    markers, normals, segments, radii = (np.asarray(x, np.float64) for x in what)
    rays = places[:, None] - markers[:, :, None]
    length = np.linalg.norm(rays, axis=-1, keepdims=True)
    cosine = (rays / length * normals[:, :, None]).sum(-1)
    # Closer together where the capsules are.
    steps = np.concatenate([np.linspace(0, 0.5, 2001), np.linspace(0.5, 1, 101)[1:]])
    start, along = segments[..., 0, :], segments[..., 1, :] - segments[..., 0, :]

    def distance(points: np.ndarray) -> np.ndarray:
        """`[F, K, …]` of `[F, …, 3]`."""
        lift = [slice(None), slice(None), *[None] * (points.ndim - 2)]
        away = points[:, None] - start[tuple(lift)]
        step = along[tuple(lift)]
        share = np.clip((away * step).sum(-1) / (step * step).sum(-1), 0, 1)
        return np.linalg.norm(away - share[..., None] * step, axis=-1)

    thick = np.minimum(radii[:, :, None], cameras.ON_SKIN * distance(markers))[..., None]
    nearest = np.full((*thick.shape[:-1], rays.shape[2]), np.inf)
    for step in steps:
        nearest = np.minimum(nearest, distance(markers[:, :, None] + step * rays))
    open_ray = (nearest > thick).all(1)
    clear = (np.abs(nearest - thick) > CLEAR).all(1) & (np.abs(cosine - math.cos(cone)) > CLEAR)
    return open_ray & (cosine > math.cos(cone)), clear


@given(st.integers(0, 999))
def test_a_camera_sees_a_marker_as_walking_along_the_ray_does(seed: int) -> None:
    what, places = scene(seed)
    seen, clear = seen_slowly(what, places, 1.2)
    counted = seeing(what, places)
    known = clear.all(-1)
    assert known.mean() > 0.2
    np.testing.assert_array_equal(counted[known], seen.sum(-1)[known])


@given(st.integers(0, 999), own.motions())
def test_one_rigid_motion_of_all_changes_nothing(
    seed: int, motion: tuple[np.ndarray, np.ndarray]
) -> None:
    what, places = scene(seed)
    _, clear = seen_slowly(what, places, 1.2)
    turn, shift = (part.astype(np.float32) for part in motion)
    moved = Surface(
        what.markers @ turn.T + shift,
        what.normals @ turn.T,
        what.segments @ turn.T + shift,
        what.radii,
    )
    known = clear.all(-1)
    before, after = seeing(what, places), seeing(moved, places @ turn.T + shift)
    np.testing.assert_array_equal(after[known], before[known])


@given(st.integers(0, 999))
def test_with_nothing_between_the_cone_alone_decides(seed: int) -> None:
    what, places = scene(seed)
    away = what._replace(segments=what.segments + np.float32([0, 0, 5]))
    rays = places[:, None] - what.markers[:, :, None]
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    off = np.arccos(np.clip((rays * what.normals[:, :, None]).sum(-1), -1, 1))
    for cone in (0.5, 1.2, 2.0):
        known = (np.abs(off - cone) > CLEAR).all(-1)
        np.testing.assert_array_equal(
            seeing(away, places, cone)[known], (off < cone).sum(-1)[known]
        )
    assert (seeing(away, places, math.pi) == places.shape[1]).all()


@given(st.integers(0, 999), st.floats(0.1, 0.9), own.directions())
def test_a_capsule_across_the_ray_hides(seed: int, share: float, along: np.ndarray) -> None:
    what, places = scene(seed, count=1)
    marker, camera = what.markers[:, 0], places[:, 0]
    middle = marker + np.float32(share) * (camera - marker)
    ends = middle[:, None] + np.float32(0.04) * np.float32([along, -along])
    wall = Surface(*cameras.obstacle(ends, np.full(len(ends), 0.01, np.float32)))
    alone = what._replace(markers=what.markers[:, :1], normals=what.normals[:, :1])
    assert (seeing(cameras.together(alone, wall), places, math.pi) == 0).all()
    # Behind the marker and behind the camera it hides nothing.
    for where in (marker + 0.1 * (marker - camera), camera + 0.1 * (camera - marker)):
        ball = np.repeat(where[:, None], 2, 1)
        behind = cameras.obstacle(ball, np.full(len(ball), 0.01, np.float32))
        free = alone._replace(segments=alone.segments + np.float32([0, 0, 50]))
        assert (seeing(cameras.together(free, behind), places, math.pi) == 1).all()


@given(st.integers(0, 999))
def test_another_camera_never_hides_and_another_occluder_never_reveals(seed: int) -> None:
    what, places = scene(seed)
    counted = seeing(what, places)
    assert (seeing(what, places[:, :-1]) <= counted).all()
    fewer = what._replace(segments=what.segments[:, :-1], radii=what.radii[:, :-1])
    assert (seeing(fewer, places) >= counted).all()
    assert (seeing(what, places, margin=0.01) <= counted).all()
    assert (seeing(what, places, cone=1.0) <= counted).all()


@given(st.integers(0, 999))
def test_a_marker_on_a_capsule_is_seen_from_outside_and_only_from_there(seed: int) -> None:
    """Also where it was modelled inside; on the axis its cone alone decides."""
    random = np.random.default_rng(seed)
    out = random.standard_normal(3)
    out /= np.linalg.norm(out)
    along = np.cross(out, random.standard_normal(3))
    ends = 0.03 * np.stack([along, -along]) / np.linalg.norm(along)
    away = np.stack([out + 0.1 * along, 0.1 * along - out, out - along, -out - along])[:, None]
    for depth in (0.0, 1e-5, 0.002, 0.004, 0.009, 0.0095):
        marker = (depth * out).reshape(1, 1, 3)
        skin = Surface(marker, out.reshape(1, 1, 3), ends[None, None], np.full((1, 1), 0.009))
        skin = jax.tree.map(np.float32, skin)
        both = [seeing(skin, np.float32(place[None]), math.pi).item() for place in away]
        assert both == ([1, 1, 1, 1] if depth < 1e-3 else [1, 0, 1, 0])


def test_no_camera_and_no_frame_see_nothing() -> None:
    what, places = scene(0)
    assert (seeing(what, places[:, :0]) == 0).all()
    assert seeing(jax.tree.map(lambda x: x[:0], what), places[:0]).shape == (0, 6)


def test_any_number_of_frames_is_the_same_as_one_at_a_time() -> None:
    what, places = scene(1, frames=cameras.AT_ONCE + 3)
    together = seeing(what, places)
    for frame in (0, cameras.AT_ONCE - 1, cameras.AT_ONCE, cameras.AT_ONCE + 2):
        alone = jax.tree.map(lambda x, at=frame: x[at], (what, places))
        np.testing.assert_array_equal(seeing(*alone), together[frame])


# -- hands in a room ---------------------------------------------------------------------------


@functools.cache
def hands() -> tuple[Surface, Surface]:
    """`[R, T]` frames of a left and a right hand about 20 cm apart, which bend, turn and wander."""
    random = np.random.default_rng(0)
    time = np.arange(FRAMES) / RATE

    def waves(size: int, reach: Any) -> np.ndarray:
        phase = random.uniform(0, 2 * np.pi, (RECORDINGS, 1, size))
        speed = random.uniform(2, 9, (RECORDINGS, 1, size))
        return reach * np.sin(phase + speed * time[:, None])

    def place() -> Surface:
        angles = own.LOW + (own.HIGH - own.LOW) * (0.5 + waves(26, 0.4))
        turns = np.array([[own.turn(v, np.linalg.norm(v)) for v in r] for r in waves(3, 1.5)])
        wrist = np.add(motion.HOME, (-0.1, 0, 0)) + waves(3, 0.05)
        return worn(angles, turns, wrist)

    return place(), cameras.reflected(place())


def worn(angles: np.ndarray, wrist_rotation: np.ndarray, wrist: np.ndarray) -> Surface:
    """The glove on the mean person, by way of numpy."""
    local = rotations_from_angles(angles)
    placed = forward_kinematics(GLOVE.skeleton, local, wrist_rotation, wrist)
    positions, rotations = (part.astype(np.float32) for part in placed)
    markers = marker_positions(GLOVE, positions, rotations)
    radii = mean_person(GLOVE).radii
    return cameras.surface(GLOVE, markers, positions, rotations, radii)


@functools.partial(jax.jit, static_argnums=3)
def observe(key: Any, what: Surface, rig: Rig, count: int) -> Any:
    """With a rig that is traced, so that one compilation does for all of one number of cameras."""
    return cameras.observe(key, what, RATE, rig._replace(cameras=count))


def observed(rig: Rig | None = None, seed: int = 0) -> np.ndarray:
    rig, what = rig or Rig(), cameras.together(*hands())
    return np.asarray(observe(jax.random.key(seed), what, rig, rig.cameras))


def test_the_same_key_gives_the_same_gaps_and_another_key_others() -> None:
    assert observed().shape == (RECORDINGS, FRAMES, 2 * len(GLOVE))
    np.testing.assert_array_equal(observed(), observed())
    assert (observed() != observed(seed=1)).any()


def test_cameras_stand_round_the_room() -> None:
    rig = Rig(cameras=9)
    places = np.asarray(cameras.place_cameras(jax.random.key(0), rig, (500,)))
    assert places.dtype == np.float32
    flat = places[..., [0, 2]] - np.array(motion.HOME)[[0, 2]]
    np.testing.assert_allclose(np.linalg.norm(flat, axis=-1), rig.distance, rtol=1e-5)
    angles = np.sort(np.arctan2(flat[..., 1], flat[..., 0]), -1)
    gaps = np.diff(np.concatenate([angles, angles[:, :1] + 2 * np.pi], -1), axis=-1)
    assert gaps.max() < 2 * np.pi / rig.cameras * (1 + 2 * cameras.PATTERN[0] + 1e-3)
    assert places[..., ::2, 1].mean() == pytest.approx(rig.low, abs=0.02)
    assert places[..., 1::2, 1].mean() == pytest.approx(rig.high, abs=0.02)


def test_a_marker_shines_away_from_its_bone() -> None:
    axes = cameras.emission_axes(GLOVE)
    np.testing.assert_allclose(np.linalg.norm(axes, axis=-1), 1, atol=1e-6)
    named = dict(zip(GLOVE.markers, axes, strict=True))
    for finger in FINGERS[1:]:
        np.testing.assert_array_equal(named[f"{finger}_tip"], [0, 1, 0])
    assert named["wrist"][1] > 0.9 < named["index_base"][1]
    dense = load_hand("dense19")
    for name, axis in zip(dense.markers, cameras.emission_axes(dense), strict=True):
        assert axis[1] > 0.4, name


def test_in_the_mirror_all_is_seen_alike() -> None:
    left, _ = hands()
    places = np.asarray(cameras.place_cameras(jax.random.key(0), Rig(cameras=6)))
    places = np.broadcast_to(places, (RECORDINGS, FRAMES, 6, 3))
    mirrored = seeing(cameras.reflected(left), places * np.float32([-1, 1, 1]))
    np.testing.assert_array_equal(mirrored, seeing(left, places))


def test_a_flat_hand_is_seen_from_above_and_a_fist_hides_its_tips() -> None:
    def shown(flexion: float) -> np.ndarray:
        angles = np.zeros(26)
        angles[[i for i in range(6, 26) if i % 5 != 2 and (i - 6) % 5 in (0, 3, 4)]] = flexion
        skin = worn(angles, np.eye(3), np.array(motion.HOME))
        above = np.float32([[[-1, 3, 1], [1, 3, 0], [0, 3, -1]]])
        return seeing(jax.tree.map(lambda x: np.asarray(x)[None], skin), above)[0]

    fingers = [name.startswith("thumb") for name in GLOVE.markers]
    assert (shown(0.0)[np.invert(fingers)] == 3).all()
    tips = [GLOVE.markers.index(tip) for tip in TIPS[1:]]
    assert (shown(math.radians(85))[tips] == 0).all()


def test_needing_more_cameras_never_reveals() -> None:
    two, three, four = (observed(Rig(needed=needed)) for needed in (2, 3, 4))
    assert (three <= two).all()
    assert (four <= three).all()
    assert four.mean() < three.mean() < two.mean() < 1
    late = observed(Rig(start=5))
    assert (late <= two).all()


def test_the_other_hand_hides_more_and_an_object_still_more() -> None:
    left, right = hands()
    middle = (left.segments[..., 8, 1, :] + right.segments[..., 8, 1, :]) / 2
    ball = cameras.obstacle(
        np.stack([middle, middle], -2), np.full(middle.shape[:-1], 0.05, np.float32)
    )

    def seen(*thickness: float) -> np.ndarray:
        """With these parts of the radii; without any nothing hides."""
        parts = zip((left, right, ball), thickness, strict=True)
        scene = cameras.together(*(x._replace(radii=x.radii * np.float32(k)) for x, k in parts))
        return np.asarray(observe(jax.random.key(0), scene, Rig(), Rig().cameras))

    alone, beside, holding = seen(1, 0, 0), seen(1, 1, 0), seen(1, 1, 1)
    of_left = slice(len(GLOVE))
    assert (beside <= alone).all()
    assert beside[..., of_left].mean() < alone[..., of_left].mean()
    assert (holding <= beside).all()
    assert holding.mean() < beside.mean()
    np.testing.assert_array_equal(beside, seen(1, 1, 0))


def test_a_marker_is_followed_until_too_few_see_it_and_found_by_more() -> None:
    seen = np.array([2, 1, 2, 2, 3, 2, 2, 1, 0, 2, 3, 3])[:, None]
    kept = np.asarray(cameras.followed(seen, Rig(needed=2, start=3)))[:, 0]
    np.testing.assert_array_equal(kept, [1, 0, 0, 0, 1, 1, 1, 0, 0, 0, 1, 1])
    plain = np.asarray(cameras.followed(seen, Rig(needed=2, start=1)))[:, 0]
    np.testing.assert_array_equal(plain, seen[:, 0] >= 2)


def test_spells_come_as_often_and_last_as_long_as_they_are_told() -> None:
    run = jax.jit(lambda key, what: cameras.spells(motion.uniform(key, (40, 6000, 5)), what, RATE))
    inside, began = map(np.asarray, run(jax.random.key(0), Spells(0.5, 0.1, 0.5)))
    assert inside.shape == began.shape == (40, 6000, 5)
    begins = (began[:, 1:] != began[:, :-1]).sum()
    assert begins == pytest.approx(0.5 * 40 * 5 * 50, rel=0.05)
    rows = np.pad(np.moveaxis(inside, 1, -1), [(0, 0), (0, 0), (1, 1)]).astype(np.int8)
    change = np.diff(rows.reshape(-1, rows.shape[-1]))
    length = (np.argwhere(change == -1) - np.argwhere(change == 1))[:, 1] / RATE
    # A few run into each other, which makes them longer.
    assert np.median(length) == pytest.approx(0.1, rel=0.15)
    assert np.quantile(length, 0.9) == pytest.approx(0.3, rel=0.25)
    silent, _ = run(jax.random.key(0), Spells(0.0, 0.1, 0.5))
    assert not np.asarray(silent).any()


def test_no_spell_begins_in_the_first_frame_and_each_knows_when_it_did() -> None:
    draws = np.full((9, 2), 0.999, np.float32)
    chance = 2.0 / RATE
    draws[0], draws[2, 1], draws[6, 1] = 0, 0.5 * chance, 0.5 * chance  # median length
    inside, began = cameras.spells(draws, Spells(2.0, 3 / RATE, 0.5), RATE)
    assert not np.asarray(inside)[:, 0].any()
    np.testing.assert_array_equal(np.asarray(inside)[:, 1], [0, 0, 1, 1, 1, 0, 1, 1, 1])
    np.testing.assert_array_equal(np.asarray(began)[:, 1], [0, 0, 2, 2, 2, 2, 6, 6, 6])
    assert not np.asarray(began)[:, 0].any()


# -- wrong positions ---------------------------------------------------------------------------

WRONG = Faults(
    jumps=Spells(0.5, 0.1, 0.6), frozen=Spells(0.5, 0.2, 0.6), swaps=Spells(0.3, 0.3, 0.6)
)


def faulty(faults: Faults, seed: int = 0) -> tuple[np.ndarray, ...]:
    markers, visible = np.asarray(hands()[0].markers), observed()[..., : len(GLOVE)]
    made = misplace(jax.random.key(seed), markers, visible, faults)
    return (markers, visible, *map(np.asarray, made))


@jax.jit
def misplace(key: Any, markers: Any, visible: Any, faults: Faults) -> Any:
    return cameras.misplace(key, markers, visible, RATE, reach(GLOVE).neighbours, faults)


@pytest.mark.parametrize("kind", ["jumps", "frozen", "swaps", "all"])
def test_wrong_positions_are_named_exactly_where_positions_differ(kind: str) -> None:
    faults = WRONG if kind == "all" else Faults()._replace(**{kind: getattr(WRONG, kind)})
    truth, before, measured, visible, wrong = faulty(faults)
    np.testing.assert_array_equal(wrong, visible & (measured != truth).any(-1))
    assert 0.005 < wrong.mean() < 0.5
    # What is hidden stays hidden, or its hidden label goes over to a neighbour.
    np.testing.assert_array_equal(visible.sum(-1), before.sum(-1))
    if kind != "swaps" and kind != "all":
        np.testing.assert_array_equal(visible, before)


def test_without_faults_nothing_is_wrong() -> None:
    truth, before, measured, visible, wrong = faulty(Faults())
    np.testing.assert_array_equal(measured, truth)
    np.testing.assert_array_equal(visible, before)
    assert not wrong.any()


def test_a_jump_keeps_its_distance_and_a_frozen_marker_its_place() -> None:
    truth, _, measured, _, wrong = faulty(Faults()._replace(jumps=Spells(0.5, 0.2, 0.3)))
    off = np.where(wrong[..., None], measured - truth, 0)
    on = wrong[:, 1:] & wrong[:, :-1]
    same = (np.abs(np.diff(off, axis=1)).max(-1) < 1e-6)[on]
    assert same.mean() > 0.95  # but where one jump begins during another
    assert 0.03 < np.linalg.norm(off[wrong], axis=-1).mean() < 0.2
    truth, before, measured, _, wrong = faulty(Faults()._replace(frozen=Spells(0.5, 0.2, 0.3)))
    on = wrong[:, 1:] & wrong[:, :-1]
    assert ((np.diff(measured, axis=1) == 0).all(-1))[on].mean() > 0.95
    # It stands where it was really seen some time before.
    recording, frame, marker = np.argwhere(wrong)[-1]
    past = truth[recording, : frame + 1, marker][before[recording, : frame + 1, marker]]
    assert (past == measured[recording, frame, marker]).all(-1).any()


def test_swapped_labels_are_those_of_neighbouring_fingers() -> None:
    truth, _, measured, _, _ = faulty(Faults()._replace(swaps=Spells(0.5, 0.2, 0.3)))
    markers = len(GLOVE)
    same = (measured[..., :, None, :] == truth[..., None, :, :]).all(-1)
    assert (same.sum(-1) == 1).all()
    assert (same.sum(-2) == 1).all()
    tips = {i for pair in reach(GLOVE).neighbours for i in pair.tolist()}
    assert tips == {GLOVE.markers.index(tip) for tip in TIPS}
    for other in set(range(markers)) - tips:
        assert same[..., other, other].all()


def test_vmap_is_one_at_a_time() -> None:
    what, places = scene(2, frames=8)
    cones = np.linspace(0.5, 2, 8, dtype=np.float32)
    many = jax.jit(jax.vmap(cameras.seeing))(what, places, cones)
    for frame in (0, 7):
        alone = jax.tree.map(lambda x, at=frame: x[at], (what, places))
        np.testing.assert_array_equal(many[frame], seeing(*alone, cones[frame]))

    # Traced only: compiling them takes longer than they are worth.
    def run(key: Any, cone: Any, hand: Surface) -> Any:
        visible = cameras.observe(key, hand, RATE, Rig(cone=cone))
        pairs = reach(GLOVE).neighbours
        return cameras.misplace(key, hand.markers, visible, RATE, pairs, WRONG)

    keys = jax.random.split(jax.random.key(5), RECORDINGS)
    found = jax.eval_shape(jax.vmap(run), keys, cones[:RECORDINGS], hands()[0])
    shape = (RECORDINGS, FRAMES, len(GLOVE))
    assert [x.shape for x in found] == [(*shape, 3), shape, shape]
