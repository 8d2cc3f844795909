"""A short drive with a camera, pair estimates, an IMU and ground truth, and runs on it that draw nothing."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from log_samples import frames
from scipy.spatial.transform import RigidTransform, Rotation

from fusion_io.records import ImuSeries, PairEstimate, Trajectory
from fusion_io.writer import LogWriter

SECOND = 1_000_000_000
FRAMES = 40


def drive() -> tuple[Trajectory, list[PairEstimate], ImuSeries]:
    """A left turn of 40 frames, pair estimates of it with noise, and samples of a gyro."""
    rng = np.random.default_rng(0)
    step = RigidTransform.from_components([0.0, 0.0, 1.0], Rotation.from_rotvec([0.0, -0.02, 0.0]))
    poses = [RigidTransform.identity()]
    for _ in range(FRAMES - 1):
        poses.append(poses[-1] * step)
    stamps = 1_300_000_000 * SECOND + np.arange(FRAMES) * 100_000_000
    sigma = np.array([1e-3, 1e-3, 1e-3, 0.03, 0.03, 0.03])
    pairs = []
    for source, target in zip(stamps[:-1].tolist(), stamps[1:].tolist(), strict=True):
        motion = step * RigidTransform.from_exp_coords(rng.normal(size=6) * sigma)
        quat_wxyz = motion.rotation.as_quat(scalar_first=True)
        pairs.append(PairEstimate(source, target, quat_wxyz, motion.translation, np.diag(sigma**2)))
    truth = Trajectory(stamps, RigidTransform.concatenate(poses))
    samples = np.arange(stamps[0], stamps[-1], 10_000_000)
    gyro = np.tile([0.0, -0.2, 0.0], (len(samples), 1)) + rng.normal(size=(len(samples), 3)) * 1e-3
    acceleration = np.tile([2.0, -9.81, 0.0], (len(samples), 1)) + rng.normal(size=(len(samples), 3)) * 1e-2
    return truth, pairs, ImuSeries(samples, gyro, acceleration)


def write_drive(path: Path, images: bool = False) -> Path:
    """The drive as a log; returns its path."""
    truth, pairs, imu = drive()
    with LogWriter(path) as log:
        log.imu(imu)
        log.ground_truth(truth)
        log.pairs(pairs)
        for stamp, frame in zip(truth.stamps_ns.tolist(), frames(FRAMES), strict=True) if images else ():
            log.image(stamp, frame.image)
            log.camera_info(stamp, frame.camera)
    return path


@contextmanager
def without_pictures() -> Iterator[None]:
    """Runs in this process draw nothing, which takes most of a small run's time; the pictures have their own tests."""
    with pytest.MonkeyPatch.context() as patch:
        for pictures in ("write_plots", "write_report"):
            patch.setattr(f"fusion.output.{pictures}", lambda *_: None)
        yield
