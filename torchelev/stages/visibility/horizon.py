"""The steepest fall that rays may have before they pass below recently hit ground."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torchelev.grid import GridConfig, locate
from torchelev.ops.indexing import read
from torchelev.ops.minima import running_minimum
from torchelev.stages.cells import lattice_offset
from torchelev.stages.visibility.config import RaycastConfig
from torchelev.stages.visibility.polar_table import PolarGrid, flat
from torchelev.stages.visibility.rays import Rays, height_margin
from torchelev.state import MapState, Measurement

if TYPE_CHECKING:
    from jaxtyping import Float

NO_FALL = 1e4  # a fall -dz/dr that no ray has


class SeenRays(NamedTuple):
    """Rays, and where their sensors are."""

    r: Float[Tensor, "B N"]  #: [m] horizontal length
    azimuth: Float[Tensor, "B N"]  #: in turns
    origin: Float[Tensor, "B 3"]  #: [m] of the sensor, counted from the measurement's horizontal origin
    offset: Float[Tensor, "B 2"]  #: [m] of that origin in the window


class Directions(NamedTuple):
    """Azimuths, evenly spaced."""

    cosines: Float[Tensor, "A"]  #: of each azimuth
    sines: Float[Tensor, "A"]  #: of each azimuth


def horizon(state: MapState, m: Measurement, rays: Rays, grid: GridConfig, cfg: RaycastConfig) -> Float[Tensor, "B N"]:
    """Return the steepest fall -dz/dr that a ray may have before it passes below ground hit within `min_time`.

    Rays that pass below it contradict it, and are wrong returns. It is the minimum, from the sensor to two bins before
    the ray's end, of the fall to each bin's ground; bins are two cells long, and as wide.

    Args:
        state: the maps.
        m: the scan.
        rays: of one sensor.
        grid: the window.
        cfg: the rules.
    """
    polar = PolarGrid.of(grid, cfg)
    ranges, ways = 8 * (polar.ranges // 16 + 1), directions(polar.azimuths // 2, rays.r)
    seen = SeenRays(rays.r, rays.azimuth, rays.origin, lattice_offset(state, m, grid))
    return limits_by_tensors(state, seen, ways, ranges, grid, cfg)


def directions(number: int, like: Tensor) -> Directions:
    """Return the directions of so many azimuths."""
    angle = (torch.arange(number, device=like.device, dtype=like.dtype) + 0.5) * (2 * math.pi / number)
    return Directions(angle.cos(), angle.sin())


def limits_by_tensors(
    state: MapState,
    rays: SeenRays,
    ways: Directions,
    ranges: int,
    grid: GridConfig,
    cfg: RaycastConfig,
) -> Float[Tensor, "B N"]:
    """Return each ray's limit, from a polar table over the whole window that is filled by gathering from the map."""
    step, azimuths = 2 * grid.resolution, len(ways.cosines)
    rho = (torch.arange(ranges, device=rays.r.device, dtype=rays.r.dtype) + 0.5)[:, None] * step
    x, y = (rays.origin[:, k, None, None] + rho * part for k, part in enumerate(ways))
    slot, inside = locate(x, y, rays.offset, grid)
    lowest = state.elevation - height_margin(state.variance, grid, cfg)
    recent = state.validity & (state.time <= cfg.min_time)
    below_sensor = torch.where(recent, rays.origin[:, 2, None, None] - lowest, NO_FALL)
    fall = torch.where(inside, read(below_sensor, slot), NO_FALL * step) / rho
    steepest = running_minimum(fall.detach())  # compared with, and so without a gradient
    k = (torch.floor(rays.r / step) - 1).clamp(max=ranges - 1)
    a = torch.floor(rays.azimuth * azimuths).clamp(max=azimuths - 1)
    limit = steepest.flatten(1).gather(1, flat(k.clamp(min=0), a, azimuths).to(torch.int64))
    return torch.where(k >= 0, limit, NO_FALL)
