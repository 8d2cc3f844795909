"""What there is to be compared: the trajectories of runs, of other people's logs and of text files."""

from __future__ import annotations

import string
import tomllib
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from fusion.output import LOG_NAME
from fusion_io.errors import LogError, UsageError
from fusion_io.odometry import RecordedTrajectories, only_trajectory, read_trajectories
from fusion_io.records import NANOSECONDS, IntArray, Trajectory
from fusion_io.trajectory_files import file_format, read_indexed_kitti_poses, read_kitti, read_times, read_trajectory
from fusion_io.words import counted

ONLY_TRAJECTORY = "trajectory"
"""The name of the trajectory of a text file."""

INDEX_PERIOD_NS = NANOSECONDS // 10  # where nothing has times, frames are compared by their index

_MCAP_MAGIC = b"\x89MCAP0\r\n"


@dataclass(frozen=True, slots=True)
class Result:
    """The trajectories of one input by name.

    key: what conditions call it: a, b, ... in the order of the inputs. label: what tables call it. settings: the
    configuration that a run recorded, as its TOML says it; empty for other inputs. notes: a line for all that was left
    out. damaged: the file is not as it was written.
    """

    key: str
    label: str
    path: Path
    trajectories: Mapping[str, Trajectory]
    ground_truth: Trajectory | None = None
    settings: Mapping[str, Any] | None = None
    notes: tuple[str, ...] = ()
    damaged: bool = False


def read_results(
    paths: Sequence[Path], names: Sequence[str] = (), times: Path | None = None, ground_truth: Path | None = None
) -> tuple[list[Result], Trajectory | None]:
    """Read runs (run.mcap or its folder), logs of others (MCAP) and trajectory files (TUM, KITTI, EuRoC).

    names: labels, one an input; without them, the names of files or of the folders of runs. times: stamps of the frames
    of KITTI files. Without it they are taken from an input with as many poses, and if no input has any, frames are
    compared by their index. ground_truth: that of a log, a log's only trajectory, or a trajectory file; it is returned
    beside the results.

    Raises LogError for a file that cannot be used, and UsageError for names or times that do not fit.
    """
    if names and len(names) != len(paths):
        raise UsageError(f"--names: {counted(len(names), 'name')} for {counted(len(paths), 'input')}")
    if repeated := [name for name, count in Counter(names).items() if count > 1]:
        raise UsageError(f"--names: {repeated[0]!r} is there twice")
    files = [log_file(path) for path in paths]
    labelled = list(zip(names or _labels(files), files, strict=True))
    results = [
        _timed(key_of(i), label, path) if has_times(path) else Result(key_of(i), label, path, {})
        for i, (label, path) in enumerate(labelled)
    ]
    truth = _ground_truth(log_file(ground_truth)) if ground_truth is not None else None
    known = [each for result in results for each in _all_of(result)] + ([] if truth is None else [truth])
    frame_stamps_ns = None if times is None else read_times(times)

    def of_kitti(path: Path) -> Trajectory:
        return read_kitti(path, _frame_stamps(path, known) if frame_stamps_ns is None else frame_stamps_ns)

    results = [
        result if result.trajectories else replace(result, trajectories={ONLY_TRAJECTORY: of_kitti(result.path)})
        for result in results
    ]
    return results, of_kitti(ground_truth) if ground_truth is not None and truth is None else truth


def log_file(path: Path) -> Path:
    """The log of a run's folder; any other path as it is. Raises LogError for one that does not exist."""
    trajectories = sorted(each.name for each in path.glob("*.tum")) if path.is_dir() else []
    path = path / LOG_NAME if path.is_dir() else path
    if not path.exists():
        instead = f"; beside it are {', '.join(trajectories)}: give one of them" if trajectories else ""
        raise LogError(f"{path}: no such file{instead}")
    return path


def is_log(path: Path) -> bool:
    """Whether a file is an MCAP log, by its name or its first bytes."""
    if path.suffix == ".mcap":
        return True
    try:
        with path.open("rb") as file:
            return file.read(len(_MCAP_MAGIC)) == _MCAP_MAGIC
    except OSError as error:
        raise LogError(f"{path}: {error.strerror}") from None


def key_of(i: int) -> str:
    """The key of the i-th input: a, ..., z, aa, ab, ..."""
    rest, last = divmod(i, len(string.ascii_lowercase))
    return (key_of(rest - 1) if rest else "") + string.ascii_lowercase[last]


def recorded_settings(path: Path, metadata: Mapping[str, Mapping[str, str]]) -> dict[str, Any] | None:
    """The configuration in the metadata of a run, as its TOML says it; None where a log has none."""
    text = metadata.get("config", {}).get("toml")
    if text is None:
        return None
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise LogError(f"{path}: its record of the configuration is not TOML: {error}") from None


def has_times(path: Path) -> bool:
    """Whether an input tells when its poses are: all but KITTI's files do."""
    return is_log(path) or file_format(path) != "kitti"


def _timed(key: str, label: str, path: Path) -> Result:
    """A log or a trajectory file that has times."""
    if not is_log(path):
        return Result(key, label, path, {ONLY_TRAJECTORY: read_trajectory(path, None)})
    recorded = read_trajectories(path)
    if not recorded.trajectories:
        raise LogError(f"{path}: {_without_trajectories(recorded)}")
    settings = recorded_settings(path, recorded.metadata)
    return Result(
        key, label, path, recorded.trajectories, recorded.ground_truth, settings, recorded.notes, recorded.damaged
    )


def _ground_truth(path: Path) -> Trajectory | None:
    """The ground truth in a file of its own; None for a file without times, which needs those of others."""
    if is_log(path):
        return only_trajectory(path, read_trajectories(path))
    return read_trajectory(path, None) if has_times(path) else None


def _without_trajectories(recorded: RecordedTrajectories) -> str:
    hint = "run fusion.run on it first" if recorded.ground_truth is not None else "no odometry and no poses"
    return f"it holds no trajectory to compare ({hint})"


def _frame_stamps(path: Path, known: Sequence[Trajectory]) -> IntArray:
    """Stamps for a KITTI file from a trajectory with as many poses; by index where nothing has any."""
    frames, poses = read_indexed_kitti_poses(path)
    count = len(poses) if frames is None else int(frames[-1]) + 1
    if not known:
        return np.arange(count, dtype=np.int64) * INDEX_PERIOD_NS
    for trajectory in known:
        if len(trajectory) == count or (frames is not None and len(trajectory) > count):
            return trajectory.stamps_ns
    raise UsageError(f"{path}: KITTI's format has no times of its own, and no input has {count} poses: give --times")


def _all_of(result: Result) -> list[Trajectory]:
    truth = [] if result.ground_truth is None else [result.ground_truth]
    return [*result.trajectories.values(), *truth]


def _labels(paths: Sequence[Path]) -> list[str]:
    """Names of files, of run.mcap the folder's; where two are the same with the folder, and then with the key."""
    places = [path.resolve().parent if path.name == LOG_NAME else path.resolve().with_suffix("") for path in paths]
    counts = Counter(place.name for place in places)
    labels = [place.name if counts[place.name] == 1 else f"{place.parent.name}/{place.name}" for place in places]
    counts = Counter(labels)
    return [label if counts[label] == 1 else f"{label} ({key_of(i)})" for i, label in enumerate(labels)]
