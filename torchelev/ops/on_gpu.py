"""Polar tables by CUDA kernels (`torchelev/native/tables/tables.cu`): the same as `torchelev.ops.operators`."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence

import torch
from torch import Tensor

from torchelev.native import kernels

_SOURCE = "tables/tables.cu"
_LEVELS = 16  # that a table may be widened by


class _Levels(ctypes.Structure):
    """`Levels` of tables.cu."""

    _fields_ = (("rows", ctypes.c_int64 * _LEVELS),)


def can_scan(values: Tensor, widen: Sequence[int]) -> bool:
    """Tell whether `scan_and_widen` takes tables of such values."""
    is_plain = values.is_cuda and values.dtype == torch.float32 and len(widen) <= _LEVELS
    return is_plain and kernels.can_launch(values.get_device())


def scan_and_widen(table: Tensor, widen: Sequence[int], ranges: int, blank: float) -> None:
    """Turn a table (B, R, P) into that of `operators.polar_minimum`, in place."""
    B, R, P = table.shape
    scanned = torch.empty_like(table)
    levels = _Levels((ctypes.c_int64 * _LEVELS)(*widen))
    with torch.cuda.device_of(table):
        kernels.launch(_SOURCE, "scan_back", B, P, table, scanned, R, P, ranges, ctypes.c_float(blank))
        kernels.launch(_SOURCE, "widen", B, R * P, scanned, table, R, P, levels)
