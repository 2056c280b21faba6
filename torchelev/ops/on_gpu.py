"""Polar tables by CUDA kernels (`torchelev/native/tables/tables.cu`), like `ops.operators`; when others may run."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence

import torch
from torch import Tensor

from torchelev.native import kernels
from torchelev.ops import scatter
from torchelev.ops.transforms import is_transforming

_SOURCE = "tables/tables.cu"
_LEVELS = 16  # that a table may be widened by


class _Levels(ctypes.Structure):
    """`Levels` of tables.cu."""

    _fields_ = (("rows", ctypes.c_int64 * _LEVELS),)


def computes(layer: Tensor) -> bool:
    """Tell whether kernels may compute what has no gradient of a layer: it is float32 on a GPU; no transform runs."""
    is_plain = layer.is_cuda and layer.dtype == torch.float32 and not is_transforming()
    return is_plain and kernels.can_launch(layer.get_device())


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
            kernels.launch_blocks(_SOURCE, "lowest_slopes", B, memory, *rays, table, N, *sizes, ranges, least, levels)
            return table
        table = scatter.lowest(index, values, rows * azimuths, blank).unflatten(1, sizes)
        scanned = torch.empty_like(table)
        kernels.launch(_SOURCE, "scan_back", B, azimuths, table, scanned, *sizes, ranges, least)
        kernels.launch(_SOURCE, "widen", B, rows * azimuths, scanned, table, *sizes, levels)
    return table
