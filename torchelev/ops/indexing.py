"""Reading and writing cells by index: all of them, or the few that a mask selects."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchelev.ops.storage import as_bytes, as_mask, realize

if TYPE_CHECKING:
    from jaxtyping import Bool, Int, Shaped, UInt8


def read(layer: Shaped[Tensor, "B *C"], index: Int[Tensor, "B *I"]) -> Shaped[Tensor, "B *I"]:
    """Return the layer's value at each flat index; the layer is stored first, not computed anew for each index."""
    values = realize(layer).flatten(1)  # in this order, or it would be computed by flat index, with divisions
    if index.ndim == 2:
        return values.gather(1, index)
    if torch.compiler.is_compiling():  # a flat index it would store, or divide to find row and column
        environment = torch.arange(len(index), device=index.device, dtype=index.dtype)[:, None, None]
        return torch.ops.aten._unsafe_index(values, [environment, index])
    return values.gather(1, index.flatten(1).to(torch.int64)).view_as(index)


def tabulate(function: Callable[[Tensor], list[Tensor]], k: Tensor, size: int) -> list[Tensor]:
    """Return a function's values at whole numbers k in [0, size), given as floats.

    Compiled code computes them for each entry; else they are computed once for each number and looked up. Each is the
    faster there.
    """
    if torch.compiler.is_compiling():
        return function(k)
    index = k.to(torch.int32).flatten()
    table = function(torch.arange(size, device=k.device, dtype=k.dtype))
    return [values.index_select(0, index).view_as(k) for values in table]


@torch.library.custom_op(
    "torchelev::pick_out", mutates_args=(), schema="(Tensor cells, Tensor slot, Tensor[] columns) -> Tensor[]"
)
def _select_points(cells: UInt8[Tensor, "B C"], slot: Int[Tensor, "B M"], columns: list[Tensor]) -> list[Tensor]:
    """Select the cells that are not zero, and their points.

    Returns these cells (K,), numbered across environments, and of each point in one of them (P,) the place of its cell
    among these K, and the point's value of each column (B, M). A custom operator, as the compiler must not look into
    what depends on the data; it compiles what follows for any K and P.
    """
    selected = cells.flatten().nonzero().squeeze(1)
    inside = cells.gather(1, slot).flatten().nonzero().squeeze(1)
    cell = slot.flatten().index_select(0, inside) + inside // slot.shape[1] * cells.shape[1]
    owner = torch.searchsorted(selected, cell)
    return [selected, owner, *(column.flatten().index_select(0, inside) for column in columns)]


@_select_points.register_fake
def _(cells: Tensor, slot: Tensor, columns: list[Tensor]) -> list[Tensor]:
    context = torch.library.get_ctx()
    K, P = context.new_dynamic_size(), context.new_dynamic_size()
    return [slot.new_empty(K), slot.new_empty(P), *(column.new_empty(P) for column in columns)]


@torch.library.custom_op("torchelev::pick_cells", mutates_args=())
def _select_cells(cells: Tensor) -> Tensor:
    """Return which cells (B, C) are not zero (K,), numbered across environments."""
    return cells.flatten().nonzero().squeeze(1)


@_select_cells.register_fake
def _(cells: Tensor) -> Tensor:
    return cells.new_empty(torch.library.get_ctx().new_dynamic_size(), dtype=torch.int64)


@torch.library.custom_op(
    "torchelev::put_in", mutates_args=(), schema="(Tensor[] layers, Tensor cells, Tensor[] values) -> Tensor[]"
)
def _put(layers: list[Tensor], cells: Tensor, values: list[Tensor]) -> list[Tensor]:
    """Return layers (B, C) with values (K,) at cells.

    An operator, as the compiler would put it off to the end of the update and hold until then all that it reads.
    """
    pairs = zip(layers, values, strict=True)
    return [layer.flatten().index_copy(0, cells, value).view_as(layer) for layer, value in pairs]


@_put.register_fake
def _(layers: list[Tensor], cells: Tensor, values: list[Tensor]) -> list[Tensor]:
    return [torch.empty_like(layer) for layer in layers]


class SelectedCells:
    """The K cells that a mask selects, numbered across environments.

    On a GPU, where the host would have to wait to learn how many there are, all cells are selected.
    """

    def __init__(self, selected: Bool[Tensor, "B C"]) -> None:
        self.selected = selected
        self.cells = _select_cells(as_bytes(selected)) if can_select(selected) else all_cells(selected)

    def of(self, layer: Tensor) -> Tensor:
        """Read a layer (B, C) at the selected cells: -> (K,)."""
        if layer.dtype == torch.bool:
            return as_bytes(layer).flatten().index_select(0, self.cells) > 0
        return layer.flatten().index_select(0, self.cells)

    def put(self, layer: Tensor, values: Tensor) -> Tensor:
        """Return a layer (B, C) with values (K,) in the selected cells."""
        if not can_select(layer):  # K counts the other cells too
            return torch.where(self.selected, values.view_as(layer), layer)
        return layer.flatten().index_copy(0, self.cells, values).view_as(layer)

    def put_all(self, layers: list[Tensor], values: list[Tensor]) -> list[Tensor]:
        """Return layers (B, C), masks or numbers, with values (K,) in the selected cells; the values elsewhere stay.

        On a GPU the values count in every cell.
        """
        masks = [layer.dtype == torch.bool for layer in layers]
        new = _put(_without_masks(layers), self.cells, _without_masks(values))
        return [as_mask(layer) if mask else layer for layer, mask in zip(new, masks, strict=True)]


def select_points(
    cells: Bool[Tensor, "B C"], slot: Int[Tensor, "B M"], columns: list[Tensor]
) -> tuple[Tensor, Tensor, list[Tensor]]:
    """Return the selected cells (K,), and of their points (P,) the place of the cell among these, and the columns.

    On a GPU all cells and all points.
    """
    columns = _without_masks(columns)
    if can_select(cells):
        selected, owner, *columns = _select_points(as_bytes(cells), slot, columns)
        return selected, owner, columns
    first = torch.arange(cells.shape[0], device=cells.device)[:, None] * cells.shape[1]
    return all_cells(cells), (slot + first).flatten(), [column.flatten() for column in columns]


def _without_masks(layers: list[Tensor]) -> list[Tensor]:
    """Return layers with masks as bytes."""
    return [as_bytes(layer) if layer.dtype == torch.bool else layer for layer in layers]


def can_select(values: Tensor) -> bool:
    """Tell whether the host may learn how many cells are selected: on a CPU, unless its tensors hold no data."""
    return values.device.type == "cpu" and (torch.compiler.is_compiling() or type(values) is Tensor)


def all_cells(layer: Tensor) -> Tensor:
    """Number all cells."""
    return torch.arange(layer.numel(), device=layer.device)
