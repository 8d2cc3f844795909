"""Settings are read as TOML, refused where they would have no effect, and combined on a grid."""

import argparse
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from log_samples import imu_series, trajectory, write_sample

from fusion import replay
from fusion.comparison import Comparison
from fusion.config import RunConfig
from fusion.evaluation import Metrics
from fusion.results import Result
from fusion_io.errors import LogError, UsageError
from fusion_io.reader import open_log
from fusion_io.writer import LogWriter


@pytest.mark.parametrize(
    ("text", "name", "value"),
    [
        ("posegraph.gyro_noise=1e-3", "posegraph.gyro_noise", 1e-3),
        ("ekf.max_rejected_in_a_row = 3", "ekf.max_rejected_in_a_row", 3),
        ("backend=ekf", "backend", "ekf"),
        ('backend="ekf"', "backend", "ekf"),
        ("frontend.refine=false", "frontend.refine", False),
        ("segment_lengths_m=[10, 20.5]", "segment_lengths_m", [10, 20.5]),
        ("a.b=x=y", "a.b", "x=y"),
    ],
)
def test_a_value_is_one_of_toml_and_a_bare_word_a_string(text: str, name: str, value: object) -> None:
    assert replay._assignment(text) == (name, value)


@pytest.mark.parametrize(
    ("text", "values"),
    [
        ("n=1e-3,1e-4", [1e-3, 1e-4]),
        ("n=1", [1]),
        ("n=huber, cauchy", ["huber", "cauchy"]),
        ("n=true,maybe", [True, "maybe"]),
        ("n=[10],[20,30]", [[10], [20, 30]]),
    ],
)
def test_a_grid_is_a_list_of_values(text: str, values: list[object]) -> None:
    assert replay._grid(text) == ("n", values)


@pytest.mark.parametrize("text", ["", "=", "x", "x=", "=1", ".x=1", "x.=1"])
def test_what_is_no_assignment_is_refused(text: str) -> None:
    for read in (replay._assignment, replay._grid):
        with pytest.raises(argparse.ArgumentTypeError, match="is not NAME=VALUE"):
            read(text)


@given(st.lists(st.lists(st.integers(), min_size=1, max_size=4), max_size=3))
def test_a_sweep_has_every_combination_once_in_the_order_of_the_grids(axes: list[list[int]]) -> None:
    grids = [(f"ekf.n{i}", list(values)) for i, values in enumerate(axes)]
    combinations = replay.settings_of([("backend", "ekf")], grids)
    expected = 1
    for values in axes:
        expected *= len(values)
    assert len(combinations) == expected
    assert all(each["backend"] == "ekf" and len(each) == len(axes) + 1 for each in combinations)
    assert combinations[0] == {"backend": "ekf"} | {name: values[0] for name, values in grids}


@pytest.mark.parametrize("name", ["frontend.refine", "topics.imu", "record"])
def test_a_setting_without_effect_is_refused(name: str) -> None:
    with pytest.raises(UsageError, match=f"{name}: a replay begins with the recorded pairs"):
        replay.settings_of([(name, 1)], [])


def test_a_name_that_is_set_twice_is_refused() -> None:
    with pytest.raises(UsageError, match="backend is set twice"):
        replay.settings_of([("backend", "ekf")], [("backend", ["ekf", "both"])])


def test_settings_lie_on_top_of_what_was_recorded_and_change_nothing_else() -> None:
    base = {"ekf": {"gyro_noise": 2e-3, "acceleration": 3.0}, "imu": {"time_offset_s": 0.1}}
    config = replay.configured(base, {"ekf.gyro_noise": 5e-3})
    assert (config.ekf.gyro_noise, config.ekf.acceleration, config.imu.time_offset_s) == (5e-3, 3.0, 0.1)
    assert config.posegraph == RunConfig().posegraph
    assert base["ekf"] == {"gyro_noise": 2e-3, "acceleration": 3.0}


@pytest.mark.parametrize(
    ("settings", "backend"),
    [
        ({}, "both"),
        ({"ekf.gyro_noise": 1e-3}, "ekf"),
        ({"posegraph.gyro_noise": 1e-3}, "posegraph"),
        ({"posegraph.gyro_noise": 1e-3, "ekf.gyro_noise": 1e-3}, "both"),
        ({"imu.time_offset_s": 0.0, "ekf.gyro_noise": 1e-3}, "both"),
        ({"backend": "both", "ekf.gyro_noise": 1e-3}, "both"),
    ],
)
def test_only_the_back_ends_that_settings_concern_are_run(settings: dict[str, object], backend: str) -> None:
    assert replay.configured({}, settings).backend == backend


@pytest.mark.parametrize(
    ("settings", "reason"),
    [
        ({"posegraph.gyro_nois": 1e-3}, "did you mean 'posegraph.gyro_noise'"),
        ({"posegraf.gyro_noise": 1e-3}, "did you mean 'posegraph'"),
        ({"gyro_noise": 1e-3}, "did you mean 'posegraph.gyro_noise' or 'ekf.gyro_noise'"),
        ({"backend.x": 1}, "backend.x: backend is a value"),
        ({"ekf.gyro_noise": -1}, "ekf.gyro_noise"),
        ({"backend": "huber"}, "backend"),
        ({"ekf": 1}, "ekf"),
    ],
)
def test_a_setting_that_does_not_exist_or_fit_is_refused(settings: dict[str, object], reason: str) -> None:
    with pytest.raises(UsageError, match=reason):
        replay.configured({"backend": "both"}, settings)


@pytest.mark.parametrize(
    ("toml", "reason"), [("x = [", "is not TOML"), ("speed = 1", "not one of this version: unknown name 'speed'")]
)
def test_a_recorded_configuration_that_cannot_be_used_is_an_error(tmp_path: Path, toml: str, reason: str) -> None:
    with LogWriter(tmp_path / "run.mcap", {"config": {"toml": toml}}) as log:
        log.imu(imu_series())
    with pytest.raises(LogError, match=reason):
        replay.recorded_configuration(open_log(tmp_path / "run.mcap"))


def test_the_topics_of_the_log_that_the_run_read_are_not_those_of_its_own(tmp_path: Path) -> None:
    with LogWriter(
        tmp_path / "run.mcap", {"config": {"toml": '[topics]\nimu = "/other"\n[ekf]\nacceleration = 2'}}
    ) as log:
        log.imu(imu_series())
    assert replay.recorded_configuration(open_log(tmp_path / "run.mcap")) == {"ekf": {"acceleration": 2}}


def test_a_log_without_pairs_cannot_be_replayed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with LogWriter(tmp_path / "log.mcap") as log:
        log.imu(imu_series())
        log.ground_truth(trajectory())
    assert replay.main([str(tmp_path / "log.mcap")]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert "no recorded pair estimates to replay" in line


@pytest.mark.parametrize(
    ("options", "code", "reason"),
    [
        (["--set", "ekf.nois=1"], 2, "did you mean"),
        (["--set", "frontend.adapt=true"], 2, "a replay begins with"),
        (["--set", "backend=ekf", "--sort-by", "ekf.ate"], 2, "did you mean 'ekf.ate_m'"),
    ],
)
def test_what_cannot_be_done_is_one_line_and_its_exit_code(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[str], code: int, reason: str
) -> None:
    log = write_sample(tmp_path / "log.mcap")
    assert replay.main([str(log), *options]) == code
    assert reason in capsys.readouterr().err.splitlines()[-1]


@pytest.mark.parametrize(
    ("settings", "names"),
    [
        ({"posegraph.gyro_noise": 1e-3}, ["ekf"]),
        ({"ekf.gyro_noise": 1e-3}, ["posegraph"]),
        ({"ekf.gyro_noise": 1e-3, "posegraph.gyro_noise": 1e-3}, []),
        ({"ekf.gyro_noise": 1e-3, "backend": "both"}, []),
        ({}, []),
    ],
)
def test_a_back_end_that_the_settings_drop_is_told(settings: dict[str, object], names: list[str]) -> None:
    assert replay.not_run(RunConfig(), [replay.configured({}, settings)]) == names


@pytest.mark.parametrize(
    ("t_rel", "marks", "all_equal"),
    [
        ([2.0, 1.0, 3.0], ["best", "", ""], False),
        ([2.0, 1.0, 1.0 + 1e-12], ["equal", "equal", ""], False),
        ([1.0, 1.0, 1.0], ["", "", ""], True),
        ([None, 1.0, 2.0], ["best", "", ""], False),
    ],
)
def test_only_what_is_better_than_others_is_marked_best(
    t_rel: list[float | None], marks: list[str], all_equal: bool
) -> None:
    """Several that are equally good are called equal, and where all are, none is the best."""
    combinations = [{"ekf.gyro_noise": value} for value in range(3)]
    truth = trajectory()
    result = Result("b", "replay", Path("b.mcap"), {"raw": truth, "ekf": truth})
    compared = [
        Comparison([result], (), {"b.raw": Metrics(), "b.ekf": Metrics(t_rel_percent=value, ate_m=value)}, [], [], [])
        for value in t_rel
    ]
    replays = [replay.Replay(each, RunConfig(), result.trajectories, {}, [], []) for each in combinations]
    order, measure = replay.ranked(compared, None, combinations)
    table = replay.sweep_table(replays, compared, order, measure)
    assert list(table.columns[0].cells) == marks
    assert ("in which all are equal" in str(table.title)) == all_equal
