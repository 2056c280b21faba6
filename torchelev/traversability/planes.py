"""Normals and the analytic rating, which share their windows: on a CPU in one pass over the map, in C++.

The equations are in `stages.surface` and `heads`; C++ (`torchelev/native/surface`) computes the same.
"""

from __future__ import annotations

import ctypes
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from torchelev.grid import GridConfig
from torchelev.native.library import load
from torchelev.ops.define import operator
from torchelev.ops.masks import NOWHERE
from torchelev.ops.native import computes, run
from torchelev.ops.storage import as_bytes, as_mask
from torchelev.stages.surface import MIN_DET, MIN_TRACE, Normals, SurfaceConfig, known_ground, min_spread, normals
from torchelev.traversability.heads import Critical, PlaneRating, TraversabilityConfig, traversability

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

_CONSTANTS = {
    name: f"{value!r}f" for name, value in dict(MIN_DET=MIN_DET, MIN_TRACE=MIN_TRACE, NOWHERE=NOWHERE).items()
}
_NAMES = (*Normals._fields, *PlaneRating._fields)


def rate_planes(
    elevation: Float[Tensor, "B H W"],
    validity: Bool[Tensor, "B H W"],
    grid: GridConfig,
    surface: SurfaceConfig,
    head: TraversabilityConfig | None,
) -> dict[str, Any]:
    """Return the layers (B, H, W) of `Normals` and, given the analytic head, those of `PlaneRating`, by name."""
    cells, critical = (0, []) if head is None else (head.cells(grid), list(head.critical))
    compute = _in_one_pass if _suits(elevation) else _layers
    layers = compute(elevation, validity, surface.radius, cells, grid.resolution, critical)
    return dict(zip(_NAMES, layers, strict=False))


def _suits(elevation: Tensor) -> bool:
    """Tell whether C++ can take a layer, whose gradient it does not compute."""
    wants_gradient = torch.is_grad_enabled() and (torch.compiler.is_compiling() or elevation.requires_grad)
    return computes(elevation) and not wants_gradient


def _layers(
    elevation: Tensor, validity: Tensor, radius: int, cells: int, resolution: float, critical: list[float]
) -> list[Tensor]:
    """Return the layers by the equations; without a head, `cells` is 0."""
    ground = known_ground(elevation, validity, max(radius, cells))
    planes = normals(ground, validity, radius, resolution)
    if cells == 0:
        return [*planes]
    return [*planes, *traversability(ground, validity, cells, resolution, Critical(*critical))]


def _in_one_pass(elevation: Tensor, validity: Tensor, *settings: Any) -> list[Tensor]:
    """Return what `_layers` does, by C++."""
    layers = _rate_planes(elevation, as_bytes(validity), *settings)
    return [as_mask(layer) if layer.dtype == torch.uint8 else layer for layer in layers]


def _fake(
    elevation: Tensor, known: Tensor, radius: int, cells: int, resolution: float, critical: list[float]
) -> list[Tensor]:
    return _empty_layers(elevation, cells)


@operator(
    "rate_planes(Tensor elevation, Tensor known, int radius, int cells, float resolution, float[] critical) "
    "-> Tensor[]",
    _fake,
)
def _rate_planes(
    elevation: Tensor, known: Tensor, radius: int, cells: int, resolution: float, critical: list[float]
) -> list[Tensor]:
    """Return what `_layers` does, masks as bytes; without a head, `cells` is 0."""
    library = load("surface/surface.cpp", _CONSTANTS)
    if library is None or elevation.numel() == 0:
        layers = _layers(elevation, as_mask(known), radius, cells, resolution, critical)
        return [as_bytes(layer) if layer.dtype == torch.bool else layer for layer in layers]
    layers = _empty_layers(elevation, cells)
    tensors = [elevation, known, *layers, *[None] * (len(_NAMES) - len(layers))]
    numbers = resolution, min_spread(radius), min_spread(cells), *(critical or 3 * [1.0])
    run(library.rate_surface, tensors, *elevation.shape, radius, cells, (ctypes.c_float * 6)(*numbers))
    return layers


def _empty_layers(elevation: Tensor, cells: int) -> list[Tensor]:
    number, mask = elevation, torch.empty((), dtype=torch.uint8, device=elevation.device)
    kinds = [number, number, mask, number, mask][: len(_NAMES) if cells else len(Normals._fields)]
    return [kind.new_empty(elevation.shape) for kind in kinds]
