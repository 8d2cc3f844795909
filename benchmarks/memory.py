"""Peak memory of ``fusion.run`` on a log and on one ten times as long: it grows with the poses, not with the images.

``python benchmarks/memory.py [--frames 300]`` simulates both logs, runs every variant on both, each in a process of its
own, and prints the growth a frame beside the size of a frame. Exit code 1 where the growth is that of held images.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from fusion_io.records import NANOSECONDS, CameraFrame, CameraInfo, Trajectory
from fusion_io.simulation.motion import DriveStyle, ImuModel, drive, simulate_imu
from fusion_io.trajectory_files import pair_estimates
from fusion_io.writer import LogWriter

LONGER = 10
WIDTH, HEIGHT = 480, 128
CAMERA = CameraInfo(WIDTH, HEIGHT, np.array([[270.0, 0.0, 239.5], [0.0, 270.0, 63.5], [0.0, 0.0, 1.0]]))
FRAME_BYTES = WIDTH * HEIGHT * (1 + 4)  # grey image and depth, as they are in memory

VARIANTS = {
    "recorded pairs, images left out": ["--record", "light"],
    "recorded pairs, images copied": ["--record", "all"],
}


def write_log(path: Path, frames: int) -> None:
    """A drive of 10 Hz frames and a 100 Hz IMU with its true motions as pair estimates."""
    rng = np.random.default_rng(0)
    seconds = frames / 10
    motion = drive(0, 0.0, seconds, DriveStyle())
    stamps_ns = np.arange(frames, dtype=np.int64) * (NANOSECONDS // 10)
    imu_stamps_ns = np.arange(10 * frames, dtype=np.int64) * (NANOSECONDS // 100)
    truth = Trajectory(stamps_ns, motion.poses(stamps_ns / NANOSECONDS))
    texture = rng.integers(0, 256, (HEIGHT, WIDTH), dtype=np.uint8)
    depth = np.full((HEIGHT, WIDTH), 10.0, dtype=np.float32)
    with LogWriter(path) as log:
        log.imu(simulate_imu(motion, imu_stamps_ns, 100.0, ImuModel(), seed=0))
        log.ground_truth(truth)
        log.pairs(pair_estimates(truth, 0.03, 1e-3))
        for k, stamp in enumerate(stamps_ns):
            log.frame(CameraFrame(int(stamp), np.roll(texture, k, axis=1), depth, CAMERA))


def peak_bytes(log: Path, options: list[str]) -> int:
    """Peak resident memory of one run."""
    with tempfile.TemporaryDirectory() as out:
        command = [sys.executable, "-m", "fusion.run", "--log", str(log), "--out", out, *options]
        process = subprocess.Popen(command, stdout=subprocess.DEVNULL)
        _, status, usage = os.wait4(process.pid, 0)
    if status:
        raise SystemExit(f"error: exit code {os.waitstatus_to_exitcode(status)} from {' '.join(command)}")
    return usage.ru_maxrss * 1024  # Linux counts in KiB


def main() -> int:
    """Measure, print, judge."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=300, help="frames of the short log (default %(default)s)")
    frames = parser.parse_args().frames

    table = Table("peak memory of fusion.run", f"{frames} frames", f"{LONGER * frames} frames", "growth a frame")
    bounded = True
    with tempfile.TemporaryDirectory() as folder:
        logs = []
        for count in (frames, LONGER * frames):
            logs.append(Path(folder, f"{count}.mcap"))
            write_log(logs[-1], count)
        for name, options in VARIANTS.items():
            short, long = (peak_bytes(log, options) for log in logs)
            growth = (long - short) / ((LONGER - 1) * frames)
            bounded &= growth < FRAME_BYTES / 2
            table.add_row(name, f"{short / 1e6:.0f} MB", f"{long / 1e6:.0f} MB", f"{growth / 1e3:.1f} kB")
    Console().print(table)
    print(f"A frame with its depth is {FRAME_BYTES / 1e3:.0f} kB in memory.")
    return 0 if bounded else 1


if __name__ == "__main__":
    sys.exit(main())
