"""How probable all that was measured is, whatever the motion was: by it the log tells which assumption is right.

Of the linear problem |A x - b|^2 with A = Q R this probability, the evidence, is but for a constant

    log p(b) = -|A x* - b|^2 / 2 - log |det R| + log |det W|                                                       (1)

W being what whitens that part of A which is assumed (MacKay, "Bayesian interpolation", Neural Computation 4, 1992).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import NamedTuple

import gtsam
import numpy as np

Eliminate = Callable[[gtsam.GaussianFactorGraph], gtsam.GaussianBayesNet]
"""Makes a Bayes net, whose conditionals all have unit noise, of a linear problem."""


class Evidence(NamedTuple):
    """The logarithm of (1) without what is to be said of W, and the solution x*."""

    log: float
    solution: gtsam.VectorValues


def evidence(linear: gtsam.GaussianFactorGraph, eliminate: Eliminate) -> Evidence:
    """Equation (1) of a linear problem; raises RuntimeError, as GTSAM does, where it has no solution."""
    net = eliminate(linear)
    solution = net.optimize()
    diagonals = np.concatenate([net.at(place).R().diagonal() for place in range(net.size())])  # by QR of either sign
    log = -float(linear.error(solution) + np.log(np.abs(diagonals)).sum())
    if not np.isfinite(log):
        raise RuntimeError("the evidence for what is assumed is not finite")
    return Evidence(log, solution)


def graph_of(*parts: Iterable[gtsam.GaussianFactor] | gtsam.GaussianFactorGraph) -> gtsam.GaussianFactorGraph:
    """A linear problem of several parts."""
    graph = gtsam.GaussianFactorGraph()
    for part in parts:
        if isinstance(part, gtsam.GaussianFactorGraph):
            graph.push_back(part)
        else:
            for factor in part:
                graph.push_back(factor)
    return graph
