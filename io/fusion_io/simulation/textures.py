"""The surfaces of the street: periodic tiles of multi-octave noise with structure, mip-mapped.

A tile is a square of ``TILE_METRES`` that repeats; a mip pyramid holds it at every halving of the
resolution, so that a lookup at the level of a pixel's footprint is band limited (Williams,
"Pyramidal parametrics", SIGGRAPH 1983): nothing finer than a pixel is ever sampled.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import IntEnum
from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray

Float32 = NDArray[np.float32]

TILE_TEXELS = 512
TEXEL_METRES = 0.025
TILE_METRES = TILE_TEXELS * TEXEL_METRES
LEVELS = TILE_TEXELS.bit_length()
FACADES = 12
LIBRARY_SEED = 20110926  # the tiles are the same in all worlds; worlds differ in how they use them


class Surface(IntEnum):
    """The tile of a surface; facades are this one and the ``FACADES - 1`` that follow."""

    ASPHALT = 0
    PAVING = 1
    GRASS = 2
    FOLIAGE = 3
    ROOF = 4
    STONE = 5
    PAINT = 6
    GLASS = 7
    WOOD = 8
    PLAIN = 9
    FENCE = 10
    PATCHES = 11
    FACADE = 12


TILES = Surface.FACADE + FACADES


_HUES = {  # RGB beside the grey tile; grey where nothing is said
    Surface.ASPHALT: (1.00, 1.00, 1.03),
    Surface.PAVING: (1.04, 1.00, 0.95),
    Surface.GRASS: (0.90, 1.15, 0.60),
    Surface.FOLIAGE: (0.80, 1.15, 0.60),
    Surface.ROOF: (1.30, 0.90, 0.75),
    Surface.STONE: (1.05, 1.00, 0.92),
    Surface.GLASS: (0.95, 1.00, 1.08),
    Surface.WOOD: (1.15, 1.00, 0.80),
    Surface.FENCE: (1.10, 1.00, 0.85),
    Surface.FACADE: (1.05, 1.00, 0.92),
}
# One row a tile, with a mean of one, so that a colour image is as bright as a grey one.
COLOURS = np.array([_HUES.get(Surface(min(tile, Surface.FACADE)), (1, 1, 1)) for tile in range(TILES)], np.float32)
COLOURS /= COLOURS.mean(axis=1, keepdims=True)


def noise(rng: np.random.Generator, cells: Sequence[int], amplitudes: Sequence[float]) -> Float32:
    """Periodic value noise: one random lattice of ``cells`` x ``cells`` an octave, cubic in between.

    Returns (TILE_TEXELS, TILE_TEXELS) with mean zero; an octave's amplitude is its standard deviation.
    """
    total = np.zeros((TILE_TEXELS, TILE_TEXELS), np.float32)
    for count, amplitude in zip(cells, amplitudes, strict=True):
        lattice = rng.standard_normal((count, count)).astype(np.float32)
        border = 2
        size = TILE_TEXELS * (count + 2 * border) // count
        padded = np.pad(lattice, border, mode="wrap")
        octave = cv2.resize(padded, (size, size), interpolation=cv2.INTER_CUBIC)
        start = TILE_TEXELS * border // count
        octave = octave[start : start + TILE_TEXELS, start : start + TILE_TEXELS]
        total += np.float32(amplitude) * (octave - octave.mean()) / octave.std()
    return total


def _blocks(rng: np.random.Generator, width_m: float, height_m: float, joint: float, spread: float) -> Float32:
    """Staggered courses of blocks (bricks, slabs, roof tiles): a brightness each, darker joints."""
    columns, rows = round(TILE_METRES / width_m), round(TILE_METRES / height_m)
    y, x = np.mgrid[0:TILE_TEXELS, 0:TILE_TEXELS] / TILE_TEXELS
    row = np.floor(y * rows).astype(int)
    across = x * columns + 0.5 * (row % 2)
    brightness = rng.standard_normal((rows, columns))[row, np.floor(across).astype(int) % columns] * spread
    edge = np.minimum((across % 1.0) * width_m, (y * rows % 1.0) * height_m)
    return np.asarray(brightness - joint * (edge < 0.03), np.float32)


def _bars(pitch_m: float, share: float) -> Float32:
    """Vertical bars of a fence: 1 on a bar, 0 between."""
    x = np.arange(TILE_TEXELS) / TILE_TEXELS * round(TILE_METRES / pitch_m)
    return np.tile((x % 1.0 < share).astype(np.float32), (TILE_TEXELS, 1))


def _facade(rng: np.random.Generator) -> Float32:
    """A house front: plaster or brick, a plinth, windows floor by floor, doors. Row 0 is the ground."""
    wall = noise(rng, (4, 16, 64, 128, 256), (0.03, 0.02, 0.02, 0.02, 0.03)) + rng.uniform(0.45, 0.95)
    if rng.random() < 0.3:
        wall = wall * 0.7 + _blocks(rng, 0.4, 0.15, 0.08, 0.05)
    bays = int(rng.integers(3, 6))
    floor_texels = round(rng.uniform(2.6, 3.2) / TEXEL_METRES)
    plinth = round(rng.uniform(0.3, 0.9) / TEXEL_METRES)
    wall[:plinth] *= rng.uniform(0.4, 0.9)
    width = round(rng.uniform(0.8, 1.7) / TEXEL_METRES)
    height = round(rng.uniform(1.1, 1.7) / TEXEL_METRES)
    sill = round(rng.uniform(0.8, 1.1) / TEXEL_METRES)
    frame = max(2, round(rng.uniform(0.05, 0.15) / TEXEL_METRES))
    frame_tone, glass_tone = rng.uniform(0.3, 1.0), rng.uniform(0.05, 0.3)
    shutters = rng.random() < 0.3
    for bottom in range(0, TILE_TEXELS - sill - height, floor_texels):
        for bay in range(bays):
            if rng.random() < 0.1:
                continue
            left = int((bay + rng.uniform(0.25, 0.35)) * TILE_TEXELS / bays)
            low, high = bottom + sill, bottom + sill + height
            if bottom == 0 and rng.random() < 0.25:
                low, high = 0, round(2.1 / TEXEL_METRES)
            if shutters:
                wall[low:high, left - width // 2 : left + width + width // 2] = rng.uniform(0.1, 0.5)
            wall[max(low - frame, 0) : high + frame, left - frame : left + width + frame] = frame_tone
            pane = wall[low:high, left : left + width]
            pane[:] = glass_tone + np.linspace(0.0, rng.uniform(0, 0.25), pane.shape[0])[:, None]
            if rng.random() < 0.3:  # a blind, half way down
                pane[int(pane.shape[0] * rng.uniform(0.2, 0.8)) :] = rng.uniform(0.5, 0.9)
            pane[:, width // 2 - 1 : width // 2 + 1] = frame_tone
    if rng.random() < 0.6:  # a drain pipe
        pipe = int(rng.integers(0, TILE_TEXELS - 5))
        wall[:, pipe : pipe + 4] = rng.uniform(0.2, 0.6)
    return wall


def _tiles() -> list[Float32]:
    """The albedo of every surface, in the order of ``Surface``; values are clipped to 0..1 later."""
    rng = np.random.default_rng(LIBRARY_SEED)
    octaves = (4, 8, 16, 32, 64, 128, 256)
    asphalt = 0.42 + noise(rng, octaves, (0.015, 0.015, 0.01, 0.012, 0.015, 0.025, 0.045))
    seams = np.abs(noise(rng, (3, 8, 32), (1.0, 0.4, 0.1)))  # tar lines follow the zeros of a smooth field
    asphalt -= 0.16 * (seams < 0.02)
    paving = 0.62 + _blocks(rng, 0.5, 0.32, 0.18, 0.05) + noise(rng, octaves, (0.03,) * 7)
    grass = 0.36 + noise(rng, octaves, (0.03, 0.03, 0.04, 0.05, 0.06, 0.08, 0.08))
    foliage = 0.32 + noise(rng, octaves[2:], (0.08, 0.13, 0.15, 0.13, 0.10))
    roof = 0.38 + _blocks(rng, 0.3, 0.35, 0.15, 0.05) + noise(rng, octaves[:4], (0.03,) * 4)
    stone = 0.50 + _blocks(rng, 0.6, 0.4, 0.2, 0.09) + noise(rng, octaves, (0.03,) * 7)
    paint = 0.60 + noise(rng, octaves[1:4], (0.03, 0.05, 0.04))
    glass = 0.14 + np.abs(noise(rng, octaves[1:4], (0.06, 0.08, 0.05)))
    wood = 0.35 + noise(rng, octaves[3:], (0.05, 0.06, 0.06, 0.05))
    plain = np.full((TILE_TEXELS, TILE_TEXELS), 0.6, np.float32) + noise(rng, octaves[4:], (0.02,) * 3)
    fence = 0.12 + 0.5 * _bars(0.2, 0.4) + noise(rng, octaves[3:6], (0.04,) * 3)
    patches = 0.5 + noise(rng, (2, 4, 8, 16, 32), (0.10, 0.10, 0.08, 0.06, 0.04))
    base = [asphalt, paving, grass, foliage, roof, stone, paint, glass, wood, plain, fence, patches]
    return base + [_facade(rng) for _ in range(FACADES)]


class Textures:
    """All tiles with their pyramids in one image, so that OpenCV's remap can interpolate in it.

    Each tile has a band of the image: the full resolution at its left, the coarser levels one below
    the other at its right, each with a border of one texel that continues it periodically.
    """

    def __init__(self) -> None:
        sizes = TILE_TEXELS >> np.arange(LEVELS)
        below = np.cumsum(sizes[1:] + 2) - (sizes[1:] + 2)
        level_rows, level_columns = np.append(0, below), np.where(sizes == TILE_TEXELS, 0, TILE_TEXELS + 2)
        band, width = TILE_TEXELS + 2 * LEVELS, TILE_TEXELS + 2 + TILE_TEXELS // 2 + 2
        self._image = np.zeros((band * TILES, width), np.float32)
        for tile, values in zip(self._image.reshape(TILES, band, width), _tiles(), strict=True):
            clipped = np.clip(values, 0.02, 1.0).astype(np.float32)
            for row, column, size in zip(level_rows, level_columns, sizes, strict=True):
                level = cv2.resize(clipped, (int(size), int(size)), interpolation=cv2.INTER_AREA)
                tile[row : row + size + 2, column : column + size + 2] = np.pad(level, 1, mode="wrap")
        # Where the levels of all tiles begin. Texel centres are integers in remap, so the edge of a
        # level's first texel, behind the border, is at a half.
        self._rows = (band * np.arange(TILES)[:, None] + level_rows + 0.5).ravel().astype(np.float32)
        self._columns = np.tile(level_columns + 0.5, TILES).astype(np.float32)
        self._sizes = sizes.astype(np.float32)

    def lookup(self, surface: NDArray[np.int32], u: Float32, v: Float32, octave: Float32) -> Float32:
        """Albedo (N,) at u, v (N,) metres on the tiles ``surface`` (N,) or (1,).

        It is the average over about 2**octave (N,) metres.
        """
        level = np.clip(octave - np.float32(np.log2(TEXEL_METRES)), 0.0, LEVELS - 1.001).astype(np.float32)
        lower = level.astype(np.int32)
        u = u * np.float32(1 / TILE_METRES)
        v = v * np.float32(1 / TILE_METRES)
        u -= np.floor(u)
        v -= np.floor(v)
        entry = surface * LEVELS + lower
        fine = self._bilinear(entry, lower, u, v)
        coarse = self._bilinear(entry + 1, lower + 1, u, v)
        coarse -= fine
        coarse *= level - lower
        fine += coarse
        return fine

    def _bilinear(self, entry: NDArray[np.int32], level: NDArray[np.int32], u: Float32, v: Float32) -> Float32:
        """Values at fractions u, v of the tile's period, from one level of the pyramid."""
        size = self._sizes[level]
        columns = self._columns[entry] + size * u
        rows = self._rows[entry] + size * v
        # remap takes images whose sides are below 2^15: fold the samples into rows of a thousand.
        count, fold = len(u), 1024
        maps = np.zeros((2, max(-(-count // fold), 1), fold), np.float32)
        maps[0].ravel()[:count], maps[1].ravel()[:count] = columns, rows
        values = cv2.remap(self._image, maps[0], maps[1], cv2.INTER_LINEAR)
        return np.asarray(values, np.float32).ravel()[:count]


@cache
def library() -> Textures:
    """The one set of tiles, baked at first use (about half a second)."""
    return Textures()
