"""Classical RGB-D odometry: exact where the data are, blind to brightness, honest where it fails."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import RigidTransform, Rotation

from fusion_io.records import CameraFrame, CameraInfo
from fusion_io.simulation import clip
from learned.baselines import rgbd_odometry

SIZE = 320, 240
K = np.array([[250.0, 0, 159.5], [0, 250, 119.5], [0, 0, 1]])
CAMERA = CameraInfo(*SIZE, K)
MOTION = RigidTransform.from_components([0.05, -0.02, 0.25], Rotation.from_rotvec([0.01, -0.02, 0.015]))

# A wall, slanted so that its depth goes from 5 to 8 m: n . p = 1 for its points p (m) in the source camera.
NORMAL = np.array([0.05, 0.03, 1.0]) / 6.0


def wall_depth() -> np.ndarray:
    u, v = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    rays = np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(K).T
    return (1 / (rays @ NORMAL)).astype(np.float32)


def grey_wall(seed: int = 0) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(size=SIZE[::-1]).astype(np.float32)
    smooth = cv2.GaussianBlur(noise, (0, 0), 2.0)
    return np.clip(110 + 25 * smooth / smooth.std(), 0, 255).astype(np.uint8)


def frame(image: np.ndarray, depth: np.ndarray | None) -> CameraFrame:
    return CameraFrame(0, image, depth, CAMERA)


@pytest.fixture
def pair() -> tuple[CameraFrame, CameraFrame]:
    """A wall before and after MOTION: its image moves by the homography of its plane."""
    T_target_source = MOTION.inv()
    homography = K @ (T_target_source.rotation.as_matrix() + np.outer(T_target_source.translation, NORMAL))
    source = grey_wall()
    target = cv2.warpPerspective(
        source, homography @ np.linalg.inv(K), SIZE, flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT
    )
    return frame(source, wall_depth()), frame(target, None)


def errors(T_source_target: np.ndarray, truth: RigidTransform) -> tuple[float, float]:
    """Metres and radians."""
    difference = truth.inv() * RigidTransform.from_matrix(T_source_target)
    return float(np.linalg.norm(difference.translation)), float(difference.rotation.magnitude())


def test_the_motion_before_a_wall_is_found_in_the_houses_convention(pair):
    """To 3 mm (of 26 cm) and 0.5 mrad: the pose of the target camera in the source camera's frame."""
    motion = rgbd_odometry(*pair)
    metres, radians = errors(motion.T_source_target, MOTION)
    assert metres < 3e-3
    assert radians < 5e-4
    assert motion.inliers > 100


def test_the_same_frame_twice_is_no_motion(pair):
    source, _ = pair
    assert_allclose(rgbd_odometry(source, source).T_source_target, np.eye(4), atol=1e-5)


@pytest.mark.parametrize(("gain", "offset"), [(0.5, 0.0), (0.7, 60.0), (1.2, -20.0)])
def test_brightness_and_contrast_of_the_target_do_not_matter(pair, gain, offset):
    """Beyond what rounding to 8 bits costs: 3 mm and 0.5 mrad."""
    source, target = pair
    changed = replace(target, image=cv2.convertScaleAbs(target.image, alpha=gain, beta=offset))
    reference = RigidTransform.from_matrix(rgbd_odometry(source, target).T_source_target)
    metres, radians = errors(rgbd_odometry(source, changed).T_source_target, reference)
    assert metres < 3e-3
    assert radians < 5e-4


def test_a_third_of_the_image_that_moves_by_itself_is_outvoted(pair):
    source, target = pair
    image = target.image.copy()
    image[:, :100] = source.image[:, 8:108]
    metres, radians = errors(rgbd_odometry(source, replace(target, image=image)).T_source_target, MOTION)
    assert metres < 5e-3
    assert radians < 1e-3


def test_pixels_without_depth_are_not_used(pair):
    source, target = pair
    depth = source.depth.copy()
    depth[::2] = 0
    depth[:, ::3] = np.nan
    metres, radians = errors(rgbd_odometry(replace(source, depth=depth), target).T_source_target, MOTION)
    assert metres < 5e-3
    assert radians < 1e-3


def test_colour_is_read_as_its_luminance(pair):
    source, target = pair
    colour = [replace(f, image=np.repeat(f.image[..., None], 3, axis=2)) for f in pair]
    assert_array_equal(rgbd_odometry(*colour).T_source_target, rgbd_odometry(source, target).T_source_target)


def test_the_same_frames_give_the_same_bits_whatever_was_estimated_before(pair):
    source, target = pair
    first = rgbd_odometry(source, target)
    rgbd_odometry(source, source)
    cv2.setRNGSeed(7)
    second = rgbd_odometry(source, target)
    assert first.T_source_target.tobytes() == second.T_source_target.tobytes()
    assert first.inliers == second.inliers


def test_where_nothing_can_be_tracked_there_is_no_estimate(pair):
    source, target = pair
    blank = np.full_like(source.image, 128)
    assert rgbd_odometry(frame(blank, source.depth), target) is None
    assert rgbd_odometry(source, frame(blank, None)) is None
    assert rgbd_odometry(source, frame(grey_wall(seed=1), None)) is None


def test_images_of_different_sizes_have_no_estimate(pair):
    source, target = pair
    assert rgbd_odometry(source, replace(target, image=target.image[:200])) is None


def test_without_depth_there_is_no_estimate(pair):
    source, target = pair
    assert rgbd_odometry(replace(source, depth=None), target) is None
    assert rgbd_odometry(replace(source, depth=np.zeros_like(source.depth)), target) is None


def test_rendered_streets_with_exact_depth_are_followed():
    """In the median of a few clips to 1 cm and 1 mrad: the images are small, and as noisy as a camera's."""
    found = []
    for seed in range(4):
        frames, _, truth = clip(seed, frames=2, width=320, height=96, exact_depth=True)
        motion = rgbd_odometry(*frames)
        if motion is not None:
            found.append(errors(motion.T_source_target, truth.poses[0].inv() * truth.poses[1]))
    assert len(found) >= 3
    metres, radians = np.median(found, axis=0)
    assert metres < 0.01
    assert radians < 1e-3
