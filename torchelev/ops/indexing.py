"""Reading and writing cells by index: all of them, or the few that a mask selects."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchelev.ops.transforms import is_readable

if TYPE_CHECKING:
    from jaxtyping import Bool, Int, Shaped


def read(layer: Shaped[Tensor, "B *C"], index: Int[Tensor, "B *I"]) -> Shaped[Tensor, "B *I"]:
    """Return the layer's value at each flat index; the layer is stored first, not recomputed for each index."""
    values = layer.flatten(1)
    if index.ndim == 2:
        return values.gather(1, index)
    return values.gather(1, index.flatten(1).to(torch.int64)).view_as(index)


def tabulate(function: Callable[[Tensor], list[Tensor]], k: Tensor, size: int) -> list[Tensor]:
    """Return a function's values at whole numbers k in [0, size), given as floats.

    They are computed once for each number and looked up.
    """
    index = k.to(torch.int32).flatten()
    table = function(torch.arange(size, device=k.device, dtype=k.dtype))
    return [values.index_select(0, index).view_as(k) for values in table]


class SelectedCells:
    """The K cells that a mask selects, numbered across environments.

    On a GPU, where the host would have to wait to learn how many there are, all cells are selected.
    """

    def __init__(self, selected: Bool[Tensor, "B C"]) -> None:
        self.selected = selected
        self.cells = selected.flatten().nonzero().squeeze(1) if can_select(selected) else all_cells(selected)

    def of(self, layer: Tensor) -> Tensor:
        """Read a layer (B, C) at the selected cells: -> (K,)."""
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
        return [self.put(layer, value) for layer, value in zip(layers, values, strict=True)]


def select_points(
    cells: Bool[Tensor, "B C"], slot: Int[Tensor, "B M"], columns: list[Tensor]
) -> tuple[Tensor, Tensor, list[Tensor]]:
    """Return the selected cells (K,), and of their points (P,) the place of the cell among these, and the columns.

    On a GPU all cells and all points.
    """
    if can_select(cells):
        selected = cells.flatten().nonzero().squeeze(1)
        inside = cells.gather(1, slot).flatten().nonzero().squeeze(1)
        cell = slot.flatten().index_select(0, inside) + inside // slot.shape[1] * cells.shape[1]
        owner = torch.searchsorted(selected, cell)
        return selected, owner, [column.flatten().index_select(0, inside) for column in columns]
    first = torch.arange(cells.shape[0], device=cells.device)[:, None] * cells.shape[1]
    return all_cells(cells), (slot + first).flatten(), [column.flatten() for column in columns]


def can_select(values: Tensor) -> bool:
    """Return whether the host may learn how many cells are selected."""
    return is_readable(values)


def all_cells(layer: Tensor) -> Tensor:
    """Number all cells."""
    return torch.arange(layer.numel(), device=layer.device)
