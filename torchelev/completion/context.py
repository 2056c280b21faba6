"""The ground in a square around each cell: how much of it is known or bounded, and how rough it is."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
import torch.nn.functional as F
from torch import Tensor

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

RADII = (0.4, 1.2)  # [m] half the sides of the squares
NUM_CONTEXT = 3 * len(RADII)


def describe_context(
    elevation: Float[Tensor, "B H W"], known: Bool[Tensor, "B H W"], bounded: Bool[Tensor, "B H W"], resolution: float
) -> Float[Tensor, "K B H W"]:
    """Return for each of RADII the shares of known and of bounded cells, and the mean height [m] of steps.

    A step is the difference of two neighbours along x or y that are both known. Outside the window nothing is known.
    """
    height = torch.where(known, elevation, 0.0)
    pairs, steps = torch.zeros_like(height), torch.zeros_like(height)
    for dim in (1, 2):
        size = height.shape[dim] - 1
        is_pair = known.narrow(dim, 0, size) & known.narrow(dim, 1, size)
        step = (height.narrow(dim, 1, size) - height.narrow(dim, 0, size)).abs()
        for side in (0, 1):  # both cells of a pair, so that mirrors and turns change nothing
            pairs.narrow(dim, side, size).add_(is_pair)
            steps = steps + _along(torch.where(is_pair, step, 0.0), dim, side)
    layers = torch.stack([known.to(height.dtype), bounded.to(height.dtype), pairs, steps])
    sums = F.pad(layers, (1, 0, 1, 0)).double().cumsum(2).cumsum(3)
    described = []
    for radius in RADII:
        cells = max(1, round(radius / resolution))
        share, bound, count, total = _sum_squares(sums, cells).to(height.dtype).unbind()
        area = (2 * cells + 1) ** 2
        described += [share / area, bound / area, total / count.clamp(min=1)]
    return torch.stack(described)


def _along(values: Tensor, dim: int, side: int) -> Tensor:
    """Put a blank line before (1) or behind (0) the lines of a dimension."""
    rim = [side, 1 - side]
    return F.pad(values, rim if dim == 2 else [0, 0, *rim])


def _sum_squares(sums: Float[Tensor, "L B h w"], radius: int) -> Float[Tensor, "L B H W"]:
    """Return the sums over the square around each cell, from the sums over all cells before each corner."""
    H, W = (size - 1 for size in sums.shape[2:])
    for dim, size in ((2, H), (3, W)):
        cell = torch.arange(size, device=sums.device)
        low, high = (cell - radius).clamp(min=0), (cell + radius + 1).clamp(max=size)
        sums = sums.index_select(dim, high) - sums.index_select(dim, low)
    return sums
