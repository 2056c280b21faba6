"""Which rays are accepted: the lowest ray decides, so that one return that is too long would clear a line of ground."""

from __future__ import annotations

import functools
import math
from typing import TYPE_CHECKING, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from torchelev.grid import GridConfig, locate
from torchelev.ops.indexing import read
from torchelev.ops.masks import NOWHERE
from torchelev.ops.operators import running_minimum
from torchelev.ops.storage import stored
from torchelev.ops.windows import neighbours
from torchelev.stages.cells import lattice_offset
from torchelev.stages.visibility.polar_table import PolarGrid, azimuth_fraction, flat
from torchelev.state import MapState, Measurement

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

    from torchelev.stages.visibility.config import RaycastConfig

NO_FALL = 1e4  # a fall -dz/dr that no ray has
# A ray that leaves the window over no known ground is accepted if it ends at most CLEARANCE below the lowest ground
# NEAR by, and taken for one that passes CLEARANCE above it: returns that are too long shall not bound below the truth.
NEAR, CLEARANCE = 1.0, 0.05  # [m]


class Rays(NamedTuple):
    """The rays of one sensor."""

    origin: Float[Tensor, "B 3"]  #: [m] counted from the measurement's horizontal origin
    xy: Float[Tensor, "B N 2"]  #: [m] from the sensor to the hit
    r: Float[Tensor, "B N"]  #: [m] horizontal length
    slope: Float[Tensor, "B N"]  #: dz / dr
    azimuth: Float[Tensor, "B N"]  #: in turns
    noise: Float[Tensor, "B N"]  #: [m] standard deviation of its end
    casts: Bool[Tensor, "B N"]  #: clears and bounds cells
    overhang: Bool[Tensor, "B N"]  #: the point lies above the exclusion ramp


def sensor_rays(m: Measurement, s: int) -> Rays:
    """Return the rays of sensor s."""
    sensors = m.origin.shape[1]
    ray = m.points.unflatten(1, (sensors, -1))[:, s] - m.origin[:, s, None]
    x, y, z = ray.unbind(-1)
    r = (x.square() + y.square()).clamp(min=1e-12).sqrt()
    casts, used, variance = (values.unflatten(1, (sensors, -1))[:, s] for values in (m.casts, m.used, m.variance))
    return Rays(m.origin[:, s], ray[..., :2], r, z / r, azimuth_fraction(x, y), variance.sqrt(), casts, casts & ~used)


def accepted_rays(state: MapState, m: Measurement, rays: Rays, grid: GridConfig, cfg: RaycastConfig) -> Rays:
    """Return the rays with `casts` narrowed to those that are accepted, and with their slopes corrected.

    Accepted rays end credibly (`has_credible_end`) and do not pass below recently hit ground (`horizon`).
    """
    lowest = state.elevation - height_margin(state, grid, cfg)
    above = horizon(state, m, rays, lowest, grid, cfg) + rays.slope >= 0
    well, slope = has_credible_end(state, m, rays, lowest, grid, cfg)
    return rays._replace(casts=rays.casts & well & above, slope=slope)


def has_credible_end(
    state: MapState, m: Measurement, rays: Rays, lowest: Tensor, grid: GridConfig, cfg: RaycastConfig
) -> tuple[Bool[Tensor, "B N"], Float[Tensor, "B N"]]:
    """Tell which rays end, or leave the window, in a well supported cell and not below it; and return their slopes.

    Of the others two kinds are accepted, as too long a return lies below the ground: those to a point above the
    exclusion ramp, and those that leave the window and end at most CLEARANCE below the lowest ground NEAR by, where
    nothing is known or below what once stood there. Relief may have stopped the latter before the border, so they are
    taken for rays that pass CLEARANCE above that ground.
    """
    end = find_ends(state, m, rays, grid)
    ground = supported_ground(state, cfg, grid.resolution)
    floor, known = (read(layer, end.slot) for layer in (lowest, ground))
    near = ground_at_borders(ground, grid).gather(1, end.border)
    z = rays.origin[:, None, 2]
    height, deepest = z + end.reach * rays.slope, z + rays.r * rays.slope.clamp(max=0)
    over = (known < 0.5 * NOWHERE) & (height >= floor)
    low = end.leaves & ~over & (deepest >= near - CLEARANCE)
    raised = torch.maximum(rays.slope, (near + CLEARANCE - z) / end.reach.clamp(min=1e-6))
    return end.inside & (over | low) | rays.overhang, torch.where(low & ~rays.overhang, raised, rays.slope)


@stored
def supported_ground(state: MapState, cfg: RaycastConfig, resolution: float) -> Float[Tensor, "B H W"]:
    """Return the elevation [m] of well supported cells, NOWHERE higher elsewhere."""
    return state.elevation + NOWHERE * ~well_supported(state, cfg, resolution)


class RayEnds(NamedTuple):
    """Where each ray ends, or where it is half a cell short of leaving the window."""

    slot: Int[Tensor, "B N"]  #: flat cell number
    inside: Bool[Tensor, "B N"]  #: false if the sensor is outside, too
    reach: Float[Tensor, "B N"]  #: [m] horizontal distance
    leaves: Bool[Tensor, "B N"]  #: the ray ends outside the window
    border: Int[Tensor, "B N"]  #: place in `ground_at_borders`


def find_ends(state: MapState, m: Measurement, rays: Rays, grid: GridConfig) -> RayEnds:
    """Locate where each ray ends or leaves the window."""
    offset = lattice_offset(state, m, grid)[:, None]
    start = rays.origin[:, None, :2] + offset
    size = torch.stack([start.new_full((), n * grid.resolution) for n in (grid.height, grid.width)])
    inner = 0.5 * grid.resolution  # half a cell inside, so that rounding leaves no ray outside
    ahead = rays.xy > 0
    room = torch.where(ahead, size - inner - start, inner - start)
    shares = room / torch.where(ahead, rays.xy.clamp(min=1e-9), rays.xy.clamp(max=-1e-9))  # never by zero
    end = start + rays.xy
    leaves = ((end < 0) | (end >= size)).any(-1)
    share = torch.where(leaves, shares.amin(-1).clamp(0, 1), 1.0)
    x, y = (rays.origin[:, None, :2] + share[..., None] * rays.xy).unbind(-1)
    slot, inside = locate(x, y, offset[:, 0], grid)
    through_x = shares[..., 0] <= shares[..., 1]
    side = torch.where(through_x, ahead[..., 0].to(torch.int32), 2 + ahead[..., 1].to(torch.int32))
    place = torch.where(through_x, slot % grid.width, slot // grid.width)
    border = side * max(grid.height, grid.width) + place
    return RayEnds(slot.to(torch.int64), inside, share * rays.r, leaves, border.to(torch.int64))


def ground_at_borders(ground: Tensor, grid: GridConfig) -> Float[Tensor, "B 4L"]:
    """Return the lowest ground [m] NEAR each place of the window's four borders, about NOWHERE where there is none.

    The borders are those of low x, high x, low y and high y; L is the longer one's number of cells.
    """
    cells = max(1, int(NEAR / grid.resolution))
    return border_minima(ground, cells, grid).unfold(2, 2 * cells + 1, 1).amin(-1).flatten(1)


@stored
def border_minima(ground: Tensor, cells: int, grid: GridConfig) -> Float[Tensor, "B 4 L+2*cells"]:
    """Return the lowest ground [m] within so many cells of each border, NOWHERE for so many cells beyond its ends."""
    rows, columns = (ground[:, :cells], ground[:, -cells:]), (ground[:, :, :cells], ground[:, :, -cells:])
    sides = [*(side.amin(1) for side in rows), *(side.amin(2) for side in columns)]
    length = max(grid.height, grid.width)
    return torch.stack([F.pad(side, (cells, cells + length - side.shape[1]), value=NOWHERE) for side in sides], 1)


def well_supported(state: MapState, cfg: RaycastConfig, resolution: float) -> Bool[Tensor, "B H W"]:
    """Tell which known cells are accepted: enough points agree, or on a neighbouring cell of like height."""
    enough = state.validity & (state.support >= cfg.min_support)
    _, above, _, left, right, _, below, _ = neighbours(state.elevation + NOWHERE * ~enough, NOWHERE)
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
    rho = (torch.arange(ranges, device=rays.r.device, dtype=rays.r.dtype) + 0.5)[:, None] * step
    x, y = (rays.origin[:, k, None, None] + rho * part for k, part in enumerate(directions(azimuths, rays.r)))
    slot, inside = locate(x, y, lattice_offset(state, m, grid), grid)
    recent = state.validity & (state.time <= cfg.min_time)
    below_sensor = torch.where(recent, rays.origin[:, 2, None, None] - lowest, NO_FALL)
    fall = torch.where(inside, read(below_sensor, slot), NO_FALL * step) / rho
    steepest = running_minimum(fall.detach())  # compared with, and so without a gradient
    k = (torch.floor(rays.r / step) - 1).clamp(max=ranges - 1)
    a = torch.floor(rays.azimuth * azimuths).clamp(max=azimuths - 1)
    limit = steepest.flatten(1).gather(1, flat(k.clamp(min=0), a, azimuths).to(torch.int64))
    return torch.where(k >= 0, limit, NO_FALL)


@stored  # or each bin of every environment would compute them anew
def directions(number: int, like: Tensor) -> tuple[Tensor, Tensor]:
    """Return the cosines and sines of so many azimuths (number,), evenly spaced."""
    angle = (torch.arange(number, device=like.device, dtype=like.dtype) + 0.5) * (2 * math.pi / number)
    return angle.cos(), angle.sin()
