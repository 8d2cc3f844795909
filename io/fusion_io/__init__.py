"""Logs of RGB-D and IMU recordings: records, MCAP reader and writer, converters, simulation.

From Python: ``fusion_io.open_log(path)`` and what it gives: ``log.frames()``, ``log.imu()``, ``log.pairs()``,
``log.ground_truth()``, ``log.trajectory("ekf")``, as the records named here.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from fusion_io.errors import FusionError as FusionError
    from fusion_io.reader import Log as Log
    from fusion_io.reader import open_log as open_log
    from fusion_io.records import CameraFrame as CameraFrame
    from fusion_io.records import EstimatorSeries as EstimatorSeries
    from fusion_io.records import ImuSeries as ImuSeries
    from fusion_io.records import PairEstimate as PairEstimate
    from fusion_io.records import Trajectory as Trajectory
    from fusion_io.writer import LogWriter as LogWriter

_HOMES = {
    "open_log": "fusion_io.reader",
    "Log": "fusion_io.reader",
    "LogWriter": "fusion_io.writer",
    "FusionError": "fusion_io.errors",
    "CameraFrame": "fusion_io.records",
    "EstimatorSeries": "fusion_io.records",
    "ImuSeries": "fusion_io.records",
    "PairEstimate": "fusion_io.records",
    "Trajectory": "fusion_io.records",
}

__all__ = [
    "CameraFrame",
    "EstimatorSeries",
    "FusionError",
    "ImuSeries",
    "Log",
    "LogWriter",
    "PairEstimate",
    "Trajectory",
    "open_log",
]


def __getattr__(name: str) -> object:
    """Import what is asked for when it is asked for, so that the commands start at once (PEP 562)."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)
