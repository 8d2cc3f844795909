"""Numbers and words in messages."""

from __future__ import annotations


def counted(count: int, one: str, many: str = "") -> str:
    """``1 frame``, ``2 frames``; many: the plural where it does not merely end in s."""
    return f"{count} {one if count == 1 else many or f'{one}s'}"


def metres(value: float) -> str:
    """A length, centimetres below ten metres."""
    return f"{value:.0f} m" if value >= 100.0 else f"{value:.1f} m" if value >= 10.0 else f"{value:.2f} m"
