"""Heights of a raster for the cells of a map.

The rule:

- A raster whose pixels are smaller than the cells: a cell gets the mean of the known pixels whose centres lie in it. A
  centre on the border of two cells belongs to the one with the larger number.
- One whose pixels are as large or larger, and cells of a turned raster that hold no pixel's centre: bilinear
  interpolation at the cell's centre between the centres of the four pixels around it. The cell is unknown if one that
  has weight is unknown or missing: nothing is extrapolated.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from torchelev.io.rasters.pixels import Part, Pixels

_ROUNDING = 1e-6  # of a cell or a pixel


class Cells(NamedTuple):
    """A rectangle of cells of the lattice."""

    corner: tuple[int, int]  #: number of the first cell along x and y
    size: tuple[int, int]  #: H, W
    resolution: float  #: [m]

    def centers(self) -> NDArray[np.float64]:
        """Return x, y (H, W, 2) [m]."""
        i, j = np.indices(self.size)
        return (np.stack([i, j], -1) + np.array(self.corner) + 0.5) * self.resolution


def resample(pixels: Pixels, cells: Cells) -> NDArray[np.float64]:
    """Return the heights (H, W) [m] of cells, NaN where unknown."""
    side = pixels.place.longest_side
    if side >= cells.resolution * (1 - _ROUNDING):
        return _interpolate(pixels, cells)
    heights, holds_centers = _average(pixels, cells)
    if side > cells.resolution * math.sqrt(0.5):  # of smaller ones, each cell within the raster holds a centre
        heights = np.where(holds_centers, heights, _interpolate(pixels, cells))
    return heights


def find_part(pixels: Pixels, cells: Cells) -> Part:
    """Return the pixels that cells depend on."""
    corner, size = np.array(cells.corner), np.array(cells.size)
    borders = np.array([(0, 0), (0, 1), (1, 0), (1, 1)]) * size + corner
    columns, rows = pixels.place.to_pixels(borders * cells.resolution).T
    limits = [(rows, pixels.shape[0]), (columns, pixels.shape[1])]
    spans = [(np.clip([math.floor(k.min()) - 1, math.ceil(k.max()) + 1], 0, n)).astype(int) for k, n in limits]
    (row, row_end), (column, column_end) = (map(int, span) for span in spans)
    return Part((row, column), (row_end - row, column_end - column))


def _average(pixels: Pixels, cells: Cells) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
    """Return the means of the known pixels whose centres lie in each cell, and which cells hold centres at all."""
    H, W = cells.size
    moment, known, all_ = np.zeros(H * W), np.zeros(H * W), np.zeros(H * W)
    for part in find_part(pixels, cells).chunks():
        heights = pixels.read(part).ravel()
        row, column = np.indices(part.size).reshape(2, -1) + np.array(part.first)[:, None] + 0.5
        xy = pixels.place.to_map(np.stack([column, row], -1))
        i, j = (np.floor(xy / cells.resolution + _ROUNDING) - cells.corner).T
        inside = (i >= 0) & (i < H) & (j >= 0) & (j < W)
        cell, heights = (i[inside] * W + j[inside]).astype(np.int64), heights[inside]
        is_known = np.isfinite(heights)
        all_ += np.bincount(cell, minlength=H * W)
        known += np.bincount(cell[is_known], minlength=H * W)
        moment += np.bincount(cell[is_known], heights[is_known], minlength=H * W)
    means = np.where(known > 0, moment / np.maximum(known, 1), np.nan)
    return means.reshape(H, W), all_.reshape(H, W) > 0


def _interpolate(pixels: Pixels, cells: Cells) -> NDArray[np.float64]:
    """Return bilinear heights at the cells' centres, NaN where a pixel that has weight is unknown or missing."""
    part = find_part(pixels, cells)
    unknown = np.full(cells.size, np.nan)
    if 0 in part.size:
        return unknown
    padded = np.pad(pixels.read(part), 2, constant_values=np.nan)  # whose element 2, 2 is the part's first pixel
    column, row = np.moveaxis(pixels.place.to_pixels(cells.centers()) - 0.5, -1, 0)
    place = np.stack([row - part.first[0], column - part.first[1]]) + 2
    first = np.floor(place + _ROUNDING)
    share = place - first
    share = np.where(np.abs(share) < _ROUNDING, 0.0, share)
    top = np.array(padded.shape)[:, None, None] - 2
    k, m = np.clip(first, 0, top).astype(np.int64)
    is_far = ((first < 0) | (first > top)).any(0)
    total = np.zeros(cells.size)
    for down in (0, 1):
        for right in (0, 1):
            weight = np.abs(1 - down - share[0]) * np.abs(1 - right - share[1])
            total += np.where(weight > 0, weight * padded[k + down, m + right], 0.0)
    return np.where(is_far, np.nan, total)
