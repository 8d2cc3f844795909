"""What cameras, depth sensors and IMUs of the simulation do to the truth."""

import numpy as np
import pytest

from fusion_io.records import NANOSECONDS
from fusion_io.simulation.motion import (
    PERFECT_IMU,
    DriveStyle,
    ImuModel,
    draw_dropouts,
    drive,
    imu_stamps,
    simulate_imu,
    without,
)
from fusion_io.simulation.photometry import ImageModel, Imager, smear_kernel
from fusion_io.simulation.sensors import Lidar, Stereo, TimeOfFlight

SHAPE = HEIGHT, WIDTH = 100, 200
K = np.array([[140.0, 0.0, 99.5], [0.0, 120.0, 49.5], [0.0, 0.0, 1.0]])
AT_REST = np.zeros(3)
BASELINE_M = 0.54


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(0)


@pytest.fixture
def textured() -> np.ndarray:
    return np.random.default_rng(9).integers(0, 256, SHAPE, dtype=np.uint8)


def flat(z: float) -> np.ndarray:
    return np.full(SHAPE, z, np.float32)


# ---------------------------------------------------------------------------------------------------- stereo

EXACT_STEREO = Stereo(noise_px=0.0, fattening_px=0.0, missing=0.0, wrong=0.0, flat_missing=0.0)


def test_noise_of_stereo_depth_grows_with_the_square_of_depth(rng, textured):
    """Disparity noise: sixteen times at four times the distance."""
    spread = {}
    for z in (10.0, 40.0):
        stereo = Stereo(noise_px=0.1, fattening_px=0.0, missing=0.0, wrong=0.0)
        measured = stereo.measure(flat(z), textured, K, rng)
        spread[z] = (measured[measured > 0] - z).std()
    assert spread[40.0] / spread[10.0] == pytest.approx(16.0, rel=0.1)


def test_stereo_sees_nothing_left_of_near_things_nor_far_away(rng, textured):
    """Occlusion opens a hole at the left of a near thing, as wide as the disparities differ; 90 m is too far."""
    depth = flat(40.0)
    depth[:, 80:120] = 4.0
    depth[20:40] = 90.0
    measured = EXACT_STEREO.measure(depth, textured, K, rng)
    assert (measured[20:40] == 0).all()
    hidden = int(K[0, 0] * BASELINE_M * (1 / 4 - 1 / 40))
    assert (measured[40:, 80 - hidden + 1 : 80] == 0).all()
    np.testing.assert_allclose(measured[40:, 80 : 120 + hidden], depth[40:, 80 : 120 + hidden], rtol=1e-5)


def test_stereo_has_no_depth_outside_the_right_image(rng, textured):
    """A point that the right camera would see left of its first column is not matched."""
    measured = EXACT_STEREO.measure(flat(5.0), textured, K, rng)
    disparity = K[0, 0] * BASELINE_M / 5.0
    assert (measured[:, : int(disparity - 0.5)] == 0).all()
    assert (measured[:, int(disparity) + 1 :] > 0).all()


def test_near_things_outgrow_their_borders_in_stereo_only_there(rng, textured):
    """Fattening: background within the reach of an edge comes nearer; elsewhere all is exact."""
    depth = flat(20.0)
    depth[30:70, 80:120] = 5.0
    reach = 2.0 * 1242 / WIDTH
    measured = Stereo(0.0, reach, 0.0, 0.0, 0.0).measure(depth, textured, K, rng)
    border = np.s_[35:65, 120:122]
    assert (measured[border] < 19.9).mean() > 0.5
    assert (measured[border] > 4.99).all()
    np.testing.assert_allclose(measured[30:70, 80:120], 5.0, rtol=1e-5)
    np.testing.assert_allclose(measured[:, 123:], 20.0, rtol=1e-5)
    np.testing.assert_allclose(measured[73:, 60:], 20.0, rtol=1e-5)


def test_a_slanted_road_is_not_fattened(rng, textured):
    """The disparity of a road changes by the same from row to row: no edge."""
    disparity = 0.33 * np.maximum(np.arange(HEIGHT) - 40.0, 0.0)[:, None] * np.ones(WIDTH)
    depth = np.divide(K[0, 0] * BASELINE_M, disparity, out=np.zeros(SHAPE), where=disparity > 1).astype(np.float32)
    measured = Stereo(0.0, 4.0, 0.0, 0.0, 0.0).measure(depth, textured, K, rng)
    both = (measured > 0) & (depth > 0) & (np.arange(HEIGHT) > 46)[:, None]
    assert both.sum() > 5000
    np.testing.assert_allclose(measured[both], depth[both], rtol=1e-5)


def test_blobs_cover_the_share_that_is_asked_for(rng, textured):
    """Missing blobs cover their share of the image, and flat parts lose theirs."""
    missing = Stereo(0.0, 0.0, 0.2, 0.0, 0.0).measure(flat(30.0), textured, K, rng)[:, 10:]
    assert (missing == 0).mean() == pytest.approx(0.2, abs=0.04)
    plain = Stereo(0.0, 0.0, 0.0, 0.0, 0.6).measure(flat(30.0), np.full(SHAPE, 200, np.uint8), K, rng)[:, 10:]
    assert (plain == 0).mean() == pytest.approx(0.6, abs=0.08)


# ---------------------------------------------------------------------------------------------------- LiDAR and ToF


@pytest.mark.parametrize("lines", [32, 64])
def test_a_lidar_has_its_lines_and_nothing_above(rng, textured, lines):
    """Down the middle column lie as many depths as the LiDAR has lines there; above its first line there is none."""
    tall = K * [[1], [10], [1]] + [[0, 0, 0], [0, 0, 450], [0, 0, 0]]
    lidar = Lidar(lines=lines, azimuth_rad=1e-4, dropout=0.0, noise_m=0.0)
    measured = lidar.measure(np.full((1000, WIDTH), 10.0, np.float32), textured, tall, rng)
    elevation = -np.arctan((np.arange(1000) - tall[1, 2]) / tall[1, 1])
    assert (measured[:, 99][elevation > lidar.top_rad + 0.001] == 0).all()
    spacing = (lidar.top_rad - lidar.bottom_rad) / (lines - 1)
    expected = (lidar.top_rad - elevation[-1]) / spacing
    column = measured[:, 99] > 0
    assert column.sum() == pytest.approx(expected, abs=1.5)
    gaps = np.diff(elevation[column])
    np.testing.assert_allclose(-gaps, spacing, atol=0.002)


def test_a_sparse_azimuth_leaves_columns_empty(rng, textured):
    """Beams a degree apart hit as many columns as there are degrees."""
    measured = Lidar(azimuth_rad=np.deg2rad(1.0), dropout=0.0).measure(flat(10.0), textured, K, rng)
    columns = (measured > 0).any(axis=0).sum()
    assert columns == pytest.approx(np.rad2deg(2 * np.arctan(100 / K[0, 0])), abs=1.5)


def test_range_noise_of_a_lidar_is_the_same_near_and_far(rng, textured):
    """Two centimetres along the ray, whatever the range; z shows them times the ray's cosine; the sky has none."""
    cosine = 1 / np.sqrt(1 + ((np.arange(WIDTH) - K[0, 2]) / K[0, 0]) ** 2)
    for z in (5.0, 50.0):
        depth = flat(z)
        depth[:60] = 0.0
        measured = Lidar(dropout=0.1).measure(depth, textured, K, rng)
        assert (measured[:60] == 0).all()
        error = ((measured - z) / cosine)[60:70][measured[60:70] > 0]
        assert len(error) > 1000
        assert error.std() == pytest.approx(0.02, rel=0.15)


def test_time_of_flight_has_a_limited_range_and_no_edges(rng, textured):
    """No depth beyond the range nor where a pixel sees both sides of an edge; noise grows with z^2."""
    depth = flat(2.0)
    depth[:, 100:] = 6.0
    depth[:, 150:] = 9.0
    measured = TimeOfFlight(range_m=8.0, noise_m=0.002, missing=0.0).measure(depth, textured, K, rng)
    assert (measured[:, 152:] == 0).all()
    assert (measured[:, 99:101] == 0).all()
    near, far = measured[:, 1:98], measured[:, 102:148]
    assert (near > 0).all()
    assert (far - 6).std() / (near - 2).std() == pytest.approx(9.0, rel=0.1)


# ---------------------------------------------------------------------------------------------------- images


def take(model: ImageModel, *radiances: np.ndarray, rate=AT_REST) -> list[np.ndarray]:
    imager = Imager(model, K, np.random.default_rng(3))
    return [imager.take(np.asarray(radiance, np.float32), rate).astype(float) for radiance in radiances]


CLEAN = ImageModel(read_noise=0.0)


def test_a_clean_camera_is_linear_and_saturates(rng):
    """Without faults a level is proportional to the light, at the exposure of the first image, up to white."""
    light = rng.uniform(0.2, 0.4, SHAPE)
    first, second, bright = take(CLEAN, light, 1.5 * light, 20 * light)
    np.testing.assert_allclose(second, 1.5 * first, atol=1.5)
    assert (bright == 255).all()


def test_automatic_exposure_reacts(rng):
    """After the light has doubled, the image returns towards its old brightness, by the adaptation a frame."""
    light = rng.uniform(0.2, 0.3, SHAPE)
    before, *after = take(ImageModel(read_noise=0.0, adaptation=0.5), light, *[2 * light] * 6)
    ratios = [image.mean() / before.mean() for image in after]
    np.testing.assert_allclose(ratios, 2.0 ** (0.5 ** np.arange(1, 7)), rtol=0.02)


def test_exposure_steps_are_sudden_and_an_automatic_exposure_takes_them_back(rng):
    """Gain changes come at their rate; with adaptation they fade, without they stay until the next."""
    light = rng.uniform(0.2, 0.3, SHAPE)
    changes = []
    for adaptation in (0.0, 0.5):
        images = take(ImageModel(read_noise=0.0, adaptation=adaptation, step_probability=0.1), *[light] * 60)
        levels = np.log([image.mean() / images[0].mean() for image in images])
        changes.append((np.abs(np.diff(levels)) > 0.01).sum())
    assert 2 <= changes[0] <= 12
    assert changes[1] > 1.5 * changes[0]


def test_gamma_and_its_wandering(rng):
    """A gamma below one lifts the shadows; a wandering one changes contrast between frames."""
    light = rng.uniform(0.05, 0.6, SHAPE)
    (linear,), (lifted,) = take(CLEAN, light), take(ImageModel(read_noise=0.0, gamma=0.6), light)
    np.testing.assert_allclose(lifted, 255 * (linear / 255) ** 0.6, atol=4.0)
    wandering = take(ImageModel(read_noise=0.0, gamma_wander=0.05), *[light] * 5)
    assert np.std([image.mean() for image in wandering]) > 0.5


def test_shot_noise_grows_with_the_light(rng):
    """Its variance is proportional to the level; read noise does not depend on it."""
    light = np.repeat([[0.1, 0.4]], WIDTH // 2, axis=1) * np.ones((HEIGHT, 1))
    noisy, still = (take(ImageModel(read_noise=r, shot_noise=s), light)[0] for r, s in ((0.0, 8.0), (3.0, 0.0)))
    dark, bright = np.s_[:, :100], np.s_[:, 100:]
    assert noisy[bright].std() / noisy[dark].std() == pytest.approx(2.0, rel=0.1)
    assert still[bright].std() == pytest.approx(still[dark].std(), rel=0.1)


def test_a_vignette_darkens_the_corners_only():
    """The middle keeps its light, the corners lose the share that is asked for."""
    image = take(ImageModel(read_noise=0.0, vignette=0.4), np.full(SHAPE, 0.3))[0]
    assert image[0, 0] / image[50, 100] == pytest.approx(0.6, abs=0.02)


def test_a_turning_camera_smears_along_its_turn():
    """Yaw smears columns together and leaves rows apart; pitch the other way round; the mean stays."""
    light = np.zeros(SHAPE)
    light[50, 100] = 1.0
    for axis, spread in ((1, (0.0, 1.4)), (0, (1.2, 0.0))):
        smear = np.array([-K[0, 0], K[1, 1]]) * [axis == 1, axis == 0] * 0.035
        kernel = smear_kernel(smear)
        offsets = np.arange(len(kernel)) - len(kernel) // 2
        assert kernel.sum() == pytest.approx(1.0)
        assert kernel.sum(axis=0) @ offsets == pytest.approx(0.0, abs=1e-6)
        deviation = [np.sqrt(kernel.sum(axis=a) @ offsets**2) for a in (1, 0)]
        np.testing.assert_allclose(deviation, spread, atol=0.15)
        rate = np.eye(3)[axis] * 3.5
        pattern = np.tile(np.arange(WIDTH) % 4 < 2, (HEIGHT, 1)) * 0.4 + 0.1
        turning = take(ImageModel(read_noise=0.0, exposure_s=0.01), pattern, rate=rate)[0]
        sharp = take(CLEAN, pattern)[0]
        assert (turning.std() < 0.8 * sharp.std()) == (axis == 1)


# ---------------------------------------------------------------------------------------------------- IMU


def test_dropped_samples_are_dropped(rng):
    """Those that stay keep their stamps and values; singles have their share, bursts leave holes; the ends stay."""
    motion = drive(0, 0.0, 10.0, DriveStyle())
    stamps = imu_stamps(0.5, 9.5, 200.0)
    imu = simulate_imu(motion, stamps, 200.0, ImuModel(), 1)
    dropped = draw_dropouts(rng, stamps, 0.1, 0)
    assert dropped.mean() == pytest.approx(0.1, abs=0.03)
    assert not dropped[[0, -1]].any()
    left = without(imu, dropped)
    np.testing.assert_array_equal(left.stamps_ns, stamps[~dropped])
    np.testing.assert_array_equal(left.angular_velocity, imu.angular_velocity[~dropped])
    np.testing.assert_array_equal(left.linear_acceleration, imu.linear_acceleration[~dropped])
    holes = np.diff(stamps[~draw_dropouts(rng, stamps, 0.0, 5)]) / NANOSECONDS
    assert 0.02 <= holes.max() <= 0.75
    assert 1 <= (holes > 0.015).sum() <= 5


def test_a_scale_error_scales_the_rate_alone():
    """One per cent too much rate; the force is untouched."""
    motion = drive(2, 0.0, 3.0, DriveStyle(yaw_rate=0.3))
    stamps = imu_stamps(0.5, 2.5, 100.0)
    scaled = ImuModel(
        gyro_bias=np.zeros(3),
        accelerometer_bias=np.zeros(3),
        gyro_noise=0,
        accelerometer_noise=0,
        gyro_scale_error=0.01,
    )
    right, wrong = (simulate_imu(motion, stamps, 100.0, model, 0) for model in (PERFECT_IMU, scaled))
    np.testing.assert_allclose(wrong.angular_velocity, 1.01 * right.angular_velocity, atol=1e-12)
    np.testing.assert_array_equal(wrong.linear_acceleration, right.linear_acceleration)
