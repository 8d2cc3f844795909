"""Fusion from Python: what ``fusion.fuse`` is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from fusion import chain, fusing
from fusion.config import RunConfig
from fusion.gnss import positions
from fusion.imu import calibrate
from fusion_io.errors import LogError
from fusion_io.findings import Findings
from fusion_io.records import GnssFix, ImuSeries, IntArray, PairEstimate, Trajectory

Backend = Literal["raw", "posegraph", "ekf"]

_NO_STAMPS: IntArray = np.zeros(0, dtype=np.int64)
_NO_IMU = ImuSeries(_NO_STAMPS, np.zeros((0, 3)), np.zeros((0, 3)))


def fuse(
    pairs: Sequence[PairEstimate],
    imu: ImuSeries | None = None,
    backend: Backend = "posegraph",
    *,
    frame_stamps: IntArray | None = None,
    mounting: Rotation | None = None,
    gnss: Sequence[GnssFix] = (),
    config: RunConfig | None = None,
) -> Trajectory:
    """The trajectory of the camera, with covariances, from the motions between its frames and an IMU.

    The IMU's mounting, time offset and gyro bias are estimated from the samples; an IMU that contradicts the pairs is
    left out. The world is the first camera's frame.

    Args:
        pairs: Motions between frames, recorded (`log.pairs`) or estimated (`learned.estimate_pairs`).
        imu: The IMU in its own axes and on its own clock; None or empty for none.
        backend: "posegraph", "ekf", or "raw" for the chained pairs without any fusion.
        frame_stamps: Stamps (N,) in ns of all frames, where pairs do not lead through all of them (`log.frame_stamps`).
        mounting: The rotation that turns camera vectors into IMU vectors, where it is known (`log.mounting`).
        gnss: Satellite positions of an antenna on the same carrier (`log.gnss`).
        config: The settings of the back ends; None for the defaults.

    Raises:
        LogError: there are no pairs, or the back end fails on them.

    """
    config = (config or RunConfig()).model_copy(update={} if backend == "raw" else {"backend": backend})
    samples = _NO_IMU if imu is None else imu
    calibration = calibrate(pairs, samples, mounting, config.imu.time_offset_s, config.imu.low_pass_s)
    stamps_ns = _NO_STAMPS if frame_stamps is None else frame_stamps
    findings = Findings()
    known = fusing.measurements(pairs, samples, calibration, stamps_ns, findings)
    if backend == "raw":
        return chain.chain(known.steps)
    known = replace(known, gnss=positions(gnss, config.gnss, findings))
    estimates = fusing.fuse(known, config, findings)
    if backend not in estimates:
        raise LogError("; ".join(findings.notes))
    return estimates[backend].trajectory
