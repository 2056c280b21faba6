"""A site on Icechunk with as little around it as possible, for `site_engines`: arrays and codecs are today's."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from datetime import datetime, timezone
from pathlib import Path
from threading import Lock
from typing import Any

import icechunk
import numpy as np
import zarr
from google_crc32c import value as checksum
from numcodecs.blosc import Blosc
from numpy.typing import ArrayLike, NDArray
from zarr.api import asynchronous
from zarr.codecs import BloscCodec, Crc32cCodec
from zarr.core.buffer import default_buffer_prototype

from benchmarks.speed.site.site_windows import RESOLUTION
from torchelev.site import SiteMap
from torchelev.site.shared.ranks import Ranks
from torchelev.site.storage.site_header import CELLS, new_header
from torchelev.site.storage.store import TileStore
from torchelev.site.storage.tile_files import Tile, as_tiles
from torchelev.site.storage.transaction import lock_folder
from torchelev.site.storage.zarr_files import TILES_PER_AXIS
from torchelev.site.tiles import LAYERS, TILE

_HALF, _CRC = TILES_PER_AXIS // 2, 4  # [tiles], [bytes]
_SHAPE = (len(LAYERS), TILE, TILE)
_PROTOTYPE = default_buffer_prototype()
_BLOSC = Blosc(cname="lz4", clevel=5, shuffle=Blosc.SHUFFLE)
# One request for a chunk: by default, Icechunk splits those of local files into five, which takes 1.4 times as long.
_ONE_REQUEST = icechunk.StorageConcurrencySettings(
    max_concurrent_requests_for_object=1, ideal_concurrent_request_size=1 << 24
)
_CONFIG = icechunk.RepositoryConfig(storage=icechunk.StorageSettings(concurrency=_ONE_REQUEST))

icechunk.set_logs_filter("error")  # it warns of several writers of local files, which the lock excludes


class IcechunkStore(TileStore):
    """The tiles of a `TileStore` in an Icechunk repository: a chunk for each tile, and a snapshot for each commit.

    The attributes of a commit are the snapshot's metadata: those of a group would let no two writers rebase. As today,
    a file keeps a second writer away: Icechunk loses commits of several writers of local files.

    Args:
        path: a folder; a repository is made in it if there is none.
        read_only: take no lock.
        raw: encode chunks here and store their bytes; otherwise zarr-python does.
    """

    def __init__(self, path: Path, *, read_only: bool = False, raw: bool = False) -> None:
        path.mkdir(exist_ok=True)
        self.path, self._put, self._get = path, *((_put_bytes, _get_bytes) if raw else (_put_tiles, _get_tiles))
        self._lock, self._committing, self.is_closed = None if read_only else lock_folder(path), Lock(), False
        self._thread = ThreadPoolExecutor(1)
        storage = icechunk.local_filesystem_storage(str(path / "repository"))
        exists = icechunk.Repository.exists(storage)
        self._repository = icechunk.Repository.open(storage, _CONFIG) if exists else _create(storage)
        self.refresh()

    def refresh(self) -> None:
        """Go to the newest snapshot."""
        self._session = self._repository.readonly_session("main")
        snapshot = next(iter(self._repository.ancestry(snapshot_id=self._session.snapshot_id)))
        self._header = new_header(LAYERS, TILE, snapshot.metadata)
        self._tiles = asyncio.run(_list_tiles(self._session))

    def read(self, tiles: Sequence[Tile] | NDArray) -> NDArray[np.float32]:
        """Read tiles (n, L, T, T) of the snapshot."""
        return asyncio.run(self._get(self._session.store, as_tiles(tiles)))

    @contextmanager
    def transaction(
        self, attributes: Mapping[str, Any], arrays: Mapping[str, Any] | None = None
    ) -> Iterator[Callable[[Sequence[Tile] | NDArray, ArrayLike], None]]:
        """Commit what the function that is yielded gets; a thread writes while the block goes on."""
        assert not arrays, "keyframes are not measured"
        session, header = self._repository.writable_session("main"), self._header.with_attributes(attributes)
        writes: list[Future[None]] = []
        written: set[Tile] = set()

        def write(tiles: Sequence[Tile] | NDArray, values: ArrayLike) -> None:
            pairs, cells = self._check(tiles, values)
            writes.append(self._thread.submit(asyncio.run, self._put(session.store, pairs, cells)))
            written.update(pairs)

        with self._committing:
            yield write
            for each in writes:
                each.result()
            snapshot = session.commit(f"{len(written)} tiles", metadata=dict(attributes))
            self._session = self._repository.readonly_session(snapshot_id=snapshot)
            self._header, self._tiles = header, self._tiles.union(written)

    def compact(self) -> None:
        """Keep the newest snapshot alone."""
        now = datetime.now(timezone.utc)
        self._repository.expire_snapshots(now)
        self._repository.garbage_collect(now)


class IcechunkSite(SiteMap):
    """A site whose store is an `IcechunkStore`."""

    def __init__(self, path: Path, *, raw: bool) -> None:
        self._ranks = Ranks(None)
        self._set_up(RESOLUTION, path, None)
        self._store, self._keyframes = IcechunkStore(path, raw=raw), None
        self._begin("cpu")


def _create(storage: Any) -> Any:
    repository = icechunk.Repository.create(storage, _CONFIG)
    session = repository.writable_session("main")
    cells, codecs = TILES_PER_AXIS * TILE, [BloscCodec(cname="lz4", clevel=5, shuffle="shuffle"), Crc32cCodec()]
    zarr.create_array(
        session.store,
        name=CELLS,
        shape=(len(LAYERS), cells, cells),
        chunks=_SHAPE,
        dtype="float32",
        fill_value=np.nan,
        compressors=codecs,
        config={"write_empty_chunks": True},  # as today
    )
    session.commit("new", metadata={"resolution": RESOLUTION})
    return repository


async def _list_tiles(session: Any) -> frozenset[Tile]:
    return frozenset([(x - _HALF, y - _HALF) async for _, x, y in session.chunk_coordinates(f"/{CELLS}")])


async def _put_tiles(store: Any, tiles: list[Tile], values: NDArray) -> None:
    array = await asynchronous.open_array(store=store, path=CELLS, config={"write_empty_chunks": True})
    await asyncio.gather(*(array.setitem(_slices(tile), value) for tile, value in zip(tiles, values, strict=True)))


async def _get_tiles(store: Any, tiles: list[Tile]) -> NDArray[np.float32]:
    array = await asynchronous.open_array(store=store, path=CELLS, mode="r")
    return np.stack(await asyncio.gather(*(array.getitem(_slices(tile)) for tile in tiles)))


async def _put_bytes(store: Any, tiles: list[Tile], values: NDArray) -> None:
    chunks = (_PROTOTYPE.buffer.from_bytes(_encode(value)) for value in values)
    await asyncio.gather(*(store.set(_key(tile), chunk) for tile, chunk in zip(tiles, chunks, strict=True)))


async def _get_bytes(store: Any, tiles: list[Tile]) -> NDArray[np.float32]:
    chunks = await asyncio.gather(*(store.get(_key(tile), _PROTOTYPE) for tile in tiles))
    return np.stack([_decode(chunk) for chunk in chunks])


def _encode(values: NDArray) -> bytes:
    encoded = _BLOSC.encode(values)
    return encoded + checksum(encoded).to_bytes(_CRC, "little")


def _decode(chunk: Any) -> NDArray[np.float32]:
    if chunk is None:
        return np.full(_SHAPE, np.nan, np.float32)
    stored = chunk.to_bytes()
    if checksum(stored[:-_CRC]) != int.from_bytes(stored[-_CRC:], "little"):
        raise ValueError("a chunk is damaged")
    return np.frombuffer(_BLOSC.decode(stored[:-_CRC]), np.float32).reshape(_SHAPE)


def _key(tile: Tile) -> str:
    return f"{CELLS}/c/0/{tile[0] + _HALF}/{tile[1] + _HALF}"


def _slices(tile: Tile) -> tuple[slice, ...]:
    x, y = ((index + _HALF) * TILE for index in tile)
    return slice(None), slice(x, x + TILE), slice(y, y + TILE)
