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
from torchelev.state import MapState, Measurement, count, tally
from torchelev.windows import running_minimum

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

NO_RAY = 1e4  # a slope above every ray's


@dataclass(frozen=True, kw_only=True)
class RaycastConfig:
    """When a ray removes a cell, and which rays are believed."""

    min_time: float = 1.0  # [s] cells hit within it stay
    min_incidence: float = 0.1  # alpha_n: |r . n| below it is a grazing ray
    max_range: float | None = None  # [m] rays count up to here; None: 1.1 half-diagonals of the window
    min_support: float = 2.0  # points that agree with a ray's end, or a neighbouring cell, for the ray to be believed
    gate: float = 3.0  # a ray that ends so many standard deviations below the known ground is a wrong return

    def __post_init__(self) -> None:
        require(self.min_time >= 0, "raycast.min_time", "must not be negative", self.min_time, "give seconds")
        cosine = 0 <= self.min_incidence < 1
        require(cosine, "raycast.min_incidence", "must lie in [0, 1)", self.min_incidence, "give a cosine such as 0.1")


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


def end_of_ray(state: MapState, m: Measurement, sensor: Tensor, points: Tensor, casts: Tensor, grid: GridConfig) -> tuple:
    """Return the cells and heights where rays end, or where they leave the window."""
    offset = lattice_offset(state, m, grid)[:, None]
    start, along = sensor[:, None, :2] + offset, points[..., :2] - sensor[:, None, :2]
    size = torch.stack([start.new_full((), n * grid.resolution) for n in (grid.height, grid.width)])
    inner = 0.5 * grid.resolution  # half a cell inside, so that rounding leaves no ray outside
    room = torch.where(along > 0, size - inner - start, inner - start)
    share = room / torch.where(along.abs() > 1e-9, along, torch.where(along > 0, 1e-9, -1e-9))
    share = share.amin(-1).clamp(0, 1)
    xy = sensor[:, None, :2] + share[..., None] * along
    height = sensor[:, None, 2] + share * (points[..., 2] - sensor[:, None, 2])
    return locate(xy, casts, offset[:, 0], grid), height


def well_supported(state: MapState, cfg: RaycastConfig, resolution: float) -> Bool[Tensor, "B H W"]:
    """Tell which known cells are believed: enough points agree, or a neighbouring cell has a like height."""
    supported = state.validity & (state.support >= cfg.min_support)
    for dim in (-1, -2):
        size = state.validity.shape[dim] - 1
        if size < 1:
            continue
        step = (state.elevation.narrow(dim, 1, size) - state.elevation.narrow(dim, 0, size)).abs()
        like = state.validity.narrow(dim, 1, size) & state.validity.narrow(dim, 0, size) & (step <= resolution)
        end = torch.zeros_like(state.validity.narrow(dim, 0, 1))
        supported = supported | torch.cat([like, end], dim) | torch.cat([end, like], dim)
    return supported & state.validity


def believed(state: MapState, m: Measurement, s: int, grid: GridConfig, cfg: RaycastConfig) -> Bool[Tensor, "B N"]:
    """Tell which rays may clear and bound.

    The lowest ray decides, so one return that is too long would clear a radial line of ground. A ray is believed only
    if it does not end below the known ground, and its end is no lone point. A ray that leaves the window is judged
    where it leaves.
    """
    points, casts = sensor_points(m, s)
    cells, height = end_of_ray(state, m, m.origin[:, s], points, casts, grid)
    known = cells.take(pad_cells(state.validity))
    supported = cells.take(pad_cells(well_supported(state, cfg, grid.resolution)))
    spread = cells.take(pad_cells(state.variance)) + (0.5 * grid.resolution) ** 2
    below = height < cells.take(pad_cells(state.elevation)) - cfg.gate * spread.sqrt()
    ends_well = (cells.index < cells.num_cells) & (~known | (supported & ~below))
    return casts & ends_well & ~under_horizon(state, m, s, grid, cfg)


def under_horizon(state: MapState, m: Measurement, s: int, grid: GridConfig, cfg: RaycastConfig) -> Bool[Tensor, "B N"]:
    """Tell which rays pass below ground that was hit within `min_time`: they contradict it, and are wrong returns.

    The horizon at a range is the steepest slope under which the sensor sees recently hit ground up to there. It is kept
    in a polar table of half the resolution, filled by gathering from the map.
    """
    step = 2 * grid.resolution
    polar = PolarGrid.of(grid, cfg)
    ranges, azimuths = polar.ranges // 2 + 1, polar.azimuths // 2
    points, device = sensor_points(m, s)[0], m.points.device
    rho = (torch.arange(ranges, device=device, dtype=points.dtype) + 0.5) * step
    angle = (torch.arange(azimuths, device=device, dtype=points.dtype) + 0.5) * (2 * math.pi / azimuths)
    circle = torch.stack([angle.cos(), angle.sin()], -1)
    xy = m.origin[:, s, None, :2] + (rho[:, None, None] * circle).flatten(0, 1)
    cells = locate(xy, torch.ones_like(xy[..., 0], dtype=torch.bool), lattice_offset(state, m, grid), grid)
    margin = cfg.gate * (state.variance + (0.5 * grid.resolution) ** 2).sqrt()
    recent = state.validity & (state.time <= cfg.min_time) & (state.support >= cfg.min_support)
    below_sensor = pad_cells(torch.where(recent, m.origin[:, s, 2, None, None] - state.elevation + margin, NO_RAY))
    fall = cells.take(below_sensor).unflatten(1, (ranges, azimuths)) / rho[:, None]
    horizon = running_minimum(torch.where(cells.index.view_as(fall) < grid.num_cells, fall, NO_RAY), from_end=False)
    ray = points - m.origin[:, s, None]
    r = (ray[..., 0].square() + ray[..., 1].square()).clamp(min=1e-12).sqrt()
    k = (torch.floor(r / step) - 1).clamp(max=ranges - 1)
    a = torch.floor(turn(ray[..., 0], ray[..., 1]) * azimuths).clamp(max=azimuths - 1)
    limit = horizon.flatten(1).gather(1, (k.clamp(min=0) * azimuths + a).to(torch.int64))
    return (k >= 0) & (-ray[..., 2] / r > limit)


def sensor_points(m: Measurement, s: int) -> tuple[Tensor, Tensor]:
    """Return the points (B, N, 3) of sensor s and whether they cast."""
    sensors = m.origin.shape[1]
    return m.points.unflatten(1, (sensors, -1))[:, s], m.casts.unflatten(1, (sensors, -1))[:, s]


def lowest_slopes(m: Measurement, s: int, casts: Tensor, polar: PolarGrid, grid: GridConfig) -> Float[Tensor, "B R A"]:
    """Return, for each range bin and azimuth, the lowest slope of the rays that reach at least one bin farther."""
    ray = sensor_points(m, s)[0] - m.origin[:, s, None]
    r = torch.linalg.vector_norm(torch.where(ray[..., :2] == 0, 1e-12, ray[..., :2]), dim=-1)
    slope = ray[..., 2] / r.clamp(min=1e-6)
    last = torch.floor(r / grid.resolution).clamp(max=polar.ranges + 1) - 2
    a = torch.floor(turn(ray[..., 0], ray[..., 1]) * polar.azimuths).clamp(max=polar.azimuths - 1)
    size = polar.ranges * polar.azimuths
    index = torch.where(casts & (last >= 0), last * polar.azimuths + a, size).to(torch.int64)
    table = slope.new_full((slope.shape[0], size + 1), NO_RAY).scatter_reduce(1, index, slope, "amin")
    return running_minimum(table[:, :-1].reshape(-1, polar.ranges, polar.azimuths), from_end=True)


def pyramid(table: Float[Tensor, "B R A"], levels: int) -> Float[Tensor, "B R P"]:
    """Append to the azimuths their minima over 2, 4, ... bins."""
    stack = [table]
    for _ in range(levels):
        stack.append(stack[-1].unflatten(-1, (-1, 2)).amin(-1))
    return torch.cat(stack, -1)


class RayOverCell(NamedTuple):
    """The lowest ray of one sensor over each cell."""

    found: Bool[Tensor, "B H W"]
    height: Float[Tensor, "B H W"]  # [m] over the cell's centre
    incidence: Float[Tensor, "B H W"]  # |r . n|


def look_up(state: MapState, m: Measurement, s: int, table: Tensor, polar: PolarGrid, grid: GridConfig) -> RayOverCell:
    """Gather the lowest ray over the inner half of each cell from the pyramid of azimuths."""
    x, y = center_offsets(state, m, grid)
    x, y, z_s = x - m.origin[:, s, 0, None, None], y - m.origin[:, s, 1, None, None], m.origin[:, s, 2, None, None]
    rho = (x.square() + y.square()).clamp(min=1e-12).sqrt()
    k = torch.floor(rho / grid.resolution)
    azimuth = turn(*torch.broadcast_tensors(x, y)) * polar.azimuths
    half_width = 0.25 * grid.resolution / rho / (2 * math.pi) * polar.azimuths
    level = torch.ceil(torch.log2(2 * half_width)).clamp(0, polar.levels)
    scale = torch.exp2(-level)
    start = 2 * polar.azimuths * (1 - scale)  # of the level within the pyramid
    total = table.shape[-1]
    slope = torch.full_like(rho, NO_RAY)
    for side in (-half_width, half_width):
        a = torch.floor(torch.remainder(azimuth + side, polar.azimuths) * scale)
        a = start + torch.minimum(a, polar.azimuths * scale - 1)
        index = (k.clamp(max=polar.ranges - 1) * total + a).to(torch.int64).flatten(1)
        slope = torch.minimum(slope, table.flatten(1).gather(1, index).view_as(rho))
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
    polar = PolarGrid.of(grid, cfg)
    cleared = torch.zeros_like(state.validity)
    for s in range(m.origin.shape[1]):
        casts = believed(state, m, s, grid, cfg)
        table = pyramid(lowest_slopes(m, s, casts, polar, grid), polar.levels)
        ray = look_up(state, m, s, table, polar, grid)
        below = ray.height < state.elevation - state.variance.sqrt()
        gone = state.validity & ray.found & below & (state.time > cfg.min_time) & (ray.incidence > cfg.min_incidence)
        bounds = ray.found & ~(state.validity & ~gone)
        lower = torch.where(state.bounded, torch.minimum(state.upper_bound, ray.height), ray.height)
        cleared = cleared | gone
        state = state._replace(
            validity=state.validity & ~gone,
            bounded=(state.bounded & ~state.validity) | bounds,
            upper_bound=torch.where(bounds, lower, state.upper_bound),
        )
    return tally(state, cleared_seen_through=count(cleared), cells_bounded=count(state.bounded & ~state.validity))
