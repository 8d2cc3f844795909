"""Samples that a sensor shows but has not measured: it hung, was filled in, or is at the end of its range."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_closing, binary_opening, find_objects, label

from fusion_io.records import FloatArray

MIN_SAMPLES = 20
"""Fewer say nothing about a sensor."""

# A live sensor has noise: what repeats itself, or runs in exactly equal steps, for so many samples was not measured.
# The sensor hung, or somebody filled a gap by interpolation, as KITTI's odometry files are in places for 1.5 s. So few
# samples may kink in between.
FROZEN_SAMPLES = 20
FROZEN_KINK = 3
EQUAL_STEPS = 1e-9  # of the sensor's unit

# A clipped sensor stays exactly at its largest value. That is far from its usual ones, or there are more of it than of
# the next value, as no noise has it.
CLIPPED_SAMPLES = 3
CLIPPED_DEVIATIONS = 3.0
CLIPPED_PILE = 3.0
MAD_TO_STD = 1.4826


def frozen(values: FloatArray) -> list[slice]:
    """The runs in which values (N, M) repeat themselves or run in exactly equal steps on all axes."""
    if len(values) < MIN_SAMPLES:
        return []
    equal = np.max(np.abs(np.diff(values, 2, axis=0)), axis=1) <= EQUAL_STEPS
    lasting = binary_opening(binary_closing(equal, np.ones(FROZEN_KINK + 1)), np.ones(FROZEN_SAMPLES))
    return runs(np.pad(lasting, 1))  # a sample has a step on either side


def clipped(values: FloatArray) -> Iterator[tuple[int, float, slice]]:
    """Axis, limit and run wherever an axis of values (N, M) stays at the end of the sensor's range."""
    if len(values) < MIN_SAMPLES:
        return
    for axis, column in enumerate(values.T):
        levels, counts = np.unique(column, return_counts=True)
        if len(levels) < MIN_SAMPLES:
            continue
        median = np.median(column)
        far = CLIPPED_DEVIATIONS * MAD_TO_STD * np.median(np.abs(column - median))
        for end, beside in ((0, 1), (-1, -2)):
            limit = float(levels[end])
            piled = counts[end] > CLIPPED_PILE * counts[beside]
            if not (piled or abs(limit - median) > far):
                continue
            for run in runs(column == limit):
                # Where all axes stand still, the sensor is stuck, not clipped.
                if run.stop - run.start >= CLIPPED_SAMPLES and np.any(np.diff(values[run], axis=0)):
                    yield axis, limit, run


def runs(mask: NDArray[np.bool_]) -> list[slice]:
    """The runs of True in a mask (N,)."""
    return [run[0] for run in find_objects(label(mask)[0])] if len(mask) else []
