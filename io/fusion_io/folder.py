"""One's own recording: a folder of images, one of depth, an IMU table and a camera file.

Images are named by their stamp in nanoseconds (``1403636579763555584.png``), or in seconds with a point
(``1305031102.175304.png``, as in TUM RGB-D). The IMU table is EuRoC's: stamp in nanoseconds, angular
velocity, acceleration. The camera is a YAML file of OpenCV, ROS (``camera_info``), EuRoC, Kalibr or
ORB-SLAM; lens distortion goes into the log as it is, and whoever reads the log undistorts.
"""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from fusion_io.camera import fit_depth
from fusion_io.errors import LogError
from fusion_io.images import SUFFIXES, WHOLE, Framing, read_depth, read_image
from fusion_io.inertial import longest_increasing
from fusion_io.recording import DepthImage, Recording
from fusion_io.records import CameraFrame, CameraInfo, FloatArray, ImuSeries
from fusion_io.trajectory_files import (
    ROTATION_TOLERANCE,
    Row,
    nanoseconds,
    read_rows,
    read_text,
    read_tum,
    rotation_error,
)

#: Depth images are in millimetres unless told otherwise.
MILLIMETRE = 0.001
#: More images a second than this, and the names are not stamps in nanoseconds.
MAX_FRAME_RATE = 10_000


def open_folder(
    images: Path,
    depth: Path,
    camera: Path,
    *,
    imu: Path | None = None,
    ground_truth: Path | None = None,
    metres_per_unit: float = MILLIMETRE,
    framing: Framing = WHOLE,
) -> Recording:
    """A recording in files.

    images, depth: folders. Depth images are registered to the images, of 16 bits, ``metres_per_unit``
    each, 0 where there is none; they have stamps of their own and may be of another size. imu: a CSV
    file. camera: a YAML file. ground_truth: poses of the camera, in TUM's format.
    """
    recording = Recording()
    image_files = _stamped_files(images, recording.warnings)
    depth_files = _stamped_files(depth, recording.warnings)
    model = read_camera(camera)
    recording.rotation_imu_camera = model.rotation_imu_camera
    if imu is not None:
        recording.imu = read_imu_csv(imu, recording.warnings)
    if ground_truth is not None:
        recording.ground_truth = read_tum(ground_truth)
    width, height = model.size or _size_of_first(image_files, images)
    info = CameraInfo(width, height, model.K, model.distortion_model, model.distortion)
    pictures = _Pictures(info, framing, metres_per_unit, recording.warnings)
    recording.frames = heapq.merge(
        pictures.images(image_files), pictures.depths(depth_files), key=lambda item: item.stamp_ns
    )
    recording.frame_count = len(image_files)
    return recording


# ----------------------------------------------------------------------------------------------------- images


def _stamped_files(folder: Path, warnings: Counter[str]) -> list[tuple[int, Path]]:
    """The images of a folder in order of the stamps (ns) that are their names; other names are counted."""
    if not folder.is_dir():
        raise LogError(f"{folder}: no such folder")
    stamped = []
    for file in sorted(folder.iterdir()):
        if file.suffix.lower() not in SUFFIXES or file.name.startswith("."):
            continue
        try:
            stamped.append((nanoseconds(file.stem) if "." in file.stem else int(file.stem), file))
        except ValueError:
            warnings["images skipped (their name is not a time stamp)"] += 1
    stamped.sort()
    if not stamped:
        raise LogError(f"{folder}: holds no image that is named by its time stamp")
    duration_ns = stamped[-1][0] - stamped[0][0]
    if (len(stamped) - 1) * 1e9 > MAX_FRAME_RATE * duration_ns:
        raise LogError(f"{folder}: {len(stamped)} images in {duration_ns} ns: names must be stamps in nanoseconds")
    return stamped


def _size_of_first(files: Sequence[tuple[int, Path]], folder: Path) -> tuple[int, int]:
    """Width and height of the first image that can be decoded."""
    for _, file in files:
        image = read_image(file)
        if image is not None:
            return image.shape[1], image.shape[0]
    raise LogError(f"{folder}: no image can be decoded")


@dataclass(frozen=True, slots=True)
class _Pictures:
    """Reads images and depth of one camera (``info``: at full size); what cannot be decoded is counted."""

    info: CameraInfo
    framing: Framing
    metres_per_unit: float
    warnings: Counter[str]

    def images(self, files: Sequence[tuple[int, Path]]) -> Iterator[CameraFrame | DepthImage]:
        camera = self.framing.camera(self.info)
        for stamp_ns, file in files:
            image = read_image(file)
            if image is None:
                self.warnings["frames skipped (image cannot be decoded)"] += 1
                continue
            if image.shape[1::-1] != (self.info.width, self.info.height):
                raise LogError(
                    f"{file}: {image.shape[1]}x{image.shape[0]} pixels where {self.info.width}x{self.info.height} "
                    "are expected"
                )
            yield CameraFrame(stamp_ns, self.framing.image(image), None, camera)

    def depths(self, files: Sequence[tuple[int, Path]]) -> Iterator[CameraFrame | DepthImage]:
        for stamp_ns, file in files:
            depth = read_depth(file, self.metres_per_unit)
            if depth is None:
                self.warnings["depth images skipped (cannot be decoded)"] += 1
                continue
            try:
                depth = fit_depth(depth, self.info.width, self.info.height)
            except ValueError as error:
                raise LogError(f"{file}: {error}") from None
            yield DepthImage(stamp_ns, self.framing.depth(depth))


# -------------------------------------------------------------------------------------------------------- IMU

#: EuRoC's names of the columns after the stamp: angular velocity (rad/s), then acceleration (m/s^2).
IMU_COLUMNS = tuple(f"{quantity}_RS_S_{axis}" for quantity in "wa" for axis in "xyz")


def read_imu_csv(path: Path, warnings: Counter[str]) -> ImuSeries:
    """An IMU table: stamp in nanoseconds and the six ``IMU_COLUMNS``, separated by commas.

    The columns may stand in another order if a header names them. Samples that are not finite, and those
    whose stamps keep the rest from increasing, are dropped and counted.
    """
    header, has_header = _imu_header(path)
    rows = read_rows(path, columns=(1 + len(IMU_COLUMNS),), separator=",")
    # A header that begins with # was skipped as a comment.
    samples = rows[1:] if has_header and not header.startswith("#") else rows
    if not samples:
        raise LogError(f"{path}: holds no data")
    columns = _imu_columns(path, header) if has_header else slice(None)
    stamps_ns = np.array([_integer_stamp(row) for row in samples], dtype=np.int64)
    values = np.array([row.floats(start=1) for row in samples])[:, columns]
    finite = np.flatnonzero(np.isfinite(values).all(axis=1))
    if len(finite) < len(samples):
        warnings["IMU samples dropped (not finite)"] += len(samples) - len(finite)
    kept = finite[longest_increasing(stamps_ns[finite])]
    if len(kept) < len(finite):
        warnings["IMU samples dropped (their time does not increase)"] += len(finite) - len(kept)
    return ImuSeries(stamps_ns[kept], angular_velocity=values[kept, :3], linear_acceleration=values[kept, 3:])


def _imu_header(path: Path) -> tuple[str, bool]:
    """The first line of the table, and whether it names the columns rather than being a sample."""
    line = next((line.strip() for line in read_text(path).splitlines() if line.strip()), "")
    return line, not line.split(",")[0].lstrip("-").isdecimal()


def _imu_columns(path: Path, header: str) -> list[int]:
    """Where each of ``IMU_COLUMNS`` stands after the stamp; a header may add units: ``w_RS_S_x [rad s^-1]``."""
    names = [word.split("[")[0].strip() for word in header.split(",")[1:]]
    try:
        return [names.index(name) for name in IMU_COLUMNS]
    except ValueError:
        raise LogError(f"{path}: the columns must be timestamp [ns],{','.join(IMU_COLUMNS)}") from None


def _integer_stamp(row: Row) -> int:
    try:
        stamp_ns = int(row.words[0])
    except ValueError:
        raise row.error(f"not a stamp in nanoseconds ({row.words[0]!r})") from None
    if abs(stamp_ns) >= 2**63:
        raise row.error(f"not a possible stamp in nanoseconds ({row.words[0]})")
    return stamp_ns


# ----------------------------------------------------------------------------------------------------- camera


@dataclass(frozen=True, slots=True)
class CameraModel:
    """What a camera file says: K (3, 3) in pixels, the lens, and if it is there the size and the mounting.

    size: (width, height). distortion_model, distortion: as in sensor_msgs/CameraInfo.
    rotation_imu_camera: v_imu = R v_camera.
    """

    K: FloatArray
    size: tuple[int, int] | None
    distortion_model: str
    distortion: FloatArray
    rotation_imu_camera: Rotation | None


# Keys are compared in small letters and without underscores: cameraMatrix, camera_matrix and Camera_Matrix are one.
_MATRIX_KEYS = ("cameramatrix", "k")
_INTRINSICS_KEYS = ("intrinsics",)
_DISTORTION_KEYS = ("distortioncoefficients", "distortioncoeffs", "distcoeffs", "d")
_SIZE_KEYS = ("resolution", "imagesize")
_WIDTH_KEYS = ("imagewidth", "width", "camera.width")
_HEIGHT_KEYS = ("imageheight", "height", "camera.height")
_MODEL_KEYS = ("distortionmodel", "camera.type")
_T_IMU_CAMERA_KEYS = ("tbs", "tbc", "imu.tbc1")
_T_CAMERA_IMU_KEYS = ("tcamimu",)
_ORB_SLAM_PREFIXES = ("camera.", "camera1.")

#: Names of lens models, and their names in sensor_msgs/distortion_models.hpp.
_LENS_MODELS = {
    "plumb_bob": "plumb_bob",
    "radtan": "plumb_bob",
    "radial-tangential": "plumb_bob",
    "pinhole": "plumb_bob",
    "rational_polynomial": "rational_polynomial",
    "equidistant": "equidistant",
    "fisheye": "equidistant",
    "kannalabrandt8": "equidistant",
}
_COEFFICIENTS = {"plumb_bob": (4, 5), "rational_polynomial": (8, 12, 14), "equidistant": (4,)}


class _Loader(yaml.SafeLoader):
    """YAML with OpenCV's matrices, which read as mappings with ``rows``, ``cols`` and ``data``."""


def _opencv_matrix(loader: yaml.SafeLoader, node: yaml.MappingNode) -> dict[Any, Any]:
    return loader.construct_mapping(node, deep=True)


_Loader.add_constructor("tag:yaml.org,2002:opencv-matrix", _opencv_matrix)


def read_camera(path: Path) -> CameraModel:
    """A camera file of OpenCV (FileStorage), ROS (camera_info), EuRoC (sensor.yaml), Kalibr or ORB-SLAM."""
    # OpenCV writes "%YAML:1.0", which is not YAML's own form of that line.
    text = "\n".join(line for line in read_text(path).splitlines() if not line.startswith("%YAML"))
    try:
        document = yaml.load(text, Loader=_Loader)
    except yaml.YAMLError as error:
        raise LogError(f"{path}: not YAML ({' '.join(str(error).split())})") from None
    if isinstance(document, Mapping):
        document = document.get("cam0", document)
    if not isinstance(document, Mapping):
        raise LogError(f"{path}: not a camera file")
    file = _CameraFile(path, {str(key).lower().replace("_", ""): value for key, value in document.items()})
    distortion_model, distortion = file.lens()
    return CameraModel(file.matrix(), file.size(), distortion_model, distortion, file.rotation_imu_camera())


@dataclass(frozen=True, slots=True)
class _CameraFile:
    """The entries of a camera file, by their normalised keys."""

    path: Path
    entries: Mapping[str, Any]

    def matrix(self) -> FloatArray:
        """K (3, 3)."""
        values = self._numbers(_MATRIX_KEYS, 9)
        if values is not None:
            K = values.reshape(3, 3)
        else:
            focal_and_centre = self._numbers(_INTRINSICS_KEYS, 4)
            if focal_and_centre is None:
                focal_and_centre = self._orb_slam("fx", "fy", "cx", "cy")
            if len(focal_and_centre) != 4:
                raise LogError(f"{self.path}: no camera matrix (camera_matrix, K, intrinsics or Camera.fx ...)")
            fx, fy, cx, cy = focal_and_centre
            K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
        if not (K[0, 0] > 0 and K[1, 1] > 0 and np.array_equal(K[2], [0, 0, 1])):
            raise LogError(f"{self.path}: not a camera matrix: {K.tolist()}")
        return K

    def size(self) -> tuple[int, int] | None:
        """Width and height, if the file has them."""
        values = self._numbers(_SIZE_KEYS, 2)
        if values is None:
            width, height = self._numbers(_WIDTH_KEYS, 1), self._numbers(_HEIGHT_KEYS, 1)
            values = None if width is None or height is None else np.concatenate([width, height])
        if values is None:
            return None
        if not (values >= 1).all():
            raise LogError(f"{self.path}: not a size of an image: {values.tolist()}")
        return int(values[0]), int(values[1])

    def lens(self) -> tuple[str, FloatArray]:
        """Distortion model and coefficients, none if the lens has no distortion."""
        values = self._numbers(_DISTORTION_KEYS)
        if values is None:
            values = self._orb_slam("k1", "k2", "p1", "p2", "k3", "k4")
        if not values.any():
            return "", np.zeros(0)
        default = "plumb_bob" if len(values) <= 5 else "rational_polynomial"
        name = str(self._entry(_MODEL_KEYS) or default)
        model = _LENS_MODELS.get(name.lower())
        if model is None or len(values) not in _COEFFICIENTS[model]:
            raise LogError(f"{self.path}: cannot use a lens model {name!r} with {len(values)} coefficients")
        return model, values

    def rotation_imu_camera(self) -> Rotation | None:
        """The mounting, if the file has a transform between camera and IMU."""
        T_imu_camera = self._numbers(_T_IMU_CAMERA_KEYS, 16)
        T_camera_imu = self._numbers(_T_CAMERA_IMU_KEYS, 16)
        if T_imu_camera is not None:
            return self._rotation(T_imu_camera)
        return None if T_camera_imu is None else self._rotation(T_camera_imu).inv()

    def _rotation(self, transform: FloatArray) -> Rotation:
        matrix = transform.reshape(4, 4)[:3, :3]
        if rotation_error(matrix) > ROTATION_TOLERANCE:
            raise LogError(f"{self.path}: the transform between camera and IMU is not rigid")
        return Rotation.from_matrix(matrix)

    def _entry(self, keys: Sequence[str]) -> Any:
        return next((self.entries[key] for key in keys if key in self.entries), None)

    def _numbers(self, keys: Sequence[str], count: int | None = None) -> FloatArray | None:
        """An entry as a flat array of finite numbers, of which there must be ``count``."""
        value = self._entry(keys)
        if value is None:
            return None
        if isinstance(value, Mapping):
            value = value.get("data")
        try:
            numbers = np.asarray(value, dtype=np.float64).ravel()
        except (TypeError, ValueError):
            raise LogError(f"{self.path}: {keys[0]} is not made of numbers") from None
        if not np.isfinite(numbers).all() or count not in (None, len(numbers)):
            raise LogError(f"{self.path}: {keys[0]} must be {count or 'some'} finite numbers")
        return numbers

    def _orb_slam(self, *names: str) -> FloatArray:
        """ORB-SLAM's entries, a number each (``Camera.fx``); those that are there."""
        entries = (self._numbers([prefix + name for prefix in _ORB_SLAM_PREFIXES], 1) for name in names)
        return np.concatenate([np.zeros(0), *(entry for entry in entries if entry is not None)])
