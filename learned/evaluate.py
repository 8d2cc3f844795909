"""Pair estimates against ground truth: `python -m learned.evaluate --log X.mcap --json OUT`."""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter, process_time
from typing import TYPE_CHECKING, Any, NamedTuple, TextIO

from fusion_io.command import STANDARD_OUTPUT, answered, command_parser, write_json
from fusion_io.errors import EXIT_DAMAGED, EXIT_OK, LogError, UsageError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray
    from rich.table import Table

    from fusion_io.reader import Log
    from fusion_io.records import CameraFrame, FloatArray
    from learned.comparison import Comparison
    from learned.estimator import Inference

# Modules that bring numpy or torch are imported by the function that needs them, so that --help answers at once.

SENTENCES = {
    "pairs_over_missing_frames": "no estimate for {} of frames with others missing between them",
    "pairs_without_depth": "no estimate for {} whose source has no depth",
    "pairs_not_refined": "the network's own estimate stands for {} for which refinement found no lower error",
}
"""What the counts of `learned.estimator` mean."""

TIMED = ("seconds_per_pair", "cpu_seconds_per_pair")


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = command_parser(
        "learned.evaluate",
        description="Errors and consistency of pair estimates on a log with ground truth.",
        epilog="Exit codes: 0 all well, 1 nothing could be computed, 2 usage, 3 computed from a damaged log.",
    )
    parser.add_argument(
        "--log", type=Path, required=True, metavar="FILE.mcap", help="a log with images, depth and ground truth"
    )
    parser.add_argument("--weights", type=Path, metavar="FILE", help="the network's weights (default: those shipped)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures; - is stdout")
    parser.add_argument("--plots", type=Path, metavar="DIR", help="draw them into this folder")
    parser.add_argument(
        "--baselines",
        action="store_true",
        help="also run classical RGB-D odometry on the same pairs, and time it beside the network",
    )
    options = parser.parse_args(arguments)
    return answered(lambda: run(options))


def run(options: argparse.Namespace) -> int:
    """Evaluate, show and write what was asked for; returns the exit code."""
    prepare_outputs(options.json, options.plots)
    evaluation = evaluate(options.log, options.weights, options.baselines)
    for note in evaluation.notes:
        print(f"warning: {note}", file=sys.stderr)
    if options.json is not None:
        write_json(options.json, evaluation.figures)
    if options.plots is not None:
        from learned.plots import write_plots

        write_plots(options.plots, evaluation.comparison, options.log.name)
    show(evaluation.figures, options.log.name, sys.stderr if options.json == STANDARD_OUTPUT else sys.stdout)
    return EXIT_DAMAGED if evaluation.damaged else EXIT_OK


def prepare_outputs(figures: Path | None, plots: Path | None) -> None:
    """Make sure, before time is spent, that results can be written; raises UsageError otherwise."""
    try:
        if figures is not None and figures != STANDARD_OUTPUT:
            figures.parent.mkdir(parents=True, exist_ok=True)
            existed = figures.exists()
            figures.open("a").close()
            if not existed:
                figures.unlink()
        if plots is not None:
            plots.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UsageError(f"{error.filename}: {error.strerror}") from None


@dataclass(frozen=True)
class Evaluation:
    """Figures for a JSON file, the pairs that they are of, a sentence for all that was amiss, whether data was lost."""

    figures: dict[str, Any]
    comparison: Comparison
    notes: list[str]
    damaged: bool


def evaluate(path: Path, weights: Path | None = None, baselines: bool = False) -> Evaluation:
    """Estimate the pairs of a log and judge them by its ground truth.

    Raises LogError where there is no ground truth, or no pair that it spans.
    """
    from fusion_io.progress import track
    from fusion_io.reader import open_log
    from learned import weights as weights_file
    from learned.comparison import compare, figures
    from learned.estimator import infer
    from learned.scores import agreement, score

    log = open_log(path)
    truth = log.ground_truth()
    if truth is None:
        raise LogError(f"{path}: no ground truth to evaluate against")
    loaded, imu, stamps = weights_file.load(weights), log.imu(), log.frame_stamps()
    skipped: Counter[str] = Counter()

    def timed(doing: str, refined: bool, counts: Counter[str]) -> tuple[list[Inference], dict[str, float]]:
        """All pairs, and the seconds a pair of streaming them from the log."""
        clock = Clock()
        frames = track(log.frames(), doing, len(stamps))
        inferences = list(infer(loaded, iter(frames), stamps, imu, counts, refined))
        return inferences, clock.per_item(len(inferences))

    refined, seconds = timed("estimate", True, skipped)
    alone, seconds_alone = timed("estimate with the network alone", False, Counter())
    try:
        comparison = compare(alone, refined, truth)
    except LogError as error:
        raise LogError(f"{path}: {error}") from None

    found = figures(comparison)
    if len(imu):
        found["baselines"].append({**score("IMU only (level 0)", comparison.levels[:, 0], comparison.truth)})
    if baselines:
        found["refined"] |= seconds
        found["network"] |= seconds_alone
        classical = classical_odometry(log, comparison)
        found["baselines"].append(classical.figures)
        kept = classical.found
        found["agreement"] = (
            agreement(comparison.refined.T_source_target[kept], classical.T_source_target[kept], comparison.truth[kept])
            if kept.any()
            else None
        )
        found["threads"] = threads()
    found |= {"pairs_per_second": 1 / seconds["seconds_per_pair"], "skipped": {k: n for k, n in skipped.items() if n}}
    return Evaluation(found, comparison, [*log.notes, *sentences(path, skipped)], log.damaged)


class Clock:
    """Wall and processor time since it was made; the latter does not depend on what else the machine does."""

    def __init__(self) -> None:
        self._start = perf_counter(), process_time()

    def per_item(self, count: int) -> dict[str, float]:
        """Seconds of both for each of `count` items."""
        spent = perf_counter() - self._start[0], process_time() - self._start[1]
        return {name: seconds / max(count, 1) for name, seconds in zip(TIMED, spent, strict=True)}


class Classical(NamedTuple):
    """Poses (N, 4, 4) of classical RGB-D odometry, which of them (N,) it found; errors, failures and seconds a pair."""

    T_source_target: FloatArray
    found: NDArray[np.bool_]
    figures: dict[str, Any]


def classical_odometry(log: Log, comparison: Comparison) -> Classical:
    """Classical RGB-D odometry on the same pairs, at the images' own resolution.

    A pair where it fails counts with the motion of the pair before, as a tracker would go on.
    """
    import numpy as np

    from fusion_io.progress import track
    from learned.scores import score

    clock = Clock()
    frames = track(log.frames(), "classical RGB-D odometry", len(log.frame_stamps()))
    motions = classical_motions(frames, set(map(tuple, comparison.stamps_ns.tolist())))
    seconds = clock.per_item(len(comparison))
    estimates, found, before = [], [], np.eye(4)
    for stamps in comparison.stamps_ns.tolist():
        motion = motions.get(tuple(stamps))
        found.append(motion is not None)
        before = before if motion is None else motion
        estimates.append(before)
    result = score("classical RGB-D odometry", np.stack(estimates), comparison.truth)
    return Classical(np.stack(estimates), np.array(found), {**result, "failures": found.count(False), **seconds})


def classical_motions(
    frames: Iterable[CameraFrame], pairs: set[tuple[int, ...]]
) -> dict[tuple[int, ...], FloatArray | None]:
    """T_source_target (4, 4) of pairs given by the stamps of consecutive frames, None where the odometry fails."""
    from learned.baselines import rgbd_odometry

    motions: dict[tuple[int, ...], FloatArray | None] = {}
    previous: CameraFrame | None = None
    for frame in frames:
        if previous is not None and (stamps := (previous.stamp_ns, frame.stamp_ns)) in pairs:
            motion = rgbd_odometry(previous, frame)
            motions[stamps] = None if motion is None else motion.T_source_target
        previous = frame
    return motions


def threads() -> dict[str, int]:
    """How many threads each library was allowed."""
    import cv2
    import torch

    return {"torch": torch.get_num_threads(), "opencv": cv2.getNumThreads()}


def sentences(path: Path, skipped: Mapping[str, int]) -> Iterator[str]:
    """A sentence for every count of the estimator."""
    for name, count in skipped.items():
        if count:
            pairs = "1 pair" if count == 1 else f"{count} pairs"
            yield f"{path}: {SENTENCES[name].format(pairs)}"


def show(figures: Mapping[str, Any], log_name: str, stream: TextIO) -> None:
    """Print errors and consistency as tables."""
    from rich.console import Console

    console = Console(file=stream, width=None if stream.isatty() else 100)
    console.print(error_table(figures, log_name))
    if "threads" in figures:
        console.print(baseline_table(figures))
    console.print(consistency_table(figures))


def error_table(figures: Mapping[str, Any], log_name: str) -> Table:
    """Errors of constant motions, levels, hypotheses, and of the network as a whole."""
    table = score_table(f"{log_name}: {figures['pairs']} pairs, {figures['pairs_per_second']:.1f} a second")
    constant = [row for row in figures["baselines"] if row["name"] in ("zero motion", "mean motion")]
    named = [{**row, "name": f"{row['name']}, won {row['wins']}"} for row in figures["by_hypothesis"]]
    hypotheses = [*named, figures["mean_of_hypotheses"], figures["best_hypothesis"]]
    for group in (constant, figures["by_level"], hypotheses, stages(figures)):
        for row in group:
            table.add_row(*score_cells(row))
        table.add_section()
    return table


def baseline_table(figures: Mapping[str, Any]) -> Table:
    """The network beside simpler estimators, with times."""
    table = score_table("Baselines on the same pairs")
    for heading in ("failed", "elapsed\n(ms)", "CPU\n(ms)"):
        table.add_column(heading, justify="right")
    for row in (*figures["baselines"], *stages(figures)):
        times = [f"{1e3 * row[name]:.0f}" if name in row else "" for name in TIMED]
        table.add_row(*score_cells(row), str(row.get("failures", "")), *times)
    used = figures["threads"]
    table.caption = (
        f"Times are for a pair, of streaming the log, decoding included; torch has {used['torch']} threads, OpenCV "
        f"{used['opencv']}; CPU is the sum of all threads."
    )
    if agreement := figures["agreement"]:
        table.caption += (
            f" The refined and the classical estimates are {agreement['apart_translation_m']:.4f} m and "
            f"{1e3 * agreement['apart_rotation_rad']:.2f} mrad apart; {agreement['shared_translation_m']:.4f} m and "
            f"{1e3 * agreement['shared_rotation_rad']:.2f} mrad of their errors are common to both, and so those of "
            "ground truth, calibration or time stamps."
        )
    return table


def stages(figures: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The network alone and with refinement, as rows."""
    refined = f"refined ({figures['pairs_refined']} of {figures['pairs']})"
    return [{**figures["network"], "name": "network alone, the winner"}, {**figures["refined"], "name": refined}]


def score_table(title: str) -> Table:
    """An empty table for `score_cells`."""
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    table = Table(title=title, box=SIMPLE_HEAD)
    table.add_column("estimate", no_wrap=True)
    for heading in ("translation\nRMSE (m)", "median\n(m)", "rotation\nRMSE (mrad)", "median\n(mrad)"):
        table.add_column(heading, justify="right")
    return table


def score_cells(row: Mapping[str, Any]) -> list[str]:
    """Name and errors of a `learned.scores.Score`."""
    metres = [f"{row[name]:.4f}" for name in ("translation_rmse_m", "translation_median_m")]
    milliradians = [f"{1e3 * row[name]:.2f}" for name in ("rotation_rmse_rad", "rotation_median_rad")]
    return [row["name"], *metres, *milliradians]


def consistency_table(figures: Mapping[str, Any]) -> Table:
    """Whether errors are as large as their covariances say, beside what is right."""
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    from learned.calibration import AXES, NOMINAL

    table = Table(title="Stated covariances against errors", box=SIMPLE_HEAD)
    table.add_column("measure", no_wrap=True)
    for heading in ("right", "network", "refined"):
        table.add_column(heading, justify="right")
    both = [figures["network"], figures["refined"]]

    def add(label: str, right: str, values: Iterable[float | None], digits: int = 2) -> None:
        table.add_row(label, right, *("-" if value is None else f"{value:.{digits}f}" for value in values))

    add("ANEES, 6 dof", "6", [stage["anees"] for stage in both])
    for percent in (round(100 * p) for p in NOMINAL):
        add(f"coverage of {percent} % (%)", str(percent), [100 * stage[f"coverage_{percent}"] for stage in both], 1)
    add("negative log likelihood (nats a pair)", "low", [stage["nll"] for stage in both])
    add("  of the best constant covariance", "", [stage["nll_constant"] for stage in both])
    table.add_section()
    for axis in AXES:
        label = f"rank correlation of sigma and error, {axis.replace('_', ' ')}"
        add(label, "high", [stage["rank_correlation"][axis] for stage in both])
    return table


if __name__ == "__main__":
    sys.exit(main())
