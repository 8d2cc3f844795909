"""Training clips: short drives through fresh worlds, each with its own camera, IMU and faults."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fusion_io.records import NANOSECONDS, CameraFrame, CameraInfo, FloatArray, ImuSeries, IntArray, Trajectory
from fusion_io.simulation.motion import (
    ROTATION_IMU_CAMERA_KITTI,
    DriveStyle,
    ImuModel,
    Motion,
    drive,
    imu_stamps,
    simulate_imu,
)
from fusion_io.simulation.street import Route
from fusion_io.simulation.textures import Float32
from fusion_io.simulation.world import World, exposed, exposure

IMU_MARGIN_S = 0.25  # of IMU samples before the first and after the last frame, on the IMU's clock
MOTION_MARGIN_S = 0.4  # of motion: more, by at least the time offset
KITTI_FRAME_S = 0.1037
KITTI_TIME_OFFSET_S = 0.065
KITTI_BASELINE_M = 0.54
KITTI_WIDTH = 1242
MAX_DEPTH_M = 80.0


def clip(
    seed: int, frames: int, width: int, height: int, exact_depth: bool = False
) -> tuple[list[CameraFrame], ImuSeries, Trajectory]:
    """A short drive through a fresh random world: frames, IMU, and ground truth at the frames' stamps.

    Everything is drawn from the seed: world, drive, camera, IMU and faults. Images are grey or RGB.
    The IMU covers at least 150 ms before the first to 150 ms after the last frame. The ground truth
    is exact, in a z-up world. exact_depth leaves the depth without noise and holes.
    """
    rng = np.random.default_rng([seed, 0])
    stamps = _frame_stamps(rng, frames)
    times = stamps / NANOSECONDS
    style = _style(rng)
    motion = drive(int(rng.integers(2**31)), times[0] - MOTION_MARGIN_S, times[-1] + MOTION_MARGIN_S, style)
    world = World(int(rng.integers(2**31)), Route(motion.sampled(), style.camera_height_m))
    imager = _Imager(rng, world, _camera(rng, width, height), exact_depth)
    trajectory = Trajectory(stamps, motion.poses(times))
    taken = [imager.take(int(stamp), pose) for stamp, pose in zip(stamps, trajectory.poses.as_matrix(), strict=True)]
    return taken, _imu(rng, motion, times), trajectory


def _frame_stamps(rng: np.random.Generator, frames: int) -> IntArray:
    """Mostly KITTI's frame interval, else anything from 5 to 30 Hz, with a little jitter."""
    interval = KITTI_FRAME_S if rng.random() < 0.7 else np.exp(rng.uniform(np.log(0.033), np.log(0.2)))
    jitter = rng.normal(0.0, 0.0005, frames).clip(-0.002, 0.002)
    return np.asarray(np.rint((1.0 + interval * np.arange(frames) + jitter) * NANOSECONDS), np.int64)


def _style(rng: np.random.Generator) -> DriveStyle:
    standing = rng.random() < 0.06
    return DriveStyle(
        speed_mps=0.0 if standing else rng.uniform(0.0, 20.0),
        speed_change_mps=0.0 if standing else rng.uniform(0.3, 3.0),
        yaw_rate=rng.choice([0.03, 0.12, 0.4]),
        shake=rng.uniform(0.3, 2.5),
        slope=rng.uniform(0.0, 0.02),
        camera_height_m=1.65 + rng.normal(0, 0.08) if rng.random() < 0.7 else rng.uniform(1.0, 2.2),
        camera_pitch_rad=rng.normal(0.0, np.deg2rad(1.5)),
        camera_roll_rad=rng.normal(0.0, np.deg2rad(0.7)),
        camera_yaw_rad=rng.normal(0.0, np.deg2rad(1.0)),
    )


def _camera(rng: np.random.Generator, width: int, height: int) -> CameraInfo:
    """Mostly KITTI's 81 degrees, the principal point off centre, pixels not quite square as after resizing."""
    degrees = rng.normal(81.0, 2.0) if rng.random() < 0.6 else rng.uniform(60.0, 100.0)
    focal = 0.5 * width / np.tan(np.deg2rad(0.5 * degrees))
    centre_x = 0.5 * (width - 1) + width * rng.normal(0.0, 0.02)
    centre_y = 0.5 * (height - 1) + height * rng.normal(-0.02, 0.04)
    K = np.array([[focal, 0.0, centre_x], [0.0, focal * rng.uniform(0.8, 1.1), centre_y], [0.0, 0.0, 1.0]])
    return CameraInfo(width, height, K)


class _Imager:
    """A camera with its faults: exposure that wanders, noise, blur, and depth as stereo would see it."""

    def __init__(self, rng: np.random.Generator, world: World, camera: CameraInfo, exact_depth: bool) -> None:
        self._rng, self._world, self._camera, self._exact_depth = rng, world, camera, exact_depth
        self._colour = bool(rng.random() < 0.3)
        self._noise = np.float32(rng.uniform(0.3, 3.0))  # grey levels
        self._blur = rng.uniform(0.0, 0.5)  # pixels
        self._contrast = float(np.exp(rng.normal(0.0, 0.25)))
        self._wander = rng.choice([0.0, 0.01, 0.03])
        self._disparity_noise_px = rng.uniform(0.2, 0.5) * camera.width / KITTI_WIDTH
        self._gain: float | None = None

    def take(self, stamp_ns: int, T_world_camera: FloatArray) -> CameraFrame:
        """The frame at a pose (4, 4)."""
        rng, camera = self._rng, self._camera
        radiance, depth = self._world.render(T_world_camera, camera.K, camera.width, camera.height, self._colour)
        if self._blur > 0.15:  # less is nothing
            radiance = np.asarray(cv2.GaussianBlur(radiance, (3, 3), self._blur), np.float32)
        if self._gain is None:  # automatic exposure settles once; what it does later is the wandering
            self._gain = exposure(radiance) * self._contrast
        gain = self._gain * (1.0 + self._wander * rng.standard_normal())
        noise = self._noise * rng.standard_normal(radiance.shape, np.float32)
        image = exposed(radiance, gain, noise + np.float32(100.0 * self._wander * rng.standard_normal()))
        if not self._exact_depth:
            depth = stereo_depth(depth, float(camera.K[0, 0]), self._disparity_noise_px, rng)
        return CameraFrame(stamp_ns, image, depth, camera)


def stereo_depth(depth: Float32, focal_px: float, noise_px: float, rng: np.random.Generator) -> Float32:
    """Exact depth (H, W) as stereo on KITTI's baseline would see it.

    The noise is that of a disparity, so it grows with z^2; part of it is common to neighbours, as
    matching windows overlap. There are holes (0) where the right camera cannot see, in blobs where
    nothing matches, and beyond 80 m.
    """
    height, width = depth.shape
    coarse = rng.standard_normal((height // 4 + 1, width // 4 + 1)).astype(np.float32)
    noise = 0.8 * cv2.resize(coarse, (width, height)) + 0.6 * rng.standard_normal((height, width), np.float32)
    scale = np.float32(focal_px * KITTI_BASELINE_M)
    disparity = np.zeros_like(depth)
    np.divide(scale, depth, out=disparity, where=depth > 0)
    noisy = disparity + np.float32(noise_px) * noise
    matched = cv2.resize(
        rng.standard_normal((max(height // 10, 2), max(width // 10, 2))).astype(np.float32),
        (width, height),
        interpolation=cv2.INTER_CUBIC,
    ) < rng.uniform(1.1, 2.5)
    valid = (depth > 0) & (noisy > scale / MAX_DEPTH_M) & matched & ~_occluded(disparity)
    return np.asarray(np.divide(scale, noisy, out=np.zeros_like(depth), where=valid))


def _occluded(disparity: Float32) -> NDArray[np.bool_]:
    """Pixels that the right camera cannot see: one further right in the row lands further left than they do."""
    landing = np.arange(disparity.shape[1], dtype=np.float32) - disparity
    to_the_right = np.minimum.accumulate(landing[:, ::-1], axis=1)[:, ::-1]
    return np.asarray(landing > to_the_right + 0.5)


def _imu(rng: np.random.Generator, motion: Motion, frame_times: FloatArray) -> ImuSeries:
    """The IMU of a clip: mostly of KITTI's kind, sometimes of another rate and mounted anyhow."""
    if rng.random() < 0.85:
        mounting = Rotation.from_rotvec(rng.normal(0.0, np.deg2rad(1.5), 3)) * ROTATION_IMU_CAMERA_KITTI
    else:
        mounting = Rotation.from_quat(rng.standard_normal(4))
    rate = 100.0 if rng.random() < 0.7 else float(np.exp(rng.uniform(np.log(50.0), np.log(400.0))))
    noise = float(np.exp(rng.uniform(np.log(0.1), np.log(2.0))))
    model = ImuModel(
        rotation_imu_camera=mounting,
        lever_arm=rng.normal(0.0, [0.3, 0.5, 0.7]),
        time_offset_s=rng.uniform(-KITTI_TIME_OFFSET_S, KITTI_TIME_OFFSET_S),
        gyro_bias=rng.normal(0.0, 0.003, 3),
        accelerometer_bias=rng.normal(0.0, 0.05, 3),
        gyro_noise=1e-4 * noise,
        accelerometer_noise=3e-3 * noise,
    )
    start = frame_times[0] - IMU_MARGIN_S + rng.uniform(0.0, 1.0 / rate)
    stamps = imu_stamps(start, frame_times[-1] + IMU_MARGIN_S, rate)
    return simulate_imu(motion, stamps, rate, model, int(rng.integers(2**31)))
