"""All that is to be known of a log before it is run, or after: statistics of its sensors, its events, its results."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from fusion import chain, events, log_statistics, verdict
from fusion.allan import NoiseEstimate
from fusion.evaluation import evaluate
from fusion.events import Event
from fusion.imu import ImuCalibration, calibrate
from fusion.log_statistics import DepthStatistics, ImageStatistics, ImuStatistics, Revisits, TopicStatistics
from fusion.placement import placement
from fusion_io import encodings, roles, topics
from fusion_io.container import Contents
from fusion_io.errors import LogError
from fusion_io.odometry import POSE_TYPES
from fusion_io.progress import track
from fusion_io.reader import Log
from fusion_io.records import (
    NANOSECONDS,
    NIS_DEGREES_OF_FREEDOM,
    ImuSeries,
    IntArray,
    PairEstimate,
    Trajectory,
)
from fusion_io.recovery import scan
from fusion_io.survey import ImuReadings, Survey

SCHEMA = 1

SAMPLED_IMAGES = 40
"""So many images of a topic are looked at, evenly over the log."""

NIS_PROBABILITY = 0.95

_INERTIAL = {"imu", "gyro", "accelerometer"}


@dataclass(frozen=True, slots=True)
class Result:
    """A trajectory in an output log, and what its back end stated; None where the log does not tell.

    metrics: as ``evaluation.Metrics``. end_sigma_m, end_sigma_rad: roots of the summed variances of the last pose.
    nis_mean: of the innovations, `NIS_DEGREES_OF_FREEDOM` is right; nis_inside: share within their two-sided bounds of
    `NIS_PROBABILITY`; used: share of the pairs that were not rejected.
    """

    poses: int
    path_length_m: float
    metrics: Mapping[str, float | int | None]
    end_sigma_m: float | None
    end_sigma_rad: float | None
    nis_mean: float | None
    nis_inside: float | None
    used: float | None


@dataclass(frozen=True, slots=True)
class Analysis:
    """What was found; statistics and results by topic or name. frames: of the topic that plays the image."""

    found: verdict.Found
    reasons: Sequence[verdict.Reason]
    damaged: bool
    frames: int
    revisits: Revisits | None
    recorded_loops: int
    results: Mapping[str, Result]

    @property
    def answer(self) -> str:
        """Whether the log is good enough to run: "ready", "usable with limits" or "not usable"."""
        return verdict.answer(self.reasons)

    @property
    def usable(self) -> bool:
        """Whether nothing stands in the way of a run."""
        return self.answer != verdict.ANSWERS[verdict.Level.BLOCKS]

    @property
    def span_ns(self) -> tuple[int, int]:
        """First and last time of all topics."""
        topics = self.found.topics.values()
        return min((each.start_ns for each in topics), default=0), max((each.end_ns for each in topics), default=0)


@np.errstate(all="ignore")  # a log may hold numbers that no sensor measures
def analyse(path: Path, chosen: Mapping[str, str]) -> Analysis:
    """Look at all of a log; `chosen` says role -> topic where its names do not.

    Raises:
        LogError: the file cannot be read, or is not an MCAP file.
        UsageError: ``chosen`` names a role that does not exist, or a topic that cannot play it.

    """
    contents = scan(path, lambda channel: True)
    survey = Survey(path, contents)
    statistics = {
        topic: log_statistics.of_topic(channel, survey.kinds[topic], survey.times(topic))
        for topic, channel in survey.channels.items()
    }
    of_kind = {kind: [topic for topic, its in survey.kinds.items() if its == kind] for kind in survey.kinds.values()}
    images = {
        topic: log_statistics.of_images(track(survey.images(topic, SAMPLED_IMAGES), topic, SAMPLED_IMAGES))
        for topic in of_kind.get("image", ())
    }
    depths = {
        topic: log_statistics.of_depths(track(survey.depths(topic, SAMPLED_IMAGES), topic, SAMPLED_IMAGES))
        for topic in of_kind.get("depth", ())
    }
    found_events = [
        event
        for topic in of_kind.get("image", ())
        for event in events.dropped_frames(np.unique(survey.stamps(topic)), topic)
    ]
    imus: dict[str, ImuStatistics] = {}
    for topic in sorted(topic for topic, kind in survey.kinds.items() if kind in _INERTIAL):
        readings = survey.imu(topic)
        of_this = _imu_events(readings, topic)
        imus[topic] = log_statistics.of_imu(readings, _intervals(of_this, events.STAND_STILL))
        found_events += of_this

    log, refusal = _open(path, contents, chosen)
    seen = _Seen(log)
    found = verdict.Found(
        path=path,
        refusal=refusal or seen.refusal,
        faults=contents.faults(path) if log is None else [note for note in log.notes if note not in log.remarks],
        remarks=[] if log is None else log.remarks,
        roles={} if log is None else log.roles,
        topics=statistics,
        images={topic: each for topic, each in images.items() if each},
        depths={topic: each for topic, each in depths.items() if each},
        imus=imus,
        events=events.in_order([*found_events, *seen.events]),
        calibration=seen.calibration,
        trajectories=_trajectories(survey),
        choices={role: _choices(survey, role) for role in roles.CANONICAL},
    )
    return Analysis(
        found=found,
        reasons=verdict.reasons(found),
        damaged=bool(contents.faults(path)),
        frames=0 if log is None else len(log.frame_stamps()),
        revisits=seen.revisits,
        recorded_loops=seen.recorded_loops,
        results=seen.results,
    )


def _trajectories(survey: Survey) -> list[str]:
    """The topics of odometry and poses, those with most messages first; neither the truth nor what a run wrote."""
    counts = {
        topic: len(survey.times(topic).log_times_ns)
        for topic, channel in survey.channels.items()
        if encodings.ros2_type(channel) in POSE_TYPES
        and topic != topics.GROUND_TRUTH
        and not topic.startswith(topics.ODOMETRY_PREFIX)
    }
    return sorted((topic for topic, count in counts.items() if count > 1), key=lambda topic: -counts[topic])


def _choices(survey: Survey, role: str) -> list[str]:
    """The topics that could be chosen for a role."""
    return [
        topic
        for topic, channel in survey.channels.items()
        if roles.could_play(role, topic, encodings.ros2_type(channel), survey.kinds[topic])
    ]


def _open(path: Path, contents: Contents, chosen: Mapping[str, str]) -> tuple[Log | None, str]:
    """The log as a run would open it, or why it cannot."""
    try:
        return Log(path, contents, chosen), ""
    except LogError as error:
        return None, str(error)


class _Seen:
    """What only a log that can be opened shows: whether frames can be made, what the pairs say, results, revisits."""

    def __init__(self, log: Log | None) -> None:
        self.refusal = ""
        self.events: list[Event] = []
        self.calibration: ImuCalibration | None = None
        self.revisits: Revisits | None = None
        self.recorded_loops = 0
        self.results: dict[str, Result] = {}
        if log is not None:
            self._look(log)

    def _look(self, log: Log) -> None:
        truth, pairs, imu = log.ground_truth(), log.pairs(), log.imu()
        log.gnss()  # what is wrong with it is noted
        self.recorded_loops = len(log.loops())
        self.refusal = _frames_refusal(log)
        if pairs:
            topic = log.roles["pairs"]
            self.events += events.missing_pairs(log.frame_stamps(), pairs, topic)
            self.events += events.wrong_pairs(pairs, topic)
            gyro = log.roles.get("imu") or log.roles.get("gyro")
            if gyro and len(imu):
                self.calibration = calibrate(pairs, imu, log.mounting(), None)
                self.events += events.clock_jumps(imu, pairs, gyro, self.calibration)
        self.results = {name: _result(log, name, truth) for name in log.trajectory_names}
        self.revisits = _revisits(log, truth, pairs)


def _frames_refusal(log: Log) -> str:
    """Why no frame can be made of the images that a run would need, "" where it can."""
    if not log.has_frames or log.has_pairs or "camera_info" not in log.roles:
        return ""
    try:
        next(log.frames(log.frame_stamps()[:1]), None)
    except LogError as error:
        return str(error)
    return ""


def _imu_events(readings: ImuReadings, topic: str) -> list[Event]:
    """The events of an IMU, or of the half that it is."""
    stamps, rate, pull = readings.stamps_ns, readings.angular_velocity, readings.linear_acceleration
    if rate is not None and pull is not None:
        return events.of_imu(ImuSeries(stamps, rate, pull), topic)
    sensor, values = ("gyro", rate) if rate is not None else ("accelerometer", pull)
    found = events.imu_gaps(stamps, topic)
    if values is not None:
        found += events.stuck(stamps, values, topic, sensor) + events.saturated(stamps, values, topic, sensor)
    return events.in_order(found)


def _intervals(found: Sequence[Event], kind: str) -> IntArray:
    """The intervals (M, 2) of the events of a kind."""
    spans = [(event.start_ns, event.end_ns) for event in found if event.kind == kind]
    return np.array(spans, dtype=np.int64).reshape(-1, 2)


def _revisits(log: Log, truth: Trajectory | None, pairs: Sequence[PairEstimate]) -> Revisits | None:
    """Where the path comes back, by the best path that the log has; None without any."""
    if truth is not None and len(truth) > 1:
        return log_statistics.revisits(truth, "ground truth")
    if pairs:
        steps, _ = chain.bridge_gaps(log.frame_stamps(), pairs, None)
        return log_statistics.revisits(chain.chain(steps), "pair estimates")
    return None


def _result(log: Log, name: str, truth: Trajectory | None) -> Result:
    trajectory = log.trajectory(name)
    if trajectory is None:
        return Result(0, 0.0, {}, None, None, None, None, None)
    end_sigma_m, end_sigma_rad = trajectory.end_sigmas or (None, None)
    series = log.estimator(name)
    nis = np.zeros(0) if series is None else series.nis[np.isfinite(series.nis)]
    low, high = chi2.interval(NIS_PROBABILITY, NIS_DEGREES_OF_FREEDOM)
    return Result(
        poses=len(trajectory),
        path_length_m=trajectory.path_length_m,
        metrics=asdict(evaluate(trajectory, truth)) if truth is not None else {},
        end_sigma_m=end_sigma_m,
        end_sigma_rad=end_sigma_rad,
        nis_mean=None if series is None else series.nis_mean,
        nis_inside=float(np.mean((nis >= low) & (nis <= high))) if len(nis) else None,
        used=None if series is None else float(series.used.mean()),
    )


# ---------------------------------------------------------------------------------------------- document


def document(analysis: Analysis) -> dict[str, Any]:
    """The analysis as JSON; its keys stay. Times `*_s` are seconds on the clock of the stamps."""
    found = analysis.found
    start_ns, end_ns = analysis.span_ns
    everything = {
        "schema": SCHEMA,
        "log": {
            "path": str(found.path),
            "damaged": analysis.damaged,
            "messages": sum(each.messages for each in found.topics.values()),
            "frames": analysis.frames,
            "start_s": start_ns / NANOSECONDS,
            "end_s": end_ns / NANOSECONDS,
            "roles": dict(found.roles),
        },
        "verdict": {
            "answer": analysis.answer,
            "reasons": [
                {
                    "level": reason.level.name.lower(),
                    "topic": reason.topic or None,
                    "time_s": _seconds(reason.at_ns),
                    "text": reason.text,
                }
                for reason in analysis.reasons
            ],
        },
        "topics": {topic: _topic(each) for topic, each in found.topics.items()},
        "images": {topic: _images(each) for topic, each in found.images.items()},
        "depth": {topic: _depths(each) for topic, each in found.depths.items()},
        "imu": {topic: _imu(each) for topic, each in found.imus.items()},
        "calibration": None if found.calibration is None else _calibration(found.calibration),
        "events": [
            {
                "kind": event.kind,
                "topic": event.topic,
                "start_s": _seconds(event.start_ns),
                "end_s": _seconds(event.end_ns),
                "text": event.text,
            }
            for event in found.events
        ],
        "loops": {"recorded": analysis.recorded_loops, "candidates": _revisited(analysis.revisits)},
        "trajectories": {name: asdict(each) for name, each in analysis.results.items()},
    }
    finite: dict[str, Any] = _finite(everything)
    return finite


def _finite(value: Any) -> Any:
    """The same without the numbers that JSON does not know, which are None."""
    if isinstance(value, dict):
        return {key: _finite(each) for key, each in value.items()}
    if isinstance(value, list):
        return [_finite(each) for each in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _topic(statistics: TopicStatistics) -> dict[str, Any]:
    values = asdict(statistics)
    for name in ("topic", "start_ns", "end_ns", "longest_gap_at_ns"):
        values.pop(name)
    return values | {
        "start_s": _seconds(statistics.start_ns),
        "end_s": _seconds(statistics.end_ns),
        "longest_gap_at_s": _seconds(statistics.longest_gap_at_ns),
    }


def _images(statistics: ImageStatistics) -> dict[str, Any]:
    return {
        "sampled": len(statistics.stamps_ns),
        "width": statistics.width,
        "height": statistics.height,
        "channels": statistics.channels,
        "brightness": _range(statistics.brightness),
        "contrast": _range(statistics.contrast),
        "dark_share": _range(statistics.dark_share),
        "bright_share": _range(statistics.bright_share),
        "sharpness": _range(statistics.sharpness),
        "repeated": int(statistics.repeated.sum()),
    }


def _depths(statistics: DepthStatistics) -> dict[str, Any]:
    return {
        "sampled": len(statistics.stamps_ns),
        "width": statistics.width,
        "height": statistics.height,
        "coverage": _range(statistics.coverage),
        "near_m": statistics.near_m,
        "median_m": statistics.median_m,
        "far_m": statistics.far_m,
    }


def _imu(statistics: ImuStatistics) -> dict[str, Any]:
    return {
        "samples": statistics.samples,
        "still_s": statistics.still_s,
        "largest_rate_rad_s": statistics.largest_rate,
        "largest_acceleration_m_s2": statistics.largest_acceleration,
        "gravity_m_s2": statistics.gravity,
        "gyro": _noise(statistics.gyro, statistics.angular_velocity_std),
        "accelerometer": _noise(statistics.accelerometer, statistics.linear_acceleration_std),
    }


def _noise(estimate: NoiseEstimate | None, stated_std: float | None) -> dict[str, Any] | None:
    """Noise of one half of an IMU, in SI units for x, y, z."""
    if estimate is None:
        return None
    return {
        "method": estimate.method,
        "seconds": estimate.seconds,
        "noise_density": estimate.density.tolist(),
        "bias_instability": _list(estimate.bias_instability),
        "mean_while_still": _list(estimate.bias),
        "stated_std": stated_std,
    }


def _calibration(calibration: ImuCalibration) -> dict[str, Any]:
    known = placement(calibration, None)
    rotation, std_rad = known.rotation_imu_camera, known.rotation_std_rad
    return {
        "used": calibration.used,
        "reason": calibration.reason,
        "rotation_imu_camera_quat_wxyz": None if rotation is None else rotation.as_quat(scalar_first=True).tolist(),
        "rotation_std_deg": None if std_rad is None else np.rad2deg(std_rad).tolist(),
        "time_offset_s": known.time_offset_s,
        "time_offset_std_s": known.time_offset_std_s,
        "gyro_bias_rad_s": calibration.gyro_bias.tolist(),
    }


def _revisited(revisits: Revisits | None) -> dict[str, Any] | None:
    if revisits is None:
        return None
    return {
        "source": revisits.source,
        "frames": revisits.frames,
        "stretches": revisits.stretches,
        "first_s": _seconds(revisits.first_ns),
    }


def _range(values: NDArray[Any]) -> dict[str, float]:
    return {"min": float(values.min()), "median": float(np.median(values)), "max": float(values.max())}


def _list(values: NDArray[Any] | None) -> list[float] | None:
    return None if values is None else values.tolist()


def _seconds(stamp_ns: int | None) -> float | None:
    return None if stamp_ns is None else stamp_ns / NANOSECONDS
