"""Laws of the command: bad input is one line and an exit code, and what was lost is said in sentences."""

import json
from collections import Counter
from pathlib import Path

import log_samples
import numpy as np
import pytest
import torch

from fusion_io.records import CameraFrame, CameraInfo
from fusion_io.writer import LogWriter
from learned import evaluate, weights
from learned.covariance import CovarianceModel
from learned.violearner import NetworkConfig, VIOLearner
from learned.weights import Weights

TINY = NetworkConfig(height=32, width=64, trunk_filters=4, extra_filters=4, imu_filters=(2, 2, 4, 4, 4, 4, 4))


@pytest.fixture(scope="module")
def tiny(tmp_path_factory: pytest.TempPathFactory) -> Path:
    torch.manual_seed(0)
    path = tmp_path_factory.mktemp("weights") / "tiny.pt"
    weights.save(path, Weights(VIOLearner(TINY), CovarianceModel(), CovarianceModel(), CovarianceModel()), {})
    return path


def _log(path: Path, frames: int = 6, truth: int = 6, depth: bool = True) -> Path:
    """Frames ten times a second, with an IMU, and ground truth of so many poses."""
    with LogWriter(path) as log:
        log.imu(log_samples.imu_series(10 * frames))
        if truth:
            log.ground_truth(log_samples.trajectory(truth))
        for frame in log_samples.frames(frames):
            log.frame(frame if depth else CameraFrame(frame.stamp_ns, frame.image, None, frame.camera))
    return path


def _run(*arguments: str | Path) -> int:
    return evaluate.main([str(argument) for argument in arguments])


def _only_error(capsys: pytest.CaptureFixture[str]) -> str:
    """The line on stderr."""
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert lines[0].startswith("error: ")
    return lines[0]


def test_figures_and_pictures_are_written_and_shown(
    tmp_path: Path, tiny: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log, out, drawn = _log(tmp_path / "log.mcap"), tmp_path / "new" / "e.json", tmp_path / "plots"
    assert _run("--log", log, "--weights", tiny, "--json", out, "--plots", drawn, "--baselines") == 0
    found = json.loads(out.read_text())
    assert found["pairs"] == 5
    assert len(list(drawn.glob("*.png"))) == 6
    printed = capsys.readouterr().out
    assert max(map(len, printed.splitlines())) <= 100
    for word in ("log.mcap: 5 pairs", "ANEES", "level 4", "mean of hypotheses", "classical RGB-D odometry"):
        assert word in printed


def test_baselines_are_of_the_same_pairs_and_timed_in_the_same_run(tmp_path: Path, tiny: Path) -> None:
    found = evaluate.evaluate(_log(tmp_path / "log.mcap"), tiny, baselines=True).figures
    names = ["zero motion", "mean motion", "IMU only (level 0)", "classical RGB-D odometry"]
    assert [row["name"] for row in found["baselines"]] == names
    imu_only, classical = found["baselines"][2:]
    assert imu_only["translation_rmse_m"] == found["by_level"][0]["translation_rmse_m"]
    assert classical["failures"] == 5  # the images are noise
    still = found["baselines"][0]
    assert classical["translation_rmse_m"] == still["translation_rmse_m"]  # nothing to go on with but standing still
    for row in (classical, found["network"], found["refined"]):
        assert row["seconds_per_pair"] > 0
        assert row["cpu_seconds_per_pair"] > 0
    assert found["threads"]["torch"] >= 1
    assert found["agreement"] is None  # with nothing


def test_the_classical_odometry_gets_the_frames_of_every_pair_in_order(monkeypatch: pytest.MonkeyPatch) -> None:
    from learned import baselines

    def motion(source: CameraFrame, target: CameraFrame) -> baselines.Motion | None:
        T = np.eye(4)
        T[2, 3] = target.stamp_ns - source.stamp_ns
        return baselines.Motion(T, 99) if source.stamp_ns else None

    monkeypatch.setattr(baselines, "rgbd_odometry", motion)
    camera = CameraInfo(4, 4, np.eye(3))
    frames = [CameraFrame(s, np.zeros((4, 4), np.uint8), np.ones((4, 4), np.float32), camera) for s in (0, 10, 25, 100)]
    found = evaluate.classical_motions(frames, {(0, 10), (10, 25)})
    assert list(found) == [(0, 10), (10, 25)]
    assert found[0, 10] is None
    assert found[10, 25][2, 3] == 15


def test_without_baselines_only_the_constant_motions_and_the_imu_are_compared(tmp_path: Path, tiny: Path) -> None:
    found = evaluate.evaluate(_log(tmp_path / "log.mcap"), tiny).figures
    assert [row["name"] for row in found["baselines"]] == ["zero motion", "mean motion", "IMU only (level 0)"]
    assert "threads" not in found


def test_a_log_without_imu_has_no_estimate_from_the_imu_only(tmp_path: Path, tiny: Path) -> None:
    with LogWriter(tmp_path / "log.mcap") as log:
        log.ground_truth(log_samples.trajectory(4))
        for frame in log_samples.frames(4):
            log.frame(frame)
    found = evaluate.evaluate(tmp_path / "log.mcap", tiny).figures
    assert [row["name"] for row in found["baselines"]] == ["zero motion", "mean motion"]


def test_a_log_without_ground_truth_is_refused(tmp_path: Path, tiny: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert _run("--log", _log(tmp_path / "log.mcap", truth=0), "--weights", tiny) == 1
    assert "log.mcap: no ground truth" in _only_error(capsys)


def test_ground_truth_of_another_time_is_refused(
    tmp_path: Path, tiny: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert _run("--log", _log(tmp_path / "log.mcap", truth=1), "--weights", tiny) == 1
    assert "log.mcap: none of its 5 estimated pairs" in capsys.readouterr().err.splitlines()[-1]


def test_a_log_without_depth_is_refused(tmp_path: Path, tiny: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert _run("--log", _log(tmp_path / "log.mcap", depth=False), "--weights", tiny) == 1
    assert "log.mcap" in capsys.readouterr().err.splitlines()[-1]


def test_a_single_frame_is_refused(tmp_path: Path, tiny: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert _run("--log", _log(tmp_path / "log.mcap", frames=1), "--weights", tiny) == 1
    assert "log.mcap: none of its 0 estimated pairs" in _only_error(capsys)


def test_missing_weights_and_logs_are_named(tmp_path: Path, tiny: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert _run("--log", _log(tmp_path / "log.mcap"), "--weights", tmp_path / "none.pt") == 1
    assert "none.pt: no such weights file" in _only_error(capsys)
    assert _run("--log", tmp_path / "none.mcap", "--weights", tiny) == 1
    assert "none.mcap" in _only_error(capsys)


@pytest.mark.parametrize("option", ["--json", "--plots"])
def test_results_that_cannot_be_written_are_refused_before_the_work(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], option: str
) -> None:
    (tmp_path / "file").write_text("")
    assert _run("--log", tmp_path / "none.mcap", option, tmp_path / "file" / "out") == 2
    assert str(tmp_path / "file") in _only_error(capsys)


def test_a_failed_evaluation_leaves_no_file(tmp_path: Path) -> None:
    assert _run("--log", tmp_path / "none.mcap", "--json", tmp_path / "e.json") == 1
    assert not (tmp_path / "e.json").exists()


def test_counts_are_said_in_sentences_that_name_the_log() -> None:
    counts = Counter({"pairs_without_depth": 1, "pairs_over_missing_frames": 3, "pairs_not_refined": 0})
    assert list(evaluate.sentences(Path("a.mcap"), counts)) == [
        "a.mcap: no estimate for 1 pair whose source has no depth",
        "a.mcap: no estimate for 3 pairs of frames with others missing between them",
    ]


def test_a_missing_frame_is_a_warning_that_names_the_log(
    tmp_path: Path, tiny: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    frames = log_samples.frames(8)
    with LogWriter(tmp_path / "log.mcap") as log:
        log.ground_truth(log_samples.trajectory(8))
        for frame in frames[:4] + frames[5:]:
            log.frame(frame)
    assert _run("--log", tmp_path / "log.mcap", "--weights", tiny) == 0
    warnings = capsys.readouterr().err.splitlines()
    assert any("log.mcap: no estimate for 1 pair of frames with others missing" in line for line in warnings)
