"""Walls and steps within a cell; the height update's tests compare whole cells with the reference."""

import math

import pytest
import torch
from conftest import small_config

from torchelev.edges import neighbour_maximum

GRID = small_config((3, 3)).grid
HEIGHTS = torch.arange(9.0)  # of the cells (i, j) = (0, 0), (0, 1), ...


@pytest.mark.parametrize("degrees", range(0, 360, 24))
def test_neighbours_behind_a_cell_lie_within_50_degrees_of_its_rays(degrees):
    angle = math.radians(degrees)
    ray = [torch.full((1, 9), 5 * part(angle)) for part in (math.cos, math.sin)]
    behind = []
    for i in (-1, 0, 1):
        for j in (-1, 0, 1):
            off = math.remainder(math.degrees(math.atan2(j, i)) - degrees, 360)
            if (i or j) and abs(off) < 50:
                behind.append(3 * (1 + i) + 1 + j)
    highest = neighbour_maximum(HEIGHTS[None], ray, GRID)[0, 4]  # of the cell in the middle
    assert highest == max(behind)


def test_all_neighbours_but_not_the_cell():
    highest = neighbour_maximum(torch.where(HEIGHTS == 4, 99.0, HEIGHTS)[None], None, GRID)
    assert highest[0, 4] == 8 and highest[0, 0] == 99
