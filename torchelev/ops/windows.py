"""Sums and maxima over the window around each cell, along one dimension after the other.

Every tensor window of the library is here; `filters/opencv.py` has the windows that OpenCV computes on the host.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor

AROUND = [(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if (i, j) != (0, 0)]


def around(device: torch.device) -> tuple[Tensor, Tensor]:
    """Return AROUND's rows and columns, (8,) int64; computed, as a copy to a GPU would make the host wait."""
    k = torch.arange(8, device=device)
    k = k + (k >= 4)
    return k // 3 - 1, k % 3 - 1


def padded(values: Tensor, radius: int, fill: float) -> Tensor:
    """Put a rim of `radius` cells around (..., H, W)."""
    return F.pad(values, [radius] * 4, value=fill)


def _line(values: Tensor, rim: int, dim: int, k: int) -> Tensor:
    """Return what lies k entries on, along a dimension that has a rim."""
    return values.narrow(dim, rim + k, values.shape[dim] - 2 * rim)


def shifted(values: Tensor, rim: int, i: int = 0, j: int = 0) -> Tensor:
    """Return what lies (i, j) cells on, of (..., H + 2 rim, W + 2 rim) the inner (..., H, W)."""
    return _line(_line(values, rim, -2, i), rim, -1, j)


def _line_sums(values: Tensor, rim: int, radius: int, dim: int, order: int) -> list[Tensor]:
    """Sum k^power * values over k = -radius .. radius along one dimension, for each power from 0 to the order."""
    middle, steps = _line(values, rim, dim, 0), range(1, radius + 1)
    sides = [(_line(values, rim, dim, -k), _line(values, rim, dim, k)) for k in steps]
    even = [before + after for before, after in sides]
    odd = [after - before for before, after in sides] if order >= 1 else []
    sums = [functools.reduce(torch.add, even, middle)]
    for power in range(1, order + 1):
        sums.append(_weighted([k**power for k in steps], odd if power % 2 else even))
    return sums


def _weighted(weights: Sequence[int], values: list[Tensor]) -> Tensor:
    """Sum weight * value; the first weight is 1."""
    total = values[0]
    for weight, value in zip(weights[1:], values[1:], strict=True):
        total = torch.add(total, value, alpha=weight)
    return total


def window_moments(layers: list[tuple[Tensor, int]], rim: int, radius: int) -> list[Tensor]:
    """Sum u^a v^b * values over the (2 * radius + 1)^2 window around each cell.

    u and v count cells from the window's centre along H and W. For each layer (B, H + 2 * rim, W + 2 * rim) with its
    order, all moments (B, H, W) with a + b <= order: (0, 0), (0, 1), ... (1, 0), ... The rim is at least the
    radius.
    """
    lines = [line for v, order in layers for line in _line_sums(v, rim, radius, -2, order)]
    orders = [order - a for _, order in layers for a in range(order + 1)]
    return [
        moment for line, order in zip(lines, orders, strict=True) for moment in _line_sums(line, rim, radius, -1, order)
    ]


def window_maximum(values: list[Tensor], rim: int, radius: int) -> list[Tensor]:
    """Return each layer's maxima over the (2 * radius + 1)^2 window around each cell; shapes as in `window_moments`."""
    for dim in (-2, -1):
        lines = ([_line(v, rim, dim, k) for k in range(-radius, radius + 1)] for v in values)
        values = [functools.reduce(torch.maximum, line) for line in lines]
    return values


def neighbours(values: Tensor, fill: float) -> list[Tensor]:
    """Return the eight neighbours of each cell of (..., H, W) in the order of AROUND, `fill` outside the layer."""
    rimmed = padded(values, 1, fill)
    rows = [_line(rimmed, 1, -2, i) for i in (-1, 0, 1)]
    return [_line(rows[1 + i], 1, -1, j) for i, j in AROUND]


def sliding_sum(values: Tensor, width: int, dim: int) -> Tensor:
    """Return the sum of every `width` neighbours along a dimension, which shrinks by width - 1.

    Sums of 1, 2, 4, ... neighbours, each of two before it; those that make up the width are added.
    """
    length = values.shape[dim] - width + 1
    parts, start, span = [], 0, 1
    while span <= width:
        if width & span:
            parts.append(values.narrow(dim, start, length))
            start += span
        if 2 * span <= width:
            rest = values.shape[dim] - span
            values = values.narrow(dim, 0, rest) + values.narrow(dim, span, rest)
        span *= 2
    return functools.reduce(torch.add, parts)


def sliding_maximum(values: Tensor, width: int, dim: int) -> Tensor:
    """Return the maximum of every `width` neighbours along a dimension, which shrinks by width - 1.

    Maxima of 1, 2, 4, ... neighbours; two overlapping ones cover the width.
    """
    span, length = 1, values.shape[dim] - width + 1
    while 2 * span <= width:
        rest = values.shape[dim] - span
        values = torch.maximum(values.narrow(dim, 0, rest), values.narrow(dim, span, rest))
        span *= 2
    if span == width:
        return values
    return torch.maximum(values.narrow(dim, 0, length), values.narrow(dim, width - span, length))


def sliding_minimum(values: Tensor, width: int, dim: int) -> Tensor:
    """Return the minimum of every `width` neighbours along a dimension, which shrinks by width - 1."""
    return -sliding_maximum(-values, width, dim)


def gaussian_sum(values: Tensor, radius: int, sigma: float, dim: int) -> Tensor:
    """Sum exp(-k^2 / (2 sigma^2)) * values over |k| <= radius cells along a dimension, which shrinks by 2 radius.

    Neither a convolution nor a matrix product: GPUs may round those to ten bits.
    """
    total = _line(values, radius, dim, 0).clone()
    for k in range(1, radius + 1):
        weight = math.exp(-0.5 * (k / sigma) ** 2)
        for step in (-k, k):
            total.add_(_line(values, radius, dim, step), alpha=weight)
    return total
