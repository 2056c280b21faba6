"""Local geometry: slope, normals, roughness, standard deviation and step height of the ground around each cell.

Every window is a square of (2 r + 1)^2 cells with r the radius in whole cells, so its size in metres depends on the
resolution. On hills of 1.6 m with a radius of 16 cm, cells of 2 cm and of 8 cm agree to 3 % of the largest value for
slope and step height, 11 % for the standard deviation and 24 % for the roughness, which grows with the window.

Heights are taken from the map's mean, so that altitude costs no precision. In float32 a slope is accurate to 1e-5 rad,
a roughness or standard deviation to 1 / 2000 of the height above that mean.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torchelev.filters import opencv
from torchelev.filters.extrema import highest_known, lowest_known
from torchelev.filters.layer_tools import radius_cells
from torchelev.filters.registry import register
from torchelev.layers import Layer, normal_component
from torchelev.ops.windows import window_moments
from torchelev.plane_fit import Plane, fit_plane, known_ground

_MIN_SQUARE = 1e-12  # smaller squares count as this one: the root's derivative is infinite at 0


def safe_root(square: Tensor) -> Tensor:
    """Return the square root, at least 1e-6, so that its derivative is finite."""
    return square.clamp(min=_MIN_SQUARE).sqrt()


def _plane_around(layer: Layer, resolution: float, radius: float) -> Plane:
    """Fit a plane to the known cells within `radius` [m] of each cell; `spans` is false at unknown cells."""
    cells = radius_cells(radius, resolution)
    plane = fit_plane(known_ground(*layer, cells), cells, resolution)
    return plane._replace(spans=plane.spans & layer[1])


@register
def slope(layer: Layer, *, resolution: float, radius: float = 0.1) -> Layer:
    """Return the inclination [rad] of the plane z = c + g_x x + g_y y around each cell: atan(sqrt(g_x^2 + g_y^2)).

    At least 1e-6 rad. Unknown where the window's known cells do not span a plane (`plane_fit.spans_plane`).

    Args:
        layer: heights [m] and mask (B, H, W).
        resolution: [m] of a cell.
        radius: [m] half the window's side, rounded to cells, at least one.

    Raises:
        ValueError: if the radius is not positive.
    """
    plane = _plane_around(layer, resolution, radius)
    return torch.atan(safe_root(plane.gradient_x.square() + plane.gradient_y.square())), plane.spans


def _normal(layer: Layer, resolution: float, radius: float, axis: int) -> Layer:
    plane = _plane_around(layer, resolution, radius)
    return normal_component(plane.gradient_x, plane.gradient_y, axis), plane.spans


@register
def normal_x(layer: Layer, *, resolution: float, radius: float = 0.1) -> Layer:
    """Return the x component of the unit normal n = (-g_x, -g_y, 1) / sqrt(1 + g_x^2 + g_y^2).

    g is the gradient of the plane around each cell. Arguments and unknown cells as for `slope`.
    """
    return _normal(layer, resolution, radius, 0)


@register
def normal_y(layer: Layer, *, resolution: float, radius: float = 0.1) -> Layer:
    """Return the y component of the unit normal, see `normal_x`."""
    return _normal(layer, resolution, radius, 1)


@register
def normal_z(layer: Layer, *, resolution: float, radius: float = 0.1) -> Layer:
    """Return the z component of the unit normal, the cosine of the slope, see `normal_x`."""
    return _normal(layer, resolution, radius, 2)


@register
def roughness(layer: Layer, *, resolution: float, radius: float = 0.1) -> Layer:
    """Return the root mean square distance [m] in z of the window's known cells from the plane around each cell.

    sqrt(mean (z - c - g_x x - g_y y)^2). Arguments and unknown cells as for `slope`.
    """
    plane = _plane_around(layer, resolution, radius)
    return safe_root(plane.residual), plane.spans


@register
def standard_deviation(layer: Layer, *, resolution: float, radius: float = 0.1) -> Layer:
    """Return the standard deviation [m] of the window's known cells, sqrt(mean z^2 - (mean z)^2).

    Unlike `roughness` it includes the slope. Arguments as for `slope`.
    """
    cells = radius_cells(radius, resolution)
    if opencv.is_usable(layer[0]):
        return opencv.standard_deviation(layer, cells, math.sqrt(_MIN_SQUARE)), layer[1]
    known, height, _ = known_ground(*layer, cells)
    (sums,) = window_moments([(torch.stack([known, height, height.square()]), 0)], cells, cells)
    number, total, squares = sums.unbind(0)
    weight = 1 / number.clamp(min=1)
    mean = total * weight
    return safe_root(squares * weight - mean * mean), layer[1]


@register
def step_height(layer: Layer, *, resolution: float, radius: float = 0.1, less_slope: bool = False) -> Layer:
    """Return the height [m] of the window's highest known cell above its lowest.

    The first stage of the step filter of traversability_estimation (Wermelinger et al. 2016), on a square window. A
    `dilation` of it is the second stage, apart from that stage's count of critical cells.

    Args:
        layer: heights [m] and mask (B, H, W).
        resolution: [m] of a cell.
        radius: [m] half the window's side, rounded to cells, at least one.
        less_slope: subtract the height of the window's own plane, 2 radius (|g_x| + |g_y|), down to 0.

    Raises:
        ValueError: if the radius is not positive.
    """
    values, known = layer
    cells = radius_cells(radius, resolution)
    height = highest_known(values, known, cells) - lowest_known(values, known, cells)
    if less_slope:
        plane = _plane_around(layer, resolution, radius)
        plane_height = 2 * cells * resolution * (plane.gradient_x.abs() + plane.gradient_y.abs())
        return (height - plane_height).clamp(min=0), plane.spans
    return height, known
