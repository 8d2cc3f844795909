"""An analysis as plain tables, for the terminal and for the page."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fusion.analysis import Analysis
from fusion_io.records import NANOSECONDS

LISTED_EVENTS = 40


class PlainTable(NamedTuple):
    """A title, the headings, and rows of as many cells; the first `words` columns are text, the others numbers."""

    title: str
    headings: Sequence[str]
    rows: Sequence[Sequence[str]]
    words: int = 1


def tables(analysis: Analysis) -> Iterator[PlainTable]:
    """The tables that have something to say."""
    for table in (
        _topics(analysis),
        _images(analysis),
        _depths(analysis),
        *_imus(analysis),
        _events(analysis),
        _results(analysis),
    ):
        if table.rows:
            yield table


def _topics(analysis: Analysis) -> PlainTable:
    rows = [
        (
            each.topic,
            each.type.rpartition("/")[2],
            str(each.messages),
            _number(each.rate_hz, 2),
            _number(each.jitter_ms, 2),
            str(each.gaps),
            _number(each.longest_gap_s, 2),
            _number(each.clock_offset_s, 2),
        )
        for each in analysis.found.topics.values()
    ]
    headings = ("topic", "type", "count", "Hz", "jitter ms", "gaps", "max s", "delay s")
    return PlainTable("Topics (max: the longest gap; delay: from stamp to recording)", headings, rows, 2)


def _images(analysis: Analysis) -> PlainTable:
    rows = [
        (
            topic,
            f"{each.width}x{each.height}x{each.channels}",
            str(len(each.stamps_ns)),
            _span(each.brightness),
            _span(100 * each.dark_share),
            _span(100 * each.bright_share),
            _span(each.contrast),
            _span(each.sharpness),
        )
        for topic, each in analysis.found.images.items()
    ]
    headings = ("topic", "size", "count", "mean", "dark %", "bright %", "contrast", "sharpness")
    return PlainTable("Images (of those sampled: median, least to most)", headings, rows, 2)


def _depths(analysis: Analysis) -> PlainTable:
    rows = [
        (
            topic,
            f"{each.width}x{each.height}",
            str(len(each.stamps_ns)),
            _span(100 * each.coverage),
            _number(each.near_m, 2),
            _number(each.median_m, 2),
            _number(each.far_m, 2),
        )
        for topic, each in analysis.found.depths.items()
    ]
    headings = ("topic", "size", "count", "coverage %", "near m", "median m", "far m")
    return PlainTable("Depth (of those sampled: median, least to most; near, far: 5 % are beyond)", headings, rows, 2)


def _imus(analysis: Analysis) -> Iterator[PlainTable]:
    """One table for each half of each IMU."""
    for topic, each in analysis.found.imus.items():
        for sensor, unit, estimate in (("gyro", "rad/s", each.gyro), ("accelerometer", "m/s^2", each.accelerometer)):
            if estimate is None:
                continue
            basis = f"noise by its {estimate.method}, {estimate.seconds:.0f} s"
            columns = [_column(estimate.density), _column(estimate.bias_instability), _column(estimate.bias)]
            headings = ("axis", f"noise {unit}/sqrt(Hz)", f"bias instability {unit}", f"mean while still {unit}")
            rows = list(zip("xyz", *columns, strict=True))
            yield PlainTable(f"{topic}: {sensor} ({basis})", headings, rows)


def _events(analysis: Analysis) -> PlainTable:
    found = analysis.found.events
    rows = [
        (f"{event.start_ns / NANOSECONDS:.3f}", f"{event.duration_s:.2f}", event.kind, event.topic, event.text)
        for event in found[:LISTED_EVENTS]
    ]
    title = "Events" if len(found) <= LISTED_EVENTS else f"Events (the first {LISTED_EVENTS} of {len(found)})"
    return PlainTable(title, ("at s", "for s", "kind", "topic", "what"), rows, 5)


def _results(analysis: Analysis) -> PlainTable:
    rows = [
        (
            name,
            str(each.poses),
            _number(each.path_length_m, 1),
            _number(each.end_sigma_m, 2),
            *(_number(each.metrics.get(key), 3) for key in ("t_rel_percent", "r_rel_deg_per_100m", "ate_m")),
            *(_number(each.metrics.get(key), 2) for key in ("anees_position", "anees_orientation")),
            _number(each.nis_mean, 2),
        )
        for name, each in analysis.results.items()
    ]
    headings = ("result", "poses", "path m", "sigma m", "t_rel %", "deg/100 m", "ATE m", "pos.", "ori.", "NIS")
    return PlainTable("Results (sigma at the end; ANEES pos., ori.: 3 is right; NIS: 6 is right)", headings, rows)


def _number(value: float | None, decimals: int) -> str:
    if value is None:
        return "-"
    return f"{value:.{decimals}f}" if abs(value) < 1e6 else f"{value:.3e}"


def _span(values: NDArray[Any]) -> str:
    return f"{np.median(values):.0f} ({values.min():.0f}-{values.max():.0f})"


def _column(values: NDArray[Any] | None) -> list[str]:
    return ["-"] * 3 if values is None else [f"{value:.2g}" for value in values]
