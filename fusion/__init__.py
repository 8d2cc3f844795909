"""Back ends, evaluation and the main job.

From Python: ``fusion.fuse(pairs, imu)`` and ``fusion.evaluate(trajectory, ground_truth)``; the commands are modules,
such as ``fusion.run``.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from fusion.api import fuse as fuse
    from fusion.evaluation import Metrics as Metrics
    from fusion.evaluation import evaluate as evaluate

_HOMES = {"fuse": "fusion.api", "evaluate": "fusion.evaluation", "Metrics": "fusion.evaluation"}

__all__ = ["Metrics", "evaluate", "fuse"]


def __getattr__(name: str) -> object:
    """Import what is asked for when it is asked for, so that the commands start at once (PEP 562)."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)
