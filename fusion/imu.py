"""How the IMU is mounted and what its clock reads, from the log alone; and the IMU in the camera's axes and time.

Gyro and pair estimates see the same turning. With v_imu = R_imu_camera v_camera, t_imu = t_camera + offset and a gyro
bias b, the rotation vectors of one interval dt obey

    turned_camera = R_imu_camera^T (turned_imu(offset) - b dt) + e                                                  (1)

The offset is found by correlating angular rates, which needs no mounting; then the mounting is Wahba's problem, in
closed form; then mounting, bias and offset are refined together on (1) by robust Gauss-Newton. The errors e of odometry
are correlated in time, so they are whitened by an autoregressive model that is fitted to them (generalised least
squares): that makes the estimates efficient and their standard deviations honest.

Many IMUs filter what they measure. A low-pass filter of first order, T dy/dt + y = x, delays slow motion by T, which
passes for a part of the offset, and damps fast motion: the rates of roll and pitch in KITTI's records by a tenth. Where
the residuals e say that there is such a filter, it is undone.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from itertools import accumulate, pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import cumulative_trapezoid
from scipy.ndimage import binary_closing, binary_opening, find_objects, label
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation, Slerp
from scipy.special import expit
from scipy.stats import f as f_distribution
from scipy.stats import multivariate_normal, multivariate_t, rankdata

from fusion import clocks, sensors
from fusion.chain import MAX_IMU_PERIODS
from fusion_io.records import NANOSECONDS, FloatArray, ImuSeries, IntArray, PairEstimate
from fusion_io.words import counted

# The search for the time offset, and how well angular rates must correlate (by rank) where it is right.
MAX_TIME_OFFSET_S = 0.5
TIME_OFFSET_STEP_S = 0.005
MIN_CORRELATION = 0.4

# What a log must show before its IMU is used.
MIN_PAIRS = 40  # that the IMU measured from start to end
MIN_COVERAGE = 0.5  # their share of all pairs
MIN_EXPLAINED = 0.5  # share of the pairs' turning (as variance) that the gyro explains
MIN_EXPLAINED_GIVEN = -0.1  # the same with a given mounting: on a straight road there is nothing to explain
MIN_EXPLAINED_AXIS = -0.5  # about each axis; an axis that the gyro has reversed is at -3
MAX_SCALE_ERROR = 0.01  # of the gyro against the pairs
MAX_SCALE_ERROR_LEARNED = 0.05  # the same where the network made them: it takes a little sideways motion for turning
MAX_ROTATION_STD_RAD = float(np.deg2rad(2.0))
MAX_TIME_OFFSET_STD_S = 0.02
GRAVITY_RANGE = (8.8, 10.8)  # m/s^2, for the median magnitude that the accelerometer shows
MAX_FAULTY_SHARE = 0.2
MAX_CLIPPED_SHARE = 0.5

# Stamps and pairs tell when a clock jumped to about so well.
JUMP_GUARD_S = 1.0
MAX_SMALL_JUMPS = 3  # of a clock
SMALL_JUMP_PRIOR_S, STEP_PRIOR = 1.0, 0.1  # by about so much a clock jumps, and beside it the gyro's bias steps (rad/s)
SMALL_JUMP_EDGE_S = 5.0  # before a jump, and after it
MIN_JUMP_S = 0.01  # smaller ones do no harm, and a front end's own delay can change by some milliseconds
# How many times likelier (logarithm) a jump has to make what was seen. Sound logs and those with other faults have at
# most 5.5 for one; a jump of 50 ms in 25 s has 7 or more, one of 0.1 s 19.
LEAST_BY_JUMP = 6.0
JUMP_CONVERGED_S = 1e-3

# Time constants at which a low-pass filter is looked for, and how many times likelier (logarithm) N residuals have to
# be with it, by root N: 132 simulated IMUs that have none give up to 1.6, those of KITTI, which have one, 3.8 and more.
LOW_PASSES_S = np.array([0.0, 0.02, 0.04, 0.06, 0.08, 0.1])
LEAST_BY_LOW_PASS = 2.5

# A gyro's bias steps where the means of batches before and after differ by more than their scatter explains.
MAX_BIAS_STEPS = 3
STEP_BATCH_S = 5.0  # as long as errors of pairs are correlated
STEP_MIN_PAIRS = 20  # on either side
STEP_MIN_BATCHES = 5
STEP_CHANCE = 1e-6
STEP_MIN = 6e-3  # rad/s: from 5e-3 down, the drift of a front end can look like it

# Where gyro and pairs disagree for long, the gyro is at fault too: front ends fail for single pairs, but an IMU that
# saturates or loses its clock does so for a while.
CONTRADICTION = 8.0  # standard deviations
CONTRADICTION_PAIRS = 6  # at least so many in a row
CONTRADICTION_PAUSE = 10  # fewer than so many pairs of agreement do not end it

# A gyro that a navigation system has corrected has hardly a bias, and knowing that is worth more than the pairs; a bare
# one has a large bias, which only the pairs can tell. Which of them it is shows in whether what the pairs see can be
# chance and their own drift, where they would see the biases of bare gyros sharply.
BARE_GYRO_BIAS = 1e-2  # rad/s
BATCHES = 5  # whose scatter shows how uncertain the mean of errors is that are correlated in time
PAIR_DRIFT = 3e-4  # rad/s: constant over a log, so that no scatter shows it

# Weak priors of the refinement: they keep it solvable where the motion leaves something open.
ROTATION_PRIOR_RAD = 0.5
GYRO_BIAS_PRIOR = 0.1  # rad/s
TIME_OFFSET_PRIOR_S = 0.1

WHITENING_ORDER = 5
CLIP = 4.0  # standard deviations
CAUCHY = 2.385  # standard deviations; 95 % efficient on Gaussian errors (Holland and Welsch, 1977)
MAD_TO_STD = 1.4826
PRIOR_STD = np.repeat([ROTATION_PRIOR_RAD, GYRO_BIAS_PRIOR, TIME_OFFSET_PRIOR_S], [3, 3, 1])
ITERATIONS = 30
CONVERGED = 1e-9

ROTATION, BIAS, OFFSET = slice(0, 3), slice(3, 6), slice(6, 7)  # of the parameters of (1)


class Change(NamedTuple):
    """From at_ns on (the IMU's clock as recorded) its stamps are by clock_ns, and its gyro is by bias (3,), further."""

    at_ns: int
    clock_ns: int
    bias: FloatArray


WANDERS = "the accelerometer's bias wanders: it is hardly believed"
"""What is said of bias steps that are not known."""


class BiasStep(NamedTuple):
    """A bias of the IMU stepped just before the frame at_ns: by (6,), accelerometer (m/s^2), then gyro (rad/s).

    std (6,): how uncertain both are by then. Zero is what did not step. Of a bias that wanders, by is zero: it may have
    stepped.
    """

    at_ns: int
    by: FloatArray
    std: FloatArray

    @property
    def is_known(self) -> bool:
        """Whether it is known by how much."""
        return bool(np.any(self.by))

    def __str__(self) -> str:
        """What stepped, and by how much."""
        of_gyro = bool(np.any(self.by[3:]))
        sensor, by, unit = ("gyro", self.by[3:], "rad/s") if of_gyro else ("accelerometer", self.by[:3], "m/s^2")
        return f"the {sensor}'s bias steps by {np.linalg.norm(by):.2g} {unit}"


def described(steps: Sequence[BiasStep], start_ns: int) -> list[str]:
    """Those steps that are known, and how long after a start they were."""
    return [f"{step} at {(step.at_ns - start_ns) / NANOSECONDS:.0f} s" for step in steps if step.is_known]


@dataclass(frozen=True, slots=True)
class ImuCalibration:
    """How an IMU relates to the camera, and whether it is used.

    rotation_imu_camera: v_imu = R v_camera, None where it is unknown. time_offset_s: t_imu = t_camera + offset, for
    slow motion. low_pass_s: the time constant of a low-pass filter of first order in the IMU, which delays slow motion
    by as much, a part of the offset; zero where there is none.
    gyro_bias (3,) rad/s in IMU axes, near zero for a gyro that seems to have been corrected. used, reason: the
    verdict and what led to it. Standard deviations, zero for what was given or is taken to be zero: rotation_std_rad
    (3,) about the camera's axes, time_offset_std_s, gyro_bias_std (rad/s) of each component. faulty_ns (M, 2):
    intervals on the IMU's clock in which the gyro was not measured, or contradicts the pairs for long. changes: where
    the clock jumped or the bias stepped; the offset and the bias above are those before the first.
    """

    rotation_imu_camera: Rotation | None
    time_offset_s: float
    gyro_bias: FloatArray
    used: bool
    reason: str
    rotation_std_rad: FloatArray = field(default_factory=lambda: np.zeros(3))
    time_offset_std_s: float = 0.0
    gyro_bias_std: float = 0.0
    faulty_ns: IntArray = field(default_factory=lambda: np.zeros((0, 2), dtype=np.int64))
    changes: Sequence[Change] = ()
    low_pass_s: float = 0.0

    @property
    def bias_steps_ns(self) -> IntArray:
        """When the bias stepped (M,), on the camera's clock."""
        offset_ns = round(self.time_offset_s * NANOSECONDS)
        jumped = np.cumsum([change.clock_ns for change in self.changes], dtype=np.int64)
        at_ns = np.array([change.at_ns for change in self.changes], dtype=np.int64)
        stepped = np.array([bool(np.any(change.bias)) for change in self.changes], dtype=np.bool_)
        return np.asarray((at_ns - jumped - offset_ns)[stepped])

    @property
    def clock_jumps(self) -> list[clocks.Jump]:
        """Where the clock jumped, in order of time."""
        jumped = [change for change in self.changes if change.clock_ns]
        if not jumped:
            return []
        ahead_ns = np.cumsum(
            [round(self.time_offset_s * NANOSECONDS), *(change.clock_ns for change in jumped)]
        ).tolist()
        return [
            clocks.Jump(change.at_ns - before_ns, before_ns / NANOSECONDS, after_ns / NANOSECONDS)
            for change, (before_ns, after_ns) in zip(jumped, pairwise(ahead_ns), strict=True)
        ]

    @property
    def bias_steps(self) -> list[BiasStep]:
        """Those steps; they are taken out of the samples on the camera's clock."""
        biases = [change.bias for change in self.changes if np.any(change.bias)]
        if not biases:
            return []
        std = np.repeat([0.0, self.gyro_bias_std], 3)
        return [
            BiasStep(at_ns, np.concatenate([np.zeros(3), bias]), std)
            for at_ns, bias in zip(self.bias_steps_ns.tolist(), biases, strict=True)
        ]

    @property
    def mounting(self) -> Rotation:
        """rotation_imu_camera of an IMU that is used; raises ValueError where it is unknown."""
        if self.rotation_imu_camera is None:
            raise ValueError("the mounting of the IMU is unknown")
        return self.rotation_imu_camera


def calibrate(
    pairs: Sequence[PairEstimate],
    imu: ImuSeries,
    rotation: Rotation | None,
    time_offset_s: float | None,
    low_pass_s: float | None = None,
) -> ImuCalibration:
    """Mounting, time offset, gyro bias and low-pass from pair estimates and the IMU; None means: to be estimated.

    Bad data is no error: an IMU that cannot be used with confidence is left out, and the reason says why.
    """

    def left_out(reason: str) -> ImuCalibration:
        return ImuCalibration(rotation, time_offset_s or 0.0, np.zeros(3), False, reason)

    problem = _sensor_problem(imu)
    if problem:
        return left_out(problem)
    not_measured_ns = _not_measured(imu)
    imu = _outside(imu, not_measured_ns)
    if len(imu) < MIN_PAIRS:
        return left_out("its gyro or accelerometer hangs, or is at the end of its range")
    changes, doubtful_ns = _clock_jumps(imu, pairs)
    estimate_offset = time_offset_s is None
    for may_jump in (*[True] * MAX_SMALL_JUMPS, False):
        good = _unchanged(_outside(imu, doubtful_ns), changes)
        fitted = _fitted(good, pairs, rotation, time_offset_s)
        if isinstance(fitted, str):
            return left_out(fitted)
        filtered_s = _low_pass(_Gyro(good), fitted, rotation, estimate_offset) if low_pass_s is None else low_pass_s
        if filtered_s > 0.0:
            good = _without_low_pass(good, filtered_s)
            delayed_s = None if time_offset_s is None else time_offset_s - filtered_s
            fitted = _fitted(good, pairs, rotation, delayed_s)
            if isinstance(fitted, str):
                return left_out(fitted)
        fit, steps, bias_std = _without_bias_steps(good, fitted, rotation, estimate_offset=estimate_offset)
        if not may_jump:
            break
        jump = _small_jump(_Gyro(_unchanged(good, steps)), fit, rotation, estimate_offset=estimate_offset)
        if jump is None:
            break
        at_s, by_s = jump
        at_ns = _as_recorded(int(good.stamps_ns[0]) + round((at_s + fit.time_offset_s) * NANOSECONDS), changes)
        changes, doubtful_ns = _with_jump(changes, doubtful_ns, at_ns, round(by_s * NANOSECONDS))
    steps = [step._replace(at_ns=_as_recorded(step.at_ns, changes)) for step in steps]
    changes = sorted([*changes, *steps], key=lambda change: change.at_ns)
    learned = any(pair.winner >= 0 for pair in pairs)
    problem = _fit_problem(fit, MAX_SCALE_ERROR_LEARNED if learned else MAX_SCALE_ERROR)
    gyro_bias, gyro_bias_std = (fit.gyro_bias, bias_std) if steps else _gyro_bias(fit)
    if learned:  # a few percent of a lasting turn look like a bias
        rate = np.mean(fit.turns.turned, axis=0) / np.mean(fit.turns.target_s - fit.turns.source_s)
        gyro_bias_std = float(np.hypot(gyro_bias_std, MAX_SCALE_ERROR_LEARNED * np.linalg.norm(rate)))
    contradicted = [_as_recorded(at_ns, changes) for at_ns in (fit.faulty_intervals() + good.stamps_ns[0]).ravel()]
    faulty_ns = np.concatenate([not_measured_ns, doubtful_ns, np.array(contradicted, dtype=np.int64).reshape(-1, 2)])
    return ImuCalibration(
        fit.rotation_imu_camera,
        fit.time_offset_s + filtered_s,
        gyro_bias,
        used=problem is None,
        reason=problem or _summary(fit, len(faulty_ns), changes, filtered_s),
        rotation_std_rad=fit.std[ROTATION],
        time_offset_std_s=float(fit.std[OFFSET][0]),
        gyro_bias_std=gyro_bias_std,
        faulty_ns=faulty_ns,
        changes=changes,
        low_pass_s=filtered_s,
    )


def on_camera_clock(imu: ImuSeries, calibration: ImuCalibration) -> ImuSeries:
    """The IMU on the camera's clock, in its own axes, without its faulty stretches and what changed meanwhile."""
    good = _unchanged(_outside(imu, calibration.faulty_ns), calibration.changes)
    if calibration.low_pass_s > 0.0:
        good = _without_low_pass(good, calibration.low_pass_s)
    offset_s = calibration.time_offset_s - calibration.low_pass_s
    return replace(good, stamps_ns=good.stamps_ns - round(offset_s * NANOSECONDS))


def in_camera_axes(imu: ImuSeries, calibration: ImuCalibration) -> ImuSeries:
    """The IMU on the camera's clock and in the camera's axes, without its gyro bias and faulty stretches.

    Raises ValueError where the mounting is unknown.
    """
    to_camera = calibration.mounting.inv()
    good = on_camera_clock(imu, calibration)
    return replace(
        good,
        angular_velocity=to_camera.apply(good.angular_velocity - calibration.gyro_bias),
        linear_acceleration=to_camera.apply(good.linear_acceleration),
    )


def _outside(imu: ImuSeries, intervals_ns: IntArray) -> ImuSeries:
    """The samples outside of all intervals (M, 2), ends included."""
    good = np.ones(len(imu), dtype=bool)
    for start_ns, end_ns in intervals_ns:
        good &= (imu.stamps_ns < start_ns) | (imu.stamps_ns > end_ns)
    return replace(
        imu,
        stamps_ns=imu.stamps_ns[good],
        angular_velocity=imu.angular_velocity[good],
        linear_acceleration=imu.linear_acceleration[good],
    )


# ------------------------------------------------------------------------------------------------ what is compared


class _Turns(NamedTuple):
    """The rotations of N pairs: rotation vectors turned (N, 3) from source_s to target_s (N,), camera clock."""

    source_s: FloatArray
    target_s: FloatArray
    turned: FloatArray

    def where(self, mask: NDArray[np.bool_]) -> _Turns:
        """Those that a mask (N,) chooses."""
        return _Turns(*(values[mask] for values in self))


def _turns(pairs: Sequence[PairEstimate], zero_ns: int) -> _Turns:
    """The rotations of pair estimates, in seconds since a stamp."""
    stamps = np.array([(pair.source_stamp_ns, pair.target_stamp_ns) for pair in pairs], dtype=np.int64).reshape(-1, 2)
    quats_wxyz = np.array([pair.quat_wxyz for pair in pairs]).reshape(-1, 4)
    seconds = (stamps - zero_ns) / NANOSECONDS
    return _Turns(seconds[:, 0], seconds[:, 1], Rotation.from_quat(quats_wxyz, scalar_first=True).as_rotvec())


class _Gyro:
    """What the gyro turned over any interval, in seconds since its first sample; rates are linear between samples."""

    def __init__(self, imu: ImuSeries) -> None:
        self._seconds = (imu.stamps_ns - imu.stamps_ns[0]) / NANOSECONDS
        self._rates = self._filtered = imu.angular_velocity
        periods = np.diff(self._seconds)
        increments = Rotation.from_rotvec((self._rates[1:] + self._rates[:-1]) / 2 * periods[:, None]).as_matrix()
        orientations = np.stack(list(accumulate(increments, np.matmul, initial=np.eye(3))))
        self._orientation = Slerp(self._seconds, Rotation.from_matrix(orientations))
        self._angle = cumulative_trapezoid(np.linalg.norm(self._rates, axis=1), self._seconds, initial=0.0)
        self._holes = np.concatenate([[0], np.cumsum(periods > MAX_IMU_PERIODS * np.median(periods))])
        self._low_pass_s = 0.0

    def without_low_pass(self, low_pass_s: float) -> _Gyro:
        """The same as if its rates had not gone through a low-pass filter of this time constant; for small turns."""
        undone = copy(self)
        undone._low_pass_s = low_pass_s
        undone._rates = self._filtered + low_pass_s * np.gradient(self._filtered, self._seconds, axis=0)
        return undone

    def measured(self, start_s: FloatArray, end_s: FloatArray) -> NDArray[np.bool_]:
        """Which intervals (N,) the samples cover from start to end without a hole."""
        first = np.searchsorted(self._seconds, start_s, side="right") - 1
        last = np.searchsorted(self._seconds, end_s)
        inside = (first >= 0) & (last < len(self._seconds))
        return np.asarray(inside & (self._holes[first] == self._holes[np.where(inside, last, 0)]))

    def turned(self, start_s: FloatArray, end_s: FloatArray) -> FloatArray:
        """Rotation vectors (N, 3) of R_start_end."""
        start, end = (self._orientation(np.clip(at_s, 0.0, self._seconds[-1])) for at_s in (start_s, end_s))
        turned = (start.inv() * end).as_rotvec()
        if self._low_pass_s:
            start_rate, end_rate = (self._interpolated(self._filtered, at_s) for at_s in (start_s, end_s))
            turned += self._low_pass_s * (end_rate - start_rate)
        return np.asarray(turned)

    def rate(self, at_s: FloatArray) -> FloatArray:
        """Angular velocity (N, 3)."""
        return self._interpolated(self._rates, at_s)

    def _interpolated(self, values: FloatArray, at_s: FloatArray) -> FloatArray:
        return np.stack([np.interp(at_s, self._seconds, axis) for axis in values.T], axis=-1)

    def speed(self, start_s: FloatArray, end_s: FloatArray) -> FloatArray:
        """Mean magnitude (N,) of the angular velocity over intervals."""
        start, end = (np.interp(at_s, self._seconds, self._angle) for at_s in (start_s, end_s))
        return np.asarray((end - start) / (end_s - start_s))


def _sensor_problem(imu: ImuSeries) -> str | None:
    """What is wrong with the samples by themselves, or None."""
    if not len(imu):
        return "the log has no IMU"
    for name, values in (("gyro", imu.angular_velocity), ("accelerometer", imu.linear_acceleration)):
        stuck = np.ptp(values, axis=0) == 0.0
        if np.any(stuck):
            return f"its {name} is stuck: {'xyz'[int(np.argmax(stuck))]} never changes"
        clipped = sum(run.stop - run.start for _, _, run in sensors.clipped(values)) / len(imu)
        if clipped > MAX_CLIPPED_SHARE:
            return f"its {name} is at the end of its range for {min(clipped, 1.0):.0%} of the time"
    shown = float(np.median(np.linalg.norm(imu.linear_acceleration, axis=1)))
    if not GRAVITY_RANGE[0] <= shown <= GRAVITY_RANGE[1]:
        return f"its accelerometer does not show gravity, but {shown:.3g} m/s^2 (median magnitude)"
    return None


def _not_measured(imu: ImuSeries) -> IntArray:
    """The intervals (M, 2) in nanoseconds in which a sensor hung, was filled in, or was at the end of its range."""
    found = []
    for values in (imu.angular_velocity, imu.linear_acceleration):
        found += [*sensors.frozen(values), *(run for _, _, run in sensors.clipped(values))]
    found.sort(key=lambda run: (run.start, run.stop))
    return np.array([(imu.stamps_ns[run][0], imu.stamps_ns[run][-1]) for run in found], dtype=np.int64).reshape(-1, 2)


def _clock_jumps(imu: ImuSeries, pairs: Sequence[PairEstimate]) -> tuple[list[Change], IntArray]:
    """Where the IMU's clock jumped, and the intervals (M, 2) about it whose samples may be of before or after."""
    changes: list[Change] = []
    doubtful_ns = np.zeros((0, 2), dtype=np.int64)
    for jump in clocks.jumps(imu, pairs):
        at_ns = jump.at_ns + round(jump.before_s * NANOSECONDS)
        changes, doubtful_ns = _with_jump(changes, doubtful_ns, at_ns, round(jump.by_s * NANOSECONDS))
    return changes, doubtful_ns


def _with_jump(
    changes: Sequence[Change], doubtful_ns: IntArray, at_ns: int, by_ns: int
) -> tuple[list[Change], IntArray]:
    """The same with one more jump of the clock; what was found near it before was a part of it."""
    near = [abs(change.at_ns - at_ns) < SMALL_JUMP_EDGE_S * NANOSECONDS for change in changes]
    by_ns += sum(change.clock_ns for change, part in zip(changes, near, strict=True) if part)
    changes = [change for change, part in zip(changes, near, strict=True) if not part]
    guard_ns = round(JUMP_GUARD_S * NANOSECONDS)
    # A clock that goes back repeats its stamps, of which a reader keeps one or the other.
    about_ns = (at_ns + min(by_ns, 0) - guard_ns, at_ns + max(by_ns, 0) + guard_ns)
    more = sorted([*changes, Change(at_ns, by_ns, np.zeros(3))], key=lambda change: change.at_ns)
    return more, np.vstack([doubtful_ns, np.array([about_ns], dtype=np.int64)])


def _unchanged(imu: ImuSeries, changes: Sequence[Change]) -> ImuSeries:
    """The samples as if clock and bias had gone on as before the first change."""
    if not changes:
        return imu
    at_ns = np.array([change.at_ns for change in changes], dtype=np.int64)
    passed = np.searchsorted(at_ns, imu.stamps_ns, side="right")
    jumped = np.concatenate([[0], np.cumsum([change.clock_ns for change in changes], dtype=np.int64)])
    stepped = np.vstack([np.zeros(3), np.cumsum([change.bias for change in changes], axis=0)])
    return replace(
        imu, stamps_ns=imu.stamps_ns - jumped[passed], angular_velocity=imu.angular_velocity - stepped[passed]
    )


def _without_low_pass(imu: ImuSeries, low_pass_s: float) -> ImuSeries:
    """The samples as they were before a low-pass filter of first order: of y its input is y + T dy/dt."""
    seconds = (imu.stamps_ns - imu.stamps_ns[0]) / NANOSECONDS
    gyro, accelerometer = imu.angular_velocity, imu.linear_acceleration
    return replace(
        imu,
        angular_velocity=gyro + low_pass_s * np.gradient(gyro, seconds, axis=0),
        linear_acceleration=accelerometer + low_pass_s * np.gradient(accelerometer, seconds, axis=0),
    )


def _as_recorded(at_ns: int, changes: Sequence[Change]) -> int:
    """The stamp that the IMU recorded at a time on its clock as it was before the first change."""
    for change in changes:
        if at_ns >= change.at_ns:
            at_ns += change.clock_ns
    return int(at_ns)


# ------------------------------------------------------------------------------------------------------ estimation


class _White(NamedTuple):
    """(1) over N pairs, whitened and weighted: what each adds to the gradient, and to the information.

    by_residual (N, 7), by_jacobian (N, 7, 7), of all parameters. log_sigma: the sum over all residuals of the logarithm
    of what they were divided by, which is less where (1) explains more of them.
    """

    by_residual: FloatArray
    by_jacobian: FloatArray
    log_sigma: float

    @classmethod
    def of(cls, residual: FloatArray, jacobian: FloatArray) -> _White:
        """From residuals (N, 3) and their Jacobian (N, 3, 7)."""
        residual, jacobian, sigma = _whitened(residual, jacobian)
        weight = 1.0 / (1.0 + (residual / CAUCHY) ** 2)
        weighted = weight[:, :, None] * jacobian
        return cls(
            np.einsum("nai,na->ni", weighted, residual),
            np.einsum("nai,naj->nij", weighted, jacobian, optimize=True),
            len(residual) * float(np.log(sigma).sum()),
        )

    @property
    def information(self) -> FloatArray:
        """(7, 7) of all parameters, their priors included."""
        return np.asarray(self.by_jacobian.sum(axis=0) + np.diag(PRIOR_STD**-2.0))


@dataclass(frozen=True, slots=True)
class _Fit:
    """The solution of (1) over N pairs.

    std (7,): standard deviations of rotation (about the camera's axes), bias and offset, zero for what is given.
    moved_s: from the offset where the refinement began. predicted (N, 3): turning in camera axes by the gyro.
    sigma (3,): robust standard deviation of the residual per axis. white: (1) as it was solved at last, free (7,):
    which parameters were estimated.
    """

    rotation_imu_camera: Rotation
    gyro_bias: FloatArray
    time_offset_s: float
    std: FloatArray
    moved_s: float
    turns: _Turns
    predicted: FloatArray
    sigma: FloatArray
    white: _White
    free: NDArray[np.bool_]

    @property
    def deviation(self) -> FloatArray:
        """The residual's norm (N,) in standard deviations."""
        return np.asarray(np.linalg.norm((self.turns.turned - self.predicted) / self.sigma, axis=1))

    @property
    def faulty(self) -> NDArray[np.bool_]:
        """Pairs (N,) of the stretches in which gyro and pairs contradict each other for long."""
        lasting = binary_opening(self.deviation > CONTRADICTION, np.ones(CONTRADICTION_PAIRS))
        return np.asarray(binary_closing(lasting, np.ones(CONTRADICTION_PAUSE)) | lasting)

    def faulty_intervals(self) -> IntArray:
        """The stretches as intervals (M, 2) in nanoseconds of the IMU's clock since its first sample."""
        runs = [run[0] for run in find_objects(label(self.faulty)[0])]
        ends = [(self.turns.source_s[run][0], self.turns.target_s[run][-1]) for run in runs]
        seconds = np.array(ends).reshape(-1, 2) + self.time_offset_s
        return np.round(seconds * NANOSECONDS).astype(np.int64)

    @property
    def explained(self) -> FloatArray:
        """Share of the pairs' turning, about its mean, that the gyro explains: about each axis, and in all (4,)."""
        weight = 1.0 / (1.0 + (self.deviation / CAUCHY) ** 2)
        turned = self.turns.turned - np.average(self.turns.turned, axis=0, weights=weight)
        unexplained, variance = weight @ (self.turns.turned - self.predicted) ** 2, weight @ turned**2
        return np.asarray(1.0 - np.append(unexplained, unexplained.sum()) / np.append(variance, variance.sum()))

    @property
    def scale(self) -> tuple[float, float]:
        """The pairs' turning as a multiple of the gyro's (least absolute deviations), and its standard deviation."""
        near = self.deviation < CONTRADICTION
        predicted, turned = self.predicted[near], self.turns.turned[near]
        angle = np.linalg.norm(predicted, axis=1)
        along = np.sum(predicted * turned, axis=1) / np.maximum(angle, np.finfo(float).tiny)
        order = np.argsort(along / np.maximum(angle, np.finfo(float).tiny))
        middle = order[np.searchsorted(np.cumsum(angle[order]), angle.sum() / 2)]  # the weighted median
        scale = along[middle] / angle[middle]
        std = np.sqrt(np.pi / 2) * _robust_std(along - scale * angle) / np.linalg.norm(angle)
        return float(scale), float(std)


def _fitted(
    imu: ImuSeries, pairs: Sequence[PairEstimate], rotation: Rotation | None, time_offset_s: float | None
) -> _Fit | str:
    """The solution of (1), from a closed form; or why that cannot be."""
    gyro, turns = _Gyro(imu), _turns(pairs, int(imu.stamps_ns[0]))
    offset_s, correlation = _correlate(gyro, turns) if time_offset_s is None else (time_offset_s, 1.0)
    covered = gyro.measured(turns.source_s + offset_s, turns.target_s + offset_s)
    if covered.sum() < MIN_PAIRS:
        return f"it measured {covered.sum()} pairs from start to end, and {MIN_PAIRS} are needed"
    if covered.mean() < MIN_COVERAGE:
        return f"it measured only {covered.mean():.0%} of the pairs"
    if correlation < MIN_CORRELATION:
        return f"its angular rates do not follow those of the pairs (correlation {correlation:.2f} at best)"
    if time_offset_s is None and abs(offset_s) >= MAX_TIME_OFFSET_S:
        return f"its clock is more than {MAX_TIME_OFFSET_S} s off the camera's"
    return _refine(gyro, turns.where(covered), rotation, offset_s, estimate_offset=time_offset_s is None)


def _correlate(gyro: _Gyro, turns: _Turns) -> tuple[float, float]:
    """The time offset at which the magnitudes of the angular rates correlate best, and that correlation.

    It is Spearman's, of ranks: a few wild pairs would rule any other.
    """
    offset_s, highest = 0.0, 0.0
    speed = np.linalg.norm(turns.turned, axis=1) / (turns.target_s - turns.source_s)
    for candidate_s in np.arange(-MAX_TIME_OFFSET_S, MAX_TIME_OFFSET_S + TIME_OFFSET_STEP_S / 2, TIME_OFFSET_STEP_S):
        start_s, end_s = turns.source_s + candidate_s, turns.target_s + candidate_s
        covered = gyro.measured(start_s, end_s)
        if covered.sum() < MIN_PAIRS:
            continue
        ranks = rankdata([speed[covered], gyro.speed(start_s[covered], end_s[covered])], axis=1)
        if np.all(np.ptp(ranks, axis=1) > 0.0):
            correlation = float(np.corrcoef(ranks)[0, 1])
            if correlation > highest:
                offset_s, highest = float(candidate_s), correlation
    return offset_s, highest


def _wahba(gyro_turned: FloatArray, turned: FloatArray) -> Rotation:
    """R_imu_camera that best turns the rotation vectors (N, 3) of the pairs into those of the gyro, in closed form.

    A constant bias drops out by centring. Pairs whose two angles differ, whatever the mounting, count little.
    """
    difference = np.linalg.norm(gyro_turned, axis=1) - np.linalg.norm(turned, axis=1)
    scale = CAUCHY * MAD_TO_STD * np.median(np.abs(difference - np.median(difference)))
    weight = 1.0 / (1.0 + ((difference - np.median(difference)) / scale) ** 2)
    centred = [values - np.average(values, axis=0, weights=weight) for values in (gyro_turned, turned)]
    rotation, _ = Rotation.align_vectors(*centred, weights=weight)
    return rotation


def _refine(
    gyro: _Gyro,
    turns: _Turns,
    rotation: Rotation | None,
    offset_s: float,
    *,
    estimate_offset: bool,
    ahead_s: FloatArray | float = 0.0,
) -> _Fit:
    """Robust generalised least squares on (1), with weak priors; rotation None is estimated from the closed form.

    ahead_s (N,): by how much more than by the offset the gyro's clock is ahead during each pair.
    """
    source_s, target_s, turned = turns
    seconds = (target_s - source_s)[:, None]
    start = rotation or _wahba(gyro.turned(source_s + offset_s, target_s + offset_s), turned)
    free = np.repeat([rotation is None, True, estimate_offset], [3, 3, 1])
    solution, covariance = np.zeros(7), np.zeros((7, 7))  # the solution is relative to the start
    to_camera = start.inv()
    for _ in range(ITERATIONS):
        from_s, to_s = (at_s + offset_s + ahead_s + solution[6] for at_s in (source_s, target_s))
        predicted = to_camera.apply(gyro.turned(from_s, to_s) - solution[BIAS] * seconds)
        by_rotation = np.cross(np.eye(3), predicted[:, None, :]).swapaxes(1, 2)  # d/dx Exp(x) p = -[p]
        by_bias = -seconds[:, :, None] * to_camera.as_matrix()
        by_offset = to_camera.apply(gyro.rate(to_s) - gyro.rate(from_s))[:, :, None]
        white = _White.of(turned - predicted, np.concatenate([by_rotation, by_bias, by_offset], axis=2))
        gradient = white.by_residual.sum(axis=0)[free] - solution[free] / PRIOR_STD[free] ** 2
        covariance[np.ix_(free, free)] = np.linalg.inv(white.information[np.ix_(free, free)])
        step = covariance[:, free] @ gradient
        solution += step
        to_camera = Rotation.from_rotvec(step[ROTATION]) * to_camera
        if np.all(np.abs(step) <= CONVERGED):
            break
    return _Fit(
        rotation_imu_camera=to_camera.inv(),
        gyro_bias=solution[BIAS],
        time_offset_s=float(offset_s + solution[6]),
        std=np.sqrt(np.diag(covariance)),
        moved_s=float(solution[6]),
        turns=turns,
        predicted=predicted,
        sigma=_robust_std(turned - predicted),
        white=white,
        free=free,
    )


def _gyro_bias(fit: _Fit) -> tuple[FloatArray, float]:
    """The gyro's bias (3,) in IMU axes and its standard deviation: of a bare gyro and of one without a bias.

    Mean and deviation of the mixture of both, with even chances beforehand: near zero where what the pairs show can be
    chance, and where that is open, uncertain by as much as it is large. How uncertain a mean of correlated errors is
    follows from the scatter of the means of batches (Law and Carson, "A sequential procedure for determining the length
    of a steady-state simulation", 1979).
    """
    weight = 1.0 / (1.0 + (fit.deviation / CAUCHY) ** 2)
    errors = (fit.turns.turned - fit.predicted) / (fit.turns.target_s - fit.turns.source_s)[:, None]
    batches = zip(np.array_split(errors, BATCHES), np.array_split(weight, BATCHES), strict=True)
    means = [np.average(values, axis=0, weights=weights) for values, weights in batches]
    variance = float(np.mean(np.var(means, axis=0, ddof=1))) / BATCHES + PAIR_DRIFT**2
    squared = fit.gyro_bias @ fit.gyro_bias
    by_chance = multivariate_t(np.zeros(3), variance * np.eye(3), df=3 * (BATCHES - 1)).logpdf(fit.gyro_bias)
    if_bare = multivariate_normal(np.zeros(3), (variance + BARE_GYRO_BIAS**2) * np.eye(3)).logpdf(fit.gyro_bias)
    bare = float(expit(if_bare - by_chance))
    return bare * fit.gyro_bias, float(np.sqrt(bare * variance + bare * (1.0 - bare) * squared / 3.0))


def _without_bias_steps(
    imu: ImuSeries, fit: _Fit, rotation: Rotation | None, *, estimate_offset: bool
) -> tuple[_Fit, list[Change], float]:
    """The fit with the steps of the gyro's bias taken out, those steps, and the standard deviation of the last."""
    steps: list[Change] = []
    std = 0.0
    while len(steps) < MAX_BIAS_STEPS and (found := _bias_step(fit)) is not None:
        at_s, step, std = found
        at_ns = int(imu.stamps_ns[0]) + round((at_s + fit.time_offset_s) * NANOSECONDS)
        steps.append(Change(at_ns, 0, fit.rotation_imu_camera.apply(step)))
        imu = _unchanged(imu, steps[-1:])
        fit = _refine(_Gyro(imu), fit.turns, rotation, fit.time_offset_s, estimate_offset=estimate_offset)
    return fit, steps, std


def _low_pass(gyro: _Gyro, fit: _Fit, rotation: Rotation | None, estimate_offset: bool) -> float:
    """The time constant (s) of the gyro's low-pass filter; zero where it is not likely to have one.

    A filter of first order delays slow motion by its time constant, which the time offset takes in, and damps fast
    motion, which nothing else explains.
    """

    def log_sigma(low_pass_s: float) -> float:
        undone, offset_s = gyro.without_low_pass(low_pass_s), fit.time_offset_s - low_pass_s
        return _refine(undone, fit.turns, rotation, offset_s, estimate_offset=estimate_offset).white.log_sigma

    gained = np.array([fit.white.log_sigma - log_sigma(each) for each in LOW_PASSES_S.tolist()])
    best = int(np.argmax(gained))
    if gained[best] < LEAST_BY_LOW_PASS * np.sqrt(fit.turns.turned.size):
        return 0.0
    near = slice(*np.clip([best - 1, best + 2], 0, len(gained)))
    curvature, slope, _ = np.polyfit(LOW_PASSES_S[near], gained[near], 2) if near.stop - near.start == 3 else (0, 0, 0)
    return float(-slope / (2.0 * curvature) if curvature < 0.0 else LOW_PASSES_S[best])


def _small_jump(
    gyro: _Gyro, fit: _Fit, rotation: Rotation | None, *, estimate_offset: bool
) -> tuple[float, float] | None:
    """When the gyro's clock jumped ahead (s, camera clock), and by how much (s); None where that is not likely."""
    start_s = fit.turns.source_s
    inside = np.flatnonzero((start_s - start_s[0] > SMALL_JUMP_EDGE_S) & (start_s[-1] - start_s > SMALL_JUMP_EDGE_S))
    if not len(inside):
        return None
    gained, by_s = _jumps_before(fit, inside)
    best = int(np.argmax(gained))
    if gained[best] < LEAST_BY_JUMP:
        return None
    row, jumped_s, step_s = inside[best], 0.0, float(by_s[best])
    after = np.arange(len(start_s)) >= row
    for _ in range(ITERATIONS):  # a step is what (1) shows of a jump where it is linear, less for outliers
        jumped_s += step_s
        offset_s = fit.time_offset_s
        ahead_s = jumped_s * after
        fit = _refine(gyro, fit.turns, rotation, offset_s, estimate_offset=estimate_offset, ahead_s=ahead_s)
        step_s = float(_jumps_before(fit, np.array([row]))[1][0])
        if abs(step_s) < JUMP_CONVERGED_S:
            break
    return (float(start_s[row]), jumped_s) if abs(jumped_s) > MIN_JUMP_S else None


def _jumps_before(fit: _Fit, rows: NDArray[np.intp]) -> tuple[FloatArray, FloatArray]:
    """How much likelier, in its logarithm, a jump of the clock before some pairs (M,) is than none, and by what (s).

    A generalised likelihood ratio of (1) (Willsky and Jones, 1976), all other parameters being free, and the gyro's
    bias to step there, too, so that such a step does not pass for a jump.
    """
    own = np.r_[BIAS, OFFSET]
    of_residual, of_jacobian = (
        np.cumsum(each[::-1], axis=0)[::-1][rows] for each in (fit.white.by_residual, fit.white.by_jacobian)
    )
    with_free = of_jacobian[:, own][:, :, fit.free]
    unknown = np.linalg.inv(fit.white.information[np.ix_(fit.free, fit.free)])
    information = of_jacobian[:, own][:, :, own] - with_free @ unknown @ with_free.swapaxes(1, 2)
    information += np.diag(np.repeat([STEP_PRIOR, SMALL_JUMP_PRIOR_S], [3, 1]) ** -2.0)
    gradient = of_residual[:, own, None]
    both, step = np.linalg.solve(information, gradient), np.linalg.solve(information[:, :3, :3], gradient[:, :3])
    gained = 0.5 * (np.sum(gradient * both, axis=(1, 2)) - np.sum(gradient[:, :3] * step, axis=(1, 2)))
    return np.asarray(gained), np.asarray(both[:, 3, 0])


def _bias_step(fit: _Fit) -> tuple[float, FloatArray, float] | None:
    """When the gyro's bias stepped most (s, camera clock), by what (3,) in camera axes, and its standard deviation.

    None where no step is beyond what batches of errors scatter by on either side (binary segmentation).
    """
    errors = (fit.predicted - fit.turns.turned) / (fit.turns.target_s - fit.turns.source_s)[:, None]
    clipped = _clipped(errors)
    number = ((fit.turns.source_s - fit.turns.source_s[0]) // STEP_BATCH_S).astype(int)
    numbers = np.unique(number)
    count, pairs = len(numbers), len(errors)
    if count < STEP_MIN_BATCHES or pairs < 2 * STEP_MIN_PAIRS:
        return None
    passed = np.arange(STEP_MIN_PAIRS, pairs - STEP_MIN_PAIRS + 1)[:, None]
    before = np.cumsum(clipped, axis=0)[passed[:, 0] - 1]
    contrast = (clipped.sum(axis=0) - before) / (pairs - passed) - before / passed
    split = int(passed[np.argmax(np.sum(contrast**2, axis=1) * (passed * (pairs - passed))[:, 0]), 0])
    step = np.median(errors[split:], axis=0) - np.median(errors[:split], axis=0)

    level = _clipped(errors - step * (np.arange(pairs) >= split)[:, None])
    means = np.stack([level[number == k].mean(axis=0) for k in numbers])
    share = split / pairs
    variance = float(np.mean(np.var(means, axis=0, ddof=1))) / (count * share * (1.0 - share))
    chance = 3.0 * variance * f_distribution.isf(STEP_CHANCE, 3, 3 * (count - 2))
    if step @ step < max(chance, STEP_MIN**2):
        return None
    return float(fit.turns.source_s[split]), step, float(np.sqrt(variance))


def _clipped(errors: FloatArray) -> FloatArray:
    """Errors (N, 3), those that are far from their median moved nearer."""
    median = np.median(errors, axis=0)
    bound = CLIP * _robust_std(errors - median)
    return np.clip(errors, median - bound, median + bound)


def _whitened(residual: FloatArray, jacobian: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Residual (N, 3) and Jacobian (N, 3, M) filtered so that the residual is white with unit variance, per axis.

    And by what (3,) they were divided after the filter.

    Outliers are clipped before, or the filter would spread them over their neighbours.
    """
    bound = CLIP * _robust_std(residual)
    clipped = np.clip(residual, -bound, bound)
    white, white_jacobian = np.empty_like(residual), np.empty_like(jacobian)
    for axis in range(3):
        taps = _autoregression(clipped[:, axis])
        white[:, axis] = lfilter(taps, 1.0, clipped[:, axis])
        white_jacobian[:, axis] = lfilter(taps, 1.0, jacobian[:, axis], axis=0)
    sigma = _robust_std(white)
    return white / sigma, white_jacobian / sigma[:, None], sigma


def _autoregression(errors: FloatArray) -> FloatArray:
    """The whitening filter (1, -a1, ..., -ap) of the errors (N,), by least squares."""
    past = np.lib.stride_tricks.sliding_window_view(errors, WHITENING_ORDER)[:-1, ::-1]
    coefficients, *_ = np.linalg.lstsq(past, errors[WHITENING_ORDER:])
    return np.concatenate([[1.0], -coefficients])


def _robust_std(values: FloatArray) -> FloatArray:
    """Standard deviation along the first axis, from the median absolute value; never zero."""
    return np.asarray(np.maximum(MAD_TO_STD * np.median(np.abs(values), axis=0), np.finfo(float).eps))


def _fit_problem(fit: _Fit, max_scale_error: float) -> str | None:
    """Why a fit does not carry the use of the IMU, or None."""
    rotation_std, offset_std = fit.std[ROTATION].max(), fit.std[OFFSET].max()
    *by_axis, explained = fit.explained
    scale, scale_std = fit.scale
    if abs(fit.moved_s) > TIME_OFFSET_PRIOR_S or offset_std > MAX_TIME_OFFSET_STD_S:
        return f"the motion does not show its time offset (+-{1e3 * max(offset_std, abs(fit.moved_s)):.0f} ms)"
    if rotation_std > MAX_ROTATION_STD_RAD:
        return f"the motion does not show its mounting (+-{np.rad2deg(rotation_std):.1f} deg)"
    if explained < (MIN_EXPLAINED if rotation_std > 0.0 else MIN_EXPLAINED_GIVEN):
        return (
            f"its gyro explains too little of the pairs' turning ({max(explained, 0.0):.0%}), or they turn too little"
        )
    if min(by_axis) < MIN_EXPLAINED_AXIS:
        return f"its gyro turns the other way than the pairs about the camera's {'xyz'[int(np.argmin(by_axis))]} axis"
    if abs(scale - 1.0) > max_scale_error + 2.0 * scale_std:
        return f"its gyro shows {1.0 / scale:.3g} times the turning of the pairs"
    if fit.faulty.mean() > MAX_FAULTY_SHARE:
        return f"its gyro contradicts the pairs for {fit.faulty.mean():.0%} of the time"
    return None


def _summary(fit: _Fit, stretches: int, changes: Sequence[Change], low_pass_s: float) -> str:
    """One line on why the IMU is believed, how it was filtered, how many stretches are faulty, and what changed."""
    faulty = f"; left out in {counted(stretches, 'faulty stretch', 'faulty stretches')}" if stretches else ""
    explained = f"its gyro explains {fit.explained[-1]:.1%} of the turning of {len(fit.predicted)} pairs"
    jumped = [f"; its clock jumps by {change.clock_ns / NANOSECONDS:+.2f} s" for change in changes if change.clock_ns]
    steps = [np.linalg.norm(change.bias) for change in changes if not change.clock_ns]
    stepped = [f"; its gyro's bias steps by {step:.2g} rad/s" for step in steps]
    filtered = f"; its low-pass filter of {1e3 * low_pass_s:.0f} ms is undone" if low_pass_s > 0.0 else ""
    return f"{explained}{filtered}{faulty}{''.join(jumped + stepped)}"
