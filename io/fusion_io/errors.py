"""Errors that a user can expect and act on: printed as one line, never as a traceback."""

from __future__ import annotations


class FusionError(Exception):
    """Root of all expected errors. The message names the file, and topic and time where they apply."""


class LogError(FusionError):
    """A log, or another input file, cannot be used at all."""


class UsageError(FusionError):
    """The command or the configuration asks for something that cannot be done (exit code 2)."""


EXIT_OK = 0
EXIT_FAILED = 1
EXIT_USAGE = 2
EXIT_DAMAGED = 3
EXIT_DIFFERS = 4  # a condition that was set for the results does not hold
EXIT_INTERRUPTED = 130  # as shells report Ctrl-C: 128 and the number of the signal
