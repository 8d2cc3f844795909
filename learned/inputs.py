"""From records to what the network reads: one path for training and inference.

Images and depth of any camera are brought to the network's size, K follows; the IMU of any rate becomes a
20 x 6 window.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from fusion_io.records import NANOSECONDS, CameraFrame, CameraInfo, FloatArray, ImuSeries, IntArray
from learned.violearner import IMU_SAMPLES, Batch, NetworkConfig

BEFORE_NS = 100_000_000
"""The window starts this long before the source (paper, section "KITTI Odometry Dataset")."""

HOLE_PERIODS = 5
"""Samples further apart than this many median periods have a hole between them."""

MIN_VALID_SHARE = 0.25
"""A pixel of the network has depth if the pixels it covers have it at least this often, relative to the whole image.

Relative, because a scanner leaves most pixels empty everywhere, stereo only where it fails.
"""


@dataclass(frozen=True)
class NetworkFrame:
    """A camera frame at the network's size: image (C, H, W) uint8, depth (H, W) float32 m or None, K (3, 3)."""

    stamp_ns: int
    image: NDArray[np.uint8]
    depth: NDArray[np.float32] | None
    K: FloatArray


def prepare(frame: CameraFrame, config: NetworkConfig) -> NetworkFrame:
    """Crop and scale a frame to the network's size; one that already has it passes unchanged.

    The crop keeps the lower rows. Images are averaged over the area of a pixel; of depth it is the inverse that is
    averaged, over valid pixels, because image motion is proportional to it.
    """
    image, depth, camera = frame.image, frame.depth, frame.camera
    if image.shape[:2] != (config.height, config.width):
        rows = round(image.shape[0] * config.keep_lower_fraction)
        top = image.shape[0] - rows
        image = cv2.resize(image[top:], (config.width, config.height), interpolation=cv2.INTER_AREA)
        if depth is not None:
            depth = resize_depth(depth[top:], config.width, config.height)
        camera = CameraInfo(frame.image.shape[1], frame.image.shape[0], frame.camera.K)
        camera = camera.cropped(0, top, camera.width, rows).scaled_to(config.width, config.height)
    return NetworkFrame(frame.stamp_ns, to_channels(image, config.channels), depth, camera.K)


def to_channels(image: NDArray[np.uint8], channels: int) -> NDArray[np.uint8]:
    """(H, W) or (H, W, 3) RGB to (channels, H, W): luminance, or grey repeated in three channels."""
    if image.ndim == 3 and channels == 1:
        image = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    if image.ndim == 2:
        return np.broadcast_to(image, (channels, *image.shape)).copy()
    return np.ascontiguousarray(image.transpose(2, 0, 1))


def resize_depth(depth: NDArray[np.float32], width: int, height: int) -> NDArray[np.float32]:
    """Depth (H, W) m at another size by averaging valid inverse depths; 0 where too few are valid."""
    valid = (depth > 0) & (depth < np.inf)  # false for NaN as well
    inverse = np.divide(1, depth, out=np.zeros_like(depth), where=valid)
    both = cv2.merge([valid.astype(np.float32), inverse])
    share, mean_inverse = cv2.split(cv2.resize(both, (width, height), interpolation=cv2.INTER_AREA))
    enough = (share >= MIN_VALID_SHARE * np.count_nonzero(valid) / valid.size) & (mean_inverse > 0)
    return np.where(enough, share / np.where(enough, mean_inverse, 1), 0).astype(np.float32)


def imu_window(imu: ImuSeries, source_ns: int, target_ns: int) -> FloatArray:
    """The 20 x 6 window of a pair: means over ten bins of the 100 ms before the source and ten up to the target.

    Columns are angular velocity (rad/s) and linear acceleration (m/s^2). A mean over a bin is exact for signals
    that are linear between samples and does not alias, whatever the log's rate. Bins that the samples do not cover
    (start of the log, a hole, no IMU) take the nearest covered bin's value, or NaN if the window has none; see
    `imu_coverage`.
    """
    edges = window_edges(source_ns, target_ns)
    covered = covered_bins(imu.stamps_ns, edges)
    if not covered.any():
        return np.full((IMU_SAMPLES, 6), np.nan)
    origin = source_ns  # float64 seconds lose nanoseconds on absolute stamps
    samples = np.hstack([imu.angular_velocity, imu.linear_acceleration])
    first = max(0, int(np.searchsorted(imu.stamps_ns, edges[0])) - 1)
    last = min(len(imu), int(np.searchsorted(imu.stamps_ns, edges[-1])) + 1)
    t = (imu.stamps_ns[first:last] - origin) / NANOSECONDS
    samples = samples[first:last]
    integral = np.vstack([np.zeros(6), np.cumsum(0.5 * np.diff(t)[:, None] * (samples[1:] + samples[:-1]), axis=0)])
    at = np.clip((edges - origin) / NANOSECONDS, t[0], t[-1])
    means = np.diff(integral_at(t, samples, integral, at), axis=0) / np.maximum(np.diff(at), 1e-9)[:, None]
    bins = np.flatnonzero(covered)
    nearest = bins[np.abs(np.arange(IMU_SAMPLES)[:, None] - bins).argmin(1)]
    return np.asarray(means[nearest])


def imu_coverage(imu: ImuSeries, source_ns: int, target_ns: int) -> float:
    """Share of the window's bins that were measured rather than filled, 0 to 1."""
    return float(covered_bins(imu.stamps_ns, window_edges(source_ns, target_ns)).mean())


def window_edges(source_ns: int, target_ns: int) -> FloatArray:
    """Edges (21,) in ns of the ten bins before the source and the ten from source to target."""
    half = IMU_SAMPLES // 2
    before = np.linspace(source_ns - BEFORE_NS, source_ns, half + 1)
    return np.concatenate([before, np.linspace(source_ns, target_ns, half + 1)[1:]])


def covered_bins(stamps_ns: IntArray, edges: FloatArray) -> NDArray[np.bool_]:
    """Whether each bin lies within the samples and clear of holes."""
    if len(stamps_ns) < 2:
        return np.zeros(len(edges) - 1, dtype=bool)
    hole_ns = HOLE_PERIODS * float(np.median(np.diff(stamps_ns)))
    after_start = np.searchsorted(stamps_ns, edges[:-1], side="right")
    before_end = np.searchsorted(stamps_ns, edges[1:], side="left")
    within = (after_start > 0) & (before_end < len(stamps_ns))
    gaps = np.diff(stamps_ns) > hole_ns
    holes_before = np.concatenate([[0], np.cumsum(gaps)])
    first = np.clip(after_start - 1, 0, len(stamps_ns) - 1)
    last = np.clip(before_end, 0, len(stamps_ns) - 1)
    return np.asarray(within & (holes_before[last] == holes_before[first]))


def integral_at(t: FloatArray, samples: FloatArray, integral: FloatArray, at: FloatArray) -> FloatArray:
    """The integral of the piecewise linear signal (t, samples) from t[0] up to each time in `at`."""
    k = np.clip(np.searchsorted(t, at, side="right") - 1, 0, len(t) - 2)
    dt = (at - t[k])[:, None]
    slope = (samples[k + 1] - samples[k]) / (t[k + 1] - t[k])[:, None]
    return np.asarray(integral[k] + samples[k] * dt + 0.5 * slope * dt**2)


def collate(
    pairs: Sequence[tuple[NetworkFrame, NetworkFrame]], windows: Sequence[FloatArray], device: str = "cpu"
) -> Batch:
    """Pairs of source and target frames with their IMU windows as one batch; sources must have depth."""
    depths = []
    for source, _ in pairs:
        if source.depth is None:
            raise ValueError(f"the source frame at {source.stamp_ns} ns has no depth")
        depths.append(source.depth)
    return Batch(
        source=to_unit(np.stack([source.image for source, _ in pairs])).to(device),
        target=to_unit(np.stack([target.image for _, target in pairs])).to(device),
        source_depth=torch.from_numpy(np.stack(depths)).to(device),
        K=torch.from_numpy(np.stack([source.K for source, _ in pairs])).float().to(device),
        imu=torch.from_numpy(np.stack(windows)).float().to(device),
        interval_s=torch.tensor(
            [(target.stamp_ns - source.stamp_ns) / NANOSECONDS for source, target in pairs], dtype=torch.float32
        ).to(device),
    )


def to_unit(images: NDArray[np.uint8]) -> torch.Tensor:
    """uint8 to float in [0, 1]."""
    return torch.from_numpy(images).float() / 255
