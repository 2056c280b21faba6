"""Planes through the windows around cells, as batched tensors: which cells are planar, and which neighbours agree."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.ops.windows import window_moments
from torchelev.plane_fit import fit_plane, known_ground

if TYPE_CHECKING:
    from jaxtyping import Bool, Float


class Limits(NamedTuple):
    """Thresholds of a planar window."""

    slope: float  #: [m/m] maximum
    roughness: float  #: [m] maximum root mean square distance of cells from their plane
    distance: float  #: [m] maximum distance of a single cell from its plane
    curvature: float  #: [1/m] maximum change of slope between neighbouring cells


class LocalPlanes(NamedTuple):
    """The plane of the window around each cell, and which neighbours' planes agree."""

    gradient_x: Float[Tensor, "B H W"]  #: dz/dx
    gradient_y: Float[Tensor, "B H W"]  #: dz/dy
    is_planar: Bool[Tensor, "B H W"]  #: the window's cells lie on a plane within the limits
    is_joined_x: Bool[Tensor, "B H-1 W"]  #: the cell and its neighbour along x lie on one surface
    is_joined_y: Bool[Tensor, "B H W-1"]  #: the cell and its neighbour along y lie on one surface


def window_radius(window: float, resolution: float) -> int:
    """Return the radius [cells] of the largest window of at most `window` [m], at least 1."""
    return max(1, math.floor((window / resolution - 1) / 2 + 1e-6))


def fit_local_planes(
    elevation: Float[Tensor, "B H W"], known: Bool[Tensor, "B H W"], resolution: float, radius: int, limits: Limits
) -> LocalPlanes:
    """Fit a plane to the window around each cell.

    A window counts if its known cells span a plane and are at least as many as a window has in a corner of the map.
    """
    ground = known_ground(elevation, known, radius)
    plane = fit_plane(ground, radius, resolution)
    (number,) = window_moments([(ground.known, 0)], radius, radius)
    gx, gy = plane.gradient_x, plane.gradient_y
    steepness = torch.addcmul(gx * gx, gy, gy)
    # The residual is in z; a plane's roughness is along its normal.
    is_smooth = plane.residual <= limits.roughness**2 * (1 + steepness)
    is_supported = plane.spans & (number >= (radius + 1) ** 2)
    is_planar = known & is_supported & (steepness <= limits.slope**2) & is_smooth
    height = ground.height[:, radius:-radius, radius:-radius]
    is_joined = (_agree(is_planar, height, (gx, gy), axis, resolution, limits) for axis in (0, 1))
    return LocalPlanes(gx, gy, is_planar, *is_joined)


def _agree(
    is_planar: Tensor, height: Tensor, gradients: tuple[Tensor, Tensor], axis: int, resolution: float, limits: Limits
) -> Tensor:
    """Return which planar cells agree in height and slope with the next cell along an axis."""

    def pairs(values: Tensor) -> tuple[Tensor, Tensor]:
        length = values.shape[axis + 1] - 1
        return values.narrow(axis + 1, 0, length), values.narrow(axis + 1, 1, length)

    (planar0, planar1), (z0, z1), (g0, g1) = pairs(is_planar), pairs(height), pairs(gradients[axis])
    step = torch.add(z1 - z0, g0 + g1, alpha=-resolution / 2)
    bends = [(after - before).square() for before, after in map(pairs, gradients)]
    is_level = (step.abs() <= 2 * limits.distance) & (bends[0] + bends[1] <= (limits.curvature * resolution) ** 2)
    return planar0 & planar1 & is_level
