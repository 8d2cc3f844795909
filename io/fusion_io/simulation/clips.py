"""Training clips: short journeys through fresh worlds, each with its own camera, IMU and faults.

Three of five clips are of KITTI's kind: a car's camera of 81 degrees, 1.65 m above the road, about
ten frames a second, stereo. The others are anything: another car, a hand, a drone; cameras of 60 to
110 degrees and any shape of image; other depth sensors.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation

from fusion_io.records import NANOSECONDS, CameraFrame, CameraInfo, FloatArray, ImuSeries, IntArray, Trajectory
from fusion_io.simulation import carriers, traffic
from fusion_io.simulation.carriers import FlightStyle, WalkStyle, fly, walk
from fusion_io.simulation.motion import (
    ROTATION_IMU_CAMERA_KITTI,
    DriveStyle,
    ImuModel,
    Motion,
    draw_dropouts,
    drive,
    imu_stamps,
    simulate_imu,
    without,
)
from fusion_io.simulation.photometry import ImageModel, Imager
from fusion_io.simulation.sensors import DepthSensor, Lidar, Stereo, TimeOfFlight
from fusion_io.simulation.street import Look, Route
from fusion_io.simulation.textures import Float32
from fusion_io.simulation.traffic import Mover
from fusion_io.simulation.world import World

IMU_MARGIN_S = 0.25  # of IMU samples before the first and after the last frame, on the IMU's clock
MOTION_MARGIN_S = 0.4  # of motion: more, by at least the time offset
KITTI_SHARE = 0.6
KITTI_FRAME_S = 0.1037
MAX_TIME_OFFSET_S = 0.065  # KITTI's
SOURCE_ASPECTS = (4 / 3, 4 / 3, 16 / 10, 16 / 9, 3 / 2, 2.0, 1242 / 375)  # width over height
LEAST_DEPTH = 0.15  # of the first frame: a sensor that sees less is replaced by stereo


def clip(
    seed: int, frames: int, width: int, height: int, exact_depth: bool = False
) -> tuple[list[CameraFrame], ImuSeries, Trajectory]:
    """A short journey through a fresh random world: frames, IMU, and ground truth at the frames' stamps.

    Everything is drawn from the seed: world, motion, camera, IMU and faults. Images are grey or RGB.
    The IMU covers at least 150 ms before the first to 150 ms after the last frame, but for samples
    that it dropped; a clip may have a gyro only: then the linear acceleration is NaN. The ground
    truth is exact, in a z-up world. exact_depth leaves the depth without noise and holes.
    """
    scene = Scene(seed, frames, width, height)
    sensor = None if exact_depth else scene.depth_sensor
    taken = []
    for i in range(frames):
        radiance, depth = scene.render(i)
        image = scene.imager.take(radiance, scene.angular_velocities[i])
        if sensor is not None:
            exact, depth = depth, sensor.measure(depth, image, scene.camera.K, scene.sensor_rng)
            if i == 0 and not isinstance(sensor, Stereo) and (depth > 0).mean() < LEAST_DEPTH:
                sensor = Stereo()
                depth = sensor.measure(exact, image, scene.camera.K, scene.sensor_rng)
        taken.append(CameraFrame(int(scene.trajectory.stamps_ns[i]), image, depth, scene.camera))
    return taken, scene.imu, scene.trajectory


class Scene:
    """All that is drawn for a clip, before anything is rendered.

    trajectory: of the camera at the frames' stamps; angular_velocities (N, 3) rad/s, camera axes.
    """

    def __init__(self, seed: int, frames: int, width: int, height: int) -> None:
        rng = np.random.default_rng([seed, 0])
        kitti_like = bool(rng.random() < KITTI_SHARE)
        carrier = "vehicle" if kitti_like else rng.choice(["vehicle", "hand", "drone"], p=[0.2, 0.45, 0.35])
        stamps = _frame_stamps(rng, frames, kitti_like)
        times = stamps / NANOSECONDS
        self._times = times
        journey = _journey(rng, carrier, kitti_like, times[0] - MOTION_MARGIN_S, times[-1] + MOTION_MARGIN_S)
        self.motion, self.carrier, self.kitti_like = journey.motion, carrier, kitti_like
        self.trajectory = Trajectory(stamps, self.motion.poses(times))
        self.angular_velocities = self.motion.angular_velocity(times)
        self._route, self._world_seed = journey.route, int(rng.integers(2**31))
        self.movers = self._draw_movers(rng)
        self.camera = (_kitti_camera if kitti_like else _any_camera)(rng, width, height)
        self._colour = bool(rng.random() < 0.3)
        self.depth_sensor = _depth_sensor(rng, carrier, kitti_like)
        self.imu = _imu(rng, self.motion, times, kitti_like)
        self.sensor_rng, image_rng = rng.spawn(2)
        self.imager = Imager(_image_model(rng, width, carrier), self.camera.K, image_rng)

    def _draw_movers(self, rng: np.random.Generator) -> list[Mover]:
        """None in every second scene, else up to three cars and two people."""
        cars, people = (0, 0) if rng.random() < 0.5 else rng.integers(0, [4, 3]).tolist()
        points = self.trajectory.poses.translation[:, :2]
        look = Look.of_world(self._world_seed)
        return traffic.draw_movers(rng, self._route, look, self._times, points, cars, people)

    @cached_property
    def _world(self) -> World:
        return World(self._world_seed, self._route, movers=self.movers)

    def render(self, index: int) -> tuple[Float32, Float32]:
        """Radiance and exact depth of a frame."""
        camera, time = self.camera, float(self._times[index])
        pose = self.trajectory.poses[index].as_matrix()
        return self._world.render(pose, camera.K, camera.width, camera.height, self._colour, time)


def _frame_stamps(rng: np.random.Generator, frames: int, kitti_like: bool) -> IntArray:
    """KITTI's frame interval, or anything from 5 to 30 Hz, with a little jitter."""
    interval = KITTI_FRAME_S if kitti_like else np.exp(rng.uniform(np.log(0.033), np.log(0.2)))
    jitter = rng.normal(0.0, 0.0005, frames).clip(-0.002, 0.002)
    return np.asarray(np.rint((1.0 + interval * np.arange(frames) + jitter) * NANOSECONDS), np.int64)


# ------------------------------------------------------------------------------------------------- motion


@dataclass(frozen=True, slots=True)
class _Journey:
    motion: Motion
    route: Route


def _journey(rng: np.random.Generator, carrier: str, kitti_like: bool, start_s: float, end_s: float) -> _Journey:
    """A motion from start to end, and the road that it happens on."""
    seed = int(rng.integers(2**31))
    if carrier == "vehicle":
        style = _drive_style(rng, kitti_like)
        motion = drive(seed, start_s, end_s, style)
        return _Journey(motion, Route(motion.sampled(), style.camera_height_m))
    motion = walk(seed, start_s, end_s, _walk_style(rng)) if carrier == "hand" else _flight(rng, seed, start_s, end_s)
    return _Journey(motion, carriers.road(seed, motion))


def _drive_style(rng: np.random.Generator, kitti_like: bool) -> DriveStyle:
    standing = rng.random() < 0.06
    return DriveStyle(
        speed_mps=0.0 if standing else rng.uniform(0.0, 20.0),
        speed_change_mps=0.0 if standing else rng.uniform(0.3, 3.0),
        yaw_rate=rng.choice([0.03, 0.12, 0.4]),
        shake=rng.uniform(0.3, 2.5),
        slope=rng.uniform(0.0, 0.02),
        camera_height_m=1.65 + rng.normal(0, 0.08) if kitti_like else rng.uniform(1.0, 2.4),
        camera_pitch_rad=rng.normal(0.0, np.deg2rad(1.5 if kitti_like else 4.0)),
        camera_roll_rad=rng.normal(0.0, np.deg2rad(0.7)),
        camera_yaw_rad=rng.normal(0.0, np.deg2rad(1.0 if kitti_like else 5.0)),
    )


def _walk_style(rng: np.random.Generator) -> WalkStyle:
    anywhere = rng.random() < 0.3
    return WalkStyle(
        speed_mps=rng.choice([0.0, rng.uniform(0.0, 2.0)], p=[0.1, 0.9]),
        heading_rad=rng.uniform(-np.pi, np.pi) if anywhere else rng.normal(0.0, 0.4),
        gaze_rad=rng.uniform(-np.pi, np.pi) if anywhere else rng.normal(0.0, 0.3),
        pitch_rad=rng.normal(0.12, 0.12),
        turn_rate=rng.choice([0.05, 0.2, 0.6]) * rng.uniform(0.5, 1.2),
        spin=rng.choice([0.0, rng.uniform(-1.2, 1.2)], p=[0.8, 0.2]),
        camera_height_m=rng.uniform(1.2, 1.9),
        offset_m=rng.uniform(-1.5, 1.5),
    )


def _flight(rng: np.random.Generator, seed: int, start_s: float, end_s: float) -> Motion:
    style = FlightStyle(
        speed_mps=rng.choice([0.0, rng.uniform(0.0, 12.0)], p=[0.1, 0.9]),
        heading_rad=rng.uniform(-np.pi, np.pi),
        climb_mps=rng.normal(0.0, 0.8),
        yaw_rad=rng.uniform(-np.pi, np.pi),
        pitch_rad=rng.uniform(0.0, 0.8),
        lean=rng.choice([0.0, 0.025]),
        turn_rate=rng.uniform(0.02, 0.3),
        spin=rng.choice([0.0, rng.uniform(-1.0, 1.0)], p=[0.7, 0.3]),
        height_m=np.exp(rng.uniform(np.log(1.2), np.log(15.0))),
        offset_m=rng.uniform(-1.5, 1.5),
    )
    return fly(seed, start_s, end_s, style)


# ------------------------------------------------------------------------------------------------- camera


def _kitti_camera(rng: np.random.Generator, width: int, height: int) -> CameraInfo:
    """About KITTI's 81 degrees, pixels not quite square as after resizing."""
    focal = _focal(width, rng.normal(81.0, 2.0))
    return _camera(rng, width, height, focal, focal * rng.uniform(0.8, 1.1))


def _any_camera(rng: np.random.Generator, width: int, height: int) -> CameraInfo:
    """60 to 110 degrees; an image of another shape, perhaps its lower part only, squeezed into the size."""
    focal = _focal(width, rng.uniform(60.0, 110.0))
    kept = rng.choice([1.0, rng.uniform(0.6, 1.0)])
    squeeze = rng.choice(SOURCE_ASPECTS) * height / width / kept
    return _camera(rng, width, height, focal, focal * squeeze)


def _focal(width: int, degrees: float) -> float:
    return float(0.5 * width / np.tan(np.deg2rad(0.5 * degrees)))


def _camera(rng: np.random.Generator, width: int, height: int, focal_x: float, focal_y: float) -> CameraInfo:
    """A camera whose principal point is off the centre."""
    centre_x = 0.5 * (width - 1) + width * rng.normal(0.0, 0.02)
    centre_y = 0.5 * (height - 1) + height * rng.normal(-0.02, 0.04)
    return CameraInfo(width, height, np.array([[focal_x, 0.0, centre_x], [0.0, focal_y, centre_y], [0.0, 0.0, 1.0]]))


def _image_model(rng: np.random.Generator, width: int, carrier: str) -> ImageModel:
    """Faults of a camera whose images were scaled down to ``width``: lens blur is small, noise averaged."""
    return ImageModel(
        brightness=float(np.exp(rng.normal(0.0, 0.25))),
        adaptation=rng.choice([0.0, rng.uniform(0.05, 0.6)]),
        wander=rng.choice([0.0, 0.01, 0.03]),
        step_probability=rng.choice([0.0, 0.08], p=[0.7, 0.3]),
        gamma=rng.choice([1.0, rng.uniform(0.5, 1.3)]),
        gamma_wander=rng.choice([0.0, 0.02, 0.05], p=[0.5, 0.3, 0.2]),
        read_noise=rng.uniform(0.2, 2.0),
        shot_noise=rng.uniform(0.0, 4.0),
        vignette=rng.choice([0.0, rng.uniform(0.0, 0.5)]),
        blur_px=rng.choice([0.0, rng.uniform(0.0, 0.5)]) * max(1.0, width / 480),
        exposure_s=rng.uniform(0.0, 0.015) if carrier == "vehicle" else rng.uniform(0.0, 0.02),
    )


def _depth_sensor(rng: np.random.Generator, carrier: str, kitti_like: bool) -> DepthSensor:
    """Mostly stereo; for others a LiDAR on cars and drones, a camera of short range in a hand."""
    if not kitti_like and rng.random() < (0.5 if carrier == "hand" else 0.4):
        if carrier == "hand":
            return TimeOfFlight(rng.uniform(5.0, 12.0), rng.uniform(0.0005, 0.003), rng.uniform(0.0, 0.1))
        if rng.random() < 0.6:
            return Lidar(dropout=rng.uniform(0.0, 0.15))
        top, bottom = np.deg2rad(rng.uniform(8.0, 15.0)), np.deg2rad(rng.uniform(-30.0, -20.0))
        return Lidar(32, top, bottom, np.deg2rad(0.2), rng.uniform(0.01, 0.03), rng.uniform(0.0, 0.15))
    return Stereo(
        rng.uniform(0.2, 0.5), rng.uniform(0.0, 4.0), rng.uniform(0.0, 0.06), rng.uniform(0.0, 0.015), rng.uniform(0, 1)
    )


# ---------------------------------------------------------------------------------------------------- IMU


def _imu(rng: np.random.Generator, motion: Motion, frame_times: FloatArray, kitti_like: bool) -> ImuSeries:
    """The IMU of a clip: of KITTI's kind, or of another rate and mounted anyhow."""
    mounting = Rotation.from_rotvec(rng.normal(0.0, np.deg2rad(1.5), 3)) * ROTATION_IMU_CAMERA_KITTI
    if rng.random() < (0.2 if kitti_like else 0.55):
        mounting = Rotation.from_quat(rng.standard_normal(4))
    usual = rng.random() < (0.8 if kitti_like else 0.3)
    rate = 100.0 if usual else float(np.exp(rng.uniform(np.log(50.0), np.log(400.0))))
    noise = float(np.exp(rng.uniform(np.log(0.1), np.log(2.0))))
    model = ImuModel(
        rotation_imu_camera=mounting,
        lever_arm=rng.normal(0.0, [0.3, 0.5, 0.7]),
        time_offset_s=rng.uniform(-MAX_TIME_OFFSET_S, MAX_TIME_OFFSET_S),
        gyro_bias=rng.normal(0.0, 0.003, 3),
        accelerometer_bias=rng.normal(0.0, 0.05, 3),
        gyro_noise=1e-4 * noise,
        accelerometer_noise=3e-3 * noise,
        gyro_scale_error=rng.choice([0.0, rng.uniform(-0.01, 0.01)], p=[0.6, 0.4]),
    )
    start = frame_times[0] - IMU_MARGIN_S + rng.uniform(0.0, 1.0 / rate)
    stamps = imu_stamps(start, frame_times[-1] + IMU_MARGIN_S, rate)
    imu = simulate_imu(motion, stamps, rate, model, int(rng.integers(2**31)))
    if rng.random() < 0.25:
        imu = without(imu, draw_dropouts(rng, stamps, rng.choice([0.0, 0.01, 0.05]), int(rng.integers(0, 3))))
    if rng.random() < 0.03:
        imu.linear_acceleration[:] = np.nan
    return imu
