"""The page itself: tables as HTML, figures as data for the script that draws them, everything in one file."""

from __future__ import annotations

import base64
import gzip
import json
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from functools import cache
from html import escape
from importlib.resources import files
from itertools import groupby
from operator import attrgetter
from pathlib import Path
from string import Template
from typing import Any

import numpy as np
from scipy.spatial.transform import RigidTransform

from fusion.evaluation import common, errors_over_time
from fusion.events import Event
from fusion.imu import ImuCalibration
from fusion.measurements import Mounting
from fusion.placement import Placement, placement
from fusion.report.content import ReportContent
from fusion.report.figures import Figure, figures, sensor_stamps
from fusion.report.verdict import Verdict, label, verdict
from fusion.table import END_ROWS, ROWS, RULE, number
from fusion_io.records import NANOSECONDS, FloatArray, IntArray, Trajectory
from fusion_io.words import counted

SHOWN_EVENTS = 5  # of a kind; the others are folded away
SIGNIFICANT = "%.5g"  # digits: far finer than a pixel
PLACES = "%.7g"  # of places: centimetres over a hundred kilometres
PRECISE = "%.9g"  # of times: milliseconds over days


def write_report(path: Path, content: ReportContent) -> None:
    """Write the report to one HTML file; the same content gives the same bytes.

    Raises OSError where the file cannot be written.
    """
    path.write_text(page(content), encoding="utf-8")


def page(content: ReportContent) -> str:
    """The report as HTML that needs nothing beside itself."""
    folder = files("fusion.report")
    sections = figures(content)
    return Template(folder.joinpath("template.html").read_text(encoding="utf-8")).substitute(
        title=escape(content.title),
        style=folder.joinpath("report.css").read_text(encoding="utf-8"),
        script=folder.joinpath("report.js").read_text(encoding="utf-8"),
        plotly=_library(),
        data=_packed(_document(content, [each for shown in sections.values() for each in shown]).encode()),
        verdict=_verdict(verdict(content)),
        facts=_facts(content),
        metrics=_metrics(content),
        calibration=_calibration(content),
        events=_events(content),
        warnings=_warnings(content),
        rates=_rates(content),
        **{f"{section}_figures": _frames(shown) for section, shown in sections.items()},
    )


# ---------------------------------------------------------------------------------------------- data


class _Columns:
    """Columns of numbers, each written once however often it is used."""

    def __init__(self) -> None:
        self._places: dict[bytes, int] = {}
        self._written: list[str] = []

    def place(self, values: FloatArray, digits: str = SIGNIFICANT) -> int:
        """Where a column stands; what is not finite is null."""
        values = np.asarray(values, dtype=np.float64)
        key = digits.encode() + values.tobytes()
        if key not in self._places:
            self._places[key] = len(self._written)
            finite = np.isfinite(values).tolist()
            numbers = (digits % value if good else "null" for value, good in zip(values.tolist(), finite, strict=True))
            self._written.append(f"[{','.join(numbers)}]")
        return self._places[key]

    def __str__(self) -> str:
        return f"[{','.join(self._written)}]"


def _document(content: ReportContent, shown: Sequence[Figure]) -> str:
    """All that the script draws, as JSON: columns of numbers, and what refers to them by their place."""
    columns = _Columns()
    document = {
        "headline": content.headline,
        "startNs": str(content.start_ns),
        "frames": columns.place(content.seconds(content.trajectories["raw"].stamps_ns), PRECISE),
        "paths": [_path(content, name, columns) for name in content.trajectories],
        "truth": _truth(content, columns),
        "loops": _loops(content),
        "fixes": _fixes(content, columns),
        "events": [_span(content, event) for event in content.events],
        "figures": [_figure(figure, columns) for figure in shown if figure.rows],
        "thumbnails": [
            {"t": content.second(each.stamp_ns), "jpeg": base64.b64encode(each.jpeg).decode()}
            for each in content.thumbnails
        ],
    }
    rest = json.dumps(document, allow_nan=False, ensure_ascii=False, separators=(",", ":"))
    return f'{{"columns":{columns},{rest[1:]}'


def _path(content: ReportContent, name: str, columns: _Columns) -> dict[str, Any]:
    """A trajectory in the first camera's axes, with the error and the sigma of every position where they are known."""
    trajectory = content.trajectories[name]
    found: dict[str, Any] = {"name": name, "label": label(name), **_positions(content, trajectory, columns)}
    if content.ground_truth is not None:
        series = errors_over_time(trajectory, content.ground_truth)
        error = np.full(len(trajectory), np.nan)
        error[np.isin(trajectory.stamps_ns, series.stamps_ns)] = np.linalg.norm(series.position_error_m, axis=1)
        if len(series.stamps_ns):
            found["error"] = columns.place(error, PLACES)
    if trajectory.covariances is not None:
        sigma = np.sqrt(np.trace(trajectory.covariances[:, 3:, 3:], axis1=1, axis2=2))
        found["sigma"] = columns.place(sigma, PLACES)
    return found


def _positions(content: ReportContent, trajectory: Trajectory, columns: _Columns) -> dict[str, int]:
    x, y, z = (columns.place(axis, PLACES) for axis in trajectory.poses.translation.T)
    return {"t": columns.place(content.seconds(trajectory.stamps_ns), PRECISE), "x": x, "y": y, "z": z}


def _truth(content: ReportContent, columns: _Columns) -> dict[str, int] | None:
    """The ground truth laid on the raw trajectory at the first frame that both know."""
    raw = content.trajectories["raw"]
    if content.ground_truth is None or not np.any(spanned := content.ground_truth.covers(raw.stamps_ns)):
        return None
    _, truth = common(raw, content.ground_truth)
    laid_on_raw = Trajectory(truth.stamps_ns, raw.poses[int(np.argmax(spanned))] * truth.poses)
    return _positions(content, laid_on_raw, columns)


def _fixes(content: ReportContent, columns: _Columns) -> list[dict[str, Any]]:
    """GNSS positions, those that were believed apart from the others."""
    if (known := content.fixes) is None:
        return []
    found = []
    for used in (True, False):
        if np.any(chosen := known.used == used):
            fixes = Trajectory(known.stamps_ns[chosen], RigidTransform.from_translation(known.places_m[chosen]))
            found.append({"used": used, **_positions(content, fixes, columns)})
    return found


def _loops(content: ReportContent) -> list[dict[str, Any]]:
    """From when to when each loop leads, and who believed it."""
    return [
        {
            "from": content.second(loop.source_stamp_ns),
            "to": content.second(loop.target_stamp_ns),
            "used": [name for name, used in content.loops_used.items() if i < len(used) and used[i]],
        }
        for i, loop in enumerate(content.loops)
    ]


def _span(content: ReportContent, event: Event) -> dict[str, Any]:
    start, end = content.second(event.start_ns), content.second(event.end_ns)
    return {"start": start, "end": end, "kind": event.kind, "fault": event.is_fault}


def _figure(figure: Figure, columns: _Columns) -> dict[str, Any]:
    """A figure with its numbers in the columns; names on the horizontal axis stay as they are."""
    rows = [
        {
            "label": row.label,
            "log": row.log,
            "lines": [
                asdict(line)
                | {
                    "x": columns.place(line.x, PRECISE) if isinstance(line.x, np.ndarray) else list(line.x),
                    "y": columns.place(line.y),
                    "middle": None if line.middle is None else columns.place(line.middle),
                }
                for line in row.lines
            ],
        }
        for row in figure.rows
    ]
    return {"key": figure.key, "xlabel": figure.xlabel, "timed": figure.timed, "rows": rows}


@cache
def _library() -> str:
    return _packed(files("plotly.package_data").joinpath("plotly.min.js").read_bytes())


def _packed(data: bytes) -> str:
    """Bytes as text for a script element: a third of their size; without a date, so that it is always the same."""
    return base64.b64encode(gzip.compress(data, compresslevel=6, mtime=0)).decode()


# ---------------------------------------------------------------------------------------------- tables


def _verdict(line: Verdict) -> str:
    first, *others = map(escape, line.sentences)
    rest = "".join(f" <span>{sentence}</span>" for sentence in others)
    return f'<p id="verdict" class="{line.status}">{first}{rest}</p>'


def _facts(content: ReportContent) -> str:
    """What was run over, in a line."""
    raw = content.trajectories["raw"]
    duration_s = (raw.stamps_ns[-1] - raw.stamps_ns[0]) / NANOSECONDS
    facts = [counted(len(raw), "frame"), f"{duration_s:.1f} s", counted(len(content.pairs), "pair estimate")]
    if content.imu is not None and len(content.imu):
        facts.append(counted(len(content.imu), "IMU sample"))
    facts.append("with ground truth" if content.ground_truth is not None else "no ground truth")
    return escape(" · ".join(facts))


def _metrics(content: ReportContent) -> str:
    """The table that a run prints: raw against fused, the best value of a row in bold."""
    names = list(content.trajectories)
    values = {name: asdict(content.metrics[name]) if name in content.metrics else {} for name in names}
    body = []
    for row in ROWS:
        measured = [values[name].get(row.key) for name in names]
        if all(value is None for value in measured):
            continue
        cells = [
            "<td>-</td>"
            if value is None
            else f"<td{' class=best' if best else ''}>{number(value * row.scale, row.decimals)}</td>"
            for value, best in zip(measured, row.best(measured), strict=True)
        ]
        body.append(
            f"<tr><th scope=row>{escape(row.label)} <small>{escape(row.unit)}</small></th>{''.join(cells)}</tr>"
        )
    for what, unit, cell in END_ROWS:
        cells = [f"<td>{escape(cell(content.trajectories[name]))}</td>" for name in names]
        body.append(f"<tr><th scope=row>{what} <small>{unit}</small></th>{''.join(cells)}</tr>")
    head = "".join(f'<th scope=col><i class="key {name}"></i>{escape(label(name))}</th>' for name in names)
    rule = f"<p class=caption>{RULE}</p>" if any(content.metrics.values()) else ""
    return f"<table class=numbers><thead><tr><th></th>{head}</tr></thead><tbody>{''.join(body)}</tbody></table>{rule}"


def _calibration(content: ReportContent) -> str:
    """What is known of the IMU and whether it was used, and what the back ends say."""
    rows: list[tuple[str, str]] = []
    if (known := content.calibration) is not None:
        rows.append(("IMU", f"{'calibrated' if known.used else 'left out'}: {known.reason}"))
        best = placement(known, content.mounting)
        rows += _placement(best)
        if content.mounting is not None:
            rows.append(("refined from", _moved(known, content.mounting)))
        bias, std = (", ".join(f"{1e3 * part:.3f}" for part in each) for each in (best.gyro_bias, best.gyro_bias_std))
        estimated = f"{bias} mrad/s, sigma {std}"
        rows.append(("gyro bias x, y, z", estimated if np.any(best.gyro_bias_std) else "taken to be zero"))
    rows += [(label(name), remark) for name, remark in content.remarks.items() if remark]
    return _pairs_table(rows)


def _placement(known: Placement) -> list[tuple[str, str]]:
    """How the IMU is mounted and what its clock reads, as metrics.json has it."""
    rows = []
    if known.rotation_imu_camera is not None:
        quat = ", ".join(f"{part:.5f}" for part in known.rotation_imu_camera.as_quat(scalar_first=True))
        rows.append(("mounting, v_imu = R v_camera", f"quaternion w x y z {quat}"))
        if known.rotation_std_rad is None:
            rows.append(("its sigma about x, y, z", "given"))
        else:
            std = ", ".join(f"{part:.3f}" for part in np.rad2deg(known.rotation_std_rad))
            rows.append(("its sigma about x, y, z", f"{std} deg"))
    std_s = known.time_offset_std_s
    deviation = " (given or not estimated)" if std_s is None else f" ± {1e3 * std_s:.2f} ms"
    rows.append(("time offset, IMU - camera", f"{1e3 * known.time_offset_s:.2f} ms{deviation}"))
    if known.lever_arm_m is not None and known.lever_arm_std_m is not None:
        arm = _with_std(known.lever_arm_m, known.lever_arm_std_m)
        rows.append(("lever arm", f"{arm} m, the IMU in camera axes"))
    return rows


def _moved(known: ImuCalibration, refined: Mounting) -> str:
    """How far refining moved what the calibration by the pairs, or a given value, began with."""
    turned = ", ".join(
        f"{angle:+.3f}" for angle in np.rad2deg((known.mounting.inv() * refined.rotation_imu_camera).as_rotvec())
    )
    return f"a calibration {turned} deg about x, y, z and {1e3 * refined.ahead_s:+.2f} ms away"


def _with_std(values: FloatArray, std: FloatArray) -> str:
    return ", ".join(f"{value:.3f} ± {deviation:.3f}" for value, deviation in zip(values, std, strict=True))


def _events(content: ReportContent) -> str:
    """What went wrong with the sensors, by kind; a click on one goes there."""
    if not content.events:
        return (
            "<p class=empty>No gaps, stuck or saturated sensors, clock jumps, dropped frames or wrong pairs found.</p>"
        )
    kind_and_topic = attrgetter("kind", "topic")
    groups = [list(group) for _, group in groupby(sorted(content.events, key=kind_and_topic), key=kind_and_topic)]
    parts = []
    for found in sorted(groups, key=lambda group: group[0].start_ns):
        kind, topic = kind_and_topic(found[0])
        lasted = sum(event.duration_s for event in found)
        times = f"{counted(len(found), 'time')}, {lasted:.1f} s in all"
        title = f"{escape(kind)} <code>{escape(topic)}</code> <small>{times}</small>"
        parts.append(f'<h4><i class="key {_slug(kind)}"></i>{title}</h4>')
        parts.append(_event_rows(content, found[:SHOWN_EVENTS]))
        if more := found[SHOWN_EVENTS:]:
            parts.append(f"<details><summary>{len(more)} more</summary>{_event_rows(content, more)}</details>")
    return "".join(parts)


def _event_rows(content: ReportContent, found: Sequence[Event]) -> str:
    rows = []
    for event in found:
        start, end = content.second(event.start_ns), content.second(event.end_ns)
        rows.append(
            f'<tr data-seconds="{start:.3f}"><td><button>{start:.2f} to {end:.2f} s</button></td>'
            f"<td>{escape(event.text)}</td></tr>"
        )
    return f"<table class=events><tbody>{''.join(rows)}</tbody></table>"


def _warnings(content: ReportContent) -> str:
    """Counts by name, and a line for each finding."""
    if not content.warnings and not content.notes:
        return "<p class=empty>No warnings.</p>"
    counts = _pairs_table([(name.replace("_", " "), str(count)) for name, count in content.warnings.items()])
    return counts + "".join(f"<p class=note>{escape(note)}</p>" for note in content.notes)


def _rates(content: ReportContent) -> str:
    """How many samples of each sensor there are, how often they come, and how evenly."""
    head = "".join(f"<th scope=col>{word}</th>" for word in ("samples", "rate, Hz", "jitter, ms", "longest gap, s"))
    body = "".join(
        f"<tr><th scope=row>{escape(content.topic(role))}</th>{_rate_cells(stamps)}</tr>"
        for role, stamps in sensor_stamps(content).items()
    )
    return f"<table class=numbers><thead><tr><th></th>{head}</tr></thead><tbody>{body}</tbody></table>"


def _rate_cells(stamps_ns: IntArray) -> str:
    period_s = np.diff(stamps_ns) / NANOSECONDS
    if not len(period_s):
        return f"<td>{len(stamps_ns)}</td><td>-</td><td>-</td><td>-</td>"
    usual = float(np.median(period_s))
    jitter_ms = 1e3 * float(np.median(np.abs(period_s - usual)))
    numbers = f"{1.0 / usual:.2f}", f"{jitter_ms:.2f}", f"{np.max(period_s):.3f}"
    return f"<td>{len(stamps_ns)}</td>" + "".join(f"<td>{number}</td>" for number in numbers)


def _pairs_table(rows: Iterable[tuple[str, str]]) -> str:
    body = "".join(f"<tr><th scope=row>{escape(name)}</th><td>{escape(value)}</td></tr>" for name, value in rows)
    return f"<table class=pairs><tbody>{body}</tbody></table>"


def _frames(shown: Sequence[Figure]) -> str:
    """The places of figures, with what each shows or why it is empty."""
    return "".join(
        f'<figure id="{each.key}" class="{"time" if each.timed else "other"}"><h3>{escape(each.title)}</h3>'
        + (
            f"<p class=caption>{escape(each.caption)}</p>"
            f'<div class="plot" style="--rows:{len(each.rows)};--listed:{_listed(each)}"></div>'
            if each.rows
            else f"<p class=empty>{escape(each.missing)}</p>"
        )
        + "</figure>"
        for each in shown
    )


def _listed(figure: Figure) -> int:
    """How many lines its legend names."""
    return len({line.name for row in figure.rows for line in row.lines if line.legend and line.mode != "band"})


def _slug(kind: str) -> str:
    return kind.lower().replace(" ", "-")
