"""Records and ROS 2 messages say the same, to the last bit."""

import contextlib
import dataclasses
import struct

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from log_samples import START, WIDTH, depth, grey, header, pair_estimates, raw_image, serialise
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import Rotation

from fusion_io import messages
from fusion_io.errors import LogError
from fusion_io.messages import FrameTransform, ImuSample, PoseSample
from fusion_io.records import CameraInfo, GnssFix, PairEstimate

any_float = st.floats(width=64)  # NaN, infinities and signed zeros too
stamps = st.integers(0, 2**31 * 10**9 - 1)


def vectors(*shape: int) -> st.SearchStrategy[np.ndarray]:
    return arrays(np.float64, shape, elements=any_float)


def same_bits(a: object, b: object) -> bool:
    """Equal in every field, where a NaN equals the same NaN and 0.0 is not -0.0."""
    for field in dataclasses.fields(a):  # type: ignore[arg-type]
        x, y = getattr(a, field.name), getattr(b, field.name)
        if isinstance(x, np.ndarray):
            if x.shape != y.shape or x.tobytes() != y.tobytes():
                return False
        elif isinstance(x, float):
            if struct.pack("<d", x) != struct.pack("<d", y):
                return False
        elif x != y:
            return False
    return True


@st.composite
def any_pair(draw: st.DrawFn) -> PairEstimate:
    hypotheses = draw(st.integers(0, 5))
    return PairEstimate(
        source_stamp_ns=draw(stamps),
        target_stamp_ns=draw(stamps),
        quat_wxyz=draw(vectors(4)),
        translation=draw(vectors(3)),
        covariance=draw(vectors(6, 6)),
        winner=draw(st.integers(-(2**31), 2**31 - 1)),
        hypotheses_quat_wxyz=draw(vectors(hypotheses, 4)),
        hypotheses_translation=draw(vectors(hypotheses, 3)),
        errors=draw(vectors(hypotheses)),
        imu_coverage=draw(any_float),
    )


@settings(max_examples=50, deadline=None, derandomize=True)
@given(any_pair())
def test_pair_estimates_round_trip_to_the_bit(pair: PairEstimate) -> None:
    data = messages.encode_pair(pair)
    assert same_bits(messages.decode_pair(data), pair)
    assert messages.encode_pair(messages.decode_pair(data)) == data
    assert messages.header_stamp(data) == pair.target_stamp_ns


@settings(max_examples=50, deadline=None, derandomize=True)
@given(stamps, vectors(3), vectors(3), st.one_of(st.none(), st.floats(1e-12, 1e12)), st.booleans())
def test_imu_samples_round_trip_to_the_bit(stamp, gyro, accelerometer, deviation, measured) -> None:
    sample = ImuSample(gyro, accelerometer, deviation, 0.25 if measured else None, has_linear_acceleration=measured)
    data = messages.encode_imu(stamp, sample)
    assert same_bits(messages.decode_imu(data), sample)
    assert messages.encode_imu(stamp, messages.decode_imu(data)) == data
    assert messages.header_stamp(data) == stamp


@settings(max_examples=50, deadline=None, derandomize=True)
@given(stamps, vectors(3), vectors(4))
def test_poses_round_trip_to_the_bit(stamp, position, quat_wxyz) -> None:
    pose = PoseSample(position, quat_wxyz)
    assert same_bits(messages.decode_pose(messages.POSE_STAMPED, messages.encode_pose(stamp, pose)), pose)
    transform = FrameTransform("a", "b", pose)
    (read,) = messages.decode_transforms(messages.encode_transforms(stamp, [transform]))
    assert (read.parent, read.child) == ("a", "b")
    assert same_bits(read.pose, pose)


def test_gnss_round_trips_and_no_fix_is_none() -> None:
    fix = GnssFix(START, 49.0, 8.4, 115.0, np.diag([1.0, 2.0, 9.0]))
    assert same_bits(messages.decode_gnss(messages.encode_gnss(fix)), fix)
    unknown = dataclasses.replace(fix, covariance=None)
    assert messages.decode_gnss(messages.encode_gnss(unknown)).covariance is None
    assert messages.decode_gnss(messages.encode_gnss(dataclasses.replace(fix, latitude_deg=np.nan))) is None


def test_camera_info_round_trips() -> None:
    K = np.array([[300.5, 0, 159.3], [0, 301.5, 119.1], [0, 0, 1.0]])
    info = CameraInfo(320, 240, K, "rational_polynomial", np.arange(8) / 7, "left")
    assert same_bits(messages.decode_camera_info(messages.encode_camera_info(START, info)), info)


def test_odometry_covariance_is_translation_first_in_fixed_axes() -> None:
    """Facing along y (yaw of 90 degrees), uncertainty along the body's x is uncertainty along the world's y."""
    variances = np.array([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])  # rotation x y z, translation x y z
    quat_wxyz = Rotation.from_euler("z", 90, degrees=True).as_quat(scalar_first=True)
    pose = PoseSample(np.zeros(3), quat_wxyz, np.diag(variances))
    data = messages.encode_odometry(START, pose, "camera_raw")
    stored = messages.TYPESTORE.deserialize_cdr(data, messages.ODOMETRY).pose.covariance.reshape(6, 6)
    np.testing.assert_allclose(stored, np.diag([5.0, 4.0, 6.0, 2.0, 1.0, 3.0]), atol=1e-12)
    np.testing.assert_allclose(messages.decode_pose(messages.ODOMETRY, data).covariance, pose.covariance, atol=1e-12)


def test_odometry_covariance_describes_the_same_uncertainty() -> None:
    """Poses perturbed on the right by our covariance scatter in ROS' axes as the message says (to first order)."""
    rng = np.random.default_rng(0)
    root = rng.normal(size=(6, 6)) * 1e-4
    R = Rotation.random(rng=rng)
    pose = PoseSample(np.zeros(3), R.as_quat(scalar_first=True), root @ root.T)
    message = messages.TYPESTORE.deserialize_cdr(messages.encode_odometry(0, pose, "c"), messages.ODOMETRY)
    xi = rng.normal(size=(20_000, 6)) @ root.T
    shift = R.apply(xi[:, 3:])
    turn = (R * Rotation.from_rotvec(xi[:, :3]) * R.inv()).as_rotvec()
    scatter = np.cov(np.hstack([shift, turn]).T)
    stated = message.pose.covariance.reshape(6, 6)
    np.testing.assert_allclose(scatter, stated, atol=0.05 * np.abs(stated).max())


def test_schemas_stand_alone() -> None:
    """What a log embeds is enough to read its messages, without knowing any type beforehand."""
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(messages.schema_text(messages.PAIR_ESTIMATE), messages.PAIR_ESTIMATE))
    pair = pair_estimates(1)[0]
    read = store.deserialize_cdr(messages.encode_pair(pair), messages.PAIR_ESTIMATE)
    assert read.covariance.tobytes() == pair.covariance.tobytes()
    assert "rotation about x, y, z [rad], then translation" in messages.schema_text(messages.PAIR_ESTIMATE)


@pytest.mark.parametrize("stamp", [-1, 2**31 * 10**9])
def test_stamps_outside_of_ros_time_are_refused(stamp: int) -> None:
    with pytest.raises(LogError, match="stamp"):
        messages.encode_depth(stamp, depth())


# --- Images -------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", [(7, 5), (7, 5, 3)])
def test_images_round_trip(shape: tuple[int, ...]) -> None:
    image = np.random.default_rng(0).integers(0, 256, shape, dtype=np.uint8)
    read = messages.decode_image(messages.COMPRESSED_IMAGE, messages.encode_image(START, image))
    np.testing.assert_array_equal(read, image)


@settings(max_examples=50, deadline=None, derandomize=True)
@given(arrays(np.float32, (2, 3), elements=st.floats(width=32)))
def test_depth_is_rounded_to_a_256th_of_a_metre_and_invalid_is_zero(values) -> None:
    values = np.where(values > 30_000, np.inf, values).astype(np.float32)  # beyond that float32 itself is coarser
    read = messages.decode_depth(messages.IMAGE, messages.encode_depth(START, values))
    valid = np.isfinite(values) & (values > 0)
    np.testing.assert_allclose(read[valid], values[valid], rtol=0, atol=0.5 / 256)
    assert not read[~valid].any()
    np.testing.assert_array_equal(messages.decode_depth(messages.IMAGE, messages.encode_depth(START, read)), read)


COLOUR = np.random.default_rng(1).integers(0, 256, (6, 5, 3), dtype=np.uint8)
ALPHA = np.full((6, 5, 1), 9, dtype=np.uint8)


@pytest.mark.parametrize(
    ("encoding", "pixels", "expected"),
    [
        ("mono8", COLOUR[..., 0], COLOUR[..., 0]),
        ("8UC1", COLOUR[..., 0], COLOUR[..., 0]),
        ("mono16", COLOUR[..., 0].astype("<u2") * 256 + 17, COLOUR[..., 0]),
        ("rgb8", COLOUR, COLOUR),
        ("bgr8", COLOUR[..., ::-1], COLOUR),
        ("8UC3", COLOUR[..., ::-1], COLOUR),
        ("rgba8", np.concatenate([COLOUR, ALPHA], axis=2), COLOUR),
        ("bgra8", np.concatenate([COLOUR[..., ::-1], ALPHA], axis=2), COLOUR),
    ],
)
def test_raw_images_become_grey_or_rgb(encoding: str, pixels: np.ndarray, expected: np.ndarray) -> None:
    _, kind, _, data = raw_image("/x", START, np.ascontiguousarray(pixels), encoding)
    np.testing.assert_array_equal(messages.decode_image(kind, data), expected)
    assert messages.image_kind(kind, data) == "image"


def test_rows_may_be_padded_and_big_endian() -> None:
    millimetres = np.arange(1000, 1020, dtype=">u2").reshape(4, 5)
    padded = np.zeros((4, 16), dtype=np.uint8)
    padded[:, :10] = millimetres.view(np.uint8)
    _, kind, _, data = raw_image("/d", START, padded, "16UC1", width=5, is_bigendian=1)
    np.testing.assert_allclose(messages.decode_depth(kind, data), np.asarray(millimetres) / 1000, rtol=1e-6)


def compressed(image_format: str, data: bytes) -> bytes:
    return serialise(
        messages.COMPRESSED_IMAGE, header=header(START), format=image_format, data=np.frombuffer(data, dtype=np.uint8)
    )


def test_jpeg_is_read() -> None:
    smooth = np.tile(np.linspace(0, 255, 64, dtype=np.uint8), (64, 1))
    data = compressed("rgb8; jpeg compressed bgr8", cv2.imencode(".jpg", cv2.merge([smooth, smooth // 2, smooth]))[1])
    read = messages.decode_image(messages.COMPRESSED_IMAGE, data).astype(int)
    np.testing.assert_allclose(read[..., 1], smooth // 2, atol=8)


def test_compressed_depth_in_millimetres_and_as_inverse_depth() -> None:
    millimetres = np.arange(1000, 1030, dtype=np.uint16).reshape(5, 6)
    png = cv2.imencode(".png", millimetres)[1].tobytes()
    expected = millimetres / 1000
    plain = compressed("16UC1; png compressed", png)
    transported = compressed("16UC1; compressedDepth png", struct.pack("<iff", 0, 0, 0) + png)
    for data in (plain, transported):
        assert messages.image_kind(messages.COMPRESSED_IMAGE, data) == "depth"
        np.testing.assert_allclose(messages.decode_depth(messages.COMPRESSED_IMAGE, data), expected, rtol=1e-6)
    a, b = 20_000.0, 3.0
    inverse = np.rint(a / expected + b).astype(np.uint16)
    inverse[0, 0] = 0
    png = cv2.imencode(".png", inverse)[1].tobytes()
    data = compressed("32FC1; compressedDepth", struct.pack("<iff", 0, a, b) + png)
    read = messages.decode_depth(messages.COMPRESSED_IMAGE, data)
    assert read[0, 0] == 0
    np.testing.assert_allclose(read.ravel()[1:], expected.ravel()[1:], atol=1e-4)


@pytest.mark.parametrize(
    "changes",
    [{"width": WIDTH * 2}, {"height": 0}, {"step": 1}, {"data": np.zeros(3, np.uint8)}],
)
def test_images_that_contradict_themselves_are_refused(changes: dict) -> None:
    _, kind, _, data = raw_image("/x", START, grey(), "mono8", **changes)
    with pytest.raises(ValueError, match=r"cannot"):
        messages.decode_image(kind, data)


def test_an_unknown_encoding_is_named() -> None:
    _, kind, _, data = raw_image("/x", START, grey(), "bayer_rggb8")
    with pytest.raises(ValueError, match="bayer_rggb8"):
        messages.decode_image(kind, data)


@settings(max_examples=100, deadline=None, derandomize=True)
@given(st.binary(max_size=200), st.sampled_from([0, 1]))
def test_garbage_is_a_value_error(body: bytes, byte_order: int) -> None:
    data = bytes([0, byte_order, 0, 0]) + body
    decoders = [
        lambda: messages.decode_imu(data),
        lambda: messages.decode_pair(data),
        lambda: messages.decode_camera_info(data),
        lambda: messages.decode_image(messages.IMAGE, data),
        lambda: messages.decode_image(messages.COMPRESSED_IMAGE, data),
        lambda: messages.decode_depth(messages.IMAGE, data),
        lambda: messages.decode_pose(messages.POSE_STAMPED, data),
        lambda: messages.decode_pose(messages.ODOMETRY, data),
        lambda: messages.decode_gnss(data),
        lambda: messages.decode_transforms(data),
    ]
    for decode in decoders:
        with contextlib.suppress(ValueError):
            decode()


def test_intrinsics_of_a_region_of_interest_and_of_a_rectified_image() -> None:
    K = np.array([[300.0, 0, 160], [0, 300, 120], [0, 0, 1]])
    P = np.array([[280.0, 0, 150, 0], [0, 280, 110, 0], [0, 0, 1, 0]])
    roi = messages.TYPESTORE.types["sensor_msgs/msg/RegionOfInterest"](
        x_offset=20, y_offset=10, height=100, width=200, do_rectify=False
    )
    data = serialise(
        messages.CAMERA_INFO, header=header(START), height=240, width=320, distortion_model="plumb_bob",
        d=np.array([0.1, 0, 0, 0, 0]), k=K.ravel(), r=np.eye(3).ravel(), p=P.ravel(), binning_x=0, binning_y=0, roi=roi,
    )  # fmt: skip
    raw = messages.decode_camera_info(data)
    assert (raw.width, raw.height, raw.K[0, 2], raw.K[1, 2], len(raw.distortion)) == (200, 100, 140, 110, 5)
    rectified = messages.decode_camera_info(data, rectified=True)
    assert (rectified.K[0, 0], rectified.K[0, 2], len(rectified.distortion)) == (280, 130, 0)


def test_an_uncalibrated_camera_is_refused() -> None:
    data = messages.encode_camera_info(START, CameraInfo(320, 240, np.zeros((3, 3))))
    with pytest.raises(ValueError, match="not calibrated"):
        messages.decode_camera_info(data)
