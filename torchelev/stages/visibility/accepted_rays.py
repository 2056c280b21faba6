"""Which rays are accepted: the lowest ray decides, so that one return that is too long would clear a line of ground."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, NamedTuple

import torch
import torch.nn.functional as F
from torch import Tensor

from torchelev.grid import GridConfig, locate
from torchelev.ops.indexing import read
from torchelev.ops.masks import NOWHERE
from torchelev.ops.windows import neighbours, sliding_minimum
from torchelev.stages.cells import lattice_offset
from torchelev.stages.visibility.horizon import horizon
from torchelev.stages.visibility.rays import Rays, height_margin
from torchelev.state import MapState, Measurement

if TYPE_CHECKING:
    from jaxtyping import Bool, Float, Int

    from torchelev.stages.visibility.config import RaycastConfig

# A ray that leaves the window over no known ground is accepted if it ends at most CLEARANCE below the lowest ground
# NEAR by, and taken for one that passes CLEARANCE above it: returns that are too long shall not bound below the truth.
NEAR, CLEARANCE = 1.0, 0.05  # [m]


def accepted_rays(state: MapState, m: Measurement, rays: Rays, grid: GridConfig, cfg: RaycastConfig) -> Rays:
    """Return the rays with `casts` narrowed to those that are accepted, and with their slopes corrected.

    Accepted rays end credibly (`has_credible_end`) and do not pass below recently hit ground (`horizon`).
    """
    above = horizon(state, m, rays, grid, cfg) + rays.slope >= 0
    well, slope = has_credible_end(state, m, rays, grid, cfg)
    return rays._replace(casts=rays.casts & well & above, slope=slope)


def has_credible_end(
    state: MapState, m: Measurement, rays: Rays, grid: GridConfig, cfg: RaycastConfig
) -> tuple[Bool[Tensor, "B N"], Float[Tensor, "B N"]]:
    """Return which rays end, or leave the window, in a well supported cell and not below it; and return their slopes.

    Of the others two kinds are accepted, as too long a return lies below the ground: those to a point above the
    exclusion ramp, and those that leave the window and end at most CLEARANCE below the lowest ground NEAR by, where
    nothing is known or below what once stood there. Relief may have stopped the latter before the border, so they are
    taken for rays that pass CLEARANCE above that ground.
    """
    end = find_ends(state, m, rays, grid)
    ground = supported_ground(state, cfg, grid.resolution)
    lowest = state.elevation - height_margin(state.variance, grid, cfg)
    floor, known = (read(layer, end.slot) for layer in (lowest, ground))
    near = read(ground_at_borders(ground, grid), end.border)
    z = rays.origin[:, None, 2]
    height, deepest = z + end.reach * rays.slope, z + rays.r * rays.slope.clamp(max=0)
    over = (known < 0.5 * NOWHERE) & (height >= floor)
    low = end.leaves & ~over & (deepest >= near - CLEARANCE)
    raised = torch.maximum(rays.slope, (near + CLEARANCE - z) / end.reach.clamp(min=1e-6))
    return end.inside & (over | low) | rays.overhang, torch.where(low & ~rays.overhang, raised, rays.slope)


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
    return sliding_minimum(border_minima(ground, cells, grid), 2 * cells + 1, 2).flatten(1)


def border_minima(ground: Tensor, cells: int, grid: GridConfig) -> Float[Tensor, "B 4 L+2*cells"]:
    """Return the lowest ground [m] within so many cells of each border, NOWHERE for so many cells beyond its ends."""
    rows, columns = (ground[:, :cells], ground[:, -cells:]), (ground[:, :, :cells], ground[:, :, -cells:])
    sides = [*(side.amin(1) for side in rows), *(side.amin(2) for side in columns)]
    length = max(grid.height, grid.width)
    return torch.stack([F.pad(side, (cells, cells + length - side.shape[1]), value=NOWHERE) for side in sides], 1)


def well_supported(state: MapState, cfg: RaycastConfig, resolution: float) -> Bool[Tensor, "B H W"]:
    """Return which known cells are accepted: enough points agree, or on a neighbouring cell of like height."""
    enough = state.validity & (state.support >= cfg.min_support)
    _, above, _, left, right, _, below, _ = neighbours(state.elevation + NOWHERE * ~enough, NOWHERE)
    unlike = functools.reduce(torch.minimum, [(h - state.elevation).abs() for h in (above, left, right, below)])
    return enough | (state.validity & (unlike <= resolution))
