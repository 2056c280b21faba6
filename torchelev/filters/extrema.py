"""Highest and lowest known cells of windows, and of several layers."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from torchelev.filters import opencv
from torchelev.filters.layer_tools import radius_cells
from torchelev.filters.registry import register
from torchelev.layers import Layer
from torchelev.ops.masks import where_finite
from torchelev.ops.windows import padded, sliding_maximum

if TYPE_CHECKING:
    from jaxtyping import Bool, Float


@register
def dilation(layer: Layer, *, resolution: float, radius: float = 0.1) -> Layer:
    """Return the highest known cell of the square window around each known cell: max of h over |dx|, |dy| <= radius.

    The gradient goes to the highest cell; equal ones share it.

    Args:
        layer: values and mask (B, H, W).
        resolution: [m] of a cell.
        radius: [m] half the window's side, rounded to cells, at least one.

    Raises:
        ValueError: if the radius is not positive.
    """
    values, known = layer
    return highest_known(values, known, radius_cells(radius, resolution)), known


@register
def erosion(layer: Layer, *, resolution: float, radius: float = 0.1) -> Layer:
    """Return the lowest known cell of the square window around each known cell. Arguments as for `dilation`."""
    values, known = layer
    return lowest_known(values, known, radius_cells(radius, resolution)), known


@register
def opening(layer: Layer, *, resolution: float, radius: float = 0.1) -> Layer:
    """Remove peaks narrower than the window: `dilation` of the `erosion`.

    The result is nowhere above the layer, and a second opening changes nothing. Arguments as for `dilation`.
    """
    values, known = layer
    cells = radius_cells(radius, resolution)
    return highest_known(lowest_known(values, known, cells), known, cells), known


@register
def closing(layer: Layer, *, resolution: float, radius: float = 0.1) -> Layer:
    """Fill dips narrower than the window, such as gaps between stones: `erosion` of the `dilation`.

    The result is nowhere below the layer, and a second closing changes nothing. Unknown cells stay unknown. Arguments
    as for `dilation`.
    """
    values, known = layer
    cells = radius_cells(radius, resolution)
    return lowest_known(highest_known(values, known, cells), known, cells), known


@register
def maximum(*layers: Layer) -> Layer:
    """Return the highest known value of several layers at each cell; known where any layer is."""
    return _highest_layer(layers), _any_known(layers)


@register
def minimum(*layers: Layer) -> Layer:
    """Return the lowest known value of several layers at each cell; known where any layer is."""
    return -_highest_layer([(-values, known) for values, known in layers]), _any_known(layers)


def _highest_layer(layers: Sequence[Layer]) -> Float[Tensor, "B H W"]:
    return functools.reduce(torch.maximum, (with_blanks(values, known) for values, known in layers))


def _any_known(layers: Sequence[Layer]) -> Bool[Tensor, "B H W"]:
    return functools.reduce(torch.logical_or, (known for _, known in layers))


def blank(dtype: torch.dtype) -> float:
    """Return the number that stands for unknown in a maximum: below all heights, and finite when doubled."""
    return -torch.finfo(dtype).max / 4


def with_blanks(values: Float[Tensor, "B H W"], known: Bool[Tensor, "B H W"]) -> Float[Tensor, "B H W"]:
    """Return the values where known, `blank` elsewhere."""
    return where_finite(known, values, blank(values.dtype))


def highest_known(values: Tensor, known: Tensor, radius: int) -> Tensor:
    """Return the highest known cell of the window around each known cell; other cells hold arbitrary values."""
    if opencv.is_usable(values):
        return opencv.window_maximum((values, known), radius)
    rimmed = padded(with_blanks(values, known), radius, blank(values.dtype))
    return highest_of_windows(rimmed, 2 * radius + 1)


def lowest_known(values: Tensor, known: Tensor, radius: int) -> Tensor:
    """Return the lowest known cell of the window around each known cell; other cells hold arbitrary values."""
    if opencv.is_usable(values):
        return opencv.window_minimum((values, known), radius)
    return -highest_known(-values, known, radius)


def highest_of_windows(rimmed: Tensor, width: int) -> Tensor:
    """Return the maxima of square windows of `width` cells: (B, H, W) -> (B, H - width + 1, W - width + 1)."""
    return sliding_maximum(sliding_maximum(rimmed, width, -2), width, -1)
