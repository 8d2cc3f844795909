"""What is read from a log is what was recorded, in order of time; what is left out is counted."""

import dataclasses
import hashlib
import tracemalloc
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from log_samples import (
    CAMERA,
    HEIGHT,
    SECOND,
    START,
    WIDTH,
    K,
    camera_info,
    depth,
    frames,
    grey,
    imu_message,
    imu_series,
    pair_estimates,
    raw_image,
    trajectory,
    write_raw,
    write_sample,
)
from scipy.spatial.transform import Rotation

from fusion_io import camera, inertial, messages, topics
from fusion_io.errors import LogError, UsageError
from fusion_io.messages import FrameTransform, ImuSample, PoseSample
from fusion_io.reader import open_log
from fusion_io.records import CameraInfo, GnssFix, ImuSeries, PairEstimate, Trajectory
from fusion_io.writer import LogWriter

MS = 1_000_000


@pytest.fixture(scope="module")
def sample(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_sample(tmp_path_factory.mktemp("sample") / "sample.mcap")


def write(path: Path, *, imu: ImuSeries | None = None, truth: Trajectory | None = None, pairs=(), frames=()) -> Path:
    with LogWriter(path) as log:
        if imu is not None:
            log.imu(imu)
        if truth is not None:
            log.ground_truth(truth)
        log.pairs(pairs)
        for frame in frames:
            log.frame(frame)
    return path


# --- Round trip ---------------------------------------------------------------------------------


def test_a_log_of_ours_fills_every_role(sample: Path) -> None:
    log = open_log(sample)
    assert log.roles == {
        "image": topics.IMAGE,
        "depth": topics.DEPTH,
        "camera_info": topics.CAMERA_INFO,
        "imu": topics.IMU,
        "ground_truth": topics.GROUND_TRUTH,
        "pairs": topics.PAIRS,
        "tf_static": topics.TF_STATIC,
    }
    assert log.has_frames
    assert log.has_pairs
    assert log.metadata == {"run": {"seed": "0"}}
    assert log.sha256 == hashlib.sha256(sample.read_bytes()).hexdigest()
    assert (log.start_ns, log.end_ns) == (START, START + 1990 * MS)


def test_frames_are_what_was_written(sample: Path) -> None:
    log = open_log(sample)
    np.testing.assert_array_equal(log.frame_stamps(), [frame.stamp_ns for frame in frames()])
    for read, written in zip(log.frames(), frames(), strict=True):
        assert read.stamp_ns == written.stamp_ns
        np.testing.assert_array_equal(read.image, written.image)
        np.testing.assert_array_equal(read.depth, written.depth)  # it was a multiple of 1/256 m
        np.testing.assert_array_equal(read.camera.K, K)
        assert (read.camera.width, read.camera.height, read.camera.frame_id) == (WIDTH, HEIGHT, "camera")


def test_frames_can_be_asked_for_by_their_stamps_in_any_order(sample: Path) -> None:
    log = open_log(sample)
    every = list(log.frames())
    asked = [3, 0, 3]
    for index, frame in zip(asked, log.frames(log.frame_stamps()[asked]), strict=True):
        assert frame.stamp_ns == every[index].stamp_ns
        np.testing.assert_array_equal(frame.image, every[index].image)
        np.testing.assert_array_equal(frame.depth, every[index].depth)
    assert not list(log.frames(np.zeros(0, np.int64)))
    with pytest.raises(ValueError, match="no frame"):
        next(log.frames(np.array([every[0].stamp_ns + 1])))


def test_imu_and_pairs_are_the_same_to_the_bit(sample: Path) -> None:
    log, written = open_log(sample), imu_series()
    read = log.imu()
    assert read.stamps_ns.tobytes() == written.stamps_ns.tobytes()
    assert read.angular_velocity.tobytes() == written.angular_velocity.tobytes()
    assert read.linear_acceleration.tobytes() == written.linear_acceleration.tobytes()
    assert (read.angular_velocity_std, read.linear_acceleration_std) == (1e-3, 2e-2)
    for pair, expected in zip(log.pairs(), pair_estimates(), strict=True):
        for field in dataclasses.fields(PairEstimate):
            assert np.array_equal(getattr(pair, field.name), getattr(expected, field.name))


def test_ground_truth_and_mounting_are_the_same_to_rounding(sample: Path) -> None:
    log, written = open_log(sample), trajectory()
    truth = log.ground_truth()
    np.testing.assert_array_equal(truth.stamps_ns, written.stamps_ns)
    np.testing.assert_array_equal(truth.poses.translation, written.poses.translation)
    assert (truth.poses.rotation * written.poses.rotation.inv()).magnitude().max() < 1e-14
    mounting = log.mounting() * Rotation.from_euler("xyz", [0.1, 0.2, 0.3]).inv()
    assert mounting.magnitude() < 1e-14


def test_loops_and_satellites_are_read_in_order_of_time(tmp_path: Path) -> None:
    fixes = [GnssFix(START + i * SECOND, 49.0, 8.0, 110.0 + i) for i in (2, 0, 1)]
    with LogWriter(tmp_path / "a.mcap") as writer:
        writer.loops(pair_estimates(3))
        for fix in fixes:
            writer.gnss(fix)
    log = open_log(tmp_path / "a.mcap")
    assert [loop.target_stamp_ns for loop in log.loops()] == [START + (i + 1) * 100 * MS for i in range(3)]
    assert [fix.altitude_m for fix in log.gnss()] == [110.0, 111.0, 112.0]
    assert not log.has_pairs


def test_what_a_log_does_not_have_is_empty(tmp_path: Path) -> None:
    log = open_log(write(tmp_path / "a.mcap", imu=imu_series(5)))
    assert (log.pairs(), log.loops(), log.gnss(), log.ground_truth(), log.mounting()) == ([], [], [], None, None)
    assert len(log.frame_stamps()) == 0
    assert log.camera_info() is None
    log = open_log(write(tmp_path / "b.mcap", pairs=pair_estimates(2)))
    assert log.imu().angular_velocity.shape == (0, 3)


def test_without_images_the_frames_are_those_of_the_camera_info(tmp_path: Path) -> None:
    path = write_raw(tmp_path / "a.mcap", [camera_info(topics.CAMERA_INFO, START + i * SECOND) for i in range(4)])
    log = open_log(path)
    assert not log.has_frames
    np.testing.assert_array_equal(log.frame_stamps(), START + np.arange(4) * SECOND)
    np.testing.assert_array_equal(log.camera_info().K, K)
    with pytest.raises(LogError, match="no images"):
        next(log.frames())


# --- Memory -------------------------------------------------------------------------------------


def test_memory_does_not_grow_with_the_length_of_the_log(tmp_path: Path) -> None:
    """Ten times the frames, the same memory, but for an index of about a hundred bytes a frame."""

    def peak(count: int) -> int:
        path = tmp_path / f"{count}.mcap"
        items = [
            item
            for i in range(count)
            for item in (
                raw_image(topics.IMAGE, START + i * SECOND, grey(i, 160, 120), "mono8"),
                camera_info(topics.CAMERA_INFO, START + i * SECOND),
            )
        ]
        write_raw(path, items, chunk_size=100_000)
        del items
        tracemalloc.start()
        for frame in open_log(path).frames():
            assert frame.image.any()
        used = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        return used

    peak(20)  # what is imported and cached on first use
    assert peak(300) < peak(30) + 270 * 1000


def test_frames_far_from_their_depth_in_the_file_are_paired(tmp_path: Path) -> None:
    """All images first, then all depth, then the intrinsics: order in the file does not matter."""
    count = 30
    items = [raw_image(topics.IMAGE, START + i * SECOND, grey(i), "mono8") for i in range(count)]
    items += [raw_image(topics.DEPTH, START + i * SECOND, depth(i), "32FC1") for i in reversed(range(count))]
    items += [camera_info(topics.CAMERA_INFO, START)]
    log = open_log(write_raw(tmp_path / "a.mcap", items, chunk_size=5_000))
    for i, frame in enumerate(log.frames()):
        np.testing.assert_array_equal(frame.depth, depth(i))
    assert i == count - 1
    assert log.warnings == {"depth_out_of_order": count - 1}


# --- Frames -------------------------------------------------------------------------------------


def camera_log(path: Path, images, depths, info: CameraInfo = CAMERA) -> Path:
    """Images and depth as (stamp, pixels)."""
    items = [raw_image(topics.IMAGE, stamp, pixels, "mono8") for stamp, pixels in images]
    items += [raw_image(topics.DEPTH, stamp, pixels, "32FC1") for stamp, pixels in depths]
    return write_raw(path, [*items, camera_info(topics.CAMERA_INFO, START, info)])


def test_image_and_depth_within_half_a_period_belong_together(tmp_path: Path) -> None:
    images = [(START + i * 100 * MS, grey(i)) for i in range(10)]
    late = {3: 60, 7: None}  # more than half a period, and missing
    depths = [(START + (100 * i + late.get(i, 30)) * MS, depth(i)) for i in range(10) if late.get(i, 30) is not None]
    log = open_log(camera_log(tmp_path / "a.mcap", images, depths))
    paired = list(log.frames())
    assert [frame.depth is None for frame in paired] == [i in (3, 7) for i in range(10)]
    assert [frame.stamp_ns for frame in paired] == [stamp for stamp, _ in images]
    np.testing.assert_array_equal(paired[5].depth, depth(5))
    assert log.warnings == {"frames_without_depth": 2, "depth_without_frame": 1}
    list(log.frames())
    assert log.warnings == {"frames_without_depth": 2, "depth_without_frame": 1}
    assert any("have no depth within half a period: 2, the first at 1700000000.300 s" in note for note in log.notes)


@settings(max_examples=100, deadline=None, derandomize=True)
@given(
    st.lists(st.integers(0, 1000), unique=True, max_size=20),
    st.lists(st.integers(0, 1000), unique=True, max_size=20),
    st.integers(0, 100),
)
def test_partners_are_mutual_nearest_and_near(a: list[int], b: list[int], tolerance: int) -> None:
    stamps, others = np.sort(np.array(a, dtype=np.int64)), np.sort(np.array(b, dtype=np.int64))
    partners = camera.pair_nearest(stamps, others, tolerance)
    assert len(partners) == len(stamps)
    used = partners[partners >= 0]
    assert len(set(used)) == len(used)
    for stamp, partner in zip(stamps, partners, strict=True):
        distance = np.abs(others - stamp)
        if partner >= 0:
            assert distance[partner] == distance.min() <= tolerance
            assert np.abs(stamps - others[partner]).min() == distance[partner]
        else:  # nobody was near, or who was nearest is nearer to another
            assert not len(others) or distance.min() > tolerance or any(
                np.abs(stamps - others[j]).min() <= distance[j] for j in np.flatnonzero(distance == distance.min())
            )  # fmt: skip


def test_duplicate_frames_are_dropped_and_counted(tmp_path: Path) -> None:
    images = [(START + i * 100 * MS, grey(i)) for i in (0, 1, 1, 2, 2, 2, 3)]
    log = open_log(camera_log(tmp_path / "a.mcap", images, []))
    np.testing.assert_array_equal(log.frame_stamps(), START + np.arange(4) * 100 * MS)
    assert len(list(log.frames())) == 4
    assert log.warnings == {"duplicate_frames": 3}
    assert any(str(log.path) in note and topics.IMAGE in note and "1700000000.100 s" in note for note in log.notes)


def test_frames_out_of_order_are_put_in_order(tmp_path: Path) -> None:
    images = [(START + i * 100 * MS, grey(i)) for i in (0, 2, 1, 3, 4)]
    log = open_log(camera_log(tmp_path / "a.mcap", images, []))
    for i, frame in enumerate(log.frames()):
        np.testing.assert_array_equal(frame.image, grey(i))
    assert log.warnings == {"frames_out_of_order": 1}


def test_depth_of_another_size_is_scaled_without_mixing(tmp_path: Path) -> None:
    small = depth(0, WIDTH // 2, HEIGHT // 2)
    large = depth(1, WIDTH * 3, HEIGHT * 3)
    images = [(START, grey(0)), (START + SECOND, grey(1))]
    log = open_log(camera_log(tmp_path / "a.mcap", images, [(START, small), (START + SECOND, large)]))
    first, second = log.frames()
    np.testing.assert_array_equal(first.depth, np.kron(small, np.ones((2, 2))))
    np.testing.assert_array_equal(second.depth, large[1::3, 1::3])


def test_depth_that_cannot_belong_to_the_image_is_refused(tmp_path: Path) -> None:
    log = open_log(camera_log(tmp_path / "a.mcap", [(START, grey())], [(START, depth(0, 64, 24))]))
    reason = r"a\.mcap: /camera/depth at 1700000000\.000 s: depth of 64x24 cannot belong to an image of 32x24"
    with pytest.raises(LogError, match=reason) as caught:
        list(log.frames())
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("size", "other", "same"),
    [
        ((640, 480), (320, 240), True),
        ((1242, 375), (621, 188), True),  # rounded
        ((1242, 375), (480, 145), True),
        ((1280, 720), (848, 480), False),  # RealSense: the sides are cut
        ((640, 480), (480, 640), False),
    ],
)
def test_sizes_of_one_camera(size: tuple[int, int], other: tuple[int, int], same: bool) -> None:
    assert camera.same_aspect(*size, *other) is same
    assert camera.same_aspect(*other, *size) is same


def test_intrinsics_for_another_size_are_scaled(tmp_path: Path) -> None:
    log = open_log(camera_log(tmp_path / "a.mcap", [(START, grey())], [], CAMERA.scaled_to(2 * WIDTH, 2 * HEIGHT)))
    (frame,) = log.frames()
    np.testing.assert_allclose(frame.camera.K, K, atol=1e-12)
    assert (frame.camera.width, frame.camera.height) == (WIDTH, HEIGHT)


def test_intrinsics_of_another_camera_are_refused(tmp_path: Path) -> None:
    log = open_log(camera_log(tmp_path / "a.mcap", [(START, grey())], [], CameraInfo(640, 100, K)))
    with pytest.raises(LogError, match=r"/camera/camera_info at .* 640x100 cannot belong to an image of 32x24"):
        list(log.frames())


def test_no_camera_info_is_an_error_when_frames_are_asked_for(tmp_path: Path) -> None:
    items = [raw_image(topics.IMAGE, START, grey(), "mono8"), raw_image(topics.DEPTH, START, depth(), "32FC1")]
    log = open_log(write_raw(tmp_path / "a.mcap", items))
    assert len(log.frame_stamps()) == 1
    with pytest.raises(LogError, match=r"a\.mcap: no camera info"):
        list(log.frames())


def test_an_uncalibrated_camera_is_an_error_that_names_it(tmp_path: Path) -> None:
    info = CameraInfo(WIDTH, HEIGHT, np.zeros((3, 3)))
    log = open_log(camera_log(tmp_path / "a.mcap", [(START, grey())], [], info))
    assert log.camera_info() is None
    with pytest.raises(LogError, match=r"/camera/camera_info at .*: the camera is not calibrated"):
        list(log.frames())


def project(info: CameraInfo, rays: np.ndarray) -> np.ndarray:
    """Pixels (N, 2) of the rays (N, 2) on the plane z = 1, by OpenCV's model of the lens."""
    if info.distortion_model == "equidistant":
        return cv2.fisheye.distortPoints(rays[:, None], info.K, info.distortion)[:, 0]
    points = np.column_stack([rays, np.ones(len(rays))])
    return cv2.projectPoints(points, np.zeros(3), np.zeros(3), info.K, info.distortion)[0][:, 0]


def seen_through(info: CameraInfo, scene) -> np.ndarray:
    """What a camera with this lens records of ``scene(x, y)`` on the plane z = 1."""
    v, u = np.mgrid[: info.height, : info.width].astype(np.float64)
    pixels = np.stack([u.ravel(), v.ravel()], axis=1)
    focal, centre = info.K[[0, 1], [0, 1]], info.K[:2, 2]
    rays = (pixels - centre) / focal
    for _ in range(30):  # fixed point: the ray whose projection is the pixel
        rays -= (project(info, rays) - pixels) / focal
    assert np.abs(project(info, rays) - pixels).max() < 1e-3
    return scene(rays[:, 0], rays[:, 1]).reshape(info.height, info.width)


@pytest.mark.parametrize(
    ("model", "coefficients"),
    [
        ("plumb_bob", [-0.25, 0.06, 0.001, -0.0005, 0.0]),
        ("rational_polynomial", [-0.3, 0.1, 0.001, 0.0005, 0.01, 0.05, -0.02, 0.002]),
        ("equidistant", [0.05, -0.02, 0.005, -0.001]),
    ],
)
def test_lens_distortion_is_undone(model: str, coefficients: list[float], tmp_path: Path) -> None:
    """A scene seen through a lens becomes what a pinhole camera with the same K sees of it."""
    K = np.array([[60.0, 0, 47.5], [0, 60.0, 35.5], [0, 0, 1]])
    lens, pinhole = CameraInfo(96, 72, K, model, np.array(coefficients)), CameraInfo(96, 72, K)

    def brightness(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return 128 + 100 * np.sin(6 * x) * np.cos(5 * y)

    def distance(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return 10 + 3 * x - 2 * y

    image = np.rint(seen_through(lens, brightness)).astype(np.uint8)
    ranges = seen_through(lens, distance).astype(np.float32)
    (frame,) = open_log(camera_log(tmp_path / "a.mcap", [(START, image)], [(START, ranges)], lens)).frames()
    inner = (slice(12, 60), slice(16, 80))  # the rim may lie outside of what the lens saw
    assert not np.any(frame.camera.distortion)
    np.testing.assert_array_equal(frame.camera.K, K)
    np.testing.assert_allclose(frame.image[inner], seen_through(pinhole, brightness)[inner], atol=4)
    np.testing.assert_allclose(
        frame.depth[inner], seen_through(pinhole, distance)[inner], atol=0.07
    )  # half a pixel and a bit
    assert set(np.unique(frame.depth)) <= {0, *np.unique(ranges)}  # depth is moved, never mixed
    before = np.abs(image[inner].astype(float) - seen_through(pinhole, brightness)[inner]).max()
    assert before > 20  # the lens did something


def test_an_unknown_lens_is_refused_by_name(tmp_path: Path) -> None:
    lens = dataclasses.replace(CAMERA, distortion_model="double_sphere", distortion=np.array([0.1, 0.2]))
    log = open_log(camera_log(tmp_path / "a.mcap", [(START, grey())], [], lens))
    with pytest.raises(LogError, match=r"'double_sphere' with 2 coefficients"):
        list(log.frames())


# --- IMU ----------------------------------------------------------------------------------------


def test_nan_in_the_imu_is_dropped_and_counted(tmp_path: Path) -> None:
    series = imu_series(50)
    series.angular_velocity[7, 1] = np.nan
    series.linear_acceleration[20, 2] = np.inf
    log = open_log(write(tmp_path / "a.mcap", imu=series))
    for _ in range(2):
        read = log.imu()
        assert log.warnings == {"imu_nan": 2}
    np.testing.assert_array_equal(read.stamps_ns, np.delete(series.stamps_ns, [7, 20]))
    assert any("/imu: messages" in note and ": 2, the first at 1700000000.070 s" in note for note in log.notes)


def test_imu_stamps_that_go_back_are_dropped_and_counted(tmp_path: Path) -> None:
    """The clock jumps back by 0.15 s for a while: the longest increasing run is kept."""
    stamps = START + np.arange(100) * 10 * MS
    stamps[40:45] -= 150 * MS
    stamps[70] = stamps[69]
    items = [imu_message("/imu", int(stamp), ImuSample(np.ones(3), np.ones(3))) for stamp in stamps]
    log = open_log(write_raw(tmp_path / "a.mcap", items))
    for _ in range(2):
        read = log.imu()
        assert log.warnings == {"imu_backward": 6}
    assert np.all(np.diff(read.stamps_ns) > 0)
    np.testing.assert_array_equal(read.stamps_ns, np.delete(stamps, [40, 41, 42, 43, 44, 70]))


@settings(max_examples=100, deadline=None, derandomize=True)
@given(st.lists(st.integers(0, 12), max_size=9))
def test_the_increasing_run_is_a_longest_one(values: list[int]) -> None:
    stamps = np.array(values, dtype=np.int64)
    kept = inertial.longest_increasing(stamps)
    assert np.all(np.diff(kept) > 0)
    assert np.all(np.diff(stamps[kept]) > 0)
    best = [1] * len(values)  # the quadratic definition
    for i, value in enumerate(values):
        best[i] += max((best[j] for j in range(i) if values[j] < value), default=0)
    assert len(kept) == max(best, default=0)


@pytest.mark.parametrize(
    ("gyro_topic", "accelerometer_topic", "marked"),
    [("/camera/gyro/sample", "/camera/accel/sample", False), ("/imu/a", "/imu/b", True), ("/left", "/right", False)],
)
def test_gyro_and_accelerometer_on_two_topics_are_joined_by_time(
    gyro_topic: str, accelerometer_topic: str, marked: bool, tmp_path: Path
) -> None:
    """200 Hz and 63 Hz, as RealSense sends them: told apart by name, by covariance, or by a half of zeros."""
    gyro_stamps = START + np.arange(200) * 5 * MS
    stamps = START + 7 * MS + np.arange(60) * 16 * MS
    stamps = np.delete(stamps, slice(20, 35))  # a hole of 0.25 s

    def rate(t: np.ndarray) -> np.ndarray:
        return np.stack([np.sin(t), np.cos(t), 0.1 * t], axis=-1)

    def force(t: np.ndarray) -> np.ndarray:
        return np.stack([1 + t, 2 - 3 * t, 9.8 + 0.5 * t], axis=-1)

    seconds = (gyro_stamps - START) / SECOND
    items = [
        imu_message(gyro_topic, int(t), ImuSample(rate(s), np.zeros(3), 0.01, has_linear_acceleration=not marked))
        for t, s in zip(gyro_stamps, seconds, strict=True)
    ]
    items += [
        imu_message(
            accelerometer_topic, int(t),
            ImuSample(np.zeros(3), force((t - START) / SECOND), None, 0.1, has_angular_velocity=not marked),
        )
        for t in stamps
    ]  # fmt: skip
    log = open_log(write_raw(tmp_path / "a.mcap", sorted(items, key=lambda item: item[2])))
    assert log.roles == {"gyro": gyro_topic, "accelerometer": accelerometer_topic}
    series = log.imu()
    kept = (gyro_stamps >= stamps[0]) & (gyro_stamps <= stamps[-1])
    kept &= (gyro_stamps <= stamps[19]) | (gyro_stamps > stamps[20]) | np.isin(gyro_stamps, stamps)
    np.testing.assert_array_equal(series.stamps_ns, gyro_stamps[kept])
    np.testing.assert_array_equal(series.angular_velocity, rate(seconds[kept]))
    np.testing.assert_allclose(series.linear_acceleration, force(seconds[kept]), atol=1e-9)  # linear in time
    assert (series.angular_velocity_std, series.linear_acceleration_std) == (0.01, 0.1)
    assert log.warnings == {"gyro_without_accelerometer": int(np.count_nonzero(~kept))}


def test_unknown_noise_is_none(tmp_path: Path) -> None:
    series = dataclasses.replace(imu_series(5), angular_velocity_std=None)
    read = open_log(write(tmp_path / "a.mcap", imu=series)).imu()
    assert (read.angular_velocity_std, read.linear_acceleration_std) == (None, 2e-2)


# --- Pairs and ground truth ---------------------------------------------------------------------


def test_pairs_that_cannot_be_used_are_left_out_and_counted(tmp_path: Path) -> None:
    good = pair_estimates(6)
    bad = [
        dataclasses.replace(good[1], covariance=np.zeros((6, 6))),
        dataclasses.replace(good[2], covariance=np.diag([1, 1, 1, 1, 1, -1.0])),
        dataclasses.replace(good[3], translation=np.array([0, np.nan, 0])),
        dataclasses.replace(good[4], quat_wxyz=np.zeros(4)),
        dataclasses.replace(good[5], source_stamp_ns=good[5].target_stamp_ns),
    ]
    log = open_log(write(tmp_path / "a.mcap", pairs=[good[0], good[0], *bad]))
    for _ in range(2):
        assert len(log.pairs()) == 1
        assert log.warnings == {"pairs_invalid": 5, "duplicate_pairs": 1}


def test_ground_truth_without_a_rotation_is_left_out_and_counted(tmp_path: Path) -> None:
    poses = [PoseSample(np.ones(3), np.array([1.0, 0, 0, 0])) for _ in range(6)]
    poses[2] = PoseSample(np.ones(3), np.zeros(4))
    poses[3] = PoseSample(np.full(3, np.nan), np.array([1.0, 0, 0, 0]))
    stamps = [START + i * SECOND for i in (0, 1, 2, 3, 4, 4)]
    items = [
        ("/ground_truth", messages.POSE_STAMPED, t, messages.encode_pose(t, p))
        for t, p in zip(stamps, poses, strict=True)
    ]
    log = open_log(write_raw(tmp_path / "a.mcap", items))
    assert len(log.ground_truth()) == 3
    assert log.warnings == {"ground_truth_invalid": 2, "ground_truth_backward": 1}


# --- Clocks -------------------------------------------------------------------------------------


def test_stamps_that_were_not_set_are_taken_from_the_log_time(tmp_path: Path) -> None:
    sample = ImuSample(np.ones(3), np.ones(3))
    items = [("/imu", messages.IMU, START + i * SECOND, messages.encode_imu(0, sample)) for i in range(5)]
    log = open_log(write_raw(tmp_path / "a.mcap", items))
    np.testing.assert_array_equal(log.imu().stamps_ns, START + np.arange(5) * SECOND)
    assert log.warnings == {"imu_unstamped": 5}


def test_a_single_missing_stamp_is_put_on_the_clock_of_the_others(tmp_path: Path) -> None:
    """The recorder's clock is a year ahead of the sensor's."""
    year = 365 * 24 * 3600 * SECOND
    sample = ImuSample(np.ones(3), np.ones(3))
    stamps = [10 * SECOND, 11 * SECOND, 0, 13 * SECOND]
    items = [
        ("/imu", messages.IMU, (10 + i) * SECOND + year, messages.encode_imu(stamp, sample))
        for i, stamp in enumerate(stamps)
    ]
    log = open_log(write_raw(tmp_path / "a.mcap", items))
    np.testing.assert_array_equal(log.imu().stamps_ns, np.arange(10, 14) * SECOND)
    assert log.warnings == {"imu_unstamped": 1}
    assert any("clock is +31536000 s from the stamps" in note for note in log.notes)


def test_a_log_may_begin_at_zero(tmp_path: Path) -> None:
    log = open_log(write(tmp_path / "a.mcap", imu=imu_series(5, start=0)))
    assert log.imu().stamps_ns[0] == 0
    assert (log.start_ns, log.end_ns) == (0, 40 * MS)
    assert log.warnings == {}


def test_the_span_of_a_log_leaves_out_what_is_on_another_clock(tmp_path: Path) -> None:
    items = [imu_message("/imu", START + i * SECOND, ImuSample(np.ones(3), np.ones(3))) for i in range(-1, 6)]
    items += [camera_info(topics.CAMERA_INFO, START + i * SECOND) for i in range(4)]
    items += [
        (
            "/ground_truth",
            messages.POSE_STAMPED,
            SECOND,
            messages.encode_pose(SECOND, PoseSample(np.zeros(3), np.eye(4)[0])),
        )
    ]
    log = open_log(write_raw(tmp_path / "a.mcap", items))
    assert (log.start_ns, log.end_ns) == (START - SECOND, START + 5 * SECOND)


# --- Mounting -----------------------------------------------------------------------------------


def static(*edges: tuple[str, str, Rotation]) -> tuple:
    transforms = [
        FrameTransform(parent, child, PoseSample(np.ones(3), rotation.as_quat(scalar_first=True)))
        for parent, child, rotation in edges
    ]
    return topics.TF_STATIC, messages.TRANSFORMS, START, messages.encode_transforms(START, transforms)


def test_the_mounting_is_composed_along_the_tree_of_static_transforms(tmp_path: Path) -> None:
    """base -> camera_link -> camera, base -> imu_link: R_imu_camera = R_base_imu^-1 R_base_link R_link_camera."""
    base_link, link_camera, base_imu = Rotation.random(3, rng=np.random.default_rng(5))
    items = [
        imu_message("/imu", START, ImuSample(np.ones(3), np.ones(3)), "imu_link"),
        camera_info(topics.CAMERA_INFO, START),
        static(("base", "imu_link", base_imu), ("camera_link", "camera", link_camera)),
        static(("base", "camera_link", base_link), ("elsewhere", "lidar", base_link)),
    ]
    mounting = open_log(write_raw(tmp_path / "a.mcap", items)).mounting()
    expected = base_imu.inv() * base_link * link_camera
    np.testing.assert_allclose(mounting.as_matrix(), expected.as_matrix(), atol=1e-14)
    unconnected = open_log(write_raw(tmp_path / "b.mcap", items[:3]))
    assert unconnected.mounting() is None


# --- Roles --------------------------------------------------------------------------------------


def whole_imu(topic: str, stamp: int = START) -> tuple:
    return imu_message(topic, stamp, ImuSample(np.ones(3), np.ones(3)))


def test_two_candidates_are_an_error_that_lists_them(tmp_path: Path) -> None:
    path = write_raw(tmp_path / "a.mcap", [whole_imu("/front/imu"), whole_imu("/rear/imu")])
    with pytest.raises(LogError, match=r"a\.mcap: 2 topics could be the imu: /front/imu, /rear/imu") as caught:
        open_log(path)
    assert "\n" not in str(caught.value)
    assert open_log(path, {"imu": "/rear/imu"}).roles == {"imu": "/rear/imu"}


def test_our_own_name_decides_between_candidates(tmp_path: Path) -> None:
    path = write_raw(tmp_path / "a.mcap", [whole_imu("/front/imu"), whole_imu("/imu")])
    assert open_log(path).roles == {"imu": "/imu"}


def test_a_whole_imu_is_preferred_to_its_halves(tmp_path: Path) -> None:
    path = write_raw(tmp_path / "a.mcap", [whole_imu("/c/gyro/x"), whole_imu("/c/accel/x"), whole_imu("/c/unit")])
    assert open_log(path).roles == {"imu": "/c/unit"}


def test_a_choice_that_cannot_be_is_an_error_of_usage(tmp_path: Path) -> None:
    path = write_raw(tmp_path / "a.mcap", [whole_imu("/imu"), camera_info("/c/camera_info", START)])
    with pytest.raises(UsageError, match=r"topic /nowhere cannot be the imu; /imu could be"):
        open_log(path, {"imu": "/nowhere"})
    with pytest.raises(UsageError, match=r"topic /imu cannot be the depth; no topic could be"):
        open_log(path, {"depth": "/imu"})
    with pytest.raises(UsageError, match="there is no role 'lidar'"):
        open_log(path, {"lidar": "/imu"})


def test_our_own_results_are_never_the_truth(tmp_path: Path) -> None:
    pose = PoseSample(np.zeros(3), np.array([1.0, 0, 0, 0]))
    items = [
        whole_imu("/imu"),
        ("/odometry/raw", messages.ODOMETRY, START, messages.encode_odometry(START, pose, "camera_raw")),
        ("/odometry/ekf", messages.POSE_STAMPED, START, messages.encode_pose(START, pose)),
    ]
    path = write_raw(tmp_path / "a.mcap", items)
    assert "ground_truth" not in open_log(path).roles
    items.append(("/vicon/pose", messages.POSE_STAMPED, START, messages.encode_pose(START, pose)))
    assert open_log(write_raw(path, items)).roles["ground_truth"] == "/vicon/pose"


def test_odometry_is_the_truth_if_the_caller_says_so(tmp_path: Path) -> None:
    pose = PoseSample(np.arange(3.0), np.array([1.0, 0, 0, 0]))
    items = [("/true_odometry", messages.ODOMETRY, START, messages.encode_odometry(START, pose, "base"))]
    log = open_log(write_raw(tmp_path / "a.mcap", items), {"ground_truth": "/true_odometry"})
    np.testing.assert_array_equal(log.ground_truth().poses.translation, [[0, 1, 2]])


def test_image_and_depth_are_told_apart_by_what_they_hold(tmp_path: Path) -> None:
    """A depth image painted for the eye is neither; the intrinsics are those beside the image."""
    millimetres = (depth() * 1000).astype(np.uint16)
    items = [
        raw_image("/c/color/image_raw", START, grey(), "mono8"),
        raw_image("/c/aligned_depth/image_raw", START, millimetres, "16UC1"),
        raw_image("/c/depth_painted/image_raw", START, grey(), "mono8"),
        camera_info("/c/aligned_depth/camera_info", START),
        camera_info("/c/color/camera_info", START),
    ]
    log = open_log(write_raw(tmp_path / "a.mcap", items))
    assert log.roles == {
        "image": "/c/color/image_raw",
        "depth": "/c/aligned_depth/image_raw",
        "camera_info": "/c/color/camera_info",
    }
    (frame,) = log.frames()
    np.testing.assert_allclose(frame.depth, millimetres / 1000, rtol=1e-6)


def test_compressed_images_have_their_intrinsics_a_level_up(tmp_path: Path) -> None:
    compressed = messages.encode_image(START, grey())
    items = [
        ("/left/image_raw/compressed", messages.COMPRESSED_IMAGE, START, compressed),
        camera_info("/left/camera_info", START),
        camera_info("/right/camera_info", START),
    ]
    assert open_log(write_raw(tmp_path / "a.mcap", items)).roles["camera_info"] == "/left/camera_info"


def test_rectified_images_are_not_undistorted_again(tmp_path: Path) -> None:
    """image_rect* of ROS: the lens is undone and the intrinsics are in P."""
    lens = dataclasses.replace(CAMERA, distortion_model="plumb_bob", distortion=np.array([-0.3, 0.1, 0, 0, 0]))
    items = [raw_image("/c/image_rect", START, grey(), "mono8"), camera_info("/c/camera_info", START, lens)]
    (frame,) = open_log(write_raw(tmp_path / "a.mcap", items)).frames()
    np.testing.assert_array_equal(frame.image, grey())


def test_an_encoding_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    items = [raw_image("/c/image_raw", START, grey(), "bayer_rggb8"), whole_imu("/imu")]
    log = open_log(write_raw(tmp_path / "a.mcap", items))
    assert not log.has_frames
    assert any("/c/image_raw" in note and "bayer_rggb8" in note for note in log.notes)


def test_a_log_whose_first_messages_are_broken_is_judged_by_the_next(tmp_path: Path) -> None:
    _, kind, _, good = whole_imu("/imu", START + SECOND)
    items = [("/imu", kind, START, good[:40]), ("/imu", kind, START + SECOND, good), camera_info("/c/info", START)]
    log = open_log(write_raw(tmp_path / "a.mcap", [*items, static(("camera", "imu", Rotation.identity()))]))
    assert log.roles["imu"] == "/imu"
    assert log.mounting().magnitude() == 0


def test_messages_that_cannot_be_decoded_are_counted(tmp_path: Path) -> None:
    good = messages.encode_imu(START, ImuSample(np.ones(3), np.ones(3)))
    later = messages.encode_imu(START + SECOND, ImuSample(np.ones(3), np.ones(3)))
    items = [("/imu", messages.IMU, START, good), ("/imu", messages.IMU, START + SECOND, later[:50])]
    log = open_log(write_raw(tmp_path / "a.mcap", items))
    for _ in range(2):
        assert len(log.imu()) == 1
        assert log.warnings == {"imu_unreadable": 1}
