"""Which cell of the window each point falls into, and where cells lie as seen from a measurement."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.grid import GridConfig, locate
from torchelev.ops.indexing import read
from torchelev.ops.scatter import cell_sums
from torchelev.state import MapState, Measurement

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int


class PointCells(NamedTuple):
    """The cell of each point. Points outside the window are given some cell: mask what is summed by `inside`."""

    slot: Int[Tensor, "B M"]  #: flat cell number of each point
    inside: Bool[Tensor, "B M"]  #: the point lies in the window and measures the ground
    num_cells: int  #: C = H * W

    def sums(self, *columns: Float[Tensor, "B M"]) -> tuple[Float[Tensor, "B C"], ...]:
        """Sum columns of the points' values per cell; they must be zero outside."""
        return cell_sums(self.slot, torch.stack(columns), self.num_cells).unbind(0)

    def take(self, *layers: Tensor) -> list[Tensor]:
        """Give each point its cell's value of each layer: (B, H, W) or (B, C) -> (B, M)."""
        return [read(layer, self.slot) for layer in layers]


def lattice_offset(state: MapState, m: Measurement, grid: GridConfig) -> Float[Tensor, "B 2"]:
    """Return where the measurement's horizontal origin lies, seen from the window's corner [m]."""
    # A cell number fits float32 exactly only as a difference of near ones; far ones are clamped, they are outside.
    cells = (m.anchor - state.corner).clamp(-(2**22), 2**22)
    return cells.to(m.points.dtype) * grid.resolution


def center_offsets(state: MapState, m: Measurement, grid: GridConfig) -> tuple[Tensor, Tensor]:
    """Return x (B, H, 1) and y (B, 1, W) of the cell centres [m], counted from the measurement's horizontal origin."""
    cells = (state.corner - m.anchor).clamp(-(2**22), 2**22).to(m.points.dtype) + 0.5
    x = torch.arange(grid.height, device=cells.device) + cells[:, 0, None]
    y = torch.arange(grid.width, device=cells.device) + cells[:, 1, None]
    return (x * grid.resolution)[:, :, None], (y * grid.resolution)[:, None, :]


def cells_of(state: MapState, m: Measurement, grid: GridConfig) -> PointCells:
    """Find the cell of each point that measures the ground."""
    slot, inside = locate(m.points[..., 0], m.points[..., 1], lattice_offset(state, m, grid), grid)
    return PointCells(slot.to(torch.int64), inside & m.used, grid.num_cells)
