"""Errors of relative poses against ground truth."""

from __future__ import annotations

from typing import TypedDict

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from fusion_io.records import FloatArray, PairEstimate


class Score(TypedDict):
    """Root mean squares of the Euclidean norms of the errors of an estimator named `name`."""

    name: str
    translation_rmse_m: float
    rotation_rmse_rad: float


def mean_motion(T: FloatArray) -> FloatArray:
    """The motion (4, 4) whose translation and rotation are the means of T (N, 4, 4)."""
    mean = np.eye(4)
    mean[:3, :3] = Rotation.from_matrix(T[:, :3, :3]).mean().as_matrix()
    mean[:3, 3] = T[:, :3, 3].mean(0)
    return mean


def hypothesis_matrices(pair: PairEstimate) -> FloatArray:
    """The hypotheses of a pair as T_source_target (M, 4, 4)."""
    rotation = Rotation.from_quat(pair.hypotheses_quat_wxyz, scalar_first=True)
    return np.asarray(RigidTransform.from_components(pair.hypotheses_translation, rotation).as_matrix())


def score(name: str, estimates: FloatArray, truth: FloatArray) -> Score:
    """Errors of estimated relative poses (N, 4, 4) against true ones."""
    relative = np.linalg.inv(estimates) @ truth
    rotation = Rotation.from_matrix(relative[:, :3, :3]).magnitude()
    translation = np.linalg.norm(estimates[:, :3, 3] - truth[:, :3, 3], axis=1)
    return Score(
        name=name,
        translation_rmse_m=float(np.sqrt(np.mean(translation**2))),
        rotation_rmse_rad=float(np.sqrt(np.mean(rotation**2))),
    )
