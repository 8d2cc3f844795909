"""Making one frame of what a camera's topics hold: pairing, matching sizes, undistorting."""

from __future__ import annotations

import functools
from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from fusion_io.records import CameraFrame, CameraInfo, IntArray

# Coefficients that OpenCV's model of a lens takes: plumb_bob has 5, rational_polynomial 8 (and up to 14).
_LENS_COEFFICIENTS = (4, 5, 8, 12, 14)
_FISHEYE_COEFFICIENTS = 4


def pair_nearest(stamps: IntArray, others: IntArray, tolerance_ns: float) -> IntArray:
    """For each stamp (N,) the index of its partner among the others (M,), -1 where there is none; both sorted.

    Partners are each other's nearest, and not further apart than the tolerance.
    """
    if not len(stamps) or not len(others):
        return np.full(len(stamps), -1)
    nearest = nearest_index(others, stamps)
    mutual = nearest_index(stamps, others)[nearest] == np.arange(len(stamps))
    return np.where(mutual & (np.abs(others[nearest] - stamps) <= tolerance_ns), nearest, -1)


def nearest_index(stamps: IntArray, at: IntArray) -> IntArray:
    """For each time (M,) the index of the nearest of the sorted stamps (N,), N > 0; the earlier of two."""
    right = np.clip(np.searchsorted(stamps, at), 1, max(len(stamps) - 1, 1))
    left = right - 1
    right = np.minimum(right, len(stamps) - 1)
    return np.where(at - stamps[left] <= stamps[right] - at, left, right)


def same_aspect(width: int, height: int, other_width: int, other_height: int) -> bool:
    """Whether one size is the other scaled, with both sides rounded to whole pixels."""
    return (
        abs(width * other_height / height - other_width) <= 1 or abs(height * other_width / width - other_height) <= 1
    )


def fit_camera(info: CameraInfo, width: int, height: int) -> CameraInfo:
    """The intrinsics of an image of this size.

    Raises:
        ValueError: an image of this size cannot be from this camera.

    """
    if (info.width, info.height) == (width, height):
        return info
    if not same_aspect(info.width, info.height, width, height):
        raise ValueError(f"a camera info of {info.width}x{info.height} cannot belong to an image of {width}x{height}")
    return info.scaled_to(width, height)


def fit_depth(depth: NDArray[np.float32], width: int, height: int) -> NDArray[np.float32]:
    """Depth at the size of the image; the nearest sample, since a mean over an edge is the depth of nothing.

    Raises:
        ValueError: depth of this size cannot be from the same camera.

    """
    depth_height, depth_width = depth.shape
    if (depth_width, depth_height) == (width, height):
        return depth
    if not same_aspect(depth_width, depth_height, width, height):
        raise ValueError(f"depth of {depth_width}x{depth_height} cannot belong to an image of {width}x{height}")
    scaled: NDArray[np.float32] = cv2.resize(depth, (width, height), interpolation=cv2.INTER_NEAREST_EXACT)
    return scaled


def undistorted(frame: CameraFrame) -> CameraFrame:
    """The frame as a pinhole camera with the same K would have seen it; depth is along the axis, so it only moves.

    Raises:
        ValueError: the lens model is not known, or does not have this many coefficients.

    """
    camera = frame.camera
    if not np.any(camera.distortion):
        return frame
    maps = _undistortion_maps(
        camera.distortion_model, tuple(camera.distortion), tuple(camera.K.ravel()), camera.width, camera.height
    )
    pinhole = CameraInfo(camera.width, camera.height, camera.K, frame_id=camera.frame_id)
    depth = None if frame.depth is None else cv2.remap(frame.depth, *maps, cv2.INTER_NEAREST)
    return CameraFrame(frame.stamp_ns, cv2.remap(frame.image, *maps, cv2.INTER_LINEAR), depth, pinhole)


@functools.lru_cache(maxsize=2)
def _undistortion_maps(
    model: str, coefficients: tuple[float, ...], K_row_major: tuple[float, ...], width: int, height: int
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Where each pixel of the pinhole image is in the distorted one."""
    K = np.array(K_row_major).reshape(3, 3)
    maps = _lens(model, len(coefficients))(K, np.array(coefficients), np.eye(3), K, (width, height), cv2.CV_32FC1)
    return maps[0], maps[1]


def _lens(model: str, coefficients: int) -> Callable[..., tuple[NDArray[np.float32], NDArray[np.float32]]]:
    """OpenCV's maps for a distortion model of sensor_msgs/distortion_models.hpp."""
    if model in {"plumb_bob", "rational_polynomial"} and coefficients in _LENS_COEFFICIENTS:
        return cv2.initUndistortRectifyMap
    if model in {"equidistant", "fisheye"} and coefficients == _FISHEYE_COEFFICIENTS:
        return cv2.fisheye.initUndistortRectifyMap
    raise ValueError(f"lens distortion {model!r} with {coefficients} coefficients cannot be undone")
