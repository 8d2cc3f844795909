"""Every factor's Jacobians against finite differences along GTSAM's own retraction, and what its errors mean."""

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import E, L, S, U, X
from numpy.testing import assert_allclose
from scipy.spatial.transform import RigidTransform

from fusion.factors import NO_KNOT, Batch, GnssFactors, PairFactors, WorldFactor, by_vector, extrinsics, poses_of
from fusion.pair_model import inverse, predict
from fusion_io.records import NANOSECONDS, FloatArray, PairEstimate

STEP = 1e-5  # of central differences, whose error is its square
FRAMES = 5
KNOTS = np.array([0, 0, 1, NO_KNOT])
SOURCE, TARGET = np.array([0, 1, 2, 0]), np.array([1, 2, 4, 3])


def _transforms(rng: np.random.Generator, count: int) -> FloatArray:
    return np.asarray(RigidTransform.from_exp_coords(rng.normal(size=(count, 6))).as_matrix())


def _covariances(rng: np.random.Generator, count: int, size: int) -> FloatArray:
    root = rng.normal(size=(count, size, size))
    return root @ root.swapaxes(1, 2) + np.eye(size)


def _values(rng: np.random.Generator) -> gtsam.Values:
    """Poses, two states of the front end, extrinsics that have strayed far, a frame and an antenna."""
    values = gtsam.Values()
    for k, pose in enumerate(_transforms(rng, FRAMES)):
        values.insert(X(k), gtsam.Pose3(pose))
    for j in range(2):
        # No scale error: its reference is not the motion itself, so that errors would not be zero.
        values.insert(S(j), np.append(0.0, 0.1 * rng.normal(size=3)))
    values.insert(E(0), 0.3 * rng.normal(size=10))
    values.insert(U(0), gtsam.Pose3(_transforms(rng, 1)[0]))
    values.insert(L(0), rng.normal(size=3))
    return values


def _linear(batch: Batch, values: gtsam.Values) -> tuple[list[list[int]], list[FloatArray], FloatArray]:
    """What GTSAM takes from the factors of a batch: keys, Jacobians (D, M) and errors (N, D)."""
    batch.update(values)
    graph = gtsam.NonlinearFactorGraph()
    batch.add_to(graph)
    linear = graph.linearize(values)
    factors = [linear.at(i) for i in range(linear.size())]
    jacobians = [np.array(factor.getA()) for factor in factors]  # copies: GTSAM gives views, which die with the graph
    return [factor.keys() for factor in factors], jacobians, -np.stack([factor.getb() for factor in factors])


def _moved(values: gtsam.Values, key: int, by: FloatArray) -> gtsam.Values:
    step, still = gtsam.VectorValues(), values.zeroVectors()
    for other in values.keys():  # noqa: SIM118 - of GTSAM, not a dictionary
        step.insert(other, by if other == key else still.at(other))
    return values.retract(step)


def _check_jacobians(batch: Batch, values: gtsam.Values) -> None:
    keys, jacobians, _ = _linear(batch, values)
    sizes = values.zeroVectors()
    for key in set().union(*keys):
        for k, direction in enumerate(STEP * np.eye(sizes.at(key).size)):
            ahead, behind = (_linear(batch, _moved(values, key, sign * direction))[2] for sign in (1, -1))
            numeric = (ahead - behind) / (2 * STEP)
            for i, of_factor in enumerate(keys):
                if key not in of_factor:
                    assert_allclose(numeric[i], 0.0, atol=1e-12)
                    continue
                column = sum(sizes.at(other).size for other in of_factor[: of_factor.index(key)]) + k
                assert_allclose(jacobians[i][:, column], numeric[i], atol=1e-7)


def _pairs(
    rng: np.random.Generator, values: gtsam.Values, mounted: FloatArray, twists: FloatArray | None
) -> PairFactors:
    """Pair estimates with just what the values say, so that errors are zero and their Jacobians exact."""
    strayed = np.zeros(10) if twists is None else values.atVector(E(0))
    still = np.zeros((FRAMES, 6)) if twists is None else twists
    front_end = np.array([np.zeros(4) if knot == NO_KNOT else values.atVector(S(int(knot))) for knot in KNOTS])
    seconds = (TARGET - SOURCE) / 10
    shown = predict(
        poses_of(values)[SOURCE],
        poses_of(values)[TARGET],
        extrinsics(mounted, strayed),
        (still[SOURCE], still[TARGET]),
        strayed[6],
        strayed[7:],
        front_end,
        seconds,
    )
    motions = RigidTransform.from_matrix(shown.motion)
    quats = motions.rotation.as_quat(scalar_first=True)
    stamps = np.arange(FRAMES) * (NANOSECONDS // 10)
    pairs = [
        PairEstimate(int(stamps[i]), int(stamps[j]), quats[n], motions.translation[n], covariance)
        for n, (i, j, covariance) in enumerate(zip(SOURCE, TARGET, _covariances(rng, 4, 6), strict=True))
    ]
    return PairFactors(pairs, SOURCE, TARGET, KNOTS, mounted, twists)


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("with_imu", [True, False])
def test_jacobians_of_pairs(with_imu: bool, seed: int) -> None:
    """With and without extrinsics, with and without a state of the front end; also of a pair that skips frames."""
    rng = np.random.default_rng(seed)
    values, mounted = _values(rng), _transforms(rng, 1)[0] if with_imu else np.eye(4)
    batch = _pairs(rng, values, mounted, rng.normal(size=(FRAMES, 6)) if with_imu else None)
    keys, _, errors = _linear(batch, values)
    assert [len(each) for each in keys] == ([4, 4, 4, 3] if with_imu else [3, 3, 3, 2])
    assert_allclose(errors, 0.0, atol=1e-13)
    _check_jacobians(batch, values)


@pytest.mark.parametrize("seed", range(2))
def test_jacobians_of_the_world(seed: int) -> None:
    rng = np.random.default_rng(seed)
    values, mounted, twist = _values(rng), _transforms(rng, 1)[0], rng.normal(size=(1, 6))
    strayed = values.atVector(E(0))
    back = RigidTransform.from_exp_coords(-strayed[6] * twist[0]).as_matrix()
    values.update(X(0), gtsam.Pose3(extrinsics(mounted, strayed) @ back))
    batch = WorldFactor(mounted, twist, 0.5)
    assert_allclose(_linear(batch, values)[2], 0.0, atol=1e-13)
    _check_jacobians(batch, values)


@pytest.mark.parametrize("seed", range(2))
def test_jacobians_of_positions(seed: int) -> None:
    """Exact at any error, for it is linear in positions."""
    rng = np.random.default_rng(seed)
    before, share = np.array([0, 1, 3]), np.array([0.0, 0.3, 0.9])
    batch = GnssFactors(rng.normal(size=(3, 3)), _covariances(rng, 3, 3), before, share)
    _check_jacobians(batch, _values(rng))


@pytest.mark.parametrize("seed", range(2))
def test_jacobians_of_what_extrinsics_stray_by(seed: int) -> None:
    """`by_vector` takes the vector in E(0) to a right perturbation of the mounting."""
    rng = np.random.default_rng(seed)
    mounted, strayed = _transforms(rng, 1)[0], rng.normal(size=7)
    at = extrinsics(mounted, strayed)

    def by(direction: FloatArray) -> FloatArray:
        T = RigidTransform.from_matrix(inverse(at) @ extrinsics(mounted, strayed + direction))
        return np.append(T.as_exp_coords(), direction[6])

    numeric = [(by(direction) - by(-direction)) / (2 * STEP) for direction in STEP * np.eye(7)]
    assert_allclose(by_vector(strayed), np.transpose(numeric), atol=1e-7)


def test_what_gtsam_adds_up_is_the_mahalanobis_distance_times_the_weight() -> None:
    """Of what each pair shows beyond the poses, under its own covariance, rotation first."""
    rng = np.random.default_rng(0)
    values, stamps = _values(rng), np.arange(2) * (NANOSECONDS // 10)
    xi, covariance = 1e-4 * rng.normal(size=6), _covariances(rng, 1, 6)[0]
    poses = RigidTransform.from_matrix(poses_of(values))
    motion = poses[0].inv() * poses[1] * RigidTransform.from_exp_coords(xi)
    pair = PairEstimate(*stamps.tolist(), motion.rotation.as_quat(scalar_first=True), motion.translation, covariance)
    batch = PairFactors([pair], np.array([0]), np.array([1]), np.array([NO_KNOT]), np.eye(4), None)
    graph = gtsam.NonlinearFactorGraph()
    batch.add_to(graph)
    batch.update(values)
    expected = xi @ np.linalg.solve(covariance, xi)
    assert batch.squared[0] == pytest.approx(expected, rel=1e-3)
    assert 2 * graph.error(values) == pytest.approx(batch.squared[0], rel=1e-12)
    batch.weigh(np.array([0.25]))
    assert 2 * graph.error(values) == pytest.approx(0.25 * batch.squared[0], rel=1e-12)
    assert_allclose(_linear(batch, values)[1][0], 0.5 * _unweighted(batch, values), rtol=1e-12)


def _unweighted(batch: Batch, values: gtsam.Values) -> FloatArray:
    batch.weights[:] = 1.0
    return _linear(batch, values)[1][0]
