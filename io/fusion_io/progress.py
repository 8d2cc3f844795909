"""Progress of long loops, with rate and time left, on stderr: a bar where somebody watches, else lines."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator, Sized
from time import monotonic
from typing import TypeVar

T = TypeVar("T")

LINE_PERIOD_S = 30.0
"""Where nobody watches, as in a file that a batch system writes, a loop says so often how far it is."""

_silent = False


def silence(silent: bool = True) -> None:
    """Show no progress in this process from here on, or show it again."""
    global _silent  # noqa: PLW0603  # what a terminal shows is a matter of the process
    _silent = silent


def is_watched() -> bool:
    """Whether a bar is shown: stderr is a terminal, and nobody asked for silence."""
    return sys.stderr.isatty() and not _silent


def track(items: Iterable[T], description: str, total: int | None = None) -> Iterable[T]:
    """The items unchanged, with a bar on stderr while they are consumed; without a terminal, lines every half minute.

    total: how many items there are, where ``items`` has no length.
    """
    if _silent:
        return items
    return _tracked(items, description, total) if is_watched() else _in_lines(items, description, total)


def _in_lines(items: Iterable[T], description: str, total: int | None) -> Iterator[T]:
    """The items; a loop that is done within the first period says nothing."""
    total = len(items) if total is None and isinstance(items, Sized) else total
    start_s = said_s = monotonic()
    for done, item in enumerate(items):
        now_s = monotonic()
        if done and now_s - said_s >= LINE_PERIOD_S:
            said_s = now_s
            print(_line(description, done, total, now_s - start_s), file=sys.stderr, flush=True)
        yield item


def _line(description: str, done: int, total: int | None, elapsed_s: float) -> str:
    """``replay: 12 of 81, 0.3/s, 230 s left``."""
    if total is None:
        return f"{description}: {done}, {done / elapsed_s:.2g}/s"
    left_s = elapsed_s * max(total - done, 0) / done
    return f"{description}: {done} of {total}, {done / elapsed_s:.2g}/s, {left_s:.0f} s left"


def _tracked(items: Iterable[T], description: str, total: int | None) -> Iterator[T]:
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        ProgressColumn,
        Task,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )
    from rich.text import Text

    class Rate(ProgressColumn):
        """Items a second, of late."""

        def render(self, task: Task) -> Text:
            speed = task.finished_speed or task.speed
            return Text("" if speed is None else f"{speed:.1f}/s", style="progress.data.speed")

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        Rate(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        yield from progress.track(items, description=description, total=total)
