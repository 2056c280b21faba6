"""Tiles of a site on disk, as Zarr 3 that any reader of Zarr opens. Needs ``torchelev[site]``."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from datetime import datetime, timezone
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np
from filelock import FileLock
from numpy.typing import ArrayLike, NDArray

from torchelev.errors import message, require
from torchelev.site.storage import named_arrays
from torchelev.site.storage.interface import Note, Version
from torchelev.site.storage.shown_version import ShownVersion
from torchelev.site.storage.site_header import Header, make_site, new_header, read_header, require_empty
from torchelev.site.storage.tile_files import Tile, TileFiles, as_tiles
from torchelev.site.storage.transaction import CommitError, clean, finish, lock_folder, stage
from torchelev.site.storage.zarr_files import METADATA, encode_metadata, import_tensorstore, wait_for

_MAX_WRITES = 32  # tiles that are written at a time


class TileStore(ShownVersion):
    """A folder of square tiles of layers, to which one process writes while others read.

    Tile (a, b) holds cells a * T to a * T + T - 1 along x and b * T to b * T + T - 1 along y; both may be negative.
    The folder is a Zarr 3 group whose array `cells` is (L, N, N) float32, NaN where unknown, with a file per tile.
    Its attributes name the layers and the place of cell 0.

    A commit is stored whole or not at all, also if the process is killed. A power cut may damage the last ones, which
    reading then reports. Methods may be called from several threads, but not in a forked process.

    Create one with `create` or `open`, and `close` it or use it in a `with` block.
    """

    engine = "files"

    def __init__(self, path: Path, lock: FileLock | None) -> None:
        self.path = path
        self._lock, self._committing, self.is_closed = lock, Lock(), False
        self._files = TileFiles(path, read_header(path))
        self.refresh()

    @classmethod
    def create(
        cls, path: str | Path, *, layers: Sequence[str], tile_size: int = 64, attributes: Mapping[str, Any]
    ) -> TileStore:
        """Make a new site and open it for writing.

        Args:
            path: a folder, which must be empty or not exist.
            layers: names of the L layers.
            tile_size: T, cells on the side of a tile.
            attributes: JSON values, such as the resolution [m].

        Raises:
            ValueError: `path` is a file or a folder that is not empty, or another argument breaks its rule.
            OSError: the folder cannot be written, or another process makes a site there.
            ModuleNotFoundError: tensorstore is missing.
        """
        path, header = Path(path).absolute(), new_header(layers, tile_size, attributes)
        encode_metadata(header.metadata())
        import_tensorstore()
        require_empty(path)
        try:
            path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise CommitError(path, error) from error
        return cls._lock_and_open(path, header)

    @classmethod
    def open(cls, path: str | Path, *, read_only: bool = False) -> TileStore:
        """Open a site; opening for writing completes a commit that a killed process left behind.

        Args:
            path: its folder.
            read_only: write nothing, beside a process that may be writing.

        Raises:
            ValueError: not a site, one of a newer version, or its metadata are damaged.
            OSError: there is no such folder, another writer has it open, or it cannot be written.
            ModuleNotFoundError: tensorstore is missing.
        """
        path = Path(path).absolute()  # the working folder may change
        read_header(path)
        return cls(path, None) if read_only else cls._lock_and_open(path)

    @classmethod
    def _lock_and_open(cls, path: Path, new: Header | None = None) -> TileStore:
        """Become the writer of a site, or of a new one."""
        lock = lock_folder(path)
        try:
            if new:
                make_site(path, new)
            clean(path)
            return cls(path, lock)
        except BaseException:
            lock.release()
            raise

    @property
    def num_bytes(self) -> int:
        """Bytes of all files on disk. Looks at each of them: about a millisecond per 100 tiles."""
        return sum(_size(Path(folder, name)) for folder, _, names in os.walk(self.path) for name in names)

    def refresh(self) -> None:
        """Find the `attributes` and `tiles` that other processes committed; `read` and `read_array` always do."""
        self._header, self._tiles = read_header(self.path), self._files.list_tiles()

    def read(self, tiles: Sequence[Tile] | NDArray) -> NDArray[np.float32]:
        """Read tiles as of the last commit.

        Args:
            tiles: n pairs.

        Returns:
            (n, L, T, T) values, NaN where nothing is stored.

        Raises:
            ValueError: a tile is damaged; the text names it and its file.
        """
        return self._files.read(as_tiles(tiles))

    @contextmanager
    def turn(self) -> Iterator[bool]:
        """Do nothing: no one else writes while this store is open for writing."""
        yield False

    @contextmanager
    def transaction(
        self,
        attributes: Mapping[str, Any],
        arrays: Mapping[str, tuple[NDArray, Mapping[str, Any]]] | None = None,
        note: Note | None = None,
    ) -> Iterator[Callable[[Sequence[Tile] | NDArray, ArrayLike], None]]:
        """Commit tiles that come some at a time, all together when the block ends, or none if it raises.

        Args:
            attributes: as for `commit`.
            arrays: as for `commit`.
            note: of no use here: there is no history.

        Yields:
            A function of tiles and values, as for `commit`. A tile may come once; the values must not change until the
            end.

        Raises:
            ValueError: as for `commit`.
            CommitError: as for `commit`.
        """
        header, arrays = self._header.with_attributes(attributes), arrays or {}
        metadata = encode_metadata(header.metadata())
        written: set[Tile] = set()
        writes: list[Any] = []
        with self._committing:
            self._prepare(list(arrays))
            with stage(self.path) as folder:

                def write(tiles: Sequence[Tile] | NDArray, values: ArrayLike) -> None:
                    pairs, cells = self._header.check_tiles(as_tiles(tiles), values)
                    writes.extend(self._files.stage(pairs, cells))
                    written.update(pairs)
                    _wait_for_older(writes)

                try:
                    yield write
                finally:
                    wait_for(writes)
                for name, (array, its_attributes) in arrays.items():
                    named_arrays.stage_array(self.path, folder, name, array, its_attributes)
                (folder / METADATA).write_bytes(metadata)
            self._header, self._tiles = header, self._tiles.union(written)
            with suppress(OSError):  # it is committed: reading finds it, and the next commit moves it
                finish(self.path)

    def invite(self) -> bytes:
        """Return nothing: other processes see the folder of the transaction."""
        return b""

    def accept(self, results: Sequence[bytes]) -> None:
        """Do nothing: what other processes have written lies in the folder of the transaction."""

    @contextmanager
    def join_transaction(
        self, invitation: bytes, results: list[bytes]
    ) -> Iterator[Callable[[Sequence[Tile] | NDArray, ArrayLike], None]]:
        """Write tiles into the transaction that is open in another process, which commits them, too.

        Args:
            invitation: of no use here: processes see one folder.
            results: likewise.

        Yields:
            A function of tiles and values, as for `commit`. All is written at the end of the block.
        """
        writes: list[Any] = []

        def write(tiles: Sequence[Tile] | NDArray, values: ArrayLike) -> None:
            writes.extend(self._files.stage(*self._header.check_tiles(as_tiles(tiles), values)))
            _wait_for_older(writes)

        try:
            yield write
        finally:
            wait_for(writes)

    @property
    def is_read_only(self) -> bool:
        """Whether it is open read-only, or closed."""
        return self._lock is None

    @property
    def version(self) -> str:
        """The number of the last commit, as this store keeps no other."""
        return str(self._header.attributes.get("num_commits", 0))

    def versions(self) -> list[Version]:
        """Return the one version that there is."""
        time = datetime.fromtimestamp((self.path / METADATA).stat().st_mtime, timezone.utc)
        return [Version(self.version, time, "a site of files, which keep no history", (), 0, 0)]

    def tag(self, name: str, version: str) -> None:
        """Raise ValueError: files keep no versions."""
        raise self._without_versions("tag")

    def rollback(self, version: str) -> str:
        """Raise ValueError: files keep no versions."""
        raise self._without_versions("rollback")

    def compact(self, keep: int) -> int:
        """Return 0: files keep no history."""
        return 0

    def holds(self, commit: str) -> bool:
        """Return False: no commit of files ends in doubt."""
        return False

    def _without_versions(self, call: str) -> ValueError:
        hint = f"torchelev site convert {self.path} NEW"
        return ValueError(message(call, "must be of a site with versions", "a site of files", hint))

    def read_array(self, name: str) -> tuple[NDArray, dict[str, Any]]:
        """Read an array and its attributes as of the last commit; KeyError if there is none of this name."""
        return named_arrays.read_array(self.path, name)

    def array_names(self) -> list[str]:
        """Return the sorted names of all arrays that were committed; reads a small file for each."""
        return named_arrays.list_arrays(self.path)

    def close(self) -> None:
        """Let another process write. Reading stays possible."""
        with self._committing:
            if self._lock:
                self._lock.release()
            self._lock, self.is_closed = None, True

    def _prepare(self, names: list[str]) -> None:
        """Complete a commit that could not be moved into place yet; raise unless another one is possible."""
        actual, hint = "a store that is read-only or closed", "open it again for writing"
        require(self._lock is not None, str(self.path), "must be open for writing", actual, hint)
        if clean(self.path):
            self.refresh()
        named_arrays.check_names(self.path, names)


def _wait_for_older(writes: list[Any]) -> None:
    """Wait until few enough of the writes are left, as their tiles stay in memory."""
    done = max(0, len(writes) - _MAX_WRITES)
    wait_for(writes[:done])
    del writes[:done]


def _size(file: Path) -> int:
    with suppress(FileNotFoundError):  # a commit has just moved it
        return file.stat().st_size
    return 0
