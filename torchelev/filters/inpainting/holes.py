"""Which known cell fills an unknown one: the lowest of the border of its hole, or the nearest.

Custom operators: on a CPU they look at unknown cells only, and stop as soon as nothing changes. Elsewhere they look at
all cells and take as many steps as the worst map needs, so that the host never waits.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor


def _stops(device: torch.device) -> bool:
    return device.type == "cpu"


def join(a: Tensor, b: Tensor, count: int) -> Tensor:
    """Number the parts of a graph of `count` nodes with edges from a to b: each node gets its part's lowest node.

    Each part, at first a node, joins the lowest part that it touches. Two such rounds leave at most half of the parts
    of what is connected: a part that joins none is lower than all that it touches; if none of them joined it, they
    joined still lower ones, so that it joins one of those in the second round.
    """
    label = torch.arange(count, device=a.device)
    for _ in range(2 * math.ceil(math.log2(max(2, count)))):
        ends = label[a], label[b]
        low, high = torch.minimum(*ends), torch.maximum(*ends)
        if _stops(a.device) and torch.equal(low, high):
            break
        label = compressed(label.scatter_reduce(0, high, low, "amin"))
    return label


def compressed(parent: Tensor) -> Tensor:
    """Follow each chain of parents to its end, twice as far each time."""
    for _ in range(math.ceil(math.log2(max(2, len(parent))))):
        before, parent = parent, parent[parent]
        if _stops(parent.device) and torch.equal(before, parent):
            break
    return parent


class Cells(NamedTuple):
    """The unknown cells of all maps, which have a rim of one cell each and lie one behind the other."""

    unknown: Tensor  #: (B * (H + 2) * (W + 2),) bool; the rim is not
    known: Tensor  #: the same of known cells; the rim is not
    place: Tensor  #: (M,) where the cells lie in these; places that are not unknown do no harm
    number: Tensor  #: which of the M lies at each place that is unknown
    around: list[int]  #: how far on each of the eight neighbours lies, in increasing order


def cells_of(known: Tensor) -> Cells:
    """List the unknown cells; where the host must not wait, all cells."""
    width = known.shape[2] + 2
    rimmed, unknown = (F.pad(mask, (1, 1, 1, 1)).flatten() for mask in (known, ~known))
    around = [width * u + v for u in (-1, 0, 1) for v in (-1, 0, 1) if (u, v) != (0, 0)]
    if _stops(known.device):
        place, number = unknown.nonzero().squeeze(1), unknown.cumsum(0) - 1
    else:
        place = number = torch.arange(len(unknown), device=known.device)
    return Cells(unknown, rimmed, place, number, around)


def parts_of(cells: Cells) -> Tensor:
    """Number the holes, which eight neighbours connect: each cell gets the lowest number of its hole."""
    starts, ends = [], []
    own = torch.arange(len(cells.place), device=cells.place.device)
    for step in cells.around[4:]:
        beside = (cells.place + step).clamp(max=len(cells.unknown) - 1)
        both = cells.unknown[cells.place] & cells.unknown[beside]
        if _stops(own.device):
            starts.append(own[both])
            ends.append(cells.number[beside[both]])
        else:
            starts.append(own)
            ends.append(torch.where(both, cells.number[beside], own))
    return join(torch.cat(starts), torch.cat(ends), len(own))


@torch.library.custom_op("torchelev::lowest_of_border", mutates_args=())
def lowest_of_border(values: Tensor, known: Tensor) -> Tensor:
    """Return for each unknown cell of (B, H, W) the number i * W + j of the lowest border cell of its hole.

    H * W where the hole has no border; for a known cell its own number. Of equally low ones, the first.
    """
    B, H, W = known.shape
    cells = cells_of(known)
    heights = F.pad(values, (1, 1, 1, 1)).flatten()
    lowest = values.new_full((len(cells.place),), torch.inf)
    source = torch.zeros_like(cells.place)
    for step in cells.around:
        beside = (cells.place + step).clamp(0, len(heights) - 1)
        height = torch.where(cells.known[beside], heights[beside], torch.inf)
        source = torch.where(height < lowest, beside, source)
        lowest = torch.minimum(lowest, height)
    part = parts_of(cells)
    floor = torch.full_like(lowest, torch.inf).scatter_reduce(0, part, lowest, "amin")[part]
    candidate = torch.where((lowest == floor) & torch.isfinite(floor), source, len(heights))
    first = torch.full_like(source, len(heights)).scatter_reduce(0, part, candidate, "amin")[part]
    own = torch.arange(H * W, device=known.device).view(1, H, W).expand(B, H, W)
    rimmed = F.pad(own, (1, 1, 1, 1)).flatten()
    found = torch.cat([rimmed, rimmed.new_full((1,), H * W)])[first]
    answer = rimmed.scatter(0, cells.place, torch.where(cells.unknown[cells.place], found, rimmed[cells.place]))
    return answer.view(B, H + 2, W + 2)[:, 1:-1, 1:-1].contiguous()


@lowest_of_border.register_fake
def _(values: Tensor, known: Tensor) -> Tensor:
    return torch.empty_like(known, dtype=torch.int64, memory_format=torch.contiguous_format)


def _nearest_along_rows(known: Tensor) -> Tensor:
    """Return for each cell the squared distance to the nearest known cell of its line along H, and that cell's row.

    Of two that are as near, the first. (B, H, W) each; a distance beyond the map where the line knows none.
    """
    H = known.shape[1]
    far = 2 * sum(known.shape[1:])
    row = torch.arange(H, device=known.device)[None, :, None]
    before = ((row + far) * known - far).cummax(1).values
    after = ((row - far - H) * known + far + H).flip(1).cummin(1).values.flip(1)
    nearest = torch.where(row - before <= after - row, before, after)
    return torch.stack([(row - nearest).square(), nearest])


@torch.library.custom_op("torchelev::nearest_known", mutates_args=())
def nearest_known(known: Tensor) -> Tensor:
    """Return for each cell of (B, H, W) the number i * W + j of the nearest known cell; H * W where none is known.

    By the exact Euclidean distance; of several that are as near, the one of the lowest number.
    """
    _, H, W = known.shape
    size = H * W
    square, row = _nearest_along_rows(known)
    column = torch.arange(W, device=known.device)
    found = known.any(2, keepdim=True).any(1, keepdim=True)
    # Distance first, number second, as digits of one integer: its minimum is the answer.
    key = torch.where(found, square * size + (row * W + column).clamp(0, size - 1), 0)
    best = key.clone()
    for k in range(1, W):
        if _stops(known.device) and k * k * size > best.max():
            break
        torch.minimum(best[:, :, k:], key[:, :, :-k] + k * k * size, out=best[:, :, k:])
        torch.minimum(best[:, :, :-k], key[:, :, k:] + k * k * size, out=best[:, :, :-k])
    return torch.where(found, best % size, size)


@nearest_known.register_fake
def _(known: Tensor) -> Tensor:
    return torch.empty_like(known, dtype=torch.int64, memory_format=torch.contiguous_format)
