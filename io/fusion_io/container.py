"""What an MCAP file holds and where, and how to fetch a message from it.

``recovery.scan`` finds it out. Messages are fetched by their place, so that they can be read in any order, without an
index in the file and without holding more than a few chunks in memory. Format: https://mcap.dev/spec.
"""

from __future__ import annotations

import functools
import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import TracebackType
from typing import NamedTuple

import lz4.frame
import numpy as np
import zstandard
from mcap.records import Schema
from numpy.typing import NDArray

from fusion_io.errors import LogError
from fusion_io.records import IntArray
from fusion_io.words import counted

RECORD = struct.Struct("<BQ")  # opcode, length of the contents
MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time; then the data

_CACHED_BLOCKS = 4

#: Brings a message of another encoding into ROS 2's CDR; it raises ValueError for one that is malformed.
ToCdr = Callable[[bytes | memoryview], bytes | memoryview]


class Channel(NamedTuple):
    """A topic, and how its messages are to be read."""

    topic: str
    message_type: str
    message_encoding: str


class Block(NamedTuple):
    """A stretch of the file that unpacks to records: the contents of a chunk, or messages that stand outside of one."""

    offset: int
    length: int
    compression: str


@dataclass(frozen=True, slots=True)
class MessageIndex:
    """The messages of a topic in order of recording: header stamps, log times (ns) and places, (N,) each.

    A stamp is 0 where the header has none, and means nothing for messages without a header. ``to_cdr``: what the
    messages have to pass when they are fetched, None where they are ROS 2's already.
    """

    stamps_ns: IntArray
    log_times_ns: IntArray
    blocks: IntArray
    offsets: IntArray
    to_cdr: ToCdr | None = None

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def __getitem__(self, selection: IntArray | NDArray[np.bool_]) -> MessageIndex:
        return replace(
            self,
            stamps_ns=self.stamps_ns[selection],
            log_times_ns=self.log_times_ns[selection],
            blocks=self.blocks[selection],
            offsets=self.offsets[selection],
        )


class Damage(NamedTuple):
    """A fault of the file: the counter it belongs to, and a line about it."""

    name: str
    note: str


@dataclass(frozen=True, slots=True)
class Contents:
    """All that was found in a file.

    ``counts`` has every channel with messages, ``schemas`` the definition of their messages where there is one;
    ``index``, by topic, those that were asked for. ``messages_lost`` is what the file itself says it once held, less
    what could be read.
    """

    counts: Mapping[Channel, int]
    schemas: Mapping[Channel, Schema]
    index: Mapping[str, MessageIndex]
    blocks: Sequence[Block]
    metadata: dict[str, dict[str, str]]
    damage: Sequence[Damage]
    messages_lost: int

    def faults(self, path: Path) -> list[str]:
        """A line for all that is wrong with the file; none where it is as it was written."""
        lost = counted(self.messages_lost, "message")
        return [
            *(each.note for each in self.damage),
            *([f"{path}: {lost} that it once held cannot be read"] if self.messages_lost else []),
        ]


class MessageFile:
    """Fetches messages; keeps the last few blocks unpacked, so that reading in order of time is cheap."""

    def __init__(self, path: Path, blocks: Sequence[Block]):
        self._path = path
        self._blocks = blocks
        self._unpacked = functools.lru_cache(maxsize=_CACHED_BLOCKS)(self._unpack)

    def __enter__(self) -> MessageFile:
        self._file = self._path.open("rb")
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._file.close()

    def read(self, index: MessageIndex, i: int) -> bytes | memoryview:
        """The data of the i-th message of an index; ValueError where it has to be brought into CDR and cannot be."""
        contents = memoryview(self._unpacked(int(index.blocks[i])))
        start = int(index.offsets[i]) + RECORD.size
        _, length = RECORD.unpack_from(contents, start - RECORD.size)
        data = contents[start + MESSAGE.size : start + length]
        return index.to_cdr(data) if index.to_cdr else data

    def _unpack(self, number: int) -> bytes:
        block = self._blocks[number]
        self._file.seek(block.offset)
        try:
            return unpack(block.compression, self._file.read(block.length))
        except ValueError as error:
            raise LogError(f"{self._path}: the file has changed while it was read ({error})") from error


def unpack(compression: str, packed: bytes) -> bytes:
    """The contents of a chunk; of a chunk that is cut short, what can be had.

    Raises:
        ValueError: these bytes are not what the compression makes, or it is not one of the format's.

    """
    try:
        match compression:
            case "":
                return packed
            case "zstd":
                return zstandard.ZstdDecompressor().decompressobj().decompress(packed)
            case "lz4":
                return bytes(lz4.frame.LZ4FrameDecompressor().decompress(packed))
    except (zstandard.ZstdError, RuntimeError) as error:
        raise ValueError(f"it cannot be unpacked: {error}") from error
    raise ValueError(f"compression {compression!r} is unknown")


def split_records(contents: bytes) -> Iterator[tuple[int, int, int, int]]:
    """Opcode, first byte, and first and last byte of the body of every whole record."""
    position = 0
    while position + RECORD.size <= len(contents):
        opcode, length = RECORD.unpack_from(contents, position)
        start = position + RECORD.size
        end = start + length
        if end > len(contents):
            return
        yield opcode, position, start, end
        position = end
