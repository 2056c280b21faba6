"""Operators by CUDA kernels (`torchelev/native/{tables,moving}`): the same as `ops.operators` and `ops.moving`."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence

import torch
from torch import Tensor

from torchelev.native import kernels
from torchelev.ops import scatter
from torchelev.ops.transforms import is_transforming

_TABLES, _MOVING = "tables/tables.cu", "moving/moving.cu"
_LEVELS = 16  # that a table may be widened by
_LAYERS = 16  # that are moved at once
_MANY = 64  # maps from which on one block for each layer of each map keeps a GPU busy


class _Levels(ctypes.Structure):
    """`Levels` of tables.cu."""

    _fields_ = (("rows", ctypes.c_int64 * _LEVELS),)


class _Layers(ctypes.Structure):
    """`Layers` of moving.cu."""

    _fields_ = (("cells", ctypes.c_void_p * _LAYERS), ("blanks", ctypes.c_float * _LAYERS))


def computes(layer: Tensor, memory: int = 0) -> bool:
    """Tell whether kernels may compute what has no gradient of a layer: it is float32 on a GPU; no transform runs.

    `memory`: what the threads of a block must share [bytes].
    """
    return layer.dtype == torch.float32 and not is_transforming() and kernels.work_on(layer, memory)


def can_tabulate(values: Tensor, widen: Sequence[int]) -> bool:
    """Tell whether `polar_minimum` takes such values."""
    return values.dtype == torch.float32 and len(widen) <= _LEVELS and kernels.work_on(values)


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


def gains_by_moving_in_place(layer: Tensor) -> bool:
    """Tell whether `move_layers` beats compiled tensors for maps with such a layer."""
    return layer.shape[0] >= _MANY and computes(layer)


def move_layers(layers: Sequence[Tensor], shift: Tensor, blanks: Sequence[float]) -> bool:
    """Do what `moving.move_in_place` does; return False where kernels cannot."""
    kinds = {"move_floats": [torch.float32], "move_bytes": [torch.bool, torch.uint8]}
    chosen = {kernel: [k for k, layer in enumerate(layers) if layer.dtype in kinds[kernel]] for kernel in kinds}
    is_plain = sum(map(len, chosen.values())) == len(layers) <= _LAYERS and all(x.is_contiguous() for x in layers)
    if not is_plain or not kernels.work_on(shift):
        return False
    shift, (B, H, W) = shift.contiguous(), layers[0].shape
    with torch.cuda.device_of(shift):
        for kernel, own in chosen.items():
            cells = (ctypes.c_void_p * _LAYERS)(*(layers[k].data_ptr() for k in own))
            values = (ctypes.c_float * _LAYERS)(*(blanks[k] for k in own))
            number = len(own)
            kernels.launch_blocks(_MOVING, kernel, B * number, 0, _Layers(cells, values), shift, number, H, W)
    return True
