"""Whether a difference between two trajectories is larger than the noise.

Both are judged on the same segments, so that what is hard for both cancels (a paired comparison). Segments overlap, and
errors of odometry are correlated in time: neighbouring differences are not independent. The variance of their mean is
therefore that of the means of all blocks that are as long as the correlation reaches, moved along the path: what a
moving block bootstrap (Kuensch, "The jackknife and the bootstrap for general stationary observations", 1989) gives
after infinitely many resamples, in closed form and without a seed. It is called the method of overlapping batch means
(Meketon and Schmeiser, "Overlapping batch means: something for nothing?", 1984), from whom the degrees of freedom of
Student's t come too: on a short path few blocks are independent, and the interval says so.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.stats import t as student_t

from fusion.evaluation import CONFIDENCE, SegmentErrors
from fusion_io.records import FloatArray

SEEN = 2 / 3
"""The share of the variance of a mean that blocks as long as a segment see, where segments overlap evenly.

Their correlation falls linearly to zero over their length, the integral of 1 - x is 1/2; means of such blocks weigh it
by 1 - x once more, which makes it 1/3.
"""

MIN_BLOCKS = 2.0
"""A series shorter than so many blocks has no interval."""

ROUNDING = 1e-6
"""Differences below it, in percent or degrees per 100 m, are those of rounding."""


class Difference(NamedTuple):
    """A mean difference (b less a) and its confidence interval; low and high are None where the series is too short."""

    mean: float
    low: float | None
    high: float | None

    @property
    def significant(self) -> bool | None:
        """Whether the interval leaves out zero; None where there is no interval."""
        if self.low is None or self.high is None:
            return None
        return abs(self.mean) > ROUNDING and not self.low <= 0.0 <= self.high

    @property
    def verdict(self) -> str:
        """What it says of b where less is better: "better", "worse", "not significant" or "path too short to tell"."""
        match self.significant:
            case None:
                return "path too short to tell"
            case False:
                return "not significant"
        return "better" if self.mean < 0.0 else "worse"


def paired_difference(a: SegmentErrors, b: SegmentErrors, measure: str) -> Difference | None:
    """The mean over all segments of b's errors less a's, in `measure` ("translation_percent", ...); None without any.

    Both must be of the same segments. A block is as long as the segments that a place of the path lies in, on average
    over the path (a long segment holds many places).
    """
    if not len(a.start):
        return None
    differences = np.asarray(getattr(b, measure) - getattr(a, measure), dtype=np.float64)
    starts, of_start = np.unique(a.start, return_inverse=True)
    counts = np.bincount(of_start).astype(np.float64)
    sums = np.bincount(of_start, differences).astype(np.float64)
    reach = np.searchsorted(starts, a.end) - of_start  # starts that lie inside of each segment, at least its own
    return mean_difference(sums, counts, int(np.ceil(np.sum(reach**2) / np.sum(reach))))


def mean_difference(sums: FloatArray, counts: FloatArray, block: int) -> Difference:
    """The ratio of the totals of sums (N,) and counts (N,), in order of time, with its interval.

    block: over how many entries they are correlated. The ratio is linearised about its value.
    """
    mean = float(sums.sum() / counts.sum())
    size = len(sums)
    if size < MIN_BLOCKS * block:
        return Difference(mean, None, None)
    influence = (sums - mean * counts) / counts.mean()
    block_means = np.convolve(influence, np.ones(block), "valid") / block
    variance = block / (size - block) * float(np.mean(block_means**2)) / SEEN  # the mean of all influences is zero
    freedom = 1.5 * (size / block - 1.0)
    half = float(student_t.isf((1.0 - CONFIDENCE) / 2, freedom)) * np.sqrt(variance)
    return Difference(mean, mean - half, mean + half)
