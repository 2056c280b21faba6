"""Maps that the tests of observations share: ground by hand, and random maps with holes."""

import numpy as np
import pytest
import torch
from hypothesis import strategies as st

from tests.helpers import pose, random_state, small_map

SEEDS = st.integers(0, 10_000)
BASE = (0.3, -0.2, 0.7)
CORNER = (-12, -17)  # the window's, 30 x 30 cells of 0.1 m, around the base


def ground_map(height, num_envs=1, corner=CORNER, cells=(30, 30), dtype=torch.float64, **layers):
    """A map of 0.1 m cells that knows `height(x, y)` [m] everywhere, with its corner at these cell numbers."""
    emap = small_map(num_envs, cells, dtype=dtype)
    emap.corner.copy_(torch.tensor(corner))
    x, y = emap.cell_centers().unbind(-1)
    emap.elevation.copy_(height(x, y))
    for mask in (emap.validity, emap.has_normal, emap.rated):
        mask.fill_(True)
    for name, value in layers.items():
        getattr(emap, name).copy_(value)
    return emap


def plane(x, y):
    """Rises to the front and more to the left."""
    return 0.1 * x + 0.2 * y


def flat(x, y):
    return torch.zeros_like(x)


def near(*values):
    return pytest.approx(values, abs=1e-9)


def at(values, *index):
    return tuple(float(values[0, i]) for i in index)


def random_map(seed, num_envs=2, known=0.6, cells=(20, 18), dtype=torch.float64):
    """Holes larger than a cell, too; unknown cells hold NaN."""
    rng = np.random.default_rng(seed)
    emap = small_map(num_envs, cells, dtype=dtype)
    state = random_state(rng, emap.cfg.grid, num_envs, known, dtype)
    validity = state.validity & ~torch.nn.functional.max_pool2d((state.time < 0.03).float(), 5, 1, 2).bool()
    bounded = state.bounded & (state.support < 12)
    elevation = torch.where(validity, state.elevation, torch.nan)
    upper_bound = torch.where(bounded, state.upper_bound, torch.nan)
    corner = torch.tensor([[-10, -9], [70, -33]])[:num_envs]
    layers = dict(elevation=elevation, validity=validity, upper_bound=upper_bound, bounded=bounded)
    emap.load_state(state._replace(corner=corner, **layers))
    return emap, rng


def random_base(emap, rng, tilt=0.4):
    half = emap.cfg.grid.resolution / 2
    poses = []
    for center in emap.center.tolist():
        place = (center[0] + rng.uniform(-half, half), center[1] + rng.uniform(-half, half), rng.uniform(0.3, 1.2))
        poses.append(pose(place, rng.uniform(-3, 3), *rng.uniform(-tilt, tilt, 2)))
    return torch.cat(poses)
