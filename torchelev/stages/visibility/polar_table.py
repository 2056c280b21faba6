"""Places around a sensor by range and azimuth: the rays' table."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.grid import GridConfig
from torchelev.ops.indexing import tabulate

if TYPE_CHECKING:
    from torchelev.stages.visibility.config import RaycastConfig

BREADTH = math.sqrt(2)  # [cells] any ray over a cell passes within half its diagonal beside the cell's centre


class PolarGrid(NamedTuple):
    """Size of the polar table: bins are no longer than a cell, and no wider at any range used."""

    ranges: int  #: bins along a ray, one cell long
    azimuths: int  #: bins around the sensor
    bins: float  #: how many azimuth bins BREADTH cells cover at a range of one cell
    widen: tuple[int, ...]  #: below which range an entry is the minimum of 2, 4, 8, ... azimuth bins

    @property
    def horizon_ranges(self) -> int:
        """Bins along a ray of the horizon's table, two cells long; a multiple of 8."""
        return 8 * (self.ranges // 16 + 1)

    @property
    def horizon_azimuths(self) -> int:
        """Bins around the sensor of the horizon's table, of two of these each."""
        return self.azimuths // 2

    @classmethod
    def of(cls, grid: GridConfig, cfg: RaycastConfig) -> PolarGrid:
        """Choose the table's size for a window."""
        reach = math.ceil(cfg.reach(grid) / grid.resolution)
        # 8 % to spare, of which the approximated azimuth below takes 3: it widens some bins.
        azimuths = 2 * math.ceil(max(16.0, 1.08 * 2 * math.pi * reach) / 2)
        bins = BREADTH * azimuths / (2 * math.pi)
        levels = math.ceil(math.log2(2 * bins + 1)) - 1  # the sensor's own cell has a range of half a cell
        # Two entries of n bins cover all windows of n to 2 n bins, and a cell of x bins lies in at most floor(x) + 2.
        return cls(reach, azimuths, bins, tuple(math.ceil(bins / (2 ** (k + 1) - 1)) for k in range(levels)))

    def covered(self, k: Tensor) -> list[Tensor]:
        """Return how many azimuth bins a cell at range k covers, and of how many an entry is the minimum there."""
        return tabulate(self._covered, k, self.ranges + 1)

    def _covered(self, k: Tensor) -> list[Tensor]:
        entry = torch.ones_like(k)
        for level, rows in enumerate(self.widen):
            entry = entry + 2.0**level * (k < rows)
        return [self.bins / k.clamp(min=0.5), entry]


def azimuth_fraction(x: Tensor, y: Tensor) -> Tensor:
    """Return the azimuth as a fraction of a turn in [0, 1], within 0.001 turns of atan2 and without its cost.

    Rays and cells use the same function, so it need only be monotonic.
    """
    ax, ay = x.abs(), y.abs()
    high = torch.maximum(ax, ay)
    t = torch.minimum(ax, ay) / high.clamp(min=1e-30)
    eighth = t * (0.125 + 0.0434 * (1 - t))  # atan(t) / 2 pi
    quarter = mirrored(eighth, 0.25, ax - ay)
    half = mirrored(quarter, 0.5, x)
    return mirrored(half, 1.0, y)


def mirrored(angle: Tensor, full: float, side: Tensor) -> Tensor:
    """Return full - angle where `side` is negative, -0.0 too, else the angle, which lies in [0, full]."""
    half = torch.copysign(angle.new_full((), full / 2), side)
    return (angle + (half - full / 2)).abs()


def flat(row: Tensor, column: Tensor, width: int) -> Tensor:
    """Return the flat index of whole numbers, int32: float32 counts no farther than 2^24."""
    return row.to(torch.int32) * width + column.to(torch.int32)
