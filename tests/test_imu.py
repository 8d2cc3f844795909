"""The calibration finds mounting, clock and bias of an IMU from the log alone, or leaves the IMU out and says why."""

from dataclasses import dataclass, replace
from functools import cache
from itertools import pairwise
from pathlib import Path

import fault_samples as faults
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from scipy.ndimage import uniform_filter1d
from scipy.spatial.transform import RigidTransform, Rotation

from fusion.chain import ImuWindows
from fusion.imu import ImuCalibration, calibrate, in_camera_axes
from fusion_io.kitti import read_imu_mat
from fusion_io.records import NANOSECONDS, FloatArray, ImuSeries, PairEstimate
from fusion_io.simulation.motion import DriveStyle, ImuModel, Motion, drive, imu_stamps, simulate_imu
from fusion_io.trajectory_files import pair_estimates, read_kitti, read_times

START_NS = 1_600_000_000 * NANOSECONDS
IMU_HZ = 100.0
SIGMA_ROTATION = 5e-4
MOUNTING = Rotation.from_rotvec([0.4, -1.1, 0.7])
BIAS = np.array([0.02, -0.03, 0.01])


@dataclass(frozen=True)
class Log:
    """Pairs and IMU of one motion, both with noise."""

    pairs: list[PairEstimate]
    imu: ImuSeries


def _rich(seconds: float) -> Motion:
    """A camera in the hand: turning about all axes."""
    times = np.arange(-1.5, seconds + 1.5, 0.25)
    rng = np.random.default_rng(3)
    phase, period = rng.uniform(0, 2 * np.pi, (3, 1)), np.array([[3.1], [4.3], [5.7]])
    angles = (0.4 * np.sin(2 * np.pi * times / period + phase)).T
    return Motion(times, RigidTransform.from_components(np.cumsum(angles, axis=0), Rotation.from_euler("xyz", angles)))


def _log(motion: Motion, seconds: float, model: ImuModel, seed: int = 0, frames_hz: int = 10) -> Log:
    rng = np.random.default_rng(seed)
    times = np.arange(int(seconds * frames_hz)) / frames_hz
    poses = motion.poses(times)
    motions = poses[:-1].inv() * poses[1:]
    rotations = motions.rotation * Rotation.from_rotvec(SIGMA_ROTATION * rng.standard_normal((len(times) - 1, 3)))
    stamps = START_NS + np.round(times * NANOSECONDS).astype(np.int64)
    covariance = np.diag([SIGMA_ROTATION] * 3 + [0.01] * 3) ** 2
    pairs = [
        PairEstimate(int(start), int(end), quat_wxyz, translation, covariance)
        for (start, end), quat_wxyz, translation in zip(
            pairwise(stamps), rotations.as_quat(scalar_first=True), motions.translation, strict=True
        )
    ]
    imu = simulate_imu(motion, imu_stamps(-0.8, seconds + 0.8, IMU_HZ), IMU_HZ, model, seed)
    return Log(pairs, replace(imu, stamps_ns=imu.stamps_ns + START_NS))


@cache
def _hand(seconds: float = 40.0, offset_s: float = 0.0, mounting: Rotation = MOUNTING, seed: int = 0) -> Log:
    return _log(_rich(seconds), seconds, ImuModel(mounting, time_offset_s=offset_s, gyro_bias=BIAS), seed)


@cache
def _car(seconds: float = 120.0) -> Log:
    motion = drive(0, -1.5, seconds + 1.5, DriveStyle())
    return _log(motion, seconds, ImuModel(time_offset_s=0.03, gyro_bias=BIAS))


@cache
def _shaken(seconds: float = 40.0) -> Log:
    """The same hand, which trembles a little, fast."""
    times = np.arange(-1.5, seconds + 1.5, 0.05)
    slow = _rich(seconds).poses(times)
    trembling = Rotation.from_rotvec(0.01 * np.sin(2 * np.pi * times[:, None] * [1.3, 1.7, 2.1]))
    motion = Motion(times, RigidTransform.from_components(slow.translation, slow.rotation * trembling))
    return _log(motion, seconds, ImuModel(MOUNTING, time_offset_s=0.01, gyro_bias=BIAS))


def _angle(one: Rotation | None, other: Rotation) -> float:
    assert one is not None
    return float((one.inv() * other).magnitude())


@pytest.mark.parametrize("low_pass_s", [0.05, 0.08])
def test_a_low_pass_filter_is_found_and_undone(low_pass_s: float) -> None:
    """To a tenth; the offset is that of slow motion, and a quarter at most is left of what the filter did to rates."""
    log = _shaken()
    filtered = faults.low_passed(log.imu, low_pass_s)
    calibration = calibrate(log.pairs, filtered, None, None)
    assert calibration.low_pass_s == pytest.approx(low_pass_s, rel=0.1)
    assert calibration.time_offset_s == pytest.approx(0.01 + low_pass_s, abs=3e-3)
    assert f"filter of {1e3 * calibration.low_pass_s:.0f} ms is undone" in calibration.reason
    given_offset = calibrate(log.pairs, filtered, None, 0.01 + low_pass_s)
    assert given_offset.low_pass_s == pytest.approx(low_pass_s, rel=0.1)

    at_s = np.linspace(2.0, 38.0, 2000)
    sound, blurred, undone = (
        _smooth_rates(in_camera_axes(imu, known), at_s)
        for imu, known in (
            (log.imu, calibrate(log.pairs, log.imu, None, None)),
            (filtered, replace(calibration, low_pass_s=0.0)),
            (filtered, calibration),
        )
    )
    assert np.std(undone - sound) < 0.25 * np.std(blurred - sound)


def _smooth_rates(imu: ImuSeries, at_s: FloatArray) -> FloatArray:
    """At some times, without the noise of single samples."""
    seconds = (imu.stamps_ns - START_NS) / NANOSECONDS
    return np.stack([np.interp(at_s, seconds, uniform_filter1d(axis, 5)) for axis in imu.angular_velocity.T], axis=1)


def test_an_imu_without_a_low_pass_filter_is_left_as_it_is() -> None:
    """Nor is a filter that is given as zero looked for."""
    for log in (_shaken(), _hand(), _car()):
        assert calibrate(log.pairs, log.imu, None, None).low_pass_s == 0.0
    filtered = faults.low_passed(_shaken().imu, 0.06)
    assert calibrate(_shaken().pairs, filtered, None, None, 0.0).low_pass_s == 0.0
    assert calibrate(_shaken().pairs, filtered, None, None, 0.05).low_pass_s == 0.05


@pytest.mark.parametrize("offset_s", [-0.21, 0.0, 0.0657])
def test_mounting_offset_and_bias_are_found(offset_s: float) -> None:
    """A rich motion: to 0.1 deg, 1 ms and 1 mrad/s, and within four of their own standard deviations."""
    log = _hand(offset_s=offset_s)
    calibration = calibrate(log.pairs, log.imu, None, None)
    assert calibration.used, calibration.reason
    assert calibration.rotation_imu_camera is not None
    error = (calibration.rotation_imu_camera.inv() * MOUNTING).as_rotvec()
    assert np.linalg.norm(error) < np.deg2rad(0.1)
    assert np.all(np.abs(error) < 4 * calibration.rotation_std_rad)
    assert abs(calibration.time_offset_s - offset_s) < min(1e-3, 4 * calibration.time_offset_std_s)
    assert_allclose(calibration.gyro_bias, BIAS, atol=1e-3)
    assert np.all(np.abs(calibration.gyro_bias - BIAS) < 4 * calibration.gyro_bias_std)


def test_a_car_shows_its_mounting_though_it_turns_mostly_about_one_axis() -> None:
    """To 0.5 deg; the axis that it turns about is the one about which the mounting is seen least."""
    log = _car()
    calibration = calibrate(log.pairs, log.imu, None, None)
    assert calibration.used, calibration.reason
    assert _angle(calibration.rotation_imu_camera, ImuModel().rotation_imu_camera) < np.deg2rad(0.5)
    assert np.argmax(calibration.rotation_std_rad) == 1
    assert abs(calibration.time_offset_s - 0.03) < 2e-3


@settings(max_examples=3, deadline=None)
@given(st.tuples(*3 * [st.floats(-2.0, 2.0)]))
def test_turning_the_imu_turns_the_mounting(turn: tuple[float, float, float]) -> None:
    """Equivariance: for any Q, an IMU that is turned by Q has the mounting Q R, and nothing else changes."""
    Q = Rotation.from_rotvec(turn)
    log = _hand(15.0)
    turned = replace(
        log.imu,
        angular_velocity=Q.apply(log.imu.angular_velocity),
        linear_acceleration=Q.apply(log.imu.linear_acceleration),
    )
    before, after = calibrate(log.pairs, log.imu, None, None), calibrate(log.pairs, turned, None, None)
    assert before.rotation_imu_camera is not None
    assert _angle(after.rotation_imu_camera, Q * before.rotation_imu_camera) < 1e-6
    assert_allclose(after.time_offset_s, before.time_offset_s, atol=1e-6)
    assert_allclose(after.gyro_bias, Q.apply(before.gyro_bias), atol=1e-6)


def test_what_is_given_is_kept() -> None:
    log = _hand(offset_s=0.05)
    given_rotation = calibrate(log.pairs, log.imu, MOUNTING, None)
    assert _angle(given_rotation.rotation_imu_camera, MOUNTING) < 1e-12
    assert_array_equal(given_rotation.rotation_std_rad, 0.0)
    assert abs(given_rotation.time_offset_s - 0.05) < 1e-3
    given_offset = calibrate(log.pairs, log.imu, None, 0.05)
    assert given_offset.time_offset_s == 0.05
    assert given_offset.time_offset_std_s == 0.0
    assert _angle(given_offset.rotation_imu_camera, MOUNTING) < np.deg2rad(0.1)
    assert given_rotation.used
    assert given_offset.used


def test_wild_pairs_do_not_disturb_it() -> None:
    """Every fifth pair is off by some ten degrees; the mounting is still found to 0.2 deg."""
    log, rng = _hand(offset_s=0.0657), np.random.default_rng(1)
    wild = [
        replace(pair, quat_wxyz=Rotation.from_rotvec(rng.normal(0, 0.2, 3)).as_quat(scalar_first=True))
        if rng.random() < 0.2
        else pair
        for pair in log.pairs
    ]
    calibration = calibrate(wild, log.imu, None, None)
    assert calibration.used, calibration.reason
    assert _angle(calibration.rotation_imu_camera, MOUNTING) < np.deg2rad(0.2)
    assert abs(calibration.time_offset_s - 0.0657) < 2e-3


def test_a_gyro_without_bias_is_seen_to_have_none_and_one_with_bias_to_have_it() -> None:
    """Against pairs that drift by 0.3 mrad/s themselves, which is not mistaken for a bias."""
    drift = Rotation.from_rotvec([3e-5, 0.0, 0.0])  # in a tenth of a second
    for bias in (np.zeros(3), BIAS):
        log = _log(_rich(60.0), 60.0, ImuModel(MOUNTING, gyro_bias=bias))
        pairs = [
            replace(pair, quat_wxyz=(pair.T_source_target.rotation * drift).as_quat(scalar_first=True))
            for pair in log.pairs
        ]
        calibration = calibrate(pairs, log.imu, None, None)
        assert np.linalg.norm(calibration.gyro_bias - bias) < (5e-4 if np.any(bias) else 1e-5)
        assert calibration.gyro_bias_std < (1e-3 if np.any(bias) else 5e-5)


@pytest.mark.parametrize("seed", range(8))
def test_where_a_short_log_leaves_open_whether_a_gyro_has_a_bias_it_is_uncertain_by_that(seed: int) -> None:
    """Of pairs whose own rotations drift by as much."""
    log = faults.simulated(seed, 25.0)
    calibration = calibrate(log.pairs, log.imu, None, None)
    off = np.linalg.norm(calibration.gyro_bias - faults.IMU.gyro_bias)
    assert off < 4.0 * calibration.gyro_bias_std * np.sqrt(3.0)


@pytest.mark.parametrize("seed", range(4, 8))
def test_a_small_step_of_the_bias_is_told_from_the_drift_of_the_pairs(seed: int) -> None:
    """0.4 deg/s, halfway through a hundred seconds, to some seconds; none where there is none."""
    log = faults.simulated(seed, 100.0)
    assert not len(calibrate(log.pairs, log.imu, None, None).bias_steps_ns)
    step = np.array([0.0025, 0.005, -0.005])
    found = calibrate(log.pairs, faults.gyro_bias_step(log.imu, 50.0, step), None, None)
    assert_allclose((found.bias_steps_ns - log.imu.stamps_ns[0]) / NANOSECONDS, [50.0], atol=10.0)


def _changed(imu: ImuSeries, **values: FloatArray) -> ImuSeries:
    return replace(imu, **values)


def _kept(imu: ImuSeries, samples: slice) -> ImuSeries:
    return ImuSeries(imu.stamps_ns[samples], imu.angular_velocity[samples], imu.linear_acceleration[samples])


FAULTS = {
    "no IMU": lambda imu: _kept(imu, slice(0)),
    "gyro is stuck": lambda imu: _changed(imu, angular_velocity=np.zeros_like(imu.angular_velocity)),
    "gyro is stuck: z": lambda imu: _changed(imu, angular_velocity=imu.angular_velocity * [1, 1, 0]),
    "accelerometer is stuck": lambda imu: _changed(imu, linear_acceleration=np.full((len(imu), 3), 5.66)),
    "does not show gravity": lambda imu: _changed(imu, linear_acceleration=imu.linear_acceleration / 9.81),
    "measured only": lambda imu: _kept(imu, slice(0, len(imu) // 3)),
    "measured 0 pairs": lambda imu: _changed(imu, stamps_ns=imu.stamps_ns + 1000 * NANOSECONDS),
    "do not follow": lambda imu: _changed(imu, angular_velocity=imu.angular_velocity[::-1].copy()),
    "times the turning": lambda imu: _changed(imu, angular_velocity=imu.angular_velocity * 1.03),
    "explains too little": lambda imu: _changed(imu, angular_velocity=np.rad2deg(imu.angular_velocity)),
    "the other way": lambda imu: _changed(imu, angular_velocity=imu.angular_velocity * [1, -1, 1]),
    "off the camera's": lambda imu: _changed(imu, stamps_ns=imu.stamps_ns + NANOSECONDS * 6 // 10),
}


@pytest.mark.parametrize("reason", FAULTS)
def test_an_imu_that_cannot_be_trusted_is_left_out_and_the_reason_says_why(reason: str) -> None:
    log = _car(60.0)
    calibration = calibrate(log.pairs, FAULTS[reason](log.imu), None, None)
    assert not calibration.used
    assert reason in calibration.reason


def test_a_log_that_is_too_short_leaves_the_imu_out() -> None:
    log = _hand()
    calibration = calibrate(log.pairs[:30], log.imu, None, None)
    assert not calibration.used
    assert "measured 30 pairs" in calibration.reason
    assert not calibrate([], log.imu, None, None).used


@pytest.mark.parametrize("style", [DriveStyle(yaw_rate=0.0, shake=0.0, slope=0.0), DriveStyle(shake=0.0, slope=0.0)])
def test_without_turning_about_two_axes_a_mounting_is_not_claimed(style: DriveStyle) -> None:
    """On rails straight ahead, or turning about one axis only, it cannot be seen; given, the IMU is welcome."""
    motion = drive(1, -1.5, 61.5, style)
    log = _log(motion, 60.0, ImuModel(gyro_bias=np.zeros(3)))
    assert not calibrate(log.pairs, log.imu, None, None).used
    given_all = calibrate(log.pairs, log.imu, ImuModel().rotation_imu_camera, 0.0)
    assert given_all.used, given_all.reason


STRETCHES = {
    "hangs": lambda rates, t: np.broadcast_to(rates[0], rates.shape),
    "was filled in by interpolation": lambda rates, t: rates[0] + (rates[-1] - rates[0]) * t[:, None] / t[-1],
    "shows what is not there": lambda rates, t: rates + 0.5 * np.sin(t)[:, None],
}


@pytest.mark.parametrize("fault", STRETCHES)
def test_a_stretch_in_which_the_gyro_is_wrong_is_left_out(fault: str) -> None:
    """Three seconds while the camera turns on: those samples go, and hardly any others."""
    log = _hand(offset_s=0.04)
    begin, end = (int(np.searchsorted(log.imu.stamps_ns, START_NS + at * NANOSECONDS)) for at in (20, 23))
    rates = log.imu.angular_velocity.copy()
    rates[begin:end] = STRETCHES[fault](rates[begin:end], np.arange(end - begin) / IMU_HZ)
    calibration = calibrate(log.pairs, replace(log.imu, angular_velocity=rates), None, None)
    assert calibration.used, calibration.reason
    assert "faulty" in calibration.reason
    left = in_camera_axes(log.imu, calibration).stamps_ns + round(calibration.time_offset_s * NANOSECONDS)
    lost = ~np.isin(log.imu.stamps_ns, left)
    assert np.mean(lost[begin + 20 : end - 20]) > 0.9
    assert np.sum(lost) < 1.2 * (end - begin)
    assert _angle(calibration.rotation_imu_camera, MOUNTING) < np.deg2rad(0.2)


def test_a_gyro_that_hangs_all_along_is_left_out() -> None:
    """Equal steps from end to end: it is not stuck on one value, but nothing was measured."""
    log = _hand()
    ramp = np.outer(np.arange(len(log.imu)), [1e-5, 2e-5, -1e-5])
    calibration = calibrate(log.pairs, replace(log.imu, angular_velocity=ramp), None, None)
    assert not calibration.used
    assert "hangs" in calibration.reason


def test_in_camera_axes_the_gyro_turns_as_the_camera_does() -> None:
    """Each pair's rotation is the integral of the rates between its stamps, to the noise of both."""
    log = _hand(offset_s=0.0657)
    windows = ImuWindows(in_camera_axes(log.imu, calibrate(log.pairs, log.imu, None, None)))
    errors = []
    for pair in log.pairs:
        window = windows.over(pair.source_stamp_ns, pair.target_stamp_ns)
        assert window is not None
        errors.append((pair.T_source_target.rotation.inv() * window.rotation(np.zeros(3))).as_rotvec())
    assert_allclose(np.std(errors, axis=0), SIGMA_ROTATION, rtol=0.2)
    assert_allclose(np.mean(errors, axis=0), 0.0, atol=1e-4)


def test_an_unknown_mounting_cannot_be_applied() -> None:
    log = _hand(15.0)
    with pytest.raises(ValueError, match="mounting"):
        in_camera_axes(log.imu, ImuCalibration(None, 0.0, np.zeros(3), False, "unknown"))


def test_real_drive_seen_by_a_published_odometry(shared_data: Path) -> None:
    """KITTI 09, a car: within 0.5 deg and 10 ms of what the ground truth's rotations give."""
    odometry = shared_data / "kitti" / "odometry"
    stamps = read_times(odometry / "sequences" / "09" / "times.txt")
    imu = read_imu_mat(odometry / "imu" / "09.mat", stamps)
    found, fitted = (
        calibrate(pair_estimates(read_kitti(odometry / folder / "09.txt", stamps), 0.04, 5e-4), imu, None, None)
        for folder in ("published/example_1", "poses")
    )
    assert found.used, found.reason
    assert fitted.rotation_imu_camera is not None
    assert _angle(found.rotation_imu_camera, fitted.rotation_imu_camera) < np.deg2rad(0.5)
    assert abs(found.time_offset_s - fitted.time_offset_s) < 0.01
    assert abs(found.time_offset_s - 0.065) < 0.01
    assert_allclose(found.gyro_bias, 0.0, atol=1e-6)
