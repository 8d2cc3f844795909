"""The filter back end: an error-state Kalman filter on the manifold, with a clone of the pose of the last frame.

The nominal state lives outside the filter, which estimates its error (filterpy): the IMU moves the nominal state and
spreads the error; a pair estimate measures the motion from the cloned pose to the present one; the estimated error is
moved into the nominal state; then the present pose becomes the clone. Everything is causal.

Error state (26): attitude, position, velocity, gyro bias, accelerometer bias, gravity direction (2), attitude and
position of the clone. Attitudes err on the right, R = R_nominal Exp(error), all else adds. Gravity is the third column of
a rotation, Q e3 times its magnitude, of which only two errors are felt. The world is the first camera's frame.

Sola, "Quaternion kinematics for the error-state Kalman filter", 2017 (error state, reset); Roumeliotis and Burdick,
"Stochastic cloning", 2002.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import accumulate

import numpy as np
from filterpy.kalman import ExtendedKalmanFilter
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

    note: one line on what predicted the motion. rejected: pair estimates that the gate refused. nis (N,): normalised
    innovation squared of each step, 6 on average where all is modelled right, NaN where there was no measurement.
    gyro_bias (3,) rad/s, accelerometer_bias (3,) m/s^2: at the end, camera axes; gravity (3,) m/s^2 in the world.
    """

    trajectory: Trajectory
    rejected: int
    nis: FloatArray
    note: str
    gyro_bias: FloatArray
    accelerometer_bias: FloatArray
    gravity: FloatArray


@dataclass(frozen=True, slots=True)
class State:
    """The nominal state: pose and velocity in the world, biases in camera axes, gravity = Q e3 GRAVITY, the clone.

    Rotations are matrices (3, 3). rate (3,) rad/s is that of the last step, by which a step without IMU is predicted.
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

    def measurement(self, dt: float) -> FloatArray:
        """What a pair estimate over dt seconds shows of the motion (4, 4): it is turned by the bias of the pairs."""
        shown = self.motion
        shown[:3, :3] = shown[:3, :3] @ exp(self.pair_rate_bias * dt)
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


def measurement_jacobian(state: State, dt: float) -> FloatArray:
    """H (6, 26): how what a pair estimate shows, perturbed on the right, changes with the error."""
    turn = state.pair_rate_bias * dt
    R_shown = state.measurement(dt)[:3, :3]
    H = np.zeros((6, DIMENSION))
    H[:3, ATTITUDE] = exp(-turn)
    H[:3, CLONE_ATTITUDE] = -R_shown.T
    H[:3, PAIR_RATE_BIAS] = right_jacobian(turn) * dt
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
    G[ATTITUDE, ATTITUDE] = right_jacobian(error[ATTITUDE])
    G[CLONE_ATTITUDE, CLONE_ATTITUDE] = right_jacobian(error[CLONE_ATTITUDE])
    G[GRAVITY_DIRECTION, GRAVITY_DIRECTION] = right_jacobian(np.append(error[GRAVITY_DIRECTION], 0.0))[:2, :2]
    return G


class Filter:
    """The nominal state, and the covariance of its error in filterpy's filter, through prediction and update."""

    def __init__(self, config: EkfConfig) -> None:
        self.config = config
        eye, zero = np.eye(3), np.zeros(3)
        self.state = State(eye, zero, zero, zero, zero, eye, zero, eye, zero)
        self.rate = np.zeros(3)  # rad/s in the last step; a step without IMU is predicted to go on so
        self.knows_gravity = False
        self.kf = ExtendedKalmanFilter(dim_x=DIMENSION, dim_z=6)
        self.kf.x = np.zeros(DIMENSION)
        sigma = np.zeros(DIMENSION)  # the first pose is the world itself, and its clone
        sigma[VELOCITY] = config.velocity_sigma
        sigma[GYRO_BIAS] = config.gyro_bias_sigma
        sigma[ACCELEROMETER_BIAS] = config.accelerometer_bias_sigma
        sigma[GRAVITY_DIRECTION] = config.gravity_sigma
        sigma[PAIR_RATE_BIAS] = config.pair_rate_bias_sigma
        self.kf.P = np.diag(sigma**2)
        # Position errors in the world that the scale of the pairs causes (3), and its error (1): see the module.
        self.by_scale = np.diag([0.0, 0.0, 0.0, config.pair_scale_sigma**2])
        density = np.zeros(DIMENSION)
        density[ATTITUDE] = config.gyro_noise
        density[GYRO_BIAS] = config.gyro_bias_walk
        density[ACCELEROMETER_BIAS] = config.accelerometer_bias_walk
        self.imu_walk = np.diag(density**2)

    def predict_by_imu(self, window: ImuWindow) -> None:
        """Move on by what an IMU measured."""
        if not self.knows_gravity:
            self._look_down(window)
        self.state, jacobians = propagate(self.state, window)
        for dt, self.kf.F in zip(window.durations, jacobians, strict=True):
            self.kf.Q = self.imu_walk * dt + _velocity_walk(self.config.accelerometer_noise, dt)
            self.kf.predict()

    def predict_by_constancy(self, dt: float) -> None:
        """Move on with constant velocity in the world and constant rate in the body."""
        config, state = self.config, self.state
        turn = exp(self.rate * dt)
        self.state = replace(state, R=state.R @ turn, p=state.p + state.v * dt)
        self.kf.F = np.eye(DIMENSION)
        self.kf.F[ATTITUDE, ATTITUDE] = turn.T
        self.kf.F[POSITION, VELOCITY] = np.eye(3) * dt
        variance = np.zeros(DIMENSION)
        variance[ATTITUDE] = config.angular_acceleration**2 * dt**3
        self.kf.Q = np.diag(variance) + _velocity_walk(config.acceleration, dt)
        self.kf.predict()

    def drift(self, dt: float) -> None:
        """Let the rate bias of the pairs fade and wander: a Gauss-Markov process."""
        keep = np.exp(-dt / self.config.pair_correlation_s)
        self.state = replace(self.state, pair_rate_bias=keep * self.state.pair_rate_bias)
        factor, variance = np.ones(DIMENSION), np.zeros(DIMENSION)
        factor[PAIR_RATE_BIAS] = keep
        variance[PAIR_RATE_BIAS] = (1 - keep**2) * self.config.pair_rate_bias_sigma**2
        self.kf.F, self.kf.Q = np.diag(factor), np.diag(variance)
        self.kf.predict()

    def forget_velocity(self) -> None:
        """Make the velocity as uncertain as at first, and independent of all else."""
        self.kf.P[VELOCITY, :] = 0.0
        self.kf.P[:, VELOCITY] = 0.0
        self.kf.P[VELOCITY, VELOCITY] = self.config.velocity_sigma**2 * np.eye(3)

    def squared_innovation(self, pair: FloatArray, covariance: FloatArray, dt: float) -> float:
        """Squared Mahalanobis distance of a pair (4, 4) over dt s to the predicted: chi-square, 6 degrees of freedom."""
        H = measurement_jacobian(self.state, dt)
        innovation = difference(pair, self.state.measurement(dt))
        return float(innovation @ np.linalg.solve(H @ self.kf.P @ H.T + covariance, innovation))

    def update(self, pair: FloatArray, covariance: FloatArray, dt: float) -> None:
        """Correct by a pair (4, 4) from the clone dt s ago (Joseph form), move the error into the state and reset it."""
        self.kf.update(
            pair,
            HJacobian=lambda _: measurement_jacobian(self.state, dt),
            Hx=lambda _: self.state.measurement(dt),
            R=covariance,
            residual=difference,
        )
        error = self.kf.x
        G = reset_jacobian(error)
        self.state = inject(self.state, error)
        self.kf.P = G @ self.kf.P @ G.T
        self.kf.P = (self.kf.P + self.kf.P.T) / 2
        self.kf.x = np.zeros(DIMENSION)

    def clone(self, dt: float) -> None:
        """Make the present pose, dt seconds after the clone, the next one; it errs as the present pose does."""
        keep = np.exp(-dt / self.config.pair_correlation_s)
        walk = np.diag([1.0, 1.0, 1.0, keep])
        walk[:3, 3] = self.state.p - self.state.p_clone
        self.by_scale = walk @ self.by_scale @ walk.T
        self.by_scale[3, 3] += (1 - keep**2) * self.config.pair_scale_sigma**2
        self.rate = log(self.state.motion[:3, :3]) / dt
        self.state = replace(self.state, R_clone=self.state.R, p_clone=self.state.p)
        copy = np.eye(DIMENSION)
        copy[CLONE_ATTITUDE] = copy[ATTITUDE]
        copy[CLONE_POSITION] = copy[POSITION]
        self.kf.P = copy @ self.kf.P @ copy.T

    def pose_covariance(self) -> FloatArray:
        """(6, 6) of the present pose, rotation first, right perturbation."""
        to_body = np.eye(6)
        to_body[3:, 3:] = self.state.R.T
        P = self.kf.P[:6, :6].copy()
        P[3:, 3:] += self.by_scale[:3, :3]
        return np.asarray(to_body @ P @ to_body.T)

    def _look_down(self, window: ImuWindow) -> None:
        """Take gravity's direction from the first accelerations: an accelerometer at rest shows what holds it up."""
        up = self.state.R @ (window.durations @ window.linear_acceleration)
        to_up, _ = Rotation.align_vectors(-up[None], np.array([[0.0, 0.0, 1.0]]))
        self.state = replace(self.state, Q=to_up.as_matrix())
        self.knows_gravity = True


def _velocity_walk(density: float, dt: float) -> FloatArray:
    """Covariance (26, 26) of a white acceleration of this density (m/s^2/sqrt(Hz)) over dt seconds."""
    Q = np.zeros((DIMENSION, DIMENSION))
    Q[POSITION, POSITION] = density**2 * dt**3 / 3 * np.eye(3)
    Q[POSITION, VELOCITY] = Q[VELOCITY, POSITION] = density**2 * dt**2 / 2 * np.eye(3)
    Q[VELOCITY, VELOCITY] = density**2 * dt * np.eye(3)
    return Q


def solve(steps: Sequence[PairEstimate], inertial: ImuSeries | None, config: EkfConfig) -> EkfResult:
    """Filter N > 0 steps that follow each other, with an IMU in the camera's axes and time, or without one."""
    filter_ = Filter(config)
    windows = ImuWindows(inertial) if inertial else None
    threshold = chi2.isf(config.gate_probability, 6)
    states, covariances = [filter_.state], [filter_.pose_covariance()]
    nis = np.empty(len(steps))
    measured = rejected = in_a_row = 0
    for k, (step, pair) in enumerate(zip(steps, motions_of(steps).as_matrix(), strict=True)):
        window = windows.over(step.source_stamp_ns, step.target_stamp_ns) if windows else None
        before = filter_.state, filter_.kf.P
        if window:
            measured += 1
            filter_.predict_by_imu(window)
        else:
            filter_.predict_by_constancy(step.duration_s)
        filter_.drift(step.duration_s)
        nis[k] = filter_.squared_innovation(pair, step.covariance, step.duration_s)
        if nis[k] <= threshold:
            in_a_row = 0
            filter_.update(pair, step.covariance, step.duration_s)
        elif in_a_row < config.max_rejected_in_a_row:
            in_a_row += 1
            rejected += 1
        else:
            filter_.state, filter_.kf.P = before
            filter_.forget_velocity()
            filter_.predict_by_constancy(step.duration_s)
            filter_.drift(step.duration_s)
            filter_.update(pair, step.covariance, step.duration_s)
        filter_.clone(step.duration_s)
        states.append(filter_.state)
        covariances.append(filter_.pose_covariance())
    poses = RigidTransform.from_components(
        np.stack([s.p for s in states]), Rotation.from_matrix(np.stack([s.R for s in states]))
    )
    note = f"the IMU predicted {measured} of {len(steps)} steps, constant velocity the others"
    final = filter_.state
    return EkfResult(
        Trajectory(stamps_of(steps), poses, np.stack(covariances)), rejected, nis, note,
        final.gyro_bias, final.accelerometer_bias, final.gravity,
    )
