"""Robots that stand still on rough ground, and the obstacles in front of them."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from torchelev import ElevationMap, ElevationMapConfig, GridConfig
from torchelev.sim import Boxes, DepthCamera, HeightField, Lidar, MountedSensor, mount
from torchelev.sim.exact import noise
from torchelev.sim.waves import natural_waves

GRID = GridConfig(resolution=0.04, length_x=8.0, length_y=8.0)
HALF_CELL = GRID.resolution / 2
BASE_HEIGHT, MAST_HEIGHT = 0.6, 0.3  # [m] of the base above the ground and of the sensor above the base
CAMERA = DepthCamera(width=64, height=48, max_range=6.0)
SENSORS = {
    "camera 64 x 48": MountedSensor(CAMERA, mount(28.6, z=MAST_HEIGHT)),
    "camera 120 x 90": MountedSensor(DepthCamera(width=120, height=90, max_range=6.0), mount(28.6, z=MAST_HEIGHT)),
    "lidar 16": MountedSensor(
        Lidar(rings=16, azimuths=720, fov_low_deg=-30, fov_high_deg=5), mount(0.0, z=MAST_HEIGHT)
    ),
    "lidar 32": MountedSensor(Lidar(rings=32, azimuths=720), mount(0.0, z=MAST_HEIGHT)),
}
OBSTACLES = {"box": (0.15, 0.15, 0.15), "person": (0.15, 0.25, 0.85), "wall": (0.1, 1.0, 0.5)}  # [m] half sizes
PERSON = OBSTACLES["person"]
_AHEAD = 2.5  # [m] from the sensor to an obstacle


class World:
    """B robots that stand still, each on its own ground, with their sensors and maps.

    Args:
        sensor: the sensor of every robot.
        seeds: B; each robot has its own ground and noise.
        compiled: compile the map's update.
        amplitude: height of the ground's waves [m].
        **cfg: groups of the map's configuration.
    """

    def __init__(self, sensor: MountedSensor, seeds: int, compiled: bool, amplitude: float = 0.03, **cfg: Any) -> None:
        axis = torch.linspace(-6.0, 6.0, 301, dtype=torch.float64)
        x, y = torch.meshgrid(axis, axis, indexing="ij")
        ground = torch.stack([natural_waves(seed, amplitude)(x, y) for seed in range(seeds)]).float()
        self.sensor, self.seeds = sensor, seeds
        self.field, self.tiles = HeightField(ground, resolution=0.04), torch.arange(seeds)
        self.T_map_base = torch.eye(4, dtype=torch.float64).repeat(seeds, 1, 1)
        self.T_map_base[:, 2, 3] = ground[:, 150, 150] + BASE_HEIGHT
        self.T_map_sensor = sensor.T_map_sensor(self.T_map_base)
        self.generator = torch.Generator().manual_seed(0)
        self.emap = ElevationMap(ElevationMapConfig(grid=GRID, **cfg), seeds)
        if compiled:
            self.emap.compile()

    def scan(self, boxes: Boxes | None, dt: float, fraction: float = 1.0) -> Tensor:
        """Fuse one scan with a fraction of its points; return the points (B, N, 3) [m] in the map frame."""
        points = self.sensor(self.field, self.tiles, self.T_map_base, boxes)
        points = noise.dropout(noise.noisy(points, self.generator), self.generator, share=1 - fraction)
        self.emap.update(points, self.T_map_sensor, self.T_map_base, dt=dt)
        T = self.T_map_sensor.float()
        return points @ T[:, :3, :3].mT + T[:, None, :3, 3]

    def above_ground(self) -> Tensor:
        """Return the elevation above the true ground (B, H, W) [m], NaN where unknown."""
        centers = self.emap.cell_centers().flatten(1, 2)
        state = self.emap.state
        truth = self.field.height(self.tiles, centers).view_as(state.elevation)
        return torch.where(state.validity, state.elevation - truth, math.nan)

    def ahead(self, half: tuple[float, float, float]) -> Boxes:
        """Return an obstacle 2.5 m ahead of each sensor, shifted at random by up to half a cell."""
        x, y = (torch.rand(2, self.seeds, generator=self.generator) - 0.5) * GRID.resolution
        return self.box(_AHEAD + half[0] + x, y, half)

    def box(self, x: Tensor, y: Tensor, half: tuple[float, float, float]) -> Boxes:
        """Return an upright box of half sizes `half` [m] on the ground of each robot, at (x, y), (B,) each [m]."""
        T = torch.eye(4).repeat(self.seeds, 1, 1, 1)
        T[:, 0, 0, 3], T[:, 0, 1, 3], T[:, 0, 2, 3] = x, y, half[2]
        return Boxes(T, torch.tensor(half).expand(self.seeds, 1, 3))
