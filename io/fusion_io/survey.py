"""Every topic of a log, whether it plays a role or not: its times, and what it holds if we can read it."""

from __future__ import annotations

from array import array
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
from mcap.records import Schema
from numpy.typing import NDArray

from fusion_io import encodings, inertial, messages, roles
from fusion_io.container import Channel, Contents, MessageFile, MessageIndex
from fusion_io.progress import track
from fusion_io.records import FloatArray, IntArray

_TRIED_MESSAGES = 10
_HEADERS = {"std_msgs/Header", "std_msgs/msg/Header", "Header"}

_T = TypeVar("_T")


@dataclass(frozen=True, slots=True)
class Times:
    """When the messages of a topic were measured and recorded, in order of recording; (N,) ns each.

    stamps_ns is None where the messages have no stamps, or none of them is set; 0 is a stamp that is not set.
    """

    stamps_ns: IntArray | None
    log_times_ns: IntArray


@dataclass(frozen=True, slots=True)
class ImuReadings:
    """What an IMU topic holds in order of time: stamps_ns (N,), and (N, 3) each in rad/s and m/s^2 if it has them.

    The standard deviations are those that the messages state, None where they do not.
    """

    stamps_ns: IntArray
    angular_velocity: FloatArray | None
    linear_acceleration: FloatArray | None
    angular_velocity_std: float | None = None
    linear_acceleration_std: float | None = None


class Survey:
    """Looks into the topics of a log one by one.

    Attributes:
        channels: By topic; of several channels with the same topic, the last.
        kinds: By topic, what it holds: a role of ``roles``, or "" for what we cannot read or have no use for.

    """

    def __init__(self, path: Path, contents: Contents):
        self._path = path
        self._contents = contents
        self.channels: Mapping[str, Channel] = {channel.topic: channel for channel in contents.counts}
        self._indices = {topic: self._indexed(channel) for topic, channel in self.channels.items()}
        self.kinds = {topic: self._kind(channel) for topic, channel in self.channels.items()}

    def times(self, topic: str) -> Times:
        """When its messages were measured and recorded."""
        index = self._indices[topic]
        stamped = _has_header(self.channels[topic], self._contents.schemas.get(self.channels[topic]))
        return Times(index.stamps_ns if stamped and np.any(index.stamps_ns) else None, index.log_times_ns)

    def stamps(self, topic: str) -> IntArray:
        """Stamps (N,) of its messages in order of recording; log times where they have none."""
        times = self.times(topic)
        return times.log_times_ns if times.stamps_ns is None else times.stamps_ns

    def imu(self, topic: str) -> ImuReadings:
        """What a topic of kind imu, gyro or accelerometer holds; messages that cannot be used are left out."""
        index, stamps = self._indices[topic], self.stamps(topic)
        times, columns = array("q"), array("d")
        with self._open() as file:
            for i, stamp in track(enumerate(stamps.tolist()), topic, len(stamps)):
                try:
                    sample = messages.decode_imu(file.read(index, i))
                except ValueError:
                    continue
                times.append(stamp)
                columns.extend(sample.angular_velocity)
                columns.extend(sample.linear_acceleration)
                columns.append(sample.angular_velocity_std or np.nan)
                columns.append(sample.linear_acceleration_std or np.nan)
        found, values = np.array(times, dtype=np.int64), np.array(columns).reshape(-1, 8)
        wanted = {"gyro": slice(0, 3), "accelerometer": slice(3, 6)}.get(self.kinds[topic], slice(0, 6))
        usable = np.flatnonzero(inertial.measurable(values[:, wanted]))
        kept = usable[inertial.longest_increasing(found[usable])]
        values = values[kept]
        return ImuReadings(
            found[kept],
            values[:, 0:3] if wanted.start == 0 else None,
            values[:, 3:6] if wanted.stop == 6 else None,
            _median(values[:, 6]),
            _median(values[:, 7]),
        )

    def images(self, topic: str, count: int) -> Iterator[tuple[int, NDArray[np.uint8]]]:
        """Stamps and images of about so many messages spread evenly over a topic; unreadable ones are left out."""
        yield from self._sampled(topic, count, messages.decode_image)

    def depths(self, topic: str, count: int) -> Iterator[tuple[int, NDArray[np.float32]]]:
        """Stamps and depth, in metres and 0 where there is none, as ``images``."""
        yield from self._sampled(topic, count, messages.decode_depth)

    def _sampled(
        self, topic: str, count: int, decode: Callable[[str, bytes | memoryview], _T]
    ) -> Iterator[tuple[int, _T]]:
        message_type = encodings.ros2_type(self.channels[topic])
        index, stamps = self._indices[topic], self.stamps(topic)
        chosen = np.unique(np.linspace(0, len(index) - 1, min(count, len(index))).astype(int))
        with self._open() as file:
            for i in chosen.tolist():
                try:
                    decoded = decode(message_type, file.read(index, i))
                except ValueError:
                    continue
                yield int(stamps[i]), decoded

    def _indexed(self, channel: Channel) -> MessageIndex:
        if encodings.ros2_type(channel) not in roles.READABLE_TYPES:
            return self._contents.index[channel.topic]
        with self._open() as file:
            return encodings.stamped(file, encodings.in_cdr(self._contents, channel))

    def _kind(self, channel: Channel) -> str:
        """What the first message says that can be read."""
        message_type, index = encodings.ros2_type(channel), self._indices[channel.topic]
        if message_type not in roles.READABLE_TYPES:
            return ""
        with self._open() as file:
            for i in range(min(len(index), _TRIED_MESSAGES)):
                try:
                    return roles.kind_of(channel.topic, message_type, file.read(index, i))
                except ValueError:
                    continue
        return ""

    def _open(self) -> MessageFile:
        return MessageFile(self._path, self._contents.blocks)


def _has_header(channel: Channel, schema: Schema | None) -> bool:
    """Whether a message begins with a stamp that we can read."""
    message_type = encodings.ros2_type(channel)
    if message_type in roles.READABLE_TYPES:
        return message_type != messages.TRANSFORMS
    if channel.message_encoding != messages.MESSAGE_ENCODING or schema is None:
        return False
    return _first_field(schema.data.decode("utf-8", "replace")) in _HEADERS


def _first_field(definition: str) -> str:
    """The type of the first field of a ROS message definition, "" where it has none."""
    for line in definition.splitlines():
        words = line.partition("#")[0].split()
        if words and "=" not in line.partition("#")[0]:  # a line with = is a constant
            return words[0]
    return ""


def _median(values: FloatArray) -> float | None:
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else None
