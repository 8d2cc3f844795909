"""From the spread of the hypotheses to a calibrated 6x6 covariance.

Four hypotheses about a winner span at most three directions, and their spread is not the error's size: a 6x6
needs a floor, and a gain an axis. Both are fitted by maximum likelihood on held-out simulation and stored with the
weights. S is the hypotheses' pooled spread or, for a refined pose, the inverse of the refinement's information.

    P = (diag(gain) S diag(gain) + diag(floor)^2) * (1 + missing_imu * (1 - coverage))^2
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace

import numpy as np
import torch
from scipy.optimize import minimize
from scipy.spatial.transform import RigidTransform
from scipy.stats import chi2

from fusion_io.records import FloatArray

DEGREES_OF_FREEDOM = 4.0
"""Of Student's t, the likelihood of the fit."""

LEAST_GROWTH = 0.1
"""A pair without its IMU never counts as surer than one with it."""


@dataclass(frozen=True)
class CovarianceModel:
    """Gain (6,) and floor (6,) in rad and m, rotation first; growth of sigma when the whole IMU window is missing."""

    gain: tuple[float, ...] = (1.0,) * 6
    floor: tuple[float, ...] = (2e-3, 2e-3, 2e-3, 0.05, 0.05, 0.05)
    missing_imu: float = 1.0

    def covariance(self, spread: FloatArray, imu_coverage: FloatArray) -> FloatArray:
        """Covariances (N, 6, 6) from spreads (N, 6, 6) and the measured shares (N,) of the IMU windows."""
        gain, floor = np.array(self.gain), np.array(self.floor)
        scaled = spread * np.outer(gain, gain) + np.diag(floor**2)
        inflation = (1 + self.missing_imu * (1 - np.asarray(imu_coverage))) ** 2
        return np.asarray(0.5 * (scaled + scaled.transpose(0, 2, 1)) * inflation[:, None, None])

    def to_dict(self) -> dict[str, object]:
        """Plain values for a checkpoint."""
        return asdict(self)


def hypothesis_spread(hypotheses: FloatArray, winner: FloatArray) -> FloatArray:
    """Second moment (N, 6, 6) of hypotheses (N, M, 4, 4) about the winner (N, 4, 4), in its tangent space."""
    count = hypotheses.shape[1]
    inverse = RigidTransform.from_matrix(winner).inv().as_matrix()
    relative = (inverse[:, None] @ hypotheses).reshape(-1, 4, 4)
    deviations = RigidTransform.from_matrix(relative).as_exp_coords().reshape(-1, count, 6)
    return np.asarray(np.einsum("nma,nmb->nab", deviations, deviations) / max(count - 1, 1))


def pooled(spread: FloatArray) -> FloatArray:
    """Spreads (N, 6, 6) without direction: the mean variance of the rotation axes on each, and of the translation's.

    The size of the spread tells which pairs are difficult, its direction nothing: with it the fitted likelihood of
    held-out simulated pairs was 3 nats a pair worse.
    """
    variances = np.einsum("naa->na", spread).reshape(-1, 2, 3).mean(2).repeat(3, axis=1)
    return np.asarray(variances[:, :, None] * np.eye(6))


def pose_errors(estimates: FloatArray, truth: FloatArray) -> FloatArray:
    """Log(estimate^-1 truth) (N, 6), rotation first, of poses (N, 4, 4)."""
    relative = RigidTransform.from_matrix(estimates).inv() * RigidTransform.from_matrix(truth)
    return np.asarray(relative.as_exp_coords())


def nees(errors: FloatArray, covariances: FloatArray) -> FloatArray:
    """The normalised errors squared e' P^-1 e (N,) of errors (N, 6)."""
    weighted = np.linalg.solve(covariances, errors[..., None])[..., 0]
    return np.asarray(np.sum(errors * weighted, axis=1))


def mean_nees(errors: FloatArray, covariances: FloatArray) -> float:
    """Mean over N errors (N, 6); 6 where the covariances are right."""
    return float(nees(errors, covariances).mean())


def fit(
    errors: FloatArray,
    spread: FloatArray,
    errors_without_imu: FloatArray | None = None,
    spread_without_imu: FloatArray | None = None,
) -> CovarianceModel:
    """Maximum-likelihood gain and floor per axis, then the growth that makes pairs without IMU consistent.

    errors (N, 6) and spread (N, 6, 6) of held-out pairs with their IMU, and, if the IMU matters to them, of pairs
    without one. The likelihood is that of Student's t, and a final scale puts 95 % of the errors within their 95 %
    region: a Gaussian and the mean NEES would be ruled by the few pairs that are lost altogether.
    """
    sizes = 1.5 * np.median(np.abs(errors), axis=0) + 1e-12
    spread_sizes = np.sqrt(np.median(np.einsum("naa->na", spread), axis=0)) + 1e-12
    e, S = torch.from_numpy(errors / sizes), torch.from_numpy(spread / np.outer(sizes, sizes))

    def negative_log_likelihood(parameters: FloatArray) -> tuple[float, FloatArray]:
        p = torch.tensor(parameters, requires_grad=True)
        gain, floor = p[:6].exp(), p[6:].exp()
        P = S * torch.outer(gain, gain) + torch.diag(floor**2)
        L = torch.linalg.cholesky(P)
        whitened = torch.linalg.solve_triangular(L, e[..., None], upper=False)
        tails = torch.log1p(whitened.square().sum((1, 2)) / DEGREES_OF_FREEDOM)
        value = 0.5 * (DEGREES_OF_FREEDOM + 6) * tails.mean() + L.diagonal(dim1=1, dim2=2).log().sum(1).mean()
        value.backward()
        assert p.grad is not None
        return float(value.detach()), p.grad.numpy()

    every = np.ones(len(errors))
    start = np.concatenate([np.log(0.3 * sizes / spread_sizes), np.log(0.7 * np.ones(6))])
    bounds = [(v - 8, v + 5) for v in start[:6]] + [(v - 3, v + 5) for v in start[6:]]  # no floor vanishes
    found = minimize(negative_log_likelihood, start, jac=True, method="L-BFGS-B", bounds=bounds)
    gain, floor = np.exp(found.x[:6]), np.exp(found.x[6:]) * sizes
    model = model_of(gain, floor, missing_scale(errors, model_of(gain, floor, 1.0).covariance(spread, every)))
    if errors_without_imu is None or spread_without_imu is None:
        return model
    P = model.covariance(spread_without_imu, np.ones(len(errors_without_imu)))
    return replace(model, missing_imu=max(missing_scale(errors_without_imu, P) - 1, LEAST_GROWTH))


def missing_scale(errors: FloatArray, covariances: FloatArray) -> float:
    """What sigmas must be multiplied with, so that 95 % of the errors (N, 6) lie within their 95 % region."""
    return float(np.sqrt(np.quantile(nees(errors, covariances), 0.95) / chi2.ppf(0.95, 6)))


def model_of(gain: FloatArray, floor: FloatArray, scale: float) -> CovarianceModel:
    """Arrays as a model of plain numbers, sigmas scaled."""
    return CovarianceModel(tuple((scale * gain).tolist()), tuple((scale * floor).tolist()), 0.0)


UNCALIBRATED = model_of(np.ones(6), np.zeros(6), 1.0)
"""Leaves a spread as it is."""
