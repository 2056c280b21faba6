"""Walls and steps within a cell; the height update's tests compare whole cells with the reference."""

import math

import pytest
import torch

from torchelev.edges import UNSEEN, heights_around, lie_behind
from torchelev.windows import AROUND


@pytest.mark.parametrize("degrees", range(0, 360, 24))
def test_neighbours_behind_a_cell_lie_within_50_degrees_of_its_rays(degrees):
    angle = math.radians(degrees)
    x, y = (torch.tensor([5.0 * part(angle)]) for part in (math.cos, math.sin))
    off = [abs(math.remainder(math.degrees(math.atan2(j, i)) - degrees, 360)) for i, j in AROUND]
    assert lie_behind(x, y)[0].tolist() == [o < 50 for o in off]


def test_heights_around():
    """Of two maps of 3 x 2 cells; outside a map nothing is seen, the other map's cells least of all."""
    layer = torch.arange(12.0).view(2, 6)
    (got,) = heights_around([layer], torch.tensor([3, 4, 6]), width=2)
    none = UNSEEN
    assert got[0].tolist() == [0, 1, none, 2, none, 4, 5, none]
    assert got[1].tolist() == [none, 2, 3, none, 5, none, none, none]
    assert got[2].tolist() == [none, none, none, none, 7, none, 8, 9]
