"""Maps and polygons that the tests of planning share."""

import math

import numpy as np
import pytest
import torch
from hypothesis import strategies as st

from tests.helpers import random_state, small_map
from torchelev import TraversabilityConfig

SEEDS = st.integers(0, 10_000)
CELLS, RESOLUTION = (16, 14), 0.125  # m, exact in floating point
CORNER = torch.tensor([[-8, -7], [40, -33]])


#: A head whose robot has no limits: random heights are full of steps.
NO_LIMITS = TraversabilityConfig(critical_slope=math.inf, critical_step=math.inf)


def ground_map(traversability=1.0, known=True, num_envs=1, dtype=torch.float64, head=None):
    """A map of 16 x 14 cells of 12.5 cm; the first one spans x from -1 to 1, y from -0.875 to 0.875."""
    emap = small_map(num_envs, CELLS, RESOLUTION, dtype, traversability=head or TraversabilityConfig())
    emap.corner.copy_(CORNER[:num_envs])
    emap.traversability.copy_(torch.as_tensor(traversability))
    emap.rated.fill_(True)
    emap.validity.copy_(torch.as_tensor(known))
    return emap


def random_map(seed, num_envs=2, known=0.7):
    """Unknown cells hold NaN: none of it may be read."""
    emap = ground_map(num_envs=num_envs, head=NO_LIMITS)
    state = random_state(np.random.default_rng(seed), emap.cfg.grid, num_envs, known)
    traversability = torch.where(state.validity, state.traversability, torch.nan)
    emap.load_state(state._replace(corner=CORNER[:num_envs], traversability=traversability))
    return emap


def rectangle(x=0.0, y=0.0, length_x=0.5, length_y=0.25, yaw=0.0):
    """Corners (1, 1, 4, 2) around (x, y)."""
    corners = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * [length_x / 2, length_y / 2]
    turn = np.array([[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]])
    return torch.from_numpy(corners @ turn.T + [x, y])[None, None]


def random_polygons(rng, emap, number=6, vertices=5):
    """Some reach beyond the window, some are smaller than a cell."""
    center = emap.center[:, None, None, :2].numpy()
    angle = np.sort(rng.uniform(0, 2 * math.pi, (emap.num_envs, number, vertices)), -1)
    away = rng.uniform(0.02, 0.7, (emap.num_envs, number, 1)) * rng.uniform(0.3, 1.0, angle.shape)
    middle = center + rng.uniform(-1.1, 1.1, (emap.num_envs, number, 1, 2))
    return torch.from_numpy(middle + away[..., None] * np.stack([np.cos(angle), np.sin(angle)], -1))


def only(check):
    """The four results of the only polygon's rating."""
    return tuple(values.flatten()[0].item() for values in check[:4])


def near(*values):
    return pytest.approx(values, abs=1e-6)


def holds(polygon, x, y):
    """Return whether a polygon holds a point, by the even-odd rule."""
    odd = False
    for (ax, ay), (bx, by) in zip(polygon, np.roll(polygon, -1, 0), strict=True):
        if (ay > y) != (by > y) and x < ax + (y - ay) * (bx - ax) / (by - ay):
            odd = not odd
    return odd


def place(x, y, num_envs=1):
    """The same point (B, 2) on every map."""
    return torch.tensor([[x, y]], dtype=torch.float64).repeat(num_envs, 1)
