"""The law of the evidence: it is the probability of what was measured, with all that is unknown integrated out."""

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import S
from scipy.stats import multivariate_normal

from fusion.evidence import evidence, graph_of
from fusion_io.records import FloatArray

SHOWN_SIGMA = 0.3
SHOWN = np.array([0.4, -0.1, 0.7, 1.9])
UNIT = gtsam.noiseModel.Unit.Create(1)


def _factor(keys: list[int], row: list[float], value: float, sigma: float) -> gtsam.JacobianFactor:
    parts = [part for key, each in zip(keys, row, strict=True) for part in (key, np.array([[each / sigma]]))]
    return gtsam.JacobianFactor(*parts, np.array([value / sigma]), UNIT)


def _log(prior: float, walk: float, how: tuple[object, ...]) -> float:
    """Of a random walk that starts within `prior` of zero, shown with noise; with what is to be said of W."""
    states = range(len(SHOWN))
    shown = [_factor([S(k)], [1.0], SHOWN[k], SHOWN_SIGMA) for k in states]
    assumed = [_factor([S(0)], [1.0], 0.0, prior)]
    assumed += [_factor([S(k - 1), S(k)], [-1.0, 1.0], 0.0, walk) for k in states[1:]]
    order = gtsam.Ordering()
    for k in states:
        order.push_back(S(k))
    found = evidence(graph_of(shown, assumed), lambda graph: graph.eliminateSequential(order, *how))
    return found.log - np.log(prior) - len(states[1:]) * np.log(walk)


def _density(prior: float, walk: float) -> float:
    states = np.arange(len(SHOWN))
    covariance: FloatArray = prior**2 + walk**2 * np.minimum(states[:, None], states)
    return float(multivariate_normal.logpdf(SHOWN, cov=covariance + SHOWN_SIGMA**2 * np.eye(len(SHOWN))))


@pytest.mark.parametrize("how", [(gtsam.EliminateQR,), ()], ids=["QR", "Cholesky"])
def test_it_differs_between_assumptions_as_the_density_of_what_is_shown(how: tuple[object, ...]) -> None:
    """In closed form, whichever way the problem is solved (QR leaves diagonals of either sign)."""
    one, other = (1.0, 0.1), (0.2, 2.0)
    assert _log(*one, how) - _log(*other, how) == pytest.approx(_density(*one) - _density(*other), abs=1e-9)


def test_what_is_not_finite_is_refused_as_gtsam_does() -> None:
    graph = graph_of([_factor([S(0)], [1.0], np.nan, 1.0)])
    order = gtsam.Ordering()
    order.push_back(S(0))
    with pytest.raises(RuntimeError):
        evidence(graph, lambda each: each.eliminateSequential(order, gtsam.EliminateQR))
