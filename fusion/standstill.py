"""When the camera stands still: pairs, gyro and accelerometer agree that nothing moves."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_opening

from fusion.chain import ImuWindow
from fusion_io.records import FloatArray, PairEstimate

# What a rig may seem to move at when it stands: a running engine shakes it a little.
STILL_SPEED = 0.05  # m/s, by the pairs
STILL_RATE = 0.02  # rad/s, by the gyro less its bias: what is left of that, too
STILL_ACCELERATION = 0.5  # m/s^2, standard deviation of the accelerometer during a step
STILL_STEPS = 5  # so many in a row
STILL_SIGMA = 0.02  # m/s: how well the velocity is zero then


def standing_still(
    steps: Sequence[PairEstimate], windows: Sequence[ImuWindow | None], gyro_bias: FloatArray
) -> NDArray[np.bool_]:
    """Steps (N,) during which the camera stands still; only what an IMU measured can be told.

    gyro_bias (3,) rad/s: as far as it is known.
    """
    still = [
        window is not None and _still(step, window, gyro_bias) for step, window in zip(steps, windows, strict=True)
    ]
    return np.asarray(binary_opening(still, np.ones(STILL_STEPS)))


def _still(step: PairEstimate, window: ImuWindow, gyro_bias: FloatArray) -> bool:
    speed = np.linalg.norm(step.translation) / step.duration_s
    rate = np.linalg.norm(window.durations @ window.angular_velocity / window.durations.sum() - gyro_bias)
    shaken = np.linalg.norm(np.std(window.linear_acceleration, axis=0))
    return bool(speed < STILL_SPEED and rate < STILL_RATE and shaken < STILL_ACCELERATION)
