"""Trajectories as text: the formats of KITTI odometry and of TUM RGB-D, and tables of numbers in general.

* KITTI: a line is a pose, the upper three rows of T_world_camera in row-major order (12 numbers). Some
  systems put the index of the frame in front (13). Stamps are in a file of their own, ``times.txt``.
* TUM: a line is ``stamp tx ty tz qx qy qz qw``, the stamp in seconds.
* EuRoC: a line is ``stamp, tx, ty, tz, qw, qx, qy, qz``, the stamp in nanoseconds; velocities and biases may follow.

Blank lines and lines that begin with ``#`` are skipped. Whatever is wrong with a file is a ``LogError``
that names the file and the line.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from fusion_io.errors import LogError, UsageError
from fusion_io.records import NANOSECONDS, FloatArray, IntArray, PairEstimate, Trajectory

#: How far a matrix may be from a rotation (or a quaternion's norm from 1) before it counts as wrong rather
#: than as rounded: three decimals are enough.
ROTATION_TOLERANCE = 5e-3

#: Stamps beyond this do not fit into 64 bits of nanoseconds (the year 2262).
MAX_STAMP_SECONDS = Decimal(2**63 - 1) / NANOSECONDS

#: Of EuRoC's tables: with the pose alone, with velocities, and with the biases of gyro and accelerometer too.
EUROC_COLUMNS = (8, 11, 17)


# ----------------------------------------------------------------------------------------- tables of numbers


@dataclass(frozen=True, slots=True)
class Row:
    """One line of a table: its file and number, for messages, and its words."""

    path: Path
    number: int
    words: list[str]

    def error(self, reason: str) -> LogError:
        """An error that names this line."""
        return LogError(f"{self.path}: line {self.number}: {reason}")

    def floats(self, start: int = 0) -> list[float]:
        """The words from ``start`` on as numbers, not necessarily finite."""
        try:
            return [float(word) for word in self.words[start:]]
        except ValueError as error:
            raise self.error(f"not a number ({error})") from None

    def finite(self, start: int = 0) -> list[float]:
        """The words from ``start`` on as finite numbers."""
        values = self.floats(start)
        if not all(map(math.isfinite, values)):
            raise self.error("not a finite number")
        return values

    def stamp_ns(self) -> int:
        """The first word, in seconds, as nanoseconds."""
        try:
            return nanoseconds(self.words[0])
        except ValueError as error:
            raise self.error(str(error)) from None


def read_text(path: Path) -> str:
    """The text of a file; a ``LogError`` where it cannot be read or is not text."""
    try:
        return path.read_text(encoding="utf-8-sig")
    except UnicodeDecodeError:
        raise LogError(f"{path}: not a text file") from None
    except OSError as error:
        raise LogError(f"{path}: {error.strerror or error}") from None


def read_rows(path: Path, columns: Sequence[int], separator: str | None = None) -> list[Row]:
    """The lines of a table, comments and blanks left out; ``columns`` are the allowed numbers of words.

    All lines must have the same number of words, and there must be at least one line.
    """
    lines = ((number, line.strip()) for number, line in enumerate(read_text(path).splitlines(), start=1))
    rows = [Row(path, number, line.split(separator)) for number, line in lines if line and not line.startswith("#")]
    if not rows:
        raise LogError(f"{path}: holds no data")
    allowed = [count for count in columns if count == len(rows[0].words)] or columns
    for row in rows:
        if len(row.words) not in allowed:
            wanted = " or ".join(map(str, allowed))
            raise row.error(f"{len(row.words)} columns where {wanted} are expected")
    return rows


def nanoseconds(seconds: str) -> int:
    """A decimal number of seconds as integer nanoseconds, rounded exactly; ``ValueError`` where it is none."""
    try:
        value = Decimal(seconds)
    except InvalidOperation:
        raise ValueError(f"not a time in seconds ({seconds!r})") from None
    if not value.is_finite() or abs(value) > MAX_STAMP_SECONDS:
        raise ValueError(f"not a possible time in seconds ({seconds!r})")
    return int((value * NANOSECONDS).to_integral_value())


def seconds(stamp_ns: int) -> str:
    """Integer nanoseconds as a decimal number of seconds, exactly."""
    whole, rest = divmod(abs(stamp_ns), NANOSECONDS)
    return f"{'-' if stamp_ns < 0 else ''}{whole}.{rest:09d}"


def _increasing(rows: Sequence[Row], stamps_ns: Sequence[int]) -> IntArray:
    """The stamps as an array; refused where one is not later than the one before."""
    array = np.array(stamps_ns, dtype=np.int64)
    late = np.flatnonzero(np.diff(array) <= 0)
    if late.size:
        raise rows[late[0] + 1].error("its time is not later than that of the line before")
    return array


def read_times(path: Path) -> IntArray:
    """KITTI's ``times.txt``: one stamp in seconds a line. Returns (N,) nanoseconds, strictly increasing."""
    rows = read_rows(path, columns=(1,))
    return _increasing(rows, [row.stamp_ns() for row in rows])


# ----------------------------------------------------------------------------------------------------- poses


def rotation_error(matrices: FloatArray) -> FloatArray:
    """How far matrices (..., 3, 3) are from rotations: the largest |singular value - 1|, infinite for a reflection."""
    error = np.abs(np.linalg.svd(matrices, compute_uv=False) - 1).max(axis=-1)
    return np.where(np.linalg.det(matrices) > 0, error, np.inf)


def read_indexed_kitti_poses(path: Path) -> tuple[IntArray | None, FloatArray]:
    """A KITTI pose file with the frames that its poses belong to.

    Returns the frame indices (N,) of the first column of 13, strictly increasing, or None where there are
    12 columns, and the poses (N, 4, 4) T_world_camera. Rotations that are merely rounded are moved to the
    nearest rotation.
    """
    rows = read_rows(path, columns=(12, 13))
    numbers = np.array([row.finite() for row in rows])
    frames = _frame_indices(rows, numbers[:, 0]) if numbers.shape[1] == 13 else None
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3] = numbers[:, -12:].reshape(-1, 3, 4)
    errors = rotation_error(poses[:, :3, :3])
    bad = np.flatnonzero(errors > ROTATION_TOLERANCE)
    if bad.size:
        raise rows[bad[0]].error(f"not a rotation (off by {errors[bad[0]]:.2g})")
    poses[:, :3, :3] = Rotation.from_matrix(poses[:, :3, :3]).as_matrix()
    return frames, poses


def _frame_indices(rows: Sequence[Row], column: FloatArray) -> IntArray:
    bad = np.flatnonzero((column != np.floor(column)) | (column <= np.r_[-1, column[:-1]]))
    if bad.size:
        raise rows[bad[0]].error(f"{column[bad[0]]:g} is not the index of a later frame")
    return column.astype(np.int64)


def read_kitti_poses(path: Path) -> FloatArray:
    """The poses of a KITTI file, (N, 4, 4) T_world_camera; an index in the first column is ignored."""
    return read_indexed_kitti_poses(path)[1]


def read_kitti(path: Path, frame_stamps_ns: IntArray) -> Trajectory:
    """A KITTI pose file with the stamps of its frames, which ``times.txt`` has for the whole sequence.

    Without an index column the file must have as many poses as there are stamps.
    """
    frames, poses = read_indexed_kitti_poses(path)
    if frames is None:
        if len(poses) != len(frame_stamps_ns):
            raise LogError(f"{path}: {len(poses)} poses do not fit {len(frame_stamps_ns)} time stamps")
        frames = np.arange(len(poses))
    elif frames[-1] >= len(frame_stamps_ns):
        raise LogError(f"{path}: frame {frames[-1]} has no time, there are only {len(frame_stamps_ns)} time stamps")
    return Trajectory(frame_stamps_ns[frames], RigidTransform.from_matrix(poses))


def read_tum(path: Path) -> Trajectory:
    """A TUM file: stamps (N,) strictly increasing, poses T_world_camera; quaternions are normalised."""
    rows = read_rows(path, columns=(8,))
    stamps_ns = _increasing(rows, [row.stamp_ns() for row in rows])
    numbers = np.array([row.finite(start=1) for row in rows])
    return Trajectory(stamps_ns, _poses(rows, numbers[:, :3], numbers[:, 3:]))


def read_euroc(path: Path) -> Trajectory:
    """A table as EuRoC's ground truth: stamps (N,) strictly increasing, poses of the body that it was made for."""
    rows = read_rows(path, EUROC_COLUMNS, separator=",")
    stamps_ns = _increasing(rows, [_integer_stamp(row) for row in rows])
    numbers = np.array([row.finite(start=1)[:7] for row in rows])
    return Trajectory(stamps_ns, _poses(rows, numbers[:, :3], numbers[:, [4, 5, 6, 3]]))


def _integer_stamp(row: Row) -> int:
    try:
        return int(row.words[0])
    except ValueError:
        raise row.error(f"not a time in nanoseconds ({row.words[0]!r})") from None


def _poses(rows: Sequence[Row], positions: FloatArray, quats_xyzw: FloatArray) -> RigidTransform:
    """Poses whose quaternions are normalised, and refused where they are none."""
    norms = np.linalg.norm(quats_xyzw, axis=1)
    bad = np.flatnonzero(np.abs(norms - 1) > ROTATION_TOLERANCE)
    if bad.size:
        raise rows[bad[0]].error(f"not a rotation (norm of the quaternion {norms[bad[0]]:.3g})")
    return RigidTransform.from_components(positions, Rotation.from_quat(quats_xyzw))


def file_format(path: Path) -> str:
    """The format of a trajectory file, by its first line: "tum", "kitti" or "euroc"."""
    if "," in next((line for line in read_text(path).splitlines() if line.strip() and line.strip()[0] != "#"), ""):
        return "euroc"
    return "tum" if len(read_rows(path, columns=(8, 12, 13))[0].words) == 8 else "kitti"


def read_trajectory(path: Path, frame_stamps_ns: IntArray | None) -> Trajectory:
    """A trajectory in the format of TUM, of EuRoC, or of KITTI, which needs the stamps of the frames."""
    match file_format(path):
        case "tum":
            return read_tum(path)
        case "euroc":
            return read_euroc(path)
    if frame_stamps_ns is None:
        raise UsageError(f"{path}: KITTI's format has no times of its own: give --times")
    return read_kitti(path, frame_stamps_ns)


def write_tum(path: Path, trajectory: Trajectory) -> None:
    """Write a trajectory in TUM's format; stamps with all nine decimals, numbers that read back bit for bit."""
    numbers = np.hstack([trajectory.poses.translation, trajectory.poses.rotation.as_quat()])
    lines = (
        " ".join([seconds(int(stamp_ns)), *map(repr, row)])
        for stamp_ns, row in zip(trajectory.stamps_ns, numbers.tolist(), strict=True)
    )
    _write_lines(path, lines)


def write_kitti(path: Path, trajectory: Trajectory) -> None:
    """Write the poses of a trajectory in KITTI's format: 12 numbers a line that read back bit for bit."""
    matrices = trajectory.poses.as_matrix()[:, :3].reshape(-1, 12)
    _write_lines(path, (" ".join(map(repr, row)) for row in matrices.tolist()))


def _write_lines(path: Path, lines: Iterator[str]) -> None:
    try:
        path.write_text("".join(f"{line}\n" for line in lines), encoding="utf-8", newline="\n")
    except OSError as error:
        raise LogError(f"{path}: {error.strerror or error}") from None


# ----------------------------------------------------------------------------------------------------- pairs


def pair_estimates(trajectory: Trajectory, sigma_translation: float, sigma_rotation: float) -> list[PairEstimate]:
    """The steps of a trajectory as pair estimates, T_source_target = T_source^-1 T_target.

    sigma_translation (m) and sigma_rotation (rad) are standard deviations of a pair, per axis. A
    ``LogError`` where there are fewer than two poses.
    """
    if len(trajectory) < 2:
        raise LogError("a trajectory needs at least two poses")
    steps = trajectory.poses[:-1].inv() * trajectory.poses[1:]
    covariance = np.diag([sigma_rotation**2] * 3 + [sigma_translation**2] * 3)
    stamps_ns = trajectory.stamps_ns.tolist()
    return [
        PairEstimate(source_ns, target_ns, quat_wxyz, translation, covariance)
        for source_ns, target_ns, quat_wxyz, translation in zip(
            stamps_ns[:-1],
            stamps_ns[1:],
            steps.rotation.as_quat(scalar_first=True),
            steps.translation,
            strict=True,
        )
    ]
