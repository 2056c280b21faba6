"""Ray casting in C++ (`torchelev/sim/sensors/kernel`): the same as `trace` and the boxes, several times as fast."""

from __future__ import annotations

import ctypes

import torch
from torch import Tensor

from torchelev.kernels.cpu_build import call, load
from torchelev.ops.transforms import can_compute_unseen
from torchelev.sim.cpp_library import address
from torchelev.sim.terrains.heightfield import HeightField

LIBRARY: tuple[str, dict[str, str]] = ("sim/sensors/kernel/casting.cpp", {})
_FARTHEST = 2.0**23  # [cells]


def cast(
    field: HeightField, tile_ids: Tensor, origin: Tensor, directions: Tensor, max_range: float, solids: Tensor
) -> Tensor | None:
    """Return the distance [m] (B, M) to the ground or a box, more than `max_range` where a ray hits neither within it.

    None where C++ cannot compute it.

    Args:
        field: terrain tiles.
        tile_ids: the tile of each environment, (B,) int64.
        origin: of the rays [m], (B, 3) float32.
        directions: of the rays, (B, M, 3) float32.
        max_range: [m].
        solids: K boxes in each environment, (B, K, 15) float32: their axes, the rays' origin in their frame [m], and
            half their sides [m], NaN if there is no box.
    """
    library = _find_library(field, tile_ids, origin, directions)
    if library is None:
        return None
    start = torch.cat([origin[:, :2] / field.resolution + field.middle, origin[:, 2:]], 1).nan_to_num(0.0, 0.0, 0.0)
    start[:, :2].clamp_(-_FARTHEST, _FARTHEST)  # float32 cannot count cells farther out, where the ground is level
    distance = directions.new_empty(directions.shape[:2])
    inputs = (*_tiles(field), tile_ids, start, directions, solids)
    arrays = [*(value.contiguous() for value in inputs), distance]
    sizes = [*(size - 1 for size in field.padded.shape[1:]), *distance.shape, solids.shape[1]]
    numbers = [ctypes.c_float(field.resolution), ctypes.c_float(max_range)]
    call(library.cast, *map(address, arrays), int(field.surface), *sizes, *numbers, torch.get_num_threads())
    return distance


def see(
    field: HeightField, tile_ids: Tensor, T_map_sensor: Tensor, rays: Tensor, min_range: float, max_range: float
) -> Tensor | None:
    """Return the points (B, M, 3) [m] that sensors see, in their frame; None where C++ cannot compute them.

    Args:
        field: terrain tiles.
        tile_ids: the tile of each environment, (B,) int64.
        T_map_sensor: poses of the sensors, (B, 4, 4) float32.
        rays: unit vectors in the sensors' frame, (M, 3) float32.
        min_range: [m] points nearer than this are NaN, as are those that are hit nowhere.
        max_range: [m].
    """
    library = _find_library(field, tile_ids, T_map_sensor, rays)
    if library is None:
        return None
    points = rays.new_empty(len(tile_ids), *rays.shape)
    inputs = (*_tiles(field), tile_ids, T_map_sensor, rays)
    arrays = [*(value.contiguous() for value in inputs), points]
    sizes = [*(size - 1 for size in field.padded.shape[1:]), *points.shape[:2]]
    numbers = [ctypes.c_float(value) for value in (field.resolution, min_range, max_range)]
    call(library.see, *map(address, arrays), int(field.surface), *sizes, *numbers, torch.get_num_threads())
    return points


def _find_library(field: HeightField, *values: Tensor) -> ctypes.CDLL | None:
    fits = can_compute_unseen((field.padded, *values)) and len(field.bounds.highest) < 2**31
    return load(*LIBRARY) if fits else None


def _tiles(field: HeightField) -> tuple[Tensor, ...]:
    return field.padded, field.bounds.highest, field.bounds.first, field.bounds.size
