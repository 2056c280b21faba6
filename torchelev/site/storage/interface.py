"""`SiteStore`: what a site needs of the engine that stores it, and the errors that its users meet."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import AbstractContextManager
from datetime import datetime
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

if TYPE_CHECKING:
    from pathlib import Path

Tile = tuple[int, int]
Arrays = Mapping[str, tuple[NDArray, Mapping[str, Any]]]  # name -> values and attributes


class InDoubtError(OSError):
    """The connection ended while a commit was on its way: it may be stored."""


class Overtaken(Exception):  # noqa: N818  # nobody sees it: the site merges again
    """Another writer has changed tiles of a transaction since it began. Nothing of it is stored."""


class Version(NamedTuple):
    """One version of a site: what a merge left."""

    id: str  #: which `SiteMap.open(path, version=...)`, `tag` and `rollback` take
    time: datetime  #: at which it was stored, UTC, by the clock of the writer
    message: str  #: what it stored
    tags: tuple[str, ...]  #: names that `tag` gave it
    num_robots: int  #: robots of the merge; 0 where it was no merge
    num_cells: int  #: cells that were new to it

    def __str__(self) -> str:
        tags = "".join(f"  [{tag}]" for tag in self.tags)
        return f"{self.id}  {self.time:%Y-%m-%d %H:%M:%S} UTC  {self.message}{tags}"


class Note(NamedTuple):
    """What the history says of a commit."""

    message: str  #: in words
    num_robots: int = 0  #: robots of the merge
    num_cells: int = 0  #: new cells


class SiteStore(Protocol):
    """Square tiles of layers, further arrays and attributes, which change together in commits.

    `torchelev.site.storage.store.TileStore` keeps them as files, for one writer at a time and without history;
    `torchelev.site.storage.versioned.store.VersionedStore` in an Icechunk repository, in which each commit is a
    version, for several writers, in a folder or an object store.
    """

    @property
    def path(self) -> Path | str:
        """The folder, or the URL in an object store."""

    @property
    def engine(self) -> str:
        """Name of the engine, as of `SiteMap`."""

    @property
    def is_closed(self) -> bool:
        """Whether it was closed."""

    @property
    def layers(self) -> tuple[str, ...]:
        """Names of the L layers."""

    @property
    def tile_size(self) -> int:
        """T, cells on the side of a tile."""

    @property
    def attributes(self) -> dict[str, Any]:
        """Attributes of the version that it shows."""

    @property
    def tiles(self) -> Collection[Tile]:
        """Tiles of the version that it shows."""

    @property
    def num_bytes(self) -> int:
        """Bytes of all that is stored, with the history."""

    @property
    def is_read_only(self) -> bool:
        """Whether it is open read-only, or closed."""

    @property
    def version(self) -> str:
        """Id of the version that it shows."""

    def read(self, tiles: Sequence[Tile] | NDArray) -> NDArray[np.float32]:
        """Read tiles (n, L, T, T), NaN where nothing is stored."""

    def read_array(self, name: str) -> tuple[NDArray, dict[str, Any]]:
        """Read an array and its attributes."""

    def array_names(self) -> list[str]:
        """Return the sorted names of all arrays."""

    def transaction(
        self, attributes: Mapping[str, Any], arrays: Arrays | None = None, note: Note | None = None
    ) -> AbstractContextManager[Callable[[Sequence[Tile] | NDArray, ArrayLike], None]]:
        """Yield a function that writes tiles; commit all together at the end of the block, or nothing if it raises.

        With no tiles and no arrays, the attributes alone may stay in memory.
        """

    def invite(self) -> bytes:
        """Return what lets other processes join the transaction that is open."""

    def join_transaction(
        self, invitation: bytes, results: list[bytes]
    ) -> AbstractContextManager[Callable[[Sequence[Tile] | NDArray, ArrayLike], None]]:
        """Yield a function that writes tiles into a transaction of another process.

        At the end of the block, what that process has to `accept` is appended to `results`.
        """

    def accept(self, results: Sequence[bytes]) -> None:
        """Take what other processes have written into the transaction that is open; its end commits it, too."""

    def turn(self) -> AbstractContextManager[bool]:
        """Keep other writers out until the end of the block; yield whether one has committed since it was read."""

    def refresh(self) -> None:
        """Show the newest version."""

    def holds(self, commit: str) -> bool:
        """Return whether a commit that ended in an `UncertainCommitError` is stored."""

    def versions(self) -> list[Version]:
        """Return all versions, the newest first, and behind them those that tags alone keep."""

    def tag(self, name: str, version: str) -> None:
        """Name a version, which keeps it."""

    def rollback(self, version: str) -> str:
        """Make an earlier version the newest; return the tag that keeps the one that was the newest."""

    def compact(self, keep: int) -> int:
        """Drop all versions but the newest ones and those with tags; return the number of bytes that became free."""

    def close(self) -> None:
        """Let others write."""
