"""How noisy a sensor is, from a recording of it: Allan deviation where it stands still, else its fastest changes.

Allan deviation: IEEE Std 952-1997, annex C; overlapping estimator: Riley, Handbook of Frequency Stability Analysis,
NIST SP 1065, 5.2.4.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from fusion_io.records import NANOSECONDS, FloatArray, IntArray

SHORTEST_STILL_S = 10.0
"""From a shorter stand-still no Allan deviation is computed."""

INSTABILITY_STILL_S = 120.0
"""From a shorter one no bias instability is read."""

# An averaging time is trusted that fits into the recording so many times.
MIN_AVERAGES = 20
TAUS_PER_DECADE = 10
# White noise is read where the curve still falls: up to this averaging time.
WHITE_NOISE_TAU_S = 1.0
# At its flat bottom the curve is sqrt(2 ln 2 / pi) times the bias instability (IEEE 952, C.1.3).
FLICKER = float(np.sqrt(2 * np.log(2) / np.pi))
# There the curve must be so many times what white noise alone would leave.
ABOVE_WHITE = 2.0
MAD_TO_STD = 1.4826
THIRD_DIFFERENCE = np.array([1.0, -3.0, 3.0, -1.0])

ALLAN = "Allan deviation"
FASTEST_CHANGES = "fastest changes"


@dataclass(frozen=True, slots=True)
class AllanCurve:
    """Averaging times tau_s (K,) and the deviation (K, 3) of the averages, in the unit of the sensor."""

    tau_s: FloatArray
    deviation: FloatArray


@dataclass(frozen=True, slots=True)
class NoiseEstimate:
    """What was found of a sensor with three axes; with u for its unit, rad/s or m/s^2.

    density (3,): of white noise, u/sqrt(Hz). bias_instability (3,) u: None where the stand-still is too short or the
    white noise hides it. bias (3,): the mean while standing still, None without; of an accelerometer it holds gravity.
    method: ``ALLAN`` over `seconds` of stand-still, or ``FASTEST_CHANGES`` over `seconds` of motion, which vibration
    makes too large and a sensor's own filter too small.
    """

    density: FloatArray
    bias_instability: FloatArray | None
    bias: FloatArray | None
    method: str
    seconds: float
    curve: AllanCurve | None = None


def noise(stamps_ns: IntArray, values: FloatArray, still_ns: IntArray) -> NoiseEstimate | None:
    """The noise of values (N, 3), from the longest of the intervals (M, 2) in which the sensor stands still.

    None where there are too few samples to say anything.
    """
    if len(stamps_ns) < 2 * len(THIRD_DIFFERENCE):
        return None
    period_s = float(np.median(np.diff(stamps_ns))) / NANOSECONDS
    inside, seconds = np.zeros(len(stamps_ns), dtype=bool), 0.0
    if len(still_ns):
        start, end = still_ns[np.argmax(still_ns[:, 1] - still_ns[:, 0])]
        inside = (stamps_ns >= start) & (stamps_ns <= end)
        seconds = float(end - start) / NANOSECONDS
    bias = values[inside].mean(axis=0) if inside.any() else None
    if seconds >= SHORTEST_STILL_S and inside.sum() > 2 * MIN_AVERAGES:
        curve = allan_deviation(values[inside], period_s)
        return NoiseEstimate(white_noise(curve), bias_instability(curve, seconds), bias, ALLAN, seconds, curve)
    duration_s = float(stamps_ns[-1] - stamps_ns[0]) / NANOSECONDS
    return NoiseEstimate(fastest_changes(values, period_s), None, bias, FASTEST_CHANGES, duration_s)


def allan_deviation(values: FloatArray, period_s: float) -> AllanCurve:
    """Overlapping Allan deviation of values (N, M) that are `period_s` apart."""
    angle = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(values - values.mean(axis=0), axis=0)]) * period_s
    largest = max(len(values) // MIN_AVERAGES, 1)
    steps = np.unique(np.geomspace(1, largest, 1 + int(TAUS_PER_DECADE * np.log10(largest))).astype(int))
    deviation = []
    for step in steps:
        second = angle[2 * step :] - 2 * angle[step:-step] + angle[: -2 * step]
        deviation.append(np.sqrt(np.mean(second**2, axis=0) / 2) / (step * period_s))
    return AllanCurve(steps * period_s, np.array(deviation))


def white_noise(curve: AllanCurve) -> FloatArray:
    """Density (M,) in u/sqrt(Hz): what a line of slope -1/2 through the first part of the curve has at one second."""
    first = curve.tau_s <= max(WHITE_NOISE_TAU_S, curve.tau_s[0])
    return np.asarray(np.median(curve.deviation[first] * np.sqrt(curve.tau_s[first])[:, None], axis=0))


def bias_instability(curve: AllanCurve, seconds: float) -> FloatArray | None:
    """Bias instability (M,) from the bottom of the curve; None where white noise still hides it on any axis."""
    bottom = np.argmin(curve.deviation, axis=0)
    lowest = curve.deviation.min(axis=0)
    white = white_noise(curve) / np.sqrt(curve.tau_s[bottom])
    if seconds < INSTABILITY_STILL_S or np.any(lowest < ABOVE_WHITE * white):
        return None
    return np.asarray(lowest / FLICKER)


def fastest_changes(values: FloatArray, period_s: float) -> FloatArray:
    """Density (M,) of white noise from third differences of values (N, M), which motion hardly reaches; robust."""
    third = np.apply_along_axis(np.convolve, 0, values, THIRD_DIFFERENCE, "valid")
    deviation = MAD_TO_STD * np.median(np.abs(third), axis=0) / np.linalg.norm(THIRD_DIFFERENCE)
    return np.asarray(deviation * np.sqrt(period_s))
