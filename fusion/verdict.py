"""Whether a log is good enough to run, and why: what was found, as reasons with file, topic and time."""

from __future__ import annotations

import shlex
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from pathlib import Path

import numpy as np

from fusion.events import DROPPED_FRAMES, IMU_GAP, MISSING_PAIRS, STAND_STILL, WRONG_PAIR, Event
from fusion.imu import ImuCalibration
from fusion.log_statistics import DepthStatistics, ImageStatistics, ImuStatistics, TopicStatistics
from fusion_io.records import NANOSECONDS
from fusion_io.words import counted

GRAVITY = 9.81
GRAVITY_TOLERANCE = 0.5  # m/s^2: more is a bias, a wrong scale, or another unit
LARGEST_RATE = 35.0  # rad/s: 2000 deg/s, the range of usual gyros; more is probably deg/s
STATED_NOISE_RATIO = 10.0
IMU_SAMPLES_A_FRAME = 5.0
FEWEST_FRAMES = 2
SLOWEST_FRAMES_HZ = 2.0

DARK_BRIGHTNESS, BRIGHT_BRIGHTNESS = 25.0, 230.0
CLIPPED_SHARE = 0.25
LEAST_CONTRAST = 10.0
BLURRED = 0.2  # of the median sharpness
FEW_IMAGES = 0.1
LEAST_COVERAGE, POOR_COVERAGE = 0.02, 0.2
CLOCK_RANGE_S = 0.5

# What lasts for so small a share of its topic is worth knowing, and no limit. A sensor that lies is always one.
SHORT_SHARE = 0.01
MISSING = {IMU_GAP, DROPPED_FRAMES, MISSING_PAIRS, WRONG_PAIR}


class Level(IntEnum):
    """How much a reason weighs."""

    NOTE = 0
    LIMIT = 1
    BLOCKS = 2


ANSWERS = {Level.NOTE: "ready", Level.LIMIT: "usable with limits", Level.BLOCKS: "not usable"}


@dataclass(frozen=True, slots=True)
class Reason:
    """One thing to know about a log; topic "" and time None where it concerns all of it."""

    level: Level
    text: str
    topic: str = ""
    at_ns: int | None = None

    def line(self, file: str) -> str:
        """With file, topic and time."""
        where = f"{file}: {self.topic}" if self.topic else file
        when = "" if self.at_ns is None else f" at {self.at_ns / NANOSECONDS:.3f} s"
        return f"{where}{when}: {self.text}"


@dataclass(frozen=True, slots=True)
class Found:
    """What a log holds and what is known of it; roles as in ``fusion_io.roles``, statistics by topic.

    calibration: of the IMU by the recorded pair estimates, None without them. trajectories: topics of somebody's
    odometry or poses. choices: topics that could be chosen for a role that none is found for, by role.
    refusal: why the log cannot be opened to run, "" where it can. faults, remarks: lines of the reader on what is wrong
    with the log, and on what is worth knowing.
    """

    path: Path
    refusal: str
    faults: Sequence[str]
    remarks: Sequence[str]
    roles: Mapping[str, str]
    topics: Mapping[str, TopicStatistics]
    images: Mapping[str, ImageStatistics]
    depths: Mapping[str, DepthStatistics]
    imus: Mapping[str, ImuStatistics]
    events: Sequence[Event] = ()
    calibration: ImuCalibration | None = None
    trajectories: Sequence[str] = ()
    choices: Mapping[str, Sequence[str]] = field(default_factory=dict)

    @property
    def held(self) -> Collection[str]:
        """The roles that the log can fill; where it could not be opened, those that some topic of it fits."""
        return self.roles.keys() or {each.kind for each in self.topics.values()} - {""}


def reasons(found: Found) -> list[Reason]:
    """All reasons, those that weigh most first."""
    everything = [
        *_contents(found),
        *[_reported(found, line, Level.LIMIT) for line in found.faults],
        *[_reported(found, line, Level.NOTE) for line in found.remarks],
        *_rates(found),
        *[reason for topic, statistics in found.images.items() for reason in _light(topic, statistics)],
        *[reason for topic, statistics in found.depths.items() for reason in _coverage(topic, statistics)],
        *[reason for topic, statistics in found.imus.items() for reason in _inertial(found.topics[topic], statistics)],
        *_times(found),
        *_events(found),
    ]
    return sorted(everything, key=lambda reason: -reason.level)


def answer(found: Sequence[Reason]) -> str:
    """The verdict: "ready", "usable with limits" or "not usable"."""
    return ANSWERS[max((reason.level for reason in found), default=Level.NOTE)]


def _reported(found: Found, line: str, level: Level) -> Reason:
    """A line of the reader, "file: topic: what" or "file: what"."""
    text = line.removeprefix(f"{found.path}: ")
    topic, _, what = text.partition(": ")
    return Reason(level, what, topic) if topic in found.topics else Reason(level, text)


def _contents(found: Found) -> Iterable[Reason]:
    """Whether there is something to run on at all: everything that stands in the way, not only the first of it."""
    if found.refusal:
        yield _reported(found, found.refusal, Level.BLOCKS)
    roles, held = found.roles, found.held
    if "pairs" not in held:
        missing = [role for role in _NEEDED if role not in held]
        if missing and held:
            words = ", ".join(_NEEDED[role] for role in missing)
            text = f"no pair estimates, and to make some it lacks {words}"
            yield Reason(Level.BLOCKS, text + _how_to_choose(found, missing))
        elif "image" in roles and (frames := found.topics[roles["image"]]).messages < FEWEST_FRAMES:
            images = counted(frames.messages, "image")
            yield Reason(Level.BLOCKS, f"{images}: a pair needs two", frames.topic, frames.start_ns)
        if missing and found.trajectories:
            yield Reason(Level.BLOCKS, _of_a_trajectory(found))
    if held and "imu" not in held and not {"gyro", "accelerometer"} <= set(held):
        text = "no IMU: there is little that fusion can add to the pair estimates"
        yield Reason(Level.LIMIT, text + _how_to_choose(found, ["imu"]))
    if found.calibration is not None and not found.calibration.used:
        topic = roles.get("imu") or roles.get("gyro", "")
        yield Reason(Level.LIMIT, f"the IMU would be left out: {found.calibration.reason}", topic)
    if held and "ground_truth" not in held:
        text = "no ground truth: errors cannot be computed"
        yield Reason(Level.NOTE, text + _how_to_choose(found, ["ground_truth"]))


def _how_to_choose(found: Found, missing: Sequence[str]) -> str:
    """The options that give these roles a topic, where some topic could play them."""
    options = [f"--topic {role}={topic}" for role in missing for topic in found.choices.get(role, ())]
    return f"; if a topic holds it under another name, say so: {' or '.join(options)}" if options else ""


def _of_a_trajectory(found: Found) -> str:
    """That a trajectory has to become pair estimates first, and how."""
    log = shlex.quote(str(found.path))
    imu = f" --imu {log}" if "imu" in found.held else ""
    command = f"violearner convert trajectory --poses {log} --topic {found.trajectories[0]}{imu} --out pairs.mcap"
    return f"it holds a trajectory instead ({', '.join(found.trajectories)}): make pair estimates of it with {command}"


_NEEDED = {"image": "images", "depth": "depth", "camera_info": "camera info"}


def _rates(found: Found) -> Iterable[Reason]:
    """Whether frames and IMU samples follow each other fast enough."""
    frames = next((found.topics[found.roles[role]] for role in ("image", "pairs") if role in found.roles), None)
    if frames is None or not frames.rate_hz:
        return
    if frames.rate_hz < SLOWEST_FRAMES_HZ:
        text = f"{frames.rate_hz:.2g} frames a second: the images will hardly overlap in motion"
        yield Reason(Level.LIMIT, text, frames.topic, frames.start_ns)
    for role in ("imu", "gyro"):
        imu = found.topics.get(found.roles.get(role, ""))
        if imu is None:
            continue
        if imu.rate_hz and imu.rate_hz < IMU_SAMPLES_A_FRAME * frames.rate_hz:
            text = f"{imu.rate_hz:.3g} Hz for {frames.rate_hz:.3g} frames a second: the motion between frames is lost"
            yield Reason(Level.LIMIT, text, imu.topic, imu.start_ns)
        if imu.end_ns < frames.start_ns or imu.start_ns > frames.end_ns:
            yield Reason(Level.LIMIT, f"has no time in common with {frames.topic}", imu.topic, imu.start_ns)


def _light(topic: str, statistics: ImageStatistics) -> Iterable[Reason]:
    """Whether the images show enough to align them."""
    count = len(statistics.stamps_ns)
    tests = (
        (statistics.brightness < DARK_BRIGHTNESS, "nearly black"),
        (statistics.brightness > BRIGHT_BRIGHTNESS, "nearly white"),
        (statistics.bright_share > CLIPPED_SHARE, f"overexposed in more than {CLIPPED_SHARE:.0%} of their pixels"),
        (statistics.dark_share > CLIPPED_SHARE, f"underexposed in more than {CLIPPED_SHARE:.0%} of their pixels"),
        (statistics.contrast < LEAST_CONTRAST, "almost without contrast"),
        (statistics.sharpness < BLURRED * np.median(statistics.sharpness), "much less sharp than the others"),
        (statistics.repeated, "the same as the one sampled before"),
    )
    for wrong, what in tests:
        if np.any(wrong):
            first_ns = int(statistics.stamps_ns[np.argmax(wrong)])
            level = Level.LIMIT if np.mean(wrong) > FEW_IMAGES else Level.NOTE
            yield Reason(level, f"{int(wrong.sum())} of {count} sampled images are {what}", topic, first_ns)


def _coverage(topic: str, statistics: DepthStatistics) -> Iterable[Reason]:
    """Whether enough pixels have depth."""
    count = len(statistics.stamps_ns)
    if np.all(statistics.coverage < LEAST_COVERAGE):
        yield Reason(Level.BLOCKS, "no depth in any sampled image", topic, int(statistics.stamps_ns[0]))
        return
    poor = statistics.coverage < POOR_COVERAGE
    if np.any(poor):
        text = f"{int(poor.sum())} of {count} sampled depth images cover less than {POOR_COVERAGE:.0%} of their pixels"
        yield Reason(Level.LIMIT, text, topic, int(statistics.stamps_ns[np.argmax(poor)]))


def _inertial(times: TopicStatistics, statistics: ImuStatistics) -> Iterable[Reason]:
    """Whether the units and the stated noise can be right."""
    topic, gravity, rate = times.topic, statistics.gravity, statistics.largest_rate
    if gravity is not None and abs(gravity - GRAVITY) > GRAVITY_TOLERANCE:
        unit = ": it looks like g, not m/s^2" if abs(gravity - 1.0) < 0.1 else ""
        yield Reason(Level.LIMIT, f"accelerations of {gravity:.2f} m/s^2 in the median, not {GRAVITY}{unit}", topic)
    if rate is not None and rate > LARGEST_RATE:
        yield Reason(Level.LIMIT, f"turns at {rate:.0f} rad/s: it looks like deg/s, not rad/s", topic)
    halves = (
        ("gyro", "rad/s", statistics.gyro, statistics.angular_velocity_std),
        ("accelerometer", "m/s^2", statistics.accelerometer, statistics.linear_acceleration_std),
    )
    for sensor, unit, noise, stated in halves:
        if noise is None or stated is None or times.rate_hz is None:
            continue
        seen = float(np.max(noise.density)) * np.sqrt(times.rate_hz)
        if seen > STATED_NOISE_RATIO * stated or stated > STATED_NOISE_RATIO * seen:
            text = f"states a noise of {stated:.2g} {unit} a sample for the {sensor}, and shows {seen:.2g} {unit}"
            yield Reason(Level.NOTE, f"{text} ({noise.method})", topic)


def _times(found: Found) -> Iterable[Reason]:
    """Clocks that disagree, and stamps that are out of order where the reader does not say so."""
    for topic, times in found.topics.items():
        spread = times.clock_offset_range_s
        if spread is not None and spread > CLOCK_RANGE_S:
            text = f"the time from stamp to recording, {times.clock_offset_s:.2f} s, varies by {spread:.2f} s"
            yield Reason(Level.NOTE, text, topic, times.start_ns)
        if times.backward and times.clock == "stamp" and topic not in found.roles.values():
            text = f"{counted(times.backward, 'stamp goes', 'stamps go')} back in time"
            yield Reason(Level.NOTE, text, topic, times.start_ns)


def _events(found: Found) -> Iterable[Reason]:
    """One reason for each kind of event on a topic."""
    groups: dict[tuple[str, str], list[Event]] = {}
    for event in found.events:
        groups.setdefault((event.kind, event.topic), []).append(event)
    for (kind, topic), group in groups.items():
        total = sum(event.duration_s for event in group)
        text = f"{kind}, {group[0].text}"
        if len(group) > 1:
            longest = max(event.duration_s for event in group)
            text += f" (the first of {len(group)} times; {total:.1f} s in all, the longest {longest:.2f} s)"
        times = found.topics[topic]
        short = kind in MISSING and total * NANOSECONDS <= SHORT_SHARE * (times.end_ns - times.start_ns)
        level = Level.NOTE if short or kind == STAND_STILL else Level.LIMIT
        yield Reason(level, text, topic, group[0].start_ns)
