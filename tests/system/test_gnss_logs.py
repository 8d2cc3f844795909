"""Logs with satellite positions: the command puts the trajectory on the earth, and a replay finds the same."""

import json
import shutil
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np
import pymap3d
import pytest
from conftest import Drive
from drive_samples import without_pictures
from numpy.testing import assert_allclose
from scipy.spatial.transform import RigidTransform, Rotation

from fusion import run
from fusion.config import RunConfig
from fusion.replay import fuse_again
from fusion_io.convert import main as convert
from fusion_io.front_end_noise import with_noise
from fusion_io.gnss import Receiver, fixes_at
from fusion_io.kitti import open_raw
from fusion_io.messages import ENU_FRAME, WORLD_FLU_FRAME, WORLD_FRAME, decode_transforms
from fusion_io.reader import open_log
from fusion_io.records import NANOSECONDS, GnssFix, PairEstimate, Trajectory
from fusion_io.trajectory_files import read_trajectory
from fusion_io.writer import LogWriter

ORIGIN = (49.0, 8.4, 115.0)
ANTENNA = [0.3, -0.5, -1.0]
QUIET = run.Presentation(quiet=True)
CONFIG = RunConfig(backend="posegraph")


def write(path: Path, drive: Drive, fixes: list[GnssFix]) -> Path:
    """A log of pairs, IMU, ground truth and fixes."""
    with LogWriter(path) as log:
        log.imu(drive.imu)
        log.pairs(drive.pairs)
        log.ground_truth(drive.ground_truth)
        for fix in fixes:
            log.gnss(fix)
    return path


@pytest.fixture(scope="module")
def quick() -> Iterator[None]:
    """Nothing is drawn: that takes most of a small run's time, and has its own tests."""
    with without_pictures():
        yield


@pytest.fixture(scope="module")
def finished(
    simulated_drive: Callable[..., Drive], tmp_path_factory: pytest.TempPathFactory, quick: None
) -> tuple[Drive, Path]:
    """A quarter of a minute with a fix every second, and the folder of its run."""
    folder, drive = tmp_path_factory.mktemp("gnss"), simulated_drive(15)
    stamps_ns, poses = drive.ground_truth.stamps_ns, drive.ground_truth.poses
    fixes = Receiver(1.0, 1.0).fixes(fixes_at(stamps_ns, poses.apply(ANTENNA), ORIGIN))
    assert run.run(write(folder / "drive.mcap", drive, fixes), folder / "out", CONFIG, QUIET) == 0
    return drive, folder / "out"


def test_the_trajectory_is_found_on_the_earth(finished: tuple[Drive, Path]) -> None:
    """posegraph.enu.tum is within 1.5 m of the truth; it is the trajectory moved by T_enu_world; the origin is told."""
    drive, folder = finished
    found = json.loads((folder / "metrics.json").read_text())["gnss"]
    assert (found["used"], found["rejected"]) == (15, 0)
    assert 0.5 < found["residual_rms_m"] < 3.0
    origin = tuple(found["origin"].values())
    truth = fixes_at(drive.ground_truth.stamps_ns, drive.ground_truth.poses.translation, ORIGIN)
    geodetic = np.array([(fix.latitude_deg, fix.longitude_deg, fix.altitude_m) for fix in truth])
    on_earth = read_trajectory(folder / "posegraph.enu.tum", None).poses.translation
    assert np.linalg.norm(on_earth - np.stack(pymap3d.geodetic2enu(*geodetic.T, *origin), axis=1), axis=1).max() < 1.5
    rotation = Rotation.from_quat(found["T_enu_world"]["quat_wxyz"], scalar_first=True)
    T_enu_world = RigidTransform.from_components(found["T_enu_world"]["translation_m"], rotation)
    assert_allclose(
        T_enu_world.apply(read_trajectory(folder / "posegraph.tum", None).poses.translation), on_earth, atol=1e-5
    )
    metadata = open_log(folder / "run.mcap").metadata["enu_origin"]
    assert tuple(float(value) for value in metadata.values()) == origin


def test_frames_of_the_log_hang_below_the_earth(finished: tuple[Drive, Path]) -> None:
    """Every frame of /tf_static has one parent, and the root is enu."""
    from mcap.reader import make_reader

    _, folder = finished
    with (folder / "run.mcap").open("rb") as stream:
        messages = [message.data for _, _, message in make_reader(stream).iter_messages(topics=["/tf_static"])]
    edges = [(each.parent, each.child) for data in messages for each in decode_transforms(data)]
    parents = {child: parent for parent, child in edges}
    assert len(parents) == len(edges)
    assert (parents[WORLD_FRAME], parents[WORLD_FLU_FRAME]) == (ENU_FRAME, WORLD_FRAME)


def test_a_replay_of_the_run_finds_the_same_from_the_fixes_that_it_kept(finished: tuple[Drive, Path]) -> None:
    _, folder = finished
    log = open_log(folder / "run.mcap")
    assert len(log.gnss()) == 15
    trajectories = fuse_again(log, CONFIG).trajectories
    recorded = read_trajectory(folder / "posegraph.tum", None).poses.translation
    assert_allclose(trajectories["posegraph"].poses.translation, recorded, atol=1e-5)


def test_a_run_without_fixes_says_nothing_of_the_earth(finished: tuple[Drive, Path], tmp_path: Path) -> None:
    """And takes away what an earlier run has left in the folder."""
    drive, before = finished
    folder = shutil.copytree(before, tmp_path / "out")
    assert (folder / "posegraph.enu.tum").exists()
    assert run.run(write(tmp_path / "without.mcap", drive, []), folder, CONFIG, QUIET) == 0
    assert json.loads((folder / "metrics.json").read_text())["gnss"] is None
    assert not (folder / "posegraph.enu.tum").exists()
    assert "enu_origin" not in open_log(folder / "run.mcap").metadata


def test_fixes_of_a_real_drive_bound_the_drift_of_a_front_end_with_the_published_errors(
    shared_data: Path, tmp_path: Path, quick: None
) -> None:
    """Drive 0039: OXTS positions every 5 s with 1 m of noise; errors on the earth at times a second from any fix.

    The pairs are true with a learned front end's noise, so that no network has to run. The fixes see to it that the
    camera is known to 1.5 m horizontally, which is their own noise; and the run itself has no ground truth.
    """
    drive = shared_data / "kitti/raw/2011_09_26/2011_09_26_drive_0039_sync"
    true, told = open_raw(drive), open_raw(drive, gnss=Receiver(5.0, 1.0))
    exact = open_raw(drive, gnss=Receiver(0.05, 1e-6)).gnss
    truth = true.ground_truth
    assert truth is not None
    motions = truth.poses[:-1].inv() * truth.poses[1:]
    quats_wxyz, translations = motions.rotation.as_quat(scalar_first=True), motions.translation
    pairs = [
        PairEstimate(int(source), int(target), quats_wxyz[k], translations[k], np.eye(6))
        for k, (source, target) in enumerate(pairwise(truth.stamps_ns))
    ]
    told.frames, told.frame_count, told.pairs = (), 0, with_noise(pairs, 0)
    told.write(tmp_path / "drive.mcap", {})
    assert run.run(tmp_path / "drive.mcap", tmp_path / "out", CONFIG, QUIET) == 0
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert metrics["trajectories"]["posegraph"]["ate_m"] is None
    found, fix_stamps = metrics["gnss"], np.array([fix.stamp_ns for fix in told.gnss])
    on_earth = read_trajectory(tmp_path / "out" / "posegraph.enu.tum", None)
    held_out = [fix for fix in exact if abs(fix_stamps - fix.stamp_ns).min() > NANOSECONDS]
    held_out = [fix for fix in held_out if on_earth.stamps_ns[0] < fix.stamp_ns < on_earth.stamps_ns[-1]]
    geodetic = np.array([(fix.latitude_deg, fix.longitude_deg, fix.altitude_m) for fix in held_out])
    east_north = np.stack(pymap3d.geodetic2enu(*geodetic.T, *found["origin"].values()), axis=1)[:, :2]
    antenna = on_earth.at(np.array([fix.stamp_ns for fix in held_out])).apply(found["antenna_m"])
    assert len(held_out) > 100
    assert np.sqrt(np.mean(np.sum((antenna[:, :2] - east_north) ** 2, axis=1))) < 1.5


def test_a_simulated_street_has_fixes_and_its_ground_truth(tmp_path: Path) -> None:
    out = tmp_path / "street.mcap"
    options = ["--seconds=2", "--size=24x16", "--gnss=0.5", "--gnss-noise=2", "--gnss-outliers=0.5", "--motion=drone"]
    assert convert(["simulate", *options, f"--out={out}"]) == 0
    log = open_log(out)
    assert len(log.gnss()) == 4
    assert_allclose(log.gnss()[0].covariance, 4.0 * np.eye(3))
    assert isinstance(log.ground_truth(), Trajectory)
