"""Choosing and counting by masks."""

from __future__ import annotations

import torch
from torch import Tensor

NOWHERE = 6e4  # [m] a height that nothing is near, and that float16 holds


def where_finite(mask: Tensor, values: Tensor, others: Tensor | float) -> Tensor:
    """Return `torch.where(mask, values, others)` of finite values, faster on a CPU.

    There `torch.where` branches at every element: irregular masks take up to ten times as long. Interpolation at
    weights of 0 and 1 is exact, but turns infinite values into NaN.
    """
    others = others if isinstance(others, Tensor) else values.new_full((), others)
    return torch.lerp(others, values, mask.view(torch.uint8).to(values.dtype))


def count(mask: Tensor) -> Tensor:
    """Count what is true in each environment: (B, ...) bool -> (B,) int64."""
    return mask.flatten(1).sum(1, dtype=torch.int64)
