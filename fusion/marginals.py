"""Marginal covariances from a Bayes net, all of them in one pass from the root.

GTSAM's own queries for covariances fall back on Cholesky, which fails on graphs whose factors differ much in weight.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence

import gtsam
import numpy as np
from scipy.linalg import solve_triangular

from fusion_io.records import FloatArray


def covariances(net: gtsam.GaussianBayesNet, wanted: Callable[[int], Sequence[int] | None]) -> dict[int, FloatArray]:
    """Joint covariances of the variables that wanted(key) names, for each key where it names any.

    The variables named are the key itself or parents of it in the net. A variable given its parents P has the
    covariance of its own noise and what that of P adds; P is a subset of its first parent and the parents of that, for
    which it is known already (Kaess and Dellaert, "Covariance recovery from a square root information matrix", 2009).
    """
    conditionals = [net.at(i) for i in range(net.size())]
    place = {conditional.keys()[0]: i for i, conditional in enumerate(conditionals)}
    parents = [sorted(conditional.keys()[1:], key=place.__getitem__) for conditional in conditionals]
    children = Counter(of[0] for of in parents if of)

    found: dict[int, FloatArray] = {}
    known: dict[int, tuple[dict[int, slice], FloatArray]] = {}
    for conditional, above in zip(reversed(conditionals), reversed(parents), strict=True):
        key, *order = conditional.keys()
        root_inverse = solve_triangular(conditional.R(), np.eye(len(conditional.R())))
        own = root_inverse @ root_inverse.T
        if order:
            where, covariance = known[above[0]]
            of_parents = _part(covariance, where, order)
            by_parents = -root_inverse @ conditional.S()
            crossed = by_parents @ of_parents
            own += crossed @ by_parents.T
            own = (own + own.T) / 2  # what is left of rounding would grow from variable to variable
            joint = np.block([[own, crossed], [crossed.T, of_parents]])
            widths = [len(own), *(where[parent].stop - where[parent].start for parent in order)]
            children[above[0]] -= 1
            if not children[above[0]]:
                del known[above[0]]
        else:
            joint, widths = own, [len(own)]
        ends = np.cumsum([0, *widths])
        known_here = {k: slice(a, b) for k, a, b in zip([key, *order], ends[:-1], ends[1:], strict=True)}
        if children[key]:
            known[key] = known_here, joint
        if named := wanted(key):
            found[key] = _part(joint, known_here, named)
    return found


def _part(covariance: FloatArray, where: dict[int, slice], keys: Sequence[int]) -> FloatArray:
    """The rows and columns of some variables."""
    index = np.concatenate([np.arange(where[key].start, where[key].stop) for key in keys])
    return np.asarray(covariance[np.ix_(index, index)])
