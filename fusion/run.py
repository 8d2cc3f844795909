"""The main job: a log in, absolute trajectories out. ``python -m fusion.run --log seq09.mcap``."""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from time import perf_counter, strftime
from typing import TYPE_CHECKING, Any

from fusion_io.errors import EXIT_DAMAGED, EXIT_FAILED, EXIT_OK, EXIT_USAGE, FusionError, LogError, UsageError

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

    from fusion.config import FrontendConfig, ImuConfig, RunConfig
    from fusion.ekf import EkfResult
    from fusion.output import Outcome
    from fusion.posegraph import PoseGraphResult
    from fusion_io.findings import Findings
    from fusion_io.reader import Log
    from fusion_io.records import ImuSeries, PairEstimate, Trajectory

# Modules that bring numpy, torch or GTSAM are imported by the function that needs them, so that --help answers at once.


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    arguments = _parser().parse_args(argv)
    try:
        from fusion import config

        return run(arguments.log, arguments.out, config.load(arguments.config, _overrides(arguments)))
    except FusionError as error:
        print(f"error: {error}", file=sys.stderr)
        return EXIT_USAGE if isinstance(error, UsageError) else EXIT_FAILED


def run(log_path: Path, out: Path | None, config: RunConfig) -> int:
    """Compute all about one log, write it to a folder, print the table; returns the exit code.

    Raises UsageError for a folder that cannot be used, and LogError for a log without anything to compute from.
    """
    stopwatch = Stopwatch()
    from fusion import chain, imu, output
    from fusion.evaluation import evaluate
    from fusion_io.findings import Findings
    from fusion_io.reader import open_log

    log = open_log(log_path, config.topics.model_dump(exclude_none=True))
    folder = output.prepare_folder(out or default_folder(log_path), log_path)
    samples, ground_truth = log.imu(), log.ground_truth()
    findings = Findings()
    stopwatch.lap("read")

    pairs = pair_estimates(log, samples, config.frontend, findings, folder)
    stopwatch.lap("pairs")

    calibration = imu.calibrate(pairs, samples, known_mounting(log, config.imu), config.imu.time_offset_s)
    inertial = imu.in_camera_axes(samples, calibration) if calibration.used else None
    faulty = len(calibration.faulty_ns)
    findings.put("imu_faulty_stretches", faulty, f"stretches where the gyro contradicts the pairs, left out: {faulty}")
    stopwatch.lap("calibration")

    steps, gaps = chain.bridge_gaps(log.frame_stamps(), pairs, inertial)
    findings.put("gaps_bridged", gaps, f"gaps between pair estimates that were bridged: {gaps}")
    trajectories, remarks = {"raw": chain.chain(steps)}, {}
    stopwatch.lap("raw")

    for name in back_ends(config):
        if fused := fuse(name, steps, inertial, calibration.gyro_bias_std, config, findings):
            trajectories[name], remarks[name] = fused
        stopwatch.lap(name)

    metrics = {name: evaluate(each, ground_truth, config.segment_lengths_m) for name, each in trajectories.items()}
    stopwatch.lap("evaluation")

    outcome = output.Outcome(
        log, config, samples, pairs, ground_truth, calibration, trajectories, remarks, metrics, findings
    )
    output.write_log(folder, outcome)
    output.write_text(folder, outcome)
    stopwatch.lap("writing")
    output.write_plots(folder, outcome)
    stopwatch.lap("plots")
    output.write_metrics(folder, outcome, stopwatch.seconds)

    report(folder, outcome)
    return exit_code(outcome)


def pair_estimates(
    log: Log, imu: ImuSeries, config: FrontendConfig, findings: Findings, folder: Path
) -> list[PairEstimate]:
    """The recorded pair estimates of the log or those of the network, as they read back from their message.

    Passing the network's estimates through their message makes a replay of the output start from the same bits.
    A network that is adapted to the log first is left in the folder. Raises LogError where there are none.
    """
    if config.mode == "recorded" or (config.mode == "auto" and log.has_pairs):
        pairs = log.pairs()
        if not pairs:
            raise LogError(f"{log.path}: no recorded pair estimates that can be used")
        return pairs
    if not log.has_frames:
        raise LogError(f"{log.path}: no images to estimate pairs from; it has {', '.join(log.roles)}")
    from fusion_io.messages import decode_pair, encode_pair
    from fusion_io.progress import track
    from learned.estimator import estimate_pairs

    weights = adapted_weights(log, config, folder) if config.adapt else config.weights
    skipped: Counter[str] = Counter()
    frames = track(log.frames(), "pair estimates", len(log.frame_stamps()))
    estimates = estimate_pairs(log, imu, weights, frames, skipped, config.refine)
    pairs = [decode_pair(encode_pair(pair)) for pair in estimates]
    for name, count in skipped.items():
        findings.put(name, count, f"{name.replace('_', ' ')}: {count}")
    if not pairs:
        reasons = "; ".join(findings.notes) or f"it has {len(log.frame_stamps())} frames"
        raise LogError(f"{log.path}: no pair of frames could be estimated ({reasons})")
    return pairs


def adapted_weights(log: Log, config: FrontendConfig, folder: Path) -> Path:
    """The weights after adaptation to the log, in the folder; says on stderr what it was good for."""
    from learned.adapt import adapt

    path = folder / "adapted.pt"
    print(adapt(log, config.weights, path), file=sys.stderr)
    return path


def known_mounting(log: Log, config: ImuConfig) -> Rotation | None:
    """The rotation from camera to IMU axes if the configuration or else the log gives it."""
    from scipy.spatial.transform import Rotation

    if config.rotation_imu_camera_quat_wxyz is not None:
        return Rotation.from_quat(config.rotation_imu_camera_quat_wxyz, scalar_first=True)
    return log.mounting()


def back_ends(config: RunConfig) -> Sequence[str]:
    """The names of the back ends that are asked for."""
    return ("posegraph", "ekf") if config.backend == "both" else (config.backend,)


def fuse(
    name: str,
    steps: Sequence[PairEstimate],
    inertial: ImuSeries | None,
    gyro_bias_std: float,
    config: RunConfig,
    findings: Findings,
) -> tuple[Trajectory, str] | None:
    """The trajectory of a back end and its remark on it; None, and counted, where it fails: the others are not lost.

    gyro_bias_std: standard deviation (rad/s) of the gyro bias that was taken off `inertial`.
    """
    import numpy as np

    try:
        result: PoseGraphResult | EkfResult
        if name == "posegraph":
            from fusion import posegraph

            result = posegraph.solve(steps, inertial, config.posegraph)
            rejected = result.imu_rejected + result.pairs_rejected
        else:
            from fusion import ekf

            result = ekf.solve(steps, inertial, config.ekf, gyro_bias_std)
            rejected = result.rejected
        if not np.all(np.isfinite(result.trajectory.poses.as_matrix())):
            raise FloatingPointError("a pose is not finite")
    except (FusionError, ArithmeticError, RuntimeError, np.linalg.LinAlgError) as error:  # GTSAM raises RuntimeError
        findings.put(f"{name}_failed", 1, f"back end failed ({name}): {' '.join(str(error).split())}")
        return None
    findings.put(f"{name}_rejected", rejected, f"measurements rejected as outliers ({name}): {rejected}")
    return result.trajectory, result.note


def report(folder: Path, outcome: Outcome) -> None:
    """Print the table, what became of the IMU and where the results are to stdout, and the warnings to stderr."""
    from dataclasses import asdict

    from rich.console import Console

    from fusion.table import HEADINGS, print_table

    log, calibration = outcome.log, outcome.calibration
    for note in (*log.notes, *outcome.findings.notes):
        print(f"warning: {note}", file=sys.stderr)
    title = f"{log.path.name}: {len(outcome.trajectories['raw'])} frames, {outcome.duration_s:.1f} s"
    metrics = {name: asdict(each) for name, each in outcome.metrics.items()}
    print_table(Console(), title, outcome.trajectories, metrics)
    print(f"IMU {'used' if calibration.used else 'left out'}: {calibration.reason}")
    for name, remark in outcome.remarks.items():
        print(f"{HEADINGS[name]}: {remark}")
    print(f"Results: {folder}")


def exit_code(outcome: Outcome) -> int:
    """1 where a back end that was asked for has nothing to show, 3 for a damaged log, else 0."""
    if any(name not in outcome.trajectories for name in back_ends(outcome.config)):
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
        if sys.stderr.isatty():
            print(f"{stage}: {self.seconds[stage]:.1f} s", file=sys.stderr)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m fusion.run",
        description="Compute absolute camera trajectories, raw and fused, from an RGB-D and IMU log.",
        epilog="Exit codes: 0 all well, 1 nothing could be computed, 2 usage, 3 computed from a damaged log.",
    )
    parser.add_argument("--log", type=Path, required=True, metavar="FILE.mcap", help="the log to compute from")
    parser.add_argument("--out", type=Path, metavar="DIR", help="where results go (default: runs/<log name>-<time>)")
    parser.add_argument("--backend", choices=("posegraph", "ekf", "both"), help="what fuses (default: both)")
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
        type=_role_and_topic,
        action="append",
        metavar="ROLE=NAME",
        help="the topic of a role where the log leaves it open; roles: image, depth, camera_info, imu, gyro, "
        "accelerometer, ground_truth, pairs, loops, gnss, tf_static; may be repeated",
    )
    return parser


def _lengths(text: str) -> list[float]:
    try:
        return [float(word) for word in text.split(",")]
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not a list of lengths such as 10,20,30") from None


def _role_and_topic(text: str) -> tuple[str, str]:
    role, equals, topic = text.partition("=")
    if not (role and equals and topic):
        raise argparse.ArgumentTypeError(f"{text!r} is not ROLE=NAME such as imu=/imu/data")
    return role, topic


def _overrides(arguments: argparse.Namespace) -> dict[str, Any]:
    """What the command line says, in the shape of the configuration; what it leaves open is absent."""
    options = {
        "backend": arguments.backend,
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
