"""The paper's tables from runs: the right quartiles under the right heads, in Markdown and in CSV."""

import csv
from io import StringIO
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from trajectory_samples import COUNT, TRUTH, walk

from fusion import paper
from fusion.evaluation import evaluate, segment_errors
from fusion.results import Result
from fusion_io.writer import LogWriter

LENGTHS = (20.0, 50.0, 10.0 * COUNT)


def _run(key: str = "a", seed: int = 1) -> Result:
    return Result(key, f"0{seed}", Path(f"{key}.mcap"), {"raw": walk(seed), "ekf": walk(seed + 50)}, TRUTH)


def test_quartiles_are_those_of_the_segments_and_lengths_that_do_not_fit_are_left_out() -> None:
    table = paper.quartile_table([_run()], LENGTHS)
    assert [row[:3] for row in table.rows] == [
        ["01", heading, length] for heading in ("raw", "EKF") for length in LENGTHS[:2]
    ]
    errors = segment_errors(walk(1).poses, TRUTH.poses, LENGTHS)
    percent = errors.translation_percent[errors.length_m == 50.0]
    row = dict(zip(table.heads, table.rows[1], strict=True))
    assert row["segments"] == len(percent)
    assert_allclose(row["translation (%), median"], np.median(percent), rtol=1e-9)
    assert_allclose(row["translation (%), 1st quartile"], np.quantile(percent, 0.25), rtol=1e-9)
    assert_allclose(row["translation (m), 3rd quartile"], np.quantile(percent, 0.75) * 0.5, rtol=1e-9)
    rotation = errors.rotation_deg_per_100m[errors.length_m == 50.0]
    assert_allclose(row["rotation (deg/100 m), median"], np.median(rotation), rtol=1e-9)


def test_the_sequence_table_has_a_row_a_run_and_the_measures_of_the_evaluation() -> None:
    other = Result("b", "02", Path("b.mcap"), {"raw": walk(2)}, TRUTH)
    table = paper.sequence_table([_run(), other], LENGTHS)
    assert table.heads[1:3] == ["raw, t_rel (%)", "raw, r_rel (deg/100 m)"]
    metrics = evaluate(walk(1), TRUTH, LENGTHS)
    assert table.rows[0][:3] == ["01", metrics.t_rel_percent, metrics.r_rel_deg_per_100m]
    assert table.rows[1][3:] == [None, None]


def test_csv_keeps_all_digits_and_markdown_is_a_table() -> None:
    table = paper.sequence_table([_run()], LENGTHS)
    heads, row = csv.reader(StringIO(table.csv()))
    assert heads == list(table.heads)
    assert [float(word) for word in row[1:]] == list(table.rows[0][1:])
    lines = table.markdown().splitlines()[2:]
    assert {line.count("|") for line in lines} == {len(table.heads) + 1}


def test_the_command_writes_tables_and_figures(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with LogWriter(tmp_path / "run.mcap") as log:
        log.ground_truth(TRUTH)
        log.trajectory("raw", walk(1))
    out = tmp_path / "paper"
    assert paper.main([str(tmp_path), "--names", "09", "--lengths", "20,50", "--out", str(out)]) == 0
    assert {path.name for path in out.iterdir()} == {
        "sequences.md",
        "sequences.csv",
        "quartiles.md",
        "quartiles.csv",
        "trajectories-a.png",
        "quartiles-a.png",
    }
    assert "| 09 | raw | 20 |" in capsys.readouterr().out
    for figure in out.glob("*.png"):
        assert figure.read_bytes().startswith(b"\x89PNG")


def test_what_is_no_run_with_ground_truth_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with LogWriter(tmp_path / "run.mcap") as log:
        log.trajectory("raw", walk(1))
    assert paper.main([str(tmp_path)]) == 1
    assert "not the log of a run with ground truth" in capsys.readouterr().err
