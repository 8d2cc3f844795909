"""What went wrong with the sensors of a log, or is worth knowing: when it began, when it ended, and its name.

Every function looks at one kind of thing in arrays and returns its events in order of time, on the clock of the stamps
that it was given; none of them raises on odd data.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_closing, median_filter, uniform_filter1d
from scipy.spatial.transform import RigidTransform, Rotation
from scipy.stats import chi2

from fusion import clocks, sensors
from fusion.imu import WANDERS, BiasStep, ImuCalibration
from fusion.sensors import MAD_TO_STD, runs
from fusion_io.records import NANOSECONDS, FloatArray, ImuSeries, IntArray, PairEstimate, Trajectory
from fusion_io.words import counted

IMU_GAP = "IMU gap"
STUCK = "sensor stuck"
SATURATED = "sensor saturated"
CLOCK_JUMP = "clock jump"
DROPPED_FRAMES = "dropped frames"
MISSING_PAIRS = "missing pairs"
WRONG_PAIR = "wrong pairs"
CONTRADICTION = "contradiction"
BIAS_STEP = "bias step"
BIAS_WANDERS = "bias wanders"
STAND_STILL = "stand-still"

FAULTS = (
    *(IMU_GAP, STUCK, SATURATED, CLOCK_JUMP, DROPPED_FRAMES, MISSING_PAIRS, WRONG_PAIR, CONTRADICTION),
    *(BIAS_STEP, BIAS_WANDERS),
)
"""The kinds that are a sensor's fault; a stand-still is not."""

# A hole is where samples are further apart than so many of their median periods.
IMU_HOLE_PERIODS = 2.5
FRAME_HOLE_PERIODS = 1.5

# An IMU at rest: within a second its readings spread no more than this.
REST_WINDOW_S = 1.0
REST_SHORTEST_S = 2.0
REST_GYRO = 0.006  # rad/s
REST_ACCELERATION = 0.06  # m/s^2
REST_RATE = 0.05  # rad/s, more than the bias of a sound gyro: a steady turn shakes little, too
REST_SPEED = 0.2  # m/s, of a trajectory over REST_WINDOW_S

# A pair is wrong that is this unlikely, by its own covariance made as wide as the bulk of all pairs needs.
WRONG_PROBABILITY = 1e-6
# Where so large a share of so many pairs is far from the fused motion, it may as well be the fusion that is wrong.
LASTING_PAIRS = 21
LASTING_SHARE = 0.3
WRONG_PAUSE_PAIRS = 2  # so few good pairs between wrong ones do not make them two events
NEIGHBOURS = 5  # a pair and those around it, of whose motions the median is taken
UNUSUAL_ACCELERATION = 15.0  # m/s^2: no vehicle changes its velocity faster between two frames
UNUSUAL_ANGULAR_ACCELERATION = 6.0  # rad/s^2


@dataclass(frozen=True, slots=True)
class Event:
    """A stretch of time in which something was the matter, half open, and what: one line that names the numbers."""

    start_ns: int
    end_ns: int
    kind: str
    topic: str
    text: str

    @property
    def is_fault(self) -> bool:
        """Whether a sensor is to blame."""
        return self.kind in FAULTS

    @property
    def duration_s(self) -> float:
        """How long it lasted."""
        return (self.end_ns - self.start_ns) / NANOSECONDS


def in_order(events: Iterable[Event]) -> list[Event]:
    """All events by their start."""
    return sorted(events, key=lambda event: (event.start_ns, event.end_ns, event.kind, event.topic))


# ---------------------------------------------------------------------------------------------- stamps


def imu_gaps(stamps_ns: IntArray, topic: str) -> list[Event]:
    """Where samples (N,) are further apart than an IMU's jitter explains."""
    return [
        Event(start, end, IMU_GAP, topic, f"no sample for {(end - start) / NANOSECONDS:.2f} s ({missing} missing)")
        for start, end, missing in _holes(stamps_ns, IMU_HOLE_PERIODS)
    ]


def dropped_frames(stamps_ns: IntArray, topic: str) -> list[Event]:
    """Where frames (N,) are missing from their rhythm."""
    return [
        Event(start, end, DROPPED_FRAMES, topic, f"{counted(missing, 'frame')} missing")
        for start, end, missing in _holes(stamps_ns, FRAME_HOLE_PERIODS)
    ]


def missing_pairs(frame_stamps_ns: IntArray, pairs: Sequence[PairEstimate], topic: str) -> list[Event]:
    """Where frames (N,) follow each other and no pair leads across; nothing where there are no pairs at all.

    Where only the pairs tell when there were frames (N = 0), those that are missing from their rhythm.
    """
    if not pairs:
        return []
    frames = np.asarray(frame_stamps_ns)
    spans = np.array([(pair.source_stamp_ns, pair.target_stamp_ns) for pair in pairs], dtype=np.int64).reshape(-1, 2)
    if not len(frames):
        return dropped_frames(np.unique(spans), topic)
    # How many pairs cover each interval between frames: +1 where a pair starts, -1 where it ends.
    cover = np.zeros(len(frames) + 1, dtype=np.int64)
    np.add.at(cover, np.searchsorted(frames, spans[:, 0], side="right") - 1, 1)
    np.add.at(cover, np.searchsorted(frames, spans[:, 1]), -1)
    bare = np.cumsum(cover)[: max(len(frames) - 1, 0)] <= 0
    return [
        Event(
            int(frames[run.start]),
            int(frames[run.stop]),
            MISSING_PAIRS,
            topic,
            f"no pair estimate across {run.stop - run.start} of the intervals between frames",
        )
        for run in runs(bare)
    ]


def _holes(stamps_ns: IntArray, longest_periods: float) -> Iterator[tuple[int, int, int]]:
    """Start, end and number of missing samples of every hole."""
    periods = np.diff(stamps_ns)
    if not len(periods):
        return
    usual = float(np.median(periods))
    for i in np.flatnonzero(periods > longest_periods * usual):
        yield int(stamps_ns[i]), int(stamps_ns[i + 1]), round(float(periods[i]) / usual) - 1


# ---------------------------------------------------------------------------------------------- values of an IMU


def of_imu(imu: ImuSeries, topic: str) -> list[Event]:
    """All that the samples of an IMU show by themselves: gaps, stuck and saturated sensors, stand-still."""
    events = [*imu_gaps(imu.stamps_ns, topic), *at_rest(imu, topic)]
    for sensor, values in (("gyro", imu.angular_velocity), ("accelerometer", imu.linear_acceleration)):
        events += stuck(imu.stamps_ns, values, topic, sensor)
        events += saturated(imu.stamps_ns, values, topic, sensor)
    return in_order(events)


def stuck(stamps_ns: IntArray, values: FloatArray, topic: str, sensor: str) -> list[Event]:
    """Where values (N, M) repeat themselves or run in exactly equal steps on all axes: they were not measured."""
    events = []
    for run in sensors.frozen(values):
        repeats = not np.any(np.diff(values[run], axis=0))
        how = "repeats one value" if repeats else "runs in equal steps, as if it had been filled in"
        start, end = int(stamps_ns[run.start]), int(stamps_ns[run.stop - 1])
        events.append(Event(start, end, STUCK, topic, f"the {sensor} {how} ({run.stop - run.start} samples)"))
    return events


def saturated(stamps_ns: IntArray, values: FloatArray, topic: str, sensor: str) -> list[Event]:
    """Where an axis of values (N, M) stays at the end of the sensor's range."""
    events = []
    for axis, limit, run in sensors.clipped(values):
        text = f"the {sensor}'s {_axis(axis)} axis stays at {limit:.4g}, the end of its range"
        events.append(Event(int(stamps_ns[run.start]), int(stamps_ns[run.stop - 1]), SATURATED, topic, text))
    return in_order(events)


def at_rest(imu: ImuSeries, topic: str) -> list[Event]:
    """Where the IMU neither turns nor shakes for a while: the vehicle stands."""
    if len(imu) < sensors.MIN_SAMPLES:
        return []
    period_s = float(np.median(np.diff(imu.stamps_ns))) / NANOSECONDS
    width = max(round(REST_WINDOW_S / period_s), 3)
    turning = np.max([_moving_spread(axis, width) for axis in imu.angular_velocity.T], axis=0)
    shaking = np.max([_moving_spread(axis, width) for axis in imu.linear_acceleration.T], axis=0)
    slow = np.max(np.abs(imu.angular_velocity), axis=1) < REST_RATE
    alive = (turning > 0.0) & (shaking > 0.0)
    still = alive & slow & (turning < REST_GYRO) & (shaking < REST_ACCELERATION)
    events = []
    for run in runs(binary_closing(still, np.ones(width)) | still):
        start, end = int(imu.stamps_ns[run.start]), int(imu.stamps_ns[run.stop - 1])
        if end - start >= REST_SHORTEST_S * NANOSECONDS:
            events.append(Event(start, end, STAND_STILL, topic, "the IMU neither turns nor shakes"))
    return events


def standing(trajectory: Trajectory, topic: str) -> list[Event]:
    """Where a trajectory does not move for a while."""
    window_ns = int(REST_WINDOW_S * NANOSECONDS)
    stamps_ns = trajectory.stamps_ns
    ahead = np.minimum(np.searchsorted(stamps_ns, stamps_ns + window_ns), len(stamps_ns) - 1)
    moved = np.linalg.norm(trajectory.poses.translation[ahead] - trajectory.poses.translation, axis=1)
    still = (moved < REST_SPEED * REST_WINDOW_S) & (stamps_ns[ahead] - stamps_ns >= window_ns)
    events = []
    for run in runs(still):
        start, end = int(stamps_ns[run.start]), int(stamps_ns[ahead[run.stop - 1]])
        if end - start >= REST_SHORTEST_S * NANOSECONDS:
            events.append(Event(start, end, STAND_STILL, topic, "the camera does not move"))
    return events


# ---------------------------------------------------------------------------------------------- IMU and pairs


def clock_jumps(
    imu: ImuSeries, pairs: Sequence[PairEstimate], topic: str, calibration: ImuCalibration | None = None
) -> list[Event]:
    """Where the clock of the IMU jumps against the camera's, on the camera's clock.

    As the calibration found them, if it did. Otherwise both tell how fast they turn, which needs no mounting: where the
    offset that makes them agree best changes for good, the stamps of one of them jumped. A forward jump looks like a
    gap, a backward one like samples out of order: the offset is what tells it from those.
    """
    events = []
    for jump in (calibration.clock_jumps if calibration else []) or clocks.jumps(imu, pairs):
        text = f"the clock of the IMU jumps by {jump.by_s:+.2f} s against the camera's"
        events.append(Event(jump.at_ns, jump.at_ns + NANOSECONDS // 2, CLOCK_JUMP, topic, text))
    return events


def bias_steps(steps: Sequence[BiasStep], topic: str) -> list[Event]:
    """Where a bias of the IMU stepped, to a second, on the camera's clock; and where it wanders."""
    known = [step for step in steps if step.is_known]
    found = [Event(step.at_ns - NANOSECONDS, step.at_ns, BIAS_STEP, topic, str(step)) for step in known]
    if unknown_ns := [step.at_ns for step in steps if not step.is_known]:
        found.append(Event(min(unknown_ns), max(unknown_ns), BIAS_WANDERS, topic, WANDERS))
    return found


def contradictions(faulty_ns: IntArray, time_offset_s: float, known: Sequence[Event], topic: str) -> list[Event]:
    """The stretches (M, 2) on the IMU's clock in which gyro and pairs contradict each other, on the camera's clock.

    Those that overlap what is known to be wrong with the IMU say nothing new.
    """
    moved = np.asarray(faulty_ns, dtype=np.int64).reshape(-1, 2) - round(time_offset_s * NANOSECONDS)
    return [
        Event(int(start), int(end), CONTRADICTION, topic, "gyro and pairs turn differently; left out of the fusion")
        for start, end in moved
        if not any(event.start_ns < end and start < event.end_ns for event in known)
    ]


# ---------------------------------------------------------------------------------------------- pairs


def wrong_pairs(
    pairs: Sequence[PairEstimate],
    topic: str,
    fused: Trajectory | None = None,
    rejected: NDArray[np.bool_] | None = None,
) -> list[Event]:
    """Pair estimates (N) that cannot be right: against their neighbours, a fused trajectory, or a back end's gate (N,).

    Give a fused trajectory only where it has an IMU or loops to judge the pairs by. Front ends fail for single pairs;
    where the two differ for long, it is left open (as a contradiction) which of them is wrong.
    """
    if not pairs:
        return []
    far = np.zeros(len(pairs), dtype=bool) if fused is None else _far_from(pairs, fused)
    share = uniform_filter1d(far.astype(np.float64), LASTING_PAIRS, mode="constant")
    lasting = binary_closing(share > LASTING_SHARE, np.ones(LASTING_PAIRS)) | (share > LASTING_SHARE)
    reasons = {
        "rejected by the back end": np.zeros(len(pairs), dtype=bool) if rejected is None else rejected,
        "far from the fused motion": far & ~lasting,
        "unlike its neighbours": _unlike_neighbours(pairs),
    }
    wrong = np.any(list(reasons.values()), axis=0)
    events = [
        Event(
            pairs[run.start].source_stamp_ns,
            pairs[run.stop - 1].target_stamp_ns,
            CONTRADICTION,
            topic,
            f"the fused motion is far from {far[run].sum()} of {run.stop - run.start} pairs",
        )
        for run in runs(lasting)
        if np.any(far[run])
    ]
    for run in runs(binary_closing(wrong, np.ones(WRONG_PAUSE_PAIRS + 1)) | wrong):
        count = int(wrong[run].sum())
        why = " and ".join(reason for reason, found in reasons.items() if np.any(found[run]))
        start, end = pairs[run.start].source_stamp_ns, pairs[run.stop - 1].target_stamp_ns
        text = f"{counted(count, 'pair')}: {why}"
        events.append(Event(start, end, WRONG_PAIR, topic, text))
    return in_order(events)


def deviations(pairs: Sequence[PairEstimate], fused: Trajectory) -> FloatArray:
    """How far each pair (N) is from the motion of a trajectory: the squared distance by the pair's covariance (N,).

    NaN where the trajectory does not span the pair. Six are expected of an unbiased pair whose motion is known.
    """
    stamps = np.array([(pair.source_stamp_ns, pair.target_stamp_ns) for pair in pairs], dtype=np.int64).reshape(-1, 2)
    known = fused.covers(stamps[:, 0]) & fused.covers(stamps[:, 1])
    squares = np.full(len(pairs), np.nan)
    if not np.any(known):
        return squares
    chosen = [pair for pair, good in zip(pairs, known, strict=True) if good]
    quats_wxyz = np.stack([pair.quat_wxyz for pair in chosen])
    translation = np.stack([pair.translation for pair in chosen])
    rotation = Rotation.from_quat(quats_wxyz, scalar_first=True)
    seen = RigidTransform.from_components(translation, rotation)
    moved = fused.at(stamps[known, 0]).inv() * fused.at(stamps[known, 1])
    residual = (seen.inv() * moved).as_exp_coords()
    covariances = np.stack([pair.covariance for pair in chosen])
    squares[known] = np.sum(residual * np.linalg.solve(covariances, residual[..., None])[..., 0], axis=1)
    return squares


def _far_from(pairs: Sequence[PairEstimate], fused: Trajectory) -> NDArray[np.bool_]:
    squares = deviations(pairs, fused)
    known = np.isfinite(squares)
    if not np.any(known):
        return known
    bulk = float(np.median(squares[known])) / float(chi2.median(6))
    return np.asarray(known & (squares > max(bulk, 1.0) * chi2.isf(WRONG_PROBABILITY, 6)))


def _unlike_neighbours(pairs: Sequence[PairEstimate]) -> NDArray[np.bool_]:
    """Pairs whose velocity differs from the median of those around them by more than bulk and physics explain."""
    if len(pairs) < NEIGHBOURS:
        return np.zeros(len(pairs), dtype=bool)
    duration = np.array([pair.duration_s for pair in pairs])[:, None]
    rotations = Rotation.from_quat(np.stack([pair.quat_wxyz for pair in pairs]), scalar_first=True)
    velocity = np.stack([pair.translation for pair in pairs]) / duration
    rate = rotations.as_rotvec() / duration
    unlike = np.zeros(len(pairs), dtype=bool)
    for values, acceleration in ((velocity, UNUSUAL_ACCELERATION), (rate, UNUSUAL_ANGULAR_ACCELERATION)):
        off = np.linalg.norm(values - median_filter(values, size=(NEIGHBOURS, 1), mode="nearest"), axis=1)
        gate = np.sqrt(chi2.isf(WRONG_PROBABILITY, 3))
        unlike |= off > np.maximum(gate * MAD_TO_STD * np.median(off), acceleration * duration[:, 0])
    return unlike


# ---------------------------------------------------------------------------------------------- small things


def _moving_spread(values: FloatArray, width: int) -> FloatArray:
    """Standard deviation of values (N,) in a window around each."""
    kernel = np.ones(width) / width
    centred = values - values.mean()
    padded = np.pad(centred, (width // 2, width - 1 - width // 2), mode="edge")
    mean, square = np.convolve(padded, kernel, "valid"), np.convolve(padded**2, kernel, "valid")
    return np.asarray(np.sqrt(np.maximum(square - mean**2, 0.0)))


def _axis(index: int) -> str:
    return "xyz"[index] if index < 3 else str(index)
