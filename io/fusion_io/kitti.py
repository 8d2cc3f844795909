"""KITTI's recordings: the odometry benchmark and the raw drives.

Geiger, Lenz, Urtasun, "Are we ready for autonomous driving? The KITTI vision benchmark suite", CVPR 2012;
Geiger, Lenz, Stiller, Urtasun, "Vision meets robotics: the KITTI dataset", IJRR 2013; the development
kits' ``readme.txt`` and ``dataformat.txt``.

Frame i of a recording is line i of its time stamps; an image that is not on disk is no error. Camera 0 is
the left grey camera, 1 the right one; 2 and 3 are the colour cameras. Both pairs are rectified. Depth comes from
the stereo pair or from the Velodyne scanner, whose scan i was taken around frame i: the cameras are triggered when
it looks forward. The odometry benchmark's scans are compensated for the car's motion, those of the raw drives are
not: what is at the margins of the image was measured up to 12 ms earlier or later than the image was taken.

All cameras are triggered at once, but each image of a raw drive was stamped by itself when the computer had it: up to
7 ms late, now this camera's, now that one's, never early. The earliest stamp of a frame is its time (see
``trigger_times``).
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from fusion_io.errors import LogError, UsageError
from fusion_io.gnss import Receiver
from fusion_io.images import SUFFIXES, WHOLE, Framing
from fusion_io.inertial import MAX_GAP_PERIODS, longest_increasing
from fusion_io.lidar import SUFFIX as SCAN_SUFFIX
from fusion_io.lidar import LidarRig, Scan, lidar_frames
from fusion_io.recording import Recording, between
from fusion_io.records import NANOSECONDS, CameraFrame, FloatArray, GnssFix, ImuSeries, IntArray, Trajectory
from fusion_io.stereo import StereoPair, StereoRig, stereo_frames
from fusion_io.trajectory_files import (
    ROTATION_TOLERANCE,
    read_kitti,
    read_rows,
    read_text,
    read_times,
    rotation_error,
)

#: IMU rows from one frame to the next in the odometry benchmark's IMU files.
IMU_ROWS_PER_FRAME = 10
IMU_VARIABLE = "imu_data_interp"

#: IMU samples are kept this long before the first and after the last frame: a window before the first
#: pair, and room for an offset between the clocks.
IMU_MARGIN_NS = NANOSECONDS // 2

#: Where depth comes from.
DepthSource = Literal["stereo", "velodyne"]

GREY_CAMERAS = (0, 1)
COLOUR_CAMERAS = (2, 3)

#: Columns of an OXTS record that are used here (``dataformat.txt``), of 30.
OXTS_COLUMNS = 30
_LATITUDE, _LONGITUDE, _ALTITUDE = 0, 1, 2
_ROLL_PITCH_YAW = slice(3, 6)
_ACCELERATION = slice(11, 14)  # ax ay az in the unit's axes; af al au are levelled
_ANGULAR_RATE = slice(17, 20)  # wx wy wz in the unit's axes
_POSITION_ACCURACY = 23
#: The earth's radius of the development kit's Mercator projection (WGS84's equator), in metres.
EARTH_RADIUS_M = 6378137.0

#: The raw drive of each odometry sequence, and which of its frames is the sequence's first (the odometry
#: development kit's ``readme.txt``, "Mapping to Raw Data"). Of sequences 11 to 21 they are not published;
#: drive 0067 is no longer offered.
RAW_DRIVES = {
    "00": ("2011_10_03_drive_0027", 0),
    "01": ("2011_10_03_drive_0042", 0),
    "02": ("2011_10_03_drive_0034", 0),
    "03": ("2011_09_26_drive_0067", 0),
    "04": ("2011_09_30_drive_0016", 0),
    "05": ("2011_09_30_drive_0018", 0),
    "06": ("2011_09_30_drive_0020", 0),
    "07": ("2011_09_30_drive_0027", 0),
    "08": ("2011_09_30_drive_0028", 1100),
    "09": ("2011_09_30_drive_0033", 0),
    "10": ("2011_09_30_drive_0034", 0),
}
#: A synchronised OXTS record is within 10 ms of its frame; further than this (median) the frames are others. Stamps
#: of one frame's images are within 7 ms.
CLOCK_TOLERANCE_NS = 20_000_000


# ---------------------------------------------------------------------------------------------- the odometry


def open_odometry(
    root: Path,
    sequence: str,
    *,
    imu: Path | None = None,
    oxts: Path | None = None,
    depth: DepthSource | None = None,
    frames: slice = slice(None),
    colour: bool = False,
    framing: Framing = WHOLE,
) -> Recording:
    """A sequence of the odometry benchmark in its official layout.

    root: the folder of ``sequences/`` and (optional) ``poses/``. imu: the sequence's IMU file. oxts: instead of
    it the folder of the sequence's raw drive, whose OXTS unit is the IMU; all times are then on its clock. depth:
    by default from stereo, or from the scanner where there are scans but no right camera. frames: the range of
    frames to take. colour: cameras 2 and 3 instead of 0 and 1. Ground truth, where there is one, is that of the
    chosen left camera, in the frame of the first pose of the range.
    """
    folder = root / "sequences" / sequence
    if not folder.is_dir():
        raise LogError(f"{folder}: no such sequence")
    times = folder / "times.txt"
    stamps_ns = read_times(times)
    calibration = folder / "calib.txt"
    matrices = read_calibration(calibration)
    cameras = _chosen_cameras(folder, "image_{}", colour)
    names = [f"P{camera}" for camera in cameras]
    T_left_camera0 = _left_from_camera0(calibration, matrices, names[0])
    left, right, scans = folder / f"image_{cameras[0]}", folder / f"image_{cameras[1]}", folder / "velodyne"
    source = _depth_source(depth, right, scans)
    rig = (
        _stereo_rig(calibration, matrices, names)
        if source == "stereo"
        else LidarRig(_K(calibration, matrices, names[0]), T_left_camera0 * _rigid(calibration, matrices, "Tr"))
    )

    recording = Recording()
    if oxts is not None:
        drive = oxts.absolute().parent if oxts.name == "oxts" else oxts.absolute()
        stamps_ns, recording.imu = _on_the_clock_of_its_drive(drive, sequence, stamps_ns, recording.warnings)
        recording.rotation_imu_camera = _mounting(drive, calibration, matrices)
    elif imu is not None:
        recording.imu = read_imu_mat(imu, stamps_ns)
    others = right if source == "stereo" else scans
    files = _on_disk(stamps_ns, left, others, _indices(stamps_ns, frames, times), recording.warnings)
    recording.frames = _frames(rig, files, framing, recording.warnings)
    recording.frame_count = len(files)
    first_ns, last_ns = files[0].stamp_ns, files[-1].stamp_ns
    if recording.imu is not None:
        recording.imu = between(recording.imu, first_ns - IMU_MARGIN_NS, last_ns + IMU_MARGIN_NS)
        if not len(recording.imu):
            raise LogError(f"{imu or oxts}: the images and the IMU do not overlap in time")
    poses = root / "poses" / f"{sequence}.txt"
    if poses.is_file():
        truth = _of_camera(read_kitti(poses, stamps_ns), T_left_camera0)
        recording.ground_truth = _between(truth, first_ns, last_ns).relative_to_first()
    return recording


def read_imu_mat(path: Path, frame_stamps_ns: IntArray) -> ImuSeries:
    """The IMU of an odometry sequence, in the OXTS unit's frame (x forward, y left, z up).

    The file holds (10 (n - 1) + 1, 6) numbers for the n frames of the whole sequence: ax ay az (m/s^2,
    gravity included), wx wy wz (rad/s). Row 10 k was measured at frame k; the nine rows that follow divide
    the interval to the next frame, which is about 104 ms and not constant.
    """
    from scipy.io import loadmat
    from scipy.io.matlab import MatReadError

    try:
        table = loadmat(path, variable_names=[IMU_VARIABLE]).get(IMU_VARIABLE)
    except OSError as error:
        raise LogError(f"{path}: {error.strerror or error}") from None
    except (MatReadError, ValueError, TypeError, NotImplementedError) as error:
        raise LogError(f"{path}: not a MATLAB file that can be read ({error})") from None
    if table is None:
        raise LogError(f"{path}: holds no variable {IMU_VARIABLE}")
    shape = (IMU_ROWS_PER_FRAME * (len(frame_stamps_ns) - 1) + 1, 6)
    if table.shape != shape or not np.issubdtype(table.dtype, np.floating):
        raise LogError(f"{path}: {IMU_VARIABLE} is {table.dtype} {table.shape} where {shape} real numbers are expected")
    if not np.isfinite(table).all():
        raise LogError(f"{path}: {IMU_VARIABLE} holds numbers that are not finite")
    return ImuSeries(
        _divided(frame_stamps_ns, IMU_ROWS_PER_FRAME),
        angular_velocity=np.ascontiguousarray(table[:, 3:], dtype=np.float64),
        linear_acceleration=np.ascontiguousarray(table[:, :3], dtype=np.float64),
    )


def _divided(stamps_ns: IntArray, parts: int) -> IntArray:
    """The stamps with each interval divided into equal parts, rounded down to nanoseconds."""
    steps = np.diff(stamps_ns)[:, None] * np.arange(parts) // parts
    return np.append((stamps_ns[:-1, None] + steps).ravel(), stamps_ns[-1])


def _on_the_clock_of_its_drive(
    drive: Path, sequence: str, stamps_ns: IntArray, warnings: Counter[str]
) -> tuple[IntArray, ImuSeries]:
    """The stamps of a sequence's frames on the clock of its raw drive, and the drive's OXTS unit as IMU.

    drive: the drive's folder, ``..._sync`` (10 Hz) or ``..._extract`` (100 Hz). Times of the frames are those of
    the sequence, moved by a constant.
    """
    if sequence not in RAW_DRIVES:
        raise UsageError(f"sequence {sequence}: its raw drive is not published (that of 00 to 10 is)")
    name, first = RAW_DRIVES[sequence]
    if not drive.is_dir():
        raise LogError(f"{drive}: no such drive")
    named = re.match(r"\d{4}_\d\d_\d\d_drive_\d{4}", drive.name)
    if named and named[0] != name:
        raise LogError(f"{drive}: sequence {sequence} was recorded on drive {name}")
    oxts = _read_oxts(drive / "oxts", warnings)
    offset_ns = _clock_offset(drive, first, stamps_ns, warnings)
    return stamps_ns + offset_ns, oxts.imu()


def _clock_offset(drive: Path, first: int, stamps_ns: IntArray, warnings: Counter[str]) -> int:
    """What turns the times of a sequence into those of its raw drive, where it begins with frame ``first``.

    The numbers of frames are those of the synchronised drive: an ``..._extract`` drive begins earlier, so that its
    twin is needed, in the folder beside it. Best are the camera's own time stamps; the OXTS record that was
    chosen for each frame is within 10 ms of it, and the median over the sequence much nearer.
    """
    synchronised = drive.with_name(drive.name.replace("_extract", "_sync"))
    camera, oxts = (synchronised / folder / "timestamps.txt" for folder in ("image_00", "oxts"))
    times = camera if camera.is_file() else oxts
    if not times.is_file():
        raise LogError(f"{camera}: No such file: it ties the frames of the sequence to the IMU's clock")
    drive_ns = read_timestamps(times)[first : first + len(stamps_ns)]
    if len(drive_ns) < len(stamps_ns):
        raise LogError(f"{times}: {first + len(drive_ns)} time stamps, the sequence has {first + len(stamps_ns)}")
    offsets = drive_ns - stamps_ns
    offset = int(np.sort(offsets)[len(offsets) // 2])  # a float's digits do not hold nanoseconds since 1970
    if np.median(np.abs(offsets - offset)) > CLOCK_TOLERANCE_NS:
        raise LogError(f"{times}: its time stamps are not those of the sequence's frames")
    if times == oxts:
        _count(
            warnings,
            "frames tied to the OXTS clock by its records, to some ms (no image_00/timestamps.txt)",
            len(offsets),
        )
    return offset


def _mounting(drive: Path, calibration: Path, matrices: Mapping[str, FloatArray]) -> Rotation | None:
    """v_imu = R v_camera, where the drive's folder has the calibration for it."""
    imu_to_velodyne = drive.parent / "calib_imu_to_velo.txt"
    if "Tr" not in matrices or not imu_to_velodyne.is_file():
        return None
    return (_rigid(calibration, matrices, "Tr") * _read_rigid(imu_to_velodyne)).rotation.inv()


# --------------------------------------------------------------------------------------------- the raw drives


def open_raw(
    drive: Path,
    calibration: Path | None = None,
    *,
    depth: DepthSource | None = None,
    frames: slice = slice(None),
    colour: bool = False,
    gnss: Receiver | None = None,
    framing: Framing = WHOLE,
) -> Recording:
    """A raw drive (``..._sync``), with its OXTS unit as IMU and as ground truth.

    calibration: the folder of the day's ``calib_*.txt``, the drive's parent if not given. depth: by default from
    stereo, or from the scanner where there are scans but no right camera. gnss: a receiver
    that sees the unit's positions. They are not ground truth for what is computed from them, so there is none then;
    otherwise it keeps the stamps of the OXTS records, and is that of the chosen left camera in the
    frame of its first pose. Frames have the times of ``trigger_times``.
    """
    calibration = drive.absolute().parent if calibration is None else calibration
    if not drive.is_dir():
        raise LogError(f"{drive}: no such drive")
    cameras = _chosen_cameras(drive, "image_{:02d}", colour)
    left, right = (drive / f"image_{camera:02d}" for camera in cameras)
    scans = drive / "velodyne_points" / "data"
    recording = Recording()
    times = left / "timestamps.txt"
    stamps_ns = trigger_times(drive, left.name, recording.warnings)
    cam_to_cam = calibration / "calib_cam_to_cam.txt"
    matrices = read_calibration(cam_to_cam)
    names = [f"P_rect_{camera:02d}" for camera in cameras]
    T_camera_velodyne = _left_from_camera0(cam_to_cam, matrices, names[0]) * _camera0_from_velodyne(
        calibration, matrices
    )
    T_camera_imu = T_camera_velodyne * _read_rigid(calibration / "calib_imu_to_velo.txt")
    source = _depth_source(depth, right / "data", scans)
    rig = (
        _stereo_rig(cam_to_cam, matrices, names)
        if source == "stereo"
        else LidarRig(_K(cam_to_cam, matrices, names[0]), T_camera_velodyne)
    )

    recording.rotation_imu_camera = T_camera_imu.rotation.inv()
    others = right / "data" if source == "stereo" else scans
    files = _on_disk(stamps_ns, left / "data", others, _indices(stamps_ns, frames, times), recording.warnings)
    width, height = _matrix(cam_to_cam, matrices, f"S_rect_{cameras[0]:02d}", (2,)).astype(int).tolist()
    recording.frames = _frames(rig, files, framing, recording.warnings, (width, height))
    recording.frame_count = len(files)

    oxts = _read_oxts(drive / "oxts", recording.warnings)
    oxts = oxts.between(files[0].stamp_ns - IMU_MARGIN_NS, files[-1].stamp_ns + IMU_MARGIN_NS)
    if not len(oxts.stamps_ns):
        raise LogError(f"{drive}: the images and the OXTS records do not overlap in time")
    recording.imu = oxts.imu()
    if gnss is None:
        recording.ground_truth = _of_camera(oxts.trajectory(), T_camera_imu).relative_to_first()
    else:
        recording.gnss = gnss.fixes(oxts.gnss())
    return recording


def trigger_times(drive: Path, camera: str, warnings: Counter[str]) -> IntArray:
    """When the frames of a raw drive were taken (N,): of each the earliest of its images' time stamps.

    camera: the folder whose frames they are, ``image_00``. Of the other cameras a stamp that is further than
    ``CLOCK_TOLERANCE_NS`` from its own is of another frame; a camera most of whose stamps are, or whose stamps cannot
    be read, is left out and counted. Of one camera its own stamps are all there is.
    """
    times = drive / camera / "timestamps.txt"
    own_ns = read_timestamps(times)
    earliest_ns = own_ns.copy()
    for other in sorted(set(drive.glob("image_*/timestamps.txt")) - {times}):
        try:
            other_ns = read_timestamps(other)[: len(own_ns)]
        except LogError as error:
            _count(warnings, f"time stamps of another camera left out ({error})", 1)
            continue
        near = np.abs(other_ns - own_ns[: len(other_ns)]) < CLOCK_TOLERANCE_NS
        if 2 * np.count_nonzero(near) <= len(near):
            _count(warnings, f"time stamps of another camera left out ({other}: not of the same frames)", 1)
            continue
        frames = np.flatnonzero(near)
        earliest_ns[frames] = np.minimum(earliest_ns[frames], other_ns[frames])
    if not (np.diff(earliest_ns) > 0).all():
        raise LogError(f"{times}: the times do not increase")
    return earliest_ns


_TIMESTAMP = re.compile(r"\d{4}-\d\d-\d\d[ T]\d\d:\d\d:\d\d(\.\d{1,9})?")


def read_timestamps(path: Path) -> IntArray:
    """A raw drive's ``timestamps.txt``: date and time with nine decimals a line, as nanoseconds since 1970.

    The times are taken as UTC. They need not increase.
    """
    lines = [line.strip() for line in read_text(path).rstrip().splitlines()]
    if not lines:
        raise LogError(f"{path}: holds no data")
    for number, line in enumerate(lines, start=1):
        if not _TIMESTAMP.fullmatch(line):
            raise LogError(f"{path}: line {number}: not a date and time ({line[:40]!r})")
    try:
        return np.array(lines, dtype="datetime64[ns]").astype(np.int64)
    except ValueError as error:
        raise LogError(f"{path}: {error}") from None


@dataclass(frozen=True, slots=True)
class Oxts:
    """Records of the OXTS unit: stamps_ns (N,) strictly increasing, values (N, 30)."""

    stamps_ns: IntArray
    values: FloatArray

    def between(self, start_ns: int, end_ns: int) -> Oxts:
        """The records from start to end, both included."""
        chosen = slice(*np.searchsorted(self.stamps_ns, [start_ns, end_ns + 1]))
        return Oxts(self.stamps_ns[chosen], self.values[chosen])

    def imu(self) -> ImuSeries:
        """Rates and accelerations in the unit's own axes (x forward, y left, z up)."""
        return ImuSeries(self.stamps_ns, self.values[:, _ANGULAR_RATE], self.values[:, _ACCELERATION])

    def trajectory(self) -> Trajectory:
        """Poses of the unit in an east-north-up world, by the development kit's rule.

        Mercator projection with the scale of the first latitude, and R = Rz(yaw) Ry(pitch) Rx(roll), as in
        ``convertOxtsToPose.m``.
        """
        latitude, longitude = np.radians(self.values[:, _LATITUDE]), np.radians(self.values[:, _LONGITUDE])
        radius = np.cos(latitude[0]) * EARTH_RADIUS_M
        north = radius * np.log(np.tan(np.pi / 4 + latitude / 2))
        position = np.column_stack([radius * longitude, north, self.values[:, _ALTITUDE]])
        # Metres near the origin keep their digits through all that follows.
        position -= position[0]
        rotation = Rotation.from_euler("xyz", self.values[:, _ROLL_PITCH_YAW])
        return Trajectory(self.stamps_ns, RigidTransform.from_components(position, rotation))

    def gnss(self) -> list[GnssFix]:
        """Positions with the unit's own estimate of their accuracy, taken as equal in all directions."""
        values = self.values[:, [_LATITUDE, _LONGITUDE, _ALTITUDE, _POSITION_ACCURACY]].tolist()
        return [
            GnssFix(stamp_ns, latitude_deg, longitude_deg, altitude_m, accuracy_m**2 * np.eye(3))
            for stamp_ns, (latitude_deg, longitude_deg, altitude_m, accuracy_m) in zip(
                self.stamps_ns.tolist(), values, strict=True
            )
        ]


def _read_oxts(folder: Path, warnings: Counter[str]) -> Oxts:
    stamps_ns = read_timestamps(folder / "timestamps.txt")
    data = folder / "data"
    files = [data / f"{index:010d}.txt" for index in range(len(stamps_ns))]
    on_disk = [index for index, file in enumerate(files) if file.is_file()]
    _count(warnings, "OXTS records missing", len(files) - len(on_disk))
    if not on_disk:
        raise LogError(f"{data}: holds no OXTS record")
    stamps_ns = stamps_ns[on_disk]
    values = np.array([_read_oxts_record(files[index]) for index in on_disk])
    increasing = longest_increasing(stamps_ns)
    _count(warnings, "OXTS records dropped (their time does not increase)", len(stamps_ns) - len(increasing))
    periods = np.diff(stamps_ns[increasing])
    holes = periods > MAX_GAP_PERIODS * np.median(periods) if len(periods) else periods
    _count(warnings, "holes between OXTS records", int(np.count_nonzero(holes)))
    return Oxts(stamps_ns[increasing], values[increasing])


def _read_oxts_record(path: Path) -> list[float]:
    row = read_rows(path, columns=(OXTS_COLUMNS,))[0]
    values = row.finite()
    if not (abs(values[_LATITUDE]) < 90 and abs(values[_LONGITUDE]) <= 360):
        raise row.error(f"not a position ({values[_LATITUDE]}, {values[_LONGITUDE]})")
    return values


def _camera0_from_velodyne(folder: Path, cam_to_cam: Mapping[str, FloatArray]) -> RigidTransform:
    """T_camera0_velodyne of the rectified camera 0."""
    rectification = _rotation(folder / "calib_cam_to_cam.txt", cam_to_cam, "R_rect_00")
    return RigidTransform.from_rotation(rectification) * _read_rigid(folder / "calib_velo_to_cam.txt")


# ------------------------------------------------------------------------------------------------ calibration


def read_calibration(path: Path) -> dict[str, FloatArray]:
    """A calibration file: lines of ``name: numbers``. Lines of another kind (``calib_time``) are left out."""
    matrices = {}
    for line in read_text(path).splitlines():
        name, _, words = line.partition(":")
        try:
            matrices[name.strip()] = np.array([float(word) for word in words.split()])
        except ValueError:
            continue
    return matrices


def _matrix(path: Path, matrices: Mapping[str, FloatArray], name: str, shape: tuple[int, ...]) -> FloatArray:
    values = matrices.get(name)
    if values is None:
        raise LogError(f"{path}: no {name}")
    if values.size != np.prod(shape) or not np.isfinite(values).all():
        raise LogError(f"{path}: {name} must be {np.prod(shape)} finite numbers")
    return values.reshape(shape)


def _rotation(path: Path, matrices: Mapping[str, FloatArray], name: str) -> Rotation:
    matrix = _matrix(path, matrices, name, (3, 3))
    if rotation_error(matrix) > ROTATION_TOLERANCE:
        raise LogError(f"{path}: {name} is not a rotation")
    return Rotation.from_matrix(matrix)


def _rigid(path: Path, matrices: Mapping[str, FloatArray], name: str) -> RigidTransform:
    """A rigid transform that is written as its upper three rows."""
    matrix = _matrix(path, matrices, name, (3, 4))
    if rotation_error(matrix[:, :3]) > ROTATION_TOLERANCE:
        raise LogError(f"{path}: {name} is not a rigid transform")
    return RigidTransform.from_components(matrix[:, 3], Rotation.from_matrix(matrix[:, :3]))


def _read_rigid(path: Path) -> RigidTransform:
    """A raw drive's calibration between two sensors: its R and T."""
    matrices = read_calibration(path)
    return RigidTransform.from_components(_matrix(path, matrices, "T", (3,)), _rotation(path, matrices, "R"))


def _K(path: Path, matrices: Mapping[str, FloatArray], name: str) -> FloatArray:
    """K (3, 3) of a projection matrix P = K [I | t]."""
    K = _matrix(path, matrices, name, (3, 4))[:, :3]
    if not (K[0, 0] > 0 and K[1, 1] > 0 and K[2, 2] > 0):
        raise LogError(f"{path}: {name} is not the projection matrix of a rectified camera")
    return K


def _stereo_rig(path: Path, matrices: Mapping[str, FloatArray], names: Sequence[str]) -> StereoRig:
    """The stereo pair of two projection matrices."""
    try:
        return StereoRig.from_projections(*(_matrix(path, matrices, name, (3, 4)) for name in names))
    except LogError as error:
        raise LogError(f"{path}: {error}") from None


def _left_from_camera0(path: Path, matrices: Mapping[str, FloatArray], name: str) -> RigidTransform:
    """T_left_camera0: camera 0 seen from the left camera, of which ``name`` is the projection matrix P = K [I | t]."""
    t = np.linalg.solve(_K(path, matrices, name), _matrix(path, matrices, name, (3, 4))[:, 3])
    return RigidTransform.from_translation(t)


# ----------------------------------------------------------------------------------------------------- frames


def _chosen_cameras(folder: Path, pattern: str, colour: bool) -> tuple[int, int]:
    """The left and right camera: grey if it is there and colour is not asked for."""
    wanted = [COLOUR_CAMERAS] if colour else [GREY_CAMERAS, COLOUR_CAMERAS]
    for cameras in wanted:
        if (folder / pattern.format(cameras[0])).is_dir():
            return cameras
    names = " or ".join(pattern.format(cameras[0]) for cameras in wanted)
    raise LogError(f"{folder}: no folder {names}")


def _depth_source(asked: DepthSource | None, right: Path, scans: Path) -> DepthSource:
    """What was asked for, else stereo, but where there are scans and no right camera."""
    if asked == "velodyne" and not scans.is_dir():
        raise LogError(f"{scans}: no such folder")
    return asked or ("velodyne" if scans.is_dir() and not right.is_dir() else "stereo")


def _numbered(folder: Path) -> dict[int, Path]:
    """The images or scans of a folder by the number that is their name; none where there is no folder."""
    if not folder.is_dir():
        return {}
    suffixes = SUFFIXES | {SCAN_SUFFIX}
    files = sorted(file for file in folder.iterdir() if file.suffix.lower() in suffixes and file.stem.isdecimal())
    return {int(file.stem): file for file in files}


def _indices(stamps_ns: IntArray, frames: slice, times: Path) -> range:
    indices = range(len(stamps_ns))[frames]
    if not indices:
        raise UsageError(f"no frame in the range asked for: {times} has {len(stamps_ns)}")
    return indices


class _Files(NamedTuple):
    """What is on disk of a frame: its left image, and what its depth comes from (a right image or a scan)."""

    stamp_ns: int
    left: Path
    other: Path | None


def _on_disk(
    stamps_ns: IntArray, left_folder: Path, other_folder: Path, indices: range, warnings: Counter[str]
) -> list[_Files]:
    """The frames whose left image is on disk."""
    left, others = _numbered(left_folder), _numbered(other_folder)
    files = [_Files(int(stamps_ns[index]), left[index], others.get(index)) for index in indices if index in left]
    if not files:
        raise LogError(f"{left_folder}: holds no image of frames {indices.start} to {indices.stop - 1}")
    _count(warnings, "frames missing (no left image)", len(indices) - len(files))
    _count(warnings, "images without a time stamp", sum(index >= len(stamps_ns) for index in left))
    return files


def _frames(
    rig: StereoRig | LidarRig,
    files: Sequence[_Files],
    framing: Framing,
    warnings: Counter[str],
    size: tuple[int, int] | None = None,
) -> Iterator[CameraFrame]:
    """Frames with depth from the right images or from the scans; size as in ``stereo_frames``."""
    without_depth = sum(file.other is None for file in files)
    if isinstance(rig, StereoRig):
        _count(warnings, "frames without depth (no right image)", without_depth)
        return stereo_frames(rig, [StereoPair(*file) for file in files], framing, warnings, size)
    _count(warnings, "frames without depth (no scan)", without_depth)
    return lidar_frames(rig, [Scan(*file) for file in files], framing, warnings, size)


def _count(warnings: Counter[str], what: str, times: int) -> None:
    if times:
        warnings[what] += times


# ------------------------------------------------------------------------------------------------ trajectories


def _of_camera(trajectory: Trajectory, T_camera_body: RigidTransform) -> Trajectory:
    """The trajectory of a camera from that of the body it is mounted on."""
    return Trajectory(trajectory.stamps_ns, trajectory.poses * T_camera_body.inv())


def _between(trajectory: Trajectory, start_ns: int, end_ns: int) -> Trajectory:
    chosen = slice(*np.searchsorted(trajectory.stamps_ns, [start_ns, end_ns + 1]))
    return Trajectory(trajectory.stamps_ns[chosen], trajectory.poses[chosen])
