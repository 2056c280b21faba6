"""Sixteen robots on tiles of a terrain curriculum; one call updates their maps."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import torch
from matplotlib.colors import LightSource
from numpy.typing import NDArray
from torch import Tensor

from torchelev import ElevationMap, ElevationMapConfig, GridConfig
from torchelev.sim import DepthCamera, MountedSensor, Terrain, mount, terrain_grid
from torchelev.sim.poses import pose

KINDS = ("stairs_up", "boxes", "slope", "gaps", "rails", "stairs_down", "rough", "stepping_stones")
GRID = GridConfig(resolution=0.05, length_x=4.8, length_y=4.8)
NUM_ROBOTS = 16
_RADIUS, _SPEED, _NOISE = 2.0, 0.7, 0.004  # [m], [m/s], [m]
_SENSOR = MountedSensor(DepthCamera(96, 72, max_range=4.0), mount(pitch_deg=35.0, x=0.3))


def make_tiles() -> Terrain:
    """Build eight kinds of ground at two levels of difficulty."""
    return terrain_grid(KINDS, 2, length=12.0, resolution=0.05, seed=2)


def walk_in_circles(terrain: Terrain, frames: int, frames_per_second: float) -> Iterator[tuple[NDArray, NDArray]]:
    """Yield the elevations (B, H, W) [m] and headings (B,) [rad] while the robots walk in circles."""
    emap = ElevationMap(ElevationMapConfig(grid=GRID), num_envs=NUM_ROBOTS)
    generator, dt = torch.Generator().manual_seed(0), 1 / frames_per_second
    ids = torch.arange(NUM_ROBOTS)
    phase = 2 * math.pi * torch.rand(NUM_ROBOTS, generator=generator, dtype=torch.float64)
    turn = 1.0 - 2.0 * (ids % 2)
    for k in range(frames):
        angle = phase + turn * _SPEED / _RADIUS * k * dt
        yaw = angle + turn * math.pi / 2
        T_base = _pose(terrain, ids, angle, yaw)
        points = _SENSOR(terrain.field, ids, T_base)
        points = points + _NOISE * torch.randn(points.shape, generator=generator)
        emap.update(points, _SENSOR.T_map_sensor(T_base), T_base, dt if k else 0.0)
        yield emap.layer("elevation").numpy(), yaw.numpy()


def _pose(terrain: Terrain, ids: Tensor, angle: Tensor, yaw: Tensor) -> Tensor:
    """Return T_map_base (B, 4, 4) half a metre over the mean ground under each robot."""
    xy = _RADIUS * torch.stack([angle.cos(), angle.sin()], -1)
    around = 0.1 * torch.cartesian_prod(*[torch.arange(-3.0, 4.0)] * 2)
    ground = terrain.field.height(ids, (xy[:, None] + around).float()).mean(-1)
    return pose(torch.cat([xy, ground[:, None].double() + 0.5], -1), yaw)


def shade(elevation: NDArray, colors: NDArray, resolution: float) -> NDArray:
    """Return the colours (H, W, 3) of cells, from 0 to 1, lit from the upper left; x to the right, y up."""
    filled = np.where(np.isnan(elevation), np.nanmedian(elevation) if np.isfinite(elevation).any() else 0, elevation)
    light = LightSource(azdeg=315, altdeg=50).hillshade(filled.T, dx=resolution, dy=resolution, vert_exag=1.2)
    return (colors.transpose(1, 0, 2) * (0.45 + 0.7 * light[..., None])).clip(0, 1)[::-1]
