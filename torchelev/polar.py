"""Places around a sensor by range and azimuth: the rays' table."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.grid import GridConfig

if TYPE_CHECKING:
    from torchelev.raycast import RaycastConfig

BREADTH = 1.125  # [cells] a ray so near passes over a cell: with less, rays of a still sensor would miss some for ever


class PolarGrid(NamedTuple):
    """Size of the polar table: bins are no longer than a cell, and no wider at any range used."""

    ranges: int
    azimuths: int
    widen: tuple[int, ...]  # up to which range BREADTH cells are wider than 1, 2, 4, ... azimuth bins

    @classmethod
    def of(cls, grid: GridConfig, cfg: RaycastConfig) -> PolarGrid:
        """Choose the table's size for a window."""
        reach = math.ceil((cfg.max_range or 0.55 * math.hypot(grid.length_x, grid.length_y)) / grid.resolution)
        # 8 % to spare, of which the approximated azimuth below takes 3: it widens some bins.
        azimuths = 2 * math.ceil(max(16.0, 1.08 * 2 * math.pi * reach) / 2)
        width = BREADTH * azimuths / (2 * math.pi)  # in azimuth bins, at a range of one cell
        levels = math.ceil(math.log2(2 * width))  # the sensor's own cell has a range of half a cell
        return cls(reach, azimuths, tuple(math.ceil(width / 2**k) for k in range(levels)))

    def widths(self, k: Tensor) -> Tensor:
        """Return how many azimuth bins a cell at range k is taken to cover, a power of two."""
        # Compiled it is computed for each cell, else for each range and looked up: each is the faster there.
        row = k if torch.compiler.is_compiling() else torch.arange(self.ranges + 1, device=k.device, dtype=k.dtype)
        width = torch.ones_like(row)
        for level, rows in enumerate(self.widen):
            width = torch.add(width, row < rows, alpha=2.0**level)
        return width if row is k else width.index_select(0, k.to(torch.int32).flatten()).view_as(k)


def turn(x: Tensor, y: Tensor) -> Tensor:
    """Return the azimuth as a fraction of a turn in [0, 1], within 0.001 turns of atan2 and without its cost.

    Rays and cells use the same function, so that only its monotony matters.
    """
    ax, ay = x.abs(), y.abs()
    high = torch.maximum(ax, ay)
    t = torch.minimum(ax, ay) / high.clamp(min=1e-30)
    eighth = t * (0.125 + 0.0434 * (1 - t))  # atan(t) / 2 pi
    quarter = mirrored(eighth, 0.25, ax - ay)
    half = mirrored(quarter, 0.5, x)
    return mirrored(half, 1.0, y)


def mirrored(share: Tensor, whole: float, side: Tensor) -> Tensor:
    """Return whole - share where `side` is negative, -0.0 too, else the share, which lies in [0, whole]."""
    half = torch.copysign(share.new_full((), whole / 2), side)
    return (share + (half - whole / 2)).abs()


def flat(row: Tensor, column: Tensor, width: int) -> Tensor:
    """Return the flat index of whole numbers, int32: float32 counts no farther than 2^24."""
    return row.to(torch.int32) * width + column.to(torch.int32)
