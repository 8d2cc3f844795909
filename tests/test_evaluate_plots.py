"""The pictures of an evaluation show the figures, are all written, and come out the same."""

from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from comparison_samples import comparison
from numpy.testing import assert_allclose

from learned import plots
from learned.comparison import figures

NAMES = [
    "error_by_level.png",
    "hypotheses.png",
    "reliability.png",
    "nees_histogram.png",
    "sigma_against_error.png",
    "errors_over_time.png",
]


def test_all_pictures_are_written_even_of_a_single_pair(tmp_path: Path) -> None:
    paths = plots.write_plots(tmp_path, comparison(1), "log")
    assert [path.name for path in paths] == NAMES
    for path in paths:
        assert path.read_bytes().startswith(b"\x89PNG")


def test_the_bars_of_the_levels_are_their_errors() -> None:
    sample = comparison()
    translation, rotation = plots.error_by_level(sample, "log").axes
    found = figures(sample)
    rows = [*found["by_level"], found["refined"]]
    assert_allclose([bar.get_height() for bar in translation.patches], [row["translation_rmse_m"] for row in rows])
    assert_allclose([bar.get_height() for bar in rotation.patches], [1e3 * row["rotation_rmse_rad"] for row in rows])
    assert "[m]" in translation.get_ylabel()
    assert "[mrad]" in rotation.get_ylabel()


def test_the_bars_of_the_hypotheses_are_their_spread_and_their_errors() -> None:
    sample = comparison()
    axes, errors = plots.hypotheses(sample, "log").axes
    found = figures(sample)
    spread = [bar.get_height() for bar in axes.patches][:6]
    assert_allclose(spread, plots.SCALES * np.sqrt(list(found["hypothesis_variance"].values())))
    rows = [*found["by_hypothesis"], found["mean_of_hypotheses"], found["winner"], found["best_hypothesis"]]
    assert_allclose([bar.get_height() for bar in errors.patches], [row["translation_rmse_m"] for row in rows])


def test_the_reliability_of_honest_covariances_is_the_diagonal() -> None:
    axes = plots.reliability(comparison(4000), "log").axes[0]
    lines = {line.get_label().split(",")[0]: line.get_data() for line in axes.get_lines()}
    for stage in ("network", "refined"):
        nominal, share = lines[stage]
        assert_allclose(share, nominal, atol=0.03)


def test_the_histogram_is_a_density_that_holds_every_pair() -> None:
    for axes in plots.nees_histogram(comparison(), "log").axes:
        assert sum(bar.get_height() * bar.get_width() for bar in axes.patches) == pytest.approx(1.0)


def test_errors_over_time_are_drawn_by_axis_in_their_units() -> None:
    sample = comparison()
    panels = plots.errors_over_time(sample, "log").axes
    errors = sample.errors("refined")
    for k, axes in enumerate(panels):
        drawn = {line.get_label(): line.get_ydata() for line in axes.get_lines()}
        assert_allclose(drawn["refined"], errors[:, k] * (1e3 if k < 3 else 1e2))


def test_the_same_pairs_give_the_same_picture() -> None:
    pictures = []
    for _ in range(2):
        buffer = BytesIO()
        plots.reliability(comparison(20), "log").savefig(buffer, format="png")
        pictures.append(buffer.getvalue())
    assert pictures[0] == pictures[1]
