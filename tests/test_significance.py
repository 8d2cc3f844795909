"""Intervals hold the truth as often as they say, and a difference is only claimed where there is one."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from fusion.evaluation import SegmentErrors
from fusion.significance import Difference, mean_difference, paired_difference
from fusion_io.records import FloatArray


def _segments(errors: FloatArray, reach: int) -> SegmentErrors:
    """Segments that begin every ten frames and last so many starts."""
    start = 10 * np.arange(len(errors))
    return SegmentErrors(start, start + 10 * reach, np.full(len(errors), 100.0), errors, errors)


def _overlapping(rng: np.random.Generator, count: int, reach: int) -> FloatArray:
    """Errors of segments that share the independent errors of the steps that they share."""
    return np.convolve(rng.normal(size=count + reach - 1), np.ones(reach) / reach, "valid")


@pytest.mark.parametrize(("count", "reach"), [(100, 1), (160, 10), (400, 40), (160, 60)])
def test_the_interval_of_overlapping_segments_holds_the_truth_as_often_as_it_says(count: int, reach: int) -> None:
    """95 %, less what little is lost to the overlap; independent values without the overlap are the control."""
    rng = np.random.default_rng(0)
    held = 0
    for _ in range(400):
        difference = paired_difference(
            _segments(np.zeros(count), reach), _segments(_overlapping(rng, count, reach), reach), "translation_percent"
        )
        assert difference is not None
        assert difference.low is not None
        assert difference.high is not None
        held += difference.low <= 0.0 <= difference.high
    assert 0.90 <= held / 400 <= 0.995


def test_an_interval_that_took_overlapping_segments_for_independent_would_be_too_short() -> None:
    rng = np.random.default_rng(1)
    values = _overlapping(rng, 400, 40)
    honest, naive = (mean_difference(values, np.ones(400), block) for block in (40, 1))
    assert honest.high is not None
    assert naive.high is not None
    assert honest.high - honest.mean > 3.0 * (naive.high - naive.mean)


def test_a_series_with_itself_differs_by_nothing() -> None:
    errors = _segments(np.random.default_rng(2).uniform(0.0, 3.0, 100), 10)
    difference = paired_difference(errors, errors, "rotation_deg_per_100m")
    assert difference == Difference(0.0, 0.0, 0.0)
    assert difference.verdict == "not significant"


def test_swapping_the_two_flips_the_signs() -> None:
    rng = np.random.default_rng(3)
    a, b = (_segments(rng.uniform(0.0, 3.0, 100), 10) for _ in range(2))
    forward, back = (paired_difference(*pair, "translation_percent") for pair in ((a, b), (b, a)))
    assert forward is not None
    assert back is not None
    assert_allclose([back.mean, back.low, back.high], [-forward.mean, -forward.high, -forward.low], rtol=1e-12)


def test_what_is_hard_for_both_cancels() -> None:
    """The path is a hundred times harder in places than the difference is large."""
    rng = np.random.default_rng(4)
    hard = rng.uniform(0.0, 10.0, 200)
    worse = hard + 0.1 + 0.01 * rng.normal(size=200)
    found = paired_difference(_segments(hard, 5), _segments(worse, 5), "translation_percent")
    assert found is not None
    assert_allclose(found.mean, 0.1, atol=0.01)
    assert found.verdict == "worse"
    found = paired_difference(_segments(worse, 5), _segments(hard, 5), "translation_percent")
    assert found is not None
    assert found.verdict == "better"


def test_a_path_shorter_than_two_blocks_has_no_interval_and_no_verdict() -> None:
    difference = mean_difference(np.ones(19), np.ones(19), 10)
    assert (difference.low, difference.high, difference.significant) == (None, None, None)
    assert difference.verdict == "path too short to tell"


def test_without_segments_there_is_no_difference_to_speak_of() -> None:
    assert paired_difference(_segments(np.zeros(0), 1), _segments(np.zeros(0), 1), "translation_percent") is None


def test_starts_with_more_segments_count_for_more() -> None:
    """The mean is that of all segments, not that of the starts."""
    assert_allclose(mean_difference(np.array([1.0, 9.0, 0.0, 0.0]), np.array([1.0, 3.0, 1.0, 1.0]), 1).mean, 10.0 / 6.0)
