"""Chaining reproduces the motion with an honest covariance, and bridging invents as little as it can."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import RigidTransform, Rotation
from scipy.stats import chi2

from fusion.chain import ImuWindow, ImuWindows, adjoint, bridge_gaps, chain, mean_rates, motions_of
from fusion_io.errors import LogError
from fusion_io.records import NANOSECONDS, FloatArray, ImuSeries, PairEstimate

PERIOD_NS = NANOSECONDS // 10
START_NS = 1_300_000_000 * NANOSECONDS
TWIST = np.array([0.01, 0.15, -0.02, 0.1, -0.05, 9.0])  # rad/s, m/s
COVARIANCE = np.diag([0.001, 0.002, 0.001, 0.01, 0.01, 0.03]) ** 2


def _pair(source: int, target: int, twist: FloatArray = TWIST, covariance: FloatArray = COVARIANCE) -> PairEstimate:
    """The pair between two frames (numbers) of a motion with a constant twist (6,)."""
    motion = RigidTransform.from_exp_coords(twist * (target - source) / 10)
    quat_wxyz = motion.rotation.as_quat(scalar_first=True)
    start_ns, end_ns = (START_NS + PERIOD_NS * frame for frame in (source, target))
    return PairEstimate(start_ns, end_ns, quat_wxyz, motion.translation, covariance)


def _stamps(count: int) -> np.ndarray:
    return START_NS + PERIOD_NS * np.arange(count)


def _imu(angular_velocity: FloatArray, seconds: float, rate_hz: int = 100) -> ImuSeries:
    """A gyro at a constant rate with a live accelerometer, from a little before the first frame."""
    stamps = START_NS - 5_000_000 + np.arange(int(seconds * rate_hz) + 2) * (NANOSECONDS // rate_hz)
    noise = 1e-9 * np.random.default_rng(0).normal(size=(len(stamps), 3))
    return ImuSeries(stamps, angular_velocity + noise, np.array([0.0, -9.81, 0.0]) + noise)


def test_the_adjoint_moves_a_twist_through_a_transform() -> None:
    rng = np.random.default_rng(0)
    T = RigidTransform.from_exp_coords(rng.normal(size=(20, 6)))
    twists = rng.normal(size=(20, 6))
    moved = RigidTransform.from_exp_coords((adjoint(T) @ twists[:, :, None])[..., 0])
    assert_allclose((T * RigidTransform.from_exp_coords(twists) * T.inv()).as_matrix(), moved.as_matrix(), atol=1e-12)


def test_the_adjoint_is_the_derivative_of_conjugation() -> None:
    T = RigidTransform.from_exp_coords([0.3, -0.5, 0.2, 1.0, 2.0, 3.0])
    step = 1e-6
    columns = [
        ((T * RigidTransform.from_exp_coords(step * axis) * T.inv()).as_exp_coords()) / step for axis in np.eye(6)
    ]
    assert_allclose(np.stack(columns, axis=1), adjoint(T), atol=1e-5)


def test_chaining_the_motions_of_a_trajectory_gives_it_back() -> None:
    rng = np.random.default_rng(1)
    steps = [_pair(k, k + 1, TWIST + rng.normal(0.0, 0.5, 6)) for k in range(50)]
    trajectory = chain(steps)
    assert_array_equal(trajectory.stamps_ns, _stamps(51))
    assert_allclose(trajectory.poses[0].as_matrix(), np.eye(4), atol=0.0)
    motions = trajectory.poses[:-1].inv() * trajectory.poses[1:]
    assert_allclose(motions.as_matrix(), motions_of(steps).as_matrix(), atol=1e-12)


def test_the_propagated_covariance_is_that_of_many_noisy_chains() -> None:
    """Every element within 6 standard errors of the sample covariance, and NEES inside its 99.8 % bounds."""
    rng = np.random.default_rng(2)
    count, length = 4000, 30
    root = np.linalg.cholesky(COVARIANCE)
    motion = RigidTransform.from_exp_coords(TWIST / 10)
    ends = RigidTransform.identity(count)
    for _ in range(length):
        ends = ends * motion * RigidTransform.from_exp_coords(rng.normal(size=(count, 6)) @ root.T)
    trajectory = chain([_pair(k, k + 1) for k in range(length)])
    assert trajectory.covariances is not None
    errors = (trajectory.poses[-1].inv() * ends).as_exp_coords()

    P = trajectory.covariances[-1]
    standard_error = np.sqrt((P**2 + np.outer(np.diag(P), np.diag(P))) / count)
    assert np.max(abs(np.cov(errors.T) - P) / standard_error) < 6.0
    nees = np.sum(errors * np.linalg.solve(P, errors.T).T)
    lower, upper = chi2.ppf([0.001, 0.999], 6 * count)
    assert lower < nees < upper
    assert_allclose(trajectory.covariances[0], 0.0)


def test_steps_that_do_not_follow_each_other_are_refused() -> None:
    with pytest.raises(ValueError, match="no step from"):
        chain([_pair(0, 1), _pair(2, 3)])
    with pytest.raises(ValueError, match="no steps"):
        chain([])


def test_complete_pairs_are_the_steps_whatever_their_order_and_pairs_that_skip_frames_are_not() -> None:
    pairs = [_pair(k, k + 1) for k in range(20)]
    skipping = [_pair(k, k + 2, 2 * TWIST) for k in range(18)]
    shuffled = [(pairs + skipping)[k] for k in np.random.default_rng(3).permutation(38)]
    steps, holes = bridge_gaps(_stamps(21), shuffled, None)
    assert holes == 0
    assert len(steps) == 20
    assert all(step is pair for step, pair in zip(steps, pairs, strict=True))


@pytest.mark.parametrize("frames_in_the_hole", [True, False])
def test_a_hole_in_a_constant_motion_is_bridged_exactly_and_counted(frames_in_the_hole: bool) -> None:
    known = [*range(5), *range(8, 15)]
    stamps = _stamps(16) if frames_in_the_hole else np.delete(_stamps(16), [6, 7])
    steps, holes = bridge_gaps(stamps, [_pair(k, k + 1) for k in known], None)
    assert holes == 1
    trajectory = chain(steps)
    assert_array_equal(trajectory.stamps_ns, stamps)
    seconds = (stamps - START_NS) / NANOSECONDS
    assert_allclose(
        trajectory.poses.as_matrix(), RigidTransform.from_exp_coords(np.outer(seconds, TWIST)).as_matrix(), atol=1e-9
    )


def test_frames_before_the_first_and_after_the_last_pair_are_bridged_too() -> None:
    steps, holes = bridge_gaps(_stamps(10), [_pair(k, k + 1) for k in range(3, 6)], None)
    assert holes == 2
    assert_array_equal(chain(steps).stamps_ns, _stamps(10))


def test_over_a_hole_the_velocity_goes_from_that_of_one_side_to_that_of_the_other() -> None:
    slow, fast = np.array([0, 0, 0, 0, 0, 4.0]), np.array([0, 0, 0, 0, 0, 8.0])
    steps, _ = bridge_gaps(_stamps(6), [_pair(0, 1, slow), _pair(4, 5, fast)], None)
    assert_allclose([step.translation[2] for step in steps], [0.4, 0.4667, 0.6, 0.7333, 0.8], atol=1e-4)


def test_the_gyro_gives_the_rotation_over_a_hole_without_its_bias() -> None:
    """The car turns during the hole, which the pairs beside it do not see."""
    bias, turn = np.array([0.01, -0.02, 0.03]), np.array([0.0, 0.8, 0.0])
    straight = np.array([0, 0, 0, 0, 0, 10.0])
    imu = _imu(np.zeros(3), 2.0)
    during = (imu.stamps_ns > START_NS + 8 * PERIOD_NS) & (imu.stamps_ns < START_NS + 10 * PERIOD_NS)
    inertial = replace(imu, angular_velocity=imu.angular_velocity + bias + during[:, None] * turn)
    pairs = [_pair(k, k + 1, straight) for k in range(20) if k not in range(7, 11)]
    with_gyro, without = (chain(bridge_gaps(_stamps(21), pairs, series)[0]) for series in (inertial, None))
    assert_allclose(with_gyro.poses[-1].rotation.as_rotvec(), [0.0, 0.8 * 0.2, 0.0], atol=0.01)
    assert_allclose(without.poses[-1].rotation.as_rotvec(), 0.0, atol=1e-9)
    assert with_gyro.covariances is not None
    assert without.covariances is not None
    yaw_sigma = [np.sqrt(each.covariances[12, 1, 1]) for each in (with_gyro, without)]
    assert yaw_sigma[0] < 0.3 * yaw_sigma[1]


def test_a_hole_in_the_gyro_too_is_bridged_without_it() -> None:
    imu = _imu(TWIST[:3], 2.0)
    keep = (imu.stamps_ns < START_NS + 9 * PERIOD_NS) | (imu.stamps_ns > START_NS + 10 * PERIOD_NS)
    holed = ImuSeries(imu.stamps_ns[keep], imu.angular_velocity[keep], imu.linear_acceleration[keep])
    pairs = [_pair(k, k + 1) for k in range(20) if k != 9]
    assert_array_equal(
        bridge_gaps(_stamps(21), pairs, holed)[0][9].covariance, bridge_gaps(_stamps(21), pairs, None)[0][9].covariance
    )


def test_the_covariance_of_a_bridge_is_wider_than_a_pair_s_and_grows_with_the_hole() -> None:
    def end_covariance(missing: int) -> FloatArray:
        pairs = [_pair(k, k + 1) for k in range(40) if not 10 <= k < 10 + missing]
        steps, _ = bridge_gaps(_stamps(41), pairs, None)
        bridged = chain(steps[10 : 10 + missing]).covariances
        assert bridged is not None
        return np.linalg.eigvalsh(bridged[-1])

    spread = [end_covariance(missing) for missing in (1, 2, 4, 8, 16)]
    assert np.all(spread[0] > np.linalg.eigvalsh(COVARIANCE))
    assert np.all(np.diff(spread, axis=0) > 0.0)


def test_frames_inside_a_pair_split_its_motion_and_its_covariance() -> None:
    root = np.random.default_rng(4).normal(0.0, 0.02, (6, 6))
    pair = _pair(0, 4, TWIST, root @ root.T)
    steps, holes = bridge_gaps(_stamps(5)[[0, 1, 3, 4]], [pair], None)
    assert holes == 0
    assert [step.duration_s for step in steps] == pytest.approx([0.1, 0.2, 0.1])
    split, whole = chain(steps), chain([pair])
    assert split.covariances is not None
    assert_allclose(split.poses[-1].as_matrix(), whole.poses[-1].as_matrix(), atol=1e-12)
    assert_allclose(split.covariances[-1], pair.covariance, atol=1e-15)
    assert_allclose(split.poses[1].as_exp_coords(), TWIST / 10, atol=1e-12)


def test_without_any_pair_there_is_no_trajectory() -> None:
    with pytest.raises(LogError, match="no pair estimates"):
        bridge_gaps(_stamps(5), [], None)


def test_imu_windows_integrate_what_is_linear_between_samples() -> None:
    """A window between samples of a rate that grows linearly integrates exactly and fills the interval."""
    imu = _imu(np.zeros(3), 1.0)
    seconds = (imu.stamps_ns - START_NS) / NANOSECONDS
    ramp = replace(imu, angular_velocity=np.outer(seconds, [1.0, -2.0, 3.0]))
    window = ImuWindows(ramp).over(START_NS + 103_000_000, START_NS + 248_000_000)
    assert window is not None
    assert_allclose(window.durations.sum(), 0.145, atol=1e-12)
    turned = window.durations @ window.angular_velocity
    assert_allclose(turned, np.array([1.0, -2.0, 3.0]) * (0.248**2 - 0.103**2) / 2, atol=1e-12)


def test_the_rates_at_the_ends_of_a_window_are_exact_where_they_change_evenly() -> None:
    """And the means near the ends lag behind them by half of what they are means of."""
    imu = _imu(np.zeros(3), 1.0)
    slope = np.array([1.0, -2.0, 3.0])
    ramp = replace(imu, angular_velocity=np.outer((imu.stamps_ns - START_NS) / NANOSECONDS, slope))
    window = ImuWindows(ramp).over(START_NS + 103_000_000, START_NS + 248_000_000)
    assert window is not None
    assert_allclose(window.rates, np.outer([0.103, 0.248], slope), atol=1e-12)
    start_ns, end_ns = imu.stamps_ns[[20, 35]].tolist()
    window = ImuWindows(ramp).over(start_ns, end_ns)
    assert window is not None
    ends_s = (np.array([start_ns, end_ns]) - START_NS) / NANOSECONDS
    shorter = ImuWindow(*(values[:3] for values in window))
    means = mean_rates([shorter, window], 0.06)
    assert_allclose(means[1], np.outer(ends_s + [0.03, -0.03], slope), atol=1e-9)
    assert_allclose(means[0, 1], shorter.durations @ shorter.angular_velocity / shorter.durations.sum(), atol=1e-12)


@given(seed=st.integers(0, 2**32 - 1), pieces=st.integers(1, 30))
def test_noise_turns_the_rates_at_both_ends_of_a_window_alike(seed: int, pieces: int) -> None:
    """So that their difference errs independently of the rotation over it: white noise of pieces that differ in length.

    Means over shorter times err by more, so that the covariance of a sum and a weighted mean is the sum of its weights.
    """
    rng = np.random.default_rng(seed)
    durations = rng.uniform(0.001, 0.02, pieces)
    units = np.stack([np.eye(pieces)[k][:, None] * np.ones(3) for k in range(pieces)])
    by_piece = np.stack([ImuWindow(durations, unit, unit).rates[:, 0] for unit in units])  # weights of each piece
    assert_allclose(by_piece.sum(axis=0), 1.0, atol=1e-6)


def test_an_imu_window_rotates_by_the_rate_less_the_bias() -> None:
    window = ImuWindows(_imu(np.array([0.1, 0.2, 0.3]), 1.0)).over(START_NS, START_NS + PERIOD_NS)
    assert window is not None
    expected = Rotation.from_rotvec([0.01, 0.02, 0.02])
    assert_allclose(window.rotation(np.array([0.0, 0.0, 0.1])).as_quat(), expected.as_quat(), atol=1e-9)


def test_there_is_no_imu_window_beyond_the_samples_over_a_hole_or_where_they_are_stuck() -> None:
    imu = _imu(np.zeros(3), 1.0)
    assert ImuWindows(imu).over(START_NS, START_NS + PERIOD_NS) is not None
    assert ImuWindows(imu).over(START_NS - PERIOD_NS, START_NS) is None
    assert ImuWindows(imu).over(START_NS + 9 * PERIOD_NS, START_NS + 11 * PERIOD_NS) is None
    keep = (imu.stamps_ns < START_NS + 20_000_000) | (imu.stamps_ns > START_NS + 50_000_000)
    holed = ImuSeries(imu.stamps_ns[keep], imu.angular_velocity[keep], imu.linear_acceleration[keep])
    assert ImuWindows(holed).over(START_NS, START_NS + PERIOD_NS) is None
    stuck = replace(imu, angular_velocity=np.full((len(imu), 3), 0.1))
    assert ImuWindows(stuck).over(START_NS, START_NS + PERIOD_NS) is None
    empty = ImuSeries(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3)))
    assert ImuWindows(empty).over(START_NS, START_NS + PERIOD_NS) is None
