"""What the back ends are given, and what they give."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fusion.gnss import Georeference, Positions
from fusion.imu import BiasStep, ImuCalibration
from fusion_io.records import EstimatorSeries, FloatArray, ImuSeries, PairEstimate, Trajectory


@dataclass(frozen=True, slots=True)
class Mounting:
    """How an IMU is mounted, what its clock reads and what its gyro shows at rest, as a back end has refined it.

    T_camera_imu (4, 4); ahead_s: how much further ahead of the camera's its clock is than the calibration says;
    misalignment (3,) rad: of the front end's rotations against its translations. covariance (10, 10): of the right
    perturbation of T_camera_imu, rotation first, of ahead_s, and of misalignment. gyro_bias, gyro_bias_std (3,) rad/s:
    at first, in the IMU's axes.
    """

    T_camera_imu: FloatArray
    ahead_s: float
    misalignment: FloatArray
    covariance: FloatArray
    gyro_bias: FloatArray
    gyro_bias_std: FloatArray

    @property
    def rotation_imu_camera(self) -> Rotation:
        """v_imu = R v_camera."""
        return Rotation.from_matrix(self.T_camera_imu[:3, :3]).inv()

    @property
    def rotation_std_rad(self) -> FloatArray:
        """(3,) about the camera's axes."""
        R = self.T_camera_imu[:3, :3]
        return np.asarray(np.sqrt(np.diag(R @ self.covariance[:3, :3] @ R.T)))

    @property
    def lever_arm_m(self) -> FloatArray:
        """(3,) where the IMU is, in the camera's axes."""
        return np.asarray(self.T_camera_imu[:3, 3])

    @property
    def lever_arm_std_m(self) -> FloatArray:
        """(3,) along the camera's axes."""
        R = self.T_camera_imu[:3, :3]
        return np.asarray(np.sqrt(np.diag(R @ self.covariance[3:6, 3:6] @ R.T)))

    @property
    def ahead_std_s(self) -> float:
        """Of ahead_s."""
        return float(np.sqrt(self.covariance[6, 6]))


@dataclass(frozen=True, slots=True)
class Measurements:
    """All that is known about one motion of the camera.

    steps: pair estimates that follow each other without holes (`chain.bridge_gaps`). imu: samples in the IMU's own axes
    on the camera's clock, without what is faulty, and calibration: what is known of how they relate to the camera; both
    None where there is no IMU to be used. mounting: the same where a back end has refined it. front_end_sigma: of the
    front end's scale error and rate bias (rad/s), where a back end has found out how large they are. bias_steps: what a
    back end has found of the IMU, and was taken out of its samples. skips: pair estimates between frames of the same
    steps that are further apart. loops: the same between frames where the camera came back. gnss: positions of an
    antenna.
    """

    steps: Sequence[PairEstimate]
    imu: ImuSeries | None = None
    calibration: ImuCalibration | None = None
    mounting: Mounting | None = None
    front_end_sigma: tuple[float, float] | None = None
    bias_steps: Sequence[BiasStep] = ()
    skips: Sequence[PairEstimate] = ()
    loops: Sequence[PairEstimate] = ()
    gnss: Positions | None = None


@dataclass(frozen=True, slots=True)
class Estimate:
    """What a back end makes of the measurements.

    trajectory: with the covariance of every pose. note: one line on how the measurements were used. rejected: how many
    of them were left out as outliers. series: what was estimated beside the poses. loops_used (M,): which of the loops
    were believed; empty for a back end that takes none. mounting: as it was refined. front_end_sigma: as in
    `Measurements`. bias_steps: those of the IMU that were found, in order of time. georeference: where on the earth the
    world is, where positions told it. hindsight: of a causal back end, the trajectory where its last instant sees it,
    where loops moved what was before them.
    """

    trajectory: Trajectory
    note: str
    rejected: int = 0
    series: EstimatorSeries | None = None
    loops_used: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, dtype=np.bool_))
    mounting: Mounting | None = None
    front_end_sigma: tuple[float, float] | None = None
    bias_steps: Sequence[BiasStep] = ()
    georeference: Georeference | None = None
    hindsight: Trajectory | None = None
