"""The tables and figures of the VIOLearner paper from runs: ``python -m fusion.paper RUN.mcap ... --out DIR``.

Quartiles of the error by segment length (its Table II), t_rel and r_rel by sequence (Tables I and III), trajectories
beside the ground truth (Figure 3). Error by level (Figure 4) needs the network at work and comes from
``python -m learned.evaluate --log LOG --plots DIR``.

The paper's Table II names no unit. Its figures grow with the length as metres do (12.33 over 500 m where the sequence
has 2.04 %), so metres stand first here, and percent beside them.
"""

from __future__ import annotations

import argparse
import csv
import sys
from collections.abc import Iterator, Sequence
from io import StringIO
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from fusion.compare import label_list, length_list
from fusion_io.command import answered, command_parser, write_text
from fusion_io.errors import EXIT_DAMAGED, EXIT_OK, LogError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from fusion.results import Result

# Modules that bring numpy are imported by the function that needs them, so that --help answers at once.

LENGTHS_M = (100.0, 200.0, 300.0, 400.0, 500.0)
"""Of the quartile table; those of the sequence table are KITTI's."""


QUARTILES_OF = ("translation (m)", "translation (%)", "rotation (deg/100 m)")


class Table(NamedTuple):
    """A table of words and numbers; None where there is nothing to say."""

    title: str
    heads: Sequence[str]
    rows: Sequence[Sequence[str | float | int | None]]

    def markdown(self) -> str:
        """For a document."""
        lines = [self.heads, ["---"] * len(self.heads), *(tuple(map(_word, row)) for row in self.rows)]
        return f"{self.title}\n\n" + "".join(f"| {' | '.join(line)} |\n" for line in lines)

    def csv(self) -> str:
        """For a program: all digits."""
        text = StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerows([self.heads, *self.rows])
        return text.getvalue()


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    arguments = _parser().parse_args(argv)
    return answered(lambda: run(arguments))


def run(arguments: argparse.Namespace) -> int:
    """Read the runs, print the tables and write them with the figures; returns the exit code."""
    from fusion.results import read_results

    results, _ = read_results(arguments.runs, arguments.names)
    for result in results:
        if result.ground_truth is None or "raw" not in result.trajectories:
            raise LogError(f"{result.path}: not the log of a run with ground truth")
        for note in result.notes:
            print(f"warning: {note}", file=sys.stderr)
    lengths = arguments.lengths or LENGTHS_M
    tables = {"sequences": sequence_table(results, arguments.lengths), "quartiles": quartile_table(results, lengths)}
    print("\n".join(table.markdown() for table in tables.values()), end="")
    if arguments.out is not None:
        for name, table in tables.items():
            write_text(arguments.out / f"{name}.md", table.markdown())
            write_text(arguments.out / f"{name}.csv", table.csv())
        for result in results:
            save(trajectories_figure(result), arguments.out / f"trajectories-{result.key}.png")
            save(quartile_figure(result, lengths), arguments.out / f"quartiles-{result.key}.png")
    return EXIT_DAMAGED if any(result.damaged for result in results) else EXIT_OK


def sequence_table(results: Sequence[Result], lengths_m: Sequence[float] | None = None) -> Table:
    """t_rel and r_rel of every run, over KITTI's segments unless lengths are given: a column for each trajectory."""
    from fusion.evaluation import KITTI_SEGMENT_LENGTHS_M, evaluate
    from fusion.table import HEADINGS

    lengths_m = tuple(lengths_m or KITTI_SEGMENT_LENGTHS_M)
    names = list(dict.fromkeys(name for result in results for name in result.trajectories))
    rows = []
    for result in results:
        row: list[str | float | int | None] = [result.label]
        for name in names:
            trajectory = result.trajectories.get(name)
            metrics = None if trajectory is None else evaluate(trajectory, result.ground_truth, lengths_m)
            row += [None, None] if metrics is None else [metrics.t_rel_percent, metrics.r_rel_deg_per_100m]
        rows.append(row)
    heads = [
        f"{HEADINGS.get(name, name)}, {measure}" for name in names for measure in ("t_rel (%)", "r_rel (deg/100 m)")
    ]
    return Table(f"Mean errors over segments of {_range(lengths_m)}", ["sequence", *heads], rows)


def quartile_table(results: Sequence[Result], lengths_m: Sequence[float] = LENGTHS_M) -> Table:
    """Median, first and third quartile of translation and rotation errors by segment length."""
    from fusion.table import HEADINGS

    rows = [
        [result.label, HEADINGS.get(name, name), *row]
        for result in results
        for name in result.trajectories
        for row in quartiles(result, name, lengths_m)
    ]
    parts = ("median", "1st quartile", "3rd quartile")
    heads = [f"{error}, {part}" for error in QUARTILES_OF for part in parts]
    return Table("Errors by segment length", ["sequence", "trajectory", "length (m)", "segments", *heads], rows)


def quartiles(result: Result, name: str, lengths_m: Sequence[float]) -> Iterator[list[float | int | None]]:
    """For each length that the path holds: it, the number of segments, and median, 1st and 3rd quartile of each error.

    The errors are those of QUARTILES_OF.
    """
    import numpy as np

    from fusion.evaluation import common, segment_errors

    assert result.ground_truth is not None
    estimate, truth = common(result.trajectories[name], result.ground_truth)
    if len(estimate) < 2:
        return
    errors = segment_errors(estimate.poses, truth.poses, lengths_m)
    for length in lengths_m:
        chosen = errors.length_m == length
        if chosen.any():
            percent, deg_per_100m = errors.translation_percent[chosen], errors.rotation_deg_per_100m[chosen]
            of_length = (percent / 100.0 * length, percent, deg_per_100m)
            parts = np.concatenate([np.quantile(each, [0.5, 0.25, 0.75]) for each in of_length])
            yield [length, int(chosen.sum()), *parts.tolist()]


def trajectories_figure(result: Result) -> Figure:
    """The trajectories of a run from above beside the ground truth."""
    from fusion.plots import STYLES, plot_trajectories

    drawn = {name: trajectory for name, trajectory in result.trajectories.items() if name in STYLES}
    return plot_trajectories(result.label, drawn, result.ground_truth)


def quartile_figure(result: Result, lengths_m: Sequence[float] = LENGTHS_M) -> Figure:
    """Medians of translation and rotation errors by segment length, with bars from first to third quartile."""
    import numpy as np
    from matplotlib.figure import Figure

    from fusion.plots import STYLES

    figure = Figure(figsize=(9, 4.2), dpi=120, layout="constrained")
    both = figure.subplots(1, 2)
    count = len(result.trajectories)
    for k, name in enumerate(result.trajectories):
        found = np.array(list(quartiles(result, name, lengths_m)), dtype=np.float64).reshape(-1, 11)
        style = {key: value for key, value in STYLES.get(name, {"label": name}).items() if key in {"label", "color"}}
        for axes, (median, first, third) in zip(both, (found[:, 2:5].T, found[:, 8:11].T), strict=True):
            place = np.arange(len(found)) + (k - (count - 1) / 2) / (count + 1)
            axes.errorbar(place, median, yerr=[median - first, third - median], fmt="o", capsize=3, **style)
            axes.set_xticks(np.arange(len(found)), [f"{length:g}" for length in found[:, 0]])
    for axes, unit in zip(both, ("translation error [m]", "rotation error [deg/100 m]"), strict=True):
        axes.set(xlabel="segment length [m]", ylabel=unit)
        axes.set_ylim(bottom=0.0)
        axes.grid(axis="y", alpha=0.3)
    figure.suptitle(f"{result.label}: medians and quartiles by segment length")
    figure.legend(*both[0].get_legend_handles_labels(), loc="outside lower center", ncols=max(count, 1))
    return figure


def save(figure: Figure, path: Path) -> None:
    """Write a figure as PNG; raises LogError where that is impossible."""
    try:
        figure.savefig(path, format="png")
    except OSError as error:
        raise LogError(f"{path}: {error.strerror}") from None


def _word(value: str | float | int | None) -> str:
    if value is None:
        return "-"
    if isinstance(value, float) and not value.is_integer():
        return f"{value:.2f}"
    return value if isinstance(value, str) else f"{value:g}"


def _range(lengths_m: Sequence[float]) -> str:
    return f"{min(lengths_m):g} to {max(lengths_m):g} m"


_EPILOG = """\
examples:
  python -m fusion.paper runs/09 runs/10 --names 09,10 --out paper
  python -m learned.evaluate --log drive.mcap --plots paper    (error by level, from a log with images)

exit codes: 0 all well, 1 nothing could be computed, 2 usage, 3 computed from a damaged log,
130 interrupted"""


def _parser() -> argparse.ArgumentParser:
    parser = command_parser(
        "fusion.paper",
        "The tables and figures of the VIOLearner paper from runs with ground truth: t_rel and r_rel by "
        "sequence, quartiles by segment length, trajectories from above.",
        _EPILOG,
    )
    parser.add_argument("runs", type=Path, nargs="+", metavar="RUN.mcap", help="logs of runs, or the runs' folders")
    parser.add_argument("--names", type=label_list, default=[], metavar="A,B,...", help="what the tables call the runs")
    parser.add_argument(
        "--lengths",
        type=length_list,
        metavar="M,M,...",
        help="segment lengths of both tables in metres (default: 100,...,500 for quartiles, KITTI's 100,...,800 for "
        "means)",
    )
    parser.add_argument("--out", type=Path, metavar="DIR", help="write the tables (Markdown, CSV) and figures (PNG)")
    return parser


if __name__ == "__main__":
    sys.exit(main())
