"""Statistics of the square around a cell: shares of known and bounded cells, roughness, spread of the heights."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

RADII = (0.4, 1.2)  # [m] half the sides of the squares
NUM_CONTEXT = 6 * len(RADII)
SMALLEST_STD = 0.01  # [m] below which the skewness fades


class Context(NamedTuple):
    """The squares of RADII around n cells, float64. Outside the window nothing is known."""

    known: Float[Tensor, "R n"]  #: share of known cells
    bounded: Float[Tensor, "R n"]  #: share of bounded cells
    step: Float[Tensor, "R n"]  #: [m] mean difference of neighbours along x or y that are both known
    mean: Float[Tensor, "R n"]  #: [m] of the known heights; 0 without any
    std: Float[Tensor, "R n"]  #: [m] of these heights
    skewness: Float[Tensor, "R n"]  #: of these heights: below 0, they are mostly high


def sum_layers(
    elevation: Float[Tensor, "B H W"],
    known: Bool[Tensor, "B H W"],
    bounded: Bool[Tensor, "B H W"],
    level: Float[Tensor, "B"],
) -> Float[Tensor, "B H+1 W+1 7"]:
    """Return for each corner of a cell the sums over all cells before it, float64, from which `describe` takes squares.

    Summed are known, bounded, pairs of known neighbours and their steps, and the first three powers of the heights over
    `level` [m].
    """
    height = torch.where(known, elevation.double() - level[:, None, None], 0.0)
    pairs, steps = torch.zeros_like(height), torch.zeros_like(height)
    for dim in (1, 2):
        size = height.shape[dim] - 1
        is_pair = known.narrow(dim, 0, size) & known.narrow(dim, 1, size)
        step = (height.narrow(dim, 1, size) - height.narrow(dim, 0, size)).abs() * is_pair
        for rim in ([0, 1], [1, 0]):  # both cells of a pair count it, so that mirrors and turns change nothing
            around = rim if dim == 2 else [0, 0, *rim]
            pairs, steps = pairs + F.pad(is_pair.double(), around), steps + F.pad(step, around)
    powers = [height, height.square(), height**3]
    layers = torch.stack([known.double(), bounded.double(), pairs, steps, *powers], -1)
    return integral(F.pad(layers, (0, 0, 1, 0, 1, 0)))


def integral(layers: Tensor) -> Tensor:
    """Sum (B, H, W, L) over all cells before each one, along both dimensions."""
    return layers.cumsum(1).cumsum(2)


def describe(
    sums: Float[Tensor, "B H+1 W+1 7"], level: Float[Tensor, "B"], place: Int[Tensor, "n"], resolution: float
) -> Context:
    """Return the squares around cells, numbered in the flat maps."""
    H, W = (size - 1 for size in sums.shape[1:3])
    robot, i, j = place // (H * W), place // W % H, place % W
    flat, described = sums.flatten(0, 2), []
    for radius in RADII:
        cells = max(1, round(radius / resolution))
        rows = [((i + k).clamp(0, H) + robot * (H + 1)) * (W + 1) for k in (-cells, cells + 1)]
        columns = [(j + k).clamp(0, W) for k in (-cells, cells + 1)]
        (a, b), (c, d) = ([flat.index_select(0, row + column) for column in columns] for row in rows)
        known, bounded, pairs, steps, *powers = (d - c - b + a).unbind(1)
        count = known.clamp(min=1)
        mean, square, cube = (power / count for power in powers)
        variance = (square - mean.square()).clamp(min=0)
        third = cube - 3 * mean * variance - mean**3
        area = (2 * cells + 1) ** 2
        spread = (variance + SMALLEST_STD**2).sqrt()
        absolute = torch.where(known > 0, level.index_select(0, robot) + mean, 0.0)
        values = known / area, bounded / area, steps / pairs.clamp(min=1), absolute, spread - SMALLEST_STD
        described.append((*values, third / spread**3))
    return Context(*(torch.stack(values) for values in zip(*described, strict=True)))
