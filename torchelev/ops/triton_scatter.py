"""`torchelev.ops.scatter` in Triton: values that change nothing are not written."""

from __future__ import annotations

import triton
import triton.language as tl
from torch import Tensor

_BLOCK = 512  # values of a program


def add(sums: Tensor, index: Tensor, values: Tensor) -> None:
    """Add values (K, B, M) to the sums (K, B, S) at their slots `index` (B, M), in place."""
    columns, rows, number = values.shape
    if values.numel() > 0:
        grid = (rows * triton.cdiv(number, _BLOCK),)
        _add[grid](sums, index, values, columns, rows, number, sums.shape[2], BLOCK=_BLOCK)


def keep(table: Tensor, index: Tensor, values: Tensor, lowest: bool) -> None:
    """Keep in a table (B, S) the lowest, or highest, of itself and the values (B, M) at their slots, in place."""
    rows, number = values.shape
    if values.numel() > 0:
        grid = (rows * triton.cdiv(number, _BLOCK),)
        _keep[grid](table, index, values, number, table.shape[1], LOWEST=lowest, BLOCK=_BLOCK)


@triton.jit
def _place(number, BLOCK: tl.constexpr):  # noqa: N803
    """Return the row of this program, and which of its values (BLOCK,) the program has, and where they exist."""
    blocks = tl.cdiv(number, BLOCK)
    row = (tl.program_id(0) // blocks).to(tl.int64)
    k = tl.program_id(0) % blocks * BLOCK + tl.arange(0, BLOCK)
    return row, k, k < number


@triton.jit
def _add(sums, index, values, columns, rows, number, slots, BLOCK: tl.constexpr):  # noqa: N803
    row, k, exists = _place(number, BLOCK)
    slot = tl.load(index + row * number + k, exists, other=0)
    for column in range(columns):
        line = column * rows + row
        value = tl.load(values + line * number + k, exists, other=0.0)
        tl.atomic_add(sums + line * slots + slot, value, mask=value != 0.0, sem="relaxed")


@triton.jit
def _keep(table, index, values, number, slots, LOWEST: tl.constexpr, BLOCK: tl.constexpr):  # noqa: N803
    row, k, exists = _place(number, BLOCK)
    place = table + row * slots + tl.load(index + row * number + k, exists, other=0)
    value = tl.load(values + row * number + k, exists, other=0.0)
    kept = tl.load(place)  # may be old by now, but then what is kept is further on
    if LOWEST:
        tl.atomic_min(place, value, mask=exists & (value < kept), sem="relaxed")
    else:
        tl.atomic_max(place, value, mask=exists & (value > kept), sem="relaxed")
