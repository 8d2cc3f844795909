"""The pictures show every trajectory, in metres and seconds, with or without ground truth."""

from io import BytesIO

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.spatial.transform import RigidTransform, Rotation

from fusion.plots import STYLES, plot_errors, plot_trajectories
from fusion_io.records import NANOSECONDS, Trajectory

FRAMES = 50


def _arc(error_m: float = 0.0) -> Trajectory:
    """A bend to the right; `error_m` is how far off to the right the last pose is."""
    angle = np.linspace(0.0, 1.0, FRAMES)
    position = np.stack([20.0 * (1.0 - np.cos(angle)) + error_m * angle, 0.0 * angle, 20.0 * np.sin(angle)], axis=1)
    rotation = Rotation.from_rotvec(angle[:, None] * [0.0, 1.0, 0.0])
    covariances = np.eye(6) * np.linspace(0.0, 1.0, FRAMES)[:, None, None]
    stamps_ns = NANOSECONDS + (np.arange(FRAMES) * NANOSECONDS) // 10
    return Trajectory(stamps_ns, RigidTransform.from_components(position, rotation), covariances)


@pytest.fixture
def trajectories() -> dict[str, Trajectory]:
    return {"raw": _arc(2.0), "posegraph": _arc(0.5), "ekf": _arc(1.0)}


def _lines(axes: object) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    return {line.get_label(): line.get_data() for line in axes.get_lines()}  # type: ignore[attr-defined]


def test_the_top_view_draws_x_against_z_of_every_trajectory_at_one_scale(trajectories: dict[str, Trajectory]) -> None:
    axes = plot_trajectories("log", trajectories, _arc()).axes[0]
    lines = _lines(axes)
    for name, trajectory in trajectories.items():
        assert_allclose(lines[STYLES[name]["label"]], trajectory.poses.translation[:, [0, 2]].T)
    assert_allclose(lines["ground truth"], _arc().poses.translation[:, [0, 2]].T, atol=1e-9)
    (start,), ends = (
        [line.get_xydata() for line in axes.get_lines() if line.get_marker() == marker and len(line.get_xdata())]
        for marker in "os"
    )
    assert_allclose(start, [[0.0, 0.0]])
    for trajectory in trajectories.values():
        assert any(np.allclose(end, trajectory.poses.translation[-1, [0, 2]]) for end in ends)
    assert {"start", "end"} <= lines.keys()
    assert axes.get_aspect() == 1.0
    assert axes.get_title() == "log"
    assert "[m]" in axes.get_xlabel()
    assert "[m]" in axes.get_ylabel()


def test_ground_truth_in_another_world_and_from_later_on_is_laid_on_raw(trajectories: dict[str, Trajectory]) -> None:
    other_world = RigidTransform.from_components([5.0, 6.0, 7.0], Rotation.from_euler("xyz", [0.3, 0.2, 0.1]))
    late = Trajectory(_arc().stamps_ns[10:], other_world * _arc().poses[10:])
    lines = _lines(plot_trajectories("log", {"raw": _arc()}, late).axes[0])
    assert_allclose(lines["ground truth"], _arc().poses.translation[10:, [0, 2]].T, atol=1e-9)


def test_the_errors_are_norms_over_seconds_and_the_sigma_is_tripled(trajectories: dict[str, Trajectory]) -> None:
    position, orientation = plot_errors("log", trajectories, _arc()).axes
    seconds, error = _lines(position)["raw"]
    assert_allclose(seconds, np.arange(FRAMES) / 10)
    assert_allclose(error, 2.0 * np.linspace(0.0, 1.0, FRAMES), atol=1e-9)
    assert_allclose(_lines(orientation)["raw"][1], 0.0, atol=1e-6)
    dotted = [
        line.get_ydata() for line in position.get_lines() if line.get_linestyle() == ":" and len(line.get_xdata())
    ]
    assert len(dotted) == len(trajectories)
    assert_allclose(dotted[0], 3.0 * np.sqrt(3.0 * np.linspace(0.0, 1.0, FRAMES)))


def test_without_ground_truth_the_sigmas_are_shown_alone(trajectories: dict[str, Trajectory]) -> None:
    assert "ground truth" not in _lines(plot_trajectories("log", trajectories, None).axes[0])
    position, orientation = plot_errors("log", trajectories, None).axes
    assert_allclose(_lines(position)["EKF"][1], 3.0 * np.sqrt(3.0 * np.linspace(0.0, 1.0, FRAMES)))
    assert "3 sigma" in position.get_ylabel()
    assert "[deg]" in orientation.get_ylabel()


def test_ground_truth_of_another_day_is_no_reason_to_fail(trajectories: dict[str, Trajectory]) -> None:
    elsewhen = Trajectory(_arc().stamps_ns + 10**15, _arc().poses)
    assert "ground truth" not in _lines(plot_trajectories("log", trajectories, elsewhen).axes[0])
    assert len(plot_errors("log", trajectories, elsewhen).axes) == 2


def test_the_same_trajectories_give_the_same_picture(trajectories: dict[str, Trajectory]) -> None:
    pictures = []
    for _ in range(2):
        buffer = BytesIO()
        plot_trajectories("log", trajectories, _arc()).savefig(buffer, format="png")
        pictures.append(buffer.getvalue())
    assert pictures[0].startswith(b"\x89PNG")
    assert pictures[0] == pictures[1]
