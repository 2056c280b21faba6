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
from torchelev.stages.surface import MIN_DET, MIN_TRACE, Normals, SurfaceConfig, known_ground, min_spread, normals
from torchelev.traversability.heads import Critical, PlaneRating, TraversabilityConfig, traversability

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

_CONSTANTS = {
    name: f"{value!r}f" for name, value in dict(MIN_DET=MIN_DET, MIN_TRACE=MIN_TRACE, NOWHERE=NOWHERE).items()
}
_NAMES = (*Normals._fields, *PlaneRating._fields)
_SOURCE, _TILE = "surface/surface.cu", (16, 32)  # rows and columns, as in the source
_LARGEST_RIM = 32  # [cells] of a tile whose heights fit into what threads share


def rate_planes(
    elevation: Float[Tensor, "B H W"],
    validity: Bool[Tensor, "B H W"],
    grid: GridConfig,
    surface: SurfaceConfig,
    head: TraversabilityConfig | None,
) -> dict[str, Any]:
    """Return the layers (B, H, W) of `Normals` and, given the analytic head, those of `PlaneRating`, by name."""
    cells, critical = (0, []) if head is None else (head.cells(grid), list(head.critical))
    compute = _in_one_pass if _suits(elevation, max(surface.radius, cells)) else _layers
    layers = compute(elevation, validity, surface.radius, cells, grid.resolution, critical)
    return dict(zip(_NAMES, layers, strict=False))


def _suits(elevation: Tensor, rim: int) -> bool:
    """Tell whether C++ or a kernel can take a layer, whose gradient they do not compute."""
    wants_gradient = torch.is_grad_enabled() and (torch.compiler.is_compiling() or elevation.requires_grad)
    computes = native.computes(elevation) or (rim <= _LARGEST_RIM and on_gpu.computes(elevation))
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


def _in_one_pass(elevation: Tensor, validity: Tensor, *settings: Any) -> list[Tensor]:
    """Return what `_layers` does, by C++ or a kernel."""
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
    layers = _empty_layers(elevation, cells)
    if kernels.work_on(elevation):
        _launch(elevation, known, layers, radius, cells, resolution, critical)
        return layers
    library = load("surface/surface.cpp", _CONSTANTS)
    if library is None or elevation.numel() == 0:
        layers = _layers(elevation, as_mask(known), radius, cells, resolution, critical)
        return [as_bytes(layer) if layer.dtype == torch.bool else layer for layer in layers]
    settings = ctypes.byref(_settings(radius, cells, resolution, critical))
    run(library.rate_surface, [elevation, known, *_padded(layers)], *elevation.shape, radius, cells, settings)
    return layers


def _launch(
    elevation: Tensor,
    known: Tensor,
    layers: list[Tensor],
    radius: int,
    cells: int,
    resolution: float,
    critical: list[float],
) -> None:
    """Write the layers by a kernel."""
    (B, *size), rim = elevation.shape, max(radius, cells)
    tiles = math.prod(-(-length // tile) for length, tile in zip(size, _TILE, strict=True))
    memory = 4 * math.prod(tile + 2 * rim for tile in _TILE)
    results, settings = kernels.addresses_of(_padded(layers)), _settings(radius, cells, resolution, critical)
    with torch.cuda.device_of(elevation):
        arguments = elevation.contiguous(), known.contiguous(), results, *size, radius, cells, settings
        kernels.launch_blocks(_SOURCE, "rate_surface", B * tiles, memory, *arguments)


class _Settings(ctypes.Structure):
    """`Settings` of surface.cu, whose first six are those of surface.cpp."""

    _fields_ = (
        ("resolution", ctypes.c_float),
        ("min_spread", ctypes.c_float * 2),
        *((name, ctypes.c_float) for name in (*Critical._fields, "min_det", "min_trace")),
    )


def _settings(radius: int, cells: int, resolution: float, critical: list[float]) -> _Settings:
    spreads = (ctypes.c_float * 2)(min_spread(radius), min_spread(cells))
    return _Settings(resolution, spreads, *(critical or 3 * [1.0]), MIN_DET, MIN_TRACE)


def _padded(layers: list[Tensor]) -> list[Tensor | None]:
    """Return the layers of the results, None where there is no head."""
    return [*layers, *[None] * (len(_NAMES) - len(layers))]


def _empty_layers(elevation: Tensor, cells: int) -> list[Tensor]:
    number, mask = elevation, torch.empty((), dtype=torch.uint8, device=elevation.device)
    kinds = [number, number, mask, number, mask][: len(_NAMES) if cells else len(Normals._fields)]
    return [kind.new_empty(elevation.shape) for kind in kinds]
