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
from scipy.spatial.transform import RigidTransform
from scipy.stats import chi2

from fusion.pair_model import inverse
from fusion_io.records import NANOSECONDS, FloatArray, IntArray, PairEstimate, Trajectory

KEYFRAME_S = 2.0
LOOP_KEYFRAME_S = 1.0  # where a loop arrives: what it tells of the way since the last keyframe stays with the next only
ROOM = 32  # keyframes that the map grows by
PENDING = 16  # loops whose corrections of the joint covariance are made together, in the time that one takes,
FRAMES = 40  # during so many frames, so that none of them takes long


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
        # The lower triangle of a joint covariance C, in slabs of ROOM keyframes, and rows A: that of the drifts is
        # C - A'A, but the first rows of C hold already what the first of A take away, which are being worked in.
        self._slabs = [np.zeros((6 * ROOM, 6 * ROOM))]
        self._told = np.zeros((12 * PENDING, 6 * ROOM))  # A, by the latest loops
        self._pending = 0  # rows of it,
        self._working = 0  # of these, rows that are being worked in,
        self._worked = 0  # and the rows of C that hold them
        self._odometry_covariance = np.zeros((6, 6))  # of the last keyframe, when it was the latest frame
        self._latest_covariance = np.zeros((6, 6))
        self._closed = False

    @property
    def last(self) -> int:
        """The frame of the last keyframe."""
        return self._keyframes[-1]

    @property
    def _size(self) -> int:
        """Rows of the joint covariance."""
        return 6 * len(self._keyframes)

    def move_to(self, odometry: Odometry) -> Pose:
        """The next frame."""
        back = _adjoint(inverse(odometry.T) @ self._places[self.last].T)
        since = np.hstack([-back, np.eye(6)])
        joint = odometry.joint.copy()
        joint[:6, :6] = self._odometry_covariance  # a smoother knows more of it by now, but T there stays as it was
        least = since @ joint @ since.T
        self._latest_covariance = odometry.joint[6:, 6:]
        grown = self._latest_covariance - back @ self._odometry_covariance @ back.T
        # An odometry may get surer; what drifted has drifted.
        own = _positive(np.stack([least, grown - least])).sum(axis=0)
        self._work_in(-(-len(self._keyframes) // FRAMES))
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
            self._slabs.append(np.zeros((6 * ROOM, 6 * (number + ROOM))))
            self._told = np.pad(self._told, ((0, 0), (0, 6 * ROOM)))
        here, there = _block(number), _block(before)
        rows = self._recorded(before)
        self._lower(number)[:, : here.start] = rows[:, : here.start]
        self._lower(number)[:, here] = rows[:, there] + own
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
        self._tell(rows)
        moved = RigidTransform.from_exp_coords((beyond @ rows).reshape(-1, 6))
        drifts = self._drifts[: len(self._keyframes)]
        drifts[:] = np.asarray(moved.as_matrix()) @ drifts
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

    def _tell(self, rows: FloatArray) -> None:
        """Take from the joint covariance what a loop tells, rows (6, 6 N) of A."""
        while self._pending == len(self._told):
            self._work_in(ROOM)
        self._told[self._pending : self._pending + 6, : self._size] = rows
        self._pending += 6
        if not self._working and self._pending >= 6 * PENDING:
            self._working, self._worked = self._pending, 0

    def _work_in(self, keyframes: int) -> None:
        """Let the rows of up to so many more keyframes hold what the loops tell that are being worked in."""
        if not self._working:
            return
        number, begin = divmod(self._worked, 6 * ROOM)
        end = min(self._worked + 6 * keyframes, 6 * ROOM * (number + 1), self._size)
        told = self._told[: self._working]
        rows = self._slabs[number][begin : begin + end - self._worked, :end]
        rows -= told[:, self._worked : end].T @ told[:, :end]
        self._worked = end
        if end == self._size:
            self._told[: self._pending - self._working] = self._told[self._working : self._pending]
            self._pending, self._working = self._pending - self._working, 0

    def _rows(self, number: int) -> FloatArray:
        """The covariances (6, 6 N) of a keyframe with all of them."""
        here, rows = _block(number), self._recorded(number)
        told = self._told[self._working : self._pending, : self._size]
        rows -= told[:, here].T @ told
        told = self._told[: self._working, : self._size]
        first = 0 if here.start >= self._worked else self._worked  # of the keyframes whose covariance lacks them
        rows[:, first:] -= told[:, here].T @ told[:, first:]
        return rows

    def _recorded(self, number: int) -> FloatArray:
        """The same as C holds them."""
        here = _block(number)
        first = number // ROOM
        below = np.concatenate([slab[:, here] for slab in self._slabs[first:]])
        below = below[here.stop - 6 * ROOM * first : self._size - 6 * ROOM * first]
        rows = np.hstack([self._lower(number)[:, : here.stop], below.T])
        own = np.tril(rows[:, here])
        rows[:, here] = own + np.tril(own, -1).T
        return rows

    def _lower(self, number: int) -> FloatArray:
        """The rows (6, M) of a keyframe in C, which end with those of its slab."""
        return self._slabs[number // ROOM][_block(number % ROOM)]

    def _between(self, one: int, other: int) -> FloatArray:
        """The covariance (6, 6) of what two frames have from their keyframes."""
        earlier, later = sorted([self._places[one].keyframe, self._places[other].keyframe])
        found = self._lower(later)[:, _block(earlier)]
        if earlier == later:
            found = np.tril(found) + np.tril(found, -1).T
        told = self._told[self._working if _block(later).start < self._worked else 0 : self._pending]
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
    """The part of symmetric matrices (..., N, N) that is positive."""
    values, vectors = np.linalg.eigh((matrix + matrix.swapaxes(-1, -2)) / 2)
    return np.asarray((vectors * np.maximum(values, 0.0)[..., None, :]) @ vectors.swapaxes(-1, -2))


def _seen(T: FloatArray, on_the_left: FloatArray) -> Pose:
    """A pose with the covariance of its errors on the right."""
    to_camera = _adjoint(inverse(T))
    covariance = to_camera @ on_the_left @ to_camera.T
    return Pose(T, (covariance + covariance.T) / 2)
