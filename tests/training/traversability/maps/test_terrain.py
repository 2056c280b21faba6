"""Robots of all sizes and their walks over the tiles."""

import numpy as np
import pytest
import torch

from torchelev.robot import RobotConfig
from torchelev.sim import HeightField
from training.traversability.maps.terrain import (
    FRACTIONS,
    LENGTH,
    RESOLUTION,
    RIM,
    Footing,
    draw_robot,
    make_tiles,
    walks,
)


def test_robots_are_of_all_sizes():
    rng = np.random.default_rng(0)
    robots = [draw_robot(rng) for _ in range(200)]
    lengths = [robot.length for robot in robots]
    assert min(lengths) < 0.45 and max(lengths) > 0.95
    for name, (low, high) in FRACTIONS.items():
        shares = [getattr(robot, name) / robot.length for robot in robots]
        assert (
            low <= min(shares) + 1e-9 < low + (high - low) / 8 and high - (high - low) / 8 < max(shares) <= high + 1e-9
        )
    assert all(0.3 <= robot.max_slope <= 0.7 for robot in robots)


@pytest.mark.slow(1)
def test_robots_walk_within_the_tile_and_above_the_ground():
    rng, robot = np.random.default_rng(1), RobotConfig()
    field = make_tiles(("obstacles", "gaps"), rng)
    path = walks(Footing(field, robot), 2, 12, rng)
    assert path.shape == (12, 2, 4, 4)
    xy, z = path[..., :2, 3], path[..., 2, 3]
    assert float(xy.abs().amax()) <= LENGTH / 2 - RIM + 1e-6
    ground = field.height(torch.arange(2), xy.transpose(0, 1).float()).t()
    assert float((z - ground).amin()) > 0.09
    step = (xy[1:] - xy[:-1]).norm(dim=-1)
    assert float(step.amax()) <= 0.3 + 1e-6, "1 m/s"
    eye = path[..., :3, :3] @ path[..., :3, :3].mT
    torch.testing.assert_close(eye, torch.eye(3, dtype=torch.float64).expand_as(eye), atol=1e-5, rtol=0)


def test_no_body_is_within_a_wall():
    field = torch.zeros(1, 401, 401)
    field[:, 200:] = 3.0
    robot = RobotConfig(length=0.6, width=0.4, clearance=0.2)
    footing = Footing(HeightField(field, RESOLUTION), robot)
    at = torch.tensor([[-2.0, 0.0], [-0.25, 0.0], [2.0, 0.0]])
    z = torch.stack([footing.pose(torch.tensor([0]), xy[None], torch.zeros(1))[0, 2, 3] for xy in at])
    assert float(z[0]) == pytest.approx(0.32) and float(z[2]) == pytest.approx(3.32), "0.2 + 0.2 * 0.6 above the ground"
    assert float(z[1]) == pytest.approx(3.1), "at the wall's foot, over the wall"


@pytest.mark.slow(2)
def test_robots_take_the_easiest_of_some_walks():
    robot = RobotConfig()
    half = torch.zeros(1, 401, 401)
    half[:, :200] = torch.rand(1, 200, 401, generator=torch.Generator().manual_seed(0)) * 0.5
    starts = [
        float(walks(Footing(HeightField(half, RESOLUTION), robot), 1, 5, np.random.default_rng(k))[0, 0, 0, 3])
        for k in range(20)
    ]
    assert sum(x > 0 for x in starts) >= 16
