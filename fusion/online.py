"""The pose graph as it runs on a robot: at each instant the pose of the latest frame, from what was known by then.

Two layers (as in Qin et al., "VINS-Mono", 2018). A *fixed-lag smoother* has the variables and factors of
`fusion.posegraph` for the last seconds; what leaves its window is marginalised into a Gaussian prior on what stays
(Dong-Si and Mourikis, "Motion tracking with fixed-lag smoothing", 2011), by QR. It knows nothing of loops: its
trajectory, the odometry, drifts. The map of keyframes of `fusion.drift` holds how it drifted there, so that a loop
corrects all keyframes, and the present through the last of them. A full iSAM2 would have to eliminate the way back to
the loop anew.

The pose of frame k depends on measurements until k only, given how the IMU is mounted, what its clock reads, the gyro's
first bias and how large the front end's errors are. Those come from the whole log (`fusion.imu.calibrate`, and found
or refined by `posegraph.solve` where the measurements have that): they stand for what a robot knows from its drives
before. What else was decided over the whole log is not undone either: which stretches of the IMU are faulty, and how
holes between pairs are bridged.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import NamedTuple

import gtsam
import numpy as np
from gtsam.symbol_shorthand import B, E, G, S, V, X
from numpy.typing import NDArray
from scipy.linalg import block_diag, solve_triangular
from scipy.spatial.transform import RigidTransform
from scipy.stats import chi2

from fusion import biases, front_end
from fusion.chain import ImuWindow, ImuWindows, motions_of, stamps_of
from fusion.config import PoseGraphConfig
from fusion.drift import Closures, Odometry, Pose
from fusion.factors import WorldFactor, by_vector, extrinsics, padded
from fusion.imu import ImuCalibration
from fusion.measurements import Estimate, Measurements
from fusion.pair_model import camera, difference, inverse, predict
from fusion.posegraph import (
    FIRST_POSE_SIGMA,
    GRAVITY,
    KNOT_S,
    REJECTED_WEIGHT,
    bias_walk,
    check,
    first_bias_sigmas,
    preintegrate,
    preintegration,
)
from fusion_io.records import NANOSECONDS, FloatArray, Trajectory

LAG = 10  # frames behind the latest one that are estimated anew with it
SETTLING = 20  # frames that all stay at first, until velocity and gravity are known
ITERATIONS = 3  # while it settles, and where a pair was left out
GRAVITY_SIGMA = 0.3  # rad, of the first direction: accelerations hide it
VELOCITY_SIGMA = 30.0  # m/s, of the first one
REJECTED_IN_A_ROW = 5  # pairs; then it is the prediction that is wrong


def solve(measurements: Measurements, config: PoseGraphConfig) -> Estimate:
    """The pose of every frame at its own instant, with its covariance; measurements as for `posegraph.solve`.

    Steps that skip frames, and positions, are not used. Raises LogError for a pair estimate that is no measurement.
    """
    check([*measurements.steps, *measurements.loops])
    tracker = Tracker(measurements, config)
    poses, covariances = zip(tracker.present, *(tracker.advance() for _ in measurements.steps), strict=True)
    stamps = stamps_of(measurements.steps)
    trajectory = Trajectory(stamps, RigidTransform.from_matrix(np.stack(poses)), np.stack(covariances))
    return Estimate(trajectory, tracker.note, tracker.rejected, loops_used=tracker.loops_used)


class Tracker:
    """Follows a camera frame by frame."""

    def __init__(self, measurements: Measurements, config: PoseGraphConfig) -> None:
        self._smoother = Smoother(measurements, config)
        self._closures = Closures(measurements.loops, stamps_of(measurements.steps), config.gate_probability)
        self._steps = len(measurements.steps)
        self.present = Pose(np.eye(4), np.zeros((6, 6)))

    def advance(self) -> Pose:
        """The next frame."""
        self.present = self._closures.move_to(self._smoother.advance(self._closures.keyframe))
        return self.present

    @property
    def loops_used(self) -> NDArray[np.bool_]:
        """Which of the loops (M,) were believed."""
        return self._closures.used

    @property
    def rejected(self) -> int:
        """Measurements that were left out as outliers."""
        return self._smoother.rejected + int(np.sum(~self.loops_used))

    @property
    def note(self) -> str:
        """One line on how the measurements were used."""
        measured = self._smoother.inertial_steps
        rejected = f"; rejected as outliers: {self._smoother.rejected}" if self._smoother.rejected else ""
        used = f"IMU on {measured} of {self._steps} steps" if measured else "pairs only"
        return used + rejected + self._closures.note


# ------------------------------------------------------------------------------------------- the fixed-lag smoother


class _Inertial(NamedTuple):
    """What the IMU measured during a step."""

    window: ImuWindow
    preintegrated: gtsam.PreintegratedImuMeasurements


@dataclass(slots=True)
class _Pair:
    """A pair estimate in the window, with its variables and the twists (2, 6) of the IMU at its ends."""

    step: int
    keys: list[int]
    twists: FloatArray
    weight: float = 1.0


class Smoother:
    """The latest pose relative to the first camera, from pairs and the IMU."""

    def __init__(self, measurements: Measurements, config: PoseGraphConfig) -> None:
        self._config = config
        self._parameters = preintegration(config)
        self._steps = measurements.steps
        assumed = config.front_end_sigma(self._steps[:1])
        told = measurements.front_end_sigma or assumed
        # Larger scale errors are not let in: what never looks back takes wrong pairs for them, and jumps.
        self._front_end_sigma = min(told[0], assumed[0]), told[1]
        self._stamps = stamps_of(self._steps)
        self._seconds = (self._stamps - self._stamps[0]) / NANOSECONDS
        covariances = np.stack([step.covariance for step in self._steps])
        self._whiteners = np.linalg.inv(np.linalg.cholesky(covariances))
        motions = motions_of(self._steps)
        self._motions = np.asarray(motions.as_matrix())
        rates = np.hstack([motions.rotation.as_rotvec(), motions.translation]) / np.diff(self._seconds)[:, None]
        self._calibration = measurements.calibration if measurements.imu is not None else None
        self._samples = ImuWindows(measurements.imu) if measurements.imu is not None else None
        self._bias_steps = measurements.bias_steps
        self._gate = float(chi2.isf(config.gate_probability, 6))
        self._T_camera_imu = np.eye(4)
        if self._calibration is not None:
            self._T_camera_imu[:3, :3] = self._calibration.mounting.inv().as_matrix()
        self._mounting = measurements.mounting
        if self._mounting is not None:
            self._T_camera_imu = self._mounting.T_camera_imu
        self._by_pairs = (rates.reshape(-1, 2, 3) @ self._T_camera_imu[:3, :3]).reshape(-1, 6)  # twists, IMU axes

        self._latest = 0
        self._values = gtsam.Values()
        self._factors: list[gtsam.NonlinearFactor] = []
        self._world: WorldFactor | None = None
        self._pairs: dict[int, _Pair] = {}
        self._evaluated: dict[int, tuple[FloatArray, list[FloatArray]]] = {}  # weighted errors and Jacobians of pairs
        self._point, self._linear, self._step = gtsam.Values(), gtsam.GaussianFactorGraph(), gtsam.VectorValues()
        self._knots = [0]  # of every frame
        self._begins = [0]  # the first frame of every knot
        self._twist = np.zeros(6)
        self._in_a_row = 0
        self.inertial_steps = self.rejected = 0

    def advance(self, keyframe: int) -> Odometry:
        """The next frame."""
        step = self._latest
        self._latest += 1
        inertial = self._measured(step)
        if step == 0:
            self._begin(inertial)
        imu_wrong, pair_wrong = self._judge(step, inertial) if inertial else (False, False)
        if imu_wrong:
            inertial = None
        self._predict(step)
        self._add_knot()
        self._add_inertial(step, inertial)
        self._add_pair(step, inertial, REJECTED_WEIGHT if pair_wrong else 1.0)

        before = self._values
        R = self._iterate(keyframe, ITERATIONS if pair_wrong or self._latest <= SETTLING else 1)
        if self._contradicted(step):
            self._pairs[step].weight = REJECTED_WEIGHT
            self._values = before
            R = self._iterate(keyframe, ITERATIONS)
        rejected = self._pairs[step].weight < 1.0
        self._in_a_row = self._in_a_row + 1 if rejected else 0
        self.rejected += int(rejected) + int(imu_wrong)
        odometry = self._odometry(R, keyframe)
        if self._latest >= SETTLING:
            self._marginalise(keyframe)
        return odometry

    # --- What a frame brings ---

    def _measured(self, step: int) -> _Inertial | None:
        """What the IMU measured during a step."""
        if self._samples is None or self._calibration is None:
            return None
        ends = self._steps[step]
        window = self._samples.over(ends.source_stamp_ns, ends.target_stamp_ns)
        if window is None:
            return None
        knot = self._knots[step]
        bias = self._values.atConstantBias(B(knot)) if step else _first_bias(self._calibration)
        return _Inertial(window, preintegrate(window, bias, self._parameters))

    def _judge(self, step: int, measured: _Inertial) -> tuple[bool, bool]:
        """Whether the IMU, and whether the pair, is wrong: where they contradict each other, who leaves the last rate.

        Motion is smooth: of two rotations that differ by more than noise, the one further from the rate before is
        wrong.
        """
        seconds = self._seconds[step + 1] - self._seconds[step]
        by_pair = self._by_pairs[step, :3]
        by_gyro = gtsam.Rot3.Logmap(measured.preintegrated.deltaRij()) / seconds
        of_pair = np.trace(self._steps[step].covariance[:3, :3]) / 3 / seconds**2
        variance = of_pair + self._front_end_sigma[1] ** 2
        if np.sum((by_pair - by_gyro) ** 2) <= self._gate * variance:
            return False, False
        gyro_away, pair_away = (np.linalg.norm(rate - self._twist[:3]) for rate in (by_gyro, by_pair))
        return bool(gyro_away > pair_away), bool(gyro_away <= pair_away)

    def _begin(self, inertial: _Inertial | None) -> None:
        """The variables of the first frame, and what is known of them."""
        config, calibration = self._config, self._calibration
        self._values.insert(X(0), gtsam.Pose3(self._T_camera_imu))
        self._values.insert(S(0), np.zeros(4))
        front_end = np.repeat(self._front_end_sigma, [1, 3])
        self._factors.append(gtsam.PriorFactorVector(S(0), np.zeros(4), gtsam.noiseModel.Diagonal.Sigmas(front_end)))
        if calibration is None:
            fixed = gtsam.noiseModel.Isotropic.Sigma(6, FIRST_POSE_SIGMA)
            self._factors.append(gtsam.PriorFactorPose3(X(0), gtsam.Pose3(), fixed))
            return
        self._twist = self._twists_by(0, inertial)[0]
        velocity = self._T_camera_imu[:3, :3] @ self._twist[3:]
        bias = _first_bias(calibration)
        self._values.insert(V(0), velocity)
        self._values.insert(B(0), bias)
        strayed, covariance = self._mounting_prior(calibration)
        self._values.insert(E(0), strayed)
        self._factors += [
            gtsam.PriorFactorVector(V(0), velocity, gtsam.noiseModel.Isotropic.Sigma(3, VELOCITY_SIGMA)),
            biases.link(bias, 0, first_bias_sigmas(calibration, config)),
            gtsam.PriorFactorVector(E(0), strayed, gtsam.noiseModel.Gaussian.Covariance(covariance)),
        ]
        self._world = WorldFactor(self._T_camera_imu, self._twist[None], FIRST_POSE_SIGMA)
        self._factors.append(self._world.factor(0))

    def _mounting_prior(self, calibration: ImuCalibration) -> tuple[FloatArray, FloatArray]:
        """E(0) (10,) and its covariance: as a back end has refined it, as the calibration found it, or as given."""
        if (refined := self._mounting) is not None:
            return np.concatenate([np.zeros(6), [refined.ahead_s], refined.misalignment]), refined.covariance
        config, R = self._config, self._T_camera_imu[:3, :3]
        given = not np.any(calibration.rotation_std_rad)
        rotation_std = np.full(3, config.given_mounting_sigma) if given else calibration.rotation_std_rad
        offset_std = calibration.time_offset_std_s or config.given_time_offset_sigma
        others = np.repeat([config.lever_arm_sigma, offset_std, config.pair_misalignment_sigma], [3, 1, 3])
        covariance = block_diag(R.T @ np.diag(rotation_std**2) @ R, np.diag(others**2))
        return np.zeros(10), np.asarray(covariance)

    def _twists_by(self, step: int, inertial: _Inertial | None) -> FloatArray:
        """The twists (2, 6) of the IMU at both ends of a step; where it measured no rates, their mean."""
        twists = np.tile(self._by_pairs[step], (2, 1))
        if inertial is not None:
            twists[:, :3] = inertial.window.rates
        return twists

    def _predict(self, step: int) -> None:
        """The variables of a frame where the pair takes them."""
        F = self._T_camera_imu
        pose = self._values.atPose3(X(step)).matrix() @ inverse(F) @ self._motions[step] @ F
        self._values.insert(X(step + 1), gtsam.Pose3(pose))
        if self._calibration is not None:
            seconds = self._seconds[step + 1] - self._seconds[step]
            moved = pose[:3, 3] - self._values.atPose3(X(step)).translation()
            self._values.insert(V(step + 1), moved / seconds)

    def _add_knot(self) -> None:
        """The states that are one a second, from those a second before."""
        seconds, knot = self._seconds, self._knots[-1]
        if seconds[self._latest] // KNOT_S == seconds[self._latest - 1] // KNOT_S:
            self._knots.append(knot)
            return
        config = self._config
        dt = seconds[self._latest] - seconds[self._begins[knot]]
        self._knots.append(knot + 1)
        self._begins.append(self._latest)
        self._values.insert(S(knot + 1), self._values.atVector(S(knot)))
        self._factors.append(front_end.walk(knot, dt, self._front_end_sigma, config))
        if self._calibration is not None:
            self._values.insert(B(knot + 1), self._values.atConstantBias(B(knot)))
            starts_ns = self._stamps[[self._begins[knot], self._latest]]
            [sigmas] = bias_walk(starts_ns, self._calibration, config)
            for step in self._bias_steps:
                if step.at_ns == starts_ns[1]:
                    sigmas = np.hypot(sigmas, step.std)
            self._factors.append(biases.link(_first_bias(self._calibration), knot + 1, sigmas))

    def _add_inertial(self, step: int, inertial: _Inertial | None) -> None:
        """The factor between two frames that the IMU measured; over others the velocity walks."""
        if self._calibration is None:
            return
        if inertial is None:
            sigma = self._config.unknown_acceleration * np.sqrt(self._seconds[step + 1] - self._seconds[step])
            walk = gtsam.noiseModel.Isotropic.Sigma(3, sigma)
            self._factors.append(gtsam.BetweenFactorVector(V(step), V(step + 1), np.zeros(3), walk))
            return
        if not self._values.exists(G(0)):
            shown = inertial.window.durations @ inertial.window.linear_acceleration
            down = gtsam.Unit3(-self._values.atPose3(X(step)).rotation().matrix() @ shown)
            self._values.insert(G(0), down)
            about = gtsam.noiseModel.Isotropic.Sigma(2, GRAVITY_SIGMA)
            self._factors.append(gtsam.PriorFactorUnit3(G(0), down, about))
        keys = X(step), V(step), X(step + 1), V(step + 1), B(self._knots[step]), G(0)
        self._factors.append(gtsam.ImuFactorWithGravityDirection(*keys, inertial.preintegrated, GRAVITY))
        self.inertial_steps += 1

    def _add_pair(self, step: int, inertial: _Inertial | None, weight: float) -> None:
        twists = np.zeros((2, 6))
        if self._calibration is not None:
            twists = self._twists_by(step, inertial)
            self._twist = twists[1]
        mounted = [] if self._calibration is None else [E(0)]
        keys = [X(step), X(step + 1), *mounted, S(self._knots[step])]
        self._pairs[step] = _Pair(step, keys, twists, weight)
        self._factors.append(gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(6), keys, self._lookup(step)))

    def _lookup(self, step: int) -> Callable[..., FloatArray]:
        def look_up(_: gtsam.CustomFactor, __: gtsam.Values, jacobians: list[FloatArray] | None) -> FloatArray:
            error, by_each = self._evaluated[step]
            if jacobians is not None:
                for place, jacobian in enumerate(by_each):
                    jacobians[place] = jacobian
            return error

        return look_up

    # --- The window ---

    def _evaluate(self) -> None:
        """All pairs in the window, and the tie to the first camera, at the present values."""
        values, pairs = self._values, list(self._pairs.values())
        if self._world is not None:
            self._world.update(values)
        source, target = (
            np.stack([values.atPose3(X(pair.step + after)).matrix() for pair in pairs]) for after in (0, 1)
        )
        inertial = self._calibration is not None
        strayed = values.atVector(E(0)) if inertial else np.zeros(10)
        steps = [pair.step for pair in pairs]
        twists = np.stack([pair.twists for pair in pairs], axis=1)
        shown = predict(
            source,
            target,
            extrinsics(self._T_camera_imu, strayed),
            (twists[0], twists[1]),
            strayed[6],
            strayed[7:],
            np.stack([values.atVector(pair.keys[-1]) for pair in pairs]),
            self._seconds[1:][steps] - self._seconds[steps],
        )
        roots = np.sqrt([pair.weight for pair in pairs])
        whiteners = roots[:, None, None] * self._whiteners[steps]
        errors = -np.einsum("nij,nj->ni", whiteners, difference(shown.motion, self._motions[steps]))
        jacobians = [shown.by_source, shown.by_target, shown.by_front_end]
        if inertial:
            by_mounting = np.concatenate([shown.by_extrinsics @ by_vector(strayed), shown.by_misalignment], axis=2)
            jacobians.insert(2, by_mounting)
        whitened = [whiteners @ each for each in jacobians]
        self._evaluated = {pair.step: (errors[row], [each[row] for each in whitened]) for row, pair in enumerate(pairs)}

    def _iterate(self, keyframe: int, times: int) -> FloatArray:
        """Gauss-Newton steps from the present values; returns R (M, M) of the last one, what is wanted at its end."""
        keys = self._order(keyframe)
        order, dims = _ordering(keys), self._values.dims()
        ends = np.cumsum([dims[key] for key in keys])
        for _ in range(times):
            self._evaluate()
            self._point = self._values
            self._linear = self._graph().linearize(self._point)
            Rd = _triangular(self._linear.augmentedJacobian(order))[: ends[-1]]
            step = solve_triangular(Rd[:, :-1], Rd[:, -1])
            if not np.all(np.isfinite(step)):
                raise RuntimeError(f"the step at frame {self._latest} is not finite")
            self._step = gtsam.VectorValues()
            for key, of_key in zip(keys, np.split(step, ends[:-1]), strict=True):
                self._step.insert(key, of_key)
            self._values = self._point.retract(self._step)
        return np.asarray(Rd[:, :-1])

    def _graph(self) -> gtsam.NonlinearFactorGraph:
        graph = gtsam.NonlinearFactorGraph()
        for factor in self._factors:
            graph.push_back(factor)
        return graph

    def _order(self, keyframe: int) -> list[int]:
        """The variables along time; what all frames share, the keyframe and the latest frame come last."""
        last = [key for key in (G(0), *self._wanted(keyframe)) if self._values.exists(key)]
        return [*sorted(set(self._values.keys()) - set(last), key=self._age), *last]

    def _wanted(self, keyframe: int) -> list[int]:
        """The keyframe and the latest frame, with what they are mounted by."""
        return [X(keyframe), X(self._latest), *([] if self._calibration is None else [E(0)])]

    def _age(self, key: int) -> tuple[int, int]:
        """Where a variable of a frame or a knot stands in time."""
        index = gtsam.symbolIndex(key)
        return (self._begins[index] if _of_knot(key) else index), key

    def _contradicted(self, step: int) -> bool:
        """Whether the latest pair is an outlier beside all else."""
        pair = self._pairs[step]
        if self._config.robust == "none" or pair.weight < 1.0 or self._in_a_row >= REJECTED_IN_A_ROW:
            return False
        error, jacobians = self._evaluated[step]
        error = error + sum(J @ self._step.at(key) for J, key in zip(jacobians, pair.keys, strict=True))
        return float(error @ error) > self._gate

    def _odometry(self, R: FloatArray, keyframe: int) -> Odometry:
        width = 12 if self._calibration is None else 22
        root = solve_triangular(R[-width:, -width:], np.eye(width))
        poses = np.stack([self._values.atPose3(X(frame)).matrix() for frame in (keyframe, self._latest)])
        if self._calibration is None:
            return Odometry(poses[1], root @ root.T)
        strayed = self._values.atVector(E(0))
        twists = np.stack([self._twist, self._twist])
        mounted = extrinsics(self._T_camera_imu, strayed)
        cameras, by_pose, by_extrinsics = camera(poses, mounted, twists, float(strayed[6]))
        by_mounting = padded(by_extrinsics @ by_vector(strayed))
        by_all = np.zeros((12, width))
        by_all[:6, :6], by_all[6:, 6:12], by_all[:, 12:] = *by_pose, by_mounting.reshape(12, -1)
        root = by_all @ root
        return Odometry(cameras[1], root @ root.T)

    def _marginalise(self, keyframe: int) -> None:
        """What is behind the window becomes a prior on what stays, linear about where the last step began."""
        oldest = self._latest - LAG
        stay = X(keyframe), G(0), E(0)
        leaving = {
            key
            for key in self._values.keys()  # noqa: SIM118  # not a mapping
            if key not in stay and self._age(key)[0] < self._first_of_knot(key, oldest)
        }
        if not leaving:
            return
        touched = [not leaving.isdisjoint(factor.keys()) for factor in self._factors]
        graph = gtsam.GaussianFactorGraph()
        for row in np.flatnonzero(touched).tolist():
            graph.push_back(self._linear.at(row))
        order = _ordering(sorted(leaving, key=self._age))
        _, prior = graph.eliminatePartialSequential(order, gtsam.EliminateQR)
        self._factors = [factor for factor, gone in zip(self._factors, touched, strict=True) if not gone]
        self._factors += [gtsam.LinearContainerFactor(prior.at(i), self._point) for i in range(prior.size())]
        for key in leaving:
            self._values.erase(key)
        self._pairs = {step: pair for step, pair in self._pairs.items() if leaving.isdisjoint(pair.keys)}
        if X(0) in leaving:
            self._world = None

    def _first_of_knot(self, key: int, oldest: int) -> int:
        """The first frame that needs a variable like this one while `oldest` is in the window."""
        return self._begins[self._knots[oldest]] if _of_knot(key) else oldest


def _first_bias(calibration: ImuCalibration) -> gtsam.imuBias.ConstantBias:
    return gtsam.imuBias.ConstantBias(np.zeros(3), calibration.gyro_bias)


def _triangular(Ab: FloatArray) -> FloatArray:
    """R (N, N) of a matrix (M, N) = Q R: by Cholesky in half the time, by QR where that fails.

    Steps and covariances then differ by less than a ten-thousandth of the standard deviations.
    """
    with suppress(np.linalg.LinAlgError):
        return np.asarray(np.linalg.cholesky(Ab.T @ Ab, upper=True))
    return np.asarray(np.linalg.qr(Ab, mode="r"))


def _of_knot(key: int) -> bool:
    """Whether a variable is of a knot rather than of a frame."""
    return chr(gtsam.symbolChr(key)) in "bs"


def _ordering(keys: Sequence[int]) -> gtsam.Ordering:
    order = gtsam.Ordering()
    for key in keys:
        order.push_back(key)
    return order
