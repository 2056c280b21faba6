"""Reading the map: layers by name, and samples at points."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchelev.grid import GridConfig
from torchelev.state import MapState

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

Layer = tuple[Tensor, Tensor]  # values and where they are known, both (B, H, W)


def _normal(state: MapState, axis: int) -> Layer:
    gx, gy = state.gradient_x, state.gradient_y
    component = (-gx, -gy, torch.ones_like(gx))[axis]
    return component / (1 + gx.square() + gy.square()).sqrt(), state.validity


def _upper_bound(state: MapState) -> Layer:
    return torch.where(state.validity, state.elevation, state.upper_bound), state.validity | state.bounded


def _validity(state: MapState) -> Layer:
    return state.validity.to(state.elevation.dtype), torch.ones_like(state.validity)


LAYERS: dict[str, Callable[[MapState], Layer]] = {
    "elevation": lambda state: (state.elevation, state.validity),
    "variance": lambda state: (state.variance, state.validity),
    "validity": _validity,
    "time": lambda state: (state.time, state.validity),
    "upper_bound": _upper_bound,
    "traversability": lambda state: (state.traversability, state.validity),
    "normal_x": lambda state: _normal(state, 0),
    "normal_y": lambda state: _normal(state, 1),
    "normal_z": lambda state: _normal(state, 2),
}


def sample_layer(
    layer: Layer, uv: Float[Tensor, "B M 2"], grid: GridConfig, mode: str
) -> tuple[Float[Tensor, "B M"], Bool[Tensor, "B M"]]:
    """Sample a layer at `uv`, in cells from the window's corner. Returns values (0 where not valid) and validity.

    Bilinear: weights of the known ones of the four surrounding cells, renormalised; valid from a weight of one half.
    Nearest: the cell that holds the point.
    """
    finite = torch.isfinite(uv).all(-1, keepdim=True)
    uv = torch.where(finite, uv.clamp(-1e6, 1e6), -1e6)
    if mode == "nearest":
        return _read_cells(layer, torch.floor(uv), grid)
    low = torch.floor(uv - 0.5)
    (u, v), (i, j) = (uv - 0.5 - low).unbind(-1), low.unbind(-1)
    # All four corners at once: (B, M, 4).
    weight = torch.stack([(1 - u) * (1 - v), (1 - u) * v, u * (1 - v), u * v], -1)
    cell = torch.stack([torch.stack([i, i, i + 1, i + 1], -1), torch.stack([j, j + 1, j, j + 1], -1)], -1)
    value, known = (corners.view_as(weight) for corners in _read_cells(layer, cell.flatten(1, 2), grid))
    weight = torch.where(known, weight, 0.0)
    total, weighted = weight.sum(-1), (weight * value).sum(-1)
    valid = total >= 0.5
    return torch.where(valid, weighted / torch.where(valid, total, 1.0), 0.0), valid


def _read_cells(layer: Layer, cell: Tensor, grid: GridConfig) -> Layer:
    values, known = layer
    i, j = cell.unbind(-1)
    inside = (i >= 0) & (i < grid.height) & (j >= 0) & (j < grid.width)
    index = torch.where(inside, i * grid.width + j, 0).to(torch.int64)
    known = known.flatten(1).gather(1, index) & inside
    # A masked read: what an unknown cell holds must not reach values or gradients.
    return torch.where(known, values.flatten(1).gather(1, index), 0.0), known
