"""The main job as a whole: what it writes, what it prints, how it ends."""

import json
import re
import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from fusion import chain, posegraph, run
from fusion.measurements import Estimate, Measurements
from fusion_io import convert
from fusion_io.reader import open_log
from fusion_io.records import Trajectory
from fusion_io.trajectory_files import read_tum

pytestmark = pytest.mark.usefixtures("no_pictures")

NAMES = ("raw", "posegraph", "ekf")


def _run(log: Path, out: Path, *options: str) -> tuple[int, dict[str, Any]]:
    """Exit code and metrics.json of a run."""
    code = run.main(["--log", str(log), "--out", str(out), *options])
    return code, json.loads((out / "metrics.json").read_text())


def _trajectory_bytes(folder: Path) -> dict[str, bytes]:
    return {name: (folder / f"{name}.tum").read_bytes() for name in NAMES}


@dataclass(frozen=True)
class Command:
    """A finished command: its folder, what it printed, how it ended."""

    log: Path
    folder: Path
    result: subprocess.CompletedProcess[str]

    @property
    def document(self) -> dict[str, Any]:
        return json.loads((self.folder / "metrics.json").read_text())


@pytest.fixture(scope="module")
def command(tmp_path_factory: pytest.TempPathFactory, simulated_drive: Callable[..., Any]) -> Command:
    """The command as a user types it, on half a minute with recorded pair estimates and a good IMU."""
    folder = tmp_path_factory.mktemp("command")
    log = simulated_drive(30.0).write(folder / "drive.mcap")
    words = [sys.executable, "-m", "fusion.run", "--log", str(log), "--out", "out", "--segment-lengths", "20,50,100"]
    result = subprocess.run(words, capture_output=True, text=True, check=False, cwd=folder)
    return Command(log, folder / "out", result)


@pytest.fixture
def short_drive(simulated_drive: Callable[..., Any]) -> Any:
    """Three seconds, small enough for the network."""
    return simulated_drive(3.0)


def test_help_needs_none_of_the_heavy_packages() -> None:
    script = (
        "import sys\nfrom fusion.run import main\ntry:\n    main(['--help'])\nexcept SystemExit as end:\n"
        "    loaded = {'numpy', 'scipy', 'torch', 'gtsam', 'matplotlib', 'pydantic', 'rich'} & set(sys.modules)\n"
        "    sys.exit(str(loaded) if end.code or loaded else 0)"
    )
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert (result.returncode, result.stderr) == (0, "")
    assert "--log" in result.stdout


def test_the_command_computes_all_and_prints_one_table(command: Command) -> None:
    assert (command.result.returncode, command.result.stderr) == (0, "")
    for words in ("raw", "pose graph", "EKF", "t_rel", "ATE", "IMU used", "At the end", "Turned", "Results: out"):
        assert words in command.result.stdout
    table, _ = command.result.stdout.split("Lower is better")
    assert max(map(len, table.splitlines())) <= 80
    log = command.document["log"]
    assert (log["frames"], log["pairs"], log["imu_samples"], log["warnings"]) == (300, 299, 3000, {})
    assert command.document["trajectories"]["raw"]["segments"] > 0
    assert command.document["timing"]["realtime_factor"] > 0
    for picture in ("trajectories.png", "errors.png"):
        assert (command.folder / picture).read_bytes().startswith(b"\x89PNG")


def test_fusion_with_a_good_imu_is_better_than_raw(command: Command) -> None:
    results = command.document["trajectories"]
    assert command.document["calibration"]["used"]
    for name in ("posegraph", "ekf"):
        assert results[name]["r_rel_deg_per_100m"] < results["raw"]["r_rel_deg_per_100m"]
        assert results[name]["t_rel_percent"] < results["raw"]["t_rel_percent"]


def test_without_an_imu_the_pose_graph_returns_raw(
    tmp_path: Path, simulated_drive: Callable[..., Any], capsys: pytest.CaptureFixture[str]
) -> None:
    log = simulated_drive(6.0).write(tmp_path / "drive.mcap", leave_out=["imu"])
    code, document = _run(log, tmp_path / "out", "--backend", "posegraph")
    assert code == 0
    assert document["trajectories"].keys() == {"raw", "posegraph"}
    assert document["calibration"]["used"] is False
    assert "IMU left out" in capsys.readouterr().out
    raw, fused = (read_tum(tmp_path / "out" / f"{name}.tum").poses for name in ("raw", "posegraph"))
    np.testing.assert_allclose(fused.as_matrix(), raw.as_matrix(), atol=1e-6)


def test_a_replay_of_the_output_gives_the_same_bytes(tmp_path: Path, command: Command) -> None:
    _, again = _run(command.folder / "run.mcap", tmp_path)
    assert _trajectory_bytes(tmp_path) == _trajectory_bytes(command.folder)
    assert again["calibration"] == command.document["calibration"]
    assert again["log"]["imu_samples"] == command.document["log"]["imu_samples"]


def test_a_replay_of_a_log_that_gives_the_mounting_gives_the_same_bytes(
    tmp_path: Path, simulated_drive: Callable[..., Any]
) -> None:
    drive = simulated_drive(6.0)
    drive.mounting = Rotation.from_euler("xyz", [-89.7, 0.4, -90.2], degrees=True)
    _, first = _run(drive.write(tmp_path / "drive.mcap"), tmp_path / "first")
    assert open_log(tmp_path / "drive.mcap").mounting() is not None
    assert first["calibration"]["used"]
    _, again = _run(tmp_path / "first" / "run.mcap", tmp_path / "again")
    assert again["calibration"] == first["calibration"]
    assert _trajectory_bytes(tmp_path / "again") == _trajectory_bytes(tmp_path / "first")


@pytest.mark.parametrize("record", ["light", "all"])
def test_a_replay_of_the_networks_output_gives_the_same_bytes(
    tmp_path: Path, short_drive: Any, small_weights: Path, record: str
) -> None:
    del short_drive.frames[12:14]  # a gap, which the replay has to bridge in the same way
    log = short_drive.write(tmp_path / "drive.mcap", leave_out=["pairs"])
    code, document = _run(log, tmp_path / "first", "--weights", str(small_weights), "--record", record)
    assert code == 0
    assert document["log"]["pairs"] == 26
    assert document["log"]["warnings"]["gaps_bridged"] == 1
    _, again = _run(tmp_path / "first" / "run.mcap", tmp_path / "again")
    assert again["log"]["pairs"] == 26
    assert _trajectory_bytes(tmp_path / "again") == _trajectory_bytes(tmp_path / "first")


def test_the_front_end_is_chosen_by_the_log_unless_the_user_does(
    tmp_path: Path, short_drive: Any, small_weights: Path
) -> None:
    log = short_drive.write(tmp_path / "drive.mcap")
    for options, from_network in (
        ((), False),
        (("--frontend", "recorded"), False),
        (("--frontend", "violearner", "--weights", str(small_weights)), True),
    ):
        _run(log, tmp_path / "out", *options)
        raw = read_tum(tmp_path / "out" / "raw.tum").poses[-1]
        recorded = short_drive.ground_truth.poses[0].inv() * short_drive.ground_truth.poses[-1]
        off_m = np.linalg.norm(raw.translation - recorded.translation)
        assert (off_m > 2.0) == from_network


def test_without_ground_truth_the_measures_are_null_and_the_run_succeeds(
    tmp_path: Path, short_drive: Any, capsys: pytest.CaptureFixture[str]
) -> None:
    code, document = _run(short_drive.write(tmp_path / "drive.mcap", ["ground_truth"]), tmp_path / "out")
    assert code == 0
    assert document["trajectories"].keys() == set(NAMES)
    for name, values in document["trajectories"].items():
        known = {measure for measure, value in values.items() if value is not None}
        assert known == (set() if name == "raw" else {"nis_mean", "nis_degrees_of_freedom"})
    assert "No ground truth" in capsys.readouterr().out


def test_a_log_shorter_than_every_segment_has_no_t_rel_and_succeeds(tmp_path: Path, short_drive: Any) -> None:
    code, document = _run(short_drive.write(tmp_path / "drive.mcap"), tmp_path / "out")
    assert code == 0
    raw = document["trajectories"]["raw"]
    assert (raw["t_rel_percent"], raw["r_rel_deg_per_100m"], raw["segments"]) == (None, None, 0)
    assert raw["ate_m"] > 0


def _unsolvable(*_: object) -> None:
    raise RuntimeError("Indeterminant linear system\ndetected")


def _diverged(known: Measurements, _: object) -> Estimate:
    raw = chain.chain(known.steps)
    poses = RigidTransform.from_translation(np.full((len(raw), 3), np.nan))
    return Estimate(Trajectory(raw.stamps_ns, poses, raw.covariances), "")


@pytest.mark.parametrize(
    ("solve", "reason"),
    [(_unsolvable, "Indeterminant linear system detected"), (_diverged, "a pose is not finite")],
)
def test_a_back_end_that_fails_takes_nothing_else_with_it(
    tmp_path: Path,
    short_drive: Any,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    solve: Callable[..., Any],
    reason: str,
) -> None:
    monkeypatch.setattr(posegraph, "solve", solve)
    code, document = _run(short_drive.write(tmp_path / "drive.mcap"), tmp_path / "out")
    assert code == 1
    assert document["trajectories"].keys() == {"raw", "ekf"}
    assert document["log"]["warnings"]["posegraph_failed"] == 1
    assert capsys.readouterr().err.splitlines() == [f"warning: back end failed (posegraph): {reason}"]


def test_results_go_to_a_folder_named_by_log_and_time(
    tmp_path: Path, short_drive: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = short_drive.write(tmp_path / "drive.mcap")
    monkeypatch.chdir(tmp_path)
    assert run.main(["--log", str(log), "--backend", "ekf"]) == 0
    (folder,) = (tmp_path / "runs").iterdir()
    assert re.fullmatch(r"drive-\d{8}-\d{6}", folder.name)
    assert (folder / "metrics.json").is_file()


def test_the_configuration_file_is_used_and_written_down(tmp_path: Path, short_drive: Any) -> None:
    (tmp_path / "run.toml").write_text('backend = "ekf"\nsegment_lengths_m = [3.0]\n[imu]\ntime_offset_s = 0.01\n')
    log = short_drive.write(tmp_path / "drive.mcap")
    _, document = _run(log, tmp_path / "out", "--config", str(tmp_path / "run.toml"))
    assert document["trajectories"].keys() == {"raw", "ekf"}
    assert document["calibration"]["time_offset_s"] == 0.01
    resolved = (tmp_path / "out" / "config.toml").read_text()
    assert 'backend = "ekf"' in resolved
    _, again = _run(log, tmp_path / "again", "--config", str(tmp_path / "out" / "config.toml"))
    assert again["trajectories"] == document["trajectories"]


def test_the_published_odometry_on_kitti_09_has_the_devkits_numbers_and_fusion_improves_it(
    tmp_path: Path, shared_data: Path
) -> None:
    odometry = shared_data / "kitti" / "odometry"
    inputs = {
        "--poses": odometry / "published" / "example_1" / "09.txt",
        "--times": odometry / "sequences" / "09" / "times.txt",
        "--imu": odometry / "imu" / "09.mat",
        "--ground-truth": odometry / "poses" / "09.txt",
        "--out": tmp_path / "09.mcap",
    }
    assert convert.main(["trajectory", *(str(part) for option in inputs.items() for part in option)]) == 0
    code, document = _run(tmp_path / "09.mcap", tmp_path / "out")
    assert code == 0
    raw, graph, ekf = (document["trajectories"][name] for name in NAMES)
    assert raw["segments"] == 958
    assert raw["t_rel_percent"] == pytest.approx(2.607, abs=1e-3)
    assert raw["r_rel_deg_per_100m"] == pytest.approx(0.288, abs=1e-3)
    assert raw["ate_m"] == pytest.approx(10.880, abs=2e-3)
    assert graph["r_rel_deg_per_100m"] <= 0.20
    assert ekf["r_rel_deg_per_100m"] <= 0.25
    assert graph["t_rel_percent"] <= raw["t_rel_percent"]
    assert ekf["t_rel_percent"] <= raw["t_rel_percent"]
    assert document["log"]["duration_s"] == pytest.approx(1590 * 0.1037, rel=0.01)
