"""Training pairs: rendered by the simulator or read from logs, kept on disk as arrays at the network's size."""

from __future__ import annotations

import multiprocessing
import os
import shutil
import signal
import sys
import threading
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, fields
from itertools import islice, pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from fusion_io import simulation
from fusion_io.errors import LogError
from fusion_io.progress import track
from fusion_io.reader import Log, open_log
from fusion_io.records import NANOSECONDS, FloatArray, ImuSeries, IntArray, Trajectory
from learned.estimator import FRAMES_AHEAD, consecutive, prefetched, ready_frame
from learned.inputs import NetworkFrame, imu_coverage, imu_window, prepare
from learned.violearner import Batch, NetworkConfig

CLIPS_A_SHARD = 32
PAIRS_A_SHARD = 256
VALIDATION_BLOCK = 16
"""Validation takes runs of this many pairs: frames next to each other are nearly the same."""


@dataclass(frozen=True)
class Pairs:
    """N pairs as arrays; the fields of `violearner.Batch`, and ground truth for validation only.

    source, target (N, C, H, W) uint8; source_depth (N, H, W) float16 m; K (N, 3, 3); imu (N, 20, 6) with NaN where
    nothing was measured; interval_s (N,); T_source_target (N, 4, 4), NaN where it is not known.
    """

    source: NDArray[np.uint8]
    target: NDArray[np.uint8]
    source_depth: NDArray[np.float16]
    K: NDArray[np.float32]
    imu: NDArray[np.float32]
    interval_s: NDArray[np.float32]
    T_source_target: FloatArray

    def __len__(self) -> int:
        return len(self.source)

    @staticmethod
    def of(
        frames: Sequence[tuple[NetworkFrame, NetworkFrame]], imu: ImuSeries, T_source_target: FloatArray | None = None
    ) -> Pairs:
        """Source and target frames with their IMU windows; sources must have depth."""
        depths = [source.depth for source, _ in frames if source.depth is not None]
        stamps = [(source.stamp_ns, target.stamp_ns) for source, target in frames]
        return Pairs(
            source=np.stack([source.image for source, _ in frames]),
            target=np.stack([target.image for _, target in frames]),
            source_depth=np.stack(depths).astype(np.float16),
            K=np.stack([source.K for source, _ in frames]).astype(np.float32),
            imu=np.stack([measured_window(imu, *stamp) for stamp in stamps]).astype(np.float32),
            interval_s=np.array([(t - s) / NANOSECONDS for s, t in stamps], dtype=np.float32),
            T_source_target=np.full((len(frames), 4, 4), np.nan) if T_source_target is None else T_source_target,
        )

    def batch(self, index: IntArray, device: str = "cpu") -> Batch:
        """The pairs of an index as input of the network."""

        def tensor(values: NDArray[Any]) -> torch.Tensor:
            return torch.from_numpy(values[index]).to(device)

        return Batch(
            source=tensor(self.source).float() / 255,
            target=tensor(self.target).float() / 255,
            source_depth=tensor(self.source_depth).float(),
            K=tensor(self.K),
            imu=tensor(self.imu),
            interval_s=tensor(self.interval_s),
        )

    def save(self, path: Path) -> None:
        """Write a .npy file with a record for each pair, complete or not at all."""
        arrays = {f.name: getattr(self, f.name) for f in fields(self)}
        records = np.empty(len(self), [(name, a.dtype, a.shape[1:]) for name, a in arrays.items()])
        for name, array in arrays.items():
            records[name] = array
        partial = path.with_suffix(".partial.npy")
        np.save(partial, records)
        partial.replace(path)

    @staticmethod
    def load(path: Path) -> Pairs:
        """What `save` wrote, read from the file when it is used."""
        records = np.load(path, mmap_mode="r")
        return Pairs(**{f.name: records[f.name] for f in fields(Pairs)})

    @staticmethod
    def concatenate(parts: Iterable[Pairs]) -> Pairs:
        """All pairs of several sets, in order."""
        parts = list(parts)
        return Pairs(**{f.name: np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(Pairs)})


@dataclass(frozen=True)
class PairSet:
    """Pairs of several files as one sequence, of which only what is drawn is in memory.

    places (N, 2): part and row of each pair; weights (N,): how often each is drawn, and how much it counts in a mean.
    """

    parts: Sequence[Pairs]
    places: IntArray
    weights: FloatArray

    @staticmethod
    def of(parts: Iterable[Pairs]) -> PairSet:
        """All pairs of all parts, with weight 1."""
        parts = list(parts)
        places = np.array([(part, row) for part, pairs in enumerate(parts) for row in range(len(pairs))])
        return PairSet(parts, places, np.ones(len(places)))

    @staticmethod
    def mixture(sets: Iterable[PairSet]) -> PairSet:
        """Several sets as one, each pair with its own weight."""
        parts: list[Pairs] = []
        places, weights = [], []
        for each in sets:
            places.append(each.places + np.array([len(parts), 0]))
            weights.append(each.weights)
            parts.extend(each.parts)
        return PairSet(parts, np.concatenate(places), np.concatenate(weights))

    def __len__(self) -> int:
        return len(self.places)

    def select(self, index: IntArray) -> PairSet:
        """The pairs of an index, still on disk."""
        return PairSet(self.parts, self.places[index], self.weights[index])

    def weighted(self, weight: float) -> PairSet:
        """The same pairs with another weight."""
        return PairSet(self.parts, self.places, np.full(len(self), weight))

    def values(self, name: str) -> NDArray[Any]:
        """One field of all pairs, in memory."""
        return np.stack([getattr(self.parts[part], name)[row] for part, row in self.places])

    def take(self, index: IntArray) -> Pairs:
        """The pairs of an index, in memory."""
        chosen = self.select(index)
        return Pairs(**{f.name: chosen.values(f.name) for f in fields(Pairs)})

    def batch(self, index: IntArray, device: str = "cpu") -> Batch:
        """The pairs of an index as input of the network."""
        return self.take(index).batch(np.arange(len(index)), device)

    def draw(self, rng: np.random.Generator, count: int) -> IntArray:
        """An index of random pairs by weight, none of them twice if there are enough."""
        probability = self.weights / self.weights.sum()
        return rng.choice(len(self), count, replace=len(self) < count, p=probability)


def split(pairs: PairSet, share: float) -> tuple[PairSet, PairSet]:
    """Training and validation pairs of consecutive pairs, without a frame in common.

    Validation gets blocks at regular distances, one at the end where there are too few pairs for more; the pair on
    either side of a block shares a frame with it and is left out of both. Raises LogError for too few pairs.
    """
    block = min(VALIDATION_BLOCK, max(1, round(share * len(pairs))))
    blocks = max(1, int(share * len(pairs) / block))
    ends = [len(pairs) * (i + 1) // blocks for i in range(blocks)]
    held_out = np.zeros(len(pairs), dtype=bool)
    beside = np.zeros(len(pairs), dtype=bool)
    for end in ends:
        held_out[end - block : end] = True
        beside[max(0, end - block - 1) : end + 1] = True
    if beside.all():
        raise LogError(f"{len(pairs)} pairs are too few to train on and to validate with")
    return pairs.select(np.flatnonzero(~beside)), pairs.select(np.flatnonzero(held_out))


def measured_window(imu: ImuSeries, source_ns: int, target_ns: int) -> FloatArray:
    """The IMU window, all NaN where no part of it was measured."""
    window = imu_window(imu, source_ns, target_ns)
    return window if imu_coverage(imu, source_ns, target_ns) > 0 else np.full_like(window, np.nan)


# --- Logs ---------------------------------------------------------------------------------------


def log_shards(path: Path, config: NetworkConfig, folder: Path) -> list[Path]:
    """The consecutive pairs of a log as files in a folder, read on the first call; ground truth is not looked at.

    Raises LogError for a log without images and depth.
    """
    if not folder.is_dir():
        partial = folder.with_name(f"{folder.name}.partial")
        shutil.rmtree(partial, ignore_errors=True)
        partial.mkdir(parents=True)
        write_shards(log_pairs(open_log(path), config), partial)
        partial.rename(folder)
    return sorted(folder.glob("*.npy"))


def write_shards(parts: Iterable[Pairs], folder: Path) -> list[Path]:
    """Write each part as it comes to a file of the folder."""
    paths = []
    for k, pairs in enumerate(parts):
        paths.append(folder / f"{k:05d}.npy")
        pairs.save(paths[-1])
    return paths


def log_pairs(log: Log, config: NetworkConfig) -> Iterator[Pairs]:
    """The consecutive pairs of a log as the estimator sees them, some at a time; says on stderr what was lost.

    Raises LogError where there is none.
    """
    imu, stamps = log.imu(), log.frame_stamps()
    skipped: Counter[str] = Counter()
    frames = track(log.frames(), f"read {log.path.name}", len(stamps))
    ready = prefetched((ready_frame(frame, config, False) for frame in frames), FRAMES_AHEAD)
    pairs = ((source.network, target.network) for source, target in consecutive(ready, stamps, skipped))
    found = False
    while some := list(islice(pairs, PAIRS_A_SHARD)):
        found = True
        yield Pairs.of(some, imu)
    for name, count in [*log.warnings.items(), *skipped.items()]:
        print(f"warning: {log.path}: {name} {count}", file=sys.stderr)
    if not found:
        raise LogError(f"{log.path}: no pair of consecutive frames with depth")


# --- Simulation ---------------------------------------------------------------------------------


def pairs_of(frames: list[NetworkFrame], imu: ImuSeries, trajectory: Trajectory) -> Pairs:
    """The consecutive pairs of a clip whose poses are known at the frames' stamps."""
    T_world_camera = trajectory.poses.as_matrix()
    usable = [i for i, frame in enumerate(frames[:-1]) if frame.depth is not None]
    true = np.stack([np.linalg.inv(T_world_camera[i]) @ T_world_camera[i + 1] for i in usable])
    return Pairs.of([(frames[i], frames[i + 1]) for i in usable], imu, true)


def simulated_clip(seed: int, frames: int, config: NetworkConfig) -> Pairs:
    """The pairs of one short drive through a fresh simulated street."""
    clip, imu, trajectory = simulation.clip(seed, frames, config.width, config.height)
    return pairs_of([prepare(frame, config) for frame in clip], imu, trajectory)


def simulated_shard(seeds: range, frames: int, config: NetworkConfig, path: Path) -> Path:
    """Render the clips of some seeds into one file, unless it is there already."""
    if not path.exists():
        Pairs.concatenate(simulated_clip(seed, frames, config) for seed in seeds).save(path)
    return path


def simulate_shards(
    folder: Path, clips: int, frames: int, first_seed: int, config: NetworkConfig, workers: int
) -> Iterator[Path]:
    """Render all clips, a file for every few of them, yielding each file as it is finished (in order of the seeds)."""
    folder.mkdir(parents=True, exist_ok=True)
    stops = [*range(0, clips, CLIPS_A_SHARD), clips]
    # A forked child would inherit the locks of OpenCV's and torch's threads, and wait for them for ever.
    spawn = multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(workers, mp_context=spawn, initializer=begin_worker)
    try:
        tasks = []
        for start, stop in pairwise(stops):
            seeds = range(first_seed + start, first_seed + stop)
            path = folder / f"clips-{seeds.start}-{seeds.stop}x{frames}-{config.width}x{config.height}.npy"
            tasks.append(pool.submit(simulated_shard, seeds, frames, config, path))
        for task in tasks:
            yield task.result()
    finally:
        pool.shutdown(cancel_futures=True)


def begin_worker() -> None:
    """Workers share the machine, one thread each, and end silently with the command, even if that is killed."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    threading.Thread(target=end_with_parent, daemon=True).start()
    torch.set_num_threads(1)
    import cv2

    cv2.setNumThreads(1)


def end_with_parent() -> None:
    """A worker would otherwise wait for its next task for ever."""
    if (parent := multiprocessing.parent_process()) is not None:
        parent.join()
        os._exit(1)


# --- Augmentation -------------------------------------------------------------------------------


def mirror(batch: Batch, flipped: torch.Tensor) -> Batch:
    """Reflect the pairs where `flipped` (B,) is true, left to right.

    The world's reflection flips the image, the principal point, and the IMU's y axis: a polar vector loses the sign
    of y, an axial vector (angular velocity) those of x and z. Whatever the mounting was, the result is a possible
    recording with another proper mounting.
    """
    width = batch.source.shape[-1]
    signs = torch.tensor([-1.0, 1.0, -1.0, 1.0, -1.0, 1.0], device=batch.imu.device)
    K = batch.K.clone()
    K[:, 0, 2] = width - 1 - K[:, 0, 2]
    return Batch(
        source=torch.where(flipped[:, None, None, None], batch.source.flip(-1), batch.source),
        target=torch.where(flipped[:, None, None, None], batch.target.flip(-1), batch.target),
        source_depth=torch.where(flipped[:, None, None], batch.source_depth.flip(-1), batch.source_depth),
        K=torch.where(flipped[:, None, None], K, batch.K),
        imu=torch.where(flipped[:, None, None], batch.imu * signs, batch.imu),
        interval_s=batch.interval_s,
    )


def drop_imu(batch: Batch, dropped: torch.Tensor) -> Batch:
    """Remove the whole IMU window of some pairs (B,), so that the network learns to do without."""
    imu = torch.where(dropped[:, None, None], torch.full_like(batch.imu, torch.nan), batch.imu)
    return Batch(batch.source, batch.target, batch.source_depth, batch.K, imu, batch.interval_s)
