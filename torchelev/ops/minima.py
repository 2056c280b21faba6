"""Running minima, and the polar table of minima."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import torch
from torch import Tensor

from torchelev.ops.scatter import lowest


def running_minimum(table: Tensor) -> Tensor:
    """Return the running minimum along dimension 1, a multiple of 8: over j <= k."""
    if torch.is_grad_enabled():
        return table.cummin(1).values
    result = table.clone(memory_format=torch.contiguous_format)
    _scan(result, from_end=False)
    return result


def polar_minimum(index: Tensor, values: Tensor, azimuths: int, widen: list[int], ranges: int, blank: float) -> Tensor:
    """Return the table (B, R, azimuths) of the lowest value at or beyond each range and near each azimuth.

    `index` (B, N) is range * azimuths + azimuth of each value (B, N); range = `ranges` drops it. Every level w of
    `widen` makes an entry of the first widen[w] ranges the minimum of twice as many azimuths, itself the first of
    them. Row `ranges` and what follows it, R being a multiple of 8, are blank, for what lies out of reach.
    """
    rows = 8 * (ranges // 8 + 1)
    table = lowest(index, values, rows * azimuths, blank).unflatten(1, (rows, azimuths))
    row = torch.arange(rows, device=values.device)[:, None]
    table = torch.where(row == ranges, blank, table)
    if torch.is_grad_enabled():
        table = table.flip(1).cummin(1).values.flip(1)
        for level, size in enumerate(widen):
            table = torch.where(row < size, torch.minimum(table, table.roll(-(2**level), 2)), table)
        return table
    _scan(table, from_end=True)
    _widen(table, widen)
    return table


def _scan_rows(rows: Sequence[Tensor]) -> None:
    """Turn each row into the minimum of itself and all before it, in place."""
    for before, row in itertools.pairwise(rows):
        row.clamp_(max=before)


def _scan(table: Tensor, from_end: bool) -> None:
    """Turn a table (B, R, P), R a multiple of 8, into its running minimum along R, in place.

    In blocks of eight rows, then over the blocks: each entry is touched twice, where doubling touches it log R times.
    """
    blocks = table.unflatten(1, (-1, 8))
    last = blocks[:, :, 0 if from_end else -1]
    steps, ends = blocks.unbind(2), last.unbind(1)
    _scan_rows(steps[::-1] if from_end else steps)
    _scan_rows(ends[::-1] if from_end else ends)
    inner, before = (blocks[:, :-1], last[:, 1:]) if from_end else (blocks[:, 1:], last[:, :-1])
    inner.clamp_(max=before.unsqueeze(2).clone())


def _widen(table: Tensor, widen: list[int]) -> None:
    """Make each entry of the first widen[w] rows the minimum of itself and the entry 2^w on, level by level."""
    for half in table.chunk(2):  # of the environments, as each takes a copy, the largest of an update's values
        for level, rows in enumerate(widen):
            near = half[:, :rows]
            near.clamp_(max=near.roll(-(2**level), 2))
