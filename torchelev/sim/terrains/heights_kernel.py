"""Heights of fields in C++ (`torchelev/sim/sensors/kernel`), for float32 on a CPU without gradients: as by tensors."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from typing import Protocol

import torch
from torch import Tensor

from torchelev.kernels.cpu_build import call
from torchelev.sim.cpp_library import find_library
from torchelev.sim.terrains.surfaces import Surface

LIBRARY: tuple[str, dict[str, str]] = ("sim/sensors/kernel/heights.cpp", {})


class _Field(Protocol):
    padded: Tensor
    resolution: float
    surface: Surface


class _Query(ctypes.Structure):
    """`Query` of heights.cpp."""

    _fields_ = (
        *((name, ctypes.c_void_p) for name in ("fields", "tiles", "points", "heights")),
        *((name, ctypes.c_int64) for name in "LKBM"),
        *((name, ctypes.c_int32) for name in ("rows", "columns", "surface")),
        ("resolution", ctypes.c_float),
    )


def read_heights(fields: Sequence[_Field], tile_ids: Tensor, xy: Tensor) -> Tensor | None:
    """Return the heights [m] (L, B, M) of L fields alike at places (B, M, 2) [m]; None where C++ cannot."""
    samples = [field.padded for field in fields]
    library = find_library(LIBRARY, xy, *samples)
    if library is None or tile_ids.dtype != torch.int64 or not tile_ids.is_cpu:
        return None
    tile_ids, xy = tile_ids.contiguous(), xy.contiguous()
    heights = xy.new_empty(len(fields), *xy.shape[:2])
    pointers = (ctypes.c_void_p * len(fields))(*(value.data_ptr() for value in samples))
    K, rows, columns = (int(size) for size in samples[0].shape)
    sizes = (len(fields), K, *xy.shape[:2], rows - 1, columns - 1)
    places = (ctypes.addressof(pointers), tile_ids.data_ptr(), xy.data_ptr(), heights.data_ptr())
    query = _Query(*places, *sizes, int(fields[0].surface), fields[0].resolution)
    call(library.read_heights, ctypes.byref(query), torch.get_num_threads())
    return heights
