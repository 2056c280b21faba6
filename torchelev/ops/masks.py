"""Choosing and counting by masks."""

from __future__ import annotations

import torch
from torch import Tensor

from torchelev.ops.storage import as_bytes, realize

NOWHERE = 6e4  # [m] a height that nothing is near, and that float16 holds


def where_finite(mask: Tensor, values: Tensor, others: Tensor | float) -> Tensor:
    """Return `torch.where(mask, values, others)` of finite values, faster in uncompiled code on a CPU.

    There `torch.where` branches at every element: irregular masks take up to ten times as long. Interpolation at
    weights of 0 and 1 is exact, but turns infinite values into NaN.
    """
    others = others if isinstance(others, Tensor) else values.new_full((), others)
    if torch.compiler.is_compiling():
        return torch.where(mask, values, others)
    return torch.lerp(others, values, as_bytes(mask).to(values.dtype))


def count(mask: Tensor) -> Tensor:
    """Count what is true in each environment: (B, ...) bool -> (B,) int64."""
    # Compiled code counts in 32 bits faster, eager code in 64; no map has more cells or points than 32 bits hold.
    bits = torch.int32 if torch.compiler.is_compiling() else torch.int64
    return realize(mask).flatten(1).sum(1, dtype=bits).to(torch.int64)
