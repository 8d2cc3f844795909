"""What a converter hands over: the recording of one drive, ready to be written as a log."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from fusion_io.errors import LogError
from fusion_io.progress import track
from fusion_io.records import CameraFrame, GnssFix, ImuSeries, PairEstimate, Trajectory
from fusion_io.writer import LogWriter


@dataclass(frozen=True, slots=True)
class DepthImage:
    """A depth image (H, W) float32 in metres with a stamp of its own; 0 where there is no depth."""

    stamp_ns: int
    depth: NDArray[np.float32]


@dataclass
class Recording:
    """The sources of one log; what it does not have is empty or None.

    frames: in order of time, read while they are written; frame_count: how many are expected, and once the
    recording is written, how many there were. rotation_imu_camera: v_imu = R v_camera. warnings: what was
    missing or skipped, and how often; complete once the recording is written.
    """

    frames: Iterable[CameraFrame | DepthImage] = ()
    frame_count: int = 0
    imu: ImuSeries | None = None
    ground_truth: Trajectory | None = None
    pairs: list[PairEstimate] = field(default_factory=list)
    gnss: list[GnssFix] = field(default_factory=list)
    rotation_imu_camera: Rotation | None = None
    warnings: Counter[str] = field(default_factory=Counter)

    def write(self, path: Path, metadata: Mapping[str, Mapping[str, str]]) -> None:
        """Write everything as one log; a ``LogError`` where that fails, and then there is no file."""
        with LogWriter(path, metadata) as log:
            if self.rotation_imu_camera is not None:
                log.mounting(self.rotation_imu_camera)
            if self.imu is not None:
                log.imu(self.imu)
            if self.ground_truth is not None:
                log.ground_truth(self.ground_truth)
            for fix in self.gnss:
                log.gnss(fix)
            log.pairs(self.pairs)
            written = 0
            for frame in track(self.frames, "frames", self.frame_count):
                if isinstance(frame, DepthImage):
                    log.depth(frame.stamp_ns, frame.depth)
                else:
                    log.frame(frame)
                    written += 1
            if self.frame_count and not written:
                raise LogError(f"{path}: not written, because no image could be decoded")
            self.frame_count = written


def between(imu: ImuSeries, start_ns: int, end_ns: int) -> ImuSeries:
    """The samples from start to end, both included."""
    chosen = slice(*np.searchsorted(imu.stamps_ns, [start_ns, end_ns + 1]))
    return ImuSeries(
        imu.stamps_ns[chosen],
        imu.angular_velocity[chosen],
        imu.linear_acceleration[chosen],
        imu.angular_velocity_std,
        imu.linear_acceleration_std,
    )
