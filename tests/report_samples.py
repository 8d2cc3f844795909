"""Runs to be reported: a simulated drive with pairs, IMU, two back ends and their series, made in a second."""

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from fusion.chain import chain, motions_of
from fusion.evaluation import evaluate
from fusion.imu import ImuCalibration
from fusion.report import ReportContent, Thumbnail
from fusion_io.records import NANOSECONDS, EstimatorSeries, ImuSeries, PairEstimate, Trajectory
from fusion_io.simulation.motion import DriveStyle, ImuModel, drive, simulate_imu

START_NS = 1_000 * NANOSECONDS
PERIOD_NS = NANOSECONDS // 10
PAIR_SIGMA = np.array([1e-3, 1e-3, 1e-3, 0.03, 0.03, 0.03])
LENGTHS_M = (20.0, 50.0, 100.0)
TOPICS = {
    "image": "/camera/image",
    "imu": "/imu",
    "pairs": "/violearner/pairs",
    "ground_truth": "/ground_truth",
}


def simulate(seconds: float = 60.0, seed: int = 0) -> tuple[Trajectory, ImuSeries]:
    """The true trajectory at 10 Hz and the IMU at 100 Hz of a winding drive."""
    start_s = START_NS / NANOSECONDS
    motion = drive(seed, start_s, start_s + seconds, DriveStyle(yaw_rate=0.3))
    stamps_ns = START_NS + np.arange(round(10 * seconds), dtype=np.int64) * PERIOD_NS
    imu_stamps_ns = START_NS + np.arange(round(100 * seconds), dtype=np.int64) * (NANOSECONDS // 100)
    truth = Trajectory(stamps_ns, motion.poses(stamps_ns / NANOSECONDS)).relative_to_first()
    return truth, simulate_imu(motion, imu_stamps_ns, 100.0, ImuModel(), seed)


def pairs_of(truth: Trajectory, seed: int = 0, hypotheses: int = 4) -> list[PairEstimate]:
    """The true motions with noise of PAIR_SIGMA; hypotheses about them with three times that."""
    rng = np.random.default_rng(seed)
    motions = truth.poses[:-1].inv() * truth.poses[1:]
    noisy = motions * RigidTransform.from_exp_coords(rng.normal(size=(len(motions), 6)) * PAIR_SIGMA)
    pairs = []
    for source, target, motion in zip(truth.stamps_ns[:-1], truth.stamps_ns[1:], noisy, strict=True):
        guesses = motion * RigidTransform.from_exp_coords(3.0 * rng.normal(size=(max(hypotheses, 1), 6)) * PAIR_SIGMA)
        pairs.append(
            PairEstimate(
                int(source),
                int(target),
                motion.rotation.as_quat(scalar_first=True),
                motion.translation,
                np.diag(PAIR_SIGMA**2),
                winner=0 if hypotheses else -1,
                hypotheses_quat_wxyz=guesses.rotation.as_quat(scalar_first=True)[:hypotheses],
                hypotheses_translation=guesses.translation[:hypotheses],
                errors=rng.uniform(0.1, 0.2, hypotheses),
            )
        )
    return pairs


def series_of(stamps_ns: np.ndarray, seed: int = 0) -> EstimatorSeries:
    """What a back end estimates: chi square NIS, small biases, two rejected pairs."""
    rng = np.random.default_rng(seed)
    count = len(stamps_ns)
    three = rng.normal(size=(count, 3))
    used = np.ones(count, dtype=bool)
    used[[20, 40]] = False
    return EstimatorSeries(
        stamps_ns,
        gyro_bias=1e-3 * three,
        gyro_bias_std=np.full((count, 3), 1e-3),
        accelerometer_bias=0.1 * three,
        accelerometer_bias_std=np.full((count, 3), 0.1),
        scale_error=0.01 * three[:, 0],
        scale_error_std=np.full(count, 0.01),
        rate_bias=1e-4 * three,
        rate_bias_std=np.full((count, 3), 1e-4),
        innovation=rng.normal(size=(count, 6)) * PAIR_SIGMA,
        nis=rng.chisquare(6, count),
        used=used,
    )


def content(
    seconds: float = 40.0,
    damage: Callable[[list[PairEstimate], ImuSeries], tuple[list[PairEstimate], ImuSeries]] | None = None,
) -> ReportContent:
    """A run with everything: half of its noise is taken off raw by the pose graph, a third by the EKF."""
    truth, imu = simulate(seconds)
    pairs = pairs_of(truth)
    if damage is not None:
        pairs, imu = damage(pairs, imu)
    trajectories = {"raw": chain(pairs)}
    for name, share in (("posegraph", 0.5), ("ekf", 0.67)):
        trajectories[name] = chain(_nearer(pairs, truth, share))
    stamps_ns = trajectories["raw"].stamps_ns
    loop = replace(pairs[0], source_stamp_ns=int(stamps_ns[5]), target_stamp_ns=int(stamps_ns[-5]))
    return ReportContent(
        title="drive.mcap",
        trajectories=trajectories,
        metrics={name: evaluate(each, truth, LENGTHS_M) for name, each in trajectories.items()},
        pairs=pairs,
        frame_stamps_ns=stamps_ns,
        ground_truth=truth,
        segment_lengths_m=LENGTHS_M,
        imu=imu,
        calibration=ImuCalibration(
            Rotation.from_quat([0.5, -0.5, 0.5, -0.5], scalar_first=True),
            0.0,
            np.full(3, 1e-3),
            True,
            "it agrees with the pairs",
            rotation_std_rad=np.full(3, 1e-3),
            time_offset_std_s=1e-3,
            gyro_bias_std=1e-4,
        ),
        series={name: series_of(stamps_ns, seed) for seed, name in enumerate(("posegraph", "ekf"))},
        loops=[loop, replace(loop, source_stamp_ns=int(stamps_ns[9]))],
        loops_used={"posegraph": np.array([True, False])},
        topics=TOPICS,
        warnings={"gaps_bridged": 2},
        notes=["gaps between pair estimates that were bridged: 2"],
        remarks={"posegraph": "IMU on all steps"},
        levels=_levels(pairs, truth),
        thumbnails=[Thumbnail(int(stamp), _picture(i)) for i, stamp in enumerate(stamps_ns[::20])],
    )


def _nearer(pairs: list[PairEstimate], truth: Trajectory, share: float) -> list[PairEstimate]:
    """The pairs, with this share of their errors."""
    true = truth.at(np.array([pair.source_stamp_ns for pair in pairs])).inv() * truth.at(
        np.array([pair.target_stamp_ns for pair in pairs])
    )
    better = true * RigidTransform.from_exp_coords(share * (true.inv() * motions_of(pairs)).as_exp_coords())
    quats_wxyz = better.rotation.as_quat(scalar_first=True)
    return [
        replace(pair, quat_wxyz=quat, translation=translation)
        for pair, quat, translation in zip(pairs, quats_wxyz, better.translation, strict=True)
    ]


def _levels(pairs: list[PairEstimate], truth: Trajectory) -> list[PairEstimate]:
    """Five levels, from 16 times the errors of the pairs, which halve each time, to those of the pairs."""
    levels = zip(*(_nearer(pairs, truth, 2.0**k) for k in (4, 3, 2, 1, 0)), strict=True)
    return [
        replace(
            pair,
            winner=-1,
            hypotheses_quat_wxyz=np.stack([each.quat_wxyz for each in of_pair]),
            hypotheses_translation=np.stack([each.translation for each in of_pair]),
            errors=np.zeros(0),
        )
        for pair, of_pair in zip(pairs, levels, strict=True)
    ]


def _picture(seed: int) -> bytes:
    pixels = np.random.default_rng(seed).integers(0, 256, (24, 64), dtype=np.uint8)
    return bytes(cv2.imencode(".jpg", pixels)[1].tobytes())
