"""The pose graph back end: everything that was measured about a motion in one least-squares problem (GTSAM).

Variables: the poses X of the IMU in the first camera's frame, its velocities V and biases B, the direction of gravity
G, how it is mounted and what its clock reads E, and the lasting errors S of the front end, one state a second; with
satellite positions also where on the earth the world is U, and where the antenna is L. At first X(0) stands still, then
the first camera, to which E(0) ties it, so that the covariances of the camera's poses are those relative to it; in the
end the world is moved there.
Without an IMU the poses are those of the camera, and without loops or positions the solution is the raw trajectory.

Preintegration: Forster et al., "On-Manifold Preintegration for Real-Time Visual-Inertial Odometry", 2017. Linear
systems are solved by QR where Cholesky fails, as it does on a chain whose factors differ so much in weight. Outliers
are found by graduated non-convexity with the Geman-McClure kernel: Yang et al., "Graduated Non-Convexity for Robust
Spatial Perception", 2020.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import NamedTuple, TypeVar

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, E, G, L, S, U, V, X
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform, Rotation
from scipy.stats import chi2

from fusion import biases, front_end, gnss, marginals, outliers
from fusion.biases import Doubt
from fusion.chain import ImuWindow, ImuWindows, chain, mean_rates, motions_of
from fusion.config import PoseGraphConfig, Robust
from fusion.evidence import graph_of
from fusion.factors import NO_KNOT, Batch, PairFactors, StillFactor, by_vector, extrinsics, padded, poses_of
from fusion.imu import WANDERS, BiasStep, ImuCalibration, described
from fusion.measurements import Estimate, Measurements, Mounting
from fusion.pair_model import camera, inverse
from fusion_io.errors import LogError
from fusion_io.records import NANOSECONDS, EstimatorSeries, FloatArray, IntArray, PairEstimate, Trajectory
from fusion_io.words import counted

GRAVITY = 9.81  # m/s^2; how far the place differs from it goes into the accelerometer's bias
DOUBTFUL_NOISE = 1.0  # m/s^2/sqrt(Hz), of an accelerometer whose bias wanders: no scale follows from it
GRAVITY_STEPS = 100  # steps over which accelerations are averaged for a first direction of gravity
FIRST_POSE_SIGMA = 1e-6  # rad, m: small beside any estimate, not so small that the solver suffers
INTEGRATION_SIGMA = 1e-4  # m/s/sqrt(Hz): error of integrating positions piece by piece
RATE_SPANS_S = (0.03, 0.06, 0.1)  # to each side of a frame: so long a carrier turns at one rate, nearly
MIN_WINDOWS = 20
MAX_CONTRADICTED = 0.2  # share of the pairs: where more seem to be wrong, it is the IMU that is
# Median, over so many steps, of the squared errors of IMU factors; rough roads have up to 5.5 and 2.6. Where a log is
# shorter, what lies between by the logarithm.
MAX_IMU_SQUARES = {51: 9.0, 301: 3.2}
KNOT_S = 1.0  # between states of the front end
LEAST_CORRELATION_TIMES = 3.0  # of the front end's scale error; over less of it the log tells no more than is assumed
MIN_EIGENVALUE = 1e-9  # of a pair's correlation matrix: below, its covariance is singular but for rounding

MAX_ITERATIONS = 30
FORGIVING_ITERATIONS = 2  # before anything is judged
CONVERGED = 1e-3  # of what a step lowers the squares by: it moves nothing by more than a thirtieth of its sigma
SETTLED = 10.0  # the same, where the log is asked for what was assumed: all assumptions are at as much of a loss by it
ANNEALING = 4.0  # of the kernel's width from step to step; by larger steps wrong loops drag good pairs out with them
REJECTED_WEIGHT = 1e-4  # of a step whose pair is left out: no more than a hint, where nothing else is known


Tree = TypeVar("Tree")  # what elimination makes of a graph


@dataclass(slots=True)
class Problem:
    """A graph, where its solution is looked for from, and those of its factors that are evaluated together.

    The first factor holds X(0) still. T_camera_imu (4, 4): what E(0) strays from. twists (K, 6): of the IMU at the
    stamps of the poses, or None where the poses are those of the camera. knots (K,): the front end's state at each
    stamp. front_end_sigma: of its scale error and rate bias; front_end_rows: the factors between its states.
    first_bias, bias_sigmas (J, 6): what is known of the IMU's biases at first, and from knot to knot, bias_rows: the
    factors that say so; doubts: what was found to contradict it.
    """

    graph: gtsam.NonlinearFactorGraph
    values: gtsam.Values
    stamps_ns: IntArray
    T_camera_imu: FloatArray
    twists: FloatArray | None
    knots: IntArray
    batches: list[Batch] = field(default_factory=list)
    front_end_sigma: tuple[float, float] = (0.0, 0.0)
    front_end_rows: range = range(0)
    first_bias: gtsam.imuBias.ConstantBias = field(default_factory=gtsam.imuBias.ConstantBias)
    bias_sigmas: FloatArray = field(default_factory=lambda: np.zeros((0, 6)))
    bias_rows: range = range(0)
    doubts: list[Doubt] = field(default_factory=list)

    @property
    def between_knots_s(self) -> FloatArray:
        """Seconds (J - 1,) from each state of the front end to the next."""
        return np.asarray(np.diff(self.stamps_ns[_first(self.knots)]) / NANOSECONDS)

    @property
    def tied_up(self) -> bool:
        """Whether factors reach beyond poses that follow each other."""
        return any(isinstance(batch, PairFactors) and np.any(batch.target - batch.source > 1) for batch in self.batches)

    def add(self, batch: Batch) -> Batch:
        """Add factors to the graph."""
        self.batches.append(batch)
        batch.add_to(self.graph)
        return batch


class Solution(NamedTuple):
    """The values that minimise a problem, and the joint covariances of each variable with E(0) where there is one."""

    values: gtsam.Values
    covariances: dict[int, FloatArray]


def solve(measurements: Measurements, config: PoseGraphConfig) -> Estimate:
    """The most likely trajectory of the camera, the covariance of every pose, and what was estimated beside them.

    Where the IMU has holes there is no factor; where it cannot be used it is left out, and the note says why. Raises
    LogError for a pair estimate that is no measurement: a rotation or covariance that is not one.
    """
    check([*measurements.steps, *measurements.skips, *measurements.loops])
    windows, problem_with_imu = _windows(measurements)
    try:
        return _solve(measurements, windows, problem_with_imu, config)
    except RuntimeError as error:  # IndeterminantLinearSystemException of GTSAM, for one
        if not any(windows):
            raise
        reason = f"the graph with the IMU has no solution ({' '.join(str(error).split())})"
        return _solve(measurements, [None] * len(windows), reason, config)


def _windows(measurements: Measurements) -> tuple[list[ImuWindow | None], str]:
    """What the IMU measured during each step, and a reason if that is too little."""
    steps, imu = measurements.steps, measurements.imu
    if imu is None:
        return [None] * len(steps), "no IMU"
    samples = ImuWindows(imu)
    windows = [samples.over(step.source_stamp_ns, step.target_stamp_ns) for step in steps]
    measured = sum(window is not None for window in windows)
    if measured < MIN_WINDOWS:
        return [None] * len(steps), f"the IMU measured {measured} of {len(steps)} steps"
    return windows, ""


def _solve(
    measurements: Measurements,
    measured: Sequence[ImuWindow | None],
    without_imu: str,
    config: PoseGraphConfig,
    wandering: Sequence[Doubt] = (),
) -> Estimate:
    """wandering: what was found of the accelerometer, which is hardly believed then."""
    if wandering:
        config = config.model_copy(update={"accelerometer_noise": max(config.accelerometer_noise, DOUBTFUL_NOISE)})
    steps, calibration = measurements.steps, measurements.calibration
    inertial = calibration if any(window is not None for window in measured) else None
    mounting = Rotation.identity() if inertial is None else inertial.mounting
    bias = np.zeros(3) if inertial is None else inertial.gyro_bias
    wrong = outliers.suspects(steps, measured, mounting, bias, config.gate_probability)
    windows = [None if bad else window for window, bad in zip(measured, wrong.imu, strict=True)]

    start = _repaired(steps, windows, wrong.pair, mounting, bias)
    problem = _pairs_only(steps, start) if inertial is None else _with_imu(steps, start, windows, inertial, config)
    pairs = _add_pairs(problem, steps, problem.knots[:-1])
    pairs.least_weight = REJECTED_WEIGHT
    pairs.weights[wrong.pair] = REJECTED_WEIGHT
    begin = np.searchsorted(problem.stamps_ns, [skip.source_stamp_ns for skip in measurements.skips])
    skips = _add_pairs(problem, measurements.skips, problem.knots[begin])
    loops = _add_pairs(problem, measurements.loops, NO_KNOT)
    problem.front_end_sigma = config.front_end_sigma(steps)
    _add_front_end(problem, config)
    tie, without_gnss = gnss.tie(problem, measurements.gnss)
    solution = minimise(problem, config)
    found = [doubt for doubt in problem.doubts if doubt.wanders]
    if found and not wandering:
        return _solve(measurements, measured, without_imu, config, found)
    problem.doubts += wandering

    if inertial is not None:
        _refuse_contradiction(problem.graph, solution.values, (pairs.weights < 0.5) & ~wrong.pair)
    rejected = np.flatnonzero(pairs.weights < 0.5)
    loops_used = loops.weights >= 0.5
    georeference = tie.georeference(problem, solution) if tie else None
    told = None if problem.front_end_sigma == config.front_end_sigma(steps) else problem.front_end_sigma
    stepped = _bias_steps(problem, solution)
    notes = described(stepped, int(problem.stamps_ns[0]))
    notes += [WANDERS] if wandering else []
    others = (skips, loops, tie.factors) if tie else (skips, loops)
    return Estimate(
        trajectory_of(problem, solution),
        _note(windows, without_imu, told, notes, skips.weights < 0.5, len(rejected), loops_used)
        + gnss.note(measurements.gnss, georeference, without_gnss),
        len(rejected) + int(wrong.imu.sum()) + sum(int(np.sum(each.weights < 0.5)) for each in others),
        series_of(problem, solution, pairs),
        loops_used,
        _mounting(problem, solution),
        told,
        stepped,
        georeference,
    )


def _refuse_contradiction(
    graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, contradicted: NDArray[np.bool_]
) -> None:
    """Raise RuntimeError where a solution shows that IMU and pairs (N,) cannot both be right."""
    if contradicted.mean() > MAX_CONTRADICTED:
        raise RuntimeError(f"it contradicts {contradicted.sum()} of {len(contradicted)} pairs")
    factors = (graph.at(i) for i in range(graph.size()))
    inertial = [each for each in factors if isinstance(each, gtsam.ImuFactorWithGravityDirection)]
    squares = np.array([2.0 * each.error(values) for each in inertial])
    for steps in sorted({min(steps, len(squares)) for steps in MAX_IMU_SQUARES}):
        most = _accepted(steps)
        stretches = np.lib.stride_tricks.sliding_window_view(squares, steps)
        worst = np.max(np.median(stretches, axis=1))
        if worst > most:
            off = f"{np.sqrt(worst):.1f} standard deviations off the motion, where {np.sqrt(most):.1f} are accepted"
            raise RuntimeError(f"the IMU is {off}, for {steps} frames")


def _accepted(steps: int) -> float:
    """The largest median, over so many steps, of the squared errors of IMU factors."""
    return float(np.interp(np.log(steps), np.log([*MAX_IMU_SQUARES]), [*MAX_IMU_SQUARES.values()]))


def check(pairs: Sequence[PairEstimate]) -> None:
    """Refuse, with a LogError, what would end the interpreter or never converge inside GTSAM."""
    quats = np.stack([pair.quat_wxyz for pair in pairs])
    translations = np.stack([pair.translation for pair in pairs])
    covariances = np.stack([pair.covariance for pair in pairs])
    _refuse(pairs, ~np.isfinite(np.hstack([quats, translations])).all(axis=1), "its pose is not finite")
    _refuse(pairs, abs(np.linalg.norm(quats, axis=1) - 1.0) > 1e-3, "its rotation is not a unit quaternion")
    variances = np.diagonal(covariances, axis1=1, axis2=2)
    finite = np.isfinite(covariances).all(axis=(1, 2)) & (variances > 0.0).all(axis=1)
    _refuse(pairs, ~finite, "its covariance has variances that are not finite and positive")
    sigmas = np.sqrt(variances)
    correlations = covariances / (sigmas[:, :, None] * sigmas[:, None, :])
    symmetric = np.isclose(correlations, correlations.swapaxes(1, 2)).all(axis=(1, 2))
    definite = np.linalg.eigvalsh(correlations)[:, 0] > MIN_EIGENVALUE
    _refuse(pairs, ~(symmetric & definite), "its covariance is not symmetric and positive definite")


def _refuse(pairs: Sequence[PairEstimate], bad: NDArray[np.bool_] | np.bool_, reason: str) -> None:
    if bad.any():
        raise LogError(f"pair estimate at {pairs[int(bad.argmax())].target_stamp_ns} ns: {reason}")


# ------------------------------------------------------------------------------------------------------- the graph


def _repaired(
    steps: Sequence[PairEstimate],
    windows: Sequence[ImuWindow | None],
    wrong: NDArray[np.bool_],
    mounting: Rotation,
    bias: FloatArray,
) -> Trajectory:
    """The chain of the steps, those that are wrong bridged by the velocity of the others and by the gyro."""
    if not np.any(wrong):
        return chain(steps)
    seconds = np.array([step.duration_s for step in steps])
    middle = np.cumsum(seconds) - seconds / 2
    rates = motions_of(steps).as_exp_coords() / seconds[:, None]
    good = ~wrong
    bridged = list(steps)
    for k in np.flatnonzero(wrong).tolist():
        twist = np.array([np.interp(middle[k], middle[good], axis) for axis in rates[good].T]) * seconds[k]
        if (window := windows[k]) is not None:
            twist[:3] = mounting.inv().apply(window.rotation(bias).as_rotvec())
        motion = RigidTransform.from_exp_coords(twist)
        quat_wxyz = motion.rotation.as_quat(scalar_first=True)
        bridged[k] = replace(steps[k], quat_wxyz=quat_wxyz, translation=motion.translation)
    return chain(bridged)


def _pairs_only(steps: Sequence[PairEstimate], start: Trajectory) -> Problem:
    """The poses of the camera, the first one fixed."""
    graph, values = _poses(start.poses.as_matrix())
    return Problem(graph, values, start.stamps_ns, np.eye(4), None, _knots(start.stamps_ns))


def _poses(poses: FloatArray) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """Variables X at poses (K, 4, 4), and a graph that holds the first one still."""
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    fixed = gtsam.noiseModel.Isotropic.Sigma(6, FIRST_POSE_SIGMA)
    graph.add(gtsam.PriorFactorPose3(X(0), gtsam.Pose3(poses[0]), fixed))
    for k, pose in enumerate(poses):
        values.insert(X(k), gtsam.Pose3(pose))
    return graph, values


def _with_imu(
    steps: Sequence[PairEstimate],
    start: Trajectory,
    windows: Sequence[ImuWindow | None],
    calibration: ImuCalibration,
    config: PoseGraphConfig,
) -> Problem:
    """The poses of the IMU, its velocities, biases, gravity and mounting; its factors."""
    T_camera_imu = np.eye(4)
    T_camera_imu[:3, :3] = calibration.mounting.inv().as_matrix()
    poses = start.poses.as_matrix() @ T_camera_imu
    graph, values = _poses(poses)
    seconds = start.stamps_ns / NANOSECONDS
    velocities = np.gradient(poses[:, :3, 3], seconds, axis=0)
    bias = gtsam.imuBias.ConstantBias(np.zeros(3), calibration.gyro_bias)
    for k, velocity in enumerate(velocities):
        values.insert(V(k), velocity)
    knots = _knots(start.stamps_ns)
    for j in range(knots[-1] + 1):
        values.insert(B(j), bias)
    bias_sigmas = np.vstack(
        [first_bias_sigmas(calibration, config), bias_walk(start.stamps_ns[_first(knots)], calibration, config)]
    )
    bias_rows = range(graph.size(), graph.size() + len(bias_sigmas))
    for factor in biases.walk(bias, bias_sigmas):
        graph.add(factor)
    used = [(k, window) for k, window in enumerate(windows) if window is not None]
    values.insert(G(0), gtsam.Unit3(_gravity(used[:GRAVITY_STEPS], poses, velocities)))
    values.insert(E(0), np.zeros(10))

    given = not np.any(calibration.rotation_std_rad)
    rotation_sigma = config.given_mounting_sigma if given else config.mounting_sigma
    offset_sigma = config.given_time_offset_sigma if not calibration.time_offset_std_s else config.time_offset_sigma
    sigmas = np.repeat(
        [rotation_sigma, config.lever_arm_sigma, offset_sigma, config.pair_misalignment_sigma], [3, 3, 1, 3]
    )
    graph.add(gtsam.PriorFactorVector(E(0), np.zeros(10), _diagonal(sigmas)))

    _add_preintegrated(graph, windows, knots, bias, np.diff(seconds), config)

    twists = np.zeros((len(poses), 6))
    twists[:, :3] = _rates(used, seconds, config.gyro_noise)
    twists[:, 3:] = np.einsum("nji,nj->ni", poses[:, :3, :3], velocities)
    problem = Problem(graph, values, start.stamps_ns, T_camera_imu, twists, knots)
    problem.first_bias, problem.bias_sigmas, problem.bias_rows = bias, bias_sigmas, bias_rows
    return problem


def _rates(windows: Sequence[tuple[int, ImuWindow]], seconds: FloatArray, gyro_noise: float) -> FloatArray:
    """The angular velocities (K, 3) at times (K,), from windows (with their step), linear where there are none.

    They are the rates at which poses move with the clock: their noise would pass for knowledge of it. Means over a
    longer time have less, but a carrier may have turned otherwise meanwhile. Of nested means of white noise the shorter
    one r and the longer one s have E |r - s|^2 = |bias of s|^2 + v_r - v_s, so that the data tell which errs least
    (Stein, "Estimation of the mean of a multivariate normal distribution", 1981).
    """
    means = [_mean_rates(windows, seconds, span_s) for span_s in RATE_SPANS_S]
    variances = [gyro_noise**2 / (2 * span_s) for span_s in RATE_SPANS_S]
    risks = [np.mean((rates - means[0]) ** 2) + 2 * v for rates, v in zip(means, variances, strict=True)]
    return means[int(np.argmin(risks))]


def _mean_rates(windows: Sequence[tuple[int, ImuWindow]], seconds: FloatArray, span_s: float) -> FloatArray:
    """The same as means over span_s on both sides of each."""
    steps = np.array([k for k, _ in windows])
    sums, counts = np.zeros((len(seconds), 3)), np.zeros(len(seconds))
    for side, rates in enumerate(mean_rates([window for _, window in windows], span_s).swapaxes(0, 1)):
        sums[steps + side] += rates
        counts[steps + side] += 1
    known = counts > 0
    means = sums[known] / counts[known, None]
    return np.stack([np.interp(seconds, seconds[known], axis) for axis in means.T], axis=1)


def first_bias_sigmas(calibration: ImuCalibration, config: PoseGraphConfig) -> FloatArray:
    """How uncertain (6,) the biases are at first: accelerometer (m/s^2), then gyro (rad/s)."""
    gyro = np.hypot(config.gyro_bias_sigma, calibration.gyro_bias_std)
    return np.repeat([config.accelerometer_bias_sigma, gyro], 3)


def bias_walk(starts_ns: IntArray, calibration: ImuCalibration, config: PoseGraphConfig) -> FloatArray:
    """By how much (J - 1, 6) the biases may differ between knots that start at (J,).

    They wander; where the calibration found that the gyro's stepped, it is as uncertain as at first.
    """
    walk = np.repeat([config.accelerometer_bias_walk, config.gyro_bias_walk], 3)
    variances = walk**2 * (np.diff(starts_ns) / NANOSECONDS)[:, None]
    for step in calibration.bias_steps:
        variances[(step.at_ns >= starts_ns[:-1]) & (step.at_ns < starts_ns[1:])] += step.std**2
    return np.asarray(np.sqrt(variances))


def _add_preintegrated(
    graph: gtsam.NonlinearFactorGraph,
    windows: Sequence[ImuWindow | None],
    knots: IntArray,
    bias: gtsam.imuBias.ConstantBias,
    seconds: FloatArray,
    config: PoseGraphConfig,
) -> None:
    """A factor for every step that the IMU measured; over the others the velocity walks."""
    parameters = preintegration(config)
    for k, (window, dt) in enumerate(zip(windows, seconds, strict=True)):
        if window is None:
            walk = gtsam.noiseModel.Isotropic.Sigma(3, config.unknown_acceleration * np.sqrt(dt))
            graph.add(gtsam.BetweenFactorVector(V(k), V(k + 1), np.zeros(3), walk))
            continue
        variables = (X(k), V(k), X(k + 1), V(k + 1), B(int(knots[k])), G(0))
        measured = preintegrate(window, bias, parameters)
        graph.add(gtsam.ImuFactorWithGravityDirection(*variables, measured, GRAVITY))


def preintegration(config: PoseGraphConfig) -> gtsam.PreintegrationParams:
    """The noise of the IMU; gravity is a variable of the graph."""
    parameters = gtsam.PreintegrationParams(np.zeros(3))
    parameters.setGyroscopeCovariance(config.gyro_noise**2 * np.eye(3))
    parameters.setAccelerometerCovariance(config.accelerometer_noise**2 * np.eye(3))
    parameters.setIntegrationCovariance(INTEGRATION_SIGMA**2 * np.eye(3))
    return parameters


def preintegrate(
    window: ImuWindow, bias: gtsam.imuBias.ConstantBias, parameters: gtsam.PreintegrationParams
) -> gtsam.PreintegratedImuMeasurements:
    """What the IMU measured during a step."""
    preintegrated = gtsam.PreintegratedImuMeasurements(parameters, bias)
    for duration, rate, acceleration in zip(*window, strict=True):
        preintegrated.integrateMeasurement(acceleration, rate, duration)
    return preintegrated


def _gravity(windows: Sequence[tuple[int, ImuWindow]], poses: FloatArray, velocities: FloatArray) -> FloatArray:
    """Where gravity points, from some windows (with their step), poses (K, 4, 4) and velocities (K, 3) of the IMU.

    An accelerometer shows acceleration less gravity, so that gravity is what the change of velocity is short of.
    """
    shown = sum(poses[k, :3, :3] @ (window.durations @ window.linear_acceleration) for k, window in windows)
    gained = sum(velocities[k + 1] - velocities[k] for k, _ in windows)
    return np.asarray(gained - shown)


def _knots(stamps_ns: IntArray) -> IntArray:
    """The state of the front end at each stamp: one for every KNOT_S, numbered without gaps."""
    seconds = (stamps_ns - stamps_ns[0]) // int(KNOT_S * NANOSECONDS)
    return np.asarray(np.unique(seconds, return_inverse=True)[1])


def _first(knots: IntArray) -> IntArray:
    """Where each knot begins."""
    return np.flatnonzero(np.diff(knots, prepend=-1))


def _add_pairs(problem: Problem, pairs: Sequence[PairEstimate], knots: IntArray | int) -> PairFactors:
    """Add pair estimates between poses of the problem."""
    ends = np.array([(pair.source_stamp_ns, pair.target_stamp_ns) for pair in pairs], dtype=np.int64).reshape(-1, 2)
    source, target = np.searchsorted(problem.stamps_ns, ends).T
    knots = np.broadcast_to(knots, len(pairs))
    factors = PairFactors(pairs, source, target, knots, problem.T_camera_imu, problem.twists)
    problem.add(factors)
    return factors


def _add_front_end(problem: Problem, config: PoseGraphConfig) -> None:
    """The lasting errors of the front end, one state a knot."""
    for knot in range(problem.knots[-1] + 1):
        problem.values.insert(S(knot), np.zeros(4))
    start = problem.graph.size()
    for factor in front_end.process(problem.between_knots_s, problem.front_end_sigma, config):
        problem.graph.add(factor)
    problem.front_end_rows = range(start, problem.graph.size())


def _diagonal(sigmas: FloatArray) -> gtsam.noiseModel.Diagonal:
    """Independent noise; not GTSAM's "smart" one, whose tiny standard deviations are constraints without covariance."""
    return gtsam.noiseModel.Diagonal.Sigmas(sigmas, False)


# ---------------------------------------------------------------------------------------------------- its solution


def minimise(problem: Problem, config: PoseGraphConfig) -> Solution:
    """Gauss-Newton, step by step less forgiving to measurements that may be wrong."""
    judged = [batch for batch in problem.batches if batch.judged]
    gates = [chi2.isf(config.gate_probability, batch.dimension) for batch in judged]
    order = elimination_order(problem)
    values, width, asking = problem.values, np.inf, problem.twists is not None
    lowered = 0.0  # by the step before; none
    for iteration in range(MAX_ITERATIONS):
        for batch in problem.batches:
            batch.update(values)
        if iteration == FORGIVING_ITERATIONS:
            _renew_velocities(problem, values)
            width = max(batch.squared.max(initial=0.0) / gate for batch, gate in zip(judged, gates, strict=True))
        if iteration >= FORGIVING_ITERATIONS:
            width = _reweigh(judged, gates, width, config.robust)
        linear = problem.graph.linearize(values)
        net = _eliminated(linear.eliminateSequential, order, problem.tied_up)
        step = net.optimize()
        before, lowered = lowered, 2.0 * (linear.error(values.zeroVectors()) - linear.error(step))
        point, values = values, values.retract(step)
        if iteration >= FORGIVING_ITERATIONS and width <= 1.0:
            # By the next step: they shrink by the same factor, or faster.
            ahead = lowered**2 / before if before > lowered else lowered
            if asking and ahead < SETTLED:
                asking = _renew_assumptions(problem, point, linear, order, config)
                lowered = 0.0
                if not asking:  # not before: E(0) still moved far, and with it all that hangs on it
                    _tie_to_first_camera(problem, values)
            elif not asking and ahead < CONVERGED:
                break
    if asking:  # it has not settled
        _tie_to_first_camera(problem, values)
        for batch in problem.batches:
            batch.update(values)
        net = _eliminated(problem.graph.linearize(values).eliminateSequential, order, problem.tied_up)
    if not np.all(np.isfinite(poses_of(values))):
        raise RuntimeError("the solution is not finite")
    moved = _make_first_camera_the_world(problem, values)
    for batch in problem.batches:
        batch.update(values)
    mounted = [E(0)] if values.exists(E(0)) else []

    def wanted(key: int) -> list[int] | None:
        """Poses and the antenna together with what they are mounted by; all else but velocities and gravity alone."""
        kind = chr(gtsam.Symbol(key).chr())
        return [key, *mounted] if kind in "xl" else [key] if kind in "bseu" else None

    covariances = marginals.covariances(net, wanted)
    if U(0) in covariances:  # the only one of these variables that is perturbed in the axes of the world
        turned = gtsam.Pose3(moved).AdjointMap()
        covariances[U(0)] = turned @ covariances[U(0)] @ turned.T
    return Solution(values, covariances)


def _renew_velocities(problem: Problem, values: gtsam.Values) -> None:
    """Take the velocities with which poses move with the clock from the solution: those of single pairs are noisy."""
    if problem.twists is not None:
        velocities = gtsam.utilities.extractVectors(values, "v")
        problem.twists[:, 3:] = np.einsum("nji,nj->ni", poses_of(values)[:, :3, :3], velocities)


def _shows_scale(problem: Problem, config: PoseGraphConfig) -> bool:
    """Whether how large scale errors are can be told: they had time to change, and an accelerometer sees it."""
    seconds = (problem.stamps_ns[-1] - problem.stamps_ns[0]) / NANOSECONDS
    believed = problem.twists is not None and config.accelerometer_noise < DOUBTFUL_NOISE
    return believed and seconds > LEAST_CORRELATION_TIMES * config.pair_scale_correlation_s


def _renew_assumptions(
    problem: Problem,
    point: gtsam.Values,
    linear: gtsam.GaussianFactorGraph,
    order: gtsam.Ordering,
    config: PoseGraphConfig,
) -> bool:
    """Take from the log what was assumed of it: the size of scale errors, and how biases of the IMU behave.

    linear: the problem at a point near its solution. Returns whether they did not as assumed: then there may be more.
    """
    assumed, rate = problem.front_end_sigma

    def process(factor: float) -> list[gtsam.NonlinearFactor]:
        return front_end.process(problem.between_knots_s, (factor * assumed, rate), config)

    def linear_process(factor: float) -> gtsam.GaussianFactorGraph:
        return graph_of(each.linearize(point) for each in process(factor))

    def eliminate(graph: gtsam.GaussianFactorGraph) -> gtsam.GaussianBayesNet:
        return _eliminated(graph.eliminateSequential, rest, problem.tied_up)

    others, rest = _between_knots(problem, linear, order)
    factor = 1.0
    if _shows_scale(problem, config):
        walks = graph_of(linear.at(row) for row in problem.bias_rows)
        factor = front_end.likely_scale(graph_of(others, walks), linear_process, eliminate)
    others.push_back(linear_process(factor))
    if len(problem.doubts) < biases.MOST:
        doubt = biases.likely_doubt(others, point, problem.first_bias, problem.bias_sigmas, eliminate)
        if doubt is not None:  # what the scale seemed to be is an effect of it, too
            problem.doubts.append(doubt)
            problem.bias_sigmas = doubt.on(problem.bias_sigmas)
            for knot in doubt.knots:
                loose = biases.link(problem.first_bias, knot, problem.bias_sigmas[knot])
                problem.graph.replace(problem.bias_rows[knot], loose)
            return True
    problem.front_end_sigma = factor * assumed, rate
    for row, each in zip(problem.front_end_rows, process(factor), strict=True):
        problem.graph.replace(row, each)
    return False


def _between_knots(
    problem: Problem, linear: gtsam.GaussianFactorGraph, order: gtsam.Ordering
) -> tuple[gtsam.GaussianFactorGraph, gtsam.Ordering]:
    """What a linear problem, but for the factors that are assumed, tells of knots; and how that is eliminated.

    Frames that only those of their own knot and the next one's first are tied to have nothing to do with assumptions,
    so that they are eliminated once for all of them.
    """
    assumed = {*problem.front_end_rows, *problem.bias_rows}
    others = graph_of(linear.at(row) for row in range(linear.size()) if row not in assumed)
    frames = len(problem.knots)
    first = _first(problem.knots)
    last = np.append(first[1:], frames - 1)[problem.knots]
    ends = np.isin(np.arange(frames), [*first, frames - 1])
    tied = ends.copy()
    for batch in problem.batches:
        if isinstance(batch, PairFactors):
            far = batch.target > last[batch.source]
            tied[batch.source[far]] = tied[batch.target[far]] = True
    gone = {*map(X, np.flatnonzero(~tied).tolist()), *map(V, np.flatnonzero(~ends).tolist())}
    inner, rest = gtsam.Ordering(), gtsam.Ordering()
    for place in range(order.size()):
        key = order.at(place)
        (inner if key in gone else rest).push_back(key)
    _, reduced = _eliminated(others.eliminatePartialSequential, inner, problem.tied_up)
    if problem.tied_up:  # what is best for all frames takes three times as long for the rest
        rest = gtsam.Ordering.ColamdGaussianFactorGraph(graph_of(reduced, (linear.at(row) for row in sorted(assumed))))
    return reduced, rest


def _tie_to_first_camera(problem: Problem, values: gtsam.Values) -> None:
    """Let the first camera stand still instead of X(0), which then depends on E(0)."""
    assert problem.twists is not None
    still = StillFactor(problem.T_camera_imu, problem.twists[:1], FIRST_POSE_SIGMA)
    still.update(values)
    problem.batches.append(still)
    problem.graph.replace(0, still.factor(0))


def _make_first_camera_the_world(problem: Problem, values: gtsam.Values) -> FloatArray:
    """Move the world, which changes no error; returns the pose (4, 4) of what was the world in what is it now."""
    if problem.twists is None:
        return np.eye(4)  # it is so already
    moved = inverse(cameras(problem, values)[0][0])
    poses, velocities = moved @ poses_of(values), gtsam.utilities.extractVectors(values, "v") @ moved[:3, :3].T
    for k, (pose, velocity) in enumerate(zip(poses, velocities, strict=True)):
        values.update(X(k), gtsam.Pose3(pose))
        values.update(V(k), velocity)
    values.update(G(0), gtsam.Unit3(moved[:3, :3] @ values.atUnit3(G(0)).point3()))
    if values.exists(U(0)):
        values.update(U(0), gtsam.Pose3(values.atPose3(U(0)).matrix() @ inverse(moved)))
    return moved


def _eliminated(eliminate: Callable[..., Tree], order: gtsam.Ordering, tied_up: bool) -> Tree:
    """A linear graph by its own `eliminate`: with Cholesky where loops tie it up, which takes a fourth of the time.

    Steps and covariances then differ by less than a ten-thousandth of the standard deviations.
    """
    if tied_up:
        with suppress(RuntimeError):  # IndeterminantLinearSystemException of GTSAM
            return eliminate(order)
    return eliminate(order, gtsam.EliminateQR)


def elimination_order(problem: Problem) -> gtsam.Ordering:
    """Along time, which is best for a chain; where loops tie it up, GTSAM's heuristic. What all share comes last."""
    shared = [key for key in (L(0), U(0), G(0), E(0)) if problem.values.exists(key)]
    if problem.tied_up:
        return gtsam.Ordering.ColamdConstrainedLastNonlinearFactorGraph(problem.graph, gtsam.KeyVector(shared), True)
    order = gtsam.Ordering()
    inertial = problem.twists is not None
    for k in reversed(range(len(problem.knots))):
        knot = int(problem.knots[k])
        of_frame = [V(k), X(k)] if inertial else [X(k)]
        of_knot = ([B(knot), S(knot)] if inertial else [S(knot)]) if k == 0 or problem.knots[k - 1] != knot else []
        for key in (*of_frame, *of_knot):
            order.push_back(key)
    for key in shared:
        order.push_back(key)
    return order


def _reweigh(batches: Sequence[Batch], gates: Sequence[float], width: float, robust: Robust) -> float:
    """Weights by the kernel of a width (in gates, squared); returns the width of the next step.

    With gnc, once the width is that of the gate, measurements are in or out.
    """
    for batch, gate in zip(batches, gates, strict=True):
        beyond = batch.squared / gate
        if robust == "huber":
            batch.weigh(1.0 / np.sqrt(np.maximum(beyond, 1.0)))
        elif robust == "gnc" and width > 1.0:
            batch.weigh(np.maximum((width / (width + beyond)) ** 2, batch.least_weight))
        elif robust == "gnc":
            batch.weigh(np.where(beyond > 1.0, batch.least_weight, 1.0))
    return width / ANNEALING if robust == "gnc" and width > 1.0 else min(width, 1.0)


def cameras(problem: Problem, values: gtsam.Values) -> tuple[FloatArray, FloatArray]:
    """The poses (K, 4, 4) of the camera, and how they change with X and E(0), (K, 6, 16); without E (K, 6, 6)."""
    poses = poses_of(values)
    if problem.twists is None:
        return poses, np.tile(np.eye(6), (len(poses), 1, 1))
    strayed = values.atVector(E(0))
    mounted = extrinsics(problem.T_camera_imu, strayed)
    seen, by_pose, by_extrinsics = camera(poses, mounted, problem.twists, strayed[6])
    return seen, np.concatenate([by_pose, padded(by_extrinsics @ by_vector(strayed))], axis=2)


def trajectory_of(problem: Problem, solution: Solution) -> Trajectory:
    """The poses of the camera at its own stamps, with their marginal covariances."""
    poses, J = cameras(problem, solution.values)
    covariances = J @ np.stack([solution.covariances[X(k)] for k in range(len(poses))]) @ J.swapaxes(1, 2)
    covariances[0] = 0.0  # the world itself
    return Trajectory(problem.stamps_ns, RigidTransform.from_matrix(poses), covariances)


def series_of(problem: Problem, solution: Solution, pairs: PairFactors) -> EstimatorSeries:
    """What was estimated beside the poses; what a pair shows beyond the solution stands in for an innovation."""
    values = solution.values
    frames = len(problem.stamps_ns)
    front_end = gtsam.utilities.extractVectors(values, "s")[problem.knots]
    std = _std_at(problem, solution, S)
    biases = np.full((frames, 12), np.nan)
    if problem.twists is not None:
        biases[:, :6] = [values.atConstantBias(B(j)).vector() for j in problem.knots.tolist()]
        biases[:, 6:] = _std_at(problem, solution, B)
    shown = np.full((frames, 7), np.nan)
    shown[1:] = np.column_stack([pairs.residual, pairs.squared])
    return EstimatorSeries(
        problem.stamps_ns,
        gyro_bias=biases[:, 3:6],
        gyro_bias_std=biases[:, 9:],
        accelerometer_bias=biases[:, :3],
        accelerometer_bias_std=biases[:, 6:9],
        scale_error=front_end[:, 0],
        scale_error_std=std[:, 0],
        rate_bias=front_end[:, 1:],
        rate_bias_std=std[:, 1:],
        innovation=shown[:, :6],
        nis=shown[:, 6],
        used=np.concatenate([[True], pairs.weights >= 0.5]),
    )


def _mounting(problem: Problem, solution: Solution) -> Mounting | None:
    """E(0), with its covariance about the mounting that it leads to, and the gyro's bias at first."""
    if problem.twists is None:
        return None
    strayed = solution.values.atVector(E(0))
    J = np.eye(10)
    J[:7, :7] = by_vector(strayed)
    T_camera_imu = extrinsics(problem.T_camera_imu, strayed)
    return Mounting(
        T_camera_imu,
        float(strayed[6]),
        strayed[7:],
        J @ solution.covariances[E(0)] @ J.T,
        solution.values.atConstantBias(B(0)).gyroscope(),
        np.sqrt(np.diag(solution.covariances[B(0)])[3:]),
    )


def _bias_steps(problem: Problem, solution: Solution) -> list[BiasStep]:
    """Those that were found, in order of time; of a bias that wanders, all that there may be."""
    starts_ns = problem.stamps_ns[_first(problem.knots)].tolist()
    found = []
    for doubt in problem.doubts:
        if doubt.is_step:
            [knot] = doubt.knots
            before, after = (solution.values.atConstantBias(B(j)).vector() for j in (knot - 1, knot))
            std = np.sqrt(np.diag(solution.covariances[B(knot)]))
            by, of_both = (np.where(doubt.sigma > 0.0, each, 0.0) for each in (after - before, std))
            found.append(BiasStep(starts_ns[knot], by, of_both))
        elif doubt.wanders:
            found += [BiasStep(starts_ns[knot], np.zeros(6), doubt.sigma) for knot in doubt.knots]
    return sorted(found, key=lambda step: step.at_ns)


def _std_at(problem: Problem, solution: Solution, symbol: Callable[[int], int]) -> FloatArray:
    """The standard deviations (K, M) at every stamp of the states of a knot."""
    knots = range(problem.knots[-1] + 1)
    return np.sqrt([np.diag(solution.covariances[symbol(j)]) for j in knots])[problem.knots]


def _note(
    windows: Sequence[ImuWindow | None],
    without_imu: str,
    front_end_told: tuple[float, float] | None,
    stepped: Sequence[str],
    skips_rejected: NDArray[np.bool_],
    pairs_rejected: int,
    loops_used: NDArray[np.bool_],
) -> str:
    measured = sum(window is not None for window in windows)
    imu = f"pairs only: {without_imu}" if not measured else f"IMU on {measured} of {len(windows)} steps"
    skips = len(skips_rejected)
    skipping = f"; {counted(skips, 'pair that skips a frame', 'pairs that skip a frame')}" if skips else ""
    skipping += f", {skips_rejected.sum()} of them rejected" if np.any(skips_rejected) else ""
    rejected = f"; pairs rejected: {pairs_rejected}" if pairs_rejected else ""
    loops = f"; loops used: {loops_used.sum()} of {len(loops_used)}" if len(loops_used) else ""
    scale = f"; the pairs' scale errors have a sigma of {100 * front_end_told[0]:.2g} %" if front_end_told else ""
    return imu + scale + "".join(f"; {step}" for step in stepped) + skipping + rejected + loops
