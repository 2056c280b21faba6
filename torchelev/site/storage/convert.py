"""Copying a site from one engine to another."""

from __future__ import annotations

import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from torchelev.errors import require
from torchelev.site.storage.engines import Engine, create_store, exists, open_store
from torchelev.site.storage.interface import Note, Tile
from torchelev.site.storage.versioned.repository import is_url

if TYPE_CHECKING:
    from collections.abc import Callable

_GROUP = 64  # tiles that are in memory at a time


def convert(
    source: str | Path,
    target: str | Path,
    *,
    version: str | None = None,
    engine: Engine = "icechunk",
    show: Callable[[list[list[Tile]]], Iterable[list[Tile]]] = iter,
) -> int:
    """Copy one version of a site into a new one, of another engine or elsewhere; the source stays as it is.

    Maps of this process go on merging into the copy as they did into the source.

    Args:
        source: the site.
        target: an empty or new folder, or s3://bucket/prefix.
        version: id or tag of the version to copy; None: the newest.
        engine: of the copy: "icechunk" or "files".
        show: wraps the groups of tiles that are copied, to show progress.

    Returns:
        The number of tiles.

    Raises:
        FileNotFoundError: there is no source.
        ValueError: the source is no site, or the target is not empty.
        OSError: one of them cannot be read or written. Nothing is left at the target folder then.
    """
    store = open_store(source, read_only=True, version=version)
    require(not exists(target), "target", "must be new", f"{target}, which is a site", "choose another place")
    tiles, attributes = sorted(store.tiles), store.attributes
    names = store.array_names()
    with _remove_if_it_fails(target):
        copy = create_store(
            target, layers=store.layers, tile_size=store.tile_size, attributes=attributes, engine=engine
        )
        try:
            arrays = {name: store.read_array(name) for name in names}
            with copy.transaction(attributes, arrays, Note(f"converted from {store.path}")) as write:
                for group in show([tiles[k : k + _GROUP] for k in range(0, len(tiles), _GROUP)]):
                    write(group, store.read(group))
        finally:
            copy.close()
    return len(tiles)


@contextmanager
def _remove_if_it_fails(target: str | Path) -> Iterator[None]:
    """Remove what a block has made at a folder, if it raises."""
    folder = None if is_url(target) else Path(target)
    was_there = folder is not None and folder.exists()
    if was_there and folder is not None:
        require(not any(folder.iterdir()), "target", "must be a new or empty folder", target, "choose another place")
    try:
        yield
    except BaseException:
        if folder is not None and folder.exists():
            shutil.rmtree(folder)
            if was_there:
                folder.mkdir()
        raise
