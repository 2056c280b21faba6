"""Writing the tiles of one commit, and keeping other writers of a folder out meanwhile."""

from __future__ import annotations

import asyncio
import getpass
import hashlib
import tempfile
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, Future
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from filelock import FileLock
from numpy.typing import ArrayLike, NDArray

from torchelev.errors import message
from torchelev.site.storage.interface import Note, Tile
from torchelev.site.storage.site_header import Header
from torchelev.site.storage.tile_files import as_tiles
from torchelev.site.storage.versioned import chunks
from torchelev.site.storage.versioned.history import metadata_of
from torchelev.site.storage.versioned.repository import (
    StoreError,
    configuration,
    errors_in_words,
    import_icechunk,
    open_storage,
)

_GROUPS = ("keyframes", "merges")  # made at the start: two writers that made one each could not both commit
WAIT = 120.0  # [s] for other writers of a folder
_MAX_WRITES = 4  # groups of tiles that are written at a time


@contextmanager
def hold(lock: FileLock, path: str | Path) -> Iterator[None]:
    """Hold the lock of a folder until the end of the block; OSError if another writer has it for two minutes."""
    try:
        lock.acquire()
    except TimeoutError as error:
        rule, hint = f"must become free within {WAIT:g} s", "wait until it has ended"
        raise OSError(message(str(path), rule, "another writer", hint)) from error
    except OSError as error:
        raise StoreError(path, error) from error
    try:
        yield
    finally:
        lock.release()


def making_lock(path: str | Path) -> FileLock:
    """Return the lock under which a user makes a site: outside of its folder, which must be empty until then."""
    name = hashlib.sha256(str(path).encode()).hexdigest()[:16]
    return FileLock(Path(tempfile.gettempdir(), f"torchelev-{getpass.getuser()}-{name}.lock"), timeout=WAIT)


def make_repository(path: str | Path, header: Header) -> None:
    """Make the repository of a new site; StoreError if there is one, or it cannot be written."""
    import zarr

    icechunk, metadata = import_icechunk(), metadata_of(header.attributes, Note("new site"))
    with errors_in_words(path):
        repository = icechunk.Repository.create(open_storage(path), configuration())
        session = repository.writable_session("main")
        chunks.create_cells(session.store, header)
        for name in _GROUPS:
            zarr.create_group(session.store, path=name)
        session.commit("new site", metadata=metadata)


@contextmanager
def write_tiles(
    session: Any, header: Header, written: set[Tile], thread: Executor
) -> Iterator[Callable[[Sequence[Tile] | NDArray, ArrayLike], None]]:
    """Yield a function that writes tiles to a session on another thread; all are written at the end.

    Args:
        session: of Icechunk.
        header: of the site.
        written: takes the tiles.
        thread: that encodes and writes.
    """
    writes: list[Future[None]] = []

    def write(tiles: Sequence[Tile] | NDArray, values: ArrayLike) -> None:
        pairs, cells = header.check_tiles(as_tiles(tiles), values)
        written.update(pairs)
        writes.append(thread.submit(asyncio.run, chunks.put(session.store, pairs, cells)))
        while len(writes) > _MAX_WRITES:  # as their tiles stay in memory
            writes.pop(0).result()

    try:
        yield write
    finally:
        failures = [each.exception() for each in writes]
    for failure in failures:
        if failure is not None:
            raise failure


def differ_in_time_alone(before: Header, after: Header) -> bool:
    """Return whether a header says nothing new but the time and number of a merge."""
    names = {*before.attributes, *after.attributes}
    changed = {name for name in names if before.attributes.get(name) != after.attributes.get(name)}
    return changed <= {"time", "num_commits"}
