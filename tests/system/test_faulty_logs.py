"""Whole runs on logs whose sensors are faulty: what comes out is no worse than raw, and says what was wrong."""

import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import fault_samples as faults
import numpy as np
import pytest

from fusion import run
from fusion_io.records import NANOSECONDS
from fusion_io.writer import LogWriter


@pytest.fixture(scope="module", autouse=True)
def _no_pictures() -> Iterator[None]:
    """Pictures take most of a small run's time, and have their own tests."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("fusion.output.write_plots", lambda folder, outcome: None)
        yield


@pytest.fixture(scope="module")
def drive() -> faults.Log:
    return faults.simulated(1, 50.0)


def _run(drive: faults.Log, folder: Path) -> dict[str, Any]:
    """metrics.json of a run on a log of the drive."""
    with LogWriter(folder / "log.mcap") as log:
        log.imu(drive.imu)
        log.pairs(drive.pairs)
        log.ground_truth(drive.truth)
    assert run.main(["--log", str(folder / "log.mcap"), "--out", str(folder), "--quiet"]) == 0
    document: dict[str, Any] = json.loads((folder / "metrics.json").read_text())
    return document


def _assert_no_worse(document: dict[str, Any]) -> None:
    """Each back end: ATE at most 1.05 times raw."""
    ate_m = {name: metrics["ate_m"] for name, metrics in document["trajectories"].items()}
    for name in ("posegraph", "ekf"):
        assert ate_m[name] <= 1.05 * ate_m["raw"], (name, ate_m)


def test_a_stuck_gyro_a_bias_step_and_wrong_pairs_are_survived_and_named(tmp_path: Path, drive: faults.Log) -> None:
    imu = faults.gyro_bias_step(faults.stuck_gyro(drive.imu, 10.0, 5.0), 30.0, np.array([0.02, -0.01, 0.03]))
    pairs, wrong = faults.wrong_pairs(drive.pairs, 0.05, 0)
    document = _run(replace(drive, imu=imu, pairs=pairs), tmp_path)
    _assert_no_worse(document)
    assert document["calibration"]["used"]
    assert "bias steps" in document["calibration"]["reason"]
    assert document["log"]["warnings"]["imu_faulty_stretches"] >= 1
    assert document["log"]["warnings"]["posegraph_rejected"] >= 0.9 * len(wrong)
    report = (tmp_path / "report.html").read_text()
    for name in ("sensor stuck", "wrong pairs"):
        assert name in report


def test_a_clock_that_goes_back_in_the_middle_is_set_right(tmp_path: Path, drive: faults.Log) -> None:
    """Samples that repeat the past are counted and left out, and those after them are used at their true times."""
    stamps_ns = drive.imu.stamps_ns
    back_ns = np.where(stamps_ns >= stamps_ns[0] + 25 * NANOSECONDS, 2 * NANOSECONDS, 0)
    document = _run(replace(drive, imu=replace(drive.imu, stamps_ns=stamps_ns - back_ns)), tmp_path)
    _assert_no_worse(document)
    assert document["log"]["warnings"]["imu_backward"] == 200
    assert document["calibration"]["used"]
    assert "clock jumps by -" in document["calibration"]["reason"]


@pytest.mark.parametrize("exists", [False, True])
def test_a_refused_log_leaves_no_empty_folder_but_takes_none_away(
    exists: bool, tmp_path: Path, simulated_drive: Callable[..., Any]
) -> None:
    log = simulated_drive(1.0).write(tmp_path / "log.mcap", leave_out=["pairs", "frames"])
    out = tmp_path / "out"
    if exists:
        out.mkdir()
    assert run.main(["--log", str(log), "--out", str(out)]) == 1
    assert out.exists() == exists


def test_after_a_hole_in_everything_printout_and_page_call_the_pose_lost(
    tmp_path: Path, drive: faults.Log, capsys: pytest.CaptureFixture[str]
) -> None:
    start_ns = drive.pairs[0].source_stamp_ns
    seconds = (drive.imu.stamps_ns - start_ns) / NANOSECONDS
    kept = (seconds < 20.0) | (seconds >= 32.0)
    imu = replace(
        drive.imu,
        stamps_ns=drive.imu.stamps_ns[kept],
        angular_velocity=drive.imu.angular_velocity[kept],
        linear_acceleration=drive.imu.linear_acceleration[kept],
    )
    pairs = [
        pair
        for pair in drive.pairs
        if pair.target_stamp_ns <= start_ns + 20 * NANOSECONDS or pair.source_stamp_ns >= start_ns + 32 * NANOSECONDS
    ]
    holed = replace(drive, imu=imu, pairs=pairs)
    with LogWriter(tmp_path / "log.mcap") as log:
        log.imu(holed.imu)
        log.pairs(holed.pairs)
    assert run.main(["--log", str(tmp_path / "log.mcap"), "--out", str(tmp_path)]) == 0
    lost = "The absolute pose is lost after 20.0 s: nothing measured the motion from 20.0 to 32.0 s"
    assert lost in capsys.readouterr().out
    assert f'<p id="verdict" class="bad">{lost}' in (tmp_path / "report.html").read_text()
