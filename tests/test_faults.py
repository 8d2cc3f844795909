"""Whatever befalls a sensor, what is fused is no worse than the pairs by themselves, and says what became of it.

The bound of every fault: fused ATE, by either back end, is at most 1.05 times that of the raw chain of the same pairs.
"""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import fault_samples as faults
import numpy as np
import pytest
from fault_samples import Log
from numpy.testing import assert_allclose

from fusion import events, fusing, posegraph
from fusion.chain import chain
from fusion.config import RunConfig
from fusion.evaluation import evaluate
from fusion.imu import ImuCalibration, calibrate
from fusion.measurements import Estimate
from fusion_io.findings import Findings
from fusion_io.kitti import read_imu_mat
from fusion_io.records import NANOSECONDS, ImuSeries, Trajectory
from fusion_io.trajectory_files import pair_estimates, read_kitti, read_times

MOST = 1.05
SECONDS = 50.0
AT_S = 25.0  # when most faults begin
BIAS_STEP = np.array([0.02, -0.01, 0.03])  # rad/s
ACCELEROMETER_STEP = np.array([2.0, -1.0, 3.0])  # m/s^2
DIRECTION = ACCELEROMETER_STEP / np.linalg.norm(ACCELEROMETER_STEP)


@dataclass(frozen=True)
class Result:
    """What a log gives: the calibration, and what the back ends make of it with their errors."""

    calibration: ImuCalibration
    estimates: Mapping[str, Estimate]
    ate_m: Mapping[str, float]
    findings: Findings


def _fused(log: Log) -> Result:
    calibration = calibrate(log.pairs, log.imu, None, None)
    findings = Findings()
    known = fusing.measurements(log.pairs, log.imu, calibration, log.truth.stamps_ns, findings)
    estimates = fusing.fuse(known, RunConfig(), findings)
    trajectories = {"raw": chain(known.steps)} | {name: each.trajectory for name, each in estimates.items()}
    ate_m = {name: evaluate(each, log.truth).ate_m for name, each in trajectories.items()}
    return Result(calibration, estimates, {name: ate for name, ate in ate_m.items() if ate is not None}, findings)


@cache
def _drive() -> Log:
    return faults.simulated(1, SECONDS)


@cache
def _sound() -> Result:
    return _fused(_drive())


def _assert_no_worse(result: Result) -> None:
    """Both back ends."""
    for name in ("posegraph", "ekf"):
        assert result.ate_m[name] <= MOST * result.ate_m["raw"], (name, result.ate_m)


# Faults of the IMU by name: what befalls its samples, and what the verdict on it has to say ("used", or a part of it).
IMU_FAULTS: dict[str, tuple[Callable[[ImuSeries], ImuSeries], str]] = {
    "a gap of 0.1 s": (lambda imu: faults.gap(imu, AT_S, 0.1), "used"),
    "a gap of 1 s": (lambda imu: faults.gap(imu, AT_S, 1.0), "used"),
    "a gap of 10 s": (lambda imu: faults.gap(imu, AT_S, 10.0), "used"),
    "a gyro stuck for 10 s": (lambda imu: faults.stuck_gyro(imu, AT_S, 10.0), "used"),
    "a gyro stuck for ever": (lambda imu: faults.stuck_gyro(imu, AT_S / 2), "measured only"),
    "a gyro stuck from the start": (lambda imu: faults.stuck_gyro(imu, 0.0), "gyro is stuck"),
    "an accelerometer at the end of its range in bends": (
        lambda imu: faults.saturated_accelerometer(imu, 10.5),
        "used",
    ),
    "an accelerometer whose range is too small": (
        lambda imu: faults.saturated_accelerometer(imu, 9.6),
        "accelerometer",
    ),
    "a gyro that is clipped in bends": (lambda imu: faults.saturated_gyro(imu, 0.3), "used"),
    "a gyro whose range is too small": (
        lambda imu: faults.saturated_gyro(imu, 0.03),
        "gyro is at the end of its range",
    ),
    "a step of the gyro's bias": (lambda imu: faults.gyro_bias_step(imu, AT_S, BIAS_STEP), "bias steps"),
    "a small step of the gyro's bias": (lambda imu: faults.gyro_bias_step(imu, AT_S, BIAS_STEP / 10), "used"),
    "a huge step of the gyro's bias": (lambda imu: faults.gyro_bias_step(imu, AT_S, 20 * BIAS_STEP), ""),
    "a step of the accelerometer's bias": (
        lambda imu: faults.accelerometer_bias_step(imu, AT_S, ACCELEROMETER_STEP),
        "",
    ),
    "a small step of the accelerometer's bias": (
        lambda imu: faults.accelerometer_bias_step(imu, AT_S, ACCELEROMETER_STEP / 3),
        "",
    ),
    "an offset that jumps by 20 ms": (lambda imu: faults.clock_jump(imu, AT_S, 0.02), "used"),
    "an offset that jumps by 50 ms": (lambda imu: faults.clock_jump(imu, AT_S, 0.05), "clock jumps by +"),
    "an offset that jumps by 0.3 s": (lambda imu: faults.clock_jump(imu, AT_S, 0.3), "clock jumps by +"),
    "an offset that jumps by 2 s": (lambda imu: faults.clock_jump(imu, AT_S, 2.0), "clock jumps by +"),
    "time going backwards by 0.3 s": (lambda imu: faults.clock_jump(imu, AT_S, -0.3), "clock jumps by -"),
    "time going backwards by 2 s": (lambda imu: faults.clock_jump(imu, AT_S, -2.0), "clock jumps by -"),
}


@pytest.mark.parametrize("fault", IMU_FAULTS)
def test_a_faulty_imu_makes_nothing_worse(fault: str) -> None:
    """Fused ATE at most 1.05 times raw, and the verdict names the fault or uses the rest of the IMU."""
    befall, verdict = IMU_FAULTS[fault]
    result = _fused(replace(_drive(), imu=befall(_drive().imu)))
    _assert_no_worse(result)
    if verdict == "used":
        assert result.calibration.used, result.calibration.reason
    else:
        assert verdict in result.calibration.reason


def test_a_bias_step_is_found_when_it_happens_and_taken_out() -> None:
    """Within a second, and to a tenth of its size; the bias after it is uncertain anew."""
    imu = faults.gyro_bias_step(_drive().imu, AT_S, BIAS_STEP)
    calibration = calibrate(_drive().pairs, imu, None, None)
    (change,) = calibration.changes
    assert abs(change.at_ns - imu.stamps_ns[0] - AT_S * NANOSECONDS) < NANOSECONDS
    assert_allclose(change.bias, BIAS_STEP, atol=0.1 * float(np.linalg.norm(BIAS_STEP)))
    assert len(calibration.bias_steps_ns) == 1
    assert calibration.gyro_bias_std > 0.0


STEPS: dict[str, Callable[[ImuSeries, float], ImuSeries]] = {
    "accelerometer, 0.3 m/s^2": lambda imu, at_s: faults.accelerometer_bias_step(imu, at_s, 0.3 * DIRECTION),
    "accelerometer, 1 m/s^2": lambda imu, at_s: faults.accelerometer_bias_step(imu, at_s, DIRECTION),
    "accelerometer, 4 m/s^2": lambda imu, at_s: faults.accelerometer_bias_step(imu, at_s, np.array([3.0, 3.0, 0.0])),
    "gyro, 0.012 rad/s": lambda imu, at_s: faults.gyro_bias_step(imu, at_s, 0.012 * DIRECTION),
}


@pytest.mark.parametrize("seconds", [25.0, SECONDS])
@pytest.mark.parametrize("step", STEPS)
def test_a_bias_that_steps_unseen_by_the_calibration_is_found_by_the_graph(step: str, seconds: float) -> None:
    """Which sensor, and when, to two seconds; a huge one may pass for a bias that wanders.

    Fused ATE is within the bound of raw, or of what a sound IMU gives.
    """
    log = faults.simulated(3, seconds)
    sound = _fused(log)
    result = _fused(replace(log, imu=STEPS[step](log.imu, seconds / 2)))
    graph = result.estimates["posegraph"]
    sensor = step.split(",", maxsplit=1)[0]
    assert re.search(f"{sensor}'s bias (steps|wanders)", graph.note + result.calibration.reason)
    for found in graph.bias_steps:
        if np.any(found.by):
            assert abs((found.at_ns - log.truth.stamps_ns[0]) / NANOSECONDS - seconds / 2) <= 2.0
    for name in ("posegraph", "ekf"):
        assert result.ate_m[name] <= MOST * max(result.ate_m["raw"], sound.ate_m[name]), (name, result.ate_m)


@pytest.mark.parametrize("by_s", [-2.0, -0.3, 0.3, 2.0])
def test_a_clock_jump_is_found_with_its_size_and_what_is_about_it_is_left_out(by_s: float) -> None:
    """To 50 ms, which is what the offset is uncertain by on either side of it."""
    imu = faults.clock_jump(_drive().imu, AT_S, by_s)
    calibration = calibrate(_drive().pairs, imu, None, None)
    (change,) = calibration.changes
    assert abs(change.clock_ns / NANOSECONDS - by_s) < 0.05
    assert np.any((calibration.faulty_ns[:, 0] < change.at_ns) & (calibration.faulty_ns[:, 1] > change.at_ns))


@pytest.mark.parametrize("seconds", [25.0, SECONDS])
@pytest.mark.parametrize("by_s", [-0.2, -0.1, -0.05, 0.05, 0.1, 0.3])
def test_a_small_clock_jump_is_found_in_a_short_drive_too(by_s: float, seconds: float) -> None:
    """Its size to 15 ms, and when, to two seconds; fused ATE is within the bound of raw, or of a sound IMU's."""
    log = faults.simulated(4, seconds)
    sound = _fused(log)
    result = _fused(replace(log, imu=faults.clock_jump(log.imu, seconds / 2, by_s)))
    (jump,) = result.calibration.clock_jumps
    assert result.findings.counts["imu_clock_jumps"] == 1
    assert abs(jump.by_s - by_s) < 0.015
    assert abs((jump.at_ns - log.truth.stamps_ns[0]) / NANOSECONDS - seconds / 2) <= 2.0
    for name in ("posegraph", "ekf"):
        assert result.ate_m[name] <= MOST * max(result.ate_m["raw"], sound.ate_m[name]), (name, result.ate_m)


@pytest.mark.parametrize("seconds", [25.0, SECONDS])
def test_other_faults_are_no_clock_jumps(seconds: float) -> None:
    """Not even a step of the gyro's bias, or pairs of which a fifth is wrong."""
    log, half = faults.simulated(4, seconds), seconds / 2
    for imu, pairs in (
        (log.imu, log.pairs),
        (faults.gap(log.imu, half, 2.0), log.pairs),
        (faults.stuck_gyro(log.imu, half, 5.0), log.pairs),
        (faults.saturated_gyro(log.imu, 0.3), log.pairs),
        (faults.gyro_bias_step(log.imu, half, 0.03 * DIRECTION), log.pairs),
        (faults.gyro_bias_step(log.imu, half, 0.3 * DIRECTION), log.pairs),
        (log.imu, faults.dropped_frames(log.pairs, half, 10)),
        (log.imu, faults.wrong_pairs(log.pairs, 0.2, 0)[0]),
    ):
        assert not calibrate(pairs, imu, None, None).clock_jumps


def test_a_sound_imu_has_no_changes_and_no_faulty_stretches() -> None:
    calibration = _sound().calibration
    assert calibration.used
    assert not calibration.changes
    assert len(calibration.faulty_ns) == 0


@pytest.mark.parametrize("count", [1, 10])
def test_dropped_frames_are_bridged(count: int) -> None:
    """Raw, which bridges them too, is the bound; a second without a frame is measured by the IMU."""
    result = _fused(replace(_drive(), pairs=faults.dropped_frames(_drive().pairs, AT_S, count)))
    _assert_no_worse(result)
    assert result.findings.counts["gaps_bridged"] == 1


@pytest.mark.parametrize("share", [0.01, 0.05, 0.2])
def test_pairs_that_are_wildly_wrong_are_left_out(share: float) -> None:
    """Either back end: nine tenths of them are rejected, and the ATE is below that of raw without them."""
    pairs, wrong = faults.wrong_pairs(_drive().pairs, share, 0)
    result = _fused(replace(_drive(), pairs=pairs))
    _assert_no_worse(result)
    for name, estimate in result.estimates.items():
        assert result.ate_m[name] < _sound().ate_m["raw"], (name, result.ate_m, _sound().ate_m)
        assert estimate.series is not None
        assert np.mean(~estimate.series.used[1:][wrong]) >= 0.9


def test_wrong_pairs_are_named_as_events() -> None:
    """What the report lists: nine tenths of the wrong pairs lie in an event of that kind."""
    pairs, wrong = faults.wrong_pairs(_drive().pairs, 0.05, 0)
    found = events.wrong_pairs(pairs, "/violearner/pairs", _sound().estimates["posegraph"].trajectory)
    spans = [(event.start_ns, event.end_ns) for event in found if event.kind == events.WRONG_PAIR]
    named = [any(s <= pairs[k].source_stamp_ns and pairs[k].target_stamp_ns <= e for s, e in spans) for k in wrong]
    assert np.mean(named) >= 0.9


def test_standing_still_for_a_minute_costs_nothing() -> None:
    """ATE, and what either back end moves by during the minute, are at most 1.05 times what they are of raw."""
    log = faults.simulated(1, SECONDS, stand_still_s=60.0)
    result = _fused(log)
    _assert_no_worse(result)
    seconds = (log.truth.stamps_ns - log.truth.stamps_ns[0]) / NANOSECONDS
    still = np.flatnonzero((seconds > AT_S + 2.0) & (seconds < AT_S + 58.0))[[0, -1]]

    def moved(trajectory: Trajectory) -> float:
        return float(np.linalg.norm(np.diff(trajectory.poses.translation[still], axis=0)))

    assert moved(log.truth) < 0.01
    for name, estimate in result.estimates.items():
        assert moved(estimate.trajectory) <= MOST * moved(chain(log.pairs)), name


@pytest.mark.parametrize("period_s", [1.0, 3.0, 15.0])
@pytest.mark.parametrize("amplitude", [0.5, 2.0])
def test_an_accelerometer_that_wanders_is_hardly_believed(amplitude: float, period_s: float) -> None:
    """Its swings would pass for scale errors of the pairs, which seem to be many times what they are."""
    imu = faults.swinging_accelerometer(_drive().imu, amplitude * np.array([1.0, 1.0, 0.0]), period_s)
    result = _fused(replace(_drive(), imu=imu))
    _assert_no_worse(result)
    if period_s > 1.0:  # faster than the bias has states, the smaller one is noise
        assert "accelerometer's bias wanders" in result.estimates["posegraph"].note


def test_an_accelerometer_that_contradicts_the_motion_is_seen_by_the_graph() -> None:
    """Two axes are in the wrong order, which its magnitude does not show: both back ends leave the IMU out."""
    imu = _drive().imu
    result = _fused(replace(_drive(), imu=replace(imu, linear_acceleration=imu.linear_acceleration[:, [1, 0, 2]])))
    _assert_no_worse(result)
    assert result.calibration.used
    assert "no solution" in result.estimates["posegraph"].note
    assert "no IMU" in result.estimates["ekf"].note


def test_a_short_log_may_be_as_rough_as_a_stretch_of_its_length(monkeypatch: pytest.MonkeyPatch) -> None:
    """What is accepted falls with the number of steps, of which there are no more than the IMU was used on."""
    accepted = [posegraph._accepted(steps) for steps in (20, 51, 100, 200, 301, 1000)]
    assert accepted == sorted(accepted, reverse=True)
    assert accepted[:2] == [9.0, 9.0]
    assert accepted[4:] == [3.2, 3.2]
    seen = re.search(r"IMU on (\d+) of", _sound().estimates["posegraph"].note)
    assert seen is not None
    monkeypatch.setattr(posegraph, "MAX_IMU_SQUARES", {51: 0.9, 301: 0.1})  # a sound IMU is rougher than that
    said = re.search(r"where (\S+) are accepted, for (\d+) frames", _fused(_drive()).estimates["posegraph"].note)
    assert said is not None
    assert float(said[1]) == pytest.approx(np.sqrt(posegraph._accepted(int(said[2]))), abs=0.05)
    assert int(said[2]) <= int(seen[1])


REAL_FAULTS: dict[str, Callable[[ImuSeries], ImuSeries]] = {
    "bias step": lambda imu: faults.gyro_bias_step(imu, 80.0, BIAS_STEP),
    "clock jump": lambda imu: faults.clock_jump(imu, 80.0, 0.3),
    "small clock jump": lambda imu: faults.clock_jump(imu, 80.0, 0.05),
}


@pytest.mark.parametrize("fault", REAL_FAULTS)
def test_a_faulty_imu_makes_a_published_odometry_no_worse(fault: str, shared_data: Path) -> None:
    """KITTI 09 with its real IMU, which a fault befalls halfway: t_rel stays below raw, and ATE within the bound."""
    odometry = shared_data / "kitti" / "odometry"
    stamps = read_times(odometry / "sequences" / "09" / "times.txt")
    imu = read_imu_mat(odometry / "imu" / "09.mat", stamps)
    pairs = pair_estimates(read_kitti(odometry / "published/example_1" / "09.txt", stamps), 0.04, 5e-4)
    truth = read_kitti(odometry / "poses" / "09.txt", stamps)
    result = _fused(Log(truth, pairs, REAL_FAULTS[fault](imu)))
    assert result.calibration.used, result.calibration.reason
    assert len(result.calibration.clock_jumps) == ("clock jump" in fault)
    _assert_no_worse(result)
