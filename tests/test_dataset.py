"""Laws of the training pairs: files, mixtures, validation without a frame in common, logs without their truth."""

import dataclasses
from collections import Counter
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from training_samples import TINY, random_pairs, random_set

from fusion_io.errors import LogError
from fusion_io.reader import Log, open_log
from learned import dataset
from learned.dataset import Pairs, PairSet, log_shards, split
from learned.estimator import ReadyFrame, consecutive
from learned.inputs import collate, imu_window, prepare

SAMPLE = Path(__file__).resolve().parents[1] / "samples" / "kitti06.mcap"


def assert_same(a: Pairs, b: Pairs) -> None:
    for field in dataclasses.fields(Pairs):
        np.testing.assert_array_equal(getattr(a, field.name), getattr(b, field.name))


def test_pairs_survive_a_round_trip_through_a_file(tmp_path: Path) -> None:
    pairs = random_pairs()
    pairs.save(tmp_path / "pairs.npy")
    assert_same(Pairs.load(tmp_path / "pairs.npy"), pairs)


def test_loaded_pairs_stay_on_disk_until_they_are_taken(tmp_path: Path) -> None:
    pairs = random_set(tmp_path)
    assert all(isinstance(part.source.base, np.memmap) for part in pairs.parts)
    assert_same(pairs.take(np.array([6, 1])), PairSet.of([random_pairs()]).take(np.array([6, 1])))


def test_a_batch_is_what_the_estimator_would_collate() -> None:
    """One path for training and inference: the same log gives the same numbers, but for the depth's float16."""
    log = open_log(SAMPLE)
    config = dataclasses.replace(TINY, height=64, width=240)
    imu, stamps = log.imu(), log.frame_stamps()
    ready = (ReadyFrame(prepare(frame, config), None) for frame in log.frames())
    pairs = consecutive(ready, stamps, Counter())
    some = [(source.network, target.network) for source, target in islice(pairs, 3)]
    expected = collate(some, [imu_window(imu, s.stamp_ns, t.stamp_ns) for s, t in some])
    batch = Pairs.of(some, imu).batch(np.arange(3))
    for field in dataclasses.fields(batch):
        tolerance = 1e-3 if field.name == "source_depth" else 1e-6
        np.testing.assert_allclose(getattr(batch, field.name), getattr(expected, field.name), rtol=tolerance)


def test_pairs_are_drawn_by_weight_and_none_twice() -> None:
    pairs = PairSet.mixture([PairSet.of([random_pairs(20)]).weighted(3), PairSet.of([random_pairs(20)])])
    rng = np.random.default_rng(0)
    drawn = [pairs.draw(rng, 2) for _ in range(4000)]
    assert all(len(set(index)) == 2 for index in drawn)
    # A share of 3/4, less a little because no pair is drawn twice; 5 standard deviations of 8000 draws are 0.024.
    assert np.mean(np.concatenate(drawn) < 20) == pytest.approx(0.75, abs=0.024)
    assert len(pairs.draw(rng, 50)) == 50  # more than there are


@pytest.mark.parametrize("count", [3, 19, 20, 51, 250, 331, 5120])
def test_validation_takes_its_share_and_has_no_frame_in_common_with_training(count: int) -> None:
    """Pair i holds frames i and i+1: no validation frame may be one of a training pair."""
    few = random_pairs(1)
    everything = PairSet([few], np.zeros((count, 2), dtype=np.int64), np.arange(count, dtype=np.float64))
    training, validation = (part.weights.astype(int) for part in split(everything, 0.05))
    assert not ({*training, *(training + 1)} & {*validation, *(validation + 1)})
    assert len(validation) == pytest.approx(0.05 * count, abs=max(1, 0.025 * count))
    blocks = 1 + np.count_nonzero(np.diff(validation) > 1)
    assert len(validation) + len(training) >= count - 2 * blocks


def test_too_few_pairs_to_split_are_refused() -> None:
    with pytest.raises(LogError, match="too few"):
        split(PairSet.of([random_pairs(2)]), 0.05)


def test_a_log_is_read_once_and_nothing_of_its_ground_truth(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def forbidden(log: Log) -> None:
        raise AssertionError("ground truth was read")

    monkeypatch.setattr(Log, "ground_truth", forbidden)
    monkeypatch.setattr(dataset, "PAIRS_A_SHARD", 20)
    paths = log_shards(SAMPLE, TINY, tmp_path / "log")
    pairs = PairSet.of(map(Pairs.load, paths))
    assert (len(paths), len(pairs)) == (3, 50)
    assert np.isnan(pairs.values("T_source_target")).all()
    monkeypatch.setattr(dataset, "open_log", forbidden)
    assert log_shards(SAMPLE, TINY, tmp_path / "log") == paths


def test_a_log_whose_reading_was_interrupted_is_read_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(log: Log, config: object) -> object:
        yield random_pairs()
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(dataset, "log_pairs", interrupted)
        with pytest.raises(KeyboardInterrupt):
            log_shards(SAMPLE, TINY, tmp_path / "log")
    assert len(PairSet.of(map(Pairs.load, log_shards(SAMPLE, TINY, tmp_path / "log")))) == 50
