"""Progress of long loops, with rate and time left: on stderr, and only where somebody watches."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator
from typing import TypeVar

T = TypeVar("T")

_silent = False


def silence(silent: bool = True) -> None:
    """Show no progress in this process from here on, or show it again."""
    global _silent  # noqa: PLW0603  # what a terminal shows is a matter of the process
    _silent = silent


def is_watched() -> bool:
    """Whether progress is shown: stderr is a terminal, and nobody asked for silence."""
    return sys.stderr.isatty() and not _silent


def track(items: Iterable[T], description: str, total: int | None = None) -> Iterable[T]:
    """The items unchanged, with a bar on stderr while they are consumed.

    total: how many items there are, where ``items`` has no length.
    """
    return _tracked(items, description, total) if is_watched() else items


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
