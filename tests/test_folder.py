"""One's own recording: every camera file format gives the same camera; tables with faults are cleaned or refused."""

from collections import Counter
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from fusion_io.errors import LogError
from fusion_io.folder import open_folder, read_camera, read_imu_csv
from fusion_io.images import Framing
from fusion_io.recording import DepthImage

START = 1_403_636_579_763_555_584
HEADER = (
    "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],"
    "a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]"
)

OPENCV = """%YAML:1.0
---
calibration_time: "Mon 03 Mar 2014"
image_width: 64
image_height: 48
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 50., 0., 31.25, 0., 5.1e+01, 23.5, 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 1
   cols: 5
   dt: d
   data: [ -2.5e-01, 1.25e-01, 1e-3, -0.002, 0. ]
"""
ROS = """image_width: 64
image_height: 48
camera_name: left
camera_matrix:
  rows: 3
  cols: 3
  data: [50, 0, 31.25, 0, 51, 23.5, 0, 0, 1]
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: [-0.25, 0.125, 0.001, -0.002, 0]
"""
EUROC = """#Default
sensor_type: camera
T_BS:
  cols: 4
  rows: 4
  data: [0, 0, 1, 0.1,
        -1, 0, 0, 0.2,
         0, -1, 0, 0.3,
         0, 0, 0, 1]
resolution: [64, 48]
camera_model: pinhole
intrinsics: [50, 51, 31.25, 23.5] #fu, fv, cu, cv
distortion_model: radial-tangential
distortion_coefficients: [-0.25, 0.125, 0.001, -0.002]
"""
KALIBR = """cam0:
  T_cam_imu:
  - [0, -1, 0, 0]
  - [0, 0, -1, 0]
  - [1, 0, 0, 0]
  - [0, 0, 0, 1]
  camera_model: pinhole
  distortion_coeffs: [-0.25, 0.125, 0.001, -0.002]
  distortion_model: radtan
  intrinsics: [50, 51, 31.25, 23.5]
  resolution: [64, 48]
"""
ORB_SLAM = """%YAML:1.0
Camera.type: "PinHole"
Camera.fx: 50
Camera.fy: 51
Camera.cx: 31.25
Camera.cy: 23.5
Camera.k1: -0.25
Camera.k2: 0.125
Camera.p1: 0.001
Camera.p2: -0.002
Camera.width: 64
Camera.height: 48
"""


def written(path: Path, text: str) -> Path:
    path.write_text(text)
    return path


# ----------------------------------------------------------------------------------------------------- camera


@pytest.mark.parametrize(
    "text", [OPENCV, ROS, EUROC, KALIBR, ORB_SLAM], ids=["opencv", "ros", "euroc", "kalibr", "orb"]
)
def test_every_format_gives_the_same_camera(tmp_path, text):
    camera = read_camera(written(tmp_path / "camera.yaml", text))
    assert_array_equal(camera.K, [[50, 0, 31.25], [0, 51, 23.5], [0, 0, 1]])
    assert camera.size == (64, 48)
    assert camera.distortion_model == "plumb_bob"
    assert_array_equal(camera.distortion[:4], [-0.25, 0.125, 0.001, -0.002])


@pytest.mark.parametrize("text", [EUROC, KALIBR], ids=["euroc", "kalibr"])
def test_the_mounting_turns_the_optical_axis_forward(tmp_path, text):
    rotation = read_camera(written(tmp_path / "camera.yaml", text)).rotation_imu_camera
    assert_allclose(rotation.apply(np.eye(3)), [[0, -1, 0], [0, 0, -1], [1, 0, 0]], atol=1e-12)


def test_a_file_that_opencv_itself_wrote_is_read(tmp_path):
    path = tmp_path / "camera.yaml"
    K = np.array([[458.654, 0, 367.215], [0, 457.296, 248.375], [0, 0, 1]])
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", 752)
    storage.write("image_height", 480)
    storage.write("cameraMatrix", K)
    storage.write("distCoeffs", np.array([[1e-9, 0.07, 2e-4, 1.8e-5, 0]]))
    storage.release()
    camera = read_camera(path)
    assert_array_equal(camera.K, K)
    assert camera.size == (752, 480)
    assert_array_equal(camera.distortion, [1e-9, 0.07, 2e-4, 1.8e-5, 0])


def test_a_lens_without_distortion_has_no_coefficients(tmp_path):
    text = EUROC.replace("[-0.25, 0.125, 0.001, -0.002]", "[0, 0.0, 0, 0]")
    camera = read_camera(written(tmp_path / "camera.yaml", text))
    assert camera.distortion_model == ""
    assert len(camera.distortion) == 0


def test_a_fisheye_lens_keeps_its_model(tmp_path):
    text = KALIBR.replace("radtan", "equidistant")
    assert read_camera(written(tmp_path / "camera.yaml", text)).distortion_model == "equidistant"


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("image_width: 64\nimage_height: 48\n", "no camera matrix"),
        ("- 1\n- 2\n", "not a camera file"),
        ("hello", "not a camera file"),
        ("a: [1, 2\n", "not YAML"),
        ("a: !!python/object:os.system 1\n", "not YAML"),
        (ROS.replace("50, 0, 31.25,", ""), "cameramatrix must be 9 finite numbers"),
        (ROS.replace("50, 0, 31.25,", ".nan, 0, 31.25,"), "cameramatrix must be 9 finite numbers"),
        (ROS.replace("50, 0, 31.25,", "fx, 0, 31.25,"), "cameramatrix is not made of numbers"),
        (ROS.replace("50, 0, 31.25,", "-50, 0, 31.25,"), "not a camera matrix"),
        (ROS.replace("plumb_bob", "omni"), "cannot use a lens model 'omni'"),
        (ROS.replace("0.001, -0.002, 0]", "0.001]"), "cannot use a lens model 'plumb_bob' with 3 coefficients"),
        (EUROC.replace("[64, 48]", "[64, 0]"), "not a size of an image"),
        (EUROC.replace("[0, 0, 1, 0.1,", "[0, 0, 2, 0.1,"), "not rigid"),
    ],
)
def test_camera_files_that_are_refused(tmp_path, text, reason):
    with pytest.raises(LogError, match=rf"camera\.yaml: .*{reason}"):
        read_camera(written(tmp_path / "camera.yaml", text))


# -------------------------------------------------------------------------------------------------------- IMU


def sample(index: int, values: str = "0.1,0.2,0.3,1,2,9.8") -> str:
    return f"{START + index * 5_000_000},{values}"


def imu_file(tmp_path: Path, *lines: str) -> Path:
    return written(tmp_path / "imu.csv", "\n".join(lines) + "\n")


@pytest.mark.parametrize("header", [[HEADER], [HEADER[1:]], []], ids=["euroc", "without #", "none"])
def test_an_imu_table_is_read_with_and_without_header(tmp_path, header):
    warnings: Counter[str] = Counter()
    imu = read_imu_csv(imu_file(tmp_path, *header, *map(sample, range(3))), warnings)
    assert_array_equal(imu.stamps_ns, START + np.arange(3) * 5_000_000)
    assert_array_equal(imu.angular_velocity, [[0.1, 0.2, 0.3]] * 3)
    assert_array_equal(imu.linear_acceleration, [[1, 2, 9.8]] * 3)
    assert not warnings


def test_columns_are_found_by_their_names(tmp_path):
    header = "#timestamp,a_RS_S_x,a_RS_S_y,a_RS_S_z,w_RS_S_x,w_RS_S_y,w_RS_S_z"
    imu = read_imu_csv(imu_file(tmp_path, header, sample(0, "1,2,9.8,0.1,0.2,0.3")), Counter())
    assert_array_equal(imu.linear_acceleration, [[1, 2, 9.8]])


def test_samples_that_are_not_finite_or_go_backwards_are_dropped_and_counted(tmp_path):
    lines = [sample(0), sample(1), sample(1), sample(2, "nan,0,0,0,0,9.8"), sample(900), sample(3), sample(4)]
    warnings: Counter[str] = Counter()
    imu = read_imu_csv(imu_file(tmp_path, HEADER, *lines), warnings)
    assert_array_equal((imu.stamps_ns - START) // 5_000_000, [0, 1, 3, 4])
    assert warnings == {
        "IMU samples dropped (not finite)": 1,
        "IMU samples dropped (their time does not increase)": 2,
    }


@pytest.mark.parametrize(
    ("lines", "reason"),
    [
        ([HEADER], "holds no data"),
        ([HEADER[1:]], "holds no data"),
        ([HEADER, sample(0, "1,2,3")], "line 2: 4 columns where 7 are expected"),
        ([HEADER, sample(0, "1,2,3,4,5,x")], "line 2: not a number"),
        ([HEADER, "1403636579.76,1,2,3,4,5,6"], "line 2: not a stamp in nanoseconds"),
        ([HEADER, f"{10**30},1,2,3,4,5,6"], "line 2: not a possible stamp"),
        (["t,gx,gy,gz,ax,ay,az", sample(0)], "the columns must be timestamp"),
        (["hello"], "1 columns where 7 are expected"),
    ],
)
def test_imu_tables_that_are_refused(tmp_path, lines, reason):
    with pytest.raises(LogError, match=rf"imu\.csv: .*{reason}"):
        read_imu_csv(imu_file(tmp_path, *lines), Counter())


# ----------------------------------------------------------------------------------------------------- folder


@pytest.fixture
def recorded(tmp_path) -> Path:
    """Three images, 33 ms apart, and depth that is stamped 4 ms later."""
    rng = np.random.default_rng(0)
    for name in ("images", "depth"):
        (tmp_path / name).mkdir()
    for i in range(3):
        stamp = START + i * 33_000_000
        cv2.imwrite(str(tmp_path / "images" / f"{stamp}.png"), rng.integers(0, 255, (48, 64, 3), np.uint8))
        depth = np.full((48, 64), 1000 * (i + 1), np.uint16)
        cv2.imwrite(str(tmp_path / "depth" / f"{stamp + 4_000_000}.png"), depth)
    written(tmp_path / "camera.yaml", EUROC)
    imu_file(tmp_path, HEADER, *map(sample, range(20)))
    written(tmp_path / "truth.tum", "1403636579.763555584 1 2 3 0 0 0 1\n")
    return tmp_path


def opened(folder: Path, **options):
    return open_folder(folder / "images", folder / "depth", folder / "camera.yaml", **options)


def test_images_and_depth_come_in_order_of_their_own_stamps(recorded):
    recording = opened(recorded, imu=recorded / "imu.csv", ground_truth=recorded / "truth.tum")
    items = list(recording.frames)
    assert [(item.stamp_ns - START) // 1_000_000 for item in items] == [0, 4, 33, 37, 66, 70]
    assert [isinstance(item, DepthImage) for item in items] == [False, True] * 3
    assert_allclose(items[3].depth, 2.0)
    assert items[0].image.shape == (48, 64, 3)
    assert items[0].camera.distortion_model == "plumb_bob"
    assert recording.ground_truth.stamps_ns == [START]
    assert len(recording.imu) == 20
    assert recording.rotation_imu_camera is not None
    assert not recording.warnings


def test_jpeg_and_stamps_in_seconds_are_read(recorded):
    image = np.full((48, 64), 100, np.uint8)
    cv2.imwrite(str(recorded / "images" / "1403636579.900000001.jpg"), image)
    stamps = [item.stamp_ns for item in opened(recorded).frames if not isinstance(item, DepthImage)]
    assert stamps[-1] == 1_403_636_579_900_000_001


def test_depth_is_scaled_cropped_and_fitted_to_the_image(recorded):
    for file in (recorded / "depth").iterdir():
        cv2.imwrite(str(file), np.full((24, 32), 10_000, np.uint16))
    recording = opened(recorded, metres_per_unit=0.0002, framing=Framing(40, (32, 20)))
    for item in recording.frames:
        picture = item.depth if isinstance(item, DepthImage) else item.image
        assert picture.shape[:2] == (20, 32)
        if isinstance(item, DepthImage):
            assert_allclose(picture, 2.0, rtol=1e-6)
        else:
            assert (item.camera.width, item.camera.height) == (32, 20)


def test_the_size_is_that_of_the_images_where_the_camera_file_has_none(recorded):
    written(recorded / "camera.yaml", "intrinsics: [50, 51, 31, 23]\n")
    (recorded / "images" / f"{START}.png").write_bytes(b"not an image")
    camera = next(item.camera for item in opened(recorded).frames if not isinstance(item, DepthImage))
    assert (camera.width, camera.height) == (64, 48)


def test_files_that_cannot_be_used_are_counted(recorded):
    (recorded / "images" / f"{START}.png").write_bytes(b"not an image")
    (recorded / "depth" / f"{START + 4_000_000}.png").write_bytes(b"")
    written(recorded / "images" / "preview.png", "")
    written(recorded / "images" / ".hidden.png", "")
    written(recorded / "images" / "notes.txt", "")
    recording = opened(recorded)
    assert len(list(recording.frames)) == 4
    assert recording.warnings == {
        "images skipped (their name is not a time stamp)": 1,
        "frames skipped (image cannot be decoded)": 1,
        "depth images skipped (cannot be decoded)": 1,
    }


def test_names_that_count_frames_are_not_taken_for_nanoseconds(recorded):
    for i, file in enumerate(sorted((recorded / "images").iterdir())):
        file.rename(file.with_name(f"{i:06d}.png"))
    with pytest.raises(LogError, match="3 images in 2 ns: names must be stamps in nanoseconds"):
        opened(recorded)


def test_folders_without_images_are_refused(recorded):
    with pytest.raises(LogError, match="gone: no such folder"):
        open_folder(recorded / "gone", recorded / "depth", recorded / "camera.yaml")
    for file in (recorded / "depth").iterdir():
        file.unlink()
    with pytest.raises(LogError, match="depth: holds no image that is named by its time stamp"):
        opened(recorded)


def test_images_of_another_size_than_the_camera_file_says_are_refused(recorded):
    written(recorded / "camera.yaml", EUROC.replace("[64, 48]", "[640, 480]"))
    with pytest.raises(LogError, match="64x48 pixels where 640x480 are expected"):
        list(opened(recorded).frames)


def test_depth_that_cannot_belong_to_the_image_is_refused(recorded):
    cv2.imwrite(str(recorded / "depth" / f"{START + 4_000_000}.png"), np.zeros((48, 48), np.uint16))
    with pytest.raises(LogError, match="depth of 48x48 cannot belong to an image of 64x48"):
        list(opened(recorded).frames)
