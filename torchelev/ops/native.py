"""Operators in C++ (`torchelev/native/tables`): the same numbers as `torchelev.ops.operators`."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from torchelev.native.library import call, load


def cell_sums(index: Tensor, values: Tensor, size: int) -> Tensor | None:
    """Return the sums (K, B, size) of values (K, B, M) by slots (B, M); None where C++ cannot compute them."""
    library = _library(values, index)
    if library is None:
        return None
    sums = values.new_empty(*values.shape[:2], size)
    rows = values.shape[0] * values.shape[1]
    _call(library.add_by_slot, [index, values, sums], rows, *index.shape, size)
    return sums


def running_minimum(table: Tensor) -> Tensor | None:
    """Return the running minimum of (B, R, P) along R; None where C++ cannot compute it."""
    library = _library(table)
    if library is None:
        return None
    result = torch.empty_like(table, memory_format=torch.contiguous_format)
    _call(library.running_minimum, [table, result], *table.shape)
    return result


def polar_minimum(
    index: Tensor, values: Tensor, rows: int, azimuths: int, widen: Sequence[int], ranges: int, blank: float
) -> Tensor | None:
    """Return the table (B, rows, azimuths) of `operators.polar_minimum`; None where C++ cannot compute it."""
    library = _library(values, index)
    if library is None:
        return None
    table = values.new_empty(len(values), rows, azimuths)
    levels = (ctypes.c_int64 * len(widen))(*widen)
    sizes = (*values.shape, rows, azimuths, ranges)
    _call(library.polar_minimum, [index, values, table], *sizes, levels, len(widen), ctypes.c_float(blank))
    return table


def move_layers(layers: Sequence[Tensor], shift: Tensor, blanks: Sequence[float]) -> bool:
    """Do what `moving.move_in_place` does; return False where C++ cannot."""
    dtypes = (torch.float32, torch.float64, torch.bool, torch.uint8)
    is_plain = all(layer.is_cpu and layer.is_contiguous() and layer.dtype in dtypes for layer in layers)
    library = load("moving/moving.cpp", {}) if is_plain else None
    if library is None:
        return False
    number = len(layers)
    arrays = (
        (ctypes.c_void_p * number)(*(layer.data_ptr() for layer in layers)),
        (ctypes.c_int64 * number)(*(layer.element_size() for layer in layers)),
        (ctypes.c_double * number)(*blanks),
    )
    sizes = [ctypes.c_int64(size) for size in layers[0].shape]
    shifts = shift.contiguous()
    address, count = ctypes.c_void_p(shifts.data_ptr()), ctypes.c_int64(number)
    call(library.move_layers, *arrays, count, address, *sizes, torch.get_num_threads())
    return True


def _library(values: Tensor, index: Tensor | None = None) -> ctypes.CDLL | None:
    """Return the functions for values (..., M) and indices (B, M); None where they cannot take them."""
    is_plain = values.dtype == torch.float32 and values.device.type == "cpu" and values.numel() > 0
    if index is not None:
        is_plain &= index.dtype == torch.int64 and index.device == values.device and index.shape == values.shape[-2:]
    return load("tables/tables.cpp", {}) if is_plain else None


def _call(function: Any, tensors: Sequence[Tensor], *arguments: Any) -> None:
    """Call a function with the addresses of tensors."""
    arrays = [tensor.contiguous() for tensor in tensors]
    addresses = [ctypes.c_void_p(array.data_ptr()) for array in arrays]
    whole = [ctypes.c_int64(value) if isinstance(value, int) else value for value in arguments]
    call(function, *addresses, *whole, torch.get_num_threads())
