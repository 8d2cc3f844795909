"""How honest covariances are: whether errors are as large as was said of them, and when it was said.

Errors and covariances are of poses, rotation first, right perturbation (`learned.covariance.pose_errors`). An honest
Gaussian's normalised squared error has a chi-square distribution of six degrees of freedom (Bar-Shalom, Li,
Kirubarajan, "Estimation with Applications to Tracking and Navigation", 2001, section 5.4).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import binom, chi2, spearmanr

from fusion_io.records import FloatArray
from learned.covariance import nees

AXES = ("rotation_x", "rotation_y", "rotation_z", "translation_x", "translation_y", "translation_z")

NOMINAL = (0.50, 0.90, 0.95, 0.99)

BLOCK = 10
"""Errors of so many pairs in a row, about a second, are resampled together: neighbours share their causes."""

RESAMPLES = 2000


def consistency(errors: FloatArray, covariances: FloatArray) -> dict[str, Any]:
    """The figures of N errors (N, 6) and the covariances (N, 6, 6) that were stated for them.

    anees: mean normalised squared error, 6 is right. coverage_P: share of errors inside the ellipsoid of P percent.
    nll: mean negative log likelihood in nats a pair. nll_constant: that of the best single covariance, which is
    fitted to these very errors and therefore the hardest opponent; None for too few pairs. nll_gain: how much better
    than it. rank_correlation: Spearman's, of stated standard deviation and size of the error; None where one is
    constant. by_axis: rmse and bias (mean error) in rad or m, and nees, 1 is right.
    """
    squared = nees(errors, covariances)
    likelihood, constant = negative_log_likelihood(errors, covariances), constant_nll(errors)
    nll = float(likelihood.mean())
    return {
        "anees": float(squared.mean()),
        **{f"coverage_{round(100 * p)}": float(inside(squared, p).mean()) for p in NOMINAL},
        "nll": nll,
        "nll_constant": constant,
        "nll_gain": None if constant is None else constant - nll,
        "rank_correlation": rank_correlation(errors, covariances),
        "by_axis": by_axis(errors, covariances),
    }


def negative_log_likelihood(errors: FloatArray, covariances: FloatArray) -> FloatArray:
    """Of every error (N,) under a Gaussian of mean zero, in nats (densities in rad and m)."""
    _, log_determinant = np.linalg.slogdet(covariances)
    return np.asarray(0.5 * (nees(errors, covariances) + log_determinant + errors.shape[1] * math.log(2 * math.pi)))


def constant_nll(errors: FloatArray) -> float | None:
    """Mean negative log likelihood under the best single covariance, the errors' second moment; None if singular."""
    moment = errors.T @ errors / len(errors)
    if np.linalg.matrix_rank(errors) < errors.shape[1]:
        return None
    return float(negative_log_likelihood(errors, np.broadcast_to(moment, (len(errors), *moment.shape))).mean())


def inside(squared: FloatArray, nominal: float) -> NDArray[np.bool_]:
    """Which normalised squared errors (N,) of 6 dof lie inside the ellipsoid of a nominal probability."""
    return np.asarray(squared <= chi2.ppf(nominal, len(AXES)))


def coverage_bounds(nominal: FloatArray, count: int) -> tuple[FloatArray, FloatArray]:
    """The central 95 % (K,), (K,) of the shares that `count` independent pairs give where nominal (K,) is true."""
    lower, upper = binom.interval(0.95, count, nominal)
    return np.asarray(lower / count), np.asarray(upper / count)


def rank_correlation(errors: FloatArray, covariances: FloatArray) -> dict[str, float | None]:
    """Spearman's rank correlation of stated standard deviation and absolute error by axis; None if undefined."""
    sigma = standard_deviations(covariances)
    return {axis: _spearman(sigma[:, k], np.abs(errors[:, k])) for k, axis in enumerate(AXES)}


def _spearman(a: FloatArray, b: FloatArray) -> float | None:
    if np.ptp(a) == 0 or np.ptp(b) == 0:
        return None
    return float(spearmanr(a, b).statistic)


def by_axis(errors: FloatArray, covariances: FloatArray) -> dict[str, dict[str, float]]:
    """Size and mean of the errors and their normalised square by axis."""
    rmse, bias = np.sqrt(np.mean(errors**2, axis=0)), errors.mean(0)
    normalised = np.mean((errors / standard_deviations(covariances)) ** 2, axis=0)
    return {
        axis: {"rmse": float(rmse[k]), "bias": float(bias[k]), "nees": float(normalised[k])}
        for k, axis in enumerate(AXES)
    }


def standard_deviations(covariances: FloatArray) -> FloatArray:
    """Roots (N, 6) of the diagonals of covariances (N, 6, 6)."""
    return np.asarray(np.sqrt(np.einsum("naa->na", covariances)))


def mean_interval(values: FloatArray) -> tuple[float, float]:
    """A 95 % interval of the mean of values (N,) in order of time, by circular block bootstrap with a fixed seed.

    Blocks keep the correlation of neighbours (Politis, Romano, "A circular block-resampling procedure for stationary
    data", 1992).
    """
    block = min(BLOCK, len(values))
    sums = np.convolve(np.concatenate([values, values[: block - 1]]), np.ones(block), "valid")
    starts = np.random.default_rng(0).integers(len(values), size=(RESAMPLES, math.ceil(len(values) / block)))
    lower, upper = np.quantile(sums[starts].mean(1) / block, [0.025, 0.975])
    return float(lower), float(upper)
