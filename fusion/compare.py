"""Runs and trajectories beside each other: ``python -m fusion.compare A.mcap B.mcap``."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, TextIO

from fusion_io.command import STANDARD_OUTPUT, answered, command_parser, write_json, write_text
from fusion_io.errors import EXIT_DAMAGED, EXIT_DIFFERS, EXIT_OK

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    from fusion.comparison import Comparison, Duel
    from fusion.evaluation import Metrics

# Modules that bring numpy are imported by the function that needs them, so that --help answers at once.

WIDTH = 100  # where nobody watches
SAME_PERCENT = 0.005  # less is not seen in the table

_MEASURES = {"t_rel_percent": "t_rel (%)", "r_rel_deg_per_100m": "r_rel (deg/100 m)"}

# Measure, heading, unit, decimals, factor.
_COLUMNS = (
    ("t_rel_percent", "t_rel", "%", 3, 1.0),
    ("r_rel_deg_per_100m", "r_rel", "deg/100m", 3, 1.0),
    ("ate_m", "ATE", "m", 2, 1.0),
    ("end_error_m", "end", "m", 2, 1.0),
    ("rpe_translation_m", "RPE", "m", 4, 1.0),
    ("rpe_rotation_rad", "RPE", "mrad", 2, 1e3),
    ("anees_position", "ANEES", "position", 1, 1.0),
    ("anees_orientation", "ANEES", "orient.", 1, 1.0),
)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    arguments = _parser().parse_args(argv)
    return answered(lambda: run(arguments))


def run(arguments: argparse.Namespace) -> int:
    """Read, compare, show, and judge by the conditions; returns the exit code."""
    from fusion import comparison, conditions, results

    parsed = [conditions.parse(text) for text in arguments.fail_if]
    inputs, truth = results.read_results(arguments.inputs, arguments.names, arguments.times, arguments.ground_truth)
    compared = comparison.compare(inputs, truth, arguments.segment_lengths)
    for condition in parsed:
        condition.check_names(compared.measures)

    for note in compared.notes:
        print(f"warning: {note}", file=sys.stderr)
    if arguments.html is not None:
        from fusion.comparison_page import page

        write_text(arguments.html, page(compared))
    met = [condition.text for condition in parsed if condition.holds(compared.measures)]
    if arguments.json is not None:
        write_json(arguments.json, comparison.document(compared) | {"met": met})
    show(compared, sys.stderr if arguments.json == STANDARD_OUTPUT else sys.stdout)
    for text in met:
        print(f"failed: {text}", file=sys.stderr)
    if met:
        return EXIT_DIFFERS
    return EXIT_DAMAGED if any(result.damaged for result in inputs) else EXIT_OK


def show(compared: Comparison, stream: TextIO) -> None:
    """Print the measures of all, the differences with their intervals, and where one is better than the other."""
    from rich.console import Console

    console = Console(file=stream, width=None if stream.isatty() else WIDTH)
    console.print(measures_table(compared))
    if compared.duels:
        console.print(differences_table(compared))
        for duel in compared.duels:
            console.print(where(duel), highlight=False)
    if compared.deviations:
        console.print(deviations_table(compared))
    _legend(console, compared)


def measures_table(compared: Comparison) -> Table:
    """A row for every trajectory; the best value of every measure in bold."""
    from rich.text import Text

    from fusion.comparison import contestants

    table = _table("Against the ground truth" if _has_truth(compared) else "No ground truth: nothing is measured")
    table.add_column("")
    table.add_column("")
    shown = [column for column in _COLUMNS if any(_value(each, column[0]) is not None for each in _all(compared))]
    best = {key: compared.best(key) for key, *_ in shown}
    for _, heading, unit, _, _ in shown:
        table.add_column(f"{heading}\n{unit}", justify="right", no_wrap=True)
    for result in compared.results:
        for each in contestants(result):
            metrics = compared.metrics[each.name]
            cells = [
                _cell(_value(metrics, key), decimals, factor, best=each.name in best[key])
                for key, _, _, decimals, factor in shown
            ]
            table.add_row(Text(f"{result.key}  {result.label}"), _heading(each.trajectory), *cells)
        table.add_section()
    return table


def differences_table(compared: Comparison) -> Table:
    """A row for every pair of trajectories: how much larger the errors of the second are, and whether that is noise."""
    table = _table("Differences, with their 95 % confidence intervals")
    table.add_column("")  # names that are long wrap, and nothing is cut
    table.add_column("", no_wrap=True)
    table.add_column("mean", justify="right", no_wrap=True)
    table.add_column("interval", no_wrap=True)
    table.add_column("", no_wrap=True)
    for duel in compared.duels:
        name = f"{duel.b.name} - {duel.a.name}"
        for measure, difference in duel.differences.items():
            interval = "" if difference.low is None else f"{difference.low:+.3f} to {difference.high:+.3f}"
            table.add_row(name, _MEASURES[measure], f"{difference.mean:+.3f}", interval, difference.verdict)
            name = ""
    return table


def deviations_table(compared: Comparison) -> Table:
    """How far trajectories are from each other where nobody knows the truth."""
    table = _table("Distance between trajectories")
    table.add_column("")
    for heading in ("t_rel\n%", "r_rel\ndeg/100m", "ATE\nm", "end\nm"):
        table.add_column(heading, justify="right", no_wrap=True)
    for each in compared.deviations:
        measures = each.measures
        values = (measures.t_rel_percent, measures.r_rel_deg_per_100m, measures.ate_m, measures.end_error_m)
        table.add_row(f"{each.b.name} - {each.a.name}", *(_cell(value, 3, 1.0) for value in values))
    return table


def where(duel: Duel) -> str:
    """On how much of the path the second is better, and where the two differ most."""
    stretches = duel.stretches
    if not stretches:
        return f"{duel.b.name} against {duel.a.name}: the path is shorter than the shortest segment"
    difference = [each.difference("t_rel_percent") for each in stretches]
    if max(map(abs, difference)) < SAME_PERCENT:
        return f"{duel.b.name} has the translation error of {duel.a.name} all along the path"
    better = sum(value < 0.0 for value in difference)
    places = [
        f"{words} at {stretches[difference.index(value)].start_m:.0f}-{stretches[difference.index(value)].end_m:.0f} m "
        f"({value:+.2f} %)"
        for words, value in (("best", min(difference)), ("worst", max(difference)))
    ]
    ahead = f"{duel.b.name} has less translation error than {duel.a.name} on {better} of {len(stretches)} stretches"
    return f"{ahead}; {', '.join(places)}"


def _table(title: str) -> Table:
    from rich import box
    from rich.table import Table

    return Table(title=title, title_justify="left", title_style="", box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0))


def _all(compared: Comparison) -> list[Metrics]:
    return list(compared.metrics.values())


def _has_truth(compared: Comparison) -> bool:
    return any(metrics.ate_m is not None for metrics in _all(compared))


def _value(metrics: Metrics, key: str) -> float | None:
    value: float | None = getattr(metrics, key)
    return value


def _cell(value: float | None, decimals: int, factor: float, best: bool = False) -> Text:
    from rich.text import Text

    if value is None:
        return Text("-")
    value *= factor
    return Text(f"{value:.{decimals}f}" if abs(value) < 1e4 else f"{value:.1e}", style="bold" if best else "")


def _heading(name: str) -> str:
    from fusion.table import HEADINGS

    return HEADINGS.get(name, name)


def _legend(console: Console, compared: Comparison) -> None:
    if _has_truth(compared):
        from fusion.table import RULE

        lines = [RULE]
        if compared.duels:
            lines.append("Differences are paired over segments: negative where the second has the smaller error.")
    else:
        lines = ["No ground truth: give --ground-truth FILE to learn which is better."]
    console.print(" ".join(lines))


_EPILOG = """\
examples:
  python -m fusion.compare runs/before runs/after --html compared.html
  python -m fusion.compare runs/09 orbslam.tum --names ours,ORB-SLAM2
  python -m fusion.compare main.mcap branch.mcap --fail-if "b.posegraph.ate_m > 1.05 * a.posegraph.ate_m"

Differences are paired over segments, with 95 % confidence intervals that allow for their overlap.

exit codes: 0 all well, 1 nothing could be compared, 2 usage, 3 compared from a damaged log,
4 a condition of --fail-if is true, 130 interrupted"""


def _parser() -> argparse.ArgumentParser:
    parser = command_parser(
        "fusion.compare",
        "Compare any number of runs and trajectories: which is better, where, and beyond the noise or not.",
        _EPILOG,
    )
    parser.add_argument(
        "inputs",
        type=Path,
        nargs="+",
        metavar="INPUT",
        help="run.mcap or the folder of a run, an MCAP log with odometry or poses, or a trajectory file (TUM, KITTI, "
        "EuRoC); all of the same body on the same drive. Conditions call them a, b, ... in this order",
    )
    parser.add_argument("--names", type=label_list, default=[], metavar="A,B,...", help="what tables call the inputs")
    parser.add_argument(
        "--ground-truth",
        type=Path,
        metavar="FILE",
        help="true poses: a log or a trajectory file (default: those in the inputs; without any, the inputs are only "
        "compared with each other)",
    )
    parser.add_argument(
        "--times",
        type=Path,
        metavar="FILE",
        help="stamps of the frames of KITTI files in seconds, one a line (default: those of an input with as many "
        "poses)",
    )
    parser.add_argument(
        "--segment-lengths",
        type=length_list,
        metavar="M,M,...",
        help="path lengths of t_rel and r_rel in metres (default: those of the first run, else KITTI's 100,...,800)",
    )
    parser.add_argument("--html", type=Path, metavar="FILE", help="write a page to look at")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures; - is stdout")
    parser.add_argument(
        "--fail-if",
        action="append",
        default=[],
        metavar="CONDITION",
        help="end with exit code 4 where this is true; measures are named as in metrics.json: a.raw.ate_m, "
        "b.posegraph.t_rel_percent; those of a trajectory file a.trajectory.ate_m. May be repeated",
    )
    return parser


def label_list(text: str) -> list[str]:
    """Words between commas, as an argument."""
    return [word.strip() for word in text.split(",")]


def length_list(text: str) -> list[float]:
    """Lengths in metres between commas, as an argument."""
    try:
        lengths = [float(word) for word in text.split(",")]
    except ValueError:
        lengths = []
    if not lengths or not all(0.0 < length < float("inf") for length in lengths):
        raise argparse.ArgumentTypeError(f"{text!r} is not a list of lengths such as 10,20,30")
    return lengths


if __name__ == "__main__":
    sys.exit(main())
