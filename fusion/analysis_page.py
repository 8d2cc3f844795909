"""An analysis as one page that needs nothing else: tables and drawings, no scripts."""

from __future__ import annotations

import html
import io
from collections.abc import Iterator, Mapping
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from fusion import events
from fusion.allan import NoiseEstimate
from fusion.analysis import Analysis
from fusion.analysis_tables import PlainTable, tables
from fusion.log_statistics import TopicStatistics
from fusion_io.records import NANOSECONDS

# Okabe and Ito's palette, which the colour-blind tell apart.
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
EVENT_COLOURS = {
    events.IMU_GAP: "#56b4e9",
    events.STUCK: "#cc79a7",
    events.SATURATED: "#f0e442",
    events.CLOCK_JUMP: "#8c5a2b",
    events.DROPPED_FRAMES: "#0072b2",
    events.MISSING_PAIRS: "#8c8c8c",
    events.WRONG_PAIR: "#e69f00",
    events.CONTRADICTION: "#d55e00",
    events.BIAS_STEP: "#7d3c98",
    events.BIAS_WANDERS: "#7d3c98",
    events.STAND_STILL: "#009e73",
}
# Lines and letters take the colour of the page's text: a drawing has this one, which is replaced.
INK = "#010203"
DRAWING: dict[Any, Any] = {
    "axes.edgecolor": INK,
    "axes.labelcolor": INK,
    "text.color": INK,
    "text.parse_math": False,  # a topic may hold anything
    "svg.fonttype": "none",
    "svg.hashsalt": "violearner",  # names in a drawing are made from it: the same log gives the same page
}
MAX_TOPICS_DRAWN = 20

STYLE = """
:root { color-scheme: light dark; }
body { font: 15px/1.5 system-ui, sans-serif; margin: 2rem auto; max-width: 70rem; padding: 0 1rem;
  color: light-dark(#222, #ddd); background: light-dark(#fff, #181818); }
h1 { font-size: 1.4rem; } h2 { font-size: 1.1rem; margin-top: 2rem; }
.ready { color: light-dark(#00664d, #3ec9a3); } .limits { color: light-dark(#9a4a00, #f0a860); }
.not { color: light-dark(#a3201c, #ff8a80); }
table { border-collapse: collapse; } .wide { overflow-x: auto; }
th, td { padding: .2rem .6rem; border-bottom: 1px solid light-dark(#ddd, #444); text-align: left; vertical-align: top; }
td.number, th.number { text-align: right; font-variant-numeric: tabular-nums; }
.wide svg { width: 100%; min-width: 44rem; height: auto; }
@media (max-width: 700px) {
  body { margin-top: 1rem; font-size: 14px; } th, td { padding: .2rem .35rem; } ul { padding-left: 1.2rem; } }
@media print { body { margin: 0; max-width: none; } }
"""

CLASSES = {"ready": "ready", "usable with limits": "limits", "not usable": "not"}


def page(analysis: Analysis) -> str:
    """The whole page as HTML."""
    name, answer = html.escape(analysis.found.path.name), analysis.answer
    reasons = "".join(
        f"<li>{reason.level.name.lower()}: {html.escape(reason.line(analysis.found.path.name))}</li>"
        for reason in analysis.reasons
    )
    with mpl.rc_context(DRAWING):
        drawings = "".join(
            f'<h2>{html.escape(title)}</h2><div class="wide">{_svg(figure)}</div>'
            for title, figure in _figures(analysis)
        )
    return (
        '<!doctype html><html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{name}: {answer}</title><style>{STYLE}</style></head><body>"
        f'<h1>{name}: <span class="{CLASSES[answer]}">{answer}</span></h1><ul>{reasons}</ul>'
        f"{drawings}{''.join(_table(each) for each in tables(analysis))}</body></html>\n"
    )


def _table(table: PlainTable) -> str:
    def row(tag: str, cells: Any) -> str:
        marked = (
            f"<{tag}{' class=number' if i >= table.words else ''}>{html.escape(cell)}</{tag}>"
            for i, cell in enumerate(cells)
        )
        return f"<tr>{''.join(marked)}</tr>"

    body = "".join(row("td", cells) for cells in table.rows)
    return (
        f'<h2>{html.escape(table.title)}</h2><div class="wide"><table>{row("th", table.headings)}{body}</table></div>'
    )


# ---------------------------------------------------------------------------------------------- drawings


def _figures(analysis: Analysis) -> Iterator[tuple[str, Figure]]:
    """Titles and drawings of what there is."""
    if analysis.found.topics:
        yield "When there are messages, and what happened", _timeline(analysis)
    if analysis.found.images or analysis.found.depths:
        yield "Light and depth", _light(analysis)
    curves = {
        f"{topic} {sensor}": estimate
        for topic, each in analysis.found.imus.items()
        for sensor, estimate in (("gyro, rad/s", each.gyro), ("accelerometer, m/s^2", each.accelerometer))
        if estimate is not None and estimate.curve is not None
    }
    if curves:
        yield "Allan deviation", _allan(curves)


def _timeline(analysis: Analysis) -> Figure:
    """A line for each topic while it lasts, and the events on it; all on the recorder's clock."""
    drawn = {each.topic: each for each in list(analysis.found.topics.values())[:MAX_TOPICS_DRAWN]}
    start_s = min(_recorded_s(each, each.start_ns) for each in drawn.values())
    figure, (axes,) = _figure(1, height=0.8 + 0.3 * len(drawn))
    rows = {topic: row for row, topic in enumerate(drawn)}
    for topic, each in drawn.items():
        span = [_recorded_s(each, at_ns) - start_s for at_ns in (each.start_ns, each.end_ns)]
        axes.plot(span, 2 * [rows[topic]], color=INK, linewidth=2, marker="|", solid_capstyle="butt")
    for event in sorted(analysis.found.events, key=lambda event: -event.duration_s):  # the shortest on top
        if event.topic in rows:
            span = [_recorded_s(drawn[event.topic], at_ns) - start_s for at_ns in (event.start_ns, event.end_ns)]
            at, colour = 2 * [rows[event.topic]], EVENT_COLOURS[event.kind]
            axes.plot(span, at, color=colour, linewidth=10, solid_capstyle="projecting", label=event.kind)
    axes.set_yticks(range(len(drawn)), list(drawn))
    axes.set_ylim(len(drawn) - 0.5, -0.5)
    axes.set_xlabel(f"seconds from {start_s:.3f} on the recorder's clock")
    _legend(axes)
    return figure


def _recorded_s(topic: TopicStatistics, stamp_ns: int) -> float:
    """When a message of a topic was recorded, by its usual delay."""
    return stamp_ns / NANOSECONDS + (topic.clock_offset_s or 0.0)


def _light(analysis: Analysis) -> Figure:
    """Shares of clipped pixels and of pixels with depth, over time."""
    figure, (axes,) = _figure(1, height=2.6)
    start_ns = analysis.span_ns[0]
    series = [
        *(
            (f"{topic}: mean brightness", each.stamps_ns, each.brightness / 255)
            for topic, each in _items(analysis, "images")
        ),
        *((f"{topic}: overexposed", each.stamps_ns, each.bright_share) for topic, each in _items(analysis, "images")),
        *((f"{topic}: with depth", each.stamps_ns, each.coverage) for topic, each in _items(analysis, "depths")),
    ]
    for i, (label, stamps_ns, share) in enumerate(series):
        colour = COLOURS[i % len(COLOURS)]
        axes.plot((stamps_ns - start_ns) / NANOSECONDS, 100 * share, color=colour, marker=".", label=label)
    axes.set_ylim(0, 100)
    axes.set_ylabel("%")
    axes.set_xlabel(f"seconds from {start_ns / NANOSECONDS:.3f}")
    _legend(axes)
    return figure


def _items(analysis: Analysis, name: str) -> list[tuple[str, Any]]:
    return list(getattr(analysis.found, name).items())


def _allan(curves: Mapping[str, NoiseEstimate]) -> Figure:
    figure, panels = _figure(len(curves), height=2.6 * len(curves))
    for axes, (label, estimate) in zip(panels, curves.items(), strict=True):
        curve = estimate.curve
        assert curve is not None
        for axis, deviation, density, colour in zip("xyz", curve.deviation.T, estimate.density, COLOURS, strict=False):
            axes.loglog(curve.tau_s, deviation, color=colour, label=axis)
            axes.loglog(curve.tau_s, density / np.sqrt(curve.tau_s), color=colour, linestyle=":", linewidth=1)
        for scale in (axes.xaxis, axes.yaxis):  # the usual labels of powers are formulas
            scale.set_major_formatter("{x:g}")
            scale.set_minor_formatter("")
        axes.set_title(f"{label} (dotted: white noise)", fontsize=10)
        axes.set_xlabel("averaging time, s")
        _legend(axes)
    return figure


def _figure(panels: int, height: float) -> tuple[Figure, list[Axes]]:
    figure = Figure(figsize=(10, height), layout="constrained")
    found = [figure.add_subplot(panels, 1, i + 1, facecolor="none") for i in range(panels)]
    for axes in found:
        axes.tick_params(colors=INK)
        axes.title.set_color(INK)
        axes.spines[["top", "right"]].set_visible(False)
    return figure, found


def _legend(axes: Axes) -> None:
    """One entry a label, beside the drawing."""
    handles, labels = axes.get_legend_handles_labels()
    unique = dict(zip(labels, handles, strict=True))
    if unique:
        style = {"frameon": False, "fontsize": 8, "labelcolor": INK, "bbox_to_anchor": (1.0, 1.0)}
        axes.legend(list(unique.values()), list(unique), loc="upper left", **style)


def _svg(figure: Figure) -> str:
    """The drawing as an element of a page, the same for the same log."""
    text = io.StringIO()
    figure.savefig(text, format="svg", transparent=True, metadata={"Date": None})
    drawing = text.getvalue()
    return drawing[drawing.index("<svg") :].replace(INK, "currentColor")
