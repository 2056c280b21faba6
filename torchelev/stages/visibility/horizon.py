"""The steepest fall that rays may have before they pass below recently hit ground."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

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


def horizon(state: MapState, m: Measurement, rays: Rays, grid: GridConfig, cfg: RaycastConfig) -> Float[Tensor, "B N"]:
    """Return the steepest fall -dz/dr that a ray may have before it passes below ground hit within `min_time`.

    Rays that pass below it contradict it, and are wrong returns. It is the minimum, from the sensor to two bins before
    the ray's end, of the fall to each bin's ground; bins are two cells long, and as wide. A polar table of them over
    the whole window is filled by gathering from the map.

    Args:
        state: the maps.
        m: the scan.
        rays: of one sensor.
        grid: the window.
        cfg: the rules.
    """
    polar, step = PolarGrid.of(grid, cfg), 2 * grid.resolution
    ranges, azimuths = polar.horizon_ranges, polar.horizon_azimuths
    rho = (torch.arange(ranges, device=rays.r.device, dtype=rays.r.dtype) + 0.5)[:, None] * step
    angle = (torch.arange(azimuths, device=rays.r.device, dtype=rays.r.dtype) + 0.5) * (2 * math.pi / azimuths)
    x, y = (rays.origin[:, k, None, None] + rho * part for k, part in enumerate((angle.cos(), angle.sin())))
    slot, inside = locate(x, y, lattice_offset(state, m, grid), grid)
    lowest = state.elevation - height_margin(state.variance, grid, cfg)
    recent = state.validity & (state.time <= cfg.min_time)
    below_sensor = torch.where(recent, rays.origin[:, 2, None, None] - lowest, NO_FALL)
    fall = torch.where(inside, read(below_sensor, slot), NO_FALL * step) / rho
    steepest = running_minimum(fall.detach())  # compared with, and so without a gradient
    k = (torch.floor(rays.r / step) - 1).clamp(max=ranges - 1)
    a = torch.floor(rays.azimuth * azimuths).clamp(max=azimuths - 1)
    limit = steepest.flatten(1).gather(1, flat(k.clamp(min=0), a, azimuths).to(torch.int64))
    return torch.where(k >= 0, limit, NO_FALL)
