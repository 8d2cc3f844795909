"""Train VIOLearner without labels: `python -m learned.train --preset fast --out DIR`.

Everything lands in DIR: rendered pairs (data/), the state to resume from (checkpoint.pt), the curve (curve.csv),
and at the end the weights with their fitted covariance (PRESET.pt). Run the same command again to go on after an
interruption: batches are a function of seed and step, so the curve is the same as without it.
"""

from __future__ import annotations

import argparse
import csv
import math
import sys
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import numpy as np
    import torch

    from learned.dataset import Pairs
    from learned.violearner import VIOLearner


@dataclass(frozen=True)
class Recipe:
    """How a preset is trained.

    Learning rate, momenta and batch of `paper` are the paper's (section "Training Procedures");
    its decay interval and lambda are not given there: gamma 0.5 every 20,000 steps and 1e-5 are our choice.
    """

    steps: int = 4000
    batch: int = 16
    learning_rate: float = 1e-3
    schedule: str = "cosine"
    bias_penalty: float = 1e-5
    gradient_norm: float = 1.0
    clips: int = 640
    frames_a_clip: int = 9
    validation_share: float = 0.05
    validate_every: int = 250
    imu_dropout: float = 0.1
    calibration_clips: int = 128


RECIPES = {
    "fast": Recipe(),
    "paper": Recipe(
        steps=100_000, batch=32, learning_rate=2e-4, schedule="exponential", gradient_norm=math.inf,
        validate_every=500, imu_dropout=0.0,
    ),
}  # fmt: skip

MOMENTA = (0.9, 0.99)
WARM_UP_STEPS = 100
CALIBRATION_SEED = 7_000_000
"""Clips of the covariance fit and the final figures: never seen in training or validation."""


def main(arguments: list[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = argparse.ArgumentParser(prog="python -m learned.train", description=__doc__.split("\n\n")[0])
    parser.add_argument("--preset", choices=sorted(RECIPES), default="fast")
    parser.add_argument("--out", type=Path, required=True, help="folder for data, checkpoints, curve and weights")
    parser.add_argument("--steps", type=int, help="number of optimiser steps (default: the preset's)")
    parser.add_argument("--clips", type=int, help="number of simulated clips to train on (default: the preset's)")
    parser.add_argument("--batch", type=int, help="pairs a step (default: the preset's)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--workers", type=int, default=2, help="processes that render (default 2)")
    parser.add_argument("--threads", type=int, default=0, help="threads of the training itself (default: torch's)")
    parser.add_argument("--device", default="auto", help="auto, cpu or cuda")
    options = parser.parse_args(arguments)

    from dataclasses import replace

    from fusion_io.errors import EXIT_FAILED, EXIT_OK, FusionError

    changes = {k: getattr(options, k) for k in ("steps", "clips", "batch") if getattr(options, k) is not None}
    recipe = replace(RECIPES[options.preset], **changes)
    try:
        train(options.preset, recipe, options.out, options.seed, options.workers, options.threads, options.device)
    except FusionError as error:
        print(f"error: {error}", file=sys.stderr)
        return EXIT_FAILED
    return EXIT_OK


def train(preset: str, recipe: Recipe, out: Path, seed: int, workers: int, threads: int, device: str) -> Path:
    """Render, train, calibrate; returns the path of the weights."""
    import torch

    from learned import weights
    from learned.violearner import PRESETS, VIOLearner

    if threads:
        torch.set_num_threads(threads)
    if device == "auto":
        device = "cuda" if torch.cuda.is_available() else "cpu"
    out.mkdir(parents=True, exist_ok=True)
    torch.manual_seed(seed)
    model = VIOLearner(PRESETS[preset]).to(device)

    pairs = render(model, recipe, out, seed, workers)
    held_out = max(1, round(recipe.validation_share * len(pairs)))
    training, validation = split(pairs, len(pairs) - held_out)
    standardise_imu(model, training)
    optimise(model, recipe, training, validation, out, seed, device)

    calibration = simulated(model, out / "calibration", recipe.calibration_clips, recipe, CALIBRATION_SEED, workers)
    model.eval()
    covariance, figures = calibrate(model, calibration, device)
    print("held-out simulation: " + ", ".join(f"{k} {v:.4g}" for k, v in figures.items()), file=sys.stderr)
    path = out / f"{preset}.pt"
    weights.save(path, model, covariance, {"seed": seed, "recipe": asdict(recipe), "held_out": figures})
    return path


def render(model: VIOLearner, recipe: Recipe, out: Path, seed: int, workers: int) -> Pairs:
    """The simulated pairs of a training run; each seed has clips of its own."""
    return simulated(model, out / "data", recipe.clips, recipe, 1_000_000 * (seed + 1) + 10_000_000, workers)


def simulated(model: VIOLearner, folder: Path, clips: int, recipe: Recipe, first_seed: int, workers: int) -> Pairs:
    """Pairs of simulated clips, rendered into a folder on the first call."""
    from fusion_io.progress import track
    from learned.dataset import CLIPS_A_SHARD, Pairs, simulate_shards

    shards = simulate_shards(folder, clips, recipe.frames_a_clip, first_seed, model.config, workers)
    paths = track(shards, f"render {clips} clips", -(-clips // CLIPS_A_SHARD))
    return Pairs.concatenate(Pairs.load(path) for path in paths)


def split(pairs: Pairs, count: int) -> tuple[Pairs, Pairs]:
    """The first `count` pairs, and the rest (whole clips lie together, so few clips are cut)."""
    from learned.dataset import select

    return select(pairs, slice(0, count)), select(pairs, slice(count, None))


def standardise_imu(model: VIOLearner, pairs: Pairs) -> None:
    """Set the statistics with which the network standardises its IMU input."""
    import numpy as np
    import torch

    samples = pairs.imu.reshape(-1, 6)
    model.imu_mean.copy_(torch.from_numpy(np.nanmean(samples, axis=0)))
    model.imu_std.copy_(torch.from_numpy(np.nanstd(samples, axis=0) + 1e-3))


def optimise(
    model: VIOLearner, recipe: Recipe, training: Pairs, validation: Pairs, out: Path, seed: int, device: str
) -> None:
    """Run or resume the optimisation; the model ends with the weights that were best on validation."""
    import torch

    from learned.violearner import loss

    out.mkdir(parents=True, exist_ok=True)
    optimiser = torch.optim.Adam(model.parameters(), recipe.learning_rate, betas=MOMENTA)
    schedule = torch.optim.lr_scheduler.LambdaLR(optimiser, lambda step: learning_rate_factor(recipe, step))
    checkpoint = out / "checkpoint.pt"
    start, best, best_state = 0, math.inf, model.state_dict()
    if checkpoint.exists():
        saved = torch.load(checkpoint, map_location=device, weights_only=True)
        model.load_state_dict(saved["model"])
        optimiser.load_state_dict(saved["optimiser"])
        schedule.load_state_dict(saved["schedule"])
        start, best, best_state = saved["step"], saved["best"], saved["best_state"]
    for step in range(start, recipe.steps):
        model.train()
        estimate = model(draw_batch(training, recipe, seed, step, device))
        value = loss(estimate, model, recipe.bias_penalty)
        optimiser.zero_grad()
        value.backward()  # type: ignore[no-untyped-call]
        torch.nn.utils.clip_grad_norm_(model.parameters(), recipe.gradient_norm)
        optimiser.step()
        schedule.step()
        done = step + 1
        if done % recipe.validate_every == 0 or done == recipe.steps:
            photometric, by_level = validate(model, validation, device)
            if photometric < best:
                best, best_state = photometric, {k: v.clone() for k, v in model.state_dict().items()}
            log_curve(out / "curve.csv", done, float(value.detach()), photometric, by_level)
            state: dict[str, Any] = {
                "model": model.state_dict(), "optimiser": optimiser.state_dict(), "schedule": schedule.state_dict(),
                "step": done, "best": best, "best_state": best_state,
            }  # fmt: skip
            torch.save(state, checkpoint.with_suffix(".partial"))
            checkpoint.with_suffix(".partial").replace(checkpoint)
    model.load_state_dict(best_state)


def learning_rate_factor(recipe: Recipe, step: int) -> float:
    """Warm-up and cosine decay, or the paper's exponential policy."""
    if recipe.schedule == "exponential":
        return float(0.5 ** (step / 20_000))
    warm = min(1.0, (step + 1) / WARM_UP_STEPS)
    return warm * (0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * step / recipe.steps)))


def draw_batch(pairs: Pairs, recipe: Recipe, seed: int, step: int, device: str) -> Any:
    """The batch of a step: a function of seed and step alone, so that resuming changes nothing."""
    import numpy as np
    import torch

    from learned.dataset import drop_imu, mirror

    rng = np.random.default_rng([seed, step])
    batch = pairs.batch(rng.choice(len(pairs), recipe.batch, replace=len(pairs) < recipe.batch), device)
    batch = mirror(batch, torch.from_numpy(rng.random(recipe.batch) < 0.5).to(device))
    return drop_imu(batch, torch.from_numpy(rng.random(recipe.batch) < recipe.imu_dropout).to(device))


def run(model: VIOLearner, pairs: Pairs, device: str, with_imu: bool = True) -> dict[str, np.ndarray[Any, Any]]:
    """Inference over all pairs: poses (N, 5, 4, 4) after each level, hypotheses (N, 4, 4, 4), error (N,)."""
    import numpy as np
    import torch

    from learned.dataset import drop_imu

    parts: dict[str, list[torch.Tensor]] = {"poses": [], "hypotheses": [], "error": []}
    with torch.inference_mode():
        for start in range(0, len(pairs), 32):
            batch = pairs.batch(np.arange(start, min(start + 32, len(pairs))), device)
            if not with_imu:
                batch = drop_imu(batch, torch.ones(len(batch), dtype=torch.bool, device=device))
            estimate = model(batch)
            parts["poses"].append(model.pose_source_target(torch.stack(estimate.poses, dim=1)))
            parts["hypotheses"].append(model.pose_source_target(estimate.hypotheses))
            parts["error"].append(estimate.errors[-1])
    return {name: torch.cat(values).cpu().numpy() for name, values in parts.items()}


def validate(model: VIOLearner, pairs: Pairs, device: str) -> tuple[float, list[float]]:
    """Photometric error of the last level, which selects, and translation RMSE (m) by level, which only informs."""
    import numpy as np

    from learned.covariance import pose_errors

    model.eval()
    result = run(model, pairs, device)
    by_level = [
        float(np.sqrt((pose_errors(result["poses"][:, level], pairs.T_source_target)[:, 3:] ** 2).sum(1).mean()))
        for level in range(5)
    ]
    return float(result["error"].mean()), by_level


def calibrate(model: VIOLearner, pairs: Pairs, device: str) -> tuple[Any, dict[str, float]]:
    """Fit the covariance on the first half of held-out pairs; report its consistency and the errors on the other."""
    import numpy as np

    from learned.covariance import fit, hypothesis_spread, mean_nees, pose_errors

    sets = {}
    for with_imu in (True, False):
        result = run(model, pairs, device, with_imu)
        errors = pose_errors(result["poses"][:, -1], pairs.T_source_target)
        sets[with_imu] = errors, hypothesis_spread(result["hypotheses"], result["poses"][:, -1])
    half = len(pairs) // 2
    covariance = fit(sets[True][0][:half], sets[True][1][:half], sets[False][0][:half], sets[False][1][:half])
    errors, spread = sets[True][0][half:], sets[True][1][half:]
    return covariance, {
        "translation_rmse_m": float(np.sqrt((errors[:, 3:] ** 2).sum(1).mean())),
        "rotation_rmse_rad": float(np.sqrt((errors[:, :3] ** 2).sum(1).mean())),
        "anees": mean_nees(errors, covariance.covariance(spread, np.ones(len(errors)))),
    }


def log_curve(path: Path, step: int, loss: float, photometric: float, by_level: list[float]) -> None:
    """Append a line to the curve, and show it."""
    new = not path.exists()
    with path.open("a", newline="") as file:
        writer = csv.writer(file)
        if new:
            writer.writerow(
                ["step", "training_loss", "validation_error", *(f"translation_rmse_m_level_{i}" for i in range(5))]
            )
        writer.writerow([step, f"{loss:.5f}", f"{photometric:.5f}", *(f"{v:.4f}" for v in by_level)])
    levels = " ".join(f"{v:.3f}" for v in by_level)
    print(
        f"step {step}: loss {loss:.4f}, validation {photometric:.4f}, translation RMSE by level {levels} m",
        file=sys.stderr,
    )


if __name__ == "__main__":
    sys.exit(main())
