"""Wrong ranges, for many clouds at once: chance comes in as even numbers u from 0 to 1, settings as (B, 1) tensors."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor

if TYPE_CHECKING:
    from jaxtyping import Float


def across_edge(d: Float[Tensor, "B M"], shape: tuple[int, int]) -> Float[Tensor, "B M"]:
    """Return, for each pixel of images (h, w) of ranges, row by row, the range of the neighbour that differs most."""
    image = d.unflatten(1, shape)
    found = image
    for dim in (1, 2):
        number = torch.arange(image.shape[dim], device=d.device)
        for by in (-1, 1):
            beside = image.index_select(dim, (number + by).clamp(0, image.shape[dim] - 1))
            # False for NaN: where nothing came back is no edge.
            found = torch.where((beside - image).abs() > (found - image).abs(), beside, found)
    return found.flatten(1)


def flying(d: Tensor, beside: Tensor, u: Tensor, share: Tensor, step: Tensor) -> Tensor:
    """Return ranges (B, M) of which a share lies between d and `beside`, where these differ by more than `step`.

    A pixel at the rim of an object sees both sides, and a stereo matcher or a lidar's beam answers with a mixture.
    """
    flies = (u < share) & ((beside - d).abs() > step)
    # Below the share, u / share is even between 0 and 1.
    return torch.where(flies, d + (beside - d) * (u / share.clamp(min=1e-6)), d)


def artefacts(d: Tensor, u: Tensor, short: Tensor, long: Tensor) -> Tensor:
    """Return ranges (B, M) of which shares are 0.1 to 1 (short) or 1.05 to 2 (long) times what they should be."""
    # Below a share, u / share is even between 0 and 1.
    nearer = 0.1 + 0.9 * u / short.clamp(min=1e-6)
    farther = 1.05 + 0.95 * (u - short) / long.clamp(min=1e-6)
    return d * torch.where(u < short, nearer, torch.where(u < short + long, farther, 1.0))


def steps(value: Tensor, step: Tensor) -> Tensor:
    """Round to multiples of a step, where it is positive."""
    return torch.where(step > 0, torch.round(value / step.clamp(min=1e-9)) * step, value)


def disparity_steps(points: Float[Tensor, "B M 3"], step: Float[Tensor, "B 1"]) -> Float[Tensor, "B M 3"]:
    """Scale points along their rays so that 1/x is a multiple of `step` [1/m].

    Stereo measures the disparity f b / x in steps of s pixels: step = s / (f b), with the focal length f in pixels and
    the baseline b [m]. Points whose disparity is rounded to none are lost, and those that are not before the sensor.
    """
    x = points[..., 0]
    # Double where: where there is no step, nothing may divide by it.
    steps_seen = torch.round(1 / (x.clamp(min=1e-6) * step.clamp(min=1e-9)))
    scale = 1 / (steps_seen * step.clamp(min=1e-9) * x)
    scale = torch.where((x > 0) & (steps_seen > 0), scale, float("nan"))
    return points * torch.where(step > 0, scale, 1.0)[..., None]
