"""Pixels of a raster, wherever they are kept: their place in the map frame, and a part of them at a time."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

_CHUNK = 1 << 21  # pixels that are read at a time


class Place(NamedTuple):
    """Where pixels lie: x = a * column + b * row + c, y = d * column + e * row + f [m], pixel 0 from 0 to 1."""

    matrix: NDArray[np.float64]  #: (2, 2) [[a, b], [d, e]]
    corner: NDArray[np.float64]  #: (2,) [c, f] the outer corner of the first pixel

    def to_map(self, pixels: NDArray) -> NDArray[np.float64]:
        """Return x, y (..., 2) [m] of columns and rows (..., 2)."""
        return pixels @ self.matrix.T + self.corner

    def to_pixels(self, xy: NDArray) -> NDArray[np.float64]:
        """Return columns and rows (..., 2) of x, y (..., 2) [m]."""
        return (xy - self.corner) @ np.linalg.inv(self.matrix).T

    @property
    def longest_side(self) -> float:
        """The longer side of a pixel [m]."""
        return float(np.linalg.norm(self.matrix, axis=0).max())


class Part(NamedTuple):
    """A rectangle of pixels."""

    first: tuple[int, int]  #: row and column of the first one
    size: tuple[int, int]  #: rows and columns

    def chunks(self) -> Iterator[Part]:
        """Yield parts of it, each of at most about two million pixels."""
        (row, column), (rows, columns) = self.first, self.size
        width = min(columns, _CHUNK)
        height = max(1, _CHUNK // max(width, 1))
        for r in range(row, row + rows, height):
            for c in range(column, column + columns, width):
                yield Part((r, c), (min(height, row + rows - r), min(width, column + columns - c)))


class Pixels(Protocol):
    """Heights of a raster, of which a part is read at a time."""

    name: str  #: of them, for errors
    shape: tuple[int, int]  #: rows, columns
    place: Place  #: in the map frame

    def read(self, part: Part) -> NDArray[np.float64]:
        """Return heights (rows, columns) [m], NaN where unknown."""


class ArrayPixels:
    """Pixels in memory.

    Args:
        name: of them, for errors.
        heights: (rows, columns) [m]; what is not finite is unknown.
        place: where they lie.
    """

    def __init__(self, name: str, heights: NDArray, place: Place) -> None:
        self.name, self.shape, self.place = name, (heights.shape[0], heights.shape[1]), place
        self._heights = heights

    def read(self, part: Part) -> NDArray[np.float64]:
        """Return a part."""
        (row, column), (rows, columns) = part
        heights = self._heights[row : row + rows, column : column + columns].astype(np.float64)
        return np.where(np.isfinite(heights), heights, np.nan)


def layer_pixels(name: str, heights: NDArray, center: NDArray, resolution: float) -> ArrayPixels:
    """Return the pixels of a layer (H, W) in torchelev's convention: rows grow along x, columns along y."""
    corner = np.asarray(center, np.float64)[:2] - np.array(heights.shape) * resolution / 2
    return ArrayPixels(name, heights, Place(np.array([[0.0, resolution], [resolution, 0.0]]), corner))


def fingerprint(pixels: Pixels) -> str:
    """Return the SHA-256 of the heights, as float32, and their place in the file's own coordinates."""
    digest = hashlib.sha256(repr((pixels.shape, pixels.place.matrix.tolist())).encode())
    for part in Part((0, 0), pixels.shape).chunks():
        digest.update(pixels.read(part).astype("<f4").tobytes())
    return digest.hexdigest()
