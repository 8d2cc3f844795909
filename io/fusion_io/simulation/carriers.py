"""What carries a camera other than a car: a walking person's hand, and a drone.

Neither follows a road, so a road is made for the motion.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import RigidTransform, Rotation

from fusion_io.records import FloatArray
from fusion_io.simulation.motion import KNOT_SECONDS, ROTATION_WORLD_CAMERA_LEVEL, Motion, integral, wander
from fusion_io.simulation.street import Route

MAX_TURN_RATE = 1.5  # rad/s about each of yaw, pitch and roll
SIGHT_METRES = 30.0  # of road before and behind the origin, beside what every road has beyond its ends
LOWEST_METRES = 1.0  # that a drone flies


@dataclass(frozen=True, slots=True)
class WalkStyle:
    """The statistics of a camera in a walking person's hand; the defaults are a calm stroll along the road.

    heading_rad: of the walk, from the road's; gaze_rad: of the camera, from the walk's (both to the
    left), pitch_rad downwards. turn_rate: standard deviation of the hand's rates of yaw, pitch and
    roll in rad/s; spin: constant rate of yaw. camera_height_m is over the ground; offset_m to the
    left of the road's path.
    """

    speed_mps: float = 1.2
    heading_rad: float = 0.0
    gaze_rad: float = 0.0
    pitch_rad: float = 0.1
    turn_rate: float = 0.2
    spin: float = 0.0
    camera_height_m: float = 1.55
    offset_m: float = 0.0


@dataclass(frozen=True, slots=True)
class FlightStyle:
    """The statistics of a drone's flight; the defaults are a slow flight along the road.

    heading_rad: of the flight, from the road's; climb_mps upwards; yaw_rad of the camera, from the
    road's heading, pitch_rad downwards. lean: how far it leans into its flight, radians for every
    m/s (0 with a gimbal). turn_rate: standard deviation of the rates of yaw, pitch and roll in
    rad/s; spin: constant rate of yaw. height_m is over the ground at the start; offset_m to the
    left of the road's path.
    """

    speed_mps: float = 4.0
    heading_rad: float = 0.0
    climb_mps: float = 0.0
    yaw_rad: float = 0.0
    pitch_rad: float = 0.3
    lean: float = 0.0
    turn_rate: float = 0.1
    spin: float = 0.0
    height_m: float = 5.0
    offset_m: float = 0.0


def walk(seed: int, start_s: float, end_s: float, style: WalkStyle) -> Motion:
    """A hand-held camera from start_s to end_s, beginning beside the world's origin.

    The walker strays a little; every step lifts the camera, every second one sways it.
    """
    rng = np.random.default_rng(seed)
    times = _knots(start_s, end_s)
    speed = style.speed_mps * np.maximum(1.0 + 0.2 * _wander(rng, len(times), 3.0), 0.0)
    heading = style.heading_rad + 0.3 * _wander(rng, len(times), 4.0)
    x, y = integral(speed * np.cos(heading)), integral(speed * np.sin(heading)) + style.offset_m
    steps = 2 * np.pi * rng.uniform(1.6, 2.1) * times + rng.uniform(0, 2 * np.pi)
    gait = min(style.speed_mps, 1.5) * rng.uniform(0.01, 0.025)
    z = style.camera_height_m + gait * np.sin(steps) + 0.02 * _wander(rng, len(times), 1.5)
    sway = 0.7 * gait * np.sin(0.5 * steps)
    x, y = x - sway * np.sin(heading), y + sway * np.cos(heading)
    turning = _turning(rng, times, style.turn_rate, style.spin, period_s=rng.uniform(0.5, 1.5))
    turning[:, 0] += heading + style.gaze_rad
    turning[:, 1] += style.pitch_rad
    rotations = Rotation.from_euler("ZYX", turning) * ROTATION_WORLD_CAMERA_LEVEL
    return Motion(times, RigidTransform.from_components(np.column_stack([x, y, z]), rotations))


def fly(seed: int, start_s: float, end_s: float, style: FlightStyle) -> Motion:
    """A drone from start_s to end_s, beginning above the world's origin, never below LOWEST_METRES."""
    rng = np.random.default_rng(seed)
    times = _knots(start_s, end_s)
    towards = np.array([np.cos(style.heading_rad), np.sin(style.heading_rad), style.climb_mps])
    towards[:2] *= style.speed_mps
    gusts = np.column_stack([_wander(rng, len(times), 2.5) for _ in range(3)])
    velocity = towards + (0.1 + 0.05 * style.speed_mps) * gusts * [1.0, 1.0, 0.5]
    positions = np.column_stack([integral(axis) for axis in velocity.T])
    positions[:, 1] += style.offset_m
    above = positions[:, 2] + style.height_m - LOWEST_METRES
    positions[:, 2] = LOWEST_METRES + 0.5 * (above + np.hypot(above, 0.5))  # a smooth maximum of above and 0
    turning = _turning(rng, times, style.turn_rate, style.spin, period_s=rng.uniform(0.8, 3.0))
    turning += [style.yaw_rad, style.pitch_rad, 0.0]
    level = np.column_stack([-velocity[:, 1], velocity[:, 0], np.zeros(len(times))])
    rotations = Rotation.from_rotvec(style.lean * level) * Rotation.from_euler("ZYX", turning)
    return Motion(times, RigidTransform.from_components(positions, rotations * ROTATION_WORLD_CAMERA_LEVEL))


def road(seed: int, motion: Motion) -> Route:
    """The level road under a motion, with everything beside it out of the camera's way.

    A short motion has a road of its own, a gentle bend along x; a long one is what the road follows.
    """
    track = motion.sampled().translation[:, :2]
    if np.abs(track).max() < SIGHT_METRES:
        along = np.arange(-SIGHT_METRES, SIGHT_METRES + 1.0)
        bend = np.random.default_rng(seed).normal(0.0, 0.004)  # 1/m
        return _level_road(np.column_stack([along, 0.5 * bend * along**2]), beside=track)
    travelled = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(track, axis=0), axis=1))])
    marks = np.arange(0.0, travelled[-1], 2.0)
    return _level_road(np.column_stack([np.interp(marks, travelled, axis) for axis in track.T]), beside=track)


def _level_road(points: FloatArray, beside: FloatArray) -> Route:
    """A road along points (N, 2), clear of those beside (M, 2)."""
    steps = np.gradient(points, axis=0)
    headings = Rotation.from_euler("z", np.arctan2(steps[:, 1], steps[:, 0])[:, None])
    places = np.column_stack([points, np.zeros(len(points))])
    return Route(RigidTransform.from_components(places, headings * ROTATION_WORLD_CAMERA_LEVEL), 0.0, beside)


def _knots(start_s: float, end_s: float) -> FloatArray:
    count = max(int(np.ceil((end_s - start_s) / KNOT_SECONDS)) + 1, 6)
    return np.asarray(start_s + KNOT_SECONDS * np.arange(count), np.float64)


def _wander(rng: np.random.Generator, count: int, period_s: float) -> FloatArray:
    return wander(rng, count, period_s / KNOT_SECONDS)


def _turning(rng: np.random.Generator, times: FloatArray, rate: float, spin: float, period_s: float) -> FloatArray:
    """Yaw, pitch and roll (N, 3) that wander at a standard deviation of ``rate``, none faster than MAX_TURN_RATE.

    spin: rad/s of constant yaw.
    """
    angles = np.column_stack([_wander(rng, len(times), period_s) for _ in range(3)])
    # The derivative of noise smoothed by a Gaussian of sigma s has a deviation of 1 / (sqrt(2) s) times its own.
    angles *= rate * np.sqrt(2.0) * 0.25 * period_s
    fastest = np.abs(np.gradient(angles, KNOT_SECONDS, axis=0)).max(axis=0)
    limits = MAX_TURN_RATE - np.array([abs(spin), 0.0, 0.0])
    angles *= np.minimum(1.0, limits / np.maximum(fastest, 1e-9))
    angles[:, 0] += spin * (times - times.mean())
    return angles
