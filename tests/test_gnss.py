"""Satellite positions: places on the earth, what ties a trajectory to them, and how little wrong ones do."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import E, G, L, U
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import RigidTransform, Rotation
from scipy.stats import chi2

import fusion
from fusion import fusing, gnss, imu, posegraph
from fusion.chain import chain
from fusion.config import GnssConfig, PoseGraphConfig, RunConfig
from fusion.evaluation import evaluate
from fusion.factors import Batch
from fusion.measurements import Estimate, Measurements
from fusion.pair_model import difference
from fusion_io.findings import Findings
from fusion_io.gnss import Receiver, every, fixes_at
from fusion_io.records import NANOSECONDS, FloatArray, GnssFix, ImuSeries, PairEstimate, Trajectory
from fusion_io.simulation.motion import ROTATION_IMU_CAMERA_KITTI, DriveStyle, ImuModel, drive, imu_stamps, simulate_imu

ORIGIN = (49.0, 8.4, 115.0)
ANTENNA = np.array([0.3, -0.5, -1.0])  # in camera axes
CONFIG = PoseGraphConfig()
UNKNOWN_ANTENNA = GnssConfig()
RECEIVER = Receiver(2.0)
STYLE = DriveStyle()
PAIR_SIGMA = np.repeat([1e-3, 0.02], 3)
PERIOD_NS = NANOSECONDS // 10


@dataclass(frozen=True)
class Drive:
    """A car's drive in a street that lies east, north, up about ORIGIN, seen by a front end and a receiver."""

    poses: Trajectory  # of the camera in the street
    pairs: Sequence[PairEstimate]
    fixes: Sequence[GnssFix]
    imu: ImuSeries

    @property
    def truth(self) -> Trajectory:
        return self.poses.relative_to_first()

    def solved(self, config: GnssConfig = UNKNOWN_ANTENNA, fixes: Sequence[GnssFix] | None = None) -> Estimate:
        """By the pose graph, without the IMU."""
        known = gnss.positions(self.fixes if fixes is None else fixes, config, Findings())
        return posegraph.solve(Measurements(self.pairs, gnss=known), CONFIG)

    def truth_about(self, origin: gnss.Origin) -> FloatArray:
        """The true T_enu_world (4, 4) for an origin that is near to that of the street."""
        T_enu_world = self.poses.poses[0].as_matrix()
        latitude, longitude, altitude = np.subtract(origin, ORIGIN)
        T_enu_world[:3, 3] -= [metres_east(longitude), metres_north(latitude), altitude]
        return T_enu_world


def metres_north(degrees: float) -> float:
    """Along the meridian at the origin: radius of curvature a (1 - e^2) / (1 - e^2 sin^2)^1.5, of WGS84."""
    return float(np.radians(degrees) * (6_371_727.0 + ORIGIN[2]))


def metres_east(degrees: float) -> float:
    """Along the parallel at the origin: radius a / (1 - e^2 sin^2)^0.5 times the cosine of the latitude."""
    return float(np.radians(degrees) * (6_390_315.0 + ORIGIN[2]) * np.cos(np.radians(ORIGIN[0])))


def wandering(rng: np.random.Generator, count: int, sigma: float, correlation_s: float) -> FloatArray:
    """A Gauss-Markov process (count,), a step every PERIOD_NS."""
    keep = np.exp(-PERIOD_NS / NANOSECONDS / correlation_s)
    values = [rng.normal(0.0, sigma)]
    for step in rng.normal(0.0, sigma * np.sqrt(1.0 - keep**2), count - 1):
        values.append(keep * values[-1] + step)
    return np.array(values)


def driven(seed: int, seconds: float = 40.0, receiver: Receiver = RECEIVER, style: DriveStyle = STYLE) -> Drive:
    """A drive whose every error is drawn from the pose graph's model."""
    motion = drive(seed, -1.0, seconds + 1.0, style)
    stamps = NANOSECONDS * 10 + np.arange(round(10 * seconds), dtype=np.int64) * PERIOD_NS
    poses = Trajectory(stamps, motion.poses(stamps / NANOSECONDS - 10.0))
    rng = np.random.default_rng([seed, 1])
    motions = poses.poses[:-1].inv() * poses.poses[1:]
    count = len(motions)
    scale = wandering(rng, count, CONFIG.pair_scale_sigma, CONFIG.pair_scale_correlation_s)
    sigma, correlation_s = CONFIG.pair_rate_bias_sigma, CONFIG.pair_rate_bias_correlation_s
    rate = np.stack([wandering(rng, count, sigma, correlation_s) for _ in range(3)], axis=1)
    rotations = motions.rotation * Rotation.from_rotvec(rate * PERIOD_NS / NANOSECONDS)
    shown = RigidTransform.from_components((1.0 + scale[:, None]) * motions.translation, rotations)
    shown *= RigidTransform.from_exp_coords(rng.normal(size=(count, 6)) * PAIR_SIGMA)
    quats_wxyz, translations = shown.rotation.as_quat(scalar_first=True), shown.translation
    pairs = [
        PairEstimate(int(stamps[k]), int(stamps[k + 1]), quats_wxyz[k], translations[k], np.diag(PAIR_SIGMA**2))
        for k in range(count)
    ]
    between = stamps[:-1] + 37_000_000
    antenna = motion.poses(between / NANOSECONDS - 10.0).apply(ANTENNA)
    inertial = simulate_imu(motion, imu_stamps(-0.5, seconds + 0.5, 100.0), 100.0, ImuModel(), seed)
    inertial = replace(inertial, stamps_ns=inertial.stamps_ns + 10 * NANOSECONDS)
    return Drive(poses, pairs, receiver.fixes(fixes_at(between, antenna, ORIGIN)), inertial)


def ate_m(trajectory: Trajectory, truth: Trajectory) -> float:
    found = evaluate(trajectory, truth).ate_m
    assert found is not None
    return found


def positions(*fixes: GnssFix, config: GnssConfig = UNKNOWN_ANTENNA) -> gnss.Positions:
    found = gnss.positions(fixes, config, Findings())
    assert found is not None
    return found


def nees(found: gnss.Georeference, true: FloatArray) -> float:
    error = difference(found.T_enu_world[None], true[None])[0]
    return float(error @ np.linalg.solve(found.covariance, error))


# --- Fixes --------------------------------------------------------------------------------------


def test_a_second_of_arc_is_as_long_as_the_ellipsoid_is_curved_there() -> None:
    """To a millimetre in 31 m; up is along the normal, and the first fix is the origin."""
    second = 1.0 / 3600.0
    places = [(0.0, 0.0, 0.0), (second, 0.0, 0.0), (0.0, second, 0.0), (0.0, 0.0, 7.0)]
    fixes = [GnssFix(i, *np.add(ORIGIN, place)) for i, place in enumerate(places)]
    found = positions(*fixes)
    assert_allclose(found.origin, ORIGIN)
    expected = [[0, 0, 0], [0, metres_north(second), 0], [metres_east(second), 0, 0], [0, 0, 7]]
    assert_allclose(found.enu_m, expected, atol=1e-3)


def test_places_come_back_from_the_local_frame() -> None:
    """To a micrometre, kilometres away."""
    enu_m = np.array([[0.0, 0.0, 0.0], [3000.0, -4000.0, 50.0], [-200.0, 10_000.0, -30.0]])
    assert_allclose(positions(*fixes_at(np.arange(3), enu_m, ORIGIN)).enu_m, enu_m, atol=1e-6)


def test_fixes_without_a_place_are_left_out_and_counted() -> None:
    good = [GnssFix(i, 49.0 + 1e-5 * i, 8.4, 115.0) for i in range(5)]
    bad = [
        GnssFix(6, np.nan, 8.4, 115.0),
        GnssFix(7, 49.0, 8.4, np.nan),
        GnssFix(8, 0.0, 0.0, 0.0),
        GnssFix(9, 491.0, 8.4, 115.0),
        replace(good[2], latitude_deg=49.1),
    ]
    findings = Findings()
    found = gnss.positions([*good[::-1], *bad], GnssConfig(), findings)
    assert found is not None
    assert findings.counts == {"gnss_unusable": 5}
    assert_array_equal(found.stamps_ns, range(5))
    assert found.origin == ORIGIN
    assert gnss.positions(bad[:2], GnssConfig(), Findings()) is None
    assert gnss.positions(good, GnssConfig(use=False), Findings()) is None


@pytest.mark.parametrize("stated", [None, np.zeros((3, 3)), np.full((3, 3), np.nan), np.diag([1.0, -1.0, 1.0])])
def test_a_covariance_that_is_none_is_that_of_the_configuration(stated: FloatArray | None) -> None:
    fix = GnssFix(0, *ORIGIN, covariance=stated)
    assert_array_equal(positions(fix, config=GnssConfig(sigma=3.0)).covariances[0], 9.0 * np.eye(3))
    good = np.diag([1.0, 2.0, 4.0])
    assert_array_equal(positions(replace(fix, covariance=good)).covariances[0], good)


def test_a_receiver_gives_a_fix_a_period_with_the_noise_that_it_states() -> None:
    """Variance over 3,000 numbers: inside 5 standard deviations of its own, 2.6 % each."""
    stamps_ns = np.arange(1000) * PERIOD_NS
    assert_array_equal(every(stamps_ns, 1.0)[:3], [0, 10, 20])
    exact = fixes_at(stamps_ns, np.zeros((1000, 3)), ORIGIN)
    enu_m = positions(exact[0], *(replace(fix, stamp_ns=fix.stamp_ns + 1) for fix in Receiver(0.1, 2.0).fixes(exact)))
    assert_allclose(enu_m.enu_m.var(), 4.0, rtol=0.13)
    assert_allclose(enu_m.covariances[1], 4.0 * np.eye(3))
    wrong = Receiver(0.1, 0.1, outliers=0.2).fixes(exact)
    far = np.linalg.norm(positions(exact[0], *wrong[1:]).enu_m, axis=1) > 10.0
    assert 0.15 < far.mean() < 0.25


# --- Alignment ----------------------------------------------------------------------------------


@pytest.mark.parametrize("up_known", [True, False])
def test_alignment_recovers_the_transform_with_a_third_of_the_fixes_wrong(up_known: bool) -> None:
    """To 2 m and 2 degrees: what the pose graph begins with."""
    rng = np.random.default_rng(0)
    T = RigidTransform.from_components([100.0, -50.0, 3.0], Rotation.from_rotvec([0.3, -0.2, 2.0]))
    world_m = np.cumsum(rng.normal(size=(60, 3)) * [10.0, 2.0, 10.0], axis=0)
    enu_m = T.apply(world_m) + 0.5 * rng.normal(size=(60, 3))
    enu_m[::3] += rng.uniform(-200.0, 200.0, (20, 3))
    up = T.rotation.inv().apply([0.0, 0.0, 1.0])
    found = RigidTransform.from_matrix(gnss.align(world_m, enu_m, 0.5, up, up_known))
    assert np.rad2deg((found.rotation.inv() * T.rotation).magnitude()) < 2.0
    assert np.linalg.norm(found.apply(world_m) - T.apply(world_m), axis=1).max() < 2.0


def test_on_a_line_the_camera_is_taken_to_be_upright() -> None:
    along = np.arange(20.0)[:, None]
    world_m = along * [0.0, 0.0, 10.0]  # ahead
    enu_m = along * [10.0, 0.0, 0.0] + 0.1 * np.random.default_rng(0).normal(size=(20, 3))
    R = gnss.align(world_m, enu_m, 1.0, gnss.UP_IN_CAMERA, up_known=False)[:3, :3]
    assert_allclose(R @ [0, -1, 0], [0, 0, 1], atol=0.05)
    assert_allclose(R @ [0, 0, 1], [1, 0, 0], atol=0.05)


# --- Factors ------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["antenna", "upright"])
def test_jacobians_are_those_of_finite_differences(name: str) -> None:
    """Central ones, whose error is the square of the step."""
    rng, step = np.random.default_rng(0), 1e-5
    values = gtsam.Values()
    if name == "antenna":
        values.insert(L(0), rng.normal(size=3))
        values.insert(E(0), 0.3 * rng.normal(size=10))
        mounted = RigidTransform.from_exp_coords(rng.normal(size=6)).as_matrix()
        factor: Batch = gnss.AntennaFactor(mounted, rng.normal(size=3), 0.5)
    else:
        values.insert(U(0), gtsam.Pose3.Expmap(rng.normal(size=6)))
        values.insert(G(0), gtsam.Unit3(rng.normal(size=3)))
        factor = gnss.UprightFactor(0.1)
    graph = gtsam.NonlinearFactorGraph()
    factor.add_to(graph)
    keys = list(graph.at(0).keys())

    def errors(key: int, by: FloatArray) -> FloatArray:
        still, moved = values.zeroVectors(), gtsam.VectorValues()
        for other in keys:
            moved.insert(other, by if other == key else still.at(other))
        factor.update(values.retract(moved))
        return np.asarray(graph.at(0).unwhitenedError(values))

    numeric = [
        (errors(key, by) - errors(key, -by)) / (2.0 * step)
        for key in keys
        for by in step * np.eye(values.zeroVectors().at(key).size)
    ]
    factor.update(values)
    jacobian = np.array(graph.at(0).linearize(values).jacobian()[0])
    assert_allclose(jacobian, np.column_stack(numeric), atol=1e-7)


# --- The pose graph -----------------------------------------------------------------------------


def test_drift_is_bounded_by_a_fix_every_five_seconds() -> None:
    """Over three drives of 80 s: at most a third of the raw chain's ATE on average, and 1.5 m."""
    ratios = []
    for seed in range(3):
        log = driven(seed, 80.0, Receiver(5.0, 1.0, seed))
        found = ate_m(log.solved().trajectory, log.truth)
        assert found < 1.5
        ratios.append(found / ate_m(chain(log.pairs), log.truth))
    assert np.mean(ratios) < 1 / 3


def test_where_the_world_is_has_the_error_that_its_covariance_says() -> None:
    """Monte Carlo over errors drawn from the model: NEES of T_enu_world and of the antenna inside 99.8 % bounds."""
    runs, of_frame, of_antenna = 20, [], []
    for seed in range(runs):
        log = driven(seed, 20.0, Receiver(1.0, 1.0, seed), DriveStyle(yaw_rate=0.3))
        thought = ANTENNA + np.random.default_rng([seed, 2]).normal(size=3)
        found = log.solved(GnssConfig(antenna=tuple(thought), given_antenna_sigma=1.0)).georeference
        assert found is not None
        of_frame.append(nees(found, log.truth_about(found.origin)))
        error = found.antenna_m - ANTENNA
        of_antenna.append(error @ np.linalg.solve(found.antenna_covariance, error))
    for values, freedom in ((of_frame, 6), (of_antenna, 3)):
        low, high = chi2.ppf([0.001, 0.999], runs * freedom) / runs
        assert low < np.mean(values) < high


def test_turns_show_where_the_antenna_is() -> None:
    """Exact fixes ten times a second, of an antenna 2 m behind and 1 m to the right of where it is thought to be.

    What it is above the camera they show where the camera tilts, and a car hardly does.
    """
    log = driven(3, 40.0, Receiver(0.1, 0.02), DriveStyle(yaw_rate=0.4))
    found = log.solved(GnssConfig(antenna=tuple(ANTENNA + [1.0, 0.0, 2.0]), given_antenna_sigma=3.0)).georeference
    assert found is not None
    sigma = np.sqrt(np.diag(found.antenna_covariance))
    assert_allclose(found.antenna_m[[0, 2]], ANTENNA[[0, 2]], atol=0.2)
    assert (sigma[[0, 2]] < 0.2).all()


@pytest.mark.parametrize("share", [0.1, 0.3])
def test_wrong_fixes_are_rejected_and_bend_nothing(share: float) -> None:
    """50 m off: all of them found, no other, and the ATE within 20 % of that of the same drive without them."""
    log = driven(5, 80.0, Receiver(2.0, 1.0))
    wrong = np.random.default_rng(1).random(len(log.fixes)) < share
    moved = [replace(fix, longitude_deg=fix.longitude_deg + 50.0 / 73_000.0) for fix in log.fixes]
    fixes = [other if bad else fix for fix, other, bad in zip(log.fixes, moved, wrong, strict=True)]
    result = log.solved(fixes=fixes)
    assert result.georeference is not None
    assert_array_equal(result.georeference.used, ~wrong)
    assert result.rejected == wrong.sum() > 2
    only_good = log.solved(fixes=[fix for fix, bad in zip(log.fixes, wrong, strict=True) if not bad])
    assert ate_m(result.trajectory, log.truth) < 1.2 * ate_m(only_good.trajectory, log.truth)


def test_fixes_in_the_world_are_where_the_antenna_was() -> None:
    """Those that were believed are as far from the antenna's estimated path as the residual says; others are 50 m."""
    log = driven(5, 80.0, Receiver(2.0, 1.0, outliers=0.2))
    known = gnss.positions(log.fixes, UNKNOWN_ANTENNA, Findings())
    result = log.solved()
    assert known is not None
    assert result.georeference is not None
    placed = result.georeference.in_world(known, result.trajectory.stamps_ns)
    assert_array_equal(placed.used, result.georeference.used)
    path_m = result.trajectory.at(placed.stamps_ns).apply(result.georeference.antenna_m)
    distance_m = np.linalg.norm(placed.places_m - path_m, axis=1)
    assert_allclose(np.sqrt(np.mean(distance_m[placed.used] ** 2)), result.georeference.residual_rms_m, rtol=0.05)
    assert not placed.used.all()
    assert_allclose(distance_m[~placed.used], 50.0, atol=6.0)


def test_a_receiver_that_hangs_is_not_believed() -> None:
    """It repeats a position for 20 of 80 s; the ATE stays below that of the raw chain."""
    log = driven(6, 80.0, Receiver(2.0, 1.0))
    stuck = log.fixes[15]
    fixes = [replace(stuck, stamp_ns=fix.stamp_ns) if 15 < i <= 25 else fix for i, fix in enumerate(log.fixes)]
    result = log.solved(fixes=fixes)
    assert result.georeference is not None
    assert not result.georeference.used[18:26].any()
    assert ate_m(result.trajectory, log.truth) < ate_m(chain(log.pairs), log.truth)


def test_an_imu_tells_the_local_frame_which_way_is_down() -> None:
    """On a way that is nearly straight: tilt to 0.6 degrees, and a third of the sigma that fixes alone leave it."""
    log = driven(7, 40.0, Receiver(2.0, 1.0), DriveStyle(yaw_rate=0.05, slope=0.0))
    config, findings = RunConfig(backend="posegraph"), Findings()
    calibration = imu.calibrate(log.pairs, log.imu, ROTATION_IMU_CAMERA_KITTI, None)
    known = fusing.measurements(log.pairs, log.imu, calibration, log.poses.stamps_ns, findings)
    with_imu = fusing.fuse(replace(known, gnss=positions(*log.fixes)), config, findings)["posegraph"].georeference
    without = log.solved().georeference
    assert with_imu is not None
    assert without is not None
    true = log.truth_about(with_imu.origin)
    up = with_imu.T_enu_world[:3, :3] @ true[:3, :3].T @ [0.0, 0.0, 1.0]
    assert np.rad2deg(np.arccos(up[2])) < 0.6
    sigmas = [np.sqrt(np.linalg.eigvalsh(each.covariance[:3, :3])[-1]) for each in (with_imu, without)]
    assert sigmas[0] < sigmas[1] / 3
    assert nees(with_imu, true) < chi2.isf(1e-4, 6)


def test_without_an_imu_the_roll_about_a_line_is_said_to_be_a_guess() -> None:
    log = driven(7, 30.0, Receiver(2.0, 1.0), DriveStyle(yaw_rate=0.01, slope=0.0))
    result = log.solved()
    assert "its roll is a guess" in result.note
    assert result.georeference is not None
    assert nees(result.georeference, log.truth_about(result.georeference.origin)) < chi2.isf(1e-4, 6)


@pytest.mark.parametrize(("count", "metres"), [(2, 300.0), (20, 0.5)])
def test_fixes_that_tell_no_direction_are_left_out_and_the_note_says_so(count: int, metres: float) -> None:
    log = driven(8, 20.0)
    stamps_ns = log.poses.stamps_ns[:: len(log.poses) // count][:count]
    enu_m = np.linspace([0.0, 0.0, 0.0], [metres, 0.0, 0.0], count)
    fixes = [replace(fix, covariance=np.eye(3)) for fix in fixes_at(stamps_ns, enu_m, ORIGIN)]
    scaled = [replace(pair, translation=pair.translation * (1e-3 if metres < 1 else 1.0)) for pair in log.pairs]
    known = gnss.positions(fixes, GnssConfig(), Findings())
    result = posegraph.solve(Measurements(scaled, gnss=known), CONFIG)
    assert result.georeference is None
    assert "GNSS left out" in result.note
    assert_allclose(result.trajectory.poses.as_matrix(), chain(scaled).poses.as_matrix(), atol=1e-6)


def test_fixes_outside_of_the_trajectory_are_not_used() -> None:
    log = driven(9, 40.0)
    early = [replace(fix, stamp_ns=fix.stamp_ns - 60 * NANOSECONDS) for fix in log.fixes]
    result = log.solved(fixes=[*early, *log.fixes])
    assert result.georeference is not None
    assert len(result.georeference.used) == len(log.fixes)


def test_from_python() -> None:
    log = driven(10, 40.0)
    config = RunConfig(gnss=GnssConfig(antenna=tuple(ANTENNA)))
    fused = fusion.fuse(log.pairs, gnss=log.fixes, config=config)
    assert ate_m(fused, log.truth) < ate_m(fusion.fuse(log.pairs, backend="raw"), log.truth)
