"""Tiles as chunks of a Zarr array, encoded and decoded here: by zarr-python, a commit takes three times as long."""

from __future__ import annotations

import asyncio
from typing import Any

import numpy as np
from numpy.typing import NDArray

from torchelev.site.storage.interface import Tile
from torchelev.site.storage.site_header import CELLS, Header
from torchelev.site.storage.zarr_files import TILES_PER_AXIS, damaged

_HALF, _CRC = TILES_PER_AXIS // 2, 4  # [tiles], [bytes]


def create_cells(store: Any, header: Header) -> None:
    """Make the group and its array of all cells, (L, N, N) float32, a chunk for each tile."""
    import zarr

    attributes = header.with_attributes({}).metadata()["attributes"]
    zarr.create_group(store, attributes=attributes)
    size = TILES_PER_AXIS * header.tile_size
    zarr.create_array(
        store,
        name=CELLS,
        shape=(len(header.layers), size, size),
        chunks=header.tile_shape,
        dtype="float32",
        fill_value=np.nan,
        compressors=codecs(),
        dimension_names=["layer", "x", "y"],
    )


def codecs() -> list[Any]:
    """Return the codecs of all arrays, which `zarr_files` writes down for files."""
    from zarr.codecs import BloscCodec, Crc32cCodec

    return [BloscCodec(cname="lz4", clevel=5, shuffle="shuffle"), Crc32cCodec()]


def read_attributes(store: Any) -> dict[str, Any]:
    """Return the attributes of the group, which do not change."""
    import zarr

    return dict(zarr.open_group(store, mode="r").attrs)


async def list_tiles(session: Any) -> frozenset[Tile]:
    """Return all tiles that are stored."""
    return frozenset([(x - _HALF, y - _HALF) async for _, x, y in session.chunk_coordinates(f"/{CELLS}")])


async def put(store: Any, tiles: list[Tile], values: NDArray[np.float32]) -> None:
    """Write tiles (n, L, T, T)."""
    from zarr.core.buffer import default_buffer_prototype

    make = default_buffer_prototype().buffer.from_bytes
    pairs = zip(tiles, values, strict=True)
    await asyncio.gather(*(store.set(_key(tile), make(_encode(value))) for tile, value in pairs))


async def get(store: Any, tiles: list[Tile], shape: tuple[int, ...]) -> NDArray[np.float32]:
    """Read tiles (n, L, T, T), NaN where nothing is stored; ValueError names a damaged one."""
    from zarr.core.buffer import default_buffer_prototype

    prototype = default_buffer_prototype()
    values = np.full((len(tiles), *shape), np.nan, np.float32)
    chunks = await asyncio.gather(*(store.get(_key(tile), prototype) for tile in tiles))
    for value, tile, chunk in zip(values, tiles, chunks, strict=True):
        if chunk is not None:
            value[...] = _decode(chunk.to_bytes(), tile, shape)
    return values


def _encode(values: NDArray[np.float32]) -> bytes:
    from google_crc32c import value as checksum
    from numcodecs.blosc import Blosc

    encoded = Blosc(cname="lz4", clevel=5, shuffle=Blosc.SHUFFLE).encode(values)
    return bytes(encoded) + checksum(encoded).to_bytes(_CRC, "little")


def _decode(stored: bytes, tile: Tile, shape: tuple[int, ...]) -> NDArray[np.float32]:
    from google_crc32c import value as checksum
    from numcodecs.blosc import Blosc

    if checksum(stored[:-_CRC]) != int.from_bytes(stored[-_CRC:], "little"):
        raise damaged(CELLS, ValueError("its checksum differs"), f"tile {tile}")
    return np.frombuffer(Blosc().decode(stored[:-_CRC]), np.float32).reshape(shape)


def _key(tile: Tile) -> str:
    return f"{CELLS}/c/0/{tile[0] + _HALF}/{tile[1] + _HALF}"
