"""The street along a path: houses, cars, hedges, trees and poles, all as convex polygons.

The path says where the road is; what stands beside it is drawn by generators whose seeds are the
world's seed and the place. A path that returns to a place finds the road that its first visit made
there, and the corridor around the whole path is kept clear, however often it crosses itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import RigidTransform

from fusion_io.records import FloatArray
from fusion_io.simulation.textures import FACADES, TILE_METRES, Surface

STATION_METRES = 0.5  # spacing of the path's stations
HEIGHT_METRES = 4.0  # spacing of the heights that the ground is blended from
ROAD_BEHIND_METRES = 30.0  # the road goes on, straight, before the path's start
ROAD_AHEAD_METRES = 130.0  # and after its end
REVISIT_METRES = 7.0  # a path this close to an earlier part of itself runs on the same road
REVISIT_GAP_METRES = 25.0  # along the path: less than this is not a revisit but the same passage
CROSSING_METRES = 12.0  # passages this close to each other share the ground
LOT_METRES = 13.0  # along the street: one house or garden a side
HOUSE_CLEARANCE = 3.0  # metres from the camera's path
THING_CLEARANCE = 1.7
KERB_METRES = 0.18  # across
KERB_RUN_METRES = LOT_METRES / 2

# A box of unit size on the ground: its four walls and its lid, (5, 4, 3), counter-clockwise from outside.
_RIM = np.array([[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]])
RIGHT, FRONT, LEFT, BACK, TOP = range(5)
UNIT_BOX = np.array(
    [[[*a, 0.0], [*b, 0.0], [*b, 1.0], [*a, 1.0]] for a, b in zip(_RIM, np.roll(_RIM, -1, axis=0), strict=True)]
    + [[[*corner, 1.0] for corner in _RIM]]
)
WALLS = (RIGHT, FRONT, LEFT, BACK)
BOX = (*WALLS, TOP)


@dataclass(frozen=True, slots=True)
class Look:
    """What one world has in common: the road's cross section, the sun, how densely it is built.

    Widths are metres from the path (the camera drives in the right lane). sun (3,) points to the
    sun; ambient is the light in the shade as a share of full light; houses, cars and plants are
    probabilities; sky is its radiance; kerb_m is the height of the step beside the road, 0 where there is none.
    """

    road_left_m: float
    road_right_m: float
    paving_m: float
    sun: FloatArray
    ambient: float
    houses: float
    cars: float
    plants: float
    markings: bool
    sky: float
    kerb_m: float

    @staticmethod
    def of_world(seed: int) -> Look:
        """The look of the world of a seed."""
        return Look.draw(np.random.default_rng([seed, 1]))

    @staticmethod
    def draw(rng: np.random.Generator) -> Look:
        """A random look."""
        azimuth, elevation = rng.uniform(0, 2 * np.pi), np.deg2rad(rng.uniform(25, 60))
        level = np.cos(elevation)
        cloudy = rng.random() < 0.25
        return Look(
            road_left_m=rng.uniform(3.0, 6.0),
            road_right_m=rng.uniform(2.3, 3.6),
            paving_m=rng.uniform(1.2, 3.5),
            sun=np.array([np.cos(azimuth) * level, np.sin(azimuth) * level, np.sin(elevation)]),
            ambient=rng.uniform(0.8, 1.0) if cloudy else rng.uniform(0.25, 0.5),
            houses=rng.uniform(0.4, 0.95),
            cars=rng.uniform(0.1, 0.7),
            plants=rng.uniform(0.3, 1.0),
            markings=bool(rng.random() < 0.6),
            sky=rng.uniform(0.3, 1.1),
            kerb_m=rng.choice([0.0, rng.uniform(0.05, 0.16)], p=[0.3, 0.7]),
        )


class Route:
    """Where the camera passes, as stations every half metre: points on the ground, tangents, normals.

    distances (N,) along; points (N, 2); tangents, normals (to the left) (N, 2); is_new (N,) is
    false where the path runs on a road that an earlier part of it has made. The road goes on
    straight beyond both ends.
    """

    def __init__(self, poses: RigidTransform, camera_height_m: float, beside: FloatArray | None = None) -> None:
        """poses: T_world_camera (z up) in order of time, close enough to interpolate; standing still is fine.

        beside: points (M, 2) off the path that are kept clear as the path is: of a camera that does not follow it.
        """
        ground = poses.translation - [0.0, 0.0, camera_height_m]
        ground = ground[_apart(ground[:, :2], STATION_METRES)]
        headings = poses.rotation[[0, -1]].apply([0.0, 0.0, 1.0])[:, :2]
        headings += [1e-9, 0.0]  # a camera that looks straight down has no heading: any will do
        headings /= np.linalg.norm(headings, axis=1, keepdims=True)
        behind = ground[0, :2] - ROAD_BEHIND_METRES * headings[0]
        ahead = ground[-1, :2] + ROAD_AHEAD_METRES * headings[1]
        course = np.concatenate([behind[None], ground[:, :2], ahead[None]])
        heights = np.concatenate([ground[:1, 2], ground[:, 2], ground[-1:, 2]])

        along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(course, axis=0), axis=1))])
        self.distances = np.arange(0.0, along[-1], STATION_METRES)
        self.points = np.column_stack([np.interp(self.distances, along, course[:, axis]) for axis in (0, 1)])
        tangents = np.gradient(self.points, axis=0)
        self.tangents = tangents / np.linalg.norm(tangents, axis=1, keepdims=True)
        self.normals = np.column_stack([-self.tangents[:, 1], self.tangents[:, 0]])
        self.tree = cKDTree(self.points)
        self._clear = self.points if beside is None else np.concatenate([self.points, beside])
        self._clear_tree = cKDTree(self._clear)
        self.is_new = self._find_new()
        # Heights come from where the camera was; the roads beyond are as high as what is near them.
        measured = np.arange(along[1], along[-2] + HEIGHT_METRES, HEIGHT_METRES)
        course_at = [np.interp(measured, along, course[:, axis]) for axis in (0, 1)]
        self._heights_tree = cKDTree(np.column_stack(course_at))
        self._heights = self._lowest(np.interp(measured, along, heights))

    def _lowest(self, heights: FloatArray) -> FloatArray:
        """The heights (N,), or those of another passage nearby that is lower.

        A recorded path may come back to a place at another height, by drift or over a bridge. The
        ground must then be below both.
        """
        gap = REVISIT_GAP_METRES / HEIGHT_METRES
        lowest = heights.copy()
        for i, j in self._heights_tree.query_pairs(CROSSING_METRES, output_type="ndarray"):
            if abs(i - j) > gap:
                lowest[i], lowest[j] = min(lowest[i], heights[j]), min(lowest[j], heights[i])
        return lowest

    def _find_new(self) -> NDArray[np.bool_]:
        gap = int(REVISIT_GAP_METRES / STATION_METRES)
        neighbours = self.tree.query_ball_point(self.points, REVISIT_METRES)
        return np.array([min(near) >= index - gap for index, near in enumerate(neighbours)])

    def height(self, points: FloatArray) -> FloatArray:
        """Height (N,) of the ground at points (N, 2): a smooth blend of what the path has thereabouts."""
        distance, index = self._heights_tree.query(points, k=range(1, min(12, self._heights_tree.n) + 1))
        weights = 1.0 / (np.square(distance) + 16.0) ** 2
        return np.asarray((weights * self._heights[index]).sum(axis=1) / weights.sum(axis=1))

    def is_clear(self, centre: FloatArray, axes: FloatArray, half: FloatArray, margin: float) -> bool:
        """Whether a rectangle stays ``margin`` away from the route.

        centre (2,), axes (2, 2) unit rows, half (2,) its half lengths along them.
        """
        radius = float(np.hypot(*half)) + margin
        nearest, _ = self._clear_tree.query(centre)
        if nearest > radius:
            return True
        near = self._clear[self._clear_tree.query_ball_point(centre, radius)]
        outside = np.maximum(np.abs((near - centre) @ axes.T) - half, 0.0)
        return bool(np.hypot(*outside.T).min() > margin)


def _apart(points: FloatArray, spacing: float) -> list[int]:
    """Indices of points (N, 2) in order, each at least ``spacing`` from the one before."""
    kept = [0]
    for index, point in enumerate(points):
        if np.hypot(*(point - points[kept[-1]])) >= spacing:
            kept.append(index)
    return kept


@dataclass(frozen=True, slots=True)
class Polygons:
    """Convex planar polygons: corners counter-clockwise as seen from outside.

    corners (F, 5, 3), padded by repeating the last; normals (F, 3) outwards; a point p has texture
    coordinates axes (F, 2, 3) @ (p - corners[:, 0]) + shifts (F, 2), in metres on the tile; surfaces
    (F,); tints (F, 3) RGB gain with the light in it; is_ground (F,).
    """

    corners: FloatArray
    normals: FloatArray
    axes: FloatArray
    shifts: FloatArray
    surfaces: NDArray[np.int32]
    tints: FloatArray
    is_ground: NDArray[np.bool_]

    @staticmethod
    def joined(parts: Sequence[Polygons]) -> Polygons:
        """All polygons of the parts."""
        return Polygons(*(np.concatenate([getattr(p, name) for p in parts]) for name in Polygons.__slots__))

    def take(self, indices: NDArray[np.int64]) -> Polygons:
        """Some of the polygons."""
        return Polygons(*(getattr(self, name)[indices] for name in Polygons.__slots__))


MAX_CORNERS = 5


def padded(corners: FloatArray) -> FloatArray:
    """Corners (F, k, 3) as (F, 5, 3), the last one repeated."""
    return np.concatenate([corners, np.repeat(corners[:, -1:], MAX_CORNERS - corners.shape[1], axis=1)], axis=1)


def planes(corners: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Axes (F, 2, 3) in the polygon's plane, the first along its first edge, and normals (F, 3)."""
    along = corners[:, 1] - corners[:, 0]
    along = along / np.linalg.norm(along, axis=1, keepdims=True)
    normals = np.cross(along, corners[:, 2] - corners[:, 1])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return np.stack([along, np.cross(normals, along)], axis=1), normals


@dataclass
class _Collector:
    """Polygons on their way into a world."""

    corners: list[FloatArray] = field(default_factory=list)
    shifts: list[FloatArray] = field(default_factory=list)
    looks: list[FloatArray] = field(default_factory=list)  # surface, texture scale, tint

    def add(
        self, corners: FloatArray, surface: int, tint: FloatArray, shifts: FloatArray | float = 0.0, scale: float = 1.0
    ) -> None:
        """Polygons (n, k, 3) of one surface; tint (3,) or (n, 3); shifts: one number or (n, 2)."""
        count = len(corners)
        self.corners.append(padded(corners))
        self.shifts.append(np.broadcast_to(shifts, (count, 2)))
        look = np.empty((count, 5))
        look[:, 0], look[:, 1], look[:, 2:] = surface, scale, tint
        self.looks.append(look)

    def build(self, look: Look) -> Polygons:
        """All polygons, lit by the world's sun and sky."""
        corners = np.concatenate([np.zeros((0, MAX_CORNERS, 3)), *self.corners])
        looks = np.concatenate([np.zeros((0, 5)), *self.looks])
        axes, normals = planes(corners)
        light = look.ambient + (1.0 - look.ambient) * np.clip(normals @ look.sun, 0.0, None)
        light *= 0.9 + 0.1 * normals[:, 2]  # the sky is brighter than the ground
        return Polygons(
            corners,
            normals,
            axes / looks[:, 1, None, None],
            np.concatenate([np.zeros((0, 2)), *self.shifts]),
            looks[:, 0].astype(np.int32),
            looks[:, 2:] * light[:, None],
            np.zeros(len(corners), bool),
        )


def _dodecahedron() -> FloatArray:
    """The faces (12, 5, 3) of the dodecahedron in the unit sphere, counter-clockwise from outside."""
    golden = (1 + np.sqrt(5)) / 2
    cube = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
    rest = np.array([[0, y / golden, z * golden] for y in (-1, 1) for z in (-1, 1)])
    corners = np.concatenate([cube, *(np.roll(rest, turn, axis=1) for turn in range(3))])
    normals = np.array([[x, 0, z * golden] for x in (-1, 1) for z in (-1, 1)], float)
    faces = []
    for normal in np.concatenate([np.roll(normals, turn, axis=1) for turn in range(3)]):
        face = corners[np.argsort(-(corners @ normal), kind="stable")[:5]]
        right = np.cross(normal, [0.1, 0.7, 0.3])  # any direction but the normal's
        up = np.cross(normal, right) / np.linalg.norm(normal)
        faces.append(face[np.argsort(np.arctan2(face @ up, face @ right))])
    return np.asarray(np.array(faces) / np.sqrt(3))


DODECAHEDRON = _dodecahedron()


def _tint(rng: np.random.Generator, low: float, high: float, colour: float) -> FloatArray:
    """A random RGB gain: brightness uniform on a log scale, and a little colour."""
    return np.asarray(np.exp(rng.uniform(np.log(low), np.log(high)) + colour * rng.standard_normal(3)))


class Ground(Protocol):
    """Where things can be placed."""

    def is_clear(self, centre: FloatArray, axes: FloatArray, half: FloatArray, margin: float) -> bool:
        """Whether a rectangle is free, see ``Route.is_clear``."""

    def height(self, points: FloatArray) -> FloatArray:
        """Height (N,) at points (N, 2)."""


class _Site:
    """A place on the ground with a heading: turns local coordinates (x along, y left, z up) into the world's."""

    def __init__(self, ground: Ground, centre: FloatArray, heading: float) -> None:
        self._ground, self.centre = ground, centre
        c, s = np.cos(heading), np.sin(heading)
        self.axes = np.array([[c, s], [-s, c]])

    def is_clear(self, length: float, width: float, margin: float) -> bool:
        """Whether a rectangle here keeps its distance from everywhere the camera passes."""
        return self._ground.is_clear(self.centre, self.axes, 0.5 * np.array([length, width]), margin)

    def settle(self) -> None:
        """Finds the ground; to be called before ``points``."""
        self._height = float(self._ground.height(self.centre[None])[0])

    def points(self, local: FloatArray) -> FloatArray:
        """Local points (..., 3) in the world."""
        world = np.empty(local.shape)
        world[..., :2] = local[..., :2] @ self.axes + self.centre
        world[..., 2] = local[..., 2] + self._height
        return world

    def outline(self, local: FloatArray) -> FloatArray:
        """Local points (..., 2) on the ground in the world."""
        return np.asarray(local @ self.axes + self.centre)


class Builder:
    """Places things; every one leaves polygons, and the outline of its shadow on the ground."""

    def __init__(self, ground: Ground, look: Look) -> None:
        self._ground, self._look = ground, look
        self._collector = _Collector()
        self.shadows: list[FloatArray] = []

    def build(self) -> Polygons:
        """The polygons of everything placed."""
        return self._collector.build(self._look)

    def _boxes(
        self,
        site: _Site,
        faces: Sequence[int],
        size: Sequence[float] | FloatArray,
        centre: Sequence[float] | FloatArray,
        surface: int,
        tint: FloatArray,
        shift: float = 0.0,
        scale: float = 1.0,
    ) -> None:
        """Faces of boxes: size (3,) and the middle of the floor, centre (3,) or (n, 3) one a face.

        The texture runs on around the corners; its v = 0 is the site's ground.
        """
        local = UNIT_BOX[list(faces)] * size + np.asarray(centre)[..., None, :]
        around = np.array([0.0, size[0], size[0] + size[1], 2 * size[0] + size[1], 0.0])[list(faces)]
        shifts = np.stack([shift + around / scale, local[:, 0, 2] / scale], axis=1)
        self._collector.add(site.points(local), surface, tint, shifts, scale)

    def _shadow(self, outline: FloatArray, height: float, lift: float = 0.0) -> None:
        """The shadow of an upright prism on an outline (n, 2) that hangs ``lift`` above the ground."""
        throw = -self._look.sun[:2] / self._look.sun[2]
        points = np.concatenate([outline + lift * throw, outline + height * throw])
        self.shadows.append(cv2.convexHull(points.astype(np.float32))[:, 0])

    def house(self, rng: np.random.Generator, centre: FloatArray, heading: float, length: float) -> None:
        """A house with a pitched or flat roof."""
        site = _Site(self._ground, centre, heading)
        depth, height = rng.uniform(7.0, 12.0), rng.uniform(3.2, 10.0)
        if not site.is_clear(length, depth, HOUSE_CLEARANCE):
            return
        site.settle()
        tint, surface = _tint(rng, 0.6, 1.35, 0.06), Surface.FACADE + int(rng.integers(FACADES))
        shift, scale = rng.uniform(0, TILE_METRES), rng.uniform(0.8, 1.25)
        sunk = 2.0  # into a slope
        self._boxes(site, WALLS, (length, depth, height + sunk), (0, 0, -sunk), surface, tint, shift, scale)
        if rng.random() < 0.3:
            self._boxes(site, (TOP,), (length, depth, height), (0, 0, 0), Surface.ASPHALT, tint, shift)
        else:
            self._gable(rng, site, (length, depth, height), surface, tint, shift, scale)
        self._shadow(site.outline(_RIM * [length, depth]), height + 1.0)
        if rng.random() < 0.6:
            self._annexes(rng, site, (length, depth, height), surface, tint)

    def _annexes(
        self, rng: np.random.Generator, site: _Site, size: tuple[float, float, float], surface: int, tint: FloatArray
    ) -> None:
        """What stands out of both fronts: balconies, bay windows, porches."""
        length, depth, height = size
        for _ in range(int(rng.integers(1, 4))):
            wide, out = rng.uniform(1.2, 3.5), rng.uniform(0.3, 1.2)
            along = rng.uniform(-0.5, 0.5) * (length - wide)
            low, high = ((2.8, 3.8), (5.7, 6.7), (-0.7, min(height, 3.0)), (-0.7, 0.5))[rng.integers(4)]
            if high > height:
                continue
            box = (wide, depth + 2 * out, high - low)
            shift, look = rng.uniform(0, TILE_METRES), tint * rng.uniform(0.7, 1.2)
            self._boxes(site, (RIGHT, LEFT), box, (along, 0, low), surface, look, shift)
            sides = np.array([[along, side * 0.5 * (depth + out), low] for side in (-1, -1, 1, 1)])
            flanks = (FRONT, BACK, FRONT, BACK)
            self._boxes(site, flanks, (wide, out, high - low), sides, Surface.PLAIN, look, shift)
            self._boxes(site, (TOP,), box, (along, 0, low), Surface.STONE, look, shift)

    def _gable(
        self,
        rng: np.random.Generator,
        site: _Site,
        size: tuple[float, float, float],
        surface: int,
        tint: FloatArray,
        shift: float,
        scale: float,
    ) -> None:
        """A pitched roof, its ridge along the longer side or across it."""
        eaves = np.column_stack([_RIM * size[:2], np.full(4, size[2])])
        if rng.random() < 0.4:
            eaves = np.roll(eaves, 1, axis=0)
        a, b, c, d = eaves
        rise = 0.5 * float(np.linalg.norm(d - a)) * rng.uniform(0.5, 1.0)
        near, far = 0.5 * (a + d) + [0, 0, rise], 0.5 * (b + c) + [0, 0, rise]
        gables = site.points(np.array([[b, c, far], [d, a, near]]))
        self._collector.add(gables, surface, tint, np.array([shift, size[2] / scale]), scale)
        roof = site.points(np.array([[a, b, far, near], [c, d, near, far]]))
        self._collector.add(roof, Surface.ROOF, _tint(rng, 0.3, 0.9, 0.05), shift)

    def car(self, rng: np.random.Generator, centre: FloatArray, heading: float) -> None:
        """A car or van: body, cabin, shadowed underside, wheels, lights and number plates."""
        site = _Site(self._ground, centre, heading)
        if rng.random() < 0.2:  # a van
            length, width, waist, roof = rng.uniform(4.6, 5.6), 1.95, 1.2, 2.1
            cabin, back = 0.9 * length, 0.0
        else:
            length, width = rng.uniform(3.7, 4.8), rng.uniform(1.65, 1.85)
            waist, roof = rng.uniform(0.85, 1.0), rng.uniform(1.4, 1.65)
            cabin, back = 0.55 * length, -0.08 * length
        if not site.is_clear(length, width, THING_CLEARANCE):
            return
        site.settle()
        paint, shift = _tint(rng, 0.08, 1.5, 0.15), rng.uniform(0, TILE_METRES)
        black, hub, white, red = np.full(3, 0.08), np.full(3, 0.5), np.full(3, 1.4), np.array([0.9, 0.15, 0.15])
        self._boxes(site, BOX, (length, width, waist - 0.25), (0, 0, 0.25), Surface.PAINT, paint, shift)
        self._boxes(site, WALLS, (cabin, width - 0.2, roof - waist), (back, 0, waist), Surface.GLASS, np.ones(3), shift)
        self._boxes(site, (TOP,), (cabin, width - 0.2, roof - waist), (back, 0, waist), Surface.PAINT, paint, shift)
        self._boxes(site, WALLS, (0.94 * length, width - 0.15, 0.25), (0, 0, 0), Surface.PLAIN, black)
        # Wheels, lamps and plates are faces of boxes a little wider or longer than the body.
        axles = np.array([[x * length, 0.0, 0.0] for x in (-0.31, -0.31, 0.31, 0.31)])
        sides = (RIGHT, LEFT, RIGHT, LEFT)
        self._boxes(site, sides, (0.6, width + 0.02, 0.6), axles, Surface.PLAIN, black)
        axles[:, 2] = 0.15
        self._boxes(site, sides, (0.3, width + 0.04, 0.3), axles, Surface.PLAIN, hub)
        lamps = np.array([[0.0, y * width, 0.6] for y in (-0.36, 0.36)])
        self._boxes(site, (FRONT, FRONT), (length + 0.02, 0.3, 0.16), lamps, Surface.PLAIN, white)
        self._boxes(site, (BACK, BACK), (length + 0.02, 0.3, 0.16), lamps, Surface.PLAIN, red)
        self._boxes(site, (FRONT, BACK), (length + 0.02, 0.52, 0.12), (0, 0, 0.4), Surface.PLAIN, white)
        self._shadow(site.outline(_RIM * [length, width]), 0.7 * roof)

    def person(self, rng: np.random.Generator, centre: FloatArray, heading: float) -> None:
        """Somebody on foot: legs, body, head."""
        site = _Site(self._ground, centre, heading)
        if not site.is_clear(0.4, 0.5, THING_CLEARANCE):
            return
        site.settle()
        tall, shift = rng.uniform(1.5, 1.95), rng.uniform(0, TILE_METRES)
        legs, shirt, skin = _tint(rng, 0.1, 0.8, 0.1), _tint(rng, 0.1, 1.5, 0.3), np.array([1.2, 0.95, 0.8])
        self._boxes(site, WALLS, (0.25, 0.32, 0.5 * tall), (0, 0, 0), Surface.PAINT, legs, shift)
        self._boxes(site, BOX, (0.28, 0.48, 0.36 * tall), (0, 0, 0.5 * tall), Surface.PAINT, shirt, shift)
        self._boxes(site, BOX, (0.2, 0.17, 0.14 * tall), (0, 0, 0.86 * tall), Surface.PLAIN, skin, shift)
        self._shadow(site.outline(_RIM * 0.4), tall)

    def kerb(self, rng: np.random.Generator, centre: FloatArray, heading: float, length: float) -> None:
        """A row of kerbstones, a step of some 10 cm."""
        site = _Site(self._ground, centre, heading)
        if not site.is_clear(length, KERB_METRES, THING_CLEARANCE):
            return
        site.settle()
        size, tint = (length, KERB_METRES, self._look.kerb_m + 0.3), np.full(3, 1.15)
        self._boxes(site, (RIGHT, LEFT, TOP), size, (0, 0, -0.3), Surface.STONE, tint, rng.uniform(0, TILE_METRES))

    def hedge(self, rng: np.random.Generator, centre: FloatArray, heading: float, length: float) -> None:
        """A hedge, a garden wall or a fence."""
        site = _Site(self._ground, centre, heading)
        kind = int(rng.choice(3, p=[0.5, 0.25, 0.25]))
        surface = (Surface.FOLIAGE, Surface.STONE, Surface.FENCE)[kind]
        thickness, height = (rng.uniform(0.5, 1.0), 0.25, 0.06)[kind], rng.uniform(0.7, 1.9)
        if not site.is_clear(length, thickness, THING_CLEARANCE):
            return
        site.settle()
        sunk = 0.7
        look = (_tint(rng, 0.4, 1.2, 0.05), rng.uniform(0, TILE_METRES), rng.uniform(0.7, 1.3))
        self._boxes(site, BOX, (length, thickness, height + sunk), (0, 0, -sunk), surface, *look)
        self._shadow(site.outline(_RIM * [length, thickness]), height)

    def bush(self, rng: np.random.Generator, centre: FloatArray) -> None:
        """A round bush on the ground."""
        radii = rng.uniform(0.5, 1.4, 3)
        self._crown(rng, centre, 0.6 * radii[2], radii)

    def tree(self, rng: np.random.Generator, centre: FloatArray) -> None:
        """A trunk with one to three crowns."""
        girth, stem = rng.uniform(0.15, 0.4), rng.uniform(2.2, 4.0)
        self._post(rng, centre, girth, stem + 1.0, Surface.WOOD, _tint(rng, 0.4, 1.0, 0.05))
        for _ in range(int(rng.integers(1, 4))):
            radii = rng.uniform(1.0, 2.4, 3) * [1.0, 1.0, 1.2]
            place = centre + rng.normal(0.0, 0.5, 2)
            self._crown(rng, place, stem + radii[2] * rng.uniform(0.8, 1.3), radii)

    def _crown(self, rng: np.random.Generator, centre: FloatArray, height: float, radii: FloatArray) -> None:
        """Leaves: a dodecahedron stretched to the radii (3,), its middle ``height`` above the ground."""
        site = _Site(self._ground, centre, rng.uniform(0, 2 * np.pi))
        if not site.is_clear(2 * radii[0], 2 * radii[1], THING_CLEARANCE):
            return
        site.settle()
        faces = site.points(DODECAHEDRON * radii + [0.0, 0.0, height])
        shifts = rng.uniform(0, TILE_METRES, (len(faces), 2))
        self._collector.add(faces, Surface.FOLIAGE, _tint(rng, 0.4, 1.3, 0.05), shifts)
        angles = np.arange(8) * np.pi / 4
        disc = 0.85 * np.column_stack([radii[0] * np.cos(angles), radii[1] * np.sin(angles)])
        self._shadow(site.outline(disc), height + 0.5 * radii[2], max(height - 0.5 * radii[2], 0.0))

    def pole(self, rng: np.random.Generator, centre: FloatArray) -> None:
        """A lamp post, or a traffic sign."""
        girth, height = rng.uniform(0.06, 0.2), rng.uniform(2.2, 7.0)
        site = self._post(rng, centre, girth, height, Surface.PLAIN, _tint(rng, 0.2, 1.2, 0.05))
        if site is not None and height < 3.5:
            tint = _tint(rng, 0.3, 1.5, 0.3)
            self._boxes(site, (FRONT, BACK), (girth + 0.06, 0.6, 0.6), (0, 0, height - 0.6), Surface.PAINT, tint)

    def _post(
        self, rng: np.random.Generator, centre: FloatArray, girth: float, height: float, surface: int, tint: FloatArray
    ) -> _Site | None:
        """Something upright and thin; None where it would be in the way."""
        site = _Site(self._ground, centre, rng.uniform(0, 2 * np.pi))
        if not site.is_clear(girth, girth, THING_CLEARANCE):
            return None
        site.settle()
        self._boxes(site, WALLS, (girth, girth, height + 0.7), (0, 0, -0.7), surface, tint, rng.uniform(0, TILE_METRES))
        self._shadow(site.outline(_RIM * girth), height)
        return site


def build_street(route: Route, look: Look, seed: int) -> tuple[Polygons, list[FloatArray]]:
    """Everything that stands along the path, and the outlines (n, 2) of the shadows on the ground."""
    builder = Builder(route, look)
    for station in range(0, len(route.points), int(LOT_METRES / STATION_METRES)):
        if not route.is_new[station]:
            continue
        for side in (1, -1):
            _furnish(builder, _place_generator(seed, route.points[station], side), route, look, station, side)
    return builder.build(), builder.shadows


def _place_generator(seed: int, point: FloatArray, side: int) -> np.random.Generator:
    """The generator of a place: seeded by the world's seed and the metre that the point lies in."""
    cell = np.floor(point).astype(np.int64)
    return np.random.default_rng([seed, side + 1, *(int(c) & 0xFFFFFFFF for c in cell)])


def _furnish(builder: Builder, rng: np.random.Generator, route: Route, look: Look, station: int, side: int) -> None:
    """One lot on one side (1 left, -1 right): a house or a garden, what stands before it, what is parked."""
    heading = float(np.arctan2(route.tangents[station, 1], route.tangents[station, 0]))
    kerb = look.road_left_m if side > 0 else look.road_right_m
    fence_line = kerb + look.paving_m + 0.4
    middle = 0.5 * LOT_METRES

    def spot(along: float, lateral: float) -> FloatArray:
        index = min(station + int(along / STATION_METRES), len(route.points) - 1)
        return np.asarray(route.points[index] + side * lateral * route.normals[index])

    setback = rng.choice([0.0, rng.uniform(1.0, 3.0), rng.uniform(3.0, 8.0)])
    if rng.random() < look.houses:
        builder.house(rng, spot(middle, fence_line + setback + 5.5), heading, rng.uniform(7.0, LOT_METRES))
    elif rng.random() < 0.5:  # one further back
        turned = heading + rng.normal(0, 0.2)
        builder.house(rng, spot(middle, fence_line + setback + rng.uniform(10, 22)), turned, rng.uniform(7.0, 16.0))
    if setback > 0.5 and rng.random() < look.plants:
        builder.hedge(rng, spot(middle, fence_line), heading, rng.uniform(5.0, LOT_METRES))
    for _ in range(rng.poisson(1.5 * look.plants)):
        builder.bush(rng, spot(rng.uniform(0, LOT_METRES), fence_line + rng.uniform(0.7, 6.0)))
    for _ in range(rng.poisson(look.plants)):
        builder.tree(rng, spot(rng.uniform(0, LOT_METRES), fence_line + rng.uniform(-1.2, 9.0)))
    for bay in (0.25, 0.75):
        if rng.random() < look.cars:
            along = bay * LOT_METRES + rng.normal(0, 0.4)
            turned = heading + rng.choice([0.0, np.pi]) + rng.normal(0, 0.03)
            builder.car(rng, spot(along, max(kerb - rng.uniform(-0.6, 1.0), 2.8)), turned)
    if rng.random() < 0.5:
        builder.pole(rng, spot(rng.uniform(0, LOT_METRES), kerb + 0.5))
    if look.kerb_m > 0:
        for start in np.arange(0.0, LOT_METRES, KERB_RUN_METRES):
            if rng.random() < 0.85:  # else it is lowered, as before a driveway
                builder.kerb(
                    rng, spot(start + 0.5 * KERB_RUN_METRES, kerb + 0.5 * KERB_METRES), heading, KERB_RUN_METRES
                )
