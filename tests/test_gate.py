"""The gate notices wrong measurements, lets right ones pass, and gives way where it is wrong."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from strategies import motions
from streams import (
    LAYOUTS,
    PATTERNS,
    a_model,
    assert_same_bits,
    at_least,
    moved,
    paths,
    place,
    seeds,
    smooth,
)

from numpy_infer import gate, tracker
from numpy_infer.gate import LONGEST, GateState
from numpy_infer.hand import FINGERS, Hand, load_hand
from numpy_infer.model import Model
from numpy_infer.pose import HandPose, Notice, Status
from numpy_infer.recordings import read

Array = np.ndarray

DT = 1 / 60
MODELS = {name: a_model("affine", name) for name in LAYOUTS}
GLOVE = MODELS["glove9"].hand
NAMES = GLOVE.markers


class Given(NamedTuple):
    """What the gate is given, frame by frame; `[T, H, …]`."""

    markers: Array
    visible: Array
    last: Array
    dt: Array


def calm(hand: Hand, seed: int, frames: int = 60, hands: int = 3) -> Array:
    """`[T, H, M, 3]` metres, world: hands that open, close and go about as in daily life, always in
    motion."""
    rng = np.random.default_rng(seed)
    angles = 0.5 + 0.4 * smooth(rng, frames, 30, (hands, 26))
    rotation, position = paths(rng, 3 * frames, hands)
    return moved(place(hand, angles), rotation[:frames], position[:frames] / 4)


def asked(truth: Array, markers: Array | None = None, visible: Array | None = None) -> Given:
    """A stream of which the tracker has put out the truth, up to every frame."""
    markers = truth if markers is None else markers
    visible = np.ones(truth.shape[:-1], bool) if visible is None else visible
    last = np.concatenate([truth[:1], truth[:-1]])
    shown = np.where(visible[..., None], markers, 0)
    return Given(shown, visible, last, np.full(truth.shape[:2], DT))


def run(model: Model, what: Given, state: GateState | None = None) -> tuple[Array, GateState]:
    """`[T, H, M]` what is accepted, and the last state."""
    hands = what.visible.shape[1:-1]
    state = gate.init(model, hands) if state is None else state
    found = []
    for t, (markers, visible, last, dt) in enumerate(zip(*what, strict=True)):
        tracked = np.full(hands, t > 0)
        state, accepted = gate.step(model, state, markers, visible, last, tracked, dt)
        assert not (accepted & ~visible).any()
        found.append(accepted)
    return np.stack(found), state


def misplaced(truth: Array, seed: int) -> Array:
    """Jumps, frozen markers and exchanged labels, many and of every length."""
    rng = np.random.default_rng(seed)
    markers = truth.copy()
    frames, hands, count, _ = truth.shape
    for hand in range(hands):
        for _ in range(6):
            start, length = rng.integers(1, frames), rng.integers(1, 20)
            part = (slice(start, start + length), hand)
            one, other = rng.choice(count, 2, replace=False)
            match rng.integers(3):
                case 0:
                    markers[*part, one] += rng.normal(0, 0.05, 3)
                case 1:
                    markers[*part, one] = markers[start - 1, hand, one]
                case 2:
                    pair = [one, other]
                    markers[part[0], hand, pair] = markers[part[0], hand, pair[::-1]]
    return markers


def faulty(model: Model, seed: int, pattern: str = "markov") -> Given:
    truth = calm(model.hand, seed)
    rng = np.random.default_rng(seed)
    visible = at_least(PATTERNS[pattern](rng, truth.shape[:-1]), 4, rng)
    return asked(truth, misplaced(truth, seed), visible)


# -- right measurements ---------------------------------------------------------------------------


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("pattern", sorted(PATTERNS))
def test_of_what_is_right_one_in_10_000_is_refused_at_most(layout: str, pattern: str) -> None:
    model = MODELS[layout]
    truth = calm(model.hand, 0, hands=40)
    visible = PATTERNS[pattern](np.random.default_rng(0), truth.shape[:-1])
    accepted, _ = run(model, asked(truth, visible=visible))
    assert (visible & ~accepted).sum() <= visible.sum() / 10000


def test_a_recording_with_gaps_is_accepted(data_root: Any) -> None:
    hand = load_hand("qualisys13")
    recording = read(data_root / "qualisys" / "recording.tsv")
    markers = recording.select(hand.markers).markers * np.array([-1, 1, 1])
    visible = np.isfinite(markers).all(-1)
    markers = np.nan_to_num(markers)
    model = MODELS["qualisys13"]
    state, own = tracker.init(model), gate.init(model)
    last, refused = np.zeros_like(markers[0]), 0
    for frame, seen in zip(markers[:2000], visible[:2000], strict=True):
        tracked = np.asarray(bool(last.any()))
        own, accepted = gate.step(model, own, frame, seen, last, tracked, np.asarray(0.01))
        state, pose = tracker.step(model, state, frame, accepted, np.asarray(0.01))
        last, refused = pose.markers, refused + (seen & ~accepted).sum()
    assert refused <= visible.sum() / 10000


# -- wrong ones -----------------------------------------------------------------------------------

START, LENGTH = 25, 12
"""Frames: when what is wrong begins, and how long it lasts."""
DURING = slice(START, START + LENGTH)


def expected(markers: list[int]) -> Array:
    """`[60, M]` True but where `markers` are wrong."""
    accepted = np.ones((60, len(GLOVE)), bool)
    accepted[DURING, markers] = False
    return accepted


@given(seed=seeds(), marker=st.integers(0, 8), cm=st.integers(7, 30), way=motions())
def test_a_jump_is_refused_as_long_as_it_lasts(seed: int, marker: int, cm: int, way: Any) -> None:
    truth = calm(GLOVE, seed, hands=1)
    markers = truth.copy()
    markers[DURING, 0, marker] += cm / 100 * way[0][0]
    accepted, _ = run(MODELS["glove9"], asked(truth, markers))
    np.testing.assert_array_equal(accepted[:, 0], expected([marker]))


@given(seed=seeds(), pair=st.integers(0, 3))
def test_exchanged_labels_of_neighbours_are_refused_as_long_as_they_are(
    seed: int, pair: int
) -> None:
    truth = calm(GLOVE, seed, hands=1)
    one, other = (NAMES.index(f"{finger}_tip") for finger in FINGERS[pair : pair + 2])
    between = np.linalg.norm(truth[DURING, 0, one] - truth[DURING, 0, other], axis=-1)
    assume(between.min() > 0.015)  # nearer ones are as good as one
    markers = truth.copy()
    markers[DURING, 0, [one, other]] = truth[DURING, 0, [other, one]]
    accepted, _ = run(MODELS["glove9"], asked(truth, markers))
    np.testing.assert_array_equal(accepted[:, 0], expected([one, other]))


@given(seed=seeds(), marker=st.integers(0, 8))
def test_a_frozen_marker_is_refused_while_the_hand_goes_on(seed: int, marker: int) -> None:
    truth = calm(GLOVE, seed, hands=1) + np.arange(60)[:, None, None, None] * [3e-3, 0, 0]
    markers = truth.copy()
    markers[DURING, 0, marker] = truth[START - 1, 0, marker]
    accepted, _ = run(MODELS["glove9"], asked(truth, markers))
    np.testing.assert_array_equal(accepted[:, 0], expected([marker]))


def test_a_frozen_marker_stays_refused_while_anything_else_gives_up() -> None:
    frames = 30 + 2 * round(LONGEST / DT)
    truth = calm(GLOVE, 0, frames, 1) + np.arange(frames)[:, None, None, None] * [3e-3, 0, 0]
    markers = truth.copy()
    markers[30:, 0, 4] = truth[29, 0, 4]
    accepted, _ = run(MODELS["glove9"], asked(truth, markers))
    assert accepted[:30].all()
    assert np.flatnonzero(~accepted[30:].all((0, 1))).tolist() == [4]
    assert not accepted[30:, 0, 4].any()


def test_a_hand_that_stands_still_is_not_frozen() -> None:
    truth = np.repeat(calm(GLOVE, 0, 1), 60, 0)
    assert run(MODELS["glove9"], asked(truth))[0].all()


@pytest.mark.parametrize("layout", LAYOUTS)
@given(seed=seeds(), data=st.data())
def test_the_first_frame_refuses_what_no_hand_can_reach(
    layout: str, seed: int, data: st.DataObject
) -> None:
    truth = calm(MODELS[layout].hand, seed, 1, 1)
    marker = data.draw(st.integers(0, truth.shape[2] - 1))
    markers = truth.copy()
    markers[0, 0, marker] += 0.5 * data.draw(motions())[0][0]
    accepted, _ = run(MODELS[layout], asked(truth, markers))
    assert np.flatnonzero(~accepted[0, 0]).tolist() == [marker]


# -- where the gate is wrong ----------------------------------------------------------------------


@given(seed=seeds(), motion=motions())
def test_a_hand_that_is_suddenly_elsewhere_is_accepted(seed: int, motion: Any) -> None:
    truth = calm(GLOVE, seed)
    truth[30:] = moved(truth[30:], *motion)
    assert run(MODELS["glove9"], asked(truth))[0].all()


@given(seed=seeds())
def test_nothing_is_refused_for_longer_than_promised(seed: int) -> None:
    """Whatever jumps wherever, and stays there."""
    rng = np.random.default_rng(seed)
    start = calm(GLOVE, seed, 1)
    frames = 30 + round(LONGEST / DT) + 2
    truth = np.repeat(start, frames, 0) + rng.normal(0, 1e-4, (frames, 3, 9, 3))
    markers = truth.copy()
    jumps = rng.uniform(size=(3, 9)) < rng.uniform()
    markers[30:] += np.where(jumps[..., None], rng.normal(0, 0.2, (3, 9, 3)), 0)
    accepted, _ = run(MODELS["glove9"], asked(truth, markers))
    assert accepted[-1].all()


@given(seed=seeds(), marker=st.integers(0, 8))
def test_what_was_accepted_in_the_end_may_come_back(seed: int, marker: int) -> None:
    """A jump that lasts: the marker is refused, accepted if a hand can be so, then right again:
    accepted at once, as of 1,350 all but three were, or in the next frame."""
    truth = calm(GLOVE, seed, 90, 1)
    markers = truth.copy()
    markers[20:75, 0, marker] += [0.06, 0, 0]
    accepted, _ = run(MODELS["glove9"], asked(truth, markers))
    assert not accepted[20:40, 0, marker].any()
    assert accepted[76:, 0, marker].all()
    assert np.delete(accepted, marker, -1).all()


@given(seed=seeds(), pattern=st.sampled_from(sorted(PATTERNS)))
def test_what_is_accepted_determines_the_hand_where_what_is_visible_does(
    seed: int, pattern: str
) -> None:
    rng = np.random.default_rng(seed)
    markers = rng.normal(0, 10.0 ** rng.uniform(-3, 0), (60, 3, 9, 3))
    visible = PATTERNS[pattern](rng, markers.shape[:-1])
    what = asked(markers, visible=visible)
    accepted, _ = run(MODELS["glove9"], what)
    extents = [
        np.linalg.svd(_centred(what.markers, mask), compute_uv=False)[..., 1]
        for mask in (visible, accepted)
    ]
    assert ((extents[0] < 5e-3 + 1e-9) | (extents[1] > 5e-3 - 1e-9)).all()
    assert (2 * accepted.sum(-1) >= visible.sum(-1)).all()


def _centred(points: Array, mask: Array) -> Array:
    weight = mask[..., None].astype(float)
    mean = (points * weight).sum(-2, keepdims=True) / np.maximum(weight.sum(-2, keepdims=True), 1)
    return (points - mean) * weight


# -- laws of every stage --------------------------------------------------------------------------


@given(seed=seeds(), motion=motions(), pattern=st.sampled_from(sorted(PATTERNS)))
def test_rigid_motion_of_all_changes_no_decision(seed: int, motion: Any, pattern: str) -> None:
    model = MODELS["glove9"]
    what = faulty(model, seed, pattern)
    elsewhere = moved(np.where(what.visible[..., None], what.markers, 0), *motion)
    elsewhere = np.where(what.visible[..., None], elsewhere, 0)
    there = what._replace(markers=elsewhere, last=moved(what.last, *motion))
    np.testing.assert_array_equal(run(model, there)[0], run(model, what)[0])


@pytest.mark.parametrize("layout", LAYOUTS)
@given(seed=seeds(), pattern=st.sampled_from(sorted(PATTERNS)))
def test_many_hands_equal_one_at_a_time(layout: str, seed: int, pattern: str) -> None:
    model = MODELS[layout]
    what = faulty(model, seed, pattern)
    accepted, state = run(model, what)
    for hand in range(accepted.shape[1]):
        alone = run(model, Given(*(part[:, hand] for part in what)))
        assert_same_bits(alone[0], accepted[:, hand])
        assert_same_bits(alone[1], GateState(*(part[hand] for part in state)))


@given(seed=seeds(), frame=st.integers(1, 58))
def test_a_frame_again_without_time_changes_nothing(seed: int, frame: int) -> None:
    model = MODELS["glove9"]
    what = faulty(model, seed)
    accepted, state = run(model, Given(*(part[:frame] for part in what)))
    again = Given(*(part[frame - 1 : frame] for part in what))._replace(dt=np.zeros((1, 3)))
    repeated, same = run(model, again, state)
    assert_same_bits(same, state)
    np.testing.assert_array_equal(repeated[0], accepted[-1])


def in_one_go(model: Model, what: Given, state: GateState) -> tuple[GateState, int]:
    tracked = np.ones(what.dt.shape[1:], bool)
    return gate.ahead(model, state, tracked, what.markers, what.visible, what.dt)


@given(seed=seeds(), pattern=st.sampled_from(sorted(PATTERNS)))
@example(seed=265, pattern="blocks")  # the gate gives way
def test_frames_that_pass_in_one_go_pass_one_by_one(seed: int, pattern: str) -> None:
    model = MODELS["glove9"]
    what = faulty(model, seed, pattern)
    what = Given(*(part[:, :1] for part in what))
    _, state = run(model, Given(*(part[:1] for part in what)))
    done = 1
    while done < len(what.dt):
        left = Given(*(part[done:] for part in what))
        after, passed = in_one_go(model, left, state)
        # What does not pass in one go is taken by itself.
        mine = Given(*(part[: max(passed, 1)] for part in left))
        accepted, state = run(model, mine, state)
        if passed:
            np.testing.assert_array_equal(accepted, mine.visible)
            for one, other in zip(after, state, strict=True):
                assert one.dtype == other.dtype
                np.testing.assert_allclose(one, other, rtol=0, atol=1e-9)
        done += len(mine.dt)


@given(seed=seeds(), hidden=st.sets(st.integers(0, 8), max_size=4))
def test_what_is_right_passes_in_one_go_until_a_marker_comes_back(
    seed: int, hidden: set[int]
) -> None:
    model = MODELS["glove9"]
    truth = calm(model.hand, seed, frames=120, hands=2)
    visible = np.ones(truth.shape[:-1], bool)
    visible[40:100, 1, list(hidden)] = False
    what = asked(truth, visible=visible)
    _, state = run(model, Given(*(part[:2] for part in what)))
    _, passed = in_one_go(model, Given(*(part[2:] for part in what)), state)
    assert passed == (98 if hidden else 118)


@given(seed=seeds())
def test_the_quick_look_decides_as_the_careful_one(seed: int) -> None:
    model = MODELS["glove9"]
    what = faulty(model, seed)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(gate, "QUIET", 0.0)
        careful, _ = run(model, what)
    np.testing.assert_array_equal(run(model, what)[0], careful)


def absurd(seed: int) -> Given:
    """Whatever is finite: sizes from nothing to 100 km, times from nothing to an hour."""
    rng = np.random.default_rng(seed)
    shape = (60, 3, 9)
    size = rng.choice([0, 1e-30, 1e-3, 0.1, 1e5], size=(*shape, 1))
    markers, last = rng.uniform(-1, 1, (2, *shape, 3)) * size
    markers = np.where(rng.uniform(size=(*shape, 1)) < 0.3, markers[:1], markers)
    dt = rng.choice([0, 1e-30, 1e-4, 0.1, 3600], size=shape[:2])
    visible = rng.uniform(size=shape) < rng.choice([0.1, 0.9, 1])
    return Given(np.where(visible[..., None], markers, 0), visible, last, dt)


def single(what: Given) -> Given:
    """The same in float32."""
    return Given(*(part if part.dtype == bool else part.astype(np.float32) for part in what))


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@given(seed=seeds())
def test_finite_input_keeps_everything_finite(dtype: type, seed: int) -> None:
    model = a_model("affine", dtype=dtype)
    what = absurd(seed) if dtype == np.float64 else single(absurd(seed))
    _, state = run(model, what)
    for name, value in state._asdict().items():
        assert np.isfinite(value).all(), name
        assert value.dtype in (bool, dtype), name


# -- the twin -------------------------------------------------------------------------------------


def scanned(model: Model, what: Given) -> tuple[Array, GateState]:
    """`run` of `jaxhand.gate`, in the precision of the session."""
    jax = pytest.importorskip("jax")
    from jaxhand import gate as twin

    def one(state: Any, frame: Any) -> Any:
        time, *measured, dt = frame
        tracked = jax.numpy.full(dt.shape, time > 0)
        return twin.step(model, state, *measured, tracked, dt)

    def all_of(what: Given) -> Any:
        frames = jax.numpy.arange(len(what.dt))
        state, accepted = jax.lax.scan(one, twin.init(model, what.dt.shape[1:]), (frames, *what))
        return accepted, state

    compiled = _COMPILED.setdefault((id(model), what.dt.shape), jax.jit(all_of))
    return jax.tree.map(np.asarray, compiled(single(what)))


_COMPILED: dict[Any, Any] = {}
SMALL = a_model("affine", dtype=np.float32)


@given(seed=seeds(), pattern=st.sampled_from(sorted(PATTERNS)))
@example(seed=465418, pattern="restless")  # a fit by so few, in a marker that is not refused
def test_jax_decides_as_numpy_does_in_either_precision(seed: int, pattern: str) -> None:
    what = faulty(MODELS["glove9"], seed, pattern)
    accepted, state = scanned(SMALL, what)
    for model, given_ in ((SMALL, single(what)), (MODELS["glove9"], what)):
        reference, own = run(model, given_)
        np.testing.assert_array_equal(accepted, reference)
        for name, value in own._asdict().items():
            # Velocities are differences of two roundings of a metre, over a frame; others are what
            # a fit leaves that may go by three markers near a line, and turn by many roundings.
            atol = 1e-4 if name in ("velocity", "leap", "restless") else 1e-5
            np.testing.assert_allclose(getattr(state, name), value, atol=atol, err_msg=name)


@settings(max_examples=5)
@given(seed=seeds())
def test_jax_stays_finite(seed: int) -> None:
    _, state = scanned(SMALL, absurd(seed))
    for name, value in state._asdict().items():
        assert np.isfinite(value).all(), name
        assert value.dtype in (bool, np.float32), name


def test_vmap_takes_hands_as_a_batch_does() -> None:
    jax = pytest.importorskip("jax")
    from jaxhand import gate as twin

    what = single(faulty(SMALL, 0))
    _, state = run(SMALL, Given(*(part[:30] for part in what)))
    markers, visible, last, dt = (part[30] for part in what)
    tracked = np.ones(3, bool)
    step = jax.jit(jax.vmap(lambda *arguments: twin.step(SMALL, *arguments)))
    found, accepted = step(state, markers, visible, last, tracked, dt)
    expected, reference = gate.step(SMALL, state, markers, visible, last, tracked, dt)
    np.testing.assert_array_equal(accepted, reference)
    for name, value in expected._asdict().items():
        np.testing.assert_allclose(getattr(found, name), value, atol=1e-4, err_msg=name)


# -- in the tracker -----------------------------------------------------------------------------


def gated(what: Given, gate: bool, at_once: bool) -> HandPose:
    """What the tracker says of a stream."""
    model = replace(a_model("learned", joints=True), gate=gate)
    state = tracker.init(model, what.visible.shape[1:-1])
    if at_once:
        return tracker.run(model, state, what.markers, what.visible, what.dt)[1]
    poses = []
    for frame in zip(what.markers, what.visible, what.dt, strict=True):
        state, pose = tracker.step(model, state, *frame)
        poses.append(pose)
    return HandPose(*(np.array(field) for field in zip(*poses, strict=True)))


@settings(max_examples=5)
@given(seed=seeds(), pattern=st.sampled_from(sorted(PATTERNS)))
def test_frames_at_once_are_refused_as_one_after_the_other(seed: int, pattern: str) -> None:
    what = faulty(a_model("learned"), seed, pattern)
    slow, fast = (gated(what, True, at_once) for at_once in (False, True))
    assert_array_equal(fast.status, slow.status)
    assert_array_equal(fast.notice, slow.notice)
    assert_allclose(fast.markers, slow.markers, rtol=0, atol=1e-6)


def test_what_is_refused_says_so_and_counts_as_hidden() -> None:
    what = faulty(a_model("learned"), 3)
    pose, believed = gated(what, True, False), gated(what, False, False)
    refused = pose.status == Status.REJECTED
    assert refused.any()
    assert_array_equal(refused.any(-1), pose.notice & Notice.REJECTED_MARKERS > 0)
    assert (pose.expected_error[refused] > 0).all()
    assert (believed.status != Status.REJECTED).all()
    hidden = gated(what._replace(visible=what.visible & ~refused), False, False)
    assert_array_equal(hidden.markers, pose.markers)
    assert_array_equal(hidden.positions, pose.positions)


def test_where_nothing_is_refused_the_gate_changes_no_bit() -> None:
    what = asked(calm(a_model("learned").hand, 1))
    for one, other in zip(gated(what, True, False), gated(what, False, False), strict=True):
        assert_array_equal(one, other)
