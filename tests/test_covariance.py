"""Laws of the covariance: positive definite, calibrated, and wider where the IMU is missing."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import RigidTransform

from learned.covariance import CovarianceModel, fit, hypothesis_spread, mean_nees, pooled, pose_errors


@given(seed=st.integers(0, 2**32 - 1), size=st.floats(0, 1))
def test_covariance_is_positive_definite_for_any_spread(seed: int, size: float) -> None:
    """Four hypotheses span at most three directions; the floor fills the rest."""
    rng = np.random.default_rng(seed)
    hypotheses = RigidTransform.from_exp_coords(size * rng.normal(size=(4, 6))).as_matrix()[None]
    spread = hypothesis_spread(hypotheses, hypotheses[:, 0])
    P = CovarianceModel().covariance(spread, np.ones(1))[0]
    if size > 1e-6:  # squares of less underflow, and a rank of rounding errors says nothing
        assert np.linalg.matrix_rank(spread[0]) <= 3
    np.testing.assert_array_equal(P, P.T)
    assert np.linalg.eigvalsh(P)[0] > 0


def test_spread_is_the_second_moment_about_the_winner() -> None:
    rng = np.random.default_rng(0)
    deviations = 0.1 * rng.normal(size=(1, 4, 6))
    deviations[0, 2] = 0
    winner = RigidTransform.from_exp_coords(rng.normal(size=(1, 6))).as_matrix()
    hypotheses = winner[:, None] @ RigidTransform.from_exp_coords(deviations[0]).as_matrix()[None]
    expected = np.einsum("nma,nmb->nab", deviations, deviations) / 3
    np.testing.assert_allclose(hypothesis_spread(hypotheses, winner), expected, atol=1e-12)


def test_pose_errors_are_right_perturbations_rotation_first() -> None:
    rng = np.random.default_rng(0)
    estimate = RigidTransform.from_exp_coords(rng.normal(size=(5, 6)))
    xi = 0.01 * rng.normal(size=(5, 6))
    truth = estimate * RigidTransform.from_exp_coords(xi)
    np.testing.assert_allclose(pose_errors(estimate.as_matrix(), truth.as_matrix()), xi, atol=1e-12)


def simulated_errors(seed: int, count: int, growth: float) -> tuple[np.ndarray, np.ndarray]:
    """Errors drawn from the model itself, with a known gain, floor and growth."""
    rng = np.random.default_rng(seed)
    spread_size = np.exp(rng.normal(size=(count, 6))) * [1e-3, 1e-3, 1e-3, 1e-2, 1e-2, 3e-2]
    spread = np.einsum("na,ab->nab", spread_size**2, np.eye(6))
    truth = CovarianceModel((2.0,) * 6, (1e-3, 1e-3, 1e-3, 5e-3, 5e-3, 2e-2), growth)
    P = truth.covariance(spread, np.zeros(count) if growth else np.ones(count))
    return np.einsum("nab,nb->na", np.linalg.cholesky(P), rng.normal(size=(count, 6))), spread


def test_fit_recovers_the_model_that_made_the_errors() -> None:
    errors, spread = simulated_errors(0, 4000, growth=0.0)
    errors_without, spread_without = simulated_errors(1, 4000, growth=1.5)
    model = fit(errors, spread, errors_without, spread_without)
    np.testing.assert_allclose(model.gain, 2.0, rtol=0.15)
    np.testing.assert_allclose(model.floor, [1e-3, 1e-3, 1e-3, 5e-3, 5e-3, 2e-2], rtol=0.15)
    assert model.missing_imu == pytest.approx(1.5, rel=0.1)


def test_fitted_covariance_is_consistent_on_other_pairs() -> None:
    """NEES: 6 is right; 4000 pairs have a standard deviation of 0.055 about it."""
    errors, spread = simulated_errors(0, 4000, growth=0.0)
    model = fit(errors, spread, errors, spread)
    errors, spread = simulated_errors(2, 4000, growth=0.0)
    assert mean_nees(errors, model.covariance(spread, np.ones(4000))) == pytest.approx(6, abs=0.3)


def test_covariance_grows_as_the_imu_window_empties() -> None:
    spread = np.zeros((3, 6, 6))
    P = CovarianceModel(missing_imu=1.0).covariance(spread, np.array([1.0, 0.5, 0.0]))
    np.testing.assert_allclose(P[2], 4 * P[0])
    np.testing.assert_allclose(P[1], 2.25 * P[0])


def test_pooling_keeps_the_size_of_the_spread_and_drops_its_direction() -> None:
    A = np.random.default_rng(0).standard_normal((5, 6, 6))
    spread = A @ A.transpose(0, 2, 1)
    P = pooled(spread)
    for block in (slice(0, 3), slice(3, 6)):
        np.testing.assert_allclose(np.trace(P[:, block, block], axis1=1, axis2=2),
                                   np.trace(spread[:, block, block], axis1=1, axis2=2))  # fmt: skip
        np.testing.assert_allclose(P[:, block, block], P[:, block.start, block.start][:, None, None] * np.eye(3))


def test_a_few_lost_pairs_do_not_rule_the_fit() -> None:
    """Three of a hundred errors, a hundred times too large, change the fitted sigmas by less than a third."""
    rng = np.random.default_rng(1)
    errors, spread = 0.01 * rng.standard_normal((2000, 6)), np.zeros((2000, 6, 6)) + 1e-6 * np.eye(6)
    lost = errors.copy()
    lost[::33] *= 100
    clean, robust = (fit(e, spread).covariance(spread[:1], np.ones(1))[0] for e in (errors, lost))
    np.testing.assert_allclose(np.sqrt(np.diag(robust) / np.diag(clean)), 1, atol=1 / 3)
