"""The trajectories that a log holds, of whoever computed them: every topic of odometry or of poses."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from fusion_io import encodings, messages, poses, topics
from fusion_io.container import Channel, Contents, MessageFile
from fusion_io.errors import LogError, UsageError
from fusion_io.records import Trajectory
from fusion_io.recovery import scan
from fusion_io.words import counted

POSE_TYPES = (messages.ODOMETRY, messages.POSE_STAMPED, messages.POSE_WITH_COVARIANCE)


@dataclass(frozen=True, slots=True)
class RecordedTrajectories:
    """The trajectories of a log by name, its ground truth, and what else is told about them.

    A name is that of the result for topics of ours (``/odometry/ekf`` is ``ekf``), and otherwise the topic's with an
    underscore for all that is no letter. metadata: named records of text. damaged: the file is not as it was written.
    notes: a line for everything that was left out.
    """

    trajectories: Mapping[str, Trajectory]
    ground_truth: Trajectory | None
    metadata: Mapping[str, Mapping[str, str]]
    damaged: bool
    notes: tuple[str, ...]


def read_trajectories(path: Path) -> RecordedTrajectories:
    """Read all odometry and poses of a log; topics with fewer than two poses are none.

    Poses that are not finite or whose quaternion is none, and those that go back in time, are left out and counted.
    Raises LogError for a file that is no MCAP file. Whether there is any trajectory is for the caller to judge.
    """
    contents = scan(path, _is_trajectory)
    notes = [damage.note for damage in contents.damage]
    channels = {channel.topic: channel for channel in contents.counts if _is_trajectory(channel)}
    found: dict[str, Trajectory] = {}
    for topic in sorted(contents.index, key=_order):
        trajectory, left_out = _read(path, contents, channels[topic])
        if left_out:
            what = counted(left_out, "pose is", "poses are")
            notes.append(f"{path}: {topic}: {what} left out: unreadable, invalid or out of order")
        if len(trajectory) > 1:
            found[topic] = trajectory
    ground_truth = found.pop(topics.GROUND_TRUTH, None)
    named: dict[str, Trajectory] = {}
    for topic, trajectory in found.items():
        name = name_of(topic)
        named[name if name not in named else f"{name}_{len(named)}"] = trajectory
    damaged = bool(contents.faults(path))
    return RecordedTrajectories(named, ground_truth, contents.metadata, damaged, tuple(notes))


def name_of(topic: str) -> str:
    """The name of the trajectory on a topic: an identifier."""
    name = re.sub(r"\W", "_", topic.removeprefix(topics.ODOMETRY_PREFIX).strip("/")) or "trajectory"
    return f"_{name}" if name[0].isdigit() else name


def _order(topic: str) -> tuple[int, str]:
    """Ours as a run writes them, then those of others by name."""
    ours = ("raw", "posegraph", "posegraph_online", "ekf", "ekf_smoothed")
    name = topic.removeprefix(topics.ODOMETRY_PREFIX)
    return (ours.index(name) if name in ours else len(ours), topic)


def _is_trajectory(channel: Channel) -> bool:
    return encodings.ros2_type(channel) in POSE_TYPES


def _read(path: Path, contents: Contents, channel: Channel) -> tuple[Trajectory, int]:
    """The trajectory on a channel (at log times where there are no stamps), and how many messages are left out."""
    message_type = encodings.ros2_type(channel)
    samples = []
    with MessageFile(path, contents.blocks) as file:
        index = encodings.stamped(file, encodings.in_cdr(contents, channel))
        stamps_ns = np.where(index.stamps_ns == 0, index.log_times_ns, index.stamps_ns)
        for i, stamp_ns in enumerate(stamps_ns.tolist()):
            with contextlib.suppress(ValueError):
                samples.append((stamp_ns, messages.decode_pose(message_type, file.read(index, i))))
    trajectory, _, _ = poses.in_order(samples)
    return trajectory, len(stamps_ns) - len(trajectory)


def trajectory_on(path: Path, recorded: RecordedTrajectories, topic: str | None) -> Trajectory:
    """The trajectory on a topic, or without one the only trajectory that a log holds.

    Raises UsageError, with those that there are, where it holds none on the topic, and LogError where none is named and
    it does not hold one.
    """
    known = dict(recorded.trajectories)
    if recorded.ground_truth is not None:
        known[name_of(topics.GROUND_TRUTH)] = recorded.ground_truth
    if topic is None and len(known) == 1:
        return next(iter(known.values()))
    if topic is not None and name_of(topic) in known:
        return known[name_of(topic)]
    asked = "which of its trajectories?" if topic is None else f"no trajectory on {topic}."
    choose = "; choose one with --topic" if known else ""
    error = LogError if topic is None else UsageError
    raise error(f"{path}: {asked} It holds {', '.join(known) or 'none'}{choose}")


def only_trajectory(path: Path, recorded: RecordedTrajectories) -> Trajectory:
    """The ground truth of a log, or the one trajectory that it holds; raises LogError where neither is there."""
    if recorded.ground_truth is not None:
        return recorded.ground_truth
    if len(recorded.trajectories) == 1:
        return next(iter(recorded.trajectories.values()))
    names = ", ".join(recorded.trajectories) or "none"
    raise LogError(f"{path}: which of its trajectories is the ground truth? It holds {names}")
