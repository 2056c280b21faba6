"""Labels against slow loops that follow the docstrings word by word."""

import functools
import itertools
import math

import numpy as np
import pytest
import torch

from tests.training.traversability.labels.ground import RESOLUTION, ROBOT, SMALL, blocks, places
from training.traversability.labels.labels import can_stand


class Slow:
    """The same criteria in loops over one robot's feet, points and footholds, float64."""

    def __init__(self, field, robot):
        self.heights, self.robot = field.heights[0].double().numpy(), robot
        self.sole = functools.cache(self._sole)
        self.height = functools.cache(self._height)

    def _height(self, x, y):
        n = len(self.heights)
        u, v = (min(max(a / RESOLUTION + (n - 1) / 2, 0), n - 1) for a in (x, y))
        i, j = min(int(u), n - 2), min(int(v), n - 2)
        (a, b), (c, d) = self.heights[i : i + 2, j : j + 2]
        u, v = u - i, v - j
        return a * (1 - u) * (1 - v) + b * (1 - u) * v + c * u * (1 - v) + d * u * v

    def _sole(self, i, j):
        """(x, y, z, dz/dx, dz/dy) of a foot at node (i, j), None where it does not carry."""
        r, steepest, x, y = self.robot.foot_radius, math.tan(self.robot.max_slope), i / 50, j / 50
        points = [(a * r / 2, b * r / 2) for a in range(-2, 3) for b in range(-2, 3) if a * a + b * b <= 4]
        z = np.array([self.height(x + dx, y + dy) for dx, dy in points])
        carries = z >= z.max() - 2 * r * steepest
        A = np.column_stack([np.ones(13), points])[carries]
        plane, *_ = np.linalg.lstsq(A, z[carries], rcond=None)
        rough = math.sqrt(((z[carries] - A @ plane) ** 2).mean()) > r / 6
        if carries.mean() < 0.75 or math.hypot(*plane[1:]) > steepest or rough:
            return None
        return x, y, *plane

    def footholds(self, x, y):
        """The nearest on the upper and on the lower level within reach."""
        i, j, reach = round(x * 50), round(y * 50), self.robot.foot_reach
        n, span = int(reach * 50 + 1e-6), 2 * reach * math.tan(self.robot.max_slope)
        around = [(a, b) for a in range(-n, n + 1) for b in range(-n, n + 1) if a * a + b * b <= n * n]
        there = [(a * a + b * b, self.sole(i + a, j + b)) for a, b in around]
        there = [(distance, -sole[2], sole) for distance, sole in there if sole is not None]
        if not there:
            return []
        highest, lowest = (f(sole[2] for *_, sole in there) for f in (max, min))
        upper = min(entry for entry in there if entry[2][2] >= highest - span)
        return {upper[2], min(entry for entry in there if entry[2][2] <= lowest + span)[2]}

    def stands(self, x, y, theta):
        cos, sin = math.cos(theta), math.sin(theta)
        length, width = self.robot.length, self.robot.width
        corners = [(a * length / 2, b * width / 2) for a, b in ((1, 1), (1, -1), (-1, -1), (-1, 1))]
        choices = [self.footholds(x + a * cos - b * sin, y + a * sin + b * cos) for a, b in corners]
        return any(self.stance(feet, x, y, cos, sin) for feet in itertools.product(*choices))

    def stance(self, feet, x, y, cos, sin):
        p = np.array(feet)
        (c, gx, gy), *_ = np.linalg.lstsq(np.column_stack([np.ones(4), p[:, :2] - (x, y)]), p[:, 2], rcond=None)
        if math.hypot(gx, gy) > math.tan(self.robot.max_slope):
            return False
        length, width = self.robot.length, self.robot.width
        for a, side in zip(range(4), (width, length, width, length), strict=True):
            if self.step(p[a], p[(a + 1) % 4], side) > self.robot.step_height:
                return False
        n, m = round(length / 0.08), round(width / 0.08)
        nodes = math.ceil(math.hypot(length / n, width / m) / 2 * 50 - 1e-6)
        for k, q in itertools.product(range(n), range(m)):
            along, across = ((k + 0.5) / n - 0.5) * length, ((q + 0.5) / m - 0.5) * width
            dx, dy = along * cos - across * sin, along * sin + across * cos
            if self.highest(x + dx, y + dy, nodes) - (c + gx * dx + gy * dy) > self.robot.clearance:
                return False
        return True

    def highest(self, x, y, nodes):
        i, j, around = round(x * 50), round(y * 50), range(-nodes, nodes + 1)
        return max(self.height((i + a) / 50, (j + b) / 50) for a in around for b in around)

    def step(self, a, b, side):
        if a[2] > b[2]:
            a, b = b, a
        points = math.ceil((side + 2 * self.robot.foot_reach) / 0.04)
        dx, dy = (b[:2] - a[:2]) / points
        h = [a[2], *(self.highest(a[0] + k * dx, a[1] + k * dy, 1) for k in range(1, points)), b[2]]
        rise = max(max(h[: k + 4]) - max(h[: k + 1]) for k in range(points - 2))
        return rise - 3 * max(0, (dx * (a[3] + b[3]) + dy * (a[4] + b[4])) / 2)


@pytest.mark.slow(1)
@pytest.mark.parametrize("robot", [ROBOT, SMALL])
@pytest.mark.parametrize("height", [0.2, 0.35, 0.5])
def test_against_slow_loops(robot, height):
    field, xy = blocks(round(100 * height), height), places(9, 6)
    found = can_stand(field, torch.tensor([0]), xy, [robot], headings=4)[0]
    slow = Slow(field, robot)
    expected = [[slow.stands(x, y, k * math.pi / 4) for k in range(4)] for x, y in xy[0].double().tolist()]
    assert found.tolist() == expected
