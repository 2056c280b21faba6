"""The lowest ray of one sensor over each cell.

All rays of a sensor share their origin, so a ray over a cell is known by azimuth and slope. Instead of marching along
each ray, a polar table holds for each (range, azimuth) the lowest slope of the rays that reached farther; each cell
looks its own entry up. Cost: points + table + cells, whatever the length of the rays.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.grid import GridConfig
from torchelev.ops.indexing import read
from torchelev.ops.minima import polar_minimum
from torchelev.stages.cells import center_offsets
from torchelev.stages.visibility.polar_table import PolarGrid, azimuth_fraction, flat
from torchelev.stages.visibility.rays import Rays
from torchelev.state import MapState, Measurement

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

NO_RAY = 1e4  # a slope above every ray's


class RayBins(NamedTuple):
    """Where the rays of one sensor lie in the polar table."""

    range: Int[Tensor, "B N"]  #: last one that a ray reaches at least a cell before its end; PolarGrid.ranges: none
    azimuth: Int[Tensor, "B N"]  #: azimuth bin
    slope: Float[Tensor, "B N"]  #: dz / dr


class View(NamedTuple):
    """Where the cells lie, as seen from a sensor."""

    x: Float[Tensor, "B H 1"]  #: [m] from the sensor to the cells' centres
    y: Float[Tensor, "B 1 W"]  #: [m] from the sensor to the cells' centres
    z: Float[Tensor, "B 1 1"]  #: [m] height of the sensor


def bins_of(rays: Rays, polar: PolarGrid, grid: GridConfig) -> RayBins:
    """Find the last range bin that each ray reaches at least a cell before its end, and its azimuth bin."""
    # Less its noise, or every other ray to the face of a step would seem to pass through the step's edge.
    last = torch.floor((rays.r - rays.noise) / grid.resolution).clamp(max=polar.ranges + 1) - 2
    a = torch.floor(rays.azimuth * polar.azimuths).clamp(max=polar.azimuths - 1)
    last = torch.where(rays.casts & (last >= 0), last, polar.ranges)
    return RayBins(last.to(torch.int32), a.to(torch.int32), rays.slope)


def view_from(state: MapState, m: Measurement, origin: Float[Tensor, "B 3"], grid: GridConfig) -> View:
    """Return where the cells lie, as seen from a sensor."""
    x, y = center_offsets(state, m, grid)
    return View(x - origin[:, 0, None, None], y - origin[:, 1, None, None], origin[:, 2, None, None])


def lowest_slopes(rays: RayBins, polar: PolarGrid) -> Float[Tensor, "B R P"]:
    """Return, for each range bin and azimuth, the lowest slope of the rays that reach at least a cell farther.

    At short range, where a cell covers several azimuth bins, an entry is the minimum of about half as many.
    """
    index = flat(rays.range, rays.azimuth, polar.azimuths).to(torch.int64)
    return polar_minimum(index, rays.slope, polar.azimuths, list(polar.widen), polar.ranges, NO_RAY)


class RayOverCell(NamedTuple):
    """The lowest ray of one sensor over each cell."""

    found: Bool[Tensor, "B H W"]  #: a ray passes over the cell
    height: Float[Tensor, "B H W"]  #: [m] over the cell's centre
    fall: Float[Tensor, "B H W"]  #: [m] how far it falls over a cell's length, or rises
    incidence: Float[Tensor, "B H W"]  #: |r . n|


def find_lowest_rays(state: MapState, view: View, table: Tensor, polar: PolarGrid, grid: GridConfig) -> RayOverCell:
    """Gather the lowest ray over each cell, or less than a cell beside it."""
    x, y, z_s = view
    rho = (x.square() + y.square()).clamp(min=1e-12).sqrt()
    k = torch.floor(rho / grid.resolution).clamp(max=polar.ranges)
    lowest = lowest_slope(table, k, azimuth_fraction(x, y) * polar.azimuths, polar)
    found = lowest < NO_RAY
    slope = lowest * found
    gx, gy = state.gradient_x, state.gradient_y
    along = (slope - (gx * x + gy * y) / rho).abs()
    incidence = along / ((1 + slope.square()) * (1 + gx.square() + gy.square())).sqrt()
    return RayOverCell(found, z_s + slope * rho, slope.abs() * grid.resolution, incidence)


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
