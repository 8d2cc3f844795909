"""The street along a path: ground, houses, cars, hedges, trees, poles, all as convex polygons.

What stands where is drawn by a generator whose seed is the world's seed and the place, so content
is a function of place; the path only says where the road is. The corridor around the whole path is
kept clear: nothing stands where the camera passes, however often the path crosses itself.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from fusion_io.records import FloatArray
from fusion_io.simulation.textures import FACADES, TILE_METRES, Surface

STATION_METRES = 0.5  # spacing of the path's stations
REVISIT_METRES = 7.0  # a path this close to an earlier one runs on the same road
REVISIT_GAP_METRES = 25.0  # along the path: less than this is not a revisit but the same passage
LOT_METRES = 13.0  # along the street: one house, garden or gap a side
GROUND_CELL_METRES = 8.0
GROUND_REACH_METRES = 56.0  # the ground ends this far from the path; beyond is the backdrop
TILE_CELL_METRES = 1.0  # grid of the road coordinates
TILE_CELLS = 16  # a tile of the ground map is 16 m wide
MAP_REACH_METRES = 20.0  # beyond this from the path the ground is plain grass
SHADOW_FACTOR = 4  # shadows are drawn four times finer than the road coordinates
MAX_CORNERS = 5

Points = FloatArray


@dataclass(frozen=True, slots=True)
class Look:
    """What one world has in common: the road's cross section, the sun, how dense it is built.

    Widths are metres from the path (the camera drives in the right lane). sun (3,) points to the
    sun; ambient is the light in the shade as a share of full light.
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

    @staticmethod
    def draw(rng: np.random.Generator) -> Look:
        """A random look."""
        azimuth, elevation = rng.uniform(0, 2 * np.pi), np.deg2rad(rng.uniform(25, 60))
        sun = np.array(
            [np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)]
        )
        cloudy = rng.random() < 0.25
        return Look(
            road_left_m=rng.uniform(3.0, 6.0),
            road_right_m=rng.uniform(2.3, 3.6),
            paving_m=rng.uniform(1.2, 3.5),
            sun=sun,
            ambient=rng.uniform(0.8, 1.0) if cloudy else rng.uniform(0.25, 0.5),
            houses=rng.uniform(0.3, 0.95),
            cars=rng.uniform(0.1, 0.7),
            plants=rng.uniform(0.2, 0.9),
            markings=bool(rng.random() < 0.6),
            sky=rng.uniform(0.65, 1.1),
        )


@dataclass
class Polygons:
    """Convex planar polygons: corners counter-clockwise as seen from outside.

    corners (F, 5, 3), padded by repeating the last; normals (F, 3) outwards; origins (F, 3) and
    axes (F, 2, 3): a point p has texture coordinates axes @ (p - origin) + shifts (F, 2), metres on
    the tile; surfaces (F,); tints (F, 3) RGB gain with the light in it. is_ground (F,).
    """

    corners: FloatArray
    normals: FloatArray
    origins: FloatArray
    axes: FloatArray
    shifts: FloatArray
    surfaces: NDArray[np.int32]
    tints: FloatArray
    is_ground: NDArray[np.bool_]


@dataclass
class PolygonList:
    """Collects polygons with their look; the sun's light is worked into the tint."""

    look: Look
    corners: list[FloatArray] = field(default_factory=list)
    origins: list[FloatArray] = field(default_factory=list)
    shifts: list[tuple[float, float]] = field(default_factory=list)
    surfaces: list[int] = field(default_factory=list)
    tints: list[FloatArray] = field(default_factory=list)
    scales: list[float] = field(default_factory=list)
    shadows: list[Points] = field(default_factory=list)

    def add(
        self,
        corners: FloatArray,
        surface: int,
        tint: FloatArray,
        shift: tuple[float, float] = (0.0, 0.0),
        scale: float = 1.0,
        base: float = 0.0,
    ) -> None:
        """One polygon; texture v = 0 lies ``base`` above the first corner."""
        padding = [corners[-1:]] * (MAX_CORNERS - len(corners))
        self.corners.append(np.concatenate([corners, *padding]))
        self.origins.append(corners[0] + [0.0, 0.0, base])
        self.shifts.append(shift)
        self.surfaces.append(surface)
        self.tints.append(tint)
        self.scales.append(scale)

    def build(self) -> Polygons:
        """All polygons as arrays, lit."""
        corners = np.array(self.corners).reshape(-1, MAX_CORNERS, 3)
        along = corners[:, 1] - corners[:, 0]
        along /= np.linalg.norm(along, axis=1, keepdims=True)
        normals = np.cross(along, corners[:, 2] - corners[:, 1])
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        across = np.cross(normals, along)
        axes = np.stack([along, across], axis=1) / np.array(self.scales).reshape(-1, 1, 1)
        look = self.look
        light = look.ambient + (1.0 - look.ambient) * np.clip(normals @ look.sun, 0.0, None)
        light *= 0.9 + 0.1 * normals[:, 2]
        return Polygons(
            corners=corners,
            normals=normals,
            origins=np.array(self.origins).reshape(-1, 3),
            axes=axes,
            shifts=np.array(self.shifts).reshape(-1, 2),
            surfaces=np.array(self.surfaces, np.int32),
            tints=np.array(self.tints).reshape(-1, 3) * light[:, None],
            is_ground=np.zeros(len(corners), bool),
        )


def _footprint(centre: FloatArray, heading: float, length: float, width: float) -> FloatArray:
    """Corners (4, 2) of a rectangle, counter-clockwise."""
    c, s = np.cos(heading), np.sin(heading)
    local = 0.5 * np.array([[-length, -width], [length, -width], [length, width], [-length, width]])
    return np.asarray(centre + local @ np.array([[c, s], [-s, c]]))


class Path:
    """Where the camera passes, as stations every half metre: positions, directions, heights of the ground."""

    def __init__(self, points: FloatArray) -> None:
        """points (N, 3): the ground below the camera along the way; repeated points are fine."""
        steps = np.linalg.norm(np.diff(points[:, :2], axis=0), axis=1)
        moving = np.concatenate([[True], steps > 1e-6])
        points = points[moving]
        along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points[:, :2], axis=0), axis=1))])
        self.distances = np.arange(0.0, along[-1], STATION_METRES)
        self.points = np.column_stack([np.interp(self.distances, along, points[:, axis]) for axis in range(3)])
        tangents = np.gradient(self.points[:, :2], axis=0)
        self.tangents = tangents / np.linalg.norm(tangents, axis=1, keepdims=True)
        self.normals = np.column_stack([-self.tangents[:, 1], self.tangents[:, 0]])  # to the left
        self.tree = cKDTree(self.points[:, :2])
        self.is_new = self._find_new()

    def _find_new(self) -> NDArray[np.bool_]:
        """Stations that lie on no road that an earlier part of the path has made."""
        gap = int(REVISIT_GAP_METRES / STATION_METRES)
        neighbours = self.tree.query_ball_point(self.points[:, :2], REVISIT_METRES)
        return np.array([min(near) > index - gap for index, near in enumerate(neighbours)])

    def height(self, points: FloatArray) -> FloatArray:
        """Height (N,) of the ground at points (N, 2): a smooth blend of the stations about."""
        count = min(24, len(self._sparse.data))
        distance, index = self._sparse.query(points, k=count)
        weights = 1.0 / (np.square(distance) + 16.0) ** 2
        return np.asarray((weights * self._sparse_heights[index]).sum(axis=1) / weights.sum(axis=1))

    @property
    def _sparse(self) -> cKDTree:
        if not hasattr(self, "_sparse_tree"):
            stride = 6
            self._sparse_tree = cKDTree(self.points[::stride, :2])
            self._sparse_heights = self.points[::stride, 2]
        return self._sparse_tree

    def clearance(self, corners: FloatArray) -> float:
        """Distance from the path to the rectangle corners (4, 2); 0 where the path crosses it."""
        centre = corners.mean(axis=0)
        axes = np.stack([corners[1] - corners[0], corners[3] - corners[0]])
        half = 0.5 * np.linalg.norm(axes, axis=1)
        axes /= 2.0 * half[:, None]
        near = self.tree.query_ball_point(centre, float(np.hypot(*half)) + 5.0)
        if not near:
            return np.inf
        offset = np.abs((self.points[near, :2] - centre) @ axes.T) - half
        return float(np.linalg.norm(np.maximum(offset, 0.0), axis=1).min())


def _icosahedron() -> tuple[FloatArray, NDArray[np.int64]]:
    """Unit vertices (12, 3) and faces (20, 3), counter-clockwise from outside."""
    golden = (1 + np.sqrt(5)) / 2
    a, b = [-1.0, 1.0], [-golden, golden]
    vertices = np.array(
        [[0, y, z] for y in a for z in b] + [[x, y, 0] for x in a for y in b] + [[x, 0, z] for z in a for x in b]
    )
    faces = [
        (i, j, k)
        for i in range(12)
        for j in range(12)
        for k in range(12)
        if i < min(j, k)
        and max(np.abs(np.linalg.norm(vertices[m] - vertices[n]) - 2.0) for m, n in ((i, j), (j, k), (k, i))) < 1e-9
        and np.linalg.det(vertices[[i, j, k]]) > 0
    ]
    return vertices / np.linalg.norm(vertices[0]), np.array(faces)


ICOSAHEDRON = _icosahedron()


class Builder:
    """Places the things of a lot; every thing also leaves the outline of its shadow on the ground."""

    def __init__(self, path: Path, look: Look) -> None:
        self.path = path
        self.look = look
        self.polygons = PolygonList(look)
        self.shadows: list[Points] = []

    def is_clear(self, corners: FloatArray, margin: float) -> bool:
        """Whether a footprint keeps its distance from everywhere the camera passes."""
        return self.path.clearance(corners) > margin

    def prism(
        self,
        corners: FloatArray,
        low: float,
        high: float,
        sides: tuple[int, FloatArray],
        top: tuple[int, FloatArray] | None,
        shift: float = 0.0,
        scale: float = 1.0,
        sink: float = 0.0,
    ) -> None:
        """Walls on a footprint (n, 2) from low to high, sunk into sloping ground, and a lid."""
        count = len(corners)
        length = shift
        for i in range(count):
            a, b = corners[i], corners[(i + 1) % count]
            wall = np.array(
                [[*a, low - sink], [*b, low - sink], [*b, high], [*a, high]],
            )
            self.polygons.add(wall, sides[0], sides[1], shift=(length, 0.0), scale=scale, base=sink)
            length += float(np.hypot(*(b - a))) / scale
        if top is not None:
            for piece in ([corners] if count <= MAX_CORNERS else [corners[[0, i, i + 1]] for i in range(1, count - 1)]):
                lid = np.column_stack([piece, np.full(len(piece), high)])
                self.polygons.add(lid, top[0], top[1], shift=(shift, shift))

    def shadow(self, corners: FloatArray, height: float, lift: float = 0.0) -> None:
        """The shadow of an upright prism that hangs ``lift`` above the ground."""
        sun = self.look.sun
        throw = -sun[:2] / sun[2]
        points = np.concatenate([corners + lift * throw, corners + height * throw])
        self.shadows.append(cv2.convexHull(points.astype(np.float32))[:, 0].astype(float))

    def house(self, rng: np.random.Generator, centre: FloatArray, heading: float, length: float) -> bool:
        """A house with a gable or flat roof, its front along the street."""
        depth = rng.uniform(7.0, 12.0)
        corners = _footprint(centre, heading, length, depth)
        if not self.is_clear(corners, 3.0):
            return False
        ground = float(self.path.height(centre[None])[0])
        height = rng.uniform(3.2, 10.0)
        tint = _tint(rng, 0.6, 1.35, 0.06)
        surface = Surface.FACADE + int(rng.integers(FACADES))
        shift, scale = rng.uniform(0, TILE_METRES), rng.uniform(0.8, 1.25)
        eaves = ground + height
        if rng.random() < 0.3:
            self.prism(corners, ground, eaves, (surface, tint), (Surface.ASPHALT, tint), shift, scale, sink=2.0)
        else:
            self._gabled(rng, corners, ground, eaves, (surface, tint), shift, scale)
        self.shadow(corners, height + 1.0)
        return True

    def _gabled(
        self,
        rng: np.random.Generator,
        corners: FloatArray,
        ground: float,
        eaves: float,
        walls: tuple[int, FloatArray],
        shift: float,
        scale: float,
    ) -> None:
        """Walls under a pitched roof, the ridge along the street or across it."""
        if rng.random() < 0.4:
            corners = np.roll(corners, 1, axis=0)
        a, b, c, d = corners
        width = float(np.hypot(*(d - a)))
        ridge = eaves + 0.5 * width * rng.uniform(0.5, 1.0)
        near, far = 0.5 * (a + d), 0.5 * (b + c)
        self.prism(corners, ground, eaves, walls, None, shift, scale, sink=2.0)
        for left, right, middle in ((b, c, far), (d, a, near)):
            gable = np.array([[*left, eaves], [*right, eaves], [*middle, ridge]])
            self.polygons.add(gable, walls[0], walls[1], shift=(shift, (eaves - ground) / scale), scale=scale)
        tint = _tint(rng, 0.3, 0.9, 0.1)
        for left, right, start, end in ((a, b, near, far), (c, d, far, near)):
            roof = np.array([[*left, eaves], [*right, eaves], [*end, ridge], [*start, ridge]])
            self.polygons.add(roof, Surface.ROOF, tint, shift=(shift, 0.0))

    def car(self, rng: np.random.Generator, centre: FloatArray, heading: float) -> None:
        """A car or van: body, cabin, wheels, lights and plates."""
        van = rng.random() < 0.2
        length, width = (rng.uniform(4.6, 5.6), 1.95) if van else (rng.uniform(3.7, 4.8), rng.uniform(1.65, 1.85))
        corners = _footprint(centre, heading, length, width)
        if not self.is_clear(corners, 1.6):
            return
        ground = float(self.path.height(centre[None])[0])
        tint = _tint(rng, 0.08, 1.5, 0.15)
        shift = rng.uniform(0, TILE_METRES)
        waist, roof = (1.2, 2.1) if van else (rng.uniform(0.85, 1.0), rng.uniform(1.4, 1.65))
        glass = (Surface.GLASS, np.ones(3))
        paint = (Surface.PAINT, tint)
        self.prism(corners, ground + 0.25, ground + waist, paint, paint, shift)
        forward = np.array([np.cos(heading), np.sin(heading)])
        cabin = _footprint(centre - forward * (0.0 if van else 0.08 * length), heading, length * (0.9 if van else 0.55), width - 0.2)
        self.prism(cabin, ground + waist, ground + roof, glass, paint, shift)
        self.prism(_footprint(centre, heading, 0.94 * length, width - 0.15), ground, ground + 0.25, (Surface.PLAIN, np.full(3, 0.1)), None)
        side = np.array([-forward[1], forward[0]])
        black, light, red = np.full(3, 0.08), np.full(3, 1.4), np.array([0.9, 0.15, 0.15])
        for sign in (-1.0, 1.0):
            for axle in (-0.31, 0.31):
                hub = centre + forward * axle * length + side * sign * 0.5 * width
                self._plate(hub, ground + 0.32, side * sign, 0.6, 0.6, Surface.PLAIN, black)
                self._plate(hub + side * sign * 0.01, ground + 0.32, side * sign, 0.3, 0.3, Surface.PAINT, np.full(3, 0.8))
            for front, lamp in ((1.0, light), (-1.0, red)):
                end = centre + forward * front * 0.5 * length
                self._plate(end + side * sign * 0.36 * width, ground + 0.68, forward * front, 0.3, 0.16, Surface.PLAIN, lamp)
        for front in (1.0, -1.0):
            self._plate(centre + forward * front * 0.5 * length, ground + 0.45, forward * front, 0.52, 0.12, Surface.PLAIN, light)
        self.shadow(corners, 0.7 * roof)

    def _plate(self, centre: FloatArray, height: float, normal: FloatArray, width: float, tall: float, surface: int, tint: FloatArray) -> None:
        """A small upright rectangle a centimetre in front of what it is fixed to."""
        middle = centre + 0.01 * normal
        along = np.array([-normal[1], normal[0]]) * 0.5 * width
        a, b = middle - along, middle + along
        low, high = height - 0.5 * tall, height + 0.5 * tall
        self.polygons.add(np.array([[*a, low], [*b, low], [*b, high], [*a, high]]), surface, tint)

    def hedge(self, rng: np.random.Generator, centre: FloatArray, heading: float, length: float) -> None:
        """A hedge, a garden wall or a fence along the street."""
        kind = rng.choice(3, p=[0.5, 0.25, 0.25])
        thickness = (rng.uniform(0.5, 1.0), 0.25, 0.06)[kind]
        surface = (Surface.FOLIAGE, Surface.STONE, Surface.FENCE)[kind]
        corners = _footprint(centre, heading, length, thickness)
        if not self.is_clear(corners, 2.0):
            return
        ground = float(self.path.height(centre[None])[0])
        height = rng.uniform(0.7, 1.9)
        look = (int(surface), _tint(rng, 0.4, 1.2, 0.1))
        self.prism(corners, ground, ground + height, look, look, rng.uniform(0, TILE_METRES), rng.uniform(0.7, 1.3), sink=0.7)
        self.shadow(corners, height)

    def bush(self, rng: np.random.Generator, centre: FloatArray) -> None:
        """A round bush on the ground."""
        size = rng.uniform(0.5, 1.4, 3) * [1.0, 1.0, 1.2]
        self._crown(rng, centre, 0.5 * size[2], size, 2.0)

    def tree(self, rng: np.random.Generator, centre: FloatArray) -> None:
        """A trunk and a crown of one to three ellipsoids."""
        girth = rng.uniform(0.15, 0.4)
        corners = _footprint(centre, rng.uniform(0, np.pi), girth, girth)
        if not self.is_clear(corners, 1.8):
            return
        ground = float(self.path.height(centre[None])[0])
        stem = rng.uniform(2.0, 4.0)
        self.prism(corners, ground, ground + stem + 1.0, (Surface.WOOD, _tint(rng, 0.4, 1.0, 0.1)), None, rng.uniform(0, 9), sink=0.7)
        self.shadow(corners, stem)
        for _ in range(int(rng.integers(1, 4))):
            size = rng.uniform(1.0, 2.4, 3) * [1.0, 1.0, 1.2]
            place = centre + rng.normal(0.0, 0.5, 2)
            self._crown(rng, place, stem + size[2] * rng.uniform(0.8, 1.3), size, 0.0)

    def _crown(self, rng: np.random.Generator, centre: FloatArray, height: float, radii: FloatArray, margin: float) -> None:
        """An ellipsoid of leaves with its middle ``height`` above the ground."""
        outline = _footprint(centre, 0.0, 2.0 * radii[0], 2.0 * radii[1])
        clear_below = height - radii[2] > 2.6
        if not clear_below and not self.is_clear(outline, max(margin, 1.5)):
            return
        ground = float(self.path.height(centre[None])[0])
        vertices, faces = ICOSAHEDRON
        turn = rng.uniform(0, 2 * np.pi)
        c, s = np.cos(turn), np.sin(turn)
        bumps = 1.0 + 0.12 * rng.standard_normal((len(vertices), 1))
        points = vertices * bumps * radii @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1.0]]) + [*centre, ground + height]
        tint = _tint(rng, 0.4, 1.3, 0.1)
        for face in faces:
            self.polygons.add(points[face], Surface.FOLIAGE, tint, shift=tuple(rng.uniform(0, TILE_METRES, 2)))
        angles = np.arange(8) * np.pi / 4
        disc = centre + 0.85 * np.column_stack([radii[0] * np.cos(angles), radii[1] * np.sin(angles)])
        self.shadow(disc, height + 0.5 * radii[2], max(height - 0.5 * radii[2], 0.0))

    def pole(self, rng: np.random.Generator, centre: FloatArray) -> None:
        """A lamp post or a traffic sign."""
        girth = rng.uniform(0.06, 0.2)
        corners = _footprint(centre, rng.uniform(0, np.pi), girth, girth)
        if not self.is_clear(corners, 1.6):
            return
        ground = float(self.path.height(centre[None])[0])
        height = rng.uniform(2.2, 7.0)
        self.prism(corners, ground, ground + height, (Surface.PLAIN, _tint(rng, 0.2, 1.2, 0.05)), None, sink=0.7)
        self.shadow(corners, height)
        if height < 3.5:
            turn = rng.uniform(0, 2 * np.pi)
            facing = np.array([np.cos(turn), np.sin(turn)])
            for sign in (-1.0, 1.0):
                front = centre + 0.1 * sign * facing
                self._plate(front, ground + height - 0.3, sign * facing, 0.6, 0.6, Surface.PAINT, _tint(rng, 0.3, 1.5, 0.3))


def _tint(rng: np.random.Generator, low: float, high: float, colour: float) -> FloatArray:
    """A random RGB gain: brightness uniform on a log scale, and a little colour."""
    return np.asarray(np.exp(rng.uniform(np.log(low), np.log(high)) + colour * rng.standard_normal(3)))


def _place_generator(seed: int, point: FloatArray, salt: int) -> np.random.Generator:
    """The generator of a place: seeded by the world's seed and the metre that the point lies in."""
    cell = np.floor(point).astype(np.int64)
    return np.random.default_rng([seed, salt, *(int(c) & 0xFFFFFFFF for c in cell)])


def build_street(path: Path, look: Look, seed: int) -> tuple[Polygons, list[Points]]:
    """Everything that stands along the path, and the outlines of the shadows on the ground."""
    builder = Builder(path, look)
    stride = int(LOT_METRES / STATION_METRES)
    for station in range(0, len(path.points), stride):
        if not path.is_new[station]:
            continue
        for side in (1, -1):
            rng = _place_generator(seed, path.points[station, :2], side + 1)
            _furnish(builder, rng, station, side)
    return builder.polygons.build(), builder.shadows


def _furnish(builder: Builder, rng: np.random.Generator, station: int, side: int) -> None:
    """One lot on one side: a house or a garden, what stands before it, what is parked at the kerb."""
    path, look = builder.path, builder.look
    heading = float(np.arctan2(path.tangents[station, 1], path.tangents[station, 0]))
    kerb = look.road_left_m if side > 0 else look.road_right_m
    fence_line = kerb + look.paving_m + 0.4

    def spot(along: float, lateral: float) -> FloatArray:
        index = min(station + int(along / STATION_METRES), len(path.points) - 1)
        return np.asarray(path.points[index, :2] + side * lateral * path.normals[index])

    setback = rng.choice([0.0, rng.uniform(1.0, 3.0), rng.uniform(3.0, 8.0)])
    if rng.random() < look.houses:
        length = rng.uniform(7.0, LOT_METRES)
        builder.house(rng, spot(0.5 * LOT_METRES, fence_line + setback + 5.5), heading, length)
    elif rng.random() < 0.5:
        builder.house(rng, spot(0.5 * LOT_METRES, fence_line + setback + rng.uniform(10, 22)), heading + rng.normal(0, 0.2), rng.uniform(7.0, 16.0))
    if setback > 0.5 and rng.random() < look.plants:
        builder.hedge(rng, spot(0.5 * LOT_METRES, fence_line), heading, rng.uniform(5.0, LOT_METRES))
    for _ in range(rng.poisson(1.5 * look.plants)):
        builder.bush(rng, spot(rng.uniform(0, LOT_METRES), fence_line + rng.uniform(0.7, 6.0)))
    for _ in range(rng.poisson(1.0 * look.plants)):
        builder.tree(rng, spot(rng.uniform(0, LOT_METRES), fence_line + rng.uniform(-1.2, 9.0)))
    for bay in (0.25, 0.75):
        if rng.random() < look.cars:
            along = bay * LOT_METRES + rng.normal(0, 0.4)
            turned = heading + (np.pi if rng.random() < 0.5 else 0.0) + rng.normal(0, 0.03)
            builder.car(rng, spot(along, max(kerb - rng.uniform(-0.6, 1.0), 2.7)), turned)
    if rng.random() < 0.5:
        builder.pole(rng, spot(rng.uniform(0, LOT_METRES), kerb + 0.5))


def build_ground(path: Path, look: Look) -> Polygons:
    """The ground as a net of triangles over square cells, wherever the path is near."""
    cell = GROUND_CELL_METRES
    low = np.floor((path.points[:, :2].min(axis=0) - GROUND_REACH_METRES) / cell).astype(int)
    near = _cells_near(path, cell, GROUND_REACH_METRES)
    corners = near[:, None, :] + np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    unique, inverse = np.unique(corners.reshape(-1, 2) - low, axis=0, return_inverse=True)
    nodes = (unique + low) * cell
    points = np.column_stack([nodes, path.height(nodes)])[inverse.reshape(-1, 4)]
    triangles = np.concatenate([points[:, [0, 1, 2, 2, 2]], points[:, [0, 2, 3, 3, 3]]])
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    count = len(triangles)
    axes = np.tile(np.array([[1.0, 0, 0], [0, 1.0, 0]]), (count, 1, 1))
    return Polygons(
        corners=triangles,
        normals=normals,
        origins=np.zeros((count, 3)),
        axes=axes,
        shifts=np.zeros((count, 2)),
        surfaces=np.full(count, int(Surface.GRASS), np.int32),
        tints=np.ones((count, 3)),
        is_ground=np.ones(count, bool),
    )


def _cells_near(path: Path, cell: float, reach: float) -> NDArray[np.int64]:
    """Indices (N, 2) of the square cells within reach of the path, in a fixed order."""
    span = int(np.ceil(reach / cell))
    stations = np.unique(np.floor(path.points[:, :2] / cell).astype(np.int64), axis=0)
    window = np.stack(np.meshgrid(*[np.arange(-span, span + 1)] * 2, indexing="ij"), axis=-1).reshape(-1, 2)
    cells = np.unique((stations[:, None] + window).reshape(-1, 2), axis=0)
    distance, _ = path.tree.query((cells + 0.5) * cell)
    return np.asarray(cells[distance < reach + 0.71 * cell])


class GroundMap:
    """What the ground looks like from above, in tiles near the path: road coordinates and sunlight.

    coordinates: lateral (left positive) and along the road, metres, on a grid of 1 m; sunlight 0..1
    on a grid of 0.25 m. Beyond the tiles there is grass in the sun.
    """

    def __init__(self, path: Path, shadows: list[Points]) -> None:
        width = TILE_CELLS * TILE_CELL_METRES
        tiles = _cells_near(path, width, MAP_REACH_METRES)
        self._low = tiles.min(axis=0)
        self._slots = np.full(tiles.max(axis=0) - self._low + 1, len(tiles), np.int32)
        self._slots[tuple((tiles - self._low).T)] = np.arange(len(tiles))
        self._coordinates = self._road_coordinates(path, tiles)
        self._sunlight = self._draw_sunlight(tiles, shadows, width)

    @staticmethod
    def _road_coordinates(path: Path, tiles: NDArray[np.int64]) -> NDArray[np.float32]:
        """(tiles + 1, 17, 17, 2); the last tile is the world beyond."""
        steps = np.arange(TILE_CELLS + 1) * TILE_CELL_METRES
        grid = np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1)
        points = (tiles * TILE_CELLS * TILE_CELL_METRES)[:, None, None, :] + grid
        flat = points.reshape(-1, 2)
        roads = np.flatnonzero(path.is_new)
        _, nearest = cKDTree(path.points[roads, :2]).query(flat)
        station = roads[nearest]
        offset = flat - path.points[station, :2]
        lateral = np.einsum("ij,ij->i", offset, path.normals[station])
        along = path.distances[station] + np.einsum("ij,ij->i", offset, path.tangents[station])
        beyond = np.hypot(*offset.T) > MAP_REACH_METRES  # the ends of the road: no road ahead of them
        lateral[beyond] = 1e3
        coordinates = np.column_stack([lateral, along]).reshape(*points.shape)
        return np.concatenate([coordinates, np.full_like(coordinates[:1], 1e3)]).astype(np.float32)

    @staticmethod
    def _draw_sunlight(tiles: NDArray[np.int64], shadows: list[Points], width: float) -> NDArray[np.float32]:
        """(tiles + 1, 65, 65), 0 in the shade."""
        size = TILE_CELLS * SHADOW_FACTOR + 1
        light = np.ones((len(tiles) + 1, size, size), np.float32)
        scale = (size - 1) / width
        bounds = np.array([[*outline.min(axis=0), *outline.max(axis=0)] for outline in shadows]).reshape(-1, 4)
        for slot, tile in enumerate(tiles * width):
            touches = np.all((bounds[:, :2] < tile + width) & (bounds[:, 2:] > tile), axis=1)
            for index in np.flatnonzero(touches):
                pixels = (shadows[index] - tile)[:, ::-1] * scale
                cv2.fillConvexPoly(light[slot], np.round(pixels * 16).astype(np.int32), 0.0, cv2.LINE_AA, 4)
        return light

    def lookup(self, x: NDArray[np.float32], y: NDArray[np.float32]) -> tuple[NDArray[np.float32], ...]:
        """Lateral, along and sunlight, each (N,), at x, y (N,) metres."""
        width = np.float32(TILE_CELLS * TILE_CELL_METRES)
        tx, ty = x / width, y / width
        ix, iy = np.floor(tx).astype(np.int32), np.floor(ty).astype(np.int32)
        gx, gy = (tx - ix), (ty - iy)
        ix -= np.int32(self._low[0])
        iy -= np.int32(self._low[1])
        outside = (ix < 0) | (iy < 0) | (ix >= self._slots.shape[0]) | (iy >= self._slots.shape[1])
        slot = self._slots[np.where(outside, 0, ix), np.where(outside, 0, iy)]
        slot[outside] = len(self._coordinates) - 1
        road = _bilinear(self._coordinates, slot, gx, gy)
        light = _bilinear(self._sunlight[..., None], slot, gx, gy)
        return road[:, 0], road[:, 1], light[:, 0]


def _bilinear(
    tiles: NDArray[np.float32], slot: NDArray[np.int32], gx: NDArray[np.float32], gy: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Values (N, C) of tiles (T, S, S, C) at fractions gx, gy (N,) of tile ``slot`` (N,)."""
    size = tiles.shape[1]
    x, y = gx * np.float32(size - 1), gy * np.float32(size - 1)
    x0 = np.minimum(x.astype(np.int32), size - 2)
    y0 = np.minimum(y.astype(np.int32), size - 2)
    fx, fy = (x - x0)[:, None], (y - y0)[:, None]
    flat = tiles.reshape(-1, tiles.shape[3])
    start = (slot * size + x0) * size + y0
    low = flat[start] * (1 - fy) + flat[start + 1] * fy
    high = flat[start + size] * (1 - fy) + flat[start + size + 1] * fy
    return np.asarray(low + fx * (high - low))
