"""A camera that slides along a painted wall and back: the smallest log with places that are seen twice."""

from collections.abc import Iterator
from typing import Any, TypeVar

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform

from fusion.config import Section
from fusion_io.records import CameraFrame, CameraInfo, FloatArray, IntArray, Trajectory

SECOND = 1_000_000_000
CAMERA = CameraInfo(240, 120, np.array([[150.0, 0, 119.5], [0, 150.0, 59.5], [0, 0, 1]]))
DISTANCE_M = 5.0  # of the wall from the camera's path
PIXELS_PER_M = CAMERA.K[0, 0] / DISTANCE_M
WALL_M = 40.0
END_M = 24.0  # where the camera turns back, from the left end of the wall's visible part


def painted(seed: int, width_m: float = WALL_M) -> np.ndarray:
    """Paint of many sizes on a piece of wall."""
    rng = np.random.default_rng(seed)
    shape = round(CAMERA.height + 2 * PIXELS_PER_M), round(width_m * PIXELS_PER_M)
    paint = np.zeros(shape, np.float32)
    for sigma in (1.5, 4.0, 10.0):
        noise = cv2.GaussianBlur(rng.normal(size=shape).astype(np.float32), (0, 0), sigma)
        paint += noise / noise.std()
    return np.clip(120 + 30 * paint, 0, 255).astype(np.uint8)


def there_and_back(step_m: float = 1.0) -> Trajectory:
    """To END_M along x and back, a bit higher; the camera looks at the wall all the time."""
    there = np.arange(0.0, END_M, step_m)
    x = np.concatenate([there, there[::-1] + 0.3])
    y = np.concatenate([np.zeros(len(there)), np.full(len(there), -0.2)])
    poses = RigidTransform.from_translation(np.column_stack([x, y, np.zeros(len(x))]))
    return Trajectory(np.arange(1, len(x) + 1) * SECOND, poses)


class WallLog:
    """The frames of a camera that looks straight at a wall.

    Frames at the stamps `blind` have no depth.
    """

    def __init__(self, wall: np.ndarray, truth: Trajectory, blind: frozenset[int] = frozenset()):
        self.wall, self.truth, self.blind = wall, truth, blind

    def frame_stamps(self) -> IntArray:
        return self.truth.stamps_ns

    def frames(self, stamps_ns: IntArray | None = None) -> Iterator[CameraFrame]:
        stamps = self.truth.stamps_ns if stamps_ns is None else stamps_ns
        for stamp, position in zip(stamps.tolist(), self.truth.at(stamps).translation, strict=True):
            yield self._frame(stamp, position)

    def _frame(self, stamp_ns: int, position: FloatArray) -> CameraFrame:
        corner = (position[:2] + [0.0, 1.0]) * PIXELS_PER_M
        to_wall = np.array([[1.0, 0.0, corner[0]], [0.0, 1.0, corner[1]]])
        size = CAMERA.width, CAMERA.height
        image = cv2.warpAffine(self.wall, to_wall, size, flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP)
        noise = np.random.default_rng(stamp_ns).normal(scale=2.0, size=image.shape)
        depth = None if stamp_ns in self.blind else np.full(image.shape, DISTANCE_M, np.float32)
        return CameraFrame(stamp_ns, np.clip(image + noise, 0, 255).astype(np.uint8), depth, CAMERA)


AnySection = TypeVar("AnySection", bound=Section)


def changed(config: AnySection, **values: Any) -> AnySection:
    """A configuration with other values."""
    return config.model_copy(update=values)
