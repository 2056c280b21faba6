"""Robots that walk through scenes with more than one height, and what their lidar sees."""

import torch

from torchelev import ElevationMap, ElevationMapConfig, GridConfig, LevelsConfig
from torchelev.sim.exact.sensors import Lidar
from torchelev.sim.poses import pose

GRID = GridConfig(resolution=0.1, length_x=6.0, length_y=6.0)
LIDAR = Lidar(rings=48, azimuths=256, fov_low_deg=-60.0, fov_high_deg=60.0, max_range=12.0)
BASE_HEIGHT = 0.45


def make_map(num_envs=1, levels=None, **settings):
    levels = LevelsConfig() if levels is None else levels
    return ElevationMap(ElevationMapConfig(grid=GRID, levels=levels, **settings), num_envs)


def look(scene, x, y, ground=0.0, yaw=0.0, noise=0.005, seed=0):
    """Return the cloud and the poses of sensor and base of a robot that stands at a place."""
    T_map_base = pose(torch.tensor([x, y, ground + BASE_HEIGHT], dtype=torch.float64), yaw)
    T_map_sensor = T_map_base.clone()
    T_map_sensor[2, 3] += 0.1
    points = LIDAR.cast(scene, T_map_sensor)
    points = points + noise * torch.randn(points.shape, generator=torch.Generator().manual_seed(seed))
    return points[None].float(), T_map_sensor[None], T_map_base[None]


def walk(emap, scene, places, **settings):
    """Update a map at places (x, y, ground)."""
    for k, (x, y, ground) in enumerate(places):
        emap.update(*look(scene, x, y, ground, seed=k, **settings), dt=0.2)


def line(start, end, number):
    """Return places on a line."""
    a, b = torch.tensor(start, dtype=torch.float64), torch.tensor(end, dtype=torch.float64)
    return [tuple((a + (b - a) * k / max(1, number - 1)).tolist()) for k in range(number)]


def at(emap, layer, x, y, **settings):
    """Return a layer in the cell that holds a place."""
    cells = emap.cell_centers()[0]
    near = (cells - torch.tensor([x, y])).abs().amax(-1)
    i, j = divmod(int(near.argmin()), cells.shape[1])
    return float(emap.layer(layer, **settings)[0, i, j])
