"""Pair estimates against ground truth: `python -m learned.evaluate --log X.mcap --json OUT`."""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any


def main(arguments: list[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m learned.evaluate",
        description="Errors and consistency of the network's pair estimates on a log with ground truth.",
        epilog="Exit codes: 0 all well, 1 nothing could be computed, 2 usage, 3 computed from a damaged log.",
    )
    parser.add_argument("--log", type=Path, required=True, help="MCAP log with images, depth and ground truth")
    parser.add_argument("--weights", type=Path, help="weights file (default: those that ship with the package)")
    parser.add_argument("--json", type=Path, help="write the figures to this file")
    options = parser.parse_args(arguments)

    from fusion_io.errors import EXIT_DAMAGED, EXIT_FAILED, EXIT_OK, FusionError

    try:
        figures, damaged = evaluate(options.log, options.weights)
    except FusionError as error:
        print(f"error: {error}", file=sys.stderr)
        return EXIT_FAILED
    if options.json is not None:
        options.json.write_text(json.dumps(figures, indent=2) + "\n")
    show(figures)
    return EXIT_DAMAGED if damaged else EXIT_OK


def evaluate(path: Path, weights: Path | None = None) -> tuple[dict[str, Any], bool]:
    """The figures of a log, and whether it was damaged.

    Raises LogError where there is no ground truth, or no pair that it spans.
    """
    from collections import Counter

    import numpy as np

    from fusion_io.errors import LogError
    from fusion_io.progress import track
    from fusion_io.reader import open_log
    from learned import weights as weights_file
    from learned.covariance import mean_nees, pose_errors
    from learned.estimator import infer
    from learned.scores import hypothesis_matrices, mean_motion, score

    log = open_log(path)
    truth = log.ground_truth()
    if truth is None:
        raise LogError(f"{path}: no ground truth to evaluate against")
    imu, stamps = log.imu(), log.frame_stamps()
    model, covariance = weights_file.load(weights)
    skipped: Counter[str] = Counter()
    start = time.perf_counter()
    frames = track(log.frames(), "estimate", len(stamps))
    inferences = list(infer(model, covariance, iter(frames), stamps, imu, skipped))
    seconds = time.perf_counter() - start
    for name, count in [*log.warnings.items(), *skipped.items()]:
        print(f"warning: {path}: {name} {count}", file=sys.stderr)

    first_ns, last_ns = truth.stamps_ns[[0, -1]]
    spanned = [i for i in inferences if first_ns <= i.pair.source_stamp_ns and i.pair.target_stamp_ns <= last_ns]
    if not spanned:
        raise LogError(f"{path}: none of its {len(inferences)} estimated pairs lies within the ground truth's stamps")
    T_world_source = truth.at(np.array([i.pair.source_stamp_ns for i in spanned]))
    T_world_target = truth.at(np.array([i.pair.target_stamp_ns for i in spanned]))
    true = (T_world_source.inv() * T_world_target).as_matrix()
    levels = np.stack([i.levels for i in spanned])
    hypotheses = np.stack([hypothesis_matrices(i.pair) for i in spanned])
    final = score("final", levels[:, -1], true)
    still, mean = np.broadcast_to(np.eye(4), true.shape), np.broadcast_to(mean_motion(true), true.shape)
    figures = {
        "pairs": len(spanned),
        "translation_rmse_m": final["translation_rmse_m"],
        "rotation_rmse_rad": final["rotation_rmse_rad"],
        "anees": mean_nees(pose_errors(levels[:, -1], true), np.stack([i.pair.covariance for i in spanned])),
        "by_level": [score(f"level {k}", levels[:, k], true) for k in range(levels.shape[1])],
        "by_hypothesis": [score(f"hypothesis {k}", hypotheses[:, k], true) for k in range(hypotheses.shape[1])],
        "baselines": [score("zero motion", still, true), score("mean motion", mean, true)],
        "pairs_per_second": len(inferences) / seconds,
        "skipped": dict(skipped),
    }
    return figures, log.damaged


def show(figures: dict[str, Any]) -> None:
    """Print the figures as one table."""
    from rich.console import Console
    from rich.table import Table

    table = Table(title=f"{figures['pairs']} pairs, {figures['pairs_per_second']:.1f} pairs/s")
    table.add_column("estimate")
    table.add_column("translation RMSE (m)", justify="right")
    table.add_column("rotation RMSE (mrad)", justify="right")
    for group in ("baselines", "by_level", "by_hypothesis"):
        for row in figures[group]:
            table.add_row(row["name"], f"{row['translation_rmse_m']:.4f}", f"{1e3 * row['rotation_rmse_rad']:.2f}")
        table.add_section()
    table.add_row("final", f"{figures['translation_rmse_m']:.4f}", f"{1e3 * figures['rotation_rmse_rad']:.2f}")
    Console().print(table)
    print(f"ANEES {figures['anees']:.2f} (6 is right)")


if __name__ == "__main__":
    sys.exit(main())
