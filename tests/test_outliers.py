"""Of measurements that contradict each other, the one that is wrong is suspected, and noise never is."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from scipy.spatial.transform import RigidTransform, Rotation

from benchmarks.drives import FRAMES_HZ, simulate
from fusion.chain import ImuWindow, ImuWindows
from fusion.outliers import Suspects, jumps, suspects
from fusion_io.records import ImuSeries, PairEstimate

GATE = 1e-6
DRIVE = simulate(0, 12.0)
PAIRS = list(DRIVE.measurements.steps)
MIDDLE = 60


def _windows(imu: ImuSeries, pairs: Sequence[PairEstimate] = PAIRS) -> list[ImuWindow | None]:
    samples = ImuWindows(imu)
    return [samples.over(pair.source_stamp_ns, pair.target_stamp_ns) for pair in pairs]


def _suspects(pairs: Sequence[PairEstimate], imu: ImuSeries | None = None) -> Suspects:
    calibration = DRIVE.measurements.calibration
    assert calibration is not None
    assert DRIVE.measurements.imu is not None
    windows = _windows(imu or DRIVE.measurements.imu, pairs)
    return suspects(pairs, windows, calibration.mounting, calibration.gyro_bias, GATE)


def _moved(pair: PairEstimate, twist: Sequence[float]) -> PairEstimate:
    wrong = pair.T_source_target * RigidTransform.from_exp_coords(twist)
    return replace(pair, quat_wxyz=wrong.rotation.as_quat(scalar_first=True), translation=wrong.translation)


@pytest.mark.parametrize("seed", range(5))
def test_noise_and_lasting_errors_are_no_outliers(seed: int) -> None:
    drive = simulate(seed, 12.0)
    assert drive.measurements.imu is not None
    found = suspects(
        drive.measurements.steps,
        _windows(drive.measurements.imu),
        Rotation.from_matrix(drive.T_camera_imu[:3, :3].T),
        np.zeros(3),
        GATE,
    )
    assert not found.imu.any()
    assert not found.pair.any()


@pytest.mark.parametrize("twist", [[0.0, 0.1, 0, 0, 0, 0], [0.05, -0.1, 0.1, 2.0, 0, 0]])
def test_a_pair_that_turns_like_nobody_else_is_suspected_and_not_the_gyro(twist: Sequence[float]) -> None:
    pairs = [_moved(pair, twist) if k in (MIDDLE, MIDDLE + 1, 90) else pair for k, pair in enumerate(PAIRS)]
    found = _suspects(pairs)
    assert_array_equal(np.flatnonzero(found.pair), [MIDDLE, MIDDLE + 1, 90])
    assert not found.imu.any()


def test_a_gyro_that_bursts_is_suspected_and_not_the_pair() -> None:
    imu = DRIVE.measurements.imu
    assert imu is not None
    step = PAIRS[MIDDLE]
    inside = (imu.stamps_ns > step.source_stamp_ns) & (imu.stamps_ns < step.target_stamp_ns)
    found = _suspects(PAIRS, replace(imu, angular_velocity=imu.angular_velocity + np.outer(inside, [0.0, 0.0, 1.0])))
    assert_array_equal(np.flatnonzero(found.imu), [MIDDLE])
    assert not found.pair.any()


def test_a_jump_in_the_velocity_is_told_without_an_imu() -> None:
    """A metre sideways in a tenth of a second, and back: no car does that. Braking hard is none."""
    pairs = [_moved(pair, [0, 0, 0, 1.0, 0, 0]) if k == MIDDLE else pair for k, pair in enumerate(PAIRS)]
    assert_array_equal(np.flatnonzero(jumps(pairs)), [MIDDLE])
    found = suspects(pairs, [None] * len(pairs), Rotation.identity(), np.zeros(3), GATE)
    assert_array_equal(found.pair, jumps(pairs))
    assert not found.imu.any()
    braking = [
        replace(pair, translation=np.array([0.0, 0.0, max(0.0, 15.0 - 9.0 * k / FRAMES_HZ) / FRAMES_HZ]))
        for k, pair in enumerate(PAIRS)
    ]
    assert not jumps(braking).any()


def test_a_pair_that_knows_little_may_jump() -> None:
    """A bridged hole says of itself how uncertain it is."""
    jump = [_moved(pair, [0, 0, 0, 1.0, 0, 0]) if k == MIDDLE else pair for k, pair in enumerate(PAIRS)]
    jump[MIDDLE] = replace(jump[MIDDLE], covariance=np.eye(6))
    assert not jumps(jump).any()


def test_where_covariances_prove_too_small_the_gate_widens() -> None:
    """A front end whose pairs are ten times worse than they say: not all of them are outliers."""
    pairs = [replace(pair, covariance=pair.covariance / 100) for pair in PAIRS]
    assert _suspects(pairs).pair.sum() == 0
    assert _suspects(pairs).imu.sum() == 0
