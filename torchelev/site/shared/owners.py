"""Which rank fuses a tile: each owns a stretch of a curve through all tiles."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

if TYPE_CHECKING:
    from jaxtyping import Int

_BITS = 30  # of a tile's number along x and y; tiles farther away begin again


def number_along_curve(x: Int[Tensor, "K"], y: Int[Tensor, "K"]) -> Int[Tensor, "K"]:
    """Return the numbers of tiles x, y along a Hilbert curve, on which neighbours are neighbours in the plane, too."""
    side = 1 << _BITS
    x, y = ((value + side // 2) & (side - 1) for value in (x, y))
    number = torch.zeros_like(x)
    for bit in reversed(range(_BITS)):
        high_x, high_y = (x >> bit) & 1, (y >> bit) & 1
        number = (number << 2) + ((3 * high_x) ^ high_y)
        flipped = (high_x & (1 - high_y)) * (side - 1)
        x, y = x ^ flipped, y ^ flipped
        x, y = torch.where(high_y == 0, y, x), torch.where(high_y == 0, x, y)
    return number


def split_curve(numbers: Int[Tensor, "N"], size: int) -> Int[Tensor, "R1"]:
    """Return where the stretches of ranks 1 to `size` - 1 begin, so that as many of these numbers lie in each."""
    ordered = numbers.sort().values
    return ordered[[len(ordered) * rank // size for rank in range(1, size)]]


def find_owners(numbers: Int[Tensor, "K"], begins: Int[Tensor, "R1"]) -> Int[Tensor, "K"]:
    """Return the ranks that own tiles, by their numbers along the curve."""
    return torch.searchsorted(begins, numbers, right=True)
