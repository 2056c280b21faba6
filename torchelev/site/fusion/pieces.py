"""Windows cut along the tiles' borders, so that a merge works on a few tiles and their windows at a time."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.site.tiles import CELL_BITS, CELLS, TILE, Tile, locate_tiles

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

_GROUP = 16  # tiles at a time: their intermediate values stay in a CPU's caches


class Pieces(NamedTuple):
    """The parts of windows that lie on a group of tiles."""

    tiles: list[Tile]  #: the group
    robot: Int[Tensor, "P"]  #: whose window it is
    tile: Int[Tensor, "P"]  #: number in `tiles`
    place: Int[Tensor, "P T T"]  #: of each of the tile's cells in the flat windows
    is_inside: Bool[Tensor, "P T T"]  #: the window holds that cell

    def select(self, mask: Bool[Tensor, "B H W"]) -> tuple[Tensor, Tensor, Tensor]:
        """Return robot, cell number in the group and place in the flat windows of the cells of a mask, (K,) each."""
        chosen = (self.is_inside & mask.reshape(-1).take(self.place)).view(-1).nonzero()[:, 0]
        piece = chosen >> CELL_BITS
        cell = (self.tile - torch.arange(len(self.tile), device=chosen.device)).index_select(0, piece) * CELLS + chosen
        return self.robot.index_select(0, piece), cell, self.place.view(-1).index_select(0, chosen)


class Group(NamedTuple):
    """Some tiles, with a function that cuts the windows on them, which takes a while."""

    tiles: list[Tile]  #: in ascending order
    cut: Callable[[], Pieces]  #: cuts the windows


def group_tiles(corner: Int[Tensor, "B 2"], mask: Bool[Tensor, "B H W"]) -> list[Group]:
    """Return the tiles below windows that hold cells of the mask, in groups."""
    first, lines = corner // TILE, mask.float()  # bytes take ten times as long
    rows, columns = _touched(corner[:, 0], lines.amax(2)), _touched(corner[:, 1], lines.amax(1))
    robot, i, j = (rows[:, :, None] & columns[:, None, :]).nonzero().unbind(1)
    tiles, number = locate_tiles(first[robot, 0] + i, first[robot, 1] + j)
    order = torch.argsort(number, stable=True)
    robot, number = robot[order], number[order]
    starts = torch.arange(0, len(tiles), _GROUP, device=number.device)
    ends = [*torch.searchsorted(number, starts).tolist(), len(number)]
    groups = []
    for k, (start, end) in zip(starts.tolist(), itertools.pairwise(ends), strict=True):
        chosen = tiles[k : k + _GROUP]
        cut = partial(_cut, chosen, robot[start:end], number[start:end] - k, corner, mask.shape[1:])
        groups.append(Group(chosen, cut))
    return groups


def _touched(corner: Int[Tensor, "B"], lines: Float[Tensor, "B size"]) -> Bool[Tensor, "B t"]:
    """Return which of the tiles that a window spans along one axis hold lines that are not zero."""
    size = lines.shape[1]
    tile = ((corner % TILE)[:, None] + torch.arange(size, device=corner.device)) // TILE
    return lines.new_zeros(len(corner), size // TILE + 2).scatter_add_(1, tile, lines) > 0


def _cut(tiles: list[Tile], robot: Tensor, tile: Tensor, corner: Tensor, size: tuple[int, ...]) -> Pieces:
    H, W = size
    origin = torch.tensor(tiles, device=corner.device)[tile] * TILE - corner[robot]
    within = torch.arange(TILE, device=corner.device)
    i, j = origin[:, :1] + within, origin[:, 1:] + within
    inside_i, inside_j = (i >= 0) & (i < H), (j >= 0) & (j < W)
    place = (robot[:, None] * H + i.clamp(0, H - 1))[:, :, None] * W + j.clamp(0, W - 1)[:, None]
    return Pieces(tiles, robot, tile, place, inside_i[:, :, None] & inside_j[:, None])
