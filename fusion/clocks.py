"""Where the clock of an IMU jumps against the camera's: told by how fast both turn, which needs no mounting."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import cumulative_trapezoid
from scipy.spatial.transform import Rotation

from fusion.sensors import MIN_SAMPLES
from fusion_io.records import NANOSECONDS, FloatArray, ImuSeries, PairEstimate

# They are compared window by window. Differences beyond so many standard
# deviations count the same, so that wrong pairs do not decide; the rest is relative to that.
WINDOW_S = 20.0
HOP_S = 5.0
SEARCH_S = 5.0
STEP_S = 0.04
FINE_STEP_S = 0.002
CLIP = 4.0  # standard deviations
GAIN = 0.15  # by which the best offset must be better than all that are further from it than...
ELSEWHERE_S = 0.5
MIN_JUMP_S = 0.25  # smaller ones are told better once the mounting is known
SIGNIFICANT = 4.0  # standard deviations, by which either side of a jump prefers its own offset
MIN_PAIRS = 20
NORMAL_QUARTILE = 0.3186  # a quarter of |N(0, 1)| is below; half of a log may have another offset than the other half


class Jump(NamedTuple):
    """From at_ns on, on the camera's clock, that of the IMU is ahead by after_s, and before by before_s."""

    at_ns: int
    before_s: float
    after_s: float

    @property
    def by_s(self) -> float:
        """How far the clock of the IMU jumped ahead."""
        return self.after_s - self.before_s


def jumps(imu: ImuSeries, pairs: Sequence[PairEstimate]) -> list[Jump]:
    """Where the offset that makes gyro and pairs agree best changes for good, in order of time."""
    if len(imu) < MIN_SAMPLES or len(pairs) < MIN_PAIRS:
        return []
    turning = _Turning(imu, pairs)
    changes = list(_changes(list(turning.windows())))
    if not changes:
        return []
    splits_s = [turning.split(change) for change in changes]
    coarse_s = [changes[0].before_s, *(change.after_s for change in changes)]
    parts_s = list(pairwise([-np.inf, *splits_s, np.inf]))
    offsets_s = [turning.refined(offset_s, *part) for offset_s, part in zip(coarse_s, parts_s, strict=True)]
    return [
        Jump(turning.zero_ns + round(splits_s[k] * NANOSECONDS), before_s, after_s)
        for k, (before_s, after_s) in enumerate(pairwise(offsets_s))
        if turning.prefers(before_s, after_s, *parts_s[k]) and turning.prefers(after_s, before_s, *parts_s[k + 1])
    ]


@dataclass(frozen=True, slots=True)
class _Window:
    """Between start_s and end_s the two agree best with this offset."""

    start_s: float
    end_s: float
    offset_s: float


@dataclass(frozen=True, slots=True)
class _Change:
    """Somewhere between start_s and end_s the offset changes."""

    start_s: float
    end_s: float
    before_s: float
    after_s: float


class _Turning:
    """How fast the pairs turn, and how far the gyro is from that at any offset of its clock; seconds."""

    def __init__(self, imu: ImuSeries, pairs: Sequence[PairEstimate]) -> None:
        self.zero_ns = pairs[0].source_stamp_ns
        stamps = np.array([(pair.source_stamp_ns, pair.target_stamp_ns) for pair in pairs], dtype=np.int64)
        self._source_s, self._target_s = ((stamps - self.zero_ns) / NANOSECONDS).T
        rotations = Rotation.from_quat(np.stack([pair.quat_wxyz for pair in pairs]), scalar_first=True)
        self._speed = rotations.magnitude() / (self._target_s - self._source_s)
        self._imu_s = (imu.stamps_ns - self.zero_ns) / NANOSECONDS
        self._angle = cumulative_trapezoid(np.linalg.norm(imu.angular_velocity, axis=1), self._imu_s, initial=0.0)
        self._offsets_s = np.arange(-SEARCH_S, SEARCH_S + STEP_S / 2, STEP_S)
        difference = self._difference(self._offsets_s)
        sigma = np.min(np.quantile(difference, 0.25, axis=1)) / NORMAL_QUARTILE
        self._clip = max(CLIP * float(sigma), float(np.finfo(float).eps))
        self._cost = self._clipped(difference)

    def windows(self) -> Iterator[_Window]:
        """The best offset of every window in which the motion tells it."""
        for start_s in np.arange(self._source_s[0], self._target_s[-1] - WINDOW_S + HOP_S, HOP_S):
            inside = self._inside(start_s, start_s + WINDOW_S)
            if inside.sum() < MIN_PAIRS:
                continue
            cost = self._cost[:, inside].mean(axis=1)
            best_s = self._offsets_s[np.argmin(cost)]
            elsewhere = np.abs(self._offsets_s - best_s) > ELSEWHERE_S
            if np.min(cost[elsewhere]) - np.min(cost) > GAIN:
                yield _Window(float(start_s), float(start_s) + WINDOW_S, float(best_s))

    def split(self, change: _Change) -> float:
        """When the offset changes, so that the gyro fits best with the one before it and the other after it."""
        inside = self._inside(change.start_s, change.end_s)
        before, after = (self._cost[np.argmin(np.abs(self._offsets_s - s))] for s in (change.before_s, change.after_s))
        gained = np.concatenate([[0.0], np.cumsum((before - after)[inside])])
        return float(np.append(self._source_s[inside], self._target_s[inside][-1:])[np.argmin(gained)])

    def _inside(self, start_s: float, end_s: float) -> NDArray[np.bool_]:
        return np.asarray((self._source_s >= start_s) & (self._target_s <= end_s))

    def refined(self, offset_s: float, start_s: float, end_s: float) -> float:
        """The best offset near one that is on the coarse grid, for the pairs between start and end."""
        offsets_s = offset_s + np.arange(-STEP_S, STEP_S + FINE_STEP_S / 2, FINE_STEP_S)
        cost = self._clipped(self._difference(offsets_s))[:, self._inside(start_s, end_s)].mean(axis=1)
        return float(offsets_s[np.argmin(cost)])

    def prefers(self, offset_s: float, other_s: float, start_s: float, end_s: float) -> bool:
        """Whether it cannot be chance that the pairs between start and end fit an offset better than another."""
        cost = self._clipped(self._difference(np.array([offset_s, other_s])))[:, self._inside(start_s, end_s)]
        gained = cost[1] - cost[0]
        return bool(gained.sum() > SIGNIFICANT * np.linalg.norm(gained))

    def _clipped(self, difference: FloatArray) -> FloatArray:
        """(offsets, pairs), 0 to 1."""
        return np.minimum(difference, self._clip) / self._clip

    def _difference(self, offsets_s: FloatArray) -> FloatArray:
        """Between the mean turning speeds of gyro and pairs at each offset: (offsets, pairs) rad/s."""
        start, end = (
            np.interp(at_s + offsets_s[:, None], self._imu_s, self._angle) for at_s in (self._source_s, self._target_s)
        )
        return np.asarray(np.abs((end - start) / (self._target_s - self._source_s) - self._speed))


def _changes(windows: Sequence[_Window]) -> Iterator[_Change]:
    """Where the offset of the windows changes and stays so."""
    settled: _Window | None = None
    for window, after in zip(windows, [*windows[1:], None], strict=False):
        if settled is None or abs(window.offset_s - settled.offset_s) < MIN_JUMP_S:
            settled = replace(window, offset_s=settled.offset_s if settled else window.offset_s)
        elif after and abs(after.offset_s - window.offset_s) < MIN_JUMP_S:
            yield _Change(settled.start_s, after.end_s, settled.offset_s, after.offset_s)
            settled = after
