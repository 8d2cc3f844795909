"""A simulated drive as a log of any kind, for tests of whole commands."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from drive_samples import without_pictures
from scipy.spatial.transform import RigidTransform, Rotation

from fusion_io.records import NANOSECONDS, CameraFrame, CameraInfo, FloatArray, ImuSeries, PairEstimate, Trajectory
from fusion_io.simulation.motion import DriveStyle, ImuModel, drive, simulate_imu
from fusion_io.writer import LogWriter

SIZE = 60, 16  # width and height in pixels: a log of a second is a few kilobytes
CAMERA = CameraInfo(*SIZE, np.array([[35.0, 0.0, 29.5], [0.0, 35.0, 7.5], [0.0, 0.0, 1.0]]))
FRAME_PERIOD_NS = NANOSECONDS // 10
PAIR_SIGMA = np.array([1e-3, 1e-3, 1e-3, 0.03, 0.03, 0.03])


@dataclass
class Drive:
    """What one drive holds; a test damages it before it is written."""

    frames: list[CameraFrame]
    imu: ImuSeries
    ground_truth: Trajectory
    pairs: list[PairEstimate]
    mounting: Rotation | None = None

    def write(self, path: Path, leave_out: Iterable[str] = ()) -> Path:
        """Write it as a log without what is left out: frames, camera_info, imu, ground_truth, pairs."""
        with LogWriter(path) as log:
            if self.mounting is not None:
                log.mounting(self.mounting)
            for role in {"imu", "ground_truth", "pairs"}.difference(leave_out):
                getattr(log, role)(getattr(self, role))
            for frame in self.frames if "frames" not in leave_out else ():
                log.image(frame.stamp_ns, frame.image)
                if frame.depth is not None:
                    log.depth(frame.stamp_ns, frame.depth)
                if "camera_info" not in leave_out:
                    log.camera_info(frame.stamp_ns, frame.camera)
        return path


def _pairs(truth: Trajectory, rng: np.random.Generator) -> list[PairEstimate]:
    """The true motions with noise of PAIR_SIGMA."""
    noise = RigidTransform.from_exp_coords(rng.normal(size=(len(truth) - 1, 6)) * PAIR_SIGMA)
    motions = truth.poses[:-1].inv() * truth.poses[1:] * noise
    covariance: FloatArray = np.diag(PAIR_SIGMA**2)
    return [
        PairEstimate(
            int(source), int(target), motion.rotation.as_quat(scalar_first=True), motion.translation, covariance
        )
        for source, target, motion in zip(truth.stamps_ns[:-1], truth.stamps_ns[1:], motions, strict=True)
    ]


@pytest.fixture(scope="session")
def simulated_drive() -> Callable[..., Drive]:
    """simulated_drive(seconds): 10 Hz frames, 100 Hz IMU mounted as on KITTI's car, exact ground truth, noisy pairs."""

    def make(seconds: float, seed: int = 0) -> Drive:
        rng = np.random.default_rng(seed)
        start_ns = 1_000 * NANOSECONDS
        motion = drive(seed, start_ns / NANOSECONDS, start_ns / NANOSECONDS + seconds, DriveStyle(yaw_rate=0.2))
        stamps_ns = start_ns + np.arange(round(10 * seconds), dtype=np.int64) * FRAME_PERIOD_NS
        truth = Trajectory(stamps_ns, motion.poses(stamps_ns / NANOSECONDS))
        imu_stamps_ns = start_ns + np.arange(round(100 * seconds), dtype=np.int64) * (NANOSECONDS // 100)
        width, height = SIZE
        frames = [
            CameraFrame(
                int(stamp),
                rng.integers(0, 256, (height, width), dtype=np.uint8),
                np.full((height, width), 8.0, dtype=np.float32),
                CAMERA,
            )
            for stamp in stamps_ns
        ]
        return Drive(frames, simulate_imu(motion, imu_stamps_ns, 100.0, ImuModel(), seed), truth, _pairs(truth, rng))

    return make


@pytest.fixture
def no_pictures() -> Iterator[None]:
    """Runs in this process draw nothing."""
    with without_pictures():
        yield


@pytest.fixture(scope="session")
def small_weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A network of the right shape that has learned nothing: for what must happen whatever it estimates."""
    import torch

    from learned import weights
    from learned.covariance import CovarianceModel
    from learned.violearner import NetworkConfig, VIOLearner

    torch.manual_seed(0)
    config = NetworkConfig(
        height=SIZE[1], width=SIZE[0], trunk_filters=4, extra_filters=4, imu_filters=(4, 4, 4, 4, 4, 4, 4)
    )
    path = tmp_path_factory.mktemp("weights") / "small.pt"
    weights.save(path, weights.Weights(VIOLearner(config), CovarianceModel(), CovarianceModel(), CovarianceModel()), {})
    return path
