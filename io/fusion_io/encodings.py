"""The ways of writing messages that we read: ROS 2, ROS 1, and Foxglove's camera messages as JSON and protobuf.

All are brought into ROS 2's CDR when a message is fetched, so that everything else knows ROS 2 alone.
"""

from __future__ import annotations

import contextlib
import struct
from dataclasses import replace

import numpy as np
from mcap.records import Schema
from rosbags.serde import SerdeError

from fusion_io import messages
from fusion_io.container import Channel, Contents, MessageFile, MessageIndex, ToCdr

ROS1 = "ros1"
_FOXGLOVE = ("json", "protobuf")


def ros2_type(channel: Channel) -> str:
    """The ROS 2 message that a channel's messages can be brought into, "" where there is none."""
    if channel.message_encoding == messages.MESSAGE_ENCODING:
        return channel.message_type
    if channel.message_encoding == ROS1:
        return "/msg/".join(channel.message_type.split("/"))
    if channel.message_encoding in _FOXGLOVE and channel.message_type.startswith("foxglove."):
        from fusion_io import foxglove  # protobuf is not needed for ROS

        return foxglove.MESSAGE_TYPES.get(channel.message_type, "")
    return ""


def to_cdr(channel: Channel, schema: Schema | None) -> ToCdr | None:
    """What brings a channel's messages into CDR; None where they are already.

    It raises ValueError for a message that is malformed.
    """
    if channel.message_encoding == ROS1:
        return _ros1_to_cdr(ros2_type(channel))
    if channel.message_encoding in _FOXGLOVE and schema:
        from fusion_io import foxglove

        return foxglove.to_cdr(channel.message_encoding, schema)
    return None


def in_cdr(contents: Contents, channel: Channel) -> MessageIndex:
    """The messages of a channel, which are fetched as CDR."""
    return replace(contents.index[channel.topic], to_cdr=to_cdr(channel, contents.schemas.get(channel)))


def stamped(file: MessageFile, index: MessageIndex) -> MessageIndex:
    """The index with the stamps in its messages, which for those that are not ROS 2's only decoding tells."""
    if index.to_cdr is None:
        return index
    stamps = np.zeros(len(index), dtype=np.int64)
    for i in range(len(index)):
        with contextlib.suppress(ValueError, struct.error):  # it is counted when it is read
            stamps[i] = messages.header_stamp(file.read(index, i))
    return replace(index, stamps_ns=stamps)


def _ros1_to_cdr(type_name: str) -> ToCdr:
    """The fields are those of ROS 2 but for the header's ``seq``, which rosbags leaves out."""

    def convert(data: bytes | memoryview) -> bytes:
        try:
            return bytes(messages.TYPESTORE.ros1_to_cdr(data, type_name))
        except (SerdeError, struct.error, IndexError) as error:
            raise ValueError(f"a ROS 1 message of {type_name} cannot be decoded: {error}") from error

    return convert
