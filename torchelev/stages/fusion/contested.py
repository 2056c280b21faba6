"""Contested cells, whose points disagree: the work on those cells and their points alone.

Few cells are contested, but each costs several rounds over its points. So a CPU selects those cells and their points; a
GPU goes through all. Nothing here has a gradient: a height is an estimate around which `fuse` averages.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.ops.indexing import SelectedCells, can_select, select_points
from torchelev.ops.scatter import cell_sums, highest_per_cell

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int


NO_HEIGHT = -1e30  # [m] below all heights


class CellHeights(NamedTuple):
    """The height of each cell in the scan and in the map, (B, C) [m]; NO_HEIGHT where it has none."""

    scan: Float[Tensor, "B C"]  #: [m] mean of the points
    map: Float[Tensor, "B C"]  #: [m] elevation


class ContestedCells(SelectedCells):
    """K contested cells and their P points; on a GPU all cells and all points."""

    def __init__(
        self,
        untrusted: Bool[Tensor, "B C"],
        has_step: Bool[Tensor, "B C"],
        slot: Int[Tensor, "B M"],
        columns: list[Tensor],
        mean: Float[Tensor, "B C"],
    ) -> None:
        """Select the untrusted cells and those with a step, and their points.

        `columns` are z, spread, weight, passed, ray x and ray y of all points; `mean` is that of a cell's points [m].
        """
        self.selected = untrusted | has_step
        self.cells, self.owner, columns = select_points(self.selected, slot, columns)
        self.has_step, self.mean = self.of(has_step), self.of(mean)
        z, self.spread, self.weight, self.passed, *self.ray = columns
        if not can_select(self.selected):  # without the other cells' points, which sums leave out if they are zero
            self.weight = torch.where(self.at_points(self.selected.flatten()), self.weight, 0.0)
        self.z = z - self.at_points(self.mean)  # [m] above the mean of the cell's points
        self.used = (self.weight > 0).to(z.dtype)

    def sum(self, values: Tensor) -> Tensor:
        """Sum the points' values (..., P) per cell: -> (..., K)."""
        if values.is_cpu:
            total = values.new_zeros(*values.shape[:-1], self.cells.shape[0])
            return total.scatter_add_(-1, self.owner.expand(values.shape), values)
        sums = cell_sums(
            self.owner[None], values.reshape(math.prod(values.shape[:-1]), 1, values.shape[-1]), self.cells.shape[0]
        )
        return sums.view(*values.shape[:-1], -1)

    def highest(self, values: Tensor) -> Tensor:
        """Return the highest of the points' values (P,) per cell: -> (K,)."""
        if values.is_cpu:
            highest = values.new_full((self.cells.shape[0],), -torch.inf)
            return highest.scatter_reduce_(-1, self.owner, values, "amax")
        return highest_per_cell(self.owner[None], values[None], self.cells.shape[0])[0]

    def at_points(self, values: Tensor) -> Tensor:
        """Give each point its cell's value: (..., K) -> (..., P)."""
        return values.index_select(-1, self.owner)

    def any_true(self, mask: Tensor) -> bool:
        """Return whether any is true; assume so where the host would have to wait."""
        return not can_select(mask) or bool(mask.any())


def ratio(numerator: Tensor, denominator: Tensor) -> Tensor:
    """Divide sums over the points of a cell; zero where there is none."""
    return numerator / denominator.clamp(min=torch.finfo(denominator.dtype).tiny)
