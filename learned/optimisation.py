"""Stochastic descent on the photometric error: what training and adaptation share."""

from __future__ import annotations

import csv
import io
import math
import os
import signal
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from torch import nn

from fusion_io.errors import LogError
from fusion_io.records import FloatArray
from learned.dataset import PairSet, drop_imu, mirror
from learned.scores import score
from learned.violearner import SCALES, Batch, ImuPathway, VIOLearner, loss

LEVELS = len(SCALES)
MOMENTA = (0.9, 0.99)
WARM_UP_STEPS = 100
PAIRS_A_BATCH = 32
"""Pairs of a batch of inference."""

PREFETCHED = 4
"""Batches that are drawn ahead of their use by each drawer."""


@dataclass(frozen=True)
class Descent:
    """How the optimiser descends.

    schedule: "cosine" with a warm-up, or "exponential", which halves the learning rate every half_life steps.
    gradient_norm: gradients are clipped to it. imu_dropout: share of the pairs that are shown without their IMU.
    """

    steps: int
    batch: int
    learning_rate: float
    schedule: Literal["cosine", "exponential"] = "cosine"
    half_life: int = 20_000
    bias_penalty: float = 1e-5
    gradient_norm: float = 1.0
    imu_dropout: float = 0.1

    def learning_rate_at(self, step: int) -> float:
        """Warm-up and cosine decay to a hundredth, or the paper's exponential policy with gamma 0.5."""
        if self.schedule == "exponential":
            return self.learning_rate * math.pow(0.5, step / self.half_life)
        warm = min(1.0, (step + 1) / WARM_UP_STEPS)
        return self.learning_rate * warm * (0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * step / self.steps)))


@dataclass
class State:
    """Where an optimisation stands: all that its future depends on, besides the pairs and the model's weights.

    curve: the rows of curve.csv; losses: of the steps since the last row; best_state: the weights that were best on
    validation, with the error `best`.
    """

    step: int = 0
    best: float = math.inf
    best_state: dict[str, torch.Tensor] = field(default_factory=dict)
    losses: list[float] = field(default_factory=list)
    curve: list[list[float]] = field(default_factory=list)


class Interrupted(KeyboardInterrupt):
    """The user stopped an optimisation; its state is saved."""


def adam(model: VIOLearner, descent: Descent) -> torch.optim.Optimizer:
    """The optimiser, with the paper's momenta."""
    return torch.optim.Adam(model.parameters(), descent.learning_rate, betas=MOMENTA, fused=True)


def descend(model: VIOLearner, optimiser: torch.optim.Optimizer, batch: Batch, descent: Descent, step: int) -> float:
    """One step of the optimiser; returns the loss before it."""
    model.train()
    value = loss(model(batch), model, descent.bias_penalty)
    optimiser.zero_grad()
    value.backward()  # type: ignore[no-untyped-call]
    torch.nn.utils.clip_grad_norm_(model.parameters(), descent.gradient_norm)
    for group in optimiser.param_groups:
        group["lr"] = descent.learning_rate_at(step)
    optimiser.step()
    return float(value.detach())


def draw_batch(pairs: PairSet, descent: Descent, seed: int, step: int, device: str) -> Batch:
    """The batch of a step: a function of seed and step alone, so that resuming changes nothing."""
    rng = np.random.default_rng([seed, step])
    batch = pairs.batch(pairs.draw(rng, descent.batch), device)
    batch = mirror(batch, torch.from_numpy(rng.random(descent.batch) < 0.5).to(device))
    return drop_imu(batch, torch.from_numpy(rng.random(descent.batch) < descent.imu_dropout).to(device))


def ahead(draw: Callable[[int], Batch], steps: Iterable[int], drawers: int) -> Iterator[tuple[int, Batch]]:
    """Each step with its batch, drawn by threads while earlier batches are in use; none ahead with 0 drawers."""
    if drawers == 0:
        for step in steps:
            yield step, draw(step)
        return
    pool = ThreadPoolExecutor(drawers)
    try:
        waiting: deque[tuple[int, Future[Batch]]] = deque()
        for step in steps:
            waiting.append((step, pool.submit(draw, step)))
            if len(waiting) > PREFETCHED * drawers:
                first, future = waiting.popleft()
                yield first, future.result()
        for last, future in waiting:
            yield last, future.result()
    finally:
        pool.shutdown(cancel_futures=True)


def optimise(
    model: VIOLearner,
    descent: Descent,
    validate_every: int,
    training: PairSet,
    validation: PairSet,
    out: Path,
    seed: int = 0,
    device: str = "cpu",
    drawers: int = 0,
    observe: Callable[[VIOLearner, int], None] = lambda model, step: None,
) -> None:
    """Run the optimisation, or resume it from the checkpoint in `out`; the model ends as it was best on validation.

    drawers: threads that draw batches ahead. `observe` is called with the model and the step after every validation.
    SIGINT ends it after the step, with a checkpoint, by raising Interrupted. Raises LogError for a checkpoint that is
    not one.
    """
    optimiser = adam(model, descent)
    checkpoint = out / "checkpoint.pt"
    state = restore(checkpoint, model, optimiser, device) if checkpoint.exists() else State()
    with interruption() as stop:
        write_curve(out / "curve.csv", state.curve)  # whoever sees it may interrupt
        batches = ahead(
            lambda s: draw_batch(training, descent, seed, s, device), range(state.step, descent.steps), drawers
        )
        for step, batch in batches:
            state.losses.append(descend(model, optimiser, batch, descent, step))
            state.step = step + 1
            due = state.step % validate_every == 0 or state.step == descent.steps
            if due:
                validate(model, validation, device, state)
                observe(model, state.step)
            if due or stop.is_set():
                save(checkpoint, model, optimiser, state)
                write_curve(out / "curve.csv", state.curve)
            if stop.is_set():
                raise Interrupted(f"stopped after step {state.step} of {descent.steps}")
    model.load_state_dict(state.best_state)


def validate(model: VIOLearner, pairs: PairSet, device: str, state: State) -> None:
    """Add a row to the curve and keep the model's weights if they are the best so far.

    The photometric error of the last level selects; translation RMSE (m) by level only informs, where it is known.
    """
    result = run(model, pairs, device)
    photometric = float(np.average(result["error"], weights=pairs.weights))
    if photometric < state.best or not state.best_state:
        state.best, state.best_state = photometric, copy_of(model)
    by_level = translation_rmse(result["poses"], pairs.values("T_source_target"))
    state.curve.append([state.step, float(np.mean(state.losses)), photometric, *by_level])
    levels = " ".join(f"{v:.3f}" for v in by_level)
    print(
        f"step {state.step}: loss {np.mean(state.losses):.4f}, validation {photometric:.4f}, "
        f"translation RMSE by level {levels} m",
        file=sys.stderr,
    )
    state.losses = []


def run(model: VIOLearner, pairs: PairSet, device: str, with_imu: bool = True) -> dict[str, FloatArray]:
    """Inference over all pairs: poses (N, 5, 4, 4) after each level, hypotheses (N, 4, 4, 4), error (N,)."""
    parts: dict[str, list[torch.Tensor]] = {"poses": [], "hypotheses": [], "error": []}
    model.eval()
    with torch.inference_mode():
        for start in range(0, len(pairs), PAIRS_A_BATCH):
            batch = pairs.batch(np.arange(start, min(start + PAIRS_A_BATCH, len(pairs))), device)
            if not with_imu:
                batch = drop_imu(batch, torch.ones(len(batch), dtype=torch.bool, device=device))
            estimate = model(batch)
            parts["poses"].append(model.pose_source_target(torch.stack(estimate.poses, dim=1)))
            parts["hypotheses"].append(model.pose_source_target(estimate.hypotheses))
            parts["error"].append(estimate.errors[-1])
    return {name: torch.cat(values).double().cpu().numpy() for name, values in parts.items()}


def translation_rmse(poses: FloatArray, true: FloatArray) -> list[float]:
    """RMSE (m) by level of poses (N, L, 4, 4) over the pairs whose truth (N, 4, 4) is known; NaN where none is."""
    known = np.isfinite(true).all((1, 2))
    if not known.any():
        return [math.nan] * poses.shape[1]
    return [score("", poses[known, level], true[known])["translation_rmse_m"] for level in range(poses.shape[1])]


def copy_of(model: VIOLearner) -> dict[str, torch.Tensor]:
    """The weights as they are now."""
    return {name: value.clone() for name, value in model.state_dict().items()}


# --- Checkpoint and curve -----------------------------------------------------------------------


def save(path: Path, model: VIOLearner, optimiser: torch.optim.Optimizer, state: State) -> None:
    """Write a checkpoint, complete or not at all, whatever happens to the process or the machine."""
    partial = path.with_suffix(".partial")
    with partial.open("wb") as file:
        torch.save({"model": model.state_dict(), "optimiser": optimiser.state_dict(), "state": vars(state)}, file)
        file.flush()
        os.fsync(file.fileno())
    partial.replace(path)


def restore(path: Path, model: VIOLearner, optimiser: torch.optim.Optimizer, device: str) -> State:
    """What `save` wrote, put back into model and optimiser. Raises LogError for anything else."""
    try:
        saved: dict[str, Any] = torch.load(path, map_location=device, weights_only=True)
        model.load_state_dict(saved["model"])
        optimiser.load_state_dict(saved["optimiser"])
        return State(**saved["state"])
    except Exception as error:  # torch raises many kinds for a file that is not its own
        raise LogError(f"{path}: not a checkpoint of this network: {' '.join(str(error).split())[:200]}") from error


def write_curve(path: Path, rows: list[list[float]]) -> None:
    """Write the whole curve: the checkpoint holds it, so that no row is lost or doubled by an interruption."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    levels = [f"translation_rmse_m_level_{i}" for i in range(LEVELS)]
    writer.writerow(["step", "training_loss", "validation_error", *levels])
    for step, *values in rows:
        writer.writerow([step, *(f"{value:.6g}" for value in values)])
    partial = path.with_suffix(".partial")
    partial.write_text(text.getvalue())
    partial.replace(path)


@contextmanager
def interruption() -> Iterator[threading.Event]:
    """An event that SIGINT sets, instead of raising KeyboardInterrupt in the middle of a step."""
    stop = threading.Event()
    if threading.current_thread() is not threading.main_thread():  # only there do signals arrive
        yield stop
        return
    before = signal.signal(signal.SIGINT, lambda number, frame: stop.set())
    try:
        yield stop
    finally:
        signal.signal(signal.SIGINT, before)


# --- Precision ----------------------------------------------------------------------------------


@contextmanager
def bfloat16_layers(model: VIOLearner, device: str) -> Iterator[None]:
    """Let the convolutions over images compute in bfloat16; all else, the geometry above all, stays in float32.

    So does the IMU: it costs little, and where the kernel is wider than the map, oneDNN 3.x on a CPU with AMX returns
    numbers that are wrong or not finite.
    """
    inertial = {layer for part in model.modules() if isinstance(part, ImuPathway) for layer in part.modules()}
    layers = [m for m in model.modules() if isinstance(m, nn.Conv2d) and m not in inertial]
    autocast = torch.autocast(torch.device(device).type, torch.bfloat16)
    for layer in layers:
        layer.forward = autocast(layer.forward)  # type: ignore[method-assign]
    try:
        yield
    finally:
        for layer in layers:
            del layer.forward
