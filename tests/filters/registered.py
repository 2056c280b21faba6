"""Filters that the tests of registry and chain register."""

import torch

from torchelev.errors import require_positive
from torchelev.filters import register

CALLS = []


@register
def counted_offset(layer, *, by: float = 1.0):
    CALLS.append(by)
    return layer[0] + by, layer[1]


@register
def difference(a, b):
    return a[0] - b[0], a[1] & b[1]


@register
def in_cells(layer, *, resolution, length: float):
    require_positive(length=length)
    return torch.full_like(layer[0], length / resolution), layer[1]


@register
def logarithm(layer):
    return layer[0].log(), layer[1]
