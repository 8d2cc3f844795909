"""A log for everyone else's tools: time series as CSV or Parquet, everything as a rerun recording.

``python -m fusion.export RUN.mcap --csv DIR --parquet DIR --rerun OUT.rrd``. Works on every log; one that
``fusion.run`` wrote has most to say. The names of the columns say their units and stay as they are.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.util import find_spec
from math import isnan
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fusion_io.command import answered, command_parser
from fusion_io.errors import EXIT_DAMAGED, EXIT_OK, LogError, UsageError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from fusion_io.reader import Log
    from fusion_io.records import EstimatorSeries, FloatArray, ImuSeries, IntArray, PairEstimate, Trajectory

    Table = Mapping[str, NDArray[Any]]

AXES = ("x", "y", "z")
QUATERNION = ("quat_w", "quat_x", "quat_y", "quat_z")


@dataclass(frozen=True, slots=True)
class Exports:
    """Where to export to: folders of CSV and Parquet files, a rerun recording; None for what is not wanted."""

    csv: Path | None = None
    parquet: Path | None = None
    rerun: Path | None = None


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    arguments = parser().parse_args(argv)
    exports = Exports(arguments.csv, arguments.parquet, arguments.rerun)
    return answered(lambda: run(arguments.log, arguments.images, exports))


def run(path: Path, images: Path | None, exports: Exports) -> int:
    """Export one log or the log in a run's folder, its images from another where given; returns the exit code.

    Raises UsageError for nothing to export to, and LogError for a log that cannot be read or a place to write to.
    """
    from fusion.results import log_file
    from fusion_io.reader import open_log

    if exports == Exports():
        raise UsageError("nothing to export to: give --csv, --parquet or --rerun")
    checked(exports)
    log = open_log(log_file(path))
    export(log, open_log(log_file(images)) if images else log, exports)
    for note in log.notes:
        print(f"warning: {note}", file=sys.stderr)
    return EXIT_DAMAGED if log.damaged else EXIT_OK


def checked(exports: Exports) -> Exports:
    """The same, before time is spent on what shall be exported.

    Raises UsageError where a library is missing that is not installed by default.
    """
    for path, module, extra in ((exports.parquet, "pyarrow", "parquet"), (exports.rerun, "rerun", "rerun")):
        if path is not None and find_spec(module) is None:
            raise UsageError(f"{path}: needs the extra {extra!r}: pip install 'violearner-fusion[{extra}]'")
    return exports


def export(log: Log, images: Log, exports: Exports) -> None:
    """Write what a log holds to all places asked for; images: the log whose images a rerun recording shows.

    Raises LogError where something cannot be written.
    """
    if exports.csv is not None or exports.parquet is not None:
        found = tables(log)
        if exports.csv is not None:
            write_csv(exports.csv, found)
        if exports.parquet is not None:
            write_parquet(exports.parquet, found)
    if exports.rerun is not None:
        from fusion.export_rerun import write_rerun

        with _writing(exports.rerun) as temporary:
            write_rerun(temporary, log, images)


# --- Tables -------------------------------------------------------------------------------------


def tables(log: Log) -> dict[str, Table]:
    """All time series of a log by name, each a mapping of column names to equally long columns.

    Names: imu, ground_truth, pairs, skips, loops, trajectory_NAME, errors_NAME (against the ground truth),
    estimator_NAME. Every table begins with stamp_ns, the log's clock, and time_s, seconds since the log's first frame.
    What the log does not have is absent.
    """
    imu, truth = log.imu(), log.ground_truth()
    found: dict[str, tuple[IntArray, Table]] = {}
    if len(imu):
        found["imu"] = imu.stamps_ns, _imu_columns(imu)
    if truth is not None:
        found["ground_truth"] = truth.stamps_ns, _pose_columns(truth)
    for name, pairs in (("pairs", log.pairs()), ("skips", log.skips()), ("loops", log.loops())):
        if pairs:
            found[name] = _pair_table(pairs)
    for name in log.trajectory_names:
        if (trajectory := log.trajectory(name)) is not None:
            found[f"trajectory_{name}"] = trajectory.stamps_ns, _pose_columns(trajectory)
            if truth is not None:
                found[f"errors_{name}"] = _error_table(trajectory, truth)
        if (series := log.estimator(name)) is not None:
            found[f"estimator_{name}"] = series.stamps_ns, _estimator_columns(series)
    return {name: _timed(stamps_ns, log.start_ns, columns) for name, (stamps_ns, columns) in found.items()}


def _timed(stamps_ns: IntArray, start_ns: int, columns: Table) -> Table:
    return {"stamp_ns": stamps_ns, "time_s": (stamps_ns - start_ns) / 1e9, **columns}


def _imu_columns(imu: ImuSeries) -> Table:
    return _columns("angular_velocity_{}_rad_s", imu.angular_velocity) | _columns(
        "linear_acceleration_{}_m_s2", imu.linear_acceleration
    )


def _pose_columns(trajectory: Trajectory) -> dict[str, NDArray[Any]]:
    """The pose in the world, and standard deviations in the axes of the camera."""
    quats_wxyz = trajectory.poses.rotation.as_quat(canonical=True, scalar_first=True)
    columns = _columns("{}_m", trajectory.poses.translation) | dict(zip(QUATERNION, quats_wxyz.T, strict=True))
    return columns if trajectory.covariances is None else columns | _sigma_columns(trajectory.covariances)


def _pair_table(pairs: Sequence[PairEstimate]) -> tuple[IntArray, Table]:
    """Pairs by their target stamps; errors of hypotheses that a pair does not have are NaN."""
    import numpy as np

    hypotheses = max(len(pair.errors) for pair in pairs)
    errors = np.full((len(pairs), hypotheses), np.nan)
    for row, pair in zip(errors, pairs, strict=True):
        row[: len(pair.errors)] = pair.errors
    columns = {
        "source_stamp_ns": np.array([pair.source_stamp_ns for pair in pairs]),
        **_columns("{}_m", np.array([pair.translation for pair in pairs])),
        **dict(zip(QUATERNION, np.array([pair.quat_wxyz for pair in pairs]).T, strict=True)),
        **_sigma_columns(np.array([pair.covariance for pair in pairs])),
        "winner": np.array([pair.winner for pair in pairs]),
        "imu_coverage": np.array([pair.imu_coverage for pair in pairs]),
        **{f"photometric_error_{i}": column for i, column in enumerate(errors.T)},
    }
    return np.array([pair.target_stamp_ns for pair in pairs]), columns


def _error_table(trajectory: Trajectory, truth: Trajectory) -> tuple[IntArray, Table]:
    """Errors in the axes of the estimated camera, with the first compared pose aligned."""
    from fusion.evaluation import errors_over_time

    errors = errors_over_time(trajectory, truth)
    return errors.stamps_ns, {
        **_columns("position_error_{}_m", errors.position_error_m),
        **_columns("rotation_error_{}_rad", errors.rotation_error_rad),
    }


def _estimator_columns(series: EstimatorSeries) -> Table:
    columns: dict[str, NDArray[Any]] = {}
    for name, unit in (("gyro_bias", "rad_s"), ("accelerometer_bias", "m_s2"), ("rate_bias", "rad_s")):
        columns |= _columns(name + "_{}_" + unit, getattr(series, name))
        columns |= _columns(name + "_sigma_{}_" + unit, getattr(series, f"{name}_std"))
    return columns | {
        "scale_error": series.scale_error,
        "scale_error_sigma": series.scale_error_std,
        **_columns("innovation_rotation_{}_rad", series.innovation[:, :3]),
        **_columns("innovation_{}_m", series.innovation[:, 3:]),
        "nis": series.nis,
        "used": series.used,
    }


def _sigma_columns(covariances: FloatArray) -> dict[str, NDArray[Any]]:
    import numpy as np

    sigmas = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2))
    return _columns("sigma_rotation_{}_rad", sigmas[:, :3]) | _columns("sigma_{}_m", sigmas[:, 3:])


def _columns(pattern: str, vectors: FloatArray) -> dict[str, NDArray[Any]]:
    return {pattern.format(axis): column for axis, column in zip(AXES, vectors.T, strict=True)}


# --- Files --------------------------------------------------------------------------------------


def write_csv(folder: Path, found: Mapping[str, Table]) -> None:
    """Write NAME.csv for every table, with a line of column names; every number reads back as it was.

    NaN is an empty field and a truth value 0 or 1.
    """
    import csv

    for name, table in found.items():
        columns = [[_cell(value) for value in column.tolist()] for column in table.values()]
        with _writing(folder / f"{name}.csv") as temporary, temporary.open("w", encoding="utf-8", newline="") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(table)
            writer.writerows(zip(*columns, strict=True))


def _cell(value: float | int | bool) -> float | int | str:
    if isinstance(value, bool):
        return int(value)
    return "" if isnan(value) else value


def write_parquet(folder: Path, found: Mapping[str, Table]) -> None:
    """Write NAME.parquet for every table."""
    import pyarrow
    from pyarrow import parquet

    for name, table in found.items():
        with _writing(folder / f"{name}.parquet") as temporary:
            parquet.write_table(pyarrow.table(dict(table)), temporary)


@contextmanager
def _writing(path: Path) -> Iterator[Path]:
    """A temporary path beside `path` to write to, which takes its place if all goes well; LogError if not."""
    temporary = path.with_name(f".{path.name}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield temporary
        temporary.replace(path)
    except OSError as error:
        raise LogError(f"{path}: cannot be written: {error.strerror or error}") from None
    finally:
        temporary.unlink(missing_ok=True)


# --- Command line -------------------------------------------------------------------------------


def parser() -> argparse.ArgumentParser:
    """The options of the command."""
    parser = command_parser(
        "fusion.export",
        "Export the time series of a log for pandas and others, and all of it for rerun.",
        "Exit codes: 0 all well, 1 nothing could be exported, 2 usage, 3 exported from a damaged log.",
    )
    parser.add_argument("log", type=Path, metavar="RUN.mcap", help="the log of a run, its folder, or any other log")
    parser.add_argument("--images", type=Path, metavar="LOG.mcap", help="the log with the images (default: the same)")
    add_options(parser)
    return parser


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add --csv, --parquet and --rerun."""
    parser.add_argument("--csv", type=Path, metavar="DIR", help="write all time series as CSV files")
    parser.add_argument("--parquet", type=Path, metavar="DIR", help="write them as Parquet files (extra: parquet)")
    parser.add_argument("--rerun", type=Path, metavar="OUT.rrd", help="write a rerun recording (extra: rerun)")


if __name__ == "__main__":
    sys.exit(main())
