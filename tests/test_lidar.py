"""Depth from scans: the depth of the surface that the points lie on, the nearest where several meet."""

from collections import Counter
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import RigidTransform, Rotation

from fusion_io.errors import LogError
from fusion_io.images import WHOLE, Framing
from fusion_io.lidar import LidarRig, Scan, lidar_frames, project, read_points
from fusion_io.records import CameraInfo

K = np.array([[60.0, 0, 31.5], [0, 60, 23.5], [0, 0, 1]])
CAMERA = CameraInfo(64, 48, K)
RIG = LidarRig(
    K, RigidTransform.from_components([0.1, -0.1, -0.3], Rotation.from_matrix([[0, -1, 0], [0, 0, -1], [1, 0, 0]]))
)
# n . p = 1: a wall that is 8 m away at the middle of the image, and slants to both sides
NORMAL = np.array([0.02, 0.01, 1 / 8])


def wall(count: int, scale: float = 1.0) -> np.ndarray:
    """Random points (N, 3) of the wall in the camera's frame, in and around the image; farther by ``scale``."""
    pixels = np.random.default_rng(0).uniform([-10, -10], [74, 58], (count, 2))
    rays = np.column_stack([pixels, np.ones(count)]) @ np.linalg.inv(K).T
    return scale * rays / (rays @ NORMAL)[:, None]


def wall_depth(camera: CameraInfo) -> np.ndarray:
    """The wall's depth at the centres of the pixels."""
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    rays = np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(camera.K).T
    return 1 / (rays @ NORMAL)


def write_scan(path: Path, points_camera: np.ndarray) -> Path:
    points = RIG.T_camera_lidar.inv().apply(points_camera)
    np.column_stack([points, np.full(len(points), 0.5)]).astype("<f4").tofile(path)
    return path


@pytest.fixture
def image(tmp_path) -> Path:
    path = tmp_path / "000000.png"
    cv2.imwrite(str(path), np.full((48, 64), 100, np.uint8))
    return path


def test_points_of_a_wall_have_its_depth():
    """Within half a pixel of the wall's slant, on as many pixels as there are points that fall on them."""
    depth = project(wall(800), CAMERA)
    valid = depth > 0
    assert depth.dtype == np.float32
    assert 300 < valid.sum() < 800
    assert_allclose(depth[valid], wall_depth(CAMERA)[valid], rtol=0.5 * (0.02 + 0.01) / 60 * 9)


def test_of_two_surfaces_the_nearer_is_seen_whatever_their_order():
    near, far = wall(20_000), wall(20_000, scale=2.0)
    alone = project(near, CAMERA)
    assert (alone > 0).mean() > 0.95
    seen = alone > 0
    for points in (np.vstack([near, far]), np.vstack([far, near])):
        assert_array_equal(project(points, CAMERA)[seen], alone[seen])


def test_points_behind_the_camera_beside_the_image_or_in_its_centre_leave_nothing():
    points = np.array([[0, 0, -5.0], [0, 0, 0], [50, 0, 5], [0, -50, 5], [0, 0, 1e-300]])
    depth = project(points, CAMERA)
    assert depth.shape == (48, 64)
    assert not depth[np.indices(depth.shape)[0] != 24].any()
    assert_array_equal(project(np.zeros((0, 3)), CAMERA), np.zeros((48, 64)))


def test_a_scan_is_moved_into_the_camera(tmp_path, image):
    scan = Scan(7, image, write_scan(tmp_path / "000000.bin", wall(800)))
    (frame,) = lidar_frames(RIG, [scan], WHOLE, Counter())
    valid = frame.depth > 0
    assert frame.stamp_ns == 7
    assert_allclose(frame.depth[valid], wall_depth(CAMERA)[valid], rtol=3e-3)


def test_a_smaller_image_is_a_denser_one(tmp_path, image):
    """Points are projected into the cropped and scaled image, not thrown away by scaling a sparse one."""
    scan = Scan(0, image, write_scan(tmp_path / "000000.bin", wall(800)))
    (whole,) = lidar_frames(RIG, [scan], WHOLE, Counter())
    (small,) = lidar_frames(RIG, [scan], Framing(crop_height=40, size=(16, 10)), Counter())
    assert small.depth.shape == small.image.shape == (10, 16)
    assert (whole.depth > 0).mean() < 0.2
    assert (small.depth > 0).mean() > 0.8
    # the nearest of a larger pixel's points: at most its half diagonal nearer than its centre
    assert_allclose(small.depth[small.depth > 0], wall_depth(small.camera)[small.depth > 0], rtol=0.02)


def test_points_that_are_not_finite_are_left_out(tmp_path):
    path = tmp_path / "a.bin"
    np.array([[1, 2, 3, 0.5], [np.nan, 0, 0, 0], [0, np.inf, 0, 0]], "<f4").tofile(path)
    assert_array_equal(read_points(path), [[1, 2, 3]])


@pytest.mark.parametrize("data", [b"", bytes(15), bytes(33)])
def test_a_file_that_is_no_whole_number_of_points_leaves_its_frame_without_depth(tmp_path, image, data):
    (tmp_path / "000000.bin").write_bytes(data)
    warnings: Counter[str] = Counter()
    (frame,) = lidar_frames(RIG, [Scan(0, image, tmp_path / "000000.bin")], WHOLE, warnings)
    assert frame.depth is None
    assert warnings == {"frames without depth (scan cannot be read)": 1}


def test_a_frame_without_a_scan_has_no_depth(image):
    (frame,) = lidar_frames(RIG, [Scan(0, image, None)], WHOLE, Counter())
    assert frame.depth is None
    assert frame.image.shape == (48, 64)


def test_an_image_that_cannot_be_decoded_is_skipped_and_counted(tmp_path, image):
    broken = tmp_path / "000001.png"
    broken.write_bytes(b"not an image")
    warnings: Counter[str] = Counter()
    frames = list(lidar_frames(RIG, [Scan(0, broken, None), Scan(1, image, None)], WHOLE, warnings))
    assert [frame.stamp_ns for frame in frames] == [1]
    assert warnings == {"frames skipped (left image cannot be decoded)": 1}


def test_an_image_of_another_size_than_the_calibration_is_refused(image):
    with pytest.raises(LogError, match="64x48 pixels where 100x48 are expected"):
        list(lidar_frames(RIG, [Scan(0, image, None)], WHOLE, Counter(), (100, 48)))
