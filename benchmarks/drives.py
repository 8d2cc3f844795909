"""Drives whose every error is drawn from the very model that the back ends assume: what consistency is judged on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import RigidTransform

from fusion.config import EkfConfig, PoseGraphConfig
from fusion.factors import extrinsics
from fusion.imu import ImuCalibration
from fusion.measurements import Measurements
from fusion.pair_model import exp
from fusion_io.records import NANOSECONDS, FloatArray, ImuSeries, PairEstimate, Trajectory
from fusion_io.simulation.carriers import WalkStyle, walk
from fusion_io.simulation.motion import (
    ROTATION_IMU_CAMERA_KITTI,
    DriveStyle,
    ImuModel,
    Motion,
    drive,
    imu_stamps,
    simulate_imu,
)

FRAMES_HZ, IMU_HZ = 10, 100
MARGIN_S = 1.0  # of motion before the first frame and after the last, for an IMU whose clock is off
PAIR_SIGMA = np.repeat([1e-3, 0.02], 3)  # white noise of a pair estimate: rad, m

# What both back ends are told, and the errors are drawn from: those of an IMU that is somewhat known, as after a
# calibration, so that first-order covariances can be right from the start.
MODEL = {
    "gyro_noise": 1e-3,
    "accelerometer_noise": 0.05,
    "gyro_bias_walk": 1e-4,
    "accelerometer_bias_walk": 1e-3,
    "gyro_bias_sigma": 2e-3,
    "accelerometer_bias_sigma": 0.1,
    "pair_scale_sigma": 0.02,
    "pair_scale_correlation_s": 10.0,
    "pair_rate_bias_sigma": 3e-3,
    "pair_rate_bias_correlation_s": 5.0,
    "pair_misalignment_sigma": 1e-2,
    "lever_arm_sigma": 0.5,
    "mounting_sigma": 1e-2,
    "time_offset_sigma": 5e-3,
}
POSE_GRAPH = PoseGraphConfig.model_validate(MODEL)
EKF = EkfConfig.model_validate(MODEL | {"stamp_jitter_s": 0.0})

Carrier = Callable[[int, float, float], Motion]
"""A motion from a seed, from a start to an end in seconds."""


def car(seed: int, start_s: float, end_s: float) -> Motion:
    """Through residential streets."""
    return drive(seed, start_s, end_s, DriveStyle())


def hand(seed: int, start_s: float, end_s: float) -> Motion:
    """In the hand of somebody who walks."""
    return walk(seed, start_s, end_s, WalkStyle())


@dataclass(frozen=True)
class Drive:
    """What was measured over K frames, and the truth.

    truth: of the camera, its first pose the world. T_camera_imu (4, 4), ahead_s, misalignment (3,): as in
    `fusion.measurements.Mounting`. gyro_bias, accelerometer_bias (K, 3): of the IMU at the frames. front_end (K, 4):
    scale error and rate bias of the pair that ends there; the first row is that of the second.
    """

    measurements: Measurements
    truth: Trajectory
    T_camera_imu: FloatArray
    ahead_s: float
    misalignment: FloatArray
    gyro_bias: FloatArray
    accelerometer_bias: FloatArray
    front_end: FloatArray


def simulate(
    seed: int,
    seconds: float,
    config: PoseGraphConfig | EkfConfig = POSE_GRAPH,
    carrier: Carrier = car,
    sigma: FloatArray = PAIR_SIGMA,
    skipping: bool = False,
) -> Drive:
    """A drive with the errors that a configuration states, and pairs with white noise sigma (6,) besides.

    skipping: with pairs over two steps, too.
    """
    rng = np.random.default_rng([seed, 1])
    frames = round(seconds * FRAMES_HZ) + 1
    stamps = np.arange(frames) * (NANOSECONDS // FRAMES_HZ)
    motion = carrier(seed, -MARGIN_S, seconds + MARGIN_S)
    truth = Trajectory(stamps, motion.poses(stamps / NANOSECONDS)).relative_to_first()

    nominal = np.eye(4)
    nominal[:3, :3] = ROTATION_IMU_CAMERA_KITTI.inv().as_matrix()
    strayed = rng.normal(size=6) * np.repeat([config.mounting_sigma, config.lever_arm_sigma], 3)
    T_camera_imu = extrinsics(nominal, strayed)
    ahead_s = config.time_offset_sigma * rng.normal()
    misalignment = config.pair_misalignment_sigma * rng.normal(size=3)
    front_end = gauss_markov(
        rng,
        frames,
        np.repeat([config.pair_scale_sigma, config.pair_rate_bias_sigma], [1, 3]),
        np.repeat([config.pair_scale_correlation_s, config.pair_rate_bias_correlation_s], [1, 3]),
    )
    imu, gyro_bias, accelerometer_bias = _imu(rng, seed, motion, T_camera_imu, ahead_s, config, seconds)
    calibration = ImuCalibration(
        ROTATION_IMU_CAMERA_KITTI,
        0.0,
        np.zeros(3),
        used=True,
        reason="",
        rotation_std_rad=np.full(3, 1e-9),  # estimated, not given
        time_offset_std_s=1e-9,
    )
    pairs = _pairs(rng, truth, misalignment, front_end, sigma, 1)
    skips = _pairs(rng, truth, misalignment, front_end, sigma, 2) if skipping else []
    at_frames = np.searchsorted(imu.stamps_ns, stamps)
    return Drive(
        Measurements(pairs, imu, calibration, skips=skips),
        truth,
        T_camera_imu,
        ahead_s,
        misalignment,
        gyro_bias[at_frames],
        accelerometer_bias[at_frames],
        front_end,
    )


def gauss_markov(rng: np.random.Generator, frames: int, sigma: FloatArray, correlation_s: FloatArray) -> FloatArray:
    """Stationary first-order processes (frames, M) with standard deviations and times of correlation (M,)."""
    keep = np.exp(-1.0 / (FRAMES_HZ * correlation_s))
    rows = [np.zeros(len(sigma)), sigma * rng.normal(size=len(sigma))]
    while len(rows) < frames:
        rows.append(keep * rows[-1] + np.sqrt(1.0 - keep**2) * sigma * rng.normal(size=len(sigma)))
    rows[0] = rows[1]
    return np.stack(rows)


def _imu(
    rng: np.random.Generator,
    seed: int,
    motion: Motion,
    T_camera_imu: FloatArray,
    ahead_s: float,
    config: PoseGraphConfig | EkfConfig,
    seconds: float,
) -> tuple[ImuSeries, FloatArray, FloatArray]:
    """The samples, and the biases (N, 3) of gyro and accelerometer in each."""
    mounted = RigidTransform.from_matrix(T_camera_imu)
    model = ImuModel(
        rotation_imu_camera=mounted.rotation.inv(),
        lever_arm=mounted.translation,
        time_offset_s=ahead_s,
        gyro_bias=np.zeros(3),
        accelerometer_bias=np.zeros(3),
        gyro_noise=config.gyro_noise,
        accelerometer_noise=config.accelerometer_noise,
    )
    stamps = imu_stamps(-0.1, seconds + 0.1, IMU_HZ)
    imu = simulate_imu(motion, stamps, IMU_HZ, model, seed + 1)
    biases = [
        sigma * rng.normal(size=3) + walk_density / np.sqrt(IMU_HZ) * np.cumsum(rng.normal(size=(len(imu), 3)), axis=0)
        for sigma, walk_density in (
            (config.gyro_bias_sigma, config.gyro_bias_walk),
            (config.accelerometer_bias_sigma, config.accelerometer_bias_walk),
        )
    ]
    shown = replace(
        imu,
        angular_velocity=imu.angular_velocity + biases[0],
        linear_acceleration=imu.linear_acceleration + biases[1],
    )
    return shown, biases[0], biases[1]


def _pairs(
    rng: np.random.Generator,
    truth: Trajectory,
    misalignment: FloatArray,
    front_end: FloatArray,
    sigma: FloatArray,
    steps: int,
) -> list[PairEstimate]:
    """Pair estimates over some steps with the errors of the front end (K, 4): equation (2) of `fusion.pair_model`."""
    motions = (truth.poses[:-steps].inv() * truth.poses[steps:]).as_matrix()
    lasting = np.mean([front_end[1 + k : len(front_end) + 1 - steps + k] for k in range(steps)], axis=0)
    aligned = exp(misalignment)
    motions[:, :3, :3] = aligned @ motions[:, :3, :3] @ aligned.T @ exp(lasting[:, 1:] * steps / FRAMES_HZ)
    motions[:, :3, 3] *= 1.0 + lasting[:, :1]
    shown = RigidTransform.from_matrix(motions) * RigidTransform.from_exp_coords(
        rng.normal(size=(len(motions), 6)) * sigma
    )
    quats_wxyz, translations = shown.rotation.as_quat(scalar_first=True), shown.translation
    stamps = truth.stamps_ns.tolist()
    return [
        PairEstimate(stamps[k], stamps[k + steps], quats_wxyz[k], translations[k], np.diag(sigma**2))
        for k in range(len(motions))
    ]
