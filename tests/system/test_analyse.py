"""The command that says whether a log is good enough to run: verdict, reasons, files, exit codes."""

import json
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fusion import analyse, run
from fusion_io.records import ImuSeries


@pytest.fixture
def drive(simulated_drive: Callable[..., Any]) -> Any:
    return simulated_drive(30.0)


def analysed(log: Path, *options: str) -> tuple[int, dict[str, Any]]:
    """Exit code and document of an analysis."""
    out = log.with_suffix(".json")
    code = analyse.main([str(log), "--json", str(out), *options])
    return code, json.loads(out.read_text())


def reasons(document: dict[str, Any], level: str) -> list[str]:
    return [f"{each['topic']}: {each['text']}" for each in document["verdict"]["reasons"] if each["level"] == level]


def test_a_good_log_is_ready(drive: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code, document = analysed(drive.write(tmp_path / "good.mcap"))
    assert code == 0
    assert document["verdict"]["answer"] == "ready", document["verdict"]
    assert document["log"]["frames"] == len(drive.frames)
    assert document["topics"]["/imu"]["rate_hz"] == 100.0
    assert document["images"]["/camera/image"]["repeated"] == 0
    assert document["depth"]["/camera/depth"]["coverage"]["median"] == 1.0
    printed = capsys.readouterr().out
    assert printed.startswith("good.mcap: ready\n")
    assert "/camera/image" in printed


@pytest.mark.parametrize(
    ("leave_out", "level", "text"),
    [
        (["frames", "pairs"], "blocks", "no pair estimates, and to make some it lacks images, depth, camera info"),
        (["camera_info", "pairs"], "blocks", "to make some it lacks camera info"),
        (["imu"], "limit", "no IMU"),
        (["ground_truth"], "note", "no ground truth"),
    ],
)
def test_what_is_missing_is_named(drive: Any, tmp_path: Path, leave_out: list[str], level: str, text: str) -> None:
    code, document = analysed(drive.write(tmp_path / "a.mcap", leave_out))
    assert code == (1 if level == "blocks" else 0)  # as a run would end
    assert any(text in reason for reason in reasons(document, level))
    answers = {"blocks": "not usable", "limit": "usable with limits", "note": "ready"}
    assert document["verdict"]["answer"] == answers[level]


def test_a_hole_in_the_imu_is_a_limit_with_its_time(drive: Any, tmp_path: Path) -> None:
    stamps = drive.imu.stamps_ns
    kept = (stamps < stamps[400]) | (stamps > stamps[600])
    drive.imu = ImuSeries(stamps[kept], drive.imu.angular_velocity[kept], drive.imu.linear_acceleration[kept])
    _, document = analysed(drive.write(tmp_path / "a.mcap"))
    assert document["verdict"]["answer"] == "usable with limits"
    (reason,) = [each for each in document["verdict"]["reasons"] if "IMU gap" in each["text"]]
    assert (reason["topic"], reason["level"]) == ("/imu", "limit")
    assert reason["time_s"] == pytest.approx(stamps[399] / 1e9)
    assert document["topics"]["/imu"]["longest_gap_s"] == pytest.approx(2.02)


def test_an_imu_that_a_run_would_leave_out_is_a_limit(drive: Any, tmp_path: Path) -> None:
    _, document = analysed(drive.write(tmp_path / "good.mcap"))
    assert document["calibration"]["used"]
    drive.imu = ImuSeries(drive.imu.stamps_ns, drive.imu.angular_velocity[::-1], drive.imu.linear_acceleration)
    _, document = analysed(drive.write(tmp_path / "bad.mcap"))
    assert not document["calibration"]["used"]
    assert any("/imu: the IMU would be left out: " in reason for reason in reasons(document, "limit"))


def test_dark_images_and_missing_depth_are_reasons(drive: Any, tmp_path: Path) -> None:
    for frame in drive.frames:
        frame.image[:] //= 64
        frame.depth[:, 10:] = 0
    _, document = analysed(drive.write(tmp_path / "a.mcap"))
    limits = reasons(document, "limit")
    assert any("/camera/image: 40 of 40 sampled images are nearly black" in reason for reason in limits)
    assert any("/camera/depth: 40 of 40 sampled depth images cover less than 20%" in reason for reason in limits)
    for frame in drive.frames:
        frame.depth[:] = 0
    _, document = analysed(drive.write(tmp_path / "b.mcap"))
    assert reasons(document, "blocks") == ["/camera/depth: no depth in any sampled image"]


def test_dropped_and_repeated_frames_are_reasons(drive: Any, tmp_path: Path) -> None:
    del drive.frames[40:60]
    for frame in drive.frames[60:]:
        frame.image[:] = drive.frames[60].image
    _, document = analysed(drive.write(tmp_path / "a.mcap"))
    limits = reasons(document, "limit")
    assert any("dropped frames, 20 frames missing" in reason for reason in limits)
    assert any("the same as the one sampled before" in reason for reason in limits)


@pytest.mark.usefixtures("no_pictures")
def test_an_output_log_is_analysed_with_its_results(drive: Any, tmp_path: Path) -> None:
    log = drive.write(tmp_path / "a.mcap")
    assert run.main(["--log", str(log), "--out", str(tmp_path / "out")]) == 0
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())["trajectories"]
    code, document = analysed(tmp_path / "out" / "run.mcap")
    assert code == 0
    assert {"raw", "posegraph", "ekf"} <= set(document["trajectories"])
    for name, result in document["trajectories"].items():
        assert result["poses"] == len(drive.frames)
        assert result["metrics"]["ate_m"] == pytest.approx(metrics[name]["ate_m"], rel=1e-6)
        assert result["end_sigma_m"] > 0


def test_a_cut_log_is_analysed_and_ends_with_3(drive: Any, tmp_path: Path) -> None:
    whole = drive.write(tmp_path / "whole.mcap").read_bytes()
    (tmp_path / "cut.mcap").write_bytes(whole[: len(whole) // 2])
    code, document = analysed(tmp_path / "cut.mcap")
    assert code == 3
    assert document["log"]["damaged"]
    assert any("the file is cut or unfinished" in reason for reason in reasons(document, "limit"))


def test_the_page_is_written_and_json_goes_to_a_pipe(drive: Any, tmp_path: Path) -> None:
    log = drive.write(tmp_path / "a.mcap")
    words = [sys.executable, "-m", "fusion.analyse", str(log), "--json", "-", "--html", "new/page.html"]
    result = subprocess.run(words, capture_output=True, text=True, check=False, cwd=tmp_path)
    assert (result.returncode, result.stderr) == (0, "")
    assert json.loads(result.stdout)["verdict"]["answer"] == "ready"
    assert (tmp_path / "new" / "page.html").read_text().startswith("<!doctype html>")


@pytest.mark.parametrize(
    ("options", "code", "message"),
    [
        (["text.txt"], 1, "text.txt: not an MCAP file"),
        (["empty.mcap"], 1, "empty.mcap: the file is empty"),
        (["nothing.mcap"], 1, "nothing.mcap: cannot be read: No such file or directory"),
        (["good.mcap", "--topic", "wheel=/x"], 2, "there is no role 'wheel'"),
        (["good.mcap", "--topic", "imu=/nope"], 2, "topic /nope cannot be the imu; /imu could be"),
        (["good.mcap", "--topic", "imu=/ground_truth"], 2, "topic /ground_truth cannot be the imu; /imu could be"),
        (["good.mcap", "--html", "text.txt/page.html"], 1, "page.html: cannot be written"),
    ],
)
def test_what_cannot_be_done_is_said_in_one_line(
    drive: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
    options: list[str], code: int, message: str,
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    Path("text.txt").write_text("no log")
    Path("empty.mcap").touch()
    drive.write(Path("good.mcap"), ["frames"])
    assert analyse.main(options) == code
    error = capsys.readouterr().err
    assert message in error
    assert error.startswith("error: ")
    assert error.count("\n") == 1


def test_every_foreign_log_is_analysed(shared_data: Path, tmp_path: Path) -> None:
    logs = sorted((shared_data / "foreign_mcap").glob("*.mcap"))
    assert logs
    for log in logs:
        copy = Path(shutil.copy(log, tmp_path))
        copy.chmod(0o644)
        code, document = analysed(copy, "--html", str(tmp_path / "page.html"))
        assert code == 1
        assert document["verdict"]["answer"] == "not usable"
        assert document["verdict"]["reasons"][0]["level"] == "blocks"
        assert document["topics"]
    chosen = tmp_path / "lichtblick_camera_json.mcap"
    _, document = analysed(chosen, "--topic", "camera_info=/camera_calibration")
    assert document["images"]["/image/compressed"]["width"] == 520
    assert document["log"]["roles"]["camera_info"] == "/camera_calibration"


def test_the_sample_is_usable_and_its_filled_in_imu_is_named() -> None:
    sample = Path(__file__).parents[2] / "samples" / "kitti06.mcap"
    from fusion.analysis import analyse as look
    from fusion.analysis import document

    found = document(look(sample, {}))
    assert found["verdict"]["answer"] == "usable with limits"
    assert any("/imu: sensor stuck, the gyro runs in equal steps" in reason for reason in reasons(found, "limit"))
    np.testing.assert_allclose(found["depth"]["/camera/depth"]["coverage"]["median"], 0.8, atol=0.05)
