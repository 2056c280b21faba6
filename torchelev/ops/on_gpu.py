"""Operators by CUDA kernels (`torchelev/native`): the same as `torchelev.ops.operators` and `torchelev.ops.moving`."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence

import torch
from torch import Tensor

from torchelev.native import kernels
from torchelev.ops import scatter

_TABLES, _MOVING = "tables/tables.cu", "moving/moving.cu"
_LEVELS = 16  # that a table may be widened by
_LAYERS = 16  # that are moved at once


class _Levels(ctypes.Structure):
    """`Levels` of tables.cu."""

    _fields_ = (("rows", ctypes.c_int64 * _LEVELS),)


class _Layers(ctypes.Structure):
    """`Layers` of moving.cu."""

    _fields_ = (("cells", ctypes.c_void_p * _LAYERS), ("blanks", ctypes.c_float * _LAYERS))


def can_tabulate(values: Tensor, widen: Sequence[int]) -> bool:
    """Tell whether `polar_minimum` takes such values."""
    is_plain = values.is_cuda and values.dtype == torch.float32 and len(widen) <= _LEVELS
    return is_plain and kernels.can_launch(values.get_device())


def polar_minimum(
    index: Tensor, values: Tensor, rows: int, azimuths: int, widen: Sequence[int], ranges: int, blank: float
) -> Tensor:
    """Return the table (B, rows, azimuths) of `operators.polar_minimum`. No value may be NaN."""
    B, N = values.shape
    levels, sizes, least = _Levels((ctypes.c_int64 * _LEVELS)(*widen)), (rows, azimuths), ctypes.c_float(blank)
    memory = 4 * ranges * azimuths
    with torch.cuda.device_of(values):
        if kernels.suits_blocks(values.get_device(), B, memory):
            table = values.new_empty(B, *sizes)
            rays = index.contiguous(), values.contiguous()
            kernels.launch_blocks(_TABLES, "lowest_slopes", B, memory, *rays, table, N, *sizes, ranges, least, levels)
            return table
        table = scatter.lowest(index, values, rows * azimuths, blank).unflatten(1, sizes)
        scanned = torch.empty_like(table)
        kernels.launch(_TABLES, "scan_back", B, azimuths, table, scanned, *sizes, ranges, least)
        kernels.launch(_TABLES, "widen", B, rows * azimuths, scanned, table, *sizes, levels)
    return table


def can_move(layer: Tensor) -> bool:
    """Tell whether `move_layers` takes the layers of such maps."""
    return layer.is_cuda and layer.dtype == torch.float32 and kernels.can_launch(layer.get_device())


def move_layers(layers: Sequence[Tensor], shift: Tensor, blanks: Sequence[float]) -> bool:
    """Do what `moving.move_in_place` does; return False where kernels cannot."""
    floats = [k for k, layer in enumerate(layers) if layer.dtype == torch.float32]
    bytes_ = [k for k, layer in enumerate(layers) if layer.dtype in (torch.bool, torch.uint8)]
    is_plain = len(floats) + len(bytes_) == len(layers) and all(layer.is_contiguous() for layer in layers)
    if not floats or not can_move(layers[floats[0]]) or not is_plain or len(layers) > _LAYERS:
        return False
    shift, (B, H, W) = shift.contiguous(), layers[0].shape
    with torch.cuda.device_of(shift):
        for kernel, chosen in (("move_floats", floats), ("move_bytes", bytes_)):
            cells = (ctypes.c_void_p * _LAYERS)(*(layers[k].data_ptr() for k in chosen))
            values = (ctypes.c_float * _LAYERS)(*(blanks[k] if kernel == "move_floats" else 0.0 for k in chosen))
            number = len(chosen)
            kernels.launch_blocks(_MOVING, kernel, B * number, 0, _Layers(cells, values), shift, number, H, W)
    return True
