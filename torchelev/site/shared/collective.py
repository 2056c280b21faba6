"""One site in many processes: each rank merges its own robots, and all hold the same site.

A merge of R ranks takes these steps, of which those marked * wait for all ranks:

1. * what each rank is about to do (2 KiB): bad use raises on all of them, before anything changes on any.
2. * all windows, in one all_gather, see `packing.Layout` for their size. From here on, all ranks compute the same.
3.   align and fuse. A rank may read tiles from disk, which are as of the last merge.
4. * on disk: all have read what they need. Rank 0 commits; before, a rank could have read what it fuses again.
5. * on disk: rank 0 has committed. What a rank reads from now on is as of this merge.

A rank that raises ends its steps: the others wait for it no longer than the timeout of `init_process_group`, 30 minutes
with gloo unless another is given, and then raise `LostRankError`. They do at once if its process has ended. With NCCL,
torch ends the processes that wait instead, see TORCH_NCCL_ASYNC_ERROR_HANDLING.

Ranks compute the same from the same windows. On machines with different processors, or on GPUs, they may differ by
rounding; on disk is what rank 0 has computed.
"""

from __future__ import annotations

import math
import uuid
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from torchelev.errors import require
from torchelev.site.channels import SiteChannels
from torchelev.site.fusion.windows import Windows
from torchelev.site.shared.packing import Layout, pack, unpack
from torchelev.site.shared.ranks import Ranks
from torchelev.site.site_levels import SiteLevels
from torchelev.site.storage.engines import create_store, exists, open_store
from torchelev.site.tiles import LAYERS, TILE

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
        return create_store(
            path, layers=layers, tile_size=TILE, attributes=attributes | levels.attributes, engine=engine
        )
    require(is_there, "path", "must be a folder that all ranks see", path, "mount it on every machine", OSError)
    store = open_store(path, read_only=read_only)
    actual, hint = float(store.attributes["resolution"]), "give that resolution, or another path"
    is_same = math.isclose(actual, resolution, rel_tol=1e-9)
    if not is_same:
        store.close()
    require(is_same, "resolution", f"must be {actual:g} m, that of {path}", resolution, hint)
    return store


def gather_windows(ranks: Ranks, windows: Windows, plans: list[dict[str, Any]]) -> tuple[Windows, slice]:
    """Return the windows of all ranks' robots, in the order of the ranks, and where those of this rank are.

    Args:
        ranks: of the site.
        windows: of this rank.
        plans: what the ranks sent by `exchange`: their numbers of `robots`, and whether any has `contributed` before.
    """
    numbers = [plan["robots"] for plan in plans]
    own = slice(sum(numbers[: ranks.rank]), sum(numbers[: ranks.rank + 1]))
    if ranks.size == 1:
        return windows, own
    H, W = windows.known.elevation.shape[1:]
    layout = Layout(H, W, any(plan["contributed"] for plan in plans))
    rows = pack(windows, layout)
    padded = torch.nn.functional.pad(rows, (0, 0, 0, max(numbers) - len(rows)))
    gathered = ranks.all_gather("merge", padded)
    return unpack(torch.cat([rows[:number] for rows, number in zip(gathered, numbers, strict=True)]), layout), own


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
    with ranks.together("merge", lambda: {"version": store.version}) as stored:
        with store.transaction(attributes, arrays, note) if ranks.rank == 0 else nullcontext(_write_nothing) as write:
            with ranks.together("merge"):
                yield write
    if ranks.rank:
        store.refresh()
        rule, hint = (
            f"must show what rank 0 has stored, {stored[0]['version']}",
            "give all ranks one folder, mounted without a cache",
        )
        require(store.version == stored[0]["version"], str(store.path), rule, store.version, hint, OSError)


def _write_nothing(*args: object) -> None:
    pass
