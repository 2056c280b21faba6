"""Helpers of the pose constructors: tensors from arrays, and 4 x 4 matrices from their parts."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from torchelev.errors import require


def to_floats(name: str, values: Tensor | ArrayLike) -> Tensor:
    """Return a tensor as it is, and anything else as a new floating-point tensor."""
    if isinstance(values, Tensor):
        return values
    array = np.array(values)
    require(array.dtype.kind in "fiu", name, "must be numbers", array.dtype, "give a tensor or a NumPy array")
    return torch.from_numpy(array if array.dtype.kind == "f" else array.astype(np.float64))


def assemble(position: Tensor, rotation: Tensor) -> Tensor:
    """Return the pose (..., 4, 4) of a position (..., 3) and a rotation (..., 3, 3)."""
    upper = torch.cat([rotation, position[..., None]], -1)
    row = torch.zeros_like(upper[..., :1, :1])
    return torch.cat([upper, torch.cat([row, row, row, torch.ones_like(row)], -1)], -2)
