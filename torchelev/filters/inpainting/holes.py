"""Choose the known cell that fills an unknown one: the lowest on the border of its hole, or the nearest.

Custom operators. On a CPU they look at unknown cells only, and stop as soon as nothing changes. On other devices they
look at all cells and take as many steps as the worst map needs, so that the host never waits.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from torchelev.ops.library import operator


def may_wait(device: torch.device) -> bool:
    """Return whether values can be read without waiting for the device."""
    return device.type == "cpu"


# Connected components -------------------------------------------------------------------------------------------------


def component_labels(a: Tensor, b: Tensor, num_nodes: int) -> Tensor:
    """Label the connected components of a graph with edges a[k] - b[k]: each node gets its component's lowest node.

    Parts, at first single nodes, join the lowest part that they touch. Two rounds at least halve the number of parts in
    a component: a part that joins none is lower than all that it touches; if none of those joined it, they joined still
    lower parts, and it joins one of those in the second round.
    """
    label = torch.arange(num_nodes, device=a.device)
    for _ in range(2 * math.ceil(math.log2(max(2, num_nodes)))):
        ends = label[a], label[b]
        low, high = torch.minimum(*ends), torch.maximum(*ends)
        if may_wait(a.device) and torch.equal(low, high):
            break
        label = roots(label.scatter_reduce(0, high, low, "amin"))
    return label


def roots(parent: Tensor) -> Tensor:
    """Return the root of each node's chain of parents; the distance looked ahead doubles each round."""
    for _ in range(math.ceil(math.log2(max(2, len(parent))))):
        before, parent = parent, parent[parent]
        if may_wait(parent.device) and torch.equal(before, parent):
            break
    return parent


# Holes ----------------------------------------------------------------------------------------------------------------


class _Cells(NamedTuple):
    """The unknown cells of all maps, flattened one after the other, each with a rim of one cell."""

    unknown: Tensor  #: (B * (H + 2) * (W + 2),) bool; false on the rim
    known: Tensor  #: likewise for known cells; false on the rim
    place: Tensor  #: (M,) flat indices of the unknown cells; others among them do no harm
    number: Tensor  #: index in `place` of each unknown flat index
    steps: list[int]  #: from a flat index to its eight neighbours, in increasing order


def _flatten(known: Tensor) -> _Cells:
    """List the unknown cells; where the host must not wait, all cells."""
    width = known.shape[2] + 2
    rimmed, unknown = (F.pad(mask, (1, 1, 1, 1)).flatten() for mask in (known, ~known))
    steps = [width * u + v for u in (-1, 0, 1) for v in (-1, 0, 1) if (u, v) != (0, 0)]
    if may_wait(known.device):
        place, number = unknown.nonzero().squeeze(1), unknown.cumsum(0) - 1
    else:
        place = number = torch.arange(len(unknown), device=known.device)
    return _Cells(unknown, rimmed, place, number, steps)


def _hole_labels(cells: _Cells) -> Tensor:
    """Label the holes, connected through eight neighbours: each cell gets the lowest number in its hole."""
    starts, ends = [], []
    own = torch.arange(len(cells.place), device=cells.place.device)
    for step in cells.steps[4:]:
        neighbour = (cells.place + step).clamp(max=len(cells.unknown) - 1)
        is_edge = cells.unknown[cells.place] & cells.unknown[neighbour]
        if may_wait(own.device):
            starts.append(own[is_edge])
            ends.append(cells.number[neighbour[is_edge]])
        else:
            starts.append(own)
            ends.append(torch.where(is_edge, cells.number[neighbour], own))
    return component_labels(torch.cat(starts), torch.cat(ends), len(own))


def _empty_indices(known: Tensor) -> Tensor:
    return torch.empty_like(known, dtype=torch.int64, memory_format=torch.contiguous_format)


@operator("lowest_of_border(Tensor values, Tensor known) -> Tensor", fake=lambda values, known: _empty_indices(known))
def lowest_of_border(values: Tensor, known: Tensor) -> Tensor:
    """Return for each unknown cell (B, H, W) the flat index i * W + j of the lowest cell on its hole's border.

    Of equally low ones the first; H * W for a hole without border; a known cell's own index.
    """
    B, H, W = known.shape
    cells = _flatten(known)
    heights = F.pad(values, (1, 1, 1, 1)).flatten()
    lowest = values.new_full((len(cells.place),), torch.inf)
    source = torch.zeros_like(cells.place)
    for step in cells.steps:
        neighbour = (cells.place + step).clamp(0, len(heights) - 1)
        height = torch.where(cells.known[neighbour], heights[neighbour], torch.inf)
        source = torch.where(height < lowest, neighbour, source)
        lowest = torch.minimum(lowest, height)
    hole = _hole_labels(cells)
    floor = torch.full_like(lowest, torch.inf).scatter_reduce(0, hole, lowest, "amin")[hole]
    candidate = torch.where((lowest == floor) & torch.isfinite(floor), source, len(heights))
    first = torch.full_like(source, len(heights)).scatter_reduce(0, hole, candidate, "amin")[hole]
    own = torch.arange(H * W, device=known.device).view(1, H, W).expand(B, H, W)
    rimmed = F.pad(own, (1, 1, 1, 1)).flatten()
    found = torch.cat([rimmed, rimmed.new_full((1,), H * W)])[first]
    answer = rimmed.scatter(0, cells.place, torch.where(cells.unknown[cells.place], found, rimmed[cells.place]))
    return answer.view(B, H + 2, W + 2)[:, 1:-1, 1:-1].contiguous()


# Nearest known cells --------------------------------------------------------------------------------------------------


@operator("nearest_known(Tensor known) -> Tensor", fake=_empty_indices)
def nearest_known(known: Tensor) -> Tensor:
    """Return for each cell (B, H, W) the flat index i * W + j of the nearest known cell; H * W if there is none.

    By the exact Euclidean distance; of equally near cells, the one with the lowest index.
    """
    _, H, W = known.shape
    size = H * W
    squared, row = _nearest_along_rows(known)
    column = torch.arange(W, device=known.device)
    has_known = known.any(2, keepdim=True).any(1, keepdim=True)
    # Squared distance and index as digits of one integer, whose minimum is the answer.
    key = torch.where(has_known, squared * size + (row * W + column).clamp(0, size - 1), 0)
    best = key.clone()
    for k in range(1, W):
        if may_wait(known.device) and k * k * size > best.max():
            break
        torch.minimum(best[:, :, k:], key[:, :, :-k] + k * k * size, out=best[:, :, k:])
        torch.minimum(best[:, :, :-k], key[:, :, k:] + k * k * size, out=best[:, :, :-k])
    return torch.where(has_known, best % size, size)


def _nearest_along_rows(known: Tensor) -> Tensor:
    """Return the squared distance to the nearest known cell along H, and that cell's row: (2, B, H, W).

    Of two equally near cells the first. A distance beyond the map where the line has no known cell.
    """
    H = known.shape[1]
    far = 2 * sum(known.shape[1:])
    row = torch.arange(H, device=known.device)[None, :, None]
    before = ((row + far) * known - far).cummax(1).values
    after = ((row - far - H) * known + far + H).flip(1).cummin(1).values.flip(1)
    nearest = torch.where(row - before <= after - row, before, after)
    return torch.stack([(row - nearest).square(), nearest])
