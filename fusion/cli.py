"""All commands under one name: ``violearner run|convert|train|...``, the same as ``python -m fusion.run`` and so on."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from difflib import get_close_matches
from functools import cache
from importlib import import_module
from importlib.metadata import version
from typing import NoReturn

from fusion_io.command import answered, called_as
from fusion_io.errors import EXIT_OK, UsageError

COMMANDS = {
    "run": ("fusion.run", "a log in, absolute trajectories out"),
    "convert": ("fusion_io.convert", "make a log of a recording: KITTI, a folder of images, a published trajectory"),
    "analyse": ("fusion.analyse", "what is in a log, and whether it is good enough to run"),
    "compare": ("fusion.compare", "runs and trajectory files beside each other"),
    "replay": ("fusion.replay", "run the back ends again on what a run recorded, with other settings"),
    "paper": ("fusion.paper", "the paper's tables and figures from runs with ground truth"),
    "export": ("fusion.export", "time series as CSV or Parquet, everything as a rerun recording"),
    "train": ("learned.train", "train the network"),
    "adapt": ("learned.adapt", "adapt the network to the images of a log, without ground truth"),
    "evaluate": ("learned.evaluate", "errors and consistency of pair estimates"),
}
"""The commands: their modules, and what they do."""

SHELLS = ("bash", "zsh", "tcsh")


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit code of the command."""
    name, *arguments = (sys.argv[1:] if argv is None else argv) or ["--help"]
    return answered(lambda: run_command(name, arguments))


def run_command(name: str, arguments: Sequence[str]) -> int:
    """Run a command; raises UsageError, with the nearest name, where there is none of this name."""
    if name in {"-h", "--help"}:
        print(help_text())
        return EXIT_OK
    if name == "--version":
        print(f"violearner-fusion {version('violearner-fusion')}")
        return EXIT_OK
    if name == "completion":
        print(completion(arguments))
        return EXIT_OK
    if name not in COMMANDS:
        near = get_close_matches(name, [*COMMANDS, "completion"], n=1, cutoff=0.0)
        raise UsageError(f"there is no command {name!r}; did you mean {near[0]!r}? See violearner --help")
    with called_as(f"violearner {name}"):
        code: int = import_module(COMMANDS[name][0]).main(arguments)
    return code


def help_text() -> str:
    """What the commands are."""
    width = max(map(len, COMMANDS))
    listed = [f"  {name:{width}}  {purpose}" for name, (_, purpose) in COMMANDS.items()]
    return "\n".join(
        [
            "usage: violearner COMMAND [OPTIONS]",
            "",
            "Absolute trajectories one can trust, from RGB-D and IMU logs.",
            "",
            "commands:",
            *listed,
            "",
            "violearner COMMAND --help tells the options, violearner --version the version. Shell completion:",
            "  violearner completion bash > ~/.local/share/bash-completion/completions/violearner",
        ]
    )


# --- The parsers of the commands ----------------------------------------------------------------


# A command that makes the options of a subcommand only where that is named.
_ALL_OPTIONS = {"convert": ["simulate"]}


class _CaughtError(Exception):
    def __init__(self, parser: argparse.ArgumentParser) -> None:
        super().__init__()
        self.parser = parser


@cache
def parser_of(name: str) -> argparse.ArgumentParser:
    """The parser of a command, caught at the moment it would parse: what help, completion and documentation show."""
    from unittest.mock import patch  # slow to import

    def catch(self: argparse.ArgumentParser, *_: object, **__: object) -> NoReturn:
        raise _CaughtError(self)

    with patch.object(argparse.ArgumentParser, "parse_args", catch):
        try:
            import_module(COMMANDS[name][0]).main(_ALL_OPTIONS.get(name, []))
        except _CaughtError as caught:
            return caught.parser
    raise LookupError(f"{name} parses no arguments")


def completion(arguments: Sequence[str]) -> str:
    """A script for the shell that completes commands, options, choices and files.

    Raises UsageError for anything else than the name of one shell that is known.
    """
    import shtab

    if len(arguments) != 1 or arguments[0] not in SHELLS:
        raise UsageError(f"completion for which shell? {', '.join(SHELLS)}")
    parser = argparse.ArgumentParser(prog="violearner", add_help=False)
    commands = parser.add_subparsers()
    for name, (_, purpose) in COMMANDS.items():
        single = parser_of(name)
        _complete_files(single)
        commands.add_parser(name, parents=[single], add_help=False, help=purpose)
    commands.add_parser("completion", add_help=False).add_argument("shell", choices=SHELLS)
    return str(shtab.complete(parser, shell=arguments[0]))


def _complete_files(parser: argparse.ArgumentParser) -> None:
    import shtab

    for action in parser._actions:  # argparse has no public list of them
        if isinstance(action, argparse._SubParsersAction):
            for each in action.choices.values():
                _complete_files(each)
        elif getattr(action.type, "__name__", "") == "Path":
            action.complete = shtab.FILE  # type: ignore[attr-defined]  # how shtab is told


if __name__ == "__main__":
    sys.exit(main())
