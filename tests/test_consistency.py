"""Both back ends know how wrong they are: a small version of `benchmarks/consistency.py`, whose bounds are wide."""

from collections import defaultdict
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.testing import assert_allclose

from benchmarks.consistency import BACK_ENDS, Square, agreement, bounds, pose_squares, squares
from benchmarks.drives import EKF, POSE_GRAPH, Drive, gauss_markov, hand, simulate
from fusion import ekf, posegraph
from fusion.measurements import Estimate
from fusion_io.records import Trajectory

RUNS, SECONDS = 6, 12.0
PROBABILITY = 0.9999  # of the bounds: a right estimator leaves one of them in a hundred sets of runs
# The rates that tell the clock carry noise that is also in the prediction, and the velocities that of the pairs: for an
# IMU as noisy as this one the offset is known less well than is said.
BLURRED = "time offset"


@cache
def _runs() -> list[tuple[Drive, dict[str, Estimate]]]:
    """Every second one in a hand, where all axes turn."""
    drives = [simulate(seed, SECONDS, **({"carrier": hand} if seed % 2 else {})) for seed in range(RUNS)]
    return [
        (
            drive,
            {
                "posegraph": posegraph.solve(drive.measurements, POSE_GRAPH),
                "ekf": ekf.solve(drive.measurements, EKF),
            },
        )
        for drive in drives
    ]


@cache
def _squares() -> dict[tuple[str, str], list[Square]]:
    found: dict[tuple[str, str], list[Square]] = defaultdict(list)
    for drive, estimates in _runs():
        for key, square in squares(drive, estimates).items():
            found[key].append(square)
    return found


@pytest.mark.parametrize("back_end", BACK_ENDS)
def test_normalised_errors_are_within_their_bounds(back_end: str) -> None:
    """Of poses along the way, of biases, of the front end's errors, of the mounting; the filter's innovations too."""
    means = {name: bounds(of_runs, PROBABILITY) for (name, of), of_runs in _squares().items() if of == back_end}
    assert len(means) >= 17
    outside = {
        name: mean
        for name, (mean, low, high) in means.items()
        if not name.startswith("difference") and not low < mean < high * (3.0 if name == BLURRED else 1.0)
    }
    assert not outside, outside


def test_the_back_ends_agree_within_the_covariance_of_the_filter() -> None:
    mean, _, high = bounds(_squares()["difference of the two at the end", "ekf"], PROBABILITY)
    assert mean < high


@pytest.mark.parametrize("back_end", BACK_ENDS)
def test_poses_err_by_what_is_said_with_pairs_that_skip_a_frame_and_by_less(back_end: str) -> None:
    solve, config = (posegraph.solve, POSE_GRAPH) if back_end == "posegraph" else (ekf.solve, EKF)
    found, said = defaultdict(list), []
    for seed in range(RUNS):
        drive = simulate(seed, SECONDS, skipping=True)
        known = drive.measurements
        with_skips, without = (solve(each, config).trajectory for each in (known, replace(known, skips=[])))
        for name, square in pose_squares(with_skips, drive.truth).items():
            found[name].append(square)
        said.append(np.log(np.linalg.det(with_skips.covariances[-1]) / np.linalg.det(without.covariances[-1])))
    means = {name: bounds(of_runs, PROBABILITY) for name, of_runs in found.items()}
    outside = {name: mean for name, (mean, low, high) in means.items() if not low < mean < high}
    assert not outside, outside
    assert max(said) < 0.0


@pytest.mark.parametrize("back_end", BACK_ENDS)
@pytest.mark.parametrize("factor", [1 / 9, 9.0])
def test_one_that_claims_a_third_or_three_times_its_errors_is_found_out(back_end: str, factor: float) -> None:
    """The bounds are not so wide that nothing could leave them."""
    found = []
    for drive, estimates in _runs():
        trajectory = estimates[back_end].trajectory
        assert trajectory.covariances is not None
        boasting = replace(trajectory, covariances=factor * trajectory.covariances)
        found.append(pose_squares(boasting, drive.truth)["pose at the end"])
    mean, low, high = bounds(found, PROBABILITY)
    assert not low < mean < high


def test_the_difference_is_judged_by_its_mahalanobis_distance() -> None:
    trajectory = _runs()[0][1]["ekf"].trajectory
    assert trajectory.covariances is not None
    sigma = np.sqrt(trajectory.covariances[-1, 3, 3])
    alone = np.diag([1.0, 1.0, 1.0, sigma**2, 1.0, 1.0])
    covariances = np.broadcast_to(alone, trajectory.covariances.shape)
    shifted = trajectory.poses.translation + trajectory.poses.rotation.apply([2.0 * sigma, 0.0, 0.0])
    moved = type(trajectory.poses).from_components(shifted, trajectory.poses.rotation)
    other = Trajectory(trajectory.stamps_ns, moved)
    assert agreement(other, replace(trajectory, covariances=covariances)).value == pytest.approx(4.0)


def test_lasting_errors_of_the_simulation_have_the_variance_and_the_memory_that_are_asked_for() -> None:
    rows = gauss_markov(np.random.default_rng(0), 40_000, np.array([0.02, 3.0]), np.array([1.0, 0.5]))[1:]
    assert_allclose(rows.std(axis=0), [0.02, 3.0], rtol=0.05)
    memory = np.mean(rows[10:] * rows[:-10], axis=0) / rows.var(axis=0)  # after a second
    assert_allclose(memory, np.exp([-1.0, -2.0]), atol=0.05)
