"""The output filter: what it leaves alone, and what it takes away."""

from __future__ import annotations

import importlib
from typing import Any

import numpy as np
import pytest
from conftest import Side, x64
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from streams import a_model, assert_same_bits, blocks, leaves, motion, moved, seeds

from jaxhand.strategies import turn
from numpy_infer import HandTracker, one_euro, tracker
from numpy_infer.cli import main
from numpy_infer.hand import load_hand
from numpy_infer.model import Model
from numpy_infer.one_euro import Filter, Smoothing
from numpy_infer.recordings import Recording, read, write

Array = np.ndarray

DT = 1 / 60


def smoothings() -> st.SearchStrategy[Smoothing]:
    return st.builds(Smoothing, st.floats(0.1, 20), st.floats(0, 50), st.floats(0.1, 20))


def walk(seed: int, frames: int = 20) -> tuple[Array, Array]:
    """`[T, 2, 5, 3]` markers that go here and there, `[T, 2]` frames of any length."""
    rng = np.random.default_rng(seed)
    return rng.normal(size=(frames, 2, 5, 3)), rng.uniform(1e-3, 0.1, (frames, 2))


def through(smoothing: Smoothing, markers: Array, dt: Array) -> tuple[Filter, Array]:
    """The state after all frames, and all outputs."""
    state, outputs = one_euro.init(markers[0]), []
    for points, elapsed in zip(markers, dt, strict=True):
        state, output = one_euro.step(smoothing, state, points, elapsed)
        outputs.append(output)
    return state, np.array(outputs)


@given(smoothings(), seeds())
def test_what_stands_still_passes_unchanged(smoothing: Smoothing, seed: int) -> None:
    markers, dt = walk(seed)
    markers[:] = markers[0]
    assert_array_equal(through(smoothing, markers, dt)[1], markers)


@given(smoothings(), seeds())
def test_the_first_frame_passes_unchanged_and_what_comes_later_changes_nothing_before(
    smoothing: Smoothing, seed: int
) -> None:
    markers, dt = walk(seed)
    whole = through(smoothing, markers, dt)[1]
    assert_array_equal(whole[0], markers[0])
    assert_array_equal(through(smoothing, markers[:7], dt[:7])[1], whole[:7])


@given(smoothings(), seeds(), st.integers(1, 19))
def test_a_state_can_be_taken_up_again(smoothing: Smoothing, seed: int, cut: int) -> None:
    markers, dt = walk(seed)
    state, _ = through(smoothing, markers[:cut], dt[:cut])
    for points, elapsed in zip(markers[cut:], dt[cut:], strict=True):
        state, output = one_euro.step(smoothing, state, points, elapsed)
    expected_state, expected = through(smoothing, markers, dt)
    assert_same_bits((state, output), (expected_state, expected[-1]))


@given(smoothings(), seeds(), st.floats(0, np.pi))
def test_a_rigid_motion_of_the_world_moves_the_output_by_it(
    smoothing: Smoothing, seed: int, angle: float
) -> None:
    markers, dt = walk(seed)
    rng = np.random.default_rng(seed)
    motion = turn(rng.normal(size=3), angle), rng.normal(size=3)
    found = through(smoothing, moved(markers, *motion), dt)[1]
    assert_allclose(found, moved(through(smoothing, markers, dt)[1], *motion), rtol=0, atol=1e-9)


@given(smoothings(), seeds(), st.sampled_from([0.0, -DT, -np.inf, np.nan]))
def test_no_time_changes_nothing(smoothing: Smoothing, seed: int, late: float) -> None:
    markers, dt = walk(seed)
    state, outputs = through(smoothing, markers, dt)
    again, output = one_euro.step(smoothing, state, markers[0], np.full(2, late))
    assert_same_bits((again, output), (state, outputs[-1]))


@given(smoothings(), seeds())
def test_the_output_comes_to_a_still_input_and_never_past_it(
    smoothing: Smoothing, seed: int
) -> None:
    markers, dt = walk(seed)
    state, outputs = through(smoothing, markers, dt)
    left = np.linalg.norm(outputs[-1] - markers[-1], axis=-1)
    for _ in range(5):
        # So long a frame that the slowest filter goes nine tenths of the way and more.
        state, output = one_euro.step(smoothing, state, markers[-1], np.full(2, 20.0))
        now = np.linalg.norm(output - markers[-1], axis=-1)
        assert (now <= 0.1 * left + 1e-15).all()
        left = now


@given(seeds(), st.floats(0.1, 2.0))
def test_a_marker_at_a_steady_speed_is_late_by_what_is_said(seed: int, speed: float) -> None:
    smoothing, rng = Smoothing(), np.random.default_rng(seed)
    direction = turn(rng.normal(size=3), rng.uniform(0, 3))[0]
    time = np.arange(3000) / 1000
    markers = (speed * time[:, None] * direction)[:, None]
    _, outputs = through(smoothing, markers, np.full(3000, 1e-3))
    late = np.linalg.norm(markers[-1] - outputs[-1]) / speed
    assert late == pytest.approx(smoothing.lag(speed), rel=0.02)


def jitter(markers: Array) -> float:
    """RMS of the steps from frame to frame."""
    return float(np.sqrt((np.diff(markers, axis=0) ** 2).mean()))


def test_a_still_hand_jitters_less() -> None:
    rng = np.random.default_rng(0)
    markers = 0.5e-3 * rng.standard_normal((1200, 1, 9, 3))
    _, outputs = through(Smoothing(), markers, np.full((1200, 1), DT))
    assert jitter(outputs[60:]) < 0.25 * jitter(markers)


def test_twins_say_the_same(side: Side) -> None:
    module = importlib.import_module(f"{side.package}.one_euro")
    step = module.step
    if side.is_jax:
        jax = pytest.importorskip("jax")
        step = jax.jit(module.step, static_argnums=0)
    markers, dt = walk(3)
    dt[4] = 0
    expected_state, expected = through(Smoothing(), markers, dt)

    def run() -> tuple[Any, Array]:
        state, outputs = module.init(side.cast(markers[0])), []
        for points, elapsed in zip(side.cast(markers), side.cast(dt), strict=True):
            state, output = step(Smoothing(), state, points, elapsed)
            outputs.append(side.check(output))
        return state, np.array(outputs)

    if side.is_jax:
        with x64(side.dtype == np.float64):
            state, outputs = run()
    else:
        state, outputs = run()
    assert_allclose(outputs, expected, rtol=0, atol=side.metres)
    for one, other in zip(leaves(state), leaves(expected_state), strict=True):
        assert_allclose(one, other, rtol=1e-4 if side.dtype == np.float32 else 1e-9, atol=1e-9)


# -- in the tracker -------------------------------------------------------------------------------


def stream(model: Model, frames: int = 80) -> tuple[Array, Array, Array]:
    rng = np.random.default_rng(2)
    markers = motion(model.hand, rng, frames, 2)
    dt = np.full(markers.shape[:2], DT)
    dt[30] = 0
    return markers, blocks(rng, markers.shape[:-1]), dt


RIGHT = np.array([False, True])


def stepped(model: Model, frames: tuple[Array, ...]) -> tuple[Any, list[Any]]:
    state, poses = tracker.init(model, (2,), RIGHT), []
    for frame in zip(*frames, strict=True):
        state, pose = tracker.step(model, state, *frame)
        poses.append(pose)
    return state, poses


@pytest.mark.parametrize("predictor", ["learned", "affine"])
def test_only_what_is_given_out_is_filtered(predictor: str) -> None:
    """The tracker goes on from what it measured, as without the filter; markers pass through it on
    their way out, and the wrist is that of the markers given."""
    bare = a_model(predictor, joints=True)
    model = a_model(predictor, joints=True, smoothing=Smoothing())
    frames = stream(model)
    (state, poses), (expected, plain) = stepped(model, frames), stepped(bare, frames)
    assert_same_bits(state._replace(smoothing=()), expected)
    own, tracked = one_euro.init(plain[0].markers), np.zeros(2, bool)
    for pose, without, dt in zip(poses, plain, frames[2], strict=True):
        tracked |= without.state == 0
        own = own._replace(begun=own.begun & tracked)
        own, markers = one_euro.step(Smoothing(), own, without.markers, dt)
        assert_allclose(pose.markers, markers, rtol=0, atol=1e-12)
        assert_same_bits(
            (pose.status, pose.expected_error), (without.status, without.expected_error)
        )
    assert np.abs(poses[-1].wrist_position - plain[-1].wrist_position).max() > 1e-4


@pytest.mark.parametrize("predictor", ["learned", "affine"])
def test_frames_at_once_are_frames_one_after_the_other(predictor: str) -> None:
    model = a_model(predictor, joints=True, smoothing=Smoothing())
    frames = stream(model)
    state, poses = stepped(model, frames)
    found, at_once = tracker.run(model, tracker.init(model, (2,), RIGHT), *frames)
    for one, other in zip(leaves(found), leaves(state), strict=True):
        assert_allclose(one, other, rtol=0, atol=1e-6)
    for name in ("markers", "wrist_rotation", "wrist_position", "positions"):
        expected = np.array([getattr(pose, name) for pose in poses])
        assert_allclose(getattr(at_once, name), expected, rtol=0, atol=1e-6)


def test_in_jax_too() -> None:
    jax = pytest.importorskip("jax")
    import jaxhand.tracker

    model = a_model("learned", dtype=np.float32, smoothing=Smoothing())
    markers, visible, dt = stream(model)
    visible[:, :, :4] = True
    frames = markers.astype(np.float32), visible, dt.astype(np.float32)
    expected = tracker.run(model, tracker.init(model, (2,), RIGHT), *frames)[1]

    @jax.jit
    def found(model: Model) -> Any:
        start = jaxhand.tracker.init(model, (2,), RIGHT)
        state, first = jaxhand.tracker.step(model, start, *(array[0] for array in frames))
        return first, jaxhand.tracker.run(model, state, *(array[1:] for array in frames))[1]

    first, others = found(model)
    for name in ("markers", "wrist_position"):
        together = np.concatenate([getattr(first, name)[None], getattr(others, name)])
        assert_allclose(together, getattr(expected, name), rtol=0, atol=1e-4)


@pytest.mark.parametrize(
    "smoothing",
    [Smoothing(0), Smoothing(-1), Smoothing(np.nan), Smoothing(1, -1), Smoothing(1, 1, 0)],
)
def test_a_filter_that_is_none_is_refused(smoothing: Smoothing) -> None:
    with pytest.raises(ValueError, match="smoothing: expected positive cutoffs"):
        HandTracker.load(smoothing=smoothing)


def test_the_command_smooths_and_says_how_late(
    tmp_path: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    hand = load_hand("glove9")
    rng = np.random.default_rng(0)
    markers = hand.template + 1e-3 * rng.standard_normal((200, *hand.template.shape))
    write(Recording(hand.markers, markers, np.arange(200) * DT, 60.0, ""), tmp_path / "a.csv")
    for name, more in (("raw", []), ("smooth", ["--smooth"]), ("slow", ["--smooth", "0.5"])):
        out = str(tmp_path / f"{name}.csv")
        assert main(["track", str(tmp_path / "a.csv"), "-o", out, *more]) == 0
    said = capsys.readouterr().out
    assert "smoothed: 80 ms late at rest, 7 ms at a steady 1 m/s" in said
    assert "smoothed: 318 ms late at rest, 8 ms at a steady 1 m/s" in said
    raw, smooth, slow = (
        jitter(read(tmp_path / f"{name}.csv").markers) for name in ("raw", "smooth", "slow")
    )
    assert slow < smooth < 0.5 * raw
