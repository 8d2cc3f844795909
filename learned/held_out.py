"""The covariance of refined pairs, fitted on held-out simulation with the imperfections of a real rig.

Rendered with an exact camera, exact stamps and exact truth, a refined pair is right to a millimetre; a real one is
not, because its calibration, its depth, its stamps and the reference that judges it are not exact. A covariance that
is to hold on a real log has to know of them; `Rig` says how large they are taken to be, and why.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform, Rotation

from fusion_io import simulation
from fusion_io.records import NANOSECONDS, CameraFrame, CameraInfo, FloatArray, Trajectory
from learned.calibration import inside
from learned.covariance import UNCALIBRATED, CovarianceModel, fit, nees, pose_errors
from learned.estimator import infer
from learned.weights import Weights

SIZE = (1242, 375)
"""Width and height of the clips: KITTI's."""

FRAMES_A_CLIP = 3
FIRST_SEED = 8_000_000
"""Clips of this fit: never seen in training, validation or the fit of the network's own covariance."""


@dataclass(frozen=True)
class Rig:
    """Standard deviations of what is not exact in a recording.

    Calibration of a checkerboard: focal length 0.2 %, principal point 1 pixel of a thousand. Rectification: the
    right image shifted by 0.1 pixel, which is a disparity. Software stamps of a triggered camera: 0.5 ms.

    The reference, about and along right, down and ahead of each pose: KITTI's GNSS/INS on the paper's training
    sequences, from frame to frame against its own gyroscopes and accelerometers (``benchmarks/reference_noise.py``).
    Such short stretches do not show how the height wanders, which satellites tell half as well as the place.
    """

    focal_share: float = 0.002
    centre_share: float = 0.001
    disparity_px: float = 0.1
    baseline_m: float = 0.54
    stamp_s: float = 0.0005
    reference_m: tuple[float, float, float] = (0.006, 0.012, 0.006)
    reference_rad: tuple[float, float, float] = (0.00025, 0.00009, 0.00025)


def imperfect(
    frames: list[CameraFrame], trajectory: Trajectory, rig: Rig, rng: np.random.Generator
) -> tuple[list[CameraFrame], RigidTransform]:
    """The frames with the camera and depth that a rig would report, and the reference's poses of them.

    A stamp that is off by dt claims for its image the pose of another moment, so the reference moves along by dt.
    """
    true = frames[0].camera
    K = true.K.copy()
    K[[0, 1], [0, 1]] *= 1 + rng.normal(0, rig.focal_share)
    K[:2, 2] += rng.normal(0, rig.centre_share * true.width, 2)
    camera = CameraInfo(true.width, true.height, K)
    shift = rng.normal(0, rig.disparity_px) / (true.K[0, 0] * rig.baseline_m)  # of the inverse depth, 1/m
    reported = [replace(f, camera=camera, depth=None if f.depth is None else shifted(f.depth, shift)) for f in frames]

    count = len(frames)
    velocity, rate = motion_rates(trajectory)
    dt = rng.normal(0, rig.stamp_s, (count, 1))
    off = Rotation.from_rotvec(rate * dt + rng.normal(0, rig.reference_rad, (count, 3)))
    moved = velocity * dt + rng.normal(0, rig.reference_m, (count, 3))
    return reported, trajectory.poses * RigidTransform.from_components(moved, off)


def shifted(depth: NDArray[np.float32], shift: float) -> NDArray[np.float32]:
    """Depth (H, W) m whose inverse is off by `shift` (1/m); 0 stays 0."""
    inverse = np.divide(1.0, depth, out=np.zeros_like(depth), where=depth > 0) + np.float32(shift)
    moved: NDArray[np.float32] = np.divide(1.0, inverse, out=np.zeros_like(depth), where=(depth > 0) & (inverse > 0))
    return moved


def motion_rates(trajectory: Trajectory) -> tuple[FloatArray, FloatArray]:
    """Velocity (N, 3) m/s and angular velocity (N, 3) rad/s in camera axes, from differences of the poses."""
    step = trajectory.poses[:-1].inv() * trajectory.poses[1:]
    seconds = np.diff(trajectory.stamps_ns)[:, None] / NANOSECONDS
    velocity, rate = step.translation / seconds, step.rotation.as_rotvec() / seconds
    return np.vstack([velocity, velocity[-1:]]), np.vstack([rate, rate[-1:]])


def held_out_pairs(weights: Weights, clips: int, rig: Rig) -> tuple[FloatArray, FloatArray]:
    """Errors (N, 6) of refined pairs of rendered clips, as a rig would record them, and their uncalibrated covariances.

    Pairs whose refinement found nothing better than the network are left out, as they keep its covariance.
    """
    raw = replace(weights, refined_covariance=UNCALIBRATED)
    errors, spread = [], []
    for seed in range(FIRST_SEED, FIRST_SEED + clips):
        frames, imu, trajectory = simulation.clip(seed, FRAMES_A_CLIP, *SIZE)
        frames, reference = imperfect(frames, trajectory, rig, np.random.default_rng([seed, 1]))
        row = {frame.stamp_ns: i for i, frame in enumerate(frames)}
        for inference in infer(raw, iter(frames), trajectory.stamps_ns, imu, Counter()):
            if inference.refined:
                source, target = (row[s] for s in (inference.pair.source_stamp_ns, inference.pair.target_stamp_ns))
                true = reference[source].inv() * reference[target]
                errors.append(pose_errors(inference.pair.T_source_target.as_matrix()[None], true.as_matrix()[None])[0])
                spread.append(inference.pair.covariance)
    return np.array(errors), np.array(spread)


def fit_refined(weights: Weights, clips: int, rig: Rig | None = None) -> tuple[CovarianceModel, dict[str, float]]:
    """The covariance model of refined pairs, fitted on held-out clips.

    In the figures the coverage is that of either half by the model of the other.
    """
    errors, spread = held_out_pairs(weights, clips, rig or Rig())
    halves = np.array_split(np.arange(len(errors)), 2)
    stated = [
        fit(errors[other], spread[other]).covariance(spread[half], np.ones(len(half)))
        for half, other in zip(halves, reversed(halves), strict=True)
    ]
    return fit(errors, spread), {
        "refined_translation_rmse_m": float(np.sqrt((errors[:, 3:] ** 2).sum(1).mean())),
        "refined_rotation_rmse_rad": float(np.sqrt((errors[:, :3] ** 2).sum(1).mean())),
        "refined_coverage_95": float(inside(nees(errors, np.concatenate(stated)), 0.95).mean()),
    }
