"""The simulated street, its camera, its IMU, and the logs and clips that come out."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import RigidTransform, Rotation

from fusion_io import convert, kitti, simulation, trajectory_files
from fusion_io.reader import open_log
from fusion_io.records import NANOSECONDS, Trajectory
from fusion_io.simulation import logs
from fusion_io.simulation.motion import (
    PERFECT_IMU,
    ROTATION_WORLD_CAMERA_LEVEL,
    DriveStyle,
    ImuModel,
    Motion,
    drive,
    imu_stamps,
    simulate_imu,
)
from fusion_io.simulation.street import Look, Route
from fusion_io.simulation.textures import COLOURS, TILE_METRES, TILES, Surface, library
from fusion_io.simulation.world import World

WIDTH, HEIGHT = 160, 48
K = np.array([[94.0, 0.0, 81.0], [0.0, 94.0, 23.0], [0.0, 0.0, 1.0]])
CAMERA_HEIGHT = DriveStyle().camera_height_m


def camera_pose(x: float, y: float, z: float, heading: float) -> RigidTransform:
    """A level camera."""
    rotation = Rotation.from_euler("z", heading) * ROTATION_WORLD_CAMERA_LEVEL
    return RigidTransform.from_components([x, y, z], rotation)


def course(points: np.ndarray) -> RigidTransform:
    """Level poses (N) along points (N, 2), looking ahead."""
    steps = np.gradient(points, axis=0)
    headings = np.arctan2(steps[:, 1], steps[:, 0])
    rotations = Rotation.from_euler("z", headings[:, None]) * ROTATION_WORLD_CAMERA_LEVEL
    return RigidTransform.from_components(np.column_stack([points, np.full(len(points), CAMERA_HEIGHT)]), rotations)


@pytest.fixture(scope="module")
def motion() -> Motion:
    return drive(3, 0.0, 6.0, DriveStyle(yaw_rate=0.2))


@pytest.fixture(scope="module")
def world(motion: Motion) -> World:
    return World(7, Route(motion.sampled(), CAMERA_HEIGHT))


def warp_error(source, source_depth, target, T_source_target: RigidTransform) -> float:
    """Mean absolute difference of the source and the target sampled where the source's points are seen."""
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    rays = np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(K).T
    seen = (source_depth > 0) & (source_depth < 60)
    points = T_source_target.inv().apply(rays[seen] * source_depth[seen][:, None]) @ K.T
    x, y = (points[:, :2] / points[:, 2:]).T
    inside = (points[:, 2] > 0.5) & (x >= 0) & (x <= WIDTH - 1) & (y >= 0) & (y <= HEIGHT - 1)
    sampled = map_coordinates(target, [y, x], order=1)
    return float(np.abs(sampled - source[seen])[inside].mean())


# ---------------------------------------------------------------------------------------------------- renderer


def test_depth_of_the_ground_is_that_of_a_plane():
    """On a flat, empty street every pixel of the road has the depth of the plane under the camera."""
    empty = Look.draw(np.random.default_rng(0))
    empty = Look(**{name: getattr(empty, name) for name in Look.__slots__} | {"houses": 0, "cars": 0, "plants": 0})
    motion = drive(0, 0.0, 3.0, DriveStyle(shake=0, slope=0, yaw_rate=0, speed_change_mps=0, camera_pitch_rad=0.05))
    world = World(1, Route(motion.sampled(), CAMERA_HEIGHT), empty)
    pose = motion.poses(np.array([1.0]))[0]
    _, depth = world.render(pose.as_matrix(), K, WIDTH, HEIGHT)
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    rays = pose.rotation.apply((np.stack([u, v, np.ones_like(u)], -1) @ np.linalg.inv(K).T).reshape(-1, 3))
    expected = (pose.translation[2] / np.maximum(-rays[:, 2], 1e-9)).reshape(HEIGHT, WIDTH)
    road = np.s_[30:, 60:100]
    np.testing.assert_allclose(depth[road], expected[road], rtol=1e-4)


def test_depth_and_pose_explain_the_image(world, motion):
    """Photometric consistency: the true motion warps one image onto the other; a wrong one does not."""
    errors = []
    for time in (1.0, 2.5, 4.0):
        poses = motion.poses(np.array([time, time + 0.1]))
        (source, depth), (target, _) = (world.render(pose, K, WIDTH, HEIGHT) for pose in poses.as_matrix())
        true = poses[0].inv() * poses[1]
        ahead = RigidTransform.from_translation([0, 0, 0.25])
        turned = RigidTransform.from_rotation(Rotation.from_rotvec([0, 0.01, 0]))
        wrong = (true, true * ahead, true * turned, RigidTransform.identity())
        errors.append([warp_error(source, depth, target, T) for T in wrong])
    exact, ahead, turned, still = np.mean(errors, axis=0)
    assert exact < 0.65 * ahead
    assert exact < 0.65 * turned
    assert exact < 0.35 * still


def test_images_are_band_limited(world, motion):
    """A render of half the size is the full one averaged: what is finer than a pixel does not alias."""
    pose = motion.poses(np.array([2.0]))[0].as_matrix()
    full, _ = world.render(pose, K, WIDTH, HEIGHT)
    half_K = K.copy()
    half_K[:2] /= 2
    half_K[:2, 2] -= 0.25
    half, _ = world.render(pose, half_K, WIDTH // 2, HEIGHT // 2)
    averaged = cv2.resize(full, (WIDTH // 2, HEIGHT // 2), interpolation=cv2.INTER_AREA)
    assert np.abs(half - averaged).mean() < 0.1 * averaged.std()


def test_a_world_is_fixed_by_its_seed(world, motion):
    """The same seed and place look the same to the bit; another seed looks different."""
    pose = motion.poses(np.array([1.0]))[0].as_matrix()
    route = Route(motion.sampled(), CAMERA_HEIGHT)
    first, again, other = (w.render(pose, K, WIDTH, HEIGHT) for w in (world, World(7, route), World(8, route)))
    np.testing.assert_array_equal(first[0], again[0])
    np.testing.assert_array_equal(first[1], again[1])
    assert np.abs(first[0] - other[0]).mean() > 0.05


def test_a_second_lap_finds_the_street_of_the_first():
    """Driving a road twice builds the same street as driving it once."""
    angles = np.arange(0.0, 4 * np.pi, 0.02)
    laps = course(35.0 * np.column_stack([np.sin(angles), 1 - np.cos(angles)]))
    once, twice = (World(5, Route(laps[:count], CAMERA_HEIGHT)) for count in (len(angles) // 2, len(angles)))
    opposite = laps[len(angles) // 4].as_matrix()  # of the start: the straight roads beyond the ends are out of sight
    for first, second in zip(*(w.render(opposite, K, WIDTH, HEIGHT) for w in (once, twice)), strict=True):
        np.testing.assert_allclose(first, second, rtol=1e-4, atol=1e-4)


def test_the_camera_never_meets_anything():
    """However a path crosses itself, the nearest thing in any direction is a metre away."""
    angle = np.linspace(0, 2 * np.pi, 400)
    poses = course(np.column_stack([40 * np.sin(angle), 30 * np.sin(2 * angle)]))
    world = World(11, Route(poses, CAMERA_HEIGHT))
    wide = np.array([[8.0, 0, 11.5], [0, 8.0, 7.5], [0, 0, 1]])
    for pose in poses[::36]:
        for turn in range(4):
            around = pose * RigidTransform.from_rotation(Rotation.from_euler("y", turn * np.pi / 2))
            _, depth = world.render(around.as_matrix(), wide, 24, 16)
            assert depth[depth > 0].min() > 0.9


def test_passages_at_two_heights_are_both_above_ground():
    """Where a path comes back to a place at another height, the ground is below both passages."""
    angle = np.linspace(0, 4 * np.pi, 800)
    flat = course(50.0 * np.column_stack([np.sin(angle), 1 - np.cos(angle)]))
    poses = RigidTransform.from_translation(np.column_stack([0 * angle, 0 * angle, 0.4 * angle])) * flat
    ground = Route(poses, CAMERA_HEIGHT).height(poses.translation[:, :2])
    assert (poses.translation[:, 2] - ground).min() > 0.8


def test_colour_and_grey_images_agree(world, motion):
    """The grey image is the mean of the colour image's channels, up to what colour tells of the surfaces."""
    pose = motion.poses(np.array([1.0]))[0].as_matrix()
    grey, _ = world.render(pose, K, WIDTH, HEIGHT)
    colour, _ = world.render(pose, K, WIDTH, HEIGHT, colour=True)
    assert colour.shape == (HEIGHT, WIDTH, 3)
    np.testing.assert_allclose(colour.mean(axis=2), grey, rtol=0.15, atol=0.01)


def test_every_surface_has_a_colour():
    assert len(COLOURS) == TILES
    np.testing.assert_allclose(COLOURS.mean(axis=1), 1.0, rtol=1e-6)


def test_tiles_are_periodic_and_average_to_their_mean():
    """A tile repeats after its size; seen from afar it is its mean."""
    rng = np.random.default_rng(0)
    u, v = rng.uniform(0, TILE_METRES, (2, 500)).astype(np.float32)
    near, far = np.full(500, -5.0, np.float32), np.full(500, 5.0, np.float32)
    for surface in (Surface.ASPHALT, Surface.FACADE):
        index = np.full(500, surface, np.int32)
        there = library().lookup(index, u, v, near)
        shifted = library().lookup(index, u + np.float32(TILE_METRES), v - np.float32(2 * TILE_METRES), near)
        np.testing.assert_allclose(there, shifted, atol=2e-3)
        assert there.std() > 0.03
        assert np.ptp(library().lookup(index, u, v, far)) < 0.05


# ---------------------------------------------------------------------------------------------------- motion and IMU


def dead_reckon(imu, T_start: RigidTransform, velocity, mounting: Rotation) -> RigidTransform:
    """The pose after all samples: trapezoids for rate, force and velocity."""
    rotation, position = T_start.rotation, T_start.translation.copy()
    gyro = mounting.inv().apply(imu.angular_velocity)
    force = mounting.inv().apply(imu.linear_acceleration)
    for i, dt in enumerate(np.diff(imu.stamps_ns) / NANOSECONDS):
        following = rotation * Rotation.from_rotvec(0.5 * (gyro[i] + gyro[i + 1]) * dt)
        acceleration = 0.5 * (rotation.apply(force[i]) + following.apply(force[i + 1])) - [0, 0, 9.81]
        position += velocity * dt + 0.5 * acceleration * dt**2
        velocity = velocity + acceleration * dt
        rotation = following
    return RigidTransform.from_components(position, rotation)


def test_dead_reckoning_of_a_perfect_imu_follows_the_motion(motion):
    """Integrating rates and specific forces gives back the trajectory, whatever the mounting."""
    mounting = Rotation.from_euler("ZYX", [0.3, -0.2, 2.0])
    model = ImuModel(
        mounting, gyro_bias=np.zeros(3), accelerometer_bias=np.zeros(3), gyro_noise=0, accelerometer_noise=0
    )
    imu = simulate_imu(motion, imu_stamps(1.0, 4.0, 500.0), 500.0, model, 0)
    start, end = motion.poses(np.array([1.0, 4.0]))
    before, after = motion.poses(np.array([1.0 - 1e-4, 1.0 + 1e-4])).translation
    reached = dead_reckon(imu, start, (after - before) / 2e-4, mounting)
    assert (reached.rotation.inv() * end.rotation).magnitude() < 1e-4
    np.testing.assert_allclose(reached.translation, end.translation, atol=3e-3)


def test_an_imu_at_rest_shows_gravity_upwards():
    """A standing car: no rate, and +g along the IMU's z axis."""
    parked = DriveStyle(speed_mps=0, speed_change_mps=0, shake=0, slope=0)
    imu = simulate_imu(drive(0, 0.0, 2.0, parked), imu_stamps(0.5, 1.5, 100.0), 100.0, PERFECT_IMU, 0)
    np.testing.assert_allclose(imu.angular_velocity, 0.0, atol=1e-9)
    np.testing.assert_allclose(imu.linear_acceleration, np.tile([0, 0, 9.81], (len(imu), 1)), atol=1e-9)


def test_a_car_that_stands_on_a_slope_does_not_move():
    """Hills belong to the road, not to time: without speed and shake nothing changes."""
    motion = drive(0, 0.0, 2.0, DriveStyle(speed_mps=0, speed_change_mps=0, shake=0, slope=0.1))
    first, *rest = motion.poses(np.arange(0.5, 1.5, 0.1)).as_matrix()
    assert abs(first[2, 2]) > 1e-3
    for pose in rest:
        np.testing.assert_allclose(pose, first, atol=1e-9)


def test_bias_and_noise_are_as_configured(motion):
    """What differs from the perfect IMU has the bias for its mean and the noise of the rate for its spread."""
    stamps, rate = imu_stamps(0.0, 5.0, 2000.0), 2000.0
    model = ImuModel()
    perfect = simulate_imu(motion, stamps, rate, PERFECT_IMU, 0)
    imu = simulate_imu(motion, stamps, rate, model, 1)
    for name, bias, density in (
        ("angular_velocity", model.gyro_bias, model.gyro_noise),
        ("linear_acceleration", model.accelerometer_bias, model.accelerometer_noise),
    ):
        error = getattr(imu, name) - getattr(perfect, name)
        std = density * np.sqrt(rate)
        np.testing.assert_allclose(error.mean(axis=0), bias, atol=4 * std / np.sqrt(len(stamps)))
        np.testing.assert_allclose(error.std(axis=0), std, rtol=0.05)
        assert getattr(imu, f"{name}_std") == pytest.approx(std)


def test_time_offset_shifts_the_stamps(motion):
    """With t_imu = t_camera + offset, the sample stamped t shows what happened at t - offset."""
    stamps, offset_ns = imu_stamps(1.0, 2.0, 100.0), 65_000_000
    late = ImuModel(
        time_offset_s=0.065, gyro_bias=np.zeros(3), accelerometer_bias=np.zeros(3), gyro_noise=0, accelerometer_noise=0
    )
    on_time = simulate_imu(motion, stamps, 100.0, PERFECT_IMU, 0)
    shifted = simulate_imu(motion, stamps + offset_ns, 100.0, late, 0)
    np.testing.assert_allclose(shifted.angular_velocity, on_time.angular_velocity, atol=1e-9)
    np.testing.assert_allclose(shifted.linear_acceleration, on_time.linear_acceleration, atol=1e-6)


def test_lever_arm_moves_the_accelerometer(motion):
    """The specific force at a lever arm is that of the point there: its second difference, less gravity."""
    arm, h, time = np.array([0.4, -0.3, -1.1]), 1e-3, 2.0
    model = ImuModel(
        lever_arm=arm, gyro_bias=np.zeros(3), accelerometer_bias=np.zeros(3), gyro_noise=0, accelerometer_noise=0
    )
    imu = simulate_imu(motion, np.array([int(time * NANOSECONDS)]), 100.0, model, 0)
    poses = motion.poses(np.array([time - h, time, time + h]))
    before, now, after = poses.apply(arm)
    force = poses[1].rotation.inv().apply((before - 2 * now + after) / h**2 + [0, 0, 9.81])
    np.testing.assert_allclose(imu.linear_acceleration[0], model.rotation_imu_camera.apply(force), atol=1e-3)


def test_drives_stay_within_the_limits_of_a_car():
    """Yaw rate and lateral acceleration of many drives stay bounded, and no car drives backwards."""
    for seed in range(10):
        motion = drive(seed, 0.0, 20.0, DriveStyle(speed_mps=3.0 * seed, yaw_rate=0.4))
        times = np.arange(0.0, 20.0, 0.1)
        poses = motion.poses(times)
        assert np.abs(motion.angular_velocity(times)[:, 1]).max() < 0.55
        steps = poses[:-1].rotation.inv().apply(np.diff(poses.translation, axis=0))
        assert steps[:, 2].min() > -0.01


# ---------------------------------------------------------------------------------------------------- clips


def test_a_clip_is_fixed_by_its_seed():
    """Frames, IMU and ground truth repeat to the bit; another seed is another clip."""
    (frames, imu, truth), (again, imu_again, truth_again) = (simulation.clip(4, 3, 64, 32) for _ in range(2))
    for one, other in zip(frames, again, strict=True):
        assert one.stamp_ns == other.stamp_ns
        np.testing.assert_array_equal(one.image, other.image)
        np.testing.assert_array_equal(one.depth, other.depth)
    np.testing.assert_array_equal(imu.angular_velocity, imu_again.angular_velocity)
    np.testing.assert_array_equal(truth.poses.as_matrix(), truth_again.poses.as_matrix())
    assert not np.array_equal(imu.stamps_ns, simulation.clip(5, 3, 64, 32)[1].stamps_ns)


def test_clips_have_what_training_needs():
    """Shapes, types, stamps in order, truth at the frames' stamps, and IMU well beyond the frames."""
    for seed in range(6):
        frames, imu, truth = simulation.clip(seed, 3, 64, 32)
        stamps = [frame.stamp_ns for frame in frames]
        assert stamps == truth.stamps_ns.tolist()
        assert (np.diff(stamps) > 20_000_000).all()
        assert (np.diff(imu.stamps_ns) > 0).all()
        assert imu.stamps_ns[0] <= stamps[0] - 150_000_000
        assert imu.stamps_ns[-1] >= stamps[-1] + 150_000_000
        for frame in frames:
            assert frame.image.dtype == np.uint8
            assert frame.image.shape[:2] == frame.depth.shape == (32, 64)
            assert frame.depth.dtype == np.float32
            assert (frame.depth >= 0).all()
            assert (frame.depth > 0).mean() > 0.05
            assert frame.depth.max() < 80


# ---------------------------------------------------------------------------------------------------- logs


def simulate(out: Path, *arguments: str) -> int:
    return convert.main(["simulate", "--out", str(out), *arguments])


def test_a_simulated_log_reads_back(tmp_path):
    """Frames, depth, camera, IMU and ground truth of the log are those that were simulated."""
    out = tmp_path / "drive.mcap"
    options = ["--seconds", "0.5", "--size", "64x32", "--frame-rate", "30", "--imu-rate", "200", "--seed", "3"]
    assert simulate(out, *options, "--imu-mounting-deg=-90,0,10", "--write-mounting") == 0
    log = open_log(out)
    frames, imu, truth, mounting = list(log.frames()), log.imu(), log.ground_truth(), log.mounting()
    assert not log.warnings
    assert len(frames) == 15
    assert frames[0].camera.K[0, 0] == pytest.approx(32 / np.tan(np.deg2rad(40.5)))
    np.testing.assert_allclose(np.diff([frame.stamp_ns for frame in frames]), 1e9 / 30, atol=1)
    np.testing.assert_allclose(np.diff(imu.stamps_ns), 5e6, atol=1)
    assert truth.stamps_ns.tolist() == [frame.stamp_ns for frame in frames]
    np.testing.assert_allclose(truth.poses[0].as_matrix(), np.eye(4), atol=1e-12)
    expected = Rotation.from_euler("ZYX", [10, 0, -90], degrees=True).inv() * ImuModel().rotation_imu_camera
    assert (mounting * expected.inv()).magnitude() < 1e-9
    assert all(0 < frame.depth.max() <= 80 for frame in frames)


def test_the_imu_of_a_log_agrees_with_its_ground_truth(tmp_path):
    """Mean rates between frames, turned by the mounting, are the ground truth's rotations, up to bias and noise."""
    out = tmp_path / "drive.mcap"
    assert simulate(out, "--seconds", "3", "--size", "16x8", "--imu-mounting-deg", "20,30,40", "--write-mounting") == 0
    log = open_log(out)
    imu, truth, mounting = log.imu(), log.ground_truth(), log.mounting()
    gyro = mounting.inv().apply(imu.angular_velocity)
    rotations = (truth.poses[:-1].inv() * truth.poses[1:]).rotation.as_rotvec()
    for start, end, rotation in zip(truth.stamps_ns[:-1], truth.stamps_ns[1:], rotations, strict=True):
        between = (imu.stamps_ns >= start) & (imu.stamps_ns <= end)
        np.testing.assert_allclose(gyro[between].mean(axis=0) * (end - start) / NANOSECONDS, rotation, atol=2e-3)


@pytest.mark.parametrize("carrier", ["vehicle", "handheld", "drone"])
def test_every_carrier_gives_a_log_with_its_own_motion(tmp_path, carrier):
    """Frames with depth, an IMU, and a ground truth that moves as the carrier does."""
    out = tmp_path / "journey.mcap"
    assert simulate(out, "--motion", carrier, "--seconds", "3", "--frame-rate", "2", "--size", "32x16") == 0
    log = open_log(out)
    truth, imu = log.ground_truth(), log.imu()
    distance = np.linalg.norm(np.diff(truth.poses.translation, axis=0), axis=1).sum()
    low, high = {"vehicle": (12, 40), "handheld": (1, 6), "drone": (6, 20)}[carrier]
    assert low < distance < high
    assert np.linalg.norm(imu.linear_acceleration.mean(axis=0)) == pytest.approx(9.81, abs=2.0)
    assert all((frame.depth > 0).any() for frame in log.frames())


def test_a_long_flight_keeps_its_road(tmp_path):
    """Wherever a drone flies, there is ground below it."""
    out = tmp_path / "flight.mcap"
    assert simulate(out, "--motion", "drone", "--seconds", "60", "--frame-rate", "0.2", "--size", "32x16") == 0
    assert all((frame.depth[-1] > 0).all() for frame in open_log(out).frames())


def test_sensors_and_photometry_change_what_they_say(tmp_path):
    """Exact, stereo, LiDAR and ToF differ in depth alone; real photometry in the image."""
    frames = {}
    for depth in ("exact", "stereo", "lidar", "tof"):
        out = tmp_path / f"{depth}.mcap"
        assert simulate(out, "--depth", depth, "--seconds", "0.1", "--size", "240x64") == 0
        frames[depth] = next(iter(open_log(out).frames()))
    shares = {depth: (frame.depth > 0).mean() for depth, frame in frames.items()}
    assert shares["exact"] > shares["stereo"] > shares["lidar"] > shares["tof"] > 0
    assert frames["tof"].depth.max() < 8.01
    for frame in frames.values():
        np.testing.assert_array_equal(frame.image, frames["exact"].image)
    assert simulate(tmp_path / "r.mcap", "--photometry", "real", "--seconds", "0.1", "--size", "240x64") == 0
    real = next(iter(open_log(tmp_path / "r.mcap").frames()))
    np.testing.assert_array_equal(real.depth, frames["exact"].depth)
    assert np.abs(real.image.astype(int) - frames["exact"].image).mean() > 2


def test_moving_cars_change_the_images_only(tmp_path):
    """With cars the ground truth and the IMU stay, and some frame sees one."""
    logs_read = []
    for cars in ("0", "6"):
        out = tmp_path / f"{cars}.mcap"
        assert simulate(out, "--moving-cars", cars, "--seconds", "2", "--frame-rate", "4", "--size", "64x32") == 0
        logs_read.append(open_log(out))
    empty, busy = logs_read
    np.testing.assert_array_equal(empty.ground_truth().poses.as_matrix(), busy.ground_truth().poses.as_matrix())
    np.testing.assert_array_equal(empty.imu().angular_velocity, busy.imu().angular_velocity)
    changed = [(a.depth != b.depth).mean() for a, b in zip(empty.frames(), busy.frames(), strict=True)]
    assert 0.005 < max(changed) < 0.7


def test_offset_and_dropout_of_the_imu_are_in_the_log(tmp_path):
    """With t_imu = t_camera + 50 ms the truth's rotations fit the rates 50 ms later; a tenth of the samples is gone."""
    out = tmp_path / "drive.mcap"
    options = ["--seconds", "5", "--frame-rate", "10", "--size", "8x8", "--imu-rate", "200", "--motion", "handheld"]
    assert simulate(out, *options, "--imu-offset-ms", "50", "--imu-dropout", "0.1", "--write-mounting") == 0
    log = open_log(out)
    imu, truth = log.imu(), log.ground_truth()
    lost = 1 - len(imu) * 0.005 / ((imu.stamps_ns[-1] - imu.stamps_ns[0]) / NANOSECONDS)
    assert 0.07 < lost < 0.2
    rotations = (truth.poses[:-1].inv() * truth.poses[1:]).rotation.as_rotvec()
    middles = 0.5 * (truth.stamps_ns[:-1] + truth.stamps_ns[1:])
    gyro = log.mounting().inv().apply(imu.angular_velocity)

    def misfit(offset_ms: float) -> float:
        rates = [np.interp(middles + 1e6 * offset_ms, imu.stamps_ns, axis) for axis in gyro.T]
        return float(np.square(np.column_stack(rates) * 0.1 - rotations).sum())

    assert min(range(-100, 101, 10), key=misfit) == 50


def test_the_same_arguments_give_the_same_bytes(tmp_path):
    """A simulated log is reproducible, and another seed gives another."""
    options = ["--seconds", "0.3", "--size", "32x16"]
    names = [tmp_path / name for name in ("a.mcap", "b.mcap", "c.mcap")]
    for name, seed in zip(names, ("1", "1", "2"), strict=True):
        assert simulate(name, *options, "--seed", seed) == 0
    first, again, other = (name.read_bytes() for name in names)
    assert first == again
    assert first != other


def test_a_given_trajectory_is_the_ground_truth(tmp_path, motion):
    """With --poses the log's ground truth is the file, at its times, and --seconds keeps the beginning."""
    times = 0.5 + 0.1037 * np.arange(20)
    stamps = np.rint(times * NANOSECONDS).astype(np.int64)
    trajectory = Trajectory(stamps, motion.poses(times)).relative_to_first()
    trajectory_files.write_kitti(tmp_path / "poses.txt", trajectory)
    (tmp_path / "times.txt").write_text("".join(f"{t:.9f}\n" for t in times))
    given = ["--poses", str(tmp_path / "poses.txt"), "--times", str(tmp_path / "times.txt"), "--size", "32x16"]
    for options, count in (([], 20), (["--seconds", "1"], 10)):
        out = tmp_path / f"{count}.mcap"
        assert simulate(out, *given, *options) == 0
        log = open_log(out)
        truth = log.ground_truth()
        assert truth.stamps_ns.tolist() == log.frame_stamps().tolist() == stamps[:count].tolist()
        np.testing.assert_allclose(truth.poses.as_matrix(), trajectory.poses[:count].as_matrix(), atol=1e-9)
        assert log.imu().stamps_ns[-1] <= truth.stamps_ns[-1]


def test_levelling_finds_up(motion):
    """Whatever world a trajectory is given in, its cameras are level on average in the simulated one."""
    poses = motion.sampled()
    tilt = RigidTransform.from_components([3, -2, 1], Rotation.from_rotvec([1.0, 0.4, -0.7]))
    levelled = logs._levelled(tilt * poses)
    np.testing.assert_allclose(levelled[0].translation, [0, 0, CAMERA_HEIGHT], atol=1e-9)
    heights = levelled.translation[:, 2] - poses.translation[:, 2]
    assert np.ptp(heights) < 0.02 * np.linalg.norm(np.diff(poses.translation, axis=0), axis=1).sum()


def test_the_real_imu_comes_with_a_real_trajectory(tmp_path, shared_data):
    """With --imu the log has the sequence's own samples at their own times."""
    root, out = shared_data / "kitti" / "odometry", tmp_path / "04.mcap"
    times, imu_file = root / "sequences" / "04" / "times.txt", root / "imu" / "04.mat"
    given = ["--poses", str(root / "poses" / "04.txt"), "--times", str(times), "--imu", str(imu_file)]
    assert simulate(out, *given, "--seconds", "2", "--size", "32x16") == 0
    imu, real = open_log(out).imu(), kitti.read_imu_mat(imu_file, trajectory_files.read_times(times))
    np.testing.assert_array_equal(imu.stamps_ns, real.stamps_ns[: len(imu)])
    np.testing.assert_array_equal(imu.linear_acceleration, real.linear_acceleration[: len(imu)])
    assert imu.stamps_ns[-1] == open_log(out).frame_stamps()[-1]


@pytest.mark.parametrize(
    ("arguments", "reason"),
    [
        (["--imu", "x.mat"], "belong to --poses"),
        (["--poses", "p.txt", "--imu", "x.mat"], "give --times"),
        (["--poses", "p.txt", "--times", "t.txt", "--imu", "x.mat", "--write-mounting"], "mounting of its own"),
        (["--poses", "p.txt", "--times", "t.txt", "--imu", "x.mat", "--imu-offset-ms", "5"], "offset of its own"),
        (["--poses", "p.txt", "--motion", "drone"], "is the motion"),
        (["--poses", "p.txt"], "p.txt"),
    ],
)
def test_arguments_that_do_not_fit_are_refused(tmp_path, capsys, monkeypatch, arguments, reason):
    """One line that says why, and no log."""
    monkeypatch.chdir(tmp_path)
    assert simulate(tmp_path / "x.mcap", *arguments) != 0
    assert reason in capsys.readouterr().err
    assert not list(tmp_path.glob("*.mcap"))


@pytest.mark.parametrize(
    "arguments",
    [
        ["--size", "480"],
        ["--size", "4x4"],
        ["--seconds", "0"],
        ["--seed", "-1"],
        ["--fov-deg", "180"],
        ["--imu-dropout", "1"],
        ["--moving-cars", "-1"],
        ["--depth", "sonar"],
    ],
)
def test_impossible_values_are_usage_errors(tmp_path, arguments):
    with pytest.raises(SystemExit) as refusal:
        simulate(tmp_path / "x.mcap", *arguments)
    assert refusal.value.code == 2
