"""What real sensors add: range noise, missing returns, and returns at wrong ranges along their ray."""

from __future__ import annotations

import torch
from torch import Tensor


def range_noise(
    points: Tensor, generator: torch.Generator | None = None, *, constant: float = 0.003, quadratic: float = 0.0015
) -> Tensor:
    """Move sensor-frame points (..., 3) [m] along their rays by N(0, sigma), sigma = constant + quadratic * d^2 [m].

    The defaults are a stereo depth camera's: 3 mm near, 9 mm at 2 m, 27 mm at 4 m.
    """
    d = torch.linalg.vector_norm(points, dim=-1, keepdim=True)
    sigma = constant + quadratic * d.square()
    error = sigma * torch.randn(d.shape, generator=generator, dtype=points.dtype)
    return points * (1 + error / d.clamp(min=1e-6))


def dropout(points: Tensor, generator: torch.Generator | None = None, *, share: float = 0.05) -> Tensor:
    """Turn a `share` of the points (..., 3) into NaN: returns that never came."""
    lost = torch.rand(points.shape[:-1], generator=generator, dtype=points.dtype) < share
    return points.masked_fill(lost[..., None], float("nan"))


def outliers(
    points: Tensor,
    generator: torch.Generator | None = None,
    *,
    dust: float = 0.0,
    flying: float = 0.0,
    too_long: float = 0.0,
) -> Tensor:
    """Put shares of the points (N, 3) at wrong ranges along their own rays; NaN stays NaN.

    `dust`: anywhere from 0.1 of the range to the range. `flying`: between its range and that of the next point in
    the cloud, where the two differ, as at the rim of an object. `too_long`: 1.05 to 2 times the range, as by a mirror.
    """
    which, u = (torch.rand(points.shape[:-1], generator=generator, dtype=points.dtype) for _ in range(2))
    d = torch.linalg.vector_norm(points, dim=-1)
    neighbour = torch.where(d.roll(-1).isfinite(), d.roll(-1), d)
    between = 1 + u * (neighbour / d.clamp(min=1e-6) - 1)
    scale = torch.where(which < dust + flying + too_long, 1.05 + 0.95 * u, 1.0)
    scale = torch.where(which < dust + flying, between, scale)
    scale = torch.where(which < dust, 0.1 + 0.9 * u, scale)
    return points * scale[..., None]


def noisy(points: Tensor, generator: torch.Generator | None = None, *, lost: float = 0.02) -> Tensor:
    """Apply the default range noise and lose some returns: an ordinary sensor on an ordinary day."""
    return dropout(range_noise(points, generator), generator, share=lost)
