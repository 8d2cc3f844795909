"""The report says what the run computed, says what is missing, and is one file that needs nothing else."""

import base64
import gzip
import json
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from log_samples import pair_estimates, write_sample
from numpy.testing import assert_allclose, assert_array_equal
from report_samples import LENGTHS_M, content
from scipy.spatial.transform import RigidTransform, Rotation

from fusion import events
from fusion.evaluation import anees_bounds, errors_over_time, evaluate
from fusion.gnss import PlacedFixes
from fusion.report import ReportContent, Thumbnail, write_report
from fusion.report import content as content_module
from fusion.report.figures import MAX_SAMPLES, NEARLY_ZERO, Figure, figures
from fusion.report.page import page
from fusion.report.verdict import agreements, nis_bounds, verdict
from fusion_io.reader import open_log
from fusion_io.records import ImuSeries, PairEstimate, Trajectory
from fusion_io.writer import LogWriter

MAX_BYTES = 8_000_000


@pytest.fixture(scope="module")
def full() -> ReportContent:
    """A run with everything."""
    return content()


@pytest.fixture(scope="module")
def html(full: ReportContent) -> str:
    """Its page."""
    return page(full)


@pytest.fixture(scope="module")
def bare(full: ReportContent) -> ReportContent:
    """The least that a run can show: raw, from pairs without hypotheses."""
    none = np.zeros((0, 4)), np.zeros((0, 3)), np.zeros(0)
    pairs = [
        replace(pair, winner=-1, hypotheses_quat_wxyz=none[0], hypotheses_translation=none[1], errors=none[2])
        for pair in full.pairs
    ]
    return ReportContent("bare.mcap", {"raw": full.trajectories["raw"]}, {}, pairs, np.zeros(0, dtype=np.int64))


def _by_key(shown: ReportContent) -> dict[str, Figure]:
    return {figure.key: figure for section in figures(shown).values() for figure in section}


def _line(figure: Figure, row: int, name: str) -> Any:
    return next(line for line in figure.rows[row].lines if line.name.startswith(name))


def _unpacked(html: str, name: str) -> str:
    packed = re.search(rf'<script id="{name}"[^>]*>([^<]*)</script>', html)
    assert packed is not None
    return gzip.decompress(base64.b64decode(packed[1])).decode()


class _Reader(HTMLParser):
    """What a page refers to, and its text."""

    def __init__(self) -> None:
        super().__init__()
        self.references: list[str] = []
        self.text = ""
        self._silent = 0

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.references += [value or "" for name, value in attrs if name in {"src", "href", "srcset", "action"}]
        self._silent += tag in {"script", "style"}

    def handle_endtag(self, tag: str) -> None:
        self._silent -= tag in {"script", "style"}

    def handle_data(self, data: str) -> None:
        self.text += "" if self._silent else data


def _read(html: str) -> _Reader:
    reader = _Reader()
    reader.feed(html)
    return reader


# ---------------------------------------------------------------------------------------------- the file


def test_the_page_refers_to_nothing_but_itself(html: str) -> None:
    assert all(reference.startswith(("#", "data:")) for reference in _read(html).references)
    style = html[html.index("<style>") : html.index("</style>")]
    assert "url(" not in style
    assert "@import" not in style
    assert not re.search(r"https?://", html[html.rindex("<script>") :])
    assert "Plotly" in _unpacked(html, "plotly")


def test_the_same_run_gives_the_same_bytes(tmp_path: Path, full: ReportContent, html: str) -> None:
    write_report(tmp_path / "report.html", replace(full))
    assert (tmp_path / "report.html").read_bytes() == html.encode()


def test_names_from_a_log_are_text_and_not_code(full: ReportContent) -> None:
    odd = replace(full, title="<script>alert(1)</script>", notes=["a & b < c"], topics={"imu": "<b>"})
    html = page(odd)
    assert "<script>alert" not in html
    text = _read(html).text
    assert "<script>alert(1)</script>" in text
    assert "a & b < c" in text


def test_five_thousand_poses_with_all_their_images_are_below_the_limit(full: ReportContent) -> None:
    count = 5000
    rng = np.random.default_rng(0)
    repeat = np.arange(count) % len(full.pairs)
    stamps = full.start_ns + np.arange(count + 1, dtype=np.int64) * 103_700_000
    pairs = [
        replace(full.pairs[k], source_stamp_ns=int(stamps[i]), target_stamp_ns=int(stamps[i + 1]))
        for i, k in enumerate(repeat)
    ]
    base = full.trajectories["raw"]
    index = np.arange(count + 1) % len(base)

    def long() -> Trajectory:
        covariances = base.covariances[index] * rng.uniform(0.5, 1.5, (count + 1, 1, 1))  # type: ignore[index]
        wobble = base.poses[index].translation + rng.normal(size=(count + 1, 3))
        return Trajectory(stamps, type(base.poses).from_components(wobble, base.poses[index].rotation), covariances)

    trajectories = {name: long() for name in (*full.trajectories, "posegraph_online", "ekf_smoothed")}
    truth = replace(long(), covariances=None)
    imu_stamps = full.start_ns + np.arange(10 * count, dtype=np.int64) * 10_370_000 + rng.integers(0, 10**6, 10 * count)
    imu = ImuSeries(imu_stamps, rng.normal(size=(10 * count, 3)), rng.normal(size=(10 * count, 3)))
    series = {
        name: replace(
            each,
            **{
                field: rng.normal(size=(count + 1, *getattr(each, field).shape[1:]))
                for field in each.__slots__
                if field not in {"stamps_ns", "used"}
            },
            stamps_ns=stamps,
            used=np.ones(count + 1, dtype=bool),
        )
        for name, each in full.series.items()
    }
    size = content_module.MAX_THUMBNAIL_BYTES // content_module.MAX_THUMBNAILS
    images = [Thumbnail(int(stamp), rng.bytes(size)) for stamp in stamps[:: count // content_module.MAX_THUMBNAILS]]
    large = replace(
        full,
        trajectories=trajectories,
        metrics={},
        pairs=pairs,
        frame_stamps_ns=stamps,
        ground_truth=truth,
        imu=imu,
        series=series,
        thumbnails=images,
    )
    assert len(page(large).encode()) < MAX_BYTES


# ---------------------------------------------------------------------------------------------- the data


def test_the_data_are_the_trajectories_and_their_errors(full: ReportContent, html: str) -> None:
    document = json.loads(_unpacked(html, "data"))
    columns = document["columns"]
    assert [path["name"] for path in document["paths"]] == list(full.trajectories)
    for path in document["paths"]:
        trajectory = full.trajectories[path["name"]]
        positions = np.stack([columns[path[axis]] for axis in "xyz"], axis=1)
        assert_allclose(positions, trajectory.poses.translation, rtol=1e-5, atol=1e-9)
        assert_allclose(columns[path["t"]], full.seconds(trajectory.stamps_ns), atol=1e-6)
        assert full.ground_truth is not None
        error = np.linalg.norm(errors_over_time(trajectory, full.ground_truth).position_error_m, axis=1)
        assert_allclose(columns[path["error"]], error, rtol=1e-5, atol=1e-9)
    assert len(document["loops"]) == 2
    assert [loop["used"] for loop in document["loops"]] == [["posegraph"], []]
    assert len(document["thumbnails"]) == len(full.thumbnails)


def test_what_is_not_finite_is_null(full: ReportContent) -> None:
    nis = full.series["ekf"].nis.copy()
    nis[:3] = np.nan, np.inf, 1.0
    holed = replace(full, series={"ekf": replace(full.series["ekf"], nis=nis)})
    document = json.loads(_unpacked(page(holed), "data"), parse_constant=pytest.fail)
    figure = next(each for each in document["figures"] if each["key"] == "nis")
    assert document["columns"][figure["rows"][0]["lines"][0]["y"]][:3] == [None, None, 1.0]


def test_gnss_positions_are_drawn_believed_ones_apart(full: ReportContent) -> None:
    stamps = full.trajectories["posegraph"].stamps_ns[::10]
    places = full.trajectories["posegraph"].poses[::10].translation + [0.0, 1.0, 0.0]
    used = np.arange(len(stamps)) != 3
    document = json.loads(_unpacked(page(replace(full, fixes=PlacedFixes(stamps, places, used))), "data"))
    assert [fixes["used"] for fixes in document["fixes"]] == [True, False]
    for fixes, chosen in zip(document["fixes"], (used, ~used), strict=True):
        drawn = np.stack([document["columns"][fixes[axis]] for axis in "xyz"], axis=1)
        assert_allclose(drawn, places[chosen], rtol=1e-5, atol=1e-9)
        assert_allclose(document["columns"][fixes["t"]], full.seconds(stamps[chosen]), atol=1e-6)
    assert json.loads(_unpacked(page(full), "data"))["fixes"] == []


def test_the_mean_nis_is_beside_its_line(full: ReportContent) -> None:
    for name, series in full.series.items():
        lines = [line.name for row in _by_key(full)["nis"].rows for line in row.lines if line.style == name]
        assert [f"mean {np.nanmean(series.nis):.3g}" in line for line in lines] == [True]


def test_what_is_nearly_zero_does_not_stretch_a_logarithmic_axis(full: ReportContent) -> None:
    """The last pair of a chain has nothing to contradict it: its NIS is 1e-25."""
    nis = full.series["posegraph"].nis.copy()
    nis[-1] = 1e-25
    shown = _by_key(replace(full, series={"posegraph": replace(full.series["posegraph"], nis=nis)}))["nis"]
    assert np.nanmin(_line(shown, 0, "pose graph").y) == NEARLY_ZERO


# ---------------------------------------------------------------------------------------------- the verdict


def test_the_verdict_compares_with_raw(full: ReportContent) -> None:
    said = verdict(full).text
    metrics = full.metrics["posegraph"]
    assert said.startswith(f"Pose graph: ATE {metrics.ate_m:.2f} m over ")
    assert "better than raw" in said
    assert "IMU used" in said
    assert "1 warning." in said


def test_an_imu_that_no_back_end_wants_is_not_called_used(full: ReportContent) -> None:
    """As where it contradicts the pairs although it could be calibrated."""
    none = np.full_like(full.series["posegraph"].gyro_bias, np.nan)
    refused = {name: replace(each, gyro_bias=none) for name, each in full.series.items()}
    assert "IMU calibrated, but no back end used it" in verdict(replace(full, series=refused)).text
    assert full.calibration is not None
    left_out = replace(full.calibration, used=False)
    assert "IMU left out" in verdict(replace(full, series=refused, calibration=left_out)).text


def test_a_run_worse_than_raw_is_called_bad(full: ReportContent) -> None:
    swapped = {"raw": full.metrics["posegraph"], "posegraph": full.metrics["raw"]}
    said = verdict(replace(full, metrics=swapped))
    assert "worse than raw" in said.text
    assert said.status == "bad"


def test_an_overconfident_run_is_no_good_run(full: ReportContent) -> None:
    metrics = {**full.metrics, "posegraph": replace(full.metrics["posegraph"], anees_position=50.0)}
    said = verdict(replace(full, metrics=metrics, series={}, warnings={}))
    assert "its position errors are 4.1 times its sigmas: overconfident (ANEES 50, 3 is right)" in said.text
    assert said.status == "caution"


def test_verdict_table_and_figure_judge_an_anees_by_one_rule(full: ReportContent) -> None:
    """What the legend calls overconfident is what the verdict calls so, for position and for orientation."""
    _, high = anees_bounds()
    for what in ("position", "orientation"):
        for value, word in ((high - 0.01, "consistent"), (high + 0.01, "overconfident")):
            metrics = replace(full.metrics["posegraph"], **{f"anees_{what}": value})
            said = verdict(replace(full, metrics={**full.metrics, "posegraph": metrics}, series={}, warnings={}))
            assert f"its {what} errors are 1.3 times its sigmas: {word} (ANEES {value:.3g}, 3 is right)" in said.text
            assert (said.status == "caution") == (word == "overconfident")
    assert f"ANEES: 3 is right, above {high:.1f} is overconfident" in _read(page(full)).text
    assert f"above {high:.1f} is overconfident" in _by_key(full)["nees"].caption


def test_the_verdict_says_where_the_camera_was_at_the_end(full: ReportContent) -> None:
    right, down, ahead = full.trajectories["posegraph"].poses.translation[-1]
    said = verdict(full).text
    assert f"{abs(right):.1f} m {'right' if right > 0 else 'left'}" in said
    assert f"{abs(down):.1f} m {'below' if down > 0 else 'above'}" in said
    assert f"{abs(ahead):.1f} m {'ahead' if ahead > 0 else 'behind'} of where it began (stated sigma" in said


def test_the_verdict_says_how_the_camera_was_turned_at_the_end(full: ReportContent) -> None:
    """By the angles that the printout has, each with its side, and the sigma of `at_end` in degrees."""
    trajectory = full.trajectories["posegraph"]
    covariances = np.zeros((len(trajectory), 6, 6))
    covariances[-1, :3, :3] = np.deg2rad(1.5) ** 2 / 3 * np.eye(3)
    for sign, sides in ((1.0, ("right", "up", "clockwise")), (-1.0, ("left", "down", "counterclockwise"))):
        last = Rotation.from_euler("YXZ", sign * np.array([30.0, 20.0, 10.0]), degrees=True)
        rotations = Rotation.concatenate([trajectory.poses.rotation[:-1], last])
        poses = RigidTransform.from_components(trajectory.poses.translation, rotations)
        turned = Trajectory(trajectory.stamps_ns, poses, covariances)
        said = verdict(replace(full, trajectories={**full.trajectories, "posegraph": turned})).text
        angles = ", ".join(f"{angle}.0 deg {side}" for angle, side in zip((30, 20, 10), sides, strict=True))
        assert f"turned {angles} (stated sigma 1.5 deg)" in said


def test_the_verdict_counts_how_often_a_fault_was_there(full: ReportContent) -> None:
    """Wrong pairs side by side are one time, those apart are two; of how many pairs each is, its event says."""

    def wrong(*which: int) -> str:
        pairs = list(full.pairs)
        for i in which:
            pairs[i] = replace(pairs[i], translation=pairs[i].translation + [0.0, 0.0, 5.0])
        return verdict(replace(full, pairs=pairs, series={})).text

    assert re.search(r"found wrong pairs[;.]", wrong(100, 101))
    assert "found wrong pairs (2 times)" in wrong(100, 101, 200)


def test_a_hole_in_everything_leads_the_verdict_with_the_time_from_which_the_pose_is_lost() -> None:
    def cut(pairs: list[PairEstimate], imu: ImuSeries) -> tuple[list[PairEstimate], ImuSeries]:
        kept = (np.arange(len(imu)) < 1000) | (np.arange(len(imu)) >= 2200)
        return pairs, ImuSeries(imu.stamps_ns[kept], imu.angular_velocity[kept], imu.linear_acceleration[kept])

    run = content(40.0, cut)
    run = replace(run, pairs=[*run.pairs[:100], *run.pairs[220:]])
    assert "a loop closure ties the poses after it" in verdict(run).text
    run = replace(run, loops=())
    said = verdict(run)
    assert said.text.startswith(
        "The absolute pose is lost after 10.0 s: nothing measured the motion from 10.0 to 22.0 s, and all poses after "
        "it rest on 12.0 s of extrapolation"
    )
    assert said.status == "bad"
    assert said.sentences[0] in _read(page(run)).text


def test_a_damaged_log_is_named_in_the_verdict_with_when_the_result_ends(full: ReportContent) -> None:
    said = verdict(replace(full, damage=["the file is cut or unfinished: its data ends at byte 6 of 9"]))
    assert said.text.startswith("The log is damaged: the file is cut or unfinished: its data ends at byte 6 of 9; ")
    assert "until 39.9 s." in said.text
    assert said.status == "caution"
    many = verdict(replace(full, damage=[f"chunk {i}" for i in range(5)])).text
    assert "chunk 2; and 2 more faults; the result is" in many


def test_without_ground_truth_the_verdict_is_about_consistency(full: ReportContent) -> None:
    said = verdict(replace(full, ground_truth=None, metrics={}))
    series = full.series["posegraph"]
    low, high = nis_bounds()
    inside = np.mean((series.nis >= low) & (series.nis <= high))
    assert "o ground truth" in said.text
    assert f"NIS inside its 95 % bounds for {100.0 * inside:.0f} % of the pairs" in said.text
    assert "pose graph and EKF differ by" in said.text
    assert "of where it began (stated sigma" in said.text


def test_a_good_run_without_faults_is_good(full: ReportContent) -> None:
    assert verdict(replace(full, series={}, warnings={})).status == "good"


def test_every_kind_of_fault_is_named_in_the_verdict_and_in_the_events() -> None:
    def damage(pairs: list[PairEstimate], imu: ImuSeries) -> tuple[list[PairEstimate], ImuSeries]:
        rates = imu.angular_velocity.copy()
        rates[1000:1500] = rates[1000]
        at = np.arange(len(imu))
        kept = (at < 500) | (at >= 700)
        stamps = imu.stamps_ns + np.where(at >= 3000, 400_000_000, 0)
        for i in (80, 250):
            pairs[i] = replace(pairs[i], translation=pairs[i].translation + [0.0, 0.0, 5.0])
        return pairs, ImuSeries(stamps[kept], rates[kept], imu.linear_acceleration[kept])

    run = content(60.0, damage)
    run = replace(run, frame_stamps_ns=np.delete(run.frame_stamps_ns, [330, 331]), series={})
    kinds = {event.kind for event in run.events}
    expected = {events.IMU_GAP, events.STUCK, events.CLOCK_JUMP, events.DROPPED_FRAMES, events.WRONG_PAIR}
    assert expected <= kinds
    text = _read(page(run)).text
    for kind in expected:
        assert kind in verdict(run).text
        assert text.count(kind) >= 2


# ---------------------------------------------------------------------------------------------- the figures


def test_every_figure_is_drawn_or_says_why_not(full: ReportContent, bare: ReportContent) -> None:
    for figure in _by_key(full).values():
        assert figure.rows, figure.key
        assert not figure.missing
    for figure in _by_key(bare).values():
        assert bool(figure.rows) != bool(figure.missing), figure.key
    text = _read(page(bare)).text
    for reason in ("no ground truth", "no innovations", "No loop closures", "only one fused", "without hypotheses"):
        assert reason in text


def test_lines_have_as_many_times_as_values(full: ReportContent) -> None:
    for figure in _by_key(full).values():
        for row in figure.rows:
            for line in row.lines:
                assert len(line.x) == len(line.y) > 0, (figure.key, line.name)


def test_nees_over_time_has_the_mean_of_the_table(full: ReportContent) -> None:
    figure = _by_key(full)["nees"]
    for name, heading in (("raw", "raw"), ("posegraph", "pose graph"), ("ekf", "EKF")):
        assert_allclose(np.nanmean(_line(figure, 0, heading).y), full.metrics[name].anees_position)
        assert_allclose(np.nanmean(_line(figure, 1, heading).y), full.metrics[name].anees_orientation)


def test_drift_by_length_is_what_each_length_alone_gives(full: ReportContent) -> None:
    line = _line(_by_key(full)["segments"], 0, "EKF")
    assert_array_equal(line.x, LENGTHS_M)
    for length, value in zip(line.x, line.y, strict=True):
        alone = evaluate(full.trajectories["ekf"], full.ground_truth, [length])
        assert_allclose(value, alone.t_rel_percent)


def test_bands_are_three_sigma_of_the_chosen_trajectory(full: ReportContent) -> None:
    figure = _by_key(full)["components"]
    trajectory = full.trajectories["ekf"]
    assert trajectory.covariances is not None
    for row, axis in zip(figure.rows, (3, 4, 5, 0, 1, 2), strict=True):
        band = next(line for line in row.lines if line.only == "ekf" and line.mode == "band")
        scale = 1.0 if axis >= 3 else 180.0 / np.pi
        assert_allclose(band.y, 3.0 * scale * np.sqrt(trajectory.covariances[:, axis, axis]))


def test_the_error_of_the_estimate_is_that_of_its_pairs(full: ReportContent) -> None:
    figure = _by_key(full)["hypothesis-errors"]
    names, values = figure.rows[0].lines[0].x, figure.rows[0].lines[0].y
    assert list(names) == ["hypothesis 1", "hypothesis 2", "hypothesis 3", "hypothesis 4", "winner", "estimate"]
    assert_allclose(values[-1], full.metrics["raw"].rpe_translation_m, rtol=1e-3)
    assert values[4] == values[0] > 2.0 * values[-1]  # the winner is always the first, with three times the noise


def test_the_error_by_level_falls_to_that_of_the_estimate(full: ReportContent) -> None:
    figure = _by_key(full)["level-errors"]
    names, values = figure.rows[0].lines[0].x, figure.rows[0].lines[0].y
    assert list(names) == ["level 0", "level 1", "level 2", "level 3", "level 4", "estimate"]
    assert_allclose(values[:4] / values[1:5], 2.0, rtol=0.02)  # as the samples are made
    assert_allclose(values[-2:], full.metrics["raw"].rpe_translation_m, rtol=1e-3)
    assert _by_key(replace(full, levels=()))["level-errors"].missing.startswith("The pair estimates were recorded")
    assert "no ground truth" in _by_key(replace(full, ground_truth=None))["level-errors"].missing


def test_agreement_is_zero_between_equals_and_in_sigmas_otherwise(full: ReportContent) -> None:
    same = replace(full, trajectories={**full.trajectories, "ekf": full.trajectories["posegraph"]})
    assert_allclose(agreements(same)[0].distance_m, 0.0, atol=1e-9)
    (found,) = agreements(full)
    stated = found.sigma_m > 0.0
    assert_allclose(found.worst, np.max(found.distance_m[stated] / found.sigma_m[stated]))


def test_thinning_out_keeps_whatever_sticks_out(full: ReportContent) -> None:
    assert full.imu is not None
    count = 10 * MAX_SAMPLES
    rates = np.zeros((count, 3))
    rates[12_345, 0], rates[23_456, 1] = 7.0, 9.0
    stamps = full.start_ns + np.arange(count, dtype=np.int64) * 10_000_000
    imu = ImuSeries(stamps, rates, np.ones((count, 3)))
    line = _line(_by_key(replace(full, imu=imu))["motion"], 1, "gyro")
    assert len(line.y) <= MAX_SAMPLES
    assert_allclose(sorted(line.y)[-2:], np.rad2deg([7.0, 9.0]))
    assert np.all(np.diff(line.x) > 0.0)


def test_no_line_leads_across_an_imu_gap(full: ReportContent) -> None:
    assert full.imu is not None
    kept = (np.arange(len(full.imu)) < 1000) | (np.arange(len(full.imu)) >= 1500)
    imu = ImuSeries(full.imu.stamps_ns[kept], full.imu.angular_velocity[kept], full.imu.linear_acceleration[kept])
    line = _line(_by_key(replace(full, imu=imu))["motion"], 1, "gyro")
    assert_allclose(line.x[np.isnan(line.y)], 12.495, atol=0.01)


# ---------------------------------------------------------------------------------------------- the images


def test_thumbnails_keep_their_shape_and_colours() -> None:
    wide = np.zeros((375, 1242, 3), dtype=np.uint8)
    wide[..., 0] = 250  # red
    picture = cv2.imdecode(np.frombuffer(content_module._jpeg(wide), np.uint8), cv2.IMREAD_COLOR)
    assert picture.shape == (97, 320, 3)
    assert picture[..., 2].mean() > 200.0  # BGR: red is last
    assert picture[..., 0].mean() < 50.0
    assert cv2.imdecode(np.frombuffer(content_module._jpeg(wide[:10, :20, 0]), np.uint8), 0).shape == (10, 20)


def test_thumbnails_are_spread_over_the_log_and_closer_than_half_a_second_to_each_time(tmp_path: Path) -> None:
    log = open_log(write_sample(tmp_path / "log.mcap", 50))
    found = [each.stamp_ns for each in content_module.thumbnails(log)]
    stamps = log.frame_stamps()
    assert set(found) <= set(stamps.tolist())
    assert (found[0], found[-1]) == (stamps[0], stamps[-1])
    assert 5 < len(found) < len(stamps)
    assert max(np.diff(found)) <= content_module.THUMBNAIL_PERIOD_S * 1e9


def test_a_log_with_many_large_images_stays_within_the_budget(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    log = open_log(write_sample(tmp_path / "log.mcap", 50))
    whole = content_module.thumbnails(log)
    monkeypatch.setattr(content_module, "MAX_THUMBNAIL_BYTES", sum(len(each.jpeg) for each in whole) // 3)
    fewer = content_module.thumbnails(log)
    assert [each.stamp_ns for each in fewer] == [each.stamp_ns for each in whole][::4]


def test_a_log_without_images_has_no_thumbnails(tmp_path: Path) -> None:
    with LogWriter(tmp_path / "log.mcap") as writer:
        writer.pairs(pair_estimates())
    assert content_module.thumbnails(open_log(tmp_path / "log.mcap")) == []
