"""Where nothing measured the motion for long, the poses after it are called lost, unless something ties them."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from report_samples import START_NS, pairs_of, simulate

from fusion.chain import bridge_gaps, chain
from fusion.extrapolation import Extrapolation, extrapolations
from fusion_io.records import NANOSECONDS, ImuSeries, IntArray, PairEstimate
from fusion_io.words import metres

TRUTH, IMU = simulate(40.0)
PAIRS = pairs_of(TRUTH)
NO_FIXES: IntArray = np.zeros(0, dtype=np.int64)


def without(start_s: float, end_s: float) -> list[PairEstimate]:
    """The pairs, less those that touch an interval."""
    start_ns, end_ns = (START_NS + round(second * NANOSECONDS) for second in (start_s, end_s))
    return [pair for pair in PAIRS if pair.target_stamp_ns <= start_ns or pair.source_stamp_ns >= end_ns]


def found(
    pairs: Sequence[PairEstimate],
    imu: ImuSeries | None = None,
    loops: Sequence[PairEstimate] = (),
    fixes_ns: IntArray = NO_FIXES,
) -> list[Extrapolation]:
    steps, _ = bridge_gaps(TRUTH.stamps_ns, pairs, None)
    return extrapolations(chain(steps), pairs, imu, loops, fixes_ns)


def test_a_whole_chain_and_a_hole_of_a_few_frames_are_no_extrapolation() -> None:
    assert found(PAIRS) == []
    assert found(without(10.0, 12.5)) == []


def test_a_long_hole_in_everything_loses_the_absolute_pose() -> None:
    """It says when, for how long, and how large the stated sigma has become."""
    pairs = without(10.0, 25.0)
    (hole,) = found(pairs)
    assert hole.is_lost
    assert ((hole.start_ns - START_NS) / NANOSECONDS, (hole.end_ns - START_NS) / NANOSECONDS) == (10.0, 25.0)
    steps, _ = bridge_gaps(TRUTH.stamps_ns, pairs, None)
    trajectory = chain(steps)
    assert trajectory.covariances is not None
    at_end = np.searchsorted(trajectory.stamps_ns, hole.end_ns)
    assert hole.sigma_m is not None
    assert hole.sigma_m == pytest.approx(np.sqrt(np.trace(trajectory.covariances[at_end, 3:, 3:])))
    assert hole.line(START_NS) == (
        "the absolute pose is lost after 10.0 s: nothing measured the motion from 10.0 to 25.0 s, and all poses after "
        f"it rest on 15.0 s of extrapolation (stated sigma at 25.0 s: {metres(hole.sigma_m)})"
    )


def test_what_an_imu_measured_is_known_by_it_and_a_silent_imu_is_none() -> None:
    pairs = without(10.0, 25.0)
    (hole,) = found(pairs, IMU)
    assert not hole.is_lost
    assert hole.line(START_NS).startswith(
        "nothing but the IMU measured the motion from 10.0 to 25.0 s, and all poses after it rest on 15.0 s of the IMU "
    )
    seconds = (IMU.stamps_ns - START_NS) / NANOSECONDS
    kept = (seconds < 12.0) | (seconds > 13.5)
    silent = ImuSeries(IMU.stamps_ns[kept], IMU.angular_velocity[kept], IMU.linear_acceleration[kept])
    assert found(pairs, silent)[0].is_lost


def test_a_hole_in_the_imu_spoils_the_whole_step_that_it_lies_in() -> None:
    """Where there are frames, a tenth of a second; where there are none, all from pair to pair."""
    pairs = without(10.0, 25.0)
    seconds = (IMU.stamps_ns - START_NS) / NANOSECONDS
    kept = (seconds < 12.0) | (seconds > 12.3)
    holed = ImuSeries(IMU.stamps_ns[kept], IMU.angular_velocity[kept], IMU.linear_acceleration[kept])
    assert found(pairs, holed)[0].by_imu
    ends = np.array([stamp for pair in pairs for stamp in (pair.source_stamp_ns, pair.target_stamp_ns)])
    steps, _ = bridge_gaps(np.unique(ends), pairs, None)
    assert extrapolations(chain(steps), pairs, IMU, (), NO_FIXES)[0].by_imu
    assert extrapolations(chain(steps), pairs, holed, (), NO_FIXES)[0].is_lost


def test_a_loop_or_positions_on_both_sides_tie_what_follows() -> None:
    pairs = without(10.0, 25.0)
    first, last = PAIRS[0].source_stamp_ns, PAIRS[-1].target_stamp_ns
    across = replace(PAIRS[0], target_stamp_ns=last)
    assert "a loop closure ties the poses after it to those before" in found(pairs, loops=[across])[0].line(START_NS)
    assert not found(pairs, loops=[across])[0].is_lost
    assert found(pairs, loops=[replace(across, target_stamp_ns=first + 5 * NANOSECONDS)])[0].is_lost
    assert not found(pairs, fixes_ns=np.array([first, last]))[0].is_lost
    assert found(pairs, fixes_ns=np.array([last]))[0].is_lost


def test_holes_at_the_ends_of_the_trajectory_count_too() -> None:
    before, after = found(without(0.0, 5.0)), found(without(30.0, 40.0))
    assert [(each.start_ns - START_NS) / NANOSECONDS for each in before] == [0.0]
    assert after[0].at_end
    assert "from 30.0 to 39.9 s, and the last poses rest on 9.9 s of extrapolation" in after[0].line(START_NS)
