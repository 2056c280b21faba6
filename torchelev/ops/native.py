"""Operators in C++ (`torchelev/native/tables`): the same as `torchelev.ops.operators`; and the way to call others."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from torchelev.native.library import call, is_native, load
from torchelev.ops.transforms import is_transforming

_MOVABLE = torch.float32, torch.float64, torch.bool, torch.uint8


def computes(layer: Tensor) -> bool:
    """Tell whether C++ may compute what has no gradient of a layer: it is float32 on a CPU, and no transform runs."""
    return layer.is_cpu and layer.dtype == torch.float32 and not is_transforming() and is_native()


def cell_sums(index: Tensor, values: Tensor, size: int) -> Tensor | None:
    """Return the sums (K, B, size) of values (K, B, M) by slots (B, M); None where C++ cannot compute them."""
    library = _library(values, index)
    if library is None:
        return None
    sums = values.new_empty(*values.shape[:2], size)
    rows = values.shape[0] * values.shape[1]
    run(library.add_by_slot, [index, values], [sums], rows, *index.shape, size)
    return sums


def running_minimum(table: Tensor) -> Tensor | None:
    """Return the running minimum of (B, R, P) along R; None where C++ cannot compute it."""
    library = _library(table)
    if library is None:
        return None
    result = torch.empty_like(table, memory_format=torch.contiguous_format)
    run(library.running_minimum, [table], [result], *table.shape)
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
    run(library.polar_minimum, [index, values], [table], *sizes, levels, len(widen), blank)
    return table


def move_layers(layers: Sequence[Tensor], shift: Tensor, blanks: Sequence[float]) -> bool:
    """Do what `moving.move_in_place` does; return False where C++ cannot."""
    is_plain = all(layer.is_cpu and layer.is_contiguous() and layer.dtype in _MOVABLE for layer in layers)
    library = load("moving/moving.cpp", {}) if is_plain else None
    if library is None:
        return False
    number = len(layers)
    arrays = (
        (ctypes.c_void_p * number)(*(layer.data_ptr() for layer in layers)),
        (ctypes.c_int64 * number)(*(layer.element_size() for layer in layers)),
        (ctypes.c_double * number)(*blanks),
    )
    run(library.move_layers, [shift], [], *arrays, number, *layers[0].shape)
    return True


def _library(values: Tensor, index: Tensor | None = None) -> ctypes.CDLL | None:
    """Return the functions for values (..., M) and indices (B, M); None where they cannot take them."""
    is_plain = values.dtype == torch.float32 and values.device.type == "cpu" and values.numel() > 0
    if index is not None:
        is_plain &= index.dtype == torch.int64 and index.device == values.device and index.shape == values.shape[-2:]
    return load("tables/tables.cpp", {}) if is_plain else None


def run(function: Any, read: Sequence[Tensor | None], written: Sequence[Tensor | None], *arguments: Any) -> None:
    """Call a library's function, which waits for torch's number of threads last.

    Args:
        function: of a library.
        read: tensors whose addresses it gets first. None: a null pointer.
        written: tensors into which it writes, whose addresses it gets next.
        arguments: an int becomes int64, a float float32.

    Raises:
        ValueError: a written tensor is not contiguous.
    """
    if not all(tensor is None or tensor.is_contiguous() for tensor in written):
        strides = [None if tensor is None else tensor.stride() for tensor in written]
        raise ValueError(f"{function.__name__} writes into contiguous tensors, got strides {strides}: copy them before")
    arrays = [None if tensor is None else tensor.contiguous() for tensor in read] + [*written]
    addresses = [ctypes.c_void_p(None if array is None else array.data_ptr()) for array in arrays]
    call(function, *addresses, *map(_number, arguments), torch.get_num_threads())


def _number(value: Any) -> Any:
    if isinstance(value, int):
        return ctypes.c_int64(value)
    return ctypes.c_float(value) if isinstance(value, float) else value
