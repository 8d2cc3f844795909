"""Trajectories as text: what is written reads back bit for bit, and whatever is wrong is refused by file and line."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import RigidTransform, Rotation

from fusion_io.errors import LogError, UsageError
from fusion_io.records import Trajectory
from fusion_io.trajectory_files import (
    file_format,
    nanoseconds,
    pair_estimates,
    read_euroc,
    read_indexed_kitti_poses,
    read_kitti,
    read_kitti_poses,
    read_times,
    read_trajectory,
    read_tum,
    rotation_error,
    seconds,
    write_kitti,
    write_tum,
)

IDENTITY = "1 0 0 0 0 1 0 0 0 0 1 0"


def random_trajectory(count: int = 20, seed: int = 0) -> Trajectory:
    rng = np.random.default_rng(seed)
    poses = RigidTransform.from_components(rng.normal(0, 100, (count, 3)), Rotation.random(count, rng=rng))
    return Trajectory(1_317_046_536_016_685_824 + np.arange(count) * 103_700_001, poses)


def written(path: Path, *lines: str) -> Path:
    path.write_text("\n".join(lines) + "\n")
    return path


# ----------------------------------------------------------------------------------------------------- times


@given(st.integers(-(2**63) + 1, 2**63 - 1))
def test_seconds_and_nanoseconds_are_inverse_for_every_64_bit_stamp(stamp_ns):
    assert nanoseconds(seconds(stamp_ns)) == stamp_ns


def test_times_are_exact_where_floating_point_is_not(tmp_path):
    """Doubles of this size are 238 ns apart."""
    assert_array_equal(
        read_times(written(tmp_path / "times.txt", "1317046536.016685824", "1317046536.016685825")),
        [1317046536016685824, 1317046536016685825],
    )


def test_kitti_times_in_scientific_notation(tmp_path):
    assert_array_equal(read_times(written(tmp_path / "t", "0.000000e+00", "1.044989e-01")), [0, 104_498_900])


@pytest.mark.parametrize(
    ("lines", "reason"),
    [
        (["0", "nan"], "line 2: not a possible time"),
        (["0", "abc"], "line 2: not a time"),
        (["0", "1", "1"], "line 3: its time is not later"),
        (["1", "0"], "line 2: its time is not later"),
        (["0 1"], "line 1: 2 columns where 1 are expected"),
        (["1e30"], "line 1: not a possible time"),
        (["# only a comment"], "holds no data"),
    ],
)
def test_times_that_are_refused(tmp_path, lines, reason):
    with pytest.raises(LogError, match=reason):
        read_times(written(tmp_path / "times.txt", *lines))


def test_a_missing_file_a_folder_and_a_binary_file_are_refused_by_name(tmp_path):
    with pytest.raises(LogError, match=r"gone\.txt: No such file"):
        read_times(tmp_path / "gone.txt")
    with pytest.raises(LogError, match="Is a directory"):
        read_times(tmp_path)
    (tmp_path / "image.png").write_bytes(b"\x89PNG\xff\xfe")
    with pytest.raises(LogError, match=r"image\.png: not a text file"):
        read_times(tmp_path / "image.png")


# ----------------------------------------------------------------------------------------------- round trips


def test_tum_reads_back_with_equal_stamps_and_poses(tmp_path):
    trajectory = random_trajectory()
    write_tum(tmp_path / "a.tum", trajectory)
    again = read_tum(tmp_path / "a.tum")
    assert_array_equal(again.stamps_ns, trajectory.stamps_ns)
    assert_array_equal(again.poses.translation, trajectory.poses.translation)
    assert_allclose(again.poses.as_matrix(), trajectory.poses.as_matrix(), rtol=0, atol=1e-15)


def test_kitti_reads_back_with_equal_poses(tmp_path):
    trajectory = random_trajectory()
    write_kitti(tmp_path / "a.txt", trajectory)
    again = read_kitti_poses(tmp_path / "a.txt")
    assert_array_equal(again[:, :3, 3], trajectory.poses.translation)
    assert_allclose(again, trajectory.poses.as_matrix(), rtol=0, atol=1e-15)


def test_a_trajectory_of_no_poses_is_an_empty_file(tmp_path):
    empty = Trajectory(np.zeros(0, dtype=np.int64), RigidTransform.identity(0))
    write_tum(tmp_path / "a.tum", empty)
    write_kitti(tmp_path / "a.txt", empty)
    assert (tmp_path / "a.tum").read_bytes() == b"" == (tmp_path / "a.txt").read_bytes()


def test_comments_blank_lines_byte_order_mark_and_windows_line_ends_are_skipped(tmp_path):
    path = tmp_path / "a.tum"
    path.write_bytes(b"\xef\xbb\xbf# stamp tx ty tz qx qy qz qw\r\n\r\n0.5 1 2 3 0 0 0 1\r\n")
    assert read_tum(path).stamps_ns == [500_000_000]


def test_a_file_that_cannot_be_written_is_an_error(tmp_path):
    with pytest.raises(LogError, match="No such file or directory"):
        write_tum(tmp_path / "gone" / "a.tum", random_trajectory())


# ----------------------------------------------------------------------------------------------------- poses


def test_an_index_column_says_which_frames_the_poses_belong_to(tmp_path):
    path = written(tmp_path / "poses.txt", f"2 {IDENTITY}", f"3 {IDENTITY}", f"7.0 {IDENTITY}")
    frames, poses = read_indexed_kitti_poses(path)
    assert_array_equal(frames, [2, 3, 7])
    assert poses.shape == (3, 4, 4)
    stamps_ns = np.arange(8) * 100
    assert_array_equal(read_kitti(path, stamps_ns).stamps_ns, [200, 300, 700])


def test_rotations_rounded_to_three_decimals_are_moved_to_rotations(tmp_path):
    matrices = np.round(random_trajectory().poses.as_matrix(), 3)
    path = tmp_path / "poses.txt"
    np.savetxt(path, matrices[:, :3].reshape(-1, 12), fmt="%.3f")
    poses = read_kitti_poses(path)
    assert_allclose(rotation_error(poses[:, :3, :3]), 0, atol=1e-14)
    assert_allclose(poses, matrices, atol=2e-3)


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        ("1 0 0 0 0 1 0 0 0 0 1", "line 2: 11 columns where 12 are expected"),
        (f"1 {IDENTITY}", "line 2: 13 columns where 12 are expected"),
        ("1 0 0 nan 0 1 0 0 0 0 1 0", "line 2: not a finite number"),
        ("1 0 0 x 0 1 0 0 0 0 1 0", "line 2: not a number"),
        ("2 0 0 0 0 2 0 0 0 0 2 0", "line 2: not a rotation"),
        ("1 0 0 0 0 1 0 0 0 0 -1 0", "line 2: not a rotation"),
        ("0 0 0 0 0 0 0 0 0 0 0 0", "line 2: not a rotation"),
    ],
)
def test_kitti_poses_that_are_refused(tmp_path, line, reason):
    with pytest.raises(LogError, match=reason):
        read_kitti_poses(written(tmp_path / "poses.txt", IDENTITY, line))


@pytest.mark.parametrize("index", ["0", "-1", "1.5", "nan"])
def test_an_index_that_is_no_later_frame_is_refused(tmp_path, index):
    with pytest.raises(LogError, match="line 2"):
        read_indexed_kitti_poses(written(tmp_path / "poses.txt", f"0 {IDENTITY}", f"{index} {IDENTITY}"))


def test_poses_that_do_not_fit_the_times_are_refused(tmp_path):
    plain = written(tmp_path / "plain.txt", IDENTITY, IDENTITY)
    indexed = written(tmp_path / "indexed.txt", f"3 {IDENTITY}")
    with pytest.raises(LogError, match="2 poses do not fit 3 time stamps"):
        read_kitti(plain, np.arange(3))
    with pytest.raises(LogError, match="frame 3 has no time"):
        read_kitti(indexed, np.arange(3))


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        ("1 0 0 0 0 0 0", "7 columns where 8 are expected"),
        ("1 0 0 0 0 0 0 2", "not a rotation"),
        ("1 0 0 0 0 0 0 0", "not a rotation"),
        ("1 inf 0 0 0 0 0 1", "not a finite number"),
        ("0 0 0 0 0 0 0 1", "its time is not later"),
    ],
)
def test_tum_lines_that_are_refused(tmp_path, line, reason):
    with pytest.raises(LogError, match=f"line 2: .*{reason}"):
        read_tum(written(tmp_path / "a.tum", "0 0 0 0 0 0 0 1", line))


def test_the_format_is_told_by_the_number_of_columns(tmp_path):
    stamps_ns = np.array([5])
    assert read_trajectory(written(tmp_path / "a", "1 0 0 0 0 0 0 1"), None).stamps_ns == [10**9]
    assert read_trajectory(written(tmp_path / "b", IDENTITY), stamps_ns).stamps_ns == [5]
    with pytest.raises(UsageError, match="--times"):
        read_trajectory(written(tmp_path / "c", IDENTITY), None)
    with pytest.raises(LogError, match="9 columns where 8 or 12 or 13 are expected"):
        read_trajectory(written(tmp_path / "d", "1 2 3 4 5 6 7 8 9"), stamps_ns)


# ----------------------------------------------------------------------------------------------------- pairs


def test_chained_pairs_return_the_trajectory():
    trajectory = random_trajectory(200)
    pairs = pair_estimates(trajectory, 0.1, 0.01)
    pose = trajectory.poses[0]
    for pair, expected, stamp_ns in zip(pairs, trajectory.poses[1:], trajectory.stamps_ns[1:], strict=True):
        pose = pose * pair.T_source_target
        assert pair.target_stamp_ns == stamp_ns
        assert_allclose(pose.as_matrix(), expected.as_matrix(), rtol=0, atol=1e-10)


def test_covariance_is_rotation_first_and_per_axis():
    pair = pair_estimates(random_trajectory(2), sigma_translation=0.1, sigma_rotation=0.01)[0]
    assert_allclose(pair.covariance, np.diag([1e-4] * 3 + [1e-2] * 3), rtol=1e-12)


def test_one_pose_makes_no_pair():
    with pytest.raises(LogError, match="at least two poses"):
        pair_estimates(random_trajectory(1), 0.1, 0.01)


# ------------------------------------------------------------------------------------------------- real files


def test_published_results_with_and_without_index_read_with_their_own_stamps(shared_data):
    odometry = shared_data / "kitti" / "odometry"
    stamps_ns = read_times(odometry / "sequences" / "09" / "times.txt")
    indexed = read_trajectory(odometry / "published" / "example_0" / "09.txt", stamps_ns)
    assert_array_equal(indexed.stamps_ns, stamps_ns[2:])
    plain = read_trajectory(odometry / "published" / "example_1" / "09.txt", stamps_ns)
    assert_array_equal(plain.stamps_ns, stamps_ns)


def test_every_ground_truth_file_of_kitti_is_read(shared_data):
    files = sorted((shared_data / "kitti" / "odometry" / "poses").glob("*.txt"))
    assert len(files) == 11
    for file in files:
        poses = read_kitti_poses(file)
        assert_allclose(poses[0], np.eye(4), atol=1e-6)
        assert_allclose(poses, _plain(file), atol=2e-6)


def _plain(file: Path) -> np.ndarray:
    rows = np.loadtxt(file).reshape(-1, 3, 4)
    return np.concatenate([rows, np.tile([[[0, 0, 0, 1]]], (len(rows), 1, 1))], axis=1)


# ----------------------------------------------------------------------------------------------------- EuRoC


@pytest.mark.parametrize("further", [0, 3, 9], ids=["poses", "velocities", "velocities and biases"])
def test_a_table_of_euroc_reads_back_bit_for_bit(tmp_path, further):
    trajectory = random_trajectory()
    rows = np.hstack([trajectory.poses.translation, trajectory.poses.rotation.as_quat(scalar_first=True)])
    lines = [
        ", ".join([str(stamp), *map(repr, row), *["0.5"] * further])
        for stamp, row in zip(trajectory.stamps_ns.tolist(), rows.tolist(), strict=True)
    ]
    path = written(tmp_path / "state.csv", "#timestamp, p_RS_R_x [m], ...", *lines)
    assert file_format(path) == "euroc"
    for read in (read_euroc(path), read_trajectory(path, None)):
        assert_array_equal(read.stamps_ns, trajectory.stamps_ns)
        assert_allclose(read.poses.as_matrix(), trajectory.poses.as_matrix(), rtol=0, atol=1e-13)


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        ("1.5,0,0,0,1,0,0,0", "not a time in nanoseconds"),
        ("2,0,0,0,1,0,0", "7 columns where 8 are expected"),
        ("2,0,0,0,2,0,0,0", "not a rotation"),
        ("2,0,0,nan,1,0,0,0", "not a finite number"),
        ("0,0,0,0,1,0,0,0", "not later than"),
    ],
)
def test_what_is_wrong_with_a_table_of_euroc_is_named_by_line(tmp_path, line, reason):
    path = written(tmp_path / "state.csv", "#timestamp", "1,0,0,0,1,0,0,0", line)
    with pytest.raises(LogError, match=reason):
        read_trajectory(path, None)
