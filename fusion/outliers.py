"""Measurements that contradict each other before anything is solved: what not to start from."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from fusion.chain import ImuWindow, motions_of, turned
from fusion_io.records import FloatArray, PairEstimate

# Nothing that carries a camera changes its velocity faster than this from one pair to its neighbours.
LARGEST_ACCELERATION = 20.0  # m/s^2
NEIGHBOURS = 7  # pairs whose median is the velocity to be near to


class Suspects(NamedTuple):
    """Steps (N,) whose inertial measurement, or whose pair estimate, is beyond noise."""

    imu: NDArray[np.bool_]
    pair: NDArray[np.bool_]


def suspects(
    steps: Sequence[PairEstimate],
    windows: Sequence[ImuWindow | None],
    rotation_imu_camera: Rotation,
    gyro_bias: FloatArray,
    gate_probability: float,
) -> Suspects:
    """Steps where gyro and pair contradict each other, and pairs whose velocity leaves that of their neighbours.

    Of two rotations that contradict each other, the one is wrong that leaves its neighbours' rate further: motion is
    smooth. gyro_bias (3,) rad/s is of the IMU's axes. gate_probability: how seldom noise alone is taken for more.
    """
    measured = np.array([window is not None for window in windows])
    seconds = np.array([step.duration_s for step in steps])[:, None]
    motions = motions_of(steps)
    claimed = np.array([np.trace(step.covariance[:3, :3]) / 3 for step in steps]) / seconds[:, 0] ** 2
    imu_wrong, pair_wrong = np.zeros(len(steps), dtype=np.bool_), jumps(steps)
    if not np.any(measured):
        return Suspects(imu_wrong, pair_wrong)

    by_pair = (motions.rotation.as_rotvec() / seconds)[measured]
    by_imu = turned([window for window in windows if window is not None], gyro_bias)
    by_gyro = rotation_imu_camera.inv().apply(by_imu) / seconds[measured]
    agree = _without_outliers(by_gyro - by_pair, claimed[measured], gate_probability)
    time = np.array([step.source_stamp_ns for step in steps])[measured]
    smooth = np.stack([np.interp(time, time[agree], axis) for axis in by_gyro[agree].T], axis=1)
    pair_further = np.linalg.norm(by_pair - smooth, axis=1) > np.linalg.norm(by_gyro - smooth, axis=1)
    imu_wrong[measured] = ~agree & ~pair_further
    pair_wrong[measured] |= ~agree & pair_further
    return Suspects(imu_wrong, pair_wrong)


def jumps(steps: Sequence[PairEstimate]) -> NDArray[np.bool_]:
    """Pairs (N,) whose velocity, in camera axes, is too far from that of their neighbours for any acceleration."""
    seconds = np.array([step.duration_s for step in steps])[:, None]
    velocity = np.stack([step.translation for step in steps]) / seconds
    sigma = np.sqrt([np.trace(step.covariance[3:, 3:]) for step in steps]) / seconds[:, 0]
    away = np.linalg.norm(velocity - median_filter(velocity, (NEIGHBOURS, 1), mode="nearest"), axis=1)
    reach = LARGEST_ACCELERATION * median_filter(seconds[:, 0], NEIGHBOURS, mode="nearest") * (NEIGHBOURS // 2)
    return np.asarray(away > reach + 5.0 * sigma)


def _without_outliers(differences: FloatArray, variances: FloatArray, probability: float) -> NDArray[np.bool_]:
    """Which (N, 3) lie within a chi-square gate about their median, widened where variances (N,) prove too small."""
    square = np.sum((differences - np.median(differences, axis=0)) ** 2, axis=1) / variances
    scale = max(1.0, float(np.median(square) / chi2.median(3)))
    return np.asarray(square <= scale * chi2.isf(probability, 3))
