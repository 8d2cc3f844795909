"""From pair estimates, IMU, loops and positions to trajectories: what the command, a replay and the API share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import accumulate

import numpy as np
from threadpoolctl import threadpool_limits

from fusion import chain, ekf, online, posegraph
from fusion.config import RunConfig
from fusion.imu import WANDERS, BiasStep, ImuCalibration, described, in_camera_axes, on_camera_clock
from fusion.measurements import Estimate, Measurements
from fusion_io.errors import FusionError
from fusion_io.findings import Findings
from fusion_io.records import NANOSECONDS, ImuSeries, IntArray, PairEstimate


def back_ends(config: RunConfig) -> Sequence[str]:
    """The names of the back ends that are asked for."""
    batch = ("posegraph", "ekf") if config.backend == "both" else (config.backend,)
    return ("posegraph", "posegraph_online", *batch[1:]) if config.online and "posegraph" in batch else batch


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
    findings.put("imu_faulty_stretches", faulty, f"faulty stretches of the IMU, left out: {faulty}")
    jumps = [f"{jump.by_s:+.3f} s" for jump in calibration.clock_jumps]
    findings.put("imu_clock_jumps", len(jumps), f"jumps of the IMU's clock, taken out of it: {', '.join(jumps)}")
    steps, gaps = chain.bridge_gaps(frame_stamps, pairs, inertial)
    longest_s, at_s = longest_gap(pairs)
    where = f"; the longest: {longest_s:.1f} s from {at_s:.1f} s" if longest_s > 0.0 else ""
    findings.put("gaps_bridged", gaps, f"gaps between pair estimates that were bridged: {gaps}{where}")
    if not calibration.used:
        return Measurements(steps)
    return Measurements(steps, on_camera_clock(imu, calibration), calibration)


def longest_gap(pairs: Sequence[PairEstimate]) -> tuple[float, float]:
    """The longest time (s) that no pair spans, and when it begins (s since the first pair)."""
    ends_ns = sorted((pair.source_stamp_ns, pair.target_stamp_ns) for pair in pairs)
    if not ends_ns:
        return 0.0, 0.0
    reached_ns = list(accumulate((target for _, target in ends_ns), max))
    gaps_ns = [(later[0] - reached, reached) for reached, later in zip(reached_ns[:-1], ends_ns[1:], strict=True)]
    gap_ns, begin_ns = max(gaps_ns, default=(0, 0))
    return gap_ns / NANOSECONDS, (begin_ns - ends_ns[0][0]) / NANOSECONDS


def between_steps(pairs: Sequence[PairEstimate], steps: Sequence[PairEstimate]) -> list[PairEstimate]:
    """Those of the pairs that begin and end where steps do."""
    stamps = set(chain.stamps_of(steps).tolist())
    return [pair for pair in pairs if {pair.source_stamp_ns, pair.target_stamp_ns} <= stamps]


def fuse(known: Measurements, config: RunConfig, findings: Findings) -> dict[str, Estimate]:
    """What the back ends that are asked for make of the measurements; one that fails is counted and left out.

    What is causal takes mounting and size of the front end's errors as the pose graph has found them, and no IMU that
    the pose graph had to leave out.
    """
    asked = back_ends(config)
    estimates: dict[str, Estimate] = {}
    of_graph = findings if "posegraph" in asked else Findings()  # who did not ask for it is not told of it
    graph = _attempt("posegraph", known, config, of_graph) if "posegraph" in asked or known.imu else None
    if graph is not None and "posegraph" in asked:
        estimates["posegraph"] = graph
    refined = known
    if graph is not None:
        stepped = described(graph.bias_steps, known.steps[0].source_stamp_ns)
        note = f"steps of the IMU's biases, taken out of it: {len(stepped)} ({'; '.join(stepped)})"
        findings.put("imu_bias_steps", len(stepped), note)
        findings.put("accelerometer_wanders", int(len(stepped) < len(graph.bias_steps)), WANDERS)
        refined = replace(
            known,
            imu=known.imu and _without(graph.bias_steps, known.imu),
            mounting=graph.mounting,
            front_end_sigma=graph.front_end_sigma,
            bias_steps=graph.bias_steps,
        )
    if graph is not None and graph.mounting is None:
        refined = replace(known, imu=None, calibration=None)
    for name in asked[1:] if "posegraph" in asked else asked:
        if estimate := _attempt(name, refined, config, findings):
            estimates[name] = replace(
                estimate,
                note=estimate.note + _by_the_graph(name, known, refined),
                front_end_sigma=refined.front_end_sigma,
                bias_steps=refined.bias_steps,
            )
            if estimate.hindsight is not None:
                estimates[f"{name}_smoothed"] = Estimate(
                    estimate.hindsight, "the EKF in hindsight: its loops move what was before them"
                )
    return estimates


def _without(steps: Sequence[BiasStep], imu: ImuSeries) -> ImuSeries:
    """The samples as if the biases had not stepped."""
    for step in steps:
        after = (imu.stamps_ns >= step.at_ns)[:, None]
        imu = replace(
            imu,
            linear_acceleration=imu.linear_acceleration - after * step.by[:3],
            angular_velocity=imu.angular_velocity - after * step.by[3:],
        )
    return imu


def _by_the_graph(name: str, known: Measurements, refined: Measurements) -> str:
    """What a back end took from the pose graph against what was known or set, to follow what else is said."""
    if known.imu is not None and refined.imu is None:
        return "; the pose graph had to leave the IMU out"
    told = list(described(refined.bias_steps, known.steps[0].source_stamp_ns))
    if name == "ekf" and refined.front_end_sigma is not None:
        told.append(f"scale errors have a sigma of {100 * refined.front_end_sigma[0]:.2g} %")
    return f"; {'; '.join(told)}, as the pose graph found" if told else ""


def _attempt(name: str, known: Measurements, config: RunConfig, findings: Findings) -> Estimate | None:
    """The estimate of a back end; None, and counted, where it fails: the others are not lost."""
    try:
        with threadpool_limits(1, "blas"):  # small matrices: threads would wait for each other most of the time
            estimate = _solve(name, known, config)
        if not np.all(np.isfinite(estimate.trajectory.poses.as_matrix())):
            raise FloatingPointError("a pose is not finite")
    except (FusionError, ArithmeticError, RuntimeError, np.linalg.LinAlgError) as error:  # GTSAM raises RuntimeError
        findings.put(f"{name}_failed", 1, f"back end failed ({name}): {' '.join(str(error).split())}")
        return None
    rejected = estimate.rejected
    note = f"single measurements (pairs, IMU, loops, GNSS) rejected as outliers ({name}): {rejected}"
    findings.put(f"{name}_rejected", rejected, note)
    return estimate


def _solve(name: str, known: Measurements, config: RunConfig) -> Estimate:
    if name == "ekf":
        return ekf.solve(known, config.ekf)
    return (
        online.solve(known, config.posegraph)
        if name == "posegraph_online"
        else posegraph.solve(known, config.posegraph)
    )
