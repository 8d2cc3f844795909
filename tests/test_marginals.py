"""Marginal covariances against the dense inverse of the information matrix."""

from collections.abc import Sequence
from itertools import pairwise

import gtsam
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from fusion.marginals import covariances
from fusion_io.records import FloatArray


def _factor(rng: np.random.Generator, keys: Sequence[int], sizes: Sequence[int], weight: float) -> gtsam.JacobianFactor:
    """A random factor that determines each of its variables given the others."""
    rows = max(sizes[key] for key in keys)
    blocks = [weight * rng.normal(size=(rows, sizes[key])) for key in keys]
    unit = gtsam.noiseModel.Unit.Create(rows)
    arguments = [argument for pair in zip(keys, blocks, strict=True) for argument in pair]
    return gtsam.JacobianFactor(*arguments, np.zeros(rows), unit)


def _graph(rng: np.random.Generator, sizes: Sequence[int], loops: int, shared: bool) -> gtsam.GaussianFactorGraph:
    """A chain of variables of some sizes, with loops and, where the last one is shared, factors of all with it."""
    graph = gtsam.GaussianFactorGraph()
    count = len(sizes) - shared
    for k in range(len(sizes)):
        graph.add(_factor(rng, [k], sizes, 0.1))
    ends = [(k, k + 1) for k in range(count - 1)]
    ends += [tuple(sorted(rng.choice(count, 2, replace=False).tolist())) for _ in range(loops)]
    for i, j in ends:
        graph.add(_factor(rng, [i, j, count] if shared else [i, j], sizes, 10.0 ** rng.uniform(-1, 2)))
    return graph


def _dense(graph: gtsam.GaussianFactorGraph, sizes: Sequence[int]) -> tuple[FloatArray, list[slice]]:
    jacobian, _ = graph.jacobian()
    ends = np.cumsum([0, *sizes])
    return np.linalg.inv(jacobian.T @ jacobian), [slice(a, b) for a, b in pairwise(ends)]


def _net(graph: gtsam.GaussianFactorGraph, order: Sequence[int]) -> gtsam.GaussianBayesNet:
    ordering = gtsam.Ordering()
    for key in order:
        ordering.push_back(key)
    return graph.eliminateSequential(ordering, gtsam.EliminateQR)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10_000), st.integers(3, 12), st.integers(0, 6), st.booleans())
def test_marginals_of_random_graphs_are_those_of_the_dense_inverse(
    seed: int, count: int, loops: int, shuffled: bool
) -> None:
    """Chains and graphs with loops, variables of all sizes, in order and in any other."""
    rng = np.random.default_rng(seed)
    sizes = rng.integers(1, 7, count).tolist()
    graph = _graph(rng, sizes, loops, shared=False)
    order = rng.permutation(count).tolist() if shuffled else list(range(count))
    found = covariances(_net(graph, order), lambda key: [key])
    expected, where = _dense(graph, sizes)
    assert sorted(found) == list(range(count))
    for key, covariance in found.items():
        assert_allclose(covariance, expected[where[key], where[key]], rtol=1e-6, atol=1e-9 * np.trace(covariance))


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 10_000), st.integers(0, 5))
def test_joint_covariances_with_a_variable_that_all_share(seed: int, loops: int) -> None:
    """In the order they are asked for, and only those that are."""
    rng = np.random.default_rng(seed)
    sizes = rng.integers(1, 7, 9).tolist()
    graph = _graph(rng, sizes, loops, shared=True)
    found = covariances(_net(graph, list(range(9))), lambda key: [key, 8] if key % 2 else None)
    expected, where = _dense(graph, sizes)
    assert sorted(found) == [1, 3, 5, 7]
    for key, covariance in found.items():
        index = np.r_[where[key], where[8]]
        assert_allclose(covariance, expected[np.ix_(index, index)], rtol=1e-6, atol=1e-9 * float(np.trace(covariance)))


@pytest.mark.parametrize("backwards", [False, True])
def test_rounding_does_not_grow_over_thousands_of_variables(backwards: bool) -> None:
    """A random walk, whose variance is known in closed form, eliminated from either end."""
    count, step, first = 4000, 1e-3, 1e-6
    graph = gtsam.GaussianFactorGraph()
    unit = gtsam.noiseModel.Unit.Create(6)
    graph.add(gtsam.JacobianFactor(0, np.eye(6) / first, np.zeros(6), unit))
    for k in range(count - 1):
        graph.add(gtsam.JacobianFactor(k, -np.eye(6) / step, k + 1, np.eye(6) / step, np.zeros(6), unit))
    order = list(range(count))
    found = covariances(_net(graph, order[::-1] if backwards else order), lambda key: [key])
    variances = np.array([np.diag(found[k]) for k in range(count)])
    expected = first**2 + np.arange(count) * step**2
    assert_allclose(variances, np.repeat(expected[:, None], 6, axis=1), rtol=1e-6, atol=1e-15)
    assert all(np.array_equal(found[k], found[k].T) for k in range(0, count, 100))


def test_a_variable_that_nothing_determines_is_an_error() -> None:
    """Rather than a covariance that is none."""
    net = gtsam.GaussianBayesNet()
    net.push_back(gtsam.GaussianConditional(0, np.zeros(2), np.array([[1.0, 0.5], [0.0, 0.0]])))
    with pytest.raises(np.linalg.LinAlgError):
        covariances(net, lambda key: [key])
