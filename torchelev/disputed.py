"""Cells whose points disagree: their robust mean, and how to work on such cells alone.

Few cells are disputed, but each costs several rounds over its points. So a CPU picks out those cells and their points;
a GPU, which would have to wait for the host to learn how many there are, goes through all. Nothing here has a
gradient: a height is a guess around which `fusion` averages.
"""

from __future__ import annotations

import torch
from torch import Tensor


class Disputed:
    """K disputed cells, numbered across environments, and their P points; on a GPU all cells and all points."""

    def __init__(self, cells: Tensor, slot: Tensor, *columns: Tensor) -> None:
        """Pick out the cells (B, C) marked in uint8, and their points' slots and columns (B, M)."""
        self.shape = cells.shape
        first = torch.arange(cells.shape[0], device=cells.device)[:, None] * cells.shape[1]
        slot, values = (slot + first).flatten(), [column.flatten() for column in columns]
        if cells.device.type == "cpu":
            marked = cells.flatten()
            self.cells = marked.nonzero().squeeze(1)
            chosen = marked.index_select(0, slot).nonzero().squeeze(1)
            number = torch.empty(cells.numel(), dtype=torch.int64)
            number[self.cells] = torch.arange(len(self.cells))
            self.owner = number.index_select(0, slot.index_select(0, chosen))
            values = [value.index_select(0, chosen) for value in values]
        else:
            self.cells, self.owner = torch.arange(cells.numel(), device=cells.device), slot
        self.z, self.spread, self.weight, *self.others = values

    def sum(self, values: Tensor) -> Tensor:
        """Sum the points' values (P,) per cell: -> (K,)."""
        return values.new_zeros(len(self.cells)).scatter_add_(0, self.owner, values)

    def at_points(self, values: Tensor) -> Tensor:
        """Give each point its cell's value: (K,) -> (P,)."""
        return values.index_select(0, self.owner)

    def of(self, layer: Tensor) -> Tensor:
        """Read a layer (B, C) at the disputed cells: -> (K,)."""
        return layer.flatten().index_select(0, self.cells)

    def spread_out(self, *values: Tensor) -> Tensor:
        """Make layers of the cells' values, zero elsewhere: n times (K,) -> (n, B, C)."""
        layers = values[0].new_zeros(len(values), self.shape.numel())
        return layers.index_copy_(1, self.cells, torch.stack(values)).unflatten(1, self.shape)


def moved_by(height: Tensor, moment: Tensor, total: Tensor) -> Tensor:
    """Return height + moment / total, and the height where the total is zero, as its moment is then."""
    return torch.addcdiv(height, moment, total.clamp(min=torch.finfo(total.dtype).tiny))


@torch.library.custom_op("torchelev::robust_mean", mutates_args=())
def robust_mean(
    cells: Tensor, slot: Tensor, z: Tensor, spread: Tensor, weight: Tensor, mean: Tensor, gate: float
) -> Tensor:
    """Return the robust mean of each disputed cell and how many points lie within the gate around it, (2, B, C).

    From the mean on, twice: the mean under the weights w / (1 + r^2 / sigma^2)^2 of the residuals r, which leave an
    outlier out. `cells` (B, C) uint8 names the disputed cells, `mean` (B, C) holds their means; the points' columns
    are (B, M), with weight zero where a point is not used. Elsewhere the results are zero, or mean nothing.
    """
    points = Disputed(cells, slot, z, spread, weight)
    height = points.of(mean)
    for _ in range(2):
        residual = points.z - points.at_points(height)
        reduced = points.weight / (1.0 + residual.square() / points.spread).square()
        height = moved_by(height, points.sum(reduced * residual), points.sum(reduced))
    residual = points.z - points.at_points(height)
    near = (points.weight > 0) & (residual.square() <= gate**2 * points.spread)
    return points.spread_out(height, points.sum(near.to(mean.dtype)))


@robust_mean.register_fake
def _(cells: Tensor, slot: Tensor, z: Tensor, spread: Tensor, weight: Tensor, mean: Tensor, gate: float) -> Tensor:
    return mean.new_empty(2, *mean.shape)
