"""One raster into the tiles of a site, some tiles at a time, as the window of a robot without a map."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchelev.io.rasters.raster import Raster
from torchelev.site.content.tiles import TILE, Tiles
from torchelev.site.fusion.merge import Merged, merge_windows
from torchelev.site.fusion.windows import Known, Windows, no_alignment
from torchelev.site.site_config import SiteConfig

_BLOCK = 8 * TILE  # cells along x and y that are merged at a time


class Box(NamedTuple):
    """A rectangle of cells of the lattice."""

    first: tuple[int, int]  #: number of the first cell along x and y
    end: tuple[int, int]  #: of the one after the last

    def meets(self, other: Box) -> bool:
        """Return whether two have cells in common."""
        return all(
            max(a, b) < min(c, d) for a, b, c, d in zip(self.first, other.first, self.end, other.end, strict=True)
        )

    def cut(self, other: Box) -> Box:
        """Return what two have in common; may be empty."""
        first = tuple(max(a, b) for a, b in zip(self.first, other.first, strict=True))
        end = tuple(min(a, b) for a, b in zip(self.end, other.end, strict=True))
        return Box(first, end)  # type: ignore[arg-type]

    @property
    def is_empty(self) -> bool:
        """Whether it has no cells."""
        return not all(a < b for a, b in zip(self.first, self.end, strict=True))

    def blocks(self) -> Iterator[Box]:
        """Yield parts of it that have no tile in common, from north to south, the fastest order for most files."""
        x, y = (range(a // _BLOCK, (b - 1) // _BLOCK + 1) for a, b in zip(self.first, self.end, strict=True))
        for b in reversed(y):
            for a in x:
                yield self.cut(Box((a * _BLOCK, b * _BLOCK), ((a + 1) * _BLOCK, (b + 1) * _BLOCK)))


class RasterCells:
    """The known cells of a raster, as windows.

    Attributes:
        known: number of known cells of all windows that were read.
    """

    def __init__(self, raster: Raster, resolution: float, now: float, device: torch.device) -> None:
        self._raster, self._resolution, self._now, self._device = raster, resolution, now, device
        self.known = 0

    def read(self, box: Box) -> Windows | None:
        """Return the window of a box; None if nothing is known there.

        The slopes of cells without known neighbours on all four sides are unknown.
        """
        size = tuple(b - a + 2 for a, b in zip(box.first, box.end, strict=True))  # with a border for the slopes
        corner = box.first[0] - 1, box.first[1] - 1
        heights = self._raster.heights(corner, size, self._resolution)  # type: ignore[arg-type]
        inner = heights[1:-1, 1:-1]
        is_known = np.isfinite(inner)
        number = int(is_known.sum())
        self.known += number
        return self._as_windows(box, heights, inner, is_known) if number else None

    def _as_windows(self, box: Box, heights: NDArray, inner: NDArray, is_known: NDArray) -> Windows:
        per_window = torch.ones(1, dtype=torch.float64, device=self._device)
        elevation, known = self._bring(np.where(is_known, inner, 0.0)), self._bring(is_known)
        nothing, nowhere = torch.zeros_like(elevation), torch.zeros_like(known)
        step = 2 * self._resolution
        slopes = (heights[2:, 1:-1] - heights[:-2, 1:-1]) / step, (heights[1:-1, 2:] - heights[1:-1, :-2]) / step
        has_slope = np.isfinite(slopes[0]) & np.isfinite(slopes[1])
        along_x, along_y = (self._bring(np.where(has_slope, slope, 0.0)) for slope in slopes)
        corner = torch.tensor([box.first], dtype=torch.int64, device=self._device)
        variance, now = torch.full_like(elevation, self._raster.variance), self._now * per_window
        layers = Known(corner, elevation, variance, nothing, known, now, 0.0 * per_window)
        return Windows(layers, along_x, along_y, self._bring(has_slope), nothing, nowhere, known, None)

    def _bring(self, array: NDArray) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(array))[None].to(self._device)


def merge_raster(
    tiles: Tiles, cells: RasterCells, box: Box, resolution: float, rate: float, cfg: SiteConfig
) -> Iterator[Merged]:
    """Return the tiles below a box after a raster's cells are fused into them, as `merge_windows` does."""
    alignment = no_alignment(1, tiles.device)
    for block in box.blocks():
        windows = cells.read(block)
        if windows is not None:
            yield from merge_windows(tiles, windows, alignment, resolution, rate, cfg)


def join(parts: Iterable[Merged]) -> Sequence[Merged]:
    """Return all parts as one, which memory takes at once; none if there is none."""
    all_ = list(parts)
    if not all_:
        return []
    tiles = [tile for part in all_ for tile in part.tiles]
    values, contradictions = torch.cat([part.values for part in all_], 1), sum(part.contradictions for part in all_)
    return [Merged(tiles, values, contradictions)]  # type: ignore[arg-type]
