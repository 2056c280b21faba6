"""One site in many processes: each rank merges its own robots, fuses its own tiles, and can read all of them.

A merge of R ranks takes these steps, of which those marked * wait for all ranks:

1. * what each rank is about to do (2 KiB): bad use raises on all of them, before anything changes on any.
2. * offsets: the heights to compare go to the owners of their tiles (16 bytes each), which find the pairs. In each
     round of least squares, ranks add up a histogram and the moments of their pairs, and all solve the same equations.
3. * new heights go to the owners of their tiles in one all_to_all, see `parts.SentPart` for their size.
4.   each owner fuses. It may read its tiles from disk, which are as of the last merge.
5. * in memory: each rank sends its fused tiles to all others. On disk: all have written theirs, and rank 0 commits.
6. * on disk: rank 0 has committed. What a rank reads from now on is as of this merge.

The result is that of one process up to the rounding of offsets, whatever the number of ranks. Each rank owns a stretch
of a space-filling curve, in which as many windows have their centres, of its own where possible, see `owners`: robots
that are near each other and on one rank send little. Owners change with the windows, as any rank can read any tile.

Ranks read without each other, also after one of them is lost. So in memory each one holds the whole site, 28 bytes for
each cell of a tile, and what falls with the number of ranks is the memory of a merge and of the maps. On disk each one
keeps its own tiles in memory, and those that it reads.

If reading, fusing or writing tiles raises on one rank, all raise. For a rank that ends, or is interrupted, the others
wait no longer than the timeout of `init_process_group`, 30 minutes with gloo unless another is given,
and then raise `LostRankError`. They do at once if its process has ended. With NCCL, torch ends the processes that wait
instead, see TORCH_NCCL_ASYNC_ERROR_HANDLING. NCCL sends the same tensors, from a GPU; that has not been tried.
"""

from __future__ import annotations

import math
import uuid
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torchelev.errors import require
from torchelev.site.content.channels import SiteChannels
from torchelev.site.content.levels import SiteLevels
from torchelev.site.content.tiles import LAYERS, TILE
from torchelev.site.shared.ranks import Ranks
from torchelev.site.storage.engines import create_store, exists, open_store

if TYPE_CHECKING:
    from torchelev.site.storage.engines import Engine
    from torchelev.site.storage.interface import Note, SiteStore


def open_shared(
    ranks: Ranks,
    call: str,
    path: str | Path,
    resolution: float,
    channels: SiteChannels,
    levels: SiteLevels,
    engine: Engine | None = None,
) -> SiteStore:
    """Create or open a site on rank 0 for writing, and then open it on the others, read-only."""
    store = None
    try:
        for turn in (True, False):
            with ranks.together(call):
                if (ranks.rank == 0) == turn:
                    store = _open(path, resolution, channels, levels, not turn, engine)
    except BaseException:
        if store is not None:
            store.close()
        raise
    assert store is not None
    return store


def _open(
    path: str | Path,
    resolution: float,
    channels: SiteChannels,
    levels: SiteLevels,
    read_only: bool,
    engine: Engine | None,
) -> SiteStore:
    """Create a site, or open one that is there, of the same resolution."""
    is_there = exists(path)
    if not is_there and not read_only:
        attributes = {"id": uuid.uuid4().hex, "resolution": resolution, "channels": channels.attributes}
        layers = (*LAYERS, *channels.stored, *levels.stored)
        attributes |= levels.attributes
        store = create_store(path, layers=layers, tile_size=TILE, attributes=attributes, engine=engine)
        return _check_resolution(store, path, resolution)  # another process may just have made it
    require(is_there, "path", "must be a folder that all ranks see", path, "mount it on every machine", OSError)
    store = open_store(path, read_only=read_only)
    hint = f"leave it out, or torchelev site convert {path} NEW --engine {engine}"
    try:
        require(engine in (None, store.engine), "engine", f"must be {store.engine}, that of {path}", engine, hint)
    except ValueError:
        store.close()
        raise
    return _check_resolution(store, path, resolution)


def _check_resolution(store: SiteStore, path: str | Path, resolution: float) -> SiteStore:
    """Return a store; ValueError if it is of another resolution."""
    actual, hint = float(store.attributes["resolution"]), "give that resolution, or another path"
    is_same = math.isclose(actual, resolution, rel_tol=1e-9)
    if not is_same:
        store.close()
    require(is_same, "resolution", f"must be {actual:g} m, that of {path}", resolution, hint)
    return store


@contextmanager
def shared_transaction(
    ranks: Ranks,
    store: SiteStore | None,
    attributes: Mapping[str, Any],
    arrays: Mapping[str, Any] | None = None,
    note: Note | None = None,
) -> Iterator[Callable[..., None]]:
    """Yield a function that writes tiles, which rank 0 commits once all ranks are at the end, if there is a store.

    If the block or the commit raises on one rank, nothing is committed, and all raise.
    """
    if store is None:
        yield _write_nothing
        return
    results: list[bytes] = []
    with ExitStack() as transaction:  # of rank 0; left with an error, it commits nothing
        invitation = b""
        with ranks.together("merge"):
            if ranks.rank == 0:
                write = transaction.enter_context(store.transaction(attributes, arrays, note))
                invitation = store.invite() if ranks.size > 1 else b""
        invitation = ranks.gather_bytes("merge", invitation)[0]
        with ranks.together("merge"):
            if ranks.rank == 0:
                yield write
            else:
                with store.join_transaction(invitation, results) as write:
                    yield write
        shares = ranks.gather_bytes("merge", b"".join(results))[1:]
        with ranks.together("merge", lambda: {"version": store.version}) as stored:
            if ranks.rank == 0:
                store.accept(shares)
            transaction.close()
    if ranks.size > 1:
        store.refresh()
        version, hint = stored[0]["version"], "give all ranks one folder, mounted without a cache"
        rule = f"must show what rank 0 has stored, {version}"
        require(store.version == version, str(store.path), rule, store.version, hint, OSError)


def _write_nothing(*args: object) -> None:
    pass
