"""Smoothing: Gaussian, box and median. Unknown cells do not count, and stay unknown."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchelev.filters import opencv
from torchelev.filters.extrema import blank, with_blanks
from torchelev.filters.layer_tools import known_weight, radius_cells
from torchelev.filters.registry import register
from torchelev.filters.sorting_network import lowest_of_windows
from torchelev.layers import Layer
from torchelev.ops.windows import gaussian_sum, padded, sliding_sum

if TYPE_CHECKING:
    from jaxtyping import Float


@register
def gaussian(layer: Layer, *, resolution: float, sigma: float = 0.1) -> Layer:
    """Return the Gaussian mean of the known cells around each known cell.

    sum w h / sum w over the known cells with |dx|, |dy| <= 3 sigma, w = exp(-(dx^2 + dy^2) / (2 sigma^2)): a normalised
    convolution (Knutsson and Westin 1993). At the border of the known area all neighbours lie on one side, which shifts
    the mean on a slope.

    Args:
        layer: values and mask (B, H, W).
        resolution: [m] of a cell.
        sigma: [m] standard deviation of the Gaussian; below a third of a cell nothing changes.

    Raises:
        ValueError: if sigma is not positive.
    """
    radius, sigma_cells = radius_cells(sigma, resolution, "sigma", reach=3.0), sigma / resolution
    if opencv.is_usable(layer[0]):
        return opencv.gaussian_mean(layer, radius, sigma_cells), layer[1]
    return _mean(layer, radius, lambda rimmed, dim: gaussian_sum(rimmed, radius, sigma_cells, dim))


@register
def box(layer: Layer, *, resolution: float, radius: float = 0.1) -> Layer:
    """Return the mean of the known cells of the square window around each known cell, |dx|, |dy| <= radius.

    Args:
        layer: values and mask (B, H, W).
        resolution: [m] of a cell.
        radius: [m] half the window's side, rounded to cells, at least one.

    Raises:
        ValueError: if the radius is not positive.
    """
    cells = radius_cells(radius, resolution)
    if opencv.is_usable(layer[0]):
        return opencv.box_mean(layer, cells), layer[1]
    return _mean(layer, cells, lambda rimmed, dim: sliding_sum(rimmed, 2 * cells + 1, dim))


@register
def median(layer: Layer, *, resolution: float, radius: float = 0.05) -> Layer:
    """Return the median of the known cells of the square window around each known cell, |dx|, |dy| <= radius.

    For an even number of cells, the mean of the middle two. Time grows a little faster than the square of the radius.
    The gradient goes to the cells whose values make the median; equal ones share it.

    Args:
        layer: values and mask (B, H, W).
        resolution: [m] of a cell.
        radius: [m] half the window's side, rounded to cells, at least one.

    Raises:
        ValueError: if the radius is not positive.
    """
    values, known = layer
    radius = radius_cells(radius, resolution)
    width = 2 * radius + 1
    rimmed = padded(-with_blanks(-values, known), radius, -blank(values.dtype))
    ranked = torch.stack(lowest_of_windows(rimmed, width, width * width // 2 + 1))
    weight = padded(known_weight(known, values.dtype), radius, 0.0)
    number = sliding_sum(sliding_sum(weight, width, -2), width, -1)
    # Unknown cells rank last, so the middle follows from the number of known ones. Halved as floats: integers are slow.
    below, above = ((0.5 * rank).to(torch.int64)[None] for rank in ((number - 1).clamp(min=0), number))
    return (0.5 * (ranked.gather(0, below) + ranked.gather(0, above)))[0], known


def _mean(layer: Layer, radius: int, sum_along: Callable[[Tensor, int], Tensor]) -> Layer:
    """Return weighted means of known cells. `sum_along` sums along one dimension; a cell's own weight is 1."""
    values, known = layer
    weight = known_weight(known, values.dtype)
    datum = mean_of_known(values, weight)  # sums of absolute heights would cost float32 its millimetres
    both = padded(torch.cat([(values - datum) * weight, weight]), radius, 0.0)
    total, weights = sum_along(sum_along(both, -2), -1).chunk(2)
    return total / weights.clamp(min=0.5) + datum, known


def mean_of_known(values: Float[Tensor, "B H W"], weight: Float[Tensor, "B H W"]) -> Float[Tensor, "B 1 1"]:
    """Return each map's mean without gradient. Weights are 1 where known, else 0, and values 0 where unknown."""
    number = weight.sum((1, 2), keepdim=True).clamp(min=1)
    return values.detach().sum((1, 2), keepdim=True) / number
