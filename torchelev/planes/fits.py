"""Planes through the windows around cells, as batched tensors: which cells are planar, and which hang together."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.ops.windows import window_moments
from torchelev.stages.surface import fit_plane, known_ground

if TYPE_CHECKING:
    from jaxtyping import Bool, Float


class Limits(NamedTuple):
    """What counts as a plane, in metres."""

    slope: float  #: [m/m]
    roughness: float  #: [m] root mean square distance from the plane
    distance: float  #: [m] of a single cell
    curvature: float  #: [1/m] of the slope between neighbours


class LocalPlanes(NamedTuple):
    """The plane of the window around each cell, and which neighbours' planes agree."""

    gradient_x: Float[Tensor, "B H W"]  #: [m/m]
    gradient_y: Float[Tensor, "B H W"]  #: dz/dy
    planar: Bool[Tensor, "B H W"]  #: the cell lies on its plane
    joined_x: Bool[Tensor, "B H-1 W"]  #: a cell and the next one along x
    joined_y: Bool[Tensor, "B H W-1"]  #: the cell and its neighbour along y lie on one surface


def window_radius(window: float, resolution: float) -> int:
    """Return the radius in cells of the largest window of at most `window` metres, but at least 1."""
    return max(1, math.floor((window / resolution - 1) / 2 + 1e-6))


def local_planes(
    elevation: Float[Tensor, "B H W"], known: Bool[Tensor, "B H W"], resolution: float, radius: int, limits: Limits
) -> LocalPlanes:
    """Fit a plane to the window of each cell, and tell which cells lie on one and which neighbours share it.

    A window counts where its known cells span a plane, and are as many as a window has in a corner of the map.
    """
    ground = known_ground(elevation, known, radius)
    plane = fit_plane(ground, radius, resolution)
    (number,) = window_moments([(ground.known, 0)], radius, radius)
    gx, gy = plane.gradient_x, plane.gradient_y
    steepness = torch.addcmul(gx * gx, gy, gy)
    smooth = plane.residual <= limits.roughness**2 * (1 + steepness)  # a distance from the plane, not in z
    planar = known & plane.spans & (number >= (radius + 1) ** 2) & (steepness <= limits.slope**2) & smooth
    height = ground.height[:, radius:-radius, radius:-radius]
    joined_x, joined_y = (_joined(planar, height, (gx, gy), axis, resolution, limits) for axis in (0, 1))
    return LocalPlanes(gx, gy, planar, joined_x, joined_y)


def _joined(
    planar: Tensor, height: Tensor, gradients: tuple[Tensor, Tensor], axis: int, resolution: float, limits: Limits
) -> Tensor:
    """Return which cells agree in height and slope with the next one along an axis."""

    def both(values: Tensor) -> tuple[Tensor, Tensor]:
        length = values.shape[axis + 1] - 1
        return values.narrow(axis + 1, 0, length), values.narrow(axis + 1, 1, length)

    (here, there), (z0, z1), (g0, g1) = both(planar), both(height), both(gradients[axis])
    step = torch.add(z1 - z0, g0 + g1, alpha=-resolution / 2)
    bends = [(after - before).square() for before, after in map(both, gradients)]
    level = (step.abs() <= 2 * limits.distance) & (bends[0] + bends[1] <= (limits.curvature * resolution) ** 2)
    return here & there & level
