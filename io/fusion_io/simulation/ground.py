"""The ground: a net of triangles for the shape, and a map of road coordinates and sunlight for the look."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from fusion_io.records import FloatArray
from fusion_io.simulation.street import Polygons, Route, padded, planes
from fusion_io.simulation.textures import Float32, Surface

CELL_METRES = 10.0  # of the net
REACH_METRES = 56.0  # the ground ends this far from the path; beyond is the backdrop
TILE_CELLS = 16  # a tile of the map is 16 m wide: road coordinates on a grid of 1 m
SHADE_CELLS = 64  # and sunlight on one of 0.25 m
MAP_REACH_METRES = 20.0  # beyond this from the path the ground is plain grass in the sun
FAR_METRES = 1e3  # the lateral coordinate where there is no road


def build_ground(route: Route) -> Polygons:
    """Triangles over square cells wherever the path is near; their texture coordinates are the world's x and y."""
    cells = _cells_near(route, CELL_METRES, REACH_METRES)
    corners = cells[:, None] + np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    unique, inverse = np.unique(corners.reshape(-1, 2), axis=0, return_inverse=True)
    nodes = unique * CELL_METRES
    squares = np.column_stack([nodes, route.height(nodes)])[inverse.reshape(-1, 4)]
    triangles = padded(np.concatenate([squares[:, [0, 1, 2]], squares[:, [0, 2, 3]]]))
    _, normals = planes(triangles)
    count = len(triangles)
    return Polygons(
        triangles,
        normals,
        np.tile(np.eye(3)[:2], (count, 1, 1)),
        triangles[:, 0, :2],
        np.full(count, Surface.GRASS, np.int32),
        np.ones((count, 3)),
        np.ones(count, bool),
    )


def _cells_near(route: Route, cell: float, reach: float) -> NDArray[np.int64]:
    """Indices (N, 2) of the square cells within reach of the path, sorted."""
    span = int(np.ceil(reach / cell))
    window = np.indices((2 * span + 1, 2 * span + 1)).reshape(2, -1).T - span
    stations = np.unique(np.floor(route.points / cell).astype(np.int64), axis=0)
    cells = np.unique((stations[:, None] + window).reshape(-1, 2), axis=0)
    distance, _ = route.tree.query((cells + 0.5) * cell)
    return np.asarray(cells[distance < reach + 0.71 * cell])


class GroundMap:
    """The ground from above, in tiles near the path: road coordinates and sunlight."""

    def __init__(self, route: Route, shadows: Sequence[FloatArray]) -> None:
        """shadows: convex outlines (n, 2) in world metres."""
        tiles = _cells_near(route, TILE_CELLS, MAP_REACH_METRES)
        self._low = tiles.min(axis=0).astype(np.int32)
        # One column and row more, and one tile more, stand for everywhere else.
        self._slots = np.full(tiles.max(axis=0) - self._low + 2, len(tiles), np.int32)
        self._slots[tuple((tiles - self._low).T)] = np.arange(len(tiles))
        self._lateral, self._along = _road_coordinates(route, tiles)
        self._sunlight = _sunlight(tiles, shadows)

    def lookup(self, x: Float32, y: Float32) -> tuple[Float32, Float32, Float32]:
        """At x, y (N,) metres: lateral (left positive) and along the road, metres, and sunlight 0..1, each (N,).

        Along is NaN where two roads meet.
        """
        x, y = x / np.float32(TILE_CELLS), y / np.float32(TILE_CELLS)
        floor_x, floor_y = np.floor(x), np.floor(y)
        x, y = x - floor_x, y - floor_y
        column = floor_x.astype(np.int32) - self._low[0]
        row = floor_y.astype(np.int32) - self._low[1]
        width, height = self._slots.shape
        column[(column < 0) | (column >= width)] = width - 1
        row[(row < 0) | (row >= height)] = height - 1
        slot = self._slots[column, row]
        road, shade = _Corners(slot, x, y, TILE_CELLS), _Corners(slot, x, y, SHADE_CELLS)
        return road.blend(self._lateral), road.blend(self._along), shade.blend(self._sunlight)


def _road_coordinates(route: Route, tiles: NDArray[np.int64]) -> tuple[Float32, Float32]:
    """Lateral and along on every tile's grid, each (tiles + 1, 17, 17), from the nearest station of a road.

    Along is NaN at seams between roads, where the coordinates must not be interpolated.
    """
    steps = np.arange(TILE_CELLS + 1.0)
    grid = np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1)
    points = (tiles[:, None, None] * TILE_CELLS + grid).reshape(-1, 2)
    roads = np.flatnonzero(route.is_new)
    distance, nearest = cKDTree(route.points[roads]).query(points, distance_upper_bound=1.5 * MAP_REACH_METRES)
    station = roads[np.minimum(nearest, len(roads) - 1)]
    offset = points - route.points[station]
    lateral = np.einsum("ij,ij->i", offset, route.normals[station])
    along = route.distances[station] + np.einsum("ij,ij->i", offset, route.tangents[station])
    lateral[distance > MAP_REACH_METRES] = FAR_METRES
    shape = (len(tiles), len(steps), len(steps))
    lateral, along = lateral.reshape(shape), along.reshape(shape)
    for axis in (1, 2):  # a jump between neighbours is where another road is nearer
        seam = np.abs(np.diff(lateral, axis=axis)) > 1.5
        before, after = (np.swapaxes(along, 1, axis)[:, s] for s in (slice(None, -1), slice(1, None)))
        before[np.swapaxes(seam, 1, axis)] = after[np.swapaxes(seam, 1, axis)] = np.nan
    elsewhere = np.full((1, *shape[1:]), FAR_METRES)
    return np.concatenate([lateral, elsewhere]).astype(np.float32), np.concatenate([along, elsewhere]).astype(
        np.float32
    )


def _sunlight(tiles: NDArray[np.int64], shadows: Sequence[FloatArray]) -> Float32:
    """(tiles + 1, 65, 65), 0 in the shade."""
    size = SHADE_CELLS + 1
    light = np.ones((len(tiles) + 1, size, size), np.float32)
    scale = SHADE_CELLS / TILE_CELLS
    bounds = np.array([[outline.min(axis=0), outline.max(axis=0)] for outline in shadows]).reshape(-1, 2, 2)
    sixteenths = 4  # OpenCV's shift: corners in sixteenths of a cell
    for slot, tile in enumerate(tiles * TILE_CELLS):
        touching = np.all((bounds[:, 0] < tile + TILE_CELLS) & (bounds[:, 1] > tile), axis=1)
        for index in np.flatnonzero(touching).tolist():
            cells = (shadows[index] - tile)[:, ::-1] * (scale * 2**sixteenths)
            cv2.fillConvexPoly(light[slot], np.rint(cells).astype(np.int32), 0.0, cv2.LINE_8, sixteenths)
    return light


class _Corners:
    """The four grid points about places in tiles, for bilinear interpolation of several layers."""

    def __init__(self, slot: NDArray[np.int32], x: Float32, y: Float32, cells: int) -> None:
        """Tiles ``slot`` (N,); x, y (N,) fractions of a tile; cells: of the grid along a side."""
        x, y = x * np.float32(cells), y * np.float32(cells)
        column = np.minimum(x.astype(np.int32), cells - 1)
        row = np.minimum(y.astype(np.int32), cells - 1)
        self._x, self._y = x - column, y - row
        self._stride = cells + 1
        self._start = (slot * np.int32(self._stride) + column) * np.int32(self._stride) + row

    def blend(self, layer: Float32) -> Float32:
        """Values (N,) of a layer (T, cells + 1, cells + 1)."""
        flat = layer.ravel()
        low = flat[self._start]
        low += self._y * (flat[self._start + 1] - low)
        high = flat[self._start + self._stride]
        high += self._y * (flat[self._start + (self._stride + 1)] - high)
        high -= low
        high *= self._x
        return np.asarray(low + high)
