"""From pair estimates, IMU, loops and positions to trajectories: what the command, a replay and the API share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from fusion import chain, ekf, posegraph
from fusion.config import RunConfig
from fusion.imu import ImuCalibration, in_camera_axes, on_camera_clock
from fusion.measurements import Estimate, Measurements
from fusion_io.errors import FusionError
from fusion_io.findings import Findings
from fusion_io.records import ImuSeries, IntArray, PairEstimate


def back_ends(config: RunConfig) -> Sequence[str]:
    """The names of the back ends that are asked for."""
    return ("posegraph", "ekf") if config.backend == "both" else (config.backend,)


def measurements(
    pairs: Sequence[PairEstimate],
    imu: ImuSeries,
    calibration: ImuCalibration,
    frame_stamps: IntArray,
    findings: Findings,
) -> Measurements:
    """The steps that lead through all frames, and the IMU where it is used.

    Raises LogError where there are no pairs.
    """
    inertial = in_camera_axes(imu, calibration) if calibration.used else None
    faulty = len(calibration.faulty_ns)
    findings.put("imu_faulty_stretches", faulty, f"stretches where the gyro contradicts the pairs, left out: {faulty}")
    steps, gaps = chain.bridge_gaps(frame_stamps, pairs, inertial)
    findings.put("gaps_bridged", gaps, f"gaps between pair estimates that were bridged: {gaps}")
    if not calibration.used:
        return Measurements(steps)
    return Measurements(steps, on_camera_clock(imu, calibration), calibration)


def fuse(known: Measurements, config: RunConfig, findings: Findings) -> dict[str, Estimate]:
    """What the back ends that are asked for make of the measurements; one that fails is counted and left out.

    The filter takes the mounting as the pose graph has refined it.
    """
    estimates: dict[str, Estimate] = {}
    graph = _attempt("posegraph", known, config, findings) if "posegraph" in back_ends(config) or known.imu else None
    if graph is not None and "posegraph" in back_ends(config):
        estimates["posegraph"] = graph
    if "ekf" in back_ends(config):
        refined = replace(known, mounting=graph.mounting if graph else None)
        if filtered := _attempt("ekf", refined, config, findings):
            estimates["ekf"] = filtered
    return estimates


def _attempt(name: str, known: Measurements, config: RunConfig, findings: Findings) -> Estimate | None:
    """The estimate of a back end; None, and counted, where it fails: the others are not lost."""
    try:
        estimate = posegraph.solve(known, config.posegraph) if name == "posegraph" else ekf.solve(known, config.ekf)
        if not np.all(np.isfinite(estimate.trajectory.poses.as_matrix())):
            raise FloatingPointError("a pose is not finite")
    except (FusionError, ArithmeticError, RuntimeError, np.linalg.LinAlgError) as error:  # GTSAM raises RuntimeError
        findings.put(f"{name}_failed", 1, f"back end failed ({name}): {' '.join(str(error).split())}")
        return None
    rejected = estimate.rejected
    findings.put(f"{name}_rejected", rejected, f"measurements rejected as outliers ({name}): {rejected}")
    return estimate
