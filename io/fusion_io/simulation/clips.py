"""Training clips: short drives through fresh worlds, each with its own camera, IMU, and faults."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform, Rotation

from fusion_io.records import NANOSECONDS, CameraFrame, CameraInfo, FloatArray, ImuSeries, IntArray, Trajectory
from fusion_io.simulation.motion import ROTATION_IMU_CAMERA_KITTI, DriveStyle, ImuModel, Motion, drive, simulate_imu
from fusion_io.simulation.street import Path
from fusion_io.simulation.world import Float32, World

IMU_MARGIN_S = 0.25  # IMU samples before the first and after the last frame
KITTI_FRAME_S = 0.1037
KITTI_TIME_OFFSET_S = 0.065
MAX_DEPTH_M = 80.0
KITTI_BASELINE_M = 0.54


def path_of(motion: Motion, camera_height_m: float) -> Path:
    """The path of a motion."""
    times = np.linspace(motion.start_s, motion.end_s, int((motion.end_s - motion.start_s) / 0.05) + 2)
    return Path(motion.poses(times), camera_height_m)


def exposed(radiance: Float32, gain: float, offset: float = 0.0, noise: Float32 | None = None) -> NDArray[np.uint8]:
    """The image (uint8) of a radiance: a linear sensor that saturates."""
    signal = radiance * np.float32(255.0 * gain) + np.float32(offset)
    if noise is not None:
        signal = signal + noise
    return np.clip(np.rint(signal), 0, 255).astype(np.uint8)


def exposure(radiance: Float32) -> float:
    """The gain that an automatic exposure picks: the median at a bit below mid grey."""
    return 0.42 / float(np.median(radiance))


def stereo_depth(depth: Float32, focal_px: float, rng: np.random.Generator, noise_px: float) -> Float32:
    """Exact depth (H, W) as stereo would see it: noise growing with z^2, holes, nothing beyond 80 m.

    The noise is that of a disparity, noise_px pixels (of a camera of focal length focal_px) on a
    baseline of 0.54 m, in part common to neighbours as matching windows overlap. Holes are at the
    left of near things, where the other camera sees past them, and in blobs without texture.
    """
    height, width = depth.shape
    shared = cv2.resize(rng.standard_normal((height // 4 + 1, width // 4 + 1)).astype(np.float32), (width, height))
    grain = rng.standard_normal((height, width)).astype(np.float32)
    with np.errstate(divide="ignore"):
        disparity = np.float32(focal_px * KITTI_BASELINE_M) / depth
    noisy = disparity + np.float32(noise_px) * (0.8 * shared + 0.6 * grain)
    measured = np.where(noisy > 0, np.float32(focal_px * KITTI_BASELINE_M) / np.maximum(noisy, 1e-6), 0.0)
    valid = (depth > 0) & (measured > 0) & (measured < MAX_DEPTH_M)
    valid &= ~_occluded(disparity, focal_px)
    lattice = rng.standard_normal((max(height // 10, 2), max(width // 10, 2))).astype(np.float32)
    blobs = cv2.resize(lattice, (width, height), interpolation=cv2.INTER_CUBIC)
    valid &= blobs < rng.uniform(1.1, 2.5)
    return np.where(valid, measured, 0.0).astype(np.float32)


def _occluded(disparity: Float32, focal_px: float) -> NDArray[np.bool_]:
    """Pixels that the right camera cannot see: one further right in the row lands on or left of them."""
    finite = np.where(np.isfinite(disparity), disparity, 0.0)
    landing = np.arange(disparity.shape[1], dtype=np.float32) - finite
    to_the_right = np.minimum.accumulate(landing[:, ::-1], axis=1)[:, ::-1]
    return np.asarray(landing > to_the_right + 0.5)


def clip(
    seed: int, frames: int, width: int, height: int, exact_depth: bool = False
) -> tuple[list[CameraFrame], ImuSeries, Trajectory]:
    """A short drive through a fresh random world: frames, IMU, and ground truth at the frames' stamps.

    Everything is drawn from the seed: world, drive, camera, mounting and faults. Images are grey or
    RGB. The IMU covers at least 150 ms before the first to 150 ms after the last frame on the
    camera's clock. The ground truth is exact, in a z-up world. exact_depth leaves the depth without
    noise and holes.
    """
    rng = np.random.default_rng([seed, 0])
    stamps = _frame_stamps(rng, frames)
    times = stamps / NANOSECONDS
    style = _style(rng)
    start, end = times[0] - IMU_MARGIN_S - 0.2, times[-1] + IMU_MARGIN_S + 0.2
    motion = drive(int(rng.integers(2**31)), start, end, style)
    world = World(int(rng.integers(2**31)), path_of(motion, style.camera_height_m))
    camera = _camera(rng, width, height)
    trajectory = Trajectory(stamps, motion.poses(times))
    images = _Imager(rng, world, camera, exact_depth)
    taken = [images.take(int(stamp), pose.as_matrix()) for stamp, pose in zip(stamps, trajectory.poses, strict=True)]
    return taken, _imu(rng, motion, stamps), trajectory


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
        yaw_rate=rng.choice([0.02, 0.08, 0.35]),
        shake=rng.uniform(0.3, 2.5),
        slope=rng.uniform(0.0, 0.03),
        camera_height_m=1.65 + rng.normal(0, 0.08) if rng.random() < 0.7 else rng.uniform(1.0, 2.2),
        camera_pitch_rad=rng.normal(0.0, np.deg2rad(1.5)),
        camera_roll_rad=rng.normal(0.0, np.deg2rad(0.7)),
        camera_yaw_rad=rng.normal(0.0, np.deg2rad(1.0)),
    )


def _camera(rng: np.random.Generator, width: int, height: int) -> CameraInfo:
    """Mostly KITTI's 81 degrees, the principal point off centre, pixels not quite square as after resizing."""
    degrees = rng.normal(81.0, 2.0) if rng.random() < 0.6 else rng.uniform(60.0, 100.0)
    focal = 0.5 * width / np.tan(np.deg2rad(0.5 * degrees))
    K = np.array(
        [
            [focal, 0.0, 0.5 * (width - 1) + width * rng.normal(0.0, 0.02)],
            [0.0, focal * rng.uniform(0.8, 1.1), 0.5 * (height - 1) + height * rng.normal(-0.02, 0.04)],
            [0.0, 0.0, 1.0],
        ]
    )
    return CameraInfo(width, height, K)


class _Imager:
    """A camera with its faults: exposure that wanders, sensor noise, blur, depth like stereo's."""

    def __init__(self, rng: np.random.Generator, world: World, camera: CameraInfo, exact_depth: bool) -> None:
        self._rng, self._world, self._camera, self._exact_depth = rng, world, camera, exact_depth
        self._colour = bool(rng.random() < 0.3)
        self._noise = rng.uniform(0.3, 3.0)
        self._blur = rng.uniform(0.0, 0.5)
        self._contrast = float(np.exp(rng.normal(0.0, 0.25)))
        self._drift = rng.choice([0.0, 0.01, 0.03])
        self._depth_noise_px = rng.uniform(0.2, 0.5) * camera.width / 1242.0
        self._gain: float | None = None

    def take(self, stamp_ns: int, T_world_camera: FloatArray) -> CameraFrame:
        rng, camera = self._rng, self._camera
        radiance, depth = self._world.render(T_world_camera, camera.K, camera.width, camera.height, self._colour)
        if self._blur > 0.15:
            radiance = cv2.GaussianBlur(radiance, (3, 3), self._blur)
        if self._gain is None:  # set once: the wandering comes on top
            self._gain = exposure(radiance) * self._contrast
        gain = self._gain * (1.0 + self._drift * rng.standard_normal())
        noise = np.float32(self._noise) * rng.standard_normal(radiance.shape, np.float32)
        image = exposed(radiance, gain, 100.0 * self._drift * rng.standard_normal(), noise)
        if not self._exact_depth:
            depth = stereo_depth(depth, float(camera.K[0, 0]), rng, self._depth_noise_px)
        return CameraFrame(stamp_ns, image, depth, camera)


def _imu(rng: np.random.Generator, motion: Motion, stamps: IntArray) -> ImuSeries:
    """The IMU of a clip: mostly KITTI's kind, sometimes of another rate and mounted anyhow."""
    if rng.random() < 0.85:
        mounting = Rotation.from_rotvec(rng.normal(0.0, np.deg2rad(1.5), 3)) * ROTATION_IMU_CAMERA_KITTI
    else:
        mounting = Rotation.from_quat(rng.standard_normal(4))
    rate = 100.0 if rng.random() < 0.7 else np.exp(rng.uniform(np.log(50.0), np.log(400.0)))
    offset = rng.uniform(-KITTI_TIME_OFFSET_S, KITTI_TIME_OFFSET_S)
    noise = float(np.exp(rng.uniform(np.log(0.1), np.log(2.0))))
    model = ImuModel(
        rotation_imu_camera=mounting,
        lever_arm=rng.normal(0.0, [0.3, 0.5, 0.7]),
        time_offset_s=offset,
        gyro_bias=rng.normal(0.0, 0.003, 3),
        accelerometer_bias=rng.normal(0.0, 0.05, 3),
        gyro_std=1e-3 * noise * np.sqrt(rate / 100.0),
        accelerometer_std=3e-2 * noise * np.sqrt(rate / 100.0),
    )
    first, last = stamps[[0, -1]] / NANOSECONDS + offset + np.array([-1, 1]) * (IMU_MARGIN_S - 0.05)
    first, last = min(first, first - offset), max(last, last - offset)
    first, last = max(first, motion.start_s + offset), min(last, motion.end_s + offset)
    times = np.arange(first, last, 1.0 / rate) + rng.uniform(0, 1.0 / rate)
    times = times[times < last]
    return simulate_imu(motion, np.rint(times * NANOSECONDS).astype(np.int64), model, int(rng.integers(2**31)))
