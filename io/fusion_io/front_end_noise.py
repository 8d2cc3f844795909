"""The errors of a learned front end, added to pair estimates that are exact.

What a network gets wrong in one pair it gets wrong in the next: beside white noise there is a part that fades slowly,
an autoregressive process of first order, in the rotation (about each axis) and in the scale of the translation.

The defaults are those that give about the errors which VIOLearner has published on KITTI: on 07, 09 and 10, over five
seeds, a raw chain has a t_rel of 2.6 % and an r_rel of 1.4 deg/100 m on average.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation

from fusion_io.records import FloatArray, PairEstimate

#: 0.035 deg/sqrt(s) in pairs that are 0.1 s apart. As the standard deviation of each pair, 0.035 deg would give three
#: times the rotation error that is published.
ROTATION_DRIFT_DEG = 0.011
SCALE_DRIFT = 0.008


@dataclass(frozen=True, slots=True)
class FrontEndNoise:
    """Standard deviations of the error of a pair.

    rotation_drift_deg (about each axis) and scale_drift (relative): of the parts that fade, which keep the share
    `correlation` of themselves from pair to pair; they have these standard deviations from the first pair on.
    rotation_white_deg (about each axis), translation_white_m (x, y, z of the source camera): of what is new in each.
    """

    rotation_drift_deg: float = ROTATION_DRIFT_DEG
    scale_drift: float = SCALE_DRIFT
    correlation: float = 0.99
    rotation_white_deg: float = 0.05
    translation_white_m: tuple[float, float, float] = (0.005, 0.002, 0.02)


def with_noise(pairs: Sequence[PairEstimate], seed: int, noise: FrontEndNoise = FrontEndNoise()) -> list[PairEstimate]:
    """Consecutive pair estimates that are exact, as a learned front end would have made them.

    The covariances are those of the errors of each pair by itself, the fading parts included; that errors last from
    pair to pair they cannot say. The same seed gives the same errors.
    """
    rng = np.random.default_rng(seed)
    drift = autoregressive(rng.standard_normal((len(pairs), 4)), noise.correlation)
    white = rng.standard_normal((len(pairs), 6))
    turned = np.deg2rad(noise.rotation_drift_deg * drift[:, :3] + noise.rotation_white_deg * white[:, :3])
    scale = 1.0 + noise.scale_drift * drift[:, 3]
    moved = white[:, 3:] * noise.translation_white_m
    return [_changed(*each, noise) for each in zip(pairs, turned, scale, moved, strict=True)]


def autoregressive(white: FloatArray, correlation: float) -> FloatArray:
    """Processes (N, M) of unit variance from white noise (N, M) of unit variance; each keeps that share of itself."""
    innovation = np.sqrt(1.0 - correlation**2) * white
    innovation[:1] = white[:1]  # stationary from the start
    return np.asarray(lfilter([1.0], [1.0, -correlation], innovation, axis=0))


def _changed(
    pair: PairEstimate, turned: FloatArray, scale: float, moved: FloatArray, noise: FrontEndNoise
) -> PairEstimate:
    """The pair turned by a rotation vector (3,), in the axes of the target, scaled, and moved (3,) by metres."""
    rotation = pair.T_source_target.rotation * Rotation.from_rotvec(turned)
    return replace(
        pair,
        quat_wxyz=rotation.as_quat(scalar_first=True),
        translation=scale * pair.translation + moved,
        covariance=_covariance(rotation.as_matrix(), pair.translation, noise),
    )


def _covariance(R_source_target: FloatArray, translation: FloatArray, noise: FrontEndNoise) -> FloatArray:
    """Of the error of one pair (6, 6), a right perturbation: in the axes of the target."""
    in_source = np.diag(np.square(noise.translation_white_m)) + noise.scale_drift**2 * np.outer(
        translation, translation
    )
    covariance = np.zeros((6, 6))
    covariance[:3, :3] = np.deg2rad(np.hypot(noise.rotation_drift_deg, noise.rotation_white_deg)) ** 2 * np.eye(3)
    covariance[3:, 3:] = R_source_target.T @ in_source @ R_source_target
    return covariance
