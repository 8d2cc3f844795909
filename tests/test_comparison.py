"""Comparisons say who is better, where, and only what the data can bear; inputs of every kind are understood."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose
from trajectory_samples import COUNT, TRUTH, walk

from fusion import comparison
from fusion.compare import main
from fusion.comparison_page import page
from fusion.evaluation import evaluate
from fusion.results import Result, key_of, read_results
from fusion_io.errors import LogError, UsageError
from fusion_io.records import Trajectory
from fusion_io.trajectory_files import write_kitti, write_tum
from fusion_io.writer import LogWriter

LENGTHS = (20.0, 50.0)


def _result(key: str, trajectory: Trajectory, truth: Trajectory | None = TRUTH) -> Result:
    return Result(key, f"run {key}", Path(f"{key}.mcap"), {"raw": trajectory}, truth)


def _duel(a: Trajectory, b: Trajectory) -> comparison.Duel:
    (duel,) = comparison.compare([_result("a", a), _result("b", b)], None, LENGTHS).duels
    return duel


# --- Laws ---------------------------------------------------------------------------------------


def test_a_trajectory_differs_from_itself_by_nothing() -> None:
    duel = _duel(walk(1), walk(1))
    for difference in duel.differences.values():
        assert_allclose([difference.mean, difference.low, difference.high], 0.0, atol=1e-9)
        assert difference.verdict == "not significant"


def test_trajectories_with_the_same_noise_are_seldom_told_apart() -> None:
    """Intervals of 95 %: two of forty are expected, more than six would be seen in less than one of a hundred."""
    verdicts = [_duel(walk(seed), walk(seed + 100)).differences["t_rel_percent"].verdict for seed in range(1, 41)]
    assert verdicts.count("not significant") > 0
    assert verdicts.count("better") + verdicts.count("worse") <= 6


def test_added_drift_is_found_and_flips_its_sign_with_the_order() -> None:
    good, bad = walk(1), walk(2, drift=5e-4)
    forward, back = _duel(good, bad), _duel(bad, good)
    for measure in comparison.MEASURES:
        assert forward.differences[measure].verdict == "worse"
        assert back.differences[measure].verdict == "better"
        assert_allclose(forward.differences[measure].mean, -back.differences[measure].mean, rtol=1e-9)


def test_the_place_where_it_is_worse_is_found() -> None:
    duel = _duel(walk(1), walk(1, drift=1e-3, from_step=400))
    differences = [stretch.difference("r_rel_deg_per_100m") for stretch in duel.stretches]
    assert len(differences) == comparison.STRETCHES
    for stretch, difference in zip(duel.stretches, differences, strict=True):
        if stretch.end_m < 400 - LENGTHS[0]:
            assert_allclose(difference, 0.0, atol=1e-6)
        if stretch.start_m > 400 and stretch.end_m < 590:
            assert difference > 1.0


def test_the_measures_are_those_of_the_evaluation_and_their_difference_is_the_difference() -> None:
    a, b = walk(1), walk(2, drift=5e-4)
    compared = comparison.compare([_result("a", a), _result("b", b)], None, LENGTHS)
    assert compared.metrics == {"a.raw": evaluate(a, TRUTH, LENGTHS), "b.raw": evaluate(b, TRUTH, LENGTHS)}
    for measure in comparison.MEASURES:
        expected = compared.measures[f"b.raw.{measure}"] - compared.measures[f"a.raw.{measure}"]
        assert_allclose(compared.duels[0].differences[measure].mean, expected, rtol=1e-9)


def test_trajectories_at_other_stamps_are_compared_on_the_same_segments() -> None:
    """Every third frame of the same estimate, from the tenth on: linear between frames is good to millimetres."""
    sparse = Trajectory(walk(1).stamps_ns[9::3], walk(1).poses[9::3])
    duel = _duel(walk(1), sparse)
    assert len(duel.stamps_ns) == COUNT - 9 - 2
    assert abs(duel.differences["t_rel_percent"].mean) < 0.02


def test_without_ground_truth_the_distance_is_given_and_nobody_is_better() -> None:
    a, b = walk(1), walk(2)
    compared = comparison.compare([_result("a", a, None), _result("b", b, None)], None, LENGTHS)
    assert not compared.duels
    (deviation,) = compared.deviations
    assert deviation.measures == evaluate(b, a, LENGTHS)
    assert set(compared.measures.values()) == {None, 0}


def test_ground_truth_of_one_input_serves_all_and_one_that_is_given_comes_first() -> None:
    a, b = _result("a", walk(1), None), _result("b", walk(2))
    compared = comparison.compare([a, b], None, LENGTHS)
    assert compared.metrics["a.raw"] == evaluate(walk(1), TRUTH, LENGTHS)
    compared = comparison.compare([a, b], walk(3), LENGTHS)
    assert compared.metrics["b.raw"] == evaluate(walk(2), walk(3), LENGTHS)


def test_inputs_of_other_times_are_not_compared_and_that_is_said() -> None:
    late = replace(walk(2), stamps_ns=walk(2).stamps_ns + 10**15)
    compared = comparison.compare([_result("a", walk(1)), _result("b", late)], None, LENGTHS)
    assert not compared.duels
    assert compared.notes == ["a.raw and b.raw are not compared: they and the ground truth have no times in common"]


def test_inputs_that_cover_different_times_are_said_to() -> None:
    """Who covers what, counted from the first of all; inputs that begin and end together need no remark."""
    whole = walk(1)
    part = Trajectory(whole.stamps_ns[100:300], whole.poses[100:300])
    assert comparison.compare([_result("a", whole), _result("b", walk(2))], None, LENGTHS).notes == []
    (note,) = comparison.compare([_result("a", whole), _result("b", part)], None, LENGTHS).notes
    first, last = ((stamp - whole.stamps_ns[0]) / 1e9 for stamp in part.stamps_ns[[0, -1]])
    end = (whole.stamps_ns[-1] - whole.stamps_ns[0]) / 1e9
    covered = f"a (run a) 0.0 to {end:.1f} s, b (run b) {first:.1f} to {last:.1f} s"
    assert note.startswith(f"the inputs cover different times: {covered}; ")


def test_equals_are_none_of_them_the_best() -> None:
    same = comparison.compare([_result("a", walk(1)), _result("b", walk(1))], None, LENGTHS)
    assert same.best("ate_m") == set()
    other = comparison.compare([_result("a", walk(1)), _result("b", walk(2, drift=5e-4))], None, LENGTHS)
    assert other.best("ate_m") == {"a.raw"}


def test_who_meets_whom() -> None:
    poses = walk(1)
    run = Result("a", "run", Path("a"), dict.fromkeys(("raw", "posegraph", "ekf"), poses), TRUTH)
    other = Result("b", "other", Path("b"), dict.fromkeys(("raw", "ekf"), poses), TRUTH)
    single = Result("c", "file", Path("c"), {"trajectory": poses}, TRUTH)

    def pairs(*inputs: Result) -> list[tuple[str, str]]:
        return [(a.name, b.name) for a, b in comparison.opponents(inputs)]

    assert pairs(run) == [("a.raw", "a.posegraph"), ("a.raw", "a.ekf")]
    assert pairs(run, other) == [("a.raw", "b.raw"), ("a.ekf", "b.ekf")]
    assert pairs(run, single) == [(f"a.{name}", "c.trajectory") for name in run.trajectories]
    assert pairs(single, other) == [("c.trajectory", "b.raw"), ("c.trajectory", "b.ekf")]
    assert pairs(other, run) == [
        ("b.raw", "a.raw"),
        ("b.raw", "a.posegraph"),
        ("b.ekf", "a.posegraph"),
        ("b.ekf", "a.ekf"),
    ]


# --- Inputs -------------------------------------------------------------------------------------


def _files(folder: Path) -> tuple[Path, Path, Path]:
    """A run's log, a TUM file and a KITTI file."""
    with LogWriter(folder / "run.mcap", {"config": {"toml": "segment_lengths_m = [20.0, 50.0]"}}) as log:
        log.ground_truth(TRUTH)
        log.trajectory("raw", walk(1))
    write_tum(folder / "other.tum", walk(2))
    write_kitti(folder / "other.txt", walk(2))
    return folder / "run.mcap", folder / "other.tum", folder / "other.txt"


def test_a_run_its_folder_and_text_files_are_the_same_trajectories(tmp_path: Path) -> None:
    log, tum, kitti = _files(tmp_path)
    (run, folder, of_tum, of_kitti), _ = read_results([log, tmp_path, tum, kitti])
    assert [each.key for each in (run, folder, of_tum, of_kitti)] == ["a", "b", "c", "d"]
    assert_allclose(run.trajectories["raw"].poses.as_matrix(), walk(1).poses.as_matrix(), atol=1e-9)
    assert folder.path == log
    for each in (of_tum, of_kitti):
        assert_allclose(each.trajectories["trajectory"].poses.as_matrix(), walk(2).poses.as_matrix(), atol=1e-9)
        assert np.array_equal(each.trajectories["trajectory"].stamps_ns, TRUTH.stamps_ns)
    assert comparison.compare([run, of_tum]).segment_lengths_m == LENGTHS


def test_kitti_files_alone_are_compared_by_index(tmp_path: Path) -> None:
    for name, trajectory in (("a.txt", walk(1)), ("b.txt", walk(2)), ("truth.txt", TRUTH)):
        write_kitti(tmp_path / name, trajectory)
    inputs, truth = read_results([tmp_path / "a.txt", tmp_path / "b.txt"], (), None, tmp_path / "truth.txt")
    compared = comparison.compare(inputs, truth, LENGTHS)
    assert_allclose(compared.measures["b.trajectory.ate_m"], evaluate(walk(2), TRUTH).ate_m, rtol=1e-6)


def test_a_kitti_file_that_fits_no_input_needs_times(tmp_path: Path) -> None:
    _, tum, _ = _files(tmp_path)
    write_kitti(tmp_path / "short.txt", walk(1, count=50))
    with pytest.raises(UsageError, match="no input has 50 poses: give --times"):
        read_results([tum, tmp_path / "short.txt"])
    (tmp_path / "times.txt").write_text("".join(f"{k / 10}\n" for k in range(50)))
    (_, short), _ = read_results([tum, tmp_path / "short.txt"], (), tmp_path / "times.txt")
    assert len(short.trajectories["trajectory"]) == 50


def test_a_kitti_file_has_the_times_of_a_ground_truth_with_as_many_poses(tmp_path: Path) -> None:
    _, tum, kitti = _files(tmp_path)
    (result,), truth = read_results([kitti], (), None, tum)
    assert truth is not None
    assert np.array_equal(result.trajectories["trajectory"].stamps_ns, TRUTH.stamps_ns)
    (result,), truth = read_results([tum], (), None, kitti)
    assert truth is not None
    assert np.array_equal(truth.stamps_ns, TRUTH.stamps_ns)


@pytest.mark.parametrize(
    ("content", "reason"),
    [(None, "no such file"), (b"", "holds no data"), (b"\xff\xfe\x00", "not a text file"), (b"1 2 3\n", "3 columns")],
)
def test_an_input_that_cannot_be_used_is_an_error_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], content: bytes | None, reason: str
) -> None:
    if content is not None:
        (tmp_path / "x.txt").write_bytes(content)
    assert main([str(tmp_path / "x.txt")]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert str(tmp_path / "x.txt") in line
    assert reason in line


def test_a_folder_without_a_log_says_what_can_be_compared_in_its_place(tmp_path: Path) -> None:
    """As what a replay writes has none."""
    write_tum(tmp_path / "posegraph.tum", TRUTH)
    with pytest.raises(LogError, match=r"run\.mcap: no such file; beside it are posegraph\.tum: give one of them"):
        read_results([tmp_path])


def test_a_log_without_trajectories_is_an_error(tmp_path: Path) -> None:
    with LogWriter(tmp_path / "input.mcap") as log:
        log.ground_truth(TRUTH)
    with pytest.raises(LogError, match=r"no trajectory to compare \(run fusion.run on it first\)"):
        read_results([tmp_path / "input.mcap"])


def test_names_are_one_an_input_and_different(tmp_path: Path) -> None:
    _, tum, kitti = _files(tmp_path)
    assert [each.label for each in read_results([tum, kitti], ["x", "y"])[0]] == ["x", "y"]
    (tmp_path / "x").mkdir()
    write_tum(tmp_path / "x" / "other.tum", TRUTH)
    labels = [each.label for each in read_results([tum, tum, tmp_path / "x" / "other.tum", tmp_path / "run.mcap"])[0]]
    folder = tmp_path.name
    assert labels == [f"{folder}/other (a)", f"{folder}/other (b)", "x/other", folder]
    for names, reason in ((["x"], "1 name for 2 inputs"), (["x", "x"], "'x' is there twice")):
        with pytest.raises(UsageError, match=reason):
            read_results([tum, kitti], names)


def test_keys_are_letters_without_end() -> None:
    keys = [key_of(i) for i in range(26 * 27 + 1)]
    assert (keys[0], keys[25], keys[26], keys[27], keys[-1]) == ("a", "z", "aa", "ab", "aaa")
    assert len(set(keys)) == len(keys)


# --- What is shown ------------------------------------------------------------------------------


def test_the_page_holds_everything_and_loads_nothing(tmp_path: Path) -> None:
    compared = comparison.compare([_result("a", walk(1)), _result("b", walk(2, drift=5e-4))], None, LENGTHS)
    text = page(compared)
    assert text == page(compared)
    assert re.search(r"<(script|link|img)[^>]+(src|href)=", text) is None
    for plot in ("from-above", "by-length", "where-0", "along-0", "length-0-t_rel_percent"):
        assert f'id="{plot}"' in text
    assert "worse" in text
    assert len(text.encode()) < 8e6


def test_names_cannot_break_the_page() -> None:
    evil = replace(_result("a", walk(1)), label="<script>alert(1)</script>")
    without_truth = replace(evil, ground_truth=None)
    for inputs in ([evil, _result("b", walk(2))], [without_truth, _result("b", walk(2), None)]):
        assert "<script>alert(1)" not in page(comparison.compare(inputs, None, LENGTHS))


def test_the_document_is_json_without_nan() -> None:
    for truth in (TRUTH, None):
        inputs = [_result("a", walk(1), truth), _result("b", walk(2), truth)]
        text = json.dumps(comparison.document(comparison.compare(inputs, None, LENGTHS)), allow_nan=False)
        assert json.loads(text)["schema"] == comparison.SCHEMA
