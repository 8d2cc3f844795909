"""ROS 2 messages and the records they carry: CDR bytes in, records out, and back.

The only place that knows ROS' conventions where they differ from ours: covariances with the
translation first and in the axes of the fixed frame, quaternions as x y z w, depth in millimetres.
Message definitions: https://docs.ros.org/en/humble/p/ (sensor_msgs, geometry_msgs, nav_msgs, tf2_msgs);
depth images: REP 118. Decoding raises ``ValueError`` for a message whose contents cannot be right.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import Rotation

from fusion_io.errors import LogError
from fusion_io.records import NANOSECONDS, CameraInfo, EstimatorSeries, FloatArray, GnssFix, PairEstimate

IMAGE = "sensor_msgs/msg/Image"
COMPRESSED_IMAGE = "sensor_msgs/msg/CompressedImage"
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
IMU = "sensor_msgs/msg/Imu"
POSE_STAMPED = "geometry_msgs/msg/PoseStamped"
POSE_WITH_COVARIANCE = "geometry_msgs/msg/PoseWithCovarianceStamped"
ODOMETRY = "nav_msgs/msg/Odometry"
PATH = "nav_msgs/msg/Path"
GNSS = "sensor_msgs/msg/NavSatFix"
TRANSFORMS = "tf2_msgs/msg/TFMessage"
PAIR_ESTIMATE = "violearner_msgs/msg/PairEstimate"
ESTIMATOR_STATE = "violearner_msgs/msg/EstimatorState"

CAMERA_FRAME = "camera"
IMU_FRAME = "imu"
WORLD_FRAME = "world"
ENU_FRAME = "enu"  # east, north, up about an origin on the earth
WORLD_FLU_FRAME = "world_flu"  # the world with x forward, y left, z up: what viewers take for upright (REP 103)

SCHEMA_ENCODING = "ros2msg"
MESSAGE_ENCODING = "cdr"

DEPTH_STEPS_PER_METRE = 256

PAIR_ESTIMATE_DEFINITION = """\
# The pose of the target camera in the source camera's frame: p_source = pose * p_target.
# Camera axes are optical: x right, y down, z forward.
std_msgs/Header header              # stamp of the target frame; frame_id: the source camera
builtin_interfaces/Time source_stamp
builtin_interfaces/Time target_stamp
geometry_msgs/Pose pose             # metres; unit quaternion

# Row-major 6x6 covariance of the tangent vector xi in T = pose * Exp(xi): right perturbation, in the
# axes of the target camera. Order: rotation about x, y, z [rad], then translation x, y, z [m].
# Mind that geometry_msgs/PoseWithCovariance differs in both order and axes.
float64[36] covariance

int32 winner                        # index of the hypothesis that was chosen; -1 where there are none
geometry_msgs/Pose[] hypotheses     # one pose each, as above
float64[] errors                    # photometric error of each hypothesis
float64 imu_coverage                # share of the IMU window that was measured rather than filled, 0 to 1
"""

ESTIMATOR_STATE_DEFINITION = """\
# What a back end estimated at one frame beside its pose; NaN where it has nothing to say. *_std: standard deviations.
std_msgs/Header header              # stamp of the frame; frame_id: the camera

# Of the IMU, in its own axes.
geometry_msgs/Vector3 gyro_bias                 # rad/s
geometry_msgs/Vector3 gyro_bias_std
geometry_msgs/Vector3 accelerometer_bias        # m/s^2
geometry_msgs/Vector3 accelerometer_bias_std

# Of the pair estimates: their translations are too long by scale_error (0.01 is 1 %), and they turn too fast by
# rate_bias, in camera axes.
float64 scale_error
float64 scale_error_std
geometry_msgs/Vector3 rate_bias                 # rad/s
geometry_msgs/Vector3 rate_bias_std

# What the pair estimate that ends at this frame shows beyond what was predicted, in the axes of the target camera.
geometry_msgs/Vector3 innovation_rotation       # rad
geometry_msgs/Vector3 innovation_translation    # m
float64 nis                         # its square, normalised by its covariance: 6 on average where all is modelled right
bool used                           # false where that pair estimate was rejected
"""

_DEFINITIONS = {PAIR_ESTIMATE: PAIR_ESTIMATE_DEFINITION, ESTIMATOR_STATE: ESTIMATOR_STATE_DEFINITION}

TYPESTORE = get_typestore(Stores.ROS2_HUMBLE)
for _name, _definition in _DEFINITIONS.items():
    TYPESTORE.register(get_types_from_msg(_definition, _name))

# Image encodings of sensor_msgs/image_encodings.hpp that show light, and how OpenCV turns them into grey or RGB.
_IMAGE_ENCODINGS: dict[str, tuple[str, int, int | None]] = {
    "mono8": ("u1", 1, None),
    "8UC1": ("u1", 1, None),
    "mono16": ("u2", 1, None),
    "rgb8": ("u1", 3, None),
    "bgr8": ("u1", 3, cv2.COLOR_BGR2RGB),
    "8UC3": ("u1", 3, cv2.COLOR_BGR2RGB),
    "rgba8": ("u1", 4, cv2.COLOR_RGBA2RGB),
    "bgra8": ("u1", 4, cv2.COLOR_BGRA2RGB),
    "8UC4": ("u1", 4, cv2.COLOR_BGRA2RGB),
}
_DEPTH_ENCODINGS = {"32FC1": "f4", "16UC1": "u2"}
_MILLIMETRES = 1000.0
_DEPTH_TRANSPORT = "compressedDepth"
_DEPTH_TRANSPORT_HEADER = struct.Struct("<iff")

_STAMP_LITTLE = struct.Struct("<iI")
_STAMP_BIG = struct.Struct(">iI")


def schema_text(type_name: str) -> str:
    """The definition of a message with those it refers to, as MCAP's ``ros2msg`` encoding wants it."""
    generated: str = TYPESTORE.generate_msgdef(type_name, ros_version=2)[0]
    if type_name not in _DEFINITIONS:
        return generated
    _, separator, references = generated.partition("=" * 80)  # rosbags drops comments: ours are worth keeping
    return _DEFINITIONS[type_name] + separator + references


def header_stamp(data: bytes | memoryview, offset: int = 0) -> int:
    """Nanoseconds of the ``header.stamp`` that a serialised message begins with, without decoding the rest.

    A CDR message is four bytes that name its byte order, then its fields.

    Raises:
        struct.error: the message is too short to hold a stamp.

    """
    seconds, nanoseconds = (_STAMP_LITTLE if data[offset + 1] else _STAMP_BIG).unpack_from(data, offset + 4)
    return int(seconds) * NANOSECONDS + int(nanoseconds)


# --- Images -------------------------------------------------------------------------------------


def encode_image(stamp_ns: int, image: NDArray[np.uint8], frame_id: str = CAMERA_FRAME) -> bytes:
    """A grey (H, W) or RGB (H, W, 3) image as lossless CompressedImage (png)."""
    stored = image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_RGB2BGR)
    _, png = cv2.imencode(".png", stored)
    return _serialise(COMPRESSED_IMAGE, header=_header(stamp_ns, frame_id), format="png", data=png.ravel())


def encode_depth(stamp_ns: int, depth: NDArray[np.float32], frame_id: str = CAMERA_FRAME) -> bytes:
    """Depth (H, W) in metres as Image 32FC1, rounded to 1/256 m so that it packs well; invalid is 0."""
    rounded = np.rint(_valid_depth(depth) * DEPTH_STEPS_PER_METRE) / DEPTH_STEPS_PER_METRE
    height, width = depth.shape
    return _serialise(
        IMAGE,
        header=_header(stamp_ns, frame_id),
        height=height,
        width=width,
        encoding="32FC1",
        is_bigendian=0,
        step=4 * width,
        data=rounded.astype("<f4").view(np.uint8).ravel(),
    )


def decode_image(type_name: str, data: bytes | memoryview) -> NDArray[np.uint8]:
    """Image or CompressedImage to grey (H, W) or RGB (H, W, 3)."""
    message = _deserialise(type_name, data)
    if type_name == COMPRESSED_IMAGE:
        return _grey_or_rgb(_uncompressed(message))
    if message.encoding not in _IMAGE_ENCODINGS:
        raise ValueError(f"an image encoded as {message.encoding!r} cannot be read")
    dtype, channels, conversion = _IMAGE_ENCODINGS[message.encoding]
    pixels = _pixels(message, dtype, channels)
    return _eight_bits(pixels if conversion is None else cv2.cvtColor(pixels, conversion))


def decode_depth(type_name: str, data: bytes | memoryview) -> NDArray[np.float32]:
    """Depth (H, W) in metres, 0 where there is none, from 32FC1 (metres) or 16 bits (millimetres)."""
    message = _deserialise(type_name, data)
    if type_name == COMPRESSED_IMAGE:
        return _compressed_depth(message)
    if message.encoding in _DEPTH_ENCODINGS:
        return _metres(_pixels(message, _DEPTH_ENCODINGS[message.encoding], 1))
    raise ValueError(f"depth encoded as {message.encoding!r} cannot be read")


def image_kind(type_name: str, data: bytes | memoryview) -> str:
    """What an Image or CompressedImage holds: "image" or "depth"."""
    message = _deserialise(type_name, data)
    if type_name == COMPRESSED_IMAGE:
        return "depth" if message.format.startswith("16UC1") or _DEPTH_TRANSPORT in message.format else "image"
    if message.encoding in _DEPTH_ENCODINGS:
        return "depth"
    if message.encoding in _IMAGE_ENCODINGS:
        return "image"
    raise ValueError(f"an image encoded as {message.encoding!r} cannot be read")


def _pixels(message: Any, dtype: str, channels: int) -> NDArray[Any]:
    """The pixels of an Image in native byte order, without the padding at the end of its rows."""
    item = np.dtype(dtype).newbyteorder(">" if message.is_bigendian else "<")
    used = message.width * channels * item.itemsize
    if not used or not message.height or message.step < used or len(message.data) < message.height * message.step:
        raise ValueError(
            f"{len(message.data)} bytes in rows of {message.step} cannot hold "
            f"{message.width}x{message.height} pixels of {message.encoding}"
        )
    rows = np.asarray(message.data)[: message.height * message.step].reshape(message.height, message.step)
    pixels = np.ascontiguousarray(rows[:, :used]).view(item).astype(dtype)
    return pixels if channels == 1 else pixels.reshape(message.height, message.width, channels)


def _compressed_depth(message: Any) -> NDArray[np.float32]:
    """A 16-bit image in millimetres, or what ROS' compressed_depth_image_transport makes of depth (its codec.cpp).

    That begins with twelve bytes: a format and two parameters a and b. The 16 bits of a pixel are millimetres, or
    a / depth + b where the depth was in metres.
    """
    transport = _DEPTH_TRANSPORT in message.format
    stored = _uncompressed(message, _DEPTH_TRANSPORT_HEADER.size if transport else 0)
    if stored.dtype != np.uint16 or stored.ndim != 2:
        raise ValueError("a compressed depth image must have one channel of 16 bits")
    if not (transport and message.format.startswith("32FC1")):
        return _metres(stored)
    _, a, b = _DEPTH_TRANSPORT_HEADER.unpack_from(message.data)
    with np.errstate(divide="ignore", invalid="ignore"):
        return _valid_depth(np.where(stored > 0, a / (stored - b), 0))


def _metres(depth: NDArray[Any]) -> NDArray[np.float32]:
    """Stored depth as metres: whole numbers are millimetres (REP 118)."""
    return _valid_depth(depth / _MILLIMETRES if depth.dtype == np.uint16 else depth)


def _uncompressed(message: Any, start: int = 0) -> NDArray[Any]:
    packed = np.asarray(message.data)[start:]
    stored: NDArray[Any] | None = cv2.imdecode(packed, cv2.IMREAD_UNCHANGED) if len(packed) else None
    if stored is None:
        raise ValueError(f"an image compressed as {message.format!r} cannot be unpacked")
    return stored


def _grey_or_rgb(stored: NDArray[Any]) -> NDArray[np.uint8]:
    """OpenCV's grey, BGR or BGRA."""
    if stored.ndim == 2:
        return _eight_bits(stored)
    return _eight_bits(cv2.cvtColor(stored, cv2.COLOR_BGR2RGB if stored.shape[2] == 3 else cv2.COLOR_BGRA2RGB))


def _eight_bits(pixels: NDArray[Any]) -> NDArray[np.uint8]:
    if pixels.dtype == np.uint16:
        return (pixels >> 8).astype(np.uint8)
    if pixels.dtype != np.uint8:
        raise ValueError(f"an image of {pixels.dtype} cannot be read")
    return pixels


def _valid_depth(depth: NDArray[Any]) -> NDArray[np.float32]:
    """0 for all that is no distance: NaN, infinity (REP 118: too far or too near), negative."""
    metres = depth.astype(np.float32)
    return np.where(np.isfinite(metres) & (metres > 0), metres, np.float32(0))


# --- Camera -------------------------------------------------------------------------------------


def encode_camera_info(stamp_ns: int, info: CameraInfo) -> bytes:
    """CameraInfo with P = [K 0]: a single camera that is not rotated."""
    return _serialise(
        CAMERA_INFO,
        header=_header(stamp_ns, info.frame_id),
        height=info.height,
        width=info.width,
        distortion_model=info.distortion_model or "plumb_bob",
        d=np.asarray(info.distortion, dtype=np.float64),
        k=info.K.astype(np.float64).ravel(),
        r=np.eye(3).ravel(),
        p=np.column_stack([info.K, np.zeros(3)]).ravel(),
        binning_x=0,
        binning_y=0,
        roi=_new("sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False),
    )


def decode_camera_info(data: bytes | memoryview, rectified: bool = False) -> CameraInfo:
    """CameraInfo of the raw image, or of the rectified one (P in place of K if it is given, and no distortion).

    Where the message names a region of interest, the intrinsics are those of that region.
    """
    message = _deserialise(CAMERA_INFO, data)
    rectified = rectified and message.p[0] > 0
    K = message.p.reshape(3, 4)[:, :3].copy() if rectified else message.k.reshape(3, 3).copy()
    if not np.all(np.isfinite(K)) or K[0, 0] <= 0 or K[1, 1] <= 0 or not message.width or not message.height:
        raise ValueError("the camera is not calibrated (no focal length or no size)")
    info = CameraInfo(
        width=message.width,
        height=message.height,
        K=K,
        distortion_model="" if rectified else message.distortion_model,
        distortion=np.zeros(0) if rectified else np.array(message.d),
        frame_id=message.header.frame_id,
    )
    roi = message.roi
    return info.cropped(roi.x_offset, roi.y_offset, roi.width, roi.height) if roi.width and roi.height else info


# --- Inertial -----------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class ImuSample:
    """One reading: angular_velocity (3,) rad/s, linear_acceleration (3,) m/s^2, with standard deviations if known.

    ``has_*`` is False where the message says that it does not carry this half.
    """

    angular_velocity: FloatArray
    linear_acceleration: FloatArray
    angular_velocity_std: float | None = None
    linear_acceleration_std: float | None = None
    has_angular_velocity: bool = True
    has_linear_acceleration: bool = True


def encode_imu(stamp_ns: int, sample: ImuSample, frame_id: str = IMU_FRAME) -> bytes:
    """Imu without an orientation."""
    return _serialise(
        IMU,
        header=_header(stamp_ns, frame_id),
        orientation=_quaternion(np.array([1.0, 0.0, 0.0, 0.0])),
        orientation_covariance=_NOT_MEASURED,
        angular_velocity=_vector(sample.angular_velocity),
        angular_velocity_covariance=_isotropic(sample.angular_velocity_std, sample.has_angular_velocity),
        linear_acceleration=_vector(sample.linear_acceleration),
        linear_acceleration_covariance=_isotropic(sample.linear_acceleration_std, sample.has_linear_acceleration),
    )


def decode_imu(data: bytes | memoryview) -> ImuSample:
    """Imu; its orientation, if it has one, is somebody's estimate and is left out."""
    message = _deserialise(IMU, data)
    w, a = message.angular_velocity, message.linear_acceleration
    return ImuSample(
        angular_velocity=np.array([w.x, w.y, w.z]),
        linear_acceleration=np.array([a.x, a.y, a.z]),
        angular_velocity_std=_deviation(message.angular_velocity_covariance),
        linear_acceleration_std=_deviation(message.linear_acceleration_covariance),
        has_angular_velocity=message.angular_velocity_covariance[0] != -1,
        has_linear_acceleration=message.linear_acceleration_covariance[0] != -1,
    )


# sensor_msgs/Imu: "If you have no estimate for one of the data elements, please set element 0 of the associated
# covariance matrix to -1"; all zeros stand for "covariance unknown".
_NOT_MEASURED = np.array([-1.0, 0, 0, 0, 0, 0, 0, 0, 0])


def _isotropic(deviation: float | None, measured: bool) -> FloatArray:
    if not measured:
        return _NOT_MEASURED
    variance = (deviation or 0.0) ** 2
    return np.array([variance, 0, 0, 0, variance, 0, 0, 0, variance])


def _deviation(covariance: FloatArray) -> float | None:
    """The largest of the three standard deviations."""
    variance = max(covariance[0], covariance[4], covariance[8])
    return math.sqrt(variance) if 0 < variance < math.inf else None


# --- Poses --------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class PoseSample:
    """A pose as a message carries it: position (3,) m, quat_wxyz (4,), covariance (6, 6) rotation first, or None."""

    position: FloatArray
    quat_wxyz: FloatArray
    covariance: FloatArray | None = None


def encode_pose(stamp_ns: int, pose: PoseSample, frame_id: str = WORLD_FRAME) -> bytes:
    """PoseStamped."""
    return _serialise(POSE_STAMPED, header=_header(stamp_ns, frame_id), pose=_pose(pose.position, pose.quat_wxyz))


def encode_odometry(stamp_ns: int, pose: PoseSample, child_frame_id: str) -> bytes:
    """Odometry of a frame in the world. Its twist is not given (zero)."""
    covariance = np.zeros(36) if pose.covariance is None else _covariance_to_ros(pose.covariance, pose.quat_wxyz)
    zero = _vector(np.zeros(3))
    twist = _new("geometry_msgs/msg/Twist", linear=zero, angular=zero)
    return _serialise(
        ODOMETRY,
        header=_header(stamp_ns, WORLD_FRAME),
        child_frame_id=child_frame_id,
        pose=_new(
            "geometry_msgs/msg/PoseWithCovariance", pose=_pose(pose.position, pose.quat_wxyz), covariance=covariance
        ),
        twist=_new("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=np.zeros(36)),
    )


def encode_path(poses: Sequence[tuple[int, PoseSample]]) -> bytes:
    """Path through at least one pose, each with its stamp in nanoseconds."""
    stamped = [
        _new(POSE_STAMPED, header=_header(stamp_ns, WORLD_FRAME), pose=_pose(pose.position, pose.quat_wxyz))
        for stamp_ns, pose in poses
    ]
    return _serialise(PATH, header=_header(poses[0][0], WORLD_FRAME), poses=stamped)


def decode_pose(type_name: str, data: bytes | memoryview) -> PoseSample:
    """PoseStamped, PoseWithCovarianceStamped or Odometry; a covariance of zeros is none."""
    message = _deserialise(type_name, data)
    if type_name == POSE_STAMPED:
        return PoseSample(*_pose_arrays(message.pose))
    position, quat_wxyz = _pose_arrays(message.pose.pose)
    if not np.any(message.pose.covariance) or not np.any(quat_wxyz):
        return PoseSample(position, quat_wxyz)
    return PoseSample(position, quat_wxyz, _covariance_from_ros(message.pose.covariance, quat_wxyz))


def _fixed_axes(quat_wxyz: FloatArray) -> FloatArray:
    """(6, 6) map of our tangent vectors (rotation first, body axes) to ROS' (translation first, fixed axes)."""
    R = Rotation.from_quat(quat_wxyz, scalar_first=True).as_matrix()
    zero = np.zeros((3, 3))
    return np.block([[zero, R], [R, zero]])


def _covariance_to_ros(covariance: FloatArray, quat_wxyz: FloatArray) -> FloatArray:
    A = _fixed_axes(quat_wxyz)
    return np.asarray(A @ covariance @ A.T, dtype=np.float64).ravel()


def _covariance_from_ros(covariance: FloatArray, quat_wxyz: FloatArray) -> FloatArray:
    A = _fixed_axes(quat_wxyz)
    return np.asarray(A.T @ covariance.reshape(6, 6) @ A, dtype=np.float64)


# --- Transforms ---------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class FrameTransform:
    """``T_parent_child``: the pose of the child frame in the parent frame."""

    parent: str
    child: str
    pose: PoseSample


def encode_transforms(stamp_ns: int, transforms: Sequence[FrameTransform]) -> bytes:
    """TFMessage."""
    return _serialise(
        TRANSFORMS,
        transforms=[
            _new(
                "geometry_msgs/msg/TransformStamped",
                header=_header(stamp_ns, transform.parent),
                child_frame_id=transform.child,
                transform=_new(
                    "geometry_msgs/msg/Transform",
                    translation=_vector(transform.pose.position),
                    rotation=_quaternion(transform.pose.quat_wxyz),
                ),
            )
            for transform in transforms
        ],
    )


def decode_transforms(data: bytes | memoryview) -> list[FrameTransform]:
    """TFMessage; frame names without the leading slash of old days."""
    return [
        FrameTransform(
            parent=item.header.frame_id.lstrip("/"),
            child=item.child_frame_id.lstrip("/"),
            pose=PoseSample(_vector_array(item.transform.translation), _quaternion_array(item.transform.rotation)),
        )
        for item in _deserialise(TRANSFORMS, data).transforms
    ]


# --- Pair estimates -----------------------------------------------------------------------------


def encode_pair(pair: PairEstimate) -> bytes:
    """PairEstimate; every number is kept to the last bit."""
    return _serialise(
        PAIR_ESTIMATE,
        header=_header(pair.target_stamp_ns, CAMERA_FRAME),
        source_stamp=_time(pair.source_stamp_ns),
        target_stamp=_time(pair.target_stamp_ns),
        pose=_pose(pair.translation, pair.quat_wxyz),
        covariance=np.asarray(pair.covariance, dtype=np.float64).ravel(),
        winner=pair.winner,
        hypotheses=[
            _pose(translation, quat_wxyz)
            for translation, quat_wxyz in zip(pair.hypotheses_translation, pair.hypotheses_quat_wxyz, strict=True)
        ],
        errors=np.asarray(pair.errors, dtype=np.float64),
        imu_coverage=float(pair.imu_coverage),
    )


def decode_pair(data: bytes | memoryview) -> PairEstimate:
    """PairEstimate as it was encoded; whether it makes sense is not judged here."""
    message = _deserialise(PAIR_ESTIMATE, data)
    translation, quat_wxyz = _pose_arrays(message.pose)
    hypotheses = [_pose_arrays(pose) for pose in message.hypotheses]
    return PairEstimate(
        source_stamp_ns=_nanoseconds(message.source_stamp),
        target_stamp_ns=_nanoseconds(message.target_stamp),
        quat_wxyz=quat_wxyz,
        translation=translation,
        covariance=message.covariance.reshape(6, 6).copy(),
        winner=message.winner,
        hypotheses_quat_wxyz=np.array([quat for _, quat in hypotheses]).reshape(-1, 4),
        hypotheses_translation=np.array([position for position, _ in hypotheses]).reshape(-1, 3),
        errors=np.array(message.errors),
        imu_coverage=message.imu_coverage,
    )


# --- States of a back end -----------------------------------------------------------------------


def encode_estimator(series: EstimatorSeries, row: int) -> bytes:
    """One row of a series as EstimatorState; every number is kept to the last bit."""
    innovation = series.innovation[row]
    return _serialise(
        ESTIMATOR_STATE,
        header=_header(int(series.stamps_ns[row]), CAMERA_FRAME),
        **{name: _vector(getattr(series, name)[row]) for name in _STATE_VECTORS},
        **{name: float(getattr(series, name)[row]) for name in _STATE_NUMBERS},
        innovation_rotation=_vector(innovation[:3]),
        innovation_translation=_vector(innovation[3:]),
        used=bool(series.used[row]),
    )


def decode_estimator(data: bytes | memoryview) -> EstimatorSeries:
    """EstimatorState as a series of one row."""
    message = _deserialise(ESTIMATOR_STATE, data)
    innovation = [_vector_array(message.innovation_rotation), _vector_array(message.innovation_translation)]
    return EstimatorSeries(
        stamps_ns=np.array([_nanoseconds(message.header.stamp)]),
        **{name: _vector_array(getattr(message, name))[None] for name in _STATE_VECTORS},
        **{name: np.array([getattr(message, name)]) for name in _STATE_NUMBERS},
        innovation=np.concatenate(innovation)[None],
        used=np.array([message.used]),
    )


_STATE_VECTORS = (
    "gyro_bias",
    "gyro_bias_std",
    "accelerometer_bias",
    "accelerometer_bias_std",
    "rate_bias",
    "rate_bias_std",
)
_STATE_NUMBERS = ("scale_error", "scale_error_std", "nis")


# --- Satellites ---------------------------------------------------------------------------------


def encode_gnss(fix: GnssFix) -> bytes:
    """NavSatFix."""
    unknown = fix.covariance is None
    return _serialise(
        GNSS,
        header=_header(fix.stamp_ns, "gnss"),
        status=_new("sensor_msgs/msg/NavSatStatus", status=0, service=1),
        latitude=fix.latitude_deg,
        longitude=fix.longitude_deg,
        altitude=fix.altitude_m,
        position_covariance=np.zeros(9) if unknown else np.asarray(fix.covariance, dtype=np.float64).ravel(),
        position_covariance_type=0 if unknown else 3,
    )


def decode_gnss(data: bytes | memoryview) -> GnssFix | None:
    """NavSatFix, or None where the receiver had no fix."""
    message = _deserialise(GNSS, data)
    if message.status.status < 0 or not np.all(np.isfinite([message.latitude, message.longitude])):
        return None
    return GnssFix(
        stamp_ns=_nanoseconds(message.header.stamp),
        latitude_deg=message.latitude,
        longitude_deg=message.longitude,
        altitude_m=message.altitude,
        covariance=message.position_covariance.reshape(3, 3).copy() if message.position_covariance_type else None,
    )


# --- Frames -------------------------------------------------------------------------------------


def frame_id(type_name: str, data: bytes | memoryview) -> str:
    """The frame that a message with a header is expressed in."""
    return str(_deserialise(type_name, data).header.frame_id).lstrip("/")


# --- rosbags' objects ---------------------------------------------------------------------------


def _new(type_name: str, **fields: Any) -> Any:
    return TYPESTORE.types[type_name](**fields)


def _serialise(type_name: str, **fields: Any) -> bytes:
    return bytes(TYPESTORE.serialize_cdr(_new(type_name, **fields), type_name, little_endian=True))


def _deserialise(type_name: str, data: bytes | memoryview) -> Any:
    try:
        return TYPESTORE.deserialize_cdr(data, type_name)
    except (SerdeError, struct.error, IndexError) as error:
        raise ValueError(f"a message of {type_name} cannot be decoded: {error}") from error


def _time(stamp_ns: int) -> Any:
    seconds, nanoseconds = divmod(int(stamp_ns), NANOSECONDS)
    if not 0 <= seconds < 2**31:
        raise LogError(f"a stamp of {stamp_ns} ns is outside of what a log can hold (0 to {2**31} s)")
    return _new("builtin_interfaces/msg/Time", sec=seconds, nanosec=nanoseconds)


def _nanoseconds(time: Any) -> int:
    return int(time.sec) * NANOSECONDS + int(time.nanosec)


def _header(stamp_ns: int, frame_id: str) -> Any:
    return _new("std_msgs/msg/Header", stamp=_time(stamp_ns), frame_id=frame_id)


def _vector(xyz: FloatArray) -> Any:
    return _new("geometry_msgs/msg/Vector3", x=xyz[0], y=xyz[1], z=xyz[2])


def _vector_array(vector: Any) -> FloatArray:
    return np.array([vector.x, vector.y, vector.z])


def _quaternion(quat_wxyz: FloatArray) -> Any:
    w, x, y, z = quat_wxyz
    return _new("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)


def _quaternion_array(quaternion: Any) -> FloatArray:
    return np.array([quaternion.w, quaternion.x, quaternion.y, quaternion.z])


def _pose(position: FloatArray, quat_wxyz: FloatArray) -> Any:
    x, y, z = position
    return _new(
        "geometry_msgs/msg/Pose",
        position=_new("geometry_msgs/msg/Point", x=x, y=y, z=z),
        orientation=_quaternion(quat_wxyz),
    )


def _pose_arrays(pose: Any) -> tuple[FloatArray, FloatArray]:
    return _vector_array(pose.position), _quaternion_array(pose.orientation)
