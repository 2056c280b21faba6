"""Rays: what lies below a ray that reached farther is gone, and what no ray saw lies below the lowest ray.

All rays of a sensor share their origin, so a ray over a cell is known by azimuth and slope. Instead of marching along
each ray, a polar table holds for each (range, azimuth) the lowest slope of the rays that reached farther; each cell
looks its own entry up. Cost: points + table + cells, whatever the length of the rays.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.grid import GridConfig
from torchelev.ops.indexing import read
from torchelev.ops.masks import count
from torchelev.ops.operators import polar_minimum
from torchelev.ops.storage import stored
from torchelev.stages.cells import center_offsets
from torchelev.stages.visibility.accepted_rays import Rays, accepted_rays, height_margin, sensor_rays
from torchelev.stages.visibility.config import RaycastConfig
from torchelev.stages.visibility.polar_table import PolarGrid, azimuth_fraction, flat
from torchelev.state import MapState, Measurement, tally

if TYPE_CHECKING:
    from jaxtyping import Bool, Float


NO_RAY = 1e4  # a slope above every ray's


def lowest_slopes(rays: Rays, polar: PolarGrid, grid: GridConfig) -> Float[Tensor, "B R P"]:
    """Return, for each range bin and azimuth, the lowest slope of the rays that reach at least a cell farther.

    At short range, where a cell covers several azimuth bins, an entry is the minimum of about half as many.
    """
    # Less its noise, or every other ray to the face of a step would seem to pass through the step's edge.
    last = torch.floor((rays.r - rays.noise) / grid.resolution).clamp(max=polar.ranges + 1) - 2
    a = torch.floor(rays.azimuth * polar.azimuths).clamp(max=polar.azimuths - 1)
    index = flat(torch.where(rays.casts & (last >= 0), last, polar.ranges), a, polar.azimuths)
    return polar_minimum(index.to(torch.int64), rays.slope, polar.azimuths, list(polar.widen), polar.ranges, NO_RAY)


class RayOverCell(NamedTuple):
    """The lowest ray of one sensor over each cell."""

    found: Bool[Tensor, "B H W"]  #: a ray passes over the cell
    height: Float[Tensor, "B H W"]  #: [m] over the cell's centre
    fall: Float[Tensor, "B H W"]  #: [m] how far it falls over a cell's length, or rises
    incidence: Float[Tensor, "B H W"]  #: |r . n|


def find_lowest_rays(
    state: MapState, m: Measurement, origin: Tensor, table: Tensor, polar: PolarGrid, grid: GridConfig
) -> RayOverCell:
    """Gather the lowest ray over each cell, or less than a cell beside it."""
    x, y = center_offsets(state, m, grid)
    x, y, z_s = x - origin[:, 0, None, None], y - origin[:, 1, None, None], origin[:, 2, None, None]
    rho = (x.square() + y.square()).clamp(min=1e-12).sqrt()
    k = torch.floor(rho / grid.resolution).clamp(max=polar.ranges)
    lowest = lowest_slope(table, k, azimuth_fraction(x, y) * polar.azimuths, polar)
    found = lowest < NO_RAY
    slope = lowest * found
    gx, gy = state.gradient_x, state.gradient_y
    along = (slope - (gx * x + gy * y) / rho).abs()
    incidence = along / ((1 + slope.square()) * (1 + gx.square() + gy.square())).sqrt()
    return RayOverCell(found, z_s + slope * rho, slope.abs() * grid.resolution, incidence)


@stored
def lowest_slope(table: Tensor, k: Tensor, azimuth: Tensor, polar: PolarGrid) -> Float[Tensor, "B H W"]:
    """Return the lowest slope in all azimuth bins that cells at range k cover; `azimuth` counts bins."""
    # Two entries, the first and the last, hold the minimum of all.
    width, entry = polar.covered(k)
    a = torch.floor(azimuth - 0.5 * width)
    further = (torch.floor(azimuth + 0.5 * width) - a + 1 - entry).clamp(min=0)
    a = torch.where(a < 0, a + polar.azimuths, a).clamp(max=polar.azimuths - 1)
    b = a + further
    b = torch.where(b < polar.azimuths, b, b - polar.azimuths)
    return torch.minimum(*(read(table, flat(k, place, polar.azimuths)) for place in (a, b)))


def clear_seen_through(state: MapState, m: Measurement, grid: GridConfig, cfg: RaycastConfig | None) -> MapState:
    """Remove what rays passed below, and bound what no ray saw (paper, Sec. II-E and II-H).

    A known cell goes if a ray's height over it is below h - sigma, it was not hit for `min_time`, and |r . n| > alpha_n
    (eq. 3 and 4), with n the cell's normal and r the direction of the lowest ray, the only one that the table keeps.
    Eq. 4 keeps grazing rays from eroding smooth ground. It is not asked of a ray that `passes_far_below`: the last
    cells of an obstacle that left have tilted normals, and would stay forever.
    The upper bound of an unknown cell is the lowest ray height over it so far. None for `cfg`: the stage is skipped.
    """
    if cfg is None:
        return state
    polar, known = PolarGrid.of(grid, cfg), state.validity
    for s in range(m.origin.shape[1]):
        rays = sensor_rays(m, s)
        table = lowest_slopes(accepted_rays(state, m, rays, grid, cfg), polar, grid)
        state = clear_and_bound(state, find_lowest_rays(state, m, rays.origin, table, polar, grid), grid, cfg)
    return tally(state, cleared_seen_through=count(known & ~state.validity))


@stored
def clear_and_bound(state: MapState, ray: RayOverCell, grid: GridConfig, cfg: RaycastConfig) -> MapState:
    """Apply the lowest ray of one sensor to every cell (paper, eq. 3 and 4).

    A cell goes if p_z < h - sigma (3) and |r . n| > alpha_n (4), and if it was not hit for `min_time`.
    """
    h, sigma, p_z = state.elevation, state.variance.sqrt(), ray.height
    passes_below = h - p_z > sigma
    is_steep = ray.incidence > cfg.min_incidence
    is_old = state.time > cfg.min_time
    gone = ray.found & passes_below & is_old & (is_steep | passes_far_below(state, h - p_z, grid, cfg))
    return lower_upper_bound(refute_challengers(state._replace(validity=state.validity & ~gone), ray), ray)


def refute_challengers(state: MapState, ray: RayOverCell) -> MapState:
    """Forget challengers that a ray passes below, and those of cells that are not known.

    Nothing stands there: outliers stop no other ray. From a cell's centre to its corner a ray falls by 0.71 of `fall`;
    those that end on an obstacle's top, more than a cell behind, pass higher than that.
    """
    passes_below = ray.found & (ray.height < state.challenger + math.sqrt(0.5) * ray.fall)
    return state._replace(challenger_support=torch.where(passes_below | ~state.validity, 0, state.challenger_support))


def lower_upper_bound(state: MapState, ray: RayOverCell) -> MapState:
    """Lower the upper bound of unknown cells to the ray's height (paper, Sec. II-H)."""
    bounds = ray.found & ~state.validity
    lower = torch.where(state.bounded, torch.minimum(state.upper_bound, ray.height), ray.height)
    upper_bound = torch.where(bounds, lower, state.upper_bound)  # which may be infinite where nothing is bounded
    return state._replace(bounded=bounds | (state.bounded & ~state.validity), upper_bound=upper_bound)


def passes_far_below(state: MapState, depth: Tensor, grid: GridConfig, cfg: RaycastConfig) -> Bool[Tensor, "B H W"]:
    """Tell where a ray passes so far below a cell that no grazing ray over its plane could, whatever the normal.

    depth > gate * sqrt(sigma^2 + (resolution / 2)^2) + |gradient| * resolution / 2: the noise, the relief within the
    cell, and what its plane rises from the centre to the border.
    """
    rise = (state.gradient_x.square() + state.gradient_y.square()).sqrt() * (0.5 * grid.resolution)
    return depth > height_margin(state, grid, cfg) + rise
