"""Sums and maxima over the square window around each cell, along one dimension after the other."""

from __future__ import annotations

import functools

import torch
from torch import Tensor

from torchelev.operators import padded
from torchelev.storage import realize_all

AROUND = [(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if (i, j) != (0, 0)]


def _line(values: Tensor, radius: int, dim: int, k: int) -> Tensor:
    """Return what lies k entries on, along a dimension that is padded by `radius`."""
    return values.narrow(dim, radius + k, values.shape[dim] - 2 * radius)


def _line_sum(values: Tensor, radius: int, dim: int, power: int) -> Tensor:
    """Sum k^power * values over k = -radius .. radius along one dimension."""
    total = torch.zeros_like(_line(values, radius, dim, 0))
    for k in range(-radius, radius + 1):
        if power == 0 or k != 0:
            total = total + float(k) ** power * _line(values, radius, dim, k)
    return total


def window_moments(layers: list[tuple[Tensor, int]], radius: int) -> list[Tensor]:
    """Sum u^a v^b * values over the (2 * radius + 1)^2 window around each cell, zeros outside the layer.

    u and v count cells from the window's centre along H and W. For each layer (B, H, W) with its order, all moments
    with a + b <= order: (0, 0), (0, 1), ... (1, 0), ...
    """
    values = padded(torch.stack([layer for layer, _ in layers]), radius, 0.0)
    lines = [
        _line_sum(v, radius, -2, a) for v, (_, order) in zip(values, layers, strict=True) for a in range(order + 1)
    ]
    orders = [order - a for _, order in layers for a in range(order + 1)]
    lines = realize_all(*lines)
    return [_line_sum(line, radius, -1, b) for line, order in zip(lines, orders, strict=True) for b in range(order + 1)]


def window_maximum(values: Tensor, radius: int) -> Tensor:
    """Return the maximum over the (2 * radius + 1)^2 window around each cell of (..., H, W)."""
    highest = padded(values, radius, -torch.inf)
    for dim in (-2, -1):
        lines = [_line(highest, radius, dim, k) for k in range(-radius, radius + 1)]
        (highest,) = realize_all(functools.reduce(torch.maximum, lines))
    return highest


def neighbours(values: Tensor, fill: float) -> list[Tensor]:
    """Return the eight neighbours of each cell of (..., H, W) in the order of AROUND, `fill` outside the layer."""
    around = padded(values, 1, fill)
    rows = [_line(around, 1, -2, i) for i in (-1, 0, 1)]
    return [_line(rows[1 + i], 1, -1, j) for i, j in AROUND]
