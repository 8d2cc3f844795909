"""A procedural street with a camera and an IMU driving through it: logs, and clips to train on."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from fusion_io.records import CameraFrame, ImuSeries, Trajectory


def clip(
    seed: int, frames: int, width: int, height: int, exact_depth: bool = False
) -> tuple[list[CameraFrame], ImuSeries, Trajectory]:
    """A short drive through a fresh random world; see ``clips.clip``."""
    from fusion_io.simulation import clips

    return clips.clip(seed, frames, width, height, exact_depth)
