"""`VersionedStore`: the tiles of a site in an Icechunk repository, whose every commit is a version."""

from __future__ import annotations

import asyncio
import os
import pickle
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, nullcontext
from functools import partial
from pathlib import Path
from threading import RLock
from typing import Any

import numpy as np
from filelock import FileLock
from numpy.typing import ArrayLike, NDArray

from torchelev.errors import require
from torchelev.site.storage.interface import Arrays, Note, Overtaken, Tile, Version
from torchelev.site.storage.named_arrays import require_names
from torchelev.site.storage.shown_version import ShownVersion
from torchelev.site.storage.site_header import Header, new_header, parse_header
from torchelev.site.storage.tile_files import as_tiles
from torchelev.site.storage.transaction import LOCK
from torchelev.site.storage.versioned import arrays as named
from torchelev.site.storage.versioned import chunks, history
from torchelev.site.storage.versioned.commits import commit, find_commit
from torchelev.site.storage.versioned.repository import (
    RefusedCommitError,
    StoreError,
    UncertainCommitError,
    configuration,
    errors_in_words,
    import_icechunk,
    is_repository,
    is_url,
    normalize,
    open_storage,
)
from torchelev.site.storage.versioned.writing import (
    WAIT,
    differ_in_time_alone,
    hold,
    make_repository,
    making_lock,
    write_tiles,
)

_MARK = "history/mark"  # an array that changes where attributes alone do: a commit has to change something


class VersionedStore(ShownVersion):
    """An Icechunk repository of square tiles, for several writers and readers, in a folder or an object store.

    The newest snapshot of the branch `main` is the newest version. Its group holds the array `cells`, (L, N, N) float32
    with a chunk for each tile, and further arrays. Attributes that change from commit to commit are metadata of the
    snapshot, so that writers of other tiles do not contradict each other.

    Local files take one commit at a time: writers of a folder wait for each other in `turn`. In an object store, the
    later of two writers commits on top of the earlier one, unless both have changed a tile: then `Overtaken` is raised.

    Methods may be called from several threads, but not in a forked process.

    Args:
        path: the folder, or s3://bucket/prefix.
        version: id or tag to show; None: the newest.
        read_only: write nothing.
    """

    _open: Any

    engine = "icechunk"

    def __init__(self, path: str | Path, *, version: str | None = None, read_only: bool = False) -> None:
        self.path, self.is_closed, self._pinned = path, False, version
        self._read_only, self._mutex = read_only or version is not None, RLock()
        self._lock = None if is_url(path) else FileLock(Path(path) / LOCK, timeout=WAIT, thread_local=False)
        self._open, self._num_accepted = None, 0  # session of a transaction; how many processes have joined it
        self._thread = ThreadPoolExecutor(1, "torchelev site")
        with errors_in_words(path):
            self._repository = import_icechunk().Repository.open(open_storage(path), configuration())
        self._show(self._newest() if version is None else history.find(self._repository, path, version))

    @classmethod
    def create(
        cls, path: str | Path, *, layers: Sequence[str], tile_size: int, attributes: Mapping[str, Any]
    ) -> VersionedStore:
        """Make a new site, or open the one that another process has just made; arguments as of `TileStore.create`."""
        header, path = new_header(layers, tile_size, attributes), normalize(path)
        if isinstance(path, Path):
            path.mkdir(parents=True, exist_ok=True)
        with hold(making_lock(path), path):
            if not is_repository(path):
                make_repository(path, header)
        return cls(path)

    @classmethod
    def open(cls, path: str | Path, *, read_only: bool = False, version: str | None = None) -> VersionedStore:
        """Open a site that is there.

        Args:
            path: the folder, or s3://bucket/prefix.
            read_only: write nothing.
            version: id or tag of the version to show, read-only; None: the newest.

        Raises:
            FileNotFoundError: there is none.
            KeyError: there is no such version.
            OSError: it cannot be read.
        """
        path = normalize(path)
        hint = "SiteMap(resolution=..., path=...) makes one"
        require(is_repository(path), str(path), "must be a site", "nothing there", hint, FileNotFoundError)
        return cls(path, version=version, read_only=read_only)

    # What it shows ---------------------------------------------------------------------------------------------------

    @property
    def version(self) -> str:
        """Id of the version that it shows."""
        return str(self._session.snapshot_id)

    @property
    def num_bytes(self) -> int:
        """Bytes of all that is stored: of a folder, all files; of an object store, all chunks."""
        if is_url(self.path):
            with errors_in_words(self.path):
                return int(self._repository.chunk_storage_stats().non_virtual_bytes())
        files = (Path(folder, name) for folder, _, names in os.walk(self.path) for name in names)
        return sum(file.stat().st_size for file in files if file.exists())

    @property
    def is_read_only(self) -> bool:
        """Whether it is open read-only, or closed."""
        return self._read_only

    def read(self, tiles: Sequence[Tile] | NDArray) -> NDArray[np.float32]:
        """Read tiles (n, L, T, T), NaN where nothing is stored; ValueError names a damaged one."""
        with errors_in_words(self.path):
            return self._run(chunks.get(self._session.store, as_tiles(tiles), self._header.tile_shape))

    def read_array(self, name: str) -> tuple[NDArray, dict[str, Any]]:
        """Read an array and its attributes; KeyError if there is none of this name."""
        with errors_in_words(self.path):
            return named.read_array(self._session.store, name)

    def array_names(self) -> list[str]:
        """Return the sorted names of all arrays but the cells."""
        with errors_in_words(self.path):
            return named.list_arrays(self._session.store)

    def refresh(self) -> None:
        """Show the newest version, if none was asked for by name."""
        if self._pinned is None:
            newest = self._newest()
            if newest != self.version:
                self._show(newest)

    # Writing ---------------------------------------------------------------------------------------------------------

    @contextmanager
    def turn(self) -> Iterator[bool]:
        """Be the only writer of a folder until the end of the block; yield whether it has found a newer version.

        Raises:
            OSError: another writer has not ended within two minutes.
        """
        with self._alone():
            is_behind = self._newest() != self.version
            if is_behind:
                self.refresh()
            yield is_behind

    @contextmanager
    def _alone(self) -> Iterator[None]:
        """Be the only writer of a folder until the end of the block; in an object store, do nothing."""
        with self._mutex, nullcontext() if self._lock is None else hold(self._lock, self.path):
            yield

    @contextmanager
    def transaction(
        self, attributes: Mapping[str, Any], arrays: Arrays | None = None, note: Note | None = None
    ) -> Iterator[Callable[[Sequence[Tile] | NDArray, ArrayLike], None]]:
        """Commit tiles that come some at a time, all together when the block ends, or none if it raises.

        Args:
            attributes: JSON values, which replace all earlier ones.
            arrays: further arrays and their attributes by name; others stay as they are.
            note: what the history says of it.

        Yields:
            A function of n different pairs and their (n, L, T, T) values, which must not change until the end.

        Raises:
            ValueError: an argument breaks its rule, or the store is open read-only or closed.
            Overtaken: another writer has changed the same tiles since this store was read.
            StoreError: it cannot be written. All that was stored before is unchanged.
            UncertainCommitError: the connection ended during the commit.
        """
        header = self._header.with_attributes(attributes)
        hint = "open it again for writing"
        require(
            not self._read_only, str(self.path), "must be open for writing", "a store that is read-only or closed", hint
        )
        require_names(arrays or {})
        written: set[Tile] = set()
        with self._alone(), errors_in_words(self.path):
            session = self._repository.writable_session("main")
            if str(session.snapshot_id) != self.version:
                raise Overtaken
            self._open, self._num_accepted = session, 0
            with write_tiles(session, header, written, self._thread) as write:
                yield write
            if not (written or arrays or self._num_accepted):
                if differ_in_time_alone(self._header, header):  # a merge of nothing new makes no version
                    time = {"time": header.attributes["time"]} if "time" in header.attributes else {}
                    self._header = self._header.with_attributes(self._header.attributes | time)
                    return
                arrays = {_MARK: (np.array(header.attributes.get("num_commits", 0)), {})}
            for name, (array, own) in (arrays or {}).items():
                named.write_array(session.store, name, array, own)
            self._commit(session, header, written, note or Note(f"{len(written)} tile{'s' * (len(written) != 1)}"))

    def invite(self) -> bytes:
        """Return what lets other processes join the transaction that is open."""
        return pickle.dumps(self._open.fork())

    @contextmanager
    def join_transaction(
        self, invitation: bytes, results: list[bytes]
    ) -> Iterator[Callable[[Sequence[Tile] | NDArray, ArrayLike], None]]:
        """Yield a function that writes tiles into a transaction of another process, as of `SiteStore`."""
        fork, written = pickle.loads(invitation), set[Tile]()  # of a rank of the same program
        with errors_in_words(self.path), write_tiles(fork, self._header, written, self._thread) as write:
            yield write
        if written:
            results.append(pickle.dumps(fork))

    def accept(self, results: Sequence[bytes]) -> None:
        """Take what other processes have written into the transaction that is open."""
        forks = [pickle.loads(result) for result in results if result]
        self._num_accepted = len(forks)
        if forks:
            with errors_in_words(self.path):
                self._open.merge(*forks)

    def _commit(self, session: Any, header: Header, written: set[Tile], note: Note) -> None:
        """Commit a session, and show what it left."""
        key, before = uuid.uuid4().hex, header.attributes
        try:
            make = partial(history.metadata_of, note=note, key=key)
            snapshot, header = commit(self._repository, session, self.path, header, note.message, key, make)
            if header.attributes != before or self._num_accepted:  # with tiles of other writers
                self._show(snapshot)
                return
            self._session = self._repository.readonly_session(snapshot_id=snapshot)
            self._header, self._tiles = header, self._tiles | written
        except (RefusedCommitError, UncertainCommitError):
            raise
        except (import_icechunk().IcechunkError, StoreError) as error:
            raise UncertainCommitError(self.path, error, key) from error  # it was sent, and may be stored
        except Exception:
            raise
        except BaseException:  # Ctrl-C, right after it was committed
            if find_commit(self._repository, key):
                self._show(self._newest())
            raise

    def holds(self, commit: str) -> bool:
        """Return whether a commit that ended in an `UncertainCommitError` is stored."""
        with errors_in_words(self.path):
            return bool(find_commit(self._repository, commit))

    def close(self) -> None:
        """Write no more. Reading stays possible."""
        with self._mutex:
            self._read_only = self.is_closed = True

    # Versions --------------------------------------------------------------------------------------------------------

    def versions(self) -> list[Version]:
        """Return all versions, the newest first, and behind them those that tags alone keep."""
        with errors_in_words(self.path):
            return history.list_versions(self._repository)

    def tag(self, name: str, version: str) -> None:
        """Name a version, which keeps it; ValueError if the name is or was taken, KeyError without such a version."""
        with errors_in_words(self.path):
            history.tag(self._repository, self.path, name, version)

    def rollback(self, version: str) -> str:
        """Make a version that shows what an earlier one did; return the tag that keeps the one that was the newest.

        It continues the numbers of commits, and its attribute `rollbacks` says which ones were taken back.
        """
        with self._alone(), errors_in_words(self.path):
            kept = history.rollback(self._repository, self.path, version)
            self._show(self._newest())
        return kept

    def compact(self, keep: int) -> int:
        """Drop all versions but the newest ones and those with tags; return the bytes that became free."""
        with self._alone(), errors_in_words(self.path):
            return history.compact(self._repository, keep, is_alone=self._lock is not None)

    # Reading ---------------------------------------------------------------------------------------------------------

    def _newest(self) -> str:
        with errors_in_words(self.path):
            return str(self._repository.lookup_branch("main"))

    def _show(self, snapshot: str) -> None:
        """Show a version."""
        with errors_in_words(self.path):
            session = self._repository.readonly_session(snapshot_id=snapshot)
            hint = "remove it, and make it again"
            is_whole = history.is_whole(self._repository, snapshot)
            require(is_whole, str(self.path), "must be a whole site", "one whose making was interrupted", hint)
            attributes = history.attributes_of(self._repository, snapshot)
            header = parse_header(self.path, chunks.read_attributes(session.store) | attributes)
            self._session, self._header, self._tiles = session, header, self._run(chunks.list_tiles(session))

    def _run(self, work: Any) -> Any:
        """Run a coroutine, on a thread of its own: the caller's may run another loop, as notebooks do."""
        return self._thread.submit(asyncio.run, work).result()
