"""The filter's mathematics is right to first order, its covariance is honest, and bad input does not lead it astray."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import RigidTransform, Rotation
from scipy.stats import chi2

from benchmarks.drives import EKF, PAIR_SIGMA, Drive, simulate
from fusion import ekf
from fusion.chain import ImuWindow, chain, motions_of
from fusion.ekf import (
    DIMENSION,
    Filter,
    Measurement,
    State,
    inject,
    propagate,
    reset_jacobian,
    shown_jacobian,
    world_jacobian,
)
from fusion.evaluation import pose_errors
from fusion.imu import ImuCalibration
from fusion.measurements import Estimate, Measurements, Mounting
from fusion.pair_model import difference
from fusion_io.records import NANOSECONDS, FloatArray, ImuSeries, PairEstimate, Trajectory

STEP = 1e-5  # of central differences, whose error is its square
EXACT = EKF.model_copy(  # what an IMU and a front end without errors are
    update={
        name: 1e-9
        for name in ("gyro_noise", "accelerometer_noise", "gyro_bias_walk", "accelerometer_bias_walk")
        + ("gyro_bias_sigma", "accelerometer_bias_sigma", "pair_scale_sigma", "pair_rate_bias_sigma")
        + ("pair_misalignment_sigma", "lever_arm_sigma", "mounting_sigma", "time_offset_sigma")
    }
)


@cache
def _drive() -> Drive:
    return simulate(0, 12.0, EKF)


def _solve(drive: Drive, pairs: Sequence[PairEstimate] | None = None, imu: ImuSeries | None = None) -> Estimate:
    """The filter's estimate, with other pairs or another IMU than those of the drive."""
    known = drive.measurements
    return ekf.solve(replace(known, steps=pairs or known.steps, imu=imu or known.imu), EKF)


def _without_imu(drive: Drive) -> Measurements:
    return Measurements(drive.measurements.steps, skips=drive.measurements.skips)


def _distance_m(one: Trajectory, other: Trajectory) -> float:
    """Between the last positions."""
    return float(np.linalg.norm(one.poses.translation[-1] - other.poses.translation[-1]))


def _squared(error: FloatArray, covariance: FloatArray) -> float:
    return float(error @ np.linalg.solve(covariance, error))


# -------------------------------------------------------------------------------------------- Jacobians


def _transform(rng: np.random.Generator) -> FloatArray:
    return np.asarray(RigidTransform.from_exp_coords(rng.normal(size=6)).as_matrix())


def _random_state(rng: np.random.Generator, ahead_s: float = 0.0) -> State:
    R, Q = Rotation.from_rotvec(rng.normal(size=(2, 3))).as_matrix()
    p, v, rate = rng.normal(size=(3, 3))
    biases, front_end = 0.1 * rng.normal(size=(2, 3)), 0.1 * rng.normal(size=4)
    extrinsics = _transform(rng), ahead_s, 0.2 * rng.normal(size=3)
    clones = np.stack([_transform(rng), _transform(rng)])
    return State(R, p, v, rate, *biases, Q, front_end, *extrinsics, clones, rng.normal(size=(2, 6)))


def _random_window(rng: np.random.Generator, pieces: int) -> ImuWindow:
    return ImuWindow(rng.uniform(0.005, 0.2, pieces), *rng.normal(size=(2, pieces, 3)) * [[[2.0]], [[10.0]]])


def _turned(R: FloatArray, other: FloatArray) -> FloatArray:
    return np.asarray(Rotation.from_matrix(R.T @ other).as_rotvec())


def _error(state: State, other: State) -> FloatArray:
    """The error (43,) that takes one nominal state to another: the inverse of `inject`, written out by itself."""
    mounted = state.T_camera_imu, other.T_camera_imu
    clones = zip(state.clones, other.clones, strict=True)
    return np.concatenate(
        [
            _turned(state.R, other.R),
            other.p - state.p,
            other.v - state.v,
            other.gyro_bias - state.gyro_bias,
            other.accelerometer_bias - state.accelerometer_bias,
            _turned(state.Q, other.Q)[:2],
            other.front_end - state.front_end,
            _turned(mounted[0][:3, :3], mounted[1][:3, :3]),
            mounted[0][:3, :3].T @ (mounted[1][:3, 3] - mounted[0][:3, 3]),
            [other.ahead_s - state.ahead_s],
            other.misalignment - state.misalignment,
            *(part for a, b in clones for part in (_turned(a[:3, :3], b[:3, :3]), b[:3, 3] - a[:3, 3])),
        ]
    )


def test_an_error_is_what_injecting_it_makes() -> None:
    rng = np.random.default_rng(0)
    state, error = _random_state(rng), 0.3 * rng.normal(size=DIMENSION)
    error[ekf.GRAVITY_DIRECTION] *= 1e-6  # whose third component is not an error
    assert_allclose(_error(state, inject(state, error)), error, atol=1e-12)


@pytest.mark.parametrize("pieces", [1, 4])
def test_the_jacobian_of_the_prediction_equals_finite_differences(pieces: int) -> None:
    """Of biases and gravity too; over one piece, and over several whose Jacobians multiply."""
    rng = np.random.default_rng(pieces)
    state, window = _random_state(rng), _random_window(rng, pieces)
    moved, jacobians, _ = propagate(state, window)
    product = np.linalg.multi_dot([np.eye(DIMENSION), *jacobians[::-1], np.eye(DIMENSION)])
    for k, direction in enumerate(STEP * np.eye(DIMENSION)):
        ends = [propagate(inject(state, sign * direction), window)[0] for sign in (1, -1)]
        numeric = (_error(moved, ends[0]) - _error(moved, ends[1])) / (2 * STEP)
        assert_allclose(product[:, k], numeric, atol=1e-7)


@pytest.mark.parametrize("since", [0, 1])
@pytest.mark.parametrize("seed", range(3))
def test_the_jacobian_of_the_measurement_equals_finite_differences(seed: int, since: int) -> None:
    """At a clock that is right, and, with twists that are taken as known, at one that is not."""
    rng = np.random.default_rng(seed)
    state = _random_state(rng)
    pair = Measurement(np.eye(4), np.eye(6), 0.4, since)
    shown = state.shown(pair)
    H = shown_jacobian(state, shown, since)
    for k, direction in enumerate(STEP * np.eye(DIMENSION)):
        ends = [inject(state, sign * direction).shown(pair).motion for sign in (1, -1)]
        numeric = (difference(shown.motion, ends[0]) - difference(shown.motion, ends[1]))[0] / (2 * STEP)
        assert_allclose(H[:, k], numeric, atol=1e-7 if k not in range(*ekf.TIME_OFFSET.indices(99)) else 1e-5)


def _turn_of_the_world(state: State) -> FloatArray:
    """(43, 3): the errors that turn everything about the axes of the world."""
    errors = np.zeros((DIMENSION, 3))
    errors[ekf.ATTITUDE], errors[ekf.POSITION] = state.R.T, -ekf.skew(state.p)
    errors[ekf.GRAVITY_DIRECTION] = state.Q.T[:2]
    for clone, attitude, position in zip(state.clones, ekf.CLONE_ATTITUDE, ekf.CLONE_POSITION, strict=True):
        errors[attitude], errors[position] = clone[:3, :3].T, -ekf.skew(clone[:3, 3])
    return errors


@pytest.mark.parametrize("velocity", [0.0, 10.0])
def test_no_measurement_feels_a_turn_of_the_world(velocity: float) -> None:
    """Neither prediction nor pair, and what is felt does not depend on the velocity, which updates change."""
    rng = np.random.default_rng(5)
    state = replace(_random_state(rng), v=velocity * rng.normal(size=3))
    moved, (jacobian,), _ = propagate(state, _random_window(rng, 1))
    assert_allclose(jacobian @ _turn_of_the_world(state), _turn_of_the_world(moved), atol=1e-12)
    for since in (0, 1):
        shown = moved.shown(Measurement(np.eye(4), np.eye(6), 0.1, since))
        assert_allclose(shown_jacobian(moved, shown, since) @ _turn_of_the_world(moved), 0.0, atol=1e-10)
    assert not np.any(_turn_of_the_world(state)[ekf.VELOCITY])


@pytest.mark.parametrize("since", [0, 1])
def test_errors_of_the_world_move_all_poses_alike(since: int) -> None:
    """One of the clones by what is asked for, the others with it, so that no pair feels it."""
    state = _random_state(np.random.default_rng(6))
    errors = world_jacobian(state, since)
    clone = np.r_[ekf.CLONE_ATTITUDE[since], ekf.CLONE_POSITION[since]]
    assert_allclose(errors[clone], np.eye(6), atol=1e-12)
    for error in STEP * errors.T:
        ends = [inject(state, sign * error) for sign in (1, -1)]
        of_world = [end.pose @ np.linalg.inv(state.pose) for end in ends]
        for k in (0, 1):
            moved = [end.clones[k] @ np.linalg.inv(state.clones[k]) for end in ends]
            assert_allclose((moved[0] - moved[1]) / (2 * STEP), (of_world[0] - of_world[1]) / (2 * STEP), atol=1e-8)


@pytest.mark.parametrize("size", [0.2, 1e-5])
def test_the_jacobian_of_the_reset_equals_finite_differences(size: float) -> None:
    """What is left of an error near `error`, about the state into which `error` was moved."""
    rng = np.random.default_rng(0)
    state, error = _random_state(rng), size * rng.normal(size=DIMENSION)
    reset = inject(state, error)
    G = reset_jacobian(error)
    for k, direction in enumerate(STEP * np.eye(DIMENSION)):
        ends = [inject(state, error + sign * direction) for sign in (1, -1)]
        numeric = (_error(reset, ends[0]) - _error(reset, ends[1])) / (2 * STEP)
        assert_allclose(G[:, k], numeric, atol=1e-7)


# -------------------------------------------------------------------------------------------- covariance


def _filter(mounting: Mounting | None = None) -> Filter:
    twist = _drive().measurements.steps[0].T_source_target.as_exp_coords() * 10
    return Filter(EKF, _drive().measurements.calibration, mounting, EKF.front_end_sigma([]), twist)


class WithTrail(Filter):
    """A filter with the past as a state of the whole: matrices (52, 52), no shortcuts, a gain of zero for it."""

    def __init__(self, *arguments: object) -> None:
        super().__init__(*arguments)  # type: ignore[arg-type]
        at_first = np.zeros((52, DIMENSION))
        at_first[:43], at_first[43:46] = np.eye(DIMENSION), np.eye(DIMENSION)[ekf.POSITION]
        self.joint = at_first @ self.kf.P @ at_first.T
        self.noise = np.zeros((0, 0))
        predict = self.kf.predict

        def both() -> None:
            F, Q = np.eye(52), np.zeros((52, 52))
            F[:43, :43], Q[:43, :43] = self.kf.F, self.kf.Q
            self.joint = F @ self.joint @ F.T + Q
            predict()

        self.kf.predict = both

    def update(self, measured: Measurement) -> None:
        self.noise = measured.covariance
        super().update(measured)

    def stand_still(self) -> None:
        self.noise = ekf.STILL_SIGMA**2 * np.eye(3)
        super().stand_still()

    def _move_error(self, H: FloatArray) -> None:
        gain = np.vstack([self.kf.K, np.zeros((9, len(H)))])
        left = np.eye(52) - gain @ np.hstack([H, np.zeros((len(H), 9))])
        reset = np.eye(52)
        reset[:43, :43] = reset_jacobian(self.kf.x)
        self.joint = reset @ (left @ self.joint @ left.T + gain @ self.noise @ gain.T) @ reset.T
        super()._move_error(H)

    def _renew_velocity(self, variance: float) -> None:
        self.joint[ekf.VELOCITY], self.joint[:, ekf.VELOCITY] = 0.0, 0.0
        self.joint[ekf.VELOCITY, ekf.VELOCITY] = variance * np.eye(3)
        super()._renew_velocity(variance)

    def _look_down(self, window: ImuWindow) -> None:
        super()._look_down(window)
        taken = np.eye(52)
        taken[ekf.GRAVITY_DIRECTION] = 0.0
        taken[ekf.GRAVITY_DIRECTION, ekf.ATTITUDE] = (self.state.Q.T @ self.state.R)[:2]
        self.joint = taken @ self.joint @ taken.T
        self.joint[ekf.GRAVITY_DIRECTION, ekf.GRAVITY_DIRECTION] += self.config.gravity_sigma**2 * np.eye(2)

    def clone(self) -> None:
        copy, same = np.eye(52), np.eye(52)
        copy[43:46] += same[ekf.CLONE_POSITION[0]] - same[ekf.CLONE_POSITION[1]]
        for (new, old), present in (
            (ekf.CLONE_ATTITUDE, ekf.ATTITUDE),
            (ekf.CLONE_POSITION, ekf.POSITION),
        ):
            copy[new], copy[old] = same[present], same[new]
        self.joint = copy @ self.joint @ copy.T
        super().clone()

    def keep(self) -> None:
        _, by_state, by_past = self._camera()
        become = np.eye(52)
        become[46:] = np.hstack([by_state, by_past[:, :9]])
        self.joint = become @ self.joint @ become.T
        super().keep()


def test_the_covariance_of_the_past_is_that_of_explicit_schmidt_states(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of trail and keyframe, over a drive that has a hole in the IMU, a wild pair, a stand-still, and skips."""
    filters: list[WithTrail] = []
    monkeypatch.setattr(ekf, "Filter", lambda *arguments: filters.append(WithTrail(*arguments)) or filters[-1])
    monkeypatch.setattr(ekf, "standing_still", lambda steps, *_: np.arange(len(steps)) // 10 == 3)
    monkeypatch.setattr(ekf, "STILL_SIGMA", 10.0)  # for it does not stand
    drive = simulate(0, 12.0, EKF, skipping=True)
    pairs = [_wild(pair) if k == 15 else pair for k, pair in enumerate(drive.measurements.steps[:45])]
    result = _solve(drive, pairs, _without(drive, 2.0, 2.5))
    assert result.rejected == 1
    assert "predicted by the IMU on 38 of 45 steps" in result.note  # of which the first has no frame before the last
    assert "44 pairs that skip" in result.note
    (found,) = filters
    assert_allclose(found.kf.P, found.joint[:43, :43], rtol=1e-6, atol=1e-12)
    assert_allclose(found.past_cross[:9], found.joint[43:, :43], rtol=1e-6, atol=1e-12)
    assert not np.any(found.past_covariance[ekf.TURN])  # no direction was lost
    assert_allclose(found.past_covariance[:9, :9], found.joint[43:, 43:], rtol=1e-6, atol=1e-12)
    assert not np.allclose(
        found.past_covariance[ekf.TRAIL, ekf.TRAIL], found.kf.P[ekf.POSITION, ekf.POSITION], rtol=0.05
    )


@pytest.mark.parametrize("with_imu", [True, False])
def test_a_wild_pair_that_skips_a_frame_is_left_out(with_imu: bool) -> None:
    drive = simulate(0, 6.0, EKF, skipping=True)
    known = drive.measurements if with_imu else _without_imu(drive)
    without = ekf.solve(replace(known, skips=[each for k, each in enumerate(known.skips) if k != 20]), EKF)
    wild = ekf.solve(
        replace(known, skips=[_wild(each) if k == 20 else each for k, each in enumerate(known.skips)]), EKF
    )
    assert (without.rejected, wild.rejected) == (0, 1)
    assert_array_equal(wild.trajectory.poses.as_matrix(), without.trajectory.poses.as_matrix())


def test_where_the_first_camera_is_the_world_it_is_so_for_any_mounting() -> None:
    """Its pose and the covariance of it are zero, whatever strays: F, the clock, both."""
    rng = np.random.default_rng(0)
    root = 0.1 * rng.normal(size=(10, 10))
    mounting = Mounting(_transform(rng), 0.05, 0.1 * rng.normal(size=3), root @ root.T, np.zeros(3), np.ones(3))
    for filter_ in (_filter(), _filter(mounting)):
        pose, covariance = (part[-6:, -6:] if len(part) == 12 else part for part in filter_.odometry())
        assert_allclose(pose, np.eye(4), atol=1e-12)
        assert_allclose(covariance, 0.0, atol=1e-12)
        extrinsics = np.zeros(DIMENSION)
        extrinsics[ekf.EXTRINSICS] = 1e-6 * rng.normal(size=7)
        # An error of the mounting, and what the covariance says goes with it, leave the camera where it is.
        P = filter_.kf.P
        with_it = P[:, ekf.EXTRINSICS] @ np.linalg.solve(P[ekf.EXTRINSICS, ekf.EXTRINSICS], extrinsics[ekf.EXTRINSICS])
        moved = inject(filter_.state, with_it)
        camera, *_ = ekf.camera(moved.pose[None], moved.T_camera_imu, filter_.state.clone_twists[:1], moved.ahead_s)
        assert_allclose(camera[0], np.eye(4), atol=1e-10)


def test_the_update_is_that_of_the_textbook() -> None:
    """Without prediction: the posterior of two Gaussians in information form, its mean moved into the state."""
    rng = np.random.default_rng(7)
    filter_ = _filter()
    filter_.kf.P = np.diag(rng.uniform(0.5, 1.0, DIMENSION)) * 1e-8
    covariance = 1e-8 * np.diag(rng.uniform(0.5, 1.0, 6))
    motion = RigidTransform.from_exp_coords(1e-4 * rng.normal(size=6)).as_matrix()
    pair = Measurement(motion, covariance, 0.1)
    H = shown_jacobian(filter_.state, filter_.state.shown(pair), 0)
    expected = np.linalg.inv(np.linalg.inv(filter_.kf.P) + H.T @ np.linalg.solve(covariance, H))
    moved = expected @ H.T @ np.linalg.solve(covariance, difference(np.eye(4)[None], motion[None])[0])
    before = filter_.state
    filter_.update(pair)
    assert_allclose(filter_.kf.P, expected, rtol=1e-3, atol=1e-12)
    assert_allclose(_error(before, filter_.state), moved, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("with_imu", [True, False])
def test_covariances_are_covariances(with_imu: bool) -> None:
    """Symmetric, definite after the first pose, which is the world; they begin as that of a pair, and grow."""
    drive = _drive()
    covariances = ekf.solve(drive.measurements if with_imu else _without_imu(drive), EKF).trajectory.covariances
    assert covariances is not None
    assert_allclose(covariances[0], 0.0, atol=1e-12)
    assert_allclose(covariances, covariances.swapaxes(1, 2), atol=1e-12)
    assert np.all(np.linalg.eigvalsh(covariances[1:]) > 0.0)
    sigma = np.sqrt(np.abs(np.diagonal(covariances, axis1=1, axis2=2)))
    assert np.all(sigma[1] < 1.5 * PAIR_SIGMA)
    assert np.all(sigma[1, 3:] > 0.5 * PAIR_SIGMA[3:])
    rough = np.linalg.norm(sigma[10::10, 3:], axis=1)
    assert np.all(np.diff(rough) > 0.0)


def test_doubt_about_the_mounting_shows_in_the_trajectory_and_certainty_stays() -> None:
    """A mounting that a back end has refined is where the filter begins, with its covariance."""
    drive = _drive()
    assert drive.measurements.calibration is not None

    def filtered(sigma: float) -> Estimate:
        covariance, bias = sigma**2 * np.eye(10), drive.measurements.calibration.gyro_bias
        mounting = Mounting(
            drive.T_camera_imu, drive.ahead_s, drive.misalignment, covariance, bias, np.full(3, EKF.gyro_bias_sigma)
        )
        return ekf.solve(replace(drive.measurements, mounting=mounting), EKF)

    sure, doubtful = filtered(1e-7), filtered(0.02)
    assert sure.mounting is not None
    assert_allclose(sure.mounting.T_camera_imu, drive.T_camera_imu, atol=1e-6)
    assert_allclose(sure.mounting.ahead_s, drive.ahead_s, atol=1e-6)
    traces = [np.trace(each.trajectory.covariances[-1, :3, :3]) for each in (sure, doubtful)]
    assert traces[1] > 1.2 * traces[0]


# -------------------------------------------------------------------------------------------- what it estimates


def test_the_prediction_is_dead_reckoning() -> None:
    """An IMU that circles at a constant speed, known in closed form, over one turn in 10 s."""
    radius, rate, count = 20.0, 2 * np.pi / 10, 1000
    ones = np.ones(count)
    gravity = np.array([0.0, ekf.GRAVITY, 0.0])  # down is y
    force = np.array([rate**2 * radius, 0.0, 0.0]) - gravity  # to the right, where the centre is
    window = ImuWindow(0.01 * ones, np.outer(ones, [0.0, rate, 0.0]), np.outer(ones, force))
    down = Rotation.align_vectors(gravity[None], [[0.0, 0.0, 1.0]])[0].as_matrix()
    v = np.array([0.0, 0.0, rate * radius])
    start = replace(_filter().state, R=np.eye(3), p=np.zeros(3), v=v, gyro_bias=np.zeros(3), Q=down)
    for pieces in (250, 500, 1000):
        angle = rate * pieces / 100
        end, *_ = propagate(start, ImuWindow(*(values[:pieces] for values in window)))
        assert_allclose(end.R, Rotation.from_rotvec([0.0, angle, 0.0]).as_matrix(), atol=1e-12)
        assert_allclose(end.p, radius * np.array([1 - np.cos(angle), 0.0, np.sin(angle)]), atol=1e-3)


def test_exact_measurements_give_the_exact_trajectory() -> None:
    drive = simulate(1, 8.0, EXACT, sigma=np.full(6, 1e-9))
    pairs = [replace(pair, covariance=np.diag(PAIR_SIGMA**2)) for pair in drive.measurements.steps]
    result = ekf.solve(replace(drive.measurements, steps=pairs), EXACT)
    assert result.rejected == 0
    position, orientation = pose_errors(result.trajectory.poses, drive.truth.poses)
    assert np.max(np.abs(position)) < 0.02
    assert np.max(np.abs(orientation)) < 1e-4


def test_the_imu_makes_orientations_better() -> None:
    """All along the drive."""
    drive = _drive()
    _, fused = pose_errors(_solve(drive).trajectory.poses, drive.truth.poses)
    _, raw = pose_errors(chain(drive.measurements.steps).poses, drive.truth.poses)
    assert np.linalg.norm(fused) < 0.7 * np.linalg.norm(raw)


def test_while_it_stands_the_position_stays_and_the_bias_of_the_gyro_is_found() -> None:
    """A quarter of a minute, camera tilted, a cheap gyro: its bias to 2 mrad/s, the position within 5 cm."""
    rng, frames, frame_ns = np.random.default_rng(4), 150, NANOSECONDS // 10
    bias, up = np.array([0.03, -0.02, 0.015]), Rotation.from_rotvec([0.2, 0.0, -0.1]).apply([0.0, -ekf.GRAVITY, 0.0])
    stamps = np.arange(-10, 10 * frames + 10) * (NANOSECONDS // 100)
    shaken = 0.01 * rng.standard_normal((len(stamps), 3))
    imu = ImuSeries(stamps, bias + 0.1 * shaken, up + shaken)
    motions = RigidTransform.from_exp_coords(rng.standard_normal((frames, 6)) * np.repeat([1e-3, 2e-3], 3))
    quats = motions.rotation.as_quat(scalar_first=True)
    pairs = [
        PairEstimate(k * frame_ns, (k + 1) * frame_ns, quats[k], motions.translation[k], np.diag(PAIR_SIGMA**2))
        for k in range(frames)
    ]
    roughly = ImuCalibration(Rotation.identity(), 0.0, bias + 5e-3, used=True, reason="", gyro_bias_std=5e-3)
    result = ekf.solve(Measurements(pairs, imu, roughly), EKF)
    assert result.series is not None
    assert_allclose(result.series.gyro_bias[-1], bias, atol=2e-3)
    position = result.trajectory.poses.translation
    assert np.max(np.linalg.norm(position, axis=1)) < 0.05
    covariances = result.trajectory.covariances
    assert covariances is not None
    assert np.all(np.abs(position[-1]) < 4 * np.sqrt(np.diagonal(covariances[-1]))[3:])


@settings(max_examples=3, deadline=None)
@given(st.tuples(*3 * [st.floats(-1.5, 1.5)]))
def test_it_does_not_matter_how_the_axes_of_the_camera_lie(turn: tuple[float, float, float]) -> None:
    """Equivariance: in axes turned by C, every pose T becomes C^-1 T C, for noise that prefers no direction."""
    C, known = Rotation.from_rotvec(turn), _drive().measurements
    assert known.calibration is not None
    basis = RigidTransform.from_rotation(C)
    motions = basis.inv() * motions_of(known.steps[:30]) * basis
    quats = motions.rotation.as_quat(scalar_first=True)
    turned = [
        replace(pair, quat_wxyz=quats[k], translation=motions.translation[k]) for k, pair in enumerate(known.steps[:30])
    ]
    calibration = replace(known.calibration, rotation_imu_camera=known.calibration.mounting * C)
    expected = basis.inv() * ekf.solve(replace(known, steps=known.steps[:30]), EKF).trajectory.poses * basis
    found = ekf.solve(replace(known, steps=turned, calibration=calibration), EKF).trajectory.poses
    assert_allclose(found.as_matrix(), expected.as_matrix(), atol=1e-6)


def test_the_rate_bias_of_the_pairs_is_told_from_a_gyro_without_one() -> None:
    """Pairs that turn 5 mrad/s more: the trajectory turns by a tenth of that at most."""
    known = _drive().measurements
    config = EKF.model_copy(update={"gyro_bias_sigma": 2e-4})
    excess = Rotation.from_rotvec([0.0, 5e-4, 0.0])
    pairs = [
        replace(pair, quat_wxyz=(pair.T_source_target.rotation * excess).as_quat(scalar_first=True))
        for pair in known.steps
    ]
    before, after = (ekf.solve(replace(known, steps=steps), config).trajectory for steps in (known.steps, pairs))
    moved = (before.poses.rotation[-1].inv() * after.poses.rotation[-1]).magnitude()
    assert moved < 0.1 * 5e-3 * 12


# -------------------------------------------------------------------------------------------- faults


def _wild(pair: PairEstimate) -> PairEstimate:
    """3 m and 17 deg off."""
    rotation = pair.T_source_target.rotation * Rotation.from_rotvec([0.0, 0.3, 0.0])
    return replace(pair, quat_wxyz=rotation.as_quat(scalar_first=True), translation=pair.translation + [3.0, 0.0, 0.0])


def _without(drive: Drive, start_s: float, end_s: float) -> ImuSeries:
    imu = drive.measurements.imu
    assert imu is not None
    seconds = imu.stamps_ns / NANOSECONDS
    keep = (seconds < start_s) | (seconds > end_s)
    return ImuSeries(imu.stamps_ns[keep], imu.angular_velocity[keep], imu.linear_acceleration[keep])


def test_a_wild_pair_is_rejected_and_counted() -> None:
    """The trajectory keeps within half a metre of what it is without the fault."""
    drive = _drive()
    known = drive.measurements
    wild = [_wild(pair) if k == 60 else pair for k, pair in enumerate(known.steps)]
    before, after = ekf.solve(known, EKF), ekf.solve(replace(known, steps=wild), EKF)
    assert (before.rejected, after.rejected) == (0, 1)
    assert after.series is not None
    assert after.series.nis[61] > chi2.isf(EKF.gate_probability, 6)
    assert_array_equal(np.flatnonzero(~after.series.used), [61])
    assert _distance_m(before.trajectory, after.trajectory) < 0.5


def test_when_the_imu_goes_mad_the_pairs_are_believed() -> None:
    """Rates of 0.5 rad/s that are not there: a few pairs are rejected, then the trajectory keeps to the pairs'."""
    drive = _drive()
    imu = drive.measurements.imu
    assert imu is not None
    mad = imu.stamps_ns > 6 * NANOSECONDS
    imu = replace(imu, angular_velocity=imu.angular_velocity + np.outer(mad, [0.0, 0.0, 0.5]))
    result = _solve(drive, imu=imu)
    assert EKF.max_rejected_in_a_row <= result.rejected <= 2 * EKF.max_rejected_in_a_row
    motions = [trajectory.poses[-40].inv() * trajectory.poses[-1] for trajectory in (result.trajectory, drive.truth)]
    difference = motions[0].inv() * motions[1]
    assert np.linalg.norm(difference.translation) < 1.5
    assert difference.rotation.magnitude() < 0.05


def test_when_a_prediction_is_given_up_nothing_of_it_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    """The trail's covariance goes on from before the prediction, as that of the state does."""
    given_up: list[tuple[FloatArray, FloatArray]] = []
    predict, forget = Filter.predict, Filter.forget_velocity

    def remember(self: Filter, window: ImuWindow | None, seconds: float) -> None:
        self.before = self.past_cross.copy()  # type: ignore[attr-defined]
        predict(self, window, seconds)

    def compare(self: Filter) -> None:
        given_up.append((self.before, self.past_cross.copy()))  # type: ignore[attr-defined]
        forget(self)

    monkeypatch.setattr(Filter, "predict", remember)
    monkeypatch.setattr(Filter, "forget_velocity", compare)
    drive = _drive()
    pairs = [_wild(pair) if k > 20 else pair for k, pair in enumerate(drive.measurements.steps[:40])]
    _solve(drive, pairs)
    assert given_up
    for before, restored in given_up:
        assert_array_equal(restored, before)


def test_without_an_imu_it_says_so_and_keeps_to_the_pairs() -> None:
    drive = _drive()
    result = ekf.solve(_without_imu(drive), EKF)
    assert result.note == "pairs only: no IMU"
    assert result.rejected == 0
    assert result.mounting is None
    raw = chain(drive.measurements.steps)
    assert_allclose(result.trajectory.poses.as_matrix(), raw.poses.as_matrix(), atol=1e-6)


def test_without_an_imu_pairs_that_skip_a_frame_are_what_a_trajectory_is_better_by() -> None:
    """Than the chain, over many drives, and as much as is said."""
    lasting = ("pair_scale_sigma", "pair_rate_bias_sigma", "pair_misalignment_sigma")
    model = EKF.model_copy(update=dict.fromkeys(lasting, 1e-9))
    chained, filtered, squares = [], [], []
    for seed in range(20):
        drive = simulate(seed, 6.0, model, skipping=True)
        found = ekf.solve(_without_imu(drive), model)
        assert found.note == "pairs only: no IMU; 59 pairs that skip a frame"
        for trajectory, errors in ((chain(drive.measurements.steps), chained), (found.trajectory, filtered)):
            position, orientation = pose_errors(trajectory.poses[-1:], drive.truth.poses[-1:])
            errors.append(np.concatenate([orientation[0] / PAIR_SIGMA[0], position[0] / PAIR_SIGMA[3]]))
        assert found.trajectory.covariances is not None
        squares.append(filtered[-1][:3] ** 2 @ (PAIR_SIGMA[0] ** 2 / np.diag(found.trajectory.covariances[-1])[:3]))
    assert np.sum(np.square(filtered)) < 0.8 * np.sum(np.square(chained))
    low, high = chi2.ppf([0.005, 0.995], 3 * len(squares))
    assert low < np.sum(squares) < high


def test_without_an_imu_motions_do_not_depend_on_how_uncertain_the_world_is() -> None:
    """The last motions of a drive of two minutes are those of a filter that begins a few seconds before its end."""
    drive = simulate(0, 120.0, EKF, skipping=True)
    steps = drive.measurements.steps[-50:]
    began = steps[0].source_stamp_ns
    late = Measurements(steps, skips=[each for each in drive.measurements.skips if each.source_stamp_ns >= began])

    def motions(known: Measurements) -> FloatArray:
        poses = ekf.solve(known, EKF).trajectory.poses[-40:]
        return np.asarray((poses[:-1].inv() * poses[1:]).as_matrix())

    off = np.abs(difference(motions(_without_imu(drive)), motions(late))) / PAIR_SIGMA
    assert np.max(off) < 0.05


def test_a_hole_in_the_imu_is_crossed_by_the_pairs() -> None:
    """Two seconds without samples: the note counts the steps, and the orientation is less certain after them."""
    drive = _drive()
    whole, holed = _solve(drive), _solve(drive, imu=_without(drive, 5.02, 7.02))
    assert holed.note.startswith("predicted by the IMU on 99 of 120 steps")
    assert holed.rejected == 0
    traces = [np.trace(each.trajectory.covariances[75, :3, :3]) for each in (whole, holed)]
    assert traces[1] > 1.2 * traces[0]
    position, _ = pose_errors(holed.trajectory.poses[-1:], drive.truth.poses[-1:])
    assert holed.trajectory.covariances is not None
    assert _squared(position[0], holed.trajectory.covariances[-1][3:, 3:]) < chi2.isf(1e-3, 3)


def test_a_hole_in_the_pairs_is_crossed_by_the_imu() -> None:
    """One second without frames is one long step whose pair says next to nothing: dead reckoning to decimetres."""
    drive = _drive()
    steps = drive.measurements.steps
    unknown = replace(steps[50], target_stamp_ns=steps[60].source_stamp_ns, covariance=np.eye(6))
    result = _solve(drive, [*steps[:50], unknown, *steps[60:]])
    assert result.rejected == 0
    crossed = result.trajectory.poses[50].inv() * result.trajectory.poses[51]
    true = drive.truth.poses[50].inv() * drive.truth.poses[60]
    assert np.linalg.norm((crossed.inv() * true).translation) < 0.6
    assert (crossed.inv() * true).rotation.magnitude() < 0.01


@pytest.mark.parametrize("off_rad", [0.0, 1.0, 2.5])
def test_after_a_hole_in_everything_the_direction_is_lost_and_what_follows_is_honest(off_rad: float) -> None:
    """Three seconds that nothing measured, bridged by a motion that is off: errors stay within their covariances.

    Those of positions as far as first order reaches. What is measured afterwards is known as well as ever.
    """
    drive = _drive()
    steps, true = drive.measurements.steps, drive.truth.poses[40].inv() * drive.truth.poses[70]
    motion = true * RigidTransform.from_exp_coords(np.array([0.3, 0.9, -0.3, 3.0, 1.0, -2.0]) * off_rad)
    unknown = replace(
        steps[40],
        target_stamp_ns=steps[69].target_stamp_ns,
        quat_wxyz=motion.rotation.as_quat(scalar_first=True),
        translation=motion.translation,
        covariance=np.diag(np.repeat([25.0, 100.0], 3)),
    )
    found = _solve(drive, [*steps[:40], unknown, *steps[70:]], _without(drive, 3.99, 7.01)).trajectory
    assert found.covariances is not None
    after, truth = found.poses[41:], drive.truth.poses[70:]
    errors = pose_errors(after, truth)
    for error, part in zip(errors, (slice(3, 6), slice(0, 3)), strict=True):
        squares = [_squared(*each) for each in zip(error, found.covariances[41:, part, part], strict=True)]
        assert max(squares) < chi2.isf(1e-3, 3) or (off_rad > 2.0 and part.start == 3)
    assert np.min(np.linalg.eigvalsh(found.covariances[41:, :3, :3])) > 0.9 * ekf.UNKNOWN_TURN**2
    whole = _solve(drive).trajectory.poses[70:]
    off, usual = ((each[0].inv() * each[-1]).inv() * truth[0].inv() * truth[-1] for each in (after, whole))
    assert np.linalg.norm(off.translation) < 1.2 * np.linalg.norm(usual.translation)
    assert off.rotation.magnitude() < 1.2 * usual.rotation.magnitude()


def test_what_a_lost_direction_does_to_a_pose_equals_finite_differences() -> None:
    """Losses one after the other: each turns what follows it about where it happened."""
    rng, lost, centres = np.random.default_rng(2), _filter(), 10.0 * np.random.default_rng(3).normal(size=(2, 3))
    lost.past_covariance[:] = 0.0
    for centre in centres:
        lost.trail = centre
        lost.lose_direction(Measurement(np.eye(4), 4.0 * np.eye(6), 1.0))
    lost.trail = 10.0 * rng.normal(size=3)
    T, _, by_past = lost._camera()
    by_turns = []
    for centre in centres:
        columns = []
        for axis in np.eye(3):
            turn = RigidTransform.from_rotation(Rotation.from_rotvec(STEP * axis))
            moved = RigidTransform.from_translation(centre) * turn * RigidTransform.from_translation(-centre)
            columns.append(
                (RigidTransform.from_matrix(T).inv() * moved * RigidTransform.from_matrix(T)).as_exp_coords()
            )
        by_turns.append(np.stack(columns, axis=1) / STEP)
    expected = sum(ekf.UNKNOWN_TURN**2 * J @ J.T for J in by_turns)
    assert_allclose(by_past @ lost.past_covariance @ by_past.T, expected, rtol=1e-4, atol=1e-3)


def test_the_same_input_gives_the_same_bits() -> None:
    drive = _drive()
    one, other = (_solve(drive, drive.measurements.steps[:40]) for _ in range(2))
    assert_array_equal(one.trajectory.poses.as_matrix(), other.trajectory.poses.as_matrix())
    assert_array_equal(one.trajectory.covariances, other.trajectory.covariances)


def test_a_loop_moves_the_present_and_what_was_before() -> None:
    """A loop from the truth: the end is where it says, hindsight moves the way there, the filter itself stays put."""
    drive = _drive()
    known, truth = drive.measurements, drive.truth
    motion = truth.poses[5].inv() * truth.poses[-1]
    sigma = np.array([1e-4, 1e-4, 1e-4, 1e-3, 1e-3, 1e-3])
    loop = PairEstimate(
        int(truth.stamps_ns[5]),
        int(truth.stamps_ns[-1]),
        motion.rotation.as_quat(scalar_first=True),
        motion.translation,
        np.diag(sigma**2),
    )
    before, after = (ekf.solve(replace(known, loops=loops), EKF) for loops in ([], [loop]))
    assert before.hindsight is None
    assert after.hindsight is not None
    assert after.loops_used.tolist() == [True]
    assert_array_equal(after.trajectory.poses[:-1].as_matrix(), before.trajectory.poses[:-1].as_matrix())
    assert _distance_m(after.trajectory, truth) < 0.2 * _distance_m(before.trajectory, truth)
    assert_allclose(after.hindsight.poses[-1].as_matrix(), after.trajectory.poses[-1].as_matrix(), atol=1e-9)
    errors = [
        np.linalg.norm(each.poses.translation - truth.poses.translation, axis=1).mean()
        for each in (before.trajectory, after.hindsight)
    ]
    assert errors[1] < errors[0]
