"""Rays against height fields, without marching sample by sample.

A round has two parts. `skip` jumps as far as the bounds of blocks of cells allow: over a block a ray is safe until it
leaves it or sinks to its highest point, so that the air costs few steps however long the way. `search` then goes
through the next cells exactly: in each, the height over the bilinear surface is a quadratic along the ray. A round gets
at least `count` cells farther, which bounds the number of rounds: no ray is left undecided. A CPU goes on with those
rays alone that need it; a GPU, which would have to wait for the host to learn how many there are, goes through all.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.sim.terrains.heightfield import HeightField

if TYPE_CHECKING:
    from jaxtyping import Float, Int

FIRST_SKIPS, SKIPS = 3, 2  # jumps before the first search and before each other one
MOST_CELLS = 32  # searched in a round, along x and along y
WORK = 16384  # cells that a CPU searches in a round, along x, all rays together
TINY = 1e-9
HUGE = 1e30


class Rays(NamedTuple):
    """N rays. x and y are counted in cells, z and the way along the ray in metres."""

    number: Int[Tensor, "N"]  #: which of the rays that were asked for
    tile: Int[Tensor, "N"]  #: tile that each ray is cast at
    along: Float[Tensor, "N"]  #: [m] nothing was hit before
    start: Float[Tensor, "3 N"]  #: [m] tile frame
    step: Float[Tensor, "3 N"]  #: per metre along
    sign: Float[Tensor, "2 N"]  #: 1 where x, y grow along the ray, else -1
    inverse: Float[Tensor, "2 N"]  #: [m] along per cell of x, y

    def keep(self, which: Int[Tensor, "K"]) -> Rays:
        """Return some of the rays."""
        return Rays(*(value.index_select(-1, which) for value in self))


def rays_from(field: HeightField, tile_ids: Tensor, origin: Tensor, directions: Tensor) -> Rays:
    """Number the rays (B, M) one after the other. What is not finite becomes 0, lest it becomes an index."""
    B, M, _ = directions.shape
    step = directions.flatten(0, 1).t().nan_to_num(0.0, 0.0, 0.0).contiguous()
    step[:2] /= field.resolution
    start = torch.cat([origin[:, :2] / field.resolution + field.middle, origin[:, 2:]], 1).nan_to_num(0.0, 0.0, 0.0)
    return Rays(
        number=torch.arange(B * M, device=origin.device),
        tile=tile_ids.repeat_interleave(M),
        along=step.new_zeros(B * M),
        start=start.t().repeat_interleave(M, 1),
        step=step,
        sign=torch.copysign(torch.ones_like(step[:2]), step[:2]),
        inverse=1 / step[:2].abs().clamp(min=TINY),
    )


def trace(
    field: HeightField,
    tile_ids: Int[Tensor, "B"],
    origin: Float[Tensor, "B 3"],
    directions: Float[Tensor, "B M 3"],
    max_range: float,
) -> Float[Tensor, "B M"]:
    """Return the distance [m] to the surface, more than `max_range` where it is not met within that; all float32."""
    rays = rays_from(field, tile_ids, origin, directions)
    can_select, most = _picks_out(origin.device), max_range / field.resolution
    distance = torch.full_like(rays.along, math.inf)
    searched, count, skips = 0, 1, FIRST_SKIPS
    # A cell is left after `resolution` [m] or more, so that by then each ray has met the surface or come to its end.
    while searched <= most + 1 and len(rays.number):
        if can_select:
            count = max(1, min(MOST_CELLS, WORK // len(rays.number)))
        rays = rays._replace(along=skip(field, rays, skips))
        ahead, horizon = search(field, rays, count)
        missed = ahead > horizon
        found = (rays.along + ahead).masked_fill(missed, math.inf)
        rays = rays._replace(along=rays.along + horizon)
        if can_select:
            distance.index_copy_(0, rays.number, found)
            rays = rays.keep((missed & (rays.along <= max_range)).nonzero().squeeze(1))
        else:
            distance = torch.minimum(distance, found)
        searched, count, skips = searched + count, min(2 * count, MOST_CELLS), SKIPS
    return distance.view(directions.shape[:2])


def _picks_out(device: torch.device) -> bool:
    """Tell whether the host may learn which rays are done without waiting for the device."""
    return device.type == "cpu"


def skip(field: HeightField, rays: Rays, times: int) -> Float[Tensor, "N"]:
    """Return how far along [m] each ray is after `times` jumps that cannot have met the surface.

    For each size of blocks, the point one block ahead has all that is up to a block away from it, and so the ray's next
    two blocks, under the highest point near it. The ray may go to their end, or until it has sunk to that height.
    """
    bounds = field.bounds
    cell = rays.inverse.amin(0)  # [m] along in which the faster of x and y grows by one cell
    reach = cell * bounds.reach
    slowness = 1 / (-rays.step[2]).clamp(min=TINY)  # [m] along per metre sunk
    first = torch.addcmul(bounds.first, rays.tile, bounds.size)
    # Where the point one block ahead is at the start, counted in blocks, and how fast it moves.
    ahead = torch.addcmul((rays.step[:2] * cell)[:, None], rays.start[:2, None], 1 / bounds.edge)
    speed = rays.step[:2, None] / bounds.edge
    along = rays.along
    for _ in range(times):
        z = torch.addcmul(rays.start[2], along, rays.step[2])
        block = torch.addcmul(ahead, along, speed).floor_().clamp_(min=0)
        block = torch.minimum(block, bounds.last, out=block)
        number = torch.addcmul(block[1], block[0], bounds.row).to(torch.int64).add_(first)
        highest = bounds.highest.index_select(0, number.view(-1)).view(number.shape)
        safe = torch.sub(z, highest, out=highest).mul_(slowness)
        along = torch.minimum(safe, reach, out=safe).amax(0).clamp_(min=0).add_(along)
    return along


def search(field: HeightField, rays: Rays, count: int) -> tuple[Float[Tensor, "N"], Float[Tensor, "N"]]:
    """Return how far ahead [m] each ray meets the surface, and the horizon [m] up to which that is right.

    The cells are that in which the ray is, and those behind the next `count` borders across x and across y. Until the
    border after those, no others are met. A meeting beyond that horizon, or none, is a number greater than it.
    """
    place = torch.addcmul(rays.start, rays.along, rays.step)
    cell = place[:2].floor()
    inside = place[:2] - cell
    k = torch.arange(count + 1, device=cell.device, dtype=cell.dtype)[:, None]
    border = ((0.5 - rays.sign * (inside - 0.5))[:, None] + k) * rays.inverse[:, None]  # (2, count + 1, N) [m] ahead
    entry = torch.cat([torch.zeros_like(border[0, :1]), border[0, :count], border[1, :count]])
    inside = torch.addcmul(inside[:, None], entry, rays.step[:2, None])
    offset = inside.floor()
    # Which cell the ray is in, and which lies behind a border, must not depend on rounding.
    passed = rays.sign[:, None] * (k + 1)[:count]
    offset[:, 0], offset[0, 1 : count + 1], offset[1, count + 1 :] = 0.0, passed[0], passed[1]
    inside -= offset
    z = torch.addcmul(place[2], entry, rays.step[2])
    meeting = _meeting(field, rays, offset.add_(cell[:, None]), inside, z)
    return meeting.add_(entry).amin(0), border[:, count].amin(0)


def _meeting(field: HeightField, rays: Rays, cell: Tensor, inside: Tensor, z: Tensor) -> Float[Tensor, "E N"]:
    """Return how far [m] each ray meets the surface behind its entry into each of E cells, HUGE if not in that cell.

    With the ray s metres behind its entry, its height over the surface is over - sinking s - bend s^2. `inside`
    (2, E, N) is where the entry lies in the cell, `z` (E, N) [m] its height.
    """
    (u, v), (step_x, step_y, step_z) = inside, rays.step
    a, b, c, d = field.surface(cell, rays.tile)
    slope_x = torch.addcmul(b, d, v)
    over = z.sub_(a).addcmul_(slope_x, u, value=-1).addcmul_(c, v, value=-1)
    sinking = slope_x.mul_(step_x).addcmul_(c.addcmul_(d, u), step_y).sub_(step_z)
    # The first root, in the form that holds for bend = 0 too; NaN where there is none.
    root = d.mul_(4 * step_x * step_y).mul_(over).addcmul_(sinking, sinking)
    root = over.mul(2).div_(sinking.addcmul_(root.rsqrt(), root))
    leave = (rays.inverse[:, None] * (0.5 - rays.sign[:, None] * (inside - 0.5))).amin(0)
    # Arithmetic, as a CPU takes many times as long for conditions: negative where the root is not in [0, leave].
    outside = (leave - root).mul_(root).clamp_(max=0)
    root = root.sub_(outside.mul_(HUGE)).nan_to_num_(HUGE, HUGE, HUGE)
    return torch.minimum(root, over.clamp_(min=0).mul_(HUGE))  # what enters below the ground is met there
