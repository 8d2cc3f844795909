"""Laws of the IMU's biases in the pose graph: they wander as stated, and what contradicts that is found and named."""

from dataclasses import replace

import fault_samples as faults
import gtsam
import numpy as np
import pytest
from gtsam.symbol_shorthand import B
from numpy.testing import assert_allclose

from benchmarks.drives import POSE_GRAPH, Drive, simulate
from fusion import biases, fusing, posegraph
from fusion.biases import ACCELEROMETER_STEP, GYRO_STEP, Doubt
from fusion.config import PoseGraphConfig
from fusion.imu import BiasStep, calibrate
from fusion.measurements import Estimate
from fusion_io.findings import Findings
from fusion_io.records import NANOSECONDS, FloatArray

FIRST = gtsam.imuBias.ConstantBias(np.array([0.1, 0.0, -0.1]), np.array([1e-3, 2e-3, 0.0]))
KNOTS = 20
FIRST_SIGMAS = np.repeat([0.2, 2e-4], 3)
WALK = np.repeat([1e-4, 1e-5], 3)
SHOWN = np.repeat([0.1, 1e-3], 3)  # by how much a knot's data are off, one by one


def _sigmas(knots: int) -> FloatArray:
    """Of a walk over so many knots."""
    return np.vstack([FIRST_SIGMAS, np.tile(WALK, (knots - 1, 1))])


SIGMAS = _sigmas(KNOTS)


def _doubt(true: FloatArray, seed: int = 0) -> Doubt | None:
    """What is doubted where the data of each knot show its biases (J, 6) with noise."""
    rng = np.random.default_rng(seed)
    shown = true + SHOWN * rng.normal(size=true.shape)
    point = gtsam.Values()
    order = gtsam.Ordering()
    for knot in range(len(true)):
        point.insert(B(knot), FIRST)
        order.push_back(B(knot))
    unit = gtsam.noiseModel.Unit.Create(6)
    others = [
        gtsam.JacobianFactor(B(knot), np.diag(1.0 / SHOWN), (of_knot - FIRST.vector()) / SHOWN, unit)
        for knot, of_knot in enumerate(shown)
    ]
    return biases.likely_doubt(
        others, point, FIRST, _sigmas(len(true)), lambda graph: graph.eliminateSequential(order, gtsam.EliminateQR)
    )


def _steady(knots: int = KNOTS) -> FloatArray:
    return np.tile(FIRST.vector(), (knots, 1))


def test_a_walk_has_the_stated_covariance() -> None:
    """Var of state j is that of the first plus what it walked since."""
    values = gtsam.Values()
    graph = gtsam.NonlinearFactorGraph()
    for knot, factor in enumerate(biases.walk(FIRST, SIGMAS[:4])):
        values.insert(B(knot), FIRST)
        graph.add(factor)
    covariance = np.linalg.inv(graph.linearize(values).hessian()[0]).reshape(4, 6, 4, 6)
    for j in range(4):
        assert_allclose(np.diag(covariance[j, :, j]), FIRST_SIGMAS**2 + j * WALK**2, rtol=1e-6)
        assert_allclose(np.diag(covariance[0, :, j]), FIRST_SIGMAS**2, rtol=1e-6)


@pytest.mark.parametrize("seed", range(10))
def test_biases_that_wander_as_assumed_are_not_doubted(seed: int) -> None:
    assert _doubt(_steady(), seed) is None


@pytest.mark.parametrize("knot", [3, 7, KNOTS - 3])
@pytest.mark.parametrize("step", [ACCELEROMETER_STEP, GYRO_STEP], ids=["accelerometer", "gyro"])
def test_a_step_is_found_at_its_knot_and_told_from_one_of_the_other_sensor(step: FloatArray, knot: int) -> None:
    true = _steady()
    true[knot:] += step * [0.5, -0.3, 0.4, 0.5, -0.3, 0.4]
    doubt = _doubt(true)
    assert doubt is not None
    assert doubt.is_step
    assert doubt.knots == range(knot, knot + 1)
    assert_allclose(doubt.sigma, step)


def test_a_first_bias_that_is_wrong_is_told_from_a_step() -> None:
    true = _steady()
    true[:, 3:] += 5e-3
    doubt = _doubt(true)
    assert doubt is not None
    assert doubt.knots == range(1)
    assert_allclose(doubt.sigma, GYRO_STEP)


@pytest.mark.parametrize("period", [5.0, 15.0])
def test_an_accelerometer_that_swings_wanders(period: float) -> None:
    true = _steady(40)
    true[:, :3] += np.sin(2 * np.pi * np.arange(40) / period)[:, None] * [0.5, 0.5, 0.0]
    doubt = _doubt(true)
    assert doubt is not None
    assert doubt.wanders
    assert doubt.knots == range(1, 40)
    assert_allclose(doubt.sigma[3:], 0.0)


def test_of_few_knots_no_step_is_found() -> None:
    """Before and after a step there must be some."""
    true = _steady(2 * biases.LEAST_KNOTS - 1)
    true[3:, 3:] += [0.01, -0.006, 0.008]
    doubt = _doubt(true)
    assert doubt is None or not doubt.is_step


def test_a_doubt_widens_its_knots_alone() -> None:
    doubt = Doubt(range(2, 4), ACCELEROMETER_STEP)
    widened = doubt.on(SIGMAS)
    others = [0, 1, *range(4, KNOTS)]
    assert_allclose(widened[others], SIGMAS[others])
    assert_allclose(widened[2:4], np.hypot(SIGMAS[2:4], ACCELEROMETER_STEP))


# ------------------------------------------------------------------------------------------- in the pose graph


def _drive(by: FloatArray, at_s: float = 20.0) -> tuple[Drive, Estimate]:
    """A drive of 40 s as assumed, but for biases that step by (6,), and what the pose graph makes of it."""
    drive = simulate(3, 40.0)
    imu = drive.measurements.imu
    assert imu is not None
    after = (imu.stamps_ns >= at_s * NANOSECONDS)[:, None]
    stepped = replace(
        imu,
        linear_acceleration=imu.linear_acceleration + after * by[:3],
        angular_velocity=imu.angular_velocity + after * by[3:],
    )
    return drive, posegraph.solve(replace(drive.measurements, imu=stepped), POSE_GRAPH)


@pytest.mark.parametrize("by", [ACCELEROMETER_STEP, 2 * GYRO_STEP], ids=["accelerometer", "gyro"])
def test_the_graph_finds_a_step_and_is_hardly_the_worse_for_it(by: FloatArray) -> None:
    """When it was to a second, what it was to five of its sigmas; positions err at most a fifth more than without."""
    drive, found = _drive(by)
    [step] = found.bias_steps
    assert abs(step.at_ns / NANOSECONDS - 20.0) <= 1.0
    assert_allclose(step.by[by == 0.0], 0.0)
    assert np.all(np.abs(step.by - by)[by > 0.0] < 5 * step.std[by > 0.0])
    assert f"{step} at " in found.note
    _, sound = _drive(np.zeros(6))
    assert not sound.bias_steps

    def off(estimate: Estimate) -> float:
        error = estimate.trajectory.poses.translation - drive.truth.poses.translation
        return float(np.sqrt(np.mean(np.sum(error**2, axis=1))))

    assert off(found) <= 1.2 * off(sound)


def test_a_step_is_said_with_its_sensor_size_and_unit() -> None:
    accelerometer = BiasStep(12 * NANOSECONDS, np.array([0.3, 0.0, -0.4, 0.0, 0.0, 0.0]), np.zeros(6))
    gyro = BiasStep(7 * NANOSECONDS, np.array([0.0, 0.0, 0.0, 0.0, 0.02, 0.0]), np.zeros(6))
    assert str(accelerometer) == "the accelerometer's bias steps by 0.5 m/s^2"
    assert str(gyro) == "the gyro's bias steps by 0.02 rad/s"


def test_a_bias_that_the_calibration_got_wrong_is_not_believed() -> None:
    """A drive of 25 s whose gyro has a bias that the calibration takes for none: the graph estimates it anew."""
    log = faults.simulated(26, 25.0)
    drive_bias = faults.IMU.gyro_bias

    calibration = calibrate(log.pairs, log.imu, None, None)
    wrong = np.linalg.norm(calibration.gyro_bias - drive_bias)
    assert wrong > 5 * calibration.gyro_bias_std
    known = fusing.measurements(log.pairs, log.imu, calibration, log.truth.stamps_ns, Findings())

    refined = posegraph.solve(known, PoseGraphConfig()).mounting
    assert refined is not None
    error = refined.gyro_bias - drive_bias
    assert np.linalg.norm(error) < 0.5 * wrong
    assert np.all(np.abs(error) < 3 * refined.gyro_bias_std)
