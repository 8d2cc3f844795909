"""The statistics of a log are what was put in, and every fault is a reason with its topic and time."""

import json
import shlex
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from log_samples import (
    SECOND,
    START,
    camera_info,
    depth,
    grey,
    imu_message,
    pair_estimates,
    raw_image,
    write_raw,
    write_sample,
)
from mcap.writer import Writer
from report_samples import pairs_of, simulate
from scipy.spatial.transform import RigidTransform, Rotation

from fusion import log_statistics
from fusion.allan import ALLAN, FASTEST_CHANGES
from fusion.analysis import analyse, document
from fusion.analysis_page import page
from fusion.log_statistics import of_depths, of_images, of_topic, revisits
from fusion_io import convert, messages
from fusion_io.container import Channel
from fusion_io.messages import ImuSample, PoseSample
from fusion_io.reader import open_log
from fusion_io.records import NANOSECONDS, EstimatorSeries, FloatArray, ImuSeries, IntArray, Trajectory
from fusion_io.survey import Times
from fusion_io.writer import LogWriter

MS = 1_000_000


def odometry(topic: str, stamp: int, ahead_m: float) -> tuple[str, str, int, bytes]:
    """nav_msgs/Odometry of a robot that drives straight ahead."""
    pose = PoseSample(np.array([ahead_m, 0.0, 0.0]), np.array([1.0, 0.0, 0.0, 0.0]))
    return topic, messages.ODOMETRY, stamp, messages.encode_odometry(stamp, pose, "base")


CHANNEL = Channel("/x", "sensor_msgs/msg/Imu", "cdr")


def found(path: Path) -> dict[str, Any]:
    return document(analyse(path, {}))


# --- Times --------------------------------------------------------------------------------------


def test_rate_gap_and_delay_of_a_topic_are_those_it_was_made_with() -> None:
    stamps = START + np.delete(np.arange(100), [40, 41, 42]) * 10 * MS
    statistics = of_topic(CHANNEL, "imu", Times(stamps, stamps + 250 * MS))
    assert statistics.clock == "stamp"
    assert statistics.rate_hz == 100.0
    assert statistics.jitter_ms == 0.0
    assert (statistics.gaps, statistics.longest_gap_s) == (1, 0.04)
    assert statistics.longest_gap_at_ns == START + 39 * 10 * MS
    assert (statistics.clock_offset_s, statistics.clock_offset_range_s) == (0.25, 0.0)
    assert (statistics.backward, statistics.repeated) == (0, 0)


def test_jitter_is_the_spread_of_the_periods_and_one_outlier_does_not_make_it() -> None:
    noise = np.random.default_rng(0).normal(0, 0.5 * MS, 5000)
    noise[100] += 50 * MS
    stamps = START + (np.cumsum(10 * MS + noise)).astype(np.int64)
    statistics = of_topic(CHANNEL, "imu", Times(stamps, stamps))
    assert statistics.jitter_ms == pytest.approx(0.5, rel=0.05)


def test_stamps_out_of_order_and_repeated_are_counted() -> None:
    stamps = START + np.array([0, 10, 20, 15, 30, 30, 40]) * MS
    statistics = of_topic(CHANNEL, "imu", Times(stamps, stamps))
    assert (statistics.backward, statistics.repeated) == (1, 1)


@pytest.mark.parametrize("count", [1, 2])
def test_of_few_messages_what_they_do_not_tell_is_none(count: int) -> None:
    stamps = np.full(count, START)
    statistics = of_topic(CHANNEL, "", Times(None, stamps))
    assert statistics.clock == "recorder"
    assert (statistics.rate_hz, statistics.jitter_ms, statistics.longest_gap_s) == (None, None, None)
    assert statistics.clock_offset_s is None


def test_messages_that_we_do_not_know_are_timed_by_their_header_if_they_have_one(tmp_path: Path) -> None:
    head = b"\0\1\0\0" + (START // SECOND).to_bytes(4, "little") + (0).to_bytes(4, "little") + bytes(8)
    definitions = {
        "/with": "# what it is\nuint8 KIND=3\nstd_msgs/Header header\nfloat32 x\n===\nMSG: std_msgs/Header\n",
        "/without": "float32 x\nstd_msgs/Header header\n",
    }
    with (tmp_path / "a.mcap").open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        for topic, definition in definitions.items():
            schema = writer.register_schema(f"my_msgs/msg/{topic[1:]}", "ros2msg", definition.encode())
            writer.add_message(writer.register_channel(topic, "cdr", schema), START + 5 * SECOND, head, START)
        writer.finish()
    topics = found(tmp_path / "a.mcap")["topics"]
    assert (topics["/with"]["clock"], topics["/with"]["clock_offset_s"]) == ("stamp", 5.0)
    assert (topics["/without"]["clock"], topics["/without"]["clock_offset_s"]) == ("recorder", None)


def test_wrong_pairs_are_counted_by_how_often_and_each_time_says_of_how_many_pairs_it_is(tmp_path: Path) -> None:
    pairs = pairs_of(simulate(20.0)[0])
    for i in (50, 51, 100):
        pairs[i] = replace(pairs[i], translation=pairs[i].translation + [0.0, 0.0, 5.0])
    with LogWriter(tmp_path / "a.mcap") as log:
        log.pairs(pairs)
    (text,) = [each["text"] for each in found(tmp_path / "a.mcap")["verdict"]["reasons"] if "wrong" in each["text"]]
    assert text == (
        "wrong pairs, 2 pairs: unlike its neighbours (the first of 2 times; 0.3 s in all, the longest 0.20 s)"
    )


# --- Light and depth ----------------------------------------------------------------------------


def test_light_is_measured_in_grey_values_and_shares() -> None:
    half = np.zeros((10, 20), np.uint8)
    half[:, 10:] = 255
    colour = np.full((10, 20, 3), 100, np.uint8)
    statistics = of_images([(1, half), (2, half), (3, colour)])
    assert statistics is not None
    np.testing.assert_allclose(statistics.brightness, [127.5, 127.5, 100])
    np.testing.assert_allclose(statistics.dark_share, [0.5, 0.5, 0])
    np.testing.assert_allclose(statistics.bright_share, [0.5, 0.5, 0])
    np.testing.assert_allclose(statistics.contrast, [127.5, 127.5, 0])
    np.testing.assert_array_equal(statistics.repeated, [False, True, False])
    assert statistics.sharpness[2] == 0
    assert (statistics.width, statistics.height, statistics.channels) == (20, 10, 3)


def test_a_blurred_image_is_less_sharp() -> None:
    sharp = grey(width=64, height=64)
    blurred = (sum(np.roll(sharp.astype(int), i, axis=1) for i in range(4)) // 4).astype(np.uint8)
    statistics = of_images([(1, sharp), (2, blurred)])
    assert statistics is not None
    assert statistics.sharpness[1] < 0.5 * statistics.sharpness[0]


def test_depth_coverage_is_the_share_of_valid_pixels() -> None:
    full = np.full((10, 10), 4.0, np.float32)
    quarter = np.zeros((10, 10), np.float32)
    quarter[:5, :5] = 8.0
    statistics = of_depths([(1, full), (2, quarter)])
    assert statistics is not None
    np.testing.assert_allclose(statistics.coverage, [1.0, 0.25])
    assert statistics.median_m == 6.0  # the median of the two images' medians
    nothing = of_depths([(1, np.zeros((4, 4), np.float32))])
    assert nothing is not None
    assert (nothing.coverage[0], nothing.median_m) == (0.0, None)


def test_without_images_there_are_no_statistics() -> None:
    assert of_images([]) is None
    assert of_depths([]) is None


# --- Revisits -----------------------------------------------------------------------------------


def along(positions: FloatArray) -> Trajectory:
    stamps = START + np.arange(len(positions), dtype=np.int64) * SECOND // 10
    return Trajectory(stamps, RigidTransform.from_components(positions, Rotation.identity(len(positions))))


def test_a_round_driven_twice_is_revisited_all_along_and_a_straight_road_is_not() -> None:
    angle = np.linspace(0, 4 * np.pi, 401)
    twice = along(30 * np.column_stack([np.cos(angle), np.sin(angle), 0 * angle]))
    seen = revisits(twice, "ground truth")
    assert seen.stretches == 1
    assert 190 <= seen.frames <= 215  # the second round, from a little before its start
    straight = along(np.column_stack([np.arange(400.0), np.zeros(400), np.zeros(400)]))
    assert revisits(straight, "x") == log_statistics.Revisits("x", 0, 0, None)


def test_standing_is_no_revisit() -> None:
    assert revisits(along(np.zeros((500, 3))), "x").frames == 0


# --- IMU ----------------------------------------------------------------------------------------


def still_imu(seconds: float, seed: int = 0) -> ImuSeries:
    rng = np.random.default_rng(seed)
    stamps: IntArray = START + np.arange(round(100 * seconds), dtype=np.int64) * (NANOSECONDS // 100)
    rate = rng.normal(0, 1e-3, (len(stamps), 3)) + [0.01, -0.02, 0.005]
    return ImuSeries(stamps, rate, rng.normal(0, 1e-2, (len(stamps), 3)) + [0, 0, 9.81])


def write_imu(path: Path, imu: ImuSeries) -> Path:
    with LogWriter(path) as log:
        log.imu(imu)
        log.pairs(pair_estimates(int((imu.stamps_ns[-1] - imu.stamps_ns[0]) // (SECOND // 10))))
    return path


def test_an_imu_that_stands_still_gives_bias_and_noise_by_allan_deviation(tmp_path: Path) -> None:
    analysed = found(write_imu(tmp_path / "a.mcap", still_imu(60)))
    imu = analysed["imu"]["/imu"]
    assert imu["still_s"] == pytest.approx(60, abs=2)
    assert imu["gyro"]["method"] == ALLAN
    np.testing.assert_allclose(imu["gyro"]["noise_density"], 1e-3 / np.sqrt(100), rtol=0.15)
    np.testing.assert_allclose(imu["gyro"]["mean_while_still"], [0.01, -0.02, 0.005], atol=1e-4)
    np.testing.assert_allclose(imu["accelerometer"]["noise_density"], 1e-2 / np.sqrt(100), rtol=0.15)
    assert any("stand-still" in reason["text"] for reason in analysed["verdict"]["reasons"])


def test_a_moving_imu_says_that_its_noise_is_from_its_fastest_changes(tmp_path: Path) -> None:
    imu = still_imu(20)
    t = (imu.stamps_ns - START)[:, None] / SECOND
    moving = ImuSeries(imu.stamps_ns, imu.angular_velocity + 0.5 * np.sin(t), imu.linear_acceleration + np.cos(t))
    gyro = found(write_imu(tmp_path / "a.mcap", moving))["imu"]["/imu"]["gyro"]
    assert (gyro["method"], gyro["mean_while_still"]) == (FASTEST_CHANGES, None)
    np.testing.assert_allclose(gyro["noise_density"], 1e-3 / np.sqrt(100), rtol=0.15)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (lambda w, a: (w, a / 9.81), "it looks like g, not m/s^2"),
        (lambda w, a: (w + [60, 0, 0], a), "it looks like deg/s, not rad/s"),
        (lambda w, a: (np.where(np.arange(len(w))[:, None] < 500, w, w[500]), a), "the gyro repeats one value"),
    ],
)
def test_an_imu_that_cannot_be_right_is_a_limit(tmp_path: Path, change: Any, text: str) -> None:
    imu = still_imu(20)
    wrong = ImuSeries(imu.stamps_ns, *change(imu.angular_velocity, imu.linear_acceleration))
    verdict = found(write_imu(tmp_path / "a.mcap", wrong))["verdict"]
    assert verdict["answer"] == "usable with limits"
    assert [reason["topic"] for reason in verdict["reasons"] if text in reason["text"]] == ["/imu"]


def test_a_gyro_and_an_accelerometer_of_their_own_are_each_looked_at(tmp_path: Path) -> None:
    imu = still_imu(20)
    none = np.zeros(3)
    items = []
    for stamp, rate, pull in zip(imu.stamps_ns.tolist(), imu.angular_velocity, imu.linear_acceleration, strict=True):
        items.append(imu_message("/gyro/sample", stamp, ImuSample(rate, none)))
        items.append(imu_message("/accel/sample", stamp, ImuSample(none, pull)))
    analysed = found(write_raw(tmp_path / "a.mcap", items))
    assert analysed["imu"]["/gyro/sample"]["accelerometer"] is None
    assert analysed["imu"]["/accel/sample"]["gyro"] is None
    assert analysed["imu"]["/accel/sample"]["gravity_m_s2"] == pytest.approx(9.81, abs=0.01)
    assert not [event for event in analysed["events"] if event["kind"] == "sensor stuck"]


def test_sensors_are_looked_at_although_the_log_leaves_open_which_to_use(tmp_path: Path) -> None:
    imu = still_imu(5)
    items = [
        imu_message(topic, stamp, ImuSample(rate, pull))
        for stamp, rate, pull in zip(imu.stamps_ns.tolist(), imu.angular_velocity, imu.linear_acceleration, strict=True)
        for topic in ("/a", "/b")
    ]
    path = write_raw(tmp_path / "a.mcap", items)
    analysed = found(path)
    assert analysed["verdict"]["answer"] == "not usable"
    assert "2 topics could be the imu: /a, /b" in analysed["verdict"]["reasons"][0]["text"]
    assert set(analysed["imu"]) == {"/a", "/b"}
    chosen = document(analyse(path, {"imu": "/b"}))
    assert chosen["log"]["roles"] == {"imu": "/b"}


# --- What stands in the way -------------------------------------------------------------------


def blockers(analysed: dict[str, Any]) -> list[str]:
    return [reason["text"] for reason in analysed["verdict"]["reasons"] if reason["level"] == "blocks"]


def test_everything_that_stands_in_the_way_is_named_and_not_only_the_first_of_it(tmp_path: Path) -> None:
    """Two choices that are left open, and depth that is missing, at once."""
    items = [raw_image(topic, START + i, grey(i), "mono8") for i in range(3) for topic in ("/left", "/right")]
    items += [imu_message(topic, START, ImuSample(np.ones(3), np.ones(3))) for topic in ("/a", "/b")]
    items += [camera_info(f"/{side}/camera_info", START) for side in ("left", "right")]
    named = blockers(found(write_raw(tmp_path / "a.mcap", items)))
    assert named == [
        "2 topics could be the imu: /a, /b; choose one, such as --topic imu=/a; "
        "2 topics could be the image: /left, /right; choose one, such as --topic image=/left",
        "no pair estimates, and to make some it lacks depth",
    ]


def test_a_topic_that_could_play_a_missing_role_is_named_with_the_option(tmp_path: Path) -> None:
    """As depth that somebody painted for the eye, or odometry where there is no ground truth."""
    items = [raw_image("/image", START, grey(), "mono8"), camera_info("/camera_info", START)]
    items += [raw_image("/depth_view", START, grey(), "mono8")]
    items += [odometry("/odom", START, 0.0)]
    verdict = found(write_raw(tmp_path / "a.mcap", items))["verdict"]
    texts = {reason["text"] for reason in verdict["reasons"]}
    assert (
        "no pair estimates, and to make some it lacks depth; if a topic holds it under another name, say so: "
        "--topic depth=/depth_view"
    ) in texts
    assert (
        "no ground truth: errors cannot be computed; if a topic holds it under another name, say so: "
        "--topic ground_truth=/odom"
    ) in texts


@pytest.mark.parametrize("with_imu", [False, True])
def test_for_a_trajectory_alone_the_command_is_named_that_makes_pair_estimates_of_it(
    tmp_path: Path, with_imu: bool
) -> None:
    """A command that works as it is: what it makes can be run."""
    path = tmp_path / "a b.mcap"
    items = [odometry("/odom", START + i * SECOND // 10, 0.1 * i) for i in range(20)]
    items += [imu_message("/imu", START + i * MS, ImuSample(np.ones(3), np.ones(3))) for i in range(20 * with_imu)]
    named = blockers(found(write_raw(path, items)))[-1]
    imu = f" --imu '{path}'" if with_imu else ""
    command = f"violearner convert trajectory --poses '{path}' --topic /odom{imu} --out pairs.mcap"
    assert named == f"it holds a trajectory instead (/odom): make pair estimates of it with {command}"
    words = shlex.split(command)[2:]
    words[-1] = str(tmp_path / "pairs.mcap")
    assert convert.main(words) == 0
    made = open_log(tmp_path / "pairs.mcap")
    assert len(made.pairs()) == 19
    assert len(made.imu()) == 20 * with_imu
    assert found(tmp_path / "pairs.mcap")["verdict"]["answer"] == "usable with limits"


# --- The whole ----------------------------------------------------------------------------------


def test_the_keys_of_the_document_stay(tmp_path: Path) -> None:
    analysed = found(write_sample(tmp_path / "a.mcap"))
    assert analysed["schema"] == 1
    assert list(analysed) == [
        "schema", "log", "verdict", "topics", "images", "depth", "imu", "calibration", "events", "loops",
        "trajectories",
    ]  # fmt: skip
    assert list(analysed["log"]) == ["path", "damaged", "messages", "frames", "start_s", "end_s", "roles"]
    assert set(analysed["verdict"]["reasons"][0]) == {"level", "topic", "time_s", "text"}
    assert set(analysed["topics"]["/imu"]) == {
        "type", "encoding", "kind", "messages", "clock", "rate_hz", "jitter_ms", "gaps", "longest_gap_s", "backward",
        "repeated", "clock_offset_s", "clock_offset_range_s", "start_s", "end_s", "longest_gap_at_s",
    }  # fmt: skip
    assert analysed["depth"]["/camera/depth"]["coverage"]["min"] == 1.0
    assert analysed["images"]["/camera/image"]["sampled"] == 20
    json.dumps(analysed, allow_nan=False)


def test_the_page_is_the_same_for_the_same_log_and_escapes_what_a_log_says(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        for topic in ("/<script>alert(1)</script>", "/$x_{$"):
            writer.add_message(writer.register_channel(topic, "json", 0), START, b"{}", START)
        writer.finish()
    text = page(analyse(path, {}))
    assert text == page(analyse(path, {}))
    assert "<script" not in text
    assert "not usable" in text


def test_the_page_draws_light_and_allan_deviation(tmp_path: Path) -> None:
    with LogWriter(tmp_path / "a.mcap") as log:
        log.imu(still_imu(30))
        for i in range(5):
            log.image(START + i * SECOND, grey(i))
            log.depth(START + i * SECOND, depth(i))
    text = page(analyse(tmp_path / "a.mcap", {}))
    assert text.count("<svg") == 3
    assert "Allan deviation" in text
    assert "$" not in text  # no formula is left as it was typed
    assert "http" not in text.replace("http://www.w3.org", "").replace("http://purl.org", "").replace(
        "http://creativecommons.org", ""
    ).replace("https://matplotlib.org", "")


def test_a_message_that_cannot_be_decoded_is_left_out_of_the_statistics(tmp_path: Path) -> None:
    """An Imu message that cannot be decoded is left out, and the others are used."""
    imu = still_imu(1)
    items = [
        imu_message("/imu", stamp, ImuSample(rate, pull))
        for stamp, rate, pull in zip(imu.stamps_ns.tolist(), imu.angular_velocity, imu.linear_acceleration, strict=True)
    ]
    topic, kind, log_time, data = items[10]
    items[10] = (topic, kind, log_time, data[:40])
    assert kind == messages.IMU
    assert found(write_raw(tmp_path / "a.mcap", items))["imu"]["/imu"]["samples"] == len(items) - 1


@pytest.mark.filterwarnings("error")
def test_numbers_that_no_sensor_measures_are_survived(tmp_path: Path) -> None:
    imu = still_imu(5)
    imu.angular_velocity[50] = 1e300
    imu.linear_acceleration[60:70] = -1e200
    positions = np.zeros((50, 3))
    positions[20:] = 1e200
    positions[30:] = 1e6
    with LogWriter(tmp_path / "a.mcap") as log:
        log.imu(imu)
        log.ground_truth(along(positions))
        log.pairs(pair_estimates(40))
        log.trajectory("raw", along(positions))
    analysis = analyse(tmp_path / "a.mcap", {})
    assert json.loads(json.dumps(document(analysis), allow_nan=False))["imu"]["/imu"]["samples"] == 489
    assert page(analysis)


def test_an_output_log_shows_what_its_back_end_stated(tmp_path: Path) -> None:
    """NIS is averaged over the frames that have one, and 95 % of honest ones lie within their bounds."""
    count, rng = 2001, np.random.default_rng(0)
    nis = np.concatenate([[np.nan], rng.chisquare(6, count - 1)])
    used = np.arange(count) % 10 != 0
    number, vector = np.zeros(count), np.zeros((count, 3))
    stamps = START + np.arange(count, dtype=np.int64) * SECOND // 10
    series = EstimatorSeries(
        stamps, vector, vector, vector, vector, number, number, vector, vector, np.zeros((count, 6)), nis, used
    )
    moved = along(np.column_stack([np.arange(float(count)), number, number]))
    sure = Trajectory(moved.stamps_ns, moved.poses, np.tile(np.diag([4e-4] * 3 + [3.0] * 3), (count, 1, 1)))
    with LogWriter(tmp_path / "run.mcap") as log:
        log.pairs(pair_estimates(count - 1))
        log.trajectory("ekf", sure)
        log.estimator("ekf", series)
    result = found(tmp_path / "run.mcap")["trajectories"]["ekf"]
    assert result["nis_mean"] == pytest.approx(6, abs=0.3)
    assert result["nis_inside"] == pytest.approx(0.95, abs=0.02)
    assert result["used"] == pytest.approx(0.9, abs=1e-3)
    assert result["end_sigma_m"] == pytest.approx(3.0, rel=1e-6)
    assert result["path_length_m"] == pytest.approx(count - 1)
    assert result["metrics"] == {}
