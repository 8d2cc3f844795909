"""What a loop tells of an odometry that drifts: it spreads along the way as the drift did, and is honest about it."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import RigidTransform
from scipy.stats import chi2

from fusion import drift
from fusion.drift import Closures, Map, Odometry
from fusion_io.records import NANOSECONDS, FloatArray, PairEstimate, Trajectory

FRAMES = 81  # at 10 Hz, so that every twentieth is a keyframe
STEP_SIGMA = np.array([1e-9, 1e-9, 1e-9, 0.05, 0.05, 0.05])  # a walk, whose covariances add
LOOP_SIGMA = np.array([1e-4, 1e-4, 1e-4, 0.05, 0.05, 0.05])
STAMPS = np.arange(FRAMES) * (NANOSECONDS // 10)


def _truth() -> FloatArray:
    """(K, 3): ahead and back."""
    ahead = 40.0 - abs(np.arange(FRAMES) - 40.0)
    return np.column_stack([np.zeros(FRAMES), np.zeros(FRAMES), ahead])


def _loop(source: int, target: int, error: FloatArray) -> PairEstimate:
    motion = _truth()[target] - _truth()[source] + error
    return PairEstimate(int(STAMPS[source]), int(STAMPS[target]), np.eye(4)[0], motion, np.diag(LOOP_SIGMA**2))


def _walked(errors: FloatArray, loops: list[PairEstimate]) -> tuple[Closures, Trajectory]:
    """Closures after a walk whose steps err by (K - 1, 3), and the trajectory of each instant."""
    closures = Closures(loops, STAMPS, 1e-6)
    positions = _truth() + np.concatenate([np.zeros((1, 3)), np.cumsum(errors, axis=0)])
    poses, covariances = [np.eye(4)], [np.zeros((6, 6))]
    for k in range(1, FRAMES):
        at_keyframe, at_frame = closures.keyframe * np.diag(STEP_SIGMA**2), k * np.diag(STEP_SIGMA**2)
        T = np.eye(4)
        T[:3, 3] = positions[k]
        present = closures.move_to(Odometry(T, np.block([[at_keyframe, at_keyframe], [at_keyframe, at_frame]])))
        poses.append(present.T)
        covariances.append(present.covariance)
    return closures, Trajectory(STAMPS, RigidTransform.from_matrix(np.stack(poses)), np.stack(covariances))


def _errors(seed: int) -> FloatArray:
    return np.random.default_rng(seed).standard_normal((FRAMES - 1, 3)) * STEP_SIGMA[3:]


def test_without_loops_the_odometry_is_all_there_is() -> None:
    closures, causal = _walked(_errors(0), [])
    past = closures.hindsight()
    assert_allclose(causal.poses.translation, _truth() + np.vstack([np.zeros(3), np.cumsum(_errors(0), axis=0)]))
    assert_allclose(past.poses.translation, causal.poses.translation, atol=1e-12)
    assert past.covariances is not None
    assert causal.covariances is not None
    assert_allclose(past.covariances, causal.covariances, atol=1e-12)


def test_a_loop_moves_what_is_between_its_ends_as_it_drifted() -> None:
    """A walk drifts evenly: what the loop corrects grows evenly along it, and the present moves by all of it."""
    (closures, causal), (_, odometry) = _walked(_errors(1), [_loop(0, 80, np.zeros(3))]), _walked(_errors(1), [])
    assert closures.used.tolist() == [True]
    moved = closures.hindsight().poses.translation - odometry.poses.translation
    assert_allclose(moved, np.outer(np.arange(FRAMES) / 80, moved[-1]), atol=1e-6)
    assert_allclose(causal.poses.translation[-1], closures.hindsight().poses.translation[-1], atol=1e-9)
    assert_allclose(causal.poses.translation[:-1], odometry.poses.translation[:-1], atol=1e-9)
    kept = 0.05**2 / (0.05**2 + 80 * 0.05**2)  # of the drift, by the loop's own noise
    drift = odometry.poses.translation[-1] - _truth()[-1]
    assert_allclose(causal.poses.translation[-1] - _truth()[-1], kept * drift, atol=1e-6)


def test_how_many_loops_are_taken_together_changes_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Corrections of the joint covariance wait for others, then for their turn; what is read of it has them."""
    loops = [_loop(80 - k, k, np.array([0.01, 0.02, 0.03])) for k in range(45, 81, 5)]
    outcomes = []
    for pending, frames, room in ((1, 1, 32), (1, 3, 2), (3, 40, 2), (100, 1, 32)):
        monkeypatch.setattr(drift, "PENDING", pending)
        monkeypatch.setattr(drift, "FRAMES", frames)
        monkeypatch.setattr(drift, "ROOM", room)
        closures, causal = _walked(_errors(3), loops)
        assert closures.used.all()
        outcomes.append((causal, closures.hindsight()))
    for found in outcomes[1:]:
        for one, other in zip(outcomes[0], found, strict=True):
            assert one.covariances is not None
            assert other.covariances is not None
            assert_allclose(other.poses.as_matrix(), one.poses.as_matrix(), atol=1e-9)
            assert_allclose(other.covariances, one.covariances, atol=1e-9)


def test_errors_are_as_large_as_stated() -> None:
    """Monte Carlo: NEES of present and past positions, with two loops, inside their 99.8 % bounds."""
    runs, frames = 60, [40, 60, 80]
    squares = np.zeros((runs, len(frames) + 1))
    for seed in range(runs):
        noise = np.random.default_rng(100 + seed).standard_normal((2, 3)) * LOOP_SIGMA[3:]
        closures, causal = _walked(_errors(seed), [_loop(20, 60, noise[0]), _loop(0, 80, noise[1])])
        past = closures.hindsight()
        for column, (trajectory, frame) in enumerate([(causal, 80), *((past, frame) for frame in frames)]):
            assert trajectory.covariances is not None
            error = trajectory.poses.translation[frame] - _truth()[frame]
            squares[seed, column] = error @ np.linalg.solve(trajectory.covariances[frame, 3:, 3:], error)
    lower, upper = chi2.ppf([0.001, 0.999], 3 * runs) / runs
    assert np.all((lower < squares.mean(axis=0)) & (squares.mean(axis=0) < upper)), squares.mean(axis=0)


def test_a_wrong_loop_moves_nothing() -> None:
    (closures, bent), (_, odometry) = (
        _walked(_errors(2), [_loop(10, 70, np.array([8.0, 0, 0]))]),
        _walked(_errors(2), []),
    )
    assert closures.used.tolist() == [False]
    assert closures.note == "; loops used: 0 of 1"
    assert_allclose(bent.poses.translation, odometry.poses.translation, atol=1e-12)


def test_an_odometry_that_gets_surer_does_not_take_from_the_maps_covariance() -> None:
    """By rounding, or by what it learns later: loop after loop the map's covariance stays one."""
    drifted, learned = Map(1e-6), 1e-3 * np.eye(6)
    for k in range(1, 60):
        before, T = 0.1 * np.eye(6) - k * learned, np.eye(4)
        T[2, 3] = k
        drifted.move_to(Odometry(T, np.block([[before, before], [before, before - learned]])))
        drifted.keep()
        loop = PairEstimate(0, int(STAMPS[1]), np.eye(4)[0], T[:3, 3], np.diag(LOOP_SIGMA**2))
        assert drifted.close(0, loop) is not None
        assert all(np.linalg.eigvalsh(pose.covariance)[0] > -1e-12 for pose in drifted.hindsight())
