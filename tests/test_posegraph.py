"""The pose graph adds nothing where nothing is to be added, and is consistent where there is."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.io import loadmat
from scipy.spatial.transform import RigidTransform, Rotation
from scipy.stats import chi2

from fusion import imu, posegraph
from fusion.chain import bridge_gaps, chain
from fusion.config import PoseGraphConfig
from fusion.evaluation import evaluate, pose_errors
from fusion_io.errors import LogError
from fusion_io.records import NANOSECONDS, FloatArray, ImuSeries, PairEstimate, Trajectory
from fusion_io.simulation.motion import DriveStyle, ImuModel, drive, simulate_imu

CONFIG = PoseGraphConfig()
PERIOD_NS = NANOSECONDS // 10
IMU_HZ = 100
SIGMA = np.array([1e-3, 1e-3, 1e-3, 0.01, 0.01, 0.02])
WITHOUT_ERROR = np.full(6, 1e-9)


@dataclass(frozen=True)
class Log:
    """A simulated drive: pairs, an IMU in camera axes, and the truth."""

    truth: Trajectory
    pairs: list[PairEstimate]
    inertial: ImuSeries


def _pairs(truth: Trajectory, errors: FloatArray, sigma: FloatArray) -> list[PairEstimate]:
    motions = truth.poses[:-1].inv() * truth.poses[1:] * RigidTransform.from_exp_coords(errors)
    quats, translations = motions.rotation.as_quat(scalar_first=True), motions.translation
    return [
        PairEstimate(int(truth.stamps_ns[k]), int(truth.stamps_ns[k + 1]), quats[k], translations[k], np.diag(sigma**2))
        for k in range(len(errors))
    ]


def _log(seed: int, frames: int, noise: FloatArray = SIGMA, **imu_model: object) -> Log:
    """Pairs with white noise, at which their covariances stay sensible where it is as good as none."""
    seconds = frames / 10
    motion = drive(seed, -0.5, seconds + 0.5, DriveStyle())
    stamps = PERIOD_NS * np.arange(frames)
    truth = Trajectory(stamps, motion.poses(stamps / NANOSECONDS)).relative_to_first()
    model = ImuModel(**{"rotation_imu_camera": Rotation.identity(), "gyro_bias": np.zeros(3)} | imu_model)
    samples = np.arange(-10, int(IMU_HZ * seconds) + 10) * (NANOSECONDS // IMU_HZ)
    errors = np.random.default_rng(seed).normal(size=(frames - 1, 6)) * noise
    inertial = simulate_imu(motion, samples, IMU_HZ, model, seed + 1000)
    return Log(truth, _pairs(truth, errors, np.maximum(noise, 1e-4)), inertial)


def _distance_m(one: Trajectory, other: Trajectory) -> float:
    """Between the last positions."""
    return float(np.linalg.norm(one.poses.translation[-1] - other.poses.translation[-1]))


def _turned_rad(one: Trajectory, other: Trajectory, start: int = 0, end: int = -1) -> float:
    """The difference of the rotations from pose `start` to pose `end`."""
    rotations = [each.poses.rotation[start].inv() * each.poses.rotation[end] for each in (one, other)]
    return float((rotations[0].inv() * rotations[1]).magnitude())


def _without(series: ImuSeries, start_s: float, end_s: float) -> ImuSeries:
    seconds = series.stamps_ns / NANOSECONDS
    keep = (seconds < start_s) | (seconds > end_s)
    return ImuSeries(series.stamps_ns[keep], series.angular_velocity[keep], series.linear_acceleration[keep])


def test_without_an_imu_the_result_is_the_raw_chain_with_its_covariances() -> None:
    """To 1e-9 in pose, and in covariance to a millionth, for covariances that are not diagonal either."""
    log = _log(0, 80)
    root = np.random.default_rng(0).normal(size=(6, 6)) * SIGMA[:, None]
    pairs = [replace(pair, covariance=root @ root.T + pair.covariance) for pair in log.pairs]
    raw, result = chain(pairs), posegraph.solve(pairs, None, CONFIG)
    assert_allclose(result.trajectory.poses.as_matrix(), raw.poses.as_matrix(), atol=1e-9)
    assert raw.covariances is not None
    assert_allclose(result.trajectory.covariances, raw.covariances, rtol=1e-6, atol=1e-10)
    assert result.note == "pairs only"


def test_exact_measurements_give_the_exact_trajectory_with_the_first_pose_as_the_world() -> None:
    log = _log(1, 60, WITHOUT_ERROR, gyro_noise=0.0, accelerometer_noise=0.0, accelerometer_bias=np.zeros(3))
    result = posegraph.solve(log.pairs, log.inertial, CONFIG)
    assert result.imu_factors == 59
    assert_allclose(result.trajectory.poses.as_matrix(), log.truth.poses.as_matrix(), atol=2e-3)
    assert_allclose(result.trajectory.poses[0].as_matrix(), np.eye(4), atol=1e-9)
    assert result.trajectory.covariances is not None
    assert_allclose(result.trajectory.covariances[0], 0.0)


@pytest.mark.parametrize("bias", [0.0, 0.03])
def test_a_gyro_makes_rotations_better_whether_it_has_a_bias_or_none(bias: float) -> None:
    log = _log(2, 150, gyro_bias=np.array([bias, -bias, bias]))
    fused = evaluate(posegraph.solve(log.pairs, log.inertial, CONFIG).trajectory, log.truth)
    raw = evaluate(chain(log.pairs), log.truth)
    assert fused.rpe_rotation_rad is not None
    assert raw.rpe_rotation_rad is not None
    assert fused.rpe_rotation_rad < 0.4 * raw.rpe_rotation_rad


def test_the_imu_carries_the_trajectory_over_pairs_that_are_wildly_wrong() -> None:
    """Preintegration is dead reckoning: half a second of it from a known velocity is good to decimetres."""
    log = _log(3, 100)
    wrong = range(50, 55)
    bad = _pairs(log.truth, np.random.default_rng(3).normal(size=(99, 6)) * [0.1, 0.1, 0.1, 0.5, 0.5, 0.5], SIGMA)
    pairs = [bad[k] if k in wrong else pair for k, pair in enumerate(log.pairs)]
    all_right = posegraph.solve(log.pairs, log.inertial, CONFIG).trajectory
    result = posegraph.solve(pairs, log.inertial, CONFIG)
    assert (result.pairs_rejected, result.imu_rejected) == (len(wrong), 0)
    assert _distance_m(result.trajectory, all_right) < 0.3
    assert _distance_m(chain(pairs), chain(log.pairs)) > 2.0


def test_a_gyro_that_bursts_is_rejected_where_it_does() -> None:
    log = _log(4, 100)
    seconds = log.inertial.stamps_ns / NANOSECONDS
    burst = np.where(abs(seconds - 5.05) < 0.05, 0.5, 0.0)
    rates = log.inertial.angular_velocity + burst[:, None] * [0.0, 1.0, 0.0]
    result = posegraph.solve(log.pairs, replace(log.inertial, angular_velocity=rates), CONFIG)
    assert (result.pairs_rejected, result.imu_rejected) == (0, 1)
    assert _turned_rad(result.trajectory, log.truth, 45, 55) < 0.005


def test_normalised_errors_are_those_of_a_consistent_estimator() -> None:
    """Monte Carlo over measurements drawn from the model: NEES of the last pose inside its 99.8 % bounds.

    Errors of the pairs are white here, and known to be; what batches of them show is chance.
    """
    config = PoseGraphConfig(
        gyro_noise=1e-3, accelerometer_noise=0.05, pair_rotation_rate_sigma=1e-6, accelerometer_bias_sigma=0.05
    )
    runs, nees = 16, []
    for seed in range(runs):
        rng = np.random.default_rng(seed)
        log = _log(
            seed,
            60,
            gyro_bias=rng.normal(0.0, config.gyro_bias_sigma, 3),
            accelerometer_bias=rng.normal(0.0, config.accelerometer_bias_sigma, 3),
            gyro_noise=config.gyro_noise,
            accelerometer_noise=config.accelerometer_noise,
        )
        trajectory = posegraph.solve(log.pairs, log.inertial, config).trajectory
        assert trajectory.covariances is not None
        position, orientation = (error[-1] for error in pose_errors(trajectory.poses, log.truth.poses))
        P = trajectory.covariances[-1]
        nees.append(
            [position @ np.linalg.solve(P[3:, 3:], position), orientation @ np.linalg.solve(P[:3, :3], orientation)]
        )
    lower, upper = chi2.ppf([0.001, 0.999], 3 * runs) / runs
    mean = np.mean(nees, axis=0)
    assert np.all(mean > lower), mean
    assert np.all(mean < upper), mean


@pytest.mark.parametrize("length_s", [0.1, 1.0, 5.0])
def test_over_a_hole_in_the_imu_the_pairs_carry_on(length_s: float) -> None:
    """The steps that the hole touches have no factor; the trajectory is hardly another."""
    log = _log(5, 120)
    holed = posegraph.solve(log.pairs, _without(log.inertial, 4.0, 4.0 + length_s), CONFIG)
    whole = posegraph.solve(log.pairs, log.inertial, CONFIG)
    assert whole.imu_factors - holed.imu_factors == round(10 * length_s) + 2
    assert _distance_m(holed.trajectory, whole.trajectory) < 0.5
    assert _turned_rad(holed.trajectory, whole.trajectory) < 0.02


def test_over_a_hole_in_the_pairs_the_imu_carries_on() -> None:
    """The car turns during the hole: the raw chain does not know, the graph measures it."""
    log = _log(6, 150)
    hole = range(70, 90)
    steps, _ = bridge_gaps(log.truth.stamps_ns, [pair for k, pair in enumerate(log.pairs) if k not in hole], None)
    raw, fused = chain(steps), posegraph.solve(steps, log.inertial, CONFIG).trajectory
    assert _turned_rad(raw, log.truth, 70, 90) > 0.02
    assert _turned_rad(fused, log.truth, 70, 90) < 0.005


def test_an_imu_that_measured_next_to_nothing_is_left_out_and_the_note_says_so() -> None:
    log = _log(7, 60)
    short = _without(log.inertial, 1.0, 100.0)
    result = posegraph.solve(log.pairs, short, CONFIG)
    assert result.note.startswith("pairs only: the IMU measured")
    assert_allclose(result.trajectory.poses.as_matrix(), chain(log.pairs).poses.as_matrix(), atol=1e-9)


def test_a_graph_that_has_no_solution_falls_back_to_the_pairs(monkeypatch: pytest.MonkeyPatch) -> None:
    def indeterminant(*_: object) -> Trajectory:
        raise RuntimeError("Indeterminant linear system\ndetected")

    monkeypatch.setattr(posegraph, "solve_inertial", indeterminant)
    log = _log(8, 60)
    result = posegraph.solve(log.pairs, log.inertial, CONFIG)
    assert "Indeterminant linear system detected" in result.note
    assert_allclose(result.trajectory.poses.as_matrix(), chain(log.pairs).poses.as_matrix(), atol=1e-9)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"quat_wxyz": np.array([np.nan, 0.0, 0.0, 0.0])}, "not finite"),
        ({"translation": np.array([0.0, np.inf, 0.0])}, "not finite"),
        ({"quat_wxyz": np.array([2.0, 0.0, 0.0, 0.0])}, "unit quaternion"),
        ({"covariance": np.full((6, 6), np.nan)}, "not finite and positive"),
        ({"covariance": np.zeros((6, 6))}, "not finite and positive"),
        ({"covariance": np.full((6, 6), 1e-4)}, "positive definite"),
        ({"covariance": np.eye(6) + np.triu(np.full((6, 6), 0.1), 1)}, "symmetric"),
    ],
)
def test_what_is_no_measurement_is_refused_before_it_reaches_gtsam(change: dict[str, FloatArray], reason: str) -> None:
    pairs = _log(9, 10).pairs
    pairs[4] = replace(pairs[4], **change)
    with pytest.raises(LogError, match=f"pair estimate at {pairs[4].target_stamp_ns} ns.*{reason}"):
        posegraph.solve(pairs, None, CONFIG)


def test_the_same_input_gives_the_same_bits() -> None:
    log = _log(10, 60)
    first, second = (posegraph.solve(log.pairs, log.inertial, CONFIG).trajectory for _ in range(2))
    assert_array_equal(first.poses.as_matrix(), second.poses.as_matrix())
    assert_array_equal(first.covariances, second.covariances)


def test_a_published_odometry_gets_better_with_the_real_imu(shared_data: Path) -> None:
    odometry = shared_data / "kitti" / "odometry"

    def read(name: str) -> Trajectory:
        poses = np.tile(np.eye(4), (len(stamps), 1, 1))
        poses[:, :3] = np.loadtxt(odometry / name).reshape(-1, 3, 4)
        return Trajectory(stamps, RigidTransform.from_matrix(poses))

    stamps = np.rint(np.loadtxt(odometry / "sequences" / "09" / "times.txt") * NANOSECONDS).astype(np.int64)
    published, truth = read("published/example_1/09.txt"), read("poses/09.txt")
    pairs = _pairs(published, np.zeros((len(stamps) - 1, 6)), np.repeat([5e-4, 0.04], 3))
    samples = loadmat(odometry / "imu" / "09.mat")["imu_data_interp"]
    sample_stamps = np.interp(np.arange(len(samples)) / 10, np.arange(len(stamps)), stamps).astype(np.int64)
    series = ImuSeries(sample_stamps, samples[:, 3:], samples[:, :3])
    inertial = imu.in_camera_axes(series, imu.calibrate(pairs, series, None, None))
    raw = evaluate(published, truth)
    fused = evaluate(posegraph.solve(pairs, inertial, CONFIG).trajectory, truth)
    assert None not in (raw.t_rel_percent, fused.t_rel_percent, fused.r_rel_deg_per_100m, fused.anees_orientation)
    assert fused.r_rel_deg_per_100m < 0.20
    assert fused.t_rel_percent < raw.t_rel_percent
    assert fused.anees_orientation < 6.0
