"""The renderer: the street's polygons through a pinhole camera, by casting a ray per sample.

For a plane n.p = d in camera axes the ray of pixel (u, v) meets it where 1/z = n.K^-1(u, v, 1)/d,
and lies inside a convex polygon where it lies on the inner side of the plane through the camera and
each edge. Both are affine in (u, v), so the cast is exact and needs no clipping.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from fusion_io.records import FloatArray
from fusion_io.simulation.street import (
    GROUND_CELL_METRES,
    GroundMap,
    Look,
    Path,
    Polygons,
    build_ground,
    build_street,
)
from fusion_io.simulation.textures import Float32, Surface, library

VIEW_METRES = 120.0  # nothing further away is drawn
INDEX_METRES = 32.0
TENT = np.array([0.25, 0.5, 0.25], np.float32)  # the pixel's filter over samples half a pixel apart


class World:
    """A street along a path, fixed by seed and place."""

    def __init__(self, seed: int, ground_path: FloatArray, look: Look | None = None) -> None:
        """ground_path (N, 3): the ground under the camera along its way, metres, z up."""
        self.look = look or Look.draw(np.random.default_rng([seed, 1]))
        self._offset = np.random.default_rng([seed, 2]).uniform(0, 100, 2).astype(np.float32)
        self._tones = np.exp(np.random.default_rng([seed, 3]).normal(0, 0.2, 4)).astype(np.float32)
        path = Path(ground_path)
        street, shadows = build_street(path, self.look, seed)
        self._ground_map = GroundMap(path, shadows)
        self._polygons = _concatenate([build_ground(path, self.look), street])
        self._index = _index_by_place(self._polygons)

    def render(
        self, T_world_camera: FloatArray, K: FloatArray, width: int, height: int, colour: bool = False
    ) -> tuple[Float32, Float32]:
        """The scene from a pose (4, 4) through a pinhole camera K (3, 3), pixel centres at integers.

        Returns the radiance (H, W) or (H, W, 3), where 1 is white and more is possible, and the
        exact depth (H, W) in metres along the optical axis at the pixels' centres, 0 for the sky.
        """
        view = _View(self._polygons, self._nearby(T_world_camera), T_world_camera, K, width, height)
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

    def _shade(self, view: _View, hits: NDArray[np.int32], inverse_depth: Float32, K: FloatArray, colour: bool) -> Float32:
        """Radiance of every sample: the surface's albedo at the ray's end times its tint and light."""
        height, width = hits.shape
        rays = view.rays(K, width, height)
        radiance = self._sky(rays, view.rotation)
        hit = hits >= 0
        index = hits[hit]
        ray = rays[hit]
        z = 1.0 / inverse_depth[hit]
        place = view.texture_coordinates(index, ray, z)
        # The footprint of a sample: z/f across, and longer by 1/cos along the slant. Between the
        # two, nearer the long one: the supersampling takes care of the rest.
        across = z / np.float32(K[0, 0])
        slant = view.slant(index, ray)
        albedo_surface = view.surfaces[index]
        light = view.tints[index] if colour else view.tints[index].mean(axis=1, keepdims=True)
        ground = view.is_ground[index]
        if ground.any():
            tone, surface = self._ground(view, ray[ground], z[ground], across[ground], slant[ground])
            albedo_surface[ground] = surface
            light = light.copy()
            light[ground] *= tone[:, None]
        footprint = across * np.exp2(np.float32(0.7) * np.log2(slant))
        albedo = library().lookup(albedo_surface, place[:, 0], place[:, 1], footprint)
        samples = albedo[:, None] * light
        out = np.empty((height, width, samples.shape[1]), np.float32)
        out[...] = radiance[..., None]
        out[hit] = samples
        return out if colour else out[..., 0]

    def _ground(self, view: _View, ray: Float32, z: Float32, across: Float32, slant: Float32) -> tuple[Float32, NDArray[np.int32]]:
        """Tone (N,) and surface (N,) of samples on the ground."""
        look = self.look
        xy = view.ground_points(ray, z)
        x, y = xy[:, 0], xy[:, 1]
        lateral, along, sunlight = self._ground_map.lookup(x, y)
        on_road = (lateral < look.road_left_m) & (lateral > -look.road_right_m)
        on_paving = (lateral < look.road_left_m + look.paving_m) & (lateral > -look.road_right_m - look.paving_m)
        surface = np.where(on_road, Surface.ASPHALT, np.where(on_paving, Surface.PAVING, Surface.GRASS)).astype(np.int32)
        tone = np.choose(surface, [self._tones[0], self._tones[1], self._tones[2]])
        patches = library().lookup(
            np.full(len(x), Surface.PATCHES, np.int32),
            (x + self._offset[0]) / 4,
            (y + self._offset[1]) / 4,
            across * slant / 4,
        )
        tone *= 0.5 + patches
        kerb = _stripe(lateral - look.road_left_m, 0.07, across) + _stripe(lateral + look.road_right_m, 0.07, across)
        paint = 0.8 * kerb
        if look.markings:
            dash = np.clip((1.5 - np.abs(np.mod(along, 9.0) - 4.5)) / (across * slant) + 0.5, 0.0, 1.0)
            centre = 0.5 * (look.road_left_m - look.road_right_m)
            paint += 1.2 * dash * _stripe(lateral - centre, 0.07, across)
            paint += 1.2 * _stripe(lateral + look.road_right_m - 0.35, 0.06, across)
        tone *= 1.0 + paint
        tone *= look.ambient + (1.0 - look.ambient) * look.sun[2] * sunlight
        return tone.astype(np.float32), surface

    def _sky(self, rays: Float32, rotation: FloatArray) -> Float32:
        """A bright gradient with clouds, and haze below the horizon; at infinity."""
        world = rays @ rotation.T.astype(np.float32)
        norm = np.linalg.norm(world, axis=2)
        up = world[..., 2] / norm
        above = np.maximum(up, 0.02)
        cloud = library().lookup(
            np.full(up.size, Surface.PATCHES, np.int32),
            (world[..., 0] / norm / (above + 0.3)).ravel() * 6,
            (world[..., 1] / norm / (above + 0.3)).ravel() * 6,
            np.full(up.size, 0.1, np.float32),
        ).reshape(up.shape)
        sky = np.float32(self.look.sky) * (1.0 - 0.5 * above) + 0.4 * (cloud - 0.5)
        haze = np.float32(0.35 * self.look.sky)
        blend = np.clip(up / 0.02 + 0.5, 0.0, 1.0)
        return np.asarray(haze + blend * (sky - haze), np.float32)


class _View:
    """The polygons that may be seen from one pose, in camera axes."""

    def __init__(
        self,
        polygons: Polygons,
        candidates: NDArray[np.int64],
        T_world_camera: FloatArray,
        K: FloatArray,
        width: int,
        height: int,
    ) -> None:
        self.rotation, self.position = T_world_camera[:3, :3], T_world_camera[:3, 3]
        first = polygons.corners[candidates, 0] - self.position
        facing = np.einsum("ij,ij->i", polygons.normals[candidates], first) < -1e-6
        facing &= np.einsum("ij,ij->i", first, first) < VIEW_METRES**2
        facing &= first @ self.rotation[:, 2] > -GROUND_CELL_METRES * 2
        candidates = candidates[facing]
        corners = (polygons.corners[candidates] - self.position) @ self.rotation
        # A polygon is out of sight if all its corners are outside of one side of the view's pyramid.
        sides = np.array([[1, 0, 1], [-1, 0, width], [0, 1, 1], [0, -1, height], [0, 0, 1]]) @ K
        outside = corners @ sides.T < 0
        seen = ~outside.all(axis=1).any(axis=1)
        candidates, corners = candidates[seen], corners[seen]
        self._corners = corners
        self._normals = polygons.normals[candidates] @ self.rotation
        self._distances = np.einsum("ij,ij->i", self._normals, corners[:, 0])
        axes = polygons.axes[candidates]
        start = np.einsum("ij,ikj->ik", self.position - polygons.origins[candidates], axes)
        self._texture_axes = (axes @ self.rotation).astype(np.float32)
        self._texture_start = (start + polygons.shifts[candidates]).astype(np.float32)
        self._unit = (self._normals / self._distances[:, None]).astype(np.float32)
        self._normals32 = self._normals.astype(np.float32)
        self.surfaces = polygons.surfaces[candidates]
        self.tints = polygons.tints[candidates].astype(np.float32)
        self.is_ground = polygons.is_ground[candidates]

    @staticmethod
    def rays(K: FloatArray, width: int, height: int) -> Float32:
        """(H, W, 3) rays in camera axes with z = 1."""
        rays = np.ones((height, width, 3), np.float32)
        rays[..., 0] = (np.arange(width) - K[0, 2]) / K[0, 0]
        rays[..., 1] = ((np.arange(height) - K[1, 2]) / K[1, 1])[:, None]
        return rays

    def cast(self, K: FloatArray, width: int, height: int) -> tuple[NDArray[np.int32], Float32]:
        """The polygon (H, W) that every ray meets first, -1 for none, and its inverse depth, 0 for none."""
        hits = np.full((height, width), -1, np.int32)
        nearest = np.zeros((height, width), np.float32)
        pixel_from_normal = np.linalg.inv(K)  # n.K^-1 (u, v, 1) = (n K^-1).(u, v, 1)
        edges = np.cross(self._corners, np.roll(self._corners, -1, axis=1)) @ pixel_from_normal
        planes = (self._normals / self._distances[:, None]) @ pixel_from_normal
        left, right = _spans(edges, self._corners.mean(axis=1), K, width, height)
        filled = left < right
        rows = np.arange(height)
        some = np.flatnonzero(filled.any(axis=1))
        top = filled[some].argmax(axis=1)
        bottom = height - filled[some, ::-1].argmax(axis=1)
        first = np.where(filled, left, width)[some].min(axis=1)
        last = np.where(filled, right, 0)[some].max(axis=1)
        columns = np.arange(width, dtype=np.float32)
        whole = np.arange(width, dtype=np.int32)
        a, b, c = planes[some].astype(np.float32).T
        for polygon, r0, r1, c0, c1, pa, pb, pc in zip(some, top, bottom, first, last, a, b, c, strict=True):
            inverse = (pb * rows[r0:r1].astype(np.float32) + pc)[:, None] + pa * columns[c0:c1]
            window = nearest[r0:r1, c0:c1]
            inside = inverse > window
            inside &= whole[c0:c1] >= left[polygon, r0:r1, None]
            inside &= whole[c0:c1] < right[polygon, r0:r1, None]
            np.copyto(window, inverse, where=inside)
            np.copyto(hits[r0:r1, c0:c1], np.int32(polygon), where=inside)
        return hits, nearest

    def texture_coordinates(self, index: NDArray[np.int32], ray: Float32, z: Float32) -> Float32:
        """(N, 2) metres on the tile."""
        axes = self._texture_axes[index]
        return np.asarray(np.einsum("nkj,nj->nk", axes, ray * z[:, None]) + self._texture_start[index])

    def slant(self, index: NDArray[np.int32], ray: Float32) -> Float32:
        """1 / cos of the angle of incidence, (N,)."""
        cosine = -np.einsum("nj,nj->n", self._normals32[index], ray)
        return np.asarray(np.linalg.norm(ray, axis=1) / np.maximum(cosine, 1e-3), np.float32)

    def ground_points(self, ray: Float32, z: Float32) -> Float32:
        """World x, y (N, 2) of the rays' ends."""
        return np.asarray((ray * z[:, None]) @ self.rotation[:2].T.astype(np.float32) + self.position[:2].astype(np.float32))


def _spans(
    edges: FloatArray, centres: FloatArray, K: FloatArray, width: int, height: int
) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """The columns [left, right) of every row (F, H) that lie inside all edges (F, 5, 3) of each polygon."""
    centre_pixels = centres @ K.T
    sign = np.sign(np.einsum("fej,fj->fe", edges, centre_pixels))
    a, b, c = np.moveaxis((edges * sign[..., None]).astype(np.float32), 2, 0)
    rest = b[..., None] * np.arange(height, dtype=np.float32) + c[..., None]
    with np.errstate(divide="ignore", invalid="ignore"):
        bound = -rest / a[..., None]
    left = np.where(a[..., None] > 0, bound, np.float32(0)).max(axis=1)
    right = np.where(a[..., None] < 0, bound, np.float32(width - 1)).min(axis=1)
    empty = ((a[..., None] == 0) & (rest < 0)).any(axis=1)
    first = np.ceil(np.clip(left, 0, width)).astype(np.int32)
    last = np.floor(np.clip(right, -1, width - 1)).astype(np.int32) + 1
    last[empty] = 0
    return first, last


def _stripe(offset: Float32, half_width: float, footprint: Float32) -> Float32:
    """Coverage of a stripe seen through a box of the footprint's width."""
    upper = np.clip((offset + half_width) / footprint + 0.5, 0.0, 1.0)
    return np.asarray(upper - np.clip((offset - half_width) / footprint + 0.5, 0.0, 1.0))


def _concatenate(parts: list[Polygons]) -> Polygons:
    return Polygons(**{name: np.concatenate([getattr(part, name) for part in parts]) for name in Polygons.__annotations__})


def _index_by_place(polygons: Polygons) -> dict[tuple[int, int], NDArray[np.int64]]:
    """Polygon indices by the square cell that their first corner lies in."""
    cells = np.floor(polygons.corners[:, 0, :2] / INDEX_METRES).astype(np.int64)
    unique, inverse = np.unique(cells, axis=0, return_inverse=True)
    order = np.argsort(inverse.ravel(), kind="stable")
    groups = np.split(order, np.cumsum(np.bincount(inverse.ravel()))[:-1])
    return {(int(x), int(y)): group for (x, y), group in zip(unique, groups, strict=True)}
