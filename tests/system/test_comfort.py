"""What a run shows and hands over: pipes, silence, exports, and what is left of it after Ctrl-C."""

import json
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fusion import run
from fusion_io.reader import open_log

pytestmark = pytest.mark.usefixtures("no_pictures")


@pytest.fixture
def drive(simulated_drive: Callable[..., Any]) -> Any:
    return simulated_drive(3.0)


@pytest.fixture
def log(drive: Any, tmp_path: Path) -> Path:
    """A log with recorded pairs."""
    path: Path = drive.write(tmp_path / "in.mcap", leave_out=["frames"])
    return path


def test_json_on_stdout_is_all_that_stands_there(log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """`--json -` pipes metrics.json; the table goes to stderr."""
    assert run.main(["--log", str(log), "--out", str(tmp_path / "out"), "--json", "-"]) == 0
    captured = capsys.readouterr()
    assert json.loads(captured.out) == json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert "pose graph" in captured.err


def test_quiet_prints_nothing_when_all_is_well(log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    json_file = tmp_path / "copy.json"
    arguments = ["--log", str(log), "--out", str(tmp_path / "out"), "--quiet", "--json", str(json_file)]
    assert run.main(arguments) == 0
    assert capsys.readouterr() == ("", "")
    assert json.loads(json_file.read_text())["schema"] >= 1


def test_a_pipe_gets_no_colours(log: Path, tmp_path: Path) -> None:
    command = [sys.executable, "-m", "fusion.run", "--log", log, "--out", tmp_path / "out", "--backend", "ekf"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "EKF" in done.stdout
    assert "\x1b" not in done.stdout + done.stderr


def test_a_run_exports_what_it_wrote(log: Path, tmp_path: Path) -> None:
    assert run.main(["--log", str(log), "--out", str(tmp_path / "out"), "--csv", str(tmp_path / "csv")]) == 0
    table = np.genfromtxt(tmp_path / "csv" / "trajectory_ekf.csv", delimiter=",", names=True)
    written = open_log(tmp_path / "out" / "run.mcap").trajectory("ekf")
    assert written is not None
    np.testing.assert_array_equal(table["z_m"], written.poses.translation[:, 2])


# --- Ctrl-C -------------------------------------------------------------------------------------


@pytest.fixture
def interrupt_after(monkeypatch: pytest.MonkeyPatch) -> Callable[[int], None]:
    """interrupt_after(n): Ctrl-C once n pairs are estimated, while the threads of the estimator are at work."""

    def install(count: int) -> None:
        from learned import estimator

        estimate_pairs = estimator.estimate_pairs

        def interrupted(*arguments: Any) -> Iterator[Any]:
            for i, pair in enumerate(estimate_pairs(*arguments)):
                if i == count:
                    signal.raise_signal(signal.SIGINT)
                yield pair

        monkeypatch.setattr(estimator, "estimate_pairs", interrupted)

    return install


@pytest.fixture
def images_only(drive: Any, tmp_path: Path, small_weights: Path) -> list[str]:
    """The command line of a run that estimates pairs, without refinement."""
    drive.write(tmp_path / "in.mcap", leave_out=["pairs"])
    options = ["--out", str(tmp_path / "out"), "--weights", str(small_weights), "--no-refine", "--record", "all"]
    return ["--log", str(tmp_path / "in.mcap"), *options]


def test_ctrl_c_leaves_a_valid_result_of_the_pairs_until_then(
    images_only: list[str], tmp_path: Path, interrupt_after: Callable[[int], None], capsys: pytest.CaptureFixture[str]
) -> None:
    """Exit code 130, all files, trajectories and run.mcap that end where the pairs end, and a replay of the same."""
    interrupt_after(12)
    assert run.main(images_only) == 130
    assert "warning: interrupted: results are of the first 1.2 s only" in capsys.readouterr().err
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert metrics["log"]["warnings"]["interrupted"] == 1
    assert metrics["log"]["pairs"] == 12
    assert metrics["log"]["frames"] == 13
    assert (tmp_path / "out" / "raw.tum").read_text().count("\n") == 13
    partial = open_log(tmp_path / "out" / "run.mcap")
    assert not partial.damaged
    assert len(partial.frame_stamps()) == 13
    assert len(list(partial.frames())) == 13
    assert [len(each.hypotheses_translation) for each in partial.levels()] == 12 * [5]
    assert run.main(["--log", str(tmp_path / "out" / "run.mcap"), "--out", str(tmp_path / "again")]) == 0
    assert (tmp_path / "again" / "raw.tum").read_bytes() == (tmp_path / "out" / "raw.tum").read_bytes()


def test_ctrl_c_before_the_first_pair_leaves_no_result(
    images_only: list[str], tmp_path: Path, interrupt_after: Callable[[int], None], capsys: pytest.CaptureFixture[str]
) -> None:
    interrupt_after(0)
    assert run.main(images_only) == 130
    assert capsys.readouterr().err == "interrupted: nothing to show for it\n"
    assert not (tmp_path / "out").exists()
