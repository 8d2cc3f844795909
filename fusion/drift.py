"""What loops tell of an odometry that drifts, causally: a map of keyframes, and the present through the last of them.

The odometry is that of a filter or a smoother that forgets the past, and that knows nothing of loops. The map holds how
it drifted at each keyframe, D = T_world_odometry, with the joint covariance of all of them (Roumeliotis and Burdick,
"Stochastic cloning", 2002). A loop corrects all keyframes, each by as much as it drifted in common with the two that
the loop binds; the odometry is never touched.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from typing import NamedTuple

import gtsam
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_triangular
from scipy.linalg.blas import dsyrk
from scipy.spatial.transform import RigidTransform
from scipy.stats import chi2

from fusion.pair_model import inverse
from fusion_io.records import NANOSECONDS, FloatArray, IntArray, PairEstimate, Trajectory

KEYFRAME_S = 2.0
LOOP_KEYFRAME_S = 1.0  # where a loop arrives: what it tells of the way since the last keyframe stays with the next only
ROOM = 32  # keyframes that the map grows by
PENDING = 16  # loops whose corrections of the joint covariance are made all at once, in the time that one takes


class Pose(NamedTuple):
    """Of the camera: T_world_camera (4, 4) and its covariance (6, 6)."""

    T: FloatArray
    covariance: FloatArray


class Odometry(NamedTuple):
    """The latest pose T (4, 4) of the camera without loops, and the joint covariance (12, 12) of keyframe and it."""

    T: FloatArray
    joint: FloatArray


class Closures:
    """Moves along with an odometry, and closes each loop (M,) when its later frame has come."""

    def __init__(self, loops: Sequence[PairEstimate], stamps_ns: IntArray, gate_probability: float) -> None:
        """stamps_ns (K,): of all frames. gate_probability: how seldom noise alone takes a loop for an outlier."""
        self._loops, self._stamps = loops, stamps_ns
        self._map = Map(gate_probability)
        self._arriving: dict[int, list[int]] = defaultdict(list)  # the loops that each frame brings
        for row, loop in enumerate(loops):
            self._arriving[self._frame(loop.target_stamp_ns)].append(row)
        self._latest = 0
        self.used: NDArray[np.bool_] = np.zeros(len(loops), dtype=np.bool_)

    @property
    def keyframe(self) -> int:
        """The frame of the last keyframe, whose covariance with the next frame is asked for."""
        return self._map.last

    def move_to(self, odometry: Odometry) -> Pose:
        """The next frame, where loops see it."""
        self._latest += 1
        present = self._map.move_to(odometry)
        arriving = self._arriving[self._latest]
        seconds = (self._stamps[self._latest] - self._stamps[self.keyframe]) / NANOSECONDS
        if seconds >= (LOOP_KEYFRAME_S if arriving else KEYFRAME_S):
            self._map.keep()
        for row in arriving:
            closed = self._map.close(self._frame(self._loops[row].source_stamp_ns), self._loops[row])
            if closed is not None:
                present, self.used[row] = closed, True
        return present

    def hindsight(self) -> Trajectory:
        """All frames (K,) until now, where all loops until now see them."""
        poses, covariances = zip(*self._map.hindsight(), strict=True)
        stamps_ns = self._stamps[: self._latest + 1]
        return Trajectory(stamps_ns, RigidTransform.from_matrix(np.stack(poses)), np.stack(covariances))

    @property
    def note(self) -> str:
        """How many loops were used, to follow what else is said."""
        return f"; loops used: {self.used.sum()} of {len(self._loops)}" if len(self._loops) else ""

    def _frame(self, stamp_ns: int) -> int:
        return int(np.searchsorted(self._stamps, stamp_ns))


class _Place(NamedTuple):
    """A frame by its odometry T (4, 4), and by how much more it may have drifted than the keyframe before it.

    own (6, 6): covariance of that, on the right of T. covariance (6, 6): of T, before any loop.
    """

    keyframe: int
    T: FloatArray
    own: FloatArray
    covariance: FloatArray


class Map:
    """How the odometry has drifted at the keyframes, all of them with their joint covariance.

    The errors xi of a pose in the world, Exp(xi) D T, are on its left, where those of a drift in common are the same. A
    loop of motion Z from frame i to frame k shows of them

        Ad(X_k) Log((X_i^-1 X_k)^-1 Z) = xi_k - xi_i + noise                                                         (1)

    Drift is a random walk. It grows as the odometry's covariance does, and no less than by that of the motion since the
    keyframe: errors that last, of scale for one, add up faster than white ones.
    """

    def __init__(self, gate_probability: float) -> None:
        self._gate = float(chi2.isf(gate_probability, 6))
        self._places = [_Place(0, np.eye(4), np.zeros((6, 6)), np.zeros((6, 6)))]
        self._keyframes = [0]  # their frames
        self._drifts = np.tile(np.eye(4), (ROOM, 1, 1))
        # The lower triangle of a joint covariance C, and rows A: that of the drifts is C - A'A.
        self._covariance = np.zeros((6 * ROOM, 6 * ROOM), order="F")
        self._told = np.zeros((6 * PENDING, 6 * ROOM))  # by the latest loops
        self._pending = 0  # rows of it
        self._odometry_covariance = np.zeros((6, 6))  # of the last keyframe, when it was the latest frame
        self._latest_covariance = np.zeros((6, 6))
        self._closed = False

    @property
    def last(self) -> int:
        """The frame of the last keyframe."""
        return self._keyframes[-1]

    def move_to(self, odometry: Odometry) -> Pose:
        """The next frame."""
        back = _adjoint(inverse(odometry.T) @ self._places[self.last].T)
        since = np.hstack([-back, np.eye(6)])
        joint = odometry.joint.copy()
        joint[:6, :6] = self._odometry_covariance  # a smoother knows more of it by now, but T there stays as it was
        least = since @ joint @ since.T
        self._latest_covariance = odometry.joint[6:, 6:]
        grown = self._latest_covariance - back @ self._odometry_covariance @ back.T
        own = _positive(least) + _positive(grown - least)  # an odometry may get surer; what drifted has drifted
        self._places.append(_Place(len(self._keyframes) - 1, odometry.T, own, self._latest_covariance))
        if not self._closed:
            return Pose(odometry.T, self._latest_covariance)
        T, own = self._at(-1)
        return _seen(T, self._between(-1, -1) + own)

    def keep(self) -> None:
        """Make the latest frame a keyframe."""
        _, own = self._at(-1)
        before, number = self._places[-1].keyframe, len(self._keyframes)
        if number == len(self._drifts):
            self._drifts = np.concatenate([self._drifts, np.tile(np.eye(4), (ROOM, 1, 1))])
            self._covariance = np.asfortranarray(np.pad(self._covariance, (0, 6 * ROOM)))
            self._told = np.pad(self._told, ((0, 0), (0, 6 * ROOM)))
        here, there = _block(number), _block(before)
        rows = self._recorded(before)
        self._covariance[here, : here.start] = rows[:, : here.start]
        self._covariance[here, here] = rows[:, there] + own
        self._told[:, here] = self._told[:, there]
        self._drifts[number] = self._drifts[before]
        self._keyframes.append(len(self._places) - 1)
        self._places[-1] = self._places[-1]._replace(keyframe=number, own=np.zeros((6, 6)))
        self._odometry_covariance = self._latest_covariance

    def close(self, source: int, loop: PairEstimate) -> Pose | None:
        """The latest pose after a loop from a frame to it; None where the loop is an outlier, and nothing changes."""
        (T_source, own_source), (T, own) = self._at(source), self._at(-1)
        to_world = _adjoint(T)
        shown = inverse(T_source) @ T
        beyond = to_world @ _log(inverse(shown) @ np.asarray(loop.T_source_target.as_matrix()))
        rows = self._rows(self._places[-1].keyframe) - self._rows(self._places[source].keyframe)
        of_latest = self._between(-1, -1) + own
        with_latest = of_latest - self._between(-1, source)
        apart = with_latest - self._between(source, -1) + self._between(source, source) + own_source
        # Of many loops, rounding makes the difference of large covariances anything but one.
        root = np.linalg.cholesky(_positive(apart) + to_world @ loop.covariance @ to_world.T)
        beyond, rows, row = (solve_triangular(root, each, lower=True) for each in (beyond, rows, with_latest.T))
        if beyond @ beyond > self._gate:
            return None
        self._told[self._pending : self._pending + 6] = rows
        self._pending += 6
        if self._pending == len(self._told):
            dsyrk(-1.0, self._told, beta=1.0, c=self._covariance, trans=True, lower=True, overwrite_c=True)
            self._pending = 0
        moved = RigidTransform.from_exp_coords((beyond @ rows).reshape(-1, 6))
        self._drifts = np.asarray(moved.as_matrix()) @ self._drifts
        self._closed = True
        return _seen(_exp(beyond @ row) @ T, of_latest - row.T @ row)

    def hindsight(self) -> list[Pose]:
        """All frames; between two keyframes the drift goes from the one to the other.

        Where a walk, which drift is taken for, makes a pose less certain than it was before any loop, the covariance is
        that of then: loops only add to what is known.
        """
        poses = []
        for frame, place in enumerate(self._places):
            T, own = self._at(frame)
            number = place.keyframe
            if number + 1 < len(self._keyframes):
                begin, end = self._keyframes[number : number + 2]
                further = self._drifts[number + 1] @ inverse(self._drifts[number])
                T = _exp((frame - begin) / (end - begin) * _log(further)) @ T
            seen = _seen(T, self._between(frame, frame) + own)
            before = place.covariance
            poses.append(seen if np.linalg.det(seen.covariance) <= np.linalg.det(before) else Pose(T, before))
        return poses

    def _at(self, frame: int) -> tuple[FloatArray, FloatArray]:
        """A frame in the world (4, 4), and the covariance (6, 6) on its left of what it has not from its keyframe."""
        number, odometry, own, _ = self._places[frame]
        T = self._drifts[number] @ odometry
        to_world = _adjoint(T)
        return T, to_world @ own @ to_world.T

    def _rows(self, number: int) -> FloatArray:
        """The covariances (6, 6 N) of a keyframe with all of them."""
        told = self._told[: self._pending]
        return self._recorded(number) - told[:, _block(number)].T @ told

    def _recorded(self, number: int) -> FloatArray:
        """The same before the pending loops."""
        here = _block(number)
        rows = np.hstack([self._covariance[here, : here.stop], self._covariance[here.stop :, here].T])
        own = np.tril(rows[:, here])
        rows[:, here] = own + np.tril(own, -1).T
        return rows

    def _between(self, one: int, other: int) -> FloatArray:
        """The covariance (6, 6) of what two frames have from their keyframes."""
        earlier, later = sorted([self._places[one].keyframe, self._places[other].keyframe])
        found = self._covariance[_block(later), _block(earlier)]
        if earlier == later:
            found = np.tril(found) + np.tril(found, -1).T
        told = self._told[: self._pending]
        found = found - told[:, _block(later)].T @ told[:, _block(earlier)]
        return np.asarray(found if self._places[one].keyframe == later else found.T)


def _block(number: int) -> slice:
    return slice(6 * number, 6 * number + 6)


def _log(T: FloatArray) -> FloatArray:
    """The twist (6,) of a rigid transform."""
    return np.asarray(gtsam.Pose3.Logmap(gtsam.Pose3(T)))


def _exp(twist: FloatArray) -> FloatArray:
    """The rigid transform (4, 4) of a twist."""
    return np.asarray(gtsam.Pose3.Expmap(twist).matrix())


def _adjoint(T: FloatArray) -> FloatArray:
    return np.asarray(gtsam.Pose3(T).AdjointMap())


def _positive(matrix: FloatArray) -> FloatArray:
    """The part of a symmetric matrix that is positive."""
    values, vectors = np.linalg.eigh((matrix + matrix.T) / 2)
    return np.asarray((vectors * np.maximum(values, 0.0)) @ vectors.T)


def _seen(T: FloatArray, on_the_left: FloatArray) -> Pose:
    """A pose with the covariance of its errors on the right."""
    to_camera = _adjoint(inverse(T))
    covariance = to_camera @ on_the_left @ to_camera.T
    return Pose(T, (covariance + covariance.T) / 2)
