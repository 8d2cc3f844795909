"""Trajectories with known errors, and what is true of them."""

import numpy as np
from scipy.spatial.transform import RigidTransform

from fusion_io.records import NANOSECONDS, Trajectory

COUNT, STEP_M = 600, 1.0


def walk(seed: int, drift: float = 0.0, from_step: int = 0, count: int = COUNT) -> Trajectory:
    """A drive of the same turns for every seed, with noise of its own and a rotation (rad a step) from a step on."""
    turns = np.zeros((count - 1, 6))
    turns[:, 1], turns[:, 5] = 0.01 * np.sin(np.arange(count - 1) / 30.0), STEP_M
    noise = np.random.default_rng(seed).normal(0.0, 1.0, turns.shape) * ([1e-4] * 3 + [5e-3] * 3) * (seed > 0)
    noise[from_step:, 1] += drift
    poses = [np.eye(4)]
    for motion in RigidTransform.from_exp_coords(turns + noise).as_matrix():
        poses.append(poses[-1] @ motion)
    stamps_ns = NANOSECONDS + np.arange(count) * (NANOSECONDS // 10)
    return Trajectory(stamps_ns, RigidTransform.from_matrix(np.stack(poses)))


TRUTH = walk(0)
