"""Walls and steps within a cell; the height update's tests compare whole cells with the reference."""

import math

import pytest
import torch

from torchelev.disputed import Disputed
from torchelev.edges import EdgeConfig, ends_of_step, lie_behind, values_around
from torchelev.windows import AROUND, around


@pytest.mark.parametrize("degrees", range(0, 360, 24))
def test_neighbours_behind_a_cell_lie_within_50_degrees_of_its_rays(degrees):
    angle = math.radians(degrees)
    x, y = (torch.tensor([5.0 * part(angle)]) for part in (math.cos, math.sin))
    off = [abs(math.remainder(math.degrees(math.atan2(j, i)) - degrees, 360)) for i, j in AROUND]
    assert lie_behind(x, y, *around(x.device))[0].tolist() == [o < 50 for o in off]


def test_values_around():
    """Of two maps of 3 x 2 cells; outside a map there is nothing, the other map's cells least of all."""
    layer, cells = torch.arange(12.0).view(2, 6), torch.tensor([3, 4, 6])
    exists, (got,) = values_around([layer], cells, *around(layer.device), width=2)
    none = -1.0
    got = torch.where(exists, got, none)
    assert got[0].tolist() == [0, 1, none, 2, none, 4, 5, none]
    assert got[1].tolist() == [none, 2, 3, none, 5, none, none, none]
    assert got[2].tolist() == [none, none, none, none, 7, none, 8, 9]


def test_points_that_are_not_used_hold_no_level():
    """One return far above the step's top is an outlier, also if points that are not used lie as high."""
    z = torch.tensor([[0.0, 0.0, 0.0, 1.0, 1.0, 1.0, 3.0, 3.0, 3.0]])
    weight = torch.tensor([[1.0] * 7 + [0.0] * 2])
    slot, cells = torch.zeros(1, 9, dtype=torch.int64), torch.ones(1, 1, dtype=torch.uint8)
    ray, passed, mean = torch.ones(1, 9), torch.zeros(1, 9, dtype=torch.uint8), torch.tensor([[6 / 7]])
    ends = []
    for count in (7, 9):
        columns = [value[:, :count] for value in (z, torch.full((1, 9), 1e-4), weight, passed, ray, ray)]
        ends.append(ends_of_step(Disputed(cells, slot[:, :count], columns, mean), EdgeConfig()))
    assert ends[0] == ends[1]
    top, bottom = (mean.item() + end.item() for end in ends[0])
    assert top == pytest.approx(6 / 7)  # the next level, 1.5, would be reached by the outlier alone
    assert bottom == pytest.approx(0.0, abs=1e-6)
