"""Laws of the network's input: one path from any camera and IMU to the network's size."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fusion_io.records import CameraFrame, CameraInfo, ImuSeries
from learned.inputs import collate, imu_coverage, imu_window, prepare, resize_depth
from learned.violearner import PRESETS, NetworkConfig

FAST = PRESETS["fast"]
MS = 1_000_000


def camera_frame(width: int, height: int, colour: bool = False) -> CameraFrame:
    rng = np.random.default_rng(0)
    image = rng.integers(0, 255, (height, width, 3) if colour else (height, width), dtype=np.uint8)
    depth = rng.uniform(3, 30, (height, width)).astype(np.float32)
    K = np.array([[0.6 * width, 0, 0.49 * width], [0, 0.6 * width, 0.47 * height], [0, 0, 1]])
    return CameraFrame(0, image, depth, CameraInfo(width, height, K))


def series(rate_hz: float, seconds: float = 1.0, start_ns: int = 0) -> ImuSeries:
    """Linear signals: column k is k + (k + 1) t."""
    stamps = start_ns + np.rint(np.arange(0, seconds, 1 / rate_hz) * 1e9).astype(np.int64)
    t = (stamps - start_ns)[:, None] / 1e9
    columns = np.arange(6) + (np.arange(6) + 1) * t
    return ImuSeries(stamps, columns[:, :3], columns[:, 3:])


def test_a_frame_at_the_networks_size_passes_unchanged() -> None:
    for config in (FAST, PRESETS["paper"]):  # also where the preset would crop
        frame = camera_frame(config.width, config.height)
        prepared = prepare(frame, config)
        np.testing.assert_array_equal(prepared.image[0], frame.image)
        np.testing.assert_array_equal(prepared.depth, frame.depth)
        np.testing.assert_array_equal(prepared.K, frame.camera.K)


@pytest.mark.parametrize("preset", ["fast", "paper"])
@pytest.mark.parametrize("size", [(1242, 375), (640, 480), (120, 40)])
@pytest.mark.parametrize("colour", [False, True])
def test_any_image_becomes_the_networks(preset: str, size: tuple[int, int], colour: bool) -> None:
    config = PRESETS[preset]
    prepared = prepare(camera_frame(*size, colour=colour), config)
    assert prepared.image.shape == (config.channels, config.height, config.width)
    assert prepared.depth is not None
    assert prepared.depth.shape == (config.height, config.width)


@pytest.mark.parametrize("preset", ["fast", "paper"])
def test_intrinsics_follow_the_image(preset: str) -> None:
    """A point seen at a pixel of the original is seen where the crop and the scaling put that pixel."""
    config = PRESETS[preset]
    frame = camera_frame(1242, 376)
    K = prepare(frame, config).K
    point = np.array([2.0, 1.0, 10.0])
    u, v, _ = frame.camera.K @ point / point[2]
    rows = round(376 * config.keep_lower_fraction)
    expected_u = (u + 0.5) * config.width / 1242 - 0.5
    expected_v = (v - (376 - rows) + 0.5) * config.height / rows - 0.5
    np.testing.assert_allclose((K @ point / point[2])[:2], [expected_u, expected_v], atol=1e-9)


def test_depth_is_averaged_as_inverse_depth_over_valid_pixels() -> None:
    depth = np.array([[2.0, 4.0, 0.0, 0.0], [2.0, 4.0, 0.0, 8.0]], dtype=np.float32)
    np.testing.assert_allclose(resize_depth(depth, 2, 1), [[1 / np.mean([1 / 2, 1 / 4]), 8.0]], rtol=1e-6)


def test_depth_with_fewer_valid_pixels_than_usual_is_unknown() -> None:
    """A quarter of the image's own share of valid pixels is asked for; NaN and 0 are not valid."""
    depth = np.full((4, 40), 5.0, dtype=np.float32)
    depth[:, :4] = 0
    depth[0, :3] = 5.0
    assert resize_depth(depth, 10, 1)[0, 0] == 0
    depth[1] = 5.0
    assert resize_depth(depth, 10, 1)[0, 0] == pytest.approx(5)
    depth[1, :4] = np.nan
    assert resize_depth(depth, 10, 1)[0, 0] == 0


def test_depth_that_is_sparse_everywhere_is_kept() -> None:
    """A scanner's points, one of thirty-six pixels, fill the small image."""
    depth = np.zeros((48, 96), dtype=np.float32)
    depth[3::6, 3::6] = 12.0
    np.testing.assert_allclose(resize_depth(depth, 16, 8), 12.0, rtol=1e-6)


@given(rate=st.floats(40, 400), source_ms=st.integers(200, 500), interval_ms=st.integers(20, 200))
def test_window_of_a_linear_signal_is_exact_at_any_rate(rate: float, source_ms: int, interval_ms: int) -> None:
    imu = series(rate)
    window = imu_window(imu, source_ms * MS, (source_ms + interval_ms) * MS)
    before = source_ms / 1e3 - 0.1 + 0.01 * (np.arange(10) + 0.5)
    after = source_ms / 1e3 + interval_ms / 1e4 * (np.arange(10) + 0.5)
    t = np.concatenate([before, after])[:, None]
    # Stamps are whole nanoseconds.
    np.testing.assert_allclose(window, np.arange(6) + (np.arange(6) + 1) * t, atol=1e-6)
    assert imu_coverage(imu, source_ms * MS, (source_ms + interval_ms) * MS) == 1.0


def test_window_before_the_log_is_filled_and_flagged() -> None:
    imu = series(100, start_ns=1_000 * MS)
    window = imu_window(imu, 1_000 * MS, 1_100 * MS)
    np.testing.assert_array_equal(window[:10], np.broadcast_to(window[10], (10, 6)))
    assert imu_coverage(imu, 1_000 * MS, 1_100 * MS) == 0.5


def test_a_hole_is_filled_and_flagged() -> None:
    whole = series(100)
    keep = (whole.stamps_ns < 300 * MS) | (whole.stamps_ns > 450 * MS)
    imu = ImuSeries(whole.stamps_ns[keep], whole.angular_velocity[keep], whole.linear_acceleration[keep])
    coverage = imu_coverage(imu, 250 * MS, 350 * MS)
    assert 0.5 < coverage < 0.8
    assert np.isfinite(imu_window(imu, 250 * MS, 350 * MS)).all()


@pytest.mark.parametrize("samples", [0, 1])
def test_no_imu_is_unknown_everywhere(samples: int) -> None:
    imu = ImuSeries(np.zeros(samples, np.int64), np.zeros((samples, 3)), np.zeros((samples, 3)))
    assert np.isnan(imu_window(imu, 200 * MS, 300 * MS)).all()
    assert imu_coverage(imu, 200 * MS, 300 * MS) == 0.0


def test_a_source_without_depth_is_refused() -> None:
    frame = prepare(camera_frame(320, 96), NetworkConfig())
    with pytest.raises(ValueError, match="no depth"):
        collate([(dataclasses.replace(frame, depth=None), frame)], [np.zeros((20, 6))])
