"""The table a run prints: raw against fused, one row a measure, readable on 80 columns and in a pipe."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text
from scipy.spatial.transform import Rotation

from fusion.evaluation import anees_bounds
from fusion_io.records import Trajectory

Metrics = Mapping[str, float | int | None]

HEADINGS = {
    "raw": "raw",
    "posegraph": "pose graph",
    "posegraph_online": "online",
    "ekf": "EKF",
    "ekf_smoothed": "smoothed",
}

WIDTH_OF_NUMBER = 9
EQUAL = 1e-9  # relative: what differs less is the same result in other digits

RULE = "Lower is better; ANEES: 3 is right, above {1:.1f} is overconfident, below {0:.1f} timid.".format(
    *anees_bounds()
)


@dataclass(frozen=True)
class _Row:
    """One measure: its key in metrics.json, how it is shown, and the value that would be right."""

    key: str
    label: str
    unit: str
    decimals: int
    scale: float = 1.0
    right: float = 0.0

    def best(self, values: Sequence[float | int | None]) -> list[bool]:
        """Which of the values are nearest to what would be right, as `best_of`."""
        return best_of([None if value is None else abs(value - self.right) for value in values])


ROWS = (
    _Row("t_rel_percent", "t_rel", "%", 3),
    _Row("r_rel_deg_per_100m", "r_rel", "deg/100 m", 3),
    _Row("ate_m", "ATE, aligned", "m", 3),
    _Row("end_error_m", "end-point error", "m", 3),
    _Row("rpe_translation_m", "RPE a pair, translation", "m", 4),
    _Row("rpe_rotation_rad", "RPE a pair, rotation", "mrad", 3, scale=1e3),
    _Row("anees_position", "ANEES, position", "3 is right", 2, right=3.0),
    _Row("anees_orientation", "ANEES, orientation", "3 is right", 2, right=3.0),
)


def print_table(
    console: Console, title: str, trajectories: Mapping[str, Trajectory], metrics: Mapping[str, Metrics]
) -> None:
    """Print all trajectories side by side; measures that nothing could be said about are left out."""
    table = Table(box=box.SIMPLE_HEAD)
    table.add_column("")
    table.add_column("")
    for name in trajectories:
        table.add_column(HEADINGS[name], justify="right", no_wrap=True)
    for row in ROWS:
        values = [metrics[name][row.key] for name in trajectories]
        if any(value is not None for value in values):
            table.add_row(row.label, Text(row.unit), *_cells(row, values))
    table.add_section()
    for label, unit, cell in END_ROWS:
        table.add_row(label, unit, *map(cell, trajectories.values()))
    console.print(Text(title))
    console.print(table)
    console.print(Text(_legend(metrics)))


def _cells(row: _Row, values: Sequence[float | int | None]) -> list[Text]:
    """The values of a row, the best one in bold (seen on a terminal only)."""
    return [
        Text("-") if value is None else Text(number(value * row.scale, row.decimals), style="bold" if best else "")
        for value, best in zip(values, row.best(values), strict=True)
    ]


def best_of(distances: Sequence[float | None]) -> list[bool]:
    """Which of the distances from what is right are the least; none where all are equal, or there is but one."""
    known = [each for each in distances if each is not None]
    if len(known) < 2 or max(known) - min(known) <= EQUAL * max(known):
        return [False] * len(distances)
    return [each is not None and each - min(known) <= EQUAL * max(known) for each in distances]


def number(value: float, decimals: int) -> str:
    """A number of at most nine characters, so that even a diverged result leaves the table in shape."""
    text = f"{value:.{decimals}f}"
    return text if len(text) <= WIDTH_OF_NUMBER else f"{value:.2e}"


def _legend(metrics: Mapping[str, Metrics]) -> str:
    if all(values["ate_m"] is None for values in metrics.values()):
        return "No ground truth for these frames in the log, so no errors can be given."
    if all(values["t_rel_percent"] is None for values in metrics.values()):
        return f"{RULE} No t_rel: the path is shorter than the shortest of --segment-lengths."
    return RULE


def _position_sigma(trajectory: Trajectory) -> str:
    return "-" if trajectory.end_sigmas is None else number(trajectory.end_sigmas[0], 2)


def _orientation_sigma(trajectory: Trajectory) -> str:
    return "-" if trajectory.end_sigmas is None else number(float(np.rad2deg(trajectory.end_sigmas[1])), 3)


END_ROWS: Sequence[tuple[str, str, Callable[[Trajectory], str]]] = (
    ("path length", "m", lambda trajectory: number(trajectory.path_length_m, 1)),
    ("stated sigma at the end", "m", _position_sigma),
    ("stated sigma at the end", "deg", _orientation_sigma),
)
"""What needs no ground truth: name, unit, and how it is shown."""


def end_lines(trajectories: Mapping[str, Trajectory]) -> list[str]:
    """Where the camera was at the end by each trajectory, and how turned; how sure that is stands in the table."""
    places = {name: each.poses.translation[-1].tolist() for name, each in trajectories.items()}
    turns = {name: turned_deg(each.poses.rotation[-1]) for name, each in trajectories.items()}
    return [
        f"At the end, right, down and ahead of the start: {_side_by_side(places, 'm')}",
        f"Turned right, up and clockwise by then: {_side_by_side(turns, 'deg')}",
    ]


def _side_by_side(values: Mapping[str, Sequence[float]], unit: str) -> str:
    return "; ".join(
        f"{HEADINGS[name]} {', '.join(f'{value:z.1f}' for value in three)} {unit}" for name, three in values.items()
    )


def turned_deg(rotation: Rotation) -> tuple[float, float, float]:
    """How far a camera that began level is turned to the right, then up, then clockwise about its view, in degrees."""
    matrix = rotation.as_matrix()
    ahead, level = matrix[:, 2], matrix[1, :2]
    angles = np.arctan2([ahead[0], -ahead[1], level[0]], [ahead[2], np.hypot(*level), level[1]])
    right, up, clockwise = np.rad2deg(angles).tolist()
    return right, up, clockwise
