"""Errors of measured ranges, batched over clouds: u are uniform random numbers from 0 to 1, settings are (B, 1)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

if TYPE_CHECKING:
    from jaxtyping import Float


def find_range_across_edge(d: Float[Tensor, "B M"], shape: tuple[int, int]) -> Float[Tensor, "B M"]:
    """Return the range of the neighbouring pixel that differs most, for range images (h, w) stored row by row."""
    image = d.unflatten(1, shape)
    across = image
    for dim in (1, 2):
        index = torch.arange(image.shape[dim], device=d.device)
        for offset in (-1, 1):
            neighbour = image.index_select(dim, (index + offset).clamp(0, image.shape[dim] - 1))
            # The comparison is False for NaN: a missing return makes no edge.
            across = torch.where((neighbour - image).abs() > (across - image).abs(), neighbour, across)
    return across.flatten(1)


def add_flying_points(d: Tensor, across: Tensor, u: Tensor, fraction: Tensor, step: Tensor) -> Tensor:
    """Move a fraction of the ranges (B, M) to between d and `across`, where the two differ by more than `step` [m].

    At the rim of an object a pixel sees both sides, and a stereo matcher or a lidar beam measures a mixture of them.
    """
    is_flying = (u < fraction) & ((across - d).abs() > step)
    # Given u < fraction, u / fraction is uniform between 0 and 1.
    return torch.where(is_flying, d + (across - d) * (u / fraction.clamp(min=1e-6)), d)


def add_artefacts(d: Tensor, u: Tensor, short_fraction: Tensor, long_fraction: Tensor) -> Tensor:
    """Scale fractions of the ranges (B, M) by 0.1 to 1 (too short) or by 1.05 to 2 (too long)."""
    # Given u < fraction, u / fraction is uniform between 0 and 1.
    short = 0.1 + 0.9 * u / short_fraction.clamp(min=1e-6)
    long = 1.05 + 0.95 * (u - short_fraction) / long_fraction.clamp(min=1e-6)
    return d * torch.where(u < short_fraction, short, torch.where(u < short_fraction + long_fraction, long, 1.0))


def quantise(value: Tensor, step: Tensor) -> Tensor:
    """Round to multiples of `step`, where it is positive."""
    return torch.where(step > 0, torch.round(value / step.clamp(min=1e-9)) * step, value)


def quantise_disparity(points: Float[Tensor, "B M 3"], step: Float[Tensor, "B 1"]) -> Float[Tensor, "B M 3"]:
    """Scale points along their rays so that 1/x is a multiple of `step` [1/m].

    Stereo measures the disparity f b / x in steps of s pixels: step = s / (f b), with the focal length f [pixels] and
    the baseline b [m]. Points behind the sensor are lost, and so are points whose disparity rounds to 0.
    """
    x = points[..., 0]
    # The clamps keep both branches of `where` finite.
    num_steps = torch.round(1 / (x.clamp(min=1e-6) * step.clamp(min=1e-9)))
    scale = 1 / (num_steps * step.clamp(min=1e-9) * x)
    scale = torch.where((x > 0) & (num_steps > 0), scale, float("nan"))
    return points * torch.where(step > 0, scale, 1.0)[..., None]
