"""Steps in the true ground, at which an error of place is a large error of height."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import torch
from torch import Tensor

if TYPE_CHECKING:
    from jaxtyping import Bool, Float


def find_steps(
    truth: Callable[[Tensor], Tensor], xy: Float[Tensor, "*M 2"], resolution: float, rise: float
) -> Bool[Tensor, "*M"]:
    """Find the cells in or next to which the ground rises by more than `rise`.

    Args:
        truth: returns the height of the ground [m] at points (..., 2) [m].
        xy: centres of the cells [m].
        resolution: of a cell [m].
        rise: [m] between points within 1.5 cells in x and y.
    """
    offset = resolution * torch.tensor([-1.5, -0.5, 0.5, 1.5], dtype=xy.dtype, device=xy.device)
    heights = (truth(xy + neighbor) for neighbor in torch.cartesian_prod(offset, offset))
    lowest = highest = next(heights)
    for z in heights:  # one after the other, so that large areas fit into memory
        lowest, highest = torch.minimum(lowest, z), torch.maximum(highest, z)
    return highest - lowest > rise
