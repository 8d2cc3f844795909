"""Everyone else's tools open what a run writes: evo, rerun, rosbags, Foxglove's layouts, pandas."""

import json
import os
import re
import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import numpy as np
import pytest
from drive_samples import FRAMES, drive, without_pictures, write_drive
from log_samples import frames, pair_estimates
from mcap.reader import make_reader
from scipy.spatial.transform import RigidTransform, Rotation
from test_estimator_series import series

from fusion import export, run
from fusion.config import RunConfig
from fusion_io import messages, topics
from fusion_io.errors import UsageError
from fusion_io.reader import Log, open_log
from fusion_io.records import PairEstimate, Trajectory
from fusion_io.writer import LogWriter

ROOT = Path(__file__).resolve().parents[1]

NAMES = ("raw", "posegraph", "ekf")


def command(name: str) -> Path:
    """A tool that is installed beside this Python; the test is skipped where it is not."""
    path = Path(sys.executable).with_name(name)
    if not path.exists():
        pytest.skip(f"needs {name}, which is not installed")
    return path


@pytest.fixture(scope="module")
def finished_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a run with images in its log."""
    folder = tmp_path_factory.mktemp("interop")
    log = write_drive(folder / "in.mcap", images=True)
    with without_pictures():
        assert run.run(log, folder / "out", RunConfig(record="all")) == 0
    return folder / "out"


@pytest.fixture(scope="module")
def full_log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log with every topic that a run can write."""
    path = tmp_path_factory.mktemp("interop") / "full.mcap"
    truth, pairs, imu = drive()
    covariances = np.tile(np.diag([1e-4, 1e-4, 1e-4, 0.01, 0.04, 0.09]), (FRAMES, 1, 1))
    with LogWriter(path) as log:
        log.mounting(Rotation.identity())
        log.imu(imu)
        log.ground_truth(truth)
        log.pairs(pairs)
        log.loops([PairEstimate(pairs[0].source_stamp_ns, pairs[30].target_stamp_ns, *_still())])
        for name in NAMES:
            log.trajectory(name, Trajectory(truth.stamps_ns, truth.poses, covariances))
            log.overview(name, truth)
            log.estimator(name, series(FRAMES))
        log.frame_tree("ekf")
        for stamp, frame in zip(truth.stamps_ns.tolist(), frames(FRAMES), strict=True):
            log.image(stamp, frame.image)
            log.depth(stamp, frame.depth)
            log.camera_info(stamp, frame.camera)
    return path


def _still() -> tuple[Any, ...]:
    pair = pair_estimates(1)[0]
    return pair.quat_wxyz, np.zeros(3), pair.covariance


def counts(path: Path) -> dict[str, int]:
    """Messages by topic, by the container's own reader."""
    with path.open("rb") as stream:
        return dict(Counter(channel.topic for _, channel, _ in make_reader(stream).iter_messages()))


def transforms(path: Path, *names: str) -> list[messages.FrameTransform]:
    """All transforms on these topics."""
    with path.open("rb") as stream:
        return [
            transform
            for _, _, message in make_reader(stream).iter_messages(topics=list(names))
            for transform in messages.decode_transforms(message.data)
        ]


def metrics(folder: Path) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((folder / "metrics.json").read_text())
    return found


# --- evo ----------------------------------------------------------------------------------------


@pytest.fixture
def evo_rmse(tmp_path: Path) -> Callable[..., float]:
    """evo_rmse(arguments): the RMSE that evo_ape gives after alignment without scale."""
    evo_ape = command("evo_ape")

    def rmse(*arguments: object) -> float:
        environment = os.environ | {"HOME": str(tmp_path), "MPLBACKEND": "Agg"}  # evo keeps its settings there
        results = tmp_path / "results.zip"
        results.unlink(missing_ok=True)
        done = subprocess.run(
            [evo_ape, *map(str, arguments), "--align", "--save_results", results],
            env=environment,
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stderr + done.stdout
        return float(json.loads(ZipFile(results).read("stats.json"))["rmse"])

    return rmse


@pytest.mark.parametrize("form", ["mcap", "tum", "kitti"])
def test_evo_reads_our_files_and_gives_our_ate(
    form: str, finished_run: Path, tmp_path: Path, evo_rmse: Callable[..., float]
) -> None:
    """To 1e-6 m: run.mcap as it is, and the text files against the ground truth in the same format."""
    from fusion_io.trajectory_files import write_kitti, write_tum

    log = open_log(finished_run / "run.mcap")
    truth = log.ground_truth()
    assert truth is not None
    write_tum(tmp_path / "truth.tum", truth)
    write_kitti(tmp_path / "truth.kitti.txt", truth)
    name = "ekf"
    arguments = {
        "mcap": (finished_run / "run.mcap", topics.GROUND_TRUTH, topics.ODOMETRY_PREFIX + name),
        "tum": (tmp_path / "truth.tum", finished_run / f"{name}.tum"),
        "kitti": (tmp_path / "truth.kitti.txt", finished_run / f"{name}.kitti.txt"),
    }[form]
    ate = metrics(finished_run)["trajectories"][name]["ate_m"]
    assert evo_rmse(form, *arguments) == pytest.approx(ate, abs=1e-6)


def test_evo_traj_lists_every_trajectory_of_a_run(finished_run: Path, tmp_path: Path) -> None:
    environment = os.environ | {"HOME": str(tmp_path), "MPLBACKEND": "Agg"}
    done = subprocess.run(
        [command("evo_traj"), "mcap", finished_run / "run.mcap", "--all_topics"],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    listed = re.findall(r"name:\s+(\S+)\ninfos:\s+(\d+) poses", done.stdout)
    expected = [topics.GROUND_TRUTH, *(topics.ODOMETRY_PREFIX + name for name in NAMES)]
    assert {(topic, str(FRAMES)) for topic in expected} <= set(listed)


# --- rosbags ------------------------------------------------------------------------------------


def test_rosbags_reads_every_message_as_ros_2(full_log: Path) -> None:
    """With the definitions that the log itself carries, our own messages among them."""
    from rosbags.highlevel import AnyReader

    decoded: Counter[str] = Counter()
    with AnyReader([full_log]) as reader:
        assert reader.is2
        for connection, _, data in reader.messages():
            message = reader.deserialize(data, connection.msgtype)
            assert message.__msgtype__ == connection.msgtype
            decoded[connection.topic] += 1
        types = {connection.msgtype for connection in reader.connections}
    assert dict(decoded) == counts(full_log)
    assert {messages.PAIR_ESTIMATE, messages.ESTIMATOR_STATE} <= types


# --- rerun --------------------------------------------------------------------------------------


def rows(path: Path) -> Counter[str]:
    """Rows at a time, by entity, of a rerun recording."""
    chunk = pytest.importorskip("rerun.chunk", reason="needs rerun-sdk, which is not installed")
    found: Counter[str] = Counter()
    for each in chunk.RrdReader(path).stream():
        if not each.is_static:
            found[each.entity_path] += each.num_rows
    return found


def test_rerun_converts_every_message(full_log: Path, tmp_path: Path) -> None:
    """A row a message; of transforms, a row each."""
    done = subprocess.run(
        [command("rerun"), "mcap", "convert", full_log, "--output", tmp_path / "full.rrd"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    converted = rows(tmp_path / "full.rrd")
    expected = counts(full_log)
    for topic in (topics.TF, topics.TF_STATIC):
        expected[topic] = len(transforms(full_log, topic))
    assert {topic: converted[topic] for topic in expected} == expected


def test_the_native_recording_has_every_pose_image_ellipsoid_and_plot(full_log: Path, tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason="needs rerun-sdk, which is not installed")
    assert export.main([str(full_log), "--rerun", str(tmp_path / "out.rrd")]) == 0
    found = rows(tmp_path / "out.rrd")
    for name in NAMES:
        for entity in (f"/world/{name}/camera", f"/world/{name}/sigma", f"/plots/nis/{name}"):
            assert found[entity] == FRAMES, entity
    assert found["/world/ground_truth/camera"] == FRAMES
    assert found["/world/posegraph/camera/image"] >= FRAMES  # rerun may keep pinhole and image in rows of their own
    assert found["/plots/imu/angular_velocity_rad_s"] == counts(full_log)[topics.IMU]


def test_an_ellipsoid_is_the_covariance_of_the_position_in_the_world() -> None:
    pytest.importorskip("rerun", reason="needs rerun-sdk, which is not installed")
    from fusion.export_rerun import SIGMAS, ellipsoids

    rng = np.random.default_rng(1)
    roots = rng.normal(size=(5, 6, 6))
    covariances = roots @ roots.transpose(0, 2, 1)
    poses = RigidTransform.from_components(rng.normal(size=(5, 3)), Rotation.random(5, rng=rng))
    half_axes, quats_xyzw = ellipsoids(Trajectory(np.arange(5), poses, covariances))
    directions = Rotation.from_quat(quats_xyzw).as_matrix()
    rebuilt = directions @ (np.eye(3) * (half_axes[:, None, :] / SIGMAS) ** 2) @ directions.transpose(0, 2, 1)
    R = poses.rotation.as_matrix()
    np.testing.assert_allclose(rebuilt, R @ covariances[:, 3:, 3:] @ R.transpose(0, 2, 1), atol=1e-12 * 100)


# --- Foxglove and Lichtblick --------------------------------------------------------------------


def layout(name: str) -> dict[str, Any]:
    found: dict[str, Any] = json.loads((ROOT / "docs" / f"{name}-layout.json").read_text())
    return found


def strings(value: Any) -> Iterator[str]:
    """All keys and texts of a JSON document."""
    if isinstance(value, dict):
        for key, each in value.items():
            yield key
            yield from strings(each)
    elif isinstance(value, list):
        for each in value:
            yield from strings(each)
    elif isinstance(value, str):
        yield value


def panels(node: Any) -> Iterator[str]:
    """The panels at the leaves of the tree that splits the screen."""
    if isinstance(node, str):
        yield node
    else:
        yield from panels(node["first"])
        yield from panels(node["second"])


@pytest.mark.parametrize("name", ["foxglove", "lichtblick"])
def test_a_layout_places_each_panel_once(name: str) -> None:
    document = layout(name)
    assert Counter(panels(document["layout"])) == Counter(document["configById"].keys())
    assert {"3D", "Image", "Plot"} <= {panel.partition("!")[0] for panel in document["configById"]}


@pytest.mark.parametrize("name", ["foxglove", "lichtblick"])
def test_every_topic_and_field_that_a_layout_names_is_one_that_we_write(name: str, full_log: Path) -> None:
    with full_log.open("rb") as stream:
        summary = make_reader(stream).get_summary()
        assert summary is not None
        types = {each.topic: summary.schemas[each.schema_id].name for each in summary.channels.values()}
    named = [text for text in strings(layout(name)) if text.startswith("/")]
    assert len(named) > 20
    for text in named:
        topic, *fields = text.split(".")
        assert topic in types, text
        _assert_field(types[topic], fields, text)


def _assert_field(type_name: str, fields: list[str], text: str) -> None:
    """Follow a path such as pose.covariance[0] through the message definitions."""
    for field in fields:
        name = field.partition("[")[0]
        definition = dict(messages.TYPESTORE.get_msgdef(type_name).fields)
        assert name in definition, text
        type_name = _message_type(definition[name])


def _message_type(description: Any) -> str:
    """The type of a field, or of the elements of an array: rosbags describes one as (kind, ((type, size), length))."""
    while not isinstance(description, str):
        description = description[1] if isinstance(description[0], int) else description[0]
    return description


def test_schema_names_are_those_that_foxglove_knows(full_log: Path) -> None:
    """As rosbag2 writes them: package/msg/Type, with the definition and its dependencies."""
    with full_log.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    for schema in summary.schemas.values():
        assert re.fullmatch(r"\w+/msg/\w+", schema.name)
        assert schema.encoding == "ros2msg"


def test_the_frame_tree_joins_camera_imu_and_world(full_log: Path) -> None:
    """One tree, rooted in the upright world; x forward, y left, z up there is z, -x, -y of the optical world."""
    tree = transforms(full_log, topics.TF, topics.TF_STATIC)
    parent = {each.child: each.parent for each in tree}

    def root(frame: str) -> str:
        return root(parent[frame]) if frame in parent else frame

    assert {root(frame) for frame in ("imu", "camera", *(f"camera_{name}" for name in NAMES))} == {"world_flu"}
    upright = next(each for each in tree if each.child == "world")
    to_flu = Rotation.from_quat(upright.pose.quat_wxyz, scalar_first=True)
    np.testing.assert_allclose(to_flu.apply([[0, 0, 1], [-1, 0, 0], [0, -1, 0]]), np.eye(3), atol=1e-15)


# --- pandas -------------------------------------------------------------------------------------


def test_csv_and_parquet_hold_every_number_of_the_log(full_log: Path, tmp_path: Path) -> None:
    """The same tables both ways, read with pandas; columns as documented, numbers to the last bit."""
    pandas = pytest.importorskip("pandas", reason="needs pandas, which is not installed")
    pytest.importorskip("pyarrow", reason="needs pyarrow, which is not installed")
    assert export.main([str(full_log), "--csv", str(tmp_path / "csv"), "--parquet", str(tmp_path / "parquet")]) == 0
    log = open_log(full_log)
    expected = export.tables(log)
    per_name = [f"{kind}_{name}" for kind in ("trajectory", "errors", "estimator") for name in NAMES]
    assert set(expected) == {"imu", "ground_truth", "pairs", "loops", *per_name}
    for name, table in expected.items():
        for each in (
            pandas.read_csv(tmp_path / "csv" / f"{name}.csv"),
            pandas.read_parquet(tmp_path / "parquet" / f"{name}.parquet"),
        ):
            assert list(each.columns) == list(table)
            for column, values in table.items():
                np.testing.assert_array_equal(each[column].to_numpy(), values, err_msg=f"{name}.{column}")


def test_table_columns_are_those_of_the_records(full_log: Path) -> None:
    log = open_log(full_log)
    found = export.tables(log)
    estimate = log.trajectory("ekf")
    assert estimate is not None
    assert estimate.covariances is not None
    table = found["trajectory_ekf"]
    np.testing.assert_array_equal(table["z_m"], estimate.poses.translation[:, 2])
    np.testing.assert_allclose(table["sigma_rotation_x_rad"], 0.01, rtol=1e-12)
    np.testing.assert_allclose(table["sigma_z_m"], 0.3, rtol=1e-12)
    np.testing.assert_array_equal(table["stamp_ns"], estimate.stamps_ns)
    assert table["time_s"][0] == 0.0
    np.testing.assert_array_equal(found["imu"]["angular_velocity_y_rad_s"], log.imu().angular_velocity[:, 1])
    np.testing.assert_array_equal(found["estimator_ekf"]["gyro_bias_z_rad_s"], series(FRAMES).gyro_bias[:, 2])


# --- When something is missing ------------------------------------------------------------------


def test_a_missing_extra_is_named_before_anything_is_computed(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(export, "find_spec", lambda name: None)
    with pytest.raises(UsageError, match=r"violearner-fusion\[parquet\]"):
        export.checked(export.Exports(parquet=tmp_path))
    with pytest.raises(UsageError, match=r"violearner-fusion\[rerun\]"):
        export.checked(export.Exports(rerun=tmp_path / "a.rrd"))


def test_the_folder_of_a_run_stands_for_its_log(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "out").mkdir()
    _, _, imu = drive()
    with LogWriter(tmp_path / "out" / "run.mcap") as log:
        log.imu(imu)
    for given, to in ((tmp_path / "out", "folder"), (tmp_path / "out" / "run.mcap", "file")):
        assert export.main([str(given), "--csv", str(tmp_path / to)]) == 0
    assert (tmp_path / "folder" / "imu.csv").read_bytes() == (tmp_path / "file" / "imu.csv").read_bytes()
    (tmp_path / "empty").mkdir()
    assert export.main([str(tmp_path / "empty"), "--csv", str(tmp_path / "none")]) == 1
    assert capsys.readouterr().err == f"error: {tmp_path / 'empty' / 'run.mcap'}: no such file\n"


def test_an_export_to_nowhere_is_a_usage_error(full_log: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert export.main([str(full_log)]) == 2
    assert "give --csv, --parquet or --rerun" in capsys.readouterr().err


def test_a_log_of_a_sensor_alone_exports_what_it_has(tmp_path: Path) -> None:
    _, _, imu = drive()
    with LogWriter(tmp_path / "imu.mcap") as log:
        log.imu(imu)
    read: Log = open_log(tmp_path / "imu.mcap")
    assert set(export.tables(read)) == {"imu"}
