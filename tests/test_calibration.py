"""Laws of consistency: honest covariances score as they should, others show on which side they are wrong."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.stats import chi2, multivariate_normal

from learned.calibration import (
    AXES,
    consistency,
    constant_nll,
    coverage_bounds,
    inside,
    mean_interval,
    negative_log_likelihood,
    rank_correlation,
)
from learned.covariance import nees

COUNT = 4000


def _covariances(count: int, seed: int = 0) -> np.ndarray:
    """Correlated, with sizes that differ by pair and by axis as those of rotation and translation do."""
    rng = np.random.default_rng(seed)
    roots = rng.normal(size=(count, 6, 6)) / 4 + np.eye(6)
    roots *= np.exp(rng.normal(0, 0.7, count))[:, None, None] * np.array([1e-3] * 3 + [2e-2] * 3)[:, None]
    return roots @ roots.transpose(0, 2, 1)


def _draws(covariances: np.ndarray, seed: int = 1) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(size=(len(covariances), 6, 1))
    return (np.linalg.cholesky(covariances) @ noise)[..., 0]


@pytest.fixture(scope="module")
def covariances() -> np.ndarray:
    return _covariances(COUNT)


@pytest.fixture(scope="module")
def errors(covariances: np.ndarray) -> np.ndarray:
    return _draws(covariances)


def test_draws_from_the_stated_covariances_are_consistent(errors: np.ndarray, covariances: np.ndarray) -> None:
    found = consistency(errors, covariances)
    assert found["anees"] == pytest.approx(6, abs=4 * np.sqrt(12 / COUNT))  # a chi-square of 6 dof has variance 12
    for percent in (50, 90, 95, 99):
        p = percent / 100
        assert found[f"coverage_{percent}"] == pytest.approx(p, abs=4 * np.sqrt(p * (1 - p) / COUNT))
    assert all(axis["nees"] == pytest.approx(1, abs=0.1) for axis in found["by_axis"].values())


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_sigmas_wrong_by_a_factor_show_as_its_square(
    errors: np.ndarray, covariances: np.ndarray, factor: float
) -> None:
    right, wrong = consistency(errors, covariances), consistency(errors, factor**2 * covariances)
    assert wrong["anees"] == pytest.approx(right["anees"] / factor**2)
    assert (wrong["coverage_95"] > right["coverage_95"]) == (factor > 1)
    assert wrong["nll"] > right["nll"]


def test_the_likelihood_is_scipys(errors: np.ndarray, covariances: np.ndarray) -> None:
    ours = negative_log_likelihood(errors[:20], covariances[:20])
    theirs = [-multivariate_normal(cov=P).logpdf(e) for e, P in zip(errors[:20], covariances[:20], strict=True)]
    assert_allclose(ours, theirs, rtol=1e-9)


def test_true_covariances_that_vary_beat_the_best_constant_one(errors: np.ndarray, covariances: np.ndarray) -> None:
    assert consistency(errors, covariances)["nll_gain"] > 1.0


def test_no_constant_covariance_beats_the_best_constant_one(errors: np.ndarray) -> None:
    best = constant_nll(errors)
    moment = errors.T @ errors / len(errors)
    others = [0.9 * moment, 1.1 * moment, np.diag(np.diag(moment)), moment + 1e-6 * np.eye(6)]
    for other in others:
        stated = np.broadcast_to(other, (len(errors), 6, 6))
        assert negative_log_likelihood(errors, stated).mean() > best
    assert consistency(errors, np.broadcast_to(moment, (len(errors), 6, 6)))["nll_gain"] == pytest.approx(0, abs=1e-9)


def test_too_few_pairs_have_no_best_constant_covariance(errors: np.ndarray, covariances: np.ndarray) -> None:
    found = consistency(errors[:5], covariances[:5])
    assert found["nll_constant"] is None
    assert found["nll_gain"] is None


def test_errors_in_proportion_to_their_sigma_correlate_fully_whatever_their_sign(covariances: np.ndarray) -> None:
    sigma = np.sqrt(np.einsum("naa->na", covariances))
    signs = np.where(np.arange(COUNT) % 3 == 0, -1.0, 1.0)[:, None]
    assert rank_correlation(0.1 * signs * sigma, covariances) == dict.fromkeys(AXES, pytest.approx(1.0))
    assert rank_correlation(0.1 / sigma, covariances) == dict.fromkeys(AXES, pytest.approx(-1.0))


def test_a_constant_covariance_has_no_rank_correlation(errors: np.ndarray) -> None:
    assert rank_correlation(errors, np.broadcast_to(np.eye(6), (COUNT, 6, 6))) == dict.fromkeys(AXES)


def test_axes_come_rotation_first(covariances: np.ndarray) -> None:
    errors = np.zeros((COUNT, 6))
    errors[:, 5] = 0.3
    axis = consistency(errors, covariances)["by_axis"]
    assert axis["translation_z"]["rmse"] == pytest.approx(0.3)
    assert axis["translation_z"]["bias"] == pytest.approx(0.3)
    assert axis["rotation_x"]["rmse"] == 0.0


def test_the_ellipsoids_are_those_of_chi_square() -> None:
    squared = np.array([chi2.ppf(0.949, 6), chi2.ppf(0.951, 6)])
    assert inside(squared, 0.95).tolist() == [True, False]


def test_honest_coverage_is_within_its_bounds_about_95_times_of_100() -> None:
    nominal = np.array([0.5, 0.9])
    lower, upper = coverage_bounds(nominal, 100)
    rng = np.random.default_rng(0)
    shares = rng.binomial(100, nominal, (2000, 2)) / 100
    held = ((lower <= shares) & (shares <= upper)).mean(0)
    assert np.all((held > 0.93) & (held < 0.98))  # the binomial is discrete


def test_the_interval_of_a_mean_holds_it_about_95_times_of_100() -> None:
    rng = np.random.default_rng(0)
    intervals = np.array([mean_interval(rng.normal(3.0, 1.0, 200)) for _ in range(100)])
    held = ((intervals[:, 0] < 3.0) & (intervals[:, 1] > 3.0)).mean()
    assert 0.86 <= held <= 1.0  # 3 standard deviations below, less the bootstrap's own few percent


def test_the_interval_is_wider_where_neighbours_are_alike() -> None:
    """Each value ten times in a row says as much as each once."""
    values = np.random.default_rng(0).normal(size=60)
    alike, apart = np.repeat(values, 10), np.tile(values, 10)
    widths = [np.ptp(mean_interval(v)) for v in (alike, apart)]
    assert widths[0] > 1.5 * widths[1]


def test_the_interval_is_the_same_every_time_and_exact_for_constants() -> None:
    values = np.random.default_rng(0).normal(size=33)
    assert mean_interval(values) == mean_interval(values)
    assert mean_interval(np.full(7, 2.0)) == pytest.approx((2.0, 2.0))
    assert mean_interval(np.array([5.0])) == pytest.approx((5.0, 5.0))


def test_normalised_squares_of_a_unit_covariance_are_squared_norms() -> None:
    assert_allclose(nees(np.eye(6)[:2] * [[2.0], [3.0]], np.stack([np.eye(6)] * 2)), [4.0, 9.0])
