"""Pictures of a training: what the network sees, what it makes of it, and the curve."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from matplotlib.figure import Figure

from fusion_io.records import FloatArray
from learned.dataset import PairSet
from learned.violearner import Batch, Estimate, VIOLearner
from learned.warp import project, sample

SHOWN_PAIRS = 3
ROW_HEIGHT = 1.1
DPI = 100


def draw_pairs(path: Path, model: VIOLearner, pairs: PairSet, device: str) -> None:
    """Source, target, the target warped to the source (or as the network's warp has it), and errors by level.

    A column for each of a few pairs, spread evenly over the set. Errors are absolute differences of brightness, from
    0 to 0.3 of the range; pixels without depth or out of sight are white.
    """
    index = np.unique(np.linspace(0, len(pairs) - 1, SHOWN_PAIRS).round().astype(np.int64))
    batch = pairs.batch(index, device)
    model.eval()
    with torch.inference_mode():
        estimate = model(batch)
        warps = [warp(model, batch, pose) for pose in estimate.poses]
    rows = 3 + len(warps)
    figure = Figure(figsize=(len(index) * ROW_HEIGHT * 3.75, rows * ROW_HEIGHT), dpi=DPI, layout="constrained")
    axes = figure.subplots(rows, len(index), squeeze=False)
    for column in range(len(index)):
        images = [batch.source[column], batch.target[column], warps[-1][0][column]]
        for row, (name, image) in enumerate(zip(("source", "target", "warped"), images, strict=True)):
            axes[row, column].imshow(displayed(image), cmap="gray", vmin=0, vmax=1)
            axes[row, column].set_ylabel(name if column == 0 else "")
        for level, (_, error) in enumerate(warps):
            axis = axes[3 + level, column]
            axis.imshow(error[column].cpu().numpy(), cmap="inferno", vmin=0, vmax=0.3)
            axis.set_ylabel(f"level {level}" if column == 0 else "")
            axis.set_xlabel(f"photometric error {photometric(estimate, level, column):.4f}", fontsize=7)
    for axis in axes.flat:
        axis.set_xticks([])
        axis.set_yticks([])
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path)


def photometric(estimate: Estimate, level: int, pair: int) -> float:
    """The error that the level is trained on."""
    return float(estimate.errors[level][pair])


def warp(model: VIOLearner, batch: Batch, pose: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """The image (B, C, H, W) that the pose makes of the other, and its error (B, H, W); NaN where nothing is seen."""
    forward = model.config.warp == "source_to_target"
    sampled, reference = (batch.target, batch.source) if forward else (batch.source, batch.target)
    grid, visible = project(batch.source_depth, batch.K, pose)
    warped = sample(sampled, grid)
    error = (warped - reference).abs().mean(1)
    return torch.where(visible[:, None], warped, torch.nan), torch.where(visible, error, torch.nan)


def displayed(image: torch.Tensor) -> np.ndarray[tuple[int, ...], np.dtype[np.float32]]:
    """An image (C, H, W) as matplotlib takes it, grey or RGB."""
    values = image.float().cpu().numpy()
    return np.asarray(values[0] if len(values) == 1 else values.transpose(1, 2, 0), dtype=np.float32)


def draw_curve(path: Path, rows: FloatArray) -> None:
    """The rows of curve.csv over the steps: loss and validation error, and translation RMSE by level where known."""
    steps, loss, validation, *levels = rows.T
    figure = Figure(figsize=(8, 6), dpi=DPI, layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True)
    above.plot(steps, loss, label="training loss (sum of the levels)")
    above.plot(steps, validation, label="validation error (last level)")
    above.set_ylabel("photometric error")
    above.legend()
    for level, values in enumerate(levels):
        if np.isfinite(values).any():
            below.semilogy(steps, values, label=f"level {level}")
    below.set_ylabel("translation RMSE a pair (m)")
    below.set_xlabel("step")
    if below.lines:
        below.legend()
    figure.savefig(path)
