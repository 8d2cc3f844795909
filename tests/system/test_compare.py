"""Comparing and replaying as whole commands, on a short run."""

import json
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from numpy.testing import assert_allclose

from fusion import compare, replay, run, table
from fusion.output import Outcome
from fusion_io.odometry import read_trajectories
from fusion_io.trajectory_files import read_tum

MODULES = ("fusion.compare", "fusion.replay", "fusion.paper")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, simulated_drive: Callable[..., Any]) -> Path:
    """A run's folder."""
    folder = tmp_path_factory.mktemp("compare")
    log = simulated_drive(20.0).write(folder / "drive.mcap")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("fusion.output.write_plots", lambda *_: None)
        code = run.main(["--log", str(log), "--out", str(folder / "run"), "--segment-lengths", "10,20,30"])
    assert code == 0
    return folder / "run"


@pytest.mark.parametrize("module", MODULES)
def test_help_needs_none_of_the_heavy_packages_and_says_how_it_ends(module: str) -> None:
    script = (
        f"import sys\nfrom {module} import main\ntry:\n    main(['--help'])\nexcept SystemExit as end:\n"
        "    loaded = {'numpy', 'scipy', 'gtsam', 'matplotlib', 'plotly', 'pydantic', 'rich'} & set(sys.modules)\n"
        "    sys.exit(str(loaded) if end.code or loaded else 0)"
    )
    result = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert (result.returncode, result.stderr) == (0, "")
    assert "exit codes" in result.stdout


def test_a_run_compared_from_its_log_has_the_measures_that_it_wrote_itself(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert compare.main([str(folder / "run.mcap"), str(folder), "--json", "-"]) == 0
    document = json.loads(capsys.readouterr().out)
    written = json.loads((folder / "metrics.json").read_text())["trajectories"]
    for each in document["inputs"]:
        assert each["trajectories"].keys() == written.keys()
        for name, measures in each["trajectories"].items():
            for measure, value in measures.items():
                assert_allclose(value, written[name][measure], rtol=1e-6, atol=1e-9)
    for difference in document["differences"]:
        assert difference["t_rel_percent"]["verdict"] == "not significant"


def test_conditions_decide_the_exit_code(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    inputs = [str(folder), str(folder / "raw.tum"), "--ground-truth", str(folder / "run.mcap")]
    for condition, code in (
        ("b.trajectory.ate_m > 1.05 * a.raw.ate_m", 0),
        ("b.trajectory.r_rel_deg_per_100m > 1.05 * a.posegraph.r_rel_deg_per_100m", 4),
        ("b.raw.ate_m > 1", 2),
        ("b.trajectory.ate_m", 2),
        ("b.trajectory.anees_position > 1", 1),
    ):
        assert compare.main([*inputs, "--fail-if", condition]) == code
        error = capsys.readouterr().err
        assert len(error.splitlines()) == (code != 0)
        assert condition.split()[0] in error or code == 0


def test_the_table_names_who_is_better_and_where(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert compare.main([str(folder)]) == 0
    text = capsys.readouterr().out
    for words in ("a.posegraph - a.raw", "pose graph", "t_rel", "r_rel", "stretches"):
        assert words in text
    assert max(map(len, text.splitlines())) <= 100
    assert "…" not in text


def test_a_page_is_written(folder: Path, tmp_path: Path) -> None:
    assert compare.main([str(folder), "--html", str(tmp_path / "new" / "page.html")]) == 0
    assert (tmp_path / "new" / "page.html").read_text().startswith("<!doctype html>")


def test_a_damaged_log_is_compared_as_far_as_it_goes(folder: Path, tmp_path: Path) -> None:
    data = (folder / "run.mcap").read_bytes()
    (tmp_path / "cut.mcap").write_bytes(data[: int(0.9 * len(data))])
    found = read_trajectories(tmp_path / "cut.mcap")
    assert found.damaged
    assert found.trajectories
    assert compare.main([str(tmp_path / "cut.mcap")]) == 3


def test_a_replay_of_a_cut_run_says_so_and_ends_with_3(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The configuration and the pairs are at its front, so that something is left to be replayed."""
    whole = (folder / "run.mcap").read_bytes()
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(whole[: len(whole) * 8 // 10])
    assert replay.main([str(cut), "--set", "ekf.gyro_noise=5e-3"]) == 3
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("warning: ")]
    assert any("cut.mcap" in line and "cut or unfinished" in line for line in lines), lines


def test_a_replay_says_what_its_run_said_of_the_end_and_of_all_figures(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Where the settings are the same. The log is the run's own, and the time is another."""
    assert replay.main([str(folder), "--out", str(tmp_path)]) == 0
    told = capsys.readouterr().out.splitlines()
    ends = table.end_lines({name: read_tum(folder / f"{name}.tum") for name in ("raw", "posegraph", "ekf")})
    assert [line for line in told if line.startswith(("At the end", "Turned"))] == ends
    run_said, said = (json.loads((each / "metrics.json").read_text()) for each in (folder, tmp_path))
    assert said.keys() == run_said.keys()
    assert said.pop("log").keys() == run_said.pop("log").keys()
    assert said.pop("timing").keys() == {"replay", "total", "realtime_factor"} <= {"replay", *run_said.pop("timing")}
    measured, run_measured = said.pop("trajectories"), run_said.pop("trajectories")
    assert measured.keys() == run_measured.keys()
    for name, measures in run_measured.items():
        near = {
            measure: value if value is None else pytest.approx(value, rel=1e-6) for measure, value in measures.items()
        }
        assert measured[name] == near
    assert said == run_said


def test_a_replay_with_unchanged_settings_gives_the_recorded_trajectories(folder: Path, tmp_path: Path) -> None:
    assert replay.main([str(folder), "--out", str(tmp_path)]) == 0
    for name in ("raw", "posegraph", "ekf"):
        assert (tmp_path / f"{name}.tum").read_bytes() == (folder / f"{name}.tum").read_bytes()
        recorded = read_trajectories(folder / "run.mcap").trajectories[name].poses.as_matrix()
        assert_allclose(read_tum(tmp_path / f"{name}.tum").poses.as_matrix(), recorded, atol=1e-9)


def test_a_setting_changes_its_back_end_as_a_run_with_it_would(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("fusion.output.write_plots", lambda *_: None)
    assert replay.main([str(folder), "--set", "ekf.gyro_noise=5e-3", "--out", str(tmp_path / "replay")]) == 0
    assert {path.stem for path in (tmp_path / "replay").glob("*.tum")} == {"raw", "ekf"}
    config = str(tmp_path / "replay" / "config.toml")
    assert run.main(["--log", str(folder / "run.mcap"), "--out", str(tmp_path / "run"), "--config", config]) == 0
    replayed, again = ((tmp_path / where / "ekf.tum").read_bytes() for where in ("replay", "run"))
    assert replayed == again
    assert replayed != (folder / "ekf.tum").read_bytes()


def test_a_sweep_is_sorted_and_has_the_best_compared_with_the_recorded(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    grids = ["--grid", "posegraph.gyro_noise=1e-1,1e-3", "--grid", "posegraph.accelerometer_noise=0.5,5"]
    assert replay.main([str(folder), *grids, "--json", str(tmp_path / "sweep.json")]) == 0
    document = json.loads((tmp_path / "sweep.json").read_text())
    assert document["sorted_by"] == "posegraph.t_rel_percent"
    values = [each["trajectories"]["posegraph"]["t_rel_percent"] for each in document["replays"]]
    assert len(set(values)) == 4
    assert values == sorted(values)
    assert document["best"]["differences"][-1]["a"] == "a.posegraph"
    table = capsys.readouterr().out
    assert "4 combinations, sorted by posegraph.t_rel_percent" in table
    assert "best" in table


def test_a_back_end_that_fails_with_a_setting_is_said_and_does_not_end_the_sweep(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    again = replay.fuse_again

    def failing(log: Any, config: Any) -> Outcome:
        outcome = again(log, config)
        raw = {"raw": outcome.trajectories["raw"]}
        return replace(outcome, trajectories=raw) if config.posegraph.gyro_noise > 1.0 else outcome

    monkeypatch.setattr(replay, "fuse_again", failing)
    assert replay.main([str(folder), "--grid", "posegraph.gyro_noise=2.0,1e-3"]) == 0
    captured = capsys.readouterr()
    assert captured.err.splitlines() == ["warning: posegraph.gyro_noise=2.0: no result of posegraph"]
    assert replay.main([str(folder), "--set", "posegraph.gyro_noise=2.0"]) == 1
