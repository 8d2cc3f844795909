"""Errors of relative poses against ground truth."""

from __future__ import annotations

from typing import TypedDict

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from fusion_io.records import FloatArray, PairEstimate


class Score(TypedDict):
    """Root mean squares, medians and maxima of the Euclidean norms of the errors of an estimator named `name`."""

    name: str
    translation_rmse_m: float
    rotation_rmse_rad: float
    translation_median_m: float
    rotation_median_rad: float
    translation_max_m: float
    rotation_max_rad: float


def score(name: str, estimates: FloatArray, truth: FloatArray) -> Score:
    """Errors of estimated relative poses (N, 4, 4) against true ones."""
    translation, rotation = error_norms(estimates, truth)
    return Score(
        name=name,
        translation_rmse_m=float(np.sqrt(np.mean(translation**2))),
        rotation_rmse_rad=float(np.sqrt(np.mean(rotation**2))),
        translation_median_m=float(np.median(translation)),
        rotation_median_rad=float(np.median(rotation)),
        translation_max_m=float(translation.max()),
        rotation_max_rad=float(rotation.max()),
    )


def error_norms(estimates: FloatArray, truth: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Norms (N,) of the errors in m, and angles (N,) in rad, of poses (N, 4, 4) against true ones."""
    relative = np.linalg.inv(estimates) @ truth
    rotation = Rotation.from_matrix(relative[:, :3, :3]).magnitude()
    return np.linalg.norm(estimates[:, :3, 3] - truth[:, :3, 3], axis=1), np.asarray(rotation)


def mean_motion(T: FloatArray) -> FloatArray:
    """The motion (4, 4) whose translation and rotation are the means of T (N, 4, 4)."""
    mean = np.eye(4)
    mean[:3, :3] = Rotation.from_matrix(T[:, :3, :3]).mean().as_matrix()
    mean[:3, 3] = T[:, :3, 3].mean(0)
    return mean


def mean_poses(T: FloatArray, weights: FloatArray | None = None) -> FloatArray:
    """The weighted means (N, 4, 4) on SE(3) of poses (N, M, 4, 4); weights (N, M), equal if None.

    The group's own mean, about which the weighted logarithms add up to zero (Pennec, Arsigny, "Exponential
    Barycenters of the Canonical Cartan Connection and Invariant Means on Lie Groups", 2013, algorithm 1). The poses
    must be less than half a turn apart.
    """
    count, each = T.shape[:2]
    weights = np.ones((count, each)) if weights is None else weights
    share = weights / weights.sum(1, keepdims=True)
    poses, mean = RigidTransform.from_matrix(T.reshape(-1, 4, 4)), RigidTransform.from_matrix(T[:, 0])
    for _ in range(20):  # converges quadratically near the mean
        deviations = (mean[np.repeat(np.arange(count), each)].inv() * poses).as_exp_coords().reshape(count, each, 6)
        step = np.einsum("nm,nma->na", share, deviations)
        mean = mean * RigidTransform.from_exp_coords(step)
        if np.abs(step).max() < 1e-12:
            break
    return np.asarray(mean.as_matrix())


def hypothesis_matrices(pair: PairEstimate) -> FloatArray:
    """The hypotheses of a pair as T_source_target (M, 4, 4)."""
    rotation = Rotation.from_quat(pair.hypotheses_quat_wxyz, scalar_first=True)
    return np.asarray(RigidTransform.from_components(pair.hypotheses_translation, rotation).as_matrix())
