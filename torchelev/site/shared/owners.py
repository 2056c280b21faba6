"""Which rank fuses a tile."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchelev.site.tiles import Tile

if TYPE_CHECKING:
    from jaxtyping import Int

# Numbers of 4 x 4 tiles along a Hilbert curve, [x][y]: neighbours on it have different owners.
_CURVE = ((0, 3, 4, 5), (1, 2, 7, 6), (14, 13, 8, 9), (15, 12, 11, 10))
_FACTORS = -7046029254386353131, -4417276706812531889, -4658895280553007687  # of splitmix64 and murmur3


def find_owners(x: Int[Tensor, "K"], y: Int[Tensor, "K"], size: int) -> Int[Tensor, "K"]:
    """Return the ranks, of `size`, that own the tiles with numbers x, y.

    Tiles of a block of 4 x 4 are dealt out along a curve, so that each rank gets as many of any area. A hash of the
    block says who gets the first one, so that no straight corridor belongs to one rank. Owners never change.
    """
    number = torch.tensor(_CURVE, device=x.device).view(-1).index_select(0, ((x & 3) << 2) + (y & 3))
    mixed = (x >> 2) * _FACTORS[0] + (y >> 2) * _FACTORS[1]
    mixed = (mixed ^ (mixed >> 29)) * _FACTORS[2]
    return (((mixed ^ (mixed >> 32)) & 0x7FFFFFFF) + number) % size


def owners_of(tiles: Sequence[Tile], size: int) -> list[int]:
    """Return the ranks, of `size`, that own tiles."""
    x, y = torch.tensor(list(tiles), dtype=torch.int64).view(-1, 2).unbind(1)
    return find_owners(x, y, size).tolist()
