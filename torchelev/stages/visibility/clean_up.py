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
from torchelev.ops.storage import as_bytes, as_mask, stored
from torchelev.ops.transforms import is_transforming
from torchelev.stages.cells import center_offsets
from torchelev.stages.visibility import native
from torchelev.stages.visibility.accepted_rays import Rays, accepted_rays, height_margin, sensor_rays
from torchelev.stages.visibility.config import RaycastConfig
from torchelev.stages.visibility.polar_table import NO_RAY, PolarGrid, azimuth_fraction, flat
from torchelev.state import MASKS, MapState, Measurement, tally

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int


# The layers that rays read, and those that they change, in the order of the operator below.
READ = (
    "elevation",
    "variance",
    "validity",
    "time",
    "gradient_x",
    "gradient_y",
    "challenger",
    "challenger_support",
    "upper_bound",
    "bounded",
)
CHANGED = ("validity", "bounded", "upper_bound", "challenger_support")


class RayBins(NamedTuple):
    """Where the rays of one sensor lie in the polar table."""

    range: Int[Tensor, "B N"]  #: last one that a ray reaches at least a cell before its end; PolarGrid.ranges: none
    azimuth: Int[Tensor, "B N"]
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
        bins = bins_of(accepted_rays(state, m, rays, grid, cfg), polar, grid)
        apply = apply_rays_on_cpu if runs_on_cpu(state) else apply_rays
        state = apply(state, bins, view_from(state, m, rays.origin, grid), polar, grid, cfg)
    return tally(state, cleared_seen_through=count(known & ~state.validity))


def apply_rays(
    state: MapState, rays: RayBins, view: View, polar: PolarGrid, grid: GridConfig, cfg: RaycastConfig
) -> MapState:
    """Apply the lowest of one sensor's rays over each cell."""
    table = lowest_slopes(rays, polar)
    return clear_and_bound(state, find_lowest_rays(state, view, table, polar, grid), grid, cfg)


def runs_on_cpu(state: MapState) -> bool:
    """Tell whether `apply_rays_on_cpu` may run: it has no gradient."""
    h = state.elevation
    return h.is_cpu and h.dtype == torch.float32 and not torch.is_grad_enabled() and not is_transforming()


def apply_rays_on_cpu(
    state: MapState, rays: RayBins, view: View, polar: PolarGrid, grid: GridConfig, cfg: RaycastConfig
) -> MapState:
    """Do the same in one pass of C++, where that can be built."""
    layers = [as_bytes(layer) if layer.dtype == torch.bool else layer for layer in (getattr(state, n) for n in READ)]
    limits = [grid.resolution, cfg.min_time, cfg.min_incidence, cfg.gate]
    sizes = polar.ranges, polar.azimuths, polar.bins, list(polar.widen)
    changed = dict(zip(CHANGED, _apply_rays(list(rays), list(view), layers, *sizes, limits), strict=True))
    masks = {name: as_mask(changed[name]) for name in MASKS if name in changed}
    return state._replace(**(changed | masks))


@torch.library.custom_op("torchelev::apply_rays", mutates_args=())
def _apply_rays(
    rays: list[Tensor],
    view: list[Tensor],
    layers: list[Tensor],
    ranges: int,
    azimuths: int,
    bins: float,
    widen: list[int],
    limits: list[float],
) -> list[Tensor]:
    polar = PolarGrid(ranges, azimuths, bins, tuple(widen))
    fast = native.clear_and_bound(rays, view, layers, polar, limits)
    return _apply_by_tensors(rays, view, layers, polar, *limits) if fast is None else fast


def _apply_by_tensors(
    rays: list[Tensor],
    view: list[Tensor],
    layers: list[Tensor],
    polar: PolarGrid,
    resolution: float,
    min_time: float,
    min_incidence: float,
    gate: float,
) -> list[Tensor]:
    """Do the same by `apply_rays`."""
    known = dict(zip(READ, layers, strict=True))
    masks = {name: as_mask(known[name]) for name in MASKS if name in known}
    state = MapState(**(dict.fromkeys(MapState._fields) | known | masks))  # type: ignore[arg-type]
    height, width = (size * resolution for size in layers[0].shape[1:])
    grid = GridConfig(resolution=resolution, length_x=height, length_y=width)
    cfg = RaycastConfig(min_time=min_time, min_incidence=min_incidence, gate=gate)
    after = apply_rays(state, RayBins(*rays), View(*view), polar, grid, cfg)
    changed = (getattr(after, name) for name in CHANGED)
    return [as_bytes(layer) if layer.dtype == torch.bool else layer for layer in changed]


@_apply_rays.register_fake
def _(rays, view, layers, ranges, azimuths, bins, widen, limits):  # noqa: ANN001
    known = dict(zip(READ, layers, strict=True))
    return [torch.empty_like(known[name], memory_format=torch.contiguous_format) for name in CHANGED]


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
