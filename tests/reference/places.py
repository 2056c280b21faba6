"""Where the cells of a window are, and how it moves."""

import math

import numpy as np


def cell_of(x, y, corner, resolution, shape):
    """The cell (i, j) that holds a map-frame position, or None outside the window."""
    i = math.floor(x / resolution) - corner[0]
    j = math.floor(y / resolution) - corner[1]
    return (i, j) if 0 <= i < shape[0] and 0 <= j < shape[1] else None


def center_of(i, j, corner, resolution):
    """The centre of a cell [m]."""
    return (corner[0] + i + 0.5) * resolution, (corner[1] + j + 0.5) * resolution


def window_corner(x, y, resolution, shape):
    """The corner of the window whose centre is nearest to a position, whole cells only."""
    return tuple(math.floor(p / resolution - n / 2 + 0.5) for p, n in zip((x, y), shape, strict=True))


def recenter(layer, old_corner, new_corner, blank):
    """A layer after the window has moved: what was there stays on its place in the world, the rest is blank."""
    moved = np.full_like(layer, blank)
    H, W = layer.shape
    for i in range(H):
        for j in range(W):
            old_i, old_j = i + new_corner[0] - old_corner[0], j + new_corner[1] - old_corner[1]
            if 0 <= old_i < H and 0 <= old_j < W:
                moved[i, j] = layer[old_i, old_j]
    return moved
