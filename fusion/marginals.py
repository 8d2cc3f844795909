"""Marginal covariances from a Bayes net, all of them in one pass from the root.

GTSAM's own queries for covariances fall back on Cholesky, which fails on graphs whose factors differ much in weight.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from typing import NamedTuple

import gtsam
import numpy as np
from scipy.linalg.lapack import dtrtri

from fusion_io.records import FloatArray


class Joint(NamedTuple):
    """The joint covariance of some variables, and where the rows of each begin and end."""

    covariance: FloatArray
    rows: dict[int, tuple[int, int]]

    def of(self, keys: Sequence[int]) -> FloatArray:
        """The joint covariance of some of them, in this order."""
        index = np.array([row for key in keys for row in range(*self.rows[key])], np.intp)
        return np.asarray(self.covariance.take(index, 0).take(index, 1))  # a third of the time of one look-up of both


def covariances(net: gtsam.GaussianBayesNet, wanted: Callable[[int], Sequence[int] | None]) -> dict[int, FloatArray]:
    """Joint covariances of the variables that wanted(key) names, for each key where it names any.

    The variables named are the key itself or parents of it in the net. A variable given its parents P has the
    covariance of its own noise and what that of P adds; P is a subset of its first parent and the parents of that, for
    which it is known already (Kaess and Dellaert, "Covariance recovery from a square root information matrix", 2009).
    """
    conditionals = [net.at(i) for i in range(net.size())]
    keys = [list(conditional.keys()) for conditional in conditionals]
    place = {of[0]: i for i, of in enumerate(keys)}
    nearest = [min(of[1:], key=place.__getitem__, default=None) for of in keys]
    named = [wanted(of[0]) for of in keys]
    children: Counter[int | None] = Counter()  # that are wanted, or have such children themselves
    for (key, *_), near, some in zip(keys, nearest, named, strict=True):
        children[near] += bool(some or children[key])

    found: dict[int, FloatArray] = {}
    known: dict[int | None, Joint] = {None: Joint(np.zeros((0, 0)), {})}
    for conditional, (key, *parents), near, some in reversed(
        list(zip(conditionals, keys, nearest, named, strict=True))
    ):
        if not (some or children[key]):
            continue
        above = known[near]
        joint = _joined(conditional, key, parents, above.of(parents), above.rows)
        children[near] -= 1
        if not children[near]:
            del known[near]
        if children[key]:
            known[key] = joint
        if some:
            found[key] = joint.of(some)
    return found


def _joined(
    conditional: gtsam.GaussianConditional,
    key: int,
    parents: Sequence[int],
    of_parents: FloatArray,
    rows_above: dict[int, tuple[int, int]],
) -> Joint:
    """A variable joined to its parents: R x + S p = d + noise."""
    root_inverse, singular = dtrtri(conditional.R())
    if singular:
        raise np.linalg.LinAlgError("a variable that nothing determines")
    n = len(root_inverse)
    by_parents = -root_inverse @ conditional.S()
    crossed = by_parents @ of_parents
    own = root_inverse @ root_inverse.T + crossed @ by_parents.T
    covariance = np.empty((n + len(of_parents), n + len(of_parents)))
    covariance[:n, :n] = (own + own.T) / 2  # what is left of rounding would grow from variable to variable
    covariance[:n, n:], covariance[n:, :n] = crossed, crossed.T
    covariance[n:, n:] = of_parents
    rows, end = {key: (0, n)}, n
    for parent in parents:
        start, stop = rows_above[parent]
        rows[parent] = (end, end + stop - start)
        end += stop - start
    return Joint(covariance, rows)
