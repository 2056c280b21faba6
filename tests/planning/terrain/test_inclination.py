"""The inclination of a surface: by hand, and on planes."""

import math

import torch

from tests.planning.maps import RESOLUTION
from torchelev.planning.terrain.inclination import compute_inclination


def test_the_inclination_by_hand():
    """0.25 m are two cells along x and y; along the diagonals one is nearer to it than two."""
    values = torch.zeros(1, 7, 7, dtype=torch.float64)
    values[0, 3, 3] = 0.1
    angle, known = compute_inclination((values, torch.ones_like(values) > 0), RESOLUTION, 0.25)
    expected = torch.zeros(7, 7, dtype=torch.float64)
    expected[[1, 5, 3, 3], [3, 3, 1, 5]] = math.atan(0.1 / 0.25)
    expected[[2, 2, 4, 4], [2, 4, 2, 4]] = expected[3, 3] = math.atan(0.1 / (0.125 * math.sqrt(2)))
    torch.testing.assert_close(angle[0], expected)
    assert known.all()
    lone = torch.zeros_like(known)
    lone[0, 3, 3] = lone[0, 0, 6] = True
    assert not compute_inclination((values / 0, lone), RESOLUTION, 0.25)[1].any(), "nothing around it is known"


def test_planes_have_their_inclination():
    """Along the axes and the diagonals exactly, elsewhere at most 8 % less steep."""
    x, y = torch.meshgrid(torch.arange(30.0).double(), torch.arange(30.0).double(), indexing="ij")
    known = torch.ones(1, 30, 30, dtype=torch.bool)
    for degrees in range(0, 360, 15):
        turn = math.radians(degrees)
        plane = 0.05 * 0.4 * (math.cos(turn) * x + math.sin(turn) * y)[None]
        steepness = compute_inclination((plane, known), 0.05, 0.3)[0][0, 10:20, 10:20].tan() / 0.4
        assert steepness.min() > 0.92 and steepness.max() < 1 + 1e-9
        if degrees % 45 == 0:
            assert steepness.min() > 1 - 1e-9
