"""The pose graph adds nothing where nothing is to be added, is right where all is exact, and survives what is wrong."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import gtsam
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import RigidTransform, Rotation

from benchmarks.drives import PAIR_SIGMA, POSE_GRAPH, Drive, simulate
from fusion import posegraph
from fusion.chain import ImuWindow, bridge_gaps, chain
from fusion.config import PoseGraphConfig
from fusion.evaluation import evaluate, pose_errors
from fusion.imu import calibrate, on_camera_clock
from fusion.measurements import Estimate, Measurements
from fusion_io.errors import LogError
from fusion_io.kitti import read_imu_mat
from fusion_io.records import NANOSECONDS, FloatArray, ImuSeries, PairEstimate, Trajectory
from fusion_io.trajectory_files import pair_estimates, read_kitti, read_times

EXACT = POSE_GRAPH.model_copy(  # an IMU and a front end that hardly err
    update={"accelerometer_noise": 1e-3, "gyro_noise": 1e-5}
    | {name: 1e-6 for name in ("gyro_bias_walk", "accelerometer_bias_walk", "gyro_bias_sigma")}
    | {name: 1e-6 for name in ("pair_scale_sigma", "pair_rate_bias_sigma", "pair_misalignment_sigma")}
    | {name: 1e-6 for name in ("accelerometer_bias_sigma", "lever_arm_sigma", "mounting_sigma", "time_offset_sigma")}
)


@cache
def _drive() -> Drive:
    return simulate(0, 12.0)


def _solve(drive: Drive, pairs: Sequence[PairEstimate] | None = None, imu: ImuSeries | None = None) -> Estimate:
    """The estimate, with other pairs or another IMU than those of the drive."""
    known = drive.measurements
    return posegraph.solve(replace(known, steps=pairs or known.steps, imu=imu or known.imu), POSE_GRAPH)


def _moved(pair: PairEstimate, twist: Sequence[float] | FloatArray) -> PairEstimate:
    wrong = pair.T_source_target * RigidTransform.from_exp_coords(twist)
    return replace(pair, quat_wxyz=wrong.rotation.as_quat(scalar_first=True), translation=wrong.translation)


def _imu(drive: Drive) -> ImuSeries:
    assert drive.measurements.imu is not None
    return drive.measurements.imu


def _without(series: ImuSeries, start_s: float, end_s: float) -> ImuSeries:
    seconds = series.stamps_ns / NANOSECONDS
    keep = (seconds < start_s) | (seconds > end_s)
    return ImuSeries(series.stamps_ns[keep], series.angular_velocity[keep], series.linear_acceleration[keep])


def _distance_m(one: Trajectory, other: Trajectory) -> float:
    """Between the last positions."""
    return float(np.linalg.norm(one.poses.translation[-1] - other.poses.translation[-1]))


def _turned_rad(one: Trajectory, other: Trajectory, start: int = 0, end: int = -1) -> float:
    """The difference of the rotations from pose `start` to pose `end`."""
    rotations = [each.poses.rotation[start].inv() * each.poses.rotation[end] for each in (one, other)]
    return float((rotations[0].inv() * rotations[1]).magnitude())


def _between(truth: Trajectory, source: int, target: int, sigma: float) -> PairEstimate:
    """A loop closure without an error."""
    motion = truth.poses[source].inv() * truth.poses[target]
    stamps = truth.stamps_ns[[source, target]].tolist()
    return PairEstimate(
        *stamps,
        motion.rotation.as_quat(scalar_first=True),
        motion.translation,
        sigma**2 * np.diag([0.01] * 3 + [1] * 3),
    )


# ------------------------------------------------------------------------------------------- nothing to be added


def test_without_an_imu_the_result_is_the_raw_chain_with_its_covariances() -> None:
    """To 1e-9 in pose, and in covariance to a millionth, for covariances that are not diagonal either."""
    root = np.random.default_rng(0).normal(size=(6, 6)) * PAIR_SIGMA[:, None]
    pairs = [replace(pair, covariance=root @ root.T + pair.covariance) for pair in _drive().measurements.steps]
    # Lasting errors of the front end add to the covariance of the chain, which knows nothing of them.
    config = POSE_GRAPH.model_copy(update={"pair_scale_sigma": 1e-9, "pair_rate_bias_sigma": 1e-9})
    raw, result = chain(pairs), posegraph.solve(Measurements(pairs), config)
    assert_allclose(result.trajectory.poses.as_matrix(), raw.poses.as_matrix(), atol=1e-9)
    assert_allclose(result.trajectory.covariances, raw.covariances, rtol=1e-6, atol=1e-10)
    assert result.note == "pairs only: no IMU"
    assert result.mounting is None


def test_lasting_errors_of_the_front_end_move_nothing_without_an_imu_but_are_in_the_covariance() -> None:
    steps = _drive().measurements.steps
    raw, result = chain(steps), posegraph.solve(Measurements(steps), POSE_GRAPH)
    assert_allclose(result.trajectory.poses.as_matrix(), raw.poses.as_matrix(), atol=1e-6)
    assert raw.covariances is not None
    assert result.trajectory.covariances is not None
    excess = result.trajectory.covariances[1:] - raw.covariances[1:]
    assert np.linalg.eigvalsh(excess[-1])[0] > 0.0
    # One second of a scale error and a rate bias that are hardly not constant yet.
    step = np.linalg.norm(raw.poses.translation[5])
    expected = np.trace(raw.covariances[5, 3:, 3:]) + (POSE_GRAPH.pair_scale_sigma * step) ** 2
    assert np.trace(result.trajectory.covariances[5, 3:, 3:]) == pytest.approx(expected, rel=0.05)


def test_an_imu_that_measured_next_to_nothing_is_left_out_and_the_note_says_so() -> None:
    drive = _drive()
    result = _solve(drive, imu=_without(_imu(drive), 1.0, 100.0))
    assert result.note.startswith("pairs only: the IMU measured")
    assert_allclose(result.trajectory.poses.as_matrix(), chain(drive.measurements.steps).poses.as_matrix(), atol=1e-6)


def test_a_graph_that_has_no_solution_falls_back_to_the_pairs(monkeypatch: pytest.MonkeyPatch) -> None:
    def indeterminant(*_: object) -> None:
        raise RuntimeError("Indeterminant linear system\ndetected")

    monkeypatch.setattr(posegraph, "_with_imu", indeterminant)
    drive = _drive()
    result = _solve(drive)
    assert "Indeterminant linear system detected" in result.note
    assert_allclose(result.trajectory.poses.as_matrix(), chain(drive.measurements.steps).poses.as_matrix(), atol=1e-6)


# ------------------------------------------------------------------------------------------------ what is exact


def test_exact_measurements_give_the_exact_trajectory_with_the_first_camera_as_the_world() -> None:
    drive = simulate(1, 6.0, EXACT, sigma=np.full(6, 1e-9))
    pairs = [replace(pair, covariance=np.diag(PAIR_SIGMA**2)) for pair in drive.measurements.steps]
    result = posegraph.solve(replace(drive.measurements, steps=pairs), EXACT)
    assert result.note == "IMU on 60 of 60 steps"
    assert_allclose(result.trajectory.poses.as_matrix(), drive.truth.poses.as_matrix(), atol=5e-3)
    assert_allclose(result.trajectory.poses[0].as_matrix(), np.eye(4), atol=1e-6)
    assert result.trajectory.covariances is not None
    assert_allclose(result.trajectory.covariances[0], 0.0)


def test_to_make_the_first_camera_the_world_changes_no_error(monkeypatch: pytest.MonkeyPatch) -> None:
    errors = []
    move = posegraph._make_first_camera_the_world

    def error(problem: posegraph.Problem, values: gtsam.Values) -> float:
        for batch in problem.batches:
            batch.update(values)
        return sum(problem.graph.at(i).error(values) for i in range(1, problem.graph.size()))

    def watched(problem: posegraph.Problem, values: gtsam.Values) -> None:
        errors.append(error(problem, values))
        first = posegraph.cameras(problem, values)[0][0]
        assert np.linalg.norm(first - np.eye(4)) > 1e-4  # or there would be nothing to move
        move(problem, values)
        errors.append(error(problem, values))
        assert_allclose(posegraph.cameras(problem, values)[0][0], np.eye(4), atol=1e-12)

    monkeypatch.setattr(posegraph, "_make_first_camera_the_world", watched)
    _solve(_drive())
    assert_allclose(errors[1], errors[0], rtol=1e-9)


def test_covariances_are_covariances_and_grow_from_that_of_a_pair() -> None:
    covariances = _solve(_drive()).trajectory.covariances
    assert covariances is not None
    assert_allclose(covariances, covariances.swapaxes(1, 2), atol=1e-12)
    assert np.all(np.linalg.eigvalsh(covariances[1:]) > 0.0)
    sigma = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2))
    assert np.all(sigma[1] < 1.05 * PAIR_SIGMA)
    assert np.all(np.diff(np.linalg.norm(sigma[10::10, 3:], axis=1)) > 0.0)


def test_noise_of_the_imu_is_a_density() -> None:
    """A second at rest, in pieces of any length: attitude and velocity have variances of density^2 x time, position
    a third of that of velocity x time^2.
    """
    for pieces in (10, 200):
        window = ImuWindow(np.full(pieces, 1 / pieces), np.zeros((pieces, 3)), np.tile([0.0, 0.0, 9.81], (pieces, 1)))
        graph, still = gtsam.NonlinearFactorGraph(), gtsam.imuBias.ConstantBias()
        config = POSE_GRAPH.model_copy(update={"gyro_noise": 1e-9})
        posegraph._add_preintegrated(graph, [window], np.zeros(2, dtype=np.int64), still, np.ones(1), config)
        P = graph.at(0).noiseModel().covariance()
        expected = config.accelerometer_noise**2 * np.repeat([1 / 3, 1.0], 3)
        assert_allclose(np.diag(P)[3:], expected, rtol=0.02)
        graph = gtsam.NonlinearFactorGraph()
        posegraph._add_preintegrated(graph, [window], np.zeros(2, dtype=np.int64), still, np.ones(1), POSE_GRAPH)
        assert_allclose(np.diag(graph.at(0).noiseModel().covariance())[:3], POSE_GRAPH.gyro_noise**2, rtol=0.02)


@pytest.mark.parametrize(("hertz", "noise"), [(0.1, 0.01), (3.7, 0.01), (3.7, 1e-4), (1.3, 0.03)])
def test_rates_are_means_over_the_span_that_errs_least(hertz: float, noise: float) -> None:
    """Of a rate that swings slowly or fast beside white noise (rad/s/sqrt(Hz)): as if one had seen the truth."""
    period_s, pieces, steps = 0.01, 10, 400
    seconds = period_s * (np.arange(pieces * steps) + 0.5)
    true = 0.3 * np.sin(2 * np.pi * hertz * seconds)
    shown = true + np.random.default_rng(0).normal(size=len(true)) * noise / np.sqrt(period_s)
    rates = np.repeat(shown[:, None], 3, axis=1).reshape(steps, pieces, 3)
    windows = [(k, ImuWindow(np.full(pieces, period_s), each, each)) for k, each in enumerate(rates)]
    frames = period_s * pieces * np.arange(steps + 1)
    wanted = 0.3 * np.sin(2 * np.pi * hertz * frames)[1:-1]

    found = posegraph._rates(windows, frames, noise)[1:-1, 0]
    errors = [
        np.mean((posegraph._mean_rates(windows, frames, span_s)[1:-1, 0] - wanted) ** 2)
        for span_s in posegraph.RATE_SPANS_S
    ]
    assert np.mean((found - wanted) ** 2) == pytest.approx(min(errors))


def test_the_imu_makes_orientations_better() -> None:
    """All along the drive."""
    drive = _drive()
    _, fused = pose_errors(_solve(drive).trajectory.poses, drive.truth.poses)
    _, raw = pose_errors(chain(drive.measurements.steps).poses, drive.truth.poses)
    assert np.linalg.norm(fused) < 0.5 * np.linalg.norm(raw)


# ------------------------------------------------------------------------------------------------ the mounting


def test_pairs_that_know_nothing_leave_the_mounting_at_its_prior() -> None:
    """Whose covariance is that of the configuration, for one that is estimated and for one that is given."""
    known = _drive().measurements
    assert known.calibration is not None
    pairs = [replace(pair, covariance=1e4 * np.eye(6)) for pair in known.steps[:40]]
    given = replace(known.calibration, rotation_std_rad=np.zeros(3), time_offset_std_s=0.0)
    c = POSE_GRAPH
    for calibration, rotation, offset in (
        (known.calibration, c.mounting_sigma, c.time_offset_sigma),
        (given, c.given_mounting_sigma, c.given_time_offset_sigma),
    ):
        found = posegraph.solve(replace(known, steps=pairs, calibration=calibration), c).mounting
        assert found is not None
        sigma = np.sqrt(np.diag(found.covariance))
        expected = np.repeat([rotation, c.lever_arm_sigma, offset, c.pair_misalignment_sigma], [3, 3, 1, 3])
        assert_allclose(sigma, expected, rtol=1e-3)


def test_a_given_mounting_is_a_prior() -> None:
    """Held loosely, two that are four degrees apart end up together; held tight, they stay where they are."""
    known = _drive().measurements
    assert known.calibration is not None
    apart = []
    for sigma in (0.5, 1e-5):
        config = POSE_GRAPH.model_copy(update={"given_mounting_sigma": sigma})
        found = []
        for angle in np.deg2rad([-2.0, 2.0]):
            mounting = known.calibration.mounting * Rotation.from_rotvec([0.0, angle, 0.0])
            given = replace(known.calibration, rotation_imu_camera=mounting, rotation_std_rad=np.zeros(3))
            estimate = posegraph.solve(replace(known, calibration=given), config)
            assert estimate.mounting is not None
            found.append(Rotation.from_matrix(estimate.mounting.T_camera_imu[:3, :3]))
        apart.append(np.rad2deg((found[0].inv() * found[1]).magnitude()))
    assert apart[0] < 0.2
    assert apart[1] == pytest.approx(4.0, abs=0.01)


# ------------------------------------------------------------------------------------------------ loops


def test_a_loop_pulls_the_end_to_where_it_is_and_a_wrong_one_does_not() -> None:
    """Loops of centimetres tie the ends of a drive together; one of them claims to be two metres elsewhere."""
    drive = _drive()
    good = [
        _between(drive.truth, 0, 118, 0.05),
        _between(drive.truth, 2, 120, 0.05),
        _between(drive.truth, 1, 119, 0.05),
    ]
    wrong = _moved(_between(drive.truth, 3, 117, 0.05), [0, 0, 0, 2.0, 0, 0])
    open_ended = _solve(drive)
    closed = posegraph.solve(replace(drive.measurements, loops=[*good, wrong]), POSE_GRAPH)
    assert_array_equal(closed.loops_used, [True, True, True, False])
    assert closed.note.endswith("loops used: 3 of 4")
    assert _distance_m(closed.trajectory, drive.truth) < 0.15
    assert _distance_m(open_ended.trajectory, drive.truth) > 0.5
    assert closed.trajectory.covariances is not None
    assert np.sqrt(np.trace(closed.trajectory.covariances[-1, 3:, 3:])) < 0.15


def test_pairs_that_skip_frames_are_measurements_too() -> None:
    """Exact ones, over half a second each, halve the error of the raw chain."""
    drive = _drive()
    skips = [_between(drive.truth, k, k + 5, 0.01) for k in range(0, 120, 5)]
    steps = drive.measurements.steps
    without, with_skips = (posegraph.solve(Measurements(steps, skips=each), POSE_GRAPH) for each in ((), skips))
    assert with_skips.rejected == 0
    assert _distance_m(with_skips.trajectory, drive.truth) < 0.5 * _distance_m(without.trajectory, drive.truth)


# ------------------------------------------------------------------------------------------------ faults


def test_the_imu_carries_the_trajectory_over_pairs_that_are_wildly_wrong() -> None:
    """Preintegration is dead reckoning: half a second of it from a known velocity is good to decimetres."""
    drive = _drive()
    rng = np.random.default_rng(3)
    steps = drive.measurements.steps
    pairs = [
        _moved(pair, rng.normal(size=6) * np.repeat([0.1, 0.5], 3)) if 50 <= k < 55 else pair
        for k, pair in enumerate(steps)
    ]
    result, all_right = _solve(drive, pairs), _solve(drive).trajectory
    assert result.rejected == 5
    assert result.series is not None
    assert_array_equal(np.flatnonzero(~result.series.used), range(51, 56))
    assert _distance_m(result.trajectory, all_right) < 0.3


def test_a_gyro_that_bursts_is_rejected_where_it_does() -> None:
    drive = _drive()
    imu = _imu(drive)
    burst = np.where(abs(imu.stamps_ns / NANOSECONDS - 5.05) < 0.04, 1.0, 0.0)
    rates = imu.angular_velocity + burst[:, None] * [0.0, 0.0, 1.0]
    result = _solve(drive, imu=replace(imu, angular_velocity=rates))
    assert result.rejected == 1
    assert result.note == "IMU on 119 of 120 steps"
    assert _turned_rad(result.trajectory, drive.truth, 45, 55) < 0.01


@pytest.mark.parametrize("length_s", [0.1, 1.0, 5.0])
def test_over_a_hole_in_the_imu_the_pairs_carry_on(length_s: float) -> None:
    """The steps that the hole touches have no factor; the trajectory is hardly another."""
    drive = _drive()
    holed = _solve(drive, imu=_without(_imu(drive), 4.0, 4.0 + length_s))
    assert holed.note == f"IMU on {120 - round(10 * length_s) - 2} of 120 steps"
    whole = _solve(drive)
    assert _distance_m(holed.trajectory, whole.trajectory) < 1.0
    assert _turned_rad(holed.trajectory, whole.trajectory) < 0.03
    assert holed.trajectory.covariances is not None
    error, _ = pose_errors(holed.trajectory.poses[-1:], drive.truth.poses[-1:])
    assert np.linalg.norm(error) < 4.0 * np.sqrt(np.trace(holed.trajectory.covariances[-1, 3:, 3:]))


def test_over_a_hole_in_the_pairs_the_imu_carries_on() -> None:
    """The car turns during the hole: the raw chain does not know, the graph measures it."""
    drive = simulate(6, 15.0)
    kept = [pair for k, pair in enumerate(drive.measurements.steps) if k not in range(70, 90)]
    steps, _ = bridge_gaps(drive.truth.stamps_ns, kept, None)
    raw, fused = chain(steps), _solve(drive, steps).trajectory
    assert _turned_rad(raw, drive.truth, 70, 90) > 0.02
    assert _turned_rad(fused, drive.truth, 70, 90) < 0.008


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
@pytest.mark.parametrize("kind", ["steps", "loops"])
def test_what_is_no_measurement_is_refused_before_it_reaches_gtsam(
    kind: str, change: dict[str, FloatArray], reason: str
) -> None:
    known = Measurements(_drive().measurements.steps[:10], loops=[_between(_drive().truth, 0, 9, 0.1)])
    changed = list(getattr(known, kind))
    changed[-1] = replace(changed[-1], **change)
    with pytest.raises(LogError, match=f"pair estimate at {changed[-1].target_stamp_ns} ns.*{reason}"):
        posegraph.solve(replace(known, **{kind: changed}), POSE_GRAPH)


def test_the_same_input_gives_the_same_bits() -> None:
    drive = _drive()
    first, second = (_solve(drive, drive.measurements.steps[:60]).trajectory for _ in range(2))
    assert_array_equal(first.poses.as_matrix(), second.poses.as_matrix())
    assert_array_equal(first.covariances, second.covariances)


def test_a_published_odometry_gets_better_with_the_real_imu(shared_data: Path) -> None:
    """KITTI 09, its first 70 s: far below raw in rotation and in translation, and covariances that say so."""
    odometry, frames = shared_data / "kitti" / "odometry", 700
    stamps = read_times(odometry / "sequences" / "09" / "times.txt")
    imu = read_imu_mat(odometry / "imu" / "09.mat", stamps)
    truth = read_kitti(odometry / "poses" / "09.txt", stamps)
    pairs = pair_estimates(read_kitti(odometry / "published" / "example_1" / "09.txt", stamps), 0.04, 5e-4)[:frames]
    calibration = calibrate(pairs, imu, None, None)
    known = Measurements(pairs, on_camera_clock(imu, calibration), calibration)
    raw = evaluate(chain(pairs), truth)
    fused = evaluate(posegraph.solve(known, PoseGraphConfig()).trajectory, truth)
    assert fused.r_rel_deg_per_100m < raw.r_rel_deg_per_100m / 2
    assert fused.t_rel_percent < 0.6 * raw.t_rel_percent
    assert fused.anees_orientation < 6.0
    assert fused.anees_position < 6.0
