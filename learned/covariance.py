"""From the spread of the hypotheses to a calibrated 6x6 covariance.

Four hypotheses about a winner span at most three directions, and their spread is not the error's size: a 6x6
needs a floor, and a gain an axis. Both are fitted by maximum likelihood on held-out simulation and stored with the
weights.

    P = (diag(gain) S diag(gain) + diag(floor)^2) * (1 + missing_imu * (1 - coverage))^2
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace

import numpy as np
import torch
from scipy.optimize import minimize
from scipy.spatial.transform import RigidTransform

from fusion_io.records import FloatArray

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


def pose_errors(estimates: FloatArray, truth: FloatArray) -> FloatArray:
    """Log(estimate^-1 truth) (N, 6), rotation first, of poses (N, 4, 4)."""
    relative = RigidTransform.from_matrix(estimates).inv() * RigidTransform.from_matrix(truth)
    return np.asarray(relative.as_exp_coords())


def mean_nees(errors: FloatArray, covariances: FloatArray) -> float:
    """Mean of e' P^-1 e over N errors (N, 6); 6 where the covariances are right."""
    weighted = np.linalg.solve(covariances, errors[..., None])[..., 0]
    return float(np.mean(np.sum(errors * weighted, axis=1)))


def fit(
    errors: FloatArray, spread: FloatArray, errors_without_imu: FloatArray, spread_without_imu: FloatArray
) -> CovarianceModel:
    """Maximum-likelihood gain and floor per axis, then the growth that makes pairs without IMU consistent.

    errors (N, 6) and spread (N, 6, 6) of held-out pairs with their IMU, and of pairs without one. A final scale
    makes the mean NEES six: the likelihood of a Gaussian alone undervalues the tails.
    """
    sizes = np.sqrt(np.mean(errors**2, axis=0))
    spread_sizes = np.sqrt(np.einsum("naa->na", spread).mean(0)) + 1e-12
    e, S = torch.from_numpy(errors / sizes), torch.from_numpy(spread / np.outer(sizes, sizes))

    def negative_log_likelihood(parameters: FloatArray) -> tuple[float, FloatArray]:
        p = torch.tensor(parameters, requires_grad=True)
        gain, floor = p[:6].exp(), p[6:].exp()
        P = S * torch.outer(gain, gain) + torch.diag(floor**2)
        L = torch.linalg.cholesky(P)
        whitened = torch.linalg.solve_triangular(L, e[..., None], upper=False)
        value = 0.5 * whitened.square().sum((1, 2)).mean() + L.diagonal(dim1=1, dim2=2).log().sum(1).mean()
        value.backward()
        assert p.grad is not None
        return float(value.detach()), p.grad.numpy()

    start = np.concatenate([np.log(0.3 * sizes / spread_sizes), np.log(0.7 * np.ones(6))])
    bounds = [(v - 8, v + 5) for v in start]
    found = minimize(negative_log_likelihood, start, jac=True, method="L-BFGS-B", bounds=bounds)
    gain, floor = np.exp(found.x[:6]), np.exp(found.x[6:]) * sizes
    nees = mean_nees(errors, model_of(gain, floor, 1.0).covariance(spread, np.ones(len(errors))))
    model = model_of(gain, floor, np.sqrt(nees / 6))
    without = mean_nees(errors_without_imu, model.covariance(spread_without_imu, np.ones(len(errors_without_imu))))
    return replace(model, missing_imu=max(float(np.sqrt(without / 6)) - 1, LEAST_GROWTH))


def model_of(gain: FloatArray, floor: FloatArray, scale: float) -> CovarianceModel:
    """Arrays as a model of plain numbers, sigmas scaled."""
    return CovarianceModel(tuple((scale * gain).tolist()), tuple((scale * floor).tolist()), 0.0)
