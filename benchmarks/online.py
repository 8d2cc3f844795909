"""Time of the pose graph, in batch and online, on 4541 poses with a 100 Hz IMU and 500 loops.

``python benchmarks/online.py [--poses 4541] [--loops 500] [--batch]`` simulates two laps of a circuit, of which the
second sees places of the first, and prints milliseconds a frame (median, 99th percentile, largest) by the wall clock
and of processor time, which is what counts on a busy machine; with --batch the time of the batch solution too.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable

import numpy as np
from rich.console import Console
from rich.table import Table
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import RigidTransform, Rotation
from threadpoolctl import threadpool_limits

from fusion import online, posegraph
from fusion.config import PoseGraphConfig
from fusion.imu import ImuCalibration
from fusion.measurements import Measurements
from fusion_io.records import NANOSECONDS, FloatArray, IntArray, PairEstimate, Trajectory
from fusion_io.simulation.motion import (
    ROTATION_IMU_CAMERA_KITTI,
    ROTATION_WORLD_CAMERA_LEVEL,
    ImuModel,
    Motion,
    imu_stamps,
    simulate_imu,
)

FRAME_HZ, IMU_HZ = 10, 100.0
SPEED = 9.0  # m/s
LAPS = 2
STEP_SIGMA = np.repeat([1e-3, 0.02], 3)
LOOP_SIGMA = np.repeat([2e-3, 0.05], 3)
Clock = Callable[[], float]


def circuit(seconds: float, seed: int) -> Motion:
    """Laps of a road that winds and rises, on wheels that shake a little."""
    rng, period = np.random.default_rng(seed), 0.05
    times = np.arange(-1.0, seconds + 1.0, period)
    angle = 2 * np.pi * LAPS * times / seconds
    radius = SPEED * seconds / LAPS / (2 * np.pi) * (1.0 + 0.15 * np.cos(3 * angle) + 0.1 * np.sin(5 * angle)) / 1.2
    positions = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), 2.0 * np.sin(2 * angle)])
    velocities = np.gradient(positions, period, axis=0)
    yaw = np.unwrap(np.arctan2(velocities[:, 1], velocities[:, 0]))
    shaking = 0.02 * gaussian_filter1d(rng.standard_normal((len(times), 2)), 10.0, axis=0)
    body = Rotation.from_euler("ZYX", np.column_stack([yaw, shaking]))
    return Motion(times, RigidTransform.from_components(positions, body * ROTATION_WORLD_CAMERA_LEVEL))


def pairs(
    truth: Trajectory, source: IntArray, target: IntArray, sigma: FloatArray, rng: np.random.Generator
) -> list[PairEstimate]:
    """The true motions between frames, with noise."""
    errors = RigidTransform.from_exp_coords(rng.standard_normal((len(source), 6)) * sigma)
    motions = truth.poses[source].inv() * truth.poses[target] * errors
    quats_wxyz, translations = motions.rotation.as_quat(scalar_first=True), motions.translation
    ends = truth.stamps_ns[source].tolist(), truth.stamps_ns[target].tolist()
    return [
        PairEstimate(start_ns, end_ns, quat_wxyz, translation, np.diag(sigma**2))
        for start_ns, end_ns, quat_wxyz, translation in zip(*ends, quats_wxyz, translations, strict=True)
    ]


def simulate(poses: int, loops: int, seed: int = 0) -> tuple[Measurements, Trajectory]:
    """All that a car measures on the circuit, and the truth."""
    seconds, rng = (poses - 1) / FRAME_HZ, np.random.default_rng(seed)
    motion = circuit(seconds, seed)
    stamps_ns = np.arange(poses, dtype=np.int64) * (NANOSECONDS // FRAME_HZ)
    truth = Trajectory(stamps_ns, motion.poses(stamps_ns / NANOSECONDS)).relative_to_first()
    model = ImuModel(gyro_noise=1e-3, accelerometer_noise=0.05, gyro_bias=np.zeros(3))
    imu = simulate_imu(motion, imu_stamps(-0.5, seconds + 0.5, IMU_HZ), IMU_HZ, model, seed)
    steps = pairs(truth, np.arange(poses - 1), np.arange(1, poses), STEP_SIGMA, rng)
    seen = np.linspace(0, poses - 1 - poses // LAPS, loops, dtype=np.int64)
    closed = pairs(truth, seen, seen + poses // LAPS, LOOP_SIGMA, rng)
    calibration = ImuCalibration(ROTATION_IMU_CAMERA_KITTI, 0.0, np.zeros(3), True, "given")
    return Measurements(steps, imu, calibration, loops=closed), truth


def frame_times(known: Measurements, clock: Clock) -> tuple[FloatArray, online.Tracker]:
    """Seconds of each frame (K - 1,), and what followed the camera."""
    tracker = online.Tracker(known, PoseGraphConfig())
    seconds = np.zeros(len(known.steps))
    for k in range(len(seconds)):
        start = clock()
        tracker.advance()
        seconds[k] = clock() - start
    return seconds, tracker


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--poses", type=int, default=4541, help="of the log (default %(default)s)")
    parser.add_argument("--loops", type=int, default=500, help="between its laps (default %(default)s)")
    parser.add_argument("--batch", action="store_true", help="the batch solution too")
    arguments = parser.parse_args()
    known, truth = simulate(arguments.poses, arguments.loops)
    threadpool_limits(1, "blas")  # as in `fusion.fusing`

    table = Table(
        title=f"{arguments.poses} poses, {IMU_HZ:.0f} Hz IMU, {arguments.loops} loops, {os.cpu_count()} cores"
    )
    for column in ("ms a frame", "median", "99th percentile", "largest"):
        table.add_column(column, justify="right")
    clocks = {"online, wall clock": time.perf_counter, "online, processor": time.process_time}
    for name, clock in clocks.items():
        seconds, tracker = frame_times(known, clock)
        table.add_row(name, *(f"{1e3 * each:.2f}" for each in (*np.percentile(seconds, [50, 99]), seconds.max())))
    Console().print(table)
    error = np.linalg.norm(tracker.present.T[:3, 3] - truth.poses.translation[-1])
    print(f"{tracker.note}; position error at the end {error:.2f} m")
    if arguments.batch:
        start = time.perf_counter(), time.process_time()
        posegraph.solve(known, PoseGraphConfig())
        wall, processor = time.perf_counter() - start[0], time.process_time() - start[1]
        print(f"batch: {wall:.2f} s by the wall clock, {processor:.2f} s of processor time")


if __name__ == "__main__":
    main()
