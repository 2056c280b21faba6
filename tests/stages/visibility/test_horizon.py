"""How steeply rays may fall, by marching along azimuths in C++ and by tensors over the whole window: the same."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.helpers import random_state, small_map
from torchelev import RaycastConfig
from torchelev.stages.visibility.horizon import NO_FALL, SeenRays, directions, limits_by_tensors
from torchelev.stages.visibility.polar_table import PolarGrid

CFG = RaycastConfig(min_time=0.5)
NO_MARGIN = replace(CFG, gate=1e-30)  # too small to change a height


@pytest.fixture(autouse=True)
def _no_gradient():
    with torch.no_grad():
        yield


def seen_by(cells, rng, num_envs=1, num_rays=100, reach=1.0, place=0.5, cfg=CFG, resolution=0.1, known=0.6):
    """What the twin takes: random maps, rays as long as `reach` windows on average, and sensors so far off centre."""
    grid = small_map(1, cells, resolution).cfg.grid
    state, polar = random_state(rng, grid, num_envs, known, dtype=torch.float32), PolarGrid.of(grid, cfg)
    size, length = (num_envs, num_rays), np.array(cells) * resolution
    offset = np.round(rng.uniform(-1, 2, (num_envs, 2)) * cells) * resolution
    sensor = length / 2 + place * length * rng.uniform(-1, 1, (num_envs, 2)) - offset
    origin = np.column_stack([sensor, rng.uniform(0.2, 1.0, num_envs)])
    r, azimuth = rng.exponential(reach * length.max(), size), rng.integers(0, 1001, size) / 1000
    rays = SeenRays(*(torch.from_numpy(value).float() for value in (r, azimuth, origin, offset)))
    return state, rays, directions(polar.azimuths // 2, rays.r), 8 * (polar.ranges // 16 + 1), grid, cfg


def test_rays_that_end_nearby_may_fall_as_they_like():
    inputs = seen_by((20, 33), np.random.default_rng(0), reach=0.0)
    assert torch.equal(limits_by_tensors(*inputs), torch.full((1, 100), NO_FALL))
