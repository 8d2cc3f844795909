"""Laws of the front end's lasting errors: their process is the stated one, and the log tells how large they are."""

from dataclasses import replace

import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import S
from scipy.stats import multivariate_normal

from benchmarks.drives import POSE_GRAPH, gauss_markov, simulate
from fusion import front_end, posegraph
from fusion_io.records import FloatArray

SIGMAS = (POSE_GRAPH.pair_scale_sigma, POSE_GRAPH.pair_rate_bias_sigma)
SECONDS = np.array([1.0, 1.0, 4.0, 1.0])
SHOWN_SIGMA = 0.01


def _information(seconds: FloatArray, sigmas: tuple[float, float] = SIGMAS) -> FloatArray:
    """That of the process (4 J, 4 J)."""
    values = gtsam.Values()
    for knot in range(len(seconds) + 1):
        values.insert(S(knot), np.zeros(4))
    graph = gtsam.NonlinearFactorGraph()
    for factor in front_end.process(seconds, sigmas, POSE_GRAPH):
        graph.add(factor)
    return np.asarray(graph.linearize(values).hessian()[0])


def test_the_process_is_stationary_and_fades_at_the_stated_times() -> None:
    covariance = np.linalg.inv(_information(SECONDS)).reshape(5, 4, 5, 4)
    times = np.concatenate([[0.0], np.cumsum(SECONDS)])
    apart = np.abs(times[:, None] - times)
    scale, rate = POSE_GRAPH.pair_scale_correlation_s, POSE_GRAPH.pair_rate_bias_correlation_s
    np.testing.assert_allclose(covariance[:, 0, :, 0], SIGMAS[0] ** 2 * np.exp(-apart / scale), rtol=1e-9)
    for axis in (1, 2, 3):
        np.testing.assert_allclose(covariance[:, axis, :, axis], SIGMAS[1] ** 2 * np.exp(-apart / rate), rtol=1e-9)
    assert np.abs(covariance[:, 0, :, 1:]).max() < 1e-15


def _likely(shown: FloatArray, seconds: FloatArray) -> float:
    """The likely factor where the scale errors (J,) of all knots are shown with noise."""
    unit = gtsam.noiseModel.Unit.Create(1)
    row = np.array([[1.0, 0.0, 0.0, 0.0]]) / SHOWN_SIGMA
    others = gtsam.GaussianFactorGraph()
    values = gtsam.Values()
    for knot, value in enumerate(shown.tolist()):
        others.push_back(gtsam.JacobianFactor(S(knot), row, np.array([value / SHOWN_SIGMA]), unit))
        values.insert(S(knot), np.zeros(4))

    def process_of(factor: float) -> gtsam.GaussianFactorGraph:
        graph = gtsam.GaussianFactorGraph()
        for each in front_end.process(seconds, (factor * SIGMAS[0], SIGMAS[1]), POSE_GRAPH):
            graph.push_back(each.linearize(values))
        return graph

    order = gtsam.Ordering()
    for knot in range(len(shown)):
        order.push_back(S(knot))
    return front_end.likely_scale(others, process_of, lambda graph: graph.eliminateSequential(order))


def test_the_evidence_is_the_likelihood_of_all_that_is_shown() -> None:
    """Against the density of the shown values, whose covariance is known in closed form, integrated over the factor."""
    shown = np.array([0.03, 0.01, -0.02, 0.04, 0.05])
    times = np.concatenate([[0.0], np.cumsum(SECONDS)])
    correlation = np.exp(-np.abs(times[:, None] - times) / POSE_GRAPH.pair_scale_correlation_s)
    logs = np.linspace(np.log(front_end.FACTORS[0]), np.log(front_end.FACTORS[-1]), 400)
    densities = [
        multivariate_normal.pdf(shown, cov=(SIGMAS[0] * np.exp(log)) ** 2 * correlation + SHOWN_SIGMA**2 * np.eye(5))
        * np.exp(-0.5 * (log / np.log(front_end.DOUBT)) ** 2)
        for log in logs
    ]
    expected = np.exp(np.average(logs, weights=densities))
    assert _likely(shown, SECONDS) == pytest.approx(expected, rel=0.01)


@pytest.mark.parametrize("factor", [0.5, 1.0, 2.0])
def test_of_many_states_the_size_is_found(factor: float) -> None:
    rng = np.random.default_rng(0)
    every_tenth = gauss_markov(rng, 8000, np.array([factor * SIGMAS[0]]), np.array([10.0]))[::10, 0]
    shown = every_tenth + SHOWN_SIGMA * rng.normal(size=len(every_tenth))
    assert _likely(shown, np.ones(len(shown) - 1)) == pytest.approx(factor, rel=0.25)


def test_the_log_tells_that_scale_errors_are_larger_than_assumed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Drives whose scale errs 2.5 times as much: estimates of it that would be overconfident are so no more."""
    larger = POSE_GRAPH.model_copy(update={"pair_scale_sigma": 2.5 * POSE_GRAPH.pair_scale_sigma})
    drives = [simulate(seed, 50.0, larger) for seed in range(4)]

    def mean_square() -> float:
        found = [(posegraph.solve(drive.measurements, POSE_GRAPH).series, drive.front_end[:, 0]) for drive in drives]
        return float(np.mean([np.mean(((s.scale_error - true) / s.scale_error_std) ** 2) for s, true in found if s]))

    told = mean_square()
    monkeypatch.setattr(front_end, "likely_scale", lambda *_: 1.0)
    assert told < 0.6 * mean_square()


def test_what_is_not_finite_is_refused_as_gtsam_does() -> None:
    with pytest.raises(RuntimeError):
        _likely(np.array([0.01, np.nan, 0.02]), np.ones(2))


def test_a_short_log_leaves_what_is_assumed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Scale errors have not changed yet: what they are tells nothing of what they may be."""

    def never(*_: object) -> float:
        raise AssertionError

    monkeypatch.setattr(front_end, "likely_scale", never)
    drive = simulate(0, 12.0)
    posegraph.solve(drive.measurements, POSE_GRAPH)
    without_imu = replace(simulate(0, 40.0).measurements, imu=None)
    posegraph.solve(without_imu, POSE_GRAPH)  # nothing to compare with
    with pytest.raises(AssertionError):
        posegraph.solve(simulate(0, 40.0).measurements, POSE_GRAPH)
