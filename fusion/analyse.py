"""Is this log good enough to run? ``python -m fusion.analyse LOG.mcap``: any MCAP, before a run or after."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from fusion_io.command import STANDARD_OUTPUT, answered, command_parser, role_and_topic, write_json, write_text
from fusion_io.errors import EXIT_DAMAGED, EXIT_FAILED, EXIT_OK
from fusion_io.words import counted

if TYPE_CHECKING:
    from rich.console import Console

    from fusion.analysis import Analysis
    from fusion.analysis_tables import PlainTable

WIDTH = 100  # where nobody watches
STYLES = {"ready": "bold green", "usable with limits": "bold yellow", "not usable": "bold red"}


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code."""
    arguments = parser().parse_args(argv)
    return answered(lambda: run(arguments.log, dict(arguments.topic or ()), arguments.json, arguments.html))


def run(log_path: Path, topics: dict[str, str], json_path: Path | None, html_path: Path | None) -> int:
    """Analyse one log, print or write what was found; returns the exit code.

    Raises LogError for a file that is no log or cannot be read, or an output that cannot be written.
    """
    from fusion.analysis import analyse, document

    analysis = analyse(log_path, topics)
    if html_path is not None:
        from fusion.analysis_page import page

        write_text(html_path, page(analysis))
    if json_path is not None:
        write_json(json_path, document(analysis))
    if json_path != STANDARD_OUTPUT:
        _print(analysis)
    if not analysis.usable:
        return EXIT_FAILED
    return EXIT_DAMAGED if analysis.damaged else EXIT_OK


def _print(analysis: Analysis) -> None:
    """The verdict with its reasons, and the tables."""
    from rich.console import Console
    from rich.text import Text

    from fusion.analysis_tables import tables
    from fusion.placement import placement

    console = Console(width=None if sys.stdout.isatty() else WIDTH)
    path = analysis.found.path
    console.print(Text(f"{path.name}: {analysis.answer}", style=STYLES[analysis.answer]))
    for reason in analysis.reasons:
        # Whoever reads it may copy a command from it: no line breaks of ours.
        console.print(Text(f"  {reason.level.name.lower()}: {reason.line(str(path))}"), soft_wrap=True)
    if (calibration := analysis.found.calibration) is not None and calibration.used:
        known = placement(calibration, None)
        console.print(Text(f"IMU by the pair estimates: {calibration.reason}; {known.summary}"))
    if analysis.revisits is not None:
        seen = analysis.revisits
        stretches = counted(seen.stretches, "stretch", "stretches")
        console.print(Text(f"Loop candidates by {seen.source}: {counted(seen.frames, 'frame')} in {stretches}"))
    for table in tables(analysis):
        _print_table(console, table)


def _print_table(console: Console, table: PlainTable) -> None:
    from rich import box
    from rich.table import Table
    from rich.text import Text

    drawn = Table(title=table.title, title_justify="left", box=box.SIMPLE_HEAD, pad_edge=False, padding=(0, 1, 0, 0))
    for i, heading in enumerate(table.headings):
        drawn.add_column(heading, justify="left" if i < table.words else "right", overflow="fold")
    for row in table.rows:
        drawn.add_row(*(Text(cell) for cell in row))
    console.print(drawn)


def parser() -> argparse.ArgumentParser:
    """The options of the command."""
    parser = command_parser(
        "fusion.analyse",
        "Say whether a log is good enough to run, and why: times, light, depth, noise, faults, results.",
        "Exit codes: as a run on it would have, 0 ready or usable with limits, 1 not usable or not readable, 2 usage, "
        "3 usable, but damaged.",
    )
    parser.add_argument("log", type=Path, metavar="LOG.mcap", help="any MCAP file, an input or an output")
    parser.add_argument(
        "--json", type=Path, metavar="OUT", help="write all of it as JSON; - prints it instead of the tables"
    )
    parser.add_argument("--html", type=Path, metavar="OUT", help="write it as one page that needs nothing else")
    parser.add_argument(
        "--topic",
        type=role_and_topic,
        action="append",
        metavar="ROLE=NAME",
        help="the topic of a role where the log leaves it open, as for fusion.run; may be repeated",
    )
    return parser


if __name__ == "__main__":
    sys.exit(main())
