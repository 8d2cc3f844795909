"""What a run leaves in its folder: the log, the trajectories as text, the configuration, the pictures, the metrics.

Every file appears whole or not at all: it is written under a temporary name and renamed.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

from fusion import plots
from fusion.config import RunConfig, to_toml
from fusion.evaluation import Metrics
from fusion.imu import ImuCalibration
from fusion_io.errors import LogError, UsageError
from fusion_io.reader import Log
from fusion_io.records import NANOSECONDS, ImuSeries, PairEstimate, Trajectory
from fusion_io.trajectory_files import write_kitti, write_tum
from fusion_io.writer import LogWriter

SCHEMA = 1
LOG_NAME = "run.mcap"
TRAJECTORIES = ("raw", "posegraph", "ekf")

# The packages whose versions decide the numbers of a run.
PACKAGES = ("violearner-fusion", "numpy", "scipy", "torch", "gtsam", "filterpy", "opencv-python-headless", "mcap")


@dataclass
class Findings:
    """What a run has to warn of: counts by name for metrics.json, and a line each for the user."""

    counts: dict[str, int] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    def add(self, name: str, count: int, note: str) -> None:
        """Count a warning; a count of zero is none."""
        if count:
            self.counts[name] = count
            self.notes.append(note)


@dataclass(frozen=True)
class Outcome:
    """All that a run read and computed; trajectories and metrics by name: raw, posegraph, ekf."""

    log: Log
    config: RunConfig
    imu: ImuSeries
    pairs: list[PairEstimate]
    ground_truth: Trajectory | None
    calibration: ImuCalibration
    trajectories: Mapping[str, Trajectory]
    metrics: Mapping[str, Metrics]
    findings: Findings

    @property
    def duration_s(self) -> float:
        """The time that the log spans."""
        return (self.log.end_ns - self.log.start_ns) / NANOSECONDS


def prepare_folder(folder: Path, log_path: Path) -> Path:
    """Create the folder of a run before time is spent on what goes into it.

    Raises UsageError where that is impossible, or where its run.mcap is the very log that is to be read.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        if (folder / LOG_NAME).exists() and (folder / LOG_NAME).samefile(log_path):
            raise UsageError(
                f"{folder}: its {LOG_NAME} is the log to be read and would be replaced; choose another --out"
            )
    except OSError as error:
        raise UsageError(f"{folder}: {error.strerror}") from None
    return folder


def write_log(folder: Path, outcome: Outcome) -> None:
    """Write run.mcap: what the back ends consumed and what they made of it, itself a valid input.

    Frames are streamed: their images and depth if the configuration says `all`, otherwise their stamps and camera.
    """
    with LogWriter(folder / LOG_NAME, _provenance(outcome)) as writer:
        if (mounting := outcome.log.mounting()) is not None:
            writer.mounting(mounting)
        writer.imu(outcome.imu)
        writer.pairs(outcome.pairs)
        if outcome.ground_truth is not None:
            writer.ground_truth(outcome.ground_truth)
        for name, trajectory in outcome.trajectories.items():
            writer.trajectory(name, trajectory)
        if outcome.config.record == "all":
            for frame in outcome.log.frames():
                writer.frame(frame)
        else:
            camera = outcome.log.camera_info()
            for stamp_ns in outcome.log.frame_stamps():
                writer.camera_info(int(stamp_ns), camera)


def write_text(folder: Path, outcome: Outcome) -> None:
    """Write the trajectories as NAME.tum and NAME.kitti.txt, and the resolved configuration as config.toml."""
    for name in TRAJECTORIES:
        for suffix, write in ((".tum", write_tum), (".kitti.txt", write_kitti)):
            path = folder / f"{name}{suffix}"
            if name in outcome.trajectories:
                with _replacing(path) as temporary:
                    write(temporary, outcome.trajectories[name])
            else:
                path.unlink(missing_ok=True)  # of an earlier run into the same folder, which had this back end
    with _replacing(folder / "config.toml") as temporary:
        temporary.write_text(to_toml(outcome.config), encoding="utf-8")


def write_plots(folder: Path, outcome: Outcome) -> None:
    """Draw trajectories.png and errors.png."""
    title = outcome.log.path.name
    for name, plot in (("trajectories.png", plots.plot_trajectories), ("errors.png", plots.plot_errors)):
        with _replacing(folder / name) as temporary:
            plot(title, outcome.trajectories, outcome.ground_truth).savefig(temporary, format="png")


def write_metrics(folder: Path, outcome: Outcome, seconds: Mapping[str, float]) -> None:
    """Write metrics.json, the last file of a run: where it is, the others are; `seconds` are those of the stages."""
    document = metrics_document(outcome, seconds)
    with _replacing(folder / "metrics.json") as temporary:
        temporary.write_text(json.dumps(document, indent=2, allow_nan=False) + "\n", encoding="utf-8")


def metrics_document(outcome: Outcome, seconds: Mapping[str, float]) -> dict[str, Any]:
    """The content of metrics.json; what could not be computed is None. Times in `timing` are seconds."""
    log, calibration = outcome.log, outcome.calibration
    total = sum(seconds.values())
    mounting = calibration.rotation_imu_camera
    return {
        "schema": SCHEMA,
        "log": {
            "path": str(log.path),
            "sha256": log.sha256,
            "duration_s": outcome.duration_s,
            "frames": len(outcome.trajectories["raw"]),
            "pairs": len(outcome.pairs),
            "imu_samples": len(outcome.imu),
            "warnings": {**log.warnings, **outcome.findings.counts},
        },
        "trajectories": {name: asdict(metrics) for name, metrics in outcome.metrics.items()},
        "calibration": {
            "rotation_imu_camera_quat_wxyz": None if mounting is None else mounting.as_quat(scalar_first=True).tolist(),
            "time_offset_s": calibration.time_offset_s,
            "used": calibration.used,
            "reason": calibration.reason,
        },
        "timing": {**seconds, "total": total, "realtime_factor": outcome.duration_s / total},
    }


def _provenance(outcome: Outcome) -> dict[str, dict[str, str]]:
    """The metadata records of run.mcap: from what, how and with what it was made."""
    return {
        "source": {"log": outcome.log.path.name, "sha256": outcome.log.sha256},
        "config": {"toml": to_toml(outcome.config)},
        "versions": {package: version(package) for package in PACKAGES},
    }


@contextmanager
def _replacing(path: Path) -> Iterator[Path]:
    """A temporary path beside `path` to write to, which takes its place if all goes well; LogError if not."""
    temporary = path.with_name(f".{path.name}.part")
    try:
        yield temporary
        with temporary.open("rb") as file:
            os.fsync(file.fileno())
        temporary.replace(path)
    except OSError as error:
        raise LogError(f"{path}: {error.strerror}") from None
    finally:
        temporary.unlink(missing_ok=True)
