"""What run, replay and API share: what the back ends get, and that the failure of one does not end the other."""

from dataclasses import replace
from types import ModuleType
from typing import Literal

import fault_samples as faults
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from benchmarks.drives import EKF, POSE_GRAPH, simulate
from fusion import ekf, fusing, online, posegraph
from fusion.config import RunConfig
from fusion.evaluation import evaluate
from fusion.imu import calibrate
from fusion.measurements import Measurements
from fusion_io.errors import LogError
from fusion_io.findings import Findings
from fusion_io.records import NANOSECONDS

DRIVE = simulate(0, 6.0)
KNOWN = DRIVE.measurements
CONFIG = RunConfig(posegraph=POSE_GRAPH, ekf=EKF)


def _config(backend: Literal["posegraph", "ekf", "both"]) -> RunConfig:
    return CONFIG.model_copy(update={"backend": backend})


@pytest.mark.parametrize(
    ("backend", "names"), [("both", ["posegraph", "ekf"]), ("posegraph", ["posegraph"]), ("ekf", ["ekf"])]
)
def test_only_the_back_ends_that_are_asked_for_give_an_estimate(
    backend: Literal["posegraph", "ekf", "both"], names: list[str]
) -> None:
    findings = Findings()
    estimates = fusing.fuse(KNOWN, _config(backend), findings)
    assert list(estimates) == names == list(fusing.back_ends(_config(backend)))
    assert findings.counts == {}
    for estimate in estimates.values():
        assert_array_equal(estimate.trajectory.stamps_ns, DRIVE.truth.stamps_ns)


@pytest.mark.parametrize("backend", ["both", "ekf"])
def test_the_filter_begins_with_the_mounting_of_the_pose_graph(
    backend: Literal["ekf", "both"], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whether the pose graph is asked for or not."""
    given: list[Measurements] = []
    solve = ekf.solve
    monkeypatch.setattr(ekf, "solve", lambda known, config: given.append(known) or solve(known, config))
    fusing.fuse(KNOWN, _config(backend), Findings())
    expected = posegraph.solve(KNOWN, POSE_GRAPH).mounting
    assert expected is not None
    assert given[0].mounting is not None
    assert_allclose(given[0].mounting.T_camera_imu, expected.T_camera_imu)
    assert_allclose(given[0].mounting.covariance, expected.covariance)


@pytest.mark.parametrize(("name", "back_end", "scale"), [("ekf", ekf, 0.07), ("posegraph_online", online, 0.002)])
def test_what_is_causal_is_told_how_large_the_errors_of_the_front_end_are(
    name: str, back_end: ModuleType, scale: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    graph = replace(posegraph.solve(KNOWN, POSE_GRAPH), front_end_sigma=(scale, 1e-3))
    monkeypatch.setattr(posegraph, "solve", lambda *_: graph)
    given: list[Measurements] = []
    solve = back_end.solve
    monkeypatch.setattr(back_end, "solve", lambda known, config: given.append(known) or solve(known, config))
    told = fusing.fuse(KNOWN, CONFIG.model_copy(update={"online": True}), Findings())[name]
    assert given[0].front_end_sigma == (scale, 1e-3)
    assumed = solve(replace(given[0], front_end_sigma=None), CONFIG.ekf if name == "ekf" else CONFIG.posegraph)
    sigmas = [np.sqrt(np.trace(each.trajectory.covariances[-1, 3:, 3:])) for each in (told, assumed)]
    larger = sigmas[0] / sigmas[1]  # the way is as uncertain as its scale
    assert larger > 1.5 if scale > POSE_GRAPH.pair_scale_sigma else larger < 0.8


@pytest.mark.parametrize("name", ["ekf", "posegraph_online"])
def test_what_is_causal_is_told_of_steps_of_the_biases_and_says_so(name: str) -> None:
    """It is the better for it, and who asks for the filter alone is told of them as well."""
    log = faults.simulated(3, 25.0)
    log = replace(log, imu=faults.accelerometer_bias_step(log.imu, 12.5, np.array([0.6, -0.3, 0.9])))
    calibration = calibrate(log.pairs, log.imu, None, None)
    known = fusing.measurements(log.pairs, log.imu, calibration, log.truth.stamps_ns, Findings())
    config = RunConfig(backend="ekf") if name == "ekf" else RunConfig(backend="posegraph", online=True)
    findings = Findings()
    told = fusing.fuse(known, config, findings)[name]
    assert findings.counts["imu_bias_steps"] == 1
    [step] = told.bias_steps
    assert f"{step} at 12 s" in told.note
    assert told.note.endswith("as the pose graph found")
    untold = ekf.solve(known, config.ekf) if name == "ekf" else online.solve(known, config.posegraph)
    ate_m = [evaluate(each.trajectory, log.truth).ate_m for each in (told, untold)]
    assert ate_m[0] is not None
    assert ate_m[1] is not None
    assert ate_m[0] < ate_m[1]


def test_the_filter_uses_no_imu_that_the_pose_graph_had_to_leave_out() -> None:
    imu = KNOWN.imu
    assert imu is not None
    early = imu.stamps_ns < NANOSECONDS
    short = replace(
        imu,
        stamps_ns=imu.stamps_ns[early],
        angular_velocity=imu.angular_velocity[early],
        linear_acceleration=imu.linear_acceleration[early],
    )
    estimates = fusing.fuse(replace(KNOWN, imu=short), CONFIG, Findings())
    assert estimates["posegraph"].note.startswith("pairs only: the IMU measured")
    assert estimates["ekf"].note == "pairs only: no IMU; the pose graph had to leave the IMU out"


def test_who_asked_for_the_filter_alone_is_told_nothing_of_the_pose_graph(monkeypatch: pytest.MonkeyPatch) -> None:
    """Neither that it rejects pairs nor that it fails: it only helps the filter to a mounting."""
    graph = posegraph.solve(KNOWN, POSE_GRAPH)
    for helped in (lambda *_: replace(graph, rejected=3), lambda *_: fail()):
        monkeypatch.setattr(posegraph, "solve", helped)
        findings = Findings()
        assert list(fusing.fuse(KNOWN, _config("ekf"), findings)) == ["ekf"]
        assert findings.notes == []


def fail() -> None:
    raise RuntimeError("Indeterminant linear system")


@pytest.mark.parametrize("broken", ["posegraph", "ekf"])
@pytest.mark.parametrize(
    "error", [RuntimeError("Indeterminant\nlinear system"), np.linalg.LinAlgError("singular"), LogError("no pair")]
)
def test_a_back_end_that_fails_is_counted_and_the_other_is_kept(
    broken: str, error: Exception, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise error

    monkeypatch.setattr({"posegraph": posegraph, "ekf": ekf}[broken], "solve", fail)
    findings = Findings()
    estimates = fusing.fuse(Measurements(KNOWN.steps), CONFIG, findings)
    assert list(estimates) == [name for name in ("posegraph", "ekf") if name != broken]
    assert findings.counts == {f"{broken}_failed": 1}
    assert findings.notes == [f"back end failed ({broken}): {' '.join(str(error).split())}"]


def test_a_mistake_in_a_back_end_is_not_hidden(monkeypatch: pytest.MonkeyPatch) -> None:
    """Only what bad data can cause is caught."""

    def fail(*_: object) -> None:
        raise TypeError("a bug")

    monkeypatch.setattr(ekf, "solve", fail)
    with pytest.raises(TypeError):
        fusing.fuse(Measurements(KNOWN.steps), CONFIG, Findings())


def test_outliers_are_counted_by_back_end() -> None:
    pairs = list(KNOWN.steps)
    pairs[30] = replace(pairs[30], translation=pairs[30].translation + [3.0, 0.0, 0.0])
    findings = Findings()
    fusing.fuse(replace(KNOWN, steps=pairs), CONFIG, findings)
    assert findings.counts == {"posegraph_rejected": 1, "ekf_rejected": 1}
    assert [
        note for note in findings.notes if not note.startswith("single measurements (pairs, IMU, loops, GNSS)")
    ] == []


def test_an_imu_that_is_used_comes_on_the_cameras_clock_without_its_faulty_stretches() -> None:
    imu, calibration = KNOWN.imu, KNOWN.calibration
    assert imu is not None
    assert calibration is not None
    faulty_ns = np.array([[2 * NANOSECONDS, 3 * NANOSECONDS]])
    known = replace(calibration, time_offset_s=0.05, faulty_ns=faulty_ns)
    findings = Findings()
    found = fusing.measurements(KNOWN.steps, imu, known, DRIVE.truth.stamps_ns, findings)
    assert found.steps == list(KNOWN.steps)
    assert found.calibration is known
    assert found.imu is not None
    own_clock = found.imu.stamps_ns + round(0.05 * NANOSECONDS)
    assert_array_equal(own_clock, imu.stamps_ns[(imu.stamps_ns < faulty_ns[0, 0]) | (imu.stamps_ns > faulty_ns[0, 1])])
    assert findings.counts == {"imu_faulty_stretches": 1}


def test_an_imu_that_is_not_used_does_not_reach_the_back_ends_and_gaps_are_bridged_all_the_same() -> None:
    imu, calibration = KNOWN.imu, KNOWN.calibration
    assert imu is not None
    assert calibration is not None
    pairs = [pair for k, pair in enumerate(KNOWN.steps) if k not in (20, 21)]
    findings = Findings()
    left_out = replace(calibration, used=False)
    found = fusing.measurements(pairs, imu, left_out, DRIVE.truth.stamps_ns, findings)
    assert (found.imu, found.calibration) == (None, None)
    assert len(found.steps) == len(KNOWN.steps)
    assert findings.counts == {"gaps_bridged": 1}


def test_the_longest_gap_is_between_what_pairs_reach_and_the_next() -> None:
    """A pair that spans others hides what is between them; where nothing is missing there is none."""
    steps = list(KNOWN.steps)
    spanning = replace(steps[10], target_stamp_ns=steps[14].target_stamp_ns)
    assert fusing.longest_gap(steps)[0] == 0.0
    assert fusing.longest_gap([])[0] == 0.0
    assert fusing.longest_gap([*steps[:11], *steps[14:]])[0] == pytest.approx(0.3)
    assert fusing.longest_gap([*steps[:10], spanning, *steps[14:]])[0] == 0.0
    gap_s, begins_s = fusing.longest_gap([*steps[:5], *steps[7:20], *steps[30:]])
    assert (gap_s, begins_s) == (pytest.approx(1.0), pytest.approx(2.0))
