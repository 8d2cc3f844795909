"""The renderer: the street's polygons through a pinhole camera, by casting a ray per sample.

For a plane n.p = d in camera axes the ray of pixel (u, v) meets it where 1/z = n.K^-1(u, v, 1)/d,
and lies inside a convex polygon where it lies on the inner side of the plane through the camera and
each edge. Both are affine in (u, v), so the cast is exact and needs no clipping.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from fusion_io.records import FloatArray
from fusion_io.simulation.ground import CELL_METRES, GroundMap, build_ground
from fusion_io.simulation.street import Look, Polygons, Route, build_street
from fusion_io.simulation.textures import COLOURS, Float32, Surface, library
from fusion_io.simulation.traffic import Mover

VIEW_METRES = 120.0  # nothing further away is drawn
INDEX_METRES = 32.0
SLANT_SHARE = 0.8  # how much of the slant's lengthening (in octaves) goes into a sample's footprint
PATCHES = np.array([Surface.PATCHES], np.int32)
TENT = np.array([0.25, 0.5, 0.25], np.float32)  # the pixel's filter over samples half a pixel apart


class World:
    """A street along a path, fixed by seed and place, and what moves on it."""

    def __init__(self, seed: int, route: Route, look: Look | None = None, movers: Sequence[Mover] = ()) -> None:
        """route: where the camera passes; look: ``Look.of_world(seed)`` unless given."""
        self.look = look or Look.of_world(seed)
        self._movers = movers
        self._offset = np.random.default_rng([seed, 2]).uniform(0, 100, 2).astype(np.float32)
        self._tones = np.exp(np.random.default_rng([seed, 3]).normal(0, 0.2, 3)).astype(np.float32)
        street, shadows = build_street(route, self.look, seed)
        self._ground_map = GroundMap(route, shadows)
        self._polygons = Polygons.joined([build_ground(route), street])
        self._index = _index_by_place(self._polygons)

    def render(
        self,
        T_world_camera: FloatArray,
        K: FloatArray,
        width: int,
        height: int,
        colour: bool = False,
        time_s: float = 0.0,
    ) -> tuple[Float32, Float32]:
        """The scene at a time from a pose (4, 4) through a pinhole camera K (3, 3), pixel centres at integers.

        Returns the radiance (H, W) or (H, W, 3), where 1 is white and more is possible, and the
        exact depth (H, W) in metres along the optical axis at the pixels' centres, 0 for the sky.
        """
        near = self._polygons.take(self._nearby(T_world_camera))
        moving = [mover.at(time_s) for mover in self._movers]
        view = _View(Polygons.joined([near, *moving]), T_world_camera, K, width, height)
        # Samples lie every half pixel, pixel centres among them, with a margin of one sample.
        fine = K.copy()
        fine[:2] *= 2.0
        fine[:2, 2] += 1.0
        hits, inverse_depth = view.cast(fine, 2 * width + 1, 2 * height + 1)
        centres = inverse_depth[1::2, 1::2]
        depth = np.zeros_like(centres)
        np.divide(1.0, centres, out=depth, where=centres > 0)
        radiance = self._shade(view, hits, inverse_depth, fine, colour)
        return cv2.sepFilter2D(radiance, -1, TENT, TENT)[1::2, 1::2], depth

    def _nearby(self, T_world_camera: FloatArray) -> NDArray[np.int64]:
        """Indices of the polygons in the cells about the camera."""
        reach = int(np.ceil(VIEW_METRES / INDEX_METRES))
        cx, cy = np.floor(T_world_camera[:2, 3] / INDEX_METRES).astype(int)
        cells = [
            self._index[key]
            for key in ((x, y) for x in range(cx - reach, cx + reach + 1) for y in range(cy - reach, cy + reach + 1))
            if key in self._index
        ]
        return np.concatenate(cells) if cells else np.zeros(0, np.int64)

    def _shade(
        self, view: _View, hits: NDArray[np.int32], inverse_depth: Float32, K: FloatArray, colour: bool
    ) -> Float32:
        """Radiance of every sample: the surface's albedo at the ray's end times its tint and light."""
        channels = 3 if colour else 1
        height, width = hits.shape
        flat = hits.ravel()
        pixels = np.flatnonzero(flat >= 0)
        polygon = flat[pixels]
        inverse = inverse_depth.ravel()[pixels]
        u, v = view.texture_coordinates(K, width, pixels, polygon, inverse)
        # The footprint of a sample is z/f across the view and longer by the slant 1/cos along it. A
        # value between the two, nearer the long one, blurs little and leaves little to alias.
        across = -np.log2(inverse) - np.float32(_log_focal(K))
        slant = _log_ray_lengths(K, width, height)[pixels] - view.log_distances[polygon] - np.log2(inverse)
        light = (view.tints if colour else view.grey_tints)[polygon]
        surface = view.surfaces[polygon]
        on_ground = np.flatnonzero(view.is_ground[polygon])
        if len(on_ground):
            tone, surface[on_ground] = self._ground(u[on_ground], v[on_ground], across[on_ground], slant[on_ground])
            light[on_ground] *= tone[:, None]
        octave = across + np.float32(SLANT_SHARE) * slant - view.log_scales[polygon]
        light *= library().lookup(surface, u, v, octave)[:, None]
        if colour:
            light *= COLOURS[surface]
        radiance = np.empty((height * width, channels), np.float32)
        radiance[pixels] = light
        sky = np.flatnonzero(flat < 0)
        radiance[sky] = self._sky(_rays(K, width, sky) @ view.rotation.T.astype(np.float32))[:, None]
        return radiance.reshape((height, width, 3) if colour else (height, width))

    def _ground(self, x: Float32, y: Float32, across: Float32, slant: Float32) -> tuple[Float32, NDArray[np.int32]]:
        """Tone (N,) and surface (N,) at ground points; across and slant are the footprint's log2."""
        look = self.look
        lateral, along, sunlight = self._ground_map.lookup(x, y)
        on_road = (lateral < look.road_left_m) & (lateral > -look.road_right_m)
        on_paving = (lateral < look.road_left_m + look.paving_m) & (lateral > -look.road_right_m - look.paving_m)
        surface = np.full(len(x), Surface.GRASS, np.int32)
        surface[on_paving] = Surface.PAVING
        surface[on_road] = Surface.ASPHALT
        tone = self._tones[surface]
        x, y = (x + self._offset[0]) * np.float32(0.25), (y + self._offset[1]) * np.float32(0.25)
        tone *= 0.75 + 0.5 * library().lookup(PATCHES, x, y, across + slant - 2)
        width, length = np.exp2(across), np.exp2(across + slant)
        paint = _stripe(lateral - look.road_left_m, 0.07, width) + _stripe(lateral + look.road_right_m, 0.07, width)
        paint *= 0.8  # kerbstones
        if look.markings:
            dash = np.clip((1.5 - np.abs(np.mod(along, 9.0) - 4.5)) / length + 0.5, 0.0, 1.0)
            centre = 0.5 * (look.road_left_m - look.road_right_m)
            paint += 1.2 * dash * _stripe(lateral - centre, 0.07, width)
            paint += 1.2 * _stripe(lateral + look.road_right_m - 0.35, 0.06, width)
        tone *= 1.0 + np.where(np.isnan(along), 0.0, paint).astype(np.float32)
        tone *= look.ambient + (1.0 - look.ambient) * look.sun[2] * sunlight
        return tone, surface

    def _sky(self, rays: Float32) -> Float32:
        """Radiance (N,) of world rays (N, 3): a bright gradient with clouds, haze below the horizon; at infinity."""
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        up = rays[:, 2]
        above = np.maximum(up, 0.02)
        spread = np.float32(6.0) / (above + np.float32(0.3))
        octave = np.full(len(up), -3.0, np.float32)
        cloud = library().lookup(PATCHES, rays[:, 0] * spread, rays[:, 1] * spread, octave)
        sky = np.float32(self.look.sky) * (1.0 - 0.5 * above) + 0.4 * (cloud - 0.5)
        haze = np.float32(0.35 * self.look.sky)
        return np.asarray(haze + np.clip(up / 0.02 + 0.5, 0.0, 1.0) * (sky - haze), np.float32)


def _log_focal(K: FloatArray) -> float:
    """log2 of the focal length that says how far apart samples are; of unequal ones nearer the shorter."""
    short, long = sorted([K[0, 0], K[1, 1]])
    return float(SLANT_SHARE * np.log2(short) + (1.0 - SLANT_SHARE) * np.log2(long))


def _rays(K: FloatArray, width: int, pixels: NDArray[np.int64]) -> Float32:
    """Rays (N, 3) of flat pixel indices in camera axes, with z = 1."""
    row, column = np.divmod(pixels, width)
    x, y = (column - K[0, 2]) / K[0, 0], (row - K[1, 2]) / K[1, 1]
    return np.column_stack([x, y, np.ones(len(pixels))]).astype(np.float32)


def _log_ray_lengths(K: FloatArray, width: int, height: int) -> Float32:
    """log2 of the length of every pixel's ray with z = 1, flat."""
    x, y = (np.arange(width) - K[0, 2]) / K[0, 0], (np.arange(height) - K[1, 2]) / K[1, 1]
    square = (1.0 + x * x).astype(np.float32) + (y * y).astype(np.float32)[:, None]
    return np.asarray(0.5 * np.log2(square).ravel())


class _View:
    """The polygons that may be seen from one pose, in camera axes."""

    def __init__(
        self,
        polygons: Polygons,
        T_world_camera: FloatArray,
        K: FloatArray,
        width: int,
        height: int,
    ) -> None:
        self.rotation, self.position = T_world_camera[:3, :3], T_world_camera[:3, 3]
        first = polygons.corners[:, 0] - self.position
        facing = np.einsum("ij,ij->i", polygons.normals, first) < -1e-6
        facing &= np.einsum("ij,ij->i", first, first) < VIEW_METRES**2
        facing &= first @ self.rotation[:, 2] > -2 * CELL_METRES
        candidates = np.flatnonzero(facing)
        corners = (polygons.corners[candidates] - self.position) @ self.rotation
        # A polygon is out of sight if all its corners are outside of one side of the view's pyramid.
        sides = np.array([[1, 0, 1], [-1, 0, width], [0, 1, 1], [0, -1, height], [0, 0, 1]]) @ K
        outside = np.all(corners @ sides.T < 0, axis=1)
        seen = ~np.any(outside, axis=1)
        # Nor is it if it is smaller than a pixel's half, but for the ground, where holes would show.
        distance = np.linalg.norm(corners, axis=2).min(axis=1)
        extent = np.ptp(corners, axis=1).max(axis=1)
        seen &= (extent * K[0, 0] > 0.7 * distance) | polygons.is_ground[candidates]
        seen = np.flatnonzero(seen)
        seen = seen[np.argsort(distance[seen], kind="stable")]  # near ones first: they hide the rest
        candidates, corners = candidates[seen], corners[seen]
        self._corners = corners
        self._normals = polygons.normals[candidates] @ self.rotation
        self._distances = np.einsum("ij,ij->i", self._normals, corners[:, 0])
        self._axes = polygons.axes[candidates] @ self.rotation
        arm = self.position - polygons.corners[candidates, 0]
        self._starts = np.einsum("fj,fkj->fk", arm, polygons.axes[candidates]) + polygons.shifts[candidates]
        self.log_distances = np.log2(-self._distances).astype(np.float32)
        self.log_scales = -np.log2(np.linalg.norm(polygons.axes[candidates, 0], axis=1)).astype(np.float32)
        self.surfaces = polygons.surfaces[candidates]
        self.tints = polygons.tints[candidates].astype(np.float32)
        self.grey_tints = self.tints.mean(axis=1, keepdims=True)
        self.is_ground = polygons.is_ground[candidates]

    def cast(self, K: FloatArray, width: int, height: int) -> tuple[NDArray[np.int32], Float32]:
        """The polygon (H, W) that every ray meets first, -1 for none, and its inverse depth, 0 for none."""
        hits = np.full((height, width), -1, np.int32)
        nearest = np.zeros((height, width), np.float32)
        pixel_from_normal = np.linalg.inv(K)  # n.K^-1 (u, v, 1) = (n K^-1).(u, v, 1)
        left, right = self._spans(K, width, height)
        filled = left < right
        some = np.flatnonzero(filled.any(axis=1))
        filled, left, right = filled[some], left[some], right[some]
        top = filled.argmax(axis=1)
        bottom = height - filled[:, ::-1].argmax(axis=1)
        first = np.where(filled, left, width).min(axis=1)
        last = np.where(filled, right, 0).max(axis=1)
        a, b, c = ((self._normals[some] / self._distances[some, None]) @ pixel_from_normal).T
        by_row = (b[:, None] * np.arange(height) + c[:, None]).astype(np.float32)[..., None]
        by_column = (a[:, None] * np.arange(width)).astype(np.float32)
        columns = np.arange(width, dtype=np.int32)
        start, length = left[..., None], np.maximum(right - left, 0).astype(np.uint32)[..., None]
        for i, (polygon, r0, r1, c0, c1) in enumerate(
            zip(some.tolist(), top.tolist(), bottom.tolist(), first.tolist(), last.tolist(), strict=True)
        ):
            inverse = by_row[i, r0:r1] + by_column[i, c0:c1]
            window = nearest[r0:r1, c0:c1]
            inside = inverse > window
            if not inside.any():
                continue
            # 0 <= column - start < length in one comparison, as a negative number is a huge unsigned one.
            inside &= (columns[c0:c1] - start[i, r0:r1]).view(np.uint32) < length[i, r0:r1]
            np.copyto(window, inverse, where=inside)
            np.copyto(hits[r0:r1, c0:c1], polygon, where=inside)
        return hits, nearest

    def _spans(self, K: FloatArray, width: int, height: int) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
        """The columns [left, right) of every row, each (F, H), that lie inside all edges of each polygon.

        An edge's plane through the camera bounds the column by a line in the row. Two polygons that
        share an edge find the same line to the bit, so no sample falls between them.
        """
        normals = np.cross(self._corners, np.roll(self._corners, -1, axis=1))
        edges = normals @ np.linalg.inv(K)
        inner = np.sign(np.einsum("fej,fj->fe", normals, self._corners.mean(axis=1)))
        a, b, c = np.moveaxis(edges, 2, 0)
        a = np.where(np.abs(a) < 1e-12 * np.abs(c), 1e-12 * np.abs(c) + 1e-150, a)  # level edges bound the rows
        a[a == 0] = 1.0  # the padding's edges have no length: they bound nothing
        slope, offset = -b / a, -c / a
        is_left, is_right = inner * a > 0, inner * a < 0
        rows = np.arange(height)
        left = np.zeros((len(a), height))
        right = np.full((len(a), height), width - 1.0)
        for edge in range(a.shape[1]):
            line = slope[:, edge, None] * rows + offset[:, edge, None]
            np.maximum(left, line, out=left, where=is_left[:, edge, None])
            np.minimum(right, line, out=right, where=is_right[:, edge, None])
        first = np.ceil(np.minimum(left, width)).astype(np.int32)
        return first, np.floor(np.maximum(right, -1.0)).astype(np.int32) + 1

    def texture_coordinates(
        self, K: FloatArray, width: int, pixels: NDArray[np.int64], polygon: NDArray[np.int32], inverse: Float32
    ) -> tuple[Float32, Float32]:
        """Texture coordinates u and v, each (N,), in metres on the tile, of flat pixels that see the polygons (N,)."""
        row, column = np.divmod(pixels.astype(np.int32), np.int32(width))
        row, column = row.astype(np.float32), column.astype(np.float32)
        per_pixel = (self._axes @ np.linalg.inv(K)).astype(np.float32)
        starts = self._starts.astype(np.float32)

        def along(axis: int) -> Float32:
            value = per_pixel[:, axis, 0][polygon] * column
            value += per_pixel[:, axis, 1][polygon] * row
            value += per_pixel[:, axis, 2][polygon]
            value /= inverse
            value += starts[:, axis][polygon]
            return value

        return along(0), along(1)


def _stripe(offset: Float32, half_width: float, footprint: Float32) -> Float32:
    """Coverage of a stripe seen through a box of the footprint's width."""
    upper = np.clip((offset + half_width) / footprint + 0.5, 0.0, 1.0)
    return np.asarray(upper - np.clip((offset - half_width) / footprint + 0.5, 0.0, 1.0))


def _index_by_place(polygons: Polygons) -> dict[tuple[int, int], NDArray[np.int64]]:
    """Polygon indices by the square cell that their first corner lies in."""
    cells = np.floor(polygons.corners[:, 0, :2] / INDEX_METRES).astype(np.int64)
    unique, inverse = np.unique(cells, axis=0, return_inverse=True)
    order = np.argsort(inverse.ravel(), kind="stable")
    groups = np.split(order, np.cumsum(np.bincount(inverse.ravel()))[:-1])
    return {(int(x), int(y)): group for (x, y), group in zip(unique, groups, strict=True)}
