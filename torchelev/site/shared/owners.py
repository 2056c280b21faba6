"""Which rank fuses a tile: each owns a stretch of a curve through all tiles."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

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


class Owners(NamedTuple):
    """Stretches of the curve, or of the same with x and y exchanged, each of which belongs to a rank."""

    begins: Int[Tensor, "R1"]  #: of all stretches but the first
    rank: Int[Tensor, "R"]  #: whose they are
    is_exchanged: bool  #: x and y

    def find(self, x: Int[Tensor, "K"], y: Int[Tensor, "K"]) -> Int[Tensor, "K"]:
        """Return the ranks that own tiles x, y."""
        number = number_along_curve(y, x) if self.is_exchanged else number_along_curve(x, y)
        return self.rank.index_select(0, torch.searchsorted(self.begins, number, right=True))


def share_out(windows: Sequence[Int[Tensor, "B 2"]]) -> Owners:
    """Return owners of equally many windows, with as many of their own as possible.

    Args:
        windows: for each rank, the tiles in which the centres of its windows lie.
    """
    tiles, size = torch.cat(list(windows)), len(windows)
    own = torch.repeat_interleave(torch.tensor([len(part) for part in windows], device=tiles.device))
    found = [_split(tiles, own, size, is_exchanged) for is_exchanged in (False, True)]
    return max(found, key=lambda owners: int((owners.find(*tiles.unbind(1)) == own).sum()))


def _split(tiles: Int[Tensor, "N 2"], own: Int[Tensor, "N"], size: int, is_exchanged: bool) -> Owners:
    """Cut the curve into stretches of equally many windows; the one with the most windows of a rank is that rank's."""
    number = number_along_curve(*(tiles.flip(1) if is_exchanged else tiles).unbind(1))
    ordered = number.sort().values
    begins = ordered[[len(ordered) * rank // size for rank in range(1, size)]]
    stretch = torch.searchsorted(begins, number, right=True)
    shared = torch.bincount(stretch * size + own, minlength=size**2).view(size, size)
    rank = torch.zeros(size, dtype=torch.int64, device=tiles.device)
    for _ in range(size):
        place = int(shared.argmax())
        rank[place // size] = place % size
        shared[place // size], shared[:, place % size] = -1, -1
    return Owners(begins, rank, is_exchanged)
