"""Every trajectory of a log is found, ours and those of others; what is not a pose is left out and counted."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from log_samples import SECOND, START, pair_estimates, trajectory, write_raw
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import RigidTransform, Rotation

from fusion_io import messages
from fusion_io.errors import LogError, UsageError
from fusion_io.messages import PoseSample
from fusion_io.odometry import name_of, only_trajectory, read_trajectories, trajectory_on
from fusion_io.reader import open_log
from fusion_io.records import Trajectory
from fusion_io.writer import LogWriter


def _odometry(topic: str, stamp: int, pose: PoseSample) -> tuple[str, str, int, bytes]:
    return topic, messages.ODOMETRY, stamp, messages.encode_odometry(stamp, pose, "base_link")


def _pose(x: float) -> PoseSample:
    return PoseSample(np.array([x, 0.0, 0.0]), np.array([1.0, 0.0, 0.0, 0.0]))


def test_what_a_run_writes_reads_back_with_covariances_and_ground_truth(tmp_path: Path) -> None:
    raw, ekf, truth = (trajectory(covariances=seed < 2, seed=seed) for seed in range(3))
    with LogWriter(tmp_path / "run.mcap", {"config": {"toml": 'backend = "ekf"'}}) as log:
        log.ground_truth(truth)
        log.trajectory("ekf", ekf)
        log.trajectory("raw", raw)
    recorded = read_trajectories(tmp_path / "run.mcap")
    assert list(recorded.trajectories) == ["raw", "ekf"]
    assert recorded.metadata["config"]["toml"] == 'backend = "ekf"'
    assert (recorded.damaged, recorded.notes) == (False, ())
    assert recorded.ground_truth is not None
    for read, written in ((recorded.trajectories["raw"], raw), (recorded.ground_truth, truth)):
        assert_array_equal(read.stamps_ns, written.stamps_ns)
        assert_allclose(read.poses.as_matrix(), written.poses.as_matrix(), atol=1e-12)
    read_covariances = recorded.trajectories["ekf"].covariances
    assert read_covariances is not None
    assert ekf.covariances is not None
    assert_allclose(read_covariances, ekf.covariances, atol=1e-9)
    assert recorded.ground_truth.covariances is None


def test_a_first_pose_without_uncertainty_keeps_the_covariances_of_the_others(tmp_path: Path) -> None:
    covariances = np.tile(0.01 * np.eye(6), (3, 1, 1))
    covariances[0] = 0.0
    poses = RigidTransform.from_components(np.zeros((3, 3)), Rotation.identity(3))
    with LogWriter(tmp_path / "run.mcap") as log:
        log.trajectory("raw", Trajectory(START + np.arange(3), poses, covariances))
    read = read_trajectories(tmp_path / "run.mcap").trajectories["raw"].covariances
    assert read is not None
    assert_allclose(read, covariances, atol=1e-15)


def test_poses_of_others_are_named_by_their_topics(tmp_path: Path) -> None:
    stamped = [
        ("/slam/pose", messages.POSE_STAMPED, START + k, messages.encode_pose(START + k, _pose(k))) for k in range(3)
    ]
    odometry = [_odometry("/odom", START + k, _pose(k)) for k in range(4)]
    path = write_raw(tmp_path / "others.mcap", [*stamped, *odometry])
    recorded = read_trajectories(path)
    assert {name: len(each) for name, each in recorded.trajectories.items()} == {"slam_pose": 3, "odom": 4}
    assert recorded.ground_truth is None
    with pytest.raises(LogError, match="which of its trajectories"):
        only_trajectory(path, recorded)


@pytest.mark.parametrize(
    ("topic", "name"), [("/odometry/ekf", "ekf"), ("/a/b-c", "a_b_c"), ("/3d", "_3d"), ("/", "trajectory")]
)
def test_names_are_identifiers(topic: str, name: str) -> None:
    assert name_of(topic) == name
    assert name_of(topic).isidentifier()


def test_topics_whose_names_are_the_same_lose_nothing(tmp_path: Path) -> None:
    topics = ("/a/b", "/a_b")
    path = write_raw(
        tmp_path / "log.mcap", [_odometry(topic, START + k, _pose(k)) for topic in topics for k in range(2)]
    )
    assert len(read_trajectories(path).trajectories) == 2


def test_a_covariance_that_is_not_finite_is_none_and_costs_no_pose(tmp_path: Path) -> None:
    """As both readers have it: poses by themselves, and those of a log with roles."""
    covariance = 0.01 * np.eye(6)
    poses = [replace(_pose(k), covariance=np.full((6, 6), np.nan) if k == 1 else covariance) for k in range(3)]
    odometry = [_odometry("/odometry/ekf", START + k * SECOND, pose) for k, pose in enumerate(poses)]
    truth = ("/ground_truth", messages.POSE_STAMPED, START, messages.encode_pose(START, _pose(0)))
    path = write_raw(tmp_path / "log.mcap", [*odometry, truth])
    for found in (read_trajectories(path).trajectories["ekf"], open_log(path).trajectory("ekf")):
        assert found is not None
        assert found.covariances is not None
        assert_allclose(found.covariances, np.stack([covariance, np.zeros((6, 6)), covariance]), atol=1e-12)


def test_bad_poses_are_left_out_and_counted(tmp_path: Path) -> None:
    nan = PoseSample(np.array([np.nan, 0.0, 0.0]), np.array([1.0, 0.0, 0.0, 0.0]))
    unset = PoseSample(np.zeros(3), np.zeros(4))
    samples = [(0, _pose(0)), (1, nan), (2, unset), (3, _pose(3)), (4, _pose(4)), (1, _pose(1)), (5, _pose(5))]
    items = [_odometry("/odom", START + k * SECOND, pose) for k, pose in samples]
    items.append(("/odom", messages.ODOMETRY, START + 9 * SECOND, b"\0\1\0\0short"))
    recorded = read_trajectories(write_raw(tmp_path / "log.mcap", items))
    found = recorded.trajectories["odom"]
    assert found.poses.translation[:, 0].tolist() == [0.0, 3.0, 4.0, 5.0]
    (note,) = recorded.notes
    assert "/odom: 4 poses are left out" in note


def test_the_trajectory_on_a_topic_is_taken_or_what_there_is_is_named(tmp_path: Path) -> None:
    two = [_odometry(topic, START + k * SECOND, _pose(k)) for k in range(3) for topic in ("/odom", "/slam/pose")]
    path = write_raw(tmp_path / "two.mcap", two)
    recorded = read_trajectories(path)
    assert len(trajectory_on(path, recorded, "/slam/pose")) == 3
    for topic, reason, error in (
        (None, "which of its trajectories?", LogError),
        ("/x", "no trajectory on /x.", UsageError),  # the user named it
    ):
        with pytest.raises(error) as caught:
            trajectory_on(path, recorded, topic)
        assert str(caught.value) == f"{path}: {reason} It holds odom, slam_pose; choose one with --topic"
    path = write_raw(tmp_path / "one.mcap", two[::2])
    assert len(trajectory_on(path, read_trajectories(path), None)) == 3


def test_a_log_without_poses_has_no_trajectories(tmp_path: Path) -> None:
    with LogWriter(tmp_path / "pairs.mcap") as log:
        log.pairs(pair_estimates())
    assert read_trajectories(tmp_path / "pairs.mcap").trajectories == {}


def test_a_cut_log_gives_what_is_left_and_says_so(tmp_path: Path) -> None:
    with LogWriter(tmp_path / "whole.mcap") as log:
        log.trajectory("raw", trajectory(count=2000, covariances=True))
    data = (tmp_path / "whole.mcap").read_bytes()
    (tmp_path / "cut.mcap").write_bytes(data[: len(data) // 2])
    recorded = read_trajectories(tmp_path / "cut.mcap")
    assert recorded.damaged
    assert recorded.notes


def test_logs_of_others_are_read(shared_data: Path) -> None:
    recorded = read_trajectories(shared_data / "foreign_mcap" / "nav2_turtlebot.mcap")
    assert {name: len(each) for name, each in recorded.trajectories.items()} == {"amcl_pose": 135, "odom": 2639}
