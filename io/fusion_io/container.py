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
        self._counts: dict[int, int] = {}
        self._entries: dict[int, _Entries] = {}
        self._unwanted: set[int] = set()
        self._blocks: list[Block] = []
        self._loose: tuple[int, int] | None = None  # start and end of messages that stand outside of a chunk
        self._metadata: dict[str, dict[str, str]] = {}
        self._statistics: records.Statistics | None = None
        self._bad_chunks: list[_BadChunk] = []
        self._after_bad_chunk = False
        self._damage: list[Damage] = []
        self._data_complete = False
        self._at_end = False

    def run(self) -> Contents:
        self._walk()
        self._close_loose_block()
        lost = self._messages_lost()
        for chunk in self._bad_chunks:
            count = f", {chunk.messages} messages lost" if chunk.messages else ""
            self._note("bad_chunks", f"the chunk {chunk.where} is damaged ({chunk.reason}){count}")
        channels = {id: self._channel(channel) for id, channel in self._channels.items()}
        topics = {channel.topic: channel for channel in reversed(channels.values())}
        by_topic = {
            topic: [id for id in channels if channels[id] == channel and id in self._counts]
            for topic, channel in topics.items()
        }
        return Contents(
            channels=topics,
            counts={topic: sum(self._counts[id] for id in ids) for topic, ids in by_topic.items()},
            index={
                topic: _merged([self._entries[id].finished() for id in ids])
                for topic, ids in by_topic.items()
                if self._wanted(topics[topic])
            },
            blocks=self._blocks,
            metadata=self._metadata,
            damage=self._damage,
            messages_lost=lost,
        )

    # --- Walking the file -----------------------------------------------------------------------

    def _walk(self) -> None:
        previous = position = len(MCAP0_MAGIC)
        while not self._at_end:
            try:
                previous, position = position, self._read_record(position)
            except _BrokenRecordError as broken:
                # The record before may already have had a wrong length: what it skipped is searched too.
                following = None if self._data_complete else self._find_chunk(previous + 1)
                if following is None:
                    self._note_early_end(position)
                    return
                self._note("bad_records", f"the record at byte {position} is damaged ({broken}), see byte {following}")
                position = following

    def _read_record(self, position: int) -> int:
        """Read what begins at this byte; returns where it ends."""
        self._file.seek(position)
        head = self._file.read(_RECORD.size)
        if len(head) < _RECORD.size:
            raise _BrokenRecordError("the file ends")
        opcode, length = _RECORD.unpack(head)
        start, end = position + _RECORD.size, position + _RECORD.size + length
        if opcode == Opcode.CHUNK:
            return self._read_chunk(position)
        if opcode == 0 or end > self._size:
            raise _BrokenRecordError(f"opcode {opcode}, {length} bytes")
        if opcode == Opcode.MESSAGE:
            self._extend_loose_block(position, end)
        elif opcode in _DEFINITIONS:
            if length > _MAX_DEFINITION_BYTES:
                raise _BrokenRecordError(f"{length} bytes")
            self._read_definition(opcode, self._file.read(length))
        elif opcode == Opcode.DATA_END:
            self._data_complete = True
        elif opcode == Opcode.FOOTER:
            self._read_footer(start)
        self._after_bad_chunk &= opcode == Opcode.MESSAGE_INDEX
        return end

    def _read_definition(self, opcode: int, body: bytes) -> None:
        """Records that say what is in the file. Those met first hold: the summary only repeats them."""
        try:
            stream = ReadDataStream(BytesIO(body))
            match opcode:
                case Opcode.SCHEMA:
                    schema = records.Schema.read(stream)
                    self._schemas.setdefault(schema.id, schema)
                case Opcode.CHANNEL:
                    channel = records.Channel.read(stream)
                    self._channels.setdefault(channel.id, channel)
                case Opcode.METADATA:
                    metadata = records.Metadata.read(stream)
                    self._metadata[metadata.name] = metadata.metadata
                case Opcode.STATISTICS:
                    self._statistics = records.Statistics.read(stream)
                case Opcode.MESSAGE_INDEX if self._after_bad_chunk:
                    self._bad_chunks[-1].messages += len(records.MessageIndex.read(stream).records)
        except (McapError, struct.error, ValueError) as error:
            raise _BrokenRecordError(str(error) or "its contents end early") from error

    def _read_footer(self, start: int) -> None:
        """The last record: checks the summary and the magic bytes that follow."""
        body = self._file.read(_FOOTER.size)
        if len(body) < _FOOTER.size:
            raise _BrokenRecordError("the file ends")
        summary_start, _, expected = _FOOTER.unpack(body)
        checked_end = start + _FOOTER.size - 4
        if self._file.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC or (
            expected and summary_start and self._crc(summary_start, checked_end) != expected
        ):
            self._statistics = None
            self._note("bad_summary", "the summary at the end of the file is damaged")
        self._at_end = True

    def _crc(self, start: int, end: int) -> int:
        self._file.seek(start)
        crc = 0
        for position in range(start, end, _LOOSE_BLOCK_BYTES):
            crc = zlib.crc32(self._file.read(min(_LOOSE_BLOCK_BYTES, end - position)), crc)
        return crc

    # --- Chunks ---------------------------------------------------------------------------------

    def _read_chunk(self, position: int) -> int:
        header = self._chunk_header(position)
        if header is None:
            raise _BrokenRecordError("a chunk whose lengths contradict each other")
        cut = header.end > self._size
        self._file.seek(header.block.offset)
        packed = self._file.read(header.block.length)
        self._after_bad_chunk = False
        try:
            data = _decompress(header.block.compression, packed)
            if not cut and header.crc and zlib.crc32(data) != header.crc:
                raise ValueError("its checksum is wrong")
            self._index_block(header.block, data, whole=not cut)
        except ValueError as error:
            self._bad_chunks.append(_BadChunk(f"at byte {position} ({_time_range(header)})", str(error)))
            self._after_bad_chunk = True
        if cut:
            self._note_early_end(position)
            self._at_end = True
        return header.end

    def _chunk_header(self, position: int) -> _ChunkHeader | None:
        """The chunk that begins at this byte, or None if none does: it says its length twice."""
        self._file.seek(position)
        head = self._file.read(_RECORD.size + _CHUNK.size + _MAX_COMPRESSION_NAME + _LENGTH.size)
        try:
            _, length = _RECORD.unpack_from(head)
            start_ns, end_ns, _, crc, name_length = _CHUNK.unpack_from(head, _RECORD.size)
            name_end = _RECORD.size + _CHUNK.size + name_length
            compression = head[name_end - name_length : name_end].decode("ascii")
            (data_length,) = _LENGTH.unpack_from(head, name_end)
        except (struct.error, UnicodeDecodeError):
            return None
        data_start = name_end + _LENGTH.size
        if _RECORD.size + length != data_start + data_length:
            return None
        block = Block(position + data_start, data_length, compression)
        return _ChunkHeader(start_ns, end_ns, crc, block, block.offset + block.length)

    def _find_chunk(self, position: int) -> int | None:
        """The first byte from here on where a chunk begins."""
        with mmap.mmap(self._file.fileno(), 0, access=mmap.ACCESS_READ) as view:
            for match in _CHUNK_START.finditer(view, position):
                if self._chunk_header(match.start()) is not None:
                    return match.start()
        return None

    # --- Messages -------------------------------------------------------------------------------

    def _index_block(self, block: Block, data: bytes, whole: bool = True) -> None:
        """Note the messages of a block; ``whole`` is False where its end is known to be missing.

        Raises:
            ValueError: the block does not consist of records.

        """
        number = len(self._blocks)
        self._blocks.append(block)
        position = 0
        for opcode, position, start, end in _split_records(data):
            if opcode == Opcode.MESSAGE:
                self._add_message(data, number, position, start, end)
            elif opcode in _DEFINITIONS:
                self._read_definition(opcode, data[start:end])

    def _add_message(self, data: bytes, block: int, position: int, start: int, end: int) -> None:
        channel, _, log_time, _ = _MESSAGE.unpack_from(data, start)
        self._counts[channel] = self._counts.get(channel, 0) + 1
        if channel in self._unwanted:
            return
        if channel not in self._entries and channel in self._channels and not self._wanted(self._channel(self._channels[channel])):
            self._unwanted.add(channel)
            return
