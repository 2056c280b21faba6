"""The ground continued over unknown cells: by hand."""

import pytest
import torch

from tests.helpers import pose
from tests.observations.maps import BASE, at, ground_map, near
from torchelev.observations.height_scan import HeightScan
from torchelev.observations.scan.presets import PRESETS


@pytest.mark.parametrize("scan", [*(HeightScan.preset(name) for name in PRESETS), HeightScan.grid()])
@pytest.mark.parametrize("altitude", [0.0, -300.0])
def test_flat_ground_continues_over_all_that_is_unknown(scan, altitude):
    """Only ground 0.5 m ahead is known, at any height: all of the pattern reads as there, the blind spot too."""
    emap = ground_map(lambda x, y: torch.full_like(x, altitude))
    expected = scan(emap, pose((0.3, -0.2, altitude + 0.62)))[0]
    emap.validity[:, :20] = emap.validity[:, 22:] = False
    values, valid = scan(emap, pose((0.3, -0.2, altitude + 0.62)))
    assert 0 < valid.sum() < 60
    torch.testing.assert_close(values, expected, atol=1e-9, rtol=0)


def test_far_from_what_is_known_the_ground_is_that_under_the_base():
    """Ground at 0 around the base, a step of 0.4 m far ahead; behind, it is as under the base and not a mean of all."""
    emap = ground_map(lambda x, y: 0.4 * (x > 0.9).double(), corner=(-97, -97), cells=(200, 200))
    emap.validity[:, :95] = False
    values, valid = HeightScan.points([(-6.0, 0.0), (-0.6, 0.0), (3.0, 0.0)], alignment="world")(emap, pose(BASE))
    assert valid.tolist() == [[False, False, True]] and at(values, 0, 1, 2) == near(0.7, 0.7, 0.3)


def test_what_lies_above_the_base_is_not_the_ground_under_it():
    """All that is known is a wall, higher than the base, 0.5 m away."""
    emap = ground_map(lambda x, y: torch.full_like(x, 1.5))
    emap.validity[:, :20] = emap.validity[:, 21:] = False
    values, valid = HeightScan.isaac_lab(alignment="world", standing_height=0.6)(emap, pose((0.3, -0.2, 0.7)))
    behind = values.view(11, 17)[:, 0]
    torch.testing.assert_close(behind, torch.full_like(behind, 0.1))
