"""Pair estimates from Python: what ``learned.estimate_pairs`` is."""

from __future__ import annotations

from pathlib import Path

from fusion_io.messages import decode_pair, encode_pair
from fusion_io.progress import track
from fusion_io.reader import Log
from fusion_io.records import PairEstimate
from learned import estimator


def estimate_pairs(log: Log, weights: str | Path | None = None, *, refine: bool = True) -> list[PairEstimate]:
    """The motions of the camera between consecutive frames of a log, by the network.

    Each is ``T_source_target``, the pose of the target camera in the source camera's frame (metres), with a 6x6
    covariance, rotation first (see `fusion_io.PairEstimate`). Frames without depth, and steps over missing frames, give
    none. They are as they would read back from a log, so that a replay starts from the same bits.

    Args:
        log: A log with images, depth and intrinsics; its IMU is used if it has one.
        weights: A checkpoint of the network; None for the one that ships with the package.
        refine: Whether estimates are refined to the photometric optimum at full resolution.

    Raises:
        LogError: weights, images or intrinsics cannot be used.

    """
    frames = track(log.frames(), "pair estimates", len(log.frame_stamps()))
    path = None if weights is None else Path(weights)
    estimates = estimator.estimate_pairs(log, log.imu(), path, frames, refined=refine)
    return [decode_pair(encode_pair(pair)) for pair in estimates]
