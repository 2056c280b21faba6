"""How steeply rays may fall before they pass below ground that was hit recently."""

import numpy as np
import torch

from tests.helpers import pose, random_state, small_map
from torchelev import RaycastConfig
from torchelev.stages.visibility.horizon import NO_FALL, horizon
from torchelev.stages.visibility.rays import sensor_rays


def limits(reach, known=1.0):
    """What rays so long [m] from the middle of a map 0.5 m above its ground may fall, by their length."""
    emap = small_map(1, (20, 33), raycast=RaycastConfig(min_time=0.5))
    state = random_state(np.random.default_rng(0), emap.cfg.grid, 1, known, torch.float32)
    state.elevation.fill_(0.0), state.variance.fill_(1e-8), state.time.fill_(0.1)
    azimuth = torch.linspace(0, 6.2, 100)
    points = torch.stack([reach * azimuth.cos(), reach * azimuth.sin(), -torch.full_like(azimuth, 0.5)], -1)[None]
    m = emap.measure(points, pose((0.0, 0.0, 0.5)), None, dt=0.1)
    return horizon(state, m, sensor_rays(m, 0), emap.cfg.grid, emap.cfg.raycast)


def test_rays_that_end_nearby_may_fall_as_they_like():
    assert torch.equal(limits(0.0), torch.full((1, 100), NO_FALL))


def test_rays_may_fall_as_far_as_the_ground_before_their_end():
    """0.5 m, and three standard deviations of half a cell, over 0.7 m: the middle of the last bin that counts."""
    fall = (0.5 + 3 * 0.05) / 0.7
    torch.testing.assert_close(limits(0.95), torch.full((1, 100), fall), rtol=1e-3, atol=0)


def test_unknown_ground_stops_no_ray():
    assert (limits(0.95, known=0.0) > 1e3).all()
