"""Loop closures: places that the camera came back to, and the relative pose measured there.

Candidates (`fusion.retrieval`) are verified in steps, each of which can only reject:

1. local features that are each other's nearest;
2. perspective-n-point with RANSAC from the depth of either frame; the two poses must be inverse to each other, and
   rest on features all over the image, not on one object of which there are many;
3. depth and brightness, which must agree over most of what both frames see;
4. the pair estimator's refinement at full resolution, which starts there; where it ends too far away, or does not
   lower the error, the pose by the features stays.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform
from scipy.stats import chi2

from fusion.chain import adjoint
from fusion.config import LoopsConfig
from fusion.retrieval import (
    Features,
    Float32,
    Visits,
    appearance,
    candidates,
    local_features,
    reduced,
    root_sift,
)
from fusion_io.findings import Findings
from fusion_io.records import CameraFrame, CameraInfo, FloatArray, IntArray, PairEstimate, Trajectory
from learned import weights as weights_file
from learned.baselines import grey, resect
from learned.covariance import CovarianceModel
from learned.refinement import prepare_full, refine
from learned.warp import NEAREST_DEPTH_M

COMPARED_STRIDE = 8
"""Every so many-th pixel of either axis is enough to compare whole frames."""

LEAST_SIGMA_PX = 0.5
"""Features are not better located than this."""

MEDIAN_OF_RAYLEIGH = np.sqrt(2 * np.log(2))
"""Median length of a plane vector of unit normal numbers."""


class FrameSource(Protocol):
    """The part of a log that loops are found in."""

    def frame_stamps(self) -> IntArray:
        """Stamps of all frames."""

    def frames(self, stamps_ns: IntArray | None = None) -> Iterator[CameraFrame]:
        """Frames at these stamps, or all."""


class Keyframe(NamedTuple):
    """What is kept of a frame to compare it with others."""

    stamp_ns: int
    features: Features
    camera: CameraInfo


class Measured(NamedTuple):
    """A relative pose and its covariance (6, 6), rotation first, right perturbation."""

    T_source_target: RigidTransform
    covariance: FloatArray

    def inverse(self) -> Measured:
        """T_target_source."""
        turn = adjoint(self.T_source_target)
        return Measured(self.T_source_target.inv(), turn @ self.covariance @ turn.T)

    def contradicts(self, other: Measured, probability: float) -> bool:
        """Whether two measurements of one pose are further apart than noise puts them, but for this probability."""
        apart = (self.T_source_target.inv() * other.T_source_target).as_exp_coords()
        squared = apart @ np.linalg.solve(self.covariance + other.covariance, apart)
        return bool(squared > chi2.isf(probability, 6))


def find_loops(
    log: FrameSource, trajectory: Trajectory, weights: Path | None, config: LoopsConfig, findings: Findings
) -> list[PairEstimate]:
    """The loops of a log, in order of their targets; the source of each is the earlier frame.

    trajectory: approximate poses of its frames, with covariances where they are known: they say where to look.
    weights: of the pair estimator, for the covariance of what it refines; None for those that ship with the package.
    How many pairs of frames pass each stage is remarked in the findings. The same input gives the same bits.

    Raises LogError for unusable weights, and where the log has no frames.
    """
    visits = Visits.of(_with_frames(trajectory, log.frame_stamps()), config.retrieval)
    compared = visits.only(visits.with_partner())
    places = [_keyframe(frame) for frame in log.frames(compared.stamps_ns)]
    places = [place for place in places if len(place.features.pixels) >= config.min_inliers]
    visited = compared.only(np.searchsorted(compared.stamps_ns, [place.stamp_ns for place in places]))
    possible = list(candidates(appearance([place.features for place in places]), visited))
    by_features = [
        (places[each.source].stamp_ns, places[each.target].stamp_ns, measured)
        for each in possible
        if (measured := measure(places[each.source], places[each.target], config)) is not None
    ]
    loops = list(_confirmed(log, by_features, weights_file.load(weights).refined_covariance, config))
    findings.remark(
        f"loops: of {len(visits)} keyframes {len(compared)} may be near another; of {len(possible)} candidates "
        f"{len(by_features)} agree in their features, {len(loops)} in depth and brightness as well"
    )
    return loops


def measure(source: Keyframe, target: Keyframe, config: LoopsConfig) -> Measured | None:
    """The relative pose of two keyframes by their local features, None where they do not show the same place."""
    here, there = matches(source.features, target.features, config.match_ratio)
    forward = _resected(source, here, target, there, config)
    backward = _resected(target, there, source, here, config) if forward else None
    if forward is None or backward is None:
        return None
    if np.linalg.norm(forward.T_source_target.translation) > config.max_distance_m:
        return None
    return None if forward.contradicts(backward.inverse(), config.gate_probability) else forward


def matches(source: Features, target: Features, ratio: float) -> tuple[IntArray, IntArray]:
    """Indices (N,) of the features of source and target that are each other's nearest, and clearly so.

    ratio: of the distances to the nearest and to the second (Lowe 2004), in both directions.
    """
    if min(len(source.pixels), len(target.pixels)) < 2:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    likeness = root_sift(source.descriptors) @ root_sift(target.descriptors).T
    nearest = likeness.argmax(axis=1)
    mutual = likeness.argmax(axis=0)[nearest] == np.arange(len(nearest))
    kept = np.flatnonzero(mutual & _is_clear(likeness, ratio) & _is_clear(likeness.T, ratio)[nearest])
    return kept, nearest[kept]


class Agreement(NamedTuple):
    """How well two frames agree at a relative pose, 0 to 1 each but for image, which is a correlation.

    overlap: the share of the source's pixels that the target sees; depth: the share of those that are where it sees
    them; image: the correlation of their brightness with the target's.
    """

    overlap: float
    depth: float
    image: float


def agreement(
    source: CameraFrame, target: CameraFrame, T_source_target: RigidTransform, depth_tolerance: float
) -> Agreement:
    """The agreement of all that both frames see, whether it has features or not.

    depth_tolerance: of the target's depth, relative. Both frames must have depth; pixels without do not count.
    """
    assert source.depth is not None
    assert target.depth is not None
    height, width = source.depth.shape
    v, u = (axis.ravel() for axis in np.mgrid[:height:COMPARED_STRIDE, :width:COMPARED_STRIDE])
    z = source.depth[v, u].astype(np.float64)
    u, v, z = (each[np.isfinite(z) & (z > 0)] for each in (u, v, z))
    points = T_source_target.inv().apply(
        np.column_stack([u, v, np.ones(len(u))]) @ np.linalg.inv(source.camera.K).T * z[:, None]
    )
    ahead = np.flatnonzero(points[:, 2] > NEAREST_DEPTH_M)
    column, row = np.rint((points[ahead] @ target.camera.K.T)[:, :2] / points[ahead, 2:]).astype(np.int64).T
    inside = (column >= 0) & (column < target.depth.shape[1]) & (row >= 0) & (row < target.depth.shape[0])
    ahead, column, row = ahead[inside], column[inside], row[inside]
    seen = target.depth[row, column]
    there = np.abs(points[ahead, 2] - seen) < depth_tolerance * seen
    valid = np.isfinite(seen) & (seen > 0)
    alike = _correlation(_smooth(source)[v[ahead], u[ahead]][valid], _smooth(target)[row, column][valid])
    return Agreement(valid.sum() / max(len(u), 1), there.sum() / max(valid.sum(), 1), alike)


def _smooth(frame: CameraFrame) -> Float32:
    """Brightness over the cells that are compared."""
    return np.asarray(cv2.blur(grey(frame).astype(np.float32), (COMPARED_STRIDE, COMPARED_STRIDE)))


def _correlation(a: Float32, b: Float32) -> float:
    """Of values (N,); 0 where there are none, or one of them does not vary."""
    if not len(a):
        return 0.0
    da, db = a - a.mean(), b - b.mean()
    return float(da @ db / max(float(np.sqrt((da @ da) * (db @ db))), 1e-9))


def _keyframe(frame: CameraFrame) -> Keyframe:
    frame = reduced(frame)
    return Keyframe(frame.stamp_ns, local_features(frame), frame.camera)


def _resected(
    source: Keyframe, here: IntArray, target: Keyframe, there: IntArray, config: LoopsConfig
) -> Measured | None:
    """The pose from which the target sees the source's features, by matches (N,), None where too few agree."""
    points = source.features.points[here].astype(np.float64)
    pixels = target.features.pixels[there].astype(np.float64)
    found = resect(points, pixels, target.camera.K, config.reprojection_px)
    if found is None or found.inliers.sum() < max(config.min_inliers, config.min_inlier_share * len(points)):
        return None
    seen = pixels[found.inliers]
    spread = cv2.contourArea(cv2.convexHull(seen.astype(np.float32))) / (target.camera.width * target.camera.height)
    if spread < config.min_spread:
        return None
    pose = RigidTransform.from_matrix(found.T_source_target)
    return Measured(pose, _covariance(pose.inv().apply(points[found.inliers]), seen, target.camera.K) + floor(config))


def _covariance(points: FloatArray, pixels: FloatArray, K: FloatArray) -> FloatArray:
    """Covariance (6, 6) of a camera that sees points (N, 3) m in its own frame at pixels (N, 2).

    sigma^2 (J'J)^-1, with the standard deviation of the pixels from the median of their residuals, which are taken to
    be normal along either axis.
    """
    projected = points @ K.T
    residuals = projected[:, :2] / projected[:, 2:] - pixels
    sigma = max(float(np.median(np.linalg.norm(residuals, axis=1))) / MEDIAN_OF_RAYLEIGH, LEAST_SIGMA_PX)
    x, y, z = points.T
    by_point = np.zeros((len(points), 2, 3))
    by_point[:, 0, 0], by_point[:, 0, 2] = K[0, 0] / z, -K[0, 0] * x / z**2
    by_point[:, 1, 1], by_point[:, 1, 2] = K[1, 1] / z, -K[1, 1] * y / z**2
    turned = np.cross(points[:, None, :], np.eye(3))  # d point / d rotation, a step of the camera to the right: [p]x
    jacobian = np.concatenate([by_point @ turned.transpose(0, 2, 1), -by_point], axis=2).reshape(-1, 6)
    return np.asarray(sigma**2 * np.linalg.inv(jacobian.T @ jacobian))


def _confirmed(
    log: FrameSource, found: Sequence[tuple[int, int, Measured]], model: CovarianceModel, config: LoopsConfig
) -> Iterator[PairEstimate]:
    """Those whose depth agrees, refined; found: stamps of source and target, and what their features say."""
    frames = log.frames(np.array([stamps for *stamps, _ in found], dtype=np.int64).ravel())
    for (_, _, measured), source, target in zip(found, frames, frames, strict=False):
        both = agreement(source, target, measured.T_source_target, config.depth_tolerance)
        if (
            both.overlap >= config.min_overlap
            and both.depth >= config.min_depth
            and both.image >= config.min_correlation
        ):
            yield _loop(source, target, _refined(source, target, measured, model, config))


def _refined(
    source: CameraFrame, target: CameraFrame, measured: Measured, model: CovarianceModel, config: LoopsConfig
) -> Measured:
    """The photometric optimum near what was measured, or what was measured where there is none."""
    if source.image.shape[:2] != target.image.shape[:2]:  # of the same camera only
        return measured
    start, prior = measured.T_source_target.as_matrix()[None], measured.covariance[None]
    result = refine([(prepare_full(source), prepare_full(target))], start, prior, np.zeros((0, 1, 4, 4)))
    covariance = model.covariance(result.covariance, np.ones(1))[0] + floor(config)
    refined = Measured(RigidTransform.from_matrix(result.T_source_target[0]), covariance)
    kept = bool(result.improved[0]) and not refined.contradicts(measured, config.gate_probability)
    return refined if kept else measured


def _loop(source: CameraFrame, target: CameraFrame, measured: Measured) -> PairEstimate:
    pose = measured.T_source_target
    quat_wxyz = pose.rotation.as_quat(scalar_first=True, canonical=True)
    covariance = 0.5 * (measured.covariance + measured.covariance.T)
    return PairEstimate(source.stamp_ns, target.stamp_ns, quat_wxyz, pose.translation, covariance)


def _is_clear(likeness: Float32, ratio: float) -> NDArray[np.bool_]:
    """Where the nearest of each row (N, M) is nearer than `ratio` times the second: distances^2 are 2 - 2 likeness."""
    second, nearest = np.partition(likeness, -2, axis=1)[:, -2:].T
    return np.asarray(1.0 - nearest < ratio**2 * (1.0 - second))


def _with_frames(trajectory: Trajectory, frame_stamps: IntArray) -> Trajectory:
    """The poses of a trajectory that are those of frames."""
    kept = np.isin(trajectory.stamps_ns, frame_stamps)
    covariances = None if trajectory.covariances is None else trajectory.covariances[kept]
    return Trajectory(trajectory.stamps_ns[kept], trajectory.poses[kept], covariances)


def floor(config: LoopsConfig) -> FloatArray:
    """The least covariance (6, 6), which is added to every other."""
    return np.diag(3 * [np.deg2rad(config.rotation_floor_deg) ** 2] + 3 * [config.translation_floor_m**2])
