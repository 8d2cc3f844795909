"""What is left of a damaged log is read, what is lost is counted, and nothing that was not written is made up."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from log_samples import SECOND, START, camera_info, depth, frames, imu_series, pair_estimates, raw_image, write_raw
from mcap.opcode import Opcode
from mcap.writer import CompressionType, IndexType

from fusion_io import messages, topics
from fusion_io.container import MessageFile
from fusion_io.errors import LogError
from fusion_io.reader import Log, open_log
from fusion_io.recovery import scan
from fusion_io.writer import LogWriter

PREFIX = 9  # bytes of opcode and length before a record
COMPRESSIONS = [CompressionType.ZSTD, CompressionType.LZ4, CompressionType.NONE]


def everything(path: Path) -> dict[str, list[tuple[int, bytes]]]:
    """Topic -> (log time, data) of all that can be read."""
    contents = scan(path, lambda channel: True)
    with MessageFile(path, contents.blocks) as file:
        return {
            topic: [(int(index.log_times_ns[i]), bytes(file.read(index, i))) for i in range(len(index))]
            for topic, index in contents.index.items()
        }


def opened(path: Path) -> tuple[Log | None, str]:
    """The log, or why it is refused."""
    try:
        return open_log(path), ""
    except LogError as error:
        return None, str(error)


def is_subsequence(some: list, whole: list) -> bool:
    rest = iter(whole)
    return all(item in rest for item in some)


def chunk_starts(data: bytes) -> list[int]:
    """The first byte of every chunk of an undamaged file, by walking its records."""
    starts, position = [], 8
    while position < len(data) - 8:
        if data[position] == Opcode.CHUNK:
            starts.append(position)
        position += PREFIX + int.from_bytes(data[position + 1 : position + PREFIX], "little")
    return starts


def raw_items(count: int = 60) -> list:
    return [
        item
        for i in range(count)
        for item in (
            raw_image("/camera/depth", START + i * SECOND, depth(i), "32FC1"),
            camera_info("/camera/camera_info", START + i * SECOND),
        )
    ]


@pytest.fixture(scope="module")
def sample(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log of some ten chunks."""
    path = tmp_path_factory.mktemp("sample") / "sample.mcap"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("fusion_io.writer.CHUNK_BYTES", 10_000)
        with LogWriter(path, {"run": {"seed": "0"}}) as log:
            log.imu(imu_series(80, period=50_000_000))
            log.pairs(pair_estimates(39))
            for frame in frames(40):
                log.frame(frame)
    assert len(chunk_starts(path.read_bytes())) > 8
    return path


@pytest.fixture(scope="module")
def whole(sample: Path) -> dict[str, list[tuple[int, bytes]]]:
    return everything(sample)


# --- Laws ---------------------------------------------------------------------------------------


@settings(max_examples=40, deadline=None, derandomize=True)
@given(data=st.data())
def test_a_log_cut_anywhere_gives_the_beginning_of_every_topic(data, sample: Path, whole, tmp_path_factory) -> None:
    cut = data.draw(st.integers(0, sample.stat().st_size - 1))
    path = tmp_path_factory.mktemp("cut") / "cut.mcap"
    path.write_bytes(sample.read_bytes()[:cut])
    log, refusal = opened(path)
    if log is None:
        assert "\n" not in refusal
        assert cut < 10_000  # before the first messages
        return
    left = everything(path)
    assert all(left[topic] == whole[topic][: len(left[topic])] for topic in left)
    assert log.damaged
    assert log.warnings.keys() & {"truncated", "bad_summary"}
    assert len(list(log.frames())) == len(left[topics.IMAGE])
    assert len(log.pairs()) == len(left[topics.PAIRS])


@settings(max_examples=60, deadline=None, derandomize=True)
@given(data=st.data())
def test_a_flipped_bit_loses_what_is_counted_and_changes_nothing(data, sample: Path, whole, tmp_path_factory) -> None:
    damaged = bytearray(sample.read_bytes())
    near_chunk = st.builds(int.__add__, st.sampled_from(chunk_starts(damaged)), st.integers(0, 60))
    position = data.draw(st.one_of(st.integers(0, len(damaged) - 1), near_chunk))
    damaged[position] ^= 1 << data.draw(st.integers(0, 7))
    path = tmp_path_factory.mktemp("flip") / "flip.mcap"
    path.write_bytes(damaged)
    log, refusal = opened(path)
    if log is None:
        assert position < 8, refusal  # the magic bytes: no longer an MCAP file
        return
    left = everything(path)
    assert all(is_subsequence(left[topic], whole[topic]) for topic in left)
    lost = sum(map(len, whole.values())) - sum(map(len, left.values()))
    assert log.warnings.get("messages_lost", 0) == lost
    assert log.damaged or not lost
    list(log.frames()), log.imu(), log.pairs()


@settings(max_examples=40, deadline=None, derandomize=True)
@given(start=st.floats(0, 1), garbage=st.binary(min_size=1, max_size=400), cut=st.floats(0.3, 1))
def test_garbage_over_a_part_of_a_cut_log_never_crashes(
    start, garbage, cut, sample: Path, whole, tmp_path_factory
) -> None:
    damaged = bytearray(sample.read_bytes())
    position = 8 + int(start * (len(damaged) - 8))
    damaged[position : position + len(garbage)] = garbage
    path = tmp_path_factory.mktemp("garbage") / "garbage.mcap"
    path.write_bytes(damaged[: int(cut * len(damaged))])
    try:
        open_log(path)
    except LogError:
        return
    left = everything(path)
    assert all(is_subsequence(left[topic], whole[topic]) for topic in left if topic in whole)


@settings(max_examples=40, deadline=None, derandomize=True)
@given(data=st.data(), chunked=st.booleans(), compression=st.sampled_from(COMPRESSIONS))
def test_garbage_in_a_log_without_checksums_never_crashes(data, chunked: bool, compression, tmp_path_factory) -> None:
    """What is read may then be wrong, but it is read: messages that make no sense are left out."""
    path = tmp_path_factory.mktemp("garbage") / "garbage.mcap"
    write_raw(
        path, raw_items(6), chunk_size=10_000, compression=compression, use_chunking=chunked, enable_crcs=False
    )  # fmt: skip
    damaged = bytearray(path.read_bytes())
    for _ in range(3):
        position = data.draw(st.integers(8, len(damaged) - 1))
        garbage = data.draw(st.binary(min_size=1, max_size=60))
        damaged[position : position + len(garbage)] = garbage
    path.write_bytes(damaged)
    log, refusal = opened(path)
    assert (log is None) == bool(refusal)
    if log and "camera_info" in log.roles:
        assert len(log.frame_stamps()) <= 6
        assert log.camera_info() is None or log.camera_info().width > 0


@pytest.mark.parametrize("compression", COMPRESSIONS)
@pytest.mark.parametrize("chunked", [True, False])
def test_other_peoples_files_are_read_to_the_cut(compression, chunked: bool, tmp_path: Path) -> None:
    """Every compression of the format, with chunks and without; a chunk as small as here is lost if it is cut."""
    items = raw_items()
    whole = write_raw(
        tmp_path / "a.mcap", items, chunk_size=10_000, compression=compression, use_chunking=chunked,
        index_types=IndexType.NONE,
    )  # fmt: skip
    assert sum(map(len, everything(whole).values())) == len(items)
    data = whole.read_bytes()
    for share in (0.2, 0.5, 0.77, 0.9):
        path = tmp_path / "cut.mcap"
        path.write_bytes(data[: int(share * len(data))])
        left = everything(path)
        total = sum(map(len, left.values()))
        assert share - 0.15 < total / len(items) < share + 0.05
        assert all(entries == everything(whole)[topic][: len(entries)] for topic, entries in left.items())


# --- Each damage by itself ----------------------------------------------------------------------


def damage(sample: Path, tmp_path: Path, change) -> Path:
    data = bytearray(sample.read_bytes())
    path = tmp_path / "damaged.mcap"
    path.write_bytes(change(data) or data)
    return path


def test_an_undamaged_log_has_no_warnings(sample: Path) -> None:
    log = open_log(sample)
    assert not log.damaged
    assert len(list(log.frames())) == 40
    assert len(log.imu()) == 80
    assert len(log.pairs()) == 39
    assert log.warnings == {}
    assert log.notes == []


def test_a_log_cut_in_the_middle(sample: Path, tmp_path: Path) -> None:
    log = open_log(damage(sample, tmp_path, lambda data: data[: len(data) // 2]))
    assert log.damaged
    assert log.warnings["truncated"] == 1
    assert 15 < len(list(log.frames())) < 25
    assert 30 < len(log.imu()) < 50
    (note,) = [note for note in log.notes if "cut or unfinished" in note]
    assert str(log.path) in note


@pytest.mark.parametrize("size", [1, 7, 8, 12, 30, 200])
def test_a_log_cut_before_its_first_message_is_refused_in_a_line(size: int, sample: Path, tmp_path: Path) -> None:
    with pytest.raises(LogError, match=r"not an MCAP file|no whole message") as caught:
        open_log(damage(sample, tmp_path, lambda data: data[:size]))
    assert "\n" not in str(caught.value)


def test_an_unfinished_log_is_complete_up_to_its_last_chunk(sample: Path, tmp_path: Path) -> None:
    """The recorder was killed: no summary, no footer."""

    def unfinished(data: bytearray) -> bytearray:
        last = chunk_starts(data)[-1]
        return data[:last]

    log = open_log(damage(sample, tmp_path, unfinished))
    assert log.damaged
    assert log.warnings == {"truncated": 1}
    assert len(list(log.frames())) > 30


@pytest.mark.parametrize("compression", COMPRESSIONS)
def test_a_chunk_that_is_cut_is_read_to_its_last_whole_message(compression, tmp_path: Path) -> None:
    """Compressed data unpacks by the 128 kB or so: of a chunk of 1 MB, most of what is there is saved."""
    items = [raw_image(topics.DEPTH, START + i * SECOND, depth(i, 96, 64), "32FC1") for i in range(40)]
    items += [camera_info(topics.CAMERA_INFO, START)]
    path = write_raw(tmp_path / "a.mcap", items, chunk_size=1 << 21, compression=compression)
    data = path.read_bytes()
    assert len(chunk_starts(data)) == 1
    path.write_bytes(data[: len(data) // 2])
    left = everything(path)[topics.DEPTH]
    assert 10 <= len(left) <= 20
    assert left == [(stamp, message) for _, _, stamp, message in items[: len(left)]]


def test_a_flipped_byte_costs_one_chunk(sample: Path, tmp_path: Path) -> None:
    def flip(data: bytearray) -> None:
        data[chunk_starts(data)[3] + 2000] ^= 0xFF

    log = open_log(damage(sample, tmp_path, flip))
    lost = log.warnings["messages_lost"]
    assert log.damaged
    assert log.warnings["bad_chunks"] == 1
    assert 0 < lost < 100
    assert len(list(log.frames())) > 34
    assert any(f"{lost} messages lost" in note and "to 1700000" in note for note in log.notes)


def test_the_loss_of_a_chunk_is_counted_without_a_summary_too(sample: Path, whole, tmp_path: Path) -> None:
    def flip_and_cut(data: bytearray) -> bytearray:
        starts = chunk_starts(data)
        data[starts[3] + 2000] ^= 0xFF
        return data[: starts[-1]]

    log = open_log(damage(sample, tmp_path, flip_and_cut))
    cut = everything(damage(sample, tmp_path, lambda data: data[: chunk_starts(data)[-1]]))
    left = everything(damage(sample, tmp_path, flip_and_cut))
    assert log.warnings["messages_lost"] == sum(map(len, cut.values())) - sum(map(len, left.values())) > 0
    assert all(is_subsequence(left[topic], whole[topic]) for topic in left)


def test_the_first_chunk_with_all_definitions_may_be_lost(sample: Path, tmp_path: Path) -> None:
    """The channels are known from the summary then."""

    def flip(data: bytearray) -> None:
        data[chunk_starts(data)[0] + 2000] ^= 0xFF

    log = open_log(damage(sample, tmp_path, flip))
    assert log.warnings["bad_chunks"] == 1
    assert len(list(log.frames())) > 34


@pytest.mark.parametrize("byte", [1, 4, 8])
def test_a_broken_chunk_length_loses_nothing(byte: int, sample: Path, tmp_path: Path) -> None:
    """A chunk says its length twice and has a checksum: the right one is found."""

    def break_length(data: bytearray) -> None:
        data[chunk_starts(data)[2] + byte] ^= 0x10

    path = damage(sample, tmp_path, break_length)
    assert everything(path) == everything(sample)
    log = open_log(path)
    assert log.damaged
    assert log.warnings == {"bad_records": 1}


@pytest.mark.parametrize("finished", [True, False])
def test_both_lengths_of_a_chunk_broken_cost_that_chunk(finished: bool, sample: Path, tmp_path: Path) -> None:
    def break_lengths(data: bytearray) -> bytearray:
        starts = chunk_starts(data)
        data[starts[2] + 1 : starts[2] + 3] = bytes([100, 1])
        data[starts[2] + 45 : starts[2] + 47] = bytes([200, 2])
        return data if finished else data[: starts[-1]]

    log = open_log(damage(sample, tmp_path, break_lengths))
    assert log.damaged
    assert log.warnings["bad_chunks"] == 1
    assert len(list(log.frames())) > 30


def test_the_last_chunk_and_the_summary_behind_it_may_both_be_broken(sample: Path, tmp_path: Path) -> None:
    """Reading stops there: it neither fails nor tries the same place for ever."""

    def break_both(data: bytearray) -> None:
        last = chunk_starts(data)[-1]
        data[last + 37] ^= 0x40  # the length of the name of its compression
        summary_start = int.from_bytes(data[-28:-20], "little")
        data[summary_start] = 0

    log = open_log(damage(sample, tmp_path, break_both))
    assert log.warnings == {"bad_chunks": 1, "truncated": 1}
    assert len(list(log.frames())) > 34


def test_a_damaged_summary_is_not_needed(sample: Path, tmp_path: Path) -> None:
    def flip(data: bytearray) -> None:
        data[-100] ^= 0xFF

    path = damage(sample, tmp_path, flip)
    assert everything(path) == everything(sample)
    log = open_log(path)
    assert log.damaged
    assert log.warnings == {"bad_summary": 1}


def test_an_image_whose_depth_was_lost_is_still_a_frame(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with LogWriter(path) as log:
        for i, frame in enumerate(frames(10)):
            log.image(frame.stamp_ns, frame.image)
            log.camera_info(frame.stamp_ns, frame.camera)
            if i != 4:
                log.depth(frame.stamp_ns, frame.depth)
    read = open_log(path)
    assert [frame.depth is None for frame in read.frames()] == [i == 4 for i in range(10)]
    assert read.warnings == {"frames_without_depth": 1}


def test_an_image_that_cannot_be_unpacked_is_counted(tmp_path: Path) -> None:
    broken = messages.encode_image(START + SECOND, np.zeros((4, 4), dtype=np.uint8))[:-40] + bytes(40)
    path = write_raw(
        tmp_path / "a.mcap",
        [
            (topics.IMAGE, messages.COMPRESSED_IMAGE, START, messages.encode_image(START, frames(1)[0].image)),
            (topics.IMAGE, messages.COMPRESSED_IMAGE, START + SECOND, broken[:60] + bytes(len(broken) - 60)),
            camera_info(topics.CAMERA_INFO, START),
        ],
    )
    log = open_log(path)
    for _ in range(2):  # a second pass counts nothing twice
        assert len(list(log.frames())) == 1
        assert log.warnings == {"image_unreadable": 1}


# --- Not a log ----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("content", "reason"),
    [(b"", "the file is empty"), (b"hello\n", "not an MCAP file"), (b"#ROSBAG V2.0\n", "not an MCAP file")],
)
def test_what_is_not_a_log_is_refused_in_a_line(content: bytes, reason: str, tmp_path: Path) -> None:
    path = tmp_path / "text.mcap"
    path.write_bytes(content)
    with pytest.raises(LogError, match=reason) as caught:
        open_log(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_log_without_messages_is_refused(tmp_path: Path) -> None:
    with LogWriter(tmp_path / "a.mcap"):
        pass
    with pytest.raises(LogError, match="no whole message"):
        open_log(tmp_path / "a.mcap")


@pytest.mark.parametrize("name", ["absent.mcap", "."])
def test_a_file_that_is_not_there_is_refused(name: str, tmp_path: Path) -> None:
    with pytest.raises(LogError, match="cannot be read"):
        open_log(tmp_path / name)
