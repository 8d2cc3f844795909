"""Pairs with known errors, as an evaluation compares them."""

import numpy as np
from scipy.spatial.transform import RigidTransform

from fusion_io.records import NANOSECONDS
from learned.comparison import Comparison, Estimates

SIGMA = np.array([1e-3] * 3 + [0.02, 0.02, 0.04])
LEVELS, HYPOTHESES = 5, 4


def moved(poses: np.ndarray, errors: np.ndarray) -> np.ndarray:
    """Estimates (..., 4, 4) of which the poses are this (..., 6) far in the estimates' tangent spaces."""
    step = RigidTransform.from_exp_coords(-errors.reshape(-1, 6)).as_matrix().reshape(*errors.shape[:-1], 4, 4)
    return poses @ step


def comparison(count: int = 80, seed: int = 0) -> Comparison:
    """A car ahead at a metre a pair: every level halves the error, and so does the refinement.

    Both stages state covariances that vary by pair and from which their errors are drawn. Each hypothesis wins in
    turn and is the winner's error away from the others at most.
    """
    rng = np.random.default_rng(seed)
    size = np.exp(rng.normal(0, 0.5, count))
    motions = rng.normal(size=(count, 6)) * [2e-3, 2e-2, 2e-3, 0.01, 0.01, 0.1] + [0, 0, 0, 0, 0, 1.0]
    truth = RigidTransform.from_exp_coords(motions).as_matrix()
    network_error = 2 * size[:, None] * SIGMA * rng.normal(size=(count, 6))
    refined_error = size[:, None] * SIGMA * rng.normal(size=(count, 6))
    covariances = size[:, None, None] ** 2 * np.diag(SIGMA**2)

    factors = 2.0 ** np.arange(LEVELS - 1, -1, -1)
    levels = moved(np.repeat(truth[:, None], LEVELS, axis=1), factors[:, None] * network_error[:, None])
    winners = np.arange(count) % HYPOTHESES
    spread = 4 * size[:, None, None] * SIGMA * rng.normal(size=(count, HYPOTHESES, 6))
    spread[np.arange(count), winners] = network_error
    hypotheses = moved(np.repeat(truth[:, None], HYPOTHESES, axis=1), spread)
    starts = np.arange(count, dtype=np.int64) * (NANOSECONDS // 10)
    return Comparison(
        stamps_ns=np.column_stack([starts, starts + NANOSECONDS // 10]),
        truth=truth,
        levels=levels,
        hypotheses=hypotheses,
        winners=winners,
        network=Estimates(levels[:, -1], 4 * covariances),
        refined=Estimates(moved(truth, refined_error), covariances),
        was_refined=np.ones(count, dtype=np.bool_),
    )
