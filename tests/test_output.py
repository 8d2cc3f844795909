"""What a run writes: complete, valid, whole or not at all, and readable again."""

import json
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from report_samples import series_of
from scipy.spatial.transform import RigidTransform, Rotation

from fusion import config, output
from fusion.evaluation import Metrics, evaluate
from fusion.imu import BiasStep, Change, ImuCalibration
from fusion.measurements import Estimate
from fusion_io.errors import LogError, UsageError
from fusion_io.findings import Findings
from fusion_io.reader import open_log
from fusion_io.records import CameraFrame, CameraInfo, ImuSeries, PairEstimate, Trajectory
from fusion_io.trajectory_files import read_kitti_poses, read_tum
from fusion_io.writer import LogWriter

FRAMES = 12
STAMPS_NS = 10**9 + 10**8 * np.arange(FRAMES)
SECONDS = {"read": 0.5, "raw": 1.5}
MOUNTING = Rotation.from_quat([0.5, -0.5, 0.5, -0.5], scalar_first=True)
CAMERA = CameraInfo(8, 6, np.array([[9.0, 0.0, 3.5], [0.0, 9.0, 2.5], [0.0, 0.0, 1.0]]), frame_id="left")
FILES = {
    "run.mcap",
    "metrics.json",
    "config.toml",
    "trajectories.png",
    "errors.png",
    "raw.tum",
    "posegraph.tum",
    "report.html",
    "ekf.tum",
    "raw.kitti.txt",
    "posegraph.kitti.txt",
    "ekf.kitti.txt",
}


def _trajectory(seed: int) -> Trajectory:
    rng = np.random.default_rng(seed)
    poses = [RigidTransform.identity()]
    for step in RigidTransform.from_exp_coords(0.1 * rng.normal(size=(FRAMES - 1, 6))):
        poses.append(poses[-1] * step)
    return Trajectory(STAMPS_NS, RigidTransform.concatenate(poses), np.tile(0.1 * np.eye(6), (FRAMES, 1, 1)))


def _pairs() -> list[PairEstimate]:
    rng = np.random.default_rng(5)
    quats = Rotation.random(FRAMES - 1, rng=rng).as_quat(scalar_first=True)
    return [
        PairEstimate(int(source), int(target), quat, rng.normal(size=3), np.diag(rng.uniform(0.1, 1.0, 6)))
        for source, target, quat in zip(STAMPS_NS[:-1], STAMPS_NS[1:], quats, strict=True)
    ]


def _imu() -> ImuSeries:
    rng = np.random.default_rng(6)
    return ImuSeries(10**9 + 10**7 * np.arange(100), rng.normal(size=(100, 3)), rng.normal(size=(100, 3)), 0.003, 0.07)


@pytest.fixture
def outcome(tmp_path: Path) -> output.Outcome:
    """A run over a log that has everything."""
    rng = np.random.default_rng(7)
    truth = replace(_trajectory(0), covariances=None)
    with LogWriter(tmp_path / "source.mcap") as writer:
        writer.imu(_imu())
        writer.pairs(_pairs())
        writer.ground_truth(truth)
        for stamp in STAMPS_NS:
            image = rng.integers(0, 256, (6, 8), dtype=np.uint8)
            writer.frame(CameraFrame(int(stamp), image, np.full((6, 8), 2.0, dtype=np.float32), CAMERA))
    log = open_log(tmp_path / "source.mcap")
    findings = Findings()
    findings.put("gaps_bridged", 2, "2 gaps")
    trajectories = {name: _trajectory(seed) for seed, name in enumerate(("raw", "posegraph", "ekf"))}
    return output.Outcome(
        log,
        config.load(None, {}),
        log.imu(),
        log.pairs(),
        log.ground_truth(),
        ImuCalibration(MOUNTING, 0.065, np.zeros(3), True, "it agrees with the pairs"),
        trajectories,
        {},
        {name: evaluate(each, truth, [0.2]) for name, each in trajectories.items()},
        findings,
    )


def _write(folder: Path, outcome: output.Outcome) -> Path:
    output.prepare_folder(folder, outcome.log.path)
    output.write_log(folder, outcome)
    output.write_text(folder, outcome)
    output.write_plots(folder, outcome)
    output.write_report(folder, outcome)
    output.write_metrics(folder, outcome, SECONDS)
    return folder


def _log(folder: Path, outcome: output.Outcome) -> Path:
    output.write_log(output.prepare_folder(folder, outcome.log.path), outcome)
    return folder / "run.mcap"


def test_a_run_leaves_these_files_and_no_others(tmp_path: Path, outcome: output.Outcome) -> None:
    folder = _write(tmp_path / "out", outcome)
    assert {path.name for path in folder.iterdir()} == FILES


def test_metrics_json_has_the_documented_shape(tmp_path: Path, outcome: output.Outcome) -> None:
    output.write_metrics(tmp_path, outcome, SECONDS)
    document = json.loads((tmp_path / "metrics.json").read_text())
    assert document.keys() == {
        *("schema", "log", "trajectories", "at_end", "calibration", "bias_steps", "clock_jumps"),
        *("front_end", "gnss", "timing"),
    }
    assert document["schema"] == 1
    assert document["log"] == {
        "path": str(outcome.log.path),
        "sha256": outcome.log.sha256,
        "duration_s": pytest.approx(1.1),
        "frames": FRAMES,
        "pairs": FRAMES - 1,
        "imu_samples": 100,
        "warnings": {"gaps_bridged": 2},
    }
    assert document["trajectories"].keys() == {"raw", "posegraph", "ekf"}
    for values in document["trajectories"].values():
        assert values.keys() == {
            "t_rel_percent",
            "r_rel_deg_per_100m",
            "segments",
            "ate_m",
            "end_error_m",
            "rpe_translation_m",
            "rpe_rotation_rad",
            "anees_position",
            "anees_orientation",
            "nis_mean",
            "nis_degrees_of_freedom",
        }
        assert all(np.isfinite(value) for name, value in values.items() if not name.startswith("nis"))
    assert document["calibration"] == {
        "rotation_imu_camera_quat_wxyz": pytest.approx([0.5, -0.5, 0.5, -0.5]),
        "rotation_std_deg": None,
        "time_offset_s": 0.065,
        "time_offset_std_s": None,
        "low_pass_s": 0.0,
        "lever_arm_m": None,
        "lever_arm_std_m": None,
        "gyro_bias_rad_s": [0.0, 0.0, 0.0],
        "used": True,
        "reason": "it agrees with the pairs",
    }
    assert document["bias_steps"] == []
    assert document["clock_jumps"] == []
    assert document["timing"] == {**SECONDS, "total": 2.0, "realtime_factor": pytest.approx(0.55)}


def test_metrics_json_has_all_steps_of_biases_that_are_known(tmp_path: Path, outcome: output.Outcome) -> None:
    """Those of the calibration and those of the pose graph, in order of time; not that a bias wanders."""
    accelerometer = BiasStep(2_000_000_000, np.array([0.5, 0.0, -0.5, 0.0, 0.0, 0.0]), np.zeros(6))
    wanders = BiasStep(1_500_000_000, np.zeros(6), np.ones(6))
    change = Change(1_065_000_000, 0, np.array([0.0, 0.02, 0.0]))
    stepped = replace(
        outcome,
        calibration=replace(outcome.calibration, changes=[change]),
        estimates={"posegraph": Estimate(_trajectory(1), "", bias_steps=[wanders, accelerometer])},
    )
    assert output.metrics_document(stepped, SECONDS)["bias_steps"] == [
        {"stamp_ns": 1_000_000_000, "accelerometer_m_s2": [0.0, 0.0, 0.0], "gyro_rad_s": [0.0, 0.02, 0.0]},
        {"stamp_ns": 2_000_000_000, "accelerometer_m_s2": [0.5, 0.0, -0.5], "gyro_rad_s": [0.0, 0.0, 0.0]},
    ]


def test_metrics_json_has_jumps_of_the_clock_on_that_of_the_camera(outcome: output.Outcome) -> None:
    """The second one happens where the first has moved the stamps to."""
    changes = [Change(1_065_000_000, 50_000_000, np.zeros(3)), Change(2_115_000_000, -20_000_000, np.zeros(3))]
    jumped = replace(outcome, calibration=replace(outcome.calibration, changes=changes))
    assert output.metrics_document(jumped, SECONDS)["clock_jumps"] == [
        {"stamp_ns": 1_000_000_000, "by_s": pytest.approx(0.05)},
        {"stamp_ns": 2_000_000_000, "by_s": pytest.approx(-0.02)},
    ]


def test_what_could_not_be_computed_is_null(outcome: output.Outcome) -> None:
    bare = replace(
        outcome,
        ground_truth=None,
        calibration=ImuCalibration(None, None, np.zeros(3), False, "no IMU in the log"),
        metrics={name: Metrics() for name in outcome.trajectories},
    )
    document = json.loads(json.dumps(output.metrics_document(bare, SECONDS), allow_nan=False))
    for values in document["trajectories"].values():
        assert set(values) == {"nis_mean", "nis_degrees_of_freedom"} | {field.name for field in fields(Metrics)}
        assert all(value is None for value in values.values())
    assert document["calibration"]["rotation_imu_camera_quat_wxyz"] is None
    assert document["calibration"]["time_offset_s"] is None


def test_the_mean_nis_is_that_of_all_pairs_that_have_one_and_needs_no_ground_truth(outcome: output.Outcome) -> None:
    """Rejected ones count, frames without an innovation do not; a back end without any, and raw, have null."""
    series = series_of(np.arange(50))
    none = replace(series, nis=np.full(50, np.nan))
    nis = none.nis.copy()
    rejected = np.flatnonzero(~series.used)[0]
    nis[[10, rejected, 30]] = 3.0, 30.0, 6.0
    some = replace(series, nis=nis)
    document = output.metrics_document(
        replace(
            outcome,
            ground_truth=None,
            estimates={
                "ekf": Estimate(_trajectory(1), "", series=some),
                "posegraph": Estimate(_trajectory(1), "", series=none),
            },
        ),
        SECONDS,
    )["trajectories"]
    found = {name: (each["nis_mean"], each["nis_degrees_of_freedom"]) for name, each in document.items()}
    assert found == {"raw": (None, None), "posegraph": (None, None), "ekf": (13.0, 6)}


def test_a_back_end_that_was_not_asked_for_is_absent_also_from_an_earlier_run(
    tmp_path: Path, outcome: output.Outcome
) -> None:
    _write(tmp_path / "out", outcome)
    without = replace(
        outcome,
        trajectories={"raw": outcome.trajectories["raw"]},
        metrics={"raw": outcome.metrics["raw"]},
    )
    folder = _write(tmp_path / "out", without)
    assert {path.name for path in folder.iterdir()} == {
        name for name in FILES if not name.startswith(("posegraph", "ekf"))
    }
    assert json.loads((folder / "metrics.json").read_text())["trajectories"].keys() == {"raw"}


def test_the_text_files_read_back_bit_for_bit(tmp_path: Path, outcome: output.Outcome) -> None:
    folder = output.prepare_folder(tmp_path / "out", outcome.log.path)
    output.write_text(folder, outcome)
    for name, trajectory in outcome.trajectories.items():
        tum = read_tum(folder / f"{name}.tum")
        np.testing.assert_array_equal(tum.stamps_ns, trajectory.stamps_ns)
        np.testing.assert_array_equal(tum.poses.translation, trajectory.poses.translation)
        np.testing.assert_allclose(
            read_kitti_poses(folder / f"{name}.kitti.txt"), trajectory.poses.as_matrix(), atol=1e-12
        )
    assert config.load(folder / "config.toml", {}) == outcome.config


def test_the_log_holds_what_was_consumed_and_no_images_unless_asked(tmp_path: Path, outcome: output.Outcome) -> None:
    log = open_log(_log(tmp_path / "out", outcome))
    np.testing.assert_array_equal(log.frame_stamps(), STAMPS_NS)
    assert not log.has_frames
    imu = log.imu()
    np.testing.assert_array_equal(imu.stamps_ns, outcome.imu.stamps_ns)
    np.testing.assert_array_equal(imu.angular_velocity, outcome.imu.angular_velocity)
    np.testing.assert_array_equal(imu.linear_acceleration, outcome.imu.linear_acceleration)
    assert imu.angular_velocity_std == outcome.imu.angular_velocity_std
    assert imu.linear_acceleration_std == outcome.imu.linear_acceleration_std
    for again, pair in zip(log.pairs(), outcome.pairs, strict=True):
        np.testing.assert_array_equal(again.quat_wxyz, pair.quat_wxyz)
        np.testing.assert_array_equal(again.translation, pair.translation)
        np.testing.assert_array_equal(again.covariance, pair.covariance)
    assert outcome.ground_truth is not None
    truth = log.ground_truth()
    assert truth is not None
    np.testing.assert_array_equal(truth.poses.translation, outcome.ground_truth.poses.translation)


def test_the_log_with_everything_has_the_frames_as_they_were(tmp_path: Path, outcome: output.Outcome) -> None:
    everything = replace(outcome, config=config.load(None, {"record": "all"}))
    log = open_log(_log(tmp_path / "out", everything))
    for again, frame in zip(log.frames(), outcome.log.frames(), strict=True):
        assert again.stamp_ns == frame.stamp_ns
        np.testing.assert_array_equal(again.image, frame.image)
        np.testing.assert_array_equal(again.depth, frame.depth)


@pytest.mark.parametrize("record", ["light", "all"])
def test_the_camera_has_the_name_that_our_mounting_refers_to(
    tmp_path: Path, outcome: output.Outcome, record: str
) -> None:
    path = _log(tmp_path / "out", replace(outcome, config=config.load(None, {"record": record})))
    camera = open_log(path).camera_info()
    assert camera is not None
    assert camera.frame_id == "camera"
    np.testing.assert_array_equal(camera.K, CAMERA.K)


def test_the_log_says_from_what_and_how_it_was_made(tmp_path: Path, outcome: output.Outcome) -> None:
    metadata = open_log(_log(tmp_path / "out", outcome)).metadata
    assert metadata["source"] == {"log": "source.mcap", "sha256": outcome.log.sha256}
    assert metadata["config"] == {"toml": config.to_toml(outcome.config)}
    assert {"violearner-fusion", "gtsam", "numpy"} <= metadata["versions"].keys()


def test_the_log_is_a_function_of_the_outcome(tmp_path: Path, outcome: output.Outcome) -> None:
    logs = [_log(tmp_path / name, outcome).read_bytes() for name in ("a", "b")]
    assert logs[0] == logs[1]


@pytest.mark.parametrize("write", [output.write_text, output.write_plots, output.write_log])
def test_a_failure_while_writing_keeps_the_earlier_file_and_leaves_no_half_one(
    tmp_path: Path,
    outcome: output.Outcome,
    monkeypatch: pytest.MonkeyPatch,
    write: Callable[[Path, output.Outcome], None],
) -> None:
    folder = output.prepare_folder(tmp_path / "out", outcome.log.path)
    write(folder, outcome)
    before = {path.name: path.read_bytes() for path in folder.iterdir()}

    def no_space(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", no_space)
    with pytest.raises(LogError, match="No space left on device"):
        write(folder, outcome)
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before


def test_the_log_that_is_read_is_never_replaced(tmp_path: Path, outcome: output.Outcome) -> None:
    folder = _log(tmp_path / "out", outcome).parent
    with pytest.raises(UsageError, match="is the log to be read"):
        output.prepare_folder(folder, folder / "run.mcap")


def test_a_file_in_place_of_the_folder_is_a_usage_error(tmp_path: Path, outcome: output.Outcome) -> None:
    with pytest.raises(UsageError, match=r"source\.mcap: "):
        output.prepare_folder(outcome.log.path, outcome.log.path)
