"""The filter back end: an error-state Kalman filter on the manifold, with a clone of the pose of the last frame.

The nominal state lives outside the filter, which estimates its error (filterpy): the IMU moves the nominal state and
spreads the error; a pair estimate measures the motion from the cloned pose to the present one; the estimated error is
moved into the nominal state; then the present pose becomes the clone. Everything is causal.

Error state (26): attitude, position, velocity, gyro bias, accelerometer bias, direction of gravity (2), rate bias of
the pairs, attitude and position of the clone. Attitudes err on the right, R = R_nominal Exp(error); all else adds.
Gravity is Q e3 times its magnitude, so that only two errors of the rotation Q are felt. The world is the first camera's
frame.

The front end's errors are correlated in time. Its rate bias is a state while an IMU measures, for gyro and gravity can
tell it. Its scale error is not: accelerations tell too little of it, and what they tell would throw the position about.
What it does to the position is carried along beside the filter and added to the covariance.

Sola, "Quaternion kinematics for the error-state Kalman filter", 2017 (error state, reset); Roumeliotis and Burdick,
"Stochastic cloning", 2002.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import accumulate
from typing import NamedTuple

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter
from scipy.linalg import block_diag
from scipy.spatial.transform import RigidTransform, Rotation
from scipy.stats import chi2

from fusion.chain import ImuWindow, ImuWindows, motions_of, stamps_of
from fusion.config import EkfConfig
from fusion_io.records import FloatArray, ImuSeries, PairEstimate, Trajectory

GRAVITY = 9.81  # m/s^2; how far the place differs from it goes into the accelerometer's bias

# Where the errors stand in the filter's state.
ATTITUDE, POSITION, VELOCITY = slice(0, 3), slice(3, 6), slice(6, 9)
GYRO_BIAS, ACCELEROMETER_BIAS, GRAVITY_DIRECTION = slice(9, 12), slice(12, 15), slice(15, 17)
PAIR_RATE_BIAS = slice(17, 20)
CLONE_ATTITUDE, CLONE_POSITION = slice(20, 23), slice(23, 26)
DIMENSION = 26

# The cross products with the three unit vectors.
GENERATORS = np.array(
    [[[0.0, 0, 0], [0, 0, -1], [0, 1, 0]], [[0.0, 0, 1], [0, 0, 0], [-1, 0, 0]], [[0.0, -1, 0], [1, 0, 0], [0, 0, 0]]]
)

# Two small turns of Q move its third column so: Exp(x, y, 0) e3 = e3 + TILT (x, y).
TILT = np.array([[0.0, 1.0], [-1.0, 0.0], [0.0, 0.0]])


@dataclass(frozen=True, slots=True)
class EkfResult:
    """The filtered trajectory and how the filter fared.

    rejected: pair estimates that the gate refused. nis (N,): normalised innovation squared of each step, 6 on average
    where all is modelled right. note: one line on what predicted the motion. gyro_bias
    (3,) rad/s and accelerometer_bias (3,) m/s^2 at the end, in camera axes; gravity (3,) m/s^2 in the world.
    """

    trajectory: Trajectory
    rejected: int
    nis: FloatArray
    note: str
    gyro_bias: FloatArray
    accelerometer_bias: FloatArray
    gravity: FloatArray


class Measurement(NamedTuple):
    """A pair estimate: motion (4, 4), T_source_target, its covariance (6, 6), and the time it took in seconds."""

    motion: FloatArray
    covariance: FloatArray
    seconds: float


@dataclass(frozen=True, slots=True)
class State:
    """The nominal state.

    R (3, 3), p, v (3,): pose and velocity in the world; gyro_bias (rad/s), accelerometer_bias (m/s^2), pair_rate_bias
    (rad/s) (3,) in camera axes; Q (3, 3), whose third column points down; R_clone, p_clone: the pose of the last frame.
    """

    R: FloatArray
    p: FloatArray
    v: FloatArray
    gyro_bias: FloatArray
    accelerometer_bias: FloatArray
    Q: FloatArray
    pair_rate_bias: FloatArray
    R_clone: FloatArray
    p_clone: FloatArray

    @property
    def gravity(self) -> FloatArray:
        """(3,) m/s^2 in the world."""
        return GRAVITY * self.Q[:, 2]

    @property
    def motion(self) -> FloatArray:
        """T_clone_now (4, 4)."""
        motion = np.eye(4)
        motion[:3, :3] = self.R_clone.T @ self.R
        motion[:3, 3] = self.R_clone.T @ (self.p - self.p_clone)
        return motion

    def shown(self, seconds: float) -> FloatArray:
        """What a pair estimate over that time shows of the motion (4, 4): it turns by the rate bias too much."""
        shown = self.motion
        shown[:3, :3] = shown[:3, :3] @ exp(self.pair_rate_bias * seconds)
        return shown


def exp(vectors: FloatArray) -> FloatArray:
    """Rotation matrices (..., 3, 3) of rotation vectors (..., 3)."""
    return np.asarray(Rotation.from_rotvec(vectors).as_matrix())


def log(matrix: FloatArray) -> FloatArray:
    """The rotation vector (3,) of a rotation matrix (3, 3)."""
    return np.asarray(Rotation.from_matrix(matrix).as_rotvec())


def skew(vectors: FloatArray) -> FloatArray:
    """The matrices (..., 3, 3) of the cross products with vectors (..., 3)."""
    return np.tensordot(vectors, GENERATORS, axes=1)


def right_jacobian(vectors: FloatArray) -> FloatArray:
    """J (..., 3, 3) of Exp(vector + d) = Exp(vector) Exp(J d), to first order in d (Sola, eq. 183)."""
    angle = np.linalg.norm(vectors, axis=-1)[..., None, None]
    small = angle < 1e-3  # there the terms of the series that are left out are below rounding
    safe = np.where(small, 1.0, angle)
    first = np.where(small, 0.5 - angle**2 / 24, (1.0 - np.cos(safe)) / safe**2)
    second = np.where(small, 1.0 / 6 - angle**2 / 120, (safe - np.sin(safe)) / safe**3)
    cross = skew(vectors)
    return np.asarray(np.eye(3) - first * cross + second * cross @ cross)


def propagate(state: State, window: ImuWindow) -> tuple[State, FloatArray]:
    """The state after M pieces of IMU, and the Jacobians (M, 26, 26) of its error from piece to piece.

    Rate and acceleration are constant over a piece; the acceleration acts with the attitude halfway through it.
    """
    dt = window.durations[:, None]
    turns = (window.angular_velocity - state.gyro_bias) * dt
    forces = window.linear_acceleration - state.accelerometer_bias
    halves, wholes = exp(turns / 2), exp(turns)
    R = np.stack(list(accumulate(wholes, np.matmul, initial=state.R)))
    R_half = R[:-1] @ halves
    gained = (np.einsum("nij,nj->ni", R_half, forces) + state.gravity) * dt
    v = state.v + np.cumsum(gained, axis=0)
    p = state.p + np.sum((v - gained / 2) * dt, axis=0)

    dt = dt[:, None]
    by_attitude = -R_half @ skew(forces) * dt
    F = np.tile(np.eye(DIMENSION), (len(dt), 1, 1))
    F[:, ATTITUDE, ATTITUDE] = wholes.swapaxes(1, 2)
    F[:, ATTITUDE, GYRO_BIAS] = -right_jacobian(turns) * dt
    F[:, VELOCITY, ATTITUDE] = by_attitude @ halves.swapaxes(1, 2)
    F[:, VELOCITY, GYRO_BIAS] = -by_attitude @ right_jacobian(turns / 2) * (dt / 2)
    F[:, VELOCITY, ACCELEROMETER_BIAS] = -R_half * dt
    F[:, VELOCITY, GRAVITY_DIRECTION] = GRAVITY * state.Q @ TILT * dt
    F[:, POSITION] += F[:, VELOCITY] * (dt / 2)
    F[:, POSITION, VELOCITY] = np.eye(3) * dt
    return replace(state, R=R[-1], p=p, v=v[-1]), F


def shown_jacobian(state: State, seconds: float) -> FloatArray:
    """H (6, 26): how what a pair estimate over that time shows changes with the error, as a right perturbation."""
    turn = state.pair_rate_bias * seconds
    R_shown = state.shown(seconds)[:3, :3]
    H = np.zeros((6, DIMENSION))
    H[:3, ATTITUDE] = exp(-turn)
    H[:3, CLONE_ATTITUDE] = -R_shown.T
    H[:3, PAIR_RATE_BIAS] = right_jacobian(turn) * seconds
    H[3:, POSITION] = exp(-turn) @ state.R.T
    H[3:, CLONE_POSITION] = -H[3:, POSITION]
    H[3:, CLONE_ATTITUDE] = R_shown.T @ skew(state.motion[:3, 3])
    return H


def difference(measured: FloatArray, predicted: FloatArray) -> FloatArray:
    """The innovation (6,) of two motions (4, 4), Log(predicted^-1 measured) to first order, rotation first."""
    R = predicted[:3, :3].T
    return np.concatenate([log(R @ measured[:3, :3]), R @ (measured[:3, 3] - predicted[:3, 3])])


def inject(state: State, error: FloatArray) -> State:
    """The state with an error (26,) moved into it."""
    return State(
        R=state.R @ exp(error[ATTITUDE]),
        p=state.p + error[POSITION],
        v=state.v + error[VELOCITY],
        gyro_bias=state.gyro_bias + error[GYRO_BIAS],
        accelerometer_bias=state.accelerometer_bias + error[ACCELEROMETER_BIAS],
        Q=state.Q @ exp(np.append(error[GRAVITY_DIRECTION], 0.0)),
        pair_rate_bias=state.pair_rate_bias + error[PAIR_RATE_BIAS],
        R_clone=state.R_clone @ exp(error[CLONE_ATTITUDE]),
        p_clone=state.p_clone + error[CLONE_POSITION],
    )


def reset_jacobian(error: FloatArray) -> FloatArray:
    """(26, 26): what is left of an error about a state into which `error` was moved (Sola, section 6.3)."""
    G = np.eye(DIMENSION)
    turns = np.stack([error[ATTITUDE], np.append(error[GRAVITY_DIRECTION], 0.0), error[CLONE_ATTITUDE]])
    G[ATTITUDE, ATTITUDE], of_gravity, G[CLONE_ATTITUDE, CLONE_ATTITUDE] = right_jacobian(turns)
    G[GRAVITY_DIRECTION, GRAVITY_DIRECTION] = of_gravity[:2, :2]
    return G


class Filter:
    """The nominal state, and the covariance of its error in filterpy's filter, through prediction and update."""

    def __init__(self, config: EkfConfig, gyro_bias_std: float = 0.0) -> None:
        self.config = config
        eye, zero = np.eye(3), np.zeros(3)
        self.state = State(eye, zero, zero, zero, zero, eye, zero, eye, zero)
        self.rate = zero  # rad/s in the last step, by which a step without an IMU is predicted to go on
        self.knows_gravity = False
        sigma = np.zeros(DIMENSION)  # the first pose is the world itself, and so is its clone
        sigma[VELOCITY] = config.velocity_sigma
        sigma[GYRO_BIAS] = np.hypot(config.gyro_bias_sigma, gyro_bias_std)
        sigma[ACCELEROMETER_BIAS] = config.accelerometer_bias_sigma
        sigma[GRAVITY_DIRECTION] = config.gravity_sigma
        sigma[PAIR_RATE_BIAS] = config.pair_rate_bias_sigma
        self.kf = ExtendedKalmanFilter(dim_x=DIMENSION, dim_z=6)
        self.kf.x = np.zeros(DIMENSION)
        self.kf.P = np.diag(sigma**2)
        # Covariance of the position error that the pairs' scale has caused (3), and of the scale error itself (1).
        self.by_scale = np.diag([0.0, 0.0, 0.0, config.pair_scale_sigma**2])
        self.imu_walk = np.zeros(DIMENSION)
        self.imu_walk[ATTITUDE] = config.gyro_noise**2
        self.imu_walk[GYRO_BIAS] = config.gyro_bias_walk**2
        self.imu_walk[ACCELEROMETER_BIAS] = config.accelerometer_bias_walk**2

    def predict(self, window: ImuWindow | None, seconds: float) -> None:
        """Move on to the next frame: by what an IMU measured, or else by constant velocity and rate."""
        if window is not None:
            self._predict_by_imu(window)
            self._drift(seconds)
        else:
            self._predict_by_constancy(seconds)

    def squared_innovation(self, measured: Measurement) -> float:
        """Squared Mahalanobis distance from prediction to measurement: chi-square of 6 degrees of freedom."""
        H = shown_jacobian(self.state, measured.seconds)
        innovation = difference(measured.motion, self.state.shown(measured.seconds))
        return float(innovation @ np.linalg.solve(H @ self.kf.P @ H.T + measured.covariance, innovation))

    def update(self, measured: Measurement) -> None:
        """Correct by a measurement since the clone (Joseph form), move the error into the state and reset it."""
        self.kf.update(
            measured.motion,
            HJacobian=lambda _: shown_jacobian(self.state, measured.seconds),
            Hx=lambda _: self.state.shown(measured.seconds),
            R=measured.covariance,
            residual=difference,
        )
        G = reset_jacobian(self.kf.x)
        P = G @ self.kf.P @ G.T
        self.kf.P = (P + P.T) / 2
        self.state = inject(self.state, self.kf.x)
        self.kf.x = np.zeros(DIMENSION)

    def clone(self, seconds: float) -> None:
        """Make the present pose the clone, which lies that time back; it errs as the present pose does."""
        walk = np.diag([1.0, 1.0, 1.0, self._keep(seconds)])
        walk[:3, 3] = self.state.p - self.state.p_clone
        self.by_scale = walk @ self.by_scale @ walk.T
        self.by_scale[3, 3] += (1.0 - self._keep(seconds) ** 2) * self.config.pair_scale_sigma**2

        self.rate = log(self.state.motion[:3, :3]) / seconds
        self.state = replace(self.state, R_clone=self.state.R, p_clone=self.state.p)
        copy = np.eye(DIMENSION)
        copy[CLONE_ATTITUDE] = copy[ATTITUDE]
        copy[CLONE_POSITION] = copy[POSITION]
        self.kf.P = copy @ self.kf.P @ copy.T

    def forget_velocity(self) -> None:
        """Make the velocity as uncertain as at first, and independent of all else."""
        P = self.kf.P.copy()
        P[VELOCITY], P[:, VELOCITY] = 0.0, 0.0
        P[VELOCITY, VELOCITY] = self.config.velocity_sigma**2 * np.eye(3)
        self.kf.P = P

    def pose_covariance(self) -> FloatArray:
        """(6, 6) of the present pose, rotation first, right perturbation."""
        P = self.kf.P[:6, :6].copy()
        P[POSITION, POSITION] += self.by_scale[:3, :3]
        to_body = block_diag(np.eye(3), self.state.R.T)
        return np.asarray(to_body @ P @ to_body.T)

    def _predict_by_imu(self, window: ImuWindow) -> None:
        if not self.knows_gravity:
            self._look_down(window)
        self.state, jacobians = propagate(self.state, window)
        variances = np.outer(window.durations, self.imu_walk)
        self._spread(jacobians, variances, self.config.accelerometer_noise, window.durations)

    def _look_down(self, window: ImuWindow) -> None:
        """Take gravity's direction from the first accelerations: an accelerometer at rest shows what holds it up."""
        down = -self.state.R @ (window.durations @ window.linear_acceleration)
        rotation, _ = Rotation.align_vectors(down[None], [[0.0, 0.0, 1.0]])
        self.state = replace(self.state, Q=rotation.as_matrix())
        self.knows_gravity = True

    def _predict_by_constancy(self, seconds: float) -> None:
        turn = exp(self.rate * seconds)
        self.state = replace(self.state, R=self.state.R @ turn, p=self.state.p + self.state.v * seconds)
        F = np.eye(DIMENSION)
        F[ATTITUDE, ATTITUDE] = turn.T
        F[POSITION, VELOCITY] = np.eye(3) * seconds
        variances = np.zeros(DIMENSION)
        variances[ATTITUDE] = self.config.angular_acceleration**2 * seconds**3
        self._spread(F[None], variances[None], self.config.acceleration, np.array([seconds]))
        # Nothing tells the rate bias of the pairs from turning now: they are taken as they are.
        self.state = replace(self.state, pair_rate_bias=np.zeros(3))
        self.kf.P[PAIR_RATE_BIAS], self.kf.P[:, PAIR_RATE_BIAS] = 0.0, 0.0

    def _drift(self, seconds: float) -> None:
        """Let the rate bias of the pairs fade and wander: a Gauss-Markov process."""
        keep = self._keep(seconds)
        self.state = replace(self.state, pair_rate_bias=keep * self.state.pair_rate_bias)
        factors, variances = np.ones(DIMENSION), np.zeros(DIMENSION)
        factors[PAIR_RATE_BIAS] = keep
        variances[PAIR_RATE_BIAS] = (1.0 - keep**2) * self.config.pair_rate_bias_sigma**2
        self._spread(np.diag(factors)[None], variances[None], 0.0, np.array([seconds]))

    def _keep(self, seconds: float) -> float:
        """What is left of a correlated error of the pairs after that time."""
        return float(np.exp(-seconds / self.config.pair_correlation_s))

    def _spread(self, jacobians: FloatArray, variances: FloatArray, acceleration: float, seconds: FloatArray) -> None:
        """Move the covariance on over M pieces that last seconds (M,), with the jacobians (M, 26, 26) of each.

        variances (M, 26) are added, and what a white acceleration of a density in m/s^2/sqrt(Hz) adds.
        """
        noise = variances[:, :, None] * np.eye(DIMENSION)
        by_axis = (acceleration**2 * seconds)[:, None, None] * np.eye(3)
        seconds = seconds[:, None, None]
        noise[:, VELOCITY, VELOCITY] += by_axis
        noise[:, VELOCITY, POSITION] += by_axis * seconds / 2
        noise[:, POSITION, VELOCITY] += by_axis * seconds / 2
        noise[:, POSITION, POSITION] += by_axis * seconds**2 / 3
        for self.kf.F, self.kf.Q in zip(jacobians, noise, strict=True):
            self.kf.predict()


def solve(
    steps: Sequence[PairEstimate], inertial: ImuSeries | None, config: EkfConfig, gyro_bias_std: float = 0.0
) -> EkfResult:
    """Filter N > 0 steps that follow each other, with an IMU in the camera's axes and time, or None.

    Steps that the IMU did not measure from start to end are predicted by constant velocity and rate. gyro_bias_std
    (rad/s): how well a bias is known that was removed from the gyro.
    """
    imu = ImuWindows(inertial) if inertial is not None else None
    ekf = Filter(config, gyro_bias_std)
    gate = chi2.isf(config.gate_probability, 6)
    states, covariances, nis = [ekf.state], [ekf.pose_covariance()], []
    measured = rejected = in_a_row = 0
    for step, motion in zip(steps, motions_of(steps).as_matrix(), strict=True):
        window = imu.over(step.source_stamp_ns, step.target_stamp_ns) if imu is not None else None
        pair = Measurement(motion, step.covariance, step.duration_s)
        measured += window is not None
        before = ekf.state, ekf.kf.P
        ekf.predict(window, pair.seconds)
        nis.append(ekf.squared_innovation(pair))
        if nis[-1] <= gate:
            in_a_row = 0
            ekf.update(pair)
        elif in_a_row < config.max_rejected_in_a_row:
            in_a_row += 1
            rejected += 1
        else:
            ekf.state, ekf.kf.P = before
            ekf.forget_velocity()
            ekf.predict(None, pair.seconds)
            ekf.update(pair)
        ekf.clone(pair.seconds)
        states.append(ekf.state)
        covariances.append(ekf.pose_covariance())

    rotations = Rotation.from_matrix(np.stack([state.R for state in states]))
    poses = RigidTransform.from_components(np.stack([state.p for state in states]), rotations)
    return EkfResult(
        Trajectory(stamps_of(steps), poses, np.stack(covariances)),
        rejected,
        np.array(nis),
        _note(measured, len(steps)),
        ekf.state.gyro_bias,
        ekf.state.accelerometer_bias,
        ekf.state.gravity,
    )


def _note(measured: int, steps: int) -> str:
    if measured == 0:
        return "predicted by constant velocity: no IMU"
    if measured < steps:
        return f"predicted by the IMU on {measured} of {steps} steps, by constant velocity on the others"
    return "predicted by the IMU"
