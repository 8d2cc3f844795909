"""Laws of the estimator: consecutive pairs only, nothing invented, and every skipped step counted."""

import dataclasses
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from fusion_io.records import CameraFrame, CameraInfo, ImuSeries, IntArray, PairEstimate
from learned import weights
from learned.covariance import CovarianceModel
from learned.estimator import PAIRS_A_BATCH, estimate_pairs, prefetched
from learned.violearner import NetworkConfig, VIOLearner

TINY = NetworkConfig(height=32, width=64, trunk_filters=4, extra_filters=4, imu_filters=(2, 2, 4, 4, 4, 4, 4))
PERIOD_NS = 100_000_000
NO_IMU = ImuSeries(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3)))


class Frames:
    """A log in memory."""

    def __init__(self, frames: list[CameraFrame]) -> None:
        self._frames = frames

    def frame_stamps(self) -> IntArray:
        return np.array([frame.stamp_ns for frame in self._frames], dtype=np.int64)

    def frames(self) -> Iterator[CameraFrame]:
        return iter(self._frames)


def frames(count: int) -> list[CameraFrame]:
    rng = np.random.default_rng(0)
    camera = CameraInfo(80, 40, np.array([[50.0, 0, 40], [0, 50.0, 20], [0, 0, 1]]))
    return [
        CameraFrame(
            i * PERIOD_NS, rng.integers(0, 255, (40, 80), dtype=np.uint8), np.full((40, 80), 8, np.float32), camera
        )
        for i in range(count)
    ]


def still_frames(count: int) -> list[CameraFrame]:
    """The same smooth picture again and again."""
    image = cv2.GaussianBlur(frames(1)[0].image, (0, 0), 2.0)
    image = cv2.normalize(image, None, 0, 255, cv2.NORM_MINMAX)
    return [dataclasses.replace(frame, image=image) for frame in frames(count)]


@pytest.fixture
def weights_path(tmp_path: Path) -> Path:
    torch.manual_seed(0)
    path = tmp_path / "tiny.pt"
    weights.save(path, weights.Weights(VIOLearner(TINY), CovarianceModel(), CovarianceModel(), CovarianceModel()), {})
    return path


def estimate(
    log: Frames, path: Path, imu: ImuSeries = NO_IMU, refined: bool = False
) -> tuple[list[PairEstimate], Counter[str]]:
    skipped: Counter[str] = Counter()
    return list(estimate_pairs(log, imu, path, skipped=skipped, refined=refined)), skipped


def test_every_consecutive_pair_is_estimated_in_order(weights_path: Path) -> None:
    count = 2 * PAIRS_A_BATCH + 3
    pairs, skipped = estimate(Frames(frames(count + 1)), weights_path)
    assert [(p.source_stamp_ns, p.target_stamp_ns) for p in pairs] == [
        (i * PERIOD_NS, (i + 1) * PERIOD_NS) for i in range(count)
    ]
    assert not skipped


def test_no_pair_is_invented_over_a_missing_frame(weights_path: Path) -> None:
    clip = frames(6)
    del clip[3]
    pairs, skipped = estimate(Frames(clip), weights_path)
    assert [p.source_stamp_ns // PERIOD_NS for p in pairs] == [0, 1, 4]
    assert skipped == {"pairs_over_missing_frames": 1}


def test_a_frame_without_depth_is_a_target_but_not_a_source(weights_path: Path) -> None:
    clip = frames(5)
    clip[2] = dataclasses.replace(clip[2], depth=None)
    pairs, skipped = estimate(Frames(clip), weights_path)
    assert [p.source_stamp_ns // PERIOD_NS for p in pairs] == [0, 1, 3]
    assert skipped == {"pairs_without_depth": 1}


def test_the_winner_is_the_estimate_and_has_the_lowest_error(weights_path: Path) -> None:
    for pair in estimate(Frames(frames(4)), weights_path)[0]:
        assert pair.winner == int(np.argmin(pair.errors))
        np.testing.assert_array_equal(pair.quat_wxyz, pair.hypotheses_quat_wxyz[pair.winner])
        np.testing.assert_array_equal(pair.translation, pair.hypotheses_translation[pair.winner])
        assert np.linalg.eigvalsh(pair.covariance)[0] > 0
        assert np.linalg.norm(pair.quat_wxyz) == pytest.approx(1, abs=1e-12)


def test_a_missing_imu_is_flagged_and_widens_the_covariance(weights_path: Path) -> None:
    stamps = np.arange(-200_000_000, 700_000_000, 10_000_000)
    imu = ImuSeries(stamps, np.zeros((len(stamps), 3)), np.tile([0, 0, 9.8], (len(stamps), 1)))
    log = Frames(frames(4))
    with_imu, without = estimate(log, weights_path, imu)[0], estimate(log, weights_path)[0]
    assert [p.imu_coverage for p in with_imu] == [1.0] * 3
    assert [p.imu_coverage for p in without] == [0.0] * 3
    for a, b in zip(with_imu, without, strict=True):
        assert np.linalg.eigvalsh(b.covariance)[0] > np.linalg.eigvalsh(a.covariance)[0]


def test_the_same_log_gives_the_same_bits(weights_path: Path) -> None:
    log = Frames(frames(5))
    for a, b in zip(estimate(log, weights_path)[0], estimate(log, weights_path)[0], strict=True):
        np.testing.assert_array_equal(a.translation, b.translation)
        np.testing.assert_array_equal(a.covariance, b.covariance)


def test_refinement_changes_the_pose_and_its_covariance_and_keeps_the_hypotheses(weights_path: Path) -> None:
    log = Frames(still_frames(PAIRS_A_BATCH + 3))
    alone, refined = estimate(log, weights_path)[0], estimate(log, weights_path, refined=True)[0]
    for a, b in zip(alone, refined, strict=True):
        np.testing.assert_array_equal(a.hypotheses_translation, b.hypotheses_translation)
        assert np.linalg.norm(b.translation) < np.linalg.norm(a.translation)
        assert np.linalg.eigvalsh(b.covariance)[0] > 0


def test_pairs_that_refinement_cannot_improve_keep_the_networks_estimate_and_are_counted(weights_path: Path) -> None:
    blank = [dataclasses.replace(frame, image=np.full_like(frame.image, 90)) for frame in frames(4)]
    alone, (kept, skipped) = (
        estimate(Frames(blank), weights_path)[0],
        estimate(Frames(blank), weights_path, refined=True),
    )
    for a, b in zip(alone, kept, strict=True):
        np.testing.assert_array_equal(a.translation, b.translation)
        np.testing.assert_array_equal(a.covariance, b.covariance)
    assert skipped == {"pairs_not_refined": 3}


def test_a_change_of_image_size_within_a_log_loses_no_pair(weights_path: Path) -> None:
    """Frames of one size are refined together; the pair across the change keeps the network's estimate."""
    clip = frames(8)
    small = CameraInfo(40, 20, np.array([[25.0, 0, 20], [0, 25.0, 10], [0, 0, 1]]))
    clip[4:] = [
        CameraFrame(f.stamp_ns, f.image[:20, :40].copy(), np.full((20, 40), 8, np.float32), small) for f in clip[4:]
    ]
    pairs, skipped = estimate(Frames(clip), weights_path, refined=True)
    assert len(pairs) == 7
    assert skipped["pairs_not_refined"] >= 1


def test_frames_made_ahead_come_in_order_and_an_error_among_them_is_raised() -> None:
    def items() -> Iterator[int]:
        yield from range(20)
        raise ValueError("broken")

    ahead = prefetched(items(), 3)
    assert [next(ahead) for _ in range(20)] == list(range(20))
    with pytest.raises(ValueError, match="broken"):
        next(ahead)


@pytest.mark.parametrize("count", [0, 1])
def test_fewer_than_two_frames_give_no_pairs(weights_path: Path, count: int) -> None:
    assert estimate(Frames(frames(count)), weights_path)[0] == []


def test_levels_are_those_of_the_pairs_and_the_last_is_the_network_s_own(weights_path: Path) -> None:
    levels: list[PairEstimate] = []
    pairs = list(estimate_pairs(Frames(frames(4)), NO_IMU, weights_path, refined=False, levels=levels))
    assert len(levels) == len(pairs) == 3
    for pair, each in zip(pairs, levels, strict=True):
        assert (each.source_stamp_ns, each.target_stamp_ns) == (pair.source_stamp_ns, pair.target_stamp_ns)
        assert each.hypotheses_quat_wxyz.shape == (5, 4)
        np.testing.assert_allclose(each.hypotheses_translation[-1], pair.translation, atol=1e-6)
