"""The whole command `learned.adapt`, and `fusion.run --adapt`."""

import dataclasses
import tomllib
from collections.abc import Callable
from pathlib import Path

import pytest
from conftest import Drive
from scipy.spatial.transform import RigidTransform

from fusion import run
from fusion_io.records import Trajectory
from learned import adapt, weights


def adapted(log: Path, out: Path, small_weights: Path) -> tuple[int, bytes]:
    code = adapt.main(["--log", str(log), "--weights", str(small_weights), "--out", str(out), "--steps", "3"])
    return code, out.read_bytes() if out.exists() else b""


def test_ground_truth_changes_nothing(
    tmp_path: Path, simulated_drive: Callable[..., Drive], small_weights: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The same bytes twice, without any ground truth, and with a false one."""
    drive = simulated_drive(3)
    logs = [drive.write(tmp_path / "true.mcap"), drive.write(tmp_path / "none.mcap", ["ground_truth"])]
    still = RigidTransform.identity(len(drive.ground_truth))
    drive.ground_truth = Trajectory(drive.ground_truth.stamps_ns, still)
    logs += [drive.write(tmp_path / "false.mcap"), logs[0]]
    results = [adapted(log, tmp_path / str(i) / "w.pt", small_weights) for i, log in enumerate(logs)]
    assert results[0][0] == 0
    assert all(result == results[0] for result in results)
    assert "adapt" in capsys.readouterr().out
    assert weights.load(tmp_path / "0" / "w.pt").covariance == weights.load(small_weights).covariance


@pytest.mark.parametrize("missing", ["frames", "camera_info", "depth"])
def test_a_log_without_images_or_depth_is_refused_in_a_line(
    tmp_path: Path,
    simulated_drive: Callable[..., Drive],
    small_weights: Path,
    missing: str,
    capsys: pytest.CaptureFixture[str],
) -> None:
    drive = simulated_drive(2)
    if missing == "depth":
        drive.frames = [dataclasses.replace(frame, depth=None) for frame in drive.frames]
    code, content = adapted(drive.write(tmp_path / "log.mcap", [missing]), tmp_path / "w.pt", small_weights)
    assert (code, content) == (1, b"")
    (line,) = [line for line in capsys.readouterr().err.splitlines() if not line.startswith("warning: ")]
    assert line.startswith("error: ")
    assert "log.mcap" in line


def test_wrong_usage_ends_with_2() -> None:
    with pytest.raises(SystemExit) as error:
        adapt.main(["--log", "x.mcap", "--out", "y.pt", "--steps", "0"])
    assert error.value.code == 2


def test_a_run_adapts_before_it_estimates(
    tmp_path: Path,
    simulated_drive: Callable[..., Drive],
    small_weights: Path,
    no_pictures: None,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The folder holds the adapted weights, and a run with those as its weights gives the same trajectory."""
    monkeypatch.setattr(adapt.Adaptation, "__init__", quick(adapt.Adaptation.__init__))
    log = simulated_drive(3).write(tmp_path / "log.mcap", ["pairs"])
    common = ["--log", str(log), "--backend", "posegraph", "--segment-lengths", "2"]
    assert run.main([*common, "--adapt", "--weights", str(small_weights), "--out", str(tmp_path / "a")]) == 0
    assert run.main([*common, "--weights", str(tmp_path / "a" / "adapted.pt"), "--out", str(tmp_path / "b")]) == 0
    assert (tmp_path / "a" / "raw.tum").read_bytes() == (tmp_path / "b" / "raw.tum").read_bytes()
    assert tomllib.loads((tmp_path / "a" / "config.toml").read_text())["frontend"]["adapt"] is True


def quick(init: Callable[..., None]) -> Callable[..., None]:
    """Adaptations of three steps."""
    return lambda self, **settings: init(self, **(settings | {"steps": 3}))
