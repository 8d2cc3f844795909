"""KITTI's layouts: stamps to the nanosecond, the ground truth by the development kit's rule, errors by file."""

import functools
import operator
from collections import Counter
from pathlib import Path

import cv2
import numpy as np
import pytest
import scipy.io
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import RigidTransform, Rotation

from fusion_io.errors import LogError, UsageError
from fusion_io.gnss import Receiver
from fusion_io.kitti import open_odometry, open_raw, read_imu_mat, read_timestamps, trigger_times
from fusion_io.trajectory_files import read_times

K = np.array([[60.0, 0, 31.5], [0, 60, 23.5], [0, 0, 1]])
FRAMES = 6


def projection(x: float = 0.0) -> np.ndarray:
    """K [I | t] of a camera at x to the right of camera 0."""
    return K @ np.hstack([np.eye(3), [[-x], [0], [0]]])


def matrix_line(name: str, matrix: np.ndarray) -> str:
    return f"{name}: {' '.join(map(repr, np.ravel(matrix).tolist()))}\n"


def write_images(folder: Path, names: list[str], disparity: int = 0) -> None:
    folder.mkdir(parents=True)
    noise = np.random.default_rng(0).uniform(0, 255, (48, 128)).astype(np.float32)
    scene = cv2.GaussianBlur(noise, (0, 0), 1.0).astype(np.uint8)
    for name in names:
        cv2.imwrite(str(folder / name), scene[:, 20 + disparity : 84 + disparity])


@pytest.fixture
def odometry(tmp_path) -> Path:
    """A sequence 42 of six frames, a tenth of a second and 2 m apart, the camera turning about its vertical axis."""
    sequence = tmp_path / "sequences" / "42"
    for camera, disparity in ((0, 0), (1, 6), (2, 0), (3, 6)):
        write_images(sequence / f"image_{camera}", [f"{i:06d}.png" for i in range(FRAMES)], disparity)
    (sequence / "times.txt").write_text("".join(f"{0.1 * i:e}\n" for i in range(FRAMES)))
    (sequence / "calib.txt").write_text(
        "".join(matrix_line(f"P{camera}", projection(x)) for camera, x in enumerate([0.0, 0.5, -0.25, 0.3]))
    )
    (tmp_path / "poses").mkdir()
    poses = RigidTransform.from_components(
        np.arange(FRAMES)[:, None] * [0, 0, 2.0], Rotation.from_rotvec(np.arange(FRAMES)[:, None] * [0, 0.1, 0])
    )
    np.savetxt(tmp_path / "poses" / "42.txt", poses.as_matrix()[:, :3].reshape(-1, 12))
    return tmp_path


# ---------------------------------------------------------------------------------------------- the odometry


def test_a_sequence_has_frames_with_depth_stamps_and_ground_truth(odometry):
    recording = open_odometry(odometry, "42")
    frames = list(recording.frames)
    assert [frame.stamp_ns for frame in frames] == [i * 100_000_000 for i in range(FRAMES)]
    assert_array_equal(recording.ground_truth.stamps_ns, [frame.stamp_ns for frame in frames])
    assert_allclose(recording.ground_truth.poses.translation[:, 2], 2.0 * np.arange(FRAMES))
    depth = frames[0].depth
    assert_allclose(np.median(depth[depth > 0]), 60 * 0.5 / 6, rtol=0.02)
    assert_array_equal(frames[0].camera.K, K)
    assert not recording.warnings


def test_frames_that_are_not_on_disk_are_counted_and_the_rest_keep_their_stamps(odometry):
    folder = odometry / "sequences" / "42"
    (folder / "image_0" / "000002.png").unlink()
    (folder / "image_1" / "000003.png").unlink()
    recording = open_odometry(odometry, "42")
    frames = list(recording.frames)
    assert [frame.stamp_ns // 100_000_000 for frame in frames] == [0, 1, 3, 4, 5]
    assert [frame.depth is None for frame in frames] == [False, False, True, False, False]
    assert recording.warnings == {"frames missing (no left image)": 1, "frames without depth (no right image)": 1}


def test_without_a_right_camera_there_are_frames_without_depth(odometry):
    for file in (odometry / "sequences" / "42" / "image_1").iterdir():
        file.unlink()
    (odometry / "sequences" / "42" / "image_1").rmdir()
    recording = open_odometry(odometry, "42")
    assert all(frame.depth is None for frame in recording.frames)
    assert recording.warnings == {"frames without depth (no right image)": FRAMES}


def test_a_range_takes_its_frames_with_ground_truth_from_its_first_pose(odometry):
    recording = open_odometry(odometry, "42", frames=slice(2, 4))
    assert [frame.stamp_ns for frame in recording.frames] == [200_000_000, 300_000_000]
    truth = recording.ground_truth
    assert_array_equal(truth.stamps_ns, [200_000_000, 300_000_000])
    assert_allclose(truth.poses[0].as_matrix(), np.eye(4), atol=1e-12)
    # 2 m along z of the world, seen from a camera that is turned by 0.2 rad
    assert_allclose(truth.poses[1].translation, [-2 * np.sin(0.2), 0, 2 * np.cos(0.2)], atol=1e-12)


def test_a_range_beyond_the_sequence_is_a_usage_error(odometry):
    with pytest.raises(UsageError, match="no frame in the range"):
        open_odometry(odometry, "42", frames=slice(6, 9))


def test_colour_cameras_have_the_ground_truth_of_their_own_place(odometry):
    """The left colour camera is 0.25 m to the left of camera 0: turning, it moves along."""
    grey, colour = (open_odometry(odometry, "42", colour=flag) for flag in (False, True))
    offset = RigidTransform.from_translation([-0.25, 0, 0])  # T_camera0_camera2
    expected = offset.inv() * grey.ground_truth.poses * offset
    assert_allclose(colour.ground_truth.poses.as_matrix(), expected.as_matrix(), atol=1e-12)
    depth = next(iter(colour.frames)).depth
    assert_allclose(np.median(depth[depth > 0]), 60 * 0.55 / 6, rtol=0.02)


def test_colour_is_taken_where_there_is_no_grey(odometry):
    folder = odometry / "sequences" / "42"
    for camera in (0, 1):
        (folder / f"image_{camera}").rename(folder / f"away_{camera}")
    assert len(list(open_odometry(odometry, "42").frames)) == FRAMES
    (folder / "image_2").rename(folder / "away_2")
    with pytest.raises(LogError, match="no folder image_0 or image_2"):
        open_odometry(odometry, "42")


@pytest.mark.parametrize(
    ("file", "text", "reason"),
    [
        ("calib.txt", "", r"calib\.txt: no P0"),
        ("calib.txt", "P0: 1 2 3\n", r"calib\.txt: P0 must be 12 finite numbers"),
        ("calib.txt", matrix_line("P0", projection()) + matrix_line("P1", projection(-0.5)), "not to the right"),
        (
            "calib.txt",
            matrix_line("P0", projection()) + matrix_line("P1", 2 * projection()),
            "not those of a rectified",
        ),
        ("times.txt", "0\n0.2\n0.1\n", r"times\.txt: line 3: its time is not later"),
        ("times.txt", "0\n0.1\n", r"42\.txt: 6 poses do not fit 2 time stamps"),
    ],
)
def test_malformed_files_of_a_sequence_are_refused_by_name(odometry, file, text, reason):
    (odometry / "sequences" / "42" / file).write_text(text)
    with pytest.raises(LogError, match=reason):
        open_odometry(odometry, "42")


def write_scan(path: Path, T_camera_velodyne: RigidTransform, depth: float) -> None:
    """Points of a wall at a depth (m) of camera 0, which fill its image."""
    pixels = np.random.default_rng(0).uniform([-8, -8], [72, 56], (20_000, 2))
    points = depth * np.column_stack([pixels, np.ones(len(pixels))]) @ np.linalg.inv(K).T
    path.parent.mkdir(parents=True, exist_ok=True)
    reflectance = np.zeros((len(points), 1))
    np.hstack([T_camera_velodyne.inv().apply(points), reflectance]).astype("<f4").tofile(path)


@pytest.fixture
def scanned(odometry) -> Path:
    """The sequence with scans of a wall that comes 2 m nearer with each frame, and the scanner's calibration."""
    folder = odometry / "sequences" / "42"
    with (folder / "calib.txt").open("a") as file:
        file.write(matrix_line("Tr", T_CAMERA_VELO.as_matrix()[:3]))
    for i in range(FRAMES):
        write_scan(folder / "velodyne" / f"{i:06d}.bin", T_CAMERA_VELO, 20.0 - 2 * i)
    return odometry


def test_depth_from_the_scanner_is_that_of_its_points(scanned):
    recording = open_odometry(scanned, "42", depth="velodyne")
    frames = list(recording.frames)
    assert [frame.stamp_ns for frame in frames] == [i * 100_000_000 for i in range(FRAMES)]
    for i, frame in enumerate(frames):
        assert (frame.depth > 0).mean() > 0.95
        assert_allclose(frame.depth[frame.depth > 0], 20.0 - 2 * i, rtol=1e-5)
    assert not recording.warnings


def test_stereo_goes_first_and_the_scanner_where_there_is_no_right_camera(scanned):
    depth = next(iter(open_odometry(scanned, "42").frames)).depth
    assert_allclose(np.median(depth[depth > 0]), 60 * 0.5 / 6, rtol=0.02)
    folder = scanned / "sequences" / "42"
    (folder / "image_1").rename(folder / "away")
    depth = next(iter(open_odometry(scanned, "42").frames)).depth
    assert_allclose(depth[depth > 0], 20, rtol=1e-5)


def test_the_scanner_is_seen_from_the_camera_that_was_chosen(scanned):
    """Camera 2 is 0.25 m to the left of camera 0: a point 4 m ahead of that is 3.75 pixels further right."""
    near = T_CAMERA_VELO.inv().apply([0, 0.02, 4])
    path = scanned / "sequences" / "42" / "velodyne" / "000000.bin"
    np.append(near, 0).astype("<f4").tofile(path)
    frame = next(iter(open_odometry(scanned, "42", depth="velodyne", colour=True).frames))
    assert_array_equal(np.argwhere(frame.depth), [[24, 35]])


def test_scans_that_are_missing_or_cut_leave_frames_without_depth_and_are_counted(scanned):
    folder = scanned / "sequences" / "42" / "velodyne"
    (folder / "000001.bin").unlink()
    with (folder / "000003.bin").open("ab") as file:
        file.write(b"rest")
    recording = open_odometry(scanned, "42", depth="velodyne")
    assert [frame.depth is None for frame in recording.frames] == [False, True, False, True, False, False]
    assert recording.warnings == {"frames without depth (no scan)": 1, "frames without depth (scan cannot be read)": 1}


def test_the_scanner_needs_its_calibration_and_its_folder(odometry):
    with pytest.raises(LogError, match="velodyne: no such folder"):
        open_odometry(odometry, "42", depth="velodyne")
    (odometry / "sequences" / "42" / "velodyne").mkdir()
    with pytest.raises(LogError, match=r"calib\.txt: no Tr"):
        open_odometry(odometry, "42", depth="velodyne")
    with (odometry / "sequences" / "42" / "calib.txt").open("a") as file:
        file.write(matrix_line("Tr", 2 * np.eye(3, 4)))
    with pytest.raises(LogError, match=r"calib\.txt: Tr is not a rigid transform"):
        open_odometry(odometry, "42", depth="velodyne")


def test_what_is_not_there_is_refused_by_name(odometry):
    with pytest.raises(LogError, match="43: no such sequence"):
        open_odometry(odometry, "43")
    (odometry / "sequences" / "42" / "calib.txt").unlink()
    with pytest.raises(LogError, match=r"calib\.txt: No such file"):
        open_odometry(odometry, "42")


def test_a_sequence_without_any_image_is_refused(odometry):
    for file in (odometry / "sequences" / "42" / "image_0").iterdir():
        file.unlink()
    with pytest.raises(LogError, match="holds no image of frames 0 to 5"):
        open_odometry(odometry, "42")


# ---------------------------------------------------------------------------------------------------- the IMU

STAMPS = np.array([0, 104_000_007, 207_000_000])


def mat_file(path: Path, table: np.ndarray, name: str = "imu_data_interp") -> Path:
    scipy.io.savemat(path, {name: table})
    return path


def test_imu_rows_divide_the_real_intervals_and_every_tenth_is_a_frame(tmp_path):
    table = np.random.default_rng(0).normal(size=(21, 6))
    imu = read_imu_mat(mat_file(tmp_path / "imu.mat", table), STAMPS)
    assert_array_equal(imu.stamps_ns[::10], STAMPS)
    assert_array_equal(imu.stamps_ns[1:4], [10_400_000, 20_800_001, 31_200_002])
    assert_array_equal(imu.linear_acceleration, table[:, :3])
    assert_array_equal(imu.angular_velocity, table[:, 3:])


@pytest.mark.parametrize(
    ("table", "reason"),
    [
        (np.zeros((20, 6)), r"float64 \(20, 6\) where \(21, 6\)"),
        (np.zeros((21, 7)), r"where \(21, 6\)"),
        (np.full((21, 6), "x"), r"where \(21, 6\) real numbers"),
        (np.full((21, 6), np.nan), "not finite"),
    ],
)
def test_imu_tables_that_are_refused(tmp_path, table, reason):
    with pytest.raises(LogError, match=reason):
        read_imu_mat(mat_file(tmp_path / "imu.mat", table), STAMPS)


def test_files_without_an_imu_table_are_refused(tmp_path):
    with pytest.raises(LogError, match="no variable imu_data_interp"):
        read_imu_mat(mat_file(tmp_path / "imu.mat", np.zeros((21, 6)), name="other"), STAMPS)
    (tmp_path / "text.mat").write_text("hello " * 100)
    with pytest.raises(LogError, match=r"text\.mat: not a MATLAB file"):
        read_imu_mat(tmp_path / "text.mat", STAMPS)
    (tmp_path / "empty.mat").touch()
    with pytest.raises(LogError, match=r"empty\.mat: not a MATLAB file"):
        read_imu_mat(tmp_path / "empty.mat", STAMPS)
    with pytest.raises(LogError, match=r"gone\.mat"):
        read_imu_mat(tmp_path / "gone.mat", STAMPS)


# ------------------------------------------------------------------------------- the IMU of the raw drive's unit

DAY_NS = int(np.datetime64("2011-09-30T12:00:00", "ns").astype(np.int64))


def write_timestamps(path: Path, stamps_ns: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    stamps = np.asarray(stamps_ns, dtype=np.int64).astype("datetime64[ns]")
    path.write_text("".join(f"{str(stamp).replace('T', ' ')}\n" for stamp in stamps))


def write_oxts(folder: Path, stamps_ns: np.ndarray) -> None:
    """Records whose angular rates and accelerations (x) are the seconds since DAY_NS."""
    write_timestamps(folder / "timestamps.txt", stamps_ns)
    (folder / "data").mkdir()
    for i, stamp in enumerate(stamps_ns):
        record = np.zeros(30)
        record[[11, 17]] = (stamp - DAY_NS) * 1e-9
        (folder / "data" / f"{i:010d}.txt").write_text(" ".join(map(repr, record.tolist())))


@pytest.fixture
def day(odometry) -> Path:
    """The folder of sequence 09's raw drive: 100 Hz for 1.5 s, and the synchronised one from its third frame on."""
    for folder, suffix in ((odometry / "sequences", ""), (odometry / "poses", ".txt")):
        (folder / f"42{suffix}").rename(folder / f"09{suffix}")
    day = odometry / "2011_09_30"
    write_oxts(day / "2011_09_30_drive_0033_extract" / "oxts", DAY_NS + np.arange(150) * 10_000_000)
    frames = np.arange(3, 3 + FRAMES)
    sync = day / "2011_09_30_drive_0033_sync"
    write_timestamps(sync / "image_00" / "timestamps.txt", DAY_NS + 4_000_000 + frames * 100_000_000)
    write_oxts(sync / "oxts", DAY_NS + frames * 100_000_000 + np.resize([1_000_000, 3_000_000, 8_000_000], FRAMES))
    return day


def test_the_imu_of_the_raw_drive_keeps_its_stamps_and_the_frames_get_theirs(day):
    recording = open_odometry(day.parent, "09", oxts=day / "2011_09_30_drive_0033_extract")
    frames = [frame.stamp_ns for frame in recording.frames]
    assert_array_equal(frames, DAY_NS + 304_000_000 + np.arange(FRAMES) * 100_000_000)
    assert_array_equal(recording.ground_truth.stamps_ns, frames)
    imu = recording.imu
    assert_array_equal(imu.stamps_ns, DAY_NS + np.arange(131) * 10_000_000)  # to half a second after the last frame
    assert_allclose(imu.angular_velocity[:, 0], (imu.stamps_ns - DAY_NS) * 1e-9, atol=1e-12)
    assert_allclose(imu.linear_acceleration[:, 0], (imu.stamps_ns - DAY_NS) * 1e-9, atol=1e-12)
    assert not recording.warnings


def test_the_folder_of_the_records_itself_may_be_named(day):
    drive = day / "2011_09_30_drive_0033_extract"
    named, inside = (open_odometry(day.parent, "09", oxts=folder) for folder in (drive, drive / "oxts"))
    assert_array_equal(named.imu.stamps_ns, inside.imu.stamps_ns)


def test_a_synchronised_drive_has_an_imu_at_the_rate_of_its_frames(day):
    recording = open_odometry(day.parent, "09", oxts=day / "2011_09_30_drive_0033_sync")
    assert len(recording.imu) == FRAMES
    assert next(iter(recording.frames)).stamp_ns - recording.imu.stamps_ns[0] == 3_000_000


def test_without_the_camera_s_stamps_the_records_of_the_frames_tie_the_clocks_and_it_is_said(day):
    (day / "2011_09_30_drive_0033_sync" / "image_00" / "timestamps.txt").unlink()
    recording = open_odometry(day.parent, "09", oxts=day / "2011_09_30_drive_0033_extract")
    # the median of records that are 1, 3 and 8 ms after the full tenth of a second
    assert next(iter(recording.frames)).stamp_ns == DAY_NS + 303_000_000
    name = "frames tied to the OXTS clock by its records, to some ms (no image_00/timestamps.txt)"
    assert recording.warnings == {name: FRAMES}


def test_sequence_08_begins_at_frame_1100_of_its_drive(day):
    for folder, suffix in ((day.parent / "sequences", ""), (day.parent / "poses", ".txt")):
        (folder / f"09{suffix}").rename(folder / f"08{suffix}")
    frames_ns = DAY_NS + np.arange(1100 + FRAMES) * 100_000_000
    write_timestamps(day / "2011_09_30_drive_0028_sync" / "image_00" / "timestamps.txt", frames_ns)
    write_oxts(day / "2011_09_30_drive_0028_extract" / "oxts", DAY_NS + 109_000_000_000 + np.arange(200) * 10_000_000)
    recording = open_odometry(day.parent, "08", oxts=day / "2011_09_30_drive_0028_extract")
    assert [frame.stamp_ns for frame in recording.frames] == frames_ns[1100:].tolist()
    assert recording.imu.stamps_ns[0] == frames_ns[1100] - 500_000_000


def test_repeated_and_backward_stamps_of_the_records_are_dropped_and_holes_counted(day):
    drive = day / "2011_09_30_drive_0033_extract"
    stamps_ns = DAY_NS + np.arange(150) * 10_000_000
    stamps_ns[40] = stamps_ns[39]
    stamps_ns[60] = stamps_ns[50]
    stamps_ns[80:] += 100_000_000
    write_timestamps(drive / "oxts" / "timestamps.txt", stamps_ns)
    recording = open_odometry(day.parent, "09", oxts=drive)
    assert (np.diff(recording.imu.stamps_ns) > 0).all()
    assert recording.warnings == {
        "OXTS records dropped (their time does not increase)": 2,
        "holes between OXTS records": 1,
    }


def test_the_mounting_comes_from_the_calibration_of_the_day(day):
    drive = day / "2011_09_30_drive_0033_extract"
    assert open_odometry(day.parent, "09", oxts=drive).rotation_imu_camera is None
    with (day.parent / "sequences" / "09" / "calib.txt").open("a") as file:
        file.write(matrix_line("Tr", T_CAMERA_VELO.as_matrix()[:3]))
    (day / "calib_imu_to_velo.txt").write_text(
        matrix_line("R", T_VELO_IMU.rotation.as_matrix()) + matrix_line("T", T_VELO_IMU.translation)
    )
    mounting = open_odometry(day.parent, "09", oxts=drive).rotation_imu_camera
    assert_allclose(mounting.as_matrix(), (T_CAMERA_VELO * T_VELO_IMU).rotation.inv().as_matrix(), atol=1e-12)


def test_drives_that_do_not_belong_to_the_sequence_are_refused(day):
    for other in ("10", "11"):
        (day.parent / "sequences" / other).symlink_to(day.parent / "sequences" / "09")
    with pytest.raises(LogError, match="drive_0033_sync: sequence 10 was recorded on drive 2011_09_30_drive_0034"):
        open_odometry(day.parent, "10", oxts=day / "2011_09_30_drive_0033_sync")
    with pytest.raises(UsageError, match="sequence 11: its raw drive is not published"):
        open_odometry(day.parent, "11", oxts=day / "2011_09_30_drive_0033_sync")
    with pytest.raises(LogError, match="gone: no such drive"):
        open_odometry(day.parent, "09", oxts=day / "gone")


def test_records_of_another_time_than_the_sequence_are_refused(day):
    drive = day / "2011_09_30_drive_0033_extract"
    write_timestamps(drive / "oxts" / "timestamps.txt", DAY_NS - 10**10 + np.arange(150) * 10_000_000)
    with pytest.raises(LogError, match="0033_extract: the images and the IMU do not overlap in time"):
        open_odometry(day.parent, "09", oxts=drive)


def test_frames_that_cannot_be_tied_to_the_clock_are_refused(day):
    extract, sync = (day / f"2011_09_30_drive_0033_{kind}" for kind in ("extract", "sync"))
    times = sync / "image_00" / "timestamps.txt"
    write_timestamps(times, DAY_NS + np.arange(FRAMES) * 150_000_000)
    with pytest.raises(LogError, match=r"timestamps\.txt: its time stamps are not those of the sequence's frames"):
        open_odometry(day.parent, "09", oxts=extract)
    write_timestamps(times, DAY_NS + np.arange(4) * 100_000_000)
    with pytest.raises(LogError, match=r"timestamps\.txt: 4 time stamps, the sequence has 6"):
        open_odometry(day.parent, "09", oxts=extract)
    sync.rename(day / "away")
    with pytest.raises(LogError, match=r"0033_sync/image_00/timestamps\.txt: No such file: it ties"):
        open_odometry(day.parent, "09", oxts=extract)


def test_imu_of_a_range_reaches_half_a_second_beyond_it(odometry, tmp_path):
    path = mat_file(tmp_path / "imu.mat", np.zeros((51, 6)))
    imu = open_odometry(odometry, "42", imu=path, frames=slice(0, 1)).imu
    assert (imu.stamps_ns[0], imu.stamps_ns[-1]) == (0, 500_000_000)
    assert len(open_odometry(odometry, "42", imu=path, frames=slice(1, 2)).imu) == 51


# --------------------------------------------------------------------------------------------- the raw drives

# IMU (x forward, y left, z up) to camera (x right, y down, z forward), with a small tilt
T_VELO_IMU = RigidTransform.from_components([-0.8, 0.3, -0.8], Rotation.from_rotvec([0.01, -0.02, 0.03]))
T_CAMERA_VELO = RigidTransform.from_components(
    [0.0, -0.08, -0.27], Rotation.from_matrix([[0, -1, 0], [0, 0, -1], [1, 0, 0]])
)
RECTIFICATION = Rotation.from_rotvec([0.003, 0.01, -0.008])
T_CAMERA_IMU = RigidTransform.from_rotation(RECTIFICATION) * T_CAMERA_VELO * T_VELO_IMU


def timestamps(first: int, count: int = FRAMES) -> str:
    return "".join(f"2011-09-26 14:05:36.{first + 100_000_000 * i:09d}\n" for i in range(count))


@pytest.fixture
def drive(tmp_path) -> Path:
    """A drive that heads north-east at 10 m/s from 49 N 8 E."""
    folder = tmp_path / "day" / "drive_sync"
    for camera, disparity in ((0, 0), (1, 6)):
        image = folder / f"image_{camera:02d}"
        write_images(image / "data", [f"{i:010d}.png" for i in range(FRAMES)], disparity)
        (image / "timestamps.txt").write_text(timestamps(16_685_824))
    (folder / "oxts" / "data").mkdir(parents=True)
    (folder / "oxts" / "timestamps.txt").write_text(timestamps(12_555_359))
    for i in range(FRAMES):
        metre = np.degrees(1 / 6378137.0)
        record = np.zeros(30)
        record[:6] = 49 + i * metre, 8 + i * metre / np.cos(np.radians(49)), 112, 0.02, -0.01, np.pi / 4
        record[11:14] = 0.1, 0.2, 9.8
        record[17:20] = 0.01, 0.02, 0.03
        record[23] = 0.3
        (folder / "oxts" / "data" / f"{i:010d}.txt").write_text(" ".join(map(repr, record.tolist())))
    (folder.parent / "calib_cam_to_cam.txt").write_text(
        "calib_time: 09-Jan-2012 13:57:47\n"
        + matrix_line("R_rect_00", RECTIFICATION.as_matrix())
        + matrix_line("P_rect_00", projection())
        + matrix_line("P_rect_01", projection(0.5))
        + matrix_line("S_rect_00", np.array([64.0, 48.0]))
    )
    for name, transform in (("velo_to_cam", T_CAMERA_VELO), ("imu_to_velo", T_VELO_IMU)):
        (folder.parent / f"calib_{name}.txt").write_text(
            matrix_line("R", transform.rotation.as_matrix()) + matrix_line("T", transform.translation)
        )
    return folder


def test_time_stamps_of_a_drive_are_exact_to_the_nanosecond(drive):
    stamps_ns = read_timestamps(drive / "oxts" / "timestamps.txt")
    assert stamps_ns[0] == 1_317_045_936_012_555_359
    assert_array_equal(np.diff(stamps_ns), 100_000_000)


@pytest.mark.parametrize(
    "line", ["now", "NaT", "2011-09-26", "2011-13-26 14:05:36.0", "2011-09-26 14:05:36.0123456789", ""]
)
def test_lines_that_are_no_time_stamp_are_refused(tmp_path, line):
    path = tmp_path / "timestamps.txt"
    path.write_text(f"{timestamps(0, 1)}{line}\n{timestamps(0, 1)}")
    with pytest.raises(LogError, match=r"timestamps\.txt"):
        read_timestamps(path)


def write_stamps(drive: Path, camera: int, late_ms: list[float]) -> None:
    """Stamps of a camera's images, each so much later than the trigger."""
    late_ns = (1e6 * np.array(late_ms)).astype(int)
    lines = [f"2011-09-26 14:05:36.{16_685_824 + 100_000_000 * i + late_ns[i]:09d}" for i in range(len(late_ms))]
    (drive / f"image_{camera:02d}" / "timestamps.txt").write_text("\n".join(lines) + "\n")


def test_a_frame_has_the_earliest_stamp_of_its_images(drive):
    """Which camera's stamps are late changes from frame to frame; where both are, the earlier is nearer."""
    write_stamps(drive, 0, [0, 6, 0.3, 0, 2, 0])
    write_stamps(drive, 1, [4, 0, 0, 0, 1, 0])
    recording = open_raw(drive)
    late_ns = np.array([frame.stamp_ns for frame in recording.frames]) - 1_317_045_936_016_685_824
    assert_array_equal(late_ns - 100_000_000 * np.arange(FRAMES), [0, 0, 0, 0, 1_000_000, 0])
    assert not recording.warnings


@pytest.mark.parametrize("late_ms", [[80, 4, 4, 4, 4, -60], [4, 4, 4, 4]], ids=["outliers", "fewer"])
def test_stamps_that_no_other_camera_bears_out_are_kept(drive, late_ms):
    write_stamps(drive, 1, late_ms)
    recording = open_raw(drive)
    assert [frame.stamp_ns - 1_317_045_936_016_685_824 for frame in recording.frames] == [
        100_000_000 * i for i in range(FRAMES)
    ]
    assert not recording.warnings


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (timestamps(0).replace("14:05", "14:04"), "not of the same frames"),
        ("soon\n", "line 1: not a date and time"),
        ("", "holds no data"),
    ],
)
def test_a_camera_whose_stamps_are_of_no_use_is_left_out_and_counted(drive, text, reason):
    (drive / "image_01" / "timestamps.txt").write_text(text)
    recording = open_raw(drive)
    assert next(iter(recording.frames)).stamp_ns == 1_317_045_936_016_685_824
    [(warning, count)] = recording.warnings.items()
    assert "image_01/timestamps.txt" in warning
    assert reason in warning
    assert count == 1


def test_a_drive_has_frames_imu_and_gnss_at_their_own_stamps(drive):
    recording = open_raw(drive, gnss=Receiver(1e-3, noise_m=1e-6))
    frames = list(recording.frames)
    assert frames[0].stamp_ns == 1_317_045_936_016_685_824
    assert frames[0].stamp_ns - recording.imu.stamps_ns[0] == 4_130_465
    assert_array_equal(recording.imu.linear_acceleration, np.tile([0.1, 0.2, 9.8], (FRAMES, 1)))
    assert_array_equal(recording.imu.angular_velocity, np.tile([0.01, 0.02, 0.03], (FRAMES, 1)))
    assert [fix.stamp_ns for fix in recording.gnss] == recording.imu.stamps_ns.tolist()
    assert_allclose(recording.gnss[0].latitude_deg, 49, atol=1e-10)
    assert_allclose(recording.gnss[0].covariance, 0.09 * np.eye(3), atol=1e-9)


def test_the_unit_gives_fixes_or_the_ground_truth_but_not_both(drive):
    with_fixes, without = open_raw(drive, gnss=Receiver(1.0)), open_raw(drive)
    assert (len(with_fixes.gnss), with_fixes.ground_truth) == (1, None)
    assert without.gnss == []
    assert without.ground_truth is not None


def test_ground_truth_of_a_drive_is_mercator_and_euler_angles_moved_into_the_camera(drive):
    truth = open_raw(drive).ground_truth
    # on these few metres the projection is east and north to 1e-5
    east_north = np.arange(FRAMES)[:, None] * [1.0, 1.0, 0.0]
    rotation = Rotation.from_euler("ZYX", [np.pi / 4, -0.01, 0.02])
    T_world_imu = RigidTransform.from_components(east_north, rotation)
    expected = (T_CAMERA_IMU * T_world_imu[0].inv()) * T_world_imu * T_CAMERA_IMU.inv()
    assert_allclose(truth.poses.as_matrix(), expected.as_matrix(), atol=1e-4)
    # it heads where the camera looks, up to tilt and mounting
    assert_allclose(truth.poses.translation[-1], [0, 0, 5 * np.sqrt(2)], atol=0.5)


def test_the_mounting_turns_camera_vectors_into_imu_vectors(drive):
    forward = open_raw(drive).rotation_imu_camera.apply([0, 0, 1])
    assert_allclose(forward, T_CAMERA_IMU.rotation.inv().apply([0, 0, 1]), atol=1e-12)
    assert_allclose(forward, [1, 0, 0], atol=0.05)


def test_missing_images_and_records_of_a_drive_are_counted(drive):
    (drive / "image_00" / "data" / "0000000001.png").unlink()
    (drive / "image_01" / "data" / "0000000004.png").unlink()
    (drive / "oxts" / "data" / "0000000002.txt").unlink()
    recording = open_raw(drive)
    assert [frame.depth is None for frame in recording.frames] == [False, False, False, True, False]
    assert len(recording.imu) == len(recording.ground_truth) == FRAMES - 1
    assert recording.warnings == {
        "frames missing (no left image)": 1,
        "frames without depth (no right image)": 1,
        "OXTS records missing": 1,
    }


def test_a_drive_has_depth_from_its_scanner(drive):
    """Through the calibration files: rectification and scanner to camera."""
    T_camera_velodyne = RigidTransform.from_rotation(RECTIFICATION) * T_CAMERA_VELO
    for i in range(1, FRAMES):
        write_scan(drive / "velodyne_points" / "data" / f"{i:010d}.bin", T_camera_velodyne, 12.0)
    recording = open_raw(drive, depth="velodyne")
    frames = list(recording.frames)
    assert [frame.depth is None for frame in frames] == [True] + [False] * (FRAMES - 1)
    assert (frames[1].depth > 0).mean() > 0.95
    assert_allclose(frames[1].depth[frames[1].depth > 0], 12, rtol=1e-5)
    assert recording.warnings == {"frames without depth (no scan)": 1}


def test_records_whose_time_does_not_increase_are_dropped_and_counted(drive):
    lines = timestamps(12_555_359).splitlines()
    lines[3] = lines[2]
    (drive / "oxts" / "timestamps.txt").write_text("\n".join(lines))
    recording = open_raw(drive)
    assert len(recording.imu) == FRAMES - 1
    assert recording.warnings == {"OXTS records dropped (their time does not increase)": 1}


def test_images_without_a_time_stamp_are_counted(drive):
    (drive / "image_00" / "timestamps.txt").write_text(timestamps(16_685_824, FRAMES - 2))
    recording = open_raw(drive)
    assert recording.frame_count == FRAMES - 2
    assert recording.warnings == {"images without a time stamp": 2}


@pytest.mark.parametrize("name", ["calib_cam_to_cam.txt", "calib_velo_to_cam.txt", "calib_imu_to_velo.txt"])
def test_missing_calibration_is_refused_by_name(drive, name):
    (drive.parent / name).unlink()
    with pytest.raises(LogError, match=f"{name}: No such file"):
        open_raw(drive)


@pytest.mark.parametrize(
    ("name", "line", "reason"),
    [
        ("calib_imu_to_velo.txt", matrix_line("R", 2 * np.eye(3)), "R is not a rotation"),
        ("calib_velo_to_cam.txt", matrix_line("T", np.full(3, np.nan)), "T must be 3 finite numbers"),
        ("calib_cam_to_cam.txt", matrix_line("S_rect_00", np.array([100.0, 48])), "64x48 pixels where 100x48"),
    ],
)
def test_malformed_calibration_is_refused(drive, name, line, reason):
    with (drive.parent / name).open("a") as file:
        file.write(line)
    with pytest.raises(LogError, match=reason):
        list(open_raw(drive).frames)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("1 2 3", "3 columns where 30 are expected"),
        (" ".join(["nan"] * 30), "not a finite number"),
        (" ".join(["91"] * 30), "not a position"),
        ("", "holds no data"),
    ],
)
def test_malformed_records_are_refused(drive, text, reason):
    (drive / "oxts" / "data" / "0000000003.txt").write_text(text)
    with pytest.raises(LogError, match=rf"0000000003\.txt: .*{reason}"):
        open_raw(drive)


def test_camera_times_that_do_not_increase_are_refused(drive):
    (drive / "image_00" / "timestamps.txt").write_text(timestamps(0, 1) * FRAMES)
    with pytest.raises(LogError, match="the times do not increase"):
        open_raw(drive)


def test_records_of_another_time_than_the_images_are_refused(drive):
    (drive / "oxts" / "timestamps.txt").write_text(timestamps(0).replace("14:05", "18:05"))
    with pytest.raises(LogError, match="do not overlap in time"):
        open_raw(drive)


def test_a_drive_that_is_not_there_is_refused(tmp_path):
    with pytest.raises(LogError, match="no such drive"):
        open_raw(tmp_path / "gone")


# -------------------------------------------------------------------------------------------------- real data


def test_the_imu_of_kitti_agrees_with_the_ground_truth(shared_data):
    """Gyro and ground truth of sequence 09 turn by the same angle over each 100 frames, to 1 % and 5 mrad.

    The IMU's clock is some 65 ms ahead, about six rows. 100 ms a frame instead of the real intervals would be
    4 % off.
    """
    odometry = shared_data / "kitti" / "odometry"
    stamps_ns = read_times(odometry / "sequences" / "09" / "times.txt")
    imu = read_imu_mat(odometry / "imu" / "09.mat", stamps_ns)
    assert_array_equal(imu.stamps_ns[::10], stamps_ns)
    assert_allclose(np.median(imu.linear_acceleration[:, 2]), 9.8, atol=0.2)
    turns = imu.angular_velocity[6:-5] * np.diff(imu.stamps_ns[6:-4])[:, None] * 1e-9
    frame_turns = Rotation.from_rotvec(turns[: 10 * (len(stamps_ns) - 2)].reshape(-1, 10, 3).sum(axis=1))
    poses = np.loadtxt(odometry / "poses" / "09.txt").reshape(-1, 3, 4)
    for start in range(0, 1450, 97):
        turned = functools.reduce(operator.mul, frame_turns[start : start + 100])
        truth = Rotation.from_matrix(poses[start, :, :3].T @ poses[start + 100, :, :3])
        assert_allclose(turned.magnitude(), truth.magnitude(), rtol=0.01, atol=0.005)


def test_the_real_drive_with_its_two_missing_images(shared_data):
    day = shared_data / "kitti" / "raw" / "2011_09_26"
    recording = open_raw(day / "2011_09_26_drive_0039_sync", frames=slice(16, 20))
    frames = list(recording.frames)
    assert [frame.depth is None for frame in frames] == [False, True, False]
    assert recording.warnings == {"frames missing (no left image)": 1, "frames without depth (no right image)": 1}
    assert frames[0].image.shape == (375, 1242)
    assert_allclose(frames[0].camera.K[[0, 0, 1], [0, 2, 2]], [721.5377, 609.5593, 172.854])
    assert (frames[0].depth > 0).mean() > 0.6
    # the road one camera height (1.65 m) below, seen in the lower rows at mid-width
    v = np.arange(300, 370)
    road = frames[0].depth[300:370, 560:660] * ((v - 172.854) / 721.5377)[:, None]
    assert_allclose(np.median(road[road > 0]), 1.65, atol=0.15)


def test_the_cameras_of_the_real_drive_are_triggered_evenly(shared_data):
    """Intervals change slowly between triggers: by far less than either camera's own stamps say."""
    drive = shared_data / "kitti" / "raw" / "2011_09_26" / "2011_09_26_drive_0039_sync"
    times = {camera: read_timestamps(drive / camera / "timestamps.txt") for camera in ("image_00", "image_01")}
    warnings: Counter[str] = Counter()
    triggers = trigger_times(drive, "image_00", warnings)
    assert not warnings
    assert_array_equal(triggers, trigger_times(drive, "image_01", warnings))

    def unevenness_ms(stamps_ns):
        return np.std(np.diff(stamps_ns, 2)) * 1e-6

    assert unevenness_ms(triggers) < 0.25 * min(map(unevenness_ms, times.values()))


def test_the_steps_of_the_real_ground_truth_are_those_of_a_car(shared_data):
    """205 m within 25 s, forward in the camera's frame, and as far as the unit's own speed says."""
    day = shared_data / "kitti" / "raw" / "2011_09_26"
    truth = open_raw(day / "2011_09_26_drive_0039_sync").ground_truth
    steps = truth.poses[:-1].inv() * truth.poses[1:]
    lengths = np.linalg.norm(steps.translation, axis=1)
    assert_allclose(lengths.sum(), 205, atol=2)
    forward = steps.translation[:, 2] / lengths
    assert np.quantile(forward, 0.05) > 0.99
    velocity = [np.loadtxt(f)[8] for f in sorted((day / "2011_09_26_drive_0039_sync/oxts/data").iterdir())]
    seconds = np.diff(truth.stamps_ns) * 1e-9
    assert_allclose(lengths.sum(), np.sum(np.array(velocity[:-1]) * seconds), rtol=0.01)
