"""The pose graph, online: causal, constant in effort, and in the end where the batch is."""

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import RigidTransform, Rotation
from scipy.stats import chi2

from fusion import online, posegraph
from fusion.chain import chain
from fusion.config import PoseGraphConfig
from fusion.imu import ImuCalibration
from fusion.measurements import Estimate, Measurements
from fusion_io.records import NANOSECONDS, FloatArray, ImuSeries, PairEstimate, Trajectory
from fusion_io.simulation.motion import DriveStyle, ImuModel, drive, imu_stamps, simulate_imu

SIGMA = np.array([1e-3, 1e-3, 1e-3, 0.02, 0.02, 0.02])
LOOP_SIGMA = np.array([2e-3, 2e-3, 2e-3, 0.05, 0.05, 0.05])
# Pairs whose errors are white, and an IMU that sits in the camera: what the simulations here have.
CONFIG = PoseGraphConfig(
    pair_scale_sigma=1e-6,
    pair_rate_bias_sigma=1e-6,
    pair_misalignment_sigma=1e-6,
    lever_arm_sigma=1e-6,
    given_mounting_sigma=1e-4,
    given_time_offset_sigma=1e-5,
)


@dataclass(frozen=True)
class Log:
    """Measurements, and the truth."""

    known: Measurements
    truth: Trajectory

    def loop(self, source: int, target: int, error: FloatArray) -> PairEstimate:
        """What a loop between two frames shows."""
        motion = self.truth.poses[source].inv() * self.truth.poses[target] * RigidTransform.from_exp_coords(error)
        return _pair(self.truth, source, target, motion, LOOP_SIGMA)


def _pair(truth: Trajectory, source: int, target: int, motion: RigidTransform, sigma: FloatArray) -> PairEstimate:
    stamps, quat_wxyz = truth.stamps_ns, motion.rotation.as_quat(scalar_first=True)
    return PairEstimate(int(stamps[source]), int(stamps[target]), quat_wxyz, motion.translation, np.diag(sigma**2))


def _log(seed: int, frames: int) -> Log:
    """A car's drive, with the noise that the configuration says, drawn anew for every seed."""
    rng = np.random.default_rng(seed)
    motion = drive(seed, -0.5, frames / 10 + 0.5, DriveStyle())
    stamps = np.arange(frames) * (NANOSECONDS // 10)
    truth = Trajectory(stamps, motion.poses(stamps / NANOSECONDS)).relative_to_first()
    model = ImuModel(
        Rotation.identity(),
        gyro_bias=CONFIG.gyro_bias_sigma * rng.standard_normal(3),
        accelerometer_bias=CONFIG.accelerometer_bias_sigma * rng.standard_normal(3),
        gyro_noise=CONFIG.gyro_noise,
        accelerometer_noise=CONFIG.accelerometer_noise,
    )
    imu = simulate_imu(motion, imu_stamps(-0.1, frames / 10 + 0.1, 100.0), 100.0, model, seed)
    errors = RigidTransform.from_exp_coords(rng.standard_normal((frames - 1, 6)) * SIGMA)
    motions = truth.poses[:-1].inv() * truth.poses[1:] * errors
    steps = [_pair(truth, k, k + 1, motion, SIGMA) for k, motion in enumerate(motions)]
    calibration = ImuCalibration(Rotation.identity(), 0.0, np.zeros(3), True, "given")
    return Log(Measurements(steps, imu, calibration), truth)


@cache
def _drive() -> Log:
    return _log(0, 80)


def _without(imu: ImuSeries, start_s: float, end_s: float) -> ImuSeries:
    seconds = imu.stamps_ns / NANOSECONDS
    keep = (seconds < start_s) | (seconds > end_s)
    return ImuSeries(imu.stamps_ns[keep], imu.angular_velocity[keep], imu.linear_acceleration[keep])


def _beyond(estimate: Estimate, truth: Trajectory) -> FloatArray:
    """The errors (K, 6) of the poses, on their right."""
    return np.asarray((estimate.trajectory.poses.inv() * truth.poses).as_exp_coords())


def _nees(estimate: Estimate, truth: Trajectory) -> float:
    """Of the last pose, 6 degrees of freedom."""
    assert estimate.trajectory.covariances is not None
    error = _beyond(estimate, truth)[-1]
    return float(error @ np.linalg.solve(estimate.trajectory.covariances[-1], error))


def test_a_pose_depends_on_nothing_that_was_measured_after_it() -> None:
    """Cutting the log after a frame leaves all poses and covariances until then as they are, bit for bit."""
    log, cut = _drive(), 45
    loops = [log.loop(3, 30, np.zeros(6)), log.loop(5, 60, np.zeros(6))]
    assert log.known.imu is not None
    now_ns = log.known.steps[cut - 1].target_stamp_ns
    imu = _without(log.known.imu, now_ns / NANOSECONDS + 0.011, np.inf)
    whole = online.solve(replace(log.known, loops=loops), CONFIG).trajectory
    part = online.solve(replace(log.known, steps=log.known.steps[:cut], imu=imu, loops=loops[:1]), CONFIG).trajectory
    assert whole.covariances is not None
    assert_array_equal(part.poses.as_matrix(), whole.poses.as_matrix()[: cut + 1])
    assert_array_equal(part.covariances, whole.covariances[: cut + 1])


def test_the_last_pose_is_where_the_batch_puts_it() -> None:
    """Within half a standard deviation of the batch, and as uncertain to a fifth."""
    log = _drive()
    batch, last = posegraph.solve(log.known, CONFIG).trajectory, online.solve(log.known, CONFIG).trajectory
    assert batch.covariances is not None
    assert last.covariances is not None
    sigma, claimed = (np.sqrt(np.diag(each[-1])) for each in (batch.covariances, last.covariances))
    difference = (batch.poses[-1].inv() * last.poses[-1]).as_exp_coords()
    assert np.all(abs(difference) < 0.5 * sigma), difference / sigma
    assert_allclose(claimed, sigma, rtol=0.2)


def test_normalised_errors_are_those_of_a_consistent_estimator() -> None:
    """Monte Carlo, with loops: the mean NEES of the last pose inside its 99.8 % bounds."""
    runs, nees = 10, []
    for seed in range(runs):
        log, rng = _log(seed, 60), np.random.default_rng(1000 + seed)
        loops = [log.loop(k - 40, k, rng.standard_normal(6) * LOOP_SIGMA) for k in (50, 57)]
        nees.append(_nees(online.solve(replace(log.known, loops=loops), CONFIG), log.truth))
    lower, upper = chi2.ppf([0.001, 0.999], 6 * runs) / runs
    assert lower < np.mean(nees) < upper, nees


def test_without_imu_and_loops_the_result_is_the_raw_chain_with_its_covariances() -> None:
    log = _drive()
    result, raw = online.solve(Measurements(log.known.steps), CONFIG), chain(log.known.steps)
    assert result.note == "pairs only"
    assert raw.covariances is not None
    assert result.trajectory.covariances is not None
    assert_allclose(result.trajectory.poses.as_matrix(), raw.poses.as_matrix(), atol=1e-6)
    assert_allclose(result.trajectory.covariances, raw.covariances, rtol=1e-3, atol=1e-9)


def test_over_a_hole_in_the_imu_the_pairs_carry_on() -> None:
    log = _drive()
    assert log.known.imu is not None
    holed = online.solve(replace(log.known, imu=_without(log.known.imu, 3.0, 5.0)), CONFIG)
    assert holed.note == "IMU on 57 of 79 steps"
    assert np.linalg.norm(_beyond(holed, log.truth)[:, 3:], axis=1).max() < 0.5
    assert _nees(holed, log.truth) < chi2.isf(1e-3, 6)


def test_a_loop_brings_the_present_nearer() -> None:
    log = _drive()
    steps = replace(log.known, imu=None, calibration=None)
    loop = log.loop(2, 79, np.zeros(6))
    before, after = (online.solve(replace(steps, loops=loops), CONFIG) for loops in ([], [loop]))
    assert after.loops_used.tolist() == [True]
    errors = [np.linalg.norm(_beyond(each, log.truth)[-1, 3:]) for each in (before, after)]
    assert errors[1] < 0.5 * errors[0]
    assert _nees(after, log.truth) < chi2.isf(1e-3, 6)


def test_a_wrong_loop_does_not_bend_the_trajectory() -> None:
    log = _drive()
    wrong = log.loop(2, 60, np.array([0.0, 0.3, 0.0, 5.0, 0.0, 3.0]))
    bent = online.solve(replace(log.known, loops=[wrong]), CONFIG)
    assert (bent.loops_used.tolist(), bent.rejected) == ([False], 1)
    straight = online.solve(log.known, CONFIG).trajectory
    assert_array_equal(bent.trajectory.poses.as_matrix(), straight.poses.as_matrix())


def test_the_imu_carries_the_present_over_pairs_that_are_wildly_wrong() -> None:
    log = _drive()
    bad = RigidTransform.from_exp_coords([0.0, 0.2, 0.0, 2.0, 0.0, 1.0])
    steps = [
        _pair(log.truth, k, k + 1, step.T_source_target * bad, SIGMA) if k in (40, 41) else step
        for k, step in enumerate(log.known.steps)
    ]
    result = online.solve(replace(log.known, steps=steps), CONFIG)
    assert result.rejected == 2
    assert np.linalg.norm(_beyond(result, log.truth)[-1, 3:]) < 0.5


def test_a_gyro_that_bursts_is_left_out_where_it_does() -> None:
    log = _drive()
    imu = log.known.imu
    assert imu is not None
    burst = abs(imu.stamps_ns / NANOSECONDS - 5.05) < 0.045
    rates = imu.angular_velocity + np.where(burst, 1.0, 0.0)[:, None] * [0.0, 1.0, 0.0]
    result = online.solve(replace(log.known, imu=replace(imu, angular_velocity=rates)), CONFIG)
    assert result.rejected == 1
    assert np.linalg.norm(_beyond(result, log.truth)[-1, 3:]) < 0.5
