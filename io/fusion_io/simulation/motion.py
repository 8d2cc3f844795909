"""How the camera moves, and what an IMU on it measures.

The world is z up. The camera's axes are the optical ones (x right, y down, z forward).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
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
        """Through N >= 2 poses T_world_camera at times_s (N,), increasing; below N = 6 of lower degree."""
        self.start_s, self.end_s = float(times_s[0]), float(times_s[-1])
        self._position = make_interp_spline(times_s, poses.translation, k=min(5, len(times_s) - 1))
        self._acceleration = self._position.derivative(2)
        self._rotation = RotationSpline(times_s, poses.rotation)

    def poses(self, times_s: FloatArray) -> RigidTransform:
        """T_world_camera at the times (N,)."""
        return RigidTransform.from_components(self._position(times_s), self._rotation(times_s))

    def sampled(self) -> RigidTransform:
        """The poses from start to end, every 50 ms or a little less."""
        return self.poses(np.linspace(self.start_s, self.end_s, int((self.end_s - self.start_s) / 0.05) + 2))

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
    """How an IMU is mounted and what is wrong with it.

    rotation_imu_camera: v_imu = R v_camera. lever_arm (3,): the IMU's place in camera axes, metres.
    time_offset_s: t_imu = t_camera + offset. Biases (3,) are constant, in IMU axes; the noise
    densities are in rad/s/sqrt(Hz) and m/s^2/sqrt(Hz). gyro_scale_error: the share by which the gyro
    shows too much. The defaults are those of a good MEMS unit.
    """

    rotation_imu_camera: Rotation = ROTATION_IMU_CAMERA_KITTI
    lever_arm: FloatArray = field(default_factory=lambda: np.zeros(3))
    time_offset_s: float = 0.0
    gyro_bias: FloatArray = field(default_factory=lambda: np.array([0.002, -0.003, 0.004]))
    accelerometer_bias: FloatArray = field(default_factory=lambda: np.array([0.03, -0.05, 0.04]))
    gyro_noise: float = 1e-4
    accelerometer_noise: float = 2e-3
    gyro_scale_error: float = 0.0


PERFECT_IMU = ImuModel(gyro_bias=np.zeros(3), accelerometer_bias=np.zeros(3), gyro_noise=0.0, accelerometer_noise=0.0)


def imu_stamps(start_s: float, end_s: float, rate_hz: float) -> IntArray:
    """Stamps (N,) in nanoseconds from start (included) to end, at a constant rate."""
    count = int(np.floor((end_s - start_s) * rate_hz)) + 1
    return np.rint((start_s + np.arange(count) / rate_hz) * NANOSECONDS).astype(np.int64)


def simulate_imu(motion: Motion, stamps_ns: IntArray, rate_hz: float, model: ImuModel, seed: int) -> ImuSeries:
    """What the IMU shows at stamps_ns (N,) of its own clock.

    The motion's clock is the camera's, in seconds. With gravity g the specific force at the lever
    arm l is R'(a - g) + w x (w x l) + w' x l in camera axes (rigid-body kinematics), then turned into
    the IMU's. A sample's noise has the standard deviation of the density times sqrt(rate).
    """
    rng = np.random.default_rng(seed)
    times = stamps_ns / NANOSECONDS - model.time_offset_s
    rate = motion.angular_velocity(times)
    force = motion.poses(times).rotation.inv().apply(motion.acceleration(times) - GRAVITY)
    if np.any(model.lever_arm):
        force += np.cross(rate, np.cross(rate, model.lever_arm))
        force += np.cross(motion.angular_acceleration(times), model.lever_arm)
    gyro_std, accelerometer_std = np.sqrt(rate_hz) * np.array([model.gyro_noise, model.accelerometer_noise])
    gyro_error, accelerometer_error = rng.standard_normal((2, len(times), 3))
    turn = model.rotation_imu_camera.apply
    return ImuSeries(
        stamps_ns,
        turn((1.0 + model.gyro_scale_error) * rate) + model.gyro_bias + gyro_std * gyro_error,
        turn(force) + model.accelerometer_bias + accelerometer_std * accelerometer_error,
        float(gyro_std),
        float(accelerometer_std),
    )


def without(imu: ImuSeries, dropped: NDArray[np.bool_]) -> ImuSeries:
    """The series less the samples that are marked (N,)."""
    return replace(
        imu,
        stamps_ns=imu.stamps_ns[~dropped],
        angular_velocity=imu.angular_velocity[~dropped],
        linear_acceleration=imu.linear_acceleration[~dropped],
    )


def draw_dropouts(rng: np.random.Generator, stamps_ns: IntArray, share: float, bursts: int) -> NDArray[np.bool_]:
    """Marks (N,) of samples to drop: single ones, ``share`` of all, and bursts of 20 to 150 ms. The ends stay."""
    dropped = rng.random(len(stamps_ns)) < share
    for start in rng.uniform(stamps_ns[0], stamps_ns[-1], bursts):
        dropped |= (stamps_ns >= start) & (stamps_ns < start + rng.uniform(0.02, 0.15) * NANOSECONDS)
    dropped[[0, -1]] = False
    return dropped


MAX_YAW_RATE = 0.5  # rad/s
MAX_LATERAL_ACCELERATION = 4.0  # m/s^2
CAMERA_AHEAD_METRES = 1.7  # of the rear axle, which is what follows the road
HILL_METRES = 120.0  # how long a rise or a fall of the road is
KNOT_SECONDS = 0.05


@dataclass(frozen=True, slots=True)
class DriveStyle:
    """The statistics of a drive; the defaults look like KITTI's residential streets.

    The speed wanders about speed_mps with a standard deviation of speed_change_mps; yaw_rate and
    slope are the standard deviations of the yaw rate in rad/s and of the road's gradient. shake is
    a factor on pitch, roll and heave of the car's body. The camera is mounted camera_height_m over
    the road, turned by pitch (downwards positive), roll and yaw.
    """

    speed_mps: float = 9.0
    speed_change_mps: float = 2.0
    yaw_rate: float = 0.12
    shake: float = 1.0
    slope: float = 0.01
    camera_height_m: float = 1.65
    camera_pitch_rad: float = 0.0
    camera_roll_rad: float = 0.0
    camera_yaw_rad: float = 0.0


def drive(seed: int, start_s: float, end_s: float, style: DriveStyle) -> Motion:
    """A car's drive from start_s to end_s, the rear axle beginning at the world's origin, heading along x.

    Speed and yaw rate wander; the yaw rate is bounded by MAX_YAW_RATE and by what the tyres hold.
    The body pitches, rolls and heaves, dives under braking, and follows the gradient of the road.
    """
    rng = np.random.default_rng(seed)
    count = max(int(np.ceil((end_s - start_s) / KNOT_SECONDS)) + 1, 6)
    times = np.asarray(start_s + KNOT_SECONDS * np.arange(count), np.float64)

    def wandering(period_s: float) -> FloatArray:
        return wander(rng, count, period_s / KNOT_SECONDS)

    speed = np.maximum(style.speed_mps + style.speed_change_mps * wandering(8.0), 0.0)
    speed = gaussian_filter1d(speed, 0.3 / KNOT_SECONDS, mode="nearest")  # stopping and starting takes time
    limit = np.minimum(MAX_YAW_RATE, MAX_LATERAL_ACCELERATION / np.maximum(speed, 1e-3))
    grip = np.minimum(speed / 2.0, 1.0)  # a standing car does not turn
    yaw_rate = grip * limit * np.tanh(style.yaw_rate * wandering(6.0) / limit)
    distance = integral(speed)
    hills = wander(rng, int(distance[-1]) + 2, HILL_METRES)  # metre by metre
    gradient = style.slope * np.interp(distance, np.arange(len(hills)), hills)

    yaw = integral(yaw_rate)
    axle = np.column_stack([integral(speed * np.cos(yaw)), integral(speed * np.sin(yaw)), integral(speed * gradient)])

    liveliness = style.shake * np.minimum(0.15 + speed / 8.0, 1.5)
    pitch, roll, heave = (
        liveliness * (slow * wandering(1.6) + fast * wandering(0.6))
        for slow, fast in ((0.006, 0.002), (0.007, 0.002), (0.012, 0.003))
    )
    dive = 0.003 * np.gradient(speed, KNOT_SECONDS)
    pitch -= gaussian_filter1d(gradient + dive, 0.2 / KNOT_SECONDS, mode="nearest")
    roll += 0.004 * yaw_rate * speed  # leaning out of the bend

    body = Rotation.from_euler("ZYX", np.column_stack([yaw, pitch, roll]))
    mounting = Rotation.from_euler("ZYX", [style.camera_yaw_rad, style.camera_pitch_rad, style.camera_roll_rad])
    positions = axle + body.apply([CAMERA_AHEAD_METRES, 0.0, style.camera_height_m])
    positions[:, 2] += heave
    return Motion(times, RigidTransform.from_components(positions, body * mounting * ROTATION_WORLD_CAMERA_LEVEL))


def wander(rng: np.random.Generator, count: int, period: float) -> FloatArray:
    """A smooth random signal (count,) of unit variance, whose features last about ``period`` steps."""
    sigma = 0.25 * period
    margin = int(4 * sigma) + 1
    white = rng.standard_normal(count + 2 * margin)
    smooth = gaussian_filter1d(white, sigma)[margin : margin + count]
    return np.asarray(smooth * np.sqrt(2.0 * np.sqrt(np.pi) * sigma), np.float64)


def integral(rate: FloatArray) -> FloatArray:
    """The integral from the first knot, by trapezoids."""
    return np.concatenate([[0.0], np.cumsum(0.5 * KNOT_SECONDS * (rate[1:] + rate[:-1]))])
