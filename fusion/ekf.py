"""The filter back end: an error-state Kalman filter on the manifold, with clones of the poses at the last two frames.

The nominal state lives outside the filter, which estimates its error (filterpy): the IMU moves the nominal state and
spreads the error; a pair estimate measures the motion from the last frame's pose to the present one, and one that skips
a frame that from the frame before; the estimated error is moved into the nominal state; then the present pose becomes
the first of the clones. Everything is causal. Loops move the trajectory
through the map of keyframes of `fusion.drift`, and leave the filter alone. Satellite positions are the pose graph's.

Error state (43): attitude, position, velocity (in the IMU's axes), gyro bias, accelerometer bias, direction of gravity
(2), scale error and rate bias of the front end (4), mounting, lever arm, time offset and misalignment (10), attitude
and position of the clones. They are those of the pose graph; what a pair shows of them is in `fusion.pair_model`. Poses
are those of the IMU, attitudes err on the right, R = R_nominal Exp(error); all else adds. Gravity is Q e3 times its
magnitude, so that only two errors of the rotation Q are felt. The world is the first camera's frame. Without an IMU its
axes are the camera's.

The velocity is that in the IMU's own axes, because no pair shows which way the world's are turned: a filter whose
velocity is the world's takes each correction of it for knowledge of the heading (Bloesch et al., "Iterated extended
Kalman filter based visual-inertial odometry using direct photometric feedback", 2017, have it so too).

What a filter learns late, of scale or gravity, moves its position by what it got wrong all the way before. A trajectory
whose past stays where it was must not jump by that: its positions are the sum of the motions as they were known when
they happened, or a frame later (the trail), and the covariance of that sum is carried along exactly, as that of a state
which no update moves; so is that of the camera's pose at the last keyframe (Schmidt, "Application of state-space
methods to navigation problems", 1966). The turn of the world where nothing measured the motion, and the direction was
lost, is such a state, too; to first order, so that positions far from there err along the line to it by more than is
said.

For the same reason the scale error of the front end is only considered: it widens the covariance, and accelerations do
not estimate it. What they tell of it within seconds is little beside gravity and their own bias. The time offset is
only considered, too: what a filter takes for knowledge of it is mostly noise in the rates of turning, which it has from
one side only, and the pose graph has estimated it already.

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

from fusion.chain import ImuWindow, ImuWindows, stamps_of
from fusion.config import EkfConfig
from fusion.drift import Closures, Odometry, Pose
from fusion.imu import ImuCalibration
from fusion.measurements import Estimate, Measurements, Mounting
from fusion.pair_model import Prediction, adjoint, camera, difference, exp, inverse, predict, right_jacobian, skew
from fusion.standstill import STILL_SIGMA, standing_still
from fusion_io.records import EstimatorSeries, FloatArray, IntArray, PairEstimate, Trajectory
from fusion_io.words import counted

GRAVITY = 9.81  # m/s^2; how far the place differs from it goes into the accelerometer's bias

# rad/s^2/sqrt(Hz), m/s^2/sqrt(Hz): so much that a prediction is worth nothing beside any pair.
ANY_MOTION = 1e3, 2e5

LOST = 0.5  # rad: a step whose turn nothing measured to that is an extrapolation
UNKNOWN_TURN = np.pi / np.sqrt(3.0)  # rad: of an angle that may be any

# Where the errors stand in the filter's state.
ATTITUDE, POSITION, VELOCITY = slice(0, 3), slice(3, 6), slice(6, 9)
GYRO_BIAS, ACCELEROMETER_BIAS, GRAVITY_DIRECTION = slice(9, 12), slice(12, 15), slice(15, 17)
FRONT_END = slice(17, 21)  # scale error, rate bias
MOUNTING, LEVER_ARM, TIME_OFFSET, MISALIGNMENT = slice(21, 24), slice(24, 27), slice(27, 28), slice(28, 31)
EXTRINSICS, MOUNTED = slice(21, 28), slice(21, 31)
CLONE_ATTITUDE = slice(31, 34), slice(37, 40)  # at the last frame, and at the one before
CLONE_POSITION = slice(34, 37), slice(40, 43)
CONSIDERED = [17, 27]  # scale error and time offset
DIMENSION = 43

# Where the errors of the past stand: of the IMU's position on the trail at the frame before the last one, of the
# camera's pose at the last keyframe, and how the world has turned where the direction was lost.
TRAIL, KEYFRAME, TURN = slice(0, 3), slice(3, 9), slice(9, 12)
PAST = 12

# Two small turns of Q move its third column so: Exp(x, y, 0) e3 = e3 + TILT (x, y).
TILT = np.array([[0.0, 1.0], [-1.0, 0.0], [0.0, 0.0]])


class Measurement(NamedTuple):
    """A pair estimate: motion (4, 4), T_source_target, its covariance (6, 6), and the time it took in seconds.

    since: which of the clones it begins at.
    """

    motion: FloatArray
    covariance: FloatArray
    seconds: float
    since: int = 0


@dataclass(frozen=True, slots=True)
class State:
    """The nominal state.

    R (3, 3), p (3,): pose of the IMU in the world; v (3,) m/s, rate (3,) rad/s: its velocity, and that of its turning,
    in its own axes; gyro_bias (rad/s), accelerometer_bias (m/s^2) (3,) in them, too; Q (3, 3), whose third column
    points down; front_end (4,): scale error and rate bias (rad/s); T_camera_imu (4, 4); ahead_s: how much further ahead
    the IMU's clock is than was thought; misalignment (3,) rad; clones (2, 4, 4), clone_twists (2, 6): pose and twist of
    the IMU at the last frame and at the one before.
    """

    R: FloatArray
    p: FloatArray
    v: FloatArray
    rate: FloatArray
    gyro_bias: FloatArray
    accelerometer_bias: FloatArray
    Q: FloatArray
    front_end: FloatArray
    T_camera_imu: FloatArray
    ahead_s: float
    misalignment: FloatArray
    clones: FloatArray
    clone_twists: FloatArray

    @property
    def gravity(self) -> FloatArray:
        """(3,) m/s^2 in the world."""
        return GRAVITY * self.Q[:, 2]

    @property
    def pose(self) -> FloatArray:
        """T_world_imu (4, 4)."""
        return pose(self.R, self.p)

    @property
    def twist(self) -> FloatArray:
        """(6,) of the IMU in its own axes, rotation first."""
        return np.concatenate([self.rate, self.v])

    def shown(self, measured: Measurement) -> Prediction:
        """What a pair estimate would show."""
        return predict(
            self.clones[measured.since, None],
            self.pose[None],
            self.T_camera_imu,
            (self.clone_twists[measured.since, None], self.twist[None]),
            self.ahead_s,
            self.misalignment,
            self.front_end[None],
            np.array([measured.seconds]),
        )


def pose(R: FloatArray, p: FloatArray) -> FloatArray:
    """The rigid transform (4, 4) of a rotation (3, 3) and a position (3,)."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, p
    return T


def log(matrix: FloatArray) -> FloatArray:
    """The rotation vector (3,) of a rotation matrix (3, 3)."""
    return np.asarray(Rotation.from_matrix(matrix).as_rotvec())


def propagate(state: State, window: ImuWindow) -> tuple[State, FloatArray, FloatArray]:
    """The state after M pieces of IMU, the Jacobians (M, 43, 43) of its error from piece to piece, and by noise.

    Rate and acceleration are constant over a piece; the acceleration acts with the attitude halfway through it. The
    noise of a piece, whose Jacobian (M, 43, 43) is the other, is that of `Filter._spread`.
    """
    dt = window.durations[:, None]
    turns = (window.angular_velocity - state.gyro_bias) * dt
    forces = window.linear_acceleration - state.accelerometer_bias
    halves, wholes = exp(turns / 2), exp(turns)
    R = np.stack(list(accumulate(wholes, np.matmul, initial=state.R)))
    R_half = R[:-1] @ halves
    gained = (np.einsum("nij,nj->ni", R_half, forces) + state.gravity) * dt
    in_world = state.R @ state.v + np.cumsum(gained, axis=0)
    p = state.p + np.sum((in_world - gained / 2) * dt, axis=0)
    v = np.concatenate([state.v[None], np.einsum("nji,nj->ni", R[1:], in_world)])

    dt = dt[:, None]
    unturn, unturn_half = wholes.swapaxes(1, 2), halves.swapaxes(1, 2)
    by_turn = -right_jacobian(turns) * dt
    force_by_bias = halves @ skew(forces) @ right_jacobian(turns / 2) * (dt / 2)  # the turn halfway changes with it
    F = np.tile(np.eye(DIMENSION), (len(dt), 1, 1))
    F[:, ATTITUDE, ATTITUDE] = unturn
    F[:, ATTITUDE, GYRO_BIAS] = by_turn
    F[:, VELOCITY, ATTITUDE] = unturn @ skew(R[:-1].swapaxes(1, 2) @ state.gravity) * dt
    F[:, VELOCITY, VELOCITY] = unturn
    F[:, VELOCITY, GYRO_BIAS] = skew(v[1:]) @ by_turn + unturn @ force_by_bias * dt
    F[:, VELOCITY, ACCELEROMETER_BIAS] = -unturn_half * dt
    F[:, VELOCITY, GRAVITY_DIRECTION] = R[1:].swapaxes(1, 2) @ (GRAVITY * state.Q @ TILT) * dt
    F[:, POSITION, ATTITUDE] = -R[:-1] @ (skew(v[:-1]) + skew(np.einsum("nij,nj->ni", halves, forces)) * (dt / 2)) * dt
    F[:, POSITION, VELOCITY] = R[:-1] * dt
    F[:, POSITION, GYRO_BIAS] = R[:-1] @ force_by_bias * (dt**2 / 2)
    F[:, POSITION, ACCELEROMETER_BIAS] = -R_half * (dt**2 / 2)
    F[:, POSITION, GRAVITY_DIRECTION] = GRAVITY * state.Q @ TILT * (dt**2 / 2)
    by_noise = np.tile(np.eye(DIMENSION), (len(dt), 1, 1))
    by_noise[:, VELOCITY, ATTITUDE] = skew(v[1:])
    by_noise[:, POSITION, POSITION] = R[1:]
    clone_twists = state.clone_twists.copy()
    clone_twists[0, :3], rate = window.rates - state.gyro_bias
    return replace(state, R=R[-1], p=p, v=v[-1], rate=rate, clone_twists=clone_twists), F, by_noise


def shown_jacobian(state: State, shown: Prediction, since: int) -> FloatArray:
    """H (6, 43): how what a pair estimate since one of the clones shows changes with the error, on the right."""
    H = np.zeros((6, DIMENSION))
    H[:, ATTITUDE] = shown.by_target[0, :, :3]
    H[:, POSITION] = shown.by_target[0, :, 3:] @ state.R.T
    H[:, CLONE_ATTITUDE[since]] = shown.by_source[0, :, :3]
    H[:, CLONE_POSITION[since]] = shown.by_source[0, :, 3:] @ state.clones[since, :3, :3].T
    H[:, FRONT_END] = shown.by_front_end[0]
    H[:, EXTRINSICS] = shown.by_extrinsics[0]
    H[:, MISALIGNMENT] = shown.by_misalignment[0]
    return H


def world_jacobian(state: State, since: int) -> FloatArray:
    """(43, 6): how all poses err with one of the clones where it is the world that errs: attitude, position."""
    N = np.zeros((DIMENSION, 6))
    first = state.clones[since]
    places = zip((ATTITUDE, *CLONE_ATTITUDE), (POSITION, *CLONE_POSITION), strict=True)
    for (attitude, position), T in zip(places, (state.pose, *state.clones), strict=True):
        N[attitude, :3] = T[:3, :3].T @ first[:3, :3]
        N[position, :3] = -skew(T[:3, 3] - first[:3, 3]) @ first[:3, :3]
        N[position, 3:] = np.eye(3)
    return N


def inject(state: State, error: FloatArray) -> State:
    """The state with an error (43,) moved into it."""
    clones = [
        pose(clone[:3, :3] @ exp(error[attitude]), clone[:3, 3] + error[position])
        for clone, attitude, position in zip(state.clones, CLONE_ATTITUDE, CLONE_POSITION, strict=True)
    ]
    return replace(
        state,
        R=state.R @ exp(error[ATTITUDE]),
        p=state.p + error[POSITION],
        v=state.v + error[VELOCITY],
        gyro_bias=state.gyro_bias + error[GYRO_BIAS],
        accelerometer_bias=state.accelerometer_bias + error[ACCELEROMETER_BIAS],
        Q=state.Q @ exp(np.append(error[GRAVITY_DIRECTION], 0.0)),
        front_end=state.front_end + error[FRONT_END],
        T_camera_imu=state.T_camera_imu @ pose(exp(error[MOUNTING]), error[LEVER_ARM]),
        ahead_s=state.ahead_s + float(error[TIME_OFFSET][0]),
        misalignment=state.misalignment + error[MISALIGNMENT],
        clones=np.stack(clones),
    )


def turning_sigma(covariance: FloatArray) -> float:
    """The standard deviation (rad) of a pair's rotation about its worst axis, from its covariance (6, 6)."""
    return float(np.sqrt(np.linalg.eigvalsh(covariance[:3, :3])[-1]))


def reset_jacobian(error: FloatArray) -> FloatArray:
    """(43, 43): what is left of an error about a state into which `error` was moved (Sola, section 6.3)."""
    G = np.eye(DIMENSION)
    turned = (ATTITUDE, *CLONE_ATTITUDE, MOUNTING)
    turns = [*(error[part] for part in turned), np.append(error[GRAVITY_DIRECTION], 0.0)]
    *left, of_gravity = right_jacobian(np.stack(turns))
    for part, matrix in zip(turned, left, strict=True):
        G[part, part] = matrix
    G[GRAVITY_DIRECTION, GRAVITY_DIRECTION] = of_gravity[:2, :2]
    G[LEVER_ARM, LEVER_ARM] = exp(error[MOUNTING]).T  # it moves along axes that have turned
    return G


class Filter:
    """The nominal state, and the covariance of its error in filterpy's filter, through prediction and update."""

    def __init__(
        self,
        config: EkfConfig,
        calibration: ImuCalibration | None,
        mounting: Mounting | None,
        front_end_sigma: tuple[float, float],
        camera_twist: FloatArray,
    ) -> None:
        """camera_twist (6,): of the camera at first, in its own axes, rotation first; it need not be exact."""
        self.config = config
        self.unknown = config.angular_acceleration, config.acceleration
        zero = np.zeros(3)
        T_camera_imu, gyro_bias = np.eye(4), zero
        sigma = np.zeros(DIMENSION)
        sigma[VELOCITY] = config.velocity_sigma
        sigma[GRAVITY_DIRECTION] = config.gravity_sigma
        self.has_imu = calibration is not None
        self.guessed = False
        if calibration is None:
            self.unknown = ANY_MOTION
        else:
            T_camera_imu[:3, :3] = calibration.mounting.inv().as_matrix()
            gyro_bias = calibration.gyro_bias
            sigma[GYRO_BIAS] = np.hypot(config.gyro_bias_sigma, calibration.gyro_bias_std)
            sigma[ACCELEROMETER_BIAS] = config.accelerometer_bias_sigma
            sigma[MOUNTING] = np.hypot(config.mounting_sigma, calibration.rotation_std_rad)
            sigma[LEVER_ARM] = config.lever_arm_sigma
            sigma[TIME_OFFSET] = np.hypot(config.time_offset_sigma, calibration.time_offset_std_s)
            sigma[MISALIGNMENT] = config.pair_misalignment_sigma
        ahead_s, misalignment = 0.0, zero
        if mounting is not None:
            T_camera_imu, ahead_s, misalignment = mounting.T_camera_imu, mounting.ahead_s, mounting.misalignment
            gyro_bias, sigma[GYRO_BIAS] = mounting.gyro_bias, mounting.gyro_bias_std
        self.front_end_sigma = np.repeat(front_end_sigma, [1, 3])
        sigma[FRONT_END] = self.front_end_sigma
        P = np.diag(sigma**2)
        if mounting is not None:
            P[MOUNTED, MOUNTED] = mounting.covariance
        self.front_end_s = np.repeat([config.pair_scale_correlation_s, config.pair_rate_bias_correlation_s], [1, 3])
        twist = adjoint(inverse(T_camera_imu)) @ camera_twist
        moved = np.asarray(RigidTransform.from_exp_coords(ahead_s * twist).as_matrix())
        first = T_camera_imu @ inverse(moved)
        R, p = first[:3, :3], first[:3, 3]
        self.state = State(
            R,
            p,
            twist[3:],
            twist[:3],
            gyro_bias,
            zero,
            np.eye(3),
            np.zeros(4),
            T_camera_imu,
            ahead_s,
            misalignment,
            np.stack([first, first]),
            np.stack([twist, twist]),
        )
        self.knows_gravity = False
        self.kf = ExtendedKalmanFilter(dim_x=DIMENSION, dim_z=6)
        self.kf.x = np.zeros(DIMENSION)
        # The first camera is the world itself, so that the IMU's first pose errs as its mounting and its clock do.
        by_extrinsics = np.column_stack([adjoint(moved), -twist])
        tie = np.eye(DIMENSION)
        for attitude, position in zip((ATTITUDE, *CLONE_ATTITUDE), (POSITION, *CLONE_POSITION), strict=True):
            tie[attitude, EXTRINSICS] = by_extrinsics[:3]
            tie[position, EXTRINSICS] = R @ by_extrinsics[3:]
        self.kf.P = tie @ P @ tie.T
        self.trail = p  # of the IMU, at the frame before the last one
        self.lost_at = p
        self.past_covariance = np.zeros((PAST, PAST))  # of what no update moves
        self.past_covariance[TRAIL, TRAIL] = self.kf.P[POSITION, POSITION]
        self.past_cross = np.zeros((PAST, DIMENSION))  # with the error of the state
        self.past_cross[TRAIL] = self.kf.P[POSITION]
        self.imu_walk = np.zeros(DIMENSION)
        self.imu_walk[ATTITUDE] = config.gyro_noise**2
        self.imu_walk[GYRO_BIAS] = config.gyro_bias_walk**2
        self.imu_walk[ACCELEROMETER_BIAS] = config.accelerometer_bias_walk**2

    def predict(self, window: ImuWindow | None, seconds: float) -> None:
        """Move on to the next frame: by what an IMU measured, or else by constant velocity and rate."""
        self.guessed = window is None
        if window is not None:
            self._predict_by_imu(window)
        else:
            self._predict_by_constancy(seconds)
        self._drift(seconds)

    def squared_innovation(self, measured: Measurement) -> tuple[FloatArray, float]:
        """The innovation (6,), rotation first, and its squared Mahalanobis norm: chi-square of 6 degrees of freedom."""
        shown = self.state.shown(measured)
        H = shown_jacobian(self.state, shown, measured.since)
        innovation = difference(shown.motion, measured.motion[None])[0]
        return innovation, float(innovation @ np.linalg.solve(H @ self.kf.P @ H.T + measured.covariance, innovation))

    def update(self, measured: Measurement) -> None:
        """Correct by a measurement since a clone (Joseph form), move the error into the state and reset it.

        Where no IMU predicted the motion the Jacobian is that of where the measurement leaves the state (Bell and
        Cathey, "The iterated Kalman filter update as a Gauss-Newton method", 1993): that of a guess that is off by some
        degrees would tie the present pose to the clones by the wrong motion, and the next measurement would take that
        for an error of the world. What an IMU predicts is better than a pair, whose noise the Jacobian is spared.
        """
        before, error = self.kf.P, np.zeros(DIMENSION)
        for _ in range(2 if self.guessed else 1):
            at = inject(self.state, error)
            shown = at.shown(measured)
            H = shown_jacobian(at, shown, measured.since) @ reset_jacobian(error)
            innovation = difference(shown.motion, measured.motion[None])[0] + H @ error
            self.kf.x, self.kf.P = np.zeros(DIMENSION), before
            self.kf.update(innovation, HJacobian=lambda _, H=H: H, Hx=lambda _: np.zeros(6), R=measured.covariance)
            self._consider(before, H, measured)
            error = self.kf.x
        self._move_error(H)

    def update_unless_outlier(self, measured: Measurement, gate: float) -> bool:
        """Correct by a measurement whose squared innovation is within a gate; returns whether it is."""
        if self.squared_innovation(measured)[1] > gate:
            return False
        self.update(measured)
        return True

    def stand_still(self) -> None:
        """Correct by the knowledge that the IMU does not move (zero-velocity update)."""
        H = np.zeros((3, DIMENSION))
        H[:, VELOCITY] = np.eye(3)
        self.kf.update(
            np.zeros(3),
            HJacobian=lambda _: H,
            Hx=lambda _: self.state.v,
            R=STILL_SIGMA**2 * np.eye(3),
        )
        self._move_error(H)

    def _consider(self, before: FloatArray, H: FloatArray, measured: Measurement) -> None:
        """Take back what an update by H did to what is only considered; before: the covariance until then.

        Without those rows the gain is not the best one, and the covariance follows by Joseph's form, good for any.

        Without an IMU a pair tells nothing of the world, and so nothing of the clone that it begins at, nor of the
        lasting errors of its own front end. What the gain has of them is of the linearisation, times how uncertain the
        world is by now (Huang, Mourikis, Roumeliotis, "Observability-based rules for designing consistent EKF SLAM
        estimators", 2010): all poses are moved back, so that the clone stays.
        """
        gain = self.kf.K.copy()
        gain[CONSIDERED] = 0.0
        if not self.has_imu:
            clone = np.r_[CLONE_ATTITUDE[measured.since], CLONE_POSITION[measured.since]]
            gain[FRONT_END] = 0.0
            gain = gain - world_jacobian(self.state, measured.since) @ gain[clone]
        keep = np.eye(DIMENSION) - gain @ H
        self.kf.K, self.kf.x = gain, gain @ self.kf.y
        self.kf.P = keep @ before @ keep.T + gain @ measured.covariance @ gain.T

    def _move_error(self, H: FloatArray) -> None:
        """After an update by H (M, 43): move the error into the state, and reset it."""
        G = reset_jacobian(self.kf.x)
        self.past_cross = self.past_cross @ (np.eye(DIMENSION) - self.kf.K @ H).T @ G.T
        P = G @ self.kf.P @ G.T
        self.kf.P = (P + P.T) / 2
        self.state = inject(self.state, self.kf.x)
        self.kf.x = np.zeros(DIMENSION)

    def clone(self) -> None:
        """Make the present pose the first of the clones, and let the trail go on to the one that it was."""
        first, second = CLONE_POSITION
        self.trail = self.trail + self.state.clones[0, :3, 3] - self.state.clones[1, :3, 3]
        added = self.kf.P[first] - self.kf.P[second]
        cross = self.past_cross[:, first] - self.past_cross[:, second]
        covariance = self.past_covariance.copy()
        covariance[:, TRAIL] += cross
        covariance[TRAIL] += cross.T
        covariance[TRAIL, TRAIL] += added[:, first] - added[:, second]
        self.past_covariance = covariance
        self.past_cross = self.past_cross.copy()
        self.past_cross[TRAIL] += added
        state = self.state
        self.state = replace(
            state,
            clones=np.stack([state.pose, state.clones[0]]),
            clone_twists=np.stack([state.twist, state.clone_twists[0]]),
        )
        copy, same = np.eye(DIMENSION), np.eye(DIMENSION)
        for (new, old), present in zip((CLONE_ATTITUDE, CLONE_POSITION), (ATTITUDE, POSITION), strict=True):
            copy[new], copy[old] = same[present], same[new]
        self.kf.P = copy @ self.kf.P @ copy.T
        self.past_cross = self.past_cross @ copy.T

    def lose_direction(self, measured: Measurement) -> None:
        """Move on by a motion that is no more than an extrapolation, after which it is unknown which way the world is.

        No linear update bears an attitude that is uncertain by about a radian, and none need: what was known of the
        world turns about the last position that was measured by one unknown rotation, which no measurement feels. It
        widens the covariances of the poses that follow. Gravity is looked for anew.
        """
        state, to_imu, here = self.state, self.state.T_camera_imu, self.on_trail
        moved = inverse(to_imu) @ measured.motion @ to_imu
        F, by_noise, variances = np.eye(DIMENSION), np.eye(DIMENSION), np.zeros(DIMENSION)
        F[ATTITUDE, ATTITUDE] = moved[:3, :3].T
        F[POSITION, ATTITUDE] = -state.R @ skew(moved[:3, 3])
        variances[POSITION] = measured.covariance[3:, 3:].trace() / 3
        self.state = replace(state, R=state.R @ moved[:3, :3], p=state.p + state.R @ moved[:3, 3])
        self._spread(F[None], by_noise[None], variances[None], 0.0, np.array([measured.seconds]))
        self._drift(measured.seconds)
        self.knows_gravity = False
        # What an earlier loss did to the position until here stays with it; from here on the turns are one.
        settled = np.eye(PAST)
        settled[TRAIL, TURN] = -skew(here - self.lost_at)
        self.past_covariance = settled @ self.past_covariance @ settled.T
        self.past_covariance[TURN, TURN] += min(turning_sigma(measured.covariance), UNKNOWN_TURN) ** 2 * np.eye(3)
        self.past_cross = settled @ self.past_cross
        self.lost_at = here

    def forget_velocity(self) -> None:
        """Make the velocity as uncertain as at first, and independent of all else."""
        self._renew_velocity(self.config.velocity_sigma**2)

    def take_twist(self, measured: Measurement) -> None:
        """Where no IMU measures it, rate and velocity are those of the step that was measured just now."""
        seconds = measured.seconds
        last = self.state.clones[0]
        turned = log(last[:3, :3].T @ self.state.R)
        halfway = self.state.R @ exp(-turned / 2)  # a mean velocity is that of the middle
        velocity = halfway.T @ (self.state.p - last[:3, 3]) / seconds
        self.state = replace(self.state, rate=turned / seconds, v=velocity)
        variance = measured.covariance[3:, 3:].trace() / 3 / seconds**2 + self.unknown[1] ** 2 * seconds
        self._renew_velocity(variance)

    def doubt_biases(self, std: FloatArray) -> None:
        """Make the biases of accelerometer and gyro more uncertain by std (6,): they may have stepped."""
        self.kf.P[ACCELEROMETER_BIAS, ACCELEROMETER_BIAS] += np.diag(std[:3] ** 2)
        self.kf.P[GYRO_BIAS, GYRO_BIAS] += np.diag(std[3:] ** 2)

    def _renew_velocity(self, variance: float) -> None:
        P = self.kf.P.copy()
        P[VELOCITY], P[:, VELOCITY] = 0.0, 0.0
        P[VELOCITY, VELOCITY] = variance * np.eye(3)
        self.kf.P = P
        self.past_cross = self.past_cross.copy()
        self.past_cross[:, VELOCITY] = 0.0

    def odometry(self) -> Odometry:
        """The pose of the camera on the trail, and its covariance with that at the last keyframe."""
        T, by_state, by_past = self._camera()
        of_present, _ = self._present(by_state, by_past)
        with_keyframe = (by_state @ self.past_cross.T + by_past @ self.past_covariance)[:, KEYFRAME]
        of_keyframe = self.past_covariance[KEYFRAME, KEYFRAME]
        return Odometry(T, np.block([[of_keyframe, with_keyframe.T], [with_keyframe, of_present]]))

    def keep(self) -> None:
        """Make the present pose of the camera the keyframe."""
        _, by_state, by_past = self._camera()
        of_present, with_state = self._present(by_state, by_past)
        with_past = by_state @ self.past_cross.T + by_past @ self.past_covariance
        covariance, cross = self.past_covariance.copy(), self.past_cross.copy()
        covariance[KEYFRAME], covariance[:, KEYFRAME] = with_past, with_past.T
        covariance[KEYFRAME, KEYFRAME] = of_present
        cross[KEYFRAME] = with_state
        self.past_covariance, self.past_cross = covariance, cross

    @property
    def on_trail(self) -> FloatArray:
        """The present position (3,) of the IMU on the trail."""
        return self.trail + self.state.p - self.state.clones[1, :3, 3]

    def _camera(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """The camera's pose (4, 4) on the trail, and how it changes with the state (6, 43) and the past (6, 12)."""
        state, here = self.state, self.on_trail
        on_trail = pose(state.R, here)[None]
        cameras, by_pose, by_extrinsics = camera(on_trail, state.T_camera_imu, state.twist[None], state.ahead_s)
        by_state, by_past = np.zeros((6, DIMENSION)), np.zeros((6, PAST))
        by_state[:, ATTITUDE] = by_pose[0, :, :3]
        by_state[:, EXTRINSICS] = by_extrinsics[0]
        by_past[:, TRAIL] = by_pose[0, :, 3:] @ state.R.T
        by_state[:, POSITION], by_state[:, CLONE_POSITION[1]] = by_past[:, TRAIL], -by_past[:, TRAIL]
        by_past[:, TURN] = by_pose[0, :, :3] @ state.R.T - by_past[:, TRAIL] @ skew(here - self.lost_at)
        return cameras[0], by_state, by_past

    def _present(self, by_state: FloatArray, by_past: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The covariance (6, 6) of a pose, and that (6, 43) with the error of the state."""
        crossed = by_past @ self.past_cross @ by_state.T
        of_past = by_past @ self.past_covariance @ by_past.T
        covariance = by_state @ self.kf.P @ by_state.T + crossed + crossed.T + of_past
        return (covariance + covariance.T) / 2, by_state @ self.kf.P + by_past @ self.past_cross

    def mounting(self) -> Mounting:
        """How the IMU is mounted, as far as it is known by now."""
        state = self.state
        covariance = self.kf.P[MOUNTED, MOUNTED].copy()
        bias, bias_std = state.gyro_bias, self.std(GYRO_BIAS)
        return Mounting(state.T_camera_imu, state.ahead_s, state.misalignment, covariance, bias, bias_std)

    def std(self, part: slice) -> FloatArray:
        """The standard deviations of a part of the error."""
        return np.asarray(np.sqrt(np.diag(self.kf.P)[part]))

    def _predict_by_imu(self, window: ImuWindow) -> None:
        if not self.knows_gravity:
            self._look_down(window)
        self.state, jacobians, by_noise = propagate(self.state, window)
        variances = np.outer(window.durations, self.imu_walk)
        self._spread(jacobians, by_noise, variances, self.config.accelerometer_noise, window.durations)

    def _look_down(self, window: ImuWindow) -> None:
        """Take gravity's direction from the next accelerations: an accelerometer at rest shows what holds it up.

        It errs as the attitude does, and by what they held beside gravity.
        """
        down = -self.state.R @ (window.durations @ window.linear_acceleration)
        rotation, _ = Rotation.align_vectors(down[None], [[0.0, 0.0, 1.0]])
        self.state = replace(self.state, Q=rotation.as_matrix())
        taken = np.eye(DIMENSION)
        taken[GRAVITY_DIRECTION] = 0.0
        taken[GRAVITY_DIRECTION, ATTITUDE] = (self.state.Q.T @ self.state.R)[:2]
        self.kf.P = taken @ self.kf.P @ taken.T
        self.kf.P[GRAVITY_DIRECTION, GRAVITY_DIRECTION] += self.config.gravity_sigma**2 * np.eye(2)
        self.past_cross = self.past_cross @ taken.T
        self.knows_gravity = True

    def _predict_by_constancy(self, seconds: float) -> None:
        """Rate and velocity stay as they are, in the axes of the IMU: it goes on along an arc."""
        turn, halfway = exp(self.state.rate * seconds), exp(self.state.rate * seconds / 2)
        R, v = self.state.R, halfway @ self.state.v
        self.state = replace(self.state, R=R @ turn, p=self.state.p + R @ v * seconds)
        F, by_noise = np.eye(DIMENSION), np.eye(DIMENSION)
        F[ATTITUDE, ATTITUDE] = turn.T
        F[POSITION, ATTITUDE] = -R @ skew(v) * seconds
        F[POSITION, VELOCITY] = R @ halfway * seconds
        by_noise[POSITION, POSITION] = self.state.R
        variances = seconds * self.imu_walk
        angular_acceleration, acceleration = self.unknown
        variances[ATTITUDE] = angular_acceleration**2 * seconds**3
        self._spread(F[None], by_noise[None], variances[None], acceleration, np.array([seconds]))

    def _drift(self, seconds: float) -> None:
        """Let the lasting errors of the front end fade and wander: Gauss-Markov processes."""
        keep = np.exp(-seconds / self.front_end_s)
        self.state = replace(self.state, front_end=keep * self.state.front_end)
        factors, variances = np.ones(DIMENSION), np.zeros(DIMENSION)
        factors[FRONT_END] = keep
        variances[FRONT_END] = (1.0 - keep**2) * self.front_end_sigma**2
        self._spread(np.diag(factors)[None], np.eye(DIMENSION)[None], variances[None], 0.0, np.array([seconds]))

    def _spread(
        self,
        jacobians: FloatArray,
        by_noise: FloatArray,
        variances: FloatArray,
        acceleration: float,
        seconds: FloatArray,
    ) -> None:
        """Move the covariance on over M pieces that last seconds (M,), with the jacobians (M, 43, 43) of each.

        Noise has variances (M, 43), and that of a white acceleration of a density in m/s^2/sqrt(Hz), whose position is
        in the axes of the IMU, too; by_noise (M, 43, 43): how the error changes with it.
        """
        noise = variances[:, :, None] * np.eye(DIMENSION)
        by_axis = (acceleration**2 * seconds)[:, None, None] * np.eye(3)
        seconds = seconds[:, None, None]
        noise[:, VELOCITY, VELOCITY] += by_axis
        noise[:, VELOCITY, POSITION] += by_axis * seconds / 2
        noise[:, POSITION, VELOCITY] += by_axis * seconds / 2
        noise[:, POSITION, POSITION] += by_axis * seconds**2 / 3
        noise = by_noise @ noise @ by_noise.swapaxes(1, 2)
        for self.kf.F, self.kf.Q in zip(jacobians, noise, strict=True):
            self.kf.predict()
            self.past_cross = self.past_cross @ self.kf.F.T


def solve(measurements: Measurements, config: EkfConfig) -> Estimate:
    """Filter the steps, which follow each other, with the IMU where there is one.

    Steps that it did not measure from start to end are predicted by constant velocity and rate; without any that it
    measured nothing is predicted, and without skips the poses are those of the chain. Each pose is that of its own
    instant; what loops tell of earlier ones is in `Estimate.hindsight`. Of the pairs that skip frames those over two
    steps are used; positions are not.
    """
    steps, calibration = measurements.steps, measurements.calibration
    samples = ImuWindows(measurements.imu) if measurements.imu is not None else None
    windows = [samples.over(step.source_stamp_ns, step.target_stamp_ns) if samples else None for step in steps]
    if not any(window is not None for window in windows):
        calibration = None
    still = standing_still(steps, windows, np.zeros(3) if calibration is None else calibration.gyro_bias)
    first_twist = steps[0].T_source_target.as_exp_coords() / steps[0].duration_s
    front_end_sigma = measurements.front_end_sigma or config.front_end_sigma(steps)
    ekf = Filter(config, calibration, measurements.mounting, front_end_sigma, first_twist)
    bias_steps = [] if calibration is None else [*calibration.bias_steps, *measurements.bias_steps]
    gate = chi2.isf(config.gate_probability, 6)
    stamps_ns = stamps_of(steps)
    closures = Closures(measurements.loops, stamps_ns, config.gate_probability)
    rows, cameras = [_row(ekf, np.full(6, np.nan), np.nan, True)], [Pose(np.eye(4), np.zeros((6, 6)))]
    in_a_row = 0
    skips = _over_two_steps(measurements.skips, stamps_ns)
    skips_rejected = 0
    for frame, (step, window, stands) in enumerate(zip(steps, windows, still, strict=True), 1):
        pair = _measurement(step, config)
        for stepped in bias_steps:
            if step.source_stamp_ns <= stepped.at_ns < step.target_stamp_ns:
                ekf.doubt_biases(stepped.std)
        lost = calibration is not None and window is None and turning_sigma(pair.covariance) > LOST
        if lost:
            ekf.lose_direction(pair)
            innovation, nis, used = np.full(6, np.nan), np.nan, True
        else:
            innovation, nis, used, in_a_row = _measure(ekf, pair, window, gate, in_a_row)
        if not lost and (skip := skips.get(frame)) is not None:
            skips_rejected += not ekf.update_unless_outlier(_measurement(skip, config, since=1), gate)
        if stands and used:
            ekf.stand_still()
        if window is None:
            ekf.take_twist(pair)
        ekf.clone()
        rows.append(_row(ekf, innovation, nis, used))
        cameras.append(closures.move_to(ekf.odometry()))
        if closures.keyframe == frame:
            ekf.keep()

    series = EstimatorSeries(stamps_ns, *(np.array(column) for column in zip(*rows, strict=True)))
    poses, covariances = (np.stack(column) for column in zip(*cameras, strict=True))
    pairs_rejected = int(np.sum(~series.used)) + skips_rejected
    measured = sum(window is not None for window in windows)
    return Estimate(
        Trajectory(stamps_ns, RigidTransform.from_matrix(poses), covariances),
        _note(measured, len(steps), len(skips), pairs_rejected) + closures.note,
        pairs_rejected + int(np.sum(~closures.used)),
        series if calibration is not None else _without_biases(series),
        loops_used=closures.used,
        mounting=ekf.mounting() if calibration is not None else None,
        hindsight=closures.hindsight() if np.any(closures.used) else None,
    )


def _measure(
    ekf: Filter, pair: Measurement, window: ImuWindow | None, gate: float, in_a_row: int
) -> tuple[FloatArray, float, bool, int]:
    """Predict a frame and correct it by its pair, unless that is an outlier.

    in_a_row: how many pairs before it were. Returns innovation (6,), its square, whether it was used, and in_a_row.
    """
    before = ekf.state, ekf.kf.P, ekf.past_cross
    ekf.predict(window, pair.seconds)
    innovation, nis = ekf.squared_innovation(pair)
    if nis > gate:
        in_a_row += 1
        if in_a_row <= ekf.config.max_rejected_in_a_row:
            return innovation, nis, False, in_a_row
        # So many cannot all be wrong: it is the prediction that is.
        ekf.state, ekf.kf.P, ekf.past_cross = before
        ekf.forget_velocity()
        ekf.predict(None, pair.seconds)
    else:
        in_a_row = 0
    ekf.update(pair)
    return innovation, nis, True, in_a_row


def _measurement(pair: PairEstimate, config: EkfConfig, since: int = 0) -> Measurement:
    covariance = pair.covariance + _by_stamps(pair, config.stamp_jitter_s)
    return Measurement(pair.T_source_target.as_matrix(), covariance, pair.duration_s, since)


def _over_two_steps(skips: Sequence[PairEstimate], stamps_ns: IntArray) -> dict[int, PairEstimate]:
    """The pairs that lead from the frame before the last one to a frame, by its number."""
    frames = {before: frame for frame, before in enumerate(stamps_ns.tolist()[:-2], 2)}
    found = ((frames.get(skip.source_stamp_ns), skip) for skip in skips)
    return {frame: skip for frame, skip in found if frame and stamps_ns[frame] == skip.target_stamp_ns}


def _by_stamps(pair: PairEstimate, jitter_s: float) -> FloatArray:
    """What uncertain stamps add to the covariance (6, 6) of a pair: its motion took a little longer, or less long."""
    rates = pair.T_source_target.as_exp_coords() / pair.duration_s
    by_rotation, by_translation = (np.outer(rates[part], rates[part]) for part in (slice(0, 3), slice(3, 6)))
    return np.asarray(2.0 * jitter_s**2 * block_diag(by_rotation, by_translation))


def _row(ekf: Filter, innovation: FloatArray, nis: float, used: bool) -> tuple[FloatArray | float | bool, ...]:
    """What `EstimatorSeries` holds for a frame, in its order."""
    state, front_end_std = ekf.state, ekf.std(FRONT_END)
    return (
        state.gyro_bias,
        ekf.std(GYRO_BIAS),
        state.accelerometer_bias,
        ekf.std(ACCELEROMETER_BIAS),
        state.front_end[0],
        front_end_std[0],
        state.front_end[1:],
        front_end_std[1:],
        innovation,
        nis,
        used,
    )


def _without_biases(series: EstimatorSeries) -> EstimatorSeries:
    """The series of a filter that had no IMU."""
    nothing = np.full((len(series), 3), np.nan)
    return replace(
        series,
        gyro_bias=nothing,
        gyro_bias_std=nothing,
        accelerometer_bias=nothing,
        accelerometer_bias_std=nothing,
    )


def _note(measured: int, steps: int, skips: int, rejected: int) -> str:
    skipping = f"; {counted(skips, 'pair that skips a frame', 'pairs that skip a frame')}" if skips else ""
    left_out = skipping + (f"; pairs rejected: {rejected}" if rejected else "")
    if measured == 0:
        return f"pairs only: no IMU{left_out}"
    if measured < steps:
        return f"predicted by the IMU on {measured} of {steps} steps, by constant velocity on the others{left_out}"
    return f"predicted by the IMU{left_out}"
