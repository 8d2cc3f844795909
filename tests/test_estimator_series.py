"""What a back end estimated beside the poses survives its way through a log."""

import dataclasses
from pathlib import Path

import numpy as np
from log_samples import START, trajectory, write_raw
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from fusion_io import messages, topics
from fusion_io.reader import open_log
from fusion_io.records import EstimatorSeries
from fusion_io.writer import LogWriter


def series(count: int = 7, seed: int = 0) -> EstimatorSeries:
    """Rows of random numbers; the first has nothing to say of the innovation, as at the first frame of a run."""
    rng = np.random.default_rng(seed)
    innovation, nis = rng.normal(size=(count, 6)), rng.uniform(size=count)
    innovation[0], nis[0] = np.nan, np.nan
    return EstimatorSeries(
        stamps_ns=START + np.arange(count) * 100_000_000,
        gyro_bias=rng.normal(size=(count, 3)),
        gyro_bias_std=rng.uniform(size=(count, 3)),
        accelerometer_bias=rng.normal(size=(count, 3)),
        accelerometer_bias_std=rng.uniform(size=(count, 3)),
        scale_error=rng.normal(size=count),
        scale_error_std=rng.uniform(size=count),
        rate_bias=rng.normal(size=(count, 3)),
        rate_bias_std=rng.uniform(size=(count, 3)),
        innovation=innovation,
        nis=nis,
        used=rng.uniform(size=count) > 0.3,
    )


def assert_same_bits(a: EstimatorSeries, b: EstimatorSeries) -> None:
    for field in dataclasses.fields(EstimatorSeries):
        x, y = getattr(a, field.name), getattr(b, field.name)
        assert (x.shape, x.dtype, x.tobytes()) == (y.shape, y.dtype, y.tobytes()), field.name


def test_a_series_reads_back_to_the_last_bit(tmp_path: Path) -> None:
    written = {"posegraph": series(seed=1), "ekf": series(seed=2)}
    with LogWriter(tmp_path / "run.mcap") as log:
        log.trajectory("raw", trajectory(7))
        log.ground_truth(trajectory(7))
        for name, each in written.items():
            log.estimator(name, each)
    log = open_log(tmp_path / "run.mcap")
    for name, each in written.items():
        read = log.estimator(name)
        assert read is not None
        assert_same_bits(read, each)
    assert log.estimator("raw") is None
    assert log.warnings == {}


def test_the_definition_in_the_log_is_enough_to_decode_a_message_and_keeps_its_comments() -> None:
    definition = messages.schema_text(messages.ESTIMATOR_STATE)
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(definition, messages.ESTIMATOR_STATE))
    each = series()
    read = store.deserialize_cdr(messages.encode_estimator(each, 3), messages.ESTIMATOR_STATE)
    assert read.accelerometer_bias.y == each.accelerometer_bias[3, 1]
    assert read.innovation_translation.z == each.innovation[3, 5]
    assert read.used == each.used[3]
    assert "6 on average where all is modelled right" in definition


def test_messages_that_cannot_be_decoded_are_counted_and_the_others_kept(tmp_path: Path) -> None:
    each, topic = series(3), topics.ESTIMATOR_PREFIX + "ekf"
    encoded = [messages.encode_estimator(each, i) for i in range(3)]
    encoded[1] = encoded[1][:40]
    truth = messages.encode_pose(START, messages.PoseSample(np.zeros(3), np.array([1.0, 0, 0, 0])))
    path = write_raw(
        tmp_path / "cut.mcap",
        [(topic, messages.ESTIMATOR_STATE, int(each.stamps_ns[i]), data) for i, data in enumerate(encoded)]
        + [(topics.GROUND_TRUTH, messages.POSE_STAMPED, START, truth)],
    )
    log = open_log(path)
    read = log.estimator("ekf")
    assert read is not None
    assert read.stamps_ns.tolist() == each.stamps_ns[[0, 2]].tolist()
    assert log.warnings == {"/estimator/ekf_unreadable": 1}


def test_a_trajectory_reads_back_with_its_covariances(tmp_path: Path) -> None:
    """Up to the rounding of the covariance's change of axes (1e-12 of its size); a zero first covariance stays zero."""
    written = trajectory(7, covariances=True)
    assert written.covariances is not None
    written.covariances[0] = 0.0
    with LogWriter(tmp_path / "run.mcap") as log:
        log.trajectory("ekf", written)
        log.ground_truth(trajectory(7, seed=1))
    log = open_log(tmp_path / "run.mcap")
    assert log.trajectory_names == ["ekf"]
    read, truth = log.trajectory("ekf"), log.ground_truth()
    assert read is not None
    assert read.covariances is not None
    np.testing.assert_array_equal(read.stamps_ns, written.stamps_ns)
    np.testing.assert_array_equal(read.poses.translation, written.poses.translation)
    np.testing.assert_allclose(read.covariances, written.covariances, atol=1e-12 * written.covariances.max())
    assert truth is not None
    assert truth.covariances is None
    assert log.trajectory("posegraph") is None
