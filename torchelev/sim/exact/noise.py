"""Noise of real sensors for single clouds: range noise, missing returns, and wrong ranges along the ray."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, TypeVar, cast

import torch
from torch import Tensor

Noise = TypeVar("Noise", bound=Callable[..., Tensor])


def _in_full_precision(noise: Noise) -> Noise:
    """Compute the noise of halves in float32: their squared distances overflow, and small shares are rounded away."""

    @functools.wraps(noise)
    def computed(points: Tensor, *args: Any, **kwargs: Any) -> Tensor:
        return noise(points.to(torch.promote_types(points.dtype, torch.float32)), *args, **kwargs).to(points.dtype)

    return cast(Noise, computed)


@_in_full_precision
def range_noise(
    points: Tensor, generator: torch.Generator | None = None, *, constant: float = 0.003, quadratic: float = 0.0015
) -> Tensor:
    """Add range noise N(0, sigma^2) with sigma = constant + quadratic * d^2 at distance d.

    The defaults are those of a stereo depth camera: 3 mm near the sensor, 9 mm at 2 m, 27 mm at 4 m.

    Args:
        points: (..., 3) [m] in the sensor frame.
        generator: Source of random numbers; None is torch's default generator.
        constant: Noise at distance 0, 1 sigma [m].
        quadratic: Growth with the squared distance [1/m].
    """
    d = torch.linalg.vector_norm(points, dim=-1, keepdim=True)
    sigma = constant + quadratic * d.square()
    error = sigma * torch.randn(d.shape, generator=generator, dtype=points.dtype)
    return points * (1 + error / d.clamp(min=1e-6))


@_in_full_precision
def dropout(points: Tensor, generator: torch.Generator | None = None, *, share: float = 0.05) -> Tensor:
    """Replace a fraction `share` of the points (..., 3) by NaN: missing returns."""
    is_lost = torch.rand(points.shape[:-1], generator=generator, dtype=points.dtype) < share
    return points.masked_fill(is_lost[..., None], float("nan"))


@_in_full_precision
def outliers(
    points: Tensor,
    generator: torch.Generator | None = None,
    *,
    dust: float = 0.0,
    flying: float = 0.0,
    too_long: float = 0.0,
) -> Tensor:
    """Give fractions of the points wrong ranges along their rays; NaN stays NaN.

    Args:
        points: (N, 3) [m] in the sensor frame, in the order of the scan.
        generator: Source of random numbers; None is torch's default generator.
        dust: Fraction measured at 0.1 to 1 times the range.
        flying: Fraction measured between the point's range and that of the next point, as at the rim of an object.
        too_long: Fraction measured at 1.05 to 2 times the range, as by a mirror.
    """
    draw, u = (torch.rand(points.shape[:-1], generator=generator, dtype=points.dtype) for _ in range(2))
    d = torch.linalg.vector_norm(points, dim=-1)
    neighbour = torch.where(d.roll(-1).isfinite(), d.roll(-1), d)
    between = 1 + u * (neighbour / d.clamp(min=1e-6) - 1)
    scale = torch.where(draw < dust + flying + too_long, 1.05 + 0.95 * u, 1.0)
    scale = torch.where(draw < dust + flying, between, scale)
    scale = torch.where(draw < dust, 0.1 + 0.9 * u, scale)
    return points * scale[..., None]


def noisy(points: Tensor, generator: torch.Generator | None = None, *, lost: float = 0.02) -> Tensor:
    """Add the default range noise and lose a fraction `lost` of the returns: an ordinary sensor."""
    return dropout(range_noise(points, generator), generator, share=lost)
