"""Training clips of every kind: carriers, traffic, and whether truth, depth, image and IMU agree."""

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import RigidTransform, Rotation

from fusion_io import simulation
from fusion_io.records import NANOSECONDS
from fusion_io.simulation import traffic
from fusion_io.simulation.carriers import MAX_TURN_RATE, FlightStyle, WalkStyle, fly, road, walk
from fusion_io.simulation.clips import Scene
from fusion_io.simulation.motion import (
    PERFECT_IMU,
    ROTATION_WORLD_CAMERA_LEVEL,
    DriveStyle,
    Motion,
    drive,
    imu_stamps,
    simulate_imu,
)
from fusion_io.simulation.sensors import Lidar, Stereo, TimeOfFlight
from fusion_io.simulation.street import Look, Route
from fusion_io.simulation.world import World

WIDTH, HEIGHT = 120, 48
K = np.array([[80.0, 0.0, 59.5], [0.0, 60.0, 23.5], [0.0, 0.0, 1.0]])


@pytest.fixture(scope="module")
def scenes() -> list[Scene]:
    """The scenes of 60 clips: only drawn, not rendered."""
    return [Scene(seed, 3, WIDTH, HEIGHT) for seed in range(60)]


# ---------------------------------------------------------------------------------------------------- what is drawn


def test_most_clips_are_of_kittis_kind_and_the_rest_is_anything(scenes):
    """Shares of carriers, sensors and cameras, within what 60 draws allow."""
    kitti_like = [scene for scene in scenes if scene.kitti_like]
    assert 0.45 <= len(kitti_like) / len(scenes) <= 0.75
    for scene in kitti_like:
        degrees = 2 * np.rad2deg(np.arctan(0.5 * WIDTH / scene.camera.K[0, 0]))
        assert scene.carrier == "vehicle"
        assert isinstance(scene.depth_sensor, Stereo)
        assert 70 < degrees < 92
        assert np.diff(scene.trajectory.stamps_ns)[0] / NANOSECONDS == pytest.approx(0.1037, abs=0.005)
    others = [scene for scene in scenes if not scene.kitti_like]
    assert {scene.carrier for scene in others} == {"vehicle", "hand", "drone"}
    assert {type(scene.depth_sensor) for scene in others} == {Stereo, Lidar, TimeOfFlight}
    aspects = [scene.camera.K[1, 1] / scene.camera.K[0, 0] for scene in others]
    assert min(aspects) < 0.7
    assert max(aspects) > 1.1
    assert any(scene.movers for scene in scenes)


def test_imus_of_clips_differ_in_rate_mounting_and_gaps(scenes):
    """50 to 400 Hz, gravity along any axis in some, some with holes."""
    rates = np.array([NANOSECONDS / np.median(np.diff(scene.imu.stamps_ns)) for scene in scenes])
    assert rates.min() >= 49
    assert rates.max() <= 410
    assert 0.4 < (np.abs(rates - 100) < 1).mean() < 0.9
    force = np.array([scene.imu.linear_acceleration.mean(axis=0) for scene in scenes])
    along_z = np.nan_to_num(force[:, 2] / np.linalg.norm(force, axis=1), nan=1.0)
    assert 0.1 < (along_z < 0.8).mean() < 0.55
    gaps = [np.diff(scene.imu.stamps_ns).max() / np.median(np.diff(scene.imu.stamps_ns)) for scene in scenes]
    assert 0.05 < (np.array(gaps) > 1.5).mean() < 0.5


# ---------------------------------------------------------------------------------------------------- consistency


def warp_error(source, depth, target, camera_K, T_source_target: RigidTransform) -> float:
    """Median absolute difference of the source and the target sampled where the source's points are seen."""
    v, u = np.mgrid[: source.shape[0], : source.shape[1]]
    seen = (depth > 0) & (depth < 40)
    rays = np.stack([u, v, np.ones_like(u)], axis=-1)[seen] @ np.linalg.inv(camera_K).T
    points = T_source_target.inv().apply(rays * depth[seen][:, None]) @ camera_K.T
    x, y = (points[:, :2] / points[:, 2:]).T.astype(np.float32)
    inside = (points[:, 2] > 0.5) & (x >= 0) & (x <= source.shape[1] - 1) & (y >= 0) & (y <= source.shape[0] - 1)
    sampled = cv2.remap(target, x[None], y[None], cv2.INTER_LINEAR)[0]
    return float(np.median(np.abs(sampled - source[seen])[inside]))


MOTIONS = {
    "vehicle": lambda seed: drive(seed, 0.0, 3.0, DriveStyle()),
    "hand": lambda seed: walk(seed, 0.0, 3.0, WalkStyle(turn_rate=0.4)),
    "hovering hand that spins": lambda seed: walk(seed, 0.0, 3.0, WalkStyle(speed_mps=0.0, spin=1.0)),
    "drone": lambda seed: fly(seed, 0.0, 3.0, FlightStyle(heading_rad=1.5, lean=0.02, climb_mps=0.5)),
}


def scaled(x: float, y: float) -> np.ndarray:
    """K with other focal lengths."""
    return K * [[x, 0, 1], [0, y, 1], [0, 0, 1]]


CAMERAS = {"square": scaled(1.0, 1.3), "squeezed": scaled(1.0, 0.45), "wide": scaled(0.6, 0.6)}


@pytest.mark.parametrize("carrier", MOTIONS)
@pytest.mark.parametrize("camera", CAMERAS)
def test_truth_explains_the_image_for_every_carrier_and_camera(carrier, camera):
    """Exact depth and true motion warp one frame onto the next; standing still explains it far worse."""
    true, still = [], []
    for seed in (1, 2):
        motion = MOTIONS[carrier](seed)
        route = Route(motion.sampled(), 1.65) if carrier == "vehicle" else road(seed, motion)
        world = World(seed, route)
        poses = motion.poses(np.array([1.4, 1.5]))
        (source, depth), (target, _) = (world.render(p, CAMERAS[camera], WIDTH, HEIGHT) for p in poses.as_matrix())
        scale = source.std()
        for errors, T in ((true, poses[0].inv() * poses[1]), (still, RigidTransform.identity())):
            errors.append(warp_error(source, depth, target, CAMERAS[camera], T) / scale)
    assert np.mean(true) < 0.06
    assert np.mean(true) < 0.5 * np.mean(still)


@pytest.mark.parametrize("carrier", MOTIONS)
def test_the_imu_integrates_to_the_motion(carrier):
    """Rates add up to the rotation and forces to the change of velocity, for every carrier."""
    motion: Motion = MOTIONS[carrier](4)
    imu = simulate_imu(motion, imu_stamps(0.5, 2.5, 1000.0), 1000.0, PERFECT_IMU, 0)
    mount = PERFECT_IMU.rotation_imu_camera.inv()
    gyro, force = mount.apply(imu.angular_velocity), mount.apply(imu.linear_acceleration)
    rotation, speed = motion.poses(np.array([0.5])).rotation[0], np.zeros(3)
    for i in range(len(imu) - 1):
        after = rotation * Rotation.from_rotvec(0.0005 * (gyro[i] + gyro[i + 1]))
        speed += 0.0005 * (rotation.apply(force[i]) + after.apply(force[i + 1])) - [0, 0, 0.00981]
        rotation = after
    start, end = (
        np.diff(motion.poses(np.array([t - 1e-4, t + 1e-4])).translation, axis=0)[0] / 2e-4 for t in (0.5, 2.5)
    )
    assert (rotation.inv() * motion.poses(np.array([2.5])).rotation[0]).magnitude() < 1e-4
    np.testing.assert_allclose(speed, end - start, atol=5e-3)


# ---------------------------------------------------------------------------------------------------- carriers


def test_hands_stay_within_their_limits():
    """Pitch and roll turn no faster than the limit, yaw only by the walk's own turning; the height is a walker's."""
    times = np.arange(0.2, 5.8, 0.02)
    for seed in range(8):
        style = WalkStyle(turn_rate=0.7, spin=(-1) ** seed * 1.0, speed_mps=0.25 * seed)
        motion = walk(seed, 0.0, 6.0, style)
        level = motion.poses(times).rotation * ROTATION_WORLD_CAMERA_LEVEL.inv()
        rates = np.abs(np.gradient(np.unwrap(level.as_euler("ZYX"), axis=0), 0.02, axis=0)).max(axis=0)
        assert rates[1:].max() < 1.05 * MAX_TURN_RATE
        assert rates[0] < MAX_TURN_RATE + 1.0
        assert rates.max() > 0.8
        heights = motion.poses(times).translation[:, 2]
        assert np.abs(heights - style.camera_height_m).max() < 0.2


def test_a_drone_never_touches_the_ground():
    """However fast it sinks, it stays above a metre."""
    motion = fly(0, 0.0, 6.0, FlightStyle(climb_mps=-4.0, height_m=3.0))
    assert motion.poses(np.arange(0.0, 6.0, 0.05)).translation[:, 2].min() > 0.95


@pytest.mark.parametrize("speed", [0.0, 12.0])
def test_nothing_stands_in_the_way_of_a_drone(speed):
    """Whatever the direction of a low flight, the nearest thing that it sees around is a metre away."""
    wide = np.array([[8.0, 0, 11.5], [0, 8.0, 7.5], [0, 0, 1]])
    for seed, heading in enumerate((0.5, 1.6, 3.0)):
        motion = fly(seed, 0.0, 2.0, FlightStyle(speed_mps=speed, heading_rad=heading, height_m=1.8, pitch_rad=0.0))
        world = World(seed, road(seed, motion))
        for pose in motion.poses(np.array([0.0, 1.0, 2.0])):
            for turn in range(4):
                around = pose * RigidTransform.from_rotation(Rotation.from_euler("y", turn * np.pi / 2))
                _, depth = world.render(around.as_matrix(), wide, 24, 16)
                assert depth[depth > 0].min() > 0.7


# ---------------------------------------------------------------------------------------------------- traffic


def test_a_car_moves_along_the_road_and_nothing_else_does():
    """Between two times the picture of a standing camera changes where the car was or is, and only there."""
    motion = drive(0, 0.0, 3.0, DriveStyle(speed_mps=0, speed_change_mps=0, shake=0, slope=0))
    route, look = Route(motion.sampled(), 1.65), Look.of_world(3)
    along = float(route.distances[route.tree.query(np.zeros(2))[1]])
    movers = [traffic.car(np.random.default_rng(seed), route, look, along, 0.0, 5.0) for seed in range(3)]
    world, empty = World(3, route, look, movers), World(3, route, look)
    pose = motion.poses(np.array([1.0]))[0].as_matrix()
    nothing, background = empty.render(pose, K, WIDTH, HEIGHT)
    (first, depth_1), (second, depth_2) = (world.render(pose, K, WIDTH, HEIGHT, time_s=t) for t in (0.0, 0.5))
    near_1, near_2 = (
        cv2.dilate((np.abs(depth - background) > 1e-6).astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
        for depth in (depth_1, depth_2)
    )
    assert near_1.any()
    assert not np.array_equal(depth_1, depth_2)
    np.testing.assert_array_equal(first[~near_1], nothing[~near_1])
    np.testing.assert_array_equal(first[~(near_1 | near_2)], second[~(near_1 | near_2)])


@pytest.mark.parametrize("speed", [-6.0, 6.0])
def test_a_mover_travels_at_its_speed_and_keeps_its_place_across(speed):
    """Distance over time is the speed, on the side of the road that is asked for, and nose first."""
    motion = drive(0, 0.0, 6.0, DriveStyle(yaw_rate=0, slope=0))
    route, look = Route(motion.sampled(), 1.65), Look.of_world(1)
    polygons = traffic._builder(route, look, 60.0, speed)
    polygons.car(np.random.default_rng(0), np.zeros(2), 0.0)
    mover = traffic.Mover(polygons.build(), traffic.CAR_METRES, route, 60.0, 3.0, speed)
    before, after = (mover.at(t).corners.reshape(-1, 3) for t in (0.0, 1.0))
    moved = (after - before).mean(axis=0)
    tangent, normal = route.tangents[100], route.normals[100]
    assert moved[:2] @ tangent == pytest.approx(speed, rel=5e-3)
    assert moved[:2] @ normal == pytest.approx(0.0, abs=0.05)
    assert before[:, :2].mean(axis=0) @ normal == pytest.approx(route.points[100] @ normal + 3.0, abs=0.1)


def test_movers_stay_away_from_the_camera(scenes):
    """At every frame of every clip the camera is outside of all that moves."""
    met = 0
    for scene in scenes:
        for time, pose in zip(scene.trajectory.stamps_ns / NANOSECONDS, scene.trajectory.poses, strict=True):
            for mover in scene.movers:
                corners = mover.at(float(time)).corners.reshape(-1, 3)
                low, high = corners[:, :2].min(axis=0), corners[:, :2].max(axis=0)
                here = pose.translation[:2]
                met += bool(np.all((here > low) & (here < high)) and pose.translation[2] < corners[:, 2].max())
    assert met == 0


# ---------------------------------------------------------------------------------------------------- whole clips


def test_clips_of_every_kind_repeat_to_the_bit(scenes):
    """One clip of each carrier and sensor, twice."""
    kinds = {(scene.carrier, type(scene.depth_sensor)): seed for seed, scene in enumerate(scenes)}
    for seed in kinds.values():
        (frames, imu, truth), (again, imu_again, truth_again) = (simulation.clip(seed, 2, 64, 32) for _ in range(2))
        for one, other in zip(frames, again, strict=True):
            np.testing.assert_array_equal(one.image, other.image)
            np.testing.assert_array_equal(one.depth, other.depth)
        np.testing.assert_array_equal(imu.angular_velocity, imu_again.angular_velocity)
        np.testing.assert_array_equal(truth.poses.as_matrix(), truth_again.poses.as_matrix())


def test_exact_depth_is_the_renderers(scenes):
    """With exact_depth there is no noise and no hole in what the renderer sees."""
    for seed in (0, 1):
        frames, _, _ = simulation.clip(seed, 3, WIDTH, HEIGHT, exact_depth=True)
        for index, frame in enumerate(frames):
            np.testing.assert_array_equal(frame.depth, scenes[seed].render(index)[1])
