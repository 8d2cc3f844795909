"""Whole commands of the network: evaluation on real streets, and a small training."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

SAMPLE = Path(__file__).resolve().parents[2] / "samples" / "kitti06.mcap"


def evaluate(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "learned.evaluate", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def assert_learned(figures: dict[str, object]) -> None:
    """The network knows real streets that it was not trained on, and every level corrects the one before."""
    assert figures["translation_rmse_m"] <= 0.08
    assert figures["rotation_rmse_rad"] <= 2.5e-3
    levels = [level["translation_rmse_m"] for level in figures["by_level"]]
    assert levels == sorted(levels, reverse=True)
    assert len(figures["by_level"]) == 5
    assert len(figures["by_hypothesis"]) == 4
    assert [b["name"] for b in figures["baselines"]] == ["zero motion", "mean motion", "IMU only (level 0)"]
    assert figures["winner"]["translation_rmse_m"] < figures["mean_of_hypotheses"]["translation_rmse_m"]
    for name in ("translation_rmse_m", "rotation_rmse_rad", "anees", "coverage_95", "nll", "nll_constant"):
        assert figures[name] == figures["refined"][name]
    assert figures["refined"]["translation_rmse_m"] < figures["network"]["translation_rmse_m"]
    assert figures["anees"] > 0
    assert figures["pairs_per_second"] > 0


def test_shipped_weights_know_a_real_street(tmp_path: Path) -> None:
    out = tmp_path / "e.json"
    done = evaluate("--log", SAMPLE, "--json", out)
    assert done.returncode == 0, done.stderr
    figures = json.loads(out.read_text())
    assert figures["pairs"] == 50
    assert_learned(figures)
    assert "ANEES" in done.stdout


def test_shipped_weights_know_a_full_size_drive_with_missing_frames(tmp_path: Path, shared_data: Path) -> None:
    day = shared_data / "kitti" / "raw" / "2011_09_26"
    log, out = tmp_path / "drive.mcap", tmp_path / "e.json"
    convert = [sys.executable, "-m", "fusion_io.convert", "kitti-raw", "--drive", day / "2011_09_26_drive_0039_sync"]
    subprocess.run([*convert, "--calib", day, "--out", log], check=True, capture_output=True)
    done = evaluate("--log", log, "--json", out)
    assert done.returncode == 0, done.stderr
    figures = json.loads(out.read_text())
    # 249 frames of 250 exist; the one without depth is the last before the missing one, so that a single step is lost,
    # and one pair reaches beyond the ground truth.
    assert figures["pairs"] == 246
    assert figures["skipped"]["pairs_over_missing_frames"] == 1
    assert_learned(figures)


def test_a_file_that_is_no_log_is_refused_in_a_line(tmp_path: Path) -> None:
    text = tmp_path / "text.mcap"
    text.write_text("hello\n")
    done = evaluate("--log", text)
    assert done.returncode == 1
    assert done.stderr.startswith("error: ")
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize("arguments", [(), ("--log",), ("--nonsense",)])
def test_wrong_usage_ends_with_2(arguments: tuple[str, ...]) -> None:
    assert evaluate(*arguments).returncode == 2
