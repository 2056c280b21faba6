"""Sums and extremes of values by slot."""

from __future__ import annotations

from torch import Tensor


def cell_sums(index: Tensor, values: Tensor, size: int) -> Tensor:
    """Sum values (K, B, M) by the slots `index` (B, M) in [0, size): -> (K, B, size). Slots never mix environments."""
    # One row per column and environment: on a CPU rows run in parallel, and each stays in the cache.
    sums = values.new_zeros(values.shape[0], values.shape[1], size)
    return sums.scatter_add(2, index.expand(values.shape), values)


def lowest(index: Tensor, values: Tensor, size: int, blank: float) -> Tensor:
    """Return the lowest of the values (B, M) in each slot: -> (B, size), `blank` where none is lower."""
    return values.new_full((values.shape[0], size), blank).scatter_reduce(1, index, values, "amin")


def highest_per_cell(index: Tensor, values: Tensor, size: int) -> Tensor:
    """Return the highest of the values (B, M) in each slot `index` (B, M): -> (B, size), -inf where there is none."""
    return values.new_full((values.shape[0], size), -float("inf")).scatter_reduce(1, index, values, "amax")
