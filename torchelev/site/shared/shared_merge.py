"""A merge that ranks share: each cuts its own robots' windows, and fuses the tiles that it owns."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchelev.ops.parallel import map_in_order
from torchelev.site.content.tiles import Tile, Tiles
from torchelev.site.fusion.entries import fuse_entries, read_offers
from torchelev.site.fusion.exchange import Exchange
from torchelev.site.fusion.merge import Merged, lower_bounds
from torchelev.site.fusion.pieces import GROUP, cut_windows
from torchelev.site.fusion.windows import Alignment, Windows
from torchelev.site.shared.messages import make_messages, read_message
from torchelev.site.shared.parts import Chosen, OwnPart, SentPart, choose_cells, join_entries
from torchelev.site.site_config import SiteConfig

if TYPE_CHECKING:
    from jaxtyping import UInt8


def merge_shared(
    tiles: Tiles,
    windows: Windows,
    alignment: Alignment,
    first: int,
    num_robots: int,
    resolution: float,
    rate: float,
    cfg: SiteConfig,
    exchange: Exchange,
) -> Iterator[Merged]:
    """Return the tiles of this rank after fusion, a group at a time; changes none in memory.

    Args:
        tiles: of the site.
        windows: of this rank's robots.
        alignment: how they lie in the site's frame.
        first: number of this rank's first robot among those of all ranks.
        num_robots: of all ranks.
        resolution: [m].
        rate: [m^2/s] at which variances grow.
        cfg: settings.
        exchange: with other ranks.
    """
    size = windows.is_new[0].numel()
    parts = _deal(windows, alignment, first * size, resolution, exchange)
    every = [part.chosen.tiles if isinstance(part, OwnPart) else part.tiles for part in parts]
    touched = torch.unique(torch.cat(every), dim=0)  # in ascending order
    groups = touched.split(GROUP) if len(touched) else ()
    tiles.reserve(sum(tile not in tiles for tile in _as_tiles(touched)))

    def fuse_group(group_and_values: tuple[Tensor, Tensor]) -> Merged:
        group, values = group_and_values
        evidence = [part.at(group) for part in parts]
        layers = values.flatten(1)
        is_contradicted = fuse_entries(layers, join_entries([part.entries for part in evidence]), rate, cfg)
        lower_bounds(
            layers, torch.cat([part.bounded for part in evidence]), torch.cat([part.bound for part in evidence])
        )
        robot = torch.cat([part.place for part in evidence])[is_contradicted] // size
        return Merged(_as_tiles(group), values, torch.bincount(robot, minlength=num_robots))

    work = ((group, tiles.read(_as_tiles(group))) for group in groups)
    return map_in_order(fuse_group, work) if tiles.device.type == "cpu" else map(fuse_group, work)


def _as_tiles(numbers: Tensor) -> list[Tile]:
    return [(x, y) for x, y in numbers.tolist()]


def _deal(
    windows: Windows, alignment: Alignment, first: int, resolution: float, exchange: Exchange
) -> list[OwnPart | SentPart]:
    """Send what this rank measured on the others' tiles; return what all measured on its own, in the order of ranks."""
    own: list[OwnPart] = []

    def send() -> tuple[UInt8[Tensor, "n"], list[int]]:
        offers, touched = read_offers(windows, alignment, resolution), windows.is_new | windows.is_bounded
        pieces = cut_windows(windows.known.corner, touched, exchange.find_owners, exchange.size)
        chosen = [choose_cells(windows, its) for its in pieces]
        own.append(OwnPart(chosen[exchange.rank], windows, alignment, offers, first, resolution))
        return _write(chosen, own[0], exchange.rank)

    received, _ = exchange.deal(send)
    return [SentPart(*read_message(message)) if len(message) else own[0] for message in received]


def _write(chosen: list[Chosen], own: OwnPart, rank: int) -> tuple[UInt8[Tensor, "n"], list[int]]:
    """Return the messages to all ranks, and their lengths; none to this one."""
    number = 4 if own.offers.contributed is None else 7
    shapes = [[] if to == rank else SentPart.shapes(its, number) for to, its in enumerate(chosen)]
    memory, lengths, tensors = make_messages(shapes, own.offers.relief.device)
    for its, values in zip(chosen, tensors, strict=True):
        if values:
            SentPart(*values).write(its, own)
    return memory, lengths


def gather_tiles(own: Iterator[Merged], exchange: Exchange) -> list[Merged]:
    """Return the fused tiles of all ranks, of which these are this rank's, as are the contradictions.

    A layer that is unknown in all of a rank's tiles is not sent.
    """
    merged: list[Merged] = []

    def send() -> tuple[UInt8[Tensor, "n"], list[int]]:
        merged.extend(own)
        if not merged:
            return torch.zeros(0, dtype=torch.uint8), [0] * exchange.size
        tiles = [tile for part in merged for tile in part.tiles]
        is_sent = torch.stack([~part.values.isnan().flatten(1).all(1) for part in merged]).any(0)
        rows, (T, _) = is_sent.nonzero()[:, 0], merged[0].values.shape[2:]
        shapes = [(torch.int64, (len(tiles), 2)), (torch.int64, (len(is_sent),))]
        shapes.append((torch.float32, (len(rows), len(tiles), T, T)))
        others = [rank != exchange.rank for rank in range(exchange.size)]
        memory, lengths, tensors = make_messages([shapes if sent else [] for sent in others], rows.device)
        for values in filter(None, tensors):
            values[0].copy_(torch.tensor(tiles))
            values[1].copy_(is_sent)
            torch.cat([part.values[rows] for part in merged], 1, out=values[2])
        return memory, lengths

    received, _ = exchange.deal(send)
    for message in filter(len, received):
        numbers, is_sent, sent = read_message(message)
        values = sent.new_full((len(is_sent), *sent.shape[1:]), torch.nan)
        values[is_sent.bool()] = sent
        merged.append(Merged(_as_tiles(numbers), values, torch.zeros((), dtype=torch.int64, device=values.device)))
    return merged
