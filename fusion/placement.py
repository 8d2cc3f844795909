"""How an IMU is mounted and what its clock reads, as a run found it: what metrics.json, printout and report show."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from fusion.imu import ImuCalibration
from fusion.measurements import Estimate, Mounting
from fusion_io.records import FloatArray


@dataclass(frozen=True, slots=True)
class Placement:
    """The best that is known: as a back end refined it, else as the pairs show it or as it was given.

    rotation_imu_camera: v_imu = R v_camera, None where it is unknown. time_offset_s: t_imu = t_camera + offset.
    lever_arm_m (3,): where the IMU is, in the camera's axes; only a back end finds it. Standard deviations are None
    where a value was given and nothing refined it; rotation_std_rad, lever_arm_std_m (3,) are about and along the
    camera's axes. gyro_bias, gyro_bias_std (3,) rad/s: at first, in IMU axes.
    """

    rotation_imu_camera: Rotation | None
    rotation_std_rad: FloatArray | None
    time_offset_s: float
    time_offset_std_s: float | None
    gyro_bias: FloatArray
    gyro_bias_std: FloatArray
    lever_arm_m: FloatArray | None = None
    lever_arm_std_m: FloatArray | None = None

    @property
    def summary(self) -> str:
        """In a line: the largest deviation of the mounting, the time offset and its deviation."""
        std = self.rotation_std_rad
        mounting = "given" if std is None else f"known to +-{np.rad2deg(np.max(std)):.2f} deg"
        deviation = "given" if self.time_offset_std_s is None else f"+-{1e3 * self.time_offset_std_s:.1f} ms"
        return f"mounting {mounting}, time offset {1e3 * self.time_offset_s:.1f} ms ({deviation})"


def placement(calibration: ImuCalibration, refined: Mounting | None) -> Placement:
    """What is known after a back end has refined the calibration, or without that."""
    if refined is not None:
        return Placement(
            refined.rotation_imu_camera,
            refined.rotation_std_rad,
            calibration.time_offset_s + refined.ahead_s,
            refined.ahead_std_s,
            refined.gyro_bias,
            refined.gyro_bias_std,
            refined.lever_arm_m,
            refined.lever_arm_std_m,
        )
    given = not np.any(calibration.rotation_std_rad)
    return Placement(
        calibration.rotation_imu_camera,
        None if given else calibration.rotation_std_rad,
        calibration.time_offset_s,
        calibration.time_offset_std_s or None,
        calibration.gyro_bias,
        np.full(3, calibration.gyro_bias_std),
    )


def refined_mounting(estimates: Iterable[Estimate]) -> Mounting | None:
    """The mounting as the first of the back ends refined it that did."""
    return next((each.mounting for each in estimates if each.mounting is not None), None)


def knows_imu(estimates: Iterable[Estimate]) -> bool:
    """Whether a back end used the IMU: one may refuse it although it could be calibrated."""
    return any(each.series is not None and each.series.knows_imu for each in estimates)


def imu_line(calibration: ImuCalibration, estimates: Iterable[Estimate]) -> str:
    """What became of the IMU, and how it is mounted where it is of use."""
    if not calibration.used:
        return f"IMU left out: {calibration.reason}"
    found = list(estimates)
    became = "used" if knows_imu(found) else "calibrated, but no back end used it"
    return f"IMU {became}: {calibration.reason}; {placement(calibration, refined_mounting(found)).summary}"
