"""Cells whose points disagree: their robust mean, and the top and the bottom of the step that they hold.

Few cells are disputed, but each costs several rounds over its points. So a CPU picks their points out; a GPU, which
would have to wait for the host to learn how many there are, goes through all. Nothing here has a gradient: a height is
a guess around which `fusion` averages.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor


class _Points:
    """The points (P,) of the disputed cells, which are numbered across environments."""

    def __init__(self, cells: Tensor, slot: Tensor, *columns: Tensor) -> None:
        """Pick the points of `cells` (B, C) out of slots and columns (B, M); on a GPU take all."""
        first = torch.arange(cells.shape[0], device=cells.device)[:, None] * cells.shape[1]
        values = [(slot + first).flatten(), *(column.flatten() for column in columns)]
        if cells.device.type == "cpu":
            chosen = cells.flatten().index_select(0, values[0]).nonzero().squeeze(1)
            values = [value.index_select(0, chosen) for value in values]
        self.slot, self.z, self.spread, self.weight, *self.others = values
        self.used = self.weight > 0
        self._sums = self.z.new_zeros(cells.numel())

    def sum(self, values: Tensor) -> Tensor:
        """Give each point the sum over its cell."""
        self._sums.index_fill_(0, self.slot, 0.0).scatter_add_(0, self.slot, values)
        return self._sums.index_select(0, self.slot)

    def at_mean(self, height: Tensor, weight: Tensor) -> Tensor:
        """Move the points' heights to their cells' means under these weights; where there are none, nowhere."""
        total, moment = self.sum(weight), self.sum(weight * (self.z - height))
        return height + moment / torch.where(total > 0, total, 1.0)

    def of_cells(self, *values: Tensor, like: Tensor) -> Tensor:
        """Give each cell its points' common values, other cells zero: K times (P,) -> (K, B, C)."""
        cells = like.new_zeros(len(values), like.numel())
        return cells.scatter_(1, self.slot.expand(len(values), -1), torch.stack(values)).unflatten(1, like.shape)


@torch.library.custom_op("torchelev::robust_mean", mutates_args=())
def robust_mean(
    cells: Tensor, slot: Tensor, z: Tensor, spread: Tensor, weight: Tensor, mean: Tensor, gate: float
) -> Tensor:
    """Return the robust mean of each disputed cell and how many points lie within the gate around it, (2, B, C).

    From the mean on, twice: the mean under the weights w / (1 + r^2 / sigma^2)^2 of the residuals r, which leave an
    outlier out. `cells` (B, C) uint8 names the disputed cells, `mean` (B, C) holds their means; the points' columns
    are (B, M), with weight zero where a point is not used. Elsewhere the results are zero, or mean nothing.
    """
    points = _Points(cells, slot, z, spread, weight)
    height = mean.flatten().index_select(0, points.slot)
    for _ in range(2):
        square = (points.z - height).square()
        height = points.at_mean(height, points.weight / (1.0 + square / points.spread).square())
    near = points.used & ((points.z - height).square() <= gate**2 * points.spread)
    return points.of_cells(height, points.sum(near.to(mean.dtype)), like=mean)


@robust_mean.register_fake
def _(cells: Tensor, slot: Tensor, z: Tensor, spread: Tensor, weight: Tensor, mean: Tensor, gate: float) -> Tensor:
    return mean.new_empty(2, *mean.shape)


@torch.library.custom_op(
    "torchelev::step_heights",
    mutates_args=(),
    schema="(Tensor cells, Tensor slot, Tensor z, Tensor spread, Tensor weight, Tensor[] ray, Tensor passed, "
    "Tensor mean, SymInt refinements, float margin, SymInt min_points) -> Tensor",
)
def step_heights(
    cells: Tensor,
    slot: Tensor,
    z: Tensor,
    spread: Tensor,
    weight: Tensor,
    ray: list[Tensor],
    passed: Tensor,
    mean: Tensor,
    refinements: int,
    margin: float,
    min_points: int,
) -> Tensor:
    """Return, as (5, B, C), what tells the ground from the top in each disputed cell.

    Its top and its bottom; which part of its low points has `passed` the centre; x and y of where its rays go.
    The top is the mean of the points above the mean, repeated: each of the `refinements` halves the distance to the
    top of a wall's face. The bottom takes two. Up to `margin` standard deviations short of a level lies past it.
    A level that fewer than `min_points` reach, give or take a standard deviation, is an outlier's.
    """
    points = _Points(cells, slot, z, spread, weight, passed, *ray)
    passed, *ray = points.others
    middle = mean.flatten().index_select(0, points.slot)
    noise = points.spread.sqrt()

    def level(side: float, rounds: int) -> Tensor:
        height = middle
        for _ in range(rounds):
            outer = side * (points.z - height) >= -margin * noise
            further = points.at_mean(height, torch.where(outer, points.weight, 0.0))
            there = points.used & (side * (points.z - further) >= -noise)
            height = torch.where(points.sum(there.to(height.dtype)) >= min_points, further, height)
        return height

    low = (points.used & (points.z < middle)).to(mean.dtype)
    passed_low = points.sum(low * passed) / points.sum(low).clamp(min=1)
    x, y = (points.sum(torch.where(points.used, part, 0.0)) for part in ray)
    return points.of_cells(level(1.0, refinements), level(-1.0, 2), passed_low, x, y, like=mean)


@step_heights.register_fake
def _(cells: Tensor, slot: Tensor, *others: Any) -> Tensor:
    return others[2].new_empty(5, *cells.shape)  # of the weights' type
