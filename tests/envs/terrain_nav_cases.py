"""What the tests of TerrainNav share: bodies, courses and ground."""

import numpy as np
import torch

from envs.terrain_nav import BodyConfig, CourseConfig
from torchelev.sim.terrains.heightfield import HeightField

ROBOT = BodyConfig()
SMALL = CourseConfig(num_tiles=4, num_routes=16)
FLAT = CourseConfig(num_tiles=1, num_routes=8, shares=(0.0, 0.0, 0.0), roughness=0.0)
IDS = torch.zeros(1, dtype=torch.int64)


def field_of(height, resolution=0.05, length=8.0):
    """Sample height(x, y), of NumPy arrays, as one tile."""
    count = round(length / resolution) + 1
    axis = (np.arange(count) - (count - 1) / 2) * resolution
    x, y = np.meshgrid(axis, axis, indexing="ij")
    return HeightField(torch.tensor(height(x, y), dtype=torch.float32)[None], resolution)


def flat(x, y):
    return 0 * x
