"""Image files, cropping and scaling: pixels and the camera that projects onto them stay together."""

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from fusion_io.errors import LogError, UsageError
from fusion_io.images import WHOLE, Framing, read_depth, read_image
from fusion_io.records import CameraInfo

CAMERA = CameraInfo(64, 48, np.array([[50.0, 0, 30], [0, 55, 20], [0, 0, 1]]))


def test_colour_is_rgb_and_grey_stays_grey(tmp_path):
    red = np.zeros((4, 6, 3), np.uint8)
    red[..., 2] = 255  # OpenCV writes BGR
    cv2.imwrite(str(tmp_path / "red.png"), red)
    cv2.imwrite(str(tmp_path / "grey.png"), red[..., 0])
    assert_array_equal(read_image(tmp_path / "red.png")[0, 0], [255, 0, 0])
    assert read_image(tmp_path / "grey.png").shape == (4, 6)


def test_what_cannot_be_decoded_is_none(tmp_path):
    (tmp_path / "text.png").write_text("hello")
    (tmp_path / "empty.png").touch()
    for name in ("text.png", "empty.png", "gone.png"):
        assert read_image(tmp_path / name) is None
        assert read_depth(tmp_path / name, 0.001) is None


def test_depth_is_scaled_to_metres_and_must_have_16_bits(tmp_path):
    cv2.imwrite(str(tmp_path / "depth.png"), np.array([[0, 1500, 65535]], np.uint16))
    assert_allclose(read_depth(tmp_path / "depth.png", 0.001), [[0, 1.5, 65.535]], rtol=1e-6)
    cv2.imwrite(str(tmp_path / "bytes.png"), np.zeros((2, 2), np.uint8))
    with pytest.raises(LogError, match=r"bytes\.png: depth must be a 16-bit image"):
        read_depth(tmp_path / "bytes.png", 0.001)


def test_nothing_changes_without_crop_and_size():
    image = np.random.default_rng(0).integers(0, 255, (48, 64), np.uint8)
    assert_array_equal(WHOLE.image(image), image)
    assert WHOLE.camera(CAMERA) is CAMERA


@pytest.mark.parametrize(
    "framing", [Framing(24), Framing(None, (32, 24)), Framing(30, (32, 10)), Framing(24, (128, 96))]
)
def test_a_point_lands_on_the_same_spot_of_the_picture(framing):
    """A bright blob at the projection of a point is found at the point's projection by the new camera."""
    point = np.array([0.06, 0.26, 1.0])
    u, v, _ = CAMERA.K @ point
    columns, rows = np.meshgrid(np.arange(64), np.arange(48))
    image = (250 * np.exp(-((columns - u) ** 2 + (rows - v) ** 2) / (2 * 2.5**2))).astype(np.uint8)
    scaled = framing.image(image).astype(float)
    camera = framing.camera(CAMERA)
    assert scaled.shape == (camera.height, camera.width)
    columns, rows = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    centre = [(scaled * columns).sum() / scaled.sum(), (scaled * rows).sum() / scaled.sum()]
    assert_allclose(centre, (camera.K @ point)[:2], atol=0.15)


def test_scaled_depth_invents_no_values():
    """Every depth that comes out went in: no mean over an edge, or with a hole."""
    depth = np.random.default_rng(0).choice(np.array([0, 5, 40], np.float32), (48, 64))
    assert set(np.unique(Framing(40, (27, 17)).depth(depth))) == {0, 5, 40}


def test_scaled_depth_is_that_of_the_pixel_centre():
    depth = np.tile(np.arange(64, dtype=np.float32), (48, 1))
    assert_array_equal(Framing(None, (64 // 3 * 3 // 3, 48)).depth(depth[:, :63])[0], np.arange(21) * 3 + 1)


def test_a_crop_higher_than_the_image_is_refused():
    with pytest.raises(UsageError, match="48 rows to 49"):
        Framing(49).image(np.zeros((48, 64), np.uint8))
