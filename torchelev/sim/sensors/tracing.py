"""Rays against height fields, without marching from sample to sample.

The rays advance in rounds of two parts. `skip` jumps through the air over blocks of cells: a ray cannot hit anything
in a block until it has descended to the block's highest point, so that free space costs few steps. `search` then
intersects the next cells exactly, see `crossing`. Every
round advances by at least `count` cells, which bounds the number of rounds: after the last one, every ray is decided.
A CPU continues with the undecided rays only. A GPU continues with all rays, because to select some of them it would
have to wait for the host.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.sim.sensors.crossing import intersect
from torchelev.sim.terrains.heightfield import HeightField

if TYPE_CHECKING:
    from jaxtyping import Float, Int

_FIRST_SKIPS, _SKIPS = 3, 2  # jumps before the first search, and before every later one
MAX_CELLS = 32  # searched in a round, along x and along y each
_MAX_WORK = 16384  # cells along x that a CPU searches in a round, for all rays together
_TINY = 1e-9


class Rays(NamedTuple):
    """N rays, with x and y in cells, and z and the distance along the ray in metres."""

    ray: Int[Tensor, "N"]  #: index of the ray in the batch
    tile: Int[Tensor, "N"]  #: tile that the ray is cast at
    along: Float[Tensor, "N"]  #: [m] distance up to which nothing is hit
    start: Float[Tensor, "3 N"]  #: [cells, cells, m] origin, counted from the rim of the tile
    step: Float[Tensor, "3 N"]  #: [cells, cells, m] change per metre along the ray
    sign: Float[Tensor, "2 N"]  #: 1 where x, y grow along the ray, else -1
    inverse: Float[Tensor, "2 N"]  #: [m] along the ray per cell of x, y

    def select(self, indices: Int[Tensor, "K"]) -> Rays:
        """Return some of the rays."""
        return Rays(*(value.index_select(-1, indices) for value in self))


def _make_rays(field: HeightField, tile_ids: Tensor, origin: Tensor, directions: Tensor) -> Rays:
    """Return the rays of all environments; values that are not finite become 0, so that they make no bad index."""
    B, M, _ = directions.shape
    step = directions.flatten(0, 1).t().nan_to_num(0.0, 0.0, 0.0).contiguous()
    step[:2] /= field.resolution
    start = torch.cat([origin[:, :2] / field.resolution + field.middle, origin[:, 2:]], 1).nan_to_num(0.0, 0.0, 0.0)
    return Rays(
        ray=torch.arange(B * M, device=origin.device),
        tile=tile_ids.repeat_interleave(M),
        along=step.new_zeros(B * M),
        start=start.t().repeat_interleave(M, 1),
        step=step,
        sign=torch.copysign(torch.ones_like(step[:2]), step[:2]),
        inverse=1 / step[:2].abs().clamp(min=_TINY),
    )


def trace(
    field: HeightField,
    tile_ids: Int[Tensor, "B"],
    origin: Float[Tensor, "B 3"],
    directions: Float[Tensor, "B M 3"],
    max_range: float,
) -> Float[Tensor, "B M"]:
    """Return the distance [m] to the surface, more than `max_range` where there is no hit within that; all float32."""
    rays = _make_rays(field, tile_ids, origin, directions)
    can_select, max_cells = can_select_rays(origin.device), max_range / field.resolution
    distance = torch.full_like(rays.along, math.inf)
    searched, count, skips = 0, 1, _FIRST_SKIPS
    # Every cell takes a ray at least `resolution` farther, so that in the end it has hit or passed its range.
    while searched <= max_cells + 1 and len(rays.ray):
        if can_select:
            count = max(1, min(MAX_CELLS, _MAX_WORK // len(rays.ray)))
        rays = rays._replace(along=skip(field, rays, skips))
        ahead, horizon = search(field, rays, count)
        is_free = ahead > horizon
        hit = (rays.along + ahead).masked_fill(is_free, math.inf)
        rays = rays._replace(along=rays.along + horizon)
        if can_select:
            distance.index_copy_(0, rays.ray, hit)
            rays = rays.select((is_free & (rays.along <= max_range)).nonzero().squeeze(1))
        else:
            distance = torch.minimum(distance, hit)
        searched, count, skips = searched + count, min(2 * count, MAX_CELLS), _SKIPS
    return distance.view(directions.shape[:2])


def can_select_rays(device: torch.device) -> bool:
    """Return whether rays can be selected by their values without waiting for the device."""
    return device.type == "cpu"


def skip(field: HeightField, rays: Rays, times: int) -> Float[Tensor, "N"]:
    """Return how far along [m] each ray is after `times` jumps through free space.

    For each block size, consider the point one block ahead of the ray. The bound there holds for everything up to one
    block away from it, hence for the ray's next two blocks. The ray is free until their end, or until it has descended
    to that bound.
    """
    bounds = field.bounds
    cell = rays.inverse.amin(0)  # [m] along in which the faster one of x and y changes by one cell
    reach = cell * bounds.reach
    slowness = 1 / (-rays.step[2]).clamp(min=_TINY)  # [m] along per metre of descent
    first = torch.addcmul(bounds.first, rays.tile, bounds.size)
    # Position of the point one block ahead, in blocks, for along = 0, and its change per metre along.
    ahead = torch.addcmul((rays.step[:2] * cell)[:, None], rays.start[:2, None], 1 / bounds.edge)
    speed = rays.step[:2, None] / bounds.edge
    along = rays.along
    for _ in range(times):
        z = torch.addcmul(rays.start[2], along, rays.step[2])
        block = torch.addcmul(ahead, along, speed).floor_().clamp_(min=0)
        block = torch.minimum(block, bounds.last, out=block)
        index = torch.addcmul(block[1], block[0], bounds.row).to(torch.int64).add_(first)
        highest = bounds.highest.index_select(0, index.view(-1)).view(index.shape)
        free = torch.sub(z, highest, out=highest).mul_(slowness)
        along = torch.minimum(free, reach, out=free).amax(0).clamp_(min=0).add_(along)
    return along


def search(field: HeightField, rays: Rays, count: int) -> tuple[Float[Tensor, "N"], Float[Tensor, "N"]]:
    """Return how far ahead [m] each ray hits the surface, and the horizon [m] up to which this is exact.

    Searched are the ray's current cell and the cells behind its next `count` borders along x and along y. The horizon
    is the first border after these. A ray without a hit up to the horizon gets a distance beyond it.
    """
    place = torch.addcmul(rays.start, rays.along, rays.step)
    cell = place[:2].floor()
    inside = place[:2] - cell
    k = torch.arange(count + 1, device=cell.device, dtype=cell.dtype)[:, None]
    border = ((0.5 - rays.sign * (inside - 0.5))[:, None] + k) * rays.inverse[:, None]  # (2, count + 1, N) [m] ahead
    entry = torch.cat([torch.zeros_like(border[0, :1]), border[0, :count], border[1, :count]])
    inside = torch.addcmul(inside[:, None], entry, rays.step[:2, None])
    offset = inside.floor()
    # The cell of the ray, and the cell behind a border, must not depend on rounding.
    passed = rays.sign[:, None] * (k + 1)[:count]
    offset[:, 0], offset[0, 1 : count + 1], offset[1, count + 1 :] = 0.0, passed[0], passed[1]
    inside -= offset
    z = torch.addcmul(place[2], entry, rays.step[2])
    leave = (rays.inverse[:, None] * (0.5 - rays.sign[:, None] * (inside - 0.5))).amin(0)
    coefficients = field.coefficients(offset.add_(cell[:, None]), rays.tile)
    hit = intersect(field.surface, coefficients, inside, z, rays.step, leave)
    return hit.add_(entry).amin(0), border[:, count].amin(0)
