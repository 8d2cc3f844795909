"""Image files, and how a converter crops and scales what is in them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from fusion_io.errors import LogError, UsageError
from fusion_io.records import CameraInfo

#: Files that count as images, in small letters.
SUFFIXES = frozenset({".png", ".jpg", ".jpeg"})


def read_image(path: Path) -> NDArray[np.uint8] | None:
    """An image file as it left the camera: (H, W) or (H, W, 3) uint8, colour as RGB; more bits are cut to 8.

    None where it cannot be read or decoded.
    """
    image = _decode(path, cv2.IMREAD_ANYCOLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    if image is None:
        return None
    return np.asarray(image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2RGB), dtype=np.uint8)


def read_depth(path: Path, metres_per_unit: float) -> NDArray[np.float32] | None:
    """A 16-bit depth image in metres, (H, W) float32, 0 where there is none.

    None where it cannot be read or decoded; a ``LogError`` where it is no 16-bit image of one channel.
    """
    depth = _decode(path, cv2.IMREAD_UNCHANGED)
    if depth is None:
        return None
    if depth.dtype != np.uint16 or depth.ndim != 2:
        raise LogError(f"{path}: depth must be a 16-bit image of one channel, this is {depth.dtype} {depth.shape}")
    return depth.astype(np.float32) * np.float32(metres_per_unit)


def _decode(path: Path, flags: int) -> NDArray[np.generic] | None:
    try:
        data = np.frombuffer(path.read_bytes(), np.uint8)
        image: NDArray[np.generic] | None = cv2.imdecode(data, flags) if data.size else None
    except (OSError, cv2.error):
        return None
    return image


@dataclass(frozen=True, slots=True)
class Framing:
    """What of each image goes into the log: its lower ``crop_height`` rows, scaled to ``size`` (width, height)."""

    crop_height: int | None = None
    size: tuple[int, int] | None = None

    def image(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """The cropped and scaled image; a smaller one averages the pixels it covers."""
        smaller = self.size is not None and self.size[0] <= image.shape[1]
        return np.asarray(self._resized(image, cv2.INTER_AREA if smaller else cv2.INTER_LINEAR), dtype=np.uint8)

    def depth(self, depth: NDArray[np.float32]) -> NDArray[np.float32]:
        """The cropped and scaled depth: each pixel takes the depth at its centre.

        Averaging would invent surfaces between an edge and what is behind it.
        """
        return np.asarray(self._resized(depth, cv2.INTER_NEAREST_EXACT), dtype=np.float32)

    def camera(self, camera: CameraInfo) -> CameraInfo:
        """The camera that takes the cropped and scaled image."""
        if self.crop_height is not None:
            rows = self._rows(camera.height)
            camera = camera.cropped(0, camera.height - rows, camera.width, rows)
        return camera if self.size is None else camera.scaled_to(*self.size)

    def _rows(self, height: int) -> int:
        rows = height if self.crop_height is None else self.crop_height
        if rows > height:
            raise UsageError(f"cannot crop images of {height} rows to {rows}")
        return rows

    def _resized(self, image: NDArray[np.generic], interpolation: int) -> NDArray[np.generic]:
        image = image[image.shape[0] - self._rows(image.shape[0]) :]
        if self.size is None or self.size == image.shape[1::-1]:
            return image
        resized: NDArray[np.generic] = cv2.resize(image, self.size, interpolation=interpolation)
        return resized


#: Nothing is cropped or scaled.
WHOLE = Framing()
