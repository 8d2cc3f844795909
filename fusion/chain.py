"""From pair estimates to the raw trajectory: holes bridged, poses chained, covariance propagated to first order.

A *step* is the motion between two stamps that follow each other; steps have no holes between them.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import reduce
from itertools import accumulate, pairwise
from operator import mul
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from fusion_io.errors import LogError
from fusion_io.records import NANOSECONDS, FloatArray, ImuSeries, IntArray, PairEstimate, Trajectory

# How far a motion strays from that of its neighbours: constant accelerations of this size, unknown in direction.
# Brisk for a car, so that the covariance of a bridged hole is wide rather than narrow.
UNKNOWN_ACCELERATION = 2.0  # m/s^2
UNKNOWN_ANGULAR_ACCELERATION = 0.5  # rad/s^2
# The same where a gyro has measured the rotation: an unknown constant rate, what is left of its bias and mounting.
UNKNOWN_GYRO_RATE = 0.01  # rad/s

# An IMU has a hole where samples are further apart than this many of its periods.
MAX_IMU_PERIODS = 2.5
# So many samples that all show the same are those of a sensor that is stuck.
MIN_REPEATS = 4

# So long a carrier turns at a rate that changes evenly, nearly.
EVENLY_S = 0.1


class ImuWindow(NamedTuple):
    """An IMU over an interval of time, in M pieces that fill it.

    durations (M,) s; the mean angular_velocity (M, 3) rad/s and linear_acceleration (M, 3) m/s^2 during each.
    """

    durations: FloatArray
    angular_velocity: FloatArray
    linear_acceleration: FloatArray

    def rotation(self, bias: FloatArray) -> Rotation:
        """R_start_end by the gyro, less its bias (3,) rad/s."""
        return reduce(mul, Rotation.from_rotvec((self.angular_velocity - bias) * self.durations[:, None]))

    @property
    def rates(self) -> FloatArray:
        """The angular velocities (2, 3) at start and end, by straight lines through what is near.

        They serve as the rates at which poses move with the clock, for which single samples are too noisy. Both err
        alike with the rotation over the whole interval, so that they do not bias what is learned of the clock.
        """
        both = (self.durations, self.angular_velocity), (self.durations[::-1], self.angular_velocity[::-1])
        return np.stack([_line_at_start(*each) for each in both])


def _line_at_start(durations: FloatArray, means: FloatArray) -> FloatArray:
    """Where a straight line through means (M, 3) over durations (M,) begins, from those of the first EVENLY_S."""
    passed = np.cumsum(durations)
    weights = np.diff(np.minimum(passed, EVENLY_S), prepend=0.0)
    weights /= weights.sum()
    middle = passed - durations / 2
    mean, mean_s = weights @ means, weights @ middle
    spread = weights @ (middle - mean_s) ** 2
    slope = (weights * (middle - mean_s)) @ means / spread if spread > 0.0 else np.zeros(3)
    return np.asarray(mean - mean_s * slope)


def turned(windows: Sequence[ImuWindow], bias: FloatArray) -> FloatArray:
    """The rotation vectors (N, 3) of what the gyro, less its bias (3,) rad/s, turned during N windows."""
    durations, rates = _side_by_side(windows)
    pieces = durations.shape[1]
    rotvecs = (rates - bias) * durations[:, :, None]
    increments = Rotation.from_rotvec(rotvecs.reshape(-1, 3)).as_matrix().reshape(-1, pieces, 3, 3)
    whole = np.tile(np.eye(3), (len(windows), 1, 1))
    for piece in range(pieces):
        whole = whole @ increments[:, piece]
    return np.asarray(Rotation.from_matrix(whole).as_rotvec())


def mean_rates(windows: Sequence[ImuWindow], span_s: float) -> FloatArray:
    """Mean angular velocities (N, 2, 3) over so many seconds after the start and before the end of N windows.

    Those of the windows on both sides of a frame make a mean about it.
    """
    durations, rates = _side_by_side(windows)
    passed = np.cumsum(durations, axis=1)
    left = passed[:, -1:] - passed
    after_start = np.diff(np.minimum(passed, span_s), prepend=0.0)
    before_end = np.minimum(left + durations, span_s) - np.minimum(left, span_s)
    weights = np.stack([after_start, before_end], axis=1)
    return np.asarray(weights @ rates / weights.sum(axis=2, keepdims=True))


def _side_by_side(windows: Sequence[ImuWindow]) -> tuple[FloatArray, FloatArray]:
    """Durations (N, M) and angular velocities (N, M, 3) of N windows, those of fewer pieces followed by zeros."""
    pieces = max((len(window.durations) for window in windows), default=0)
    durations, rates = np.zeros((len(windows), pieces)), np.zeros((len(windows), pieces, 3))
    for k, window in enumerate(windows):
        durations[k, : len(window.durations)] = window.durations
        rates[k, : len(window.durations)] = window.angular_velocity
    return durations, rates


class ImuWindows:
    """The samples of an IMU over any interval of time, linear between them."""

    def __init__(self, imu: ImuSeries) -> None:
        self._stamps = imu.stamps_ns
        self._values = np.hstack([imu.angular_velocity, imu.linear_acceleration])
        gaps = np.diff(self._stamps)
        longest_ns = MAX_IMU_PERIODS * np.median(gaps) if len(imu) > 1 else 0.0
        changed = np.diff(self._values, axis=0) != 0.0
        # How many holes, changes of the gyro and of the accelerometer there are until each sample.
        counted = np.column_stack([gaps > longest_ns, changed[:, :3].any(axis=1), changed[:, 3:].any(axis=1)])
        self._until = np.cumsum(np.vstack([np.zeros((1, 3), np.int64), counted]), axis=0)

    def over(self, start_ns: int, end_ns: int) -> ImuWindow | None:
        """The window from start to end, or None where the samples do not cover it without a hole, or are stuck.

        Stuck is a sensor that repeats one value on all axes: a live one has noise.
        """
        first = int(np.searchsorted(self._stamps, start_ns, side="right")) - 1
        last = int(np.searchsorted(self._stamps, end_ns))
        if first < 0 or last >= len(self._stamps):
            return None
        holes, *changes = (self._until[last] - self._until[first]).tolist()
        if holes or (last - first + 1 >= MIN_REPEATS and not all(changes)):
            return None
        stamps, edges = self._stamps[first : last + 1], self._values[first : last + 1].copy()
        at_start = edges[0] + (edges[1] - edges[0]) * ((start_ns - stamps[0]) / (stamps[1] - stamps[0]))
        at_end = edges[-1] - (edges[-1] - edges[-2]) * ((stamps[-1] - end_ns) / (stamps[-1] - stamps[-2]))
        edges[0], edges[-1] = at_start, at_end
        means = (edges[1:] + edges[:-1]) / 2
        seconds = (stamps - start_ns) / NANOSECONDS
        seconds[0], seconds[-1] = 0.0, (end_ns - start_ns) / NANOSECONDS
        return ImuWindow(seconds[1:] - seconds[:-1], means[:, :3], means[:, 3:])


def adjoint(transform: RigidTransform) -> FloatArray:
    """Ad(T) (..., 6, 6), rotation first: T Exp(xi) T^-1 = Exp(Ad(T) xi)."""
    R, t = transform.rotation.as_matrix(), transform.translation
    matrix = np.zeros((*R.shape[:-2], 6, 6))
    matrix[..., :3, :3] = matrix[..., 3:, 3:] = R
    matrix[..., 3:, :3] = np.cross(t[..., None, :], np.swapaxes(R, -1, -2)).swapaxes(-1, -2)
    return matrix


def chain(steps: Sequence[PairEstimate]) -> Trajectory:
    """The raw trajectory of N steps: N + 1 poses in the first camera's frame, and their covariances.

    With independent steps T_k+1 = T_k D_k the covariance is P_k+1 = Ad(D_k^-1) P_k Ad(D_k^-1)' + Q_k to first order
    (Barfoot and Furgale, "Associating uncertainty with three-dimensional poses", 2014, for right perturbations).

    Raises ValueError for no steps, and where one does not begin where the step before it ends.
    """
    if not steps:
        raise ValueError("no steps")
    for before, after in pairwise(steps):
        if before.target_stamp_ns != after.source_stamp_ns:
            raise ValueError(f"no step from {before.target_stamp_ns} to {after.source_stamp_ns} ns")
    motions = motions_of(steps)
    poses = list(accumulate(motions.as_matrix(), np.matmul, initial=np.eye(4)))
    covariances = [np.zeros((6, 6))]
    for backward, step in zip(adjoint(motions.inv()), steps, strict=True):
        covariances.append(backward @ covariances[-1] @ backward.T + step.covariance)
    return Trajectory(stamps_of(steps), RigidTransform.from_matrix(np.stack(poses)), np.stack(covariances))


def motions_of(steps: Sequence[PairEstimate]) -> RigidTransform:
    """The motions T_source_target of N > 0 steps."""
    rotations = Rotation.from_quat(np.stack([step.quat_wxyz for step in steps]), scalar_first=True)
    return RigidTransform.from_components(np.stack([step.translation for step in steps]), rotations)


def stamps_of(steps: Sequence[PairEstimate]) -> IntArray:
    """The N + 1 stamps that N steps lead through."""
    return np.array([steps[0].source_stamp_ns, *(step.target_stamp_ns for step in steps)], dtype=np.int64)


def bridge_gaps(
    frame_stamps: IntArray, pairs: Sequence[PairEstimate], inertial: ImuSeries | None
) -> tuple[list[PairEstimate], int]:
    """The steps through all stamps of frames (N,) and pairs, and the number of holes between pairs that were bridged.

    Recorded pairs that follow each other become steps as they are; pairs that skip what others lead through are left
    out. A frame inside the span of a pair splits its motion evenly. A hole is crossed with the velocity of the pairs
    at its sides (interpolated between them, constant where there is but one), and with the rotation of the gyro where
    `inertial` (in the camera's axes and time) measured it; its covariance grows with the time since it began.

    Raises LogError where there is no pair at all.
    """
    recorded = _following_each_other(pairs)
    if not recorded:
        raise LogError("no pair estimates: nothing to make a trajectory of")
    ends = [stamp for pair in recorded for stamp in (pair.source_stamp_ns, pair.target_stamp_ns)]
    stamps = np.union1d(frame_stamps, ends)
    gyro = _Gyro(inertial, recorded)
    steps: list[PairEstimate] = []
    holes = 0
    for before, after in pairwise([None, *recorded, None]):
        hole = _between(
            stamps,
            before.target_stamp_ns if before else int(stamps[0]),
            after.source_stamp_ns if after else int(stamps[-1]),
        )
        if len(hole) > 1:
            holes += 1
            steps.extend(_bridge(hole, before, after, gyro))
        if after:
            steps.extend(_split(after, _between(stamps, after.source_stamp_ns, after.target_stamp_ns)))
    return steps, holes


def _following_each_other(pairs: Sequence[PairEstimate]) -> list[PairEstimate]:
    """The longest list of pairs of which none overlaps another (earliest end first; of equal ends the shortest)."""
    chosen: list[PairEstimate] = []
    for pair in sorted(pairs, key=lambda pair: (pair.target_stamp_ns, -pair.source_stamp_ns)):
        if not chosen or pair.source_stamp_ns >= chosen[-1].target_stamp_ns:
            chosen.append(pair)
    return chosen


def _between(stamps: IntArray, start_ns: int, end_ns: int) -> IntArray:
    """The sorted stamps from start to end, both included."""
    return stamps[np.searchsorted(stamps, start_ns) : np.searchsorted(stamps, end_ns, side="right")]


def _split(pair: PairEstimate, stamps: IntArray) -> list[PairEstimate]:
    """A pair as steps through the stamps (N,) it spans: constant twist, pieces that compound to its covariance."""
    if len(stamps) == 2:
        return [pair]
    twist = pair.T_source_target.as_exp_coords()
    share = (stamps - stamps[0]) / (stamps[-1] - stamps[0])
    to_end = adjoint(RigidTransform.from_exp_coords(np.outer(1.0 - share[1:], twist)))
    covariances = np.diff(share)[:, None, None] * (to_end @ pair.covariance @ to_end.swapaxes(-1, -2))
    return [
        _step(start, end, RigidTransform.from_exp_coords(part * twist), covariance)
        for (start, end), part, covariance in zip(pairwise(stamps), np.diff(share), covariances, strict=True)
    ]


def _bridge(
    stamps: IntArray, before: PairEstimate | None, after: PairEstimate | None, gyro: _Gyro
) -> Iterator[PairEstimate]:
    """Steps through the stamps (N,) of a hole between two pairs, of which one may be missing.

    The covariance of a step is what the hole's covariance grows by during it, so that the sum over the hole is that
    of one unknown constant acceleration (variance t^4 / 4) and of the neighbours' uncertain rate (variance t^2).
    """
    sides = [pair for pair in (before, after) if pair]
    rates = np.stack([pair.T_source_target.as_exp_coords() / pair.duration_s for pair in sides])
    rate_covariance = np.mean([pair.covariance / pair.duration_s**2 for pair in sides], axis=0)
    acceleration_covariance = np.diag(3 * [UNKNOWN_ANGULAR_ACCELERATION**2] + 3 * [UNKNOWN_ACCELERATION**2])
    seconds = (stamps - stamps[0]) / NANOSECONDS
    for k, (start, end) in enumerate(pairwise(stamps)):
        t0, t1 = seconds[k : k + 2]
        share = (t0 + t1) / 2 / seconds[-1]
        twist = (t1 - t0) * (rates[0] * (1.0 - share) + rates[-1] * share)
        covariance = rate_covariance * (t1**2 - t0**2) + acceleration_covariance * (t1**4 - t0**4) / 4
        rotation = gyro.rotation(start, end)
        if rotation is not None:
            twist[:3] = rotation.as_rotvec()
            covariance[:3], covariance[:, :3] = 0.0, 0.0
            covariance[:3, :3] = UNKNOWN_GYRO_RATE**2 * (t1**2 - t0**2) * np.eye(3)
        yield _step(start, end, RigidTransform.from_exp_coords(twist), covariance)


class _Gyro:
    """Rotations measured by the gyro, its bias taken as the median difference to the rates of the recorded pairs."""

    def __init__(self, inertial: ImuSeries | None, pairs: Sequence[PairEstimate]) -> None:
        self._windows = ImuWindows(inertial) if inertial is not None else None
        self._bias = np.zeros(3)
        excess = [
            (measured.as_rotvec() - pair.T_source_target.rotation.as_rotvec()) / pair.duration_s
            for pair in pairs
            if (measured := self.rotation(pair.source_stamp_ns, pair.target_stamp_ns)) is not None
        ]
        if excess:
            self._bias = np.median(excess, axis=0)

    def rotation(self, start_ns: int, end_ns: int) -> Rotation | None:
        """The rotation R_start_end, or None where the gyro did not measure all of it."""
        window = self._windows.over(start_ns, end_ns) if self._windows else None
        return window.rotation(self._bias) if window else None


def _step(start_ns: int, end_ns: int, motion: RigidTransform, covariance: FloatArray) -> PairEstimate:
    """A step that no front end has seen."""
    quat_wxyz = motion.rotation.as_quat(scalar_first=True)
    return PairEstimate(int(start_ns), int(end_ns), quat_wxyz, motion.translation, covariance)
