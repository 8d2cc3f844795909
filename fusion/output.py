"""What a run leaves in its folder: the log, the trajectories as text, the configuration, the pictures, the metrics.

Every file appears whole or not at all: it is written under a temporary name and renamed.
"""

from __future__ import annotations

import itertools
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from fusion import plots, report
from fusion.chain import chain
from fusion.config import RunConfig, to_toml
from fusion.evaluation import Metrics, evaluate
from fusion.gnss import Georeference
from fusion.imu import BiasStep, ImuCalibration
from fusion.measurements import Estimate, Measurements, Mounting
from fusion.placement import Placement, placement, refined_mounting
from fusion_io.errors import LogError, UsageError
from fusion_io.findings import Findings
from fusion_io.messages import CAMERA_FRAME
from fusion_io.reader import Log
from fusion_io.records import (
    NANOSECONDS,
    NIS_DEGREES_OF_FREEDOM,
    CameraFrame,
    CameraInfo,
    GnssFix,
    ImuSeries,
    PairEstimate,
    Trajectory,
)
from fusion_io.trajectory_files import write_kitti, write_tum
from fusion_io.writer import LogWriter

SCHEMA = 1
LOG_NAME = "run.mcap"
TRAJECTORIES = ("raw", "posegraph", "posegraph_online", "ekf", "ekf_smoothed")

# What sensor_msgs/CameraInfo calls uncalibrated: K is zero.
NOT_CALIBRATED = CameraInfo(0, 0, np.zeros((3, 3)))

# The packages whose versions decide the numbers of a run.
PACKAGES = ("violearner-fusion", "numpy", "scipy", "torch", "gtsam", "filterpy", "opencv-python-headless", "mcap")


@dataclass(frozen=True)
class Outcome:
    """All that a run read and computed; trajectories and metrics by name: raw, posegraph, ekf.

    estimates: all that the back ends found, by the same names. levels: what the network made of the pairs level by
    level, as hypotheses.
    """

    log: Log
    config: RunConfig
    imu: ImuSeries
    pairs: list[PairEstimate]
    ground_truth: Trajectory | None
    calibration: ImuCalibration
    trajectories: Mapping[str, Trajectory]
    estimates: Mapping[str, Estimate]
    metrics: Mapping[str, Metrics]
    findings: Findings
    loops: Sequence[PairEstimate] = ()
    gnss: Sequence[GnssFix] = ()
    skips: Sequence[PairEstimate] = ()
    levels: Sequence[PairEstimate] = ()

    @classmethod
    def of(
        cls,
        log: Log,
        config: RunConfig,
        read: tuple[ImuSeries, list[PairEstimate], Trajectory | None, Sequence[GnssFix]],
        calibration: ImuCalibration,
        known: Measurements,
        estimates: Mapping[str, Estimate],
        findings: Findings,
        levels: Sequence[PairEstimate] = (),
    ) -> Outcome:
        """From what back ends made of what was known, with raw beside it; read: IMU, pairs, ground truth, positions."""
        imu, pairs, truth, fixes = read
        trajectories = {"raw": chain(known.steps)} | {name: each.trajectory for name, each in estimates.items()}
        metrics = {name: evaluate(each, truth, config.segment_lengths_m) for name, each in trajectories.items()}
        found = (calibration, trajectories, estimates, metrics, findings)
        return cls(log, config, imu, pairs, truth, *found, known.loops, fixes, known.skips, levels)

    @property
    def mounting(self) -> Mounting | None:
        """How the IMU is mounted, as a back end has refined it, or None."""
        return refined_mounting(self.estimates.values())

    @property
    def bias_steps(self) -> list[BiasStep]:
        """Those of the IMU that the calibration and a back end found."""
        found = next((each.bias_steps for each in self.estimates.values() if each.bias_steps), ())
        return sorted([*self.calibration.bias_steps, *found], key=lambda step: step.at_ns)

    @cached_property
    def content(self) -> report.ReportContent:
        """What the report shows."""
        return report.content_of(self)

    @property
    def duration_s(self) -> float:
        """The time that the log spans."""
        return (self.log.end_ns - self.log.start_ns) / NANOSECONDS

    @property
    def georeference(self) -> Georeference | None:
        """Where on the earth the world is, if the pose graph found out."""
        return self.estimates["posegraph"].georeference if "posegraph" in self.estimates else None


@contextmanager
def folder_of_run(folder: Path, log_path: Path) -> Iterator[Path]:
    """A prepared folder, which is gone again if it is new and nothing came of the run."""
    new = not folder.exists()
    prepare_folder(folder, log_path)
    try:
        yield folder
    finally:
        if new:
            with suppress(OSError):  # something did
                folder.rmdir()


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
        writer.skips(outcome.skips)
        writer.loops(outcome.loops)
        writer.levels(outcome.levels)
        for fix in outcome.gnss:
            writer.gnss(fix)
        if outcome.ground_truth is not None:
            writer.ground_truth(outcome.ground_truth)
        for name, trajectory in outcome.trajectories.items():
            writer.trajectory(name, trajectory)
        for name, estimate in outcome.estimates.items():
            if estimate.series is not None:
                writer.estimator(name, estimate.series)
            writer.overview(name, trajectory)
        on_earth = outcome.georeference
        writer.frame_tree([*outcome.trajectories][-1], None if on_earth is None else on_earth.T_enu_world)
        _write_frames(writer, outcome)


def write_text(folder: Path, outcome: Outcome) -> None:
    """Write the trajectories as NAME.tum and NAME.kitti.txt, and the resolved configuration as config.toml.

    posegraph.enu is that of the pose graph on the earth, in the local frame of the satellite positions.
    """
    found: dict[str, Trajectory] = dict(outcome.trajectories)
    if outcome.georeference is not None:
        found["posegraph.enu"] = outcome.georeference.of(found["posegraph"])
    for name in (*TRAJECTORIES, "posegraph.enu"):
        for suffix, write in ((".tum", write_tum), (".kitti.txt", write_kitti)):
            path = folder / f"{name}{suffix}"
            if name in found:
                with _replacing(path) as temporary:
                    write(temporary, found[name])
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


def write_report(folder: Path, outcome: Outcome) -> None:
    """Write report.html, the page that shows all of it."""
    with _replacing(folder / "report.html") as temporary:
        report.write_report(temporary, outcome.content)


def write_metrics(folder: Path, outcome: Outcome, seconds: Mapping[str, float]) -> None:
    """Write metrics.json, the last file of a run: where it is, the others are; `seconds` are those of the stages."""
    document = metrics_document(outcome, seconds)
    with _replacing(folder / "metrics.json") as temporary:
        temporary.write_text(json.dumps(document, indent=2, allow_nan=False) + "\n", encoding="utf-8")


def metrics_document(outcome: Outcome, seconds: Mapping[str, float]) -> dict[str, Any]:
    """The content of metrics.json; what could not be computed is None. Times in `timing` are seconds."""
    log, calibration = outcome.log, outcome.calibration
    total = sum(seconds.values())
    told = (estimate.front_end_sigma for estimate in outcome.estimates.values())
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
        "trajectories": {name: _values(outcome, name) for name in outcome.metrics},
        "at_end": {name: _at_end(each) for name, each in outcome.trajectories.items()},
        "calibration": _calibration(calibration, placement(calibration, outcome.mounting)),
        "bias_steps": [_bias_step(step) for step in outcome.bias_steps if step.is_known],
        "clock_jumps": [{"stamp_ns": jump.at_ns, "by_s": jump.by_s} for jump in calibration.clock_jumps],
        "front_end": {"scale_sigma": next((sigma[0] for sigma in told if sigma), None)},
        "gnss": None if outcome.georeference is None else _georeference(outcome.georeference),
        "timing": {**seconds, "total": total, "realtime_factor": outcome.duration_s / total},
    }


def _calibration(found: ImuCalibration, known: Placement) -> dict[str, Any]:
    """How the IMU is mounted and what its clock reads; standard deviations are None where something was given."""
    rotation, std_rad = known.rotation_imu_camera, known.rotation_std_rad
    return {
        "rotation_imu_camera_quat_wxyz": None if rotation is None else rotation.as_quat(scalar_first=True).tolist(),
        "rotation_std_deg": None if std_rad is None else np.rad2deg(std_rad).tolist(),
        "time_offset_s": known.time_offset_s,
        "time_offset_std_s": known.time_offset_std_s,
        "low_pass_s": found.low_pass_s,
        "lever_arm_m": None if known.lever_arm_m is None else known.lever_arm_m.tolist(),
        "lever_arm_std_m": None if known.lever_arm_std_m is None else known.lever_arm_std_m.tolist(),
        "gyro_bias_rad_s": known.gyro_bias.tolist(),
        "used": found.used,
        "reason": found.reason,
    }


def _bias_step(step: BiasStep) -> dict[str, Any]:
    accelerometer, gyro = step.by[:3].tolist(), step.by[3:].tolist()
    return {"stamp_ns": step.at_ns, "accelerometer_m_s2": accelerometer, "gyro_rad_s": gyro}


def _write_frames(writer: LogWriter, outcome: Outcome) -> None:
    """Stream the frames in the frame id that the mounting in our logs refers to: whole, or stamp and camera alone."""
    log, last_ns = outcome.log, -1
    end_ns = outcome.trajectories["raw"].stamps_ns[-1]  # before the end of the log where the run was interrupted
    if outcome.config.record == "all" and log.has_frames:
        frames = itertools.takewhile(lambda frame: frame.stamp_ns <= end_ns, log.frames())
        for frame in _as_far_as_readable(frames, outcome.findings):
            writer.frame(replace(frame, camera=replace(frame.camera, frame_id=CAMERA_FRAME)))
            last_ns = frame.stamp_ns
    camera = replace(log.camera_info() or NOT_CALIBRATED, frame_id=CAMERA_FRAME)
    stamps = log.frame_stamps()
    for stamp_ns in stamps[(stamps > last_ns) & (stamps <= end_ns)].tolist():
        writer.camera_info(stamp_ns, camera)


def _as_far_as_readable(frames: Iterator[CameraFrame], findings: Findings) -> Iterator[CameraFrame]:
    """The frames up to the first that has no place in a log: results from recorded pairs shall not be lost for it."""
    try:
        yield from frames
    except LogError as error:
        findings.put("images_not_copied", 1, f"images are left out of {LOG_NAME} from here on: {error}")


def _values(outcome: Outcome, name: str) -> dict[str, float | int | None]:
    """The measures of a trajectory; without ground truth not even the number of segments is known, but its NIS is."""
    values = asdict(outcome.metrics[name])
    estimate = outcome.estimates.get(name)
    nis_mean = estimate.series.nis_mean if estimate is not None and estimate.series is not None else None
    return (values if outcome.ground_truth is not None else dict.fromkeys(values)) | {
        "nis_mean": nis_mean,
        "nis_degrees_of_freedom": None if nis_mean is None else NIS_DEGREES_OF_FREEDOM,
    }


def _at_end(trajectory: Trajectory) -> dict[str, Any]:
    """Where the camera was at the end, in the frame of the first one, and how sure the back end is of it.

    The sigmas are roots of the summed variances of the three axes.
    """
    end: dict[str, Any] = {
        "position_m": trajectory.poses.translation[-1].tolist(),
        "orientation_quat_wxyz": trajectory.poses.rotation[-1].as_quat(scalar_first=True).tolist(),
        "path_length_m": trajectory.path_length_m,
    }
    if (sigmas := trajectory.end_sigmas) is not None:
        end["position_sigma_m"], end["orientation_sigma_rad"] = sigmas
    return end


def _georeference(found: Georeference) -> dict[str, Any]:
    """Where on the earth the world is; the covariance is that of T_enu_world, rotation first, right perturbation."""
    used = int(np.sum(found.used))
    T_enu_world = RigidTransform.from_matrix(found.T_enu_world)
    return {
        "origin": found.origin._asdict(),
        "T_enu_world": {
            "quat_wxyz": T_enu_world.rotation.as_quat(scalar_first=True).tolist(),
            "translation_m": T_enu_world.translation.tolist(),
            "covariance": found.covariance.tolist(),
        },
        "antenna_m": found.antenna_m.tolist(),
        "used": used,
        "rejected": len(found.used) - used,
        "residual_rms_m": found.residual_rms_m,
    }


def _provenance(outcome: Outcome) -> dict[str, dict[str, str]]:
    """The metadata records of run.mcap: from what, how and with what it was made, and where on the earth that is."""
    on_earth = outcome.georeference
    origin = {} if on_earth is None else {name: repr(value) for name, value in on_earth.origin._asdict().items()}
    return ({"enu_origin": origin} if origin else {}) | {
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
