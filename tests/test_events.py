"""Each kind of sensor fault is found where it is, by its name; a sound log has none."""

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from report_samples import PERIOD_NS, START_NS, pairs_of, simulate
from scipy.spatial.transform import RigidTransform

from fusion import analysis_page, events, report
from fusion.chain import chain
from fusion.events import Event
from fusion.imu import BiasStep, calibrate
from fusion_io.records import NANOSECONDS, ImuSeries, PairEstimate, Trajectory

SECONDS = 90.0
NOTHING = ImuSeries(np.zeros(0, dtype=np.int64), np.zeros((0, 3)), np.zeros((0, 3)))


@pytest.fixture(scope="module")
def drive() -> tuple[Trajectory, ImuSeries, list[PairEstimate]]:
    """A minute and a half of a winding drive."""
    truth, imu = simulate(SECONDS)
    return truth, imu, pairs_of(truth)


@pytest.fixture
def truth(drive: tuple[Trajectory, ImuSeries, list[PairEstimate]]) -> Trajectory:
    return drive[0]


@pytest.fixture
def imu(drive: tuple[Trajectory, ImuSeries, list[PairEstimate]]) -> ImuSeries:
    return drive[1]


@pytest.fixture
def pairs(drive: tuple[Trajectory, ImuSeries, list[PairEstimate]]) -> list[PairEstimate]:
    return drive[2]


def _spans(found: Sequence[Event]) -> list[tuple[float, float]]:
    """Start and end in seconds since the first frame."""
    return [((event.start_ns - START_NS) / NANOSECONDS, (event.end_ns - START_NS) / NANOSECONDS) for event in found]


def _at(imu: ImuSeries) -> np.ndarray:
    return (imu.stamps_ns - START_NS) / NANOSECONDS


def _moved(pair: PairEstimate, twist: Sequence[float]) -> PairEstimate:
    motion = pair.T_source_target * RigidTransform.from_exp_coords(np.array(twist))
    return replace(pair, quat_wxyz=motion.rotation.as_quat(scalar_first=True), translation=motion.translation)


def test_a_sound_drive_has_no_events(truth: Trajectory, imu: ImuSeries, pairs: list[PairEstimate]) -> None:
    assert events.of_imu(imu, "/imu") == []
    assert events.clock_jumps(imu, pairs, "/imu") == []
    assert events.dropped_frames(truth.stamps_ns, "/camera") == []
    assert events.missing_pairs(truth.stamps_ns, pairs, "/pairs") == []
    assert events.wrong_pairs(pairs, "/pairs", truth) == []
    assert events.standing(truth, "/camera") == []


def test_an_imu_gap_is_as_long_as_its_missing_samples(imu: ImuSeries) -> None:
    at = _at(imu)
    kept = (at < 30.0) | (at >= 35.0)
    gaps = events.imu_gaps(imu.stamps_ns[kept], "/imu")
    assert _spans(gaps) == [(29.99, 35.0)]
    assert (gaps[0].kind, gaps[0].topic) == (events.IMU_GAP, "/imu")
    assert "500 missing" in gaps[0].text
    assert gaps[0].is_fault


@pytest.mark.parametrize("how", ["repeats one value", "equal steps"])
def test_a_stuck_gyro_is_found_while_the_accelerometer_lives(imu: ImuSeries, how: str) -> None:
    rates = imu.angular_velocity.copy()
    end = rates[1999] if how == "repeats one value" else rates[1999] + 0.1
    rates[1000:2000] = np.linspace(rates[1999] if how == "repeats one value" else rates[999], end, 1000)
    found = events.of_imu(replace(imu, angular_velocity=rates), "/imu")
    assert [event.kind for event in found] == [events.STUCK]
    assert how in found[0].text
    assert "gyro" in found[0].text
    assert_allclose(_spans(found), [(10.0, 20.0)], atol=0.03)


def test_a_clipped_axis_is_saturated_and_not_stuck(imu: ImuSeries) -> None:
    rates = imu.angular_velocity.copy()
    rates[4000:4100, 2] += 3.0
    found = events.of_imu(replace(imu, angular_velocity=np.clip(rates, -2.0, 2.0)), "/imu")
    assert {event.kind for event in found} == {events.SATURATED}
    assert_allclose(_spans(found)[0], (40.0, 41.0), atol=0.03)
    assert "z axis stays at 2" in found[0].text


def test_an_imu_at_rest_is_a_stand_still_and_no_fault(imu: ImuSeries) -> None:
    rng = np.random.default_rng(0)
    still = (_at(imu) >= 50.0) & (_at(imu) < 60.0)
    rates, accelerations = imu.angular_velocity.copy(), imu.linear_acceleration.copy()
    rates[still] = rng.normal(size=(still.sum(), 3)) * 1e-3
    accelerations[still] = rng.normal(size=(still.sum(), 3)) * 0.02 + [0.0, 0.0, 9.81]
    found = events.of_imu(replace(imu, angular_velocity=rates, linear_acceleration=accelerations), "/imu")
    assert [event.kind for event in found] == [events.STAND_STILL]
    assert not found[0].is_fault
    assert_allclose(_spans(found), [(50.0, 60.0)], atol=1.0)


def test_a_trajectory_that_stays_is_a_stand_still(truth: Trajectory) -> None:
    positions = truth.poses.translation.copy()
    positions[300:400] = positions[300]
    stopped = Trajectory(truth.stamps_ns, RigidTransform.from_components(positions, truth.poses.rotation))
    found = events.standing(stopped, "/camera")
    assert [event.kind for event in found] == [events.STAND_STILL]
    assert_allclose(_spans(found), [(30.0, 39.9)], atol=0.2)


@pytest.mark.parametrize("jump_s", [0.5, -0.4, 3.0])
def test_a_clock_jump_is_found_with_its_size_and_sign(imu: ImuSeries, pairs: list[PairEstimate], jump_s: float) -> None:
    late = _at(imu) >= 45.0
    stamps = imu.stamps_ns + np.where(late, round(jump_s * NANOSECONDS), 0)
    kept = ~late | (stamps > stamps[~late][-1])  # as the reader leaves out what goes back in time
    jumped = ImuSeries(stamps[kept], imu.angular_velocity[kept], imu.linear_acceleration[kept])
    found = events.clock_jumps(jumped, pairs, "/imu")
    assert [event.kind for event in found] == [events.CLOCK_JUMP]
    assert_allclose(_spans(found)[0][0], 45.0, atol=1.0)
    assert_allclose(float(found[0].text.split(" by ")[1].split(" s ")[0]), jump_s, atol=0.05)


def test_of_clock_jumps_the_calibration_knows_best(imu: ImuSeries, pairs: list[PairEstimate]) -> None:
    """It finds such as are too small to be seen without the mounting."""
    stamps = imu.stamps_ns + np.where(_at(imu) >= 45.0, NANOSECONDS // 20, 0)
    jumped = replace(imu, stamps_ns=stamps)
    assert not events.clock_jumps(jumped, pairs, "/imu")
    (found,) = events.clock_jumps(jumped, pairs, "/imu", calibrate(pairs, jumped, None, None))
    assert_allclose(_spans([found])[0][0], 45.0, atol=2.0)
    assert "jumps by +0.05 s" in found.text


def test_a_gap_alone_is_no_clock_jump(imu: ImuSeries, pairs: list[PairEstimate]) -> None:
    kept = (_at(imu) < 40.0) | (_at(imu) >= 43.0)
    gappy = ImuSeries(imu.stamps_ns[kept], imu.angular_velocity[kept], imu.linear_acceleration[kept])
    assert events.clock_jumps(gappy, pairs, "/imu") == []


def test_dropped_frames_are_counted(truth: Trajectory) -> None:
    stamps = np.delete(truth.stamps_ns, [100, 101, 102, 500])
    found = events.dropped_frames(stamps, "/camera")
    assert [event.text for event in found] == ["3 frames missing", "1 frame missing"]
    assert_allclose(_spans(found), [(9.9, 10.3), (49.9, 50.1)])


def test_frames_without_a_pair_are_one_event_for_each_hole(truth: Trajectory, pairs: list[PairEstimate]) -> None:
    found = events.missing_pairs(truth.stamps_ns, [*pairs[:100], *pairs[103:]], "/pairs")
    assert_allclose(_spans(found), [(10.0, 10.3)])
    assert "3 of the intervals" in found[0].text
    spanning = replace(pairs[100], target_stamp_ns=pairs[102].target_stamp_ns)
    assert events.missing_pairs(truth.stamps_ns, [*pairs[:100], spanning, *pairs[103:]], "/pairs") == []


def test_where_there_are_no_frames_the_pairs_tell_which_are_missing(pairs: list[PairEstimate]) -> None:
    """As in a log that holds pair estimates and no images."""
    found = events.missing_pairs(np.zeros(0, dtype=np.int64), [*pairs[:100], *pairs[103:]], "/pairs")
    assert [(event.kind, event.text) for event in found] == [(events.DROPPED_FRAMES, "2 frames missing")]
    assert_allclose(_spans(found), [(10.0, 10.3)])


def test_wrong_pairs_are_seen_by_their_neighbours(pairs: list[PairEstimate]) -> None:
    damaged = list(pairs)
    for i in (100, 101, 400):
        damaged[i] = _moved(pairs[i], [0.0, 0.2, 0.0, 0.0, 0.0, 3.0])
    found = events.wrong_pairs(damaged, "/pairs")
    assert [event.kind for event in found] == [events.WRONG_PAIR] * 2
    assert_allclose(_spans(found), [(10.0, 10.2), (40.0, 40.1)])
    assert found[0].text == "2 pairs: unlike its neighbours"


def test_a_fused_trajectory_sees_what_neighbours_cannot(truth: Trajectory, pairs: list[PairEstimate]) -> None:
    """Half a metre in a tenth of a second is within what a vehicle may do, but not within the pair's covariance."""
    damaged = [*pairs[:300], _moved(pairs[300], [0.0, 0.0, 0.0, 0.0, 0.0, 0.3]), *pairs[301:]]
    assert events.wrong_pairs(damaged, "/pairs") == []
    found = events.wrong_pairs(damaged, "/pairs", truth)
    assert [event.text for event in found] == ["1 pair: far from the fused motion"]
    assert_allclose(_spans(found), [(30.0, 30.1)])


def test_pairs_and_fused_motion_that_differ_for_long_contradict_each_other(
    truth: Trajectory, pairs: list[PairEstimate]
) -> None:
    damaged = [
        _moved(pair, [0.0, 0.02, 0.0, 0.0, 0.0, 0.3]) if 300 <= i < 400 else pair for i, pair in enumerate(pairs)
    ]
    found = events.wrong_pairs(damaged, "/pairs", truth)
    assert [event.kind for event in found if event.duration_s > 1.0] == [events.CONTRADICTION]
    assert_allclose(_spans([event for event in found if event.duration_s > 1.0]), [(30.0, 40.0)], atol=1.0)


def test_a_rejected_pair_is_named(pairs: list[PairEstimate]) -> None:
    rejected = np.zeros(len(pairs), dtype=bool)
    rejected[7] = True
    found = events.wrong_pairs(pairs, "/pairs", rejected=rejected)
    assert [event.text for event in found] == ["1 pair: rejected by the back end"]
    assert found[0].start_ns == pairs[7].source_stamp_ns


def test_contradictions_are_on_the_cameras_clock_and_say_nothing_of_what_is_stuck() -> None:
    faulty = np.array([[START_NS, START_NS + NANOSECONDS], [START_NS + 9 * NANOSECONDS, START_NS + 10 * NANOSECONDS]])
    stuck = [Event(START_NS + 9 * NANOSECONDS, START_NS + 10 * NANOSECONDS, events.STUCK, "/imu", "")]
    found = events.contradictions(faulty, 0.25, stuck, "/imu")
    assert_allclose(_spans(found), [(-0.25, 0.75)])


def test_deviations_are_chi_square_where_the_covariance_is_right(truth: Trajectory, pairs: list[PairEstimate]) -> None:
    squares = events.deviations(pairs, truth)
    assert_allclose(np.mean(squares), 6.0, atol=0.5)
    assert np.isnan(events.deviations(pairs, Trajectory(truth.stamps_ns[:10], truth.poses[:10]))[-1])


def test_next_to_nothing_is_no_reason_to_fail(truth: Trajectory) -> None:
    one = ImuSeries(np.array([START_NS]), np.zeros((1, 3)), np.zeros((1, 3)))
    for imu in (NOTHING, one):
        assert events.of_imu(imu, "/imu") == []
        assert events.clock_jumps(imu, [], "/imu") == []
    for stamps in (truth.stamps_ns[:0], truth.stamps_ns[:1]):
        assert events.dropped_frames(stamps, "/camera") == []
        assert events.missing_pairs(stamps, [], "/pairs") == []
    assert events.wrong_pairs([], "/pairs") == []


def test_chained_pairs_are_their_own_fused_motion(pairs: list[PairEstimate]) -> None:
    assert_allclose(events.deviations(pairs, chain(pairs)), 0.0, atol=1e-12)
    assert pairs[0].target_stamp_ns - pairs[0].source_stamp_ns == PERIOD_NS


def test_steps_of_a_bias_are_events_of_a_second_and_wandering_one_of_all() -> None:
    """Those that are known are named one by one."""
    std = np.full(6, 0.1)
    known = [BiasStep(START_NS + k * NANOSECONDS, np.array([0.0, 0.0, 0.6, 0.0, 0.0, 0.0]), std) for k in (10, 20)]
    unknown = [BiasStep(START_NS + k * NANOSECONDS, np.zeros(6), std) for k in range(1, 30)]
    found = events.bias_steps([*known, *unknown], "/imu")
    assert [event.kind for event in found] == [events.BIAS_STEP, events.BIAS_STEP, events.BIAS_WANDERS]
    assert [event.duration_s for event in found] == [1.0, 1.0, 28.0]
    assert [event.end_ns for event in found[:2]] == [step.at_ns for step in known]
    assert "0.6 m/s^2" in found[0].text
    assert all(event.is_fault for event in found)
    assert not events.bias_steps([], "/imu")


def test_every_kind_of_event_has_a_colour_in_both_pages() -> None:
    """Without one it is not shaded in the report."""
    kinds = [*events.FAULTS, events.STAND_STILL]
    assert set(analysis_page.EVENT_COLOURS) == set(kinds)
    css = (Path(report.__file__).parent / "report.css").read_text()
    for kind in kinds:
        assert re.search(rf"--{kind.lower().replace(' ', '-')}: #\w{{6}};", css), kind
