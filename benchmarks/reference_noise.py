"""How far KITTI's ground truth is from its own IMU between consecutive frames: what a reference of that make can judge.

``python benchmarks/reference_noise.py --kitti DIR [--sequences 00 01 ...]`` takes poses, times and IMU of the odometry
benchmark; by default the paper's training sequences that have an IMU. It prints figures and asserts nothing.
`learned.held_out.Rig` has them.

Rotations: a frame's turn against the gyroscopes', with mounting, bias and delay fitted to the sequence. Positions: the
ground truth less the twice integrated acceleration is a parabola for some seconds; a frame's step of what is left of
it beside the best one.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table
from scipy.integrate import cumulative_trapezoid
from scipy.signal import savgol_filter
from scipy.spatial.transform import Rotation, Slerp

from fusion_io.kitti import read_imu_mat
from fusion_io.records import NANOSECONDS, FloatArray, ImuSeries, Trajectory
from fusion_io.trajectory_files import read_kitti, read_times

SEQUENCES = ("00", "01", "02", "04", "05", "06", "07", "08")
DELAYS_S = np.arange(0, 0.13, 0.005)
WINDOW_S = 8.0
#: What is left out at both ends, in frames: there the delay reaches beyond the IMU, and a window beyond the log.
ENDS = slice(40, -60)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--kitti", type=Path, required=True, metavar="DIR", help="folder of sequences/, poses/ and imu/"
    )
    parser.add_argument("--sequences", nargs="+", default=SEQUENCES, metavar="NN")
    options = parser.parse_args()

    table = Table(title="ground truth against its own IMU, from frame to frame: about or along right, down, ahead")
    for heading in ("sequence", "rotation (mrad), robust", "standard deviation", "position (mm)", "delay (ms)"):
        table.add_column(heading)
    found = []
    for sequence in options.sequences:
        stamps_ns = read_times(options.kitti / "sequences" / sequence / "times.txt")
        truth = read_kitti(options.kitti / "poses" / f"{sequence}.txt", stamps_ns)
        imu = read_imu_mat(options.kitti / "imu" / f"{sequence}.mat", stamps_ns)
        delay, mounting, turns = rotation_errors(truth, imu)
        steps = position_errors(truth, imu, delay, mounting)
        rows = 1e3 * np.array([robust_std(turns), turns.std(0), steps.std(0)])
        found.append(rows)
        table.add_row(sequence, *map(words, rows), f"{1e3 * delay:.0f}")
    table.add_row("mean", *map(words, np.mean(found, axis=0)), "", style="bold")
    table.add_row("of a pose: mean / root 2", *map(words, np.mean(found, axis=0) / np.sqrt(2)), "", style="bold")
    Console(width=120).print(table)


def rotation_errors(truth: Trajectory, imu: ImuSeries) -> tuple[float, Rotation, FloatArray]:
    """Delay of the IMU (s), its mounting v_camera = R v_imu, and the turns (N, 3) in rad less the gyroscopes'."""
    true = (truth.poses[:-1].inv() * truth.poses[1:]).rotation.as_rotvec()
    frame_s, imu_s = clocks(truth, imu)
    angle = cumulative_trapezoid(imu.angular_velocity, imu_s, axis=0, initial=0)
    fits = []
    for delay in DELAYS_S:
        turned = np.diff(at(frame_s + delay, imu_s, angle), axis=0)
        kept = np.zeros(len(true), dtype=bool)
        kept[ENDS] = True
        bias = np.zeros(3)
        for _ in range(6):  # what is far off, such as a gyroscope's fault, must not turn the mounting
            mounting, _ = Rotation.align_vectors((true - bias)[kept], turned[kept])
            errors = true - mounting.apply(turned)
            bias = np.median(errors[kept], axis=0)
            size = np.linalg.norm(errors - bias, axis=1)
            kept[ENDS] = size[ENDS] < 4 * np.median(size[ENDS])
        rest = (errors - bias)[ENDS]
        fits.append((float(np.sum(robust_std(rest) ** 2)), float(delay), mounting, rest))
    return min(fits, key=lambda fit: fit[0])[1:]


def position_errors(truth: Trajectory, imu: ImuSeries, delay: float, mounting: Rotation) -> FloatArray:
    """What the steps (N, 3) of the ground truth in metres, in its own axes, are off the accelerometers'.

    The unit is not where the camera is: the lever arm is fitted too.
    """
    frame_s, imu_s = clocks(truth, imu)
    world_s = np.clip(imu_s - delay, frame_s[0], frame_s[-1])
    force = Slerp(frame_s, truth.poses.rotation)(world_s).apply(mounting.apply(imu.linear_acceleration))
    velocity = cumulative_trapezoid(force - force.mean(0), world_s, axis=0, initial=0)
    path = at(frame_s, world_s, cumulative_trapezoid(velocity, world_s, axis=0, initial=0))
    frames = round(WINDOW_S / np.median(np.diff(frame_s))) | 1
    axes = truth.poses.rotation.as_matrix()
    off, arms = (x - savgol_filter(x, frames, 2, axis=0) for x in (truth.poses.translation - path, axes))
    lever, *_ = np.linalg.lstsq(arms[ENDS].reshape(-1, 3), off[ENDS].ravel())
    steps: FloatArray = truth.poses.rotation[:-1].inv().apply(np.diff(off - arms @ lever, axis=0))[ENDS]
    return steps


def clocks(truth: Trajectory, imu: ImuSeries) -> tuple[FloatArray, FloatArray]:
    """Stamps of the poses and of the IMU in seconds from the first pose."""
    first_ns = truth.stamps_ns[0]
    return (truth.stamps_ns - first_ns) / NANOSECONDS, (imu.stamps_ns - first_ns) / NANOSECONDS


def at(moments: FloatArray, stamps: FloatArray, values: FloatArray) -> FloatArray:
    """Values (N, 3) interpolated linearly."""
    return np.column_stack([np.interp(moments, stamps, column) for column in values.T])


def robust_std(errors: FloatArray) -> FloatArray:
    """Standard deviations of the columns (N, 3), of which outliers know nothing: scaled median absolute deviations."""
    return np.asarray(1.4826 * np.median(np.abs(errors - np.median(errors, axis=0)), axis=0))


def words(row: FloatArray) -> str:
    """Three numbers."""
    return "  ".join(f"{value:6.2f}" for value in row)


if __name__ == "__main__":
    main()
