"""Laws of retrieval: where loops are looked for, and where never."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
from loop_samples import CAMERA, DISTANCE_M, SECOND, WallLog, changed, painted, there_and_back
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import RigidTransform, Rotation

from fusion.config import RetrievalConfig
from fusion.retrieval import (
    MAX_WIDTH,
    Features,
    Visits,
    appearance,
    candidates,
    keyframes,
    local_features,
    reduced,
)
from fusion_io.records import CameraFrame, Trajectory

CONFIG = RetrievalConfig(min_time_s=5.0, min_path_m=10.0, place_m=4.0)


def likeness_by_position(trajectory: Trajectory) -> np.ndarray:
    """Vectors (M, M) by which keyframes are the more alike, the nearer they are."""
    x = trajectory.poses.translation
    kernel = np.exp(-0.5 * np.sum((x[:, None] - x[None]) ** 2, axis=2))
    return np.linalg.cholesky(kernel + 1e-6 * np.eye(len(x))).astype(np.float32)


def at_keyframes(trajectory: Trajectory, config: RetrievalConfig) -> Trajectory:
    chosen = keyframes(trajectory, config)
    return Trajectory(trajectory.stamps_ns[chosen], trajectory.poses[chosen])


@pytest.fixture
def wall_features() -> list[Features]:
    log = WallLog(painted(0), there_and_back(2.0))
    return [local_features(frame) for frame in log.frames()]


def test_a_keyframe_is_taken_after_so_much_way_or_so_much_turning():
    straight = RigidTransform.from_translation(np.outer(np.arange(9), [0.0, 0.0, 0.5]))
    turning = RigidTransform.from_rotation(Rotation.from_rotvec(np.outer(np.deg2rad(4.0 * np.arange(9)), [0, 1, 0])))
    stamps = np.arange(9) * SECOND
    assert_array_equal(keyframes(Trajectory(stamps, straight), CONFIG), [0, 4, 8])
    assert_array_equal(keyframes(Trajectory(stamps, turning), CONFIG), [0, 3, 6])


def test_a_camera_that_stands_still_has_one_keyframe_and_no_partner():
    still = Trajectory(np.arange(500) * SECOND, RigidTransform.identity(500))
    visits = Visits.of(still, CONFIG)
    assert len(visits) == 1
    assert len(visits.with_partner()) == 0


def test_frames_that_are_near_in_time_or_along_the_path_are_never_compared():
    trajectory = at_keyframes(there_and_back(), CONFIG)
    vectors = np.ones((len(trajectory), 4), np.float32)  # everything looks the same
    everywhere = changed(CONFIG, max_drift=10.0, candidates=100, place_m=0.1)
    path = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(trajectory.poses.translation, axis=0), axis=1))])
    found = list(candidates(vectors, Visits.of(trajectory, everywhere)))
    assert len(found) > 100
    for source, target in found:
        assert path[target] - path[source] >= CONFIG.min_path_m
        assert trajectory.stamps_ns[target] - trajectory.stamps_ns[source] >= CONFIG.min_time_s * SECOND


def test_the_place_seen_before_is_a_candidate_of_every_keyframe_on_the_way_back():
    trajectory = at_keyframes(there_and_back(), CONFIG)
    visits = Visits.of(trajectory, CONFIG)
    assert_array_equal(visits.stamps_ns, trajectory.stamps_ns)
    found = list(candidates(likeness_by_position(trajectory), visits))
    x = trajectory.poses.translation[:, 0]
    nearest = {target: min(abs(x[s] - x[t]) for s, t in found if t == target) for _, target in found}
    returning = [i for i in range(len(x)) if i > len(x) / 2 and x[i] < x.max() - CONFIG.min_path_m / 2 - 2]
    assert set(returning) <= nearest.keys()
    assert max(nearest[i] for i in returning) <= 1.0


def test_candidates_of_a_keyframe_are_few_and_of_different_places():
    trajectory = at_keyframes(there_and_back(), CONFIG)
    found = list(candidates(likeness_by_position(trajectory), Visits.of(trajectory, CONFIG)))
    assert found == sorted(found, key=lambda each: (each.target, each.source))
    for target in {each.target for each in found}:
        assert len([each for each in found if each.target == target]) <= 2 * CONFIG.candidates


def test_what_looks_the_same_but_is_further_than_any_drift_is_no_candidate():
    straight = RigidTransform.from_translation(np.outer(np.arange(100), [0.0, 0.0, 2.0]))
    visits = Visits.of(Trajectory(np.arange(100) * SECOND, straight), CONFIG)
    assert len(visits.with_partner()) == 0
    assert not list(candidates(np.ones((100, 4), np.float32), visits))


def test_the_reach_grows_with_the_covariance_of_the_trajectory():
    """A drifted return passes the start at 12 m: near for a trajectory that says 3 m, not for one that says 0.3 m."""
    there = np.outer(np.arange(50), [0.0, 0.0, 2.0])
    back = there[::-1] + [12.0, 0.0, 0.0]
    poses = RigidTransform.from_translation(np.concatenate([there, back]))
    stamps = np.arange(100) * SECOND
    strict = changed(CONFIG, max_drift=0.0)
    for sigma, expected in ((0.3, False), (3.0, True)):
        covariances = np.tile(sigma**2 * np.eye(6), (100, 1, 1))
        visits = Visits.of(Trajectory(stamps, poses, covariances), strict)
        assert visits.near(90)[:50].any() == expected
    looking_back = Rotation.from_rotvec(np.outer(np.repeat([0.0, np.pi], 50), [0, 1, 0]))
    turned = RigidTransform.from_components(poses.translation, looking_back)
    assert not Visits.of(Trajectory(stamps, turned, covariances), strict).near(90)[:50].any()


def test_the_same_piece_of_wall_looks_more_alike_than_any_other(wall_features):
    vectors = appearance(wall_features)
    assert_allclose(np.linalg.norm(vectors, axis=1), 1.0, atol=1e-5)
    likeness = vectors @ vectors.T
    half = len(vectors) // 2
    best = [len(vectors) - 1 - int(np.argmax(likeness[i, half:])) - half for i in range(half)]
    assert_array_equal(best, np.arange(half))


def test_appearance_is_the_same_to_the_bit_every_time(wall_features):
    assert appearance(wall_features).tobytes() == appearance(wall_features).tobytes()


def test_too_few_features_for_a_vocabulary_look_like_nothing():
    none = Features(np.zeros((0, 2), np.float32), np.zeros((0, 3), np.float32), np.zeros((0, 128), np.uint8))
    assert not appearance([none, none]).any()
    assert appearance([]).shape[0] == 0


def test_a_picture_that_repeats_itself_has_a_vocabulary_all_the_same():
    """Three different descriptors, many times each: most words stay empty, and nobody is warned of it."""
    descriptors = np.random.default_rng(0).integers(0, 256, (3, 128)).astype(np.uint8)
    frames = [
        Features(np.zeros((80, 2), np.float32), np.zeros((80, 3), np.float32), d[None].repeat(80, 0))
        for d in descriptors
    ]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        vectors = appearance(frames)
    assert np.all(np.isfinite(vectors))
    assert np.all(np.linalg.norm(vectors, axis=1) < 1 + 1e-5)


def test_local_features_lie_where_their_pixels_see_them():
    frame = next(WallLog(painted(0), there_and_back()).frames())
    features = local_features(frame)
    assert len(features.pixels) > 50
    projected = features.points @ CAMERA.K.T
    assert_allclose(projected[:, :2] / projected[:, 2:], features.pixels, atol=1e-3)
    assert_allclose(features.points[:, 2], DISTANCE_M)


def test_pixels_without_depth_and_frames_without_depth_have_no_features():
    frame = next(WallLog(painted(0), there_and_back()).frames())
    depth = frame.depth.copy()
    depth[:, :80], depth[:, 80:160] = 0.0, np.nan
    assert local_features(replace(frame, depth=depth)).pixels[:, 0].min() > 159
    assert len(local_features(replace(frame, depth=None)).pixels) == 0
    assert len(local_features(replace(frame, image=np.full_like(frame.image, 90))).pixels) == 0


def test_a_wide_image_is_reduced_with_its_depth_and_camera():
    camera = CAMERA.scaled_to(1280, 400)
    depth = np.full((400, 1280), 7.0, np.float32)
    small = reduced(CameraFrame(5, np.zeros((400, 1280, 3), np.uint8), depth, camera))
    assert small.image.shape == (200, MAX_WIDTH, 3)
    assert small.depth.shape == (200, MAX_WIDTH)
    assert (small.camera.width, small.camera.height) == (MAX_WIDTH, 200)
    assert_allclose(small.camera.K, camera.scaled_to(MAX_WIDTH, 200).K)
    assert reduced(small) is small
