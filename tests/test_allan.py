"""A sensor's noise is found as it was put in."""

import numpy as np
import pytest
from log_samples import SECOND, START

from fusion import allan

RATE = 100
DENSITY = np.array([2e-3, 1e-3, 5e-3])


def stamps(seconds: float) -> np.ndarray:
    return START + np.arange(round(RATE * seconds)) * (SECOND // RATE)


def white(seconds: float, seed: int = 0) -> np.ndarray:
    """White noise of a given density: its standard deviation is the density times the root of the rate."""
    return np.random.default_rng(seed).normal(size=(round(RATE * seconds), 3)) * DENSITY * np.sqrt(RATE)


def whole(times: np.ndarray) -> np.ndarray:
    return np.array([[times[0], times[-1]]])


def test_the_curve_of_white_noise_falls_with_the_root_of_time() -> None:
    curve = allan.allan_deviation(white(300), 1 / RATE)
    slope = np.polyfit(np.log(curve.tau_s[:20]), np.log(curve.deviation[:20]), 1)[0]
    np.testing.assert_allclose(slope, -0.5, atol=0.03)


def test_the_curve_is_the_definition_at_every_averaging_time() -> None:
    """sigma^2(tau) = 1/2 <(mean over the next tau - mean over this tau)^2>, by plain averages at every start."""
    values = white(6)
    curve = allan.allan_deviation(values, 1 / RATE)
    assert len(curve.tau_s) > 5
    for tau_s, deviation in zip(curve.tau_s, curve.deviation, strict=True):
        step = round(tau_s * RATE)
        means = np.stack([values[i : i + step].mean(axis=0) for i in range(len(values) - step + 1)])
        np.testing.assert_allclose(deviation, np.sqrt(np.mean((means[step:] - means[:-step]) ** 2, axis=0) / 2))


def test_density_and_bias_are_found_while_standing_still() -> None:
    times, bias = stamps(60), np.array([0.01, -0.02, 0.03])
    found = allan.noise(times, white(60) + bias, whole(times))
    assert found is not None
    assert found.method == allan.ALLAN
    assert found.seconds == pytest.approx(59.99)
    np.testing.assert_allclose(found.density, DENSITY, rtol=0.1)
    np.testing.assert_allclose(found.bias, bias, atol=5e-3 / np.sqrt(60) * 4)
    assert found.bias_instability is None  # a minute does not tell


def test_the_bottom_of_the_curve_is_the_bias_instability() -> None:
    """Flicker noise has a flat curve at sqrt(2 ln 2 / pi) times its coefficient, wherever white noise is gone."""
    n, coefficient = 2**17, 1e-3
    rng = np.random.default_rng(1)
    frequency = np.fft.rfftfreq(n, 1 / RATE)[1:, None]
    # S(f) = B^2 / (2 pi f), two-sided, for which sigma = B sqrt(2 ln 2 / pi) (IEEE 952, C.1.3).
    amplitude = np.sqrt(coefficient**2 / (2 * np.pi * frequency) * n * RATE)
    phases = rng.normal(size=(len(frequency), 3)) + 1j * rng.normal(size=(len(frequency), 3))
    flicker = np.fft.irfft(np.concatenate([np.zeros((1, 3)), amplitude * phases / np.sqrt(2)]), n=n, axis=0)
    times = stamps(n / RATE)
    found = allan.noise(times, flicker + white(n / RATE, 2) * 0.1, whole(times))
    assert found is not None
    assert found.bias_instability is not None
    np.testing.assert_allclose(found.bias_instability, coefficient, rtol=0.3)


def test_without_standing_still_the_fastest_changes_tell_the_density() -> None:
    times = stamps(60)
    t = (times - START) / SECOND
    motion = np.stack([np.sin(2 * t), 0.3 * np.cos(5 * t), t], axis=1)
    found = allan.noise(times, white(60) + motion, np.zeros((0, 2), dtype=np.int64))
    assert found is not None
    assert found.method == allan.FASTEST_CHANGES
    assert found.bias is None
    np.testing.assert_allclose(found.density, DENSITY, rtol=0.1)


def test_a_short_stop_tells_the_bias_alone() -> None:
    times = stamps(30)
    found = allan.noise(times, white(30) + 0.5, np.array([[times[100], times[400]]]))
    assert found is not None
    assert found.method == allan.FASTEST_CHANGES
    np.testing.assert_allclose(found.bias, 0.5, atol=0.02)


def test_white_noise_alone_has_no_bias_instability() -> None:
    for seed in range(5):
        times = stamps(200)
        found = allan.noise(times, white(200, seed), whole(times))
        assert found is not None
        assert found.bias_instability is None


@pytest.mark.parametrize("count", [0, 1, 2, 7])
def test_a_few_samples_say_nothing(count: int) -> None:
    assert allan.noise(stamps(1)[:count], white(1)[:count], np.zeros((0, 2), dtype=np.int64)) is None
