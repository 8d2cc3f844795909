"""A log in, pair estimates out."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol, TypeVar

import numpy as np
import torch
from scipy.spatial.transform import RigidTransform, Rotation

from fusion_io.ahead import computed_ahead
from fusion_io.records import CameraFrame, FloatArray, ImuSeries, IntArray, PairEstimate
from learned import weights as weights_file
from learned.covariance import hypothesis_spread, pooled
from learned.inference import for_inference
from learned.inputs import NetworkFrame, collate, imu_coverage, imu_window, prepare
from learned.refinement import FullFrame, prepare_full, refine
from learned.violearner import NetworkConfig
from learned.weights import Weights

PAIRS_A_BATCH = 8
"""Pairs computed at once: enough to keep two cores busy, few enough to hold in memory at any size."""

FRAMES_AHEAD = 8
"""Frames decoded and prepared while the network works."""

BATCHES_AHEAD = 2
"""Batches that the network estimates, at the same time, while the one before is refined."""

LONGEST_STEP = 1.5
"""Frames further apart than this many median frame periods have a missing frame between them."""

Item = TypeVar("Item")


class FrameSource(Protocol):
    """The part of a log that the network reads."""

    def frame_stamps(self) -> IntArray:
        """Stamps of all frames."""

    def frames(self, stamps_ns: IntArray | None = None) -> Iterator[CameraFrame]:
        """Frames in order of time: all, or those at these stamps."""


@dataclass(frozen=True)
class Inference:
    """What is said of a pair.

    pair: the estimate to use, refined where refinement was asked for and found a lower error; network: that of the
    network, the start of the refinement; levels (5, 4, 4): T_source_target after each level of the network.
    """

    pair: PairEstimate
    network: PairEstimate
    levels: FloatArray

    @property
    def refined(self) -> bool:
        """Whether the estimate is better than the network's own."""
        return self.pair is not self.network


@dataclass(frozen=True)
class ReadyFrame:
    """A frame as the network reads it, and at full resolution where it is to be refined."""

    network: NetworkFrame
    full: FullFrame | None


def estimate_pairs(
    log: FrameSource,
    imu: ImuSeries,
    weights: Path | None = None,
    progress: Iterable[CameraFrame] | None = None,
    skipped: Counter[str] | None = None,
    refined: bool = True,
    levels: list[PairEstimate] | None = None,
) -> Iterator[PairEstimate]:
    """Pair estimates of the consecutive frames of a log, streamed.

    imu: the log's IMU on its own clock (possibly empty). weights: None for those that ship with the package.
    progress: `log.frames()` wrapped in a progress display. skipped: counts the pairs that could not be estimated, as
    "pairs_over_missing_frames" and "pairs_without_depth", and those that were but not refined, as
    "pairs_not_refined". levels: gets the motion after each level of the network, as `by_level`. Raises LogError for
    unusable weights or logs.
    """
    frames = log.frames() if progress is None else iter(progress)
    skipped = Counter() if skipped is None else skipped
    for inference in infer(weights_file.load(weights), frames, log.frame_stamps(), imu, skipped, refined):
        if levels is not None:
            levels.append(by_level(inference))
        yield inference.pair


def by_level(inference: Inference) -> PairEstimate:
    """The estimate of the network alone, whose hypotheses are the motions after each of its levels."""
    motions = RigidTransform.from_matrix(inference.levels)
    return replace(
        inference.network,
        winner=-1,
        hypotheses_quat_wxyz=motions.rotation.as_quat(scalar_first=True),
        hypotheses_translation=motions.translation,
        errors=np.zeros(0),
    )


def estimate_skips(
    log: FrameSource,
    imu: ImuSeries,
    weights: Path | None = None,
    track: Callable[[Iterator[CameraFrame]], Iterable[CameraFrame]] = iter,
    refined: bool = True,
) -> Iterator[PairEstimate]:
    """Pair estimates from each frame to the one after the next, streamed: from the even frames, then from the odd ones.

    track: wraps the frames in a progress display. The rest as for `estimate_pairs`.
    """
    loaded, stamps = weights_file.load(weights), log.frame_stamps()
    for first in (0, 1):
        every_other = stamps[first::2]
        frames = iter(track(log.frames(every_other)))
        for inference in infer(loaded, frames, every_other, imu, Counter(), refined):
            yield inference.pair


def infer(
    weights: Weights,
    frames: Iterator[CameraFrame],
    frame_stamps: IntArray,
    imu: ImuSeries,
    skipped: Counter[str],
    refined: bool = True,
) -> Iterator[Inference]:
    """Run the network, and the refinement if asked for, over consecutive frames, a few pairs at a time.

    A network whose estimates are refined says only where to start: its own are then less exact than without refinement.
    Frames, network and refinement are three stages that work at the same time, in threads of one operation each: that
    keeps the cores busier than threads within an operation, and the result does not depend on their number.
    """
    weights = weights.as_start() if refined else weights
    weights = replace(weights, model=for_inference(weights.model))
    with single_threaded():
        ready = prefetched((ready_frame(f, weights.model.config, refined) for f in frames), FRAMES_AHEAD)
        batch = batches(consecutive(ready, frame_stamps, skipped))
        estimated = computed_ahead(lambda pairs: (pairs, infer_batch(weights, pairs, imu)), batch, BATCHES_AHEAD)
        before = np.eye(4)  # the motion of the pair before: another start of the refinement
        for pairs, inferences in estimated:
            motions = np.stack([inference.levels[-1] for inference in inferences])
            if not refined:
                yield from inferences
                continue
            for inference in refine_batch(weights, pairs, inferences, np.concatenate([before[None], motions[:-1]])):
                skipped.update(() if inference.refined else ("pairs_not_refined",))
                yield inference
            before = motions[-1]


@contextmanager
def single_threaded() -> Iterator[None]:
    """One thread an operation of torch, while this lasts."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def ready_frame(frame: CameraFrame, config: NetworkConfig, refined: bool) -> ReadyFrame:
    """A frame as network and refinement want it."""
    return ReadyFrame(prepare(frame, config), prepare_full(frame) if refined else None)


def prefetched(items: Iterator[Item], count: int) -> Iterator[Item]:
    """The items, up to `count` of them made ahead by another thread."""
    end = object()
    with ThreadPoolExecutor(1) as pool:
        waiting = deque(pool.submit(next, items, end) for _ in range(count))
        while (item := waiting.popleft().result()) is not end:
            waiting.append(pool.submit(next, items, end))
            yield item  # type: ignore[misc]


def consecutive(
    frames: Iterator[ReadyFrame], frame_stamps: IntArray, skipped: Counter[str]
) -> Iterator[tuple[ReadyFrame, ReadyFrame]]:
    """Source and target of consecutive frames; counts the steps that make no pair."""
    longest_ns = LONGEST_STEP * float(np.median(np.diff(frame_stamps))) if len(frame_stamps) > 1 else 0.0
    previous: ReadyFrame | None = None
    for frame in frames:
        if previous is not None:
            source, target = previous.network, frame.network
            if target.stamp_ns - source.stamp_ns > longest_ns:
                skipped["pairs_over_missing_frames"] += 1
            elif source.depth is None or not source.depth.any():
                skipped["pairs_without_depth"] += 1
            else:
                yield previous, frame
        previous = frame


def batches(pairs: Iterator[tuple[ReadyFrame, ReadyFrame]]) -> Iterator[list[tuple[ReadyFrame, ReadyFrame]]]:
    """Pairs in lists of up to `PAIRS_A_BATCH` whose frames are all of one size."""
    batch: list[tuple[ReadyFrame, ReadyFrame]] = []
    for pair in pairs:
        if len(batch) == PAIRS_A_BATCH or (batch and sizes(pair) != sizes(batch[0])):
            yield batch
            batch = []
        batch.append(pair)
    if batch:
        yield batch


def sizes(pair: tuple[ReadyFrame, ReadyFrame]) -> list[torch.Size]:
    """The full sizes of source and target."""
    return [frame.full.images[0].shape for frame in pair if frame.full is not None]


def infer_batch(weights: Weights, pairs: list[tuple[ReadyFrame, ReadyFrame]], imu: ImuSeries) -> list[Inference]:
    """The network's estimates for a batch of source and target frames."""
    frames = [(source.network, target.network) for source, target in pairs]
    stamps = [(source.stamp_ns, target.stamp_ns) for source, target in frames]
    windows = [imu_window(imu, *stamp) for stamp in stamps]
    coverage = np.array([imu_coverage(imu, *stamp) for stamp in stamps])
    with torch.inference_mode():
        estimate = weights.model(collate(frames, windows))
        levels = weights.model.pose_source_target(torch.stack(estimate.poses, dim=1)).numpy()
        hypotheses = weights.model.pose_source_target(estimate.hypotheses).numpy()
    errors, winners = estimate.hypothesis_errors.double().numpy(), estimate.winner.numpy()
    covariances = weights.covariance.covariance(pooled(hypothesis_spread(hypotheses, levels[:, -1])), coverage)
    quats = quaternions(hypotheses.reshape(-1, 4, 4)).reshape(*hypotheses.shape[:2], 4)
    estimates = [
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
        )
        for i, (source_ns, target_ns) in enumerate(stamps)
    ]
    return [Inference(pair, pair, levels[i]) for i, pair in enumerate(estimates)]


def refine_batch(
    weights: Weights, pairs: list[tuple[ReadyFrame, ReadyFrame]], inferences: list[Inference], before: FloatArray
) -> list[Inference]:
    """The estimates refined at full resolution; before (B, 4, 4): the motions of the pairs before.

    Across a change of the image's size nothing is refined: the target's camera is another than the source's.
    """
    if len(set(sizes(pairs[0]))) > 1:
        return inferences
    full = [(source.full, target.full) for source, target in pairs if source.full and target.full]
    starts = np.stack([inference.levels[-1] for inference in inferences])
    prior = np.stack([inference.network.covariance for inference in inferences])
    still = np.broadcast_to(np.eye(4), starts.shape)
    from_imu = np.stack([inference.levels[0] for inference in inferences])
    refined = refine(full, starts, prior, np.stack([before, from_imu, still]))
    coverage = np.array([inference.network.imu_coverage for inference in inferences])
    covariances = weights.refined_covariance.covariance(refined.covariance, coverage)
    quats = quaternions(refined.T_source_target)
    return [
        replace(
            inference,
            pair=replace(
                inference.network,
                quat_wxyz=quats[i],
                translation=refined.T_source_target[i, :3, 3],
                covariance=covariances[i],
            ),
        )
        if refined.improved[i]
        else inference
        for i, inference in enumerate(inferences)
    ]


def quaternions(T: FloatArray) -> FloatArray:
    """The rotations of poses (N, 4, 4) as quat_wxyz (N, 4)."""
    return np.asarray(Rotation.from_matrix(T[:, :3, :3]).as_quat(scalar_first=True, canonical=True))
