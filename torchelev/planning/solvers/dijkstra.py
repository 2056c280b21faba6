"""The cost to go and the descent in C++ (`torchelev/planning/kernel`): bit for bit those of tensors, many times faster.

Off the CPU, without a compiler and inside `torch.func` transforms, tensors compute them.
"""

from __future__ import annotations

import ctypes
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchelev.kernels.cpu_build import call, load
from torchelev.ops.transforms import can_compute_unseen

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

LIBRARY: tuple[str, dict[str, str]] = ("planning/kernel/dijkstra.cpp", {})  #: source and constants
_SUFFIXES = {torch.float32: "float", torch.float64: "double"}
_MOST_CELLS = 2**31  # of a map and its rim


def find_costs(
    cost: Float[Tensor, "B H W"], goal: Bool[Tensor, "B H W"], resolution: float
) -> Float[Tensor, "B H W"] | None:
    """Return the cost to go by Dijkstra's algorithm; None where C++ cannot compute it."""
    library = _library(cost, goal)
    if library is None:
        return None
    value = torch.empty_like(cost, memory_format=torch.contiguous_format)
    _run(library, "cost_to_go", [cost.contiguous(), goal.contiguous(), value], cost.shape, resolution)
    return value


def follow(
    value: Float[Tensor, "B H W"],
    cost: Float[Tensor, "B H W"],
    first: Int[Tensor, "B 1"],
    resolution: float,
    max_cells: int,
) -> Int[Tensor, "B K"] | None:
    """Return the numbers of the cells of each path, from the first on; None where C++ cannot compute them."""
    library = _library(cost, value, first) if value.dtype == cost.dtype and first.dtype == torch.int64 else None
    if library is None:
        return None
    path = first.repeat(1, max_cells)
    _run(library, "descend", [value.contiguous(), cost.contiguous(), path], (*cost.shape, max_cells), resolution)
    return path


def _library(cost: Tensor, *others: Tensor) -> ctypes.CDLL | None:
    is_plain = cost.dtype in _SUFFIXES and can_compute_unseen((cost, *others))
    fits = (cost.shape[1] + 2) * (cost.shape[2] + 2) < _MOST_CELLS
    return load(*LIBRARY) if is_plain and fits else None


def _run(library: ctypes.CDLL, name: str, tensors: list[Tensor], sizes: tuple[int, ...], resolution: float) -> None:
    function = getattr(library, f"{name}_{_SUFFIXES[tensors[0].dtype]}")
    pointers = [ctypes.c_void_p(tensor.data_ptr()) for tensor in tensors]
    numbers = [ctypes.c_int64(size) for size in sizes]
    call(function, *pointers, *numbers, ctypes.c_double(resolution), torch.get_num_threads())
