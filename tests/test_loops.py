"""Laws of loop closure: true ones with an honest covariance, wrong ones not at all."""

from dataclasses import replace

import numpy as np
import pytest
from loop_samples import SECOND, WallLog, changed, painted, there_and_back
from numpy.testing import assert_allclose
from scipy.spatial.transform import RigidTransform, Rotation
from scipy.stats import chi2

from fusion.config import LoopsConfig, RetrievalConfig
from fusion.loops import Keyframe, Measured, agreement, find_loops, floor, matches, measure
from fusion.retrieval import Features
from fusion_io.findings import Findings
from fusion_io.records import CameraInfo, PairEstimate, Trajectory

CONFIG = LoopsConfig(retrieval=RetrievalConfig(min_time_s=5.0, min_path_m=10.0, place_m=4.0))
CAMERA_640 = CameraInfo(640, 480, np.array([[500.0, 0, 319.5], [0, 500.0, 239.5], [0, 0, 1]]))


def found_in(log: WallLog, trajectory: Trajectory, config: LoopsConfig = CONFIG) -> list[PairEstimate]:
    return find_loops(log, trajectory, None, config, Findings())


def drifted(truth: Trajectory, share: float) -> Trajectory:
    """The same, but the way back is longer or shorter by a share of all that was driven."""
    positions = truth.poses.translation.copy()
    positions[:, 0] += share * np.arange(len(truth))
    return Trajectory(truth.stamps_ns, RigidTransform.from_translation(positions))


def errors(loop: PairEstimate, truth: Trajectory) -> np.ndarray:
    source, target = truth.at(np.array([loop.source_stamp_ns, loop.target_stamp_ns]))
    return np.asarray((loop.T_source_target.inv() * source.inv() * target).as_exp_coords())


@pytest.fixture(scope="module")
def truth() -> Trajectory:
    return there_and_back()


@pytest.fixture(scope="module")
def findings() -> Findings:
    return Findings()


@pytest.fixture(scope="module")
def loops(truth: Trajectory, findings: Findings) -> list[PairEstimate]:
    return find_loops(WallLog(painted(0), truth), drifted(truth, 0.03), None, CONFIG, findings)


def test_the_way_back_is_tied_to_the_way_there_in_spite_of_drift(loops, truth):
    """Every loop within 3 cm and 3 mrad of the truth, one for every 4 m of the way back or more."""
    assert len(loops) >= 6
    for loop in loops:
        twist = errors(loop, truth)
        assert np.linalg.norm(twist[3:]) < 0.03
        assert np.linalg.norm(twist[:3]) < 3e-3


def test_loops_go_from_the_earlier_to_the_later_frame_in_order_of_their_targets(loops):
    targets = [loop.target_stamp_ns for loop in loops]
    assert targets == sorted(targets)
    for loop in loops:
        assert loop.target_stamp_ns - loop.source_stamp_ns >= CONFIG.retrieval.min_time_s * SECOND
        assert loop.winner == -1


def test_loops_carry_covariances_that_cover_their_errors_and_are_never_surer_than_the_floor(loops, truth):
    for loop in loops:
        assert np.all(np.linalg.eigvalsh(loop.covariance - 0.999 * floor(CONFIG)) > 0)
        twist = errors(loop, truth)
        assert twist @ np.linalg.solve(loop.covariance, twist) < chi2.isf(1e-3, 6)


def test_the_same_log_gives_the_same_bits(loops, truth):
    again = found_in(WallLog(painted(0), truth), drifted(truth, 0.03))
    assert len(again) == len(loops)
    for one, other in zip(loops, again, strict=True):
        for name in ("quat_wxyz", "translation", "covariance"):
            assert getattr(one, name).tobytes() == getattr(other, name).tobytes()


def test_a_wall_that_repeats_itself_is_not_mistaken_for_one_place(truth):
    """Every 16 m looks exactly the same: only the trajectory can tell, and it does."""
    piece = painted(1, 16.0)
    found = found_in(WallLog(np.hstack([piece, piece, piece]), truth), truth)
    assert found
    assert max(np.linalg.norm(errors(loop, truth)[3:]) for loop in found) < 0.05


CARELESS = changed(
    CONFIG,
    retrieval=changed(CONFIG.retrieval, max_drift=10.0),
    min_spread=0.0,
    min_inlier_share=0.0,
    min_depth=0.0,
    min_correlation=-1.0,
)


@pytest.mark.parametrize(("side", "check"), [(48, {"min_spread": 0.1}), (80, {"min_correlation": 0.5})])
def test_one_way_along_a_wall_with_the_same_poster_twice_has_no_loop(truth, side, check):
    """The posters agree to the pixel, and so does the depth behind them, but they are not all that is there."""
    wall = painted(2)
    wall[60 : 60 + side, 840 : 840 + side] = wall[60 : 60 + side, 330 : 330 + side]
    one_way = Trajectory(truth.stamps_ns[:24], truth.poses[:24])
    log = WallLog(wall, one_way)
    assert found_in(log, one_way, changed(CARELESS, min_inliers=12))
    assert not found_in(log, one_way, changed(CARELESS, min_inliers=12, **check))
    assert all(getattr(LoopsConfig(), name) >= value for name, value in check.items())


def test_frames_without_depth_take_no_part_and_do_no_harm(loops, truth):
    blind = frozenset(truth.stamps_ns[10:20].tolist())
    found = found_in(WallLog(painted(0), truth, blind), drifted(truth, 0.03))
    assert 0 < len(found) < len(loops)
    assert all(not {loop.source_stamp_ns, loop.target_stamp_ns} & blind for loop in found)


def test_poses_that_are_no_frames_and_frames_without_a_pose_are_passed_over(truth):
    between = np.arange(len(truth) - 1) * SECOND + 3 * SECOND // 2
    stamps = np.union1d(truth.stamps_ns[5:], between[5:])
    found = found_in(WallLog(painted(0), truth), Trajectory(stamps, truth.at(stamps)))
    assert found
    assert {loop.source_stamp_ns for loop in found} <= set(truth.stamps_ns[5:].tolist())
    elsewhen = Trajectory(truth.stamps_ns + 1, truth.poses)
    assert not found_in(WallLog(painted(0), truth), elsewhen)


def test_what_was_found_is_said_and_is_no_fault(loops, findings):
    assert len(findings.notes) == 1
    assert f"{len(loops)} in depth" in findings.notes[0]
    assert not findings.counts


# --- The measurement by features ----------------------------------------------------------------


def two_views(seed: int, noise_px: float, T_source_target: RigidTransform) -> tuple[Keyframe, Keyframe]:
    """Points in front of two cameras, with descriptors that match."""
    rng = np.random.default_rng(seed)
    z = rng.uniform(4.0, 20.0, 120)
    here = np.column_stack([rng.uniform(60, 580, 120), rng.uniform(60, 420, 120), np.ones(120)])
    points = here @ np.linalg.inv(CAMERA_640.K).T * z[:, None]
    descriptors = rng.integers(0, 256, (120, 128)).astype(np.uint8)
    views = []
    for stamp, seen in ((1, points), (2, T_source_target.inv().apply(points))):
        projected = seen @ CAMERA_640.K.T
        pixels = projected[:, :2] / projected[:, 2:] + rng.normal(scale=noise_px, size=(120, 2))
        features = Features(pixels.astype(np.float32), seen.astype(np.float32), descriptors)
        views.append(Keyframe(stamp, features, CAMERA_640))
    return views[0], views[1]


MOTION = RigidTransform.from_components([0.4, -0.1, 0.8], Rotation.from_rotvec([0.02, -0.1, 0.03]))


def test_the_covariance_of_the_pose_by_features_is_that_of_its_errors():
    """Mean NEES of 60 draws within the 99.9 % bounds of the mean of chi-square with 6 degrees of freedom."""
    exact = changed(CONFIG, rotation_floor_deg=1e-6, translation_floor_m=1e-6, reprojection_px=4.0)
    nees = []
    for seed in range(60):
        measured = measure(*two_views(seed, 0.8, MOTION), exact)
        assert measured is not None
        twist = (measured.T_source_target.inv() * MOTION).as_exp_coords()
        nees.append(twist @ np.linalg.solve(measured.covariance, twist))
    low, high = chi2.ppf([0.0005, 0.9995], 6 * len(nees)) / len(nees)
    assert low < np.mean(nees) < high


def test_two_directions_that_do_not_invert_each_other_are_no_loop():
    source, target = two_views(0, 0.5, MOTION)
    assert measure(source, target, CONFIG) is not None
    doubled = target._replace(features=target.features._replace(points=2 * target.features.points))
    assert measure(source, doubled, CONFIG) is None


def test_features_on_one_small_object_are_no_loop():
    source, target = two_views(0, 0.5, MOTION)
    patch = np.all(np.abs(source.features.pixels - [320, 240]) < [140, 140], axis=1)
    small = [view._replace(features=Features(*(a[patch] for a in view.features))) for view in (source, target)]
    few = changed(CONFIG, min_inliers=12)
    assert patch.sum() >= 12
    assert measure(*small, changed(few, min_spread=0.01)) is not None
    assert measure(*small, changed(few, min_spread=0.3)) is None


def test_views_too_far_apart_are_no_loop():
    views = two_views(0, 0.5, MOTION)
    assert measure(*views, changed(CONFIG, max_distance_m=0.5)) is None


def test_matches_are_mutual_and_clear():
    rng = np.random.default_rng(0)
    descriptors = rng.integers(0, 256, (6, 128)).astype(np.uint8)
    doubled = np.concatenate([descriptors, descriptors[:1]])  # the first is there twice: which one is it?
    blank = np.zeros((7, 3), np.float32)
    source = Features(blank[:6, :2], blank[:6], descriptors)
    target = Features(blank[:, :2], blank, doubled[::-1])
    here, there = matches(source, target, 0.8)
    assert here.tolist() == [1, 2, 3, 4, 5]
    assert there.tolist() == [5, 4, 3, 2, 1]
    assert all(len(each) == 0 for each in matches(source, Features(*(a[:1] for a in target)), 0.8))


def test_a_frame_agrees_with_itself_but_not_with_another_distance_or_picture():
    frame = next(WallLog(painted(0), there_and_back()).frames())
    still = RigidTransform.identity()
    assert_allclose(agreement(frame, frame, still, 0.1), (1.0, 1.0, 1.0), rtol=1e-6)
    assert agreement(frame, replace(frame, depth=1.3 * frame.depth), still, 0.1).depth == 0.0
    darker = replace(frame, image=frame.image // 2 + 20)
    assert agreement(frame, darker, still, 0.1).image > 0.99
    other = next(WallLog(painted(7), there_and_back()).frames())
    assert abs(agreement(frame, other, still, 0.1).image) < 0.3
    blank = replace(frame, image=np.full_like(frame.image, 7))
    assert agreement(frame, blank, still, 0.1).image == 0.0


def test_agreement_counts_what_both_see():
    frame = next(WallLog(painted(0), there_and_back()).frames())
    away = RigidTransform.from_translation([100.0, 0.0, 0.0])
    assert agreement(frame, frame, away, 0.1) == (0.0, 0.0, 0.0)
    past = RigidTransform.from_translation([0.0, 0.0, 10.0])  # the target is behind the wall
    assert agreement(frame, frame, past, 0.1) == (0.0, 0.0, 0.0)
    ahead = RigidTransform.from_translation([0.0, 0.0, 1.0])  # the target is a metre nearer to the wall
    nearer = agreement(frame, replace(frame, depth=frame.depth - 1.0), ahead, 0.01)
    assert_allclose(nearer.overlap, (4.0 / 5.0) ** 2, atol=0.05)
    assert nearer.depth == 1.0
    half = frame.depth.copy()
    half[:, :120] = np.nan
    assert_allclose(
        agreement(frame, replace(frame, depth=half), RigidTransform.identity(), 0.1), (0.5, 1.0, 1.0), rtol=1e-6
    )
    assert_allclose(agreement(replace(frame, depth=half), frame, RigidTransform.identity(), 0.1), 1.0, rtol=1e-6)


def test_the_inverse_of_a_measurement_has_the_covariance_of_its_inverted_draws():
    rng = np.random.default_rng(0)
    root = 1e-3 * rng.normal(size=(6, 6))
    measured = Measured(MOTION, root @ root.T)
    draws = MOTION * RigidTransform.from_exp_coords(rng.normal(size=(20_000, 6)) @ root.T)
    inverted = (MOTION * draws.inv()).as_exp_coords()
    assert_allclose(np.cov(inverted.T), measured.inverse().covariance, rtol=0.1, atol=2e-7)
    assert_allclose((measured.inverse().T_source_target * MOTION).as_matrix(), np.eye(4), atol=1e-12)
