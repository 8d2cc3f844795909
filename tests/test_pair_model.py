"""What pairs show of an IMU: the model's laws, and its Jacobians against finite differences."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.linalg import expm
from scipy.spatial.transform import RigidTransform, Rotation

from fusion import chain, pair_model
from fusion.pair_model import Prediction, adjoint, camera, difference, exp, inverse, predict, right_jacobian, skew
from fusion_io.records import FloatArray

STEP = 1e-5  # of central differences, whose error is its square
COUNT = 4  # motions at once

vectors = st.tuples(*3 * [st.floats(-1.8, 1.8)]).map(np.array)


def transforms(rng: np.random.Generator, count: int, size: float = 1.0) -> FloatArray:
    return np.asarray(RigidTransform.from_exp_coords(size * rng.normal(size=(count, 6))).as_matrix())


def perturbed(T: FloatArray, xi: FloatArray) -> FloatArray:
    return np.asarray(T @ RigidTransform.from_exp_coords(xi).as_matrix())


def log(T: FloatArray) -> FloatArray:
    return np.asarray(RigidTransform.from_matrix(T).as_exp_coords())


class Case:
    """Random arguments of `predict`, each of which can be perturbed; errors are not small."""

    def __init__(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self.source, self.target = transforms(rng, COUNT), transforms(rng, COUNT)
        self.mounted = transforms(rng, 1)[0]
        self.twists = rng.normal(size=(COUNT, 6)), rng.normal(size=(COUNT, 6))
        self.ahead_s, self.misalignment = 0.3, 0.4 * rng.normal(size=3)
        self.front_end, self.seconds = 0.2 * rng.normal(size=(COUNT, 4)), rng.uniform(0.1, 1.0, COUNT)

    def shown(self, name: str = "", by: FloatArray | None = None) -> Prediction:
        """The prediction, with one argument moved by (M,)."""
        moved = dict.fromkeys(("source", "target", "extrinsics", "misalignment", "front_end"), None) | {name: by}
        extrinsics = np.zeros(7) if moved["extrinsics"] is None else moved["extrinsics"]
        return predict(
            perturbed(self.source, np.zeros(6) if moved["source"] is None else moved["source"]),
            perturbed(self.target, np.zeros(6) if moved["target"] is None else moved["target"]),
            perturbed(self.mounted, extrinsics[:6]),
            self.twists,
            self.ahead_s + extrinsics[6],
            self.misalignment + (0.0 if moved["misalignment"] is None else moved["misalignment"]),
            self.front_end + (0.0 if moved["front_end"] is None else moved["front_end"]),
            self.seconds,
        )


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(
    ("name", "dimension"), [("source", 6), ("target", 6), ("extrinsics", 7), ("misalignment", 3), ("front_end", 4)]
)
def test_every_jacobian_of_the_prediction_equals_finite_differences(name: str, dimension: int, seed: int) -> None:
    """For errors, offsets and turns that are large."""
    case = Case(seed)
    at = case.shown()
    jacobian = getattr(at, f"by_{name}")
    assert jacobian.shape == (COUNT, 6, dimension)
    for k, direction in enumerate(STEP * np.eye(dimension)):
        ahead, behind = (log(inverse(at.motion) @ case.shown(name, by).motion) for by in (direction, -direction))
        assert_allclose(jacobian[:, :, k], (ahead - behind) / (2 * STEP), atol=1e-7)


@pytest.mark.parametrize("seed", range(3))
def test_the_jacobians_of_the_camera_equal_finite_differences(seed: int) -> None:
    rng = np.random.default_rng(seed)
    poses, mounted, twists = transforms(rng, COUNT), transforms(rng, 1)[0], rng.normal(size=(COUNT, 6))

    def moved(by: FloatArray) -> FloatArray:
        return camera(perturbed(poses, by[:6]), perturbed(mounted, by[6:12]), twists, 0.3 + by[12])[0]

    at, by_pose, by_extrinsics = camera(poses, mounted, twists, 0.3)
    jacobian = np.concatenate([by_pose, by_extrinsics], axis=2)
    for k, direction in enumerate(STEP * np.eye(13)):
        ahead, behind = (log(inverse(at) @ moved(by)) for by in (direction, -direction))
        assert_allclose(jacobian[:, :, k], (ahead - behind) / (2 * STEP), atol=1e-7)


def test_without_errors_a_pair_shows_the_motion_between_the_cameras() -> None:
    case = Case(0)
    shown = predict(
        case.source, case.target, case.mounted, case.twists, 0.0, np.zeros(3), np.zeros((COUNT, 4)), case.seconds
    )
    cameras = [poses @ inverse(case.mounted) for poses in (case.source, case.target)]
    assert_allclose(shown.motion, inverse(cameras[0]) @ cameras[1], atol=1e-14)


def test_a_clock_that_is_ahead_shows_the_camera_where_the_imu_will_be() -> None:
    """Along a constant twist, an IMU that is d ahead sees at t what the camera sees at t + d; pairs do not change."""
    rng = np.random.default_rng(0)
    twist, mounted, d = rng.normal(size=6), transforms(rng, 1)[0], 0.25
    times = np.arange(COUNT + 1) * 0.5
    poses, later = (RigidTransform.from_exp_coords(np.outer(times + by, twist)).as_matrix() for by in (0.0, d))
    twists = np.tile(twist, (COUNT + 1, 1))
    assert_allclose(camera(poses, mounted, twists, d)[0], later @ inverse(mounted), atol=1e-13)
    still = np.zeros(3), np.zeros((COUNT, 4)), np.full(COUNT, 0.5)
    shown = [predict(poses[:-1], poses[1:], mounted, (twists[1:], twists[1:]), ahead, *still) for ahead in (d, 0.0)]
    assert_allclose(shown[0].motion, shown[1].motion, atol=1e-13)


@settings(max_examples=25, deadline=None)
@given(st.floats(-0.5, 0.5), vectors, st.integers(0, 100))
def test_scale_acts_on_translations_and_the_rate_bias_on_rotations(scale: float, bias: FloatArray, seed: int) -> None:
    case = Case(seed)
    case.misalignment = np.zeros(3)
    case.front_end = np.zeros((COUNT, 4))
    plain = case.shown().motion
    case.front_end = np.tile(np.append(scale, bias), (COUNT, 1))
    shown = case.shown().motion
    assert_allclose(shown[:, :3, 3], (1.0 + scale) * plain[:, :3, 3], atol=1e-12)
    excess = Rotation.from_matrix(plain[:, :3, :3].swapaxes(1, 2) @ shown[:, :3, :3])
    expected = Rotation.from_rotvec(case.seconds[:, None] * bias)
    assert_allclose((excess.inv() * expected).magnitude(), 0.0, atol=1e-7)


@settings(max_examples=25, deadline=None)
@given(vectors, st.integers(0, 100))
def test_a_misalignment_turns_the_axis_of_a_rotation_and_not_its_angle(misalignment: FloatArray, seed: int) -> None:
    case = Case(seed)
    case.front_end = np.zeros((COUNT, 4))
    case.misalignment = np.zeros(3)
    plain = case.shown().motion
    case.misalignment = misalignment
    shown = case.shown().motion
    assert_allclose(shown[:, :3, 3], plain[:, :3, 3], atol=1e-12)
    angles = [Rotation.from_matrix(motion[:, :3, :3]).magnitude() for motion in (plain, shown)]
    assert_allclose(angles[0], angles[1], atol=1e-7)
    axes = [Rotation.from_matrix(motion[:, :3, :3]).as_rotvec() for motion in (plain, shown)]
    near_pi = angles[0] > 3.1  # where an axis and its opposite are the same
    assert_allclose(axes[1][~near_pi], Rotation.from_rotvec(misalignment).apply(axes[0][~near_pi]), atol=1e-6)


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 1000))
def test_it_does_not_matter_where_the_world_is(seed: int) -> None:
    """A pair shows the same in any world, and depends on the poses as before."""
    case = Case(seed)
    world = transforms(np.random.default_rng(seed + 1), 1)[0]
    at = case.shown()
    case.source, case.target = world @ case.source, world @ case.target
    for value, moved in zip(at, case.shown(), strict=True):
        assert_allclose(moved, value, atol=1e-10)


def test_the_difference_is_the_logarithm_to_first_order() -> None:
    rng = np.random.default_rng(0)
    shown, xi = transforms(rng, COUNT), 1e-5 * rng.normal(size=(COUNT, 6))
    assert_allclose(difference(shown, perturbed(shown, xi)), xi, atol=1e-9)
    assert_allclose(difference(shown, shown), 0.0, atol=1e-15)


@given(vectors, st.sampled_from([1.0, 1e-2, 2e-3, 0.999e-3, 1e-6, 0.0]))
def test_the_right_jacobian_moves_an_increment_through_the_exponential(direction: FloatArray, size: float) -> None:
    """Exp(v + d) = Exp(v) Exp(J(v) d), with its series near zero as well."""
    vector, increment = size * direction, 1e-6 * np.array([1.0, -2.0, 0.5])
    left = Rotation.from_rotvec(vector).inv() * Rotation.from_rotvec(vector + increment)
    assert_allclose(left.as_rotvec(), right_jacobian(vector) @ increment, atol=1e-11)


@given(vectors)
def test_the_right_jacobian_is_the_exponential_integrated(vector: FloatArray) -> None:
    """J(v) = int_0^1 Exp(-s v) ds: here as a block of a matrix exponential (Van Loan, 1978)."""
    block = np.zeros((6, 6))
    block[:3, :3], block[:3, 3:] = -skew(vector), np.eye(3)
    assert_allclose(right_jacobian(vector), expm(block)[:3, 3:], atol=1e-11)


@settings(max_examples=25)
@given(st.integers(0, 1000))
def test_the_algebra_of_rigid_transforms(seed: int) -> None:
    """Inverses undo, adjoints carry a twist to the other side, and skew and exp are those of scipy."""
    rng = np.random.default_rng(seed)
    T, xi, v = transforms(rng, COUNT), rng.normal(size=6), rng.normal(size=(2, COUNT, 3))
    assert_allclose(T @ inverse(T), np.tile(np.eye(4), (COUNT, 1, 1)), atol=1e-13)
    carried = RigidTransform.from_exp_coords(adjoint(T) @ xi).as_matrix()
    assert_allclose(perturbed(T, xi), carried @ T, atol=1e-10)
    assert_allclose(adjoint(T), chain.adjoint(RigidTransform.from_matrix(T)), atol=1e-13)
    assert_allclose(np.einsum("nij,nj->ni", skew(v[0]), v[1]), np.cross(v[0], v[1]), atol=1e-13)
    assert_allclose(exp(v[0][0]), expm(skew(v[0][0])), atol=1e-12)


def test_the_generators_are_the_cross_products_with_the_unit_vectors() -> None:
    for generator, unit in zip(pair_model.GENERATORS, np.eye(3), strict=True):
        assert_allclose(generator @ [1.0, 2.0, 3.0], np.cross(unit, [1.0, 2.0, 3.0]))
