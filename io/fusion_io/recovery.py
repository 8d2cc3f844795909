"""Finding out what is in an MCAP file, in whatever state it is.

One pass over the file reads every chunk, checks its CRC and notes the place of every message. ``mcap``'s own readers
stop at the first fault, so the records are walked here:

* a chunk whose contents fail their check is left out, and the next one is read;
* a record whose length cannot be right is left behind by searching for the next chunk;
* a file that ends too early is read to its last whole message, also within the last chunk.
"""

from __future__ import annotations

import mmap
import re
import struct
import zlib
from array import array
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import IO, NamedTuple

import numpy as np
from mcap import records
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.writer import MCAP0_MAGIC

from fusion_io.container import MESSAGE, RECORD, Block, Channel, Contents, Damage, MessageIndex, split_records, unpack
from fusion_io.errors import LogError
from fusion_io.messages import header_stamp
from fusion_io.records import NANOSECONDS
from fusion_io.words import counted

_CHUNK = struct.Struct("<QQQII")  # first and last log time, size and CRC of the contents, length of the next string
_DATA_LENGTH = struct.Struct("<Q")
_FOOTER = struct.Struct("<QQI")  # start of the summary, start of its offsets, CRC
_COMPRESSIONS = rb"(?:\x04\x00{3}zstd|\x03\x00{3}lz4|\x00{4})"
_CHUNK_HEAD_BYTES = RECORD.size + _CHUNK.size + len("zstd") + _DATA_LENGTH.size
_CHUNK_START = re.compile(bytes([Opcode.CHUNK]) + rb"(?=.{8}.{28}" + _COMPRESSIONS + rb")", re.DOTALL)

_DEFINITIONS = {Opcode.SCHEMA, Opcode.CHANNEL, Opcode.METADATA, Opcode.STATISTICS, Opcode.MESSAGE_INDEX}
_MAX_DEFINITION_BYTES = 1 << 26
_LOOSE_BLOCK_BYTES = 1 << 20
_DATA_END_BYTES = 4
_HEADER_BYTES = 12


def scan(path: Path, wanted: Callable[[Channel], bool]) -> Contents:
    """Read the whole file once; ``wanted`` says which channels are to be indexed.

    Raises:
        LogError: the file does not exist, cannot be read, is empty, or is not an MCAP file.

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


class _BrokenRecordError(ValueError):
    """A record that cannot be what it says."""


class _BrokenChunkError(_BrokenRecordError):
    """A chunk whose length is not known."""


class _Chunk(NamedTuple):
    """What the head of a chunk says. It says its length twice: that of the record, and that of its contents."""

    start_ns: int
    end_ns: int
    crc: int
    compression: str
    data_start: int
    lengths: tuple[int, int]

    @property
    def consistent(self) -> bool:
        return self.lengths[0] == self.lengths[1]


@dataclass(slots=True)
class _BadChunk:
    where: str
    reason: str
    messages_lost: int = 0


@dataclass(slots=True)
class _GrowingIndex:
    stamps: array[int] = field(default_factory=lambda: array("q"))
    log_times: array[int] = field(default_factory=lambda: array("Q"))
    blocks: array[int] = field(default_factory=lambda: array("I"))
    offsets: array[int] = field(default_factory=lambda: array("Q"))

    def columns(self) -> tuple[array[int], ...]:
        return self.stamps, self.log_times, self.blocks, self.offsets


class _Scan:
    """One pass over a file, and what it has found so far."""

    def __init__(self, path: Path, file: IO[bytes], wanted: Callable[[Channel], bool]):
        self._path = path
        self._file = file
        self._size = path.stat().st_size
        self._wanted = wanted
        self._schemas: dict[int, records.Schema] = {}
        self._channels: dict[int, records.Channel] = {}
        self._counts: Counter[int] = Counter()
        self._indices: dict[int, _GrowingIndex] = {}
        self._blocks: list[Block] = []
        self._loose: Block | None = None  # messages that stand outside of a chunk
        self._metadata: dict[str, dict[str, str]] = {}
        self._statistics: records.Statistics | None = None
        self._bad_chunks: list[_BadChunk] = []
        self._after_bad_chunk = False
        self._damage: list[Damage] = []
        self._chunked = False
        self._data_complete = False
        self._at_end = False

    def run(self) -> Contents:
        self._walk()
        self._index_loose_block()
        senders: dict[Channel, list[int]] = {}
        for number in sorted(self._counts):
            if channel := self._channel(number):
                senders.setdefault(channel, []).append(number)
        return Contents(
            counts={channel: sum(self._counts[number] for number in numbers) for channel, numbers in senders.items()},
            schemas={
                channel: self._schemas[schema_id]
                for channel, numbers in senders.items()
                if (schema_id := self._channels[numbers[0]].schema_id)
            },
            index={
                channel.topic: _in_order([self._indices[number] for number in numbers])
                for channel, numbers in senders.items()
                if self._wanted(channel)
            },
            blocks=self._blocks,
            metadata=self._metadata,
            damage=[*self._damage, *self._chunk_damage()],
            messages_lost=self._messages_lost(),
        )

    # --- Records --------------------------------------------------------------------------------

    def _walk(self) -> None:
        previous = position = len(MCAP0_MAGIC)
        while not self._at_end:
            try:
                previous, position = position, self._read_record(position)
            except _BrokenRecordError as broken:
                # The record before may already have had a wrong length: what it skipped is searched too.
                following = None if self._data_complete else self._find_resumption(previous + 1)
                if following is None:
                    self._end_early(position)
                    return
                self._note(
                    "bad_chunks" if isinstance(broken, _BrokenChunkError) else "bad_records",
                    f"the record at byte {position} is damaged ({broken}): read on from byte {following}",
                )
                previous = position = following

    def _read_record(self, position: int) -> int:
        """Read what begins at this byte; returns where it ends."""
        self._file.seek(position)
        head = self._file.read(RECORD.size)
        if len(head) < RECORD.size:
            raise _BrokenRecordError("the file ends")
        opcode, length = RECORD.unpack(head)
        if opcode == Opcode.CHUNK:
            return self._read_chunk(position)
        end = position + RECORD.size + length
        if not self._is_plausible(opcode, length, end):
            raise _BrokenRecordError(f"opcode {opcode} of {length} bytes")
        if opcode == Opcode.MESSAGE:
            self._extend_loose_block(position, end)
        elif opcode in _DEFINITIONS:
            self._read_definition(opcode, self._file.read(length))
        elif opcode == Opcode.DATA_END:
            self._data_complete = True
        elif opcode == Opcode.FOOTER:
            self._read_footer()
        return int(end)

    def _is_plausible(self, opcode: int, length: int, end: int) -> bool:
        """Whether a record with this head can stand here; without a checksum this is all that guards its opcode."""
        if opcode in _DEFINITIONS:
            return length <= _MAX_DEFINITION_BYTES and end <= self._size
        match opcode:
            case 0:
                return False
            case Opcode.MESSAGE:  # writers put either all messages into chunks or none
                return not self._chunked and not self._data_complete and end <= self._size
            case Opcode.DATA_END:
                return length == _DATA_END_BYTES
            case Opcode.FOOTER:
                return end + len(MCAP0_MAGIC) == self._size
        return end <= self._size

    def _read_definition(self, opcode: int, body: bytes) -> None:
        """A record that says what is in the file. What is met first holds: the summary only repeats it."""
        stream = ReadDataStream(BytesIO(body))
        try:
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
                    self._bad_chunks[-1].messages_lost += len(records.MessageIndex.read(stream).records)
        except (McapError, struct.error, UnicodeDecodeError) as error:
            raise _BrokenRecordError(f"opcode {opcode} of {len(body)} bytes: {error}") from error

    def _read_footer(self) -> None:
        """The last record: the summary before it and the magic bytes behind it are checked."""
        body = self._file.read(_FOOTER.size + len(MCAP0_MAGIC))
        if len(body) < _FOOTER.size + len(MCAP0_MAGIC):
            raise _BrokenRecordError("the file ends")
        checked_end = self._file.tell() - len(MCAP0_MAGIC) - 4
        summary_start, _, crc = _FOOTER.unpack_from(body)
        if (
            not body.endswith(MCAP0_MAGIC)
            or summary_start > checked_end
            or (crc and summary_start and self._crc(summary_start, checked_end) != crc)
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
        chunk = self._chunk_at(position)
        if chunk is None:
            raise _BrokenChunkError("not a chunk of this format")
        block = self._block_of(chunk, position)
        self._chunked = True
        end = block.offset + block.length
        cut = end > self._size
        if cut:
            block = block._replace(length=self._size - block.offset)
        self._after_bad_chunk = False
        try:
            contents = self._unpacked(block)
            if not cut and chunk.crc and zlib.crc32(contents) != chunk.crc:
                raise ValueError("its checksum is wrong")
            if self._index_block(block, contents) < len(contents) and not cut:
                raise ValueError("its last record is not whole")
        except ValueError as error:
            self._bad_chunks.append(_BadChunk(f"at byte {position}, {_time_range(chunk)}", str(error)))
            self._after_bad_chunk = True
        if cut:
            self._end_early(position)
        return end

    def _chunk_at(self, position: int) -> _Chunk | None:
        """The head of the chunk that begins at this byte, or None if none can begin there."""
        self._file.seek(position)
        head = self._file.read(_CHUNK_HEAD_BYTES)
        name_start = RECORD.size + _CHUNK.size
        try:
            _, length = RECORD.unpack_from(head)
            start_ns, end_ns, _, crc, name_length = _CHUNK.unpack_from(head, RECORD.size)
            compression = head[name_start : name_start + name_length].decode("ascii")
            (data_length,) = _DATA_LENGTH.unpack_from(head, name_start + name_length)
        except (struct.error, UnicodeDecodeError):
            return None
        data_start = name_start + name_length + _DATA_LENGTH.size
        lengths = (data_length, RECORD.size + length - data_start)
        return _Chunk(start_ns, end_ns, crc, compression, position + data_start, lengths)

    def _block_of(self, chunk: _Chunk, position: int) -> Block:
        """The contents of a chunk; where its two lengths contradict each other, the checksum says which is right."""
        blocks = [Block(chunk.data_start, length, chunk.compression) for length in chunk.lengths]
        if chunk.consistent:
            return blocks[0]
        for block in blocks:
            if chunk.crc and 0 < block.length <= self._size - block.offset and self._has_crc(block, chunk.crc):
                self._note("bad_records", f"a length of the chunk at byte {position} is damaged; its contents are not")
                return block
        raise _BrokenChunkError("a chunk whose lengths contradict each other")

    def _has_crc(self, block: Block, crc: int) -> bool:
        try:
            return zlib.crc32(self._unpacked(block)) == crc
        except ValueError:
            return False

    def _unpacked(self, block: Block) -> bytes:
        self._file.seek(block.offset)
        return unpack(block.compression, self._file.read(block.length))

    def _find_resumption(self, position: int) -> int | None:
        """Where the next chunk begins, from this byte on, or behind the last chunk the summary."""
        with mmap.mmap(self._file.fileno(), 0, access=mmap.ACCESS_READ) as view:
            for match in _CHUNK_START.finditer(view, position):
                chunk = self._chunk_at(match.start())
                if chunk and chunk.consistent:
                    return match.start()
        summary_start = self._summary_start()
        return summary_start if position <= summary_start < self._size else None

    def _summary_start(self) -> int:
        """The place of the summary, or of the footer if there is no summary, as the end of the file tells it; or 0."""
        footer_start = self._size - len(MCAP0_MAGIC) - _FOOTER.size - RECORD.size
        self._file.seek(max(footer_start, 0))
        tail = self._file.read()
        if tail[:1] != bytes([Opcode.FOOTER]) or not tail.endswith(MCAP0_MAGIC):
            return 0
        return int(_FOOTER.unpack_from(tail, RECORD.size)[0]) or footer_start

    # --- Messages -------------------------------------------------------------------------------

    def _index_block(self, block: Block, contents: bytes) -> int:
        """Note the messages of a block; returns where its last whole record ends."""
        number, last_end = len(self._blocks), 0
        self._blocks.append(block)
        for opcode, position, start, end in split_records(contents):
            if opcode == Opcode.MESSAGE and end - start >= MESSAGE.size:
                self._add_message(contents, number, position, start, end)
            elif opcode in _DEFINITIONS:
                self._read_definition(opcode, contents[start:end])
            last_end = end
        return last_end

    def _add_message(self, contents: bytes, block: int, position: int, start: int, end: int) -> None:
        channel, _, log_time, _ = MESSAGE.unpack_from(contents, start)
        self._counts[channel] += 1
        index = self._indices.get(channel)
        if index is None:
            # Which channel it is may only be known at the end, if the chunk that says so is damaged.
            known = self._channel(channel)
            if known and not self._wanted(known):
                return
            index = self._indices[channel] = _GrowingIndex()
        data_start = start + MESSAGE.size
        index.stamps.append(header_stamp(contents, data_start) if end - data_start >= _HEADER_BYTES else 0)
        index.log_times.append(log_time)
        index.blocks.append(block)
        index.offsets.append(position)

    def _channel(self, number: int) -> Channel | None:
        """What is known of a channel; None while its definition or that of its messages has not been met."""
        channel = self._channels.get(number)
        if channel is None or (channel.schema_id and channel.schema_id not in self._schemas):
            return None
        message_type = self._schemas[channel.schema_id].name if channel.schema_id else ""
        return Channel(channel.topic, message_type, channel.message_encoding)

    def _extend_loose_block(self, position: int, end: int) -> None:
        if self._loose and self._loose.offset + self._loose.length == position:
            self._loose = self._loose._replace(length=end - self._loose.offset)
        else:
            self._index_loose_block()
            self._loose = Block(position, end - position, "")
        if self._loose.length >= _LOOSE_BLOCK_BYTES:
            self._index_loose_block()

    def _index_loose_block(self) -> None:
        if self._loose:
            self._file.seek(self._loose.offset)
            self._index_block(self._loose, self._file.read(self._loose.length))
            self._loose = None

    # --- Losses ---------------------------------------------------------------------------------

    def _note(self, name: str, text: str) -> None:
        self._damage.append(Damage(name, f"{self._path}: {text}"))

    def _end_early(self, position: int) -> None:
        """The file ends before its end: in the data, or in the summary that only repeats what was read."""
        self._at_end = True
        if self._data_complete:
            self._note("bad_summary", "the summary at the end of the file is damaged")
        else:
            self._note("truncated", f"the file is cut or unfinished: its data ends at byte {position} of {self._size}")

    def _chunk_damage(self) -> list[Damage]:
        return [
            Damage(
                "bad_chunks",
                f"{self._path}: the chunk {chunk.where} is damaged ({chunk.reason})"
                + (f", {counted(chunk.messages_lost, 'message')} lost" if chunk.messages_lost else ""),
            )
            for chunk in self._bad_chunks
        ]

    def _messages_lost(self) -> int:
        """By the file's own count where it has one, else by the index behind each damaged chunk."""
        if self._statistics is None:
            return sum(chunk.messages_lost for chunk in self._bad_chunks)
        readable = sum(count for channel, count in self._counts.items() if self._channel(channel))
        return max(0, self._statistics.message_count - readable)


def _in_order(indices: Sequence[_GrowingIndex]) -> MessageIndex:
    """One index of several channels, in the order of the file."""
    stamps, log_times, blocks, offsets = (
        np.concatenate([np.array(column, dtype=np.int64) for column in columns])
        for columns in zip(*(index.columns() for index in indices), strict=True)
    )
    order = np.lexsort((offsets, blocks))
    return MessageIndex(stamps[order], log_times[order], blocks[order], offsets[order])


def _time_range(chunk: _Chunk) -> str:
    return f"{chunk.start_ns / NANOSECONDS:.3f} to {chunk.end_ns / NANOSECONDS:.3f} s"
