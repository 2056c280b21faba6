"""The update of all cells by CUDA kernels (`torchelev/native/fusion/fusion.cu`), for float32 without a gradient."""

from __future__ import annotations

import ctypes
from collections.abc import Mapping
from typing import NamedTuple

import torch
from torch import Tensor

from torchelev.grid import GridConfig
from torchelev.native import kernels
from torchelev.ops.define import operator
from torchelev.stages.fast_layers import has_kernels
from torchelev.stages.fusion.config import FusionConfig
from torchelev.stages.fusion.native import ARGUMENTS, c_settings, config_of, new_tallies, numbers
from torchelev.stages.fusion.points import CellLayers, HitPoints
from torchelev.stages.fusion.update import Update
from torchelev.state import MapState

OWN = ("variance", "challenger", "time")  # layers of which no cell looks at another's
_ARGUMENTS = ARGUMENTS.format(layers="Tensor[] layers, Tensor(a!)[] new")
_SOURCE = "fusion/fusion.cu"
_POINT_BYTES = 32  # of `Point` in point.h
_FEW = 8  # as in fusion.cu: points of a cell up to which one thread takes it
_HEAVY_THREADS = 2**16  # that share the other cells
_WARP, _TEAM = 32, 8  # threads that share one of the other cells
_MANY_POINTS = 2**20  # of all maps, above which a team shares one, else a warp


def can_update_on_gpu(state: MapState, points: Tensor) -> bool:
    """Tell whether `update_on_gpu` takes the state and its points: float32 on a GPU, without a gradient.

    It adds up in any order, so it is not used where results must repeat.
    """
    fits_in_32_bits = max(points.numel() // 3, state.elevation.numel()) < 2**31
    return fits_in_32_bits and has_kernels(state) and not torch.are_deterministic_algorithms_enabled()


def update_on_gpu(
    points: HitPoints,
    before: CellLayers,
    grid: GridConfig,
    cfg: FusionConfig,
    has_rays: bool,
    into: Mapping[str, Tensor] | None = None,
) -> Update:
    """Update all cells; arguments are those of `update_all`.

    `into`: layers that get the results instead of new ones. They may be those before if they are among `OWN`.
    """
    hits = (*points[:-1], points.cells.inside, points.cells.slot)
    new = CellLayers(*(torch.empty_like(layer, memory_format=torch.contiguous_format) for layer in before))
    new = new._replace(**(into or {}))
    used, ignored = _update(*hits, list(before), list(new), grid.resolution, grid.width, has_rays, numbers(cfg))
    return Update(new, used, ignored)


@operator(f"update_cells_on_gpu({_ARGUMENTS}) -> (Tensor, Tensor)", new_tallies)
def _update(
    points: Tensor,
    noise: Tensor,
    shared: Tensor | None,
    origin: Tensor,
    inside: Tensor,
    slot: Tensor,
    layers: list[Tensor],
    new: list[Tensor],
    resolution: float,
    width: int,
    has_rays: bool,
    settings: list[float],
) -> tuple[Tensor, Tensor]:
    """Write all layers (B, C) into contiguous new ones, and return the points used and ignored (B,)."""
    (B, M), C = slot.shape, layers[0].shape[1]
    own, layers = c_settings(config_of(tuple(settings)), resolution, has_rays), [layer.contiguous() for layer in layers]
    points, noise, origin, inside, slot = (
        value.contiguous() for value in (points.transpose(1, 2), noise, origin, inside, slot)
    )
    shared = None if shared is None else shared.contiguous()
    with torch.cuda.device_of(points):
        hits = kernels.addresses_of([points, noise, shared, origin, inside, slot])
        cells, in_scan, memory = _sort(hits, slot, layers[0], origin.shape[1], own)
        tallies = slot.new_zeros(B), slot.new_zeros(B)
        heavy = slot.new_empty(B * M // _FEW, dtype=torch.int32), slot.new_zeros(1, dtype=torch.int32)
        maps = [kernels.addresses_of(values) for values in (layers, [*new, *tallies], heavy)]
        update = cells, in_scan, *maps, C // width, width, own
        kernels.launch(_SOURCE, "update_cells", B, C, *update)
        team = _TEAM if B * M > _MANY_POINTS else _WARP
        kernels.launch(_SOURCE, "update_heavy_cells", 1, _HEAVY_THREADS, *update, _HEAVY_THREADS, team)
        del memory  # not before: `cells` holds nothing but its addresses
    return tallies


class _Sorted(NamedTuple):
    """The points of each cell, one after the other."""

    cells: ctypes.Structure  #: `Sorted` of fusion.cu
    in_scan: Tensor  #: (B, C) [m] their mean height
    memory: tuple[Tensor, ...]  #: that `cells` points to


def _sort(hits: ctypes.Structure, slot: Tensor, like: Tensor, sensors: int, settings: ctypes.Structure) -> _Sorted:
    """Bring the points of each cell together."""
    (B, M), C = slot.shape, like.shape[1]
    gathered = slot.new_empty(B * M * _POINT_BYTES, dtype=torch.uint8)
    in_scan = torch.empty_like(like)
    memory = 4 * (C + kernels.LARGE_BLOCK)
    if kernels.suits_blocks(like.get_device(), B, memory):
        counts, ends = (slot.new_empty(B, C, dtype=torch.int32) for _ in range(2))
        scan = hits, counts, ends, gathered, in_scan
        kernels.launch_blocks(_SOURCE, "sort_in_block", B, memory, *scan, M, sensors, C, settings)
        return _Sorted(kernels.addresses_of([gathered, ends, counts]), in_scan, (gathered, ends, counts))
    counts, numbers_in_cell = slot.new_zeros(B, C, dtype=torch.int32), torch.empty_like(slot, dtype=torch.int32)
    kernels.launch(_SOURCE, "count_points", B, M, hits, counts, numbers_in_cell, M, C)
    ends = counts.flatten().cumsum(0, dtype=torch.int32)
    cells = kernels.addresses_of([gathered, ends, counts])
    kernels.launch(_SOURCE, "sort_points", B, M, hits, numbers_in_cell, cells, gathered, M, sensors, C, settings)
    kernels.launch(_SOURCE, "average_points", B, C, cells, in_scan, C)
    return _Sorted(cells, in_scan, (gathered, ends, counts))
