"""Where the points of a height scan are."""

import numpy as np
import pytest
import torch

from tests.helpers import pose, seen_from, small_map
from torchelev import HeightScan


def ramp_map():
    """A map of the plane z = 0.2 x + 0.1 y."""
    emap = small_map(cells=(40, 40))
    xy = emap.cell_centers()[0].reshape(-1, 2).numpy()
    T = pose((0.0, 0.0, 3.0))
    emap.update(seen_from(T, np.column_stack([xy, xy @ [0.2, 0.1]])), T, None, 0.1)
    return emap


@pytest.mark.parametrize("yaw", [0.0, 0.7])
def test_the_scan_reads_the_ground_at_these_points(yaw):
    emap, T = ramp_map(), pose((0.2, -0.1, 0.5), yaw=yaw)
    scan = HeightScan.grid(length_x=1.0, length_y=0.6, resolution=0.2)
    x, y = scan.xy(T).unbind(-1)
    values, valid = scan(emap, T)
    assert valid.all() and torch.allclose(values.double(), 0.5 - (0.2 * x + 0.1 * y), atol=1e-4)


def test_around_feet():
    T = pose((0.0, 0.0, 0.5))
    feet = torch.tensor([[[0.3, 0.2, 0.1], [-0.3, -0.2, 0.0]]], dtype=torch.float64)
    scan = HeightScan.feet(num_feet=2)
    xy = scan.xy(T, feet)
    assert xy.shape == (1, scan.num_points, 2)
    near = xy.unflatten(1, (2, -1)) - feet[:, :, None, :2]
    assert near.norm(dim=-1).max() < 0.49 and torch.allclose(near[:, 0], near[:, 1])


def test_feet_are_given_for_feet_alone():
    with pytest.raises(ValueError, match=r"feet: expected \(B, 4, 3\), got None"):
        HeightScan.feet(num_feet=4).xy(pose())
    with pytest.raises(ValueError, match="feet: must be left out"):
        HeightScan.isaac_lab().xy(pose(), torch.zeros(1, 4, 3))
