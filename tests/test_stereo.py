"""Depth from stereo: true on a scene of known disparity, silent where nothing can be matched."""

from collections import Counter

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from fusion_io.errors import LogError
from fusion_io.images import WHOLE, Framing
from fusion_io.stereo import StereoPair, StereoRig, stereo_frames

K = np.array([[200.0, 0, 159.5], [0, 200, 59.5], [0, 0, 1]])
RIG = StereoRig(K, 0.5)
WIDTH, HEIGHT = 320, 120


def texture(seed: int = 0) -> np.ndarray:
    noise = np.random.default_rng(seed).uniform(0, 255, (HEIGHT, 2 * WIDTH)).astype(np.float32)
    return cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 1.2), None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)


def plane(disparity: int) -> tuple[np.ndarray, np.ndarray]:
    """Both views of a textured plane that faces the cameras."""
    scene = texture()
    return scene[:, 50 : 50 + WIDTH], scene[:, 50 + disparity : 50 + disparity + WIDTH]


@pytest.mark.parametrize("disparity", [4, 10, 20])
def test_a_plane_has_its_depth_everywhere_that_both_cameras_see(disparity):
    depth = RIG.depth(*plane(disparity))
    assert depth.dtype == np.float32
    seen = depth[:, disparity:]
    assert (seen > 0).mean() > 0.97
    errors = np.abs(200 * 0.5 / seen[seen > 0] - disparity)
    assert np.quantile(errors, 0.98) <= 2 / 16  # a sixteenth of a pixel is the resolution of the matcher
    assert errors.max() < 1


def test_the_margin_that_only_the_left_camera_sees_has_no_depth():
    disparity = 20
    unseen = RIG.depth(*plane(disparity))[:, :disparity]
    assert (unseen > 0).mean() < 0.05


def test_colour_gives_the_depth_of_grey():
    left, right = plane(10)
    depth = RIG.depth(cv2.merge([left] * 3), cv2.merge([right] * 3))
    assert_allclose(np.median(depth[depth > 0]), 10, rtol=0.01)


def test_images_without_texture_or_without_relation_have_hardly_any_depth():
    flat = np.full((HEIGHT, WIDTH), 128, np.uint8)
    unrelated = texture(1)[:, :WIDTH], texture(2)[:, :WIDTH]
    assert (RIG.depth(flat, flat) > 0).mean() == 0
    assert (RIG.depth(*unrelated) > 0).mean() < 0.1


def test_an_occluded_surface_is_not_given_the_depth_of_what_hides_it():
    """A box of disparity 20 before a wall of 5: beside it the wall is hidden from the right camera."""
    wall_left, wall_right = plane(5)
    left, right = wall_left.copy(), wall_right.copy()
    box = texture(3)[30:90, :60]
    left[30:90, 150:210], right[30:90, 130:190] = box, box
    depth = RIG.depth(left, right)
    hidden = depth[40:80, 137:148]
    assert (hidden > 0).mean() < 0.5
    assert_allclose(np.median(depth[45:75, 165:200]), 5, rtol=0.02)
    assert_allclose(np.median(depth[45:75, 230:300]), 20, rtol=0.02)


def test_results_do_not_depend_on_the_number_of_threads():
    threads = cv2.getNumThreads()
    try:
        cv2.setNumThreads(1)
        one = RIG.depth(*plane(10))
        cv2.setNumThreads(3)
        assert_array_equal(RIG.depth(*plane(10)), one)
    finally:
        cv2.setNumThreads(threads)


def projections(baseline_m: float) -> tuple[np.ndarray, np.ndarray]:
    offset = K @ np.array([[-baseline_m], [0], [0]])
    return np.hstack([K, np.zeros((3, 1))]), np.hstack([K, offset])


def test_baseline_comes_from_the_projection_matrices():
    assert_allclose(StereoRig.from_projections(*projections(0.54)).baseline_m, 0.54, rtol=1e-12)


def test_cameras_that_are_swapped_or_not_rectified_are_refused():
    left, right = projections(0.54)
    with pytest.raises(LogError, match="not to the right"):
        StereoRig.from_projections(right, left)
    with pytest.raises(LogError, match="not those of a rectified stereo pair"):
        StereoRig.from_projections(left, np.diag([2.0, 2, 1]) @ right)


# ------------------------------------------------------------------------------------------- whole recordings


@pytest.fixture
def pair_files(tmp_path):
    """Five frames on disk."""
    pairs = []
    for index, disparity in enumerate([4, 6, 8, 10, 12]):
        files = tmp_path / f"left{index}.png", tmp_path / f"right{index}.png"
        for file, image in zip(files, plane(disparity), strict=True):
            cv2.imwrite(str(file), image)
        pairs.append(StereoPair(index * 100, *files))
    return pairs


def test_frames_come_in_order_each_with_its_own_depth(pair_files):
    warnings: Counter[str] = Counter()
    frames = list(stereo_frames(RIG, pair_files, WHOLE, warnings))
    assert [frame.stamp_ns for frame in frames] == [0, 100, 200, 300, 400]
    medians = [float(np.median(frame.depth[frame.depth > 0])) for frame in frames]
    assert_allclose(medians, 100 / np.array([4, 6, 8, 10, 12]), rtol=0.02)
    assert not warnings


def test_files_that_cannot_be_decoded_are_counted(pair_files):
    pair_files[1].left.write_bytes(b"not an image")
    pair_files[3].right.write_bytes(b"")
    pair_files[4] = StereoPair(400, pair_files[4].left, None)
    warnings: Counter[str] = Counter()
    frames = list(stereo_frames(RIG, pair_files, WHOLE, warnings))
    assert [(frame.stamp_ns, frame.depth is None) for frame in frames] == [
        (0, False),
        (200, False),
        (300, True),
        (400, True),
    ]
    assert warnings == {
        "frames skipped (left image cannot be decoded)": 1,
        "frames without depth (right image cannot be decoded)": 1,
    }


def test_camera_and_depth_follow_the_framing(pair_files):
    frames = list(stereo_frames(RIG, pair_files, Framing(crop_height=60, size=(160, 30)), Counter()))
    frame = frames[0]
    assert frame.image.shape == frame.depth.shape == (30, 160)
    assert (frame.camera.width, frame.camera.height) == (160, 30)
    assert_allclose(frame.camera.K[:2, 2], [79.5, -0.5], atol=1e-12)


def test_images_of_another_size_are_refused(pair_files):
    with pytest.raises(LogError, match="320x120 pixels where 640x240 are expected"):
        list(stereo_frames(RIG, pair_files, WHOLE, Counter(), size=(640, 240)))
    cv2.imwrite(str(pair_files[2].right), np.zeros((50, 60), np.uint8))
    with pytest.raises(LogError, match=r"right2\.png: not of the same size"):
        list(stereo_frames(RIG, pair_files, WHOLE, Counter()))
