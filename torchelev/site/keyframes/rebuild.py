"""Fuse keyframes into tiles at their corrected poses: those of a new merge, or again those of all merges."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.site.content.tiles import CELLS, TILE, Tile, Tiles
from torchelev.site.fusion.entries import fuse_entries
from torchelev.site.fusion.fuse import Entries, Heights
from torchelev.site.fusion.merge import Merged, lower_bounds
from torchelev.site.keyframes.keyframe_log import KeyframeLog
from torchelev.site.keyframes.keyframes import BOUND, CONTRIBUTED, OWN, Recorded, Rows, join
from torchelev.site.keyframes.moves import Moves, find_footprints, find_moves, look_up
from torchelev.site.site_config import SiteConfig

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

_BLOCK = 8  # tiles along x and y that are rebuilt at a time


class Placed(NamedTuple):
    """Keyframes at their corrected poses."""

    ids: Int[Tensor, "K"]  #: of the keyframes
    merge: Int[Tensor, "K"]  #: number of their merges, ascending
    corner: Int[Tensor, "K 2"]  #: of their layers, before the move
    moves: Moves  #: since their merges
    previous_moves: Moves  #: of the robots' earlier contributions
    first: Int[Tensor, "K 2"]  #: cells of the boxes that hold them
    last: Int[Tensor, "K 2"]  #: the last of these cells
    read: Callable[[int], Tensor]  #: returns the layers of one, by id


class Share(NamedTuple):
    """A keyframe's values at a block's cells."""

    entries: Entries  #: heights
    bound_cell: Int[Tensor, "U"]  #: number of the cell
    bound: Float[Tensor, "U"]  #: [m] upper bounds of these


def place(rows: Rows, ids: Tensor, read: Callable[[int], Tensor], resolution: float) -> Placed:
    """Return some of the keyframes at their corrected poses, without the empty ones."""
    ids = ids[(rows.size[ids] > 0).all(1)]
    moves = find_moves(rows.T_first, rows.T_now)
    own, contributed = moves.at(ids), moves.at(rows.previous[ids])
    box = find_footprints(own, rows.corner[ids], rows.size[ids], rows.heights[ids], resolution)
    return Placed(ids, rows.merge[ids], rows.corner[ids], own, contributed, *box, read)


def tiles_of(*parts: Placed) -> list[Tile]:
    """Return the tiles that keyframes may touch."""
    boxes = {
        (*a, *b) for p in parts for a, b in zip((p.first // TILE).tolist(), (p.last // TILE).tolist(), strict=True)
    }
    return sorted({(x, y) for a, b, c, d in boxes for x in range(a, c + 1) for y in range(b, d + 1)})


def merge_recorded(
    tiles: Tiles, rows: Rows, new: Recorded, resolution: float, rate: float, cfg: SiteConfig
) -> Iterator[Merged]:
    """Yield the tiles after a merge, as `merge_windows` does, of its keyframes; `rows` are those of all before."""
    first, B = int(new.ids[0]), len(new.ids)
    placed = place(join(rows, new.rows), new.ids, lambda number: new.layers[number - first], resolution)
    for part in rebuild(tiles, placed, tiles_of(placed), True, resolution, rate, cfg):
        counts = part.contradictions.new_zeros(B)
        yield part._replace(
            contradictions=counts.index_add(0, (placed.ids - first).to(counts.device), part.contradictions)
        )


def rebuild_moved(
    tiles: Tiles, log: KeyframeLog, after: Rows, resolution: float, rate: float, cfg: SiteConfig
) -> Iterator[Merged]:
    """Yield the tiles that change when keyframes move to their poses in `after`."""
    changed = find_changed(log.rows, after)
    touched = tiles_of(*(place(rows, changed, log.read, resolution) for rows in (log.rows, after)))
    placed = place(after, torch.arange(len(after.merge)), log.read, resolution)
    yield from rebuild(tiles, placed, touched, False, resolution, rate, cfg)


def find_changed(before: Rows, after: Rows) -> Int[Tensor, "k"]:
    """Return the keyframes whose pose changed, and those whose earlier contribution is one of them."""
    changed = (before.T_now != after.T_now).flatten(1).any(1)
    return (changed | changed[after.previous]).nonzero()[:, 0]


def rebuild(
    tiles: Tiles, placed: Placed, touched: list[Tile], is_new: bool, resolution: float, rate: float, cfg: SiteConfig
) -> Iterator[Merged]:
    """Yield the tiles after all keyframes were fused into them in the order of their merges, block by block.

    Args:
        tiles: the site's, which do not change.
        placed: the keyframes.
        touched: the tiles.
        is_new: the keyframes are fused into what the tiles hold; otherwise into blank tiles.
        resolution: [m].
        rate: [m^2/s] at which variances grow.
        cfg: settings.
    """
    for block in _cut(touched):
        values = tiles.read(block)
        values = values if is_new else torch.full_like(values, torch.nan)
        contradicted = [torch.zeros(0, dtype=torch.int64)]
        for numbers in _split(placed, block):
            contradicted.append(_fuse(values, block, placed, numbers, resolution, rate, cfg))
        kept = [n for n, tile in enumerate(block) if tile in tiles or values[:, n].isfinite().any()]
        counts = torch.bincount(torch.cat(contradicted), minlength=len(placed.ids)).to(values.device)
        yield Merged([block[n] for n in kept], values[:, kept], counts)


def _cut(touched: list[Tile]) -> Iterator[list[Tile]]:
    """Yield the tiles of one block at a time."""

    def block(tile: Tile) -> Tile:
        return tile[0] // _BLOCK, tile[1] // _BLOCK

    for _, group in itertools.groupby(sorted(touched, key=lambda tile: (block(tile), tile)), block):
        yield list(group)


def _split(placed: Placed, block: list[Tile]) -> Iterator[Tensor]:
    """Yield which keyframes of each merge reach a block, in the order of the merges."""
    cells = torch.tensor(block) * TILE
    reaches = ((placed.last >= cells.amin(0)) & (placed.first < cells.amax(0) + TILE)).all(1).nonzero()[:, 0]
    _, counts = torch.unique_consecutive(placed.merge[reaches], return_counts=True)
    yield from reaches.split(counts.tolist())


def _fuse(
    values: Float[Tensor, "L n T T"],
    block: list[Tile],
    placed: Placed,
    numbers: Tensor,
    resolution: float,
    rate: float,
    cfg: SiteConfig,
) -> Int[Tensor, "C"]:
    """Fuse keyframes of one merge into a block's tiles, in place; return the number of one for each contradiction."""
    cells = torch.tensor(block) * TILE
    low, high = placed.first[numbers].amin(0), placed.last[numbers].amax(0)
    used = ((cells <= high) & (cells + TILE > low)).all(1).nonzero()[:, 0]
    if not len(used):
        return used
    layers = values[:, used].flatten(1)
    shares = [_share(placed, number, cells[used], values.device, resolution) for number in numbers.tolist()]
    entries = join_entries([share.entries for share in shares])
    is_contradicted = fuse_entries(layers, entries, rate, cfg).cpu()
    lower_bounds(layers, torch.cat([s.bound_cell for s in shares]), torch.cat([s.bound for s in shares]))
    values[:, used] = layers.view(len(layers), -1, TILE, TILE)
    return torch.cat([number.expand(len(s.entries.cell)) for number, s in zip(numbers, shares, strict=True)])[
        is_contradicted
    ]


def join_entries(parts: list[Entries]) -> Entries:
    """Return entries one after another, all of which have earlier contributions."""
    contributed = Heights(
        *(torch.cat(columns) for columns in zip(*(part.contributed or () for part in parts), strict=True))
    )
    heights = Heights(*(torch.cat(columns) for columns in zip(*(part.heights for part in parts), strict=True)))
    return Entries(torch.cat([p.cell for p in parts]), heights, torch.cat([p.relief for p in parts]), contributed)


def _share(placed: Placed, number: int, cells: Tensor, device: torch.device, resolution: float) -> Share:
    """Look up a keyframe's values at tiles, given their first cells."""
    layers = placed.read(int(placed.ids[number]))
    targets, at = _find_targets(cells, placed.first[number], placed.last[number])
    corner, move, previous_move = placed.corner[number], placed.moves.at(number), placed.previous_moves.at(number)
    own = look_up(layers[OWN], corner, move, targets, resolution)
    known = own[2].isfinite().nonzero()[:, 0]
    contributed = look_up(layers[CONTRIBUTED], corner, previous_move, targets[known], resolution)
    bound = look_up(layers[BOUND], corner, move, targets, resolution)[0]
    bounded = bound.isfinite().nonzero()[:, 0]
    elevation, variance, time, relief = own[:, known].to(device)
    entries = Entries(
        at[known].to(device), Heights(elevation, variance, time), relief, Heights(*contributed.to(device))
    )
    return Share(entries, at[bounded].to(device), bound[bounded].to(device))


def _find_targets(
    cells: Int[Tensor, "n 2"], first: Tensor, last: Tensor
) -> tuple[Int[Tensor, "N 2"], Int[Tensor, "N"]]:
    """Return the cells of tiles that lie in a box, and their places in the flat tiles."""
    lines = cells[:, None] + torch.arange(TILE)[:, None]
    inside: Bool[Tensor, "n T 2"] = (lines >= first) & (lines <= last)
    n, i, j = (inside[:, :, None, 0] & inside[:, None, :, 1]).nonzero().unbind(1)
    return cells[n] + torch.stack([i, j], 1), n * CELLS + i * TILE + j
