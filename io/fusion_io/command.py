"""What the commands have in common: errors as one line and an exit code, arguments, and output to files or a pipe."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import Any

from fusion_io.errors import EXIT_FAILED, EXIT_INTERRUPTED, EXIT_USAGE, FusionError, LogError, UsageError

STANDARD_OUTPUT = Path("-")
"""What a pipe is called where a file is asked for."""

_called_as: ContextVar[str | None] = ContextVar("called_as", default=None)


@contextmanager
def called_as(name: str) -> Iterator[None]:
    """Meanwhile commands are called by this name, such as ``violearner run``, and say so in their help."""
    token = _called_as.set(name)
    try:
        yield
    finally:
        _called_as.reset(token)


def command_parser(module: str, description: str, epilog: str) -> argparse.ArgumentParser:
    """The parser of a command, which its help calls as it was called: by another name or ``python -m MODULE``.

    An epilog of several lines keeps them.
    """
    spelled = f"python -m {module}"
    name = _called_as.get() or spelled
    kept = argparse.RawDescriptionHelpFormatter if "\n" in epilog else argparse.HelpFormatter
    return argparse.ArgumentParser(
        prog=name, description=description, epilog=epilog.replace(spelled, name), formatter_class=kept
    )


def answered(job: Callable[[], int], interrupted: str = "") -> int:
    """The exit code of a job; an expected error or Ctrl-C is a line on stderr and a code of its own.

    interrupted: what the line says after "interrupted".
    """
    try:
        return job()
    except FusionError as error:
        print(f"error: {error}", file=sys.stderr)
        return EXIT_USAGE if isinstance(error, UsageError) else EXIT_FAILED
    except KeyboardInterrupt as interruption:
        print(f"{str(interruption) or 'interrupted'}{interrupted}", file=sys.stderr)
        return EXIT_INTERRUPTED


def role_and_topic(text: str) -> tuple[str, str]:
    """``ROLE=NAME``, as an argument."""
    role, equals, topic = text.partition("=")
    if not (role and equals and topic):
        raise argparse.ArgumentTypeError(f"{text!r} is not ROLE=NAME such as imu=/imu/data")
    return role, topic


def write_text(path: Path, text: str) -> None:
    """Write a text file, or print it where the path is `-`; raises LogError where that is impossible."""
    if path == STANDARD_OUTPUT:
        sys.stdout.write(text)
        return
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    except OSError as error:
        raise LogError(f"{path}: cannot be written: {error.strerror or error}") from None


def write_json(path: Path, document: dict[str, Any]) -> None:
    """Write a document as JSON, as `write_text` does."""
    write_text(path, json.dumps(document, indent=2, allow_nan=False) + "\n")
