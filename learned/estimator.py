"""A log in, pair estimates out."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from fusion_io.records import CameraFrame, FloatArray, ImuSeries, IntArray, PairEstimate
from learned import weights as weights_file
from learned.covariance import CovarianceModel, hypothesis_spread
from learned.inputs import NetworkFrame, collate, imu_coverage, imu_window, prepare
from learned.violearner import NetworkConfig, VIOLearner

PAIRS_A_BATCH = 8
"""Pairs computed at once: enough to keep two cores busy, few enough to hold in memory at any size."""

LONGEST_STEP = 1.5
"""Frames further apart than this many median frame periods have a missing frame between them."""


class FrameSource(Protocol):
    """The part of a log that the network reads."""

    def frame_stamps(self) -> IntArray:
        """Stamps of all frames."""

    def frames(self) -> Iterator[CameraFrame]:
        """Frames in order of time."""


@dataclass(frozen=True)
class Inference:
    """What the network says of a pair: its estimate, and T_source_target (5, 4, 4) after each level."""

    pair: PairEstimate
    levels: FloatArray


def estimate_pairs(
    log: FrameSource,
    imu: ImuSeries,
    weights: Path | None = None,
    progress: Iterable[CameraFrame] | None = None,
    skipped: Counter[str] | None = None,
) -> Iterator[PairEstimate]:
    """Pair estimates of the consecutive frames of a log, streamed.

    imu: the log's IMU on its own clock (possibly empty). weights: None for those that ship with the package.
    progress: `log.frames()` wrapped in a progress display. skipped: counts the pairs that could not be estimated, as
    "pairs_over_missing_frames" and "pairs_without_depth". Raises LogError for unusable weights or logs.
    """
    model, covariance = weights_file.load(weights)
    frames = log.frames() if progress is None else iter(progress)
    for inference in infer(model, covariance, frames, log.frame_stamps(), imu, skipped):
        yield inference.pair


def infer(
    model: VIOLearner,
    covariance: CovarianceModel,
    frames: Iterator[CameraFrame],
    frame_stamps: IntArray,
    imu: ImuSeries,
    skipped: Counter[str] | None = None,
) -> Iterator[Inference]:
    """Run the network over consecutive frames, a few pairs at a time."""
    waiting: list[tuple[NetworkFrame, NetworkFrame]] = []
    for pair in consecutive(frames, model.config, frame_stamps, Counter() if skipped is None else skipped):
        waiting.append(pair)
        if len(waiting) == PAIRS_A_BATCH:
            yield from infer_batch(model, covariance, waiting, imu)
            waiting.clear()
    if waiting:
        yield from infer_batch(model, covariance, waiting, imu)


def consecutive(
    frames: Iterator[CameraFrame], config: NetworkConfig, frame_stamps: IntArray, skipped: Counter[str]
) -> Iterator[tuple[NetworkFrame, NetworkFrame]]:
    """Source and target of consecutive frames at the network's size; counts the steps that make no pair."""
    longest_ns = LONGEST_STEP * float(np.median(np.diff(frame_stamps))) if len(frame_stamps) > 1 else 0.0
    previous: NetworkFrame | None = None
    for record in frames:
        frame = prepare(record, config)
        if previous is not None:
            if frame.stamp_ns - previous.stamp_ns > longest_ns:
                skipped["pairs_over_missing_frames"] += 1
            elif previous.depth is None or not previous.depth.any():
                skipped["pairs_without_depth"] += 1
            else:
                yield previous, frame
        previous = frame


def infer_batch(
    model: VIOLearner, covariance: CovarianceModel, pairs: list[tuple[NetworkFrame, NetworkFrame]], imu: ImuSeries
) -> list[Inference]:
    """Pair estimates of a batch of source and target frames."""
    stamps = [(source.stamp_ns, target.stamp_ns) for source, target in pairs]
    windows = [imu_window(imu, *stamp) for stamp in stamps]
    coverage = np.array([imu_coverage(imu, *stamp) for stamp in stamps])
    with torch.inference_mode():
        estimate = model(collate(pairs, windows))
        levels = model.pose_source_target(torch.stack(estimate.poses, dim=1)).numpy()
        hypotheses = model.pose_source_target(estimate.hypotheses).numpy()
    errors, winners = estimate.hypothesis_errors.double().numpy(), estimate.winner.numpy()
    covariances = covariance.covariance(hypothesis_spread(hypotheses, levels[:, -1]), coverage)
    quats = Rotation.from_matrix(hypotheses[..., :3, :3].reshape(-1, 3, 3)).as_quat(scalar_first=True, canonical=True)
    quats = quats.reshape(*hypotheses.shape[:2], 4)
    return [
        Inference(
            PairEstimate(
                source_stamp_ns=source_ns,
                target_stamp_ns=target_ns,
                quat_wxyz=quats[i, winners[i]],
                translation=hypotheses[i, winners[i], :3, 3],
                covariance=covariances[i],
                winner=int(winners[i]),
                hypotheses_quat_wxyz=quats[i],
                hypotheses_translation=hypotheses[i, :, :3, 3],
                errors=errors[i],
                imu_coverage=float(coverage[i]),
            ),
            levels[i],
        )
        for i, (source_ns, target_ns) in enumerate(stamps)
    ]
