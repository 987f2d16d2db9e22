"""Recorded hands shown in other sizes: each frame as a whole, others in every epoch."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("jax")
pytest.importorskip("tyro")

import jax
from small_training import CONFIG, HAND, TRAINING, VALIDATION, with_gaps

from jaxhand import tasks
from jaxhand.anthropometry import SIZE_SPREAD
from jaxhand.tasks import Frames
from jaxhand.training import fit_networks
from numpy_infer.arrays import Array
from numpy_infer.model import Model


def shown(frames: Frames, sizes: float, key: int = 1) -> Array:
    """`[N, M, 3]` metres: what the marker network is asked for."""
    args = frames, VALIDATION, HAND, jax.random.key(0), CONFIG.marker_layers, CONFIG.occlusions
    task = tasks.marker_task(*args, sizes=sizes)
    targets = np.asarray(task.prepare(jax.random.key(key), task.frames)[1], np.float64)
    network = task.network
    return (targets * network.output_scale + network.output_mean).reshape(len(targets), -1, 3)


def grown(frames: Frames, sizes: float, key: int = 1) -> Array:
    """`[N, M, M]` how much larger the distances between markers are than recorded."""
    recorded, now = (
        np.linalg.norm(markers[:, :, None] - markers[:, None], axis=-1)
        for markers in (np.asarray(frames.markers, np.float64), shown(frames, sizes, key))
    )
    return now / np.where(recorded > 0, recorded, np.nan)


@pytest.mark.parametrize("frames", [TRAINING, with_gaps()], ids=["whole", "with gaps"])
def test_a_hand_grows_as_a_whole_and_by_as_much_as_asked(frames: Frames) -> None:
    ratio = grown(frames, 0.06)
    of_frame = np.nanmedian(ratio, (1, 2))
    np.testing.assert_allclose(
        ratio, np.where(np.isnan(ratio), np.nan, of_frame[:, None, None]), rtol=2e-3
    )
    assert np.log(of_frame).mean() == pytest.approx(0, abs=0.01)
    assert np.log(of_frame).std() == pytest.approx(0.06, rel=0.1)
    measured = np.isfinite(np.asarray(frames.markers))
    np.testing.assert_array_equal(np.isfinite(shown(frames, 0.06)), measured)


def test_another_epoch_has_other_sizes_and_without_a_spread_none() -> None:
    np.testing.assert_array_equal(shown(TRAINING, 0.06), shown(TRAINING, 0.06))
    assert (
        np.abs(grown(TRAINING, 0.06) - grown(TRAINING, 0.06, key=2))[:, 0, 1] > 1e-3
    ).mean() > 0.9
    np.testing.assert_allclose(grown(TRAINING, 0.0)[:, 0, 1], 1, rtol=2e-3)


def test_simulated_hands_have_people_s_sizes_already() -> None:
    frames = TRAINING._replace(simulated=1.0)
    np.testing.assert_array_equal(shown(frames, 0.06), shown(frames, 0.0))


def test_a_training_is_told_of_it_and_a_refinement_does_it_by_itself() -> None:
    short = replace(CONFIG, epochs=1, joints=False)
    first = fit_networks(TRAINING, VALIDATION, HAND, short)

    def kernel(sizes: float | None, start: Model | None) -> Array:
        config = replace(short, sizes=sizes)
        network = fit_networks(TRAINING, VALIDATION, HAND, config, start=start).marker_network
        return np.asarray(network.arrays["0.kernel"])

    for start, by_default in ((None, 0.0), (first, SIZE_SPREAD)):
        ways = {sizes: kernel(sizes, start) for sizes in (0.0, SIZE_SPREAD, None)}
        np.testing.assert_array_equal(ways[None], ways[by_default])
        assert np.abs(ways[0.0] - ways[SIZE_SPREAD]).max() > 1e-4


def test_senseless_sizes_are_refused() -> None:
    for wrong in (-0.1, 0.5, float("nan")):
        with pytest.raises(ValueError, match="sizes: expected 0 to"):
            replace(CONFIG, sizes=wrong)
    with pytest.raises(ValueError, match="sizes are for recordings"):
        replace(CONFIG, data=("simulated",), sizes=0.06)
    replace(CONFIG, data=("simulated", "recordings:takes"), sizes=0.06)
