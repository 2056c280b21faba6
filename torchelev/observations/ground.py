"""The ground where the map knows none: what is known nearby, continued, else the ground under the robot."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import torch
import torch.nn.functional as F
from torch import Tensor

from torchelev.grid import GridConfig
from torchelev.layers import Layer, sample_layer

if TYPE_CHECKING:
    from jaxtyping import Float

MARGIN = 0.5  # [m] how far beyond the points cells are looked at
LARGEST = 1.0  # [m] side of the largest block of cells that counts as near a point


def continue_ground(
    layer: Layer,
    uv: Float[Tensor, "B M 2"],
    base_uv: Float[Tensor, "B 1 2"],
    base_z: Float[Tensor, "B 1"],
    grid: GridConfig,
    half: tuple[int, int],
) -> Layer:
    """Estimate the ground at points, in cells from the window's corner, from the known cells of an elevation layer.

    Means of the known cells over blocks of 1, 2, 4, ... cells a side, read bilinearly: the smallest block that knows
    something counts, up to 1 m a side. Farther from what is known, the ground is flat, as high as under the base:
    the mean of the smallest block around the base, of any size, that lies below the base.

    Only cells at most `half` + 0.5 m along x and y from the window's centre are looked at, so that time and memory grow
    with the pattern and not with the window. Returns heights (B, M), and where there is one: nowhere on an empty map.
    """
    values, known = layer
    margin = math.ceil(MARGIN / grid.resolution)
    top, left = (max(0, n // 2 - cells - margin) for n, cells in zip(values.shape[1:], half, strict=True))
    values, known = (v[:, top : v.shape[1] - top, left : v.shape[2] - left] for v in (values, known))
    z = torch.nan_to_num(base_z, nan=0.0, posinf=0.0, neginf=0.0)  # on a GPU nobody has looked at the poses
    above = torch.where(known, values - z[..., None], 0.0)
    places = torch.cat([uv, base_uv], 1)
    places = torch.stack([places[..., 0] - top, places[..., 1] - left], -1)
    levels = _levels((above, known), places)
    near = 1 + max(0, math.floor(math.log2(LARGEST / grid.resolution)))
    below = [(mean[:, -1:], found[:, -1:] & (mean[:, -1:] < 0)) for mean, found in levels]
    base_ground, base_found = _first_known(below)
    ground, found = _first_known([(mean[:, :-1], found[:, :-1]) for mean, found in levels[:near]])
    return torch.where(found, ground, base_ground) + z, found | base_found


def _levels(layer: Layer, places: Float[Tensor, "B M 2"]) -> list[Layer]:
    """Read a layer at places, in cells from its corner, as means over blocks of 1, 2, 4, ... cells a side, up to all.

    A block's mean is that of its quarters, of those that are known.
    """
    values, known = layer
    read = []
    while True:
        H, W = values.shape[1:]
        blocks = GridConfig(resolution=1.0, length_x=H, length_y=W)
        read.append(sample_layer((values, known), places, blocks, "bilinear"))
        if max(H, W) == 1:
            return read
        both = F.avg_pool2d(torch.stack([values, known.to(values.dtype)], 1), 2, ceil_mode=True)
        total, weight = both.unbind(1)
        known = weight > 0
        values, places = total / torch.where(known, weight, 1.0), places / 2


def _first_known(layers: list[Layer]) -> Layer:
    """Return the first value that is known, at each place."""
    values, known = layers[-1]
    for value, found in reversed(layers[:-1]):
        values, known = torch.where(found, value, values), known | found
    return values, known
