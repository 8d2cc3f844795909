"""A log is complete or absent, in order of time, and the same bytes for the same input."""

import errno
import itertools
import resource
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from log_samples import (
    CAMERA,
    SECOND,
    START,
    depth,
    frames,
    grey,
    imu_series,
    pair_estimates,
    trajectory,
    write_sample,
)
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader
from scipy.spatial.transform import Rotation

from fusion_io import topics
from fusion_io.errors import LogError
from fusion_io.reader import open_log
from fusion_io.records import GnssFix
from fusion_io.writer import WAITING_IMAGES, LogWriter


def written(path: Path) -> list[tuple[str, int]]:
    """Topic and log time of every message in the order of the file, read by mcap's own reader with checksums."""
    with path.open("rb") as stream:
        messages = make_reader(stream, validate_crcs=True).iter_messages(log_time_order=False)
        return [(channel.topic, message.log_time) for _, channel, message in messages]


def test_every_topic_is_written_with_its_count(tmp_path: Path) -> None:
    path = write_sample(tmp_path / "a.mcap")
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    counts = {summary.channels[i].topic: n for i, n in summary.statistics.channel_message_counts.items()}
    assert counts == {
        topics.IMAGE: 20,
        topics.DEPTH: 20,
        topics.CAMERA_INFO: 20,
        topics.IMU: 200,
        topics.GROUND_TRUTH: 20,
        topics.PAIRS: 19,
        topics.TF: 20,
        topics.TF_STATIC: 1,
        "/odometry/raw": 20,
    }
    assert {chunk.compression for chunk in summary.chunk_indexes} == {"zstd"}
    assert len(summary.metadata_indexes) == 1


def test_every_chunk_has_a_checksum(tmp_path: Path) -> None:
    path = write_sample(tmp_path / "a.mcap")
    with path.open("rb") as stream:
        chunks = [r for r in StreamReader(stream, emit_chunks=True).records if type(r).__name__ == "Chunk"]
    assert chunks
    assert all(chunk.uncompressed_crc for chunk in chunks)


def test_messages_are_in_order_of_time_whatever_the_order_of_the_calls(tmp_path: Path) -> None:
    """The series come first as a whole, depth lags behind its image, and frames arrive in disorder."""
    path = tmp_path / "a.mcap"
    shuffled = frames(40)
    for i in range(0, 40, 8):
        shuffled[i : i + 8] = reversed(shuffled[i : i + 8])
    with LogWriter(path) as log:
        log.imu(imu_series(400))
        log.ground_truth(trajectory(40))
        for pair in pair_estimates(39):
            log.pair(pair)
        for frame in shuffled:
            log.depth(frame.stamp_ns + 5_000_000, frame.depth)
            log.image(frame.stamp_ns, frame.image)
            log.camera_info(frame.stamp_ns, CAMERA)
    stamps = [stamp for _, stamp in written(path)]
    assert len(stamps) == 400 + 40 + 39 + 3 * 40
    assert stamps == sorted(stamps)


def test_a_mounting_does_not_stretch_the_log(tmp_path: Path) -> None:
    path = write_sample(tmp_path / "a.mcap")
    assert written(path)[0] == (topics.TF_STATIC, START)


def test_images_are_not_hoarded(tmp_path: Path) -> None:
    """What waits is bounded, so that a recording of any length can be written."""
    with LogWriter(tmp_path / "a.mcap") as log:
        for i in range(3 * WAITING_IMAGES):
            log.image(START + i * SECOND, grey())
            assert len(log._heap) <= WAITING_IMAGES


def test_the_same_input_gives_the_same_bytes(tmp_path: Path) -> None:
    assert write_sample(tmp_path / "a.mcap").read_bytes() == write_sample(tmp_path / "b.mcap").read_bytes()


def test_what_is_read_back_is_written_as_the_same_bytes(tmp_path: Path) -> None:
    """A log of IMU and pair estimates survives any number of copies to the last bit."""
    copies = [tmp_path / f"{name}.mcap" for name in "abc"]
    with LogWriter(copies[0]) as log:
        log.imu(imu_series())
        log.pairs(pair_estimates())
        log.gnss(GnssFix(START, 49.0, 8.0, 110.0, np.eye(3)))
        for frame in frames(5):
            log.frame(frame)
    for source, target in itertools.pairwise(copies):
        read = open_log(source)
        with LogWriter(target) as log:
            log.imu(read.imu())
            log.pairs(read.pairs())
            log.gnss(read.gnss()[0])
            for frame in read.frames():
                log.frame(frame)
    assert copies[0].read_bytes() == copies[1].read_bytes() == copies[2].read_bytes()


def test_missing_folders_are_made_and_an_old_log_is_replaced(tmp_path: Path) -> None:
    path = tmp_path / "new" / "a.mcap"
    write_sample(path, count=3)
    write_sample(path, count=5)
    assert len(open_log(path).frame_stamps()) == 5
    assert list(path.parent.iterdir()) == [path]


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
def test_an_interrupted_run_leaves_the_old_log_and_nothing_else(tmp_path: Path, error: type[BaseException]) -> None:
    path = write_sample(tmp_path / "a.mcap")
    before = path.read_bytes()

    def interrupted() -> None:
        with LogWriter(path) as log:
            for frame in frames(40):
                log.frame(frame)
            raise error

    with pytest.raises(error):
        interrupted()
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_an_error_while_finishing_leaves_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def no_space(descriptor: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("os.fsync", no_space)
    with pytest.raises(LogError, match=r"a\.mcap: cannot be written: No space left on device") as caught:
        write_sample(tmp_path / "a.mcap")
    assert "\n" not in str(caught.value)
    assert not list(tmp_path.iterdir())


def test_no_space_left_is_one_line_and_no_half_file(tmp_path: Path) -> None:
    """The operating system refuses to let the file grow, in the middle of the frames and at the end."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    for bytes_left, count in ((100_000, 400), (2_000, 5)):
        resource.setrlimit(resource.RLIMIT_FSIZE, (bytes_left, limits[1]))
        try:
            with pytest.raises(LogError, match=r"a\.mcap: cannot be written: ") as caught:
                write_sample(tmp_path / "a.mcap", count)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        assert "\n" not in str(caught.value)
        assert not list(tmp_path.iterdir())


def test_a_killed_run_leaves_nothing_under_the_final_name(tmp_path: Path) -> None:
    script = (
        "import os, signal, sys; sys.path.insert(0, sys.argv[2]); from pathlib import Path\n"
        "from log_samples import frames; from fusion_io.writer import LogWriter\n"
        "with LogWriter(Path(sys.argv[1])) as log:\n"
        "    for frame in frames(100): log.frame(frame)\n"
        "    os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    path = tmp_path / "a.mcap"
    finished = subprocess.run([sys.executable, "-c", script, path, Path(__file__).parent], check=False)
    assert finished.returncode == -9
    assert not path.exists()


def test_a_place_that_cannot_be_written_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(LogError, match="cannot be written"), LogWriter(tmp_path / "file" / "a.mcap"):
        pass


@settings(max_examples=30, deadline=None, derandomize=True)
@given(st.lists(st.integers(0, 30), max_size=40), st.integers(0, 40))
def test_no_message_is_lost_whatever_the_stamps(tmp_path_factory, offsets: list[int], samples: int) -> None:
    path = tmp_path_factory.mktemp("log") / "a.mcap"
    with LogWriter(path) as log:
        for offset in offsets:
            log.depth(START + offset * SECOND, depth(width=4, height=3))
        log.imu(imu_series(samples))
        log.mounting(Rotation.identity())
    count = {topic: sum(1 for name, _ in written(path) if name == topic) for topic in (topics.DEPTH, topics.IMU)}
    assert count == {topics.DEPTH: len(offsets), topics.IMU: samples}
