"""Where feet can stand: hand-worked soles and footholds, and planes fitted by NumPy."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tests.training.traversability.labels.ground import ROBOT
from training.traversability.labels.footholds import check_soles, choose_nodes, disc, fit_sole, lattice_around


def sole_of(depths, robot=ROBOT):
    """Whether ground carries that lies so deep at a disc's 13 points."""
    good, _ = check_soles(-torch.tensor(depths, dtype=torch.float32)[:, None], robot)
    return bool(good)


def test_a_foot_may_hang_over_a_drop_by_a_quarter():
    x, y = (disc(ROBOT.foot_radius) / (ROBOT.foot_radius / 2)).round().t()
    assert len(x) == 13
    assert sole_of((x > 1).float().tolist())  # 1 of 13 points
    assert sole_of(((x + y) > 1).float().tolist())  # 3
    assert not sole_of((x > 0).float().tolist())  # 4


def test_a_foot_does_not_rest_on_a_spike():
    assert not sole_of([1.0] * 6 + [0.0] + [1.0] * 6)
    assert sole_of([0.0] * 6 + [1.0] + [0.0] * 6)  # over a hole it does


def test_a_foot_rests_on_small_bumps_alone():
    """Bumps without a slope; their standard deviation may be a sixth of the radius, 5 mm."""
    x, y = (disc(ROBOT.foot_radius) / (ROBOT.foot_radius / 2)).round().t()
    ring = x.square() + y.square()
    bumps = torch.where(ring == 1, -1.0, torch.where(ring == 0, 0.0, 1.0))  # 1 in the middle, 4 below, 8 above
    deviation = float(bumps.std(correction=0))
    assert sole_of((0.0049 / deviation * bumps).tolist()) and not sole_of((0.0051 / deviation * bumps).tolist())


@pytest.mark.slow(1)
@given(st.integers(0, 10_000))
def test_soles_are_the_planes_of_what_carries(seed):
    rng = np.random.default_rng(seed)
    points = disc(0.03).double()
    z = torch.from_numpy(rng.normal(0, 0.01, (13, 5)) + 0.4 * points[:, :1].numpy() + 1.0)
    found = fit_sole(z, points, 0.03)
    for n in range(5):
        carries = (z[:, n].max() - z[:, n] <= 0.03).numpy()
        if carries.sum() < 6:
            continue  # span no plane
        A = np.column_stack([np.ones(13), points.numpy()])[carries]
        (height, *gradient), *_ = np.linalg.lstsq(A, z[carries, n].numpy(), rcond=None)
        residual = z[carries, n].numpy() - A @ [height, *gradient]
        assert float(found.support[n]) == pytest.approx(carries.mean())
        assert found.gradient[:, n].tolist() == pytest.approx(gradient, abs=1e-9)
        assert float(found.height[n]) == pytest.approx(height, abs=1e-9)
        assert float(found.roughness[n]) == pytest.approx(math.sqrt((residual**2).mean()), abs=1e-9)


def test_the_nearest_foothold_of_each_level():
    """One row of nodes; a foot reaches two nodes on. Levels are 0.1 m; nodes 3 and 6 do not carry."""
    row = torch.tensor([0.0, 0.0, 0.05, -torch.inf, 0.5, 0.5, -torch.inf, 0.52, 0.5])
    height = torch.full((5, 9), -torch.inf)
    height[2] = row
    chosen, levels = choose_nodes(height, 2, 0.1)
    assert levels.tolist() == [2, 2, 2, 1, 1]  # of nodes 2 to 6
    assert (chosen - 2 * 9).tolist() == [[2, 4], [4, 2], [4, 2], [5, 5], [7, 7]]  # of two as near the higher


def test_the_lattice_covers_what_it_must():
    lattice = lattice_around(torch.tensor([[0.011, -0.495], [0.31, 0.195]]), 0.1)
    p = lattice.places(torch.device("cpu"))
    assert p[0, 0].tolist() == pytest.approx([-0.1, -0.6]) and p[-1, -1].tolist() == pytest.approx([0.42, 0.3])
    assert int(lattice.node(torch.tensor(-0.1), torch.tensor(-0.581))) == 1
    assert int(lattice.node(torch.tensor(-0.081), torch.tensor(-0.6))) == p.shape[1]
