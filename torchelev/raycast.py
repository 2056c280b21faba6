"""Rays: what lies below a ray that reached farther is gone, and what no ray saw lies below the lowest ray.

All rays of a sensor share their origin, so a ray over a cell is known by azimuth and slope. Instead of marching along
each ray, a polar table holds for each (range, azimuth) the lowest slope of the rays that reached farther; each cell
looks its own entry up. Cost: points + table + cells, whatever the length of the rays.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.errors import require
from torchelev.grid import GridConfig, center_offsets, lattice_offset, locate, pad_cells
from torchelev.operators import azimuth_pyramid, realize, running_minimum
from torchelev.state import MapState, Measurement, count, tally

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

NO_RAY = 1e4  # a slope above every ray's


@dataclass(frozen=True, kw_only=True)
class RaycastConfig:
    """When a ray removes a cell, and which rays are believed."""

    min_time: float = 1.0  # [s] cells hit within it stay, and contradict rays that pass below them
    min_incidence: float = 0.1  # alpha_n: |r . n| below it is a grazing ray
    max_range: float | None = None  # [m] rays count up to here; None: 1.1 half-diagonals of the window
    min_support: float = 3.0  # points that agree with a ray's end, or a neighbouring cell, for the ray to be believed
    gate: float = 3.0  # a ray so many standard deviations below ground that is known is a wrong return

    def __post_init__(self) -> None:
        require(self.min_time >= 0, "raycast.min_time", "must not be negative", self.min_time, "give seconds")
        cosine = 0 <= self.min_incidence < 1
        require(cosine, "raycast.min_incidence", "must lie in [0, 1)", self.min_incidence, "give a cosine such as 0.1")
        reach = self.max_range is None or self.max_range > 0
        require(reach, "raycast.max_range", "must be positive", self.max_range, "give metres, or None")


class PolarGrid(NamedTuple):
    """Size of the polar table: bins are no longer than a cell, and no wider at any range used."""

    ranges: int
    azimuths: int
    levels: int  # of the azimuth pyramid, each twice as wide as the one before

    @classmethod
    def of(cls, grid: GridConfig, cfg: RaycastConfig) -> PolarGrid:
        """Choose the table's size for a window."""
        reach = cfg.max_range or 0.55 * math.hypot(grid.length_x, grid.length_y)
        ranges = math.ceil(reach / grid.resolution)
        # The approximated azimuth below stretches some bins by 8 %.
        wanted = max(16.0, 1.08 * 2 * math.pi * ranges)
        levels = max(1, int(math.log2(wanted)) - 3)
        return cls(ranges, 2**levels * math.ceil(wanted / 2**levels), levels)


def turn(x: Tensor, y: Tensor) -> Tensor:
    """Return the azimuth as a fraction of a turn in [0, 1), within 0.1 % of atan2 and without its cost.

    Rays and cells use the same function, so that only its monotony matters.
    """
    ax, ay = x.abs(), y.abs()
    high = torch.maximum(ax, ay)
    t = torch.minimum(ax, ay) / torch.where(high > 0, high, 1.0)
    eighth = t * (0.125 + 0.0434 * (1 - t))  # atan(t) / 2 pi
    quarter = torch.where(ay > ax, 0.25 - eighth, eighth)
    half = torch.where(x < 0, 0.5 - quarter, quarter)
    return torch.where(y < 0, 1 - half, half)


class Rays(NamedTuple):
    """The rays of one sensor."""

    origin: Float[Tensor, "B 3"]  # [m] counted from the measurement's horizontal origin
    xy: Float[Tensor, "B N 2"]  # [m] from the sensor to the hit
    r: Float[Tensor, "B N"]  # [m] horizontal length
    slope: Float[Tensor, "B N"]  # dz / dr
    azimuth: Float[Tensor, "B N"]  # in turns
    casts: Bool[Tensor, "B N"]
    overhang: Bool[Tensor, "B N"]  # the point lies above the exclusion ramp


def rays_of(m: Measurement, s: int) -> Rays:
    """Return the rays of sensor s."""
    sensors = m.origin.shape[1]
    ray = m.points.unflatten(1, (sensors, -1))[:, s] - m.origin[:, s, None]
    x, y, z = ray.unbind(-1)
    r = (x.square() + y.square()).clamp(min=1e-12).sqrt()
    casts, used = (mask.unflatten(1, (sensors, -1))[:, s] for mask in (m.casts, m.used))
    return Rays(m.origin[:, s], ray[..., :2], r, z / r, turn(x, y), casts, casts & ~used)


# Which rays are believed ----------------------------------------------------------------------------------------------
# The lowest ray decides, so that one return that is too long would clear a radial line of ground.


def believed(state: MapState, m: Measurement, rays: Rays, grid: GridConfig, cfg: RaycastConfig) -> Bool[Tensor, "B N"]:
    """Tell which rays may clear and bound: their end is credible, and they pass below no ground hit of late."""
    clearance = horizon(state, m, rays, grid, cfg) + rays.slope
    return rays.casts & ends_well(state, m, rays, grid, cfg) & (clearance >= 0)


def ends_well(state: MapState, m: Measurement, rays: Rays, grid: GridConfig, cfg: RaycastConfig) -> Bool[Tensor, "B N"]:
    """Tell which rays end, or leave the window, in a well supported cell and not below it.

    Where nothing is known nobody vouches for a ray, unless its point is above the exclusion ramp: too long a return
    lies below the ground, not up there.
    """
    offset = lattice_offset(state, m, grid)[:, None]
    start = rays.origin[:, None, :2] + offset
    size = torch.stack([start.new_full((), n * grid.resolution) for n in (grid.height, grid.width)])
    inner = 0.5 * grid.resolution  # half a cell inside, so that rounding leaves no ray outside
    room = torch.where(rays.xy > 0, size - inner - start, inner - start)
    along = torch.where(rays.xy.abs() > 1e-9, rays.xy, torch.where(rays.xy > 0, 1e-9, -1e-9))
    share = (room / along).amin(-1).clamp(0, 1)
    xy = rays.origin[:, None, :2] + share[..., None] * rays.xy
    cells = locate(xy, rays.casts, offset[:, 0], grid)
    lowest = state.elevation - height_margin(state, grid, cfg)
    floor = cells.take(pad_cells(torch.where(well_supported(state, cfg, grid.resolution), lowest, 1e6)))
    height = rays.origin[:, None, 2] + share * rays.r * rays.slope
    return (cells.slot < cells.num_cells) & (height >= floor) | rays.overhang


def well_supported(state: MapState, cfg: RaycastConfig, resolution: float) -> Bool[Tensor, "B H W"]:
    """Tell which known cells are believed: enough points agree, or on a neighbouring cell of like height."""
    enough = supported = state.validity & (state.support >= cfg.min_support)
    for dim in (-1, -2):
        size = supported.shape[dim] - 1
        first, second = state.elevation.narrow(dim, 0, size), state.elevation.narrow(dim, 1, size)
        both = state.validity.narrow(dim, 0, size) & state.validity.narrow(dim, 1, size)
        like = both & ((first - second).abs() <= resolution)
        end = torch.zeros_like(enough.narrow(dim, 0, 1))
        by_second, by_first = like & enough.narrow(dim, 1, size), like & enough.narrow(dim, 0, size)
        supported = supported | torch.cat([by_second, end], dim) | torch.cat([end, by_first], dim)
    return supported


def height_margin(state: MapState, grid: GridConfig, cfg: RaycastConfig) -> Float[Tensor, "B H W"]:
    """Return how far below a cell's elevation a ray must pass to contradict it [m]; half a cell allows for relief."""
    return cfg.gate * (state.variance + (0.5 * grid.resolution) ** 2).sqrt()


def horizon(state: MapState, m: Measurement, rays: Rays, grid: GridConfig, cfg: RaycastConfig) -> Float[Tensor, "B N"]:
    """Return the steepest fall -dz/dr that a ray may have before it passes below ground hit within `min_time`.

    Rays that pass below it contradict it, and are wrong returns. Kept in a polar table of half the resolution, filled
    by gathering from the map: the running minimum, from the sensor outwards, of the fall to each bin's ground.
    """
    step = 2 * grid.resolution
    polar = PolarGrid.of(grid, cfg)
    ranges, azimuths = polar.ranges // 2 + 1, polar.azimuths // 2
    device, dtype = rays.r.device, rays.r.dtype
    rho = (torch.arange(ranges, device=device, dtype=dtype) + 0.5) * step
    angle = (torch.arange(azimuths, device=device, dtype=dtype) + 0.5) * (2 * math.pi / azimuths)
    circle = torch.stack([angle.cos(), angle.sin()], -1)
    xy = rays.origin[:, None, :2] + realize(rho[:, None, None] * circle).flatten(0, 1)
    cells = locate(xy, torch.ones_like(xy[..., 0], dtype=torch.bool), lattice_offset(state, m, grid), grid)
    recent = state.validity & (state.time <= cfg.min_time)
    depth = rays.origin[:, 2, None, None] - state.elevation + height_margin(state, grid, cfg)
    below_sensor = torch.where(recent, depth, NO_RAY)
    fall = torch.where(cells.slot < grid.num_cells, cells.take(pad_cells(below_sensor)), NO_RAY * step)
    fall = realize(fall).unflatten(1, (ranges, azimuths)) / rho[:, None]
    lowest = running_minimum(fall, from_end=False)
    k = (torch.floor(rays.r / step) - 1).clamp(max=ranges - 1)
    a = torch.floor(rays.azimuth * azimuths).clamp(max=azimuths - 1)
    limit = lowest.flatten(1).gather(1, (k.clamp(min=0) * azimuths + a).to(torch.int64))
    return torch.where(k >= 0, limit, NO_RAY)


# The polar table ------------------------------------------------------------------------------------------------------


def lowest_slopes(rays: Rays, casts: Tensor, polar: PolarGrid, grid: GridConfig) -> Float[Tensor, "B R P"]:
    """Return, for each range bin and azimuth, the lowest slope of the rays that reach at least a cell farther.

    Azimuths come as a pyramid: single bins, then minima over 2, 4, ...
    """
    last = torch.floor(rays.r / grid.resolution).clamp(max=polar.ranges + 1) - 2
    a = torch.floor(rays.azimuth * polar.azimuths).clamp(max=polar.azimuths - 1)
    size = polar.ranges * polar.azimuths
    index = torch.where(casts & (last >= 0), last * polar.azimuths + a, size).to(torch.int64)
    table = rays.slope.new_full((rays.slope.shape[0], size + 1), NO_RAY)
    table = table.scatter_reduce(1, index, rays.slope.detach(), "amin")[:, :-1]
    table = running_minimum(table.reshape(-1, polar.ranges, polar.azimuths), from_end=True)
    return azimuth_pyramid(table, polar.levels)


def cell_widths(polar: PolarGrid, like: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return half the width of a cell's inner half in azimuth bins, and where the pyramid has bins as wide, by range.

    The latter as the scale 2^-l of the level l and its begin in the flat table.
    """
    k = torch.arange(polar.ranges, device=like.device, dtype=like.dtype)
    half_width = realize(0.25 * polar.azimuths / (2 * math.pi * k.clamp(min=0.5)))
    scale = realize(torch.exp2(-torch.ceil(torch.log2(2 * half_width)).clamp(0, polar.levels)))
    total = sum(polar.azimuths >> level for level in range(polar.levels + 1))
    return half_width, scale, realize(k * total + 2 * polar.azimuths * (1 - scale))


def read(values: Float[Tensor, "B K"], index: Float[Tensor, "B H W"]) -> Float[Tensor, "B H W"]:
    """Give each cell the value at its index."""
    # Realized while it has two dimensions: flattened first, the compiler would divide to find row and column.
    return values.gather(1, realize(index.to(torch.int64)).flatten(1)).view_as(index)


class RayOverCell(NamedTuple):
    """The lowest ray of one sensor over each cell."""

    found: Bool[Tensor, "B H W"]
    height: Float[Tensor, "B H W"]  # [m] over the cell's centre
    incidence: Float[Tensor, "B H W"]  # |r . n|


def look_up(
    state: MapState, m: Measurement, origin: Tensor, table: Tensor, polar: PolarGrid, grid: GridConfig
) -> RayOverCell:
    """Gather the lowest ray over the inner half of each cell from the pyramid of azimuths."""
    x, y = center_offsets(state, m, grid)
    x, y, z_s = x - origin[:, 0, None, None], y - origin[:, 1, None, None], origin[:, 2, None, None]
    rho = (x.square() + y.square()).clamp(min=1e-12).sqrt()
    k = torch.floor(rho / grid.resolution)
    azimuth = turn(*torch.broadcast_tensors(x, y)) * polar.azimuths
    bins = k.clamp(max=polar.ranges - 1)
    half_width, scale, start = (read(values.expand(len(rho), -1), bins) for values in cell_widths(polar, rho))
    slope = torch.full_like(rho, NO_RAY)
    for side in (-half_width, half_width):
        a = torch.floor(torch.remainder(azimuth + side, polar.azimuths) * scale)
        slope = torch.minimum(slope, read(table.flatten(1), start + torch.minimum(a, polar.azimuths * scale - 1)))
    found = (slope < NO_RAY) & (k < polar.ranges)
    slope = torch.where(found, slope, 0.0)
    gx, gy = state.gradient_x, state.gradient_y
    along = (slope - gx * x / rho - gy * y / rho).abs()
    incidence = along / ((1 + slope.square()) * (1 + gx.square() + gy.square())).sqrt()
    return RayOverCell(found, z_s + slope * rho, incidence)


def clear_seen_through(state: MapState, m: Measurement, grid: GridConfig, cfg: RaycastConfig) -> MapState:
    """Remove what rays passed below, and bound what no ray saw (paper, Sec. II-E and II-H).

    A known cell goes if a ray's height over it is below h - sigma, it was not hit for `min_time`, and |r . n| > alpha_n
    (eq. 3 and 4), with n the cell's normal and r the direction of the lowest ray, the only one that the table keeps.
    The upper bound of an unknown cell is the lowest ray height over it so far.
    """
    polar, known = PolarGrid.of(grid, cfg), state.validity
    for s in range(m.origin.shape[1]):
        rays = rays_of(m, s)
        table = lowest_slopes(rays, believed(state, m, rays, grid, cfg), polar, grid)
        state = clear_and_bound(state, look_up(state, m, rays.origin, table, polar, grid), cfg)
    return tally(state, cleared_seen_through=count(known & ~state.validity))


def clear_and_bound(state: MapState, ray: RayOverCell, cfg: RaycastConfig) -> MapState:
    """Apply the lowest ray of one sensor to every cell."""
    below = ray.height < state.elevation - state.variance.sqrt()
    gone = state.validity & ray.found & below & (state.time > cfg.min_time) & (ray.incidence > cfg.min_incidence)
    validity = state.validity & ~gone
    bounds = ray.found & ~validity
    lower = torch.where(state.bounded, torch.minimum(state.upper_bound, ray.height), ray.height)
    return state._replace(
        validity=validity,
        bounded=(state.bounded & ~state.validity) | bounds,
        upper_bound=torch.where(bounds, lower, state.upper_bound),
    )
