"""A map as a mesh: smooth where the ground is smooth, with vertical faces at steps."""

from __future__ import annotations

import numpy as np
import pyvista as pv
from numpy.typing import NDArray

_STEP = 0.05  # [m] from one cell to the next; less is smooth ground
_MAX_RISE = 1.2  # [m]; a higher side is left open
_SIGNS = ((-1, -1), (1, -1), (1, 1), (-1, 1))  # corners of a cell, counted around it


def surface(xy: NDArray, elevation: NDArray, resolution: float, values: NDArray | None = None) -> pv.PolyData:
    """Return the top of each known cell and the sides between neighbours.

    Args:
        xy: (H, W, 2) [m] centres of the cells.
        elevation: (H, W) [m], NaN where unknown.
        resolution: [m] of a cell.
        values: (H, W) what is coloured; None: the heights.
    """
    corners = np.stack([_corner_height(elevation, *sign) for sign in _SIGNS], -1)  # (H, W, 4)
    offset = np.array(_SIGNS) * resolution / 2
    points = np.concatenate([xy[:, :, None] + offset, corners[..., None]], -1)  # (H, W, 4, 3)
    colors = corners if values is None else np.broadcast_to(values[..., None], corners.shape)
    tops = np.isfinite(corners).all(-1)
    quads, shades = [points[tops]], [colors[tops]]
    for faces, shade in (_sides(points, colors, 0), _sides(points, colors, 1)):
        quads.append(faces)
        shades.append(shade)
    return _mesh(np.concatenate(quads), np.concatenate(shades))


def _corner_height(z: NDArray, sx: int, sy: int) -> NDArray:
    """Return the height of one corner of each cell: the mean of the cells around it on the same level."""
    padded = np.pad(z, 1, constant_values=np.nan)
    H, W = z.shape
    around = [padded[1 + a * sx : 1 + a * sx + H, 1 + b * sy : 1 + b * sy + W] for a in (0, 1) for b in (0, 1)]
    stack = np.stack(around)
    level = np.abs(stack - z) < _STEP
    with np.errstate(invalid="ignore"):
        return np.where(level, stack, 0).sum(0) / np.where(np.isnan(z), np.nan, level.sum(0))


def _sides(points: NDArray, colors: NDArray, axis: int) -> tuple[NDArray, NDArray]:
    """Return the faces (F, 4, 3) between neighbours along an axis, and their colours (F, 4)."""
    near, far = ((1, 2), (0, 3)) if axis == 0 else ((3, 2), (0, 1))
    a, b = _pairs(points, axis)
    c, d = _pairs(colors, axis)
    faces = np.concatenate([a[..., near, :], b[..., far[::-1], :]], -2)
    shades = np.concatenate([c[..., near], d[..., far[::-1]]], -1)
    rise = np.abs(a[..., near, 2] - b[..., far, 2]).max(-1)
    drawn = (rise > 1e-4) & (rise < _MAX_RISE)
    return faces[drawn], shades[drawn]


def _pairs(values: NDArray, axis: int) -> tuple[NDArray, NDArray]:
    return (values[:-1], values[1:]) if axis == 0 else (values[:, :-1], values[:, 1:])


def _mesh(quads: NDArray, shades: NDArray) -> pv.PolyData:
    faces = np.column_stack([np.full(len(quads), 4), np.arange(4 * len(quads)).reshape(-1, 4)])
    mesh = pv.PolyData(quads.reshape(-1, 3), faces.ravel())
    mesh["values"] = shades.ravel()
    return mesh
