"""The table of a run is complete and fits where it is printed."""

from io import StringIO

import numpy as np
import pytest
from rich.console import Console
from scipy.spatial.transform import RigidTransform, Rotation

from fusion.table import ROWS, best_of, end_lines, print_table, turned_deg
from fusion_io.records import Trajectory

NAMES = ("raw", "posegraph", "ekf")


def _trajectory() -> Trajectory:
    poses = RigidTransform.from_translation([[0.0, 0.0, 0.0], [0.0, 0.0, 3.0], [4.0, 0.0, 3.0]])
    return Trajectory(np.arange(3), poses, np.tile(np.eye(6), (3, 1, 1)))


def _printed(metrics: dict[str, dict[str, float | None]]) -> str:
    """What a pipe of 80 columns receives."""
    file = StringIO()
    console = Console(file=file, width=80, force_terminal=False)
    print_table(console, "seq[09].mcap", {name: _trajectory() for name in metrics}, metrics)
    return file.getvalue()


def _metrics(value: float | None) -> dict[str, float | None]:
    return {row.key: value for row in ROWS}


@pytest.mark.parametrize("value", [0.0, 1.5, 1234.5678, 9.87e12])
def test_every_measure_and_every_trajectory_is_shown_within_80_columns(value: float) -> None:
    text = _printed({name: _metrics(value) for name in NAMES})
    assert max(map(len, text.splitlines())) <= 80
    for row in ROWS:
        assert sum(row.label in line and row.unit in line for line in text.splitlines()) == 1
    for heading in ("raw", "pose graph", "EKF", "seq[09].mcap"):
        assert heading in text


def test_numbers_are_shown_in_the_unit_of_their_row() -> None:
    text = _printed({"raw": _metrics(0.0123)})
    line = next(line for line in text.splitlines() if "mrad" in line)
    assert line.split()[-1] == "12.300"


@pytest.mark.parametrize("name", NAMES)
def test_path_and_stated_uncertainty_need_no_ground_truth(name: str) -> None:
    text = _printed({name: _metrics(None)})
    assert "No ground truth" in text
    assert "t_rel" not in text
    assert next(line for line in text.splitlines() if "path length" in line).split()[-1] == "7.0"
    sigmas = [line.split()[-2:] for line in text.splitlines() if "stated sigma" in line]
    assert sigmas == [["m", "1.73"], ["deg", f"{np.rad2deg(np.sqrt(3.0)):.3f}"]]


def test_a_log_shorter_than_a_segment_says_so() -> None:
    assert "--segment-lengths" in _printed({"raw": _metrics(1.0) | {"t_rel_percent": None}})


@pytest.mark.parametrize("missing", [{}, {"t_rel_percent": None}])
def test_what_stands_under_the_table_is_right_for_all_its_rows(missing: dict[str, None]) -> None:
    """Lower is better of all but the rows whose unit says what is right."""
    text = " ".join(_printed({"raw": _metrics(1.0) | missing}).split())
    other = {(row.label.partition(",")[0], row.right) for row in ROWS if row.right}
    assert other == {("ANEES", 3.0)}
    assert "Lower is better; ANEES: 3 is right, above 4.7 is overconfident, below 1.7 timid." in text


@pytest.mark.parametrize(
    ("right_deg", "up_deg", "clockwise_deg"),
    [(170.0, 0.0, 0.0), (0.0, 20.0, 0.0), (0.0, 0.0, 10.0), (-30.0, -20.0, -9.0)],
)
def test_the_end_is_told_as_places_and_turns(right_deg: float, up_deg: float, clockwise_deg: float) -> None:
    """About the camera's y axis, which is down, its x axis, and its z axis, which is ahead, in this order."""
    rotation = Rotation.from_euler("YXZ", [right_deg, up_deg, clockwise_deg], degrees=True)
    poses = RigidTransform.from_components([[0.0, 0.0, 0.0], [1.0, -0.04, 3.0]], Rotation.concatenate([rotation] * 2))
    assert end_lines({"raw": Trajectory(np.arange(2), poses)}) == [
        "At the end, right, down and ahead of the start: raw 1.0, 0.0, 3.0 m",
        f"Turned right, up and clockwise by then: raw {right_deg}, {up_deg}, {clockwise_deg} deg",
    ]


def test_a_camera_that_looks_straight_up_at_the_end_is_turned_up() -> None:
    """There right and clockwise cannot be told apart."""
    rotation = Rotation.from_euler("YXZ", [30.0, 90.0, 15.0], degrees=True)
    assert turned_deg(rotation)[1] == pytest.approx(90.0)


@pytest.mark.parametrize(
    ("distances", "best"),
    [
        ([2.0, 1.0, None], [False, True, False]),
        ([1.0, 1.0, 2.0], [True, True, False]),
        ([1.0, 1.0 + 1e-12], [False, False]),
        ([1.0, None], [False, False]),
        ([0.0, 0.0], [False, False]),
        ([None], [False]),
    ],
)
def test_the_best_is_better_than_another(distances: list[float | None], best: list[bool]) -> None:
    assert best_of(distances) == best
