"""The main job: a log in, absolute trajectories out. ``python -m fusion.run --log seq09.mcap``."""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from time import perf_counter, strftime
from typing import TYPE_CHECKING, Any, TextIO

from fusion.export import Exports, add_options, checked, export
from fusion_io import progress
from fusion_io.command import STANDARD_OUTPUT, answered, command_parser, role_and_topic, write_text
from fusion_io.errors import EXIT_DAMAGED, EXIT_FAILED, EXIT_INTERRUPTED, EXIT_OK, LogError
from fusion_io.words import counted

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

    from fusion.config import FrontendConfig, ImuConfig, RunConfig
    from fusion.output import Outcome
    from fusion_io.findings import Findings
    from fusion_io.reader import Log
    from fusion_io.records import ImuSeries, IntArray, PairEstimate, Trajectory

# Modules that bring numpy, torch or GTSAM are imported by the function that needs them, so that --help answers at once.

INTERRUPTED = "interrupted"
ADAPTED = "adapted.pt"


@dataclass(frozen=True, slots=True)
class Presentation:
    """How results are shown beside the folder they go to: json is a file to copy metrics.json to, or "-" for stdout."""

    quiet: bool = False
    json: Path | None = None
    exports: Exports = field(default_factory=Exports)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    arguments = _parser().parse_args(argv)
    progress.silence(arguments.quiet)
    return answered(lambda: _run(arguments), ": nothing to show for it")


def _run(arguments: argparse.Namespace) -> int:
    from fusion import config

    exports = checked(Exports(arguments.csv, arguments.parquet, arguments.rerun))
    presentation = Presentation(arguments.quiet, arguments.json, exports)
    return run(arguments.log, arguments.out, config.load(arguments.config, _overrides(arguments)), presentation)


def run(log_path: Path, out: Path | None, config: RunConfig, presentation: Presentation = Presentation()) -> int:
    """Compute all about one log, write it to a folder, print the table; returns the exit code.

    Interrupted (Ctrl-C) while pairs are estimated, it goes on with those that it has.

    Raises UsageError for a folder that cannot be used, and LogError for a log without anything to compute from.
    """
    stopwatch = Stopwatch()
    from fusion import output
    from fusion_io.reader import open_log

    log = open_log(log_path, config.topics.model_dump(exclude_none=True))
    with output.folder_of_run(out or default_folder(log_path), log_path) as folder:
        return compute(log, folder, config, presentation, stopwatch)


def compute(log: Log, folder: Path, config: RunConfig, presentation: Presentation, stopwatch: Stopwatch) -> int:
    """All that is done with a log that could be opened; the results go to the folder. Returns the exit code."""
    from fusion import chain, fusing, gnss, imu, output
    from fusion_io.findings import Findings

    samples, fixes, ground_truth = log.imu(), log.gnss(), log.ground_truth()
    findings = Findings()
    stopwatch.lap("read")

    pairs, levels = pair_estimates(log, samples, config.frontend, findings, folder)
    stopwatch.lap("pairs")

    calibration = imu.calibrate(
        pairs, samples, known_mounting(log, config.imu), config.imu.time_offset_s, config.imu.low_pass_s
    )
    stopwatch.lap("calibration")

    known = fusing.measurements(pairs, samples, calibration, frame_stamps(log, pairs, findings), findings)
    raw = chain.chain(known.steps)
    stopwatch.lap("raw")

    skips = skipping_pairs(log, samples, pairs, config.frontend, findings, folder)
    stopwatch.lap("skips")

    positions = gnss.positions(fixes, config.gnss, findings)
    known = replace(
        known,
        skips=fusing.between_steps(skips, known.steps),
        loops=loop_closures(log, raw, config, findings),
        gnss=positions,
    )
    stopwatch.lap("loops")

    estimates = fusing.fuse(known, config, findings)
    stopwatch.lap("fusion")

    read = (samples, pairs, ground_truth, fixes)
    outcome = output.Outcome.of(log, config, read, calibration, known, estimates, findings, levels)
    stopwatch.lap("evaluation")

    output.write_log(folder, outcome)
    output.write_text(folder, outcome)
    stopwatch.lap("writing")
    output.write_plots(folder, outcome)
    stopwatch.lap("plots")
    output.write_report(folder, outcome)
    stopwatch.lap("report")
    output.write_metrics(folder, outcome, stopwatch.seconds)

    present(folder, outcome, presentation)
    return exit_code(outcome)


def pair_estimates(
    log: Log, imu: ImuSeries, config: FrontendConfig, findings: Findings, folder: Path
) -> tuple[list[PairEstimate], list[PairEstimate]]:
    """The recorded pair estimates of the log or those of the network, as they read back from their message.

    Beside them, what the network made of the pairs level by level, where it is known (`learned.estimator.by_level`).
    Passing the network's estimates through their message makes a replay of the output start from the same bits.
    A network that is adapted to the log first is left in the folder. Raises LogError where there are none.
    """
    if config.mode == "recorded" or (config.mode == "auto" and log.has_pairs):
        if recorded := log.pairs():
            return recorded, log.levels()
        raise LogError(f"{log.path}: no recorded pair estimates that can be used")
    if not log.has_frames:
        raise LogError(f"{log.path}: no images to estimate pairs from; it has {', '.join(log.roles)}")
    from fusion_io.messages import decode_pair, encode_pair
    from learned.estimator import estimate_pairs

    weights = adapted_weights(log, config, folder) if config.adapt else config.weights
    pairs: list[PairEstimate] = []
    levels: list[PairEstimate] = []
    skipped: Counter[str] = Counter()
    frames = progress.track(log.frames(), "pair estimates", len(log.frame_stamps()))
    try:
        for pair in estimate_pairs(log, imu, weights, frames, skipped, config.refine, levels):
            pairs.append(decode_pair(encode_pair(pair)))
    except KeyboardInterrupt:
        if not pairs:
            raise
        if progress.is_watched():
            print(f"interrupted: going on with {counted(len(pairs), 'pair')}; Ctrl-C again to give up", file=sys.stderr)
        until_s = (pairs[-1].target_stamp_ns - log.start_ns) / 1e9
        findings.put(INTERRUPTED, 1, f"interrupted: results are of the first {until_s:.1f} s only")
    for name, count in skipped.items():
        findings.put(name, count, f"{name.replace('_', ' ')}: {count}")
    if not pairs:
        reasons = "; ".join(findings.notes) or f"it has {counted(len(log.frame_stamps()), 'frame')}"
        raise LogError(f"{log.path}: no pair of frames could be estimated ({reasons})")
    return pairs, levels[: len(pairs)]  # one may have been under way when it was interrupted


def skipping_pairs(
    log: Log, imu: ImuSeries, pairs: Sequence[PairEstimate], config: FrontendConfig, findings: Findings, folder: Path
) -> list[PairEstimate]:
    """Pairs that skip a frame: those that the log has recorded, or the network's where it made the others too."""
    if recorded := log.skips():
        return recorded
    by_network = config.mode == "violearner" or not log.has_pairs
    if not (config.skips and by_network and log.has_frames) or INTERRUPTED in findings.counts:
        return []
    from fusion_io.messages import decode_pair, encode_pair
    from learned.estimator import estimate_skips

    adapted = folder / ADAPTED
    weights = adapted if config.adapt and adapted.exists() else config.weights
    frames = len(log.frame_stamps()) // 2
    estimates = estimate_skips(
        log, imu, weights, lambda each: progress.track(each, "pairs that skip a frame", frames), config.refine
    )
    skips: list[PairEstimate] = []
    try:
        skips.extend(decode_pair(encode_pair(skip)) for skip in estimates)
    except KeyboardInterrupt:
        findings.put(INTERRUPTED, 1, f"interrupted: {len(skips)} of {len(pairs)} pairs that skip a frame are there")
    return sorted(skips, key=lambda skip: skip.target_stamp_ns)


def loop_closures(log: Log, raw: Trajectory, config: RunConfig, findings: Findings) -> Sequence[PairEstimate]:
    """The loops that the log has recorded, or those found in its images, as they read back from their message."""
    if recorded := log.loops():
        return [loop for loop in recorded if loop.target_stamp_ns <= raw.stamps_ns[-1]]
    if not (config.loops.find and log.has_frames):
        return []
    from fusion.loops import find_loops
    from fusion_io.messages import decode_pair, encode_pair

    try:
        found = find_loops(log, raw, config.frontend.weights, config.loops, findings)
    except LogError as error:  # recorded pairs need no images that can be used
        findings.remark(f"loops were not looked for: {error}")
        return []
    return [decode_pair(encode_pair(loop)) for loop in found]


def frame_stamps(log: Log, pairs: Sequence[PairEstimate], findings: Findings) -> IntArray:
    """The frames that the trajectories lead through: all, or up to the last pair if the run was interrupted."""
    stamps = log.frame_stamps()
    return stamps[stamps <= pairs[-1].target_stamp_ns] if INTERRUPTED in findings.counts else stamps


def adapted_weights(log: Log, config: FrontendConfig, folder: Path) -> Path:
    """The weights after adaptation to the log, in the folder; says on stderr what it was good for."""
    from learned.adapt import adapt

    path = folder / ADAPTED
    print(adapt(log, config.weights, path), file=sys.stderr)
    return path


def known_mounting(log: Log, config: ImuConfig) -> Rotation | None:
    """The rotation from camera to IMU axes if the configuration or else the log gives it."""
    from scipy.spatial.transform import Rotation

    if config.rotation_imu_camera_quat_wxyz is not None:
        return Rotation.from_quat(config.rotation_imu_camera_quat_wxyz, scalar_first=True)
    return log.mounting()


def present(folder: Path, outcome: Outcome, presentation: Presentation) -> None:
    """Show the results on the terminal, and hand them to the files and tools that were asked for.

    stdout belongs to metrics.json where that is to go there; the table goes to stderr then.
    """
    remarks = {*outcome.log.remarks, *outcome.findings.remarks}
    for note in (*outcome.log.notes, *outcome.findings.notes):
        if note not in remarks:
            print(f"warning: {note}", file=sys.stderr)
    if not presentation.quiet:
        print_results(folder, outcome, sys.stderr if presentation.json == STANDARD_OUTPUT else sys.stdout)
    if presentation.json is not None:
        write_text(presentation.json, (folder / "metrics.json").read_text(encoding="utf-8"))
    if presentation.exports != Exports():
        from fusion.output import LOG_NAME
        from fusion_io.reader import open_log

        export(open_log(folder / LOG_NAME), outcome.log, presentation.exports)


def print_results(folder: Path, outcome: Outcome, stream: TextIO) -> None:
    """Print the table, what it comes to, what became of the IMU and where the results are."""
    from rich.console import Console

    from fusion.placement import imu_line
    from fusion.report.verdict import doubts, judgement
    from fusion.table import HEADINGS, end_lines, print_table

    log = outcome.log
    title = f"{log.path.name}: {counted(len(outcome.trajectories['raw']), 'frame')}, {outcome.duration_s:.1f} s"
    metrics = {name: asdict(each) for name, each in outcome.metrics.items()}
    print_table(Console(file=stream), title, outcome.trajectories, metrics)
    for line in (*doubts(outcome.content), judgement(outcome.content)[0]):
        print(f"{line[0].upper()}{line[1:]}.", file=stream)
    for line in end_lines(outcome.trajectories):
        print(line, file=stream)
    for remark in (*log.remarks, *outcome.findings.remarks):
        print(remark, file=stream)
    print(imu_line(outcome.calibration, outcome.estimates.values()), file=stream)
    for name, estimate in outcome.estimates.items():
        print(f"{HEADINGS[name]}: {estimate.note}", file=stream)
    print(f"Results: {folder}", file=stream)


def exit_code(outcome: Outcome) -> int:
    """130 after Ctrl-C, 1 where a back end that was asked for has nothing to show, 3 for a damaged log, else 0."""
    from fusion import fusing

    if INTERRUPTED in outcome.findings.counts:
        return EXIT_INTERRUPTED
    if any(name not in outcome.trajectories for name in fusing.back_ends(outcome.config)):
        return EXIT_FAILED
    return EXIT_DAMAGED if outcome.log.damaged else EXIT_OK


def default_folder(log_path: Path) -> Path:
    """runs/<log name>-<time>."""
    return Path("runs", f"{log_path.stem}-{strftime('%Y%m%d-%H%M%S')}")


class Stopwatch:
    """Seconds by stage: each lap ends the stage that began with the lap before, and says so where somebody watches."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._last = perf_counter()

    def lap(self, stage: str) -> None:
        """End a stage."""
        now = perf_counter()
        self.seconds[stage] = now - self._last
        self._last = now
        if progress.is_watched():
            print(f"{stage}: {self.seconds[stage]:.1f} s", file=sys.stderr)


_EPILOG = """\
examples:
  python -m fusion.run --log drive.mcap
  python -m fusion.run --log drive.mcap --out runs/drive --config drive.toml --backend ekf
  python -m fusion.run --log drive.mcap --topic image=/cam0/image_raw --topic imu=/imu0
  python -m fusion.run --log drive.mcap --csv runs/tables --rerun runs/drive.rrd
  python -m fusion.run --log drive.mcap --json - | jq .trajectories.ekf.ate_m

exit codes: 0 all well, 1 nothing could be computed, 2 usage, 3 computed from a damaged log,
130 interrupted (Ctrl-C while pairs are estimated: the results are of the pairs until then)"""


def _parser() -> argparse.ArgumentParser:
    parser = command_parser(
        "fusion.run",
        "Compute absolute camera trajectories, raw and fused, from an RGB-D and IMU log.",
        _EPILOG,
    )
    parser.add_argument("--log", type=Path, required=True, metavar="FILE.mcap", help="the log to compute from")
    parser.add_argument("--out", type=Path, metavar="DIR", help="where results go (default: runs/<log name>-<time>)")
    parser.add_argument("--backend", choices=("posegraph", "ekf", "both"), help="what fuses (default: both)")
    parser.add_argument(
        "--online", action="store_true", default=None, help="the pose graph also as it runs on a robot, frame by frame"
    )
    parser.add_argument(
        "--frontend",
        choices=("auto", "violearner", "recorded"),
        help="where pair estimates come from (default: auto, those in the log if it has any, else the network)",
    )
    parser.add_argument("--weights", type=Path, metavar="FILE", help="the network's weights (default: those shipped)")
    parser.add_argument(
        "--adapt", action="store_true", default=None, help="adapt the network to the log's images first (minutes)"
    )
    parser.add_argument(
        "--refine",
        action=argparse.BooleanOptionalAction,
        help="refine the network's estimates at full resolution (default: yes)",
    )
    parser.add_argument("--config", type=Path, metavar="FILE.toml", help="settings; the options here come before it")
    parser.add_argument(
        "--segment-lengths",
        type=_lengths,
        metavar="M,M,...",
        help="path lengths of t_rel and r_rel in metres (default: KITTI's 100,200,...,800)",
    )
    parser.add_argument(
        "--record",
        choices=("light", "all"),
        help="what goes into run.mcap: all with the images, light without (default: light)",
    )
    parser.add_argument(
        "--topic",
        type=role_and_topic,
        action="append",
        metavar="ROLE=NAME",
        help="the topic of a role where the log leaves it open; roles: image, depth, camera_info, imu, gyro, "
        "accelerometer, ground_truth, pairs, loops, gnss, tf_static; may be repeated",
    )
    add_options(parser)
    parser.add_argument("--json", type=Path, metavar="FILE", help="copy metrics.json there; - is stdout")
    parser.add_argument("--quiet", action="store_true", help="print warnings and errors only, no progress, no table")
    return parser


def _lengths(text: str) -> list[float]:
    try:
        return [float(word) for word in text.split(",")]
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a list of lengths such as 10,20,30") from None


def _overrides(arguments: argparse.Namespace) -> dict[str, Any]:
    """What the command line says, in the shape of the configuration; what it leaves open is absent."""
    options = {
        "backend": arguments.backend,
        "online": arguments.online,
        "record": arguments.record,
        "segment_lengths_m": arguments.segment_lengths,
        "topics": dict(arguments.topic) if arguments.topic else None,
    }
    frontend = {name: getattr(arguments, name) for name in ("weights", "adapt", "refine")} | {
        "mode": arguments.frontend
    }
    return _given(options) | {"frontend": _given(frontend)}


def _given(options: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in options.items() if value is not None}


if __name__ == "__main__":
    sys.exit(main())
