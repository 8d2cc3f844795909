"""Pairs and a network small enough that a step of training takes milliseconds."""

from pathlib import Path

import numpy as np
import torch

from learned.dataset import Pairs, PairSet
from learned.violearner import NetworkConfig, VIOLearner

TINY = NetworkConfig(height=32, width=64, trunk_filters=4, extra_filters=4, imu_filters=(2, 2, 4, 4, 4, 4, 4))


def random_pairs(count: int = 8, seed: int = 0) -> Pairs:
    """Noise, for what must hold whatever the images show."""
    rng = np.random.default_rng(seed)
    images = rng.integers(0, 255, (2, count, TINY.channels, TINY.height, TINY.width), dtype=np.uint8)
    K = np.array([[40, 0, 31.5], [0, 40, 15.5], [0, 0, 1]], dtype=np.float32)
    return Pairs(
        source=images[0],
        target=images[1],
        source_depth=rng.uniform(4, 20, (count, TINY.height, TINY.width)).astype(np.float16),
        K=np.tile(K, (count, 1, 1)),
        imu=rng.normal(size=(count, 20, 6)).astype(np.float32),
        interval_s=np.full(count, 0.1, np.float32),
        T_source_target=np.tile(np.eye(4), (count, 1, 1)),
    )


def random_set(folder: Path, count: int = 8) -> PairSet:
    """Random pairs on disk, in two files."""
    pairs = PairSet.of([random_pairs(count)])
    half = np.arange(count // 2)
    for name, index in (("a", half), ("b", half + count // 2)):
        pairs.take(index).save(folder / f"{name}.npy")
    return PairSet.of(Pairs.load(folder / f"{name}.npy") for name in "ab")


def new_model() -> VIOLearner:
    """The same untrained network every time."""
    torch.manual_seed(0)
    return VIOLearner(TINY)
