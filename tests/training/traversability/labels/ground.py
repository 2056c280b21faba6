"""Robots and hand-made ground for the tests of labels."""

import torch

from torchelev.robot import RobotConfig
from torchelev.sim import HeightField

ROBOT = RobotConfig()  # 0.7 x 0.4 m, feet of 3 cm that reach 0.1 m, steps of 0.2 m, clearance 0.3 m, 0.5 rad
SMALL = RobotConfig(length=0.45, width=0.3, foot_radius=0.02, foot_reach=0.07, step_height=0.1, clearance=0.15)
RESOLUTION = 0.02


def tile(function, length=4.0):
    """A height field of z(x, y); an edge is a ramp of 2 cm."""
    line = (torch.arange(round(length / RESOLUTION) + 1) - length / RESOLUTION / 2) * RESOLUTION
    x, y = torch.meshgrid(line, line, indexing="ij")
    return HeightField((function(x, y) + torch.zeros_like(x))[None], RESOLUTION)


def ledge(height):
    """Ground that is higher from x = 0 on: the ramp goes to x = 0.02."""
    return tile(lambda x, y: height * (x > 0.01))


def blocks(seed, height, size=0.31):
    """Squares of random heights, whose edges lie anyhow, on gentle hills."""
    table = torch.rand(64, 64, generator=torch.Generator().manual_seed(seed)) * height

    def z(x, y):
        i, j = ((a / size + 32.37).long() for a in (x, y))
        return table[i, j] + 0.03 * torch.sin(5 * x) * torch.cos(4 * y)

    return tile(z)


def places(seed, number, half=1.3):
    return (torch.rand(1, number, 2, generator=torch.Generator().manual_seed(seed)) * 2 - 1) * half
