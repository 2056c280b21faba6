"""The attributes of a site's folder: its format, its layers and its tiles, beside those of the caller."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from torchelev.errors import require, require_count
from torchelev.site.storage.interface import Tile
from torchelev.site.storage.transaction import COMMITTED, LOCK, STAGED, read_newest, stage
from torchelev.site.storage.zarr_files import (
    METADATA,
    TILES_PER_AXIS,
    cells_metadata,
    damaged,
    group_metadata,
    read_metadata,
    write_metadata,
)

FORMAT, VERSION = "torchelev site", 1
CELLS = "cells"
_RULE = "cell k of an axis spans k * resolution to (k + 1) * resolution in metres, and is at index k + origin"
_OWN = ("format", "version", "layers", "tile_size", "origin", "rule")


class Header(NamedTuple):
    """The contents of the folder's `zarr.json`."""

    layers: tuple[str, ...]  #: names of the layers, in the order of the array
    tile_size: int  #: T, cells on the side of a tile
    attributes: dict[str, Any]  #: of the caller

    @property
    def origin(self) -> int:
        """Index of cell 0 in the array, on both axes."""
        return TILES_PER_AXIS // 2 * self.tile_size

    @property
    def tile_shape(self) -> tuple[int, int, int]:
        """(L, T, T)."""
        return len(self.layers), self.tile_size, self.tile_size

    def metadata(self) -> dict[str, Any]:
        """Return the folder's metadata."""
        own = {"format": FORMAT, "version": VERSION, "layers": list(self.layers), "tile_size": self.tile_size}
        return group_metadata({**own, "origin": self.origin, "rule": _RULE, **self.attributes})

    def check_tiles(self, pairs: list[Tile], values: ArrayLike) -> tuple[list[Tile], NDArray[np.float32]]:
        """Return tiles and their (n, L, T, T) values; ValueError if they break a rule."""
        cells = np.ascontiguousarray(values, np.float32)
        require(len(set(pairs)) == len(pairs), "tiles", "must differ", f"{len(pairs)} with repeats", "give each once")
        shape = (len(pairs), *self.tile_shape)
        require(cells.shape == shape, "values", f"expected (n, L, T, T) = {shape}", cells.shape, "stack the tiles")
        return pairs, cells

    def with_attributes(self, attributes: Mapping[str, Any]) -> Header:
        """Return a header with other attributes of the caller; ValueError if the header has one of their names."""
        taken = sorted(set(attributes) & set(_OWN))
        require(not taken, "attributes", f"must not be named {', '.join(_OWN)}", ", ".join(taken), "rename them")
        return self._replace(attributes=dict(attributes))


def new_header(layers: Sequence[str], tile_size: int, attributes: Mapping[str, Any]) -> Header:
    """Return the header of a new site."""
    are_names = len(layers) > 0 and all(isinstance(name, str) for name in layers) and not isinstance(layers, str)
    require(are_names, "layers", "must be names of one or more layers", repr(layers), 'give ("elevation",), say')
    require(len(set(layers)) == len(layers), "layers", "must differ", repr(layers), "name each once")
    return Header(tuple(layers), require_count("tile_size", tile_size, "give 64, say"), {}).with_attributes(attributes)


def require_empty(path: Path) -> None:
    """Raise ValueError unless a site can be made here; leftovers of a killed process do not count."""
    if not os.path.lexists(path):
        return
    require(path.is_dir(), str(path), "must be a folder", "a file", "choose another path")
    require(not is_site(path), str(path), "must be empty", "a site", "open it with SiteMap.open")
    names = sorted(set(os.listdir(path)) - {LOCK, STAGED})
    require(not names, str(path), "must be an empty folder", f"one with {', '.join(names[:5])}", "choose another path")


def make_site(path: Path, header: Header) -> None:
    """Commit the metadata of a new site in a folder that this process has locked."""
    require_empty(path)  # another process may just have made one
    with stage(path) as folder:
        write_metadata(folder / CELLS / METADATA, cells_metadata(*header.tile_shape[:2]))
        write_metadata(folder / METADATA, header.metadata())


def is_site(path: Path) -> bool:
    """Return whether a folder holds a site, or something else in Zarr 3."""
    return (path / METADATA).exists() or (path / COMMITTED / METADATA).exists()


def read_header(path: Path) -> Header:
    """Read the header as of the last commit.

    Raises:
        FileNotFoundError: there is no such folder.
        ValueError: it is not a site, one of a newer version, or its metadata are damaged.
    """
    hint = "give the folder of a site; SiteMap(resolution=..., path=...) makes one"
    require(os.path.lexists(path), str(path), "must be a folder", "a path where nothing is", hint, FileNotFoundError)
    require(path.is_dir(), str(path), "must be a folder", "a file", hint)
    require(is_site(path), str(path), "must be a site", f"a folder without {METADATA}", hint)
    attributes = read_newest(path, lambda folder: read_metadata(folder / METADATA))["attributes"]
    return parse_header(path, attributes)


def read_cells_metadata(path: Path, header: Header) -> dict[str, Any]:
    """Return the metadata of the array of cells; ValueError if they are missing, damaged, or of other tiles."""
    file = path / CELLS / METADATA
    try:
        metadata = read_newest(path, lambda folder: read_metadata(folder / CELLS / METADATA))
    except FileNotFoundError as error:
        raise damaged(file, error) from error
    expected = cells_metadata(*header.tile_shape[:2])
    for name in ("node_type", "shape", "data_type", "chunk_grid", "chunk_key_encoding"):
        if metadata.get(name) != expected[name]:
            raise damaged(file, ValueError(f"{name}: expected {expected[name]}, got {metadata.get(name)}"))
    return metadata


def parse_header(path: Path | str, attributes: dict[str, Any]) -> Header:
    """Return the header that a group's attributes hold; ValueError as of `read_header`."""
    actual = f"Zarr of another format: {attributes.get('format', 'unnamed')}"
    require(attributes.get("format") == FORMAT, str(path), "must be a site", actual, "read it with zarr")
    version = attributes.get("version")
    is_known = isinstance(version, int) and 1 <= version <= VERSION
    require(is_known, str(path), f"must be of format version 1 to {VERSION}", version, "read it with a newer torchelev")
    try:
        own = new_header(tuple(attributes["layers"]), attributes["tile_size"], {})
    except (KeyError, TypeError, ValueError) as error:
        raise damaged(f"{path}/{METADATA}", error) from error
    return own._replace(attributes={name: value for name, value in attributes.items() if name not in _OWN})
