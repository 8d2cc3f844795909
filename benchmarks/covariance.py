"""Which covariance to ship: spread about the winner or the mean, a mixture, the Hessian of the refinement, or both.

``python benchmarks/covariance.py [--clips 48] [--frames 5] [--log X.mcap ...]`` renders drives that no training has
seen at full size (2 s of processor time a frame) as an imperfect rig would record them (`learned.held_out`), estimates
their pairs with the shipped weights (or ``--weights``), fits gain and floor of every form on every second clip and
judges it on the others, and on the logs given. It prints figures and asserts nothing.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from fusion_io import simulation
from fusion_io.progress import track
from fusion_io.reader import open_log
from fusion_io.records import FloatArray, Trajectory
from learned import weights as weights_file
from learned.calibration import constant_nll, inside, nees, negative_log_likelihood, rank_correlation
from learned.comparison import Comparison, compare
from learned.covariance import UNCALIBRATED, CovarianceModel, fit, hypothesis_spread, pose_errors
from learned.estimator import infer
from learned.held_out import Rig, imperfect
from learned.scores import mean_poses, score
from learned.weights import Weights

FIRST_SEED = 9_000_000  # training draws from 11,000,000 on, calibration from 7,000,000 and 8,000,000


@dataclass(frozen=True)
class Pairs:
    """N refined pairs.

    The true pose (N, 4, 4), the hypotheses (N, M, 4, 4) and their photometric errors (N, M), the winner and the refined
    pose (N, 4, 4), and the inverse of the refinement's Hessian (N, 6, 6).
    """

    truth: FloatArray
    hypotheses: FloatArray
    errors: FloatArray
    winner: FloatArray
    refined: FloatArray
    hessian: FloatArray

    @staticmethod
    def of(comparison: Comparison, errors: FloatArray) -> Pairs:
        """The pairs of a comparison that were refined; errors (N, M)."""
        kept = comparison.was_refined
        return Pairs(
            comparison.truth[kept],
            comparison.hypotheses[kept],
            errors[kept],
            comparison.network.T_source_target[kept],
            comparison.refined.T_source_target[kept],
            comparison.refined.covariances[kept],
        )

    @staticmethod
    def join(parts: Sequence[Pairs]) -> Pairs:
        """The pairs of all parts."""
        return Pairs(*(np.concatenate(arrays) for arrays in zip(*(vars(p).values() for p in parts), strict=True)))


Form = Callable[[Pairs], tuple[FloatArray, FloatArray]]
"""Poses (N, 4, 4) and the raw covariances (N, 6, 6) that gain and floor are fitted to."""


def about_winner(pairs: Pairs) -> tuple[FloatArray, FloatArray]:
    """The winner, and the spread of the hypotheses about it."""
    return pairs.winner, hypothesis_spread(pairs.hypotheses, pairs.winner)


def about_mean(pairs: Pairs) -> tuple[FloatArray, FloatArray]:
    """The mean of the hypotheses, and their spread about it."""
    mean = mean_poses(pairs.hypotheses)
    return mean, hypothesis_spread(pairs.hypotheses, mean)


def mixture(fitted_on: Pairs) -> Form:
    """Mean and second moment of the hypotheses, weighted down by e for the usual range of photometric errors.

    The moments of the mixture, as a back end takes a single Gaussian.
    """
    usual = np.median(np.ptp(fitted_on.errors, axis=1))

    def moments(pairs: Pairs) -> tuple[FloatArray, FloatArray]:
        weights = np.exp(-(pairs.errors - pairs.errors.min(1, keepdims=True)) / usual)
        shares = (weights / weights.sum(1, keepdims=True)).T[..., None, None]
        mean = mean_poses(pairs.hypotheses, weights)
        each = [hypothesis_spread(T[:, None], mean) for T in pairs.hypotheses.swapaxes(0, 1)]
        return mean, np.sum(shares * each, axis=0)

    return moments


def hessian(pairs: Pairs) -> tuple[FloatArray, FloatArray]:
    """The refined pose, and the inverse of the Hessian there."""
    return pairs.refined, pairs.hessian


def refined_spread(pairs: Pairs) -> tuple[FloatArray, FloatArray]:
    """The refined pose, and the spread of the hypotheses about it."""
    return pairs.refined, hypothesis_spread(pairs.hypotheses, pairs.refined)


def refined_constant(pairs: Pairs) -> tuple[FloatArray, FloatArray]:
    """The refined pose with a floor only."""
    return pairs.refined, np.zeros((len(pairs.truth), 6, 6))


def both(fitted_on: Pairs) -> Form:
    """The refined pose, and the sum of Hessian and spread, each scaled by the gain that fits it alone."""
    gains = []
    for form in (hessian, refined_spread):
        pose, raw = form(fitted_on)
        gain = np.array(fit(pose_errors(pose, fitted_on.truth), raw).gain)
        gains.append(np.outer(gain, gain))

    def summed(pairs: Pairs) -> tuple[FloatArray, FloatArray]:
        return pairs.refined, gains[0] * pairs.hessian + gains[1] * refined_spread(pairs)[1]

    return summed


def main() -> None:
    """Render, fit, judge, print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--clips", type=int, default=48)
    parser.add_argument("--frames", type=int, default=5, help="frames a clip")
    parser.add_argument("--size", type=int, nargs=2, default=(1242, 375), metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--weights", type=Path)
    parser.add_argument("--log", type=Path, nargs="*", default=[], help="logs with ground truth to judge on as well")
    options = parser.parse_args()

    weights = replace(weights_file.load(options.weights), refined_covariance=UNCALIBRATED)
    seeds = range(FIRST_SEED, FIRST_SEED + options.clips)
    clips = [simulated(weights, seed, options.frames, options.size) for seed in track(seeds, "clips", len(seeds))]
    fitted_on = Pairs.join(clips[::2])
    judged = {"held-out simulation": Pairs.join(clips[1::2])} | {
        path.name: recorded(weights, path) for path in options.log
    }

    forms: dict[str, Form] = {
        "winner, spread about it": about_winner,
        "mean, spread about it": about_mean,
        "mixture by photometric error": mixture(fitted_on),
        "refined, constant": refined_constant,
        "refined, spread about it": refined_spread,
        "refined, Hessian": hessian,
        "refined, Hessian and spread": both(fitted_on),
    }
    models = {
        name: fit(pose_errors(form(fitted_on)[0], fitted_on.truth), form(fitted_on)[1]) for name, form in forms.items()
    }
    for name, pairs in judged.items():
        Console(width=110).print(table(name, pairs, forms, models))


def simulated(weights: Weights, seed: int, frames: int, size: tuple[int, int]) -> Pairs:
    """The pairs of a rendered clip, as an imperfect rig would record it."""
    rendered, imu, truth = simulation.clip(seed, frames, *size)
    rendered, reference = imperfect(rendered, truth, Rig(), np.random.default_rng([seed, 1]))
    truth = Trajectory(truth.stamps_ns, reference)
    alone, refined = (
        list(infer(weights, iter(rendered), truth.stamps_ns, imu, Counter(), polish)) for polish in (False, True)
    )
    return Pairs.of(compare(alone, refined, truth), np.stack([i.network.errors for i in alone]))


def recorded(weights: Weights, path: Path) -> Pairs:
    """The pairs of a log that its ground truth spans."""
    log = open_log(path)
    truth = log.ground_truth()
    if truth is None:
        raise SystemExit(f"{path}: no ground truth to judge by")
    alone, refined = (
        list(infer(weights, log.frames(), log.frame_stamps(), log.imu(), Counter(), polish)) for polish in (False, True)
    )
    comparison = compare(alone, refined, truth)
    errors = {i.pair.source_stamp_ns: i.network.errors for i in alone}
    return Pairs.of(comparison, np.stack([errors[stamp] for stamp in comparison.stamps_ns[:, 0].tolist()]))


def table(name: str, pairs: Pairs, forms: dict[str, Form], models: dict[str, CovarianceModel]) -> Table:
    """A row for every form."""
    result = Table(title=f"{name}: {len(pairs.truth)} pairs; gain and floor from other simulated clips")
    result.add_column("estimate and covariance", no_wrap=True)
    for heading in (
        "RMSE\n(m)",
        "RMSE\n(mrad)",
        "ANEES\n(6)",
        "cover\n50 %",
        "cover\n95 %",
        "NLL",
        "of best\nconstant",
        "mean\nrank",
    ):
        result.add_column(heading, justify="right")
    for label, form in forms.items():
        pose, raw = form(pairs)
        errors = pose_errors(pose, pairs.truth)
        covariances = models[label].covariance(raw, np.ones(len(raw)))
        squared, constant = nees(errors, covariances), constant_nll(errors)
        ranks = [rank for rank in rank_correlation(errors, covariances).values() if rank is not None]
        found = score(label, pose, pairs.truth)
        result.add_row(
            label,
            f"{found['translation_rmse_m']:.4f}",
            f"{1e3 * found['rotation_rmse_rad']:.2f}",
            f"{squared.mean():.2f}",
            *(f"{100 * inside(squared, p).mean():.1f}" for p in (0.5, 0.95)),
            f"{negative_log_likelihood(errors, covariances).mean():.2f}",
            "-" if constant is None else f"{constant:.2f}",
            f"{np.mean(ranks):.2f}" if ranks else "-",
        )
    return result


if __name__ == "__main__":
    main()
