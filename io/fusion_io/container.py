"""MCAP files in whatever state they are: what a file holds, where each message is, and what was lost.

One pass over the file reads every chunk, checks its CRC and notes the place of each message, so that messages can be
fetched in any order afterwards without an index in the file, and without holding more than a few chunks in memory.
Format: https://mcap.dev/spec. ``mcap``'s own readers stop at the first fault, which is why the records are walked here:

* a chunk whose contents fail their check is left out, and the next one is read;
* a record whose length cannot be right is left behind by searching for the next chunk;
* a file that ends too early is read to its last whole message, also within the last chunk.
"""

from __future__ import annotations

import functools
import mmap
import re
import struct
import zlib
from array import array
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from types import TracebackType
from typing import IO, NamedTuple

import lz4.frame
import numpy as np
import zstandard
from mcap import records
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.writer import MCAP0_MAGIC
from numpy.typing import NDArray

from fusion_io.errors import LogError
from fusion_io.messages import header_stamp
from fusion_io.records import NANOSECONDS, IntArray

_RECORD = struct.Struct("<BQ")  # opcode, length of the contents
_MESSAGE = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time; then the data
_CHUNK = struct.Struct("<QQQII")  # first and last log time, size and CRC of the contents, length of the next string
_LENGTH = struct.Struct("<Q")
_CHUNK_START = re.compile(
    rb"\x06(?=.{8}.{28}(?:\x04\x00{3}zstd|\x03\x00{3}lz4|\x00{4}))", re.DOTALL
)  # what a chunk begins with, in each of the format's compressions

_MAX_DEFINITION_BYTES = 1 << 26  # records other than chunks, messages and attachments are small
_LOOSE_BLOCK_BYTES = 1 << 20
_CACHED_BLOCKS = 4
_STAMP_BYTES = 12


class Channel(NamedTuple):
    """A topic of one sender, and how its messages are to be read."""

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

    A stamp is 0 where the header has none; it means nothing for messages without a header.
    """

    stamps_ns: IntArray
    log_times_ns: IntArray
    blocks: IntArray
    offsets: IntArray

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def __getitem__(self, selection: IntArray | NDArray[np.bool_]) -> MessageIndex:
        return MessageIndex(
            self.stamps_ns[selection], self.log_times_ns[selection], self.blocks[selection], self.offsets[selection]
        )


@dataclass(frozen=True, slots=True)
class Damage:
    """A fault of the file: the counter it goes under, and a line about it."""

    name: str
    note: str


@dataclass(frozen=True, slots=True)
class Contents:
    """What a pass over the file found. ``counts`` has every topic, ``index`` those of the wanted message types."""

    channels: Mapping[str, Channel]
    counts: Mapping[str, int]
    index: Mapping[str, MessageIndex]
    blocks: Sequence[Block]
    metadata: dict[str, dict[str, str]]
    damage: Sequence[Damage]
    messages_lost: int


def scan(path: Path, wanted: Callable[[Channel], bool]) -> Contents:
    """Read the whole file once; ``wanted`` says which channels are to be indexed.

    Raises:
        LogError: the file does not exist, is empty, or is not an MCAP file.

    """
    try:
        with path.open("rb") as file:
            magic = file.read(len(MCAP0_MAGIC))
            if not magic:
                raise LogError(f"{path}: the file is empty")
            if magic != MCAP0_MAGIC:
                raise LogError(f"{path}: not an MCAP file (it begins with {magic!r})")
            return _Scan(path, file, wanted).run()
    except OSError as error:
        raise LogError(f"{path}: cannot be read: {error.strerror or error}") from error


class MessageFile:
    """Fetches messages by their place; keeps the last few blocks, so that reading in order of time is cheap."""

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

    def read(self, block: int, offset: int) -> memoryview:
        """The data of one message."""
        data = self._unpacked(int(block))
        _, length = _RECORD.unpack_from(data, offset)
        start = int(offset) + _RECORD.size
        return memoryview(data)[start + _MESSAGE.size : start + length]

    def _unpack(self, number: int) -> bytes:
        block = self._blocks[number]
        self._file.seek(block.offset)
        return _decompress(block.compression, self._file.read(block.length))


class _BrokenRecord(Exception):
    """A record that cannot be what it says."""


class _ChunkHeader(NamedTuple):
    start_ns: int
    end_ns: int
    crc: int
    block: Block
    end: int  # of the record


@dataclass(slots=True)
class _Entries:
    """A message index that grows."""

    stamps: array[int] = field(default_factory=lambda: array("q"))
    log_times: array[int] = field(default_factory=lambda: array("Q"))
    blocks: array[int] = field(default_factory=lambda: array("I"))
    offsets: array[int] = field(default_factory=lambda: array("Q"))

    def finished(self) -> MessageIndex:
        columns = (self.stamps, self.log_times, self.blocks, self.offsets)
        return MessageIndex(*(np.array(column, dtype=np.int64) for column in columns))


@dataclass(slots=True)
class _BadChunk:
    where: str
    reason: str
    messages: int = 0


class _Scan:
    """The state of one pass."""

    def __init__(self, path: Path, file: IO[bytes], wanted: Callable[[Channel], bool]):
        self._path = path
        self._file = file
        self._size = path.stat().st_size
        self._wanted = wanted
        self._schemas: dict[int, records.Schema] = {}
        self._channels: dict[int, records.Channel] = {}
        self._indexed: dict[int, bool] = {}
        self._counts: dict[int, int] = {}
        self._entries: dict[int, _Entries] = {}
        self._blocks: list[Block] = []
        self._loose_start = self._loose_end = 0
        self._metadata: dict[str, dict[str, str]] = {}
        self._statistics: records.Statistics | None = None
        self._bad_chunks: list[_BadChunk] = []
        self._last_was_bad = False
        self._damage: list[Damage] = []
        self._data_complete = self._finished = False

    def run(self) -> Contents:
        self._walk()
        self._close_loose_block()
        lost = self._messages_lost()
        for chunk in self._bad_chunks:
            count = f", {chunk.messages} messages lost" if chunk.messages else ""
            self._note("bad_chunks", f"the chunk {chunk.where} is damaged ({chunk.reason}){count}")
        return Contents(**self._by_topic(), blocks=self._blocks, metadata=self._metadata, damage=self._damage, messages_lost=lost)

    # --- Walking the file -----------------------------------------------------------------------

    def _walk(self) -> None:
        previous = position = len(MCAP0_MAGIC)
        while not self._finished:
            try:
                previous, position = position, self._read_record(position)
            except _BrokenRecord as broken:
                following = self._find_chunk(previous + 1)
                if following is None or self._data_complete:
                    self._note_early_end(position)
                    return
                self._note("bad_records", f"the record at byte {position} is damaged ({broken}); reading goes on at byte {following}")
                position = following
