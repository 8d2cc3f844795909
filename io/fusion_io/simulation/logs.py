"""Simulated recordings: a drive of its own, or along a given trajectory, through a street."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from fusion_io import kitti, trajectory_files
from fusion_io.errors import LogError
from fusion_io.recording import Recording, between
from fusion_io.records import NANOSECONDS, CameraFrame, CameraInfo, FloatArray, ImuSeries, IntArray, Trajectory
from fusion_io.simulation.motion import DriveStyle, ImuModel, Motion, drive, imu_stamps, simulate_imu
from fusion_io.simulation.street import Route
from fusion_io.simulation.world import World, exposed, exposure

START_S = 1.0  # the first frame's stamp: IMU samples before it have stamps above zero
IMU_MARGIN_S = 0.25  # of IMU samples before the first and after the last frame of a drive
CAMERA_HEIGHT_M = DriveStyle().camera_height_m
MAX_DEPTH_M = 80.0


@dataclass(frozen=True, slots=True)
class Setup:
    """What is simulated, whatever the trajectory. rotation_imu_camera: v_imu = R v_camera."""

    seed: int = 0
    width: int = 480
    height: int = 128
    fov_deg: float = 81.0
    colour: bool = False
    imu_rate_hz: float = 100.0
    imu: ImuModel = field(default_factory=ImuModel)

    def camera(self) -> CameraInfo:
        """The pinhole camera: square pixels, the principal point in the middle."""
        focal = 0.5 * self.width / np.tan(np.deg2rad(0.5 * self.fov_deg))
        K = np.array([[focal, 0.0, 0.5 * (self.width - 1)], [0.0, focal, 0.5 * (self.height - 1)], [0.0, 0.0, 1.0]])
        return CameraInfo(self.width, self.height, K)


def simulate_drive(setup: Setup, seconds: float, frame_rate_hz: float) -> Recording:
    """A drive with frames over [0, seconds), an IMU with bias and noise, and exact ground truth.

    The world of the ground truth is the first camera frame.
    """
    count = max(int(np.ceil(seconds * frame_rate_hz - 1e-9)), 1)
    times = START_S + np.arange(count) / frame_rate_hz
    stamps = np.rint(times * NANOSECONDS).astype(np.int64)
    start, end = times[0] - IMU_MARGIN_S, times[-1] + IMU_MARGIN_S
    motion = drive(setup.seed, start, end, DriveStyle())
    imu = simulate_imu(motion, imu_stamps(start, end, setup.imu_rate_hz), setup.imu_rate_hz, setup.imu, setup.seed)
    poses = motion.poses(stamps / NANOSECONDS)
    truth = Trajectory(stamps, poses).relative_to_first()
    return _recording(setup, stamps, poses, Route(motion.sampled(), CAMERA_HEIGHT_M), truth, imu)


def simulate_along(
    setup: Setup, poses_file: Path, times_file: Path | None, imu_file: Path | None, seconds: float | None
) -> Recording:
    """Frames along a trajectory from a file (KITTI's format, or TUM's), which is the ground truth.

    The IMU is the real one if its file is given, else simulated along a smooth curve through the
    poses. That curve follows whatever jitter the poses have: on KITTI's it shows accelerations of
    1 to 3 m/s^2 (standard deviation) that the real car did not have. seconds: how much of the
    trajectory; all of it if None.
    """
    stamps = None if times_file is None else trajectory_files.read_times(times_file)
    trajectory = trajectory_files.read_trajectory(poses_file, stamps)
    if len(trajectory) < 2:
        raise LogError(f"{poses_file}: a drive needs two poses or more")
    end_ns = int(trajectory.stamps_ns[-1] if seconds is None else trajectory.stamps_ns[0] + seconds * NANOSECONDS)
    chosen = int(np.searchsorted(trajectory.stamps_ns, end_ns, side="right" if seconds is None else "left"))
    levelled = _levelled(trajectory.poses)
    route = Route(levelled, CAMERA_HEIGHT_M)  # the whole one: its look must not depend on how much is driven
    truth = Trajectory(trajectory.stamps_ns[:chosen], trajectory.poses[:chosen])
    first_ns, last_ns = int(truth.stamps_ns[0]), int(truth.stamps_ns[-1])
    if imu_file is not None and stamps is not None:
        imu = between(kitti.read_imu_mat(imu_file, stamps), first_ns, last_ns)
    else:
        motion = Motion(trajectory.stamps_ns / NANOSECONDS, levelled)
        times = imu_stamps(first_ns / NANOSECONDS, last_ns / NANOSECONDS, setup.imu_rate_hz)
        imu = simulate_imu(motion, times, setup.imu_rate_hz, setup.imu, setup.seed)
    return _recording(setup, truth.stamps_ns, levelled[:chosen], route, truth, imu)


def _levelled(poses: RigidTransform) -> RigidTransform:
    """The trajectory in a z-up world, the first camera above its origin.

    A car's camera is level on average, so up is the mean of its upward axes.
    """
    up = -poses.rotation.apply([0.0, 1.0, 0.0]).mean(axis=0)
    up /= np.linalg.norm(up)
    forward = poses[0].rotation.apply([0.0, 0.0, 1.0])
    forward -= (forward @ up) * up
    forward /= np.linalg.norm(forward)
    turn = Rotation.from_matrix(np.stack([forward, np.cross(up, forward), up]))
    start = [0.0, 0.0, CAMERA_HEIGHT_M] - turn.apply(poses[0].translation)
    return RigidTransform.from_components(start, turn) * poses


def _recording(
    setup: Setup, stamps: IntArray, poses: RigidTransform, route: Route, truth: Trajectory, imu: ImuSeries
) -> Recording:
    world = World(setup.seed, route)
    return Recording(
        frames=_frames(setup, world, stamps, poses.as_matrix()),
        frame_count=len(stamps),
        imu=imu,
        ground_truth=truth,
    )


def _frames(setup: Setup, world: World, stamps: IntArray, poses: FloatArray) -> Iterator[CameraFrame]:
    """The frames, rendered one by one; depth is exact, and 0 beyond 80 m."""
    camera = setup.camera()
    rng = np.random.default_rng([setup.seed, 4])
    gain = None
    for stamp, pose in zip(stamps, poses, strict=True):
        radiance, depth = world.render(pose, camera.K, camera.width, camera.height, setup.colour)
        gain = exposure(radiance) if gain is None else gain
        noise = rng.standard_normal(radiance.shape, np.float32)  # one grey level
        depth[depth > MAX_DEPTH_M] = 0.0
        yield CameraFrame(int(stamp), exposed(radiance, gain, noise), depth, camera)
