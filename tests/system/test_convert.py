"""The command ``python -m fusion_io.convert``: what goes in comes out of the log, errors by exit code."""

import os
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from fusion_io.convert import main
from fusion_io.reader import open_log
from fusion_io.trajectory_files import read_kitti, read_times

START = 1_403_636_579_763_555_584
TUM = "".join(f"{i}.5 {i} 0 0 0 0 0 1\n" for i in range(5))


@pytest.fixture
def odometry(shared_data) -> Path:
    return shared_data / "kitti" / "odometry"


def trajectory_arguments(odometry: Path, out: Path) -> list[str]:
    return [
        "trajectory",
        f"--poses={odometry / 'published/example_1/09.txt'}",
        f"--times={odometry / 'sequences/09/times.txt'}",
        f"--imu={odometry / 'imu/09.mat'}",
        f"--ground-truth={odometry / 'poses/09.txt'}",
        f"--out={out}",
    ]


# ------------------------------------------------------------------------------------------------- trajectory


def test_a_published_result_comes_back_from_the_log_to_double_precision(odometry, tmp_path, capsys):
    out = tmp_path / "09.mcap"
    assert main(trajectory_arguments(odometry, out)) == 0
    captured = capsys.readouterr()
    assert captured.out == f"{out}: 1590 pairs, 15901 IMU samples, 1591 ground-truth poses\n"
    assert captured.err == ""

    log = open_log(out)
    stamps_ns = read_times(odometry / "sequences/09/times.txt")
    poses = read_kitti(odometry / "published/example_1/09.txt", stamps_ns).poses
    pairs = log.pairs()
    assert_array_equal([pair.source_stamp_ns for pair in pairs], stamps_ns[:-1])
    assert_array_equal([pair.target_stamp_ns for pair in pairs], stamps_ns[1:])
    chained = poses[0]
    for pair in pairs:
        chained = chained * pair.T_source_target
    assert_allclose(chained.as_matrix(), poses[-1].as_matrix(), rtol=0, atol=1e-9)
    assert_array_equal(log.imu().stamps_ns[::10], stamps_ns)
    assert_array_equal(log.ground_truth().stamps_ns, stamps_ns)
    assert log.warnings == {}


def test_tum_needs_no_times_and_sigmas_are_taken(tmp_path):
    (tmp_path / "a.tum").write_text(TUM)
    out = tmp_path / "a.mcap"
    arguments = ["--sigma-translation=0.5", "--sigma-rotation=0.25"]
    assert main(["trajectory", f"--poses={tmp_path / 'a.tum'}", f"--out={out}", *arguments]) == 0
    log = open_log(out)
    assert [pair.target_stamp_ns for pair in log.pairs()] == [i * 10**9 + 500_000_000 for i in range(1, 5)]
    assert_allclose(log.pairs()[0].covariance, np.diag([0.0625] * 3 + [0.25] * 3), rtol=1e-12)
    assert log.metadata["converter"]["sigma_rotation"] == "0.25"


def test_a_trajectory_takes_an_imu_table_too(tmp_path):
    (tmp_path / "a.tum").write_text(TUM)
    (tmp_path / "imu.csv").write_text("".join(f"{i * 10**7},0,0,0,0,0,9.8\n" for i in range(500)))
    out = tmp_path / "a.mcap"
    code = main(["trajectory", f"--poses={tmp_path / 'a.tum'}", f"--imu={tmp_path / 'imu.csv'}", f"--out={out}"])
    assert code == 0
    assert len(open_log(out).imu()) == 500


# ------------------------------------------------------------------------------------------------------ kitti


def test_an_odometry_sequence_becomes_a_log(odometry, tmp_path, capsys):
    out = tmp_path / "06.mcap"
    arguments = ["--sequence=06", "--frames=48:54", "--crop-height=320", "--resize=240x64", f"--out={out}"]
    assert main(["kitti-odometry", f"--root={odometry}", f"--imu={odometry / 'imu/06.mat'}", *arguments]) == 0
    captured = capsys.readouterr()
    assert captured.out.startswith(f"{out}: 3 frames, ")
    assert captured.err == "warning: frames missing (no left image): 3\n"

    log = open_log(out)
    frames = list(log.frames())
    stamps_ns = read_times(odometry / "sequences/06/times.txt")
    assert_array_equal([frame.stamp_ns for frame in frames], stamps_ns[48:51])
    for frame in frames:
        assert frame.image.shape == frame.depth.shape == (64, 240)
        assert (frame.depth > 0).mean() > 0.6
    assert_allclose(frames[0].camera.K[0, 0], 707.0912 * 240 / 1226, rtol=1e-12)
    assert_array_equal(log.ground_truth().stamps_ns, stamps_ns[48:51])
    assert log.warnings == {}
    assert log.metadata["converter"] == {
        "version": log.metadata["converter"]["version"],
        "kind": "kitti-odometry",
        "root": "odometry",
        "sequence": "06",
        "imu": "06.mat",
        "frames": "48:54",
        "colour": "False",
        "crop_height": "320",
        "resize": "240x64",
    }


def test_the_scanner_of_a_sequence_gives_the_depth_of_the_log(odometry, tmp_path, capsys):
    """Real images and calibration; the scan is a wall 15 m ahead, its calibration an assumed one."""
    folder = tmp_path / "sequences/06"
    (folder / "velodyne").mkdir(parents=True)
    for name in ("image_0", "times.txt"):
        (folder / name).symlink_to(odometry / "sequences/06" / name)
    velodyne_in_camera = "0 -1 0 0 0 0 -1 0 1 0 0 0"  # forward, left, up
    calibration = (odometry / "sequences/06/calib.txt").read_text()
    (folder / "calib.txt").write_text(f"{calibration}Tr: {velodyne_in_camera}\n")
    left, up = np.random.default_rng(0).uniform(-15, 15, (2, 200_000))
    scan = np.column_stack([np.full_like(left, 15.0), left, up, np.zeros_like(left)])
    scan.astype("<f4").tofile(folder / "velodyne/000000.bin")
    out = tmp_path / "06.mcap"
    arguments = ["--sequence=06", "--frames=0:2", "--resize=240x64", "--depth=velodyne", f"--out={out}"]
    assert main(["kitti-odometry", f"--root={tmp_path}", *arguments]) == 0
    assert capsys.readouterr().err == "warning: frames without depth (no scan): 1\n"
    log = open_log(out)
    first, second = log.frames()
    assert first.depth.shape == (64, 240)
    assert (first.depth == 15).mean() > 0.7
    assert (first.depth[first.depth != 15] == 0).all()
    assert second.depth is None
    assert log.metadata["converter"]["depth"] == "velodyne"


def test_a_raw_drive_becomes_a_log_with_its_mounting(shared_data, tmp_path, capsys):
    drive = shared_data / "kitti/raw/2011_09_26/2011_09_26_drive_0039_sync"
    out = tmp_path / "39.mcap"
    assert main(["kitti-raw", f"--drive={drive}", "--frames=17:20", "--resize=310x94", f"--out={out}"]) == 0
    assert "frames missing (no left image): 1, frames without depth" in capsys.readouterr().err
    log = open_log(out)
    assert [frame.depth is None for frame in log.frames()] == [True, False]
    assert_allclose(log.mounting().apply([0, 0, 1]), [1, 0, 0], atol=0.03)
    assert len(log.imu()) == len(log.ground_truth())
    assert log.gnss() == []
    assert log.warnings.keys() <= {"frames_without_depth"}


def test_fixes_of_a_raw_drive_are_noisy_and_leave_no_ground_truth(shared_data, tmp_path, capsys):
    drive = shared_data / "kitti/raw/2011_09_26/2011_09_26_drive_0039_sync"
    logs = []
    for seed in (0, 1, 1):
        out = tmp_path / f"{len(logs)}.mcap"
        arguments = ["--frames=17:20", "--resize=310x94", "--gnss=0.2", "--gnss-noise=2", f"--gnss-seed={seed}"]
        assert main(["kitti-raw", f"--drive={drive}", *arguments, f"--out={out}"]) == 0
        logs.append(open_log(out))
    assert "no ground truth beside GNSS fixes" in capsys.readouterr().err
    assert logs[0].ground_truth() is None
    fixes = [log.gnss() for log in logs]
    assert 5 <= len(fixes[0]) <= 7  # in 1.2 s
    assert min(fix.covariance[0, 0] for fix in fixes[0]) > 4.0
    latitudes = [[fix.latitude_deg for fix in each] for each in fixes]
    assert latitudes[1] == latitudes[2] != latitudes[0]
    assert logs[0].metadata["converter"]["gnss_noise"] == "2.0"


# ----------------------------------------------------------------------------------------------------- folder


@pytest.fixture
def recorded(tmp_path) -> list[str]:
    """Arguments for a recording of five frames."""
    for name in ("images", "depth"):
        (tmp_path / name).mkdir()
    rng = np.random.default_rng(0)
    for i in range(5):
        name = f"{START + i * 50_000_000}.png"
        cv2.imwrite(str(tmp_path / "images" / name), rng.integers(0, 255, (24, 32, 3), np.uint8))
        cv2.imwrite(str(tmp_path / "depth" / name), np.full((24, 32), 2500 + i, np.uint16))
    (tmp_path / "imu.csv").write_text("".join(f"{START + i * 10**7},0,0,0.1,0,0,9.8\n" for i in range(30)))
    (tmp_path / "camera.yaml").write_text("resolution: [32, 24]\nintrinsics: [30, 30, 15.5, 11.5]\n")
    names = {"images": "images", "depth": "depth", "imu": "imu.csv", "camera": "camera.yaml"}
    return ["folder", *(f"--{option}={tmp_path / name}" for option, name in names.items())]


def test_a_folder_comes_back_from_the_log_pixel_by_pixel(recorded, tmp_path, capsys):
    out = tmp_path / "own.mcap"
    assert main([*recorded, f"--out={out}"]) == 0
    assert capsys.readouterr().out == f"{out}: 5 frames, 30 IMU samples\n"
    log = open_log(out)
    frames = list(log.frames())
    for i, frame in enumerate(frames):
        assert frame.stamp_ns == START + i * 50_000_000
        original = cv2.imread(str(tmp_path / "images" / f"{frame.stamp_ns}.png"))
        assert_array_equal(frame.image, original[..., ::-1])
        assert_allclose(frame.depth, 2.5 + 0.001 * i, atol=1 / 512)
    assert len(frames) == 5
    assert_array_equal(log.imu().angular_velocity[0], [0, 0, 0.1])
    assert log.warnings == {}


def test_the_same_recording_gives_the_same_bytes_whatever_it_is_called(recorded, tmp_path):
    outs = [tmp_path / "a.mcap", tmp_path / "elsewhere" / "b.mcap"]
    for out in outs:
        assert main([*recorded, f"--out={out}"]) == 0
    assert outs[0].read_bytes() == outs[1].read_bytes()
    assert str(tmp_path).encode() not in outs[0].read_bytes()


# ------------------------------------------------------------------------------------------ errors, exit codes


@pytest.mark.parametrize(
    "arguments",
    [
        [],
        ["unknown"],
        ["trajectory"],
        ["trajectory", "--poses=a.tum", "--out=x.mcap", "--sigma-rotation=0"],
        ["kitti-odometry", "--root=.", "--sequence=06", "--out=x.mcap", "--resize=480"],
        ["kitti-odometry", "--root=.", "--sequence=06", "--out=x.mcap", "--frames=5"],
        ["kitti-odometry", "--root=.", "--sequence=06", "--out=x.mcap", "--crop-height=-1"],
        ["kitti-odometry", "--root=.", "--sequence=06", "--out=x.mcap", "--depth=lidar"],
        ["kitti-odometry", "--root=.", "--sequence=06", "--out=x.mcap", "--imu=a.mat", "--oxts=drive"],
    ],
)
def test_wrong_usage_is_exit_code_2(arguments):
    with pytest.raises(SystemExit) as error:
        main(arguments)
    assert error.value.code == 2


def test_an_unusable_input_is_one_line_and_exit_code_1_and_leaves_no_file(tmp_path, capsys):
    (tmp_path / "a.tum").write_text("1 2 3\n")
    assert main(["trajectory", f"--poses={tmp_path / 'a.tum'}", f"--out={tmp_path / 'a.mcap'}"]) == 1
    error = capsys.readouterr().err
    assert error == f"error: {tmp_path / 'a.tum'}: line 1: 3 columns where 8 or 12 or 13 are expected\n"
    assert sorted(file.name for file in tmp_path.iterdir()) == ["a.tum"]


def test_an_error_in_the_middle_leaves_no_file_and_an_older_log_untouched(recorded, tmp_path, capsys):
    out = tmp_path / "own.mcap"
    out.write_text("older")
    cv2.imwrite(str(tmp_path / "depth" / f"{START + 4 * 50_000_000}.png"), np.zeros((24, 24), np.uint16))
    assert main([*recorded, f"--out={out}"]) == 1
    assert "cannot belong" in capsys.readouterr().err
    assert out.read_text() == "older"
    assert not list(tmp_path.glob(".*"))


def test_a_recording_of_which_no_image_can_be_decoded_is_refused(recorded, tmp_path, capsys):
    for file in (tmp_path / "images").iterdir():
        file.write_bytes(b"not an image")
    assert main([*recorded, f"--out={tmp_path / 'own.mcap'}"]) == 1
    assert "no image could be decoded" in capsys.readouterr().err
    assert not (tmp_path / "own.mcap").exists()


def test_kitti_poses_without_times_are_a_usage_error(tmp_path, capsys):
    (tmp_path / "a.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0\n")
    assert main(["trajectory", f"--poses={tmp_path / 'a.txt'}", f"--out={tmp_path / 'a.mcap'}"]) == 2
    assert "--times" in capsys.readouterr().err


def test_help_imports_nothing_heavy():
    """Each subcommand but ``simulate`` explains itself without numpy, OpenCV or torch."""
    program = (
        "import sys\n"
        "from fusion_io.convert import main\n"
        "try:\n    main(sys.argv[1:])\nexcept SystemExit as end:\n    assert end.code == 0\n"
        "assert not {'numpy', 'scipy', 'cv2', 'torch'} & sys.modules.keys()\n"
    )
    for arguments in (["--help"], ["kitti-odometry", "--help"], ["trajectory", "--help"], ["folder", "--help"]):
        subprocess.run([sys.executable, "-c", program, *arguments], check=True, stdout=subprocess.DEVNULL)


def test_the_module_runs_as_a_command_without_a_bar_where_nobody_watches(recorded, tmp_path):
    command = [sys.executable, "-m", "fusion_io.convert", *recorded, f"--out={tmp_path / 'own.mcap'}"]
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).resolve().parents[2] / "io")}
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    assert (done.returncode, done.stderr) == (0, "")
