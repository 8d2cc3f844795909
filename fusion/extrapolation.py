"""Where nothing measured the motion for so long that all poses after it rest on a guess.

Holes between pairs are bridged with the velocity of their neighbours, so that a trajectory is always whole
(`chain.bridge_gaps`). Over a few frames that is sound; over seconds it is an extrapolation, and says so.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from fusion.chain import ImuWindows
from fusion_io.records import NANOSECONDS, ImuSeries, IntArray, PairEstimate, Trajectory
from fusion_io.words import metres

LONG_S = 3.0
"""A hole as long as this is no matter of a few frames."""

UNMEASURED_S = 1.0
"""An IMU that the back ends could not use for longer than this did not measure the motion either."""


@dataclass(frozen=True, slots=True)
class Extrapolation:
    """A stretch of a trajectory without any pair.

    by_imu: the IMU measured it throughout. tie: what ties the poses after it to those before, "" where nothing does.
    at_end: no pair follows. sigma_m: stated at its end, root of the summed variances; None where nothing is stated.
    """

    start_ns: int
    end_ns: int
    by_imu: bool
    tie: str
    at_end: bool
    sigma_m: float | None

    @property
    def is_lost(self) -> bool:
        """Whether the absolute poses after it are worth nothing."""
        return not self.by_imu and not self.tie

    def line(self, zero_ns: int) -> str:
        """What it means, with times in seconds since a stamp."""
        start_s, end_s = ((stamp_ns - zero_ns) / NANOSECONDS for stamp_ns in (self.start_ns, self.end_ns))
        lost = f"the absolute pose is lost after {start_s:.1f} s: " if self.is_lost else ""
        measured = "nothing but the IMU" if self.by_imu else "nothing"
        basis = f"{end_s - start_s:.1f} s of {'the IMU alone' if self.by_imu else 'extrapolation'}"
        if self.tie:
            then = f"and {self.tie} ties the poses after it to those before"
        else:
            then = f"and {'the last poses rest' if self.at_end else 'all poses after it rest'} on {basis}"
        stated = "" if self.sigma_m is None else f" (stated sigma at {end_s:.1f} s: {metres(self.sigma_m)})"
        return f"{lost}{measured} measured the motion from {start_s:.1f} to {end_s:.1f} s, {then}{stated}"


def extrapolations(
    trajectory: Trajectory,
    pairs: Sequence[PairEstimate],
    imu: ImuSeries | None,
    loops: Sequence[PairEstimate],
    fixes_ns: IntArray,
) -> list[Extrapolation]:
    """The stretches of a trajectory of `LONG_S` or more that no pair spans, in order of time.

    imu: the one that was used, on the camera's clock. loops, fixes_ns (M,): the loops and the stamps of the GNSS
    positions that were believed.
    """
    sigmas = None
    if trajectory.covariances is not None:
        sigmas = np.sqrt(np.trace(trajectory.covariances[:, 3:, 3:], axis1=1, axis2=2))
    first_ns, last_ns = int(trajectory.stamps_ns[0]), int(trajectory.stamps_ns[-1])
    windows = None if imu is None else ImuWindows(imu)
    return [
        Extrapolation(
            start_ns,
            end_ns,
            windows is not None and _measured(windows, trajectory.stamps_ns, start_ns, end_ns),
            _tie(start_ns, end_ns, loops, fixes_ns),
            end_ns == last_ns,
            None if sigmas is None else float(np.interp(end_ns, trajectory.stamps_ns, sigmas)),
        )
        for start_ns, end_ns in _bare(pairs, first_ns, last_ns)
        if end_ns - start_ns >= LONG_S * NANOSECONDS
    ]


def _bare(pairs: Sequence[PairEstimate], first_ns: int, last_ns: int) -> Iterator[tuple[int, int]]:
    """The intervals from first to last that no pair spans."""
    reached_ns = first_ns
    for source_ns, target_ns in sorted((pair.source_stamp_ns, pair.target_stamp_ns) for pair in pairs):
        if source_ns > reached_ns:
            yield reached_ns, source_ns
        reached_ns = max(reached_ns, target_ns)
    if last_ns > reached_ns:
        yield reached_ns, last_ns


def _measured(windows: ImuWindows, stamps_ns: IntArray, start_ns: int, end_ns: int) -> bool:
    """Whether an IMU measured the steps between these ends, as the back ends take it: each from start to end."""
    inside = stamps_ns[(stamps_ns >= start_ns) & (stamps_ns <= end_ns)].tolist()
    unmeasured_ns = sum(end - start for start, end in pairwise(inside) if windows.over(start, end) is None)
    return bool(unmeasured_ns <= UNMEASURED_S * NANOSECONDS)


def _tie(start_ns: int, end_ns: int, loops: Sequence[PairEstimate], fixes_ns: IntArray) -> str:
    """What leads from before an interval to after it."""
    if any(loop.source_stamp_ns <= start_ns and loop.target_stamp_ns >= end_ns for loop in loops):
        return "a loop closure"
    return "GNSS" if np.any(fixes_ns <= start_ns) and np.any(fixes_ns >= end_ns) else ""
