"""Pair estimates beside the ground truth, and the figures that follow."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fusion_io.errors import LogError
from fusion_io.records import FloatArray, IntArray, PairEstimate, Trajectory
from learned.calibration import AXES, consistency, inside, mean_interval, negative_log_likelihood
from learned.covariance import hypothesis_spread, nees, pose_errors
from learned.estimator import Inference
from learned.scores import error_norms, hypothesis_matrices, mean_motion, mean_poses, score

DEFAULT = "refined"
"""The estimate that `fusion.run` uses unless told otherwise: the figures at the top are its own."""


@dataclass(frozen=True)
class Estimates:
    """What an estimator says of N pairs: T_source_target (N, 4, 4) and covariances (N, 6, 6)."""

    T_source_target: FloatArray
    covariances: FloatArray

    @staticmethod
    def of(pairs: Sequence[PairEstimate]) -> Estimates:
        """Estimates as arrays."""
        return Estimates(
            np.stack([pair.T_source_target.as_matrix() for pair in pairs]),
            np.stack([pair.covariance for pair in pairs]),
        )


@dataclass(frozen=True)
class Comparison:
    """N pairs that the ground truth spans, in order of time.

    stamps_ns (N, 2) of source and target; true T_source_target (N, 4, 4). Of the network alone: after the levels
    (N, 5, 4, 4), the hypotheses (N, M, 4, 4), which of them won (N,), and its estimates. The refined estimates, which
    are those that they started from where `was_refined` (N,) is false.
    """

    stamps_ns: IntArray
    truth: FloatArray
    levels: FloatArray
    hypotheses: FloatArray
    winners: IntArray
    network: Estimates
    refined: Estimates
    was_refined: NDArray[np.bool_]

    def __len__(self) -> int:
        return len(self.truth)

    @property
    def stages(self) -> dict[str, Estimates]:
        """Both estimates by name."""
        return {"network": self.network, "refined": self.refined}

    def errors(self, stage: str) -> FloatArray:
        """Errors (N, 6) of a stage in its own tangent space, rotation first."""
        return pose_errors(self.stages[stage].T_source_target, self.truth)


def compare(alone: Sequence[Inference], refined: Sequence[Inference], truth: Trajectory) -> Comparison:
    """The pairs whose frames the ground truth spans, inferred without and with refinement, beside it.

    Raises LogError, with no file named, where there is none.
    """
    stamps = np.array([(i.pair.source_stamp_ns, i.pair.target_stamp_ns) for i in alone]).reshape(-1, 2)
    known = truth.covers(stamps[:, 0]) & truth.covers(stamps[:, 1])
    if not known.any():
        raise LogError(f"none of its {len(alone)} estimated pairs lies within the ground truth's stamps")
    both = [each for *each, spanned in zip(alone, refined, known, strict=True) if spanned]
    networks, polished = zip(*both, strict=True)
    stamps = stamps[known]
    return Comparison(
        stamps_ns=stamps,
        truth=(truth.at(stamps[:, 0]).inv() * truth.at(stamps[:, 1])).as_matrix(),
        levels=np.stack([i.levels for i in networks]),
        hypotheses=np.stack([hypothesis_matrices(i.network) for i in networks]),
        winners=np.array([i.network.winner for i in networks]),
        network=Estimates.of([i.network for i in networks]),
        refined=Estimates.of([i.pair for i in polished]),
        was_refined=np.array([i.refined for i in polished]),
    )


def figures(comparison: Comparison) -> dict[str, Any]:
    """All that can be said of the pairs, as plain values for a JSON file."""
    stages = {name: stage_figures(comparison, name) for name in comparison.stages}
    levels = [score(f"level {k}", T, comparison.truth) for k, T in enumerate(comparison.levels.swapaxes(0, 1))]
    return {
        "pairs": len(comparison),
        "default": DEFAULT,
        **stages[DEFAULT],
        **stages,
        "pairs_refined": int(comparison.was_refined.sum()),
        "by_level": levels,
        **hypothesis_figures(comparison),
        "baselines": constant_motions(comparison.truth),
    }


def stage_figures(comparison: Comparison, stage: str) -> dict[str, Any]:
    """Errors and consistency of a stage, and 95 % intervals of those figures that are means over the pairs."""
    estimates, errors = comparison.stages[stage], comparison.errors(stage)
    found = {**score(stage, estimates.T_source_target, comparison.truth), **consistency(errors, estimates.covariances)}
    del found["name"]
    translation, rotation = error_norms(estimates.T_source_target, comparison.truth)
    squared = nees(errors, estimates.covariances)
    found["interval_95"] = {
        "translation_rmse_m": np.sqrt(mean_interval(translation**2)).tolist(),
        "rotation_rmse_rad": np.sqrt(mean_interval(rotation**2)).tolist(),
        "anees": list(mean_interval(squared)),
        "coverage_95": list(mean_interval(inside(squared, 0.95).astype(float))),
        "nll": list(mean_interval(negative_log_likelihood(errors, estimates.covariances))),
    }
    return found


def hypothesis_figures(comparison: Comparison) -> dict[str, Any]:
    """The paper's section on multi-hypothesis error reduction.

    by_hypothesis: errors of each, and how often it won. winner, mean_of_hypotheses (on SE(3)) and best_hypothesis (in
    hindsight, by translation: what a perfect choice would reach). hypothesis_variance: between the hypotheses of a
    pair, averaged over the pairs, in rad^2 and m^2 by axis.
    """
    hypotheses, truth = comparison.hypotheses, comparison.truth
    mean = mean_poses(hypotheses)
    distances = np.linalg.norm(hypotheses[:, :, :3, 3] - truth[:, None, :3, 3], axis=2)
    best = hypotheses[np.arange(len(truth)), distances.argmin(1)]
    variance = np.einsum("naa->na", hypothesis_spread(hypotheses, mean)).mean(0)
    return {
        "by_hypothesis": [
            {**score(f"hypothesis {k}", T, truth), "wins": int((comparison.winners == k).sum())}
            for k, T in enumerate(hypotheses.swapaxes(0, 1))
        ],
        "winner": score("winner", comparison.network.T_source_target, truth),
        "mean_of_hypotheses": score("mean of hypotheses", mean, truth),
        "best_hypothesis": score("best hypothesis in hindsight", best, truth),
        "hypothesis_variance": dict(zip(AXES, variance.tolist(), strict=True)),
    }


def constant_motions(truth: FloatArray) -> list[dict[str, Any]]:
    """The errors of one motion for all pairs: none, and the mean of the true ones."""
    still, mean = np.broadcast_to(np.eye(4), truth.shape), np.broadcast_to(mean_motion(truth), truth.shape)
    return [{**score("zero motion", still, truth)}, {**score("mean motion", mean, truth)}]
