"""Whole commands of training: KITTI's three with an interruption, and a mixture."""

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from learned import weights

SAMPLE = Path(__file__).resolve().parents[2] / "samples" / "kitti06.mcap"
SMALL = ("--batch", "2", "--calibration-clips", "2", "--workers", "1", "--threads", "1")


def run(module: str, *arguments: str | Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", module, *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def test_kitti_in_three_commands_of_which_the_second_is_interrupted(tmp_path: Path, shared_data: Path) -> None:
    """Convert, train, evaluate, as docs/training.md has it, with a few frames; enough steps to be interrupted in."""
    root, log, out = shared_data / "kitti" / "odometry", tmp_path / "06.mcap", tmp_path / "out"
    done = run("fusion_io.convert", "kitti-odometry", "--root", root, "--sequence", "06", "--frames", "0:10",
               "--imu", root / "imu" / "06.mat", "--out", log)  # fmt: skip
    assert done.returncode == 0, done.stderr

    arguments = ["--data", log, "--steps", "30", *SMALL, "--out", out]
    command = [sys.executable, "-m", "learned.train", *map(str, arguments)]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    while not (out / "curve.csv").exists():  # the steps begin
        assert process.poll() is None
        time.sleep(0.001)
    process.send_signal(signal.SIGINT)
    _, stderr = process.communicate()
    assert process.returncode == 130, stderr
    assert stderr.splitlines()[-1].endswith("run the same command again to go on")
    assert (out / "checkpoint.pt").exists()
    done = run("learned.train", *arguments)
    assert done.returncode == 0, done.stderr

    done = run(
        "fusion.run", "--log", log, "--weights", out / "fast.pt", "--segment-lengths", "2", "--out", tmp_path / "r"
    )
    assert done.returncode == 0, done.stderr
    metrics = json.loads((tmp_path / "r" / "metrics.json").read_text())
    assert metrics["trajectories"]["raw"]["t_rel_percent"] > 0


def test_training_on_a_mixture_leaves_weights_curves_and_pictures(tmp_path: Path) -> None:
    """No truth is known of the log's pairs: the curve's errors are those of the simulated ones."""
    out = tmp_path / "out"
    done = run("learned.train", "--data", "sim:2@2", f"{SAMPLE}@0.5", "--steps", "2", *SMALL, "--out", out)
    assert done.returncode == 0, done.stderr
    loaded = weights.load(out / "fast.pt")
    assert all(floor > 0 for floor in (*loaded.covariance.floor, *loaded.refined_covariance.floor))
    (header, row) = (out / "curve.csv").read_text().splitlines()
    assert len(header.split(",")) == len(row.split(",")) == 8
    assert all(float(value) > 0 for value in row.split(","))
    for picture in (out / "pictures" / "step-000002.png", out / "curve.png"):
        assert picture.read_bytes().startswith(b"\x89PNG")
    refused = run("learned.train", "--data", "sim:2@2", f"{SAMPLE}@2", "--steps", "2", *SMALL, "--out", out)
    assert refused.returncode == 2
    assert refused.stderr.count("\n") == 1


def test_a_log_that_cannot_be_trained_on_is_refused_in_a_line(tmp_path: Path) -> None:
    text = tmp_path / "text.mcap"
    text.write_text("hello\n")
    done = run("learned.train", "--data", text, "--out", tmp_path / "out")
    assert done.returncode == 1
    assert done.stderr.startswith("error: ")
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize(
    "arguments", [(), ("--out",), ("--out", "x", "--steps", "0"), ("--out", "x", "--data", "sim:a")]
)
def test_wrong_usage_ends_with_2(arguments: tuple[str, ...]) -> None:
    assert run("learned.train", *arguments).returncode == 2
