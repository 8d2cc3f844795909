"""The back ends again, on what a log recorded, with other settings: ``python -m fusion.replay RUN.mcap --set ...``."""

from __future__ import annotations

import argparse
import math
import sys
from collections.abc import Mapping, Sequence
from copy import deepcopy
from dataclasses import asdict, dataclass, replace
from difflib import get_close_matches
from itertools import product
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any, TextIO

from fusion_io.command import STANDARD_OUTPUT, answered, command_parser, write_json, write_text
from fusion_io.errors import EXIT_DAMAGED, EXIT_FAILED, EXIT_OK, LogError, UsageError

if TYPE_CHECKING:
    from rich.table import Table

    from fusion.comparison import Comparison
    from fusion.config import RunConfig
    from fusion.output import Outcome
    from fusion.results import Result
    from fusion_io.reader import Log
    from fusion_io.records import Trajectory

# Modules that bring numpy or GTSAM are imported by the function that needs them, so that --help answers at once.

Settings = dict[str, Any]
"""Values by dotted name: ``posegraph.gyro_noise``."""

_WITHOUT_EFFECT = ("frontend", "topics", "record")
"""Settings of what comes before the pairs or after the trajectories."""

WIDTH = 120  # where nobody watches

_SHOWN = (("t_rel_percent", "t_rel", "%", 3), ("r_rel_deg_per_100m", "r_rel", "deg/100m", 3), ("ate_m", "ATE", "m", 2))


@dataclass(frozen=True, slots=True)
class Replay:
    """One combination of settings, the whole configuration, and what came of it.

    trajectories: by name. metrics: the content of metrics.json. notes: what became of the IMU, and what was amiss.
    failed: the back ends that have no result.
    """

    settings: Settings
    config: RunConfig
    trajectories: Mapping[str, Trajectory]
    metrics: dict[str, Any]
    notes: Sequence[str]
    failed: Sequence[str]

    @property
    def label(self) -> str:
        """The settings in a line."""
        return ", ".join(f"{name}={value}" for name, value in self.settings.items()) or "unchanged"


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    arguments = _parser().parse_args(argv)
    return answered(lambda: run(arguments))


def run(arguments: argparse.Namespace) -> int:
    """Replay all combinations of settings, compare them with what was recorded, and show it; returns the exit code."""
    from fusion import compare, comparison
    from fusion.results import Result, log_file
    from fusion.table import HEADINGS, end_lines
    from fusion_io.progress import track
    from fusion_io.reader import open_log

    combinations = settings_of(arguments.set, arguments.grid)
    path = log_file(arguments.run)
    log = open_log(path)
    for line in log.damage:
        print(f"warning: {line}", file=sys.stderr)
    base = recorded_configuration(log)
    configurations = [configured(base, settings) for settings in combinations]
    recorded = recorded_result(log) or _as_result(replay(log, {}, configured(base, {})), path)
    truth = log.ground_truth()

    replays: list[Replay] = []
    compared: list[Comparison] = []
    for settings, config in track(list(zip(combinations, configurations, strict=True)), "replay"):
        replays.append(replay(log, settings, config))
        result = Result("b", "replay", path, replays[-1].trajectories)
        compared.append(comparison.compare([recorded, result], truth, config.segment_lengths_m))
        check_measure(arguments.sort_by, compared[0])  # before minutes are spent on the rest
    for each in replays:
        if each.failed:
            print(f"warning: {each.label}: no result of {', '.join(each.failed)}", file=sys.stderr)
    order, measure = ranked(compared, arguments.sort_by, combinations)
    best = compared[order[0]]
    if arguments.json is not None:
        write_json(arguments.json, document(log, replays, compared, order, measure))
    if arguments.out is not None:
        write_folder(arguments.out, replays[order[0]], best)
    stream = sys.stderr if arguments.json == STANDARD_OUTPUT else sys.stdout
    for name in not_run(configured(base, {}), configurations):
        print(f"{HEADINGS[name]} not run again: no setting of it is given (--set backend=both runs both)", file=stream)
    if len(replays) > 1:
        _print(sweep_table(replays, compared, order, measure), stream)
    print(f"{replays[order[0]].label}, compared with the recorded run:", file=stream)
    compare.show(best, stream)
    for line in (*end_lines(replays[order[0]].trajectories), *replays[order[0]].notes):
        print(line, file=stream)
    if all(each.failed for each in replays):
        return EXIT_FAILED
    return EXIT_DAMAGED if log.damaged else EXIT_OK


# --- Settings -----------------------------------------------------------------------------------


def settings_of(assignments: Sequence[tuple[str, Any]], grids: Sequence[tuple[str, list[Any]]]) -> list[Settings]:
    """Every combination of the grids' values on top of the assignments.

    Raises UsageError for a name that is there twice, and for one that a replay does not depend on.
    """
    names = [name for name, _ in (*assignments, *grids)]
    for name in names:
        if names.count(name) > 1:
            raise UsageError(f"{name} is set twice")
        if name.split(".")[0] in _WITHOUT_EFFECT:
            raise UsageError(f"{name}: a replay begins with the recorded pairs, and this does not change what follows")
    axes = [[(name, value) for value in values] for name, values in grids]
    return [dict(assignments) | dict(chosen) for chosen in product(*axes)]


def recorded_configuration(log: Log) -> dict[str, Any]:
    """The configuration of the run that wrote the log, as tables of TOML; empty for a log that no run wrote."""
    from fusion import config
    from fusion.results import recorded_settings

    table = recorded_settings(log.path, log.metadata) or {}
    table.pop("topics", None)  # names of another log
    try:
        config.load(None, table)
    except UsageError as error:
        reason = str(error).removeprefix("command line: ")
        raise LogError(f"{log.path}: the configuration that it recorded is not one of this version: {reason}") from None
    return table


def configured(base: Mapping[str, Any], settings: Settings) -> RunConfig:
    """The base with settings on top, and the back ends that they concern, unless one of the settings says which.

    Raises UsageError, with the nearest valid name, for a name that does not exist.
    """
    from fusion import config

    table = deepcopy(dict(base))
    for name, value in settings.items():
        *sections, last = name.split(".")
        inner = table
        for section in sections:
            inner = inner.setdefault(section, {})
            if not isinstance(inner, dict):
                raise UsageError(f"{name}: {section} is a value and not a table of settings")
        inner[last] = value
    table.setdefault("frontend", {})["mode"] = "recorded"
    concerned = {name.split(".")[0] for name in settings}
    if concerned and concerned <= {"posegraph", "ekf"}:
        table["backend"] = "both" if len(concerned) > 1 else concerned.pop()
    return config.load(None, table)


def not_run(base: RunConfig, configurations: Sequence[RunConfig]) -> list[str]:
    """The back ends that the recorded run had and no replay has, because the settings do not concern them."""
    from fusion.fusing import back_ends

    run_again = {name for config in configurations for name in back_ends(config)}
    return [name for name in back_ends(base) if name not in run_again]


# --- Fusing -------------------------------------------------------------------------------------


def replay(log: Log, settings: Settings, config: RunConfig) -> Replay:
    """Fuse what the log recorded with a configuration; the settings are what it is called by."""
    from fusion.fusing import back_ends
    from fusion.output import metrics_document
    from fusion.placement import imu_line
    from fusion.table import HEADINGS

    started = perf_counter()
    outcome = fuse_again(log, config)
    metrics = metrics_document(outcome, {"replay": perf_counter() - started})
    estimates = outcome.estimates
    of_back_ends = [f"{HEADINGS[name]}: {each.note}" for name, each in estimates.items()]
    notes = [imu_line(outcome.calibration, estimates.values()), *of_back_ends, *outcome.findings.notes]
    failed = [name for name in back_ends(config) if name not in outcome.trajectories]
    return Replay(settings, config, outcome.trajectories, metrics, notes, failed)


def fuse_again(log: Log, config: RunConfig) -> Outcome:
    """What a run makes of the recorded pairs, IMU, loops and positions; a log without pairs raises LogError."""
    from fusion import fusing, gnss, imu
    from fusion.output import Outcome
    from fusion.run import known_mounting
    from fusion_io.findings import Findings

    pairs, samples, fixes, truth = log.pairs(), log.imu(), log.gnss(), log.ground_truth()
    if not pairs:
        raise LogError(f"{log.path}: no recorded pair estimates to replay: run fusion.run on it first")
    findings = Findings()
    calibration = imu.calibrate(
        pairs, samples, known_mounting(log, config.imu), config.imu.time_offset_s, config.imu.low_pass_s
    )
    known = fusing.measurements(pairs, samples, calibration, log.frame_stamps(), findings)
    skips = fusing.between_steps(log.skips(), known.steps)
    positions = gnss.positions(fixes, config.gnss, findings)
    known = replace(known, skips=skips, loops=log.loops(), gnss=positions)
    estimates = fusing.fuse(known, config, findings)
    return Outcome.of(log, config, (samples, pairs, truth, fixes), calibration, known, estimates, findings)


def recorded_result(log: Log) -> Result | None:
    """The trajectories that the log recorded; None where it has none."""
    from fusion.results import Result
    from fusion_io.odometry import read_trajectories

    recorded = read_trajectories(log.path).trajectories
    return Result("a", "recorded", log.path, recorded) if recorded else None


def _as_result(unchanged: Replay, path: Path) -> Result:
    from fusion.results import Result

    return Result("a", "unchanged", path, unchanged.trajectories)


# --- Judging ------------------------------------------------------------------------------------


def ranked(
    compared: Sequence[Comparison], sort_by: str | None, combinations: Sequence[Settings]
) -> tuple[list[int], str | None]:
    """The replays from best to worst, and the measure that says so; as they are where nothing can be measured.

    sort_by: a measure such as ``ekf.ate_m``. By default t_rel, or the ATE where the path is too short for it, of the
    back end whose settings vary, the pose graph where that leaves it open.
    """
    measures = [_measures(each) for each in compared]
    chosen = sort_by or _default_measure(measures, combinations)
    distances = [math.inf if distance is None else distance for distance in _distances(compared, chosen)]
    return sorted(range(len(compared)), key=distances.__getitem__), chosen


def _distances(compared: Sequence[Comparison], measure: str | None) -> list[float | None]:
    """How far each replay is from what would be right in a measure; None where that is not known."""
    from fusion.comparison import badness

    values = [None if measure is None else _measures(each).get(measure) for each in compared]
    return [None if measure is None or value is None else badness(measure, value) for value in values]


def check_measure(name: str | None, compared: Comparison) -> None:
    """Raise UsageError, with the nearest that exists, for a measure that a replay does not have."""
    measures = _measures(compared)
    if name is not None and name not in measures:
        near = get_close_matches(name, measures, n=1, cutoff=0.0)[0]
        raise UsageError(f"--sort-by: unknown measure {name!r}; did you mean {near!r}?")


def _measures(compared: Comparison) -> dict[str, float | None]:
    """The measures of a replay, without its key."""
    return {name.removeprefix("b."): value for name, value in compared.measures.items() if name.startswith("b.")}


def _default_measure(measures: Sequence[Mapping[str, float | None]], combinations: Sequence[Settings]) -> str | None:
    varied = {name.split(".")[0] for settings in combinations for name in settings}
    back_ends = ("ekf", "posegraph") if "ekf" in varied and "posegraph" not in varied else ("posegraph", "ekf")
    for name in back_ends:
        for measure in ("t_rel_percent", "ate_m"):
            if any(each.get(f"{name}.{measure}") is not None for each in measures):
                return f"{name}.{measure}"
    return None


def sweep_table(
    replays: Sequence[Replay], compared: Sequence[Comparison], order: Sequence[int], measure: str | None
) -> Table:
    """A row for every combination, the best first and marked, several that are equally good as equal.

    Its columns are the settings that vary.
    """
    from rich import box
    from rich.table import Table

    from fusion.table import HEADINGS, best_of

    distances = _distances(compared, measure)
    best = best_of(distances)
    varied = [name for name in replays[0].settings if len({repr(each.settings[name]) for each in replays}) > 1]
    names = [name for name in replays[order[0]].trajectories if name != "raw"]
    by = f", sorted by {measure}" if measure else ": no ground truth, so none is the best"
    if measure and not any(best):
        by += ", in which all are equal"
    table = Table(title=f"{len(replays)} combinations{by}", title_justify="left", title_style="", box=box.SIMPLE_HEAD)
    table.add_column("")
    for name in varied:
        section, _, last = name.rpartition(".")
        table.add_column(f"{section}\n{last}" if section else last, justify="right")
    for name in names:
        for _, heading, unit, _ in _SHOWN:
            table.add_column(f"{HEADINGS.get(name, name)}\n{heading} {unit}", justify="right")
    for i in order:
        metrics = compared[i].metrics
        cells = [
            _cell(getattr(metrics[f"b.{name}"], key) if f"b.{name}" in metrics else None, decimals)
            for name in names
            for key, _, _, decimals in _SHOWN
        ]
        chosen = [str(replays[i].settings[name]) for name in varied]
        mark = "" if not best[i] else "best" if sum(best) == 1 else "equal"
        table.add_row(mark, *chosen, *cells, style="bold" if best[i] else "")
    return table


def document(
    log: Log, replays: Sequence[Replay], compared: Sequence[Comparison], order: Sequence[int], measure: str | None
) -> dict[str, Any]:
    """What was recorded, every replay from best to worst, and the best compared with what was recorded."""
    from fusion import comparison

    best = compared[order[0]]
    return {
        "schema": comparison.SCHEMA,
        "log": str(log.path),
        "sorted_by": measure,
        "recorded": _metrics(best, "a."),
        "replays": [
            {
                "settings": replays[i].settings,
                "trajectories": _metrics(compared[i], "b."),
                "failed": list(replays[i].failed),
                "notes": list(replays[i].notes),
            }
            for i in order
        ],
        "best": comparison.document(best),
    }


def write_folder(folder: Path, best: Replay, compared: Comparison) -> None:
    """Write a replay's trajectories as NAME.tum and NAME.kitti.txt, its configuration, the comparison, metrics.json."""
    from fusion.comparison_page import page
    from fusion.config import to_toml
    from fusion_io.trajectory_files import write_kitti, write_tum

    write_text(folder / "config.toml", to_toml(best.config))
    write_text(folder / "comparison.html", page(compared))
    for name, trajectory in best.trajectories.items():
        write_tum(folder / f"{name}.tum", trajectory)
        write_kitti(folder / f"{name}.kitti.txt", trajectory)
    write_json(folder / "metrics.json", best.metrics)  # the last, as of a run


def _metrics(compared: Comparison, prefix: str) -> dict[str, Any]:
    return {
        name.removeprefix(prefix): asdict(metrics)
        for name, metrics in compared.metrics.items()
        if name.startswith(prefix)
    }


def _cell(value: float | None, decimals: int) -> str:
    return "-" if value is None else f"{value:.{decimals}f}"


def _print(table: Table, stream: TextIO) -> None:
    from rich.console import Console

    Console(file=stream, width=None if stream.isatty() else WIDTH).print(table)


# --- The command line ---------------------------------------------------------------------------


_EPILOG = """\
examples:
  python -m fusion.replay runs/09 --set posegraph.gyro_noise=2e-3
  python -m fusion.replay runs/09 --grid ekf.gyro_noise=1e-4,1e-3 --grid ekf.acceleration=1,5 --out best

Settings of one back end run that one alone; --set backend=both runs both.

exit codes: 0 all well, 1 nothing could be computed, 2 usage, 3 computed from a damaged log,
130 interrupted"""


def _parser() -> argparse.ArgumentParser:
    parser = command_parser(
        "fusion.replay",
        "Run the back ends again on what a log recorded (pairs, loops, IMU, GNSS), with other settings, "
        "and compare with the trajectories that it recorded.",
        _EPILOG,
    )
    parser.add_argument("run", type=Path, metavar="RUN.mcap", help="the log of a run, or the run's folder")
    parser.add_argument(
        "--set",
        type=_assignment,
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="a setting as in config.toml, on top of those that the run recorded; may be repeated",
    )
    parser.add_argument(
        "--grid",
        type=_grid,
        action="append",
        default=[],
        metavar="NAME=V,V,...",
        help="several values of a setting: all combinations are computed; may be repeated",
    )
    parser.add_argument(
        "--sort-by",
        metavar="MEASURE",
        help="what makes the best of a grid, such as ekf.ate_m (default: t_rel of the back end whose settings vary)",
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures; - is stdout")
    parser.add_argument(
        "--out",
        type=Path,
        metavar="DIR",
        help="write the trajectories, configuration, page and metrics.json of the best",
    )
    return parser


def _assignment(text: str) -> tuple[str, Any]:
    name, value = _name_and_text(text)
    return name, _value(value)


def _grid(text: str) -> tuple[str, list[Any]]:
    name, values = _name_and_text(text)
    array = _toml(f"[{values}]")
    return name, array if array else [_value(word) for word in values.split(",")]


def _name_and_text(text: str) -> tuple[str, str]:
    name, equals, value = (part.strip() for part in text.partition("="))
    if not (equals and value and all(name.split("."))):
        raise argparse.ArgumentTypeError(f"{text!r} is not NAME=VALUE such as posegraph.gyro_noise=1e-3")
    return name, value


def _value(text: str) -> Any:
    """A value of TOML; what is none is a string without its quotes."""
    value = _toml(text)
    return text.strip() if value is None else value


def _toml(text: str) -> Any:
    """The value that TOML sees in a text, None where it sees none."""
    import tomllib

    try:
        table = tomllib.loads(f"value = {text}")
    except tomllib.TOMLDecodeError:
        return None
    return table["value"] if len(table) == 1 else None


if __name__ == "__main__":
    sys.exit(main())
