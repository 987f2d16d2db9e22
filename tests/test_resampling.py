"""Laws of resampling and of smoothing: what is not known stays unknown, what is exact stays so."""

from __future__ import annotations

import numpy as np

from jaxhand.sequences import resample, smooth


def test_every_second_frame_of_120_hz_is_kept_exactly() -> None:
    values = np.random.default_rng(0).normal(size=(1001, 2, 3))
    values[10, 1] = values[11, 0] = np.nan
    np.testing.assert_array_equal(resample(np.arange(1001) * 0.008333334, values), values[::2])


def test_a_sample_is_hidden_unless_both_neighbours_were_seen() -> None:
    time = np.arange(101) / 100
    values = np.stack([time, 2 * time, 1 - time], -1)[:, None]
    values[[7, 40, 50, 51]] = np.nan
    resampled, wanted = resample(time, values), np.arange(61) / 60
    assert resampled.shape == (61, 1, 3)
    at = wanted * 100
    needs = [{int(np.floor(x + 1e-6)), int(np.ceil(x - 1e-6))} for x in at]
    expected = np.array([not need & {7, 40, 50, 51} for need in needs])
    np.testing.assert_array_equal(np.isfinite(resampled[:, 0, 0]), expected)
    np.testing.assert_allclose(resampled[expected, 0, 1], 2 * wanted[expected], atol=1e-12)


def test_lost_frames_are_not_bridged_and_stopped_time_is_left_out() -> None:
    time = np.array([0, 1, 1, 2, 3, 9, 10, 11]) / 50
    resampled = resample(time, time[:, None] * np.array([1.0, 2, 3]), rate=100)
    seen = np.isfinite(resampled[:, 0])
    wanted = np.arange(23) / 100
    np.testing.assert_array_equal(seen, (wanted < 0.061) | (wanted > 0.179))
    np.testing.assert_allclose(resampled[seen, 0], wanted[seen], atol=1e-12)


def test_smoothing_keeps_quadratics_also_at_the_ends_and_lowers_noise() -> None:
    t = np.linspace(-1, 1, 31)[:, None, None]
    quadratic = 3 - 2 * t + 5 * t**2 * np.array([1.0, -2, 0.5])
    np.testing.assert_allclose(smooth(quadratic), quadratic, atol=1e-12)
    noise = np.random.default_rng(0).normal(size=(2000, 1, 3))
    # The middle coefficient of 9 points, order 2, is 59 / 231 (Savitzky and Golay, table I).
    np.testing.assert_allclose(smooth(noise).var(), 59 / 231, rtol=0.1)
    impulse = np.zeros(21)
    impulse[10] = 231
    np.testing.assert_allclose(
        smooth(impulse)[6:15], [-21, 14, 39, 54, 59, 54, 39, 14, -21], atol=1e-9
    )
