"""Square tiles of cells: where a cell of the lattice lies in them, and which of them are in memory."""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Callable, Collection, Iterator, Sequence
from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from torchelev.site.content.channels import SiteChannels
from torchelev.site.content.levels import SiteLevels

if TYPE_CHECKING:
    from jaxtyping import Float, Int

TILE = 64  # cells of a tile along x and y
_SHIFT, _WITHIN = 6, TILE - 1
CELLS, CELL_BITS = TILE * TILE, 2 * _SHIFT
_GROUP = 32  # tiles that are read from disk at a time: reading takes several times their size
_MAX_TABLE = 1 << 22  # tiles of the box around all cells, up to which a table finds their numbers
# Heights [m], variances [m^2] right after the last measurement, and its time on the site's clock [s].
LAYERS = ("elevation", "variance", "time", "upper_bound", "other_elevation", "other_variance", "other_time")

Tile = tuple[int, int]


class Storage(Protocol):
    """The storage of the tiles that are not in memory."""

    @property
    def tiles(self) -> Collection[Tile]:
        """The tiles that it has."""

    def read(self, tiles: Sequence[Tile]) -> NDArray[np.float32]:
        """Return tiles (n, L, TILE, TILE)."""


class Located(NamedTuple):
    """The places of K cells in a list of tiles."""

    tiles: list[Tile]  #: all different
    place: Int[Tensor, "K"]  #: number of the tile * CELLS + number of the cell in it


def locate(x: Int[Tensor, "K"], y: Int[Tensor, "K"]) -> Located:
    """Return the tiles that hold cells of the lattice, in ascending order, and where in them."""
    tiles, number = locate_tiles(x >> _SHIFT, y >> _SHIFT)
    return Located(tiles, number * CELLS + ((x & _WITHIN) << _SHIFT) + (y & _WITHIN))


def locate_tiles(x: Int[Tensor, "K"], y: Int[Tensor, "K"]) -> tuple[list[Tile], Int[Tensor, "K"]]:
    """Return the different tiles among those with numbers x, y, in ascending order, and each one's place there."""
    if not len(x):
        return [], x
    low_x, low_y = int(x.min()), int(y.min())
    columns = int(y.max()) - low_y + 1
    flat = (x - low_x) * columns + (y - low_y)
    found, number = _number(flat, (int(x.max()) - low_x + 1) * columns)
    tiles = zip((found // columns + low_x).tolist(), (found % columns + low_y).tolist(), strict=True)
    return list(tiles), number


def _number(flat: Tensor, size: int) -> tuple[Tensor, Tensor]:
    """Return the different values of `flat`, which are below `size`, and each element's place among them."""
    if size > _MAX_TABLE:
        return torch.unique(flat, return_inverse=True)
    is_used = torch.zeros(size, dtype=torch.bool, device=flat.device)
    is_used[flat] = True
    return is_used.nonzero()[:, 0], (is_used.cumsum(0) - 1)[flat]


class Tiles:
    """The tiles in memory: with a storage, those used last; without, all.

    Args:
        storage: where all tiles are; None: in memory alone.
        capacity: how many stay in memory if there is a storage.
        device: that holds them.
        channels: of the site; None: there are none.
        levels: of the site; None: there are none.

    Attributes:
        channels: of the site.
        levels: of the site.
        layers: names of the L layers: `LAYERS`, and those of channels and levels.
    """

    def __init__(
        self,
        storage: Storage | None,
        capacity: int,
        device: torch.device | str,
        channels: SiteChannels | None = None,
        levels: SiteLevels | None = None,
    ) -> None:
        self.channels = SiteChannels(None, LAYERS) if channels is None else channels
        self.levels = SiteLevels(None) if levels is None else levels
        self.layers = (*LAYERS, *self.channels.stored, *self.levels.stored)
        self._storage, self._capacity = storage, capacity
        self._slots: OrderedDict[Tile, int] = OrderedDict()
        self._free: list[int] = []
        with torch.inference_mode(False):  # written by reading, in inference mode and outside of it, and by merging
            self.values = torch.empty(len(self.layers), 0, TILE, TILE, device=device)

    @property
    def device(self) -> torch.device:
        """The device of the tiles."""
        return self.values.device

    def __len__(self) -> int:
        return len(self._stored)

    def __contains__(self, tile: Tile) -> bool:
        return tile in self._stored

    def __iter__(self) -> Iterator[Tile]:
        return iter(sorted(self._stored))

    @property
    def _stored(self) -> Collection[Tile]:
        return self._slots if self._storage is None else self._storage.tiles

    def read(self, tiles: Sequence[Tile]) -> Float[Tensor, "L n T T"]:
        """Return copies of tiles, NaN where unknown."""
        if not any(tile in self for tile in tiles):
            return self.values.new_full((len(self.layers), len(tiles), TILE, TILE), torch.nan)
        slots = self._fetch(tiles)  # before `values`, which it may replace
        return self.values.index_select(1, slots)

    def reserve(self, number: int) -> None:
        """Make room for so many more tiles at once."""
        self._make_room(number if self._storage is None else min(number, self._capacity), 0)

    def look_up(self, located: Located, layers: Sequence[str]) -> Float[Tensor, "l K"]:
        """Return layers of cells, NaN where unknown."""
        values = self.values.new_full((len(layers), len(located.place)), torch.nan)
        rows = [self.layers.index(layer) for layer in layers]
        stored = [k for k, tile in enumerate(located.tiles) if tile in self]
        step = len(stored) if self._storage is None else self._capacity
        for start in range(0, len(stored), max(step, 1)):
            chosen = stored[start : start + step]
            slots = torch.full((len(located.tiles),), -1, dtype=torch.int64, device=self.device)
            slots[chosen] = self._fetch([located.tiles[k] for k in chosen])
            slot = slots[located.place // CELLS]
            is_here = slot >= 0
            place = slot.clamp(min=0) * CELLS + located.place % CELLS
            for row, value in zip(rows, values, strict=True):
                value.copy_(torch.where(is_here, self.values[row].view(-1)[place], value))
        return values

    def write(self, tiles: Sequence[Tile], values: Float[Tensor, "L n T T"]) -> None:
        """Replace tiles in memory. Those of a storage must be there before."""
        slots = self._fetch(tiles, overwritten=True)
        self.values.index_copy_(1, slots, values)

    def forget(self, chosen: Callable[[list[Tile]], list[bool]] | None = None) -> None:
        """Drop the tiles that the storage has: those chosen among them, or all."""
        if self._storage is not None:
            tiles = list(self._slots)
            for tile, is_chosen in zip(tiles, [True] * len(tiles) if chosen is None else chosen(tiles), strict=True):
                if is_chosen:
                    self._free.append(self._slots.pop(tile))

    def _fetch(self, tiles: Sequence[Tile], overwritten: bool = False) -> Int[Tensor, "n"]:
        """Bring tiles into memory, and return their slots."""
        absent = [tile for tile in tiles if tile not in self._slots]
        for tile in tiles:
            if tile in self._slots:
                self._slots.move_to_end(tile)
        if absent:
            self._make_room(len(absent), len(tiles))
            slots = self._free[-len(absent) :]
            if not overwritten:  # first, as reading may fail
                for start in range(0, len(absent), _GROUP):
                    some = slice(start, start + _GROUP)
                    self.values[:, slots[some]] = self._load(absent[some])
            del self._free[-len(absent) :]
            self._slots.update(zip(absent, slots, strict=True))
        return torch.tensor([self._slots[tile] for tile in tiles], dtype=torch.int64, device=self.device)

    def _load(self, tiles: list[Tile]) -> Tensor:
        if self._storage is None or not any(tile in self._storage.tiles for tile in tiles):
            return self.values.new_full((len(self.layers), len(tiles), TILE, TILE), torch.nan)
        return torch.from_numpy(self._storage.read(tiles)).to(self.device).transpose(0, 1)

    def _make_room(self, needed: int, used: int) -> None:
        """Free slots: of the tiles not used for longest, or by growing."""
        if self._storage is not None:
            kept = max(self._capacity, used)
            for _ in range(min(needed - len(self._free), len(self._slots) + needed - kept)):
                self._free.append(self._slots.popitem(last=False)[1])
        short = needed - len(self._free)
        if short > 0:
            old, most = self.values, math.inf if self._storage is None else self._capacity
            size = max(old.shape[1] + short, int(min(2 * old.shape[1], most)))
            with torch.inference_mode(False):
                self.values = torch.empty(len(self.layers), size, TILE, TILE, device=old.device)
            self.values[:, : old.shape[1]] = old
            self._free += range(old.shape[1], size)
