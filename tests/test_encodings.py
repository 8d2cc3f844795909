"""ROS 1 messages and Foxglove's camera messages say in a log what the same ROS 2 messages say."""

import base64
import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from foxglove_schemas_protobuf.CameraCalibration_pb2 import CameraCalibration
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from hypothesis import given, settings
from hypothesis import strategies as st
from log_samples import CAMERA, HEIGHT, SECOND, START, WIDTH, K, depth, grey, trajectory
from mcap.records import Schema
from mcap.writer import Writer
from mcap_protobuf.schema import build_file_descriptor_set
from mcap_protobuf.writer import Writer as ProtobufWriter
from rosbags.typesys import Stores, get_typestore

from fusion_io import encodings, foxglove, messages
from fusion_io.container import Channel
from fusion_io.reader import Log, open_log

ROS1 = get_typestore(Stores.ROS1_NOETIC)
PERIOD = SECOND // 10
COUNT = 5
P = np.column_stack([K, np.zeros(3)])

# What the recorder's clock is ahead of the stamps: whoever takes one for the other is found out.
LATE = 30_000_000


def stamp_of(i: int) -> int:
    return START + i * PERIOD + 123_456_789


def png(image: np.ndarray) -> bytes:
    return cv2.imencode(".png", image)[1].tobytes()


# --- The same frames and poses in three encodings -----------------------------------------------


def protobuf_items(i: int) -> list[tuple[str, Any]]:
    def message(kind: Callable[..., Any], **fields: Any) -> Any:
        made = kind(frame_id="camera", **fields)
        made.timestamp.FromNanoseconds(stamp_of(i))
        return made

    pose = trajectory(COUNT).poses[i]
    x, y, z, w = pose.rotation.as_quat()
    truth = message(PoseInFrame)
    truth.pose.position.x, truth.pose.position.y, truth.pose.position.z = pose.translation
    truth.pose.orientation.x, truth.pose.orientation.y, truth.pose.orientation.z, truth.pose.orientation.w = x, y, z, w
    return [
        ("/camera/compressed", message(CompressedImage, format="png", data=png(grey(i)))),
        (
            "/camera/range",
            message(
                RawImage,
                width=WIDTH,
                height=HEIGHT,
                encoding="32FC1",
                step=4 * WIDTH,
                data=depth(i).astype("<f4").tobytes(),
            ),
        ),
        (
            "/camera/calibration",
            message(
                CameraCalibration,
                width=WIDTH,
                height=HEIGHT,
                distortion_model="plumb_bob",
                D=np.zeros(5),
                K=K.ravel(),
                R=np.eye(3).ravel(),
                P=P.ravel(),
            ),
        ),
        ("/truth", truth),
    ]  # fmt: skip


def write_protobuf(path: Path) -> Path:
    with path.open("wb") as stream:
        writer = ProtobufWriter(stream)
        for i in range(COUNT):
            for topic, message in protobuf_items(i):
                writer.write_message(topic, message, log_time=stamp_of(i) + LATE)
        writer.finish()
    return path


def json_items(i: int) -> list[tuple[str, str, dict[str, Any]]]:
    seconds, nanoseconds = divmod(stamp_of(i), SECOND)
    head = {"timestamp": {"sec": seconds, "nsec": nanoseconds}, "frame_id": "camera"}
    pose = trajectory(COUNT).poses[i]
    pixels = depth(i).astype("<f4").tobytes()
    return [
        (
            "/camera/compressed",
            "foxglove.CompressedImage",
            head | {"format": "png", "data": base64.b64encode(png(grey(i))).decode()},
        ),
        (
            "/camera/range",
            "foxglove.RawImage",
            head
            | {"width": WIDTH, "height": HEIGHT, "encoding": "32FC1", "step": 4 * WIDTH}
            | {"data": base64.b64encode(pixels).decode()},
        ),
        (
            "/camera/calibration",
            "foxglove.CameraCalibration",
            head
            | {"width": WIDTH, "height": HEIGHT, "distortion_model": "plumb_bob", "D": [0, 0, 0, 0, 0]}
            | {"K": K.ravel().tolist(), "R": np.eye(3).ravel().tolist(), "P": P.ravel().tolist()},
        ),
        (
            "/truth",
            "foxglove.PoseInFrame",
            head
            | {
                "pose": {
                    "position": dict(zip("xyz", pose.translation.tolist(), strict=True)),
                    "orientation": dict(zip("xyzw", pose.rotation.as_quat().tolist(), strict=True)),
                }
            },
        ),
    ]


def write_json(path: Path) -> Path:
    items = [
        (topic, kind, stamp_of(i) + LATE, json.dumps(fields).encode())
        for i in range(COUNT)
        for topic, kind, fields in json_items(i)
    ]
    return write(path, "json", "jsonschema", items)


def ros1(type_name: str, **fields: Any) -> Any:
    return ROS1.types[type_name](**fields)


def ros1_header(i: int) -> Any:
    seconds, nanoseconds = divmod(stamp_of(i), SECOND)
    time = ros1("builtin_interfaces/msg/Time", sec=seconds, nanosec=nanoseconds)
    return ros1("std_msgs/msg/Header", seq=7 + i, stamp=time, frame_id="camera")


def ros1_items(i: int) -> list[tuple[str, Any]]:
    header, pose = ros1_header(i), trajectory(COUNT).poses[i]
    x, y, z = pose.translation
    qx, qy, qz, qw = pose.rotation.as_quat()
    vector = ros1("geometry_msgs/msg/Vector3", x=0.1 * i, y=0.2, z=0.3)
    roi = ros1("sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
    return [
        (
            "/camera/compressed",
            ros1(
                "sensor_msgs/msg/CompressedImage", header=header, format="png", data=np.frombuffer(png(grey(i)), "u1")
            ),
        ),
        (
            "/camera/range",
            ros1(
                "sensor_msgs/msg/Image", header=header, height=HEIGHT, width=WIDTH, encoding="32FC1", is_bigendian=0,
                step=4 * WIDTH, data=depth(i).astype("<f4").reshape(-1).view("u1"),
            ),
        ),
        (
            "/camera/calibration",
            ros1(
                "sensor_msgs/msg/CameraInfo", header=header, height=HEIGHT, width=WIDTH, distortion_model="plumb_bob",
                D=np.zeros(5), K=K.ravel(), R=np.eye(3).ravel(), P=P.ravel(), binning_x=0, binning_y=0, roi=roi,
            ),
        ),
        (
            "/truth",
            ros1(
                "geometry_msgs/msg/PoseStamped", header=header,
                pose=ros1(
                    "geometry_msgs/msg/Pose",
                    position=ros1("geometry_msgs/msg/Point", x=x, y=y, z=z),
                    orientation=ros1("geometry_msgs/msg/Quaternion", x=qx, y=qy, z=qz, w=qw),
                ),
            ),
        ),
        (
            "/imu/data",
            ros1(
                "sensor_msgs/msg/Imu", header=header,
                orientation=ros1("geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0),
                orientation_covariance=np.zeros(9), angular_velocity=vector, angular_velocity_covariance=np.zeros(9),
                linear_acceleration=vector, linear_acceleration_covariance=np.zeros(9),
            ),
        ),
    ]  # fmt: skip


def write_ros1(path: Path) -> Path:
    items = [
        (
            topic,
            message.__msgtype__.replace("/msg/", "/"),
            stamp_of(i) + LATE,
            bytes(ROS1.serialize_ros1(message, message.__msgtype__)),
        )
        for i in range(COUNT)
        for topic, message in ros1_items(i)
    ]
    return write(path, "ros1", "ros1msg", items)


def write(
    path: Path,
    message_encoding: str,
    schema_encoding: str,
    items: list[tuple[str, str, int, bytes]],
    schema: bytes = b"",
) -> Path:
    channels: dict[str, int] = {}
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        for topic, kind, log_time, data in items:
            if topic not in channels:
                schema_id = writer.register_schema(kind, schema_encoding, schema)
                channels[topic] = writer.register_channel(topic, message_encoding, schema_id)
            writer.add_message(channels[topic], log_time, data, log_time)
        writer.finish()
    return path


@pytest.fixture(params=[write_protobuf, write_json, write_ros1], ids=["protobuf", "json", "ros1"])
def log(request: pytest.FixtureRequest, tmp_path: Path) -> Log:
    return open_log(request.param(tmp_path / "foreign.mcap"))


def test_frames_and_poses_are_read_as_they_were_written_at_their_own_stamps(log: Log) -> None:
    assert {role: topic for role, topic in log.roles.items() if role != "imu"} == {
        "image": "/camera/compressed",
        "depth": "/camera/range",
        "camera_info": "/camera/calibration",
        "ground_truth": "/truth",
    }
    stamps = [stamp_of(i) for i in range(COUNT)]
    assert (log.start_ns, log.end_ns) == (stamps[0], stamps[-1])
    np.testing.assert_array_equal(log.frame_stamps(), stamps)
    for i, frame in enumerate(log.frames()):
        np.testing.assert_array_equal(frame.image, grey(i))
        np.testing.assert_array_equal(frame.depth, depth(i))
        np.testing.assert_array_equal(frame.camera.K, CAMERA.K)
        assert (frame.camera.width, frame.camera.height, frame.camera.frame_id) == (WIDTH, HEIGHT, "camera")
    truth = log.ground_truth()
    np.testing.assert_array_equal(truth.stamps_ns, stamps)
    np.testing.assert_array_equal(truth.poses.translation, trajectory(COUNT).poses.translation)
    assert (truth.poses.rotation * trajectory(COUNT).poses.rotation.inv()).magnitude().max() < 1e-14
    assert log.warnings == {}
    assert log.notes == []


def test_ros1_imu_is_read(tmp_path: Path) -> None:
    series = open_log(write_ros1(tmp_path / "a.mcap")).imu()
    np.testing.assert_array_equal(series.stamps_ns, [stamp_of(i) for i in range(COUNT)])
    np.testing.assert_array_equal(series.angular_velocity, [[0.1 * i, 0.2, 0.3] for i in range(COUNT)])


@pytest.mark.parametrize(
    ("type_name", "fields"),
    [
        ("nav_msgs/Odometry", {"header", "child_frame_id", "pose", "twist"}),
        ("sensor_msgs/NavSatFix", {"header", "status", "latitude", "position_covariance_type"}),
        ("geometry_msgs/PoseWithCovarianceStamped", {"header", "pose"}),
    ],
)
def test_the_other_ros1_messages_have_the_fields_of_ros2(type_name: str, fields: set[str]) -> None:
    """The bytes are taken over as they are: the two definitions must agree in order and type of all but `seq`."""

    def flat(store: Any, name: str) -> list[Any]:
        _, definition = store.fielddefs[name]
        return [(field.lower(), kind) for field, kind in definition if (name, field) != ("std_msgs/msg/Header", "seq")]

    ros2_type = encodings.ros2_type(Channel("/x", type_name, "ros1"))
    assert fields <= {field for field, _ in flat(ROS1, ros2_type)}
    for name in (ros2_type, "std_msgs/msg/Header", "sensor_msgs/msg/NavSatStatus", "geometry_msgs/msg/Twist"):
        assert flat(ROS1, name) == flat(messages.TYPESTORE, name)


def test_a_fisheye_lens_is_known_by_its_ros_name(tmp_path: Path) -> None:
    topic, kind, fields = json_items(0)[2]
    fields |= {"distortion_model": "kannala_brandt", "D": [0.1, 0.01, 0.001, 0.0001]}
    path = write(tmp_path / "a.mcap", "json", "jsonschema", [(topic, kind, START, json.dumps(fields).encode())])
    camera = open_log(path).camera_info()
    assert camera is not None
    assert camera.distortion_model == "equidistant"
    np.testing.assert_array_equal(camera.distortion, [0.1, 0.01, 0.001, 0.0001])


def test_a_real_foxglove_log_is_read_once_its_camera_is_chosen(shared_data: Path) -> None:
    path = shared_data / "foreign_mcap" / "lichtblick_camera_json.mcap"
    log = open_log(path, {"camera_info": "/camera_calibration"})
    assert log.roles == {"image": "/image/compressed", "camera_info": "/camera_calibration"}
    np.testing.assert_array_equal(log.frame_stamps(), [1_747_930_377 * SECOND])
    assert log.warnings["duplicate_frames"] == 9  # all of its images bear the same stamp
    camera = log.camera_info()
    assert camera is not None
    np.testing.assert_array_equal(camera.K, [[800, 0, 320], [0, 800, 240], [0, 0, 1]])
    assert camera.distortion_model == "plumb_bob"


# --- Malformed ----------------------------------------------------------------------------------


def json_message(name: str, **changes: Any) -> bytes:
    _, _, fields = next(item for item in json_items(0) if item[1] == name)
    return json.dumps({key: value for key, value in (fields | changes).items() if value is not None}).encode()


@pytest.mark.parametrize(
    ("name", "data", "reason"),
    [
        ("foxglove.RawImage", b"\xff\xfe", "cannot be decoded"),
        ("foxglove.RawImage", b"[1, 2", "cannot be decoded"),
        ("foxglove.RawImage", b"[1, 2]", "timestamp"),
        ("foxglove.RawImage", json_message("foxglove.RawImage", width=None), "width"),
        ("foxglove.RawImage", json_message("foxglove.RawImage", width=-3), "cannot be decoded"),
        ("foxglove.RawImage", json_message("foxglove.RawImage", width="wide"), "cannot be decoded"),
        ("foxglove.RawImage", json_message("foxglove.RawImage", data="not base64!"), "cannot be decoded"),
        ("foxglove.RawImage", json_message("foxglove.RawImage", timestamp={"sec": 1}), "nsec"),
        ("foxglove.RawImage", json_message("foxglove.RawImage", timestamp={"sec": -1, "nsec": 0}), "a time of -1 s"),
        ("foxglove.CompressedImage", json_message("foxglove.CompressedImage", data=None), "data"),
        (
            "foxglove.CameraCalibration",
            json_message("foxglove.CameraCalibration", K=[1, 2, 3]),
            "K has 3 numbers, not 9",
        ),
        ("foxglove.CameraCalibration", json_message("foxglove.CameraCalibration", D=["a"]), "cannot be decoded"),
        ("foxglove.PoseInFrame", json_message("foxglove.PoseInFrame", pose={"position": {}}), "orientation"),
    ],
)
def test_a_malformed_json_message_is_a_value_error_with_the_reason(name: str, data: bytes, reason: str) -> None:
    convert = encodings.to_cdr(Channel("/x", name, "json"), Schema(1, b"", "jsonschema", name))
    assert convert is not None
    with pytest.raises(ValueError, match=reason):
        convert(data)


def protobuf_channel(kind: Any) -> tuple[Channel, Schema]:
    name = kind.DESCRIPTOR.full_name
    definition = build_file_descriptor_set(kind).SerializeToString()
    return Channel("/x", name, "protobuf"), Schema(1, definition, "protobuf", name)


@pytest.mark.parametrize(
    ("kind", "data", "reason"),
    [
        (RawImage, b"\xff\xff\xff", "cannot be decoded"),
        (CameraCalibration, CameraCalibration(K=[1.0]).SerializeToString(), "K has 1 numbers, not 9"),
        (PoseInFrame, PoseInFrame(timestamp={"seconds": -5}).SerializeToString(), "a time of -5 s"),
    ],
)
def test_a_malformed_protobuf_message_is_a_value_error_with_the_reason(kind: Any, data: bytes, reason: str) -> None:
    convert = encodings.to_cdr(*protobuf_channel(kind))
    assert convert is not None
    with pytest.raises(ValueError, match=reason):
        convert(data)


@pytest.mark.parametrize("definition", [b"", b"\xff\xff", build_file_descriptor_set(PoseInFrame).SerializeToString()])
def test_a_protobuf_definition_that_does_not_define_the_message_is_a_value_error(definition: bytes) -> None:
    schema = Schema(1, definition, "protobuf", "foxglove.RawImage")
    convert = encodings.to_cdr(Channel("/x", "foxglove.RawImage", "protobuf"), schema)
    assert convert is not None
    with pytest.raises(ValueError, match="cannot be decoded"):
        convert(b"")


@settings(max_examples=100, deadline=None, derandomize=True)
@given(st.binary(max_size=300), st.sampled_from(sorted(foxglove.MESSAGE_TYPES)), st.sampled_from(["json", "protobuf"]))
def test_foxglove_garbage_is_a_value_error_or_a_message(body: bytes, name: str, encoding: str) -> None:
    kinds = {kind.DESCRIPTOR.full_name: kind for kind in (CompressedImage, RawImage, CameraCalibration, PoseInFrame)}
    channel, schema = protobuf_channel(kinds[name])
    must_convert_or_refuse(encodings.to_cdr(channel._replace(message_encoding=encoding), schema), body)


@settings(max_examples=100, deadline=None, derandomize=True)
@given(st.binary(max_size=300), st.sampled_from(["sensor_msgs/Imu", "sensor_msgs/Image", "tf2_msgs/TFMessage"]))
def test_ros1_garbage_is_a_value_error_or_a_message(body: bytes, name: str) -> None:
    must_convert_or_refuse(encodings.to_cdr(Channel("/x", name, "ros1"), None), body)


def must_convert_or_refuse(convert: Any, body: bytes) -> None:
    try:
        data = convert(body)
    except ValueError:
        return
    assert bytes(data[:2]) == b"\x00\x01"  # little-endian CDR


def test_a_ros1_message_that_is_cut_or_too_long_is_a_value_error() -> None:
    topic, message = ros1_items(0)[-1]
    data = bytes(ROS1.serialize_ros1(message, message.__msgtype__))
    convert = encodings.to_cdr(Channel(topic, "sensor_msgs/Imu", "ros1"), None)
    assert convert is not None
    for malformed in (data[:-1], data + b"\0", data[:10]):
        with pytest.raises(ValueError, match="sensor_msgs/msg/Imu cannot be decoded"):
            convert(malformed)


def test_a_malformed_message_among_others_is_left_out_and_counted(tmp_path: Path) -> None:
    items = [
        (topic, kind, stamp_of(i) + LATE, json.dumps(fields).encode())
        for i in range(COUNT)
        for topic, kind, fields in json_items(i)
    ]
    topic, kind, log_time, _ = items[8]
    items[8] = (topic, kind, log_time, b'{"timestamp": {"sec": 1')
    log = open_log(write(tmp_path / "a.mcap", "json", "jsonschema", items))
    assert len(list(log.frames())) == COUNT - 1
    assert log.warnings["image_unreadable"] == 1
    assert any("foxglove.CompressedImage as json cannot be decoded" in note for note in log.notes)


def test_other_foxglove_messages_and_other_encodings_are_not_readable() -> None:
    assert encodings.ros2_type(Channel("/x", "foxglove.SceneUpdate", "protobuf")) == ""
    assert encodings.ros2_type(Channel("/x", "foxglove.RawImage", "flatbuffer")) == ""
    assert encodings.ros2_type(Channel("/x", "sensor_msgs/msg/Imu", "json")) == ""


# --- compressedDepth ----------------------------------------------------------------------------

# What compressed_depth_image_transport/src/codec.cpp does with depth on its way into a message.
DEPTH_MAX, DEPTH_QUANTIZATION = 10.0, 100.0


def transported(image_format: str, header: bytes, pixels: np.ndarray) -> bytes:
    fields = {"header": ros1_header(0), "format": image_format, "data": np.frombuffer(header + png(pixels), np.uint8)}
    message = ros1("sensor_msgs/msg/CompressedImage", **fields)
    return bytes(ROS1.serialize_ros1(message, message.__msgtype__))


def read_depth(data: bytes) -> np.ndarray:
    convert = encodings.to_cdr(Channel("/x/compressedDepth", "sensor_msgs/CompressedImage", "ros1"), None)
    assert convert is not None
    return messages.decode_depth(messages.COMPRESSED_IMAGE, convert(data))


@pytest.mark.parametrize("image_format", ["32FC1; compressedDepth", "32FC1; compressedDepth png"])
def test_compressed_depth_in_metres_is_read_to_its_quantisation(image_format: str) -> None:
    metres = np.random.default_rng(0).uniform(0.5, DEPTH_MAX, (HEIGHT, WIDTH)).astype(np.float32)
    a = DEPTH_QUANTIZATION * (DEPTH_QUANTIZATION + 1)
    b = 1 - a / DEPTH_MAX
    inverse = (a / metres + b).astype(np.uint16)  # it cuts off
    metres[0, 0], inverse[0, 0] = 0, 0  # no depth
    read = read_depth(transported(image_format, struct.pack("<iff", 1, a, b), inverse))
    assert read[0, 0] == 0
    step = metres.astype(float) ** 2 / a  # d depth / d inverse
    assert np.all(np.abs(read - metres) <= 1.2 * step + 1e-5)


def test_compressed_depth_in_millimetres_is_read_exactly() -> None:
    millimetres = np.random.default_rng(0).integers(0, 65536, (HEIGHT, WIDTH), dtype=np.uint16)
    read = read_depth(transported("16UC1; compressedDepth png", bytes(12), millimetres))
    np.testing.assert_allclose(read, millimetres / 1000, rtol=1e-6)


@pytest.mark.parametrize(
    ("image_format", "header", "pixels", "reason"),
    [
        ("16UC1; compressedDepth png", b"", grey().astype(np.uint16), "cannot be unpacked"),  # no configuration
        ("16UC1; compressedDepth png", bytes(12), grey(), "one channel of 16 bits"),
        ("16UC1; compressedDepth png", bytes(12), np.zeros((4, 4, 3), np.uint16), "one channel of 16 bits"),
        ("16UC1; compressedDepth rvl", bytes(20), grey().astype(np.uint16), "rvl' cannot be unpacked"),
    ],
)
def test_malformed_compressed_depth_is_a_value_error(
    image_format: str, header: bytes, pixels: np.ndarray, reason: str
) -> None:
    with pytest.raises(ValueError, match=reason):
        read_depth(transported(image_format, header, pixels))


@pytest.mark.parametrize("parameters", [(np.nan, 1.0), (np.inf, 0.0), (0.0, 5.0), (-1.0, 0.0)])
def test_compressed_depth_with_impossible_parameters_has_no_depth(parameters: tuple[float, float]) -> None:
    pixels = np.full((4, 4), 5, np.uint16)
    read = read_depth(transported("32FC1; compressedDepth", struct.pack("<iff", 1, *parameters), pixels))
    np.testing.assert_array_equal(read, 0)
