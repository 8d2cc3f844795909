"""What the sensors of a log look like in numbers: times, light, depth, noise. Nothing is judged here."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from fusion import allan
from fusion_io.container import Channel
from fusion_io.records import NANOSECONDS, FloatArray, IntArray, Trajectory
from fusion_io.survey import ImuReadings, Times

# Messages that are further apart than so many of their median periods have a gap between them.
GAP_PERIODS = 2.5

DARK, BRIGHT = 2, 253  # grey values of 255: so close to the ends of the range, light is not told apart

# A place is met again where the path comes as near as this, after so long a way.
REVISIT_M = 5.0
REVISIT_PATH_M = 50.0
REVISIT_STEP_M = 1.0  # of the way: who stands still is not compared with himself


@dataclass(frozen=True, slots=True)
class TopicStatistics:
    """The times of a topic, by its stamps or else by those of the recorder (`clock`: "stamp" or "recorder").

    rate_hz: of the median period. jitter_ms: robust standard deviation of the periods. gaps: periods longer than
    `GAP_PERIODS` medians. backward, repeated: stamps before or equal to the one recorded before. clock_offset_s:
    median time from stamp to recording, and its range from the 5th to the 95th percentile.
    """

    topic: str
    type: str
    encoding: str
    kind: str
    messages: int
    clock: str
    start_ns: int
    end_ns: int
    rate_hz: float | None
    jitter_ms: float | None
    gaps: int
    longest_gap_s: float | None
    longest_gap_at_ns: int | None
    backward: int
    repeated: int
    clock_offset_s: float | None
    clock_offset_range_s: float | None


def of_topic(channel: Channel, kind: str, times: Times) -> TopicStatistics:
    """Statistics of a topic's times; what needs more messages than there are is None."""
    recorded = times.log_times_ns if times.stamps_ns is None else times.stamps_ns[times.stamps_ns != 0]
    steps, ordered = np.diff(recorded), np.sort(recorded)
    periods = np.diff(ordered)
    positive = periods[periods > 0]
    usual_ns = float(np.median(positive)) if len(positive) else None
    longest = int(np.argmax(periods)) if len(positive) else None
    offsets = None
    if times.stamps_ns is not None:
        offsets = (times.log_times_ns - times.stamps_ns)[times.stamps_ns != 0] / NANOSECONDS
    return TopicStatistics(
        topic=channel.topic,
        type=channel.message_type,
        encoding=channel.message_encoding,
        kind=kind,
        messages=len(times.log_times_ns),
        clock="recorder" if times.stamps_ns is None else "stamp",
        start_ns=int(ordered[0]),
        end_ns=int(ordered[-1]),
        rate_hz=NANOSECONDS / usual_ns if usual_ns else None,
        jitter_ms=allan.MAD_TO_STD * float(np.median(np.abs(positive - usual_ns))) / 1e6 if usual_ns else None,
        gaps=int(np.sum(positive > GAP_PERIODS * usual_ns)) if usual_ns else 0,
        longest_gap_s=None if longest is None else float(periods[longest]) / NANOSECONDS,
        longest_gap_at_ns=None if longest is None else int(ordered[longest]),
        backward=int(np.sum(steps < 0)),
        repeated=int(np.sum(steps == 0)),
        clock_offset_s=None if offsets is None else float(np.median(offsets)),
        clock_offset_range_s=None if offsets is None else float(np.ptp(np.percentile(offsets, [5, 95]))),
    )


@dataclass(frozen=True, slots=True)
class ImageStatistics:
    """The light in N sampled images, in grey values of 0 to 255.

    stamps_ns (N,); brightness, contrast (N,): mean and standard deviation; dark_share, bright_share (N,): of pixels at
    the ends of the range; sharpness (N,): variance of the Laplacian (Pech-Pacheco et al. 2000); repeated (N,): the
    image is the sampled one before, to the bit.
    """

    width: int
    height: int
    channels: int
    stamps_ns: IntArray
    brightness: FloatArray
    contrast: FloatArray
    dark_share: FloatArray
    bright_share: FloatArray
    sharpness: FloatArray
    repeated: NDArray[np.bool_]


def of_images(images: Iterable[tuple[int, NDArray[np.uint8]]]) -> ImageStatistics | None:
    """Statistics of images with their stamps; None without any."""
    stamps, rows, repeated = [], [], []
    previous, shape = None, (0, 0, 1)
    for stamp_ns, image in images:
        grey = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
        sharpness = float(cv2.Laplacian(grey, cv2.CV_64F).var())
        rows.append([grey.mean(), grey.std(), np.mean(grey <= DARK), np.mean(grey >= BRIGHT), sharpness])
        stamps.append(stamp_ns)
        repeated.append(previous is not None and np.array_equal(image, previous))
        previous, shape = image, (*image.shape, 1)[:3]
    if not stamps:
        return None
    brightness, contrast, dark, bright, sharpness_of = np.array(rows).T
    times = np.array(stamps, dtype=np.int64)
    return ImageStatistics(
        shape[1], shape[0], shape[2], times, brightness, contrast, dark, bright, sharpness_of, np.array(repeated)
    )


@dataclass(frozen=True, slots=True)
class DepthStatistics:
    """N sampled depth images: stamps_ns and coverage, the share of pixels that have depth, (N,).

    near_m, median_m, far_m: percentiles 5, 50 and 95 of all depth that was sampled, None where there is none.
    """

    width: int
    height: int
    stamps_ns: IntArray
    coverage: FloatArray
    near_m: float | None
    median_m: float | None
    far_m: float | None


def of_depths(depths: Iterable[tuple[int, NDArray[np.float32]]]) -> DepthStatistics | None:
    """Statistics of depth images with their stamps; None without any."""
    stamps, coverage, percentiles = [], [], []
    shape: tuple[int, ...] = (0, 0)
    for stamp_ns, depth in depths:
        valid = depth[depth > 0]
        stamps.append(stamp_ns)
        coverage.append(valid.size / depth.size)
        shape = depth.shape
        if valid.size:
            percentiles.append(np.percentile(valid, [5, 50, 95]))
    if not stamps:
        return None
    near, median, far = np.median(percentiles, axis=0).tolist() if percentiles else (None, None, None)
    return DepthStatistics(shape[1], shape[0], np.array(stamps, dtype=np.int64), np.array(coverage), near, median, far)


@dataclass(frozen=True, slots=True)
class ImuStatistics:
    """An IMU's samples: noise of its halves, None for one that it does not have; SI units.

    largest_rate, largest_acceleration: the largest norm. gravity: the median norm of the acceleration. *_std: what the
    messages state of a sample, None where they do not.
    """

    samples: int
    still_s: float
    gyro: allan.NoiseEstimate | None
    accelerometer: allan.NoiseEstimate | None
    largest_rate: float | None
    largest_acceleration: float | None
    gravity: float | None
    angular_velocity_std: float | None
    linear_acceleration_std: float | None


def of_imu(readings: ImuReadings, still_ns: IntArray) -> ImuStatistics:
    """Statistics of an IMU that stands still in the intervals (M, 2)."""
    stamps = readings.stamps_ns
    rate = None if readings.angular_velocity is None else np.linalg.norm(readings.angular_velocity, axis=1)
    pull = None if readings.linear_acceleration is None else np.linalg.norm(readings.linear_acceleration, axis=1)
    return ImuStatistics(
        samples=len(stamps),
        still_s=float(np.sum(still_ns[:, 1] - still_ns[:, 0])) / NANOSECONDS,
        gyro=None if readings.angular_velocity is None else allan.noise(stamps, readings.angular_velocity, still_ns),
        accelerometer=None
        if readings.linear_acceleration is None
        else allan.noise(stamps, readings.linear_acceleration, still_ns),
        largest_rate=float(rate.max()) if rate is not None and len(rate) else None,
        largest_acceleration=float(pull.max()) if pull is not None and len(pull) else None,
        gravity=float(np.median(pull)) if pull is not None and len(pull) else None,
        angular_velocity_std=readings.angular_velocity_std,
        linear_acceleration_std=readings.linear_acceleration_std,
    )


@dataclass(frozen=True, slots=True)
class Revisits:
    """Where a path comes back to: candidates for loop closures by position alone.

    frames: poses within `REVISIT_M` of one that is at least `REVISIT_PATH_M` of way before. stretches: their runs.
    """

    source: str
    frames: int
    stretches: int
    first_ns: int | None


def revisits(trajectory: Trajectory, source: str) -> Revisits:
    """The revisits of a trajectory; `source` says which it is."""
    positions = trajectory.poses.translation
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    way = np.concatenate([[0.0], np.cumsum(steps)])
    _, first, step_of = np.unique(way // REVISIT_STEP_M, return_index=True, return_inverse=True)
    near = KDTree(positions[first]).query_pairs(REVISIT_M, output_type="ndarray")
    earlier, later = np.sort(near, axis=1).T
    seen = np.zeros(len(first), dtype=bool)
    seen[later[way[first[later]] - way[first[earlier]] > REVISIT_PATH_M]] = True
    again = seen[step_of]
    starts = np.flatnonzero(np.diff(again.astype(int), prepend=0) == 1)
    first_ns = int(trajectory.stamps_ns[starts[0]]) if len(starts) else None
    return Revisits(source, int(again.sum()), len(starts), first_ns)
