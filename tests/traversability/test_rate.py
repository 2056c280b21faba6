"""The pure function of the learned head; `test_net.py` tests it through the module."""

import torch

from torchelev.robot import RobotConfig
from torchelev.traversability.rate import min_in_reach
from torchelev.traversability.stances import in_cells


def test_minimum_within_a_foots_reach():
    cell = torch.ones(1, 1, 12, 12)
    cell[0, 0, 3, 4] = 0.2
    lowest = min_in_reach(cell, in_cells(RobotConfig(), 0.04))  # a reach of 2 cells
    expected = torch.ones(8, 8)
    expected[:4, :5] = 0.2  # within 2 cells of (1, 2)
    torch.testing.assert_close(lowest[0, 0], expected)
