"""Continue the known ground over unknown cells: nearby known heights, else the ground below the robot."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
import torch.nn.functional as F
from torch import Tensor

from torchelev.grid import GridConfig
from torchelev.layers import Layer, sample_layer

if TYPE_CHECKING:
    from jaxtyping import Float

MARGIN = 0.5  # [m] beyond the pattern within which cells are read
MAX_BLOCK = 1.0  # [m] side of the largest block of cells that counts as near a point


def continue_ground(
    layer: Layer,
    uv: Float[Tensor, "B M 2"],
    base_uv: Float[Tensor, "B 1 2"],
    base_z: Float[Tensor, "B 1"],
    grid: GridConfig,
    half_extent: tuple[int, int],
) -> Layer:
    """Estimate the ground at points from the known cells of an elevation layer.

    The known cells are averaged over blocks of 1, 2, 4, ... cells a side, and each level is read bilinearly. A point
    takes the smallest block that holds a known cell, up to 1 m a side. Farther from known cells the ground is flat, at
    its height below the base: the mean of the smallest block of any size around the base that lies below the base.

    Args:
        layer: the elevation, and where it is known.
        uv: the points, in cells from the window's corner.
        base_uv: the base, in cells from the window's corner.
        base_z: height of the base [m], map frame.
        grid: the map's grid.
        half_extent: largest distance of the points from the window's centre [cells]. Cells more than 0.5 m farther
            away are ignored, so that time and memory grow with the pattern and not with the window.

    Returns:
        Heights (B, M) and whether there is one; on an empty map there is none.
    """
    values, known = layer
    top, left = border_left_out(values.shape[1:], half_extent, margin_around(grid))
    values, known = (v[:, top : v.shape[1] - top, left : v.shape[2] - left] for v in (values, known))
    z = torch.nan_to_num(base_z, nan=0.0, posinf=0.0, neginf=0.0)  # GPU poses are not checked
    relative = torch.where(known, values - z[..., None], 0.0)
    points = torch.cat([uv, base_uv], 1)
    points = torch.stack([points[..., 0] - top, points[..., 1] - left], -1)
    num_near = count_near_levels(grid)
    levels = _read_levels((relative, known), points, num_near)
    below = [(mean[:, -1:], found[:, -1:] & (mean[:, -1:] < 0)) for mean, found in levels]
    base_ground, base_found = _take_first_known(below)
    ground, found = _take_first_known([(mean[:, :-1], found[:, :-1]) for mean, found in levels[:num_near]])
    return torch.where(found, ground, base_ground) + z, found | base_found


def margin_around(grid: GridConfig) -> int:
    """Return how many cells beyond the points `continue_ground` reads."""
    return math.ceil(MARGIN / grid.resolution)


def count_near_levels(grid: GridConfig) -> int:
    """Return how many sizes of blocks, from a cell on, count as near a point."""
    return 1 + max(0, math.floor(math.log2(MAX_BLOCK / grid.resolution)))


def border_left_out(size: Sequence[int], half_extent: tuple[int, int], margin: int) -> tuple[int, int]:
    """Return how many rows and columns at each side of a window lie more than `margin` cells beyond the points."""
    top, left = (max(0, n // 2 - cells - margin) for n, cells in zip(size, half_extent, strict=True))
    return top, left


def _read_levels(layer: Layer, points: Float[Tensor, "B M 2"], num_near: int) -> list[Layer]:
    """Read a layer at points [cells], averaged over blocks of 1, 2, 4, ... cells a side, up to one block.

    The mean of a block is that of its known quarters. Levels after the first `num_near` are read at the last point.
    """
    values, known = layer
    levels: list[Layer] = []
    while True:
        H, W = values.shape[1:]
        blocks = GridConfig(resolution=1.0, length_x=H, length_y=W)
        points = points if len(levels) < num_near else points[:, -1:]
        levels.append(sample_layer((values, known), points, blocks, "bilinear"))
        if max(H, W) == 1:
            return levels
        averages = F.avg_pool2d(torch.stack([values, known.to(values.dtype)], 1), 2, ceil_mode=True)
        total, weight = averages.unbind(1)
        known = weight > 0
        values, points = total / torch.where(known, weight, 1.0), points / 2


def _take_first_known(layers: list[Layer]) -> Layer:
    """Return at each point the value of the first layer that is known there."""
    values, known = layers[-1]
    for value, found in reversed(layers[:-1]):
        values, known = torch.where(found, value, values), known | found
    return values, known
