"""Poses as messages carry them: which of them can be used, and the trajectory that they are in order of time."""

from __future__ import annotations

from array import array
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import RigidTransform, Rotation

from fusion_io.inertial import longest_increasing
from fusion_io.messages import PoseSample
from fusion_io.records import FloatArray, IntArray, Trajectory

FARTHEST_M = 1e9  # nothing on Earth is as far away, and the square of more may not be finite
_UNIT_TOLERANCE = 0.01
_NO_COVARIANCE = (0.0,) * 36


def is_unit(quats_wxyz: FloatArray) -> NDArray[np.bool_]:
    """Whether quaternions (..., 4) are those of rotations, up to rounding."""
    unit: NDArray[np.bool_] = np.abs(np.linalg.norm(quats_wxyz, axis=-1) - 1) < _UNIT_TOLERANCE
    return unit


def in_order(stamped: Iterable[tuple[int, PoseSample]]) -> tuple[Trajectory, IntArray, IntArray]:
    """The longest run of valid poses whose stamps increase, possibly empty, and the stamps of what is left out.

    Those are the stamps of the poses that are none, and of the valid ones that go back in time or repeat a stamp, both
    as they were recorded. A covariance that is not finite is none; covariances are zero where only others have one.
    """
    recorded, columns = array("q"), array("d")
    for stamp_ns, pose in stamped:
        recorded.append(stamp_ns)
        columns.extend(pose.position)
        columns.extend(pose.quat_wxyz)
        stated = pose.covariance
        columns.extend(_NO_COVARIANCE if stated is None or not np.isfinite(stated).all() else stated.ravel())
    stamps_ns, poses = np.array(recorded, dtype=np.int64), np.array(columns).reshape(-1, 43)
    valid = np.all(np.abs(poses[:, :3]) < FARTHEST_M, axis=1) & is_unit(poses[:, 3:7])
    usable_ns, usable = stamps_ns[valid], poses[valid]
    kept = longest_increasing(usable_ns)
    positions, quats_wxyz, covariances = np.split(usable[kept], [3, 7], axis=1)
    trajectory = Trajectory(
        usable_ns[kept],
        RigidTransform.from_components(positions, Rotation.from_quat(quats_wxyz, scalar_first=True)),
        covariances.reshape(-1, 6, 6) if covariances.any() else None,
    )
    return trajectory, stamps_ns[~valid], np.delete(usable_ns, kept)
