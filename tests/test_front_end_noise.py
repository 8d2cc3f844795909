"""The noise of a learned front end: as large, as lasting and as well stated as it says, and the same every time."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import RigidTransform, Rotation

from fusion_io import convert
from fusion_io.errors import EXIT_OK, EXIT_USAGE
from fusion_io.front_end_noise import FrontEndNoise, autoregressive, with_noise
from fusion_io.reader import open_log
from fusion_io.records import PairEstimate, Trajectory
from fusion_io.trajectory_files import pair_estimates, read_tum, write_tum

NONE = FrontEndNoise(rotation_drift_deg=0.0, scale_drift=0.0, rotation_white_deg=0.0, translation_white_m=(0, 0, 0))


def drive(count: int = 200) -> Trajectory:
    """A winding drive at 10 m/s."""
    turns = Rotation.from_rotvec(np.array([0.002, 0.05, 0.001]) * np.sin(np.arange(count) / 20)[:, None])
    step = RigidTransform.from_components(np.tile([0.01, 0.0, 1.0], (count, 1)), turns)
    poses = [RigidTransform.identity()]
    for k in range(count - 1):
        poses.append(poses[-1] * step[k])
    return Trajectory(1_000_000_000 + np.arange(count) * 103_700_001, RigidTransform.concatenate(poses))


def exact_pairs(count: int = 200) -> list[PairEstimate]:
    return pair_estimates(drive(count), 0.04, 0.0005)


def errors(pairs: list[PairEstimate], truth: list[PairEstimate]) -> np.ndarray:
    """Of pairs (N, 6), as right perturbations, rotation first."""
    rows = []
    for pair, exact in zip(pairs, truth, strict=True):
        back = pair.T_source_target.rotation.inv()
        turned = (exact.T_source_target.rotation.inv() * pair.T_source_target.rotation).as_rotvec()
        rows.append(np.concatenate([turned, back.apply(pair.translation - exact.translation)]))
    return np.array(rows)


def written(path: Path) -> Path:
    write_tum(path, drive())
    return path


def test_a_process_keeps_its_share_and_its_variance():
    """Within 4 standard deviations of what 400,000 samples can tell: 0.99 to 0.0004, 1 to 0.13."""
    process = autoregressive(np.random.default_rng(0).standard_normal((100_000, 4)), 0.99)
    kept = np.sum(process[1:] * process[:-1]) / np.sum(process[:-1] ** 2)
    assert kept == pytest.approx(0.99, abs=1e-3)
    assert np.mean(process**2) == pytest.approx(1.0, abs=0.13)


def test_a_process_is_as_large_at_its_beginning_as_later():
    """The variance over 100,000 processes is 1 at each of 5 steps, to 2 % (4.5 standard deviations)."""
    process = autoregressive(np.random.default_rng(1).standard_normal((5, 100_000)), 0.99)
    assert_allclose(np.mean(process**2, axis=1), 1.0, atol=0.02)


def test_white_noise_has_the_stated_deviations():
    """Each axis by itself, to 7 % (4.5 standard deviations of 2,000 pairs)."""
    noise = dataclasses.replace(NONE, rotation_white_deg=0.05, translation_white_m=(0.005, 0.002, 0.02))
    truth = exact_pairs(2001)
    noisy = with_noise(truth, 2, noise)
    moved = np.array([pair.translation - exact.translation for pair, exact in zip(noisy, truth, strict=True)])
    assert_allclose(moved.std(axis=0), [0.005, 0.002, 0.02], rtol=0.07)
    assert_allclose(errors(noisy, truth)[:, :3].std(axis=0), np.deg2rad(0.05), rtol=0.07)


def test_the_scale_is_what_changes_a_translation_where_nothing_else_does():
    noise = dataclasses.replace(NONE, scale_drift=0.008)
    truth = exact_pairs()
    for pair, exact in zip(with_noise(truth, 3, noise), truth, strict=True):
        ratio = pair.translation @ exact.translation / (exact.translation @ exact.translation)
        assert_allclose(pair.translation, ratio * exact.translation, atol=1e-12)
        assert 0.95 < ratio < 1.05


def test_covariances_are_those_of_the_errors():
    """Mean normalised squared error of 6 degrees of freedom over 3,000 pairs, white so that they count: 6 to 0.25."""
    truth = exact_pairs(3001)
    noisy = with_noise(truth, 4, FrontEndNoise(rotation_drift_deg=0.05, scale_drift=0.02, correlation=0.0))
    error = errors(noisy, truth)
    whitened = np.linalg.solve([pair.covariance for pair in noisy], error[..., None])[..., 0]
    assert np.mean(np.sum(error * whitened, axis=1)) == pytest.approx(6.0, abs=0.25)


def test_covariances_can_be_inverted():
    for pair in with_noise(exact_pairs(), 5):
        assert np.linalg.eigvalsh(pair.covariance).min() > 0.0
        assert_allclose(pair.covariance, pair.covariance.T, rtol=1e-12)


def test_no_noise_leaves_pairs_as_they_are():
    truth = exact_pairs()
    assert_allclose(errors(with_noise(truth, 6, NONE), truth), 0.0, atol=1e-15)


def test_a_seed_gives_the_same_noise_and_another_seed_another():
    first, again, other = (with_noise(exact_pairs(), seed) for seed in (7, 7, 8))
    assert_array_equal([pair.translation for pair in first], [pair.translation for pair in again])
    assert_array_equal([pair.quat_wxyz for pair in first], [pair.quat_wxyz for pair in again])
    assert np.abs(errors(first, other)).min() > 0.0


def test_the_converter_writes_the_noisy_pairs_and_the_true_poses(tmp_path):
    """Bit for bit, but for the world's origin, which a trajectory chooses."""
    poses = written(tmp_path / "true.tum")
    arguments = ["trajectory", "--poses", str(poses), "--noise-seed", "9", "--out"]
    assert convert.main([*arguments, str(tmp_path / "a.mcap")]) == EXIT_OK
    assert convert.main([*arguments, str(tmp_path / "b.mcap")]) == EXIT_OK
    log = open_log(tmp_path / "a.mcap")
    expected = with_noise(pair_estimates(read_tum(poses), 1.0, 1.0), 9)
    assert_array_equal([pair.translation for pair in log.pairs()], [pair.translation for pair in expected])
    assert_array_equal([pair.quat_wxyz for pair in log.pairs()], [pair.quat_wxyz for pair in expected])
    truth = log.ground_truth()
    assert truth is not None
    assert_allclose(truth.poses.as_matrix(), drive().poses.as_matrix(), atol=1e-12)
    assert (tmp_path / "a.mcap").read_bytes() == (tmp_path / "b.mcap").read_bytes()


def test_the_drift_can_be_chosen(tmp_path):
    poses, out = written(tmp_path / "true.tum"), tmp_path / "out.mcap"
    arguments = ["trajectory", "--poses", str(poses), "--noise-seed", "0", "--noise-rotation-drift", "0.035"]
    assert convert.main([*arguments, "--out", str(out)]) == EXIT_OK
    stated = open_log(out).pairs()[0].covariance[:3, :3]
    assert_allclose(stated, np.deg2rad(np.hypot(0.035, 0.05)) ** 2 * np.eye(3), atol=1e-15)


def test_a_drift_without_noise_is_refused(tmp_path, capsys):
    poses = written(tmp_path / "true.tum")
    arguments = ["trajectory", "--poses", str(poses), "--noise-rotation-drift", "0.035"]
    assert convert.main([*arguments, "--out", str(tmp_path / "out.mcap")]) == EXIT_USAGE
    assert "--noise-seed" in capsys.readouterr().err


def test_a_negative_seed_is_refused(tmp_path, capsys):
    with pytest.raises(SystemExit) as exit_:
        convert.main(["trajectory", "--poses", "x", "--noise-seed", "-1", "--out", str(tmp_path / "out.mcap")])
    assert exit_.value.code == EXIT_USAGE
    assert "negative" in capsys.readouterr().err
