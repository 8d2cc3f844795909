"""What a log holds, as typed records.

Conventions (the same in every package):

* ``T_a_b`` maps points from frame b to frame a, so that ``T_world_camera @ p_camera == p_world``.
* Time is integer nanoseconds on the clock of the log; a record's time is when it was measured.
* Camera frame: x right, y down, z forward. IMU frame: whatever the log says.
* Tangent vectors and covariances of SE(3) are ordered rotation (rad) first, then translation (m),
  and perturb on the right: ``T = T_mean * Exp(xi)``, as in GTSAM.
* SI units and radians; a name that holds anything else says so.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, fields

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform, Rotation, Slerp

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

NANOSECONDS = 1_000_000_000

LONGEST_INTERPOLATION_S = 1.0
"""A hole in a trajectory longer than this is not bridged by interpolation."""


@dataclass(frozen=True, slots=True)
class CameraInfo:
    """Pinhole intrinsics of an image: K (3, 3) in pixels, distortion as in sensor_msgs/CameraInfo."""

    width: int
    height: int
    K: FloatArray
    distortion_model: str = ""
    distortion: FloatArray = field(default_factory=lambda: np.zeros(0))
    frame_id: str = "camera"

    def scaled_to(self, width: int, height: int) -> CameraInfo:
        """The same camera with its image resized; pixel centres are at integer coordinates."""
        sx, sy = width / self.width, height / self.height
        K = self.K.copy()
        K[0] *= sx
        K[1] *= sy
        # Pixel centres are integers: the image's corner is at -0.5, and that is what scaling keeps.
        K[0, 2] += 0.5 * sx - 0.5
        K[1, 2] += 0.5 * sy - 0.5
        return CameraInfo(width, height, K, self.distortion_model, self.distortion, self.frame_id)

    def cropped(self, left: int, top: int, width: int, height: int) -> CameraInfo:
        """The same camera seen through the window whose upper left pixel is (left, top)."""
        K = self.K.copy()
        K[0, 2] -= left
        K[1, 2] -= top
        return CameraInfo(width, height, K, self.distortion_model, self.distortion, self.frame_id)


@dataclass(frozen=True, slots=True)
class CameraFrame:
    """An undistorted image with the depth of its pixels.

    image: (H, W) or (H, W, 3) uint8, colour as RGB. depth: (H, W) float32 metres along the optical
    axis, 0 where there is none, or None for a frame without depth (it can still be a target).
    """

    stamp_ns: int
    image: NDArray[np.uint8]
    depth: NDArray[np.float32] | None
    camera: CameraInfo


@dataclass(frozen=True, slots=True)
class ImuSeries:
    """IMU samples in order of time, in the IMU's own frame.

    stamps_ns (N,) strictly increasing; angular_velocity (N, 3) rad/s; linear_acceleration (N, 3)
    m/s^2, gravity included (an IMU at rest shows +g upwards). The standard deviations are per
    sample, as the log's covariance fields give them, or None where they are unknown.
    """

    stamps_ns: IntArray
    angular_velocity: FloatArray
    linear_acceleration: FloatArray
    angular_velocity_std: float | None = None
    linear_acceleration_std: float | None = None

    def __len__(self) -> int:
        return len(self.stamps_ns)


@dataclass(frozen=True, slots=True)
class PairEstimate:
    """The pose of the target camera in the source camera's frame, with its covariance.

    Rotations are kept as the unit quaternions that a message carries, not as matrices, so that
    writing and reading change no bit and a replay starts from the same numbers.

    quat_wxyz (4,), translation (3,) m; covariance (6, 6), rotation first, right perturbation.
    hypotheses_quat_wxyz (M, 4), hypotheses_translation (M, 3), errors (M,): the hypotheses of the
    last level and their photometric errors; M is 0 and winner is -1 where a pair did not come from
    the network. imu_coverage: the share of the IMU window that was measured rather than filled.
    """

    source_stamp_ns: int
    target_stamp_ns: int
    quat_wxyz: FloatArray
    translation: FloatArray
    covariance: FloatArray
    winner: int = -1
    hypotheses_quat_wxyz: FloatArray = field(default_factory=lambda: np.zeros((0, 4)))
    hypotheses_translation: FloatArray = field(default_factory=lambda: np.zeros((0, 3)))
    errors: FloatArray = field(default_factory=lambda: np.zeros(0))
    imu_coverage: float = 1.0

    @property
    def T_source_target(self) -> RigidTransform:
        """The estimate as a rigid transform."""
        rotation = Rotation.from_quat(self.quat_wxyz, scalar_first=True)
        return RigidTransform.from_components(self.translation, rotation)

    @property
    def duration_s(self) -> float:
        """Time from source to target."""
        return (self.target_stamp_ns - self.source_stamp_ns) / NANOSECONDS


@dataclass(frozen=True, slots=True)
class Trajectory:
    """Poses of the camera over time.

    stamps_ns (N,) strictly increasing; poses: N transforms T_world_camera; covariances (N, 6, 6),
    rotation first, right perturbation, or None where they are unknown (ground truth).
    """

    stamps_ns: IntArray
    poses: RigidTransform
    covariances: FloatArray | None = None

    def __len__(self) -> int:
        return len(self.stamps_ns)

    @property
    def path_length_m(self) -> float:
        """Length of the way along all positions."""
        return float(np.linalg.norm(np.diff(self.poses.translation, axis=0), axis=1).sum())

    def at(self, stamps_ns: IntArray) -> RigidTransform:
        """Poses at stamps (M,) that the trajectory spans: linear position, slerp rotation."""
        t = (self.stamps_ns - self.stamps_ns[0]) / NANOSECONDS
        at = (stamps_ns - self.stamps_ns[0]) / NANOSECONDS
        position = np.stack([np.interp(at, t, axis) for axis in self.poses.translation.T], axis=-1)
        return RigidTransform.from_components(position, Slerp(t, self.poses.rotation)(at))

    def covers(self, stamps_ns: IntArray) -> NDArray[np.bool_]:
        """Which stamps (M,) lie on a pose, or between two that are close enough in time to interpolate."""
        known = self.stamps_ns
        if len(known) < 2:
            return np.zeros(len(stamps_ns), dtype=np.bool_)
        after = np.clip(np.searchsorted(known, stamps_ns), 1, len(known) - 1)
        inside = (stamps_ns >= known[0]) & (stamps_ns <= known[-1])
        exact = (stamps_ns == known[after]) | (stamps_ns == known[after - 1])
        near = known[after] - known[after - 1] <= LONGEST_INTERPOLATION_S * NANOSECONDS
        return np.asarray(inside & (exact | near))

    @property
    def end_sigmas(self) -> tuple[float, float] | None:
        """Roots of the summed variances of the last position (m) and orientation (rad); None without covariances."""
        if self.covariances is None:
            return None
        variances = np.diag(self.covariances[-1])
        return float(np.sqrt(variances[3:].sum())), float(np.sqrt(variances[:3].sum()))

    def relative_to_first(self) -> Trajectory:
        """The same trajectory in the frame of its first pose (covariances are in body axes: kept)."""
        return Trajectory(self.stamps_ns, self.poses[0].inv() * self.poses, self.covariances)


NIS_DEGREES_OF_FREEDOM = 6
"""Of a pair: what its NIS is on average where all is modelled right."""


@dataclass(frozen=True, slots=True)
class EstimatorSeries:
    """What a back end estimated beside the poses, a row for each of N frames; NaN where it has nothing to say.

    stamps_ns (N,). In IMU axes: gyro_bias (N, 3) rad/s and accelerometer_bias (N, 3) m/s^2. Of the front end:
    scale_error (N,), by which its translations are too long (0.01 is 1 %), and rate_bias (N, 3) rad/s in camera axes,
    by which it turns too fast. *_std: standard deviations, of the same shapes. innovation (N, 6): what the pair that
    ends at the frame shows beyond what was predicted, rotation (rad) first, then translation (m), in the axes of the
    target camera; nis (N,): its square, normalised by its covariance, 6 on average where all is modelled right. used
    (N,): False where that pair was rejected.
    """

    stamps_ns: IntArray
    gyro_bias: FloatArray
    gyro_bias_std: FloatArray
    accelerometer_bias: FloatArray
    accelerometer_bias_std: FloatArray
    scale_error: FloatArray
    scale_error_std: FloatArray
    rate_bias: FloatArray
    rate_bias_std: FloatArray
    innovation: FloatArray
    nis: FloatArray
    used: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.stamps_ns)

    @property
    def nis_mean(self) -> float | None:
        """Mean NIS of the pairs that have one, rejected ones too; None without any."""
        known = self.nis[np.isfinite(self.nis)]
        return float(known.mean()) if len(known) else None

    @property
    def knows_imu(self) -> bool:
        """Whether it tells anything of an IMU."""
        return bool(np.any(np.isfinite(self.gyro_bias)))

    @classmethod
    def joined(cls, parts: Sequence[EstimatorSeries]) -> EstimatorSeries:
        """One series of the rows of at least one."""
        names = [each.name for each in fields(cls)]
        return cls(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in names})


@dataclass(frozen=True, slots=True)
class GnssFix:
    """A position on the WGS84 ellipsoid: degrees, degrees, metres; covariance (3, 3) m^2 in ENU."""

    stamp_ns: int
    latitude_deg: float
    longitude_deg: float
    altitude_m: float
    covariance: FloatArray | None = None
