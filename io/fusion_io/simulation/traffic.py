"""What moves by itself: cars on the road and people beside it. The camera's ground truth knows nothing of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from fusion_io.records import FloatArray
from fusion_io.simulation.street import Builder, Look, Polygons, Route

CAR_METRES = np.array([5.6, 2.0])  # the largest
PERSON_METRES = np.array([0.6, 0.6])
CLEARANCE_METRES = 1.0
ONCOMING_METRES = 2.9  # to the left of the path, at least


class _FlatSite:
    """Level ground without a road: where a thing is built before it moves."""

    def is_clear(self, centre: FloatArray, axes: FloatArray, half: FloatArray, margin: float) -> bool:
        """Nothing is in the way."""
        return True

    def height(self, points: FloatArray) -> FloatArray:
        """Zero (N,) at points (N, 2)."""
        return np.zeros(len(points))


class Mover:
    """Polygons that travel along a route at a constant speed and distance from its middle."""

    def __init__(
        self, polygons: Polygons, size: FloatArray, route: Route, start_m: float, lateral_m: float, speed_mps: float
    ) -> None:
        """polygons: around the origin, heading along x; size (2,) length and width.

        start_m along the route at time 0, lateral_m to the left of it; a negative speed is towards its beginning.
        """
        self._polygons, self._half, self._route = polygons, 0.5 * size, route
        self._start_m, self._lateral_m, self._speed_mps = start_m, lateral_m, speed_mps

    def at(self, time_s: float) -> Polygons:
        """The polygons in the world at a time."""
        place, forward = self._place(time_s)
        turn = np.array([[forward[0], -forward[1], 0.0], [forward[1], forward[0], 0.0], [0.0, 0.0, 1.0]])
        ground = float(self._route.height(place[None])[0])
        local = self._polygons
        return replace(
            local,
            corners=local.corners @ turn.T + [*place, ground],
            normals=local.normals @ turn.T,
            axes=local.axes @ turn.T,
        )

    def is_clear_of(self, times_s: FloatArray, points: FloatArray) -> bool:
        """Whether it stays away from something that is at points (N, 2) at the times (N,)."""
        for time, point in zip(times_s, points, strict=True):
            place, forward = self._place(float(time))
            offset = point - place
            along, across = abs(offset @ forward), abs(offset @ [-forward[1], forward[0]])
            if along < self._half[0] + CLEARANCE_METRES and across < self._half[1] + CLEARANCE_METRES:
                return False
        return True

    def _place(self, time_s: float) -> tuple[FloatArray, FloatArray]:
        """Where it is (2,), and its unit direction (2,)."""
        route, along = self._route, self._start_m + self._speed_mps * time_s
        point, tangent = (
            np.array([np.interp(along, route.distances, values[:, axis]) for axis in (0, 1)])
            for values in (route.points, route.tangents)
        )
        tangent /= np.linalg.norm(tangent)
        place = point + self._lateral_m * np.array([-tangent[1], tangent[0]])
        return place, tangent if self._speed_mps >= 0 else -tangent


def draw_movers(
    rng: np.random.Generator, route: Route, look: Look, times_s: FloatArray, points: FloatArray, cars: int, people: int
) -> list[Mover]:
    """Cars and people that come near a camera which is at points (N, 2) at the times (N,), but never touch it.

    Each passes near the camera at one of the times; whoever would touch it stays away.
    """
    span = max(float(times_s[-1] - times_s[0]), 1e-3)
    camera_speed = float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum()) / span
    movers = []
    for kind in [car] * cars + [person] * people:
        index = int(rng.integers(len(times_s)))
        along = float(route.distances[route.tree.query(points[index])[1]])
        movers.append(kind(rng, route, look, along, float(times_s[index]), camera_speed))
    return [mover for mover in movers if mover.is_clear_of(times_s, points)]


def car(
    rng: np.random.Generator, route: Route, look: Look, along_m: float, time_s: float, camera_speed_mps: float
) -> Mover:
    """A car ahead in the camera's lane at about its speed, or an oncoming one; at time_s the camera is at along_m."""
    if rng.random() < 0.4:
        lateral, there = rng.normal(0.0, 0.2), along_m + rng.uniform(8.0, 45.0)
        speed = max(camera_speed_mps + rng.normal(0.0, 2.0), 0.5)
    else:
        lateral, there = max(look.road_left_m - rng.uniform(1.2, 2.0), ONCOMING_METRES), along_m + rng.uniform(6, 70)
        speed = -rng.uniform(3.0, 15.0)
    builder = _builder(route, look, there, speed)
    builder.car(rng, np.zeros(2), 0.0)
    return Mover(builder.build(), CAR_METRES, route, there - speed * time_s, lateral, speed)


def person(
    rng: np.random.Generator, route: Route, look: Look, along_m: float, time_s: float, camera_speed_mps: float
) -> Mover:
    """Somebody who walks along the pavement, whatever the camera's speed; at time_s the camera is at along_m."""
    there = along_m + rng.uniform(2.0, 30.0)
    left = rng.random() < 0.5
    lateral = (look.road_left_m if left else -look.road_right_m) + (1 if left else -1) * rng.uniform(0.3, 1.2)
    speed = rng.choice([-1.0, 1.0]) * rng.uniform(0.5, 2.0)
    builder = _builder(route, look, there, speed)
    builder.person(rng, np.zeros(2), 0.0)
    return Mover(builder.build(), PERSON_METRES, route, there - speed * time_s, lateral, speed)


def _builder(route: Route, look: Look, along_m: float, speed_mps: float) -> Builder:
    """Builds things in their own axes, lit by the sun as it stands to the road there."""
    station = int(np.argmin(np.abs(route.distances - along_m)))
    forward = route.tangents[station] * (1 if speed_mps >= 0 else -1)
    turned = np.array([forward @ look.sun[:2], forward[0] * look.sun[1] - forward[1] * look.sun[0], look.sun[2]])
    return Builder(_FlatSite(), replace(look, sun=turned))
