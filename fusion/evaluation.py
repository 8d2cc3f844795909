"""How far an estimated trajectory is from the ground truth, in the measures of the field.

Ground truth is interpolated to the camera's stamps (linear position, slerp rotation); only frames that it spans are
compared, and the world of both trajectories is the first of them.

Errors are those that the estimate's own covariance speaks of: in the axes of the estimated camera (right
perturbation), position R_est^T (p_true - p_est) and orientation Log(R_est^T R_true).
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation
from scipy.stats import chi2

from fusion_io.records import FloatArray, IntArray, Trajectory

# Of the KITTI odometry devkit (cpp/evaluate_odometry.cpp).
KITTI_SEGMENT_LENGTHS_M = (100.0, 200.0, 300.0, 400.0, 500.0, 600.0, 700.0, 800.0)
KITTI_START_EVERY_FRAMES = 10

# A standard deviation below a micrometre or a microradian claims nothing: it marks the pose that defines the world.
MIN_VARIANCE = 1e-12

ANEES_DIMENSIONS = 3
"""Of position, and of orientation: the ANEES of a covariance that is right."""

CONFIDENCE = 0.95
INDEPENDENT_ERRORS = 10
"""Errors of odometry are correlated in time: those of a run tell about as much as so many independent ones."""

Consistency = Literal["overconfident", "consistent", "timid"]


@dataclass(frozen=True, slots=True)
class Metrics:
    """The measures of one trajectory, named as in metrics.json; None where one cannot be computed.

    t_rel_percent, r_rel_deg_per_100m: KITTI devkit, over `segments` segments. ate_m: RMSE of position after SE(3)
    alignment of the whole trajectory. end_error_m: distance at the last frame with the first poses aligned.
    rpe_*: RMSE of the relative pose error between consecutive frames. anees_*: mean normalised squared error of 3
    degrees of freedom; 3 is right (`consistency`).
    """

    t_rel_percent: float | None = None
    r_rel_deg_per_100m: float | None = None
    segments: int = 0
    ate_m: float | None = None
    end_error_m: float | None = None
    rpe_translation_m: float | None = None
    rpe_rotation_rad: float | None = None
    anees_position: float | None = None
    anees_orientation: float | None = None


class ErrorSeries(NamedTuple):
    """The error of every compared pose and what the estimate says of it, in the axes of the estimated camera.

    stamps_ns (N,); position_error_m, rotation_error_rad (N, 3); the standard deviations (N, 3) of the same
    components, or None where the estimate has no covariance.
    """

    stamps_ns: IntArray
    position_error_m: FloatArray
    rotation_error_rad: FloatArray
    position_sigma_m: FloatArray | None
    rotation_sigma_rad: FloatArray | None


class SegmentErrors(NamedTuple):
    """The errors of M segments: the pose that the estimate ends in, where both begin in the same one.

    start, end (M,): indices of poses. length_m (M,): the nominal length. translation_percent (M,): distance between
    the ends by length. rotation_deg_per_100m (M,): angle between them by length.
    """

    start: IntArray
    end: IntArray
    length_m: FloatArray
    translation_percent: FloatArray
    rotation_deg_per_100m: FloatArray


def evaluate(
    estimate: Trajectory,
    ground_truth: Trajectory | None,
    segment_lengths_m: Sequence[float] = KITTI_SEGMENT_LENGTHS_M,
) -> Metrics:
    """All measures of a trajectory against the ground truth, None where there is nothing to compute them from."""
    if ground_truth is None:
        return Metrics()
    estimate, truth = common(estimate, ground_truth)
    if len(estimate) < 2:
        return Metrics()
    t_rel_percent, r_rel_deg_per_100m, segments = kitti_errors(estimate.poses, truth.poses, segment_lengths_m)
    rpe_translation_m, rpe_rotation_rad = relative_pose_error(estimate.poses, truth.poses)
    anees_position, anees_orientation = anees(estimate, truth)
    return Metrics(
        t_rel_percent=t_rel_percent,
        r_rel_deg_per_100m=r_rel_deg_per_100m,
        segments=segments,
        ate_m=absolute_trajectory_error(estimate.poses.translation, truth.poses.translation),
        end_error_m=float(np.linalg.norm(estimate.poses.translation[-1] - truth.poses.translation[-1])),
        rpe_translation_m=rpe_translation_m,
        rpe_rotation_rad=rpe_rotation_rad,
        anees_position=anees_position,
        anees_orientation=anees_orientation,
    )


def anees_bounds() -> tuple[float, float]:
    """Between which the ANEES of a covariance that is right is expected with 95 %: 1.7 to 4.7.

    By the chi-square distribution of `INDEPENDENT_ERRORS`. Outside, sigmas are off by more than a quarter.
    """
    low, high = chi2.interval(CONFIDENCE, INDEPENDENT_ERRORS * ANEES_DIMENSIONS)
    return float(low) / INDEPENDENT_ERRORS, float(high) / INDEPENDENT_ERRORS


def consistency(anees: float) -> Consistency:
    """Whether errors are as large as was stated: the one rule for all that is shown."""
    low, high = anees_bounds()
    return "overconfident" if anees > high else "timid" if anees < low else "consistent"


def errors_by_sigmas(anees: float) -> float:
    """How many times the stated sigmas the errors are, by their root mean square; 1 is right."""
    return float(np.sqrt(anees / ANEES_DIMENSIONS))


def errors_over_time(estimate: Trajectory, ground_truth: Trajectory) -> ErrorSeries:
    """The errors of all compared poses with the first of them aligned; empty where the two have no time in common."""
    estimate, truth = common(estimate, ground_truth)
    position, rotation = pose_errors(estimate.poses, truth.poses)
    if estimate.covariances is None:
        return ErrorSeries(estimate.stamps_ns, position, rotation, None, None)
    sigma = np.sqrt(np.diagonal(estimate.covariances, axis1=1, axis2=2))
    return ErrorSeries(estimate.stamps_ns, position, rotation, sigma[:, 3:], sigma[:, :3])


def common(estimate: Trajectory, ground_truth: Trajectory) -> tuple[Trajectory, Trajectory]:
    """The compared poses of both, at the estimate's stamps and in the frame of the first of them.

    The covariances are kept: where the ground truth begins after the estimate's first pose, they still speak of the
    error since then.
    """
    spanned = ground_truth.covers(estimate.stamps_ns)
    stamps = estimate.stamps_ns[spanned]
    covariances = None if estimate.covariances is None else estimate.covariances[spanned]
    compared = Trajectory(stamps, estimate.poses[spanned], covariances)
    if not len(stamps):
        return compared, Trajectory(stamps, compared.poses)
    return compared.relative_to_first(), Trajectory(stamps, ground_truth.at(stamps)).relative_to_first()


def kitti_errors(
    estimate: RigidTransform,
    truth: RigidTransform,
    segment_lengths_m: Sequence[float] = KITTI_SEGMENT_LENGTHS_M,
) -> tuple[float | None, float | None, int]:
    """t_rel (percent), r_rel (degrees per 100 m) and the number of segments they are the plain mean over."""
    errors = segment_errors(estimate, truth, segment_lengths_m)
    if not len(errors.start):
        return None, None, 0
    return float(np.mean(errors.translation_percent)), float(np.mean(errors.rotation_deg_per_100m)), len(errors.start)


def segment_errors(
    estimate: RigidTransform,
    truth: RigidTransform,
    segment_lengths_m: Sequence[float] = KITTI_SEGMENT_LENGTHS_M,
) -> SegmentErrors:
    """The error of every segment of N poses, by their starts and then by their lengths.

    As in the KITTI odometry devkit: a segment starts at every tenth frame and ends at the first frame whose distance
    travelled in the ground truth exceeds its length; segments that the trajectory is too short for do not exist.
    """
    step_m = np.linalg.norm(np.diff(truth.translation, axis=0), axis=1)
    distance_m = np.concatenate([[0.0], np.cumsum(step_m)])
    starts = np.arange(0, len(distance_m), KITTI_START_EVERY_FRAMES)
    start, length_m = (grid.ravel() for grid in np.meshgrid(starts, np.asarray(segment_lengths_m), indexing="ij"))
    end = np.searchsorted(distance_m, distance_m[start] + length_m, side="right")
    exists = end < len(distance_m)
    start, end, length_m = start[exists], end[exists], length_m[exists]
    if not len(start):
        return SegmentErrors(start, end, length_m, np.zeros(0), np.zeros(0))
    true_motion = truth[start].inv() * truth[end]
    error = (estimate[start].inv() * estimate[end]).inv() * true_motion
    translation_percent = 100.0 * np.linalg.norm(error.translation, axis=1) / length_m
    rotation_deg_per_100m = 100.0 * np.rad2deg(error.rotation.magnitude()) / length_m
    return SegmentErrors(start, end, length_m, translation_percent, rotation_deg_per_100m)


def absolute_trajectory_error(estimate_m: FloatArray, truth_m: FloatArray) -> float:
    """RMSE (m) of the positions (N, 3) after the rigid alignment that makes it smallest (Umeyama 1991, no scale)."""
    estimate_m = estimate_m - estimate_m.mean(axis=0)
    truth_m = truth_m - truth_m.mean(axis=0)
    with warnings.catch_warnings():  # on a straight line the best rotation is not unique, but its error is
        warnings.simplefilter("ignore", UserWarning)
        rotation, _ = Rotation.align_vectors(truth_m, estimate_m)
    return _root_mean_square(truth_m - rotation.apply(estimate_m))


def relative_pose_error(estimate: RigidTransform, truth: RigidTransform) -> tuple[float, float]:
    """RMSE of the error of the motion between consecutive poses: translation (m) and rotation angle (rad)."""
    error = (truth[:-1].inv() * truth[1:]).inv() * (estimate[:-1].inv() * estimate[1:])
    return _root_mean_square(error.translation), _root_mean_square(error.rotation.as_rotvec())


def pose_errors(estimate: RigidTransform, truth: RigidTransform) -> tuple[FloatArray, FloatArray]:
    """Position (N, 3) m and orientation (N, 3) rad of the truth as seen from the estimated poses."""
    position = estimate.rotation.inv().apply(truth.translation - estimate.translation)
    orientation = (estimate.rotation.inv() * truth.rotation).as_rotvec()
    return position, orientation


def anees(estimate: Trajectory, truth: Trajectory) -> tuple[float | None, float | None]:
    """Mean normalised squared error of position and of orientation, 3 degrees of freedom each.

    Poses without uncertainty (the one that defines the world) make no claim and are left out.
    """
    if estimate.covariances is None:
        return None, None
    position, orientation = pose_errors(estimate.poses, truth.poses)
    return (
        _mean_normalised_square(position, estimate.covariances[:, 3:, 3:]),
        _mean_normalised_square(orientation, estimate.covariances[:, :3, :3]),
    )


def _mean_normalised_square(error: FloatArray, covariance: FloatArray) -> float | None:
    uncertain = np.linalg.eigvalsh(covariance)[:, 0] > MIN_VARIANCE
    if not uncertain.any():
        return None
    error, covariance = error[uncertain], covariance[uncertain]
    whitened = np.linalg.solve(covariance, error[..., None])[..., 0]
    return float(np.mean(np.sum(error * whitened, axis=1)))


def _root_mean_square(vectors: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.sum(vectors**2, axis=1))))
