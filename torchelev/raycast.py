"""Rays: what lies below a ray that reached farther is gone, and what no ray saw lies below the lowest ray.

All rays of a sensor share their origin, so a ray over a cell is known by azimuth and slope. Instead of marching along
each ray, a polar table holds for each (range, azimuth) the lowest slope of the rays that reached farther; each cell
looks its own entry up. Cost: points + table + cells, whatever the length of the rays.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.errors import require
from torchelev.grid import GridConfig, center_offsets, lattice_offset, locate
from torchelev.masks import NOWHERE, chosen, lifted, masked, zeroed
from torchelev.operators import polar_minimum, running_minimum
from torchelev.state import MapState, Measurement, count, tally
from torchelev.storage import read, realize, realize_all
from torchelev.windows import neighbours

if TYPE_CHECKING:
    from jaxtyping import Bool, Float

NO_RAY = 1e4  # a slope above every ray's
BREADTH = 1.125  # [cells] a ray so near passes over a cell: with less, rays of a still sensor would miss some for ever


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
        require(self.gate > 0, "raycast.gate", "must be positive", self.gate, "give standard deviations, such as 3")
        require(reach, "raycast.max_range", "must be positive", self.max_range, "give metres, or None")


class PolarGrid(NamedTuple):
    """Size of the polar table: bins are no longer than a cell, and no wider at any range used."""

    ranges: int
    azimuths: int
    widen: tuple[int, ...]  # up to which range BREADTH cells are wider than 1, 2, 4, ... azimuth bins

    @classmethod
    def of(cls, grid: GridConfig, cfg: RaycastConfig) -> PolarGrid:
        """Choose the table's size for a window."""
        reach = math.ceil((cfg.max_range or 0.55 * math.hypot(grid.length_x, grid.length_y)) / grid.resolution)
        # 8 % to spare, of which the approximated azimuth below takes 3: it widens some bins.
        azimuths = 2 * math.ceil(max(16.0, 1.08 * 2 * math.pi * reach) / 2)
        width = BREADTH * azimuths / (2 * math.pi)  # in azimuth bins, at a range of one cell
        levels = math.ceil(math.log2(2 * width))  # the sensor's own cell has a range of half a cell
        return cls(reach, azimuths, tuple(math.ceil(width / 2**k) for k in range(levels)))

    def widths(self, k: Tensor) -> Tensor:
        """Return how many azimuth bins a cell at range k is taken to cover, a power of two."""
        # Compiled it is computed for each cell, else for each range and looked up: each is the faster there.
        row = k if torch.compiler.is_compiling() else torch.arange(self.ranges + 1, device=k.device, dtype=k.dtype)
        width = torch.ones_like(row)
        for level, rows in enumerate(self.widen):
            width = torch.add(width, row < rows, alpha=2.0**level)
        return width if row is k else width.index_select(0, k.to(torch.int32).flatten()).view_as(k)


def turn(x: Tensor, y: Tensor) -> Tensor:
    """Return the azimuth as a fraction of a turn in [0, 1], within 0.001 turns of atan2 and without its cost.

    Rays and cells use the same function, so that only its monotony matters.
    """
    ax, ay = x.abs(), y.abs()
    high = torch.maximum(ax, ay)
    t = torch.minimum(ax, ay) / high.clamp(min=1e-30)
    eighth = t * (0.125 + 0.0434 * (1 - t))  # atan(t) / 2 pi
    quarter = mirrored(eighth, 0.25, ax - ay)
    half = mirrored(quarter, 0.5, x)
    return mirrored(half, 1.0, y)


def mirrored(share: Tensor, whole: float, side: Tensor) -> Tensor:
    """Return whole - share where `side` is negative, -0.0 too, else the share, which lies in [0, whole]."""
    half = torch.copysign(share.new_full((), whole / 2), side)
    return (share + (half - whole / 2)).abs()


class Rays(NamedTuple):
    """The rays of one sensor."""

    origin: Float[Tensor, "B 3"]  # [m] counted from the measurement's horizontal origin
    xy: Float[Tensor, "B N 2"]  # [m] from the sensor to the hit
    r: Float[Tensor, "B N"]  # [m] horizontal length
    slope: Float[Tensor, "B N"]  # dz / dr
    azimuth: Float[Tensor, "B N"]  # in turns
    noise: Float[Tensor, "B N"]  # [m] standard deviation of its end
    casts: Bool[Tensor, "B N"]
    overhang: Bool[Tensor, "B N"]  # the point lies above the exclusion ramp


def rays_of(m: Measurement, s: int) -> Rays:
    """Return the rays of sensor s."""
    sensors = m.origin.shape[1]
    ray = m.points.unflatten(1, (sensors, -1))[:, s] - m.origin[:, s, None]
    x, y, z = ray.unbind(-1)
    r = (x.square() + y.square()).clamp(min=1e-12).sqrt()
    casts, used, variance = (values.unflatten(1, (sensors, -1))[:, s] for values in (m.casts, m.used, m.variance))
    return Rays(m.origin[:, s], ray[..., :2], r, z / r, turn(x, y), variance.sqrt(), casts, casts & ~used)


# Which rays are believed ----------------------------------------------------------------------------------------------
# The lowest ray decides, so that one return that is too long would clear a radial line of ground.


def believed(state: MapState, m: Measurement, rays: Rays, grid: GridConfig, cfg: RaycastConfig) -> Bool[Tensor, "B N"]:
    """Tell which rays may clear and bound: their end is credible, and they pass below no ground hit of late."""
    lowest = state.elevation - height_margin(state, grid, cfg)
    clearance = horizon(state, m, rays, lowest, grid, cfg) + rays.slope
    return rays.casts & ends_well(state, m, rays, lowest, grid, cfg) & (clearance >= 0)


def ends_well(
    state: MapState, m: Measurement, rays: Rays, lowest: Tensor, grid: GridConfig, cfg: RaycastConfig
) -> Bool[Tensor, "B N"]:
    """Tell which rays end, or leave the window, in a well supported cell and not below it.

    Where nothing is known nobody vouches for a ray, unless its point is above the exclusion ramp: too long a return
    lies below the ground, not up there.
    """
    offset = lattice_offset(state, m, grid)[:, None]
    start = rays.origin[:, None, :2] + offset
    size = torch.stack([start.new_full((), n * grid.resolution) for n in (grid.height, grid.width)])
    inner = 0.5 * grid.resolution  # half a cell inside, so that rounding leaves no ray outside
    ahead = rays.xy > 0
    room = chosen(ahead, size - inner - start, inner - start)
    along = chosen(ahead, rays.xy.clamp(min=1e-9), rays.xy.clamp(max=-1e-9))  # never zero
    share = (room / along).amin(-1).clamp(0, 1)
    x, y = (rays.origin[:, None, :2] + share[..., None] * rays.xy).unbind(-1)
    slot, inside = locate(x, y, offset[:, 0], grid)
    floor = (
        realize(lifted(lowest, ~well_supported(state, cfg, grid.resolution))).flatten(1).gather(1, slot.to(torch.int64))
    )
    height = rays.origin[:, None, 2] + share * rays.r * rays.slope
    return inside & (height >= floor) | rays.overhang


def well_supported(state: MapState, cfg: RaycastConfig, resolution: float) -> Bool[Tensor, "B H W"]:
    """Tell which known cells are believed: enough points agree, or on a neighbouring cell of like height."""
    enough = state.validity & (state.support >= cfg.min_support)
    _, above, _, left, right, _, below, _ = neighbours(lifted(state.elevation, ~enough), NOWHERE)
    unlike = functools.reduce(torch.minimum, [(h - state.elevation).abs() for h in (above, left, right, below)])
    return enough | (state.validity & (unlike <= resolution))


def height_margin(state: MapState, grid: GridConfig, cfg: RaycastConfig) -> Float[Tensor, "B H W"]:
    """Return how far below a cell's elevation a ray must pass to contradict it [m]; half a cell allows for relief."""
    # An infinite gate must leave finite heights.
    return (cfg.gate * (state.variance + (0.5 * grid.resolution) ** 2).sqrt()).clamp(max=NOWHERE)


def horizon(
    state: MapState, m: Measurement, rays: Rays, lowest: Tensor, grid: GridConfig, cfg: RaycastConfig
) -> Float[Tensor, "B N"]:
    """Return the steepest fall -dz/dr that a ray may have before it passes below ground hit within `min_time`.

    Rays that pass below it contradict it, and are wrong returns. Kept in a polar table of half the resolution, filled
    by gathering from the map: the running minimum, from the sensor outwards, of the fall to each bin's ground.
    """
    step = 2 * grid.resolution
    polar = PolarGrid.of(grid, cfg)
    ranges, azimuths = 8 * (polar.ranges // 16 + 1), polar.azimuths // 2
    device, dtype = rays.r.device, rays.r.dtype
    rho = (torch.arange(ranges, device=device, dtype=dtype) + 0.5)[:, None] * step
    angle = (torch.arange(azimuths, device=device, dtype=dtype) + 0.5) * (2 * math.pi / azimuths)
    # Realized, or the compiler computes them anew for every bin of every environment.
    x, y = (rays.origin[:, k, None, None] + rho * part for k, part in enumerate(realize_all(angle.cos(), angle.sin())))
    slot, inside = locate(x, y, lattice_offset(state, m, grid), grid)
    recent = state.validity & (state.time <= cfg.min_time)
    below_sensor = chosen(recent, rays.origin[:, 2, None, None] - lowest, NO_RAY)
    fall = chosen(inside, read(realize(below_sensor).flatten(1), slot), NO_RAY * step) / rho
    steepest = running_minimum(fall.detach(), from_end=False)  # compared with, and so without a gradient
    k = (torch.floor(rays.r / step) - 1).clamp(max=ranges - 1)
    a = torch.floor(rays.azimuth * azimuths).clamp(max=azimuths - 1)
    limit = steepest.flatten(1).gather(1, flat(k.clamp(min=0), a, azimuths).to(torch.int64))
    return chosen(k >= 0, limit, NO_RAY)


# The polar table ------------------------------------------------------------------------------------------------------


def lowest_slopes(rays: Rays, casts: Tensor, polar: PolarGrid, grid: GridConfig) -> Float[Tensor, "B R P"]:
    """Return, for each range bin and azimuth, the lowest slope of the rays that reach at least a cell farther.

    At short range, where a cell spans several azimuth bins, an entry is the minimum over half of them.
    """
    # Less its noise, or every other ray to the face of a step would seem to pass through the step's edge.
    last = torch.floor((rays.r - rays.noise) / grid.resolution).clamp(max=polar.ranges + 1) - 2
    a = torch.floor(rays.azimuth * polar.azimuths).clamp(max=polar.azimuths - 1)
    index = flat(chosen(casts & (last >= 0), last, polar.ranges), a, polar.azimuths)
    return polar_minimum(index.to(torch.int64), rays.slope, polar.azimuths, list(polar.widen[1:]), polar.ranges, NO_RAY)


def flat(row: Tensor, column: Tensor, width: int) -> Tensor:
    """Return the flat index of whole numbers, int32: float32 counts no farther than 2^24."""
    return row.to(torch.int32) * width + column.to(torch.int32)


class RayOverCell(NamedTuple):
    """The lowest ray of one sensor over each cell."""

    found: Bool[Tensor, "B H W"]
    height: Float[Tensor, "B H W"]  # [m] over the cell's centre
    fall: Float[Tensor, "B H W"]  # [m] how far it falls over a cell's length, or rises
    incidence: Float[Tensor, "B H W"]  # |r . n|


def look_up(
    state: MapState, m: Measurement, origin: Tensor, table: Tensor, polar: PolarGrid, grid: GridConfig
) -> RayOverCell:
    """Gather the lowest ray over each cell, or less than a cell beside it."""
    x, y = center_offsets(state, m, grid)
    x, y, z_s = x - origin[:, 0, None, None], y - origin[:, 1, None, None], origin[:, 2, None, None]
    rho = (x.square() + y.square()).clamp(min=1e-12).sqrt()
    k = torch.floor(rho / grid.resolution).clamp(max=polar.ranges)
    width = polar.widths(k)
    a = torch.floor(turn(x, y) * polar.azimuths - 0.5 * (width - 1))
    a = chosen(a < 0, a + polar.azimuths, a).clamp(max=polar.azimuths - 1)
    # Its two halves, as widening the whole table once more would take longer than to read twice.
    b = a + torch.floor(0.5 * width)
    b = chosen(b < polar.azimuths, b, b - polar.azimuths)
    slopes = table.flatten(1)
    lowest = torch.minimum(*(read(slopes, flat(k, place, polar.azimuths)) for place in (a, b)))
    slope = realize(lowest)  # or the compiler would gather anew for the masks and for the heights
    found = slope < NO_RAY
    slope = masked(slope, found)
    gx, gy = state.gradient_x, state.gradient_y
    along = (slope - torch.addcmul(gx * x, gy, y) / rho).abs()
    incidence = along / ((1 + slope.square()) * (1 + gx.square() + gy.square())).sqrt()
    return RayOverCell(found, z_s + slope * rho, slope.abs() * grid.resolution, incidence)


def clear_seen_through(state: MapState, m: Measurement, grid: GridConfig, cfg: RaycastConfig) -> MapState:
    """Remove what rays passed below, and bound what no ray saw (paper, Sec. II-E and II-H).

    A known cell goes if a ray's height over it is below h - sigma, it was not hit for `min_time`, and |r . n| > alpha_n
    (eq. 3 and 4), with n the cell's normal and r the direction of the lowest ray, the only one that the table keeps.
    Eq. 4 keeps grazing rays from eroding smooth ground; a ray that `passes_far_below` does not graze, and needs none:
    what is left of a ghost tilts its own normal, by which it would stay for ever.
    The upper bound of an unknown cell is the lowest ray height over it so far.
    """
    polar, known = PolarGrid.of(grid, cfg), state.validity
    for s in range(m.origin.shape[1]):
        rays = rays_of(m, s)
        table = lowest_slopes(rays, believed(state, m, rays, grid, cfg), polar, grid)
        state = clear_and_bound(state, look_up(state, m, rays.origin, table, polar, grid), grid, cfg)
    return tally(state, cleared_seen_through=count(known & ~state.validity))


def clear_and_bound(state: MapState, ray: RayOverCell, grid: GridConfig, cfg: RaycastConfig) -> MapState:
    """Apply the lowest ray of one sensor to every cell."""
    depth = state.elevation - ray.height
    seen_through = passes_far_below(state, depth, grid, cfg) | (ray.incidence > cfg.min_incidence)
    gone = state.validity & ray.found & (depth > state.variance.sqrt()) & (state.time > cfg.min_time) & seen_through
    validity = state.validity & ~gone
    # A ray below a challenger shows that nothing stands there: outliers stop no other ray. Within a cell a ray falls as
    # far as `fall`; those that end on an obstacle's top, two cells behind or farther, pass higher.
    passed = realize((ray.found & (ray.height < state.challenger + ray.fall)) | ~validity)
    bounds = ray.found & ~validity
    lower = torch.where(state.bounded, torch.minimum(state.upper_bound, ray.height), ray.height)
    upper_bound = torch.where(bounds, lower, state.upper_bound)  # which may be infinite where nothing is bounded
    challenger_support = zeroed(state.challenger_support, passed)
    validity, bounded, upper_bound, challenger_support = realize_all(
        validity, (state.bounded & ~state.validity) | bounds, upper_bound, challenger_support
    )
    return state._replace(
        validity=validity, bounded=bounded, upper_bound=upper_bound, challenger_support=challenger_support
    )


def passes_far_below(state: MapState, depth: Tensor, grid: GridConfig, cfg: RaycastConfig) -> Bool[Tensor, "B H W"]:
    """Tell where a ray passes so far below a cell that no grazing ray over its plane could, whatever the normal.

    depth > gate * sqrt(sigma^2 + (resolution / 2)^2) + |gradient| * resolution / 2: the noise, the relief within the
    cell, and what its plane rises from the centre to the border.
    """
    rise = (state.gradient_x.square() + state.gradient_y.square()).sqrt() * (0.5 * grid.resolution)
    return depth > height_margin(state, grid, cfg) + rise
