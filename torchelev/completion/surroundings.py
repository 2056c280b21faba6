"""The known ground around a cell: the next known cells in eight directions."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.ops.library import operator

if TYPE_CHECKING:
    from jaxtyping import Float, Int

# Rows and columns of a step; each direction is followed by the opposite one. Quarter turns and mirrors permute them.
DIRECTIONS = ((1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, -1), (1, -1), (-1, 1))
REACHES = (0.3, 0.8)  # [m] beyond the next known cell, where the ground is read once more, for its slope
NONE = 2**28  # [steps] where a direction holds no known cell; more than any map is wide
UNKNOWN = 1e7  # [m] above all ground


class Surroundings(NamedTuple):
    """The known ground in eight directions from n cells. Values are 0 where there is none."""

    is_known: Float[Tensor, "8 n"]  #: 1 where the direction holds a known cell, other than the cell itself, else 0
    distance: Float[Tensor, "8 n"]  #: [m] of the next one
    height: Float[Tensor, "8 n"]  #: [m] of it
    slope: Float[Tensor, "R 8 n"]  #: rise over run towards the cell, of the ground from each of REACHES beyond it
    has_slope: Float[Tensor, "R 8 n"]  #: 1 where the ground at that reach is known, too, else 0


def _empty_steps(known: Tensor) -> Tensor:
    return known.new_empty(len(DIRECTIONS), *known.shape, dtype=torch.int32)


@operator("count_steps(Tensor known) -> Tensor", fake=_empty_steps)
def count_steps(known: Tensor) -> Tensor:
    """Count the steps (8, B, H, W) int32 from each cell to the next known one in DIRECTIONS; NONE: there is none.

    By doubling: what the cell 2^k steps on sees within 2^k steps, this one sees within 2^(k + 1).
    """
    H, W = known.shape[1:]
    at_cells = torch.where(known, 0, NONE).to(torch.int32)
    steps = torch.full((len(DIRECTIONS), *known.shape), NONE, dtype=torch.int32, device=known.device)
    for (di, dj), counted in zip(DIRECTIONS, steps, strict=True):
        within, reach = at_cells.clone(), 1
        while reach < min(H if di else W, W if dj else H):
            here, there = _overlap(within, reach * di, reach * dj)
            torch.minimum(here, there + reach, out=here)
            reach *= 2
        here, there = _overlap(counted, di, dj)[0], _overlap(within, di, dj)[1]
        torch.clamp(there + 1, max=NONE, out=here)
    return steps


def _overlap(values: Tensor, i: int, j: int) -> tuple[Tensor, Tensor]:
    """Return views of the cells (B, h, w) whose neighbour at offset (i, j) is inside, and of these neighbours."""
    H, W = values.shape[1:]
    here = values[:, max(0, -i) : H - max(0, i), max(0, -j) : W - max(0, j)]
    there = values[:, max(0, i) : H + min(0, i), max(0, j) : W + min(0, j)]
    return here, there


def look_around(
    ground: Float[Tensor, "B H W"],
    steps: Int[Tensor, "8 B H W"],
    place: Int[Tensor, "n"],
    resolution: float,
) -> Surroundings:
    """Return the known ground around cells.

    Args:
        ground: [m] elevation, UNKNOWN where it does not count.
        steps: of `count_steps`.
        place: numbers of the cells in the flat maps.
        resolution: [m].
    """
    H, W = ground.shape[1:]
    place = place.to(torch.int32)
    rows, columns = _directions(place.device)
    stride = rows * W + columns
    lengths = resolution * (rows.square() + columns.square()).to(ground.dtype).sqrt()
    steps, room = steps.flatten(1).index_select(1, place).to(torch.int32), _count_room(place, H, W)
    ground = ground.flatten()

    def read(steps: Tensor) -> tuple[Tensor, Tensor]:
        """Return the heights at these numbers of steps, 0 where unknown, and whether they are known, 1 or 0."""
        inside = (steps <= room).to(torch.int32)
        heights = ground.index_select(0, (place + stride * (steps * inside)).flatten()).view(steps.shape)
        found = (heights < UNKNOWN).to(heights.dtype) * inside
        return heights * found, found

    height, is_known = read(steps)
    slopes, has_slope = [], []
    for reach in REACHES:
        more = (reach / lengths).round().clamp(min=3)
        far, found = read(steps + more.to(torch.int32))
        slopes.append((height - far) * found / (more * lengths))
        has_slope.append(found)
    distance = steps * lengths * is_known
    return Surroundings(is_known, distance, height, torch.stack(slopes), torch.stack(has_slope))


def _directions(device: torch.device) -> tuple[Int[Tensor, "8 1"], Int[Tensor, "8 1"]]:
    """Return the rows and columns of DIRECTIONS; computed, as a copy to a GPU would make the host wait."""
    k = torch.arange(len(DIRECTIONS), device=device, dtype=torch.int32)[:, None]
    pair, sign = k // 2, 1 - 2 * (k % 2)
    return sign * (pair != 1), sign * ((pair > 0).to(torch.int32) - 2 * (pair == 3))


def _count_room(place: Int[Tensor, "n"], H: int, W: int) -> Int[Tensor, "8 n"]:
    """Return how many steps in each direction end inside the map."""
    i, j = place // W % H, place % W
    room = {(1, 0): H - 1 - i, (-1, 0): i, (0, 1): W - 1 - j, (0, -1): j}
    return torch.stack(
        [room[di, dj] if di == 0 or dj == 0 else torch.minimum(room[di, 0], room[0, dj]) for di, dj in DIRECTIONS]
    )
