"""What was found wrong with a log: counted once, however often it is read."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(slots=True)
class Findings:
    """Counts and one-line notes by name."""

    _found: dict[str, tuple[int, list[str]]] = field(default_factory=dict)

    def put(self, name: str, count: int, note: str) -> None:
        """State a finding; it replaces what was stated under this name, and a count of 0 removes it."""
        self._found.pop(name, None)
        if count:
            self._found[name] = (count, [note])

    def add(self, name: str, note: str) -> None:
        """One more finding under this name."""
        count, notes = self._found.get(name, (0, []))
        self._found[name] = (count + 1, [*notes, note])

    def remark(self, note: str) -> None:
        """A note that is no fault and is not counted."""
        self._found[note] = (0, [note])

    @property
    def counts(self) -> dict[str, int]:
        """Name -> how often."""
        return {name: count for name, (count, _) in self._found.items() if count}

    @property
    def notes(self) -> list[str]:
        """All notes."""
        return [note for _, notes in self._found.values() for note in notes]

    @property
    def remarks(self) -> list[str]:
        """The notes that are no faults."""
        return [note for count, notes in self._found.values() if not count for note in notes]
