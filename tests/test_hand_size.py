"""The size of a hand comes out of few markers, and nothing is changed where there is nothing to."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("jax")

from fitted import fitted_model
from simulated import motion, worn
from strategies import turn

from jaxhand.hand_size import FEWEST, Size, hand_size
from numpy_infer import load_hand
from numpy_infer.arrays import Array
from numpy_infer.hand import FINGERS
from numpy_infer.model import Model

GLOVE = load_hand("glove9")
FRAMES, RATE = 600, 30.0
NEAR = 0.01


@pytest.fixture(scope="module")
def model() -> Model:
    return fitted_model()


def recording(factor: float, seed: int = 1) -> Array:
    """`[T, M, 3]` metres: free motion of a hand of this size, measured with 0.3 mm of noise."""
    markers = worn(GLOVE.resized(factor), motion(seed, FRAMES, RATE))[0]
    return markers + 0.3e-3 * np.random.default_rng(seed).standard_normal(markers.shape)


@pytest.mark.parametrize("factor", [0.86, 0.95, 1.12])
def test_a_hand_of_another_size_is_found_to_be(model: Model, factor: float) -> None:
    found = hand_size(model, recording(factor))
    assert found.factor == found.likeliest == pytest.approx(factor, abs=NEAR)
    assert found.interval[0] <= found.likeliest <= found.interval[1]
    assert found.interval[1] - found.interval[0] < 0.05
    assert found.seen.all()


@pytest.mark.parametrize("factor", [0.98, 1.0, 1.02])
def test_the_models_own_size_and_one_too_near_to_tell_stay_what_they_are(
    model: Model, factor: float
) -> None:
    found = hand_size(model, recording(factor))
    assert found.factor == 1
    assert found.likeliest == pytest.approx(factor, abs=NEAR)


def test_a_size_is_not_a_matter_of_place(model: Model) -> None:
    markers = recording(1.1)
    moved = markers @ turn((0.3, -2.0, 1.0), 2.0).T + np.array([3.0, -1.0, 2.0])
    assert hand_size(model, moved).likeliest == pytest.approx(
        hand_size(model, markers).likeliest, abs=1e-3
    )


def test_what_is_hidden_and_what_is_a_ghost_decide_nothing(model: Model) -> None:
    markers = recording(1.1)
    clean = hand_size(model, markers).likeliest
    rng = np.random.default_rng(2)
    ghosts = rng.random(FRAMES) < 0.05
    markers[ghosts, 4] += rng.normal(scale=0.3, size=(ghosts.sum(), 3))
    hidden = rng.random(FRAMES) < 0.5
    markers[hidden, rng.integers(len(GLOVE), size=hidden.sum())] = np.nan
    found = hand_size(model, markers).likeliest
    assert found == pytest.approx(clean, abs=NEAR)
    mask = np.isnan(markers)
    masked = np.ma.array(np.where(mask, 0, markers), mask=mask)
    assert hand_size(model, masked).likeliest == found


@pytest.mark.parametrize("noise", [0.0, 0.3e-3])
def test_a_still_hand_has_not_been_seen_and_keeps_the_models_size(
    model: Model, noise: float
) -> None:
    """However sure one posture, over and over, looks."""
    still = np.repeat(recording(1.1)[:1], FRAMES, 0)
    still += noise * np.random.default_rng(0).standard_normal(still.shape)
    found = hand_size(model, still)
    assert not found.seen.any()
    assert found.interval[1] - found.interval[0] < 0.01
    assert found.factor == 1


def test_what_cannot_be_measured_is_named(model: Model) -> None:
    with pytest.raises(ValueError, match="no joint network"):
        hand_size(replace(model, joints="none", joint_network=None), recording(1.0))
    markers = recording(1.0)
    markers[FEWEST - 1 :, 3] = np.nan
    with pytest.raises(ValueError, match=f"{FEWEST - 1} frames show all of .*{FEWEST} are needed"):
        hand_size(model, markers)


def test_as_many_fingers_are_reported_as_there_are(model: Model) -> None:
    found = hand_size(model, recording(1.0)[:FEWEST])
    assert isinstance(found, Size)
    assert found.seen.shape == (len(FINGERS),)
