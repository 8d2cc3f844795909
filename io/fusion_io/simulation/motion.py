"""How the camera moves, and what an IMU on it measures.

The world is z up. The camera's axes are the optical ones (x right, y down, z forward).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.interpolate import make_interp_spline
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import RigidTransform, Rotation, RotationSpline

from fusion_io.records import NANOSECONDS, FloatArray, ImuSeries, IntArray

GRAVITY = np.array([0.0, 0.0, -9.81])  # m/s^2, world axes

# Columns: the camera's x (right), y (down), z (forward) for a level camera that looks along world x.
ROTATION_WORLD_CAMERA_LEVEL = Rotation.from_matrix([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])

# v_imu = R v_camera for KITTI's kind of mounting: IMU x forward, y left, z up.
ROTATION_IMU_CAMERA_KITTI = ROTATION_WORLD_CAMERA_LEVEL


class Motion:
    """A smooth path of the camera through given poses: twice differentiable, so an IMU can be simulated.

    Positions are a quintic spline, rotations scipy's cubic rotation spline; rates and accelerations
    are their derivatives, so that they integrate to exactly these poses.
    """

    def __init__(self, times_s: FloatArray, poses: RigidTransform) -> None:
        """times_s (N,) increasing, N >= 6; poses N transforms T_world_camera."""
        self.start_s, self.end_s = float(times_s[0]), float(times_s[-1])
        self._position = make_interp_spline(times_s, poses.translation, k=5)
        self._acceleration = self._position.derivative(2)
        self._rotation = RotationSpline(times_s, poses.rotation)

    def poses(self, times_s: FloatArray) -> RigidTransform:
        """T_world_camera at the times (N,)."""
        return RigidTransform.from_components(self._position(times_s), self._rotation(times_s))

    def angular_velocity(self, times_s: FloatArray) -> FloatArray:
        """(N, 3) rad/s, camera axes."""
        return np.asarray(self._rotation(times_s, 1))

    def angular_acceleration(self, times_s: FloatArray) -> FloatArray:
        """(N, 3) rad/s^2, camera axes."""
        return np.asarray(self._rotation(times_s, 2))

    def acceleration(self, times_s: FloatArray) -> FloatArray:
        """(N, 3) m/s^2, world axes, gravity not included."""
        return np.asarray(self._acceleration(times_s))


@dataclass(frozen=True, slots=True)
class ImuModel:
    """How the IMU is mounted and what is wrong with it.

    rotation_imu_camera: v_imu = R v_camera. lever_arm: the IMU's place in camera axes, metres.
    time_offset_s: t_imu = t_camera + offset. Biases (3,) in IMU axes; the standard deviations are
    those of a sample. The defaults are a good MEMS unit at 100 Hz: the noise densities are
    1e-4 rad/s/sqrt(Hz) and 2e-3 m/s^2/sqrt(Hz), times sqrt(100).
    """

    rotation_imu_camera: Rotation = ROTATION_IMU_CAMERA_KITTI
    lever_arm: FloatArray = field(default_factory=lambda: np.zeros(3))
    time_offset_s: float = 0.0
    gyro_bias: FloatArray = field(default_factory=lambda: np.array([0.002, -0.003, 0.004]))
    accelerometer_bias: FloatArray = field(default_factory=lambda: np.array([0.03, -0.05, 0.04]))
    gyro_std: float = 1e-3
    accelerometer_std: float = 2e-2


PERFECT_IMU = ImuModel(gyro_bias=np.zeros(3), accelerometer_bias=np.zeros(3), gyro_std=0.0, accelerometer_std=0.0)


def simulate_imu(motion: Motion, stamps_ns: IntArray, model: ImuModel, seed: int) -> ImuSeries:
    """What the IMU shows at stamps_ns (N,) on its own clock; the motion's time is the stamp in seconds less the offset.

    The specific force at the lever arm l is R' (a - g) + w x (w x l) + w' x l in camera axes
    (rigid-body kinematics), then rotated into the IMU's.
    """
    rng = np.random.default_rng(seed)
    times = stamps_ns / NANOSECONDS - model.time_offset_s
    rate = motion.angular_velocity(times)
    force = motion.poses(times).rotation.inv().apply(motion.acceleration(times) - GRAVITY)
    if np.any(model.lever_arm):
        force += np.cross(rate, np.cross(rate, model.lever_arm))
        force += np.cross(motion.angular_acceleration(times), model.lever_arm)
    mounting = model.rotation_imu_camera
    gyro_noise, accelerometer_noise = rng.standard_normal((2, len(times), 3))
    return ImuSeries(
        stamps_ns,
        mounting.apply(rate) + model.gyro_bias + model.gyro_std * gyro_noise,
        mounting.apply(force) + model.accelerometer_bias + model.accelerometer_std * accelerometer_noise,
        model.gyro_std,
        model.accelerometer_std,
    )


@dataclass(frozen=True, slots=True)
class DriveStyle:
    """The statistics of a drive.

    speed_mps: the speed it wanders about. speed_change: standard deviation of the wandering in m/s.
    yaw_rate: standard deviation in rad/s. shake: a factor on pitch, roll and heave of the car's
    body. slope: standard deviation of the road's gradient. camera_height_m over the road,
    camera_pitch_rad (downwards positive), camera_roll_rad and camera_yaw_rad of the mounting.
    """

    speed_mps: float = 9.0
    speed_change_mps: float = 2.0
    yaw_rate: float = 0.08
    shake: float = 1.0
    slope: float = 0.015
    camera_height_m: float = 1.65
    camera_pitch_rad: float = 0.0
    camera_roll_rad: float = 0.0
    camera_yaw_rad: float = 0.0


MAX_YAW_RATE = 0.35  # rad/s
MAX_LATERAL_ACCELERATION = 4.0  # m/s^2
KNOT_SECONDS = 0.05


def _wander(rng: np.random.Generator, count: int, period_s: float) -> FloatArray:
    """A smooth random signal (count,) at the knots with unit variance, whose features last about period_s."""
    sigma = 0.25 * period_s / KNOT_SECONDS
    margin = int(4 * sigma) + 1
    white = rng.standard_normal(count + 2 * margin)
    smooth = gaussian_filter1d(white, sigma, mode="nearest")[margin : margin + count]
    return np.asarray(smooth * np.sqrt(2.0 * np.sqrt(np.pi) * sigma))


def drive(seed: int, start_s: float, end_s: float, style: DriveStyle) -> Motion:
    """A car's drive from start_s to end_s, beginning at the world's origin and heading along x.

    Speed and yaw rate wander; the yaw rate is bounded by the tyres (lateral acceleration) and by
    MAX_YAW_RATE. The body pitches, rolls and heaves by a fraction of a degree and of a decimetre,
    dives under braking, and follows the gradient of the road.
    """
    rng = np.random.default_rng(seed)
    count = int(np.ceil((end_s - start_s) / KNOT_SECONDS)) + 1
    times = start_s + KNOT_SECONDS * np.arange(count)

    speed = np.maximum(style.speed_mps + style.speed_change_mps * _wander(rng, count, 8.0), 0.0)
    speed = gaussian_filter1d(speed, 0.3 / KNOT_SECONDS, mode="nearest") if speed.any() else speed
    limit = np.minimum(MAX_YAW_RATE, MAX_LATERAL_ACCELERATION / np.maximum(speed, 1e-3))
    grip = np.minimum(speed / 2.0, 1.0)  # a standing car does not turn
    yaw_rate = grip * limit * np.tanh(style.yaw_rate * _wander(rng, count, 6.0) / limit)
    gradient = style.slope * _wander(rng, count, 12.0)

    yaw = _integrate(yaw_rate)
    x, y = _integrate(speed * np.cos(yaw)), _integrate(speed * np.sin(yaw))
    road_height = _integrate(speed * gradient)
    acceleration = np.gradient(speed, KNOT_SECONDS)

    liveliness = style.shake * np.minimum(0.15 + speed / 8.0, 1.5)
    pitch = liveliness * (0.004 * _wander(rng, count, 1.6) + 0.0015 * _wander(rng, count, 0.6))
    roll = liveliness * (0.005 * _wander(rng, count, 2.0) + 0.0015 * _wander(rng, count, 0.6))
    heave = liveliness * (0.015 * _wander(rng, count, 1.6) + 0.003 * _wander(rng, count, 0.6))
    body_pitch = gaussian_filter1d(-gradient - 0.003 * acceleration, 0.2 / KNOT_SECONDS, mode="nearest") + pitch
    body_roll = roll + 0.004 * yaw_rate * speed

    body = Rotation.from_euler("ZYX", np.column_stack([yaw, body_pitch, body_roll]))
    mounting = Rotation.from_euler("ZYX", [style.camera_yaw_rad, style.camera_pitch_rad, style.camera_roll_rad])
    positions = np.column_stack([x, y, road_height + style.camera_height_m + heave])
    return Motion(times, RigidTransform.from_components(positions, body * mounting * ROTATION_WORLD_CAMERA_LEVEL))


def _integrate(rate: FloatArray) -> FloatArray:
    """The integral from the first knot, by trapezoids."""
    return np.concatenate([[0.0], np.cumsum(0.5 * KNOT_SECONDS * (rate[1:] + rate[:-1]))])
