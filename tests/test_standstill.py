"""Standing still is what pairs, gyro and accelerometer agree on for a while."""

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from fusion.chain import ImuWindow
from fusion.standstill import STILL_STEPS, standing_still
from fusion_io.records import NANOSECONDS, PairEstimate

STEPS = 20
DT_NS = NANOSECONDS // 10
UP = np.array([0.0, 0.0, 9.81])
BIAS = np.array([0.03, -0.01, 0.02])  # rad/s, of a cheap gyro


def _steps(speed: float = 0.0) -> list[PairEstimate]:
    noise = 1e-3 * np.random.default_rng(0).normal(size=(STEPS, 3))
    translation = [0.0, 0.0, speed / 10] + noise
    return [
        PairEstimate(k * DT_NS, (k + 1) * DT_NS, np.array([1.0, 0, 0, 0]), translation[k], 1e-4 * np.eye(6))
        for k in range(STEPS)
    ]


def _windows(rate: float = 0.0, shaking: float = 0.05) -> list[ImuWindow | None]:
    rng = np.random.default_rng(1)
    return [
        ImuWindow(
            np.full(10, 0.01),
            BIAS + [0.0, 0.0, rate] + 2e-3 * rng.normal(size=(10, 3)),
            UP + shaking * rng.normal(size=(10, 3)),
        )
        for _ in range(STEPS)
    ]


def test_a_rig_whose_engine_runs_stands_still() -> None:
    assert standing_still(_steps(), _windows(), BIAS).all()


@pytest.mark.parametrize(
    ("steps", "windows"),
    [
        (_steps(speed=0.2), _windows()),  # creeping without a shake
        (_steps(), _windows(rate=0.05)),  # turning on the spot
        (_steps(), _windows(shaking=2.0)),  # driving in fog: pairs that are stuck
        (_steps(), [None] * STEPS),  # no IMU to agree
    ],
)
def test_it_takes_all_three_to_agree(steps: list[PairEstimate], windows: list[ImuWindow | None]) -> None:
    assert not standing_still(steps, windows, BIAS).any()


@pytest.mark.parametrize("length", [STILL_STEPS - 1, STILL_STEPS])
def test_a_moment_is_not_enough(length: int) -> None:
    steps = [*_steps(speed=5.0)]
    stop = slice(8, 8 + length)
    steps[stop] = _steps()[stop]
    expected = np.zeros(STEPS, dtype=bool)
    expected[stop] = length >= STILL_STEPS
    assert_array_equal(standing_still(steps, _windows(), BIAS), expected)


def test_up_to_the_ends_of_the_log() -> None:
    """A log that begins or ends standing still does so from its first step to its last."""
    steps = [*_steps()[:6], *_steps(speed=5.0)[6:13], *_steps()[13:]]
    still = standing_still(steps, _windows(), BIAS)
    assert_array_equal(np.flatnonzero(~still), range(6, 13))
