"""Smoothing: Gaussian, box and median. Unknown cells neither spread nor count, and stay unknown."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchelev.errors import require_positive
from torchelev.filters import opencv
from torchelev.filters.extrema import blank, lowered
from torchelev.filters.order import lowest_of_windows
from torchelev.filters.registry import radius_cells, register
from torchelev.layers import Layer
from torchelev.ops.operators import padded
from torchelev.ops.storage import as_bytes, realize

if TYPE_CHECKING:
    from jaxtyping import Float


@register
def gaussian(layer: Layer, *, resolution: float, sigma: float = 0.1) -> Layer:
    """Return the Gaussian mean of the known cells around each known cell.

    sum of w h / sum of w over the known cells with |dx|, |dy| <= 3 sigma, w = exp(-(dx^2 + dy^2) / (2 sigma^2)): a
    normalised convolution (Knutsson and Westin 1993). `sigma` [m]; one of less than a third of a cell changes next to
    nothing. At the border of what is known the mean is of the inside, which on a slope shifts it.
    Raises ValueError for a sigma that is not positive.
    """
    require_positive(sigma=sigma)
    radius, width = radius_cells(3 * sigma, resolution), sigma / resolution
    if opencv.serves(layer[0]):
        return opencv.gaussian_mean(layer, radius, width), layer[1]
    return _mean(layer, radius, lambda rimmed, dim: gaussian_sums(rimmed, radius, width, dim))


@register
def box(layer: Layer, *, resolution: float, radius: float = 0.1) -> Layer:
    """Return the mean of the known cells of the square window around each known cell, |dx|, |dy| <= radius.

    `radius` [m], to the nearest cell, at least one. Raises ValueError for a radius that is not positive.
    """
    cells = radius_cells(radius, resolution)
    width = 2 * cells + 1
    if opencv.serves(layer[0]):
        return opencv.box_mean(layer, cells), layer[1]
    return _mean(layer, width // 2, lambda rimmed, dim: running_sums(rimmed, width, dim))


@register
def median(layer: Layer, *, resolution: float, radius: float = 0.05) -> Layer:
    """Return the median of the known cells of the square window around each known cell, |dx|, |dy| <= radius.

    Of an even number of cells, the mean of the middle two. `radius` [m], to the nearest cell, at least one; the time
    grows a little faster than its square. The gradient goes to the cells that the value is from, in parts to equal
    ones. Raises ValueError for a radius that is not positive.
    """
    values, known = layer
    radius = radius_cells(radius, resolution)
    width = 2 * radius + 1
    weight = as_bytes(known).to(values.dtype)
    rimmed = padded(-lowered(-values, weight), radius, -blank(values.dtype))
    ranked = torch.stack(lowest_of_windows(rimmed, width, width * width // 2 + 1))
    number = running_sums(realize(running_sums(padded(weight, radius, 0.0), width, -2)), width, -1)
    # Unknown cells rank last, so that the known ones' middle is found by their number. Integers divide slowly.
    below, above = ((0.5 * count).to(torch.int64)[None] for count in ((number - 1).clamp(min=0), number))
    return (0.5 * (ranked.gather(0, below) + ranked.gather(0, above)))[0], known


def _mean(layer: Layer, rim: int, sums: Callable[[Tensor, int], Tensor]) -> Layer:
    """Return weighted means: sums along each dimension of the known values, and of 1 for each known cell.

    A cell's own weight is 1.
    """
    values, known = layer
    weight = as_bytes(known).to(values.dtype)
    datum = mean_of_known(values, weight)  # sums of absolute heights would cost float32 its millimetres
    both = padded(torch.cat([(values - datum) * weight, weight]), rim, 0.0)
    total, weights = sums(realize(sums(both, -2)), -1).chunk(2)
    return total / weights.clamp(min=0.5) + datum, known


def mean_of_known(values: Float[Tensor, "B H W"], weight: Float[Tensor, "B H W"]) -> Float[Tensor, "B 1 1"]:
    """Return each map's mean, a datum without gradient. The values are 0 where the weight is."""
    number = weight.sum((1, 2), keepdim=True).clamp(min=1)
    return values.detach().sum((1, 2), keepdim=True) / number


def running_sums(values: Tensor, width: int, dim: int) -> Tensor:
    """Return the sums of each `width` neighbours along a dimension, which becomes shorter by width - 1.

    Of 1, 2, 4, ... neighbours, each from the one before; those that the width is made of are added.
    """
    length = values.shape[dim] - width + 1
    parts, done, span = [], 0, 1
    while span <= width:
        if width & span:
            parts.append(values.narrow(dim, done, length))
            done += span
        shorter = values.shape[dim] - span
        values = values.narrow(dim, 0, shorter) + values.narrow(dim, span, shorter) if 2 * span <= width else values
        span *= 2
    return functools.reduce(torch.add, parts)


def gaussian_sums(rimmed: Tensor, radius: int, width: float, dim: int) -> Tensor:
    """Return the sums of exp(-k^2 / (2 width^2)) * values over |k| <= radius cells along a dimension with such a rim.

    Not by convolutions or matrix products: a GPU may round these to ten bits.
    """
    length = rimmed.shape[dim] - 2 * radius
    total = rimmed.narrow(dim, radius, length).clone()
    for k in range(1, radius + 1):
        weight = math.exp(-0.5 * (k / width) ** 2)
        for start in (radius - k, radius + k):
            total.add_(rimmed.narrow(dim, start, length), alpha=weight)
    return total
