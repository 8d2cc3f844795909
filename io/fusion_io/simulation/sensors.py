"""Depth as sensors give it: stereo matching, a spinning LiDAR, a time-of-flight or structured-light camera.

All take the exact depth (H, W) in metres along the optical axis, 0 where there is none, and the
camera's image, and return what the sensor would have measured in the same pixels, 0 where it
measured nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from fusion_io.records import FloatArray
from fusion_io.simulation.textures import Float32

KITTI_BASELINE_M = 0.54
KITTI_WIDTH = 1242
MAX_DEPTH_M = 80.0
FLAT_LEVELS = 3  # grey levels: less contrast is no texture
SKY_STREAKS = 1.5  # standard deviations
SKY_MATCHES_M = (3.2, 8.0)


@dataclass(frozen=True, slots=True)
class Stereo:
    """A stereo camera on KITTI's baseline with semi-global matching.

    noise_px: of the disparity; fattening_px: by how much near things outgrow their borders, as the
    matching window sees them first; missing and wrong: shares of the image that blobs without a
    match, and blobs matched wrongly, cover; flat_missing: how much is missing where the image has
    no texture. Pixels are those of a KITTI image, 1242 wide.
    """

    noise_px: float = 0.3
    fattening_px: float = 2.0
    missing: float = 0.03
    wrong: float = 0.005
    flat_missing: float = 0.5

    def measure(self, depth: Float32, image: NDArray[np.uint8], K: FloatArray, rng: np.random.Generator) -> Float32:
        """The noise is that of a disparity, so it grows with z^2; part of it is common to neighbours.

        There are holes where the right camera cannot see, outside of its image, in blobs where
        nothing matches, in streaks where the image is flat, and beyond 80 m. In streaks of the
        sky something near is matched.
        """
        pixel = depth.shape[1] / KITTI_WIDTH
        scale = np.float32(K[0, 0] * KITTI_BASELINE_M)
        true = np.zeros_like(depth)
        np.divide(scale, depth, out=true, where=depth > 0)
        seen = (depth > 0) & ~_occluded(true)
        disparity = _fattened(true, self.fattening_px * pixel, float(K[0, 0] / K[1, 1]), rng)
        noise = 0.8 * _smooth_noise(rng, depth.shape, 4) + 0.6 * rng.standard_normal(depth.shape, np.float32)
        disparity += np.float32(self.noise_px * pixel) * noise
        streaks = _smooth_noise(rng, depth.shape, 20, 3)
        wrong_sky = (depth == 0) & (streaks > SKY_STREAKS)
        disparity[wrong_sky] = scale / rng.uniform(*SKY_MATCHES_M)
        blobs = _smooth_noise(rng, depth.shape, 10)
        low, high = np.quantile(blobs, [self.wrong, 1.0 - self.missing])
        disparity[blobs < low] *= np.float32(np.exp(rng.normal(0.0, 0.3)))
        valid = (seen | wrong_sky) & (disparity > scale / MAX_DEPTH_M) & (blobs <= high)
        valid &= ~_flat(image) | (streaks > np.quantile(streaks, self.flat_missing))
        return np.asarray(np.divide(scale, disparity, out=np.zeros_like(depth), where=valid))


def _fattened(disparity: Float32, reach_px: float, pixel_aspect: float, rng: np.random.Generator) -> Float32:
    """Near things grown by up to ``reach_px``, more in some places than in others; slopes stay as they are.

    pixel_aspect: fx / fy, by which the disparity of a road changes faster from row to row. A reach
    below a pixel is the mean over a pixel that is partly covered.
    """
    if reach_px <= 0:
        return disparity.copy()
    radius = int(np.ceil(reach_px))
    near = np.asarray(cv2.dilate(disparity, np.ones((2 * radius + 1, 2 * radius + 1), np.uint8)), np.float32)
    jump = near - disparity
    is_edge = jump > 0.8 * max(pixel_aspect, 1.0) * radius
    share = np.clip(0.7 + 0.5 * _smooth_noise(rng, disparity.shape, 6), 0.0, 1.0)
    # The wider of two growths with whole pixels covers its outermost ring in part.
    share *= reach_px / radius
    return np.asarray(disparity + np.where(is_edge, share * jump, 0.0), np.float32)


def _occluded(disparity: Float32) -> NDArray[np.bool_]:
    """Pixels that the right camera cannot see.

    One further right in the row lands further left than they do, or they land outside of the image.
    """
    landing = np.arange(disparity.shape[1], dtype=np.float32) - disparity
    to_the_right = np.minimum.accumulate(landing[:, ::-1], axis=1)[:, ::-1]
    return np.asarray((landing > to_the_right + 0.5) | (landing < -0.5))


def _flat(image: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Pixels (H, W) that look like all their neighbours."""
    grey = image if image.ndim == 2 else image[..., 1]
    around = np.ones((3, 5), np.uint8)
    return np.asarray(cv2.dilate(grey, around) - cv2.erode(grey, around) <= FLAT_LEVELS)


def _smooth_noise(
    rng: np.random.Generator, shape: tuple[int, int], period: int, row_period: int | None = None
) -> Float32:
    """Noise (H, W) of about unit variance with features ``period`` pixels wide and ``row_period`` (or as) high."""
    height, width = shape
    rows, columns = height // (row_period or period), width // period
    coarse = rng.standard_normal((max(rows, 2), max(columns, 2))).astype(np.float32)
    return np.asarray(cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC))


@dataclass(frozen=True, slots=True)
class Lidar:
    """A spinning LiDAR beside the camera; the defaults are those of the Velodyne HDL-64E on KITTI's car.

    lines at even angles from top_rad (upwards positive) to bottom_rad about the camera's x axis, a
    beam every azimuth_rad on each; noise_m of the range; dropout: share of beams without an echo.
    """

    lines: int = 64
    top_rad: float = np.deg2rad(2.0)
    bottom_rad: float = np.deg2rad(-24.8)
    azimuth_rad: float = np.deg2rad(0.17)
    noise_m: float = 0.02
    dropout: float = 0.05

    def measure(self, depth: Float32, image: NDArray[np.uint8], K: FloatArray, rng: np.random.Generator) -> Float32:
        """Pixels that a beam hits have its depth; all others have none."""
        height, width = depth.shape
        x, y = (np.arange(width) - K[0, 2]) / K[0, 0], (np.arange(height) - K[1, 2]) / K[1, 1]
        edges = (np.arange(height + 1) - 0.5 - K[1, 2]) / K[1, 1]
        elevation = -np.arctan(edges[:, None] / np.sqrt(1.0 + x * x))
        spacing = (self.top_rad - self.bottom_rad) / (self.lines - 1)
        first = np.ceil((self.top_rad - elevation) / spacing).clip(0, self.lines)  # lines above each edge
        azimuth = np.arctan((np.arange(width + 1) - 0.5 - K[0, 2]) / K[0, 0]) / self.azimuth_rad + rng.random()
        hit = (np.diff(first, axis=0) > 0) & (np.diff(np.floor(azimuth)) > 0)
        hit &= (depth > 0) & (rng.random(depth.shape) >= self.dropout)
        lengths = np.sqrt(1.0 + x * x + (y * y)[:, None])  # of rays with z = 1
        measured = depth + self.noise_m * rng.standard_normal(depth.shape) / lengths
        return np.where(hit & (measured > 0) & (measured < MAX_DEPTH_M), measured, 0.0).astype(np.float32)


@dataclass(frozen=True, slots=True)
class TimeOfFlight:
    """A time-of-flight or structured-light camera of limited range.

    The noise's standard deviation is noise_m at 1 m and grows with z^2 (Khoshelham and Elberink,
    "Accuracy and resolution of Kinect depth data", Sensors 2012); missing: the share of the image
    covered by blobs that send too little light back.
    """

    range_m: float = 8.0
    noise_m: float = 0.002
    missing: float = 0.03

    def measure(self, depth: Float32, image: NDArray[np.uint8], K: FloatArray, rng: np.random.Generator) -> Float32:
        """No depth beyond the range, nor at the borders of things, where a pixel sees both sides."""
        deviation = np.float32(self.noise_m) * depth * depth
        measured = depth + deviation * rng.standard_normal(depth.shape, np.float32)
        around = np.ones((3, 3), np.uint8)
        spread = cv2.dilate(depth, around) - cv2.erode(depth, around)
        blobs = _smooth_noise(rng, depth.shape, 10)
        valid = (depth > 0) & (measured > 0) & (measured < self.range_m)
        # A slanted floor changes by its depth times the pixel's angle over its own angle: far below a fifth.
        valid &= (spread < 0.2 * depth) & (blobs <= np.quantile(blobs, 1.0 - self.missing))
        return np.where(valid, measured, 0.0).astype(np.float32)


DepthSensor = Stereo | Lidar | TimeOfFlight
