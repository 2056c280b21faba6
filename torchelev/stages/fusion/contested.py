"""Cells whose points disagree: their robust mean, their step if they hold one, and how to work on them alone.

Few cells are contested, but each costs several rounds over its points. So a CPU picks out those cells and their points;
a GPU, which would have to wait for the host to learn how many there are, goes through all. Nothing here has a
gradient: a height is an estimate around which `fuse` averages.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

if TYPE_CHECKING:
    from jaxtyping import Float, Int, UInt8


NO_HEIGHT = -1e30  # [m] below all heights


class CellHeights(NamedTuple):
    """The height that the scan and the map show of each cell, (B, C) [m]; NO_HEIGHT where they show none."""

    scan: Float[Tensor, "B C"]  #: mean of the points
    map: Float[Tensor, "B C"]  #: [m] elevation


@torch.library.custom_op(
    "torchelev::pick_out", mutates_args=(), schema="(Tensor cells, Tensor slot, Tensor[] columns) -> Tensor[]"
)
def select_points(cells: UInt8[Tensor, "B C"], slot: Int[Tensor, "B M"], columns: list[Tensor]) -> list[Tensor]:
    """Pick out the cells that are not zero, and their points.

    Returns these cells (K,), numbered across environments, and of each point in one of them (P,) the place of its cell
    among these K, and the point's value of each column (B, M). A custom operator, as the compiler must not look into
    what depends on the data; it compiles what follows for any K and P.
    """
    contested = cells.flatten().nonzero().squeeze(1)
    picked = cells.gather(1, slot).flatten().nonzero().squeeze(1)
    cell = slot.flatten().index_select(0, picked) + picked // slot.shape[1] * cells.shape[1]
    owner = torch.searchsorted(contested, cell)
    return [contested, owner, *(column.flatten().index_select(0, picked) for column in columns)]


@select_points.register_fake
def _(cells: Tensor, slot: Tensor, columns: list[Tensor]) -> list[Tensor]:
    context = torch.library.get_ctx()
    K, P = context.new_dynamic_size(), context.new_dynamic_size()
    return [slot.new_empty(K), slot.new_empty(P), *(column.new_empty(P) for column in columns)]


@torch.library.custom_op("torchelev::pick_cells", mutates_args=())
def select_cells(cells: Tensor) -> Tensor:
    """Return which cells (B, C) are not zero (K,), numbered across environments."""
    return cells.flatten().nonzero().squeeze(1)


@select_cells.register_fake
def _(cells: Tensor) -> Tensor:
    return cells.new_empty(torch.library.get_ctx().new_dynamic_size(), dtype=torch.int64)


@torch.library.custom_op(
    "torchelev::put_in", mutates_args=(), schema="(Tensor[] layers, Tensor cells, Tensor[] values) -> Tensor[]"
)
def put_in(layers: list[Tensor], cells: Tensor, values: list[Tensor]) -> list[Tensor]:
    """Return layers (B, C) with values (K,) at cells.

    An operator, as the compiler would put it off to the end of the update and hold until then all that it reads.
    """
    pairs = zip(layers, values, strict=True)
    return [layer.flatten().index_copy(0, cells, value).view_as(layer) for layer, value in pairs]


@put_in.register_fake
def _(layers: list[Tensor], cells: Tensor, values: list[Tensor]) -> list[Tensor]:
    return [torch.empty_like(layer) for layer in layers]


class SelectedCells:
    """K cells that are marked, numbered across environments; on a GPU all cells."""

    def __init__(self, marked: UInt8[Tensor, "B C"]) -> None:
        self.marked = marked
        self.cells = select_cells(marked) if self.can_select(marked) else self.all(marked)

    @staticmethod
    def all(marked: Tensor) -> Tensor:
        """Number all cells."""
        return torch.arange(marked.numel(), device=marked.device)

    @staticmethod
    def can_select(values: Tensor) -> bool:
        """Tell whether the host may learn how many cells are picked: of a CPU, unless its tensors hold no data."""
        return values.device.type == "cpu" and (torch.compiler.is_compiling() or type(values) is Tensor)

    def of(self, layer: Tensor) -> Tensor:
        """Read a layer (B, C) at the picked cells: -> (K,)."""
        return layer.flatten().index_select(0, self.cells)

    def put(self, layer: Tensor, values: Tensor) -> Tensor:
        """Return a layer (B, C) with values (K,) put into the picked cells."""
        if not self.can_select(layer):  # K counts the other cells too
            return torch.where(self.marked > 0, values.view_as(layer), layer)
        return layer.flatten().index_copy(0, self.cells, values).view_as(layer)


class ContestedCells(SelectedCells):
    """K contested cells and their P points; on a GPU all cells and all points."""

    def __init__(
        self,
        cells: UInt8[Tensor, "B C"],
        slot: Int[Tensor, "B M"],
        columns: list[Tensor],
        mean: Float[Tensor, "B C"],
    ) -> None:
        """Pick out the cells that are not 0, and of their points z, spread, weight, passed, ray x and ray y.

        A cell of 2 is marked as a step. `mean` is that of the cell's points [m].
        """
        self.marked = cells
        if self.can_select(cells):
            self.cells, self.owner, *columns = select_points(cells, slot, columns)
        else:
            first = torch.arange(cells.shape[0], device=cells.device)[:, None] * cells.shape[1]
            self.cells = self.all(cells)
            self.owner, columns = (slot + first).flatten(), [column.flatten() for column in columns]
        self.mean = self.of(mean)
        z, self.spread, self.weight, self.passed, *self.ray = columns
        self.z = z - self.at_points(self.mean)  # [m] above the mean of the cell's points
        self.used = (self.weight > 0).to(z.dtype)

    def sum(self, values: Tensor) -> Tensor:
        """Sum the points' values (..., P) per cell: -> (..., K)."""
        total = values.new_zeros(*values.shape[:-1], self.cells.shape[0])
        return total.scatter_add_(-1, self.owner.expand(values.shape), values)

    def highest(self, values: Tensor) -> Tensor:
        """Return the highest of the points' values (..., P) per cell: -> (..., K)."""
        highest = values.new_full((*values.shape[:-1], self.cells.shape[0]), -torch.inf)
        return highest.scatter_reduce_(-1, self.owner.expand(values.shape), values, "amax")

    def at_points(self, values: Tensor) -> Tensor:
        """Give each point its cell's value: (..., K) -> (..., P)."""
        return values.index_select(-1, self.owner)

    def any_true(self, mask: Tensor) -> bool:
        """Tell whether anything is true; assume so where the host would have to wait, and in compiled code."""
        return torch.compiler.is_compiling() or not self.can_select(mask) or bool(mask.any())


def ratio(numerator: Tensor, denominator: Tensor) -> Tensor:
    """Divide sums over the points of a cell; zero where there is none."""
    return numerator / denominator.clamp(min=torch.finfo(denominator.dtype).tiny)
