"""VIOLearner: the network, its training and its covariance.

From Python: ``learned.estimate_pairs(log, weights)``.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from learned.api import estimate_pairs as estimate_pairs

_HOMES = {"estimate_pairs": "learned.api"}

__all__ = ["estimate_pairs"]


def __getattr__(name: str) -> object:
    """Import what is asked for when it is asked for, so that the commands start at once (PEP 562)."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)
