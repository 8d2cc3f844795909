"""A comparison as a page to look at: one file with everything in it, for any screen, light or dark."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict
from html import escape
from typing import Any

import numpy as np
import plotly.graph_objects as go
from plotly.offline import get_plotlyjs

from fusion.comparison import MEASURES, Comparison, Contestant, Duel, contestants
from fusion.evaluation import common, segment_errors
from fusion.results import ONLY_TRAJECTORY
from fusion.significance import ROUNDING, Difference
from fusion.table import HEADINGS, ROWS
from fusion_io.records import FloatArray, Trajectory

# Colours that the colour-blind can tell apart (Okabe and Ito 2008), on white and on black; then other dashes.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#8C8C8C")
DASHES = ("solid", "dash", "dot", "dashdot")
TRUTH_COLOUR = "#808080"

# Blue where the second is better, orange where it is worse; the middle is grey on any background.
DIVERGING = ((0.0, "#0072B2"), (0.5, "#A0A0A0"), (1.0, "#D55E00"))

UNITS = {"t_rel_percent": "%", "r_rel_deg_per_100m": "deg/100 m"}
NAMES = {"t_rel_percent": "translation", "r_rel_deg_per_100m": "rotation"}

_STYLE = """
:root { color-scheme: light dark; --ink: #1a1c20; --paper: #ffffff; --line: #d8dbe0; --good: #00629b; --bad: #b34700; }
@media (prefers-color-scheme: dark) {
  :root { --ink: #e6e8eb; --paper: #15171a; --line: #3a3e45; --good: #6cb8ea; --bad: #ff9a52; } }
body { font: 15px/1.5 system-ui, sans-serif; color: var(--ink); background: var(--paper);
  margin: 0 auto; padding: 1rem; max-width: 76rem; }
h1 { font-size: 1.4rem; } h2 { font-size: 1.1rem; margin: 2rem 0 .5rem; }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
th, td { padding: .25rem .75rem; text-align: right; border-bottom: 1px solid var(--line); white-space: nowrap; }
th { white-space: normal; vertical-align: bottom; }
th:first-child, td:first-child, td.word { text-align: left; }
td.best { font-weight: 700; } .better { color: var(--good); } .worse { color: var(--bad); }
.plots { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 30rem), 1fr)); gap: 1rem; }
.plots > div { min-width: 0; height: 27rem; }
@media (max-width: 700px) {
  body { font-size: 14px; padding: .75rem; } th, td { padding: .25rem .4rem; } .key { display: none; }
  .scroll th:first-child, .scroll td:first-child {
    position: sticky; left: 0; background: var(--paper); white-space: normal; min-width: 8rem; }
  .whole > div { height: 34rem; } }
@media print { .plots { display: block; } .plots > div { break-inside: avoid; } }
"""

_SCRIPT = """
const dark = matchMedia("(prefers-color-scheme: dark)");
function colours() {
  const ink = dark.matches ? "#e6e8eb" : "#1a1c20", line = dark.matches ? "#3a3e45" : "#d8dbe0";
  for (const plot of document.querySelectorAll(".js-plotly-plot")) {
    const change = { "font.color": ink };
    for (const axis of Object.keys(plot.layout).filter(name => /^[xy]axis/.test(name)))
      for (const part of ["gridcolor", "zerolinecolor", "linecolor"]) change[axis + "." + part] = line;
    Plotly.relayout(plot, change);
  }
}
dark.addEventListener("change", colours);
addEventListener("load", () => {  // plots above were drawn before the page knew how many stand beside them
  document.querySelectorAll(".js-plotly-plot").forEach(Plotly.Plots.resize);
  colours();
});
"""


def page(comparison: Comparison) -> str:
    """The page; it needs nothing else, and the same comparison gives the same bytes."""
    title = " and ".join(result.label for result in comparison.results[:3])
    title += f" and {len(comparison.results) - 3} more" if len(comparison.results) > 3 else ""
    body = [f"<h1>Comparison: {escape(title)}</h1>", *_notes(comparison), *_measures(comparison)]
    if comparison.duels:
        body += [*_differences(comparison), *_whole(comparison)]
        for i, duel in enumerate(comparison.duels):
            body += _duel(duel, i)
    body += _deviations(comparison)
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(title)}</title><style>{_STYLE}</style><script>{get_plotlyjs()}</script></head>"
        f"<body>{''.join(body)}<script>{_SCRIPT}</script></body></html>\n"
    )


# --- Tables -------------------------------------------------------------------------------------


def _notes(comparison: Comparison) -> Iterator[str]:
    if comparison.notes:
        yield f"<ul>{''.join(f'<li>{escape(note)}</li>' for note in comparison.notes)}</ul>"


def _measures(comparison: Comparison) -> Iterator[str]:
    rows = []
    best = {row.key: comparison.best(row.key) for row in ROWS}
    known = [row for row in ROWS if any(getattr(each, row.key) is not None for each in comparison.metrics.values())]
    for result in comparison.results:
        for each in contestants(result):
            values = asdict(comparison.metrics[each.name])
            cells = [_cell(values[row.key], row.scale, row.decimals, best=each.name in best[row.key]) for row in known]
            rows.append(f"<tr><td>{escape(label(each))}</td><td class='word key'>{each.name}</td>{''.join(cells)}</tr>")
    heads = "".join(f"<th>{escape(row.label)}<br>{escape(row.unit)}</th>" for row in known)
    yield _table(f"<th></th><th class=key></th>{heads}", rows)
    if not known:
        yield "<p>There is no ground truth, so nothing says which of them is better.</p>"


def _cell(value: float | None, scale: float, decimals: int, best: bool) -> str:
    if value is None:
        return "<td>-</td>"
    return f"<td{' class=best' if best else ''}>{value * scale:.{decimals}f}</td>"


def _differences(comparison: Comparison) -> Iterator[str]:
    yield "<h2>Differences, paired over segments, with 95 % confidence intervals</h2>"
    rows = [
        f"<tr><td>{escape(label(duel.b))} less {escape(label(duel.a))}</td>"
        + "".join(_difference(duel.differences.get(measure)) for measure in MEASURES)
        + "</tr>"
        for duel in comparison.duels
    ]
    heads = "".join(f"<th>{NAMES[each]}, {UNITS[each]}</th><th></th>" for each in MEASURES)
    yield _table(f"<th></th>{heads}", rows)
    yield (
        "<p>Negative: the first has the smaller error. An interval without zero is a difference larger than the noise. "
        "Overlapping segments are correlated; the intervals allow for it by overlapping batch means.</p>"
    )


def _difference(difference: Difference | None) -> str:
    if difference is None:
        return "<td>-</td><td></td>"
    interval = "" if difference.low is None else f" [{difference.low:+.3f}, {difference.high:+.3f}]"
    verdict = difference.verdict
    return f'<td>{difference.mean:+.3f}{interval}</td><td class="word {verdict}">{verdict}</td>'


def _deviations(comparison: Comparison) -> Iterator[str]:
    if not comparison.deviations:
        return
    yield "<h2>How far they are from each other</h2>"
    known = [row for row in ROWS if any(getattr(each.measures, row.key) is not None for each in comparison.deviations)]
    rows = [
        f"<tr><td>{escape(label(each.b))} from {escape(label(each.a))}</td>"
        + "".join(
            "<td>-</td>"
            if (value := getattr(each.measures, row.key)) is None
            else f"<td>{value * row.scale:.{row.decimals}f}</td>"
            for row in known
        )
        + "</tr>"
        for each in comparison.deviations
    ]
    yield _table("<th></th>" + "".join(f"<th>{escape(row.label)}<br>{escape(row.unit)}</th>" for row in known), rows)
    figure = _figure("from above", "x, right [m]", "z, ahead [m]")
    names: dict[str, Contestant] = {}
    for each in comparison.deviations:
        names |= {each.a.name: each.a, each.b.name: each.b}
    for i, contestant in enumerate(names.values()):
        figure.add_trace(_path(contestant.poses.relative_to_first().poses.translation, label(contestant), i))
    figure.update_yaxes(scaleanchor="x")
    yield f"<div class=plots>{_html(figure, 'from-above')}</div>"


def _table(heads: str, rows: Sequence[str]) -> str:
    return f"<div class=scroll><table><thead><tr>{heads}</tr></thead><tbody>{''.join(rows)}</tbody></table></div>"


# --- Plots --------------------------------------------------------------------------------------


def label(contestant: Contestant) -> str:
    """What the page calls a trajectory."""
    if contestant.trajectory == ONLY_TRAJECTORY:
        return contestant.result.label
    return f"{contestant.result.label}, {HEADINGS.get(contestant.trajectory, contestant.trajectory)}"


def _whole(comparison: Comparison) -> Iterator[str]:
    """All trajectories from above, and their errors by segment length."""
    above = _figure("from above", "x, right [m]", "z, ahead [m]")
    boxes = _figure("error by segment length: quartiles", "segment length [m]", "translation error [%]")
    truth_drawn = False
    everyone = [each for result in comparison.results for each in contestants(result)]
    for i, each in enumerate(everyone):
        truth = each.result.ground_truth
        estimate, true = common(each.poses, truth) if truth is not None else (each.poses.relative_to_first(), None)
        if true is not None and len(true) and not truth_drawn:
            path = _path(true.poses.translation, "ground truth", 0)
            path.line = {"color": TRUTH_COLOUR, "width": 4}
            above.add_trace(path)
            truth_drawn = True
        above.add_trace(_path(estimate.poses.translation, label(each), i))
        if true is not None and len(true) > 1:
            boxes.add_trace(_quartiles(estimate, true, comparison.segment_lengths_m, label(each), i))
    above.update_yaxes(scaleanchor="x")
    boxes.update_layout(boxmode="group")
    boxes.update_xaxes(type="category")
    yield f'<h2>All</h2><div class="plots whole">{_html(above, "from-above")}{_html(boxes, "by-length")}</div>'


def _quartiles(estimate: Trajectory, truth: Trajectory, lengths: Sequence[float], name: str, i: int) -> go.Box:
    errors = segment_errors(estimate.poses, truth.poses, lengths)
    shown = [length for length in lengths if np.any(errors.length_m == length)]
    of_length = [errors.translation_percent[errors.length_m == length] for length in shown]
    low, first, median, third, high = (
        np.array([np.quantile(each, [0.05, 0.25, 0.5, 0.75, 0.95]) for each in of_length]).reshape(-1, 5).T
    )
    return go.Box(
        x=[f"{length:g}" for length in shown],
        lowerfence=low,
        q1=first,
        median=median,
        q3=third,
        upperfence=high,
        name=name,
        marker_color=COLOURS[i % len(COLOURS)],
    )


def _duel(duel: Duel, number: int) -> Iterator[str]:
    """Where along the path the one is better than the other."""
    if not len(duel.errors_a.start):
        return
    yield f"<h2>{escape(label(duel.b))} against {escape(label(duel.a))}</h2>"
    if np.allclose(duel.errors_a.translation_percent, duel.errors_b.translation_percent, rtol=0.0, atol=ROUNDING):
        yield "<p>They have the same translation error all along the path.</p>"
        return
    shortest = float(duel.errors_a.length_m.min())
    chosen = duel.errors_a.length_m == shortest
    start = duel.errors_a.start[chosen]
    difference = duel.errors_b.translation_percent[chosen] - duel.errors_a.translation_percent[chosen]
    limit = float(np.quantile(np.abs(difference), 0.95)) or 1.0
    above = _figure("where it is better (blue) or worse (orange)", "x, right [m]", "z, ahead [m]")
    above.add_trace(_plain_path(duel.path_m))
    marker = {
        "color": difference,
        "colorscale": DIVERGING,
        "cmin": -limit,
        "cmax": limit,
        "size": 9,
        "colorbar": {"title": {"text": f"difference<br>over {shortest:g} m<br>[%]"}, "thickness": 12},
    }
    x, _, z = duel.path_m[start].T
    hover = "%{customdata[0]:.0f} m, %{customdata[1]:.2f} s: %{customdata[2]:+.3f} %<extra></extra>"
    data = np.column_stack([duel.distance_m[start], _seconds(duel)[start], difference])
    above.add_trace(
        go.Scatter(x=x, y=z, mode="markers", marker=marker, customdata=data, hovertemplate=hover, showlegend=False)
    )
    above.update_yaxes(scaleanchor="x")

    along = _figure("errors along the path", "distance travelled [m]", f"translation error over {shortest:g} m [%]")
    for each, errors, i in ((duel.a, duel.errors_a, 0), (duel.b, duel.errors_b, 1)):
        along.add_trace(
            go.Scatter(
                x=duel.distance_m[start],
                y=errors.translation_percent[chosen],
                name=label(each),
                line={"color": COLOURS[i], "dash": DASHES[i]},
            )
        )
    along.update_yaxes(rangemode="tozero")
    plots = [_html(above, f"where-{number}"), _html(along, f"along-{number}")]
    plots += [_html(_by_length(duel, measure), f"length-{number}-{measure}") for measure in MEASURES]
    yield f"<div class=plots>{''.join(plots)}</div>"


def _by_length(duel: Duel, measure: str) -> go.Figure:
    """The difference for segments of each length, with intervals where the path is long enough for them."""
    figure = _figure(
        f"difference in {NAMES[measure]} by length", "segment length [m]", f"difference [{UNITS[measure]}]"
    )
    differences = [each[measure] for each in duel.by_length.values()]
    half = [0.0 if each.high is None else each.high - each.mean for each in differences]
    figure.add_trace(
        go.Scatter(
            x=list(duel.by_length),
            y=[each.mean for each in differences],
            error_y={"type": "data", "array": half, "thickness": 1.5},
            mode="markers",
            marker={"size": 9, "color": COLOURS[0], "symbol": ["circle" if each else "circle-open" for each in half]},
            text=[each.verdict for each in differences],
            hovertemplate="%{x} m: %{y:+.3f}, %{text}<extra></extra>",
            showlegend=False,
        )
    )
    figure.update_yaxes(zeroline=True, zerolinewidth=2)
    return figure


def _seconds(duel: Duel) -> FloatArray:
    seconds: FloatArray = (duel.stamps_ns - duel.stamps_ns[0]) / 1e9
    return seconds


def _path(positions_m: FloatArray, name: str, i: int) -> go.Scatter:
    x, _, z = positions_m.T
    style = {"color": COLOURS[i % len(COLOURS)], "dash": DASHES[i % len(DASHES)]}
    return go.Scatter(x=x, y=z, mode="lines", name=name, line=style)


def _plain_path(positions_m: FloatArray) -> go.Scatter:
    x, _, z = positions_m.T
    return go.Scatter(
        x=x, y=z, mode="lines", line={"color": TRUTH_COLOUR, "width": 1}, hoverinfo="skip", showlegend=False
    )


def _figure(title: str, x: str, y: str) -> go.Figure:
    layout: dict[str, Any] = {
        "title": {"text": title, "font": {"size": 15}},
        "xaxis": {"title": x},
        "yaxis": {"title": y},
        "paper_bgcolor": "rgba(0,0,0,0)",
        "plot_bgcolor": "rgba(0,0,0,0)",
        "margin": {"l": 60, "r": 15, "t": 45, "b": 50},
        "legend": {"orientation": "h", "yref": "container", "y": 0.0, "yanchor": "bottom"},
    }
    return go.Figure(layout=layout)


def _html(figure: go.Figure, name: str) -> str:
    html: str = figure.to_html(
        full_html=False, include_plotlyjs=False, div_id=name, config={"displayModeBar": False, "responsive": True}
    )
    return html
