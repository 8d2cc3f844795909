"""Laws of an evaluation's figures: those of the default come first, both stages are judged, only known pairs count."""

import json

import numpy as np
import pytest
from comparison_samples import SIGMA, comparison
from scipy.spatial.transform import RigidTransform

from fusion_io.errors import LogError
from fusion_io.records import NANOSECONDS, PairEstimate, Trajectory
from learned.calibration import AXES
from learned.comparison import Comparison, compare, figures
from learned.estimator import Inference

TENTH = NANOSECONDS // 10


def test_the_figures_at_the_top_are_those_of_the_default() -> None:
    found = figures(comparison())
    assert found["default"] == "refined"
    assert {name: found[name] for name in found["refined"]} == found["refined"]
    assert found["network"]["translation_rmse_m"] > found["refined"]["translation_rmse_m"]


def test_both_stages_are_judged_in_full() -> None:
    found = figures(comparison(2000))
    for stage in ("network", "refined"):
        figure = found[stage]
        assert figure["anees"] == pytest.approx(6, abs=0.4)
        assert figure["coverage_95"] == pytest.approx(0.95, abs=0.02)
        assert figure["nll_gain"] > 0.5
        assert list(figure["rank_correlation"]) == list(AXES)
        assert min(figure["rank_correlation"].values()) > 0.2
    expected = np.sqrt(np.mean(np.exp(2 * np.random.default_rng(0).normal(0, 0.5, 2000))) * np.sum(SIGMA[3:] ** 2))
    assert found["refined"]["translation_rmse_m"] == pytest.approx(expected, rel=0.1)


def test_intervals_hold_their_figures() -> None:
    found = figures(comparison())["refined"]
    for name, (lower, upper) in found["interval_95"].items():
        assert lower <= found[name] <= upper


def test_levels_halve_the_error_as_they_were_made_to() -> None:
    by_level = figures(comparison())["by_level"]
    errors = np.array([level["translation_rmse_m"] for level in by_level])
    assert [level["name"] for level in by_level] == [f"level {k}" for k in range(5)]
    assert errors[:-1] / errors[1:] == pytest.approx(2.0, rel=0.01)


def test_hypotheses_are_counted_as_winners_and_compared_with_their_mean() -> None:
    found = figures(comparison(80))
    assert [row["wins"] for row in found["by_hypothesis"]] == [20] * 4
    best, winner, mean = (
        found[name]["translation_rmse_m"] for name in ("best_hypothesis", "winner", "mean_of_hypotheses")
    )
    assert best <= min(winner, mean)
    assert winner == found["by_level"][-1]["translation_rmse_m"]
    variance = found["hypothesis_variance"]
    assert variance["translation_z"] > 2 * variance["translation_x"] > 100 * variance["rotation_x"]


def test_hypotheses_that_agree_have_no_variance_and_are_all_the_same() -> None:
    sample = comparison()
    sample.hypotheses[:] = sample.network.T_source_target[:, None]
    found = figures(sample)
    assert max(found["hypothesis_variance"].values()) < 1e-20
    assert found["mean_of_hypotheses"]["translation_rmse_m"] == pytest.approx(found["winner"]["translation_rmse_m"])


@pytest.mark.parametrize("count", [1, 2, 5])
def test_few_pairs_have_figures_that_json_can_hold(count: int) -> None:
    assert json.loads(json.dumps(figures(comparison(count)), allow_nan=False))["pairs"] == count


def _truth(stamps_ns: list[int]) -> Trajectory:
    """One metre a second along z."""
    position = np.array(stamps_ns)[:, None] / NANOSECONDS * [0.0, 0.0, 1.0]
    return Trajectory(np.array(stamps_ns), RigidTransform.from_translation(position))


def _inference(source_ns: int, z: float) -> Inference:
    quat, translation = np.array([1.0, 0, 0, 0]), np.array([0.0, 0, z])
    pair = PairEstimate(
        source_ns,
        source_ns + TENTH,
        quat,
        translation,
        np.eye(6),
        0,
        np.tile(quat, (4, 1)),
        np.tile(translation, (4, 1)),
    )
    return Inference(pair, pair, np.repeat(pair.T_source_target.as_matrix()[None], 5, axis=0))


def compared(inferences: list[Inference], truth: Trajectory) -> Comparison:
    """With nothing refined."""
    return compare(inferences, inferences, truth)


def test_ground_truth_is_interpolated_to_the_stamps_of_the_frames() -> None:
    found = compared([_inference(TENTH // 3, 0.1)], _truth([0, TENTH, 2 * TENTH]))
    assert found.truth[0, :3, 3] == pytest.approx([0, 0, 0.1])
    assert figures(found)["translation_rmse_m"] == pytest.approx(0, abs=1e-12)


def test_pairs_outside_the_ground_truth_are_not_judged() -> None:
    inferences = [_inference(k * TENTH, 0.1) for k in range(10)]
    assert len(compared(inferences, _truth([2 * TENTH, 5 * TENTH]))) == 3


def test_pairs_in_a_long_hole_of_the_ground_truth_are_not_judged() -> None:
    truth = _truth([0, TENTH, 2 * TENTH, 3 * NANOSECONDS, 3 * NANOSECONDS + TENTH])
    stamps = np.array([0, TENTH, 2 * TENTH, 3 * TENTH, 3 * NANOSECONDS, 3 * NANOSECONDS + TENTH // 2])
    assert truth.covers(stamps).tolist() == [True, True, True, False, True, True]


@pytest.mark.parametrize("stamps_ns", [[0], [99 * NANOSECONDS, 100 * NANOSECONDS]])
def test_ground_truth_that_spans_no_pair_is_refused(stamps_ns: list[int]) -> None:
    with pytest.raises(LogError, match="none of its 1 estimated pairs"):
        compared([_inference(0, 0.1)], _truth(stamps_ns))


def test_no_estimates_at_all_are_refused() -> None:
    with pytest.raises(LogError, match="none of its 0 estimated pairs"):
        compared([], _truth([0, TENTH]))
