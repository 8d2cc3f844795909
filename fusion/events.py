"""What went wrong with the sensors of a log, or is worth knowing: when it began, when it ended, and its name.

Every function looks at one kind of thing in arrays and returns its events in order of time, on the clock of the stamps
that it was given; none of them raises on odd data.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_closing, binary_opening, find_objects, label, median_filter, uniform_filter1d
from scipy.spatial.transform import RigidTransform, Rotation
from scipy.stats import chi2

from fusion_io.records import NANOSECONDS, FloatArray, ImuSeries, IntArray, PairEstimate, Trajectory

IMU_GAP = "IMU gap"
STUCK = "sensor stuck"
SATURATED = "sensor saturated"
CLOCK_JUMP = "clock jump"
DROPPED_FRAMES = "dropped frames"
MISSING_PAIRS = "missing pairs"
WRONG_PAIR = "wrong pairs"
CONTRADICTION = "contradiction"
STAND_STILL = "stand-still"

FAULTS = (IMU_GAP, STUCK, SATURATED, CLOCK_JUMP, DROPPED_FRAMES, MISSING_PAIRS, WRONG_PAIR, CONTRADICTION)
"""The kinds that are a sensor's fault; a stand-still is not."""

# A hole is where samples are further apart than so many of their median periods.
IMU_HOLE_PERIODS = 2.5
FRAME_HOLE_PERIODS = 1.5

# A live sensor has noise: one that repeats itself, or runs in equal steps, for so many samples is not measuring.
STUCK_SAMPLES = 20
STUCK_KINK = 3  # so few samples may kink in between
EQUAL_STEPS = 1e-9  # of the sensor's unit

# A clipped sensor stays exactly at its largest value, which is far from its usual ones.
CLIPPED_SAMPLES = 3
CLIPPED_DEVIATIONS = 3.0

# An IMU at rest: within a second its readings spread no more than this.
REST_WINDOW_S = 1.0
REST_SHORTEST_S = 2.0
REST_GYRO = 0.006  # rad/s
REST_ACCELERATION = 0.06  # m/s^2
REST_RATE = 0.05  # rad/s, more than the bias of a sound gyro: a steady turn shakes little, too
REST_SPEED = 0.2  # m/s, of a trajectory over REST_WINDOW_S

# The clocks of IMU and camera are compared by how fast both turn, window by window. Differences beyond so many standard
# deviations count the same, so that wrong pairs do not decide; the rest is relative to that.
CLOCK_WINDOW_S = 20.0
CLOCK_HOP_S = 5.0
CLOCK_SEARCH_S = 5.0
CLOCK_STEP_S = 0.04
CLOCK_CLIP = 4.0  # standard deviations
CLOCK_GAIN = 0.15  # by which the best offset must be better than all that are further from it than...
CLOCK_ELSEWHERE_S = 0.5
CLOCK_MIN_JUMP_S = 0.1
CLOCK_MIN_PAIRS = 20
NORMAL_QUARTILE = 0.3186  # a quarter of |N(0, 1)| is below; half of a log may have another offset than the other half

# A pair is wrong that is this unlikely, by its own covariance made as wide as the bulk of all pairs needs.
WRONG_PROBABILITY = 1e-6
# Where so large a share of so many pairs is far from the fused motion, it may as well be the fusion that is wrong.
LASTING_PAIRS = 21
LASTING_SHARE = 0.3
WRONG_PAUSE_PAIRS = 2  # so few good pairs between wrong ones do not make them two events
NEIGHBOURS = 5  # a pair and those around it, of whose motions the median is taken
UNUSUAL_ACCELERATION = 15.0  # m/s^2: no vehicle changes its velocity faster between two frames
UNUSUAL_ANGULAR_ACCELERATION = 6.0  # rad/s^2
MAD_TO_STD = 1.4826


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
        Event(start, end, DROPPED_FRAMES, topic, f"{missing} {'frame' if missing == 1 else 'frames'} missing")
        for start, end, missing in _holes(stamps_ns, FRAME_HOLE_PERIODS)
    ]


def missing_pairs(frame_stamps_ns: IntArray, pairs: Sequence[PairEstimate], topic: str) -> list[Event]:
    """Where frames (N,) follow each other and no pair leads across; nothing where there are no pairs at all."""
    if not pairs:
        return []
    frames = np.asarray(frame_stamps_ns)
    spans = np.array([(pair.source_stamp_ns, pair.target_stamp_ns) for pair in pairs], dtype=np.int64).reshape(-1, 2)
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
        for run in _runs(bare)
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
    if len(values) < STUCK_SAMPLES:
        return []
    steps = np.diff(values, axis=0)
    equal = np.max(np.abs(np.diff(steps, axis=0)), axis=1) <= EQUAL_STEPS
    lasting = binary_opening(binary_closing(equal, np.ones(STUCK_KINK + 1)), np.ones(STUCK_SAMPLES))
    events = []
    for run in _runs(np.pad(lasting, 1)):  # a sample has a step on either side
        repeats = not np.any(steps[run.start : run.stop - 1])
        how = "repeats one value" if repeats else "runs in equal steps, as if it had been filled in"
        start, end = int(stamps_ns[run.start]), int(stamps_ns[run.stop - 1])
        events.append(Event(start, end, STUCK, topic, f"the {sensor} {how} ({run.stop - run.start} samples)"))
    return events


def saturated(stamps_ns: IntArray, values: FloatArray, topic: str, sensor: str) -> list[Event]:
    """Where an axis of values (N, M) stays at the end of the sensor's range."""
    if len(values) < STUCK_SAMPLES:
        return []
    events = []
    for axis, column in enumerate(values.T):
        far = CLIPPED_DEVIATIONS * _spread(column)
        for limit in (float(column.min()), float(column.max())):
            for run in _runs(column == limit) if abs(limit - float(np.median(column))) > far else ():
                # Where all axes stand still, the sensor is stuck, not clipped.
                if run.stop - run.start >= CLIPPED_SAMPLES and np.any(np.diff(values[run], axis=0)):
                    start, end = int(stamps_ns[run.start]), int(stamps_ns[run.stop - 1])
                    text = f"the {sensor}'s {_axis(axis)} axis stays at {limit:.4g}, the end of its range"
                    events.append(Event(start, end, SATURATED, topic, text))
    return in_order(events)


def at_rest(imu: ImuSeries, topic: str) -> list[Event]:
    """Where the IMU neither turns nor shakes for a while: the vehicle stands."""
    if len(imu) < STUCK_SAMPLES:
        return []
    period_s = float(np.median(np.diff(imu.stamps_ns))) / NANOSECONDS
    width = max(round(REST_WINDOW_S / period_s), 3)
    turning = np.max([_moving_spread(axis, width) for axis in imu.angular_velocity.T], axis=0)
    shaking = np.max([_moving_spread(axis, width) for axis in imu.linear_acceleration.T], axis=0)
    slow = np.max(np.abs(imu.angular_velocity), axis=1) < REST_RATE
    alive = (turning > 0.0) & (shaking > 0.0)
    still = alive & slow & (turning < REST_GYRO) & (shaking < REST_ACCELERATION)
    events = []
    for run in _runs(binary_closing(still, np.ones(width)) | still):
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
    for run in _runs(still):
        start, end = int(stamps_ns[run.start]), int(stamps_ns[ahead[run.stop - 1]])
        if end - start >= REST_SHORTEST_S * NANOSECONDS:
            events.append(Event(start, end, STAND_STILL, topic, "the camera does not move"))
    return events


# ---------------------------------------------------------------------------------------------- IMU and pairs


def clock_jumps(imu: ImuSeries, pairs: Sequence[PairEstimate], topic: str) -> list[Event]:
    """Where the clock of the IMU jumps against the camera's, on the camera's clock.

    Both tell how fast they turn, which needs no mounting. The offset that makes them agree best is found in windows;
    where it changes for good, the stamps of one of them jumped. A forward jump looks like a gap, a backward one like
    samples out of order: the offset is what tells it from those.
    """
    if len(imu) < STUCK_SAMPLES or len(pairs) < CLOCK_MIN_PAIRS:
        return []
    turning = _Turning(imu, pairs)
    events = []
    for change in _changes(list(turning.windows())):
        at_ns = turning.zero_ns + round(turning.split(change) * NANOSECONDS)
        by_s = change.after_s - change.before_s
        text = f"the clock of the IMU jumps by {by_s:+.2f} s against the camera's"
        events.append(Event(at_ns, at_ns + NANOSECONDS // 2, CLOCK_JUMP, topic, text))
    return events


@dataclass(frozen=True, slots=True)
class _Window:
    """Between start_s and end_s the two agree best with this offset."""

    start_s: float
    end_s: float
    offset_s: float


@dataclass(frozen=True, slots=True)
class _Change:
    """Somewhere between start_s and end_s the offset changes."""

    start_s: float
    end_s: float
    before_s: float
    after_s: float


class _Turning:
    """How fast the pairs turn, and how far the gyro is from that at any offset of its clock; seconds."""

    def __init__(self, imu: ImuSeries, pairs: Sequence[PairEstimate]) -> None:
        self.zero_ns = pairs[0].source_stamp_ns
        stamps = np.array([(pair.source_stamp_ns, pair.target_stamp_ns) for pair in pairs], dtype=np.int64)
        self._source_s, self._target_s = ((stamps - self.zero_ns) / NANOSECONDS).T
        rotations = Rotation.from_quat(np.stack([pair.quat_wxyz for pair in pairs]), scalar_first=True)
        speed = rotations.magnitude() / (self._target_s - self._source_s)
        self._offsets_s = np.arange(-CLOCK_SEARCH_S, CLOCK_SEARCH_S + CLOCK_STEP_S / 2, CLOCK_STEP_S)
        difference = np.abs(self._gyro_speed(imu) - speed)
        sigma = np.min(np.quantile(difference, 0.25, axis=1)) / NORMAL_QUARTILE
        clip = max(CLOCK_CLIP * float(sigma), float(np.finfo(float).eps))
        self._cost = np.minimum(difference, clip) / clip  # (offsets, pairs), 0 to 1

    def windows(self) -> Iterator[_Window]:
        """The best offset of every window in which the motion tells it."""
        for start_s in np.arange(self._source_s[0], self._target_s[-1] - CLOCK_WINDOW_S + CLOCK_HOP_S, CLOCK_HOP_S):
            inside = self._inside(start_s, start_s + CLOCK_WINDOW_S)
            if inside.sum() < CLOCK_MIN_PAIRS:
                continue
            cost = self._cost[:, inside].mean(axis=1)
            best_s = self._offsets_s[np.argmin(cost)]
            elsewhere = np.abs(self._offsets_s - best_s) > CLOCK_ELSEWHERE_S
            if np.min(cost[elsewhere]) - np.min(cost) > CLOCK_GAIN:
                yield _Window(float(start_s), float(start_s) + CLOCK_WINDOW_S, float(best_s))

    def split(self, change: _Change) -> float:
        """When the offset changes, so that the gyro fits best with the one before it and the other after it."""
        inside = self._inside(change.start_s, change.end_s)
        before, after = (self._cost[np.argmin(np.abs(self._offsets_s - s))] for s in (change.before_s, change.after_s))
        gained = np.concatenate([[0.0], np.cumsum((before - after)[inside])])
        return float(np.append(self._source_s[inside], self._target_s[inside][-1:])[np.argmin(gained)])

    def _inside(self, start_s: float, end_s: float) -> NDArray[np.bool_]:
        return np.asarray((self._source_s >= start_s) & (self._target_s <= end_s))

    def _gyro_speed(self, imu: ImuSeries) -> FloatArray:
        """Mean turning speed during each pair by the gyro, at each offset: (offsets, pairs) rad/s."""
        imu_s = (imu.stamps_ns - self.zero_ns) / NANOSECONDS
        rate = np.linalg.norm(imu.angular_velocity, axis=1)
        angle = np.concatenate([[0.0], np.cumsum((rate[1:] + rate[:-1]) / 2 * np.diff(imu_s))])
        start, end = (
            np.interp(at_s + self._offsets_s[:, None], imu_s, angle) for at_s in (self._source_s, self._target_s)
        )
        return np.asarray((end - start) / (self._target_s - self._source_s))


def _changes(windows: Sequence[_Window]) -> Iterator[_Change]:
    """Where the offset of the windows changes and stays so."""
    settled: _Window | None = None
    for window, after in zip(windows, [*windows[1:], None], strict=False):
        if settled is None or abs(window.offset_s - settled.offset_s) < CLOCK_MIN_JUMP_S:
            settled = replace(window, offset_s=settled.offset_s if settled else window.offset_s)
        elif after and abs(after.offset_s - window.offset_s) < CLOCK_MIN_JUMP_S:
            yield _Change(settled.start_s, after.end_s, settled.offset_s, after.offset_s)
            settled = after


def contradictions(faulty_ns: IntArray, time_offset_s: float, stuck_ns: Sequence[Event], topic: str) -> list[Event]:
    """The stretches (M, 2) on the IMU's clock in which gyro and pairs contradict each other, on the camera's clock.

    Those that overlap what is known to be stuck say nothing new.
    """
    moved = np.asarray(faulty_ns, dtype=np.int64).reshape(-1, 2) - round(time_offset_s * NANOSECONDS)
    return [
        Event(int(start), int(end), CONTRADICTION, topic, "gyro and pairs turn differently; left out of the fusion")
        for start, end in moved
        if not any(event.start_ns < end and start < event.end_ns for event in stuck_ns)
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
        for run in _runs(lasting)
        if np.any(far[run])
    ]
    for run in _runs(binary_closing(wrong, np.ones(WRONG_PAUSE_PAIRS + 1)) | wrong):
        count = int(wrong[run].sum())
        why = " and ".join(reason for reason, found in reasons.items() if np.any(found[run]))
        start, end = pairs[run.start].source_stamp_ns, pairs[run.stop - 1].target_stamp_ns
        text = f"{count} {'pair' if count == 1 else 'pairs'}: {why}"
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


# ---------------------------------------------------------------------------------------------- runs and spreads


def _runs(mask: NDArray[np.bool_]) -> list[slice]:
    """The runs of True in a mask (N,)."""
    return [run[0] for run in find_objects(label(mask)[0])] if len(mask) else []


def _spread(values: FloatArray) -> float:
    """Robust standard deviation of values (N,)."""
    return float(MAD_TO_STD * np.median(np.abs(values - np.median(values))))


def _moving_spread(values: FloatArray, width: int) -> FloatArray:
    """Standard deviation of values (N,) in a window around each."""
    kernel = np.ones(width) / width
    centred = values - values.mean()
    padded = np.pad(centred, (width // 2, width - 1 - width // 2), mode="edge")
    mean, square = np.convolve(padded, kernel, "valid"), np.convolve(padded**2, kernel, "valid")
    return np.asarray(np.sqrt(np.maximum(square - mean**2, 0.0)))


def _axis(index: int) -> str:
    return "xyz"[index] if index < 3 else str(index)
