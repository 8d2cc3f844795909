"""Laws of the scores: known errors give known figures, and the mean of poses is that of the group."""

import numpy as np
from numpy.testing import assert_allclose
from scipy.spatial.transform import RigidTransform, Rotation

from fusion_io.records import FloatArray
from learned.scores import agreement, mean_motion, mean_poses, score


def _poses(count: int, size: float, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return RigidTransform.from_exp_coords(size * rng.normal(size=(count, 6))).as_matrix()


def _turned(angles: list[float]) -> np.ndarray:
    return RigidTransform.from_rotation(Rotation.from_rotvec(np.outer(angles, [0.0, 1.0, 0.0]))).as_matrix()


def test_known_errors_give_their_root_mean_square_median_and_maximum() -> None:
    truth = _poses(4, 0.3)
    estimates = truth @ _turned([0.01, 0.01, 0.02, -0.04])
    estimates[:, 0, 3] += [0.1, -0.1, 0.2, 0.4]
    found = score("known", estimates, truth)
    assert found["name"] == "known"
    assert_allclose(found["translation_rmse_m"], np.sqrt(np.mean([0.01, 0.01, 0.04, 0.16])))
    assert_allclose(found["rotation_rmse_rad"], np.sqrt(np.mean([1e-4, 1e-4, 4e-4, 16e-4])))
    assert_allclose([found["translation_median_m"], found["translation_max_m"]], [0.15, 0.4])
    assert_allclose([found["rotation_median_rad"], found["rotation_max_rad"]], [0.015, 0.04])


def test_the_truth_has_no_error() -> None:
    truth = _poses(5, 0.5)
    found = score("truth", truth, truth)
    assert max(value for name, value in found.items() if name != "name") < 1e-7


def test_the_mean_motion_has_the_smallest_translation_rmse_of_all_constant_motions() -> None:
    truth = _poses(20, 0.2)
    mean = mean_motion(truth)
    best = score("mean", np.broadcast_to(mean, truth.shape), truth)["translation_rmse_m"]
    for axis in range(3):
        other = mean.copy()
        other[axis, 3] += 0.01
        assert score("other", np.broadcast_to(other, truth.shape), truth)["translation_rmse_m"] > best


def test_about_the_mean_of_poses_the_logarithms_add_up_to_zero() -> None:
    T = _poses(15, 0.4).reshape(5, 3, 4, 4)
    weights = np.random.default_rng(1).uniform(0.1, 1, (5, 3))
    for w in (None, weights):
        inverse = np.linalg.inv(mean_poses(T, w))
        logarithms = RigidTransform.from_matrix((inverse[:, None] @ T).reshape(-1, 4, 4)).as_exp_coords()
        shares = np.ones((5, 3)) if w is None else w
        assert_allclose(np.einsum("nm,nma->na", shares, logarithms.reshape(5, 3, 6)), 0.0, atol=1e-12)


def test_the_mean_of_equal_poses_is_each_of_them() -> None:
    T = _poses(4, 0.5)
    assert_allclose(mean_poses(np.repeat(T[:, None], 3, axis=1)), T, atol=1e-12)


def test_the_mean_moves_with_the_frames_in_which_the_poses_are_given() -> None:
    """Mean of L T R is L mean(T) R: it depends on no choice of frame, unlike a mean of coordinates."""
    T = _poses(8, 0.4).reshape(2, 4, 4, 4)
    L, R = _poses(2, 1.0, seed=2)
    assert_allclose(mean_poses(L @ T @ R), L @ mean_poses(T) @ R, atol=1e-12)


def test_a_weight_of_one_alone_chooses_its_pose() -> None:
    T = _poses(6, 0.4).reshape(2, 3, 4, 4)
    assert_allclose(mean_poses(T, np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 5.0]])), T[[0, 1], [1, 2]], atol=1e-12)


def test_what_two_estimates_share_is_the_references_error() -> None:
    """Known errors of three independent sources are found again from the distances between them, to 5 %."""
    rng = np.random.default_rng(3)

    def off(rotation_rad: float, translation_m: float) -> FloatArray:
        twist = rng.normal(size=(4000, 6)) * np.repeat([rotation_rad, translation_m], 3)
        return np.asarray((true * RigidTransform.from_exp_coords(twist)).as_matrix())

    true = RigidTransform.from_exp_coords(0.1 * rng.normal(size=(4000, 6)))
    one, other, reference = off(1e-3, 0.01), off(2e-3, 0.02), off(4e-3, 0.05)
    found = agreement(one, other, reference)
    root = np.sqrt(3)
    assert_allclose(found["shared_rotation_rad"], 4e-3 * root, rtol=0.05)
    assert_allclose(found["shared_translation_m"], 0.05 * root, rtol=0.05)
    assert_allclose(found["apart_rotation_rad"], np.hypot(1e-3, 2e-3) * root, rtol=0.05)
    assert_allclose(found["apart_translation_m"], np.hypot(0.01, 0.02) * root, rtol=0.05)


def test_where_the_reference_is_exact_nothing_is_shared() -> None:
    rng = np.random.default_rng(4)
    one, other = (RigidTransform.from_exp_coords(0.01 * rng.normal(size=(50, 6))).as_matrix() for _ in range(2))
    exact = np.tile(np.eye(4), (50, 1, 1))
    found = agreement(one, other, exact)
    assert found["shared_translation_m"] < 0.5 * found["apart_translation_m"]
    assert agreement(one, exact, exact)["shared_translation_m"] == 0.0
