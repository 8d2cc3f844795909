"""Bad input is normal: each kind has its exit code and a line that says what was wrong, and nothing else is lost."""

import json
import resource
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fusion import run
from fusion_io.reader import open_log
from fusion_io.writer import LogWriter

pytestmark = pytest.mark.usefixtures("no_pictures")

Outcome = tuple[int, list[str], dict[str, Any] | None]


@pytest.fixture
def outcome(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Callable[..., Outcome]:
    """outcome(log, *options): exit code, lines on stderr, and metrics.json if there is one."""

    def compute(log: Path, *options: str) -> Outcome:
        out = tmp_path / "out"
        capsys.readouterr()
        code = run.main(["--log", str(log), "--out", str(out), *options])
        metrics = out / "metrics.json"
        return code, capsys.readouterr().err.splitlines(), json.loads(metrics.read_text()) if metrics.exists() else None

    return compute


@pytest.fixture
def drive(simulated_drive: Callable[..., Any]) -> Any:
    return simulated_drive(6.0)


def _assert_refused(outcome: Outcome, code: int, *words: str) -> None:
    """Ended with this code and one line that has these words, and nothing was computed."""
    actual, lines, document = outcome
    assert actual == code
    assert document is None
    assert len(lines) == 1
    assert lines[0].startswith("error: ")
    for word in words:
        assert word in lines[0]


def _assert_computed(outcome: Outcome, code: int, warning: str, count: int, *words: str) -> dict[str, Any]:
    """Ended with this code, this warning counted and said in one line that has these words."""
    actual, lines, document = outcome
    assert actual == code
    assert document is not None
    assert document["log"]["warnings"][warning] == count
    assert all(line.startswith("warning: ") for line in lines)
    assert sum(all(word in line for word in words) for line in lines) == 1
    return document


@pytest.fixture
def log_of_many_chunks(tmp_path: Path, drive: Any) -> Path:
    """Images that do not compress make the log some four megabytes long."""
    rng = np.random.default_rng(0)
    drive.frames = [
        replace(frame, image=rng.integers(0, 256, (240, 320), dtype=np.uint8), depth=None) for frame in drive.frames
    ]
    return drive.write(tmp_path / "whole.mcap")


def test_a_log_cut_in_the_middle_is_computed_as_far_as_it_goes(
    log_of_many_chunks: Path, outcome: Callable[..., Outcome]
) -> None:
    whole = log_of_many_chunks.read_bytes()
    cut = log_of_many_chunks.with_name("cut.mcap")
    cut.write_bytes(whole[: len(whole) // 2])
    document = _assert_computed(outcome(cut), 3, "truncated", 1, "cut.mcap", "cut or unfinished")
    assert 20 < document["log"]["pairs"] < 40


def test_one_flipped_byte_costs_one_chunk(log_of_many_chunks: Path, outcome: Callable[..., Outcome]) -> None:
    data = bytearray(log_of_many_chunks.read_bytes())
    data[len(data) // 2] ^= 0xFF
    flipped = log_of_many_chunks.with_name("flipped.mcap")
    flipped.write_bytes(data)
    document = _assert_computed(outcome(flipped), 3, "bad_chunks", 1, "flipped.mcap", "chunk", "damaged")
    assert 40 < document["log"]["pairs"] < 59
    assert document["log"]["frames"] >= document["log"]["pairs"] + 1


def test_images_without_camera_info_are_refused(
    tmp_path: Path, drive: Any, small_weights: Path, outcome: Callable[..., Outcome]
) -> None:
    log = drive.write(tmp_path / "log.mcap", leave_out=["camera_info", "pairs"])
    _assert_refused(outcome(log, "--weights", str(small_weights)), 1, "log.mcap", "no camera info")


def test_recorded_pairs_need_no_camera_info(tmp_path: Path, drive: Any, outcome: Callable[..., Outcome]) -> None:
    code, lines, document = outcome(drive.write(tmp_path / "log.mcap", leave_out=["camera_info"]))
    assert (code, lines) == (0, [])
    assert document is not None
    assert document["log"]["pairs"] == 59


def test_results_are_not_lost_for_images_that_cannot_be_copied(
    tmp_path: Path, drive: Any, outcome: Callable[..., Outcome]
) -> None:
    log = drive.write(tmp_path / "log.mcap", leave_out=["camera_info"])
    result = outcome(log, "--record", "all")
    document = _assert_computed(result, 0, "images_not_copied", 1, "images are left out", "no camera info")
    assert document["log"]["pairs"] == 59
    assert len(open_log(tmp_path / "out" / "run.mcap").frame_stamps()) == 60


def test_depth_that_cannot_belong_to_the_image_is_refused(
    tmp_path: Path, drive: Any, small_weights: Path, outcome: Callable[..., Outcome]
) -> None:
    drive.frames = [replace(frame, depth=np.full((30, 30), 8.0, dtype=np.float32)) for frame in drive.frames]
    log = drive.write(tmp_path / "log.mcap", leave_out=["pairs"])
    _assert_refused(outcome(log, "--weights", str(small_weights)), 1, "log.mcap", "/camera/depth", "30x30", "60x16")


def test_nan_in_the_imu_is_left_out_and_counted(tmp_path: Path, drive: Any, outcome: Callable[..., Outcome]) -> None:
    drive.imu.angular_velocity[[100, 250], 1] = np.nan
    drive.imu.linear_acceleration[400, 2] = np.inf
    document = _assert_computed(outcome(drive.write(tmp_path / "log.mcap")), 0, "imu_nan", 3, "/imu", "finite")
    assert document["log"]["imu_samples"] == 597


def test_imu_stamps_going_backwards_are_left_out_and_counted(
    tmp_path: Path, drive: Any, outcome: Callable[..., Outcome]
) -> None:
    drive.imu.stamps_ns[[200, 201]] -= 10**9
    document = _assert_computed(outcome(drive.write(tmp_path / "log.mcap")), 0, "imu_backward", 2, "/imu", "backward")
    assert document["log"]["imu_samples"] == 598


def test_duplicate_frames_are_left_out_and_counted(
    tmp_path: Path, drive: Any, small_weights: Path, outcome: Callable[..., Outcome]
) -> None:
    drive.frames.insert(30, drive.frames[30])
    log = drive.write(tmp_path / "log.mcap", leave_out=["pairs"])
    result = outcome(log, "--weights", str(small_weights))
    document = _assert_computed(result, 0, "duplicate_frames", 1, "/camera/image")
    assert document["log"]["frames"] == 60


def test_missing_frames_are_bridged_and_counted(
    tmp_path: Path, drive: Any, small_weights: Path, outcome: Callable[..., Outcome]
) -> None:
    del drive.frames[40:43], drive.frames[20]
    log = drive.write(tmp_path / "log.mcap", leave_out=["pairs"])
    document = _assert_computed(outcome(log, "--weights", str(small_weights)), 0, "gaps_bridged", 2, "bridged: 2")
    assert document["log"]["warnings"]["pairs_over_missing_frames"] == 2


def test_frames_without_any_depth_leave_nothing_to_compute(
    tmp_path: Path, drive: Any, small_weights: Path, outcome: Callable[..., Outcome]
) -> None:
    drive.frames = [replace(frame, depth=None) for frame in drive.frames]
    log = drive.write(tmp_path / "log.mcap", leave_out=["pairs"])
    _assert_refused(outcome(log, "--weights", str(small_weights)), 1, "log.mcap", "pairs without depth: 59")


def test_an_empty_file_is_refused(tmp_path: Path, outcome: Callable[..., Outcome]) -> None:
    (tmp_path / "log.mcap").touch()
    _assert_refused(outcome(tmp_path / "log.mcap"), 1, "log.mcap", "empty")


def test_a_log_without_messages_is_refused(tmp_path: Path, outcome: Callable[..., Outcome]) -> None:
    with LogWriter(tmp_path / "log.mcap"):
        pass
    _assert_refused(outcome(tmp_path / "log.mcap"), 1, "log.mcap", "nothing")


def test_an_imu_alone_is_not_enough(tmp_path: Path, drive: Any, outcome: Callable[..., Outcome]) -> None:
    log = drive.write(tmp_path / "log.mcap", leave_out=["frames", "pairs"])
    _assert_refused(outcome(log), 1, "log.mcap", "no images to estimate pairs from")


def test_a_text_file_is_refused(tmp_path: Path, outcome: Callable[..., Outcome]) -> None:
    (tmp_path / "log.mcap").write_text("hello\n")
    _assert_refused(outcome(tmp_path / "log.mcap"), 1, "log.mcap", "not an MCAP file")


def test_a_log_that_does_not_exist_is_refused(tmp_path: Path, outcome: Callable[..., Outcome]) -> None:
    _assert_refused(outcome(tmp_path / "log.mcap"), 1, "log.mcap", "No such file")


def test_recorded_pairs_that_are_not_there_are_refused(
    tmp_path: Path, drive: Any, outcome: Callable[..., Outcome]
) -> None:
    log = drive.write(tmp_path / "log.mcap", leave_out=["pairs"])
    _assert_refused(outcome(log, "--frontend", "recorded"), 1, "log.mcap", "pair estimates")


def test_a_file_that_holds_no_weights_is_refused(tmp_path: Path, drive: Any, outcome: Callable[..., Outcome]) -> None:
    (tmp_path / "net.pt").write_text("hello\n")
    log = drive.write(tmp_path / "log.mcap", leave_out=["pairs"])
    _assert_refused(outcome(log, "--weights", str(tmp_path / "net.pt")), 1, "net.pt")


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--topic", "imu=/none"), ["/none", "/imu could be"]),
        (("--topic", "imagination=/camera/image"), ["imagination", "'topics.image'"]),
        (("--config", "none.toml"), ["none.toml"]),
        (("--segment-lengths", "10,-20"), ["segment_lengths_m", "-20"]),
    ],
)
def test_what_the_user_got_wrong_is_said_in_one_line(
    tmp_path: Path, drive: Any, outcome: Callable[..., Outcome], options: tuple[str, ...], words: list[str]
) -> None:
    _assert_refused(outcome(drive.write(tmp_path / "log.mcap"), *options), 2, *words)


@pytest.mark.parametrize(
    "options", [("--segment-lengths", "10;20"), ("--topic", "imu"), ("--backend", "isam"), ("-x",)]
)
def test_a_misspelt_option_ends_with_the_code_for_usage(options: tuple[str, ...]) -> None:
    with pytest.raises(SystemExit) as end:
        run.main(["--log", "log.mcap", *options])
    assert end.value.code == 2


def test_no_space_left_ends_in_one_line_and_leaves_no_half_file(tmp_path: Path, drive: Any) -> None:
    log = drive.write(tmp_path / "log.mcap")
    out = tmp_path / "out"
    limit = 20_000  # bytes: less than run.mcap needs

    def no_space() -> None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))

    command = [sys.executable, "-m", "fusion.run", "--log", str(log), "--out", str(out)]
    result = subprocess.run(command, capture_output=True, text=True, check=False, preexec_fn=no_space)
    assert result.returncode == 1
    assert result.stdout == ""
    (line,) = result.stderr.splitlines()
    assert line.startswith(f"error: {out / 'run.mcap'}: cannot be written")
    assert not out.exists()
