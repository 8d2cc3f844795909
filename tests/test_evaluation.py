"""The measures are those of the KITTI devkit and of evo, and the normalised errors are honest."""

from dataclasses import asdict, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from evo.core import metrics as evo_metrics
from evo.core.trajectory import PoseTrajectory3D
from numpy.testing import assert_allclose
from scipy.spatial.transform import RigidTransform, Rotation
from scipy.stats import chi2

from fusion.evaluation import Metrics, errors_over_time, evaluate, kitti_errors, segment_errors
from fusion_io.records import NANOSECONDS, FloatArray, Trajectory

PERIOD_NS = NANOSECONDS // 10
STEP_M = 1.3


def _walk(seed: int, count: int) -> RigidTransform:
    """A random drive of about STEP_M a frame."""
    rng = np.random.default_rng(seed)
    motions = RigidTransform.from_exp_coords(np.array([0, 0, 0, 0, 0, STEP_M]) + rng.normal(0.0, 0.03, (count - 1, 6)))
    poses = [np.eye(4)]
    for motion in motions.as_matrix():
        poses.append(poses[-1] @ motion)
    return RigidTransform.from_matrix(np.stack(poses))


def _disturbed(poses: RigidTransform, seed: int) -> RigidTransform:
    return poses * RigidTransform.from_exp_coords(np.random.default_rng(seed).normal(0.0, 0.02, (len(poses), 6)))


def _trajectory(poses: RigidTransform) -> Trajectory:
    return Trajectory(NANOSECONDS + PERIOD_NS * np.arange(len(poses)), poses)


def _evo(trajectory: Trajectory) -> PoseTrajectory3D:
    return PoseTrajectory3D(poses_se3=list(trajectory.poses.as_matrix()), timestamps=trajectory.stamps_ns / NANOSECONDS)


def _devkit(estimate: FloatArray, truth: FloatArray, lengths: tuple[float, ...]) -> tuple[float, float, int]:
    """calcSequenceErrors of the KITTI odometry devkit, loop by loop, on matrices (N, 4, 4)."""
    distances = [0.0]
    for before, after in pairwise(truth):
        distances.append(distances[-1] + float(np.linalg.norm(after[:3, 3] - before[:3, 3])))
    translations, rotations = [], []
    for first in range(0, len(truth), 10):
        for length in lengths:
            last = next((k for k in range(first, len(truth)) if distances[k] > distances[first] + length), None)
            if last is None:
                continue
            true_motion = np.linalg.inv(truth[first]) @ truth[last]
            motion = np.linalg.inv(estimate[first]) @ estimate[last]
            error = np.linalg.inv(motion) @ true_motion
            cosine = 0.5 * (np.trace(error[:3, :3]) - 1.0)
            rotations.append(np.arccos(np.clip(cosine, -1.0, 1.0)) / length)
            translations.append(np.linalg.norm(error[:3, 3]) / length)
    return 100.0 * np.mean(translations), 100.0 * np.rad2deg(np.mean(rotations)), len(translations)


def test_segment_errors_are_those_of_the_devkit_written_as_loops() -> None:
    truth, lengths = _walk(0, 400), (20.0, 50.0, 100.0, 300.0)
    estimate = _disturbed(truth, 1)
    expected = _devkit(estimate.as_matrix(), truth.as_matrix(), lengths)
    assert expected[2] > 100
    assert_allclose(kitti_errors(estimate, truth, lengths), expected, rtol=1e-6)


def test_a_segment_ends_at_the_first_pose_beyond_its_length_and_has_the_error_made_in_it() -> None:
    """All of the error is made in one step: segments with that step have it, the others have none."""
    truth, lengths = _walk(20, 200), (10.0, 40.0)
    step, jump = 105, RigidTransform.from_exp_coords([0.0, 0.02, 0.0, 0.0, 0.0, 0.5])
    estimate = RigidTransform.concatenate([truth[:step], truth[step] * jump * truth[step].inv() * truth[step:]])
    errors = segment_errors(estimate, truth, lengths)
    assert set(errors.length_m.tolist()) == set(lengths)
    distance = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(truth.translation, axis=0), axis=1))])
    assert np.all(distance[errors.end] - distance[errors.start] > errors.length_m)
    assert np.all(distance[errors.end - 1] - distance[errors.start] <= errors.length_m)
    within = (errors.start < step) & (errors.end >= step)
    assert 0 < within.sum() < len(within)
    assert_allclose(errors.rotation_deg_per_100m[within], 100 * np.rad2deg(0.02) / errors.length_m[within], rtol=1e-6)
    assert_allclose(errors.rotation_deg_per_100m[~within], 0.0, atol=1e-9)
    assert np.all(errors.translation_percent[within] > 1e-3)
    assert_allclose(errors.translation_percent[~within], 0.0, atol=1e-9)


def test_ate_and_rpe_are_those_of_evo() -> None:
    truth = _walk(2, 300)
    turned = RigidTransform.from_exp_coords([0.3, -0.2, 0.9, 4.0, 5.0, -6.0]) * _disturbed(truth, 3)
    estimate, ground_truth = _trajectory(turned), _trajectory(truth)

    aligned = _evo(estimate)
    aligned.align(_evo(ground_truth), correct_scale=False)
    ape = evo_metrics.APE(evo_metrics.PoseRelation.translation_part)
    ape.process_data((_evo(ground_truth), aligned))
    result = evaluate(estimate, ground_truth)
    assert_allclose(result.ate_m, ape.get_statistic(evo_metrics.StatisticsType.rmse), rtol=1e-9)

    for value, relation in (
        (result.rpe_translation_m, evo_metrics.PoseRelation.translation_part),
        (result.rpe_rotation_rad, evo_metrics.PoseRelation.rotation_angle_rad),
    ):
        rpe = evo_metrics.RPE(relation, delta=1, delta_unit=evo_metrics.Unit.frames, all_pairs=True)
        rpe.process_data((_evo(ground_truth), _evo(estimate)))
        assert_allclose(value, rpe.get_statistic(evo_metrics.StatisticsType.rmse), rtol=1e-6)


def test_a_published_result_on_kitti_09_has_its_published_errors(shared_data: Path) -> None:
    odometry = shared_data / "kitti" / "odometry"

    def read(name: str) -> Trajectory:
        poses = np.tile(np.eye(4), (len(stamps_ns), 1, 1))
        poses[:, :3] = np.loadtxt(odometry / name).reshape(-1, 3, 4)
        return Trajectory(stamps_ns, RigidTransform.from_matrix(poses))

    stamps_ns = np.rint(np.loadtxt(odometry / "sequences" / "09" / "times.txt") * NANOSECONDS).astype(np.int64)
    result = evaluate(read("published/example_1/09.txt"), read("poses/09.txt"))
    assert result.segments == 958
    assert_allclose(result.t_rel_percent, 2.607, atol=5e-4)
    assert_allclose(result.r_rel_deg_per_100m, 0.288, atol=5e-4)
    assert_allclose(result.ate_m, 10.880, atol=1e-3)


def test_no_measure_depends_on_the_world_that_either_is_given_in() -> None:
    truth = _walk(4, 200)
    estimate = _disturbed(truth, 5)
    moved = [
        RigidTransform.from_exp_coords(coords) * poses
        for coords, poses in (([1.0, 0.5, -0.3, 10.0, 20.0, 30.0], estimate), ([-0.4, 2.0, 0.1, -5.0, 0.0, 7.0], truth))
    ]
    lengths = (20.0, 50.0)
    here = evaluate(_trajectory(estimate), _trajectory(truth), lengths)
    there = evaluate(_trajectory(moved[0]), _trajectory(moved[1]), lengths)
    for name, value in asdict(here).items():
        if value is not None:
            assert_allclose(getattr(there, name), value, rtol=1e-7, err_msg=name)


def test_the_end_error_is_the_distance_at_the_end_with_the_first_poses_aligned() -> None:
    truth = RigidTransform.from_translation([[0.0, 0.0, float(k)] for k in range(11)])
    yaw = RigidTransform.from_rotation(Rotation.from_rotvec([0.0, 0.1, 0.0]))
    drifted = RigidTransform.concatenate([truth[0], yaw * truth[1:]])
    result = evaluate(_trajectory(drifted), _trajectory(truth))
    assert_allclose(result.end_error_m, 2.0 * 10.0 * np.sin(0.05), rtol=1e-9)


def test_ground_truth_is_interpolated_linearly_in_position_and_by_slerp_in_rotation() -> None:
    ends = RigidTransform.from_components(
        [[0.0, 0.0, 0.0], [1.0, 2.0, 4.0]], Rotation.from_rotvec([[0.0, 0.0, 0.0], [0.0, 0.8, 0.0]])
    )
    known = Trajectory(np.array([0, PERIOD_NS]), ends)
    found = known.at(np.array([0, PERIOD_NS // 4, PERIOD_NS]))
    assert_allclose(found.translation, [[0, 0, 0], [0.25, 0.5, 1.0], [1.0, 2.0, 4.0]], atol=1e-12)
    assert_allclose(found.rotation.as_rotvec(), [[0, 0, 0], [0, 0.2, 0], [0, 0.8, 0]], atol=1e-12)


def test_ground_truth_at_other_stamps_gives_the_errors_of_the_same_motion() -> None:
    """A circle at constant speed, sampled ten times as often as the frames and between them."""
    rate, speed = 0.2, 10.0

    def circle(seconds: FloatArray) -> RigidTransform:
        return RigidTransform.from_exp_coords(np.outer(seconds, [0.0, rate, 0.0, 0.0, 0.0, speed]))

    frames_ns = NANOSECONDS + PERIOD_NS * np.arange(300)
    truth_ns = NANOSECONDS + PERIOD_NS // 10 * np.arange(3000) - 7_000_000
    estimate = Trajectory(frames_ns, circle(frames_ns / NANOSECONDS))
    result = evaluate(estimate, Trajectory(truth_ns, circle(truth_ns / NANOSECONDS)), (10.0, 50.0))
    assert result.segments > 0
    assert result.ate_m is not None
    assert result.ate_m < 1e-3


def test_only_frames_that_the_ground_truth_spans_are_compared() -> None:
    truth = _walk(6, 100)
    estimate = _trajectory(truth)
    part = Trajectory(estimate.stamps_ns[20:60] + PERIOD_NS // 2, truth[20:60])
    assert_allclose(errors_over_time(estimate, part).stamps_ns, estimate.stamps_ns[21:60])


def test_frames_inside_a_hole_of_the_ground_truth_are_not_compared() -> None:
    truth = _walk(7, 100)
    known = np.r_[0:40, 60:100]
    holed = Trajectory(_trajectory(truth).stamps_ns[known], truth[known])
    compared = errors_over_time(_trajectory(truth), holed).stamps_ns
    assert_allclose(compared, holed.stamps_ns)


def test_what_cannot_be_computed_is_none() -> None:
    short = _trajectory(_walk(8, 5))
    assert evaluate(short, None) == Metrics()
    elsewhere = replace(short, stamps_ns=short.stamps_ns + 100 * NANOSECONDS)
    assert evaluate(short, elsewhere) == Metrics()
    result = evaluate(short, short)
    assert (result.segments, result.t_rel_percent, result.r_rel_deg_per_100m) == (0, None, None)
    assert (result.anees_position, result.anees_orientation) == (None, None)
    assert result.ate_m is not None


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("direction", [[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]], ids=["standing still", "straight ahead"])
def test_motion_that_leaves_the_alignment_open_still_has_an_error(direction: list[float]) -> None:
    positions = np.outer(np.arange(20.0), direction)
    truth = RigidTransform.from_translation(positions)
    estimate = RigidTransform.from_translation(1.1 * positions)
    result = evaluate(_trajectory(estimate), _trajectory(truth))
    expected = 0.1 * np.std(positions[:, 2])
    assert_allclose(result.ate_m, expected, atol=1e-9)


def test_anees_is_three_for_errors_drawn_from_the_covariance_and_falls_as_it_grows() -> None:
    count = 2000
    rng = np.random.default_rng(9)
    root = rng.normal(0.0, 0.05, (count, 6, 6))
    covariances = root @ root.swapaxes(1, 2) + 1e-4 * np.eye(6)
    error = (np.linalg.cholesky(covariances) @ rng.normal(size=(count, 6, 1)))[..., 0]
    truth = _walk(10, count)
    rotation = truth.rotation * Rotation.from_rotvec(error[:, :3]).inv()
    estimate = RigidTransform.from_components(truth.translation - rotation.apply(error[:, 3:]), rotation)
    # The first pose is the world: its own error is none, and its covariance says so.
    estimate = RigidTransform.concatenate([truth[0], estimate[1:]])
    covariances[0] = 0.0
    trajectory = replace(_trajectory(estimate), covariances=covariances)

    result = evaluate(trajectory, _trajectory(truth))
    lower, upper = chi2.ppf([0.001, 0.999], 3 * (count - 1)) / (count - 1)
    assert result.anees_position is not None
    assert lower < result.anees_position < upper
    assert result.anees_orientation is not None
    assert lower < result.anees_orientation < upper

    timid = evaluate(replace(trajectory, covariances=4.0 * covariances), _trajectory(truth))
    assert_allclose(timid.anees_position, result.anees_position / 4.0)
    assert_allclose(timid.anees_orientation, result.anees_orientation / 4.0)


def test_the_error_series_shows_what_the_metrics_are_made_of() -> None:
    truth = _walk(11, 50)
    sigma = np.array([0.01, 0.02, 0.03, 0.1, 0.2, 0.3])
    covariances = np.tile(np.diag(sigma**2), (50, 1, 1))
    estimate = replace(_trajectory(_disturbed(truth, 12)), covariances=covariances)
    series = errors_over_time(estimate, _trajectory(truth))
    assert series.position_sigma_m is not None
    assert series.rotation_sigma_rad is not None
    assert_allclose(series.rotation_sigma_rad, np.tile(sigma[:3], (50, 1)))
    assert_allclose(series.position_sigma_m, np.tile(sigma[3:], (50, 1)))
    result = evaluate(estimate, _trajectory(truth))
    assert_allclose(np.linalg.norm(series.position_error_m[-1]), result.end_error_m)
    squares = np.sum((series.rotation_error_rad / series.rotation_sigma_rad) ** 2, axis=1)
    assert_allclose(np.mean(squares), result.anees_orientation)
