"""Highest and lowest of the known cells of a window, and of several layers."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchelev.filters import opencv
from torchelev.filters.registry import radius_cells, register
from torchelev.layers import Layer
from torchelev.ops.operators import padded
from torchelev.ops.storage import as_bytes, realize

if TYPE_CHECKING:
    from jaxtyping import Bool, Float


@register
def dilation(layer: Layer, *, resolution: float, radius: float = 0.1) -> Layer:
    """Return the highest known cell of the square window around each known cell: max of h over |dx|, |dy| <= radius.

    `radius` [m], to the nearest cell, at least one. The gradient goes to the highest cell, in parts to equal ones.
    Raises ValueError for a radius that is not positive.
    """
    values, known = layer
    return highest_known(values, known, radius_cells(radius, resolution)), known


@register
def erosion(layer: Layer, *, resolution: float, radius: float = 0.1) -> Layer:
    """Return the lowest known cell of the square window around each known cell, as `dilation` the highest."""
    values, known = layer
    return lowest_known(values, known, radius_cells(radius, resolution)), known


@register
def opening(layer: Layer, *, resolution: float, radius: float = 0.1) -> Layer:
    """Take away what is high and narrower than the window: `dilation` of the `erosion`.

    Nowhere above the layer; opening twice changes nothing more. `radius` as of `dilation`.
    """
    values, known = layer
    cells = radius_cells(radius, resolution)
    return highest_known(lowest_known(values, known, cells), known, cells), known


@register
def closing(layer: Layer, *, resolution: float, radius: float = 0.1) -> Layer:
    """Fill what is low and narrower than the window, as gaps between stones: `erosion` of the `dilation`.

    Nowhere below the layer; closing twice changes nothing more. Unknown cells stay unknown. `radius` as of `dilation`.
    """
    values, known = layer
    cells = radius_cells(radius, resolution)
    return lowest_known(highest_known(values, known, cells), known, cells), known


@register
def maximum(*layers: Layer) -> Layer:
    """Return the highest of several layers at each cell, of those that are known there; known where any is."""
    return _highest_layer(layers), _any_known(layers)


@register
def minimum(*layers: Layer) -> Layer:
    """Return the lowest of several layers at each cell, of those that are known there; known where any is."""
    return -_highest_layer([(-values, known) for values, known in layers]), _any_known(layers)


def _highest_layer(layers: Sequence[Layer]) -> Float[Tensor, "B H W"]:
    lifted = (lowered(values, as_bytes(known).to(values.dtype)) for values, known in layers)
    return functools.reduce(torch.maximum, lifted)


def _any_known(layers: Sequence[Layer]) -> Bool[Tensor, "B H W"]:
    return functools.reduce(torch.logical_or, (known for _, known in layers))


def lowered(values: Float[Tensor, "B H W"], weight: Float[Tensor, "B H W"]) -> Float[Tensor, "B H W"]:
    """Return the values where the weight is 1, and about `blank` where it is 0.

    By a sum, which on a CPU takes a tenth of the time of `torch.where`.
    """
    return torch.add(values, weight - 1, alpha=-blank(values.dtype))


def blank(dtype: torch.dtype) -> float:
    """Return a number that lies below all heights, and that two of may be added."""
    return -torch.finfo(dtype).max / 4


def highest_known(values: Tensor, known: Tensor, radius: int) -> Tensor:
    """Return the highest known cell of the window around each known cell; what is at unknown cells has no meaning."""
    if opencv.serves(values):
        return opencv.highest((values, known), radius)
    rimmed = padded(lowered(values, as_bytes(known).to(values.dtype)), radius, blank(values.dtype))
    return highest_of_windows(rimmed, 2 * radius + 1)


def lowest_known(values: Tensor, known: Tensor, radius: int) -> Tensor:
    """Return the lowest known cell of the window around each known cell, as `highest_known` the highest."""
    if opencv.serves(values):
        return opencv.lowest((values, known), radius)
    return -highest_known(-values, known, radius)


def highest_of_windows(rimmed: Tensor, width: int) -> Tensor:
    """Return the maxima of the square windows of `width` cells; (B, H, W) becomes smaller by width - 1."""
    return running_maximum(realize(running_maximum(rimmed, width, -2)), width, -1)


def running_maximum(values: Tensor, width: int, dim: int) -> Tensor:
    """Return the maxima of each `width` neighbours along a dimension, which becomes shorter by width - 1.

    Of 2, 4, 8, ... neighbours first; then two overlapping spans make the window.
    """
    span, last = 1, values.shape[dim] - width + 1
    while 2 * span <= width:
        length = values.shape[dim] - span
        values = torch.maximum(values.narrow(dim, 0, length), values.narrow(dim, span, length))
        span *= 2
    if span == width:
        return values
    return torch.maximum(values.narrow(dim, 0, last), values.narrow(dim, width - span, last))
