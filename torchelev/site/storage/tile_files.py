"""The array of all cells of a site, of which each tile is one file."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchelev.errors import require
from torchelev.site.storage.interface import Tile
from torchelev.site.storage.site_header import CELLS, Header, read_cells_metadata
from torchelev.site.storage.transaction import COMMITTED, STAGED
from torchelev.site.storage.zarr_files import TILES_PER_AXIS, damaged, is_missing, open_array

_HALF = TILES_PER_AXIS // 2
_CHUNKS = Path(CELLS, "c", "0")  # in it, one folder per tile along x; all layers are in one file


class TileFiles:
    """Reads and writes the tiles of the folder `path`. Holds no tile in memory."""

    def __init__(self, path: Path, header: Header) -> None:
        self.path, self.size, self.shape = path, header.tile_size, header.tile_shape
        metadata = read_cells_metadata(path, header)
        self._cells = {name: open_array(path / name / CELLS, metadata) for name in (STAGED, COMMITTED, "")}

    def read(self, tiles: Sequence[Tile]) -> NDArray[np.float32]:
        """Return (n, L, T, T) values as of the last commit, NaN where nothing is stored."""
        values = np.full((len(tiles), *self.shape), np.nan, np.float32)
        remaining = list(enumerate(tiles))
        if (self.path / COMMITTED).exists():
            remaining = self._read_from(COMMITTED, remaining, values)
        self._read_from("", remaining, values)  # files move here, and never back
        return values

    def stage(self, tiles: Sequence[Tile], values: NDArray[np.float32]) -> list[Any]:
        """Begin to write (n, L, T, T) values to the folder of staged files; `wait_for` what it returns.

        The values must not change until then.
        """
        options: dict[str, Any] = {"can_reference_source_data_indefinitely": True}  # saves a copy
        pairs = zip(tiles, values, strict=True)
        return [self._view(STAGED, tile).write(value, **options) for tile, value in pairs]

    def list_tiles(self) -> frozenset[Tile]:
        """Return all tiles that are stored."""
        return frozenset(tile for name in (COMMITTED, "") for tile in _list_in(self.path / name / _CHUNKS))

    def _read_from(self, name: str, tiles: list[tuple[int, Tile]], values: NDArray) -> list[tuple[int, Tile]]:
        """Fill in the values that a folder has, and return those that it lacks."""
        missing = []
        reads = [(index, tile, self._view(name, tile).read()) for index, tile in tiles]
        for index, tile, read in reads:
            try:
                values[index] = read.result()
            except ValueError as error:
                if not is_missing(error):
                    raise damaged(self.path / name / _CHUNKS / _name(tile), error, f"tile {tile}") from error
                missing.append((index, tile))
        return missing

    def _view(self, name: str, tile: Tile) -> Any:
        x, y = ((index + _HALF) * self.size for index in tile)
        return self._cells[name][:, x : x + self.size, y : y + self.size]


def as_tiles(tiles: Sequence[Tile] | NDArray) -> list[Tile]:
    """Return n pairs of ints; ValueError for anything else, or beyond the array."""
    pairs = np.asarray(tiles if isinstance(tiles, np.ndarray) else list(tiles))
    if pairs.size == 0:
        return []
    are_pairs = pairs.ndim == 2 and pairs.shape[1] == 2 and pairs.dtype.kind in "iu"
    require(are_pairs, "tiles", "expected n pairs of ints", f"{pairs.shape} {pairs.dtype}", "give [(0, -1)], say")
    is_inside = -_HALF <= pairs.min() and pairs.max() < _HALF
    actual = f"{pairs.min()} to {pairs.max()}"
    rule = f"must be from {-_HALF} to {_HALF - 1}, counted from the map frame's origin"
    require(bool(is_inside), "tiles", rule, actual, "begin another site, whose map frame has its origin nearer")
    return [(int(a), int(b)) for a, b in pairs]


def _name(tile: Tile) -> str:
    return f"{tile[0] + _HALF}/{tile[1] + _HALF}"


def _list_in(folder: Path) -> Iterator[Tile]:
    for row in _list_numbers(folder):
        for column in _list_numbers(folder / str(row)):
            yield row - _HALF, column - _HALF


def _list_numbers(folder: Path) -> list[int]:
    """Return the names in a folder that are numbers; none if a commit has just moved it."""
    with suppress(FileNotFoundError):
        return [int(name) for name in os.listdir(folder) if name.isdecimal()]
    return []
