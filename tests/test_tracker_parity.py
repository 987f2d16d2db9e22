"""JAX = numpy: the tracker's two sides give the same, over long streams and from any state."""

from __future__ import annotations

import functools
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from streams import PATTERNS, Stream, a_model, at_least, leaves, motion, run

from numpy_infer import tracker
from numpy_infer.model import Model
from numpy_infer.pose import State, Status

Array = np.ndarray

# A step takes about ten seconds to compile. So the JAX side is compiled once for each predictor
# with arithmetic of its own, as a scan over 250 frames of 4 hands, with the model as an argument.

FRAMES, HANDS = 250, 4
RIGHT = np.array([False, True, False, True])
TWINS = ("moving_average", "affine", "learned")


@functools.cache
def jax_scan(predictor: str) -> Any:
    """`(model, stream) -> (poses, states after each frame)`, in numpy arrays, float32."""
    jax = pytest.importorskip("jax")
    import jaxhand.tracker

    def scan(model: Model, frames: Any, right: Array) -> Any:
        def step(state: State, frame: Any) -> Any:
            state, pose = jaxhand.tracker.step(model, state, *frame)
            return state, (pose, state)

        return jax.lax.scan(step, jaxhand.tracker.init(model, right.shape, right), frames)[1]

    # One of them under vmap, hand by hand: leading axes and vmap must come to the same.
    function = jax.jit(jax.vmap(scan, (None, 1, 0), 1) if predictor == "learned" else scan)

    def on_arrays(model: Model, stream: Stream) -> Any:
        frames = tuple(np.asarray(a, np.float32) for a in (stream.markers, stream.dt))
        frames = (frames[0], stream.visible, frames[1])
        return jax.tree.map(np.asarray, function(model, frames, RIGHT))

    return on_arrays


def long_stream(model: Model, least: int) -> Stream:
    """Every pattern of gaps for 50 frames; float32, so that both sides are given the same."""
    rng = np.random.default_rng(7)
    shape = (FRAMES, HANDS, len(model.hand))
    visible = np.concatenate([pattern(rng, (50, *shape[1:])) for pattern in PATTERNS.values()])
    visible = at_least(visible, least, rng)
    if least and model.predictor == "affine":
        # Where the markers are nearly in a plane, λ = 1e-8 m² makes of float32's rounding of
        # coordinates a millimetre and more, on each side another one. So five stay in sight that
        # do not lie in a plane.
        visible[..., [0, 1, 2, 4, 8]] = True
    truth = motion(model.hand, rng, FRAMES, HANDS).astype(np.float32)
    return Stream(truth, visible, np.full(shape[:2], 1 / 60, np.float32))


def twin_model(predictor: str, seed: int = 0) -> Model:
    joints = predictor == "learned"
    return a_model(predictor, dtype=np.float32, joints=joints, seed=seed)


@pytest.mark.parametrize("predictor", TWINS)
def test_a_thousand_frames_with_four_markers_visible_are_the_same_in_jax(predictor: str) -> None:
    model = twin_model(predictor)
    stream = long_stream(model, 4)
    theirs, _ = jax_scan(predictor)(model, stream)
    ours, _ = run(model, stream, right=RIGHT)
    assert_allclose(theirs.markers, ours.markers, rtol=0, atol=1e-4)
    assert_array_equal(theirs.status, ours.status)
    assert_array_equal(theirs.state, ours.state)
    seen = ours.status == Status.OBSERVED
    for own, within in ((~seen, 1e-5), (seen, 1e-4)):  # those seen are on their way back: places
        assert_allclose(theirs.expected_error[own], ours.expected_error[own], rtol=0, atol=within)
    if ours.angles is not None:
        # Not the angles: near 90° of abduction, where this random network goes, they are no
        # function of the rotations.
        clear = ~nearly_opposite(model, stream, ours.rotations)
        assert clear.mean() > 0.99
        rotations = (
            pose.rotations[..., 1:, :, :].reshape(*clear.shape, 3, 3, 3) for pose in (theirs, ours)
        )
        assert_allclose(*(of[clear] for of in rotations), rtol=0, atol=1e-3)
        assert_allclose(theirs.positions, ours.positions, rtol=0, atol=1e-4)


def nearly_opposite(model: Model, stream: Stream, rotations: Array) -> Array:
    """`[T, H, 5]` fingers that alignment turns by more than 170°: there it is the less determined
    the nearer it comes to a half turn, and all rounding counts six times and more."""
    stiff, _ = run(replace(model, alignment=False), stream, right=RIGHT)
    base = rotations[..., 1::3, :, :] * stiff.rotations[..., 1::3, :, :]
    return (base.sum((-1, -2)) - 1) / 2 < np.cos(np.radians(170))


@pytest.mark.parametrize("predictor", TWINS)
def test_one_step_from_the_same_state_is_the_same_in_jax_whatever_is_visible(
    predictor: str,
) -> None:
    """From every state that the JAX side goes through, few visible and lost ones among them, numpy
    takes the next step: all of them at once, as leading axes."""
    model = twin_model(predictor, seed=5)  # other weights, the same compilation
    stream = long_stream(model, 0)
    poses, states = jax_scan(predictor)(model, stream)
    before, after = (
        _each(lambda a, part=part: a[part], states) for part in (np.s_[:-1], np.s_[1:])
    )
    ours, pose = tracker.step(model, before, *(a[1:] for a in (stream.markers, *stream[1:])))
    # float32, one step, through rotations that few markers determine; these themselves: times ten.
    rounding = 2e-4
    clear = np.ones(pose.state.shape, bool)
    if predictor == "affine":  # see `long_stream`: there λ decides, and rounding
        clear = np.isin(after.visible.sum(-1), [0, 1, 2, 9]) & (before.visible.sum(-1) == 9)
        assert clear.sum() > 10
    expected = _each(lambda a: a[1:], poses)
    for one, other in zip(leaves((ours, pose)), leaves((after, expected)), strict=True):
        assert one.dtype.kind == other.dtype.kind
        size = rounding * (10 if one.shape[-2:] == (3, 3) else 1)
        assert_allclose(one[clear], other[clear], rtol=0, atol=size)


def _each(function: Any, tree: Any) -> Any:
    """The function on all arrays of a state or an output."""
    if isinstance(tree, tuple):
        parts = [_each(function, part) for part in tree]
        return type(tree)(*parts) if parts else tree
    return None if tree is None else function(tree)
