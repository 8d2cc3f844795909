"""Factors of the pose graph that GTSAM does not have: pair estimates with all that they depend on, and GNSS positions.

GTSAM calls a factor that is written in Python once for each measurement. So that a long log takes no longer for it, all
factors of a kind are evaluated together, in numpy, and what GTSAM asks for is looked up.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence

import gtsam
import numpy as np
from gtsam.symbol_shorthand import E, L, S, U, X
from scipy.ndimage import gaussian_filter1d, median_filter

from fusion.chain import motions_of
from fusion.pair_model import camera, difference, exp, predict, right_jacobian, skew
from fusion_io.records import FloatArray, IntArray, PairEstimate

SMOOTHED_OUTLIERS, SMOOTHING_SIGMA = 5, 10.0  # pairs: width of the median, sigma of the mean after it

NO_KNOT = -1  # of a pair estimate without a state of the front end


class Batch(ABC):
    """N factors of one kind with errors of D components, whitened, times the root of their weights (N,).

    judged: whether they are measurements that can be outliers; least_weight: what an outlier keeps.
    """

    def __init__(self, keys: Sequence[Sequence[int]], dimension: int, judged: bool = True) -> None:
        self.weights = np.ones(len(keys))
        self.judged = judged
        self.least_weight = 0.0
        self.dimension = dimension
        self._unit = gtsam.noiseModel.Unit.Create(dimension)
        self._keys = keys
        self._errors = np.zeros((len(keys), dimension))
        self._jacobians: list[FloatArray] = []
        self._weighted = (self._errors, self._jacobians)

    @abstractmethod
    def _evaluate(self, values: gtsam.Values) -> tuple[FloatArray, list[FloatArray]]:
        """Whitened errors (N, D), and their Jacobians (N, D, M) by the variable in each place of the keys."""

    @property
    def squared(self) -> FloatArray:
        """The squared norms (N,) of the whitened errors, without weights."""
        return np.asarray(np.sum(self._errors**2, axis=1))

    def update(self, values: gtsam.Values) -> None:
        """Evaluate all factors; what GTSAM looks up from now on belongs to these values."""
        self._errors, self._jacobians = self._evaluate(values)
        self.weigh(self.weights)

    def weigh(self, weights: FloatArray) -> None:
        """Give the factors other weights (N,)."""
        self.weights = weights
        roots = np.sqrt(weights)
        self._weighted = roots[:, None] * self._errors, [roots[:, None, None] * each for each in self._jacobians]

    def add_to(self, graph: gtsam.NonlinearFactorGraph) -> None:
        """Add the factors to a graph."""
        for row in range(len(self._keys)):
            graph.add(self.factor(row))

    def factor(self, row: int) -> gtsam.NonlinearFactor:
        """One of the factors."""
        return gtsam.CustomFactor(self._unit, list(self._keys[row]), self._lookup(row))

    def _lookup(self, row: int) -> Callable[..., FloatArray]:
        variables = range(len(self._keys[row]))

        def look_up(_: gtsam.CustomFactor, __: gtsam.Values, jacobians: list[FloatArray] | None) -> FloatArray:
            errors, by_variables = self._weighted
            if jacobians is not None:
                for place in variables:
                    jacobians[place] = by_variables[place][row]
            return np.asarray(errors[row])

        return look_up


class PairFactors(Batch):
    """Pair estimates between poses X(source) and X(target), (N,) each: eqs. (1) and (2) of `fusion.pair_model`.

    The variables are X, T_world_imu; E(0) (10): how T_camera_imu strays from `T_camera_imu`, d, and m;
    S(knot) (4): scale error and rate bias of the front end, for those with knots (N,) that are not NO_KNOT. Without
    twists (K, 6) of all poses there is no E: the poses are those of the camera. Those twists may change meanwhile.
    """

    def __init__(
        self,
        pairs: Sequence[PairEstimate],
        source: IntArray,
        target: IntArray,
        knots: IntArray,
        T_camera_imu: FloatArray,
        twists: FloatArray | None,
    ) -> None:
        extrinsics = [] if twists is None else [E(0)]
        keys = [
            [X(int(i)), X(int(j)), *extrinsics, *([] if knot == NO_KNOT else [S(int(knot))])]
            for i, j, knot in zip(source, target, knots, strict=True)
        ]
        super().__init__(keys, 6)
        self.source, self.target, self._knots = source, target, knots
        self._T_camera_imu = T_camera_imu
        self._with_extrinsics = twists is not None
        self._twists = twists if twists is not None else np.zeros((np.max(target, initial=0) + 1, 6))
        self._measured = motions_of(pairs).as_matrix() if pairs else np.zeros((0, 4, 4))
        self._seconds = np.array([pair.duration_s for pair in pairs])
        self._reference = _smooth(self._measured[:, :3, 3], self._seconds)
        self._whiteners = np.linalg.inv(np.linalg.cholesky(np.array([p.covariance for p in pairs]).reshape(-1, 6, 6)))
        self.residual = np.zeros((len(pairs), 6))

    def _evaluate(self, values: gtsam.Values) -> tuple[FloatArray, list[FloatArray]]:
        poses = poses_of(values)
        strayed = values.atVector(E(0)) if self._with_extrinsics else np.zeros(10)
        front_end = np.zeros((len(self._knots), 4))
        with_state = self._knots != NO_KNOT
        if np.any(with_state):
            front_end[with_state] = gtsam.utilities.extractVectors(values, "s")[self._knots[with_state]]
        shown = predict(
            poses[self.source],
            poses[self.target],
            extrinsics(self._T_camera_imu, strayed),
            (self._twists[self.source], self._twists[self.target]),
            strayed[6],
            strayed[7:],
            front_end,
            self._seconds,
            self._reference,
        )
        self.residual = difference(shown.motion, self._measured)
        errors = -np.einsum("nij,nj->ni", self._whiteners, self.residual)
        jacobians = [shown.by_source, shown.by_target]
        if self._with_extrinsics:
            jacobians.append(np.concatenate([shown.by_extrinsics @ by_vector(strayed), shown.by_misalignment], axis=2))
        return errors, [self._whiteners @ each for each in (*jacobians, shown.by_front_end)]


def extrinsics(T_camera_imu: FloatArray, strayed: FloatArray) -> FloatArray:
    """T_camera_imu (4, 4) after it strayed by (10,): turned, then moved along its own axes; the rest is not of it."""
    by = np.eye(4)
    by[:3, :3] = exp(strayed[:3])
    by[:3, 3] = strayed[3:6]
    return np.asarray(T_camera_imu @ by)


def by_vector(strayed: FloatArray) -> FloatArray:
    """(7, 7): how the right perturbation of T_camera_imu, and d, change with the vector that `extrinsics` takes."""
    matrix = np.eye(7)
    matrix[:3, :3] = right_jacobian(strayed[:3])
    matrix[3:6, 3:6] = exp(strayed[:3]).T
    return matrix


class WorldFactor(Batch):
    """The first camera is the world: eq. (1) of `fusion.pair_model` gives the identity for X(0) and E(0)."""

    def __init__(self, T_camera_imu: FloatArray, twist: FloatArray, sigma: float) -> None:
        super().__init__([[X(0), E(0)]], 6, judged=False)
        self._T_camera_imu, self._twist, self._sigma = T_camera_imu, twist, sigma

    def _evaluate(self, values: gtsam.Values) -> tuple[FloatArray, list[FloatArray]]:
        strayed = values.atVector(E(0))
        mounted = extrinsics(self._T_camera_imu, strayed)
        first = np.asarray(values.atPose3(X(0)).matrix())[None]
        pose, by_pose, by_extrinsics = camera(first, mounted, self._twist, strayed[6])
        errors = -difference(pose, np.eye(4)[None])
        return errors / self._sigma, [by_pose / self._sigma, padded(by_extrinsics @ by_vector(strayed)) / self._sigma]


class StillFactor(WorldFactor):
    """The first camera stays where it is, whatever X(0) and E(0) are: a step does not move it, but to second order."""

    def _evaluate(self, values: gtsam.Values) -> tuple[FloatArray, list[FloatArray]]:
        errors, jacobians = super()._evaluate(values)
        return np.zeros_like(errors), jacobians


class GnssFactors(Batch):
    """Positions (N, 3) of an antenna in a local east-north-up frame, between poses X(before) and X(before + 1).

    The variables are those two, of which the position is interpolated at share (N,); U(0), T_enu_world; and L(0) (3),
    the antenna in the axes of X. covariances (N, 3, 3).
    """

    def __init__(self, positions_m: FloatArray, covariances: FloatArray, before: IntArray, share: FloatArray) -> None:
        super().__init__([[X(int(i)), X(int(i) + 1), U(0), L(0)] for i in before], 3)
        self._positions, self._before, self._share = positions_m, before, share[:, None]
        self._whiteners = np.linalg.inv(np.linalg.cholesky(covariances))
        self.residual = np.zeros((len(before), 3))

    def _evaluate(self, values: gtsam.Values) -> tuple[FloatArray, list[FloatArray]]:
        poses, antenna = poses_of(values), values.atVector(L(0))
        T_enu_world = np.asarray(values.atPose3(U(0)).matrix())
        R_enu = T_enu_world[:3, :3]
        shares = (1.0 - self._share, self._share)
        in_world = np.zeros_like(self._positions)
        by_poses, by_antenna = [], np.zeros((len(self._before), 3, 3))
        for share, pose in zip(shares, (poses[self._before], poses[self._before + 1]), strict=True):
            R = pose[:, :3, :3]
            in_world += share * (R @ antenna + pose[:, :3, 3])
            by_pose = np.concatenate([-R @ skew(antenna), R], axis=2)
            by_poses.append(share[:, :, None] * (R_enu @ by_pose))
            by_antenna += share[:, :, None] * (R_enu @ R)
        by_frame = np.concatenate([-R_enu @ skew(in_world), np.broadcast_to(R_enu, by_antenna.shape)], axis=2)
        self.residual = in_world @ R_enu.T + T_enu_world[:3, 3] - self._positions
        return (
            np.einsum("nij,nj->ni", self._whiteners, self.residual),
            [self._whiteners @ each for each in (*by_poses, by_frame, by_antenna)],
        )


def poses_of(values: gtsam.Values) -> FloatArray:
    """All variables X(0), X(1), ... as matrices (K, 4, 4)."""
    rows = gtsam.utilities.extractPose3(values)  # in order of their keys, R row by row, then t
    rows = rows[1:] if values.exists(U(0)) else rows
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3, :3] = rows[:, :9].reshape(-1, 3, 3)
    poses[:, :3, 3] = rows[:, 9:]
    return poses


def padded(by_extrinsics: FloatArray) -> FloatArray:
    """Jacobians (N, 6, 7) with nothing for the misalignment: (N, 6, 10)."""
    return np.concatenate([by_extrinsics, np.zeros((len(by_extrinsics), 6, 3))], axis=2)


def _smooth(translations: FloatArray, seconds: FloatArray) -> FloatArray:
    """Translations (N, 3) of pairs in order of time at the speed of their neighbours, without outliers and noise."""
    rates = median_filter(translations / seconds[:, None], (SMOOTHED_OUTLIERS, 1), mode="nearest")
    return np.asarray(gaussian_filter1d(rates, SMOOTHING_SIGMA, axis=0, mode="nearest") * seconds[:, None])
