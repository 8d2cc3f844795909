"""The filter's mathematics is right to first order, its covariance is honest, and bad input does not lead it astray."""

from dataclasses import dataclass, replace
from functools import cache
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import RigidTransform, Rotation
from scipy.stats import chi2

from fusion import ekf
from fusion.chain import ImuWindow, chain
from fusion.config import EkfConfig
from fusion.ekf import DIMENSION, Filter, Measurement, State, inject, propagate, reset_jacobian, right_jacobian
from fusion.evaluation import evaluate, pose_errors
from fusion.imu import calibrate, in_camera_axes
from fusion_io.kitti import read_imu_mat
from fusion_io.records import NANOSECONDS, FloatArray, ImuSeries, PairEstimate, Trajectory
from fusion_io.simulation.motion import DriveStyle, ImuModel, drive, imu_stamps, simulate_imu
from fusion_io.trajectory_files import pair_estimates, read_kitti, read_times

CONFIG = EkfConfig()
# Pairs whose errors are white, and an IMU that sits in the camera: what the simulations here have.
WHITE = EkfConfig(accelerometer_noise=0.02, gyro_noise=1e-3, pair_rate_bias_sigma=1e-9, pair_scale_sigma=1e-9)
SIGMA = np.array([1e-3, 1e-3, 1e-3, 0.02, 0.02, 0.02])
IMU_HZ = 100.0
STEP = 1e-6  # of finite differences


@dataclass(frozen=True)
class Log:
    """Pairs, an IMU in camera axes, and the truth."""

    truth: Trajectory
    pairs: list[PairEstimate]
    imu: ImuSeries


def _log(seed: int, frames: int, sigma: FloatArray = SIGMA, config: EkfConfig = WHITE) -> Log:
    """A car's drive, with the noise that the configuration says, drawn anew for every seed."""
    rng = np.random.default_rng(seed)
    motion = drive(seed, -0.5, frames / 10 + 0.5, DriveStyle())
    stamps = np.arange(frames) * (NANOSECONDS // 10)
    truth = Trajectory(stamps, motion.poses(stamps / NANOSECONDS)).relative_to_first()
    model = ImuModel(
        Rotation.identity(),
        gyro_bias=config.gyro_bias_sigma * rng.standard_normal(3),
        accelerometer_bias=config.accelerometer_bias_sigma * rng.standard_normal(3),
        gyro_noise=config.gyro_noise,
        accelerometer_noise=config.accelerometer_noise,
    )
    imu = simulate_imu(motion, imu_stamps(-0.1, frames / 10 + 0.1, IMU_HZ), IMU_HZ, model, seed)
    errors = RigidTransform.from_exp_coords(rng.standard_normal((frames - 1, 6)) * sigma)
    motions = truth.poses[:-1].inv() * truth.poses[1:] * errors
    return Log(truth, _pairs(stamps.tolist(), motions, sigma), imu)


def _pairs(stamps: list[int], motions: RigidTransform, sigma: FloatArray) -> list[PairEstimate]:
    quats_wxyz, translations = motions.rotation.as_quat(scalar_first=True), motions.translation
    return [
        PairEstimate(start, end, quats_wxyz[k], translations[k], np.diag(sigma**2))
        for k, (start, end) in enumerate(pairwise(stamps))
    ]


@cache
def _drive() -> Log:
    return _log(0, 120)


def _wild(pair: PairEstimate) -> PairEstimate:
    rotation = pair.T_source_target.rotation * Rotation.from_rotvec([0.0, 0.3, 0.0])
    return replace(pair, quat_wxyz=rotation.as_quat(scalar_first=True), translation=pair.translation + [3.0, 0.0, 0.0])


def _final_distance_m(one: Trajectory, other: Trajectory) -> float:
    return float(np.linalg.norm(one.poses.translation[-1] - other.poses.translation[-1]))


# -------------------------------------------------------------------------------------------- Jacobians


def _random_state(rng: np.random.Generator) -> State:
    rotations = Rotation.from_rotvec(rng.normal(size=(3, 3))).as_matrix()
    small = 0.1 * rng.normal(size=(3, 3))
    R, Q, R_clone = rotations
    return State(R, rng.normal(size=3), rng.normal(size=3), *small[:2], Q, small[2], R_clone, rng.normal(size=3))


def _random_window(rng: np.random.Generator, pieces: int) -> ImuWindow:
    return ImuWindow(rng.uniform(0.005, 0.2, pieces), *rng.normal(size=(2, pieces, 3)) * [[[2.0]], [[10.0]]])


def _error(state: State, other: State) -> FloatArray:
    """The error (26,) that takes one nominal state to another: the inverse of `inject`, written out by itself."""
    return np.concatenate(
        [
            Rotation.from_matrix(state.R.T @ other.R).as_rotvec(),
            other.p - state.p,
            other.v - state.v,
            other.gyro_bias - state.gyro_bias,
            other.accelerometer_bias - state.accelerometer_bias,
            Rotation.from_matrix(state.Q.T @ other.Q).as_rotvec()[:2],
            other.pair_rate_bias - state.pair_rate_bias,
            Rotation.from_matrix(state.R_clone.T @ other.R_clone).as_rotvec(),
            other.p_clone - state.p_clone,
        ]
    )


@pytest.mark.parametrize("pieces", [1, 4])
def test_the_jacobian_of_the_prediction_equals_finite_differences(pieces: int) -> None:
    """Over one piece, and over several whose Jacobians multiply."""
    rng = np.random.default_rng(pieces)
    state, window = _random_state(rng), _random_window(rng, pieces)
    moved, jacobians = propagate(state, window)
    product = np.linalg.multi_dot([np.eye(DIMENSION), *jacobians[::-1], np.eye(DIMENSION)])
    for k, direction in enumerate(np.eye(DIMENSION)):
        ends = [propagate(inject(state, sign * STEP * direction), window)[0] for sign in (1, -1)]
        numeric = (_error(moved, ends[0]) - _error(moved, ends[1])) / (2 * STEP)
        assert_allclose(product[:, k], numeric, atol=2e-7)


def test_the_jacobian_of_the_measurement_equals_finite_differences() -> None:
    rng = np.random.default_rng(0)
    state, seconds = _random_state(rng), 0.4
    shown = state.shown(seconds)
    H = ekf.shown_jacobian(state, seconds)
    for k, direction in enumerate(np.eye(DIMENSION)):
        ends = [inject(state, sign * STEP * direction).shown(seconds) for sign in (1, -1)]
        numeric = (ekf.difference(ends[0], shown) - ekf.difference(ends[1], shown)) / (2 * STEP)
        assert_allclose(H[:, k], numeric, atol=2e-8)


def test_the_jacobian_of_the_reset_equals_finite_differences() -> None:
    """What is left of an error near `error`, about the state into which `error` was moved."""
    rng = np.random.default_rng(0)
    state, error = _random_state(rng), 0.2 * rng.normal(size=DIMENSION)
    reset = inject(state, error)
    G = reset_jacobian(error)
    for k, direction in enumerate(np.eye(DIMENSION)):
        ends = [inject(state, error + sign * STEP * direction) for sign in (1, -1)]
        numeric = (_error(reset, ends[0]) - _error(reset, ends[1])) / (2 * STEP)
        assert_allclose(G[:, k], numeric, atol=2e-8)


@given(st.tuples(*3 * [st.floats(-1.8, 1.8)]), st.sampled_from([1.0, 1e-3, 1e-6, 0.0]))
def test_the_right_jacobian_moves_an_increment_through_the_exponential(
    direction: tuple[float, float, float], size: float
) -> None:
    """Exp(v + d) = Exp(v) Exp(J(v) d), with its series near zero as well."""
    vector, increment = size * np.array(direction), 1e-6 * np.array([1.0, -2.0, 0.5])
    left = Rotation.from_rotvec(vector).inv() * Rotation.from_rotvec(vector + increment)
    assert_allclose(left.as_rotvec(), right_jacobian(vector) @ increment, atol=1e-11)


# -------------------------------------------------------------------------------------------- prediction


def test_the_prediction_is_dead_reckoning() -> None:
    """A camera that circles at a constant speed, known in closed form, over one turn in 10 s."""
    radius, rate, count = 20.0, 2 * np.pi / 10, 1000
    ones = np.ones(count)
    gravity = np.array([0.0, ekf.GRAVITY, 0.0])  # down is y
    force = np.array([rate**2 * radius, 0.0, 0.0]) - gravity  # to the right, where the centre is
    window = ImuWindow(0.01 * ones, np.outer(ones, [0.0, rate, 0.0]), np.outer(ones, force))
    down = Rotation.align_vectors(gravity[None], [[0.0, 0.0, 1.0]])[0].as_matrix()
    start = replace(Filter(CONFIG).state, v=np.array([0.0, 0.0, rate * radius]), Q=down)
    for pieces in (250, 500, 1000):
        angle = rate * pieces / 100
        end, _ = propagate(start, ImuWindow(*(values[:pieces] for values in window)))
        assert_allclose(end.R, Rotation.from_rotvec([0.0, angle, 0.0]).as_matrix(), atol=1e-12)
        assert_allclose(end.p, radius * np.array([1 - np.cos(angle), 0.0, np.sin(angle)]), atol=1e-3)


def test_exact_measurements_give_the_exact_trajectory() -> None:
    exact = WHITE.model_copy(update={"accelerometer_bias_sigma": 1e-9, "gyro_bias_sigma": 1e-9})
    log = _log(1, 80, np.full(6, 1e-9), exact.model_copy(update={"gyro_noise": 1e-9, "accelerometer_noise": 1e-9}))
    pairs = [replace(pair, covariance=np.diag(SIGMA**2)) for pair in log.pairs]
    result = ekf.solve(pairs, log.imu, exact)
    assert result.rejected == 0
    assert_allclose(result.trajectory.poses.translation, log.truth.poses.translation, atol=0.02)
    turned = (result.trajectory.poses.rotation.inv() * log.truth.poses.rotation).magnitude()
    assert np.max(turned) < 1e-4
    assert_allclose(result.trajectory.covariances[0], 0.0)


def test_the_imu_makes_the_trajectory_better() -> None:
    log = _drive()
    fused = evaluate(ekf.solve(log.pairs, log.imu, WHITE).trajectory, log.truth)
    raw = evaluate(chain(log.pairs), log.truth)
    assert fused.rpe_rotation_rad < 0.5 * raw.rpe_rotation_rad
    assert fused.ate_m < 0.7 * raw.ate_m


def test_biases_and_gravity_are_found_while_standing() -> None:
    """A quarter of a minute, camera tilted: the gyro's bias to 1 mrad/s, down to 1 deg, position as it claims."""
    rng, frames = np.random.default_rng(4), 150
    bias, up = np.array([0.01, -0.02, 0.015]), Rotation.from_rotvec([0.2, 0.0, -0.1]).apply([0.0, -ekf.GRAVITY, 0.0])
    stamps = imu_stamps(-0.1, frames / 10, IMU_HZ)
    rates = bias + 0.01 * rng.standard_normal((len(stamps), 3))
    imu = ImuSeries(stamps, rates, up + 0.1 * rng.standard_normal((len(stamps), 3)))
    errors = RigidTransform.from_exp_coords(rng.standard_normal((frames, 6)) * SIGMA)
    pairs = _pairs([k * NANOSECONDS // 10 for k in range(frames + 1)], errors, SIGMA)
    result = ekf.solve(pairs[:-1], imu, WHITE, gyro_bias_std=0.02)
    sigma = np.sqrt(np.diagonal(result.trajectory.covariances[-1]))
    assert_allclose(result.gyro_bias, bias, atol=1e-3)
    assert_allclose(result.gravity / ekf.GRAVITY, -up / ekf.GRAVITY, atol=0.02)
    assert np.all(np.abs(result.trajectory.poses.translation[-1]) < 4 * sigma[3:])


@settings(max_examples=3, deadline=None)
@given(st.tuples(*3 * [st.floats(-1.5, 1.5)]))
def test_it_does_not_matter_how_the_axes_of_the_camera_lie(turn: tuple[float, float, float]) -> None:
    """Equivariance: in axes turned by C, every pose T becomes C^-1 T C, for noise that prefers no direction."""
    C, log = Rotation.from_rotvec(turn), _drive()
    basis = RigidTransform.from_rotation(C)
    motions = RigidTransform.concatenate([pair.T_source_target for pair in log.pairs[:30]])
    stamps = [pair.source_stamp_ns for pair in log.pairs[:31]]
    turned = _pairs(stamps, basis.inv() * motions * basis, SIGMA)
    imu = replace(
        log.imu,
        angular_velocity=C.inv().apply(log.imu.angular_velocity),
        linear_acceleration=C.inv().apply(log.imu.linear_acceleration),
    )
    expected = basis.inv() * ekf.solve(log.pairs[:30], log.imu, WHITE).trajectory.poses * basis
    assert_allclose(ekf.solve(turned, imu, WHITE).trajectory.poses.as_matrix(), expected.as_matrix(), atol=1e-6)


# -------------------------------------------------------------------------------------------- consistency


def test_the_covariance_is_honest() -> None:
    """Monte Carlo, 12 drives of 6 s: position, orientation and innovations within their 99.8 % chi-square bounds."""
    runs = 12
    position, orientation, innovation, steps = 0.0, 0.0, 0.0, 0
    for seed in range(100, 100 + runs):
        log = _log(seed, 60)
        result = ekf.solve(log.pairs, log.imu, WHITE)
        at, turned = pose_errors(result.trajectory.poses, log.truth.poses)
        covariance = result.trajectory.covariances[-1]
        orientation += _squared(turned[-1], covariance[:3, :3])
        position += _squared(at[-1], covariance[3:, 3:])
        innovation += float(np.sum(result.nis[10:]))
        steps += len(result.nis) - 10
    for squared, freedoms in ((position, 3 * runs), (orientation, 3 * runs), (innovation, 6 * steps)):
        assert chi2.ppf(0.001, freedoms) < squared < chi2.ppf(0.999, freedoms)


def _squared(error: FloatArray, covariance: FloatArray) -> float:
    return float(error @ np.linalg.solve(covariance, error))


def test_correlated_errors_of_the_pairs_are_in_the_covariance() -> None:
    """A scale that is 2 % off all along: without a model of it the position claims what is not so."""
    log = _drive()
    pairs = [replace(pair, translation=1.02 * pair.translation) for pair in log.pairs]
    squared = []
    for scale_sigma in (1e-9, 0.02):
        result = ekf.solve(pairs, log.imu, WHITE.model_copy(update={"pair_scale_sigma": scale_sigma}))
        at, _ = pose_errors(result.trajectory.poses, log.truth.poses)
        squared.append(_squared(at[-1], result.trajectory.covariances[-1][3:, 3:]))
    assert squared[0] > chi2.isf(1e-6, 3)
    assert squared[1] < chi2.isf(1e-2, 3)


def test_the_rate_bias_of_the_pairs_is_told_from_the_gyro() -> None:
    """Pairs that turn 5 mrad/s too much: the trajectory turns by a fifth of that at most, and expects it."""
    log = _drive()
    excess = Rotation.from_rotvec([0.0, 5e-4, 0.0])
    pairs = [
        replace(pair, quat_wxyz=(pair.T_source_target.rotation * excess).as_quat(scalar_first=True))
        for pair in log.pairs
    ]
    result = ekf.solve(pairs, log.imu, WHITE.model_copy(update={"pair_rate_bias_sigma": 5e-3}))
    error = (result.trajectory.poses.rotation[-1].inv() * log.truth.poses.rotation[-1]).as_rotvec()
    assert np.linalg.norm(error) < 0.2 * 5e-3 * 12
    assert _squared(error, result.trajectory.covariances[-1][:3, :3]) < chi2.isf(1e-3, 3)


@pytest.mark.parametrize("with_imu", [True, False])
def test_covariances_are_covariances(with_imu: bool) -> None:
    """Symmetric, positive definite after the first pose, which is the world and has none."""
    log = _drive()
    covariances = ekf.solve(log.pairs, log.imu if with_imu else None, CONFIG).trajectory.covariances
    assert_array_equal(covariances[0], np.zeros((6, 6)))
    assert_allclose(covariances, covariances.swapaxes(1, 2), atol=1e-12)
    assert np.all(np.linalg.eigvalsh(covariances[1:]) > 0.0)


# -------------------------------------------------------------------------------------------- faults


@pytest.mark.parametrize("with_imu", [True, False])
def test_a_wild_pair_is_rejected_and_counted(with_imu: bool) -> None:
    """3 m and 17 deg off: the trajectory keeps within half a metre of what it is without the fault."""
    log = _drive()
    imu = log.imu if with_imu else None
    wild = [_wild(pair) if k == 60 else pair for k, pair in enumerate(log.pairs)]
    before, after = ekf.solve(log.pairs, imu, CONFIG), ekf.solve(wild, imu, CONFIG)
    assert before.rejected == 0
    assert after.rejected == 1
    assert after.nis[60] > chi2.isf(CONFIG.gate_probability, 6)
    assert _final_distance_m(before.trajectory, after.trajectory) < 0.5


def test_when_the_imu_goes_mad_the_pairs_are_believed() -> None:
    """Rates of 0.5 rad/s that are not there: a few pairs are rejected, then the trajectory keeps to the pairs'."""
    log = _drive()
    mad = log.imu.stamps_ns > 6 * NANOSECONDS
    imu = replace(log.imu, angular_velocity=log.imu.angular_velocity + np.outer(mad, [0.0, 0.5, 0.0]))
    result = ekf.solve(log.pairs, imu, CONFIG)
    assert CONFIG.max_rejected_in_a_row <= result.rejected <= 2 * CONFIG.max_rejected_in_a_row
    motions = [trajectory.poses[-40].inv() * trajectory.poses[-1] for trajectory in (result.trajectory, log.truth)]
    difference = motions[0].inv() * motions[1]
    assert np.linalg.norm(difference.translation) < 0.5
    assert difference.rotation.magnitude() < 0.03


def test_without_an_imu_it_says_so_and_keeps_to_the_pairs() -> None:
    log = _drive()
    result = ekf.solve(log.pairs, None, CONFIG)
    assert result.note == "predicted by constant velocity: no IMU"
    assert result.rejected == 0
    raw = evaluate(chain(log.pairs), log.truth)
    fused = evaluate(result.trajectory, log.truth)
    assert fused.ate_m < 1.05 * raw.ate_m
    assert fused.rpe_rotation_rad < 1.05 * raw.rpe_rotation_rad


def test_a_hole_in_the_imu_is_crossed_by_the_pairs() -> None:
    """Two seconds without samples: the note counts the steps, the error stays, the covariance grows faster inside."""
    log = _drive()
    seconds = log.imu.stamps_ns / NANOSECONDS
    keep = (seconds < 5.02) | (seconds > 7.02)
    imu = ImuSeries(log.imu.stamps_ns[keep], log.imu.angular_velocity[keep], log.imu.linear_acceleration[keep])
    whole, result = ekf.solve(log.pairs, log.imu, WHITE), ekf.solve(log.pairs, imu, WHITE)
    assert result.note.startswith("predicted by the IMU on 98 of 119 steps")
    assert result.rejected == 0
    assert _final_distance_m(result.trajectory, log.truth) < 0.5
    growth = [np.diff(np.trace(each.trajectory.covariances[:, :3, :3], axis1=1, axis2=2)) for each in (result, whole)]
    assert np.sum(growth[0][52:68]) > 2.0 * np.sum(growth[1][52:68])


def test_a_hole_in_the_pairs_is_crossed_by_the_imu() -> None:
    """One second without frames is one long step whose pair says next to nothing: dead reckoning to half a metre."""
    log = _drive()
    unknown = replace(log.pairs[50], target_stamp_ns=log.pairs[60].source_stamp_ns, covariance=np.diag([1.0] * 6))
    pairs = [*log.pairs[:50], unknown, *log.pairs[60:]]
    result = ekf.solve(pairs, log.imu, WHITE)
    assert result.rejected == 0
    assert _final_distance_m(result.trajectory, log.truth) < 1.0


def test_a_bias_that_was_removed_is_known_as_well_as_it_is_said_to_be() -> None:
    """The doubt about it shows in the orientation."""
    log = _drive()
    sure, doubtful = (ekf.solve(log.pairs[:20], log.imu, WHITE, std).trajectory.covariances for std in (0.0, 0.05))
    assert np.trace(doubtful[10, :3, :3]) > 2.0 * np.trace(sure[10, :3, :3])


def test_the_update_is_that_of_the_textbook() -> None:
    """Without prediction: the posterior of two Gaussians in information form, its mean moved into the state."""
    rng = np.random.default_rng(7)
    filter_ = Filter(CONFIG)
    filter_.kf.P = np.diag(rng.uniform(0.5, 1.0, DIMENSION)) * 1e-8
    H = ekf.shown_jacobian(filter_.state, 0.1)
    covariance = 1e-8 * np.diag(rng.uniform(0.5, 1.0, 6))
    motion = RigidTransform.from_exp_coords(1e-4 * rng.normal(size=6)).as_matrix()
    expected = np.linalg.inv(np.linalg.inv(filter_.kf.P) + H.T @ np.linalg.solve(covariance, H))
    moved = expected @ H.T @ np.linalg.solve(covariance, ekf.difference(motion, np.eye(4)))
    before = filter_.state
    filter_.update(Measurement(motion, covariance, 0.1))
    assert_allclose(filter_.kf.P, expected, rtol=1e-3, atol=1e-12)
    assert_allclose(_error(before, filter_.state), moved, rtol=1e-9, atol=1e-12)


def test_the_same_input_gives_the_same_bits() -> None:
    log = _drive()
    one, other = (ekf.solve(log.pairs[:40], log.imu, CONFIG) for _ in range(2))
    assert_array_equal(one.trajectory.poses.as_matrix(), other.trajectory.poses.as_matrix())
    assert_array_equal(one.trajectory.covariances, other.trajectory.covariances)


def test_real_drive_of_a_published_odometry_with_its_real_imu(shared_data: Path) -> None:
    """KITTI 09, its first minute: rotations twice as good as raw, and translations that are as good as exact rotations
    make them (within 5 %): what is left is the odometry's scale.
    """
    odometry, frames = shared_data / "kitti" / "odometry", 600
    stamps = read_times(odometry / "sequences" / "09" / "times.txt")
    imu = read_imu_mat(odometry / "imu" / "09.mat", stamps)
    truth = read_kitti(odometry / "poses" / "09.txt", stamps)
    pairs = pair_estimates(read_kitti(odometry / "published" / "example_1" / "09.txt", stamps), 0.04, 5e-4)[:frames]
    inertial = in_camera_axes(imu, calibrate(pairs, imu, None, None))
    turned = truth.poses.rotation[:frames].inv() * truth.poses.rotation[1 : frames + 1]
    turned_right = [
        replace(pair, quat_wxyz=rotation.as_quat(scalar_first=True))
        for pair, rotation in zip(pairs, turned, strict=True)
    ]
    fused = evaluate(ekf.solve(pairs, inertial, CONFIG).trajectory, truth)
    assert fused.r_rel_deg_per_100m < 0.5 * evaluate(chain(pairs), truth).r_rel_deg_per_100m
    assert fused.t_rel_percent < 1.05 * evaluate(chain(turned_right), truth).t_rel_percent
