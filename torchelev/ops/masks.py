"""Masks in arithmetic: eager code on a CPU branches at every element of a `torch.where`, up to ten times the cost."""

from __future__ import annotations

import torch
from torch import Tensor

from torchelev.ops.storage import as_bytes

NOWHERE = 6e4  # [m] a height that nothing is near, and that float16 holds


def as_factor(mask: Tensor) -> Tensor:
    """Return a mask to multiply with. Eager code makes numbers of bytes four times as fast as of booleans."""
    return mask if torch.compiler.is_compiling() else as_bytes(mask)


def masked(values: Tensor, mask: Tensor) -> Tensor:
    """Return the values where the mask is true, else 0. All must be finite: of others NaN would be left."""
    return values * as_factor(mask)


def masked_any(values: Tensor, mask: Tensor) -> Tensor:
    """Return the values where the mask is true, which are finite, else 0; of the others any may be NaN."""
    if torch.compiler.is_compiling():
        return torch.where(mask, values, 0.0)
    return masked(values.nan_to_num(0.0, 0.0, 0.0), mask)


def where_finite(mask: Tensor, values: Tensor, others: Tensor | float) -> Tensor:
    """Return the values where the mask is true, else the others. Finite ones, or NaN would be left."""
    others = others if isinstance(others, Tensor) else values.new_full((), others)
    if torch.compiler.is_compiling():
        return torch.where(mask, values, others)
    return torch.lerp(others, values, as_bytes(mask).to(values.dtype))  # exact at weights of 0 and 1


def zeroed(counts: Tensor, mask: Tensor) -> Tensor:
    """Return counts in uint8, 0 where the mask is true. Compiled code chooses integers faster than bytes."""
    return torch.where(mask, 0, counts.to(torch.int32)).to(torch.uint8)


def lifted(heights: Tensor, mask: Tensor) -> Tensor:
    """Return the heights [m], NOWHERE higher where the mask is true."""
    return torch.add(heights, as_factor(mask), alpha=NOWHERE)
