"""Voxels in C++ (`voxels.cpp`), on a CPU and of float32 maps: as by tensors (`voxel_crop.py`)."""

from __future__ import annotations

import ctypes
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchelev.kernels.cpu_build import call, load
from torchelev.levels.module import MapLevels
from torchelev.observations.image_kernel import _Images
from torchelev.observations.patterns import ALIGNMENTS, Pattern
from torchelev.ops.transforms import can_compute_unseen
from torchelev.state import MapState

if TYPE_CHECKING:
    from jaxtyping import Float, UInt8

LIBRARY: tuple[str, dict[str, str]] = ("observations/kernel/voxels.cpp", {})
_GROUND = ("elevation", "upper_bound", "validity", "bounded")
_LEVELS = ("lower", "upper", "support", "free_top")


class _Voxels(ctypes.Structure):
    """`Voxels` of voxels.cpp."""

    _fields_ = (
        ("place", _Images),
        *((name, ctypes.c_void_p) for name in (*_GROUND, *_LEVELS, "voxels")),
        *((name, ctypes.c_int64) for name in "LZ"),
        *((name, ctypes.c_float) for name in ("step", "offset", "min_support")),
    )


class _Distances(ctypes.Structure):
    """`Voxels` of distances.h."""

    _fields_ = (
        *((name, ctypes.c_void_p) for name in ("states", "distances")),
        *((name, ctypes.c_int64) for name in ("B", "X", "Y", "Z", "reach")),
        *((name, ctypes.c_float) for name in ("step", "max_distance")),
        ("occupied", ctypes.c_uint8),
    )


def can_read(T_map_base: Tensor, state: MapState, levels: MapLevels) -> bool:
    """Return whether `read_voxels` takes the maps: float32 on a CPU, and nothing to differentiate."""
    tensors = [T_map_base, state.corner, *(getattr(state, n) for n in _GROUND), *levels.stored]
    is_plain = state.elevation.dtype == torch.float32 and all(value.is_contiguous() for value in tensors[2:])
    # Levels that have not followed the window yet lie elsewhere.
    is_plain = is_plain and levels.lower.dtype == torch.float32
    return is_plain and can_compute_unseen(tensors) and load(*LIBRARY) is not None


def read_voxels(
    T_map_base: Tensor, state: MapState, levels: MapLevels, pattern: Pattern, num_z: int, step: float, offset: float
) -> UInt8[Tensor, "B P Z"]:
    """Return the states of the voxels in columns at the points of a pattern, what `VoxelCrop` reads by tensors."""
    library = load(*LIBRARY)
    assert library is not None and levels.cfg.levels is not None
    grid = levels.cfg.grid
    poses, corner = T_map_base.detach().double().contiguous(), state.corner.contiguous()
    points = pattern.on(corner.device, torch.float32)
    B, P = len(poses), len(points)
    voxels = torch.empty(B, P, num_z, dtype=torch.uint8)
    is_single = T_map_base.dtype != torch.float64
    place = _Images(
        *(value.data_ptr() for value in (poses, corner, points)),
        *(None, None, grid.resolution),
        *(B, P, 0, 0, grid.height, grid.width),
        *(0, ALIGNMENTS.index(pattern.alignment), is_single, 0.0),
    )
    ground = (getattr(state, name).data_ptr() for name in _GROUND)
    stored = (getattr(levels, name).data_ptr() for name in _LEVELS)
    numbers = (levels.cfg.levels.others, num_z, step, offset, levels.cfg.levels.least_support)
    settings = _Voxels(place, *ground, *stored, voxels.data_ptr(), *numbers)
    call(library.read_voxels, ctypes.byref(settings), torch.get_num_threads())
    return voxels


def can_measure(states: Tensor) -> bool:
    """Return whether `measure_distances` takes the states of voxels."""
    return can_compute_unseen([states]) and load(*LIBRARY) is not None


def measure_distances(
    states: UInt8[Tensor, "B X Y Z"], occupied: int, reach: int, step: float, max_distance: float
) -> Float[Tensor, "B X Y Z"]:
    """Return the signed distances [m] to the voxels of a state, what `VoxelCrop` measures by tensors."""
    library = load(*LIBRARY)
    assert library is not None
    states = states.contiguous()
    distances = torch.empty(states.shape)
    sizes = (*states.shape, min(reach, sum(states.shape[1:])))  # nothing is farther
    settings = _Distances(states.data_ptr(), distances.data_ptr(), *sizes, step, max_distance, occupied)
    call(library.measure_distances, ctypes.byref(settings), torch.get_num_threads())
    return distances
