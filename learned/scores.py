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


class Agreement(TypedDict):
    """Root mean squares of how far two estimates are apart, and of the error that both share."""

    apart_translation_m: float
    apart_rotation_rad: float
    shared_translation_m: float
    shared_rotation_rad: float


def agreement(one: FloatArray, other: FloatArray, truth: FloatArray) -> Agreement:
    """What two estimates (N, 4, 4) made in different ways say of the reference (N, 4, 4) that they are judged by.

    Of independent errors the squares of the distances between the three are the sums of two of the squares, so that
    each follows from the distances ("three-cornered hat": Gray and Allan, "A method for estimating the frequency
    stability of an individual oscillator", 1974). What both estimates have in common (calibration, stamps) counts as
    the reference's.
    """
    first, second, apart = (
        np.mean(np.square(error_norms(a, b)), axis=1) for a, b in ((one, truth), (other, truth), (one, other))
    )
    shared = np.maximum((first + second - apart) / 2, 0.0)
    (apart_m, apart_rad), (shared_m, shared_rad) = np.sqrt([apart, shared]).tolist()
    return Agreement(
        apart_translation_m=apart_m,
        apart_rotation_rad=apart_rad,
        shared_translation_m=shared_m,
        shared_rotation_rad=shared_rad,
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
