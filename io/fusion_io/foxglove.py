"""Foxglove's camera messages, as JSON or protobuf, brought into the ROS 2 messages that say the same.

Message definitions: https://docs.foxglove.dev/docs/sdk/schemas. The fields are found by name: a JSON message carries
their names, and a protobuf log carries the definition of its messages.
"""

from __future__ import annotations

import base64
import json
import struct
from collections.abc import Callable, Sequence
from types import SimpleNamespace
from typing import Any

import numpy as np
from google.protobuf.message import DecodeError
from mcap.exceptions import McapError
from mcap.records import Schema
from mcap_protobuf.decoder import DecoderFactory
from rosbags.serde import SerdeError

from fusion_io import messages
from fusion_io.records import NANOSECONDS, FloatArray

JSON = "json"
PROTOBUF = "protobuf"

# Foxglove's name for OpenCV's fisheye model is another than that of sensor_msgs/distortion_models.hpp.
_DISTORTION_MODELS = {"kannala_brandt": "equidistant"}

# What comes of fields that are not there, or hold something else than they should.
_MALFORMED = (AttributeError, TypeError, ValueError, OverflowError, struct.error, SerdeError, DecodeError)


def to_cdr(message_encoding: str, schema: Schema) -> Callable[[bytes | memoryview], bytes]:
    """What brings the messages of a schema of ``MESSAGE_TYPES`` into CDR; it raises ValueError for a malformed one."""
    read = _read_json if message_encoding == JSON else _protobuf_reader(schema)
    build = _BUILDERS[schema.name]

    def convert(data: bytes | memoryview) -> bytes:
        try:
            return build(read(bytes(data)))
        except _MALFORMED as error:
            raise ValueError(f"a message of {schema.name} as {message_encoding} cannot be decoded: {error}") from error

    return convert


# --- Fields by name -----------------------------------------------------------------------------


def _read_json(data: bytes) -> Any:
    return json.loads(data, object_hook=lambda fields: SimpleNamespace(**fields))


def _protobuf_reader(schema: Schema) -> Callable[[bytes], Any]:
    """Decodes messages by the definition in the log; where that is unusable, every message is malformed."""
    try:
        decoder = DecoderFactory().decoder_for(PROTOBUF, schema)
    except (McapError, DecodeError, TypeError) as error:
        return _refusing(str(error))
    return decoder or _refusing(f"its definition is {schema.encoding or 'not given'}")


def _refusing(reason: str) -> Callable[[bytes], Any]:
    def refuse(data: bytes) -> Any:
        raise ValueError(reason)

    return refuse


def _stamp_ns(message: Any) -> int:
    """The time of a message: ``nsec`` in JSON, ``nanos`` in protobuf."""
    time = message.timestamp
    seconds, nanoseconds = (time.sec, time.nsec) if hasattr(time, "sec") else (time.seconds, time.nanos)
    if not (0 <= seconds < 2**31 and 0 <= nanoseconds < NANOSECONDS):
        raise ValueError(f"a time of {seconds} s and {nanoseconds} ns")
    return int(seconds) * NANOSECONDS + int(nanoseconds)


def _bytes(data: str | bytes) -> np.typing.NDArray[np.uint8]:
    """A field of bytes, which JSON has as base64."""
    return np.frombuffer(base64.b64decode(data, validate=True) if isinstance(data, str) else data, dtype=np.uint8)


def _matrix(name: str, values: Sequence[float], size: int) -> FloatArray:
    """A row-major matrix; one that is not given is zero."""
    if len(values) not in {0, size}:
        raise ValueError(f"{name} has {len(values)} numbers, not {size}")
    return np.array(values, dtype=np.float64) if len(values) else np.zeros(size)


# --- Messages -----------------------------------------------------------------------------------


def _compressed_image(message: Any) -> bytes:
    return _serialise(
        messages.COMPRESSED_IMAGE, header=_header(message), format=message.format, data=_bytes(message.data)
    )


def _raw_image(message: Any) -> bytes:
    return _serialise(
        messages.IMAGE,
        header=_header(message),
        height=message.height,
        width=message.width,
        encoding=message.encoding,
        is_bigendian=0,
        step=message.step,
        data=_bytes(message.data),
    )


def _camera_calibration(message: Any) -> bytes:
    whole = _new("sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
    return _serialise(
        messages.CAMERA_INFO,
        header=_header(message),
        height=message.height,
        width=message.width,
        distortion_model=_DISTORTION_MODELS.get(message.distortion_model, message.distortion_model),
        d=np.array(message.D, dtype=np.float64),
        k=_matrix("K", message.K, 9),
        r=_matrix("R", message.R, 9),
        p=_matrix("P", message.P, 12),
        binning_x=0,
        binning_y=0,
        roi=whole,
    )


def _pose_in_frame(message: Any) -> bytes:
    p, q = message.pose.position, message.pose.orientation
    pose = messages.PoseSample(np.array([p.x, p.y, p.z], dtype=float), np.array([q.w, q.x, q.y, q.z], dtype=float))
    return messages.encode_pose(_stamp_ns(message), pose, message.frame_id)


def _header(message: Any) -> Any:
    seconds, nanoseconds = divmod(_stamp_ns(message), NANOSECONDS)
    time = _new("builtin_interfaces/msg/Time", sec=seconds, nanosec=nanoseconds)
    return _new("std_msgs/msg/Header", stamp=time, frame_id=message.frame_id)


def _new(type_name: str, **fields: Any) -> Any:
    return messages.TYPESTORE.types[type_name](**fields)


def _serialise(type_name: str, **fields: Any) -> bytes:
    return bytes(messages.TYPESTORE.serialize_cdr(_new(type_name, **fields), type_name))


_BUILDERS: dict[str, Callable[[Any], bytes]] = {
    "foxglove.CompressedImage": _compressed_image,
    "foxglove.RawImage": _raw_image,
    "foxglove.CameraCalibration": _camera_calibration,
    "foxglove.PoseInFrame": _pose_in_frame,
}

#: Foxglove's messages that can be read, and the ROS 2 message that says the same.
MESSAGE_TYPES = {
    "foxglove.CompressedImage": messages.COMPRESSED_IMAGE,
    "foxglove.RawImage": messages.IMAGE,
    "foxglove.CameraCalibration": messages.CAMERA_INFO,
    "foxglove.PoseInFrame": messages.POSE_STAMPED,
}
