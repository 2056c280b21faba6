"""What the windows of one rank measured on the tiles of one rank: the rank's own, and those that were sent."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.site.content.tiles import CELLS
from torchelev.site.fusion.entries import Offers
from torchelev.site.fusion.fuse import Entries, Heights
from torchelev.site.fusion.merge import read_bounds
from torchelev.site.fusion.pieces import Pieces
from torchelev.site.fusion.windows import Alignment, Windows
from torchelev.site.shared.messages import Shape

if TYPE_CHECKING:
    from jaxtyping import Float, Int


class Evidence(NamedTuple):
    """What windows measured on a group of tiles."""

    entries: Entries  #: heights
    place: Int[Tensor, "k"]  #: of them in the flat windows of all ranks
    bounded: Int[Tensor, "u"]  #: cells that have an upper bound
    bound: Float[Tensor, "u"]  #: [m] in the site's frame


class Chosen(NamedTuple):
    """The cells of windows on some tiles that are new, and those that have an upper bound."""

    tiles: Int[Tensor, "n 2"]  #: in ascending order
    cell: Int[Tensor, "K"]  #: number of the tile * CELLS + number of the cell, by tiles
    place: Int[Tensor, "K"]  #: in the flat windows
    bounded: Int[Tensor, "U"]  #: as `cell`
    bound_place: Int[Tensor, "U"]  #: as `place`


def choose_cells(windows: Windows, pieces: Pieces) -> Chosen:
    """Return the cells of pieces that are new or have an upper bound."""
    tiles = torch.tensor(pieces.tiles, dtype=torch.int64, device=pieces.cell.device).view(-1, 2)
    return Chosen(tiles, *pieces.find(windows.is_new), *pieces.find(windows.is_bounded))


class OwnPart(NamedTuple):
    """What a rank's windows measured on its own tiles, which is read from them group by group."""

    chosen: Chosen  #: cells on its tiles
    windows: Windows  #: of its robots
    alignment: Alignment  #: of these
    offers: Offers  #: of these
    first: int  #: place of the rank's first cell in the flat windows of all ranks
    resolution: float  #: [m]

    def at(self, group: Int[Tensor, "g 2"]) -> Evidence:
        """Return what it measured on a group of tiles."""
        chosen = self.chosen
        cell, part = cut_cells(chosen.tiles, chosen.cell, group)
        bounded, bound_part = cut_cells(chosen.tiles, chosen.bounded, group)
        place = chosen.place[part]
        bound = read_bounds(self.windows, self.alignment, chosen.bound_place[bound_part], self.resolution)
        return Evidence(self.offers.at(cell, place), place + self.first, bounded, bound)


class SentPart(NamedTuple):
    """What another rank's windows measured on tiles.

    24 bytes for each cell that is new, 36 once a robot has contributed.
    """

    tiles: Int[Tensor, "n 2"]  #: in ascending order
    cell: Int[Tensor, "K"]  #: number of the tile * CELLS + number of the cell, by tiles, int32
    place: Int[Tensor, "K"]  #: in the flat windows of all ranks, int32
    values: Float[Tensor, "v K"]  #: elevation, variance, time, relief, and, if a robot has contributed, these 3 again
    bounded: Int[Tensor, "U"]  #: cells that have an upper bound, by tiles, int32
    bound: Float[Tensor, "U"]  #: [m] in the site's frame

    def at(self, group: Int[Tensor, "g 2"]) -> Evidence:
        """Return what it measured on a group of tiles."""
        cell, part = cut_cells(self.tiles, self.cell, group)
        bounded, bound_part = cut_cells(self.tiles, self.bounded, group)
        values = self.values[:, part]
        contributed = Heights(*values[4:]) if len(values) > 4 else None
        entries = Entries(cell, Heights(*values[:3]), values[3], contributed)
        return Evidence(entries, self.place[part].long(), bounded, self.bound[bound_part])

    @staticmethod
    def shapes(chosen: Chosen, number: int) -> list[Shape]:
        """Return types and shapes of what is sent, of so many values of each cell."""
        n, K, U = len(chosen.tiles), len(chosen.cell), len(chosen.bounded)
        whole, real = torch.int32, torch.float32
        return [
            (torch.int64, (n, 2)), (whole, (K,)), (whole, (K,)), (real, (number, K)), (whole, (U,)), (real, (U,))
        ]  # fmt: skip

    def write(self, chosen: Chosen, own: OwnPart) -> None:
        """Write what windows measured on chosen cells into this part."""
        self.tiles.copy_(chosen.tiles)
        self.cell.copy_(chosen.cell)
        self.place.copy_(chosen.place).add_(own.first)
        offers = own.offers
        for row, layer in zip(self.values, (*offers.heights, offers.relief, *(offers.contributed or ())), strict=True):
            torch.index_select(layer, 0, chosen.place, out=row)
        self.bounded.copy_(chosen.bounded)
        self.bound.copy_(read_bounds(own.windows, own.alignment, chosen.bound_place, own.resolution))


def cut_cells(tiles: Int[Tensor, "n 2"], cell: Tensor, group: Int[Tensor, "g 2"]) -> tuple[Int[Tensor, "k"], slice]:
    """Return the cells of a group of tiles, numbered in it, and where they are among all, in the order of tiles."""
    a, b = (tiles[:, None] == group).all(2).nonzero().unbind(1)  # both ascend: tiles of a group lie together
    if not len(a):
        return a, slice(0, 0)
    ends = (CELLS * torch.stack([a[0], a[-1] + 1])).to(cell.dtype)
    first, last = torch.searchsorted(cell, ends).tolist()
    part = cell[first:last].long()
    shift = CELLS * (b - a)
    if (shift == shift[0]).all():
        return part + shift[0], slice(first, last)
    return part + shift.index_select(0, part // CELLS - a[0]), slice(first, last)


def join_entries(parts: list[Entries]) -> Entries:
    """Return entries one after another, of which some may have earlier contributions."""
    parts = [part for part in parts if len(part.cell)] or parts[:1]
    if len(parts) == 1:
        return parts[0]
    contributed = None
    if any(part.contributed is not None for part in parts):
        each = [part.contributed or Heights(*[torch.full_like(part.relief, torch.nan)] * 3) for part in parts]
        contributed = Heights(*(torch.cat(column) for column in zip(*each, strict=True)))
    heights = Heights(*(torch.cat(column) for column in zip(*(part.heights for part in parts), strict=True)))
    return Entries(torch.cat([p.cell for p in parts]), heights, torch.cat([p.relief for p in parts]), contributed)
