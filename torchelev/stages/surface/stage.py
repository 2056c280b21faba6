"""Normals and the analytic rating, which share their windows: in one pass over the map, by C++ or a CUDA kernel.

The equations are in `stages.surface` and `heads`; C++ and CUDA (`torchelev/native/surface`) compute the same.
"""

from __future__ import annotations

import ctypes
import math
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from torchelev.grid import GridConfig
from torchelev.native import kernels
from torchelev.native.library import load
from torchelev.ops import native, on_gpu
from torchelev.ops.define import operator
from torchelev.ops.masks import NOWHERE
from torchelev.ops.native import run
from torchelev.ops.storage import as_bytes, as_mask
from torchelev.plane_fit import MIN_DET, MIN_TRACE, Normals, known_ground, min_spread, normals
from torchelev.stages.surface.config import SurfaceConfig
from torchelev.state import MASKS, MapState
from torchelev.traversability.heads import Critical, PlaneRating, TraversabilityConfig, step_cells, traversability

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

_CONSTANTS = {
    name: f"{value!r}f" for name, value in dict(MIN_DET=MIN_DET, MIN_TRACE=MIN_TRACE, NOWHERE=NOWHERE).items()
}
_NAMES = (*Normals._fields, *PlaneRating._fields)
_SOURCE, _TILE = "surface/surface.cu", (16, 32)  # rows and columns, as in the source
_SUMS = 14  # along each row of a tile, as in the source


def rate_planes(
    elevation: Float[Tensor, "B H W"],
    validity: Bool[Tensor, "B H W"],
    grid: GridConfig,
    surface: SurfaceConfig,
    head: TraversabilityConfig | None,
    into: MapState | None = None,
) -> dict[str, Any]:
    """Return the layers (B, H, W) of `Normals` and, given the analytic head, those of `PlaneRating`, by name.

    Given a state whose masks are bytes, C++ and kernels write into its layers, and the result is empty.
    """
    cells, critical = (0, []) if head is None else (head.cells(grid), list(head.critical))
    settings = surface.radius, cells, grid.resolution, critical
    if not _suits(elevation, max(surface.radius, cells)):
        return dict(zip(_NAMES, _layers(elevation, validity, *settings), strict=False))
    if into is None:
        return dict(zip(_NAMES, _in_one_pass(elevation, validity, *settings), strict=False))
    _write_planes(elevation, as_bytes(validity), [getattr(into, name) for name in _names(cells)], *settings)
    return {}


def _names(cells: int) -> tuple[str, ...]:
    return _NAMES if cells else Normals._fields


def _suits(elevation: Tensor, rim: int) -> bool:
    """Tell whether C++ or a kernel can take a layer, whose gradient they do not compute."""
    wants_gradient = torch.is_grad_enabled() and (torch.compiler.is_compiling() or elevation.requires_grad)
    computes = native.computes(elevation) or on_gpu.computes(elevation, _shared_memory(rim))
    return computes and not wants_gradient


def _layers(
    elevation: Tensor, validity: Tensor, radius: int, cells: int, resolution: float, critical: list[float]
) -> list[Tensor]:
    """Return the layers by the equations; without a head, `cells` is 0."""
    ground = known_ground(elevation, validity, max(radius, cells))
    planes = normals(ground, validity, radius, resolution)
    if cells == 0:
        return [*planes]
    return [*planes, *traversability(ground, validity, cells, resolution, Critical(*critical))]


def _in_one_pass(elevation: Tensor, validity: Tensor, radius: int, cells: int, *others: Any) -> list[Tensor]:
    """Return what `_layers` does, by C++ or a kernel."""
    kinds = [torch.uint8 if name in MASKS else elevation.dtype for name in _names(cells)]
    layers = [elevation.new_empty(elevation.shape, dtype=kind) for kind in kinds]
    _write_planes(elevation, as_bytes(validity), layers, radius, cells, *others)
    return [as_mask(layer) if layer.dtype == torch.uint8 else layer for layer in layers]


@operator(
    "write_planes(Tensor elevation, Tensor known, Tensor(a!)[] layers, int radius, int cells, float resolution, "
    "float[] critical) -> ()",
    lambda *_: None,
)
def _write_planes(
    elevation: Tensor,
    known: Tensor,
    layers: list[Tensor],
    radius: int,
    cells: int,
    resolution: float,
    critical: list[float],
) -> None:
    """Write what `_layers` returns into contiguous layers, masks as bytes; without a head, `cells` is 0."""
    settings, steps = _settings(radius, cells, resolution, critical), min(cells, step_cells(resolution))
    results = [*layers, *[None] * (len(_NAMES) - len(layers))]
    if kernels.work_on(elevation):
        _launch(elevation.contiguous(), known.contiguous(), results, radius, cells, steps, settings)
        return
    library = load("surface/surface.cpp", _CONSTANTS) if elevation.is_cpu else None
    if library is not None and elevation.numel() > 0:
        sizes = *elevation.shape, radius, cells, steps
        run(library.rate_surface, [elevation, known], results, *sizes, ctypes.byref(settings))
        return
    values = _layers(elevation, as_mask(known), radius, cells, resolution, critical)
    for layer, value in zip(layers, values, strict=True):
        layer.copy_(value)


def _launch(
    elevation: Tensor,
    known: Tensor,
    results: list[Tensor | None],
    radius: int,
    cells: int,
    steps: int,
    settings: _Settings,
) -> None:
    """Write the layers by a kernel."""
    (B, *size), rim = elevation.shape, max(radius, cells)
    tiles = math.prod(-(-length // tile) for length, tile in zip(size, _TILE, strict=True))
    arguments = elevation, known, kernels.addresses_of(results), *size, radius, cells, steps, settings
    with torch.cuda.device_of(elevation):
        kernels.launch_blocks(_SOURCE, "rate_surface", B * tiles, _shared_memory(rim), *arguments)


def _shared_memory(rim: int) -> int:
    """Return how much memory a block needs for its tile, whose rim has so many cells [bytes]."""
    rows, columns = (length + 2 * rim for length in _TILE)
    return kernels.SUM_MEMORY + 4 * rows * (columns + _SUMS * _TILE[1])


class _Settings(ctypes.Structure):
    """`Settings` of surface.cu, whose first six are those of surface.cpp."""

    _fields_ = (
        ("per_cell", ctypes.c_float),
        ("min_spread", ctypes.c_float * 2),
        *((name, ctypes.c_float) for name in ("per_slope", "per_step", "per_roughness", "min_det", "min_trace")),
    )


def _settings(radius: int, cells: int, resolution: float, critical: list[float]) -> _Settings:
    spreads = (ctypes.c_float * 2)(min_spread(radius), min_spread(cells))
    return _Settings(1 / resolution, spreads, *(1 / value for value in critical or 3 * [1.0]), MIN_DET, MIN_TRACE)
