"""Train VIOLearner without labels: `python -m learned.train --preset fast --out DIR`.

Everything lands in DIR: what it was begun with (run.json), the pairs (data/), the state to resume from
(checkpoint.pt), the curve (curve.csv, curve.png), a picture at every validation (pictures/), and at the end the
weights with their fitted covariance (PRESET.pt). Run the same command again to go on after an interruption: batches
are a function of seed and step, so the curve is the same as without it.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import math
import os
import sys
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from fusion_io.command import answered, command_parser
from fusion_io.errors import EXIT_OK, LogError, UsageError

if TYPE_CHECKING:
    from learned.covariance import CovarianceModel
    from learned.dataset import PairSet
    from learned.optimisation import Descent
    from learned.violearner import VIOLearner
    from learned.weights import Weights


@dataclass(frozen=True)
class Recipe:
    """How a preset is trained.

    Learning rate, momenta, batch, gamma 0.5 and validation every 500 steps of `paper` are the paper's (section
    "Training Procedures"); its decay interval and lambda are not given there: 20,000 steps and 1e-5 are our choice.
    """

    steps: int = 4000
    batch: int = 16
    learning_rate: float = 1e-3
    schedule: Literal["cosine", "exponential"] = "cosine"
    bias_penalty: float = 1e-5
    gradient_norm: float = 1.0
    clips: int = 1280
    frames_a_clip: int = 9
    validation_share: float = 0.05
    validate_every: int = 250
    imu_dropout: float = 0.1
    calibration_clips: int = 128
    refined_calibration_clips: int = 256

    def descent(self) -> Descent:
        """The part of it that the optimiser needs."""
        from learned.optimisation import Descent

        return Descent(
            self.steps, self.batch, self.learning_rate, self.schedule,
            bias_penalty=self.bias_penalty, gradient_norm=self.gradient_norm, imu_dropout=self.imu_dropout,
        )  # fmt: skip


RECIPES = {
    "fast": Recipe(),
    "paper": Recipe(
        steps=100_000, batch=32, learning_rate=2e-4, schedule="exponential", gradient_norm=math.inf,
        validate_every=500, imu_dropout=0.0,
    ),
}  # fmt: skip

CALIBRATION_SEED = 7_000_000
"""Clips of the covariance fit and the final figures: never seen in training or validation."""


DRAWERS = 4
"""Threads that gather batches while a GPU computes; a CPU has nothing to gain from them."""


@dataclass(frozen=True)
class Source:
    """Where pairs come from: a log, or the simulator where `log` is None; `clips` None means the recipe's.

    A pair of a source with weight 2 is drawn twice as often as one with weight 1.
    """

    log: Path | None = None
    clips: int | None = None
    weight: float = 1.0

    def identity(self) -> dict[str, Any]:
        """What tells it from another, without reading it. Raises LogError for a log that does not exist."""
        if self.log is None:
            return {"sim": self.clips, "weight": self.weight}
        try:
            return {"log": self.log.name, "bytes": self.log.stat().st_size, "weight": self.weight}
        except OSError as error:
            raise LogError(f"{self.log}: {error.strerror}") from None


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = command_parser(
        "learned.train",
        description=__doc__.split("\n\n")[0],
        epilog="Exit codes: 0 all well, 1 nothing could be computed, 2 usage, 130 interrupted (run again to go on).",
    )
    parser.add_argument("--preset", choices=sorted(RECIPES), default="fast", help="the recipe (default: fast)")
    parser.add_argument("--out", type=Path, required=True, help="folder for data, checkpoints, curve and weights")
    parser.add_argument(
        "--data", type=_source, nargs="+", action="extend", metavar="SOURCE[@WEIGHT]",
        help="sim, sim:CLIPS or an MCAP log with images and depth; several make a mixture, in which a pair of weight 2 "
        "is drawn twice as often as one of weight 1 (default: sim)",
    )  # fmt: skip
    parser.add_argument("--steps", type=positive_integer, help="number of optimiser steps (default: the preset's)")
    parser.add_argument("--weights", type=Path, help="a weights file to start from (default: random weights)")
    parser.add_argument("--learning-rate", type=positive, help="at its highest (default: the preset's)")
    parser.add_argument("--batch", type=positive_integer, help="pairs a step (default: the preset's)")
    parser.add_argument(
        "--calibration-clips",
        type=positive_integer,
        help="simulated clips to fit the covariance on (default: the preset's)",
    )
    parser.add_argument("--seed", type=int, default=0, help="what all random numbers begin with (default: 0)")
    parser.add_argument("--workers", type=positive_integer, help="processes that render (default: one a core)")
    parser.add_argument("--threads", type=positive_integer, help="threads of the training itself (default: torch's)")
    parser.add_argument("--device", choices=("auto", "cpu", "cuda"), default="auto", help="default: auto")
    parser.add_argument(
        "--precision", choices=("auto", "float32", "bf16"), default="auto",
        help="of the convolutions; geometry is always float32 (default: bf16 on cuda, else float32)",
    )  # fmt: skip
    options = parser.parse_args(arguments)

    from dataclasses import replace

    changes = {"steps": options.steps, "batch": options.batch, "learning_rate": options.learning_rate}
    changes["calibration_clips"] = options.calibration_clips
    changes["refined_calibration_clips"] = options.calibration_clips
    recipe = replace(RECIPES[options.preset], **{name: value for name, value in changes.items() if value})

    def job() -> int:
        train(
            options.preset, recipe, options.out, options.seed, options.workers, options.threads, options.device,
            options.data or (Source(),), options.precision, options.weights,
        )  # fmt: skip
        return EXIT_OK

    return answered(job, "; run the same command again to go on")


def train(
    preset: str,
    recipe: Recipe,
    out: Path,
    seed: int = 0,
    workers: int | None = None,
    threads: int | None = None,
    device: str = "auto",
    data: Sequence[Source] = (Source(),),
    precision: str = "auto",
    start: Path | None = None,
) -> Path:
    """Gather pairs, train, calibrate; returns the path of the weights.

    start: weights to begin with, None for random ones. Raises UsageError where `out` was begun with other settings,
    LogError for a log that cannot be trained on or weights that do not fit the preset, KeyboardInterrupt where the
    user stops it.
    """
    from contextlib import nullcontext
    from functools import partial

    import torch

    from learned import weights
    from learned.optimisation import bfloat16_layers, optimise
    from learned.violearner import PRESETS, VIOLearner

    device = ("cuda" if torch.cuda.is_available() else "cpu") if device == "auto" else device
    precision = ("bf16" if device == "cuda" else "float32") if precision == "auto" else precision
    workers = workers or os.cpu_count() or 1
    if threads:
        torch.set_num_threads(threads)
    if sum(source.log is None for source in data) > 1:
        raise UsageError("the simulator can be a source only once")
    torch.manual_seed(seed)
    model = VIOLearner(PRESETS[preset])
    if start is not None:
        begin_with(model, start)
    begin(out, preset, recipe, seed, data, precision, start, asdict(PRESETS[preset]))
    model.to(device)
    model.to(memory_format=torch.channels_last)  # type: ignore[call-overload]  # missing in torch's stubs

    training, validation = gather(data, model, recipe, out / "data", seed, workers)
    if start is None:
        standardise_imu(model, training)
    with bfloat16_layers(model, device) if precision == "bf16" else nullcontext():
        optimise(
            model, recipe.descent(), recipe.validate_every, training, validation, out, seed, device,
            drawers=min(workers, DRAWERS) if device == "cuda" else 0,
            observe=partial(draw_validation, out, validation, device),
        )  # fmt: skip
    draw_training_curve(out)

    calibration = simulated(model, out / "calibration", recipe.calibration_clips, recipe, CALIBRATION_SEED, workers)
    calibrated, figures = calibrate(model, calibration, recipe.refined_calibration_clips, device)
    print("held-out simulation: " + ", ".join(f"{k} {v:.4g}" for k, v in figures.items()), file=sys.stderr)
    path = out / f"{preset}.pt"
    weights.save(path, calibrated, {"seed": seed, "recipe": asdict(recipe), "held_out": figures})
    return path


def begin_with(model: VIOLearner, start: Path) -> None:
    """Give the network the weights of a file, its IMU statistics included. Raises LogError where they do not fit."""
    from learned import weights

    try:
        model.load_state_dict(weights.load(start).model.state_dict())
    except RuntimeError:  # torch's message lists every tensor
        raise LogError(f"{start}: weights of a network of another shape than the preset's") from None


def begin(
    out: Path,
    preset: str,
    recipe: Recipe,
    seed: int,
    data: Sequence[Source],
    precision: str,
    start: Path | None,
    network: dict[str, Any],
) -> None:
    """Note in run.json what a folder is begun with, or raise UsageError if it was begun with something else."""
    run = {
        "preset": preset, "seed": seed, "precision": precision, "data": [source.identity() for source in data],
        "weights": None if start is None else hashlib.sha256(start.read_bytes()).hexdigest(),
        "recipe": asdict(recipe), "network": network,
    }  # fmt: skip
    text = json.dumps(run, indent=2) + "\n"
    path = out / "run.json"
    if path.exists():
        differences = list(differing(json.loads(path.read_text()), json.loads(text)))
        if differences:
            raise UsageError(f"{out}: begun with {'; '.join(differences)}: use the same settings, or another --out")
        return
    if (out / "checkpoint.pt").exists():
        raise UsageError(f"{out}: has a checkpoint but no run.json to tell how it was begun: use another --out")
    try:
        out.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    except OSError as error:
        raise UsageError(f"{out}: {error.strerror}") from None


def differing(before: dict[str, Any], now: dict[str, Any], prefix: str = "") -> Iterator[str]:
    """What differs between two nested settings, in words."""
    for name in before | now:
        old, new = before.get(name), now.get(name)
        if isinstance(old, dict) and isinstance(new, dict):
            yield from differing(old, new, f"{prefix}{name}.")
        elif old != new:
            yield f"{prefix}{name} {json.dumps(old)}, not {json.dumps(new)}"


def gather(
    data: Sequence[Source], model: VIOLearner, recipe: Recipe, folder: Path, seed: int, workers: int
) -> tuple[PairSet, PairSet]:
    """Training and validation pairs of all sources, rendered or read on the first call.

    Each seed has simulated clips of its own.
    """
    from learned.dataset import Pairs, PairSet, log_shards, split

    sets = []
    for number, source in enumerate(data):
        if source.log is None:
            first_seed = 1_000_000 * (seed + 1) + 10_000_000
            pairs = simulated(model, folder, source.clips or recipe.clips, recipe, first_seed, workers)
        else:
            paths = log_shards(source.log, model.config, folder / f"{number}-{source.log.stem}")
            pairs = PairSet.of(map(Pairs.load, paths))
        sets.append(split(pairs.weighted(source.weight), recipe.validation_share))
    training, validation = zip(*sets, strict=True)
    return PairSet.mixture(training), PairSet.mixture(validation)


def simulated(model: VIOLearner, folder: Path, clips: int, recipe: Recipe, first_seed: int, workers: int) -> PairSet:
    """Pairs of simulated clips, rendered into a folder on the first call."""
    from fusion_io.progress import track
    from learned.dataset import CLIPS_A_SHARD, Pairs, PairSet, simulate_shards

    shards = simulate_shards(folder, clips, recipe.frames_a_clip, first_seed, model.config, workers)
    paths = list(track(shards, f"render {clips} clips", -(-clips // CLIPS_A_SHARD)))
    return PairSet.of(map(Pairs.load, paths))


def standardise_imu(model: VIOLearner, pairs: PairSet) -> None:
    """Set the statistics with which the network standardises its IMU input; without any IMU they stay as they are."""
    import numpy as np
    import torch

    samples = pairs.values("imu").reshape(-1, 6)
    if np.isfinite(samples).any():
        model.imu_mean.copy_(torch.from_numpy(np.nanmean(samples, axis=0)))
        model.imu_std.copy_(torch.from_numpy(np.nanstd(samples, axis=0) + 1e-3))


def draw_validation(out: Path, pairs: PairSet, device: str, model: VIOLearner, step: int) -> None:
    """Draw a few validation pairs as they are estimated after a step."""
    from learned.pictures import draw_pairs

    draw_pairs(out / "pictures" / f"step-{step:06d}.png", model, pairs, device)


def draw_training_curve(out: Path) -> None:
    """Draw curve.csv as curve.png."""
    import numpy as np

    from learned.pictures import draw_curve

    draw_curve(out / "curve.png", np.loadtxt(out / "curve.csv", delimiter=",", skiprows=1, ndmin=2))


def calibrate(model: VIOLearner, pairs: PairSet, refined_clips: int, device: str) -> tuple[Weights, dict[str, float]]:
    """Fit the covariances on held-out simulation; the network's weights, and figures on what was not fitted to.

    Those of the network's winner are fitted on pairs with and without their IMU, that of the refined pose on clips at
    full resolution.
    """
    from learned.covariance import UNCALIBRATED
    from learned.held_out import fit_refined
    from learned.weights import Weights

    covariance, figures = fit_winner(model, pairs, device)
    weights = Weights(model, covariance, UNCALIBRATED, UNCALIBRATED)
    start_covariance, start_figures = fit_winner(weights.as_start().model, pairs, device)
    weights = replace(weights, model=model.cpu(), start_covariance=start_covariance)
    refined_covariance, refined_figures = fit_refined(weights, refined_clips)
    starts = {f"start_{name}": value for name, value in start_figures.items()}
    return replace(weights, refined_covariance=refined_covariance), figures | starts | refined_figures


def fit_winner(model: VIOLearner, pairs: PairSet, device: str) -> tuple[CovarianceModel, dict[str, float]]:
    """The covariance of the network's winner, fitted on one half of the pairs, and the figures on the other half."""
    import numpy as np

    from learned.covariance import fit, hypothesis_spread, mean_nees, pooled, pose_errors
    from learned.optimisation import run

    true, half = pairs.values("T_source_target"), len(pairs) // 2
    results = [run(model, pairs, device, with_imu) for with_imu in (True, False)]
    errors = [pose_errors(result["poses"][:, -1], true) for result in results]
    spread = [pooled(hypothesis_spread(result["hypotheses"], result["poses"][:, -1])) for result in results]
    covariance = fit(errors[0][:half], spread[0][:half], errors[1][:half], spread[1][:half])
    rest = errors[0][half:]
    return covariance, {
        "translation_rmse_m": float(np.sqrt((rest[:, 3:] ** 2).sum(1).mean())),
        "rotation_rmse_rad": float(np.sqrt((rest[:, :3] ** 2).sum(1).mean())),
        "anees": mean_nees(rest, covariance.covariance(spread[0][half:], np.ones(len(rest)))),
    }


def _source(text: str) -> Source:
    name, at, number = text.rpartition("@")
    try:
        weight = float(number) if at else 1.0
    except ValueError:  # the @ belongs to the path
        name, weight = text, 1.0
    name = name or text
    if not 0 < weight < math.inf:
        raise argparse.ArgumentTypeError(f"{text!r}: a weight is positive")
    kind, colon, clips = name.partition(":")
    if kind != "sim":
        return Source(Path(name), weight=weight)
    return Source(clips=positive_integer(clips) if colon else None, weight=weight)


def positive(text: str) -> float:
    """A positive number on the command line."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0 < value < math.inf:
        raise argparse.ArgumentTypeError(f"{text!r} is not a positive number")
    return value


def positive_integer(text: str) -> int:
    """A number of steps, clips or threads on the command line."""
    if not text.isdigit() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is not a positive number")
    return int(text)


if __name__ == "__main__":
    sys.exit(main())
