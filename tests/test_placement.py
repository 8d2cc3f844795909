"""What is shown of the mounting and the clock of an IMU is the best that is known, everywhere the same."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from report_samples import content
from scipy.spatial.transform import Rotation

from fusion.imu import ImuCalibration
from fusion.measurements import Estimate, Mounting
from fusion.output import _calibration
from fusion.placement import imu_line, placement
from fusion.report import ReportContent
from fusion.report.page import page

CALIBRATION = ImuCalibration(
    Rotation.from_quat([0.5, -0.5, 0.5, -0.5], scalar_first=True),
    0.070,
    np.zeros(3),
    True,
    "it agrees with the pairs",
    rotation_std_rad=np.deg2rad([0.1, 0.11, 0.09]),
    time_offset_std_s=0.4e-3,
)


@pytest.fixture
def refined() -> Mounting:
    """Turned by 0.3 deg about the camera's y axis, 0.9 ms further ahead, five times less certain."""
    turned = CALIBRATION.mounting * Rotation.from_rotvec(np.deg2rad([0.0, 0.3, 0.0]))
    T_camera_imu = np.eye(4)
    T_camera_imu[:3, :3] = turned.inv().as_matrix()
    T_camera_imu[:3, 3] = -0.5, 0.2, -0.9
    covariance = np.diag([*np.deg2rad([0.5, 0.5, 0.5]) ** 2, 0.01, 0.04, 0.09, 0.8e-3**2, 1e-4, 1e-4, 1e-4])
    return Mounting(T_camera_imu, 0.9e-3, np.zeros(3), covariance, np.zeros(3), np.zeros(3))


@pytest.fixture
def run() -> ReportContent:
    return replace(content(10.0), calibration=CALIBRATION)


def _estimates(run: ReportContent, mounting: Mounting | None) -> list[Estimate]:
    return [Estimate(run.trajectories["posegraph"], "", series=run.series["posegraph"], mounting=mounting)]


def test_a_refined_mounting_takes_the_place_of_the_calibration(refined: Mounting) -> None:
    known = placement(CALIBRATION, refined)
    assert known.rotation_imu_camera is not None
    away = CALIBRATION.mounting.inv() * known.rotation_imu_camera
    assert_allclose(np.rad2deg(away.as_rotvec()), [0.0, 0.3, 0.0], atol=1e-9)
    assert known.rotation_std_rad is not None
    assert_allclose(np.rad2deg(known.rotation_std_rad), 0.5)
    assert_allclose([known.time_offset_s, known.time_offset_std_s], [0.0709, 0.0008])


def test_printout_page_and_metrics_say_the_same(run: ReportContent, refined: Mounting) -> None:
    """The deviations of the calibration (.11 deg, .4 ms) stand nowhere once the mounting is refined."""
    line = imu_line(CALIBRATION, _estimates(run, refined))
    assert line == ("IMU used: it agrees with the pairs; mounting known to +-0.50 deg, time offset 70.9 ms (+-0.8 ms)")
    shown = page(replace(run, mounting=refined))
    assert "0.500, 0.500, 0.500 deg" in shown
    assert "70.90 ms ± 0.80 ms" in shown
    assert "a calibration +0.000, +0.300, +0.000 deg about x, y, z and +0.90 ms away" in shown
    assert "0.110" not in shown
    document = _calibration(CALIBRATION, placement(CALIBRATION, refined))
    assert_allclose(document["rotation_std_deg"], 0.5)
    assert_allclose([document["time_offset_s"], document["time_offset_std_s"]], [0.0709, 0.0008])


def test_without_a_refinement_the_calibration_is_shown(run: ReportContent) -> None:
    line = imu_line(CALIBRATION, _estimates(run, None))
    assert line.endswith("mounting known to +-0.11 deg, time offset 70.0 ms (+-0.4 ms)")
    assert "refined from" not in page(run)


def test_what_was_given_has_no_deviation() -> None:
    given = replace(CALIBRATION, rotation_std_rad=np.zeros(3), time_offset_std_s=0.0)
    known = placement(given, None)
    assert (known.rotation_std_rad, known.time_offset_std_s) == (None, None)
    assert known.summary == "mounting given, time offset 70.0 ms (given)"


def test_an_imu_that_was_left_out_or_refused_is_not_called_used(run: ReportContent) -> None:
    left_out = replace(CALIBRATION, used=False, reason="it hangs")
    assert imu_line(left_out, _estimates(run, None)) == "IMU left out: it hangs"
    none = np.full_like(run.series["posegraph"].gyro_bias, np.nan)
    refusing = replace(_estimates(run, None)[0], series=replace(run.series["posegraph"], gyro_bias=none))
    assert imu_line(CALIBRATION, [refusing]).startswith("IMU calibrated, but no back end used it: it agrees")
