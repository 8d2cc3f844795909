"""The lasting errors of a front end in the pose graph: scale error and rate bias, one state S a knot.

They fade and wander (a Gauss-Markov process). How large scale errors are is not known of a front end beforehand, but
the IMU sees the motion too, so that the log tells: by the evidence for each size.
"""

from __future__ import annotations

from collections.abc import Callable

import gtsam
import numpy as np
from gtsam.symbol_shorthand import S
from scipy.interpolate import CubicSpline

from fusion.config import FusionConfig
from fusion.evidence import Eliminate, evidence, graph_of
from fusion_io.records import FloatArray

FACTORS = 2.0 ** np.arange(-2, 3)  # of the scale error that is assumed, at which the evidence is computed
DOUBT = 1.5  # by about this factor scale errors of a front end are larger or smaller than is assumed
FINE = 201  # points at which the evidence is interpolated


def process(seconds: FloatArray, sigmas: tuple[float, float], config: FusionConfig) -> list[gtsam.NonlinearFactor]:
    """The states of knots that are so many seconds (J,) apart, the first one included.

    sigmas: of scale error and rate bias (rad/s), as long as nothing is known of them.
    """
    noise = gtsam.noiseModel.Diagonal.Sigmas(np.repeat(sigmas, [1, 3]), False)
    first = gtsam.PriorFactorVector(S(0), np.zeros(4), noise)
    return [first, *(walk(knot, dt, sigmas, config) for knot, dt in enumerate(seconds.tolist()))]


def walk(knot: int, dt: float, sigmas: tuple[float, float], config: FusionConfig) -> gtsam.NonlinearFactor:
    """From the state of one knot to the next, dt seconds later; sigmas as in `process`."""
    keep = np.exp([-dt / config.pair_scale_correlation_s, *[-dt / config.pair_rate_bias_correlation_s] * 3])
    whitener = np.diag(1.0 / (np.array([sigmas[0], *[sigmas[1]] * 3]) * np.sqrt(1.0 - keep**2)))
    unit = gtsam.noiseModel.Unit.Create(4)
    linear = gtsam.JacobianFactor(S(knot), -whitener * keep, S(knot + 1), whitener, np.zeros(4), unit)
    point = gtsam.Values()
    point.insert(S(knot), np.zeros(4))
    point.insert(S(knot + 1), np.zeros(4))
    return gtsam.LinearContainerFactor(linear, point)


def likely_scale(
    others: gtsam.GaussianFactorGraph,
    process_of: Callable[[float], gtsam.GaussianFactorGraph],
    eliminate: Eliminate,
) -> float:
    """The factor by which scale errors are larger than is assumed: the mean, in its logarithm, over all that may be.

    others: all of a linear problem but the process; process_of: the process for a factor, a row for each state;
    eliminate: makes a Bayes net of a problem. Raises RuntimeError, as GTSAM does, where that cannot be told.
    """

    def log_evidence(factor: float) -> float:
        """Of the four components of each state, one row of the process each, the scale error is one."""
        linear = process_of(factor)
        states = linear.size()
        return evidence(graph_of(linear, others), eliminate).log - states * float(np.log(factor))

    logs = np.log(FACTORS)
    fine = np.linspace(logs[0], logs[-1], FINE)
    density = (
        CubicSpline(logs, [log_evidence(factor) for factor in FACTORS.tolist()])(fine)
        - 0.5 * (fine / np.log(DOUBT)) ** 2
    )
    weights = np.exp(density - density.max())
    return float(np.exp(weights @ fine / weights.sum()))
