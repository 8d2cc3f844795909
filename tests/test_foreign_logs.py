"""Logs that other people's software wrote are read, or refused with a reason in one line."""

import json
from pathlib import Path

import numpy as np
import pytest
from log_samples import START, imu_message, write_raw
from mcap.writer import Writer

from fusion_io import messages
from fusion_io.errors import LogError
from fusion_io.messages import ImuSample
from fusion_io.reader import open_log


def refusal(path: Path) -> str:
    with pytest.raises(LogError) as caught:
        open_log(path)
    assert "\n" not in str(caught.value)
    assert str(path) in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize(
    ("name", "reasons"),
    [
        ("nav2_turtlebot.mcap", ["/odom (nav_msgs/msg/Odometry, cdr)", "/amcl_pose"]),
        ("rosbag2_cdr_test.mcap", ["/test_topic (test_msgs/msg/BasicTypes, cdr)"]),
        ("rosbag2_services.mcap", ["/test_service1/_service_event (test_msgs/srv/BasicTypes_Event, cdr)"]),
    ],
)
def test_real_logs_with_nothing_for_us_are_refused_by_what_they_hold(
    shared_data: Path, name: str, reasons: list[str]
) -> None:
    reason = refusal(shared_data / "foreign_mcap" / name)
    assert "nothing to work with" in reason
    assert all(part in reason for part in reasons)


def test_a_real_log_with_two_cameras_is_refused_until_one_is_chosen(shared_data: Path) -> None:
    reason = refusal(shared_data / "foreign_mcap" / "lichtblick_camera_json.mcap")
    assert "2 topics could be the camera info: /camera_calibration, /camera_calibration/custom; choose one" in reason


def test_every_real_log_is_read_or_refused(shared_data: Path) -> None:
    for path in sorted((shared_data / "foreign_mcap").glob("*.mcap")):
        try:
            outcome = str(open_log(path).roles)
        except LogError as error:
            outcome = str(error)
        assert outcome
        assert "\n" not in outcome


def test_a_real_odometry_is_read_as_truth_if_the_caller_says_so(shared_data: Path) -> None:
    """2639 poses of a robot that drives half a metre a second at most, at their own stamps, in one chunk."""
    path = shared_data / "foreign_mcap" / "nav2_turtlebot.mcap"
    log = open_log(path, {"ground_truth": "/odom"})
    truth = log.ground_truth()
    assert len(truth) == 2639
    assert not log.damaged
    assert log.warnings == {}
    speeds = np.linalg.norm(np.diff(truth.poses.translation, axis=0), axis=1) / np.diff(truth.stamps_ns) * 1e9
    assert 0.4 < speeds.max() < 0.5 + 1e-6
    assert open_log(path, {"ground_truth": "/amcl_pose"}).ground_truth() is not None


def test_a_real_log_cut_in_the_middle_of_its_only_chunk_is_read_to_the_cut(shared_data: Path, tmp_path: Path) -> None:
    data = (shared_data / "foreign_mcap" / "nav2_turtlebot.mcap").read_bytes()
    path = tmp_path / "cut.mcap"
    path.write_bytes(data[:200_000])
    log = open_log(path, {"ground_truth": "/odom"})
    assert log.damaged
    assert log.warnings["truncated"] == 1
    assert 500 < len(log.ground_truth()) < 2639


@pytest.mark.parametrize(
    ("message_encoding", "schema_name", "schema_encoding", "data"),
    [
        ("json", "sensor_msgs/msg/Imu", "jsonschema", json.dumps({"angular_velocity": {"x": 1}}).encode()),
        ("protobuf", "foxglove.CompressedImage", "protobuf", b"\x0a\x04abcd"),
        ("ros1", "sensor_msgs/Imu", "ros1msg", bytes(300)),
        ("flatbuffer", "foxglove.RawImage", "flatbuffer", bytes(40)),
    ],
)
def test_encodings_and_messages_that_we_cannot_read_are_named(
    tmp_path: Path, message_encoding: str, schema_name: str, schema_encoding: str, data: bytes
) -> None:
    path = tmp_path / "a.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        schema = writer.register_schema(schema_name, schema_encoding, b"")
        channel = writer.register_channel("/some/topic", message_encoding, schema)
        bare = writer.register_channel("/bare", "", 0)
        writer.add_message(channel, START, data, START)
        writer.add_message(bare, START, data, START)
        writer.finish()
    reason = refusal(path)
    assert f"/some/topic ({schema_name}, {message_encoding})" in reason
    assert "/bare (no schema, )" in reason


def test_a_log_with_many_topics_is_refused_in_a_short_line(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        for i in range(100):
            writer.add_message(writer.register_channel(f"/topic/{i}", "json", 0), START, b"{}", START)
        writer.finish()
    assert refusal(path).endswith("and 92 more")


def test_what_we_can_read_is_read_beside_what_we_cannot(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        lidar = writer.register_channel("/lidar", "json", writer.register_schema("Lidar", "jsonschema", b"{}"))
        definition = messages.schema_text(messages.IMU).encode()
        # The same topic from two senders, as two channels.
        senders = [
            writer.register_channel("/imu", "cdr", writer.register_schema(messages.IMU, "ros2msg", definition))
            for _ in range(2)
        ]
        for i in range(10):
            writer.add_message(lidar, START + i, b"{}", START)
            data = messages.encode_imu(START + i, ImuSample(np.ones(3), np.ones(3)))
            writer.add_message(senders[i % 2], START + i, data, START)
        writer.finish()
    log = open_log(path)
    assert log.roles == {"imu": "/imu"}
    np.testing.assert_array_equal(log.imu().stamps_ns, START + np.arange(10))
    assert log.warnings == {}


def test_big_endian_messages_are_read(tmp_path: Path) -> None:
    message = messages.TYPESTORE.deserialize_cdr(
        messages.encode_imu(START, ImuSample(np.arange(3.0), np.arange(3.0) + 5)), messages.IMU
    )
    big = bytes(messages.TYPESTORE.serialize_cdr(message, messages.IMU, little_endian=False))
    series = open_log(write_raw(tmp_path / "a.mcap", [("/imu", messages.IMU, START, big)])).imu()
    assert series.stamps_ns[0] == START
    np.testing.assert_array_equal(series.linear_acceleration, [[5, 6, 7]])


def test_topics_without_messages_are_no_candidates(tmp_path: Path) -> None:
    items = [imu_message("/a", START, ImuSample(np.ones(3), np.ones(3)))]
    path = tmp_path / "a.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        schema = writer.register_schema(messages.IMU, "ros2msg", messages.schema_text(messages.IMU).encode())
        writer.register_channel("/b", "cdr", schema)
        writer.add_message(writer.register_channel("/a", "cdr", schema), START, items[0][3], START)
        writer.finish()
    assert open_log(path).roles == {"imu": "/a"}
