"""The pose graph back end: pair estimates and preintegrated inertial measurements in one least-squares problem (GTSAM).

Variables are the camera poses in the first camera's frame and, where an IMU measured, velocities, IMU biases and the
direction of gravity in that frame. The first pose is fixed, so that the marginal covariances are those of the poses
relative to it. Without an IMU the graph is a chain: its solution is the raw trajectory, its marginals the propagated
covariances.

Preintegration: Forster et al., "On-Manifold Preintegration for Real-Time Visual-Inertial Odometry", 2017. All linear
systems are solved by QR: Cholesky fails on graphs whose factors differ so much in weight.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, G, V, X
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform
from scipy.stats import chi2

from fusion.chain import ImuWindow, ImuWindows, chain, motions_of, stamps_of
from fusion.config import PoseGraphConfig
from fusion_io.errors import LogError
from fusion_io.records import NANOSECONDS, FloatArray, ImuSeries, IntArray, PairEstimate, Trajectory

GRAVITY = 9.81  # m/s^2; how far the place differs from it goes into the accelerometer's bias
GRAVITY_STEPS = 100  # steps over which accelerations are averaged for a first direction of gravity
FIRST_POSE_SIGMA = 1e-6  # rad, m: small beside any estimate, not so small that the solver suffers
INTEGRATION_SIGMA = 1e-4  # m/s/sqrt(Hz): error of integrating positions piece by piece
BATCHES = 10  # whose means tell how far the errors of pairs are correlated in time
MIN_WINDOWS = 2 * BATCHES
REJECTED_INFLATION = 100.0  # on the standard deviations of a pair that is left out: no more than a hint
MIN_EIGENVALUE = 1e-9  # of a pair's correlation matrix: below, its covariance is singular but for rounding


@dataclass(frozen=True, slots=True)
class PoseGraphResult:
    """The fused trajectory with the marginal covariance of every pose, and what became of the measurements.

    note: one line on how the IMU was used, or why it was not. imu_factors: steps with a preintegrated factor. Where
    the rotations of IMU and pair contradict each other beyond noise, one of them is left out: imu_rejected and
    pairs_rejected count those.
    """

    trajectory: Trajectory
    note: str
    imu_factors: int = 0
    imu_rejected: int = 0
    pairs_rejected: int = 0


@dataclass(frozen=True, slots=True)
class GyroComparison:
    """What the rotations of gyro and pairs say of each other.

    bias (3,) rad/s: the mean difference of their rates. bias_sigma: how far from zero the gyro's bias may be, before
    the pairs are asked. inflation: the factor on the standard deviation of pair rotations after which their sums over
    time are as uncertain as they are. imu_wrong, pair_wrong (N,): steps where one of the two is beyond noise.
    """

    bias: FloatArray
    bias_sigma: float
    inflation: float
    imu_wrong: NDArray[np.bool_]
    pair_wrong: NDArray[np.bool_]


def solve(steps: Sequence[PairEstimate], inertial: ImuSeries | None, config: PoseGraphConfig) -> PoseGraphResult:
    """The most likely trajectory of N steps given an IMU in the camera's axes and time, or None.

    Where the IMU has holes there is no factor, and its bias walks on. Where it cannot be used the pairs alone are
    solved, and the note says why. Raises LogError for a step that is no measurement: a rotation or covariance that
    is not one.
    """
    check(steps)
    if inertial is None:
        return PoseGraphResult(solve_pairs(steps), "pairs only")
    samples = ImuWindows(inertial)
    windows = [samples.over(step.source_stamp_ns, step.target_stamp_ns) for step in steps]
    measured = sum(window is not None for window in windows)
    if measured < MIN_WINDOWS:
        return PoseGraphResult(solve_pairs(steps), f"pairs only: the IMU measured {measured} of {len(steps)} steps")
    gyro = compare_rotations(steps, windows, config)
    used = [None if wrong else window for window, wrong in zip(windows, gyro.imu_wrong, strict=True)]
    weighed = _weigh(steps, gyro)
    try:
        trajectory = solve_inertial(weighed, used, gyro, config)
    except RuntimeError as error:  # IndeterminantLinearSystemException of GTSAM, for one
        reason = " ".join(str(error).split())
        return PoseGraphResult(solve_pairs(steps), f"pairs only: the graph with the IMU has no solution ({reason})")
    imu_rejected, pairs_rejected = int(gyro.imu_wrong.sum()), int(gyro.pair_wrong.sum())
    factors = measured - imu_rejected
    note = f"IMU on {factors} of {len(steps)} steps; rejected: IMU on {imu_rejected}, pair on {pairs_rejected}"
    return PoseGraphResult(trajectory, note, factors, imu_rejected, pairs_rejected)


def check(steps: Sequence[PairEstimate]) -> None:
    """Refuse, with a LogError, what would end the interpreter or never converge inside GTSAM."""
    quats = np.stack([step.quat_wxyz for step in steps])
    translations = np.stack([step.translation for step in steps])
    covariances = np.stack([step.covariance for step in steps])
    _refuse(steps, ~np.isfinite(np.hstack([quats, translations])).all(axis=1), "its pose is not finite")
    _refuse(steps, abs(np.linalg.norm(quats, axis=1) - 1.0) > 1e-3, "its rotation is not a unit quaternion")
    variances = np.diagonal(covariances, axis1=1, axis2=2)
    finite = np.isfinite(covariances).all(axis=(1, 2)) & (variances > 0.0).all(axis=1)
    _refuse(steps, ~finite, "its covariance has variances that are not finite and positive")
    sigmas = np.sqrt(variances)
    correlations = covariances / (sigmas[:, :, None] * sigmas[:, None, :])
    symmetric = np.isclose(correlations, correlations.swapaxes(1, 2)).all(axis=(1, 2))
    definite = np.linalg.eigvalsh(correlations)[:, 0] > MIN_EIGENVALUE
    _refuse(steps, ~(symmetric & definite), "its covariance is not symmetric and positive definite")


def _refuse(steps: Sequence[PairEstimate], bad: NDArray[np.bool_] | np.bool_, reason: str) -> None:
    if bad.any():
        raise LogError(f"pair estimate at {steps[int(bad.argmax())].target_stamp_ns} ns: {reason}")


def solve_pairs(steps: Sequence[PairEstimate]) -> Trajectory:
    """The graph of the pairs alone: the raw chain, with marginal covariances."""
    return _optimise(_pair_graph(steps), _pose_values(chain(steps)), stamps_of(steps))


def compare_rotations(
    steps: Sequence[PairEstimate], windows: Sequence[ImuWindow | None], config: PoseGraphConfig
) -> GyroComparison:
    """Outliers, gyro bias, and correlation in time from the differences between the rates of gyro and pairs.

    Errors of odometry are correlated in time, so that their mean is less certain than independent pairs would make
    it. The scatter of the means of batches shows by how much (Law and Carson, 1979); an error that is constant over
    the log shows nowhere, and is assumed: config.pair_rotation_rate_sigma.

    A gyro that a navigation system has corrected has hardly a bias, and knowing that is worth more than the pairs; a
    bare one has a large bias, which only the pairs can tell. It is taken for the first where the pairs show, ten times
    sharper than the biases of bare gyros, a difference that can be chance.
    """
    measured = np.array([window is not None for window in windows])
    seconds = np.array([step.duration_s for step in steps])[measured, None]
    by_pair = motions_of(steps).rotation.as_rotvec()[measured] / seconds
    turned = np.array([window.durations @ window.angular_velocity for window in windows if window is not None])
    by_gyro = turned / seconds
    claimed = np.array([np.trace(step.covariance[:3, :3]) / 3 for step in steps])[measured] / seconds[:, 0] ** 2

    agree = _without_outliers(by_gyro - by_pair, claimed, config.gate_probability)
    bias, variance = _mean(by_gyro[agree] - by_pair[agree], claimed[agree])
    variance += config.pair_rotation_rate_sigma**2
    inflation = max(1.0, float(np.sqrt(variance * np.sum(1.0 / claimed[agree]))))

    sharp = variance < (config.gyro_bias_sigma / 10) ** 2
    corrected = sharp and bias @ bias < (variance + config.corrected_gyro_bias_sigma**2) * chi2.isf(0.05, 3)
    bias_sigma = config.corrected_gyro_bias_sigma if corrected else config.gyro_bias_sigma

    # Motion is smooth: of two that contradict each other, the one that leaves its neighbours' rate further is wrong.
    time = np.array([step.source_stamp_ns for step in steps])[measured]
    smooth = np.stack([np.interp(time, time[agree], axis) for axis in by_gyro[agree].T], axis=1)
    pair_leaves_further = _norm(by_pair + bias - smooth) > _norm(by_gyro - smooth)
    imu_wrong, pair_wrong = np.zeros((2, len(steps)), dtype=np.bool_)
    imu_wrong[measured] = ~agree & ~pair_leaves_further
    pair_wrong[measured] = ~agree & pair_leaves_further
    return GyroComparison(bias, bias_sigma, inflation, imu_wrong, pair_wrong)


def _without_outliers(differences: FloatArray, variances: FloatArray, probability: float) -> NDArray[np.bool_]:
    """Which (N, 3) lie within a chi-square gate about their median, widened where variances (N,) prove too small."""
    square = np.sum((differences - np.median(differences, axis=0)) ** 2, axis=1) / variances
    scale = max(1.0, float(np.median(square) / chi2.median(3)))
    return np.asarray(square <= scale * chi2.isf(probability, 3))


def _mean(values: FloatArray, variances: FloatArray) -> tuple[FloatArray, float]:
    """The weighted mean (3,) of a series (N, 3), and the variance of its components by the method of batch means."""
    weights = 1.0 / variances
    batches = zip(np.array_split(values, BATCHES), np.array_split(weights, BATCHES), strict=True)
    means = [np.average(batch, axis=0, weights=weight) for batch, weight in batches]
    return np.average(values, axis=0, weights=weights), float(np.mean(np.var(means, axis=0, ddof=1))) / BATCHES


def _norm(vectors: FloatArray) -> FloatArray:
    return np.asarray(np.linalg.norm(vectors, axis=1))


def _weigh(steps: Sequence[PairEstimate], gyro: GyroComparison) -> list[PairEstimate]:
    """The steps with the covariances that the gyro shows to be right."""
    scale = np.repeat([gyro.inflation, 1.0], 3)
    inflated = np.outer(scale, scale)
    return [
        replace(step, covariance=step.covariance * inflated * (REJECTED_INFLATION**2 if wrong else 1.0))
        for step, wrong in zip(steps, gyro.pair_wrong, strict=True)
    ]


def solve_inertial(
    steps: Sequence[PairEstimate], windows: Sequence[ImuWindow | None], gyro: GyroComparison, config: PoseGraphConfig
) -> Trajectory:
    """The graph of pairs and IMU, whose windows (one a step, some None) start from the bias that the gyro shows."""
    raw = chain(steps)
    graph, values = _pair_graph(steps), _pose_values(raw)
    bias = gtsam.imuBias.ConstantBias(np.zeros(3), gyro.bias)
    parameters = _preintegration_parameters(config)
    used = [(k, window) for k, window in enumerate(windows) if window is not None]
    for k, window in used:
        preintegrated = gtsam.PreintegratedCombinedMeasurements(parameters, bias)
        for duration, rate, acceleration in zip(*window, strict=True):
            preintegrated.integrateMeasurement(acceleration, rate, duration)
        graph.add(
            gtsam.CombinedImuFactorWithGravityDirection(
                X(k), V(k), X(k + 1), V(k + 1), B(k), B(k + 1), G(0), preintegrated, GRAVITY
            )
        )

    velocities = np.gradient(raw.poses.translation, raw.stamps_ns / NANOSECONDS, axis=0)
    states = sorted({state for k, _ in used for state in (k, k + 1)})
    for k in states:
        values.insert(V(k), velocities[k])
        values.insert(B(k), bias)
    values.insert(G(0), gtsam.Unit3(_gravity(used[:GRAVITY_STEPS], raw, velocities)))

    sigmas = np.repeat([config.accelerometer_bias_sigma, gyro.bias_sigma], 3)
    prior = gtsam.noiseModel.Diagonal.Sigmas(sigmas)
    graph.add(gtsam.PriorFactorConstantBias(B(states[0]), gtsam.imuBias.ConstantBias(), prior))
    walk = np.repeat([config.accelerometer_bias_walk, config.gyro_bias_walk], 3)
    for before, after in pairwise(states):
        if windows[before] is None:
            seconds = (raw.stamps_ns[after] - raw.stamps_ns[before]) / NANOSECONDS
            noise = gtsam.noiseModel.Diagonal.Sigmas(walk * np.sqrt(seconds))
            graph.add(gtsam.BetweenFactorConstantBias(B(before), B(after), gtsam.imuBias.ConstantBias(), noise))
    return _optimise(graph, values, raw.stamps_ns)


def _preintegration_parameters(config: PoseGraphConfig) -> gtsam.PreintegrationCombinedParams:
    parameters = gtsam.PreintegrationCombinedParams(np.zeros(3))  # gravity is a variable of the graph
    parameters.setGyroscopeCovariance(config.gyro_noise**2 * np.eye(3))
    parameters.setAccelerometerCovariance(config.accelerometer_noise**2 * np.eye(3))
    parameters.setBiasOmegaCovariance(config.gyro_bias_walk**2 * np.eye(3))
    parameters.setBiasAccCovariance(config.accelerometer_bias_walk**2 * np.eye(3))
    parameters.setIntegrationCovariance(INTEGRATION_SIGMA**2 * np.eye(3))
    return parameters


def _gravity(windows: Sequence[tuple[int, ImuWindow]], raw: Trajectory, velocities: FloatArray) -> FloatArray:
    """Where gravity points in the first camera's frame, from some windows (with their step) and the raw trajectory.

    An accelerometer shows acceleration less gravity, so that gravity is what the change of velocity is short of.
    """
    rotations = raw.poses.rotation.as_matrix()
    shown = sum(rotations[k] @ (window.durations @ window.linear_acceleration) for k, window in windows)
    gained = sum(velocities[k + 1] - velocities[k] for k, _ in windows)
    return np.asarray(gained - shown)


def _pair_graph(steps: Sequence[PairEstimate]) -> gtsam.NonlinearFactorGraph:
    """The first pose fixed, and a factor for every step."""
    graph = gtsam.NonlinearFactorGraph()
    fixed = gtsam.noiseModel.Isotropic.Sigma(6, FIRST_POSE_SIGMA)
    graph.add(gtsam.PriorFactorPose3(X(0), gtsam.Pose3(), fixed))
    for k, (step, motion) in enumerate(zip(steps, motions_of(steps).as_matrix(), strict=True)):
        noise = gtsam.noiseModel.Gaussian.Covariance(step.covariance)
        graph.add(gtsam.BetweenFactorPose3(X(k), X(k + 1), gtsam.Pose3(motion), noise))
    return graph


def _pose_values(trajectory: Trajectory) -> gtsam.Values:
    values = gtsam.Values()
    for k, pose in enumerate(trajectory.poses.as_matrix()):
        values.insert(X(k), gtsam.Pose3(pose))
    return values


def _optimise(graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, stamps_ns: IntArray) -> Trajectory:
    """Solve the graph from the given values; the marginals come from iSAM2, GTSAM's only ones by QR in Python."""
    solver = gtsam.LevenbergMarquardtParams()
    solver.setLinearSolverType("MULTIFRONTAL_QR")
    solution = gtsam.LevenbergMarquardtOptimizer(graph, values, solver).optimize()

    elimination = gtsam.ISAM2Params()
    elimination.setFactorization("QR")
    tree = gtsam.ISAM2(elimination)
    tree.update(graph, solution)
    poses = np.stack([solution.atPose3(X(k)).matrix() for k in range(len(stamps_ns))])
    if not np.all(np.isfinite(poses)):
        raise RuntimeError("the solution is not finite")
    covariances = np.stack([tree.marginalCovariance(X(k)) for k in range(len(stamps_ns))])
    covariances[0] = 0.0  # the world itself
    return Trajectory(stamps_ns, RigidTransform.from_matrix(poses), covariances)
