"""Simulated recordings: a journey of its own, or along a given trajectory, through a street."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from enum import StrEnum
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from fusion_io import kitti, trajectory_files
from fusion_io.errors import LogError
from fusion_io.gnss import Receiver, fixes_at
from fusion_io.recording import Recording, between
from fusion_io.records import NANOSECONDS, CameraFrame, CameraInfo, FloatArray, ImuSeries, IntArray, Trajectory
from fusion_io.simulation import traffic
from fusion_io.simulation.carriers import FlightStyle, WalkStyle, fly, road, walk
from fusion_io.simulation.motion import (
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
from fusion_io.simulation.sensors import MAX_DEPTH_M, DepthSensor
from fusion_io.simulation.street import Look, Route
from fusion_io.simulation.traffic import Mover
from fusion_io.simulation.world import World

START_S = 1.0  # the first frame's stamp: IMU samples before it have stamps above zero
IMU_MARGIN_S = 0.25  # of IMU samples before the first and after the last frame of a drive
CAMERA_HEIGHT_M = DriveStyle().camera_height_m
BURST_EVERY_S = 10.0
CAR_ATTEMPTS = 10
ANTENNA_IN_CAMERA = np.array([0.3, -0.5, -1.0])  # m
ORIGIN = (49.0, 8.4, 115.0)  # of the street, which lies east, north, up about it: degrees, degrees, metres


class Carrier(StrEnum):
    """What carries the camera."""

    VEHICLE = "vehicle"
    HANDHELD = "handheld"
    DRONE = "drone"


@dataclass(frozen=True, slots=True)
class Setup:
    """What is simulated, whatever the trajectory.

    depth_sensor: None gives the exact depth. moving_cars: how many are to come near the camera on
    its way. imu_dropout: share of IMU samples that are lost, singly; with any there is also a
    burst every ten seconds. gnss: what receives satellites, if anything does.
    """

    seed: int = 0
    width: int = 480
    height: int = 128
    fov_deg: float = 81.0
    colour: bool = False
    image_model: ImageModel = field(default_factory=ImageModel)
    depth_sensor: DepthSensor | None = None
    moving_cars: int = 0
    imu_rate_hz: float = 100.0
    imu: ImuModel = field(default_factory=ImuModel)
    imu_dropout: float = 0.0
    gnss: Receiver | None = None

    def camera(self) -> CameraInfo:
        """The pinhole camera: square pixels, the principal point in the middle."""
        focal = 0.5 * self.width / np.tan(np.deg2rad(0.5 * self.fov_deg))
        K = np.array([[focal, 0.0, 0.5 * (self.width - 1)], [0.0, focal, 0.5 * (self.height - 1)], [0.0, 0.0, 1.0]])
        return CameraInfo(self.width, self.height, K)

    def simulated_imu(self, motion: Motion, start_s: float, end_s: float) -> ImuSeries:
        """The IMU's samples from start to end of its own clock, less those that it drops."""
        stamps = imu_stamps(start_s, end_s, self.imu_rate_hz)
        return self.with_dropouts(simulate_imu(motion, stamps, self.imu_rate_hz, self.imu, self.seed))

    def with_dropouts(self, imu: ImuSeries) -> ImuSeries:
        """The series less what is dropped."""
        if self.imu_dropout == 0:
            return imu
        bursts = round((imu.stamps_ns[-1] - imu.stamps_ns[0]) / (BURST_EVERY_S * NANOSECONDS))
        rng = np.random.default_rng([self.seed, 6])
        return without(imu, draw_dropouts(rng, imu.stamps_ns, self.imu_dropout, bursts))


def simulate_drive(setup: Setup, seconds: float, frame_rate_hz: float, carrier: Carrier = Carrier.VEHICLE) -> Recording:
    """A journey with frames over [0, seconds), an IMU with bias and noise, and exact ground truth.

    The world of the ground truth is the first camera frame.
    """
    count = max(int(np.ceil(seconds * frame_rate_hz - 1e-9)), 1)
    times = START_S + np.arange(count) / frame_rate_hz
    stamps = np.rint(times * NANOSECONDS).astype(np.int64)
    start, end = times[0] - IMU_MARGIN_S, times[-1] + IMU_MARGIN_S
    margin = abs(setup.imu.time_offset_s)
    motion, route = _journey(setup.seed, start - margin, end + margin, carrier)
    truth = Trajectory(stamps, motion.poses(stamps / NANOSECONDS)).relative_to_first()
    imu = setup.simulated_imu(motion, start, end)
    return _recording(setup, stamps, motion.poses(stamps / NANOSECONDS), route, truth, imu)


def _journey(seed: int, start_s: float, end_s: float, carrier: Carrier) -> tuple[Motion, Route]:
    """The motion of a carrier in its default style, and its road."""
    if carrier == Carrier.VEHICLE:
        motion = drive(seed, start_s, end_s, DriveStyle())
        return motion, Route(motion.sampled(), CAMERA_HEIGHT_M)
    if carrier == Carrier.HANDHELD:
        motion = walk(seed, start_s, end_s, WalkStyle())
    else:
        motion = fly(seed, start_s, end_s, FlightStyle())
    return motion, road(seed, motion)


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
        imu = setup.with_dropouts(between(kitti.read_imu_mat(imu_file, stamps), first_ns, last_ns))
    else:
        motion = Motion(trajectory.stamps_ns / NANOSECONDS, levelled)
        offset = setup.imu.time_offset_s  # nothing is known of the motion before its first pose and after its last
        imu = setup.simulated_imu(
            motion, first_ns / NANOSECONDS + max(offset, 0.0), last_ns / NANOSECONDS + min(offset, 0.0)
        )
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
    look = Look.of_world(setup.seed)
    world = World(setup.seed, route, look, _cars(setup, route, look, stamps / NANOSECONDS, poses.translation[:, :2]))
    return Recording(
        frames=_frames(setup, world, stamps, poses),
        frame_count=len(stamps),
        imu=imu,
        ground_truth=truth,
        gnss=[] if setup.gnss is None else setup.gnss.fixes(fixes_at(stamps, poses.apply(ANTENNA_IN_CAMERA), ORIGIN)),
    )


def _cars(setup: Setup, route: Route, look: Look, times_s: FloatArray, points: FloatArray) -> list[Mover]:
    """As many moving cars as are asked for; fewer where most would touch a camera that is at points (N, 2)."""
    rng = np.random.default_rng([setup.seed, 5])
    cars: list[Mover] = []
    for _ in range(CAR_ATTEMPTS):
        cars += traffic.draw_movers(rng, route, look, times_s, points, setup.moving_cars - len(cars), people=0)
    return cars


def _frames(setup: Setup, world: World, stamps: IntArray, poses: RigidTransform) -> Iterator[CameraFrame]:
    """The frames, rendered one by one; depth is 0 beyond 80 m."""
    camera = setup.camera()
    image_rng, depth_rng = (np.random.default_rng([setup.seed, stream]) for stream in (4, 7))
    imager = Imager(setup.image_model, camera.K, image_rng)
    rates = _angular_velocities(stamps, poses)
    for stamp, pose, rate in zip(stamps, poses.as_matrix(), rates, strict=True):
        time = float(stamp) / NANOSECONDS
        radiance, depth = world.render(pose, camera.K, camera.width, camera.height, setup.colour, time)
        image = imager.take(radiance, rate)
        if setup.depth_sensor is None:
            depth[depth > MAX_DEPTH_M] = 0.0
        else:
            depth = setup.depth_sensor.measure(depth, image, camera.K, depth_rng)
        yield CameraFrame(int(stamp), image, depth, camera)


def _angular_velocities(stamps: IntArray, poses: RigidTransform) -> FloatArray:
    """Mean rates (N, 3) rad/s in camera axes from each frame to the next one, of the last from the one before."""
    if len(poses) < 2:
        return np.zeros((len(poses), 3))
    turns = (poses[:-1].rotation.inv() * poses[1:].rotation).as_rotvec()
    rates = turns / (np.diff(stamps) / NANOSECONDS)[:, None]
    return np.concatenate([rates, rates[-1:]])
