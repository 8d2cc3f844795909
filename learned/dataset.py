"""Training pairs: rendered by the simulator, kept as arrays at the network's size, mirrored half the time."""

from __future__ import annotations

import multiprocessing
from collections.abc import Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, fields
from itertools import pairwise
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from fusion_io import simulation
from fusion_io.records import NANOSECONDS, FloatArray, ImuSeries, Trajectory
from learned.inputs import NetworkFrame, imu_coverage, imu_window, prepare, to_unit
from learned.violearner import Batch, NetworkConfig

CLIPS_A_SHARD = 32


@dataclass(frozen=True)
class Pairs:
    """N pairs as arrays; the fields of `violearner.Batch`, and ground truth for validation only.

    source, target (N, C, H, W) uint8; source_depth (N, H, W) float16 m; K (N, 3, 3); imu (N, 20, 6) with NaN where
    nothing was measured; interval_s (N,); T_source_target (N, 4, 4).
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

    def batch(self, index: NDArray[np.int64], device: str = "cpu") -> Batch:
        """The pairs of an index as input of the network."""
        return Batch(
            source=to_unit(self.source[index]).to(device),
            target=to_unit(self.target[index]).to(device),
            source_depth=torch.from_numpy(self.source_depth[index].astype(np.float32)).to(device),
            K=torch.from_numpy(self.K[index]).to(device),
            imu=torch.from_numpy(self.imu[index]).to(device),
            interval_s=torch.from_numpy(self.interval_s[index]).to(device),
        )

    def save(self, path: Path) -> None:
        """Write all arrays to one .npz file, complete or not at all."""
        partial = path.with_suffix(".partial.npz")
        np.savez(partial, **{f.name: getattr(self, f.name) for f in fields(self)})
        partial.replace(path)

    @staticmethod
    def load(path: Path) -> Pairs:
        """Read what `save` wrote."""
        with np.load(path) as arrays:
            return Pairs(**{f.name: arrays[f.name] for f in fields(Pairs)})

    @staticmethod
    def concatenate(parts: Iterable[Pairs]) -> Pairs:
        """All pairs of several sets, in order."""
        parts = list(parts)
        return Pairs(**{f.name: np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(Pairs)})


def pairs_of(frames: list[NetworkFrame], imu: ImuSeries, trajectory: Trajectory) -> Pairs:
    """The consecutive pairs of a clip whose poses are known at the frames' stamps."""
    T_world_camera = trajectory.poses.as_matrix()
    usable = [(i, s, t) for i, (s, t) in enumerate(pairwise(frames)) if s.depth is not None]
    depths = [s.depth for _, s, _ in usable if s.depth is not None]
    return Pairs(
        source=np.stack([s.image for _, s, _ in usable]),
        target=np.stack([t.image for _, _, t in usable]),
        source_depth=np.stack(depths).astype(np.float16),
        K=np.stack([s.K for _, s, _ in usable]).astype(np.float32),
        imu=np.stack([measured_window(imu, s.stamp_ns, t.stamp_ns) for _, s, t in usable]).astype(np.float32),
        interval_s=np.array([(t.stamp_ns - s.stamp_ns) / NANOSECONDS for _, s, t in usable], dtype=np.float32),
        T_source_target=np.stack([np.linalg.inv(T_world_camera[i]) @ T_world_camera[i + 1] for i, _, _ in usable]),
    )


def measured_window(imu: ImuSeries, source_ns: int, target_ns: int) -> FloatArray:
    """The IMU window, all NaN where no part of it was measured."""
    window = imu_window(imu, source_ns, target_ns)
    return window if imu_coverage(imu, source_ns, target_ns) > 0 else np.full_like(window, np.nan)


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
    folder: Path,
    clips: int,
    frames: int,
    first_seed: int,
    config: NetworkConfig,
    workers: int,
    clips_a_shard: int = CLIPS_A_SHARD,
) -> Iterator[Path]:
    """Render all clips, a shard a task, yielding each file as it is finished (in order of the seeds)."""
    folder.mkdir(parents=True, exist_ok=True)
    stops = [*range(0, clips, CLIPS_A_SHARD), clips]
    # A forked child would inherit the locks of OpenCV's and torch's threads, and wait for them for ever.
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(workers, mp_context=spawn, initializer=single_thread) as pool:
        tasks = []
        for start, stop in pairwise(stops):
            seeds = range(first_seed + start, first_seed + stop)
            path = folder / f"clips-{seeds.start}-{seeds.stop}x{frames}-{config.width}x{config.height}.npz"
            tasks.append(pool.submit(simulated_shard, seeds, frames, config, path))
        for task in tasks:
            yield task.result()


def single_thread() -> None:
    """Workers share the machine: one thread each."""
    torch.set_num_threads(1)
    import cv2

    cv2.setNumThreads(1)


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


def select(pairs: Pairs, index: slice) -> Pairs:
    """A part of a set of pairs."""
    return Pairs(**{f.name: getattr(pairs, f.name)[index] for f in fields(Pairs)})
