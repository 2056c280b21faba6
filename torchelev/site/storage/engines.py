"""Which engine keeps a site, and opening it by the one that it was made with."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from torchelev.errors import require
from torchelev.site.storage.site_header import is_site, require_empty
from torchelev.site.storage.versioned import repository

if TYPE_CHECKING:
    from torchelev.site.storage.interface import SiteStore

Engine = Literal["icechunk", "files"]
ENGINES = ("icechunk", "files")


def exists(path: str | Path) -> bool:
    """Return whether there is a site, of any engine."""
    path = repository.normalize(path)
    return (isinstance(path, Path) and is_site(path)) or repository.is_repository(path)


def create_store(
    path: str | Path,
    *,
    layers: Sequence[str],
    tile_size: int,
    attributes: Mapping[str, Any],
    engine: Engine | None = None,
) -> SiteStore:
    """Make a new site, and open it for writing.

    Args:
        path: an empty or new folder, or s3://bucket/prefix.
        layers: names of the L layers.
        tile_size: T, cells on the side of a tile.
        attributes: JSON values, such as the resolution [m].
        engine: that keeps it; None: Icechunk where it is installed, which it always is on Python 3.11 and later, and
            otherwise files.

    Raises:
        ValueError: the folder is not empty, or the engine cannot keep it there.
        OSError: it cannot be written.
        ModuleNotFoundError: the engine is missing.
    """
    require(engine in (None, *ENGINES), "engine", f"must be one of {', '.join(ENGINES)}", repr(engine), "leave it out")
    is_remote = repository.is_url(path)
    hint = "leave engine out"
    require(not (is_remote and engine == "files"), "engine", "must be 'icechunk' in an object store", engine, hint)
    engine = engine or ("icechunk" if is_remote or repository.is_available() else "files")
    if engine == "files":
        from torchelev.site.storage.store import TileStore

        return TileStore.create(path, layers=layers, tile_size=tile_size, attributes=attributes)
    from torchelev.site.storage.versioned.store import VersionedStore

    if not is_remote:
        require_empty(Path(path).absolute())
    return VersionedStore.create(path, layers=layers, tile_size=tile_size, attributes=attributes)


def open_store(path: str | Path, *, read_only: bool = False, version: str | None = None) -> SiteStore:
    """Open a site by the engine that it was made with; arguments and errors as of `SiteMap.open`."""
    from torchelev.site.storage.store import TileStore

    place = repository.normalize(path)
    if isinstance(place, Path) and (is_site(place) or not repository.is_repository(place)):
        store = TileStore.open(place, read_only=read_only or version is not None)
        hint = f"leave it out, or convert the site: torchelev site convert {place} NEW"
        is_known, actual = (
            version in (None, store.version),
            f"{version!r} of a site of files, which has {store.version}",
        )
        require(is_known, "version", "must be there", actual, hint, KeyError)
        return store
    from torchelev.site.storage.versioned.store import VersionedStore

    return VersionedStore.open(place, read_only=read_only, version=version)
