"""Windows cut along the tiles' borders, so that a merge works on a few tiles and their windows at a time."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from functools import partial
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.site.content.tiles import CELLS, TILE, Tile, locate_tiles

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

GROUP = 16  # tiles at a time: their intermediate values stay in a CPU's caches


class Pieces(NamedTuple):
    """The parts of windows that lie on a group of tiles, line by line, in the order of tiles and robots."""

    tiles: list[Tile]  #: the group
    cell: Int[Tensor, "K"]  #: number in the group of each cell that windows hold
    place: Int[Tensor, "K"]  #: number of the cell in the flat windows

    def find(self, mask: Bool[Tensor, "B H W"]) -> tuple[Tensor, Tensor]:
        """Return cell number in the group and place in the flat windows of the cells of a mask, (K,) each."""
        chosen = mask.reshape(-1).index_select(0, self.place)
        if chosen.all():
            return self.cell, self.place
        number = chosen.nonzero()[:, 0]
        return self.cell.index_select(0, number), self.place.index_select(0, number)

    def select(self, mask: Bool[Tensor, "B H W"]) -> tuple[Tensor, Tensor, Tensor]:
        """Return robot, cell number in the group and place in the flat windows of the cells of a mask, (K,) each."""
        cell, place = self.find(mask)
        return place // mask[0].numel(), cell, place


class Group(NamedTuple):
    """Some tiles, with a function that cuts the windows on them, which takes a while."""

    tiles: list[Tile]  #: in ascending order
    cut: Callable[[], Pieces]  #: cuts the windows


def group_tiles(corner: Int[Tensor, "B 2"], mask: Bool[Tensor, "B H W"]) -> list[Group]:
    """Return the tiles below windows that hold cells of the mask, in groups."""
    tiles, number, robot = _find_tiles(corner, mask)
    starts = torch.arange(0, len(tiles), GROUP, device=number.device)
    ends = [*torch.searchsorted(number, starts).tolist(), len(number)]
    groups = []
    for k, (start, end) in zip(starts.tolist(), itertools.pairwise(ends), strict=True):
        chosen = tiles[k : k + GROUP]
        cut = partial(_cut, chosen, robot[start:end], number[start:end] - k, corner, mask.shape[1:])
        groups.append(Group(chosen, cut))
    return groups


def cut_windows(
    corner: Int[Tensor, "B 2"], mask: Bool[Tensor, "B H W"], find_owners: Callable[[Tensor, Tensor], Tensor], size: int
) -> Iterator[Pieces]:
    """Yield the pieces of windows on the tiles of each of `size` owners, of tiles that hold cells of the mask."""
    tiles, number, robot = _find_tiles(corner, mask)
    owner = find_owners(*torch.tensor(tiles, dtype=torch.int64, device=number.device).view(-1, 2).unbind(1))
    for rank in range(size):
        own = (owner == rank).nonzero()[:, 0]
        place = torch.full_like(owner, -1).index_copy_(0, own, torch.arange(len(own), device=own.device))
        tile = place.index_select(0, number)
        chosen = (tile >= 0).nonzero()[:, 0]
        its = [tiles[k] for k in own.tolist()]
        yield _cut(its, robot.index_select(0, chosen), tile.index_select(0, chosen), corner, mask.shape[1:])


def _find_tiles(corner: Int[Tensor, "B 2"], mask: Bool[Tensor, "B H W"]) -> tuple[list[Tile], Tensor, Tensor]:
    """Return the tiles that hold cells of the mask, and the pieces of windows on them, in their order: tile, robot."""
    first, lines = corner // TILE, mask.float()  # bytes take ten times as long
    rows, columns = _touched(corner[:, 0], lines.amax(2)), _touched(corner[:, 1], lines.amax(1))
    robot, i, j = (rows[:, :, None] & columns[:, None, :]).nonzero().unbind(1)
    tiles, number = locate_tiles(first[robot, 0] + i, first[robot, 1] + j)
    order = torch.argsort(number, stable=True)
    return tiles, number[order], robot[order]


def _touched(corner: Int[Tensor, "B"], lines: Float[Tensor, "B size"]) -> Bool[Tensor, "B t"]:
    """Return which of the tiles that a window spans along one axis hold lines that are not zero."""
    size = lines.shape[1]
    tile = ((corner % TILE)[:, None] + torch.arange(size, device=corner.device)) // TILE
    return lines.new_zeros(len(corner), size // TILE + 2).scatter_add_(1, tile, lines) > 0


def _cut(tiles: list[Tile], robot: Tensor, tile: Tensor, corner: Tensor, size: tuple[int, ...]) -> Pieces:
    origin = torch.tensor(tiles, dtype=torch.int64, device=corner.device).view(-1, 2).index_select(
        0, tile
    ) * TILE - corner.index_select(0, robot)
    last = torch.minimum(origin + TILE, torch.tensor(size, device=corner.device))
    first = origin.clamp(min=0)
    height, width = (last - first).unbind(1)
    # Lines of cells: where they begin in the windows and in the tiles.
    piece, number = _enumerate(height)
    i, j = first[:, 0].index_select(0, piece) + number, first[:, 1].index_select(0, piece)
    place = (robot.index_select(0, piece) * size[0] + i) * size[1] + j
    at_i, at_j = (torch.stack([i, j]) - origin.index_select(0, piece).T).unbind(0)
    cell = tile.index_select(0, piece) * CELLS + at_i * TILE + at_j
    length = width.index_select(0, piece)
    begin = length.cumsum(0) - length
    number = torch.arange(int(length.sum()), device=length.device)
    lines = (
        torch.repeat_interleave(start - begin, length, output_size=len(number)).add_(number) for start in (cell, place)
    )
    return Pieces(tiles, *lines)


def _enumerate(counts: Int[Tensor, "P"]) -> tuple[Tensor, Tensor]:
    """Return for each counted item its owner, and its number among that owner's items."""
    whose = torch.repeat_interleave(torch.arange(len(counts), device=counts.device), counts)
    number = torch.arange(len(whose), device=counts.device)
    return whose, number - (counts.cumsum(0) - counts).index_select(0, whose)
