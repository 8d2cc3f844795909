"""A drive with the errors that a learned front end makes, and the faults that befall its sensors."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy.signal import bilinear, lfilter, lfilter_zi
from scipy.spatial.transform import RigidTransform

from fusion_io.front_end_noise import with_noise
from fusion_io.records import NANOSECONDS, FloatArray, ImuSeries, IntArray, PairEstimate, Trajectory
from fusion_io.simulation.motion import DriveStyle, ImuModel, Motion, drive, imu_stamps, simulate_imu, without

START_NS = 1_000 * NANOSECONDS
FRAME_PERIOD_NS = NANOSECONDS // 10
IMU_HZ = 100.0
IMU = ImuModel(time_offset_s=0.03, lever_arm=np.array([0.3, -0.2, -0.5]))


@dataclass(frozen=True)
class Log:
    """A drive: the truth, pairs between all frames, and an IMU in its own axes and on its own clock."""

    truth: Trajectory
    pairs: Sequence[PairEstimate]
    imu: ImuSeries


def simulated(seed: int, seconds: float, stand_still_s: float = 0.0) -> Log:
    """A winding drive of so many seconds, on which the car stands still for a while in its middle."""
    motion = drive(seed, -1.0, seconds + 1.0, DriveStyle(yaw_rate=0.25))
    if stand_still_s:
        motion = standing(motion, seconds / 2, stand_still_s)
        seconds += stand_still_s
    stamps = np.arange(round(10 * seconds), dtype=np.int64) * FRAME_PERIOD_NS
    truth = Trajectory(START_NS + stamps, motion.poses(stamps / NANOSECONDS)).relative_to_first()
    imu = simulate_imu(motion, imu_stamps(-0.5, seconds + 0.5, IMU_HZ), IMU_HZ, IMU, seed)
    return Log(truth, with_noise(exact_pairs(truth), seed), replace(imu, stamps_ns=START_NS + imu.stamps_ns))


def standing(motion: Motion, at_s: float, seconds: float, braking_s: float = 4.0) -> Motion:
    """The same way, at whose time `at_s` the car has come to a stand, stays for a while, and drives on."""
    times = np.arange(motion.start_s, motion.end_s + seconds, 0.05)
    # How fast the way goes by: smoothly from one to zero and back, so that braking takes twice as long as its way.
    inside = (times - at_s) / braking_s
    pace = np.clip(np.maximum(-inside, inside - seconds / braking_s), 0.0, 1.0)
    pace = pace**2 * (3.0 - 2.0 * pace)
    travelled = motion.start_s + np.concatenate([[0.0], np.cumsum((pace[1:] + pace[:-1]) / 2) * 0.05])
    known = travelled <= motion.end_s
    return Motion(times[known], motion.poses(travelled[known]))


def exact_pairs(truth: Trajectory) -> list[PairEstimate]:
    """The true motions."""
    motions = truth.poses[:-1].inv() * truth.poses[1:]
    quats_wxyz, translations = motions.rotation.as_quat(scalar_first=True), motions.translation
    return [
        PairEstimate(int(source), int(target), quats_wxyz[k], translations[k], np.eye(6))
        for k, (source, target) in enumerate(pairwise(truth.stamps_ns))
    ]


# ------------------------------------------------------------------------------------------ faults of an IMU


def gap(imu: ImuSeries, start_s: float, length_s: float) -> ImuSeries:
    """No samples for a while."""
    return without(imu, _during(imu, start_s, length_s))


def stuck_gyro(imu: ImuSeries, start_s: float, length_s: float = np.inf) -> ImuSeries:
    """The gyro shows one value for a while, or for ever; the accelerometer goes on."""
    held = _during(imu, start_s, length_s)
    rates = imu.angular_velocity.copy()
    rates[held] = rates[np.argmax(held)]
    return replace(imu, angular_velocity=rates)


def saturated_accelerometer(imu: ImuSeries, range_mps2: float) -> ImuSeries:
    """No axis shows more than the end of its range."""
    return replace(imu, linear_acceleration=np.clip(imu.linear_acceleration, -range_mps2, range_mps2))


def saturated_gyro(imu: ImuSeries, range_rps: float) -> ImuSeries:
    """No axis shows more than the end of its range."""
    return replace(imu, angular_velocity=np.clip(imu.angular_velocity, -range_rps, range_rps))


def gyro_bias_step(imu: ImuSeries, at_s: float, step: FloatArray) -> ImuSeries:
    """From some time on the gyro shows (3,) rad/s more."""
    return replace(imu, angular_velocity=imu.angular_velocity + _during(imu, at_s)[:, None] * step)


def accelerometer_bias_step(imu: ImuSeries, at_s: float, step: FloatArray) -> ImuSeries:
    """From some time on the accelerometer shows (3,) m/s^2 more."""
    return replace(imu, linear_acceleration=imu.linear_acceleration + _during(imu, at_s)[:, None] * step)


def swinging_accelerometer(imu: ImuSeries, by: FloatArray, period_s: float) -> ImuSeries:
    """The accelerometer shows (3,) m/s^2 more and less in turn: no bias does, nor one that steps."""
    seconds = (imu.stamps_ns - imu.stamps_ns[0]) / NANOSECONDS
    swing = np.sin(2 * np.pi * seconds / period_s)[:, None] * by
    return replace(imu, linear_acceleration=imu.linear_acceleration + swing)


def low_passed(imu: ImuSeries, low_pass_s: float) -> ImuSeries:
    """All that it shows has gone through a low-pass filter of first order."""
    numerator, denominator = bilinear([1.0], [low_pass_s, 1.0], IMU_HZ)
    settled = lfilter_zi(numerator, denominator)[:, None]

    def filtered(values: FloatArray) -> FloatArray:
        return np.asarray(lfilter(numerator, denominator, values, axis=0, zi=settled * values[:1])[0])

    return replace(
        imu, angular_velocity=filtered(imu.angular_velocity), linear_acceleration=filtered(imu.linear_acceleration)
    )


def clock_jump(imu: ImuSeries, at_s: float, by_s: float) -> ImuSeries:
    """From some time on the stamps are ahead by so much; those that repeat the past are left out, as a reader does."""
    stamps = imu.stamps_ns + np.where(_during(imu, at_s), round(by_s * NANOSECONDS), 0)
    backward = np.concatenate([[False], stamps[1:] <= np.maximum.accumulate(stamps)[:-1]])
    return without(replace(imu, stamps_ns=stamps), backward)


def _during(imu: ImuSeries, start_s: float, length_s: float = np.inf) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Samples (N,) in an interval; seconds since the first."""
    seconds = (imu.stamps_ns - imu.stamps_ns[0]) / NANOSECONDS
    return np.asarray((seconds >= start_s) & (seconds < start_s + length_s))


# ------------------------------------------------------------------------------------------ faults of the camera


def dropped_frames(pairs: Sequence[PairEstimate], at_s: float, count: int) -> list[PairEstimate]:
    """Frames are missing: one pair leads across them that is as good as those before (its motions are theirs)."""
    first = int(
        np.searchsorted([pair.source_stamp_ns for pair in pairs], pairs[0].source_stamp_ns + at_s * NANOSECONDS)
    )
    return [*pairs[:first], *pairs[first + count + 1 :]]


def wrong_pairs(pairs: Sequence[PairEstimate], share: float, seed: int) -> tuple[list[PairEstimate], IntArray]:
    """A share of the pairs shows any motion at all: turned by 10 deg an axis, moved by a metre; and which they are."""
    rng = np.random.default_rng(seed)
    chosen = np.sort(rng.choice(len(pairs), round(share * len(pairs)), replace=False))
    wrong = list(pairs)
    for k in chosen.tolist():
        by = RigidTransform.from_exp_coords(rng.standard_normal(6) * np.repeat([np.deg2rad(10.0), 1.0], 3))
        motion = pairs[k].T_source_target * by
        quat_wxyz = motion.rotation.as_quat(scalar_first=True)
        wrong[k] = replace(pairs[k], quat_wxyz=quat_wxyz, translation=motion.translation)
    return wrong, chosen
