"""What a pair estimate shows of the motion of an IMU: the measurement model that both back ends share.

With X = T_world_imu at the stamps of source and target, F = T_camera_imu, the twist xi of the IMU (rotation first, per
second, in its own axes) and d, by which the IMU's clock is further ahead of the camera's than was thought, the camera
is at

    C = X Exp(d xi) F^-1                                                                                            (1)

and an estimate of the motion Z = C_source^-1 C_target over dt seconds shows it with those errors of the front end that
last: a misalignment m between the axes of its rotations and those of its translations, as a camera has that is not
perfectly calibrated, a rate bias b and a scale error s:

    R_shown = Exp(m) R_Z Exp(-m) Exp(b dt),   t_shown = t_Z + s r                                                    (2)

The reference r is about t_Z. Were it t_Z itself, scale and motion were a product of two unknowns, and the most likely
of all solutions would make the motion short and the scale long, because that shortens what the IMU has to explain.

Perturbations act on the right and are ordered rotation first. All functions work on N motions at once.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from fusion_io.records import FloatArray

# The cross products with the three unit vectors.
GENERATORS = np.array(
    [[[0.0, 0, 0], [0, 0, -1], [0, 1, 0]], [[0.0, 0, 1], [0, 0, 0], [-1, 0, 0]], [[0.0, -1, 0], [1, 0, 0], [0, 0, 0]]]
)


class Prediction(NamedTuple):
    """What N pair estimates would show, and how that changes (as a right perturbation) with what it depends on.

    motion (N, 4, 4); by_source, by_target (N, 6, 6): with the poses X; by_extrinsics (N, 6, 7): with F, and with d
    (seconds); by_misalignment (N, 6, 3): with m; by_front_end (N, 6, 4): with s and b.
    """

    motion: FloatArray
    by_source: FloatArray
    by_target: FloatArray
    by_extrinsics: FloatArray
    by_misalignment: FloatArray
    by_front_end: FloatArray


def predict(
    source: FloatArray,
    target: FloatArray,
    T_camera_imu: FloatArray,
    twists: tuple[FloatArray, FloatArray],
    ahead_s: float,
    misalignment: FloatArray,
    front_end: FloatArray,
    seconds: FloatArray,
    reference: FloatArray | None = None,
) -> Prediction:
    """Equations (1) and (2) for poses source, target (N, 4, 4), T_camera_imu (4, 4), the twists (N, 6) at both.

    ahead_s: d. misalignment (3,): m. front_end (N, 4): s, then b. seconds (N,): dt. reference (N, 3): r,
    None for t_Z as it is now.
    """
    both = camera(np.concatenate([source, target]), T_camera_imu, np.concatenate(twists), ahead_s)
    (camera_source, camera_target), (by_source, by_target), (of_source, of_target) = (np.split(v, 2) for v in both)
    motion = inverse(camera_source) @ camera_target
    back = adjoint(inverse(motion))

    turn = front_end[:, 1:] * seconds[:, None]
    unturn = exp(-turn)
    stretch = 1.0 + front_end[:, :1] if reference is None else np.ones((len(motion), 1))
    reference = motion[:, :3, 3] if reference is None else reference
    aligned = exp(misalignment)
    turned = aligned @ motion[:, :3, :3] @ aligned.T
    shown = motion.copy()
    shown[:, :3, :3] = turned @ unturn.swapaxes(1, 2)
    shown[:, :3, 3] += front_end[:, :1] * reference
    by_motion = np.zeros((len(motion), 6, 6))
    by_motion[:, :3, :3] = unturn @ aligned
    by_motion[:, 3:, 3:] = stretch[:, :, None] * shown[:, :3, :3].swapaxes(1, 2) @ motion[:, :3, :3]
    by_misalignment = np.zeros((len(motion), 6, 3))
    by_misalignment[:, :3] = unturn @ (turned.swapaxes(1, 2) - np.eye(3)) @ right_jacobian(-misalignment)
    by_front_end = np.zeros((len(motion), 6, 4))
    by_front_end[:, :3, 1:] = right_jacobian(turn) * seconds[:, None, None]
    by_front_end[:, 3:, 0] = np.einsum("nji,nj->ni", shown[:, :3, :3], reference)
    return Prediction(
        shown,
        -by_motion @ back @ by_source,
        by_motion @ by_target,
        by_motion @ (of_target - back @ of_source),
        by_misalignment,
        by_front_end,
    )


def camera(
    poses: FloatArray, T_camera_imu: FloatArray, twists: FloatArray, ahead_s: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The camera's poses (N, 4, 4) by (1), and how they change with the IMU's (N, 6, 6), and with F and d (N, 6, 7)."""
    moved = np.asarray(RigidTransform.from_exp_coords(ahead_s * twists).as_matrix())
    by_pose = adjoint(T_camera_imu) @ adjoint(inverse(moved))
    by_extrinsics = np.empty((len(poses), 6, 7))
    by_extrinsics[:, :, :6] = -adjoint(T_camera_imu)
    by_extrinsics[:, :, 6] = twists @ adjoint(T_camera_imu).T
    return poses @ moved @ inverse(T_camera_imu), by_pose, by_extrinsics


def difference(shown: FloatArray, measured: FloatArray) -> FloatArray:
    """What motions (N, 4, 4) were measured beyond what is shown, (N, 6): Log(shown^-1 measured), to first order."""
    back = shown[:, :3, :3].swapaxes(1, 2)
    turned = Rotation.from_matrix(back @ measured[:, :3, :3]).as_rotvec()
    return np.hstack([turned, np.einsum("nij,nj->ni", back, measured[:, :3, 3] - shown[:, :3, 3])])


def exp(vectors: FloatArray) -> FloatArray:
    """Rotation matrices (..., 3, 3) of rotation vectors (..., 3)."""
    return np.asarray(Rotation.from_rotvec(vectors).as_matrix())


def skew(vectors: FloatArray) -> FloatArray:
    """The matrices (..., 3, 3) of the cross products with vectors (..., 3)."""
    return np.asarray((vectors @ GENERATORS.reshape(3, 9)).reshape(*vectors.shape, 3))


def right_jacobian(vectors: FloatArray) -> FloatArray:
    """J (..., 3, 3) of Exp(vector + d) = Exp(vector) Exp(J d), to first order in d (Sola 2017, eq. 183)."""
    angle = np.linalg.norm(vectors, axis=-1)[..., None, None]
    small = angle < 1e-3  # there the terms of the series that are left out are below rounding
    safe = np.where(small, 1.0, angle)
    first = np.where(small, 0.5 - angle**2 / 24, (1.0 - np.cos(safe)) / safe**2)
    second = np.where(small, 1.0 / 6 - angle**2 / 120, (safe - np.sin(safe)) / safe**3)
    cross = skew(vectors)
    return np.asarray(np.eye(3) - first * cross + second * cross @ cross)


def inverse(T: FloatArray) -> FloatArray:
    """The inverses of rigid transforms (..., 4, 4)."""
    inverted = T.copy()
    inverted[..., :3, :3] = T[..., :3, :3].swapaxes(-1, -2)
    inverted[..., :3, 3] = -np.einsum("...ji,...j->...i", T[..., :3, :3], T[..., :3, 3])
    return inverted


def adjoint(T: FloatArray) -> FloatArray:
    """Ad(T) (..., 6, 6) of rigid transforms (..., 4, 4), rotation first: T Exp(xi) T^-1 = Exp(Ad(T) xi)."""
    matrix = np.zeros((*T.shape[:-2], 6, 6))
    matrix[..., :3, :3] = matrix[..., 3:, 3:] = T[..., :3, :3]
    matrix[..., 3:, :3] = skew(T[..., :3, 3]) @ T[..., :3, :3]
    return matrix
