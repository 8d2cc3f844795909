"""The biases of the IMU in the pose graph: one state B a knot, which wander a little; and what contradicts that.

A bias may step, by a knock or a restart, that of an accelerometer may wander far, with vibrations, and what the
calibration took for the gyro's first one may be wrong on a short log: the graph would explain each by the motion.
Whether it is so is told by the evidence for it against that for what was assumed (a generalised likelihood ratio:
Willsky and Jones, "A generalized likelihood ratio approach to the detection and estimation of jumps in linear systems",
1976). Of all knots that is asked where the problem without a step pulls most.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B

from fusion.evidence import Eliminate, evidence, graph_of
from fusion_io.records import FloatArray

# How far a bias may step: accelerometer (m/s^2) or gyro (rad/s); and how far that of an accelerometer may wander from
# knot to knot. (Where a gyro's would, it is the first bias that is wrong.)
ACCELEROMETER_STEP, GYRO_STEP, WANDERING = np.repeat([[1.0, 0.0], [0.0, 0.02], [0.3, 0.0]], 3, axis=1)
LEAST_KNOTS = 3  # before a step, and after it
# The gain is the logarithm of how many times likelier what was measured is by it. Of a step it is -1.5 at most in real
# logs and 280 simulated ones of sound IMUs whose first bias is right; a bias that wanders costs little where there are
# few knots.
LEAST_BY_STEP, LEAST_BY_WANDERING = 0.0, 3.0
# Of what wandering would gain, what is enough for a step: it is simpler, and what it leaves is asked again.
NEARLY_ALL = 0.95
MOST = 4  # that is found in a log


class Doubt(NamedTuple):
    """By sigma (6,) the states of some knots differ from those before; that of knot 0 from what is known of it."""

    knots: range
    sigma: FloatArray

    @property
    def is_step(self) -> bool:
        """Whether it is about one knot that is not the first."""
        return len(self.knots) == 1 and self.knots[0] > 0

    @property
    def wanders(self) -> bool:
        """Whether it is about all knots but the first."""
        return len(self.knots) > 1

    def on(self, sigmas: FloatArray) -> FloatArray:
        """What sigmas (J, 6) of a walk are with it."""
        loose = sigmas.copy()
        loose[self.knots] = np.hypot(sigmas[self.knots], self.sigma)
        return loose


def at(knot: int, sigma: FloatArray) -> Doubt:
    """About one knot."""
    return Doubt(range(knot, knot + 1), sigma)


def walk(first: gtsam.imuBias.ConstantBias, sigmas: FloatArray) -> list[gtsam.NonlinearFactor]:
    """The first state, and from each to the next: known by, and differing by, sigmas (J, 6).

    Accelerometer (m/s^2), then gyro (rad/s).
    """
    return [link(first, knot, of_knot) for knot, of_knot in enumerate(sigmas)]


def link(first: gtsam.imuBias.ConstantBias, knot: int, sigmas: FloatArray) -> gtsam.NonlinearFactor:
    """From the state before a knot's to it; of knot 0, what is known of it."""
    noise = gtsam.noiseModel.Diagonal.Sigmas(sigmas, False)
    if knot == 0:
        return gtsam.PriorFactorConstantBias(B(0), first, noise)
    return gtsam.BetweenFactorConstantBias(B(knot - 1), B(knot), gtsam.imuBias.ConstantBias(), noise)


def likely_doubt(
    others: Sequence[gtsam.GaussianFactor] | gtsam.GaussianFactorGraph,
    point: gtsam.Values,
    first: gtsam.imuBias.ConstantBias,
    sigmas: FloatArray,
    eliminate: Eliminate,
) -> Doubt | None:
    """What contradicts a walk most likely; None where nothing is likelier than the walk.

    others: all of the linear problem at a point but the walk from `first` with sigmas (J, 6).
    """
    knots = len(sigmas)
    links = [each.linearize(point) for each in walk(first, sigmas)]
    assumed = evidence(graph_of(links, others), eliminate)

    def gain(doubt: Doubt) -> float:
        loose = doubt.on(sigmas)
        changed = [link(first, knot, loose[knot]).linearize(point) for knot in doubt.knots]
        graph = graph_of(links[: doubt.knots.start], changed, links[doubt.knots.stop :], others)
        return evidence(graph, eliminate).log - assumed.log - float(np.log(loose / sigmas).sum())

    def most(doubts: Sequence[Doubt]) -> tuple[float, Doubt]:
        return max(((gain(doubt), doubt) for doubt in doubts), key=lambda each: each[0])

    simple = [at(0, GYRO_STEP)]
    inner = range(LEAST_KNOTS, knots + 1 - LEAST_KNOTS)
    if inner:
        states = np.stack([point.atConstantBias(B(j)).vector() + assumed.solution.at(B(j)) for j in range(knots)])
        simple += [at(_pulled(states, sigmas, step, inner), step) for step in (ACCELEROMETER_STEP, GYRO_STEP)]
    gained, doubt = most(simple)
    while doubt.is_step and gained > 0.0:
        beside = [at(knot, doubt.sigma) for knot in (doubt.knots.start - 1, doubt.knots.stop) if knot in inner]
        more, other = most(beside) if beside else (gained, doubt)
        if more <= gained:
            break
        gained, doubt = more, other
    if inner:
        wandering = Doubt(range(1, knots), WANDERING)
        by_wandering = gain(wandering)
        if by_wandering > LEAST_BY_WANDERING and gained < NEARLY_ALL * by_wandering:
            return wandering
    return doubt if gained > LEAST_BY_STEP else None


def _pulled(states: FloatArray, sigmas: FloatArray, step: FloatArray, among: range) -> int:
    """The knot, of some, before which states (J, 6) of a walk with sigmas (J, 6) are pulled most to step.

    How much the squares would fall with a step is the square of their derivative times its variance, and that, where
    all knots tell alike and the first bias is known, is as the number of knots after it.
    """
    pulls = np.where(step > 0.0, np.diff(states, axis=0) / sigmas[1:] ** 2, 0.0)
    fall = np.sum(pulls**2, axis=1) / np.arange(1, len(states))[::-1]
    return among.start + int(np.argmax(fall[among.start - 1 : among.stop - 1]))
