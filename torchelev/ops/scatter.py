"""Sums and extremes of values by slot.

On a GPU torch writes every value, also those that change nothing, and all that share a slot wait for each other. There
`torchelev.ops.triton_scatter` does the same and leaves those out.
"""

from __future__ import annotations

import functools
import importlib.util
import warnings

import torch
from torch import Tensor


def add(index: Tensor, values: Tensor, size: int) -> Tensor:
    """Sum values (K, B, M) by the slots `index` (B, M) in [0, size): -> (K, B, size)."""
    # One row per column and environment: on a CPU rows run in parallel, and each stays in the cache.
    sums = values.new_zeros(values.shape[0], values.shape[1], size)
    if _takes_triton(values):
        from torchelev.ops import triton_scatter

        with torch.cuda.device(values.device):
            triton_scatter.add(sums, index.contiguous(), values.contiguous())
        return sums
    return sums.scatter_add_(2, index.expand(values.shape), values)


def lowest(index: Tensor, values: Tensor, size: int, blank: float) -> Tensor:
    """Return the lowest of the values (B, M) in each slot: -> (B, size), `blank` where none is lower."""
    table = values.new_full((values.shape[0], size), blank)
    return _keep(table, index, values, "amin")


def highest(index: Tensor, values: Tensor, size: int, blank: float) -> Tensor:
    """Return the highest of the values (B, M) in each slot: -> (B, size), `blank` where none is higher."""
    table = values.new_full((values.shape[0], size), blank)
    return _keep(table, index, values, "amax")


def _keep(table: Tensor, index: Tensor, values: Tensor, which: str) -> Tensor:
    if _takes_triton(values):
        from torchelev.ops import triton_scatter

        with torch.cuda.device(values.device):
            triton_scatter.keep(table, index.contiguous(), values.contiguous(), lowest=which == "amin")
        return table
    return table.scatter_reduce_(1, index, values, which)


def _takes_triton(values: Tensor) -> bool:
    """Tell whether Triton computes it: not if runs must repeat, as its sums differ in the last bit."""
    is_float = values.is_cuda and values.dtype == torch.float32
    return is_float and not torch.are_deterministic_algorithms_enabled() and _triton_works(values.device)


@functools.cache
def _triton_works(device: torch.device) -> bool:
    """Tell whether Triton is there and can run on the device: it needs a C compiler, and not too old a GPU."""
    if importlib.util.find_spec("triton") is None:
        return False
    one = torch.ones(1, 1, device=device)
    try:
        from torchelev.ops import triton_scatter

        with torch.cuda.device(device):
            triton_scatter.add(one[None], torch.zeros_like(one, dtype=torch.int64), one[None])
    except Exception as error:  # of many kinds, by Triton, its compiler and the driver
        warnings.warn(
            f"Triton does not work here, and slower code does its work: {error}", RuntimeWarning, stacklevel=2
        )
        return False
    return True
