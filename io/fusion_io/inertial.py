"""Cleaning inertial series: order, gaps, and two sensors with clocks of their own."""

from __future__ import annotations

import bisect

import numpy as np
from numpy.typing import NDArray

from fusion_io.records import FloatArray, IntArray

# A sample between two others that lie further apart than this many usual periods would be invented.
MAX_GAP_PERIODS = 5

# No sensor shows as much, in rad/s or m/s^2: it is garbage, and its square may not be finite.
LARGEST_READING = 1e6


def measurable(values: FloatArray) -> NDArray[np.bool_]:
    """Which rows of values (N, M) can have been measured: all of their numbers are finite and not absurdly large."""
    return np.asarray(np.all(np.abs(values) < LARGEST_READING, axis=1))


def longest_increasing(stamps: IntArray) -> IntArray:
    """Indices of a longest strictly increasing subsequence, in O(n log n).

    Patience sorting (Fredman 1975): ``tails[k]`` is the smallest stamp that ends an increasing run of length k + 1.
    """
    if np.all(np.diff(stamps) > 0):
        return np.arange(len(stamps))
    tails: list[int] = []
    tail_indices: list[int] = []
    before = np.full(len(stamps), -1)
    for i, stamp in enumerate(stamps.tolist()):
        k = bisect.bisect_left(tails, stamp)
        before[i] = tail_indices[k - 1] if k else -1
        tails[k : k + 1] = [stamp]
        tail_indices[k : k + 1] = [i]
    kept = np.empty(len(tails), dtype=np.int64)
    i = tail_indices[-1] if tail_indices else -1
    for k in range(len(tails) - 1, -1, -1):
        kept[k] = i
        i = before[i]
    return kept


def interpolate(stamps: IntArray, values: FloatArray, at: IntArray) -> tuple[FloatArray, NDArray[np.bool_]]:
    """Values (N, 3) at other times (M,), linear in time, and where that is supported by the samples around it.

    A time is supported within the span of the samples and outside of their holes.
    """
    if len(stamps) < 2:
        return np.zeros((len(at), 3)), np.zeros(len(at), dtype=np.bool_)
    right = np.clip(np.searchsorted(stamps, at), 1, len(stamps) - 1)
    left = right - 1
    gaps = stamps[right] - stamps[left]
    # Differences of integers: absolute nanoseconds have more digits than a float.
    weight = ((at - stamps[left]) / gaps)[:, None]
    supported = (at >= stamps[0]) & (at <= stamps[-1]) & (gaps <= MAX_GAP_PERIODS * np.median(np.diff(stamps)))
    return values[left] + weight * (values[right] - values[left]), supported
