"""Reading layers at points, and filling unknown heights: by hand, and against loops."""

import dataclasses

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tests.helpers import pose
from tests.observations.loops import loop_inpaint
from tests.observations.maps import BASE, SEEDS, at, flat, ground_map, near, random_map
from torchelev.observations.fill import inpaint
from torchelev.observations.height_scan import HeightScan


@pytest.mark.parametrize(
    "height, lowest", [(lambda x, y: -0.1 * x, -0.085), (lambda x, y: -0.1 * y, 0.095), (lambda x, y: 0 * x, 0.0)]
)
def test_minimum_looks_one_cell_ahead(height, lowest):
    """At (0.8, -1.0) the cells' centres are 0.75 and 0.85, -1.05 and -0.95."""
    scan = HeightScan.points([(0.5, -0.8)], mode="minimum", alignment="world")
    assert at(scan(ground_map(height), pose(BASE))[0], 0) == near(0.7 - lowest)


def test_minimum_leaves_out_the_fourth_cell_and_unknown_ones():
    emap = ground_map(flat)
    scan = HeightScan.points([(0.5, -0.8)], mode="minimum", alignment="world")
    i, j = 19, 6  # the cell with its centre at (0.75, -1.05)
    emap.elevation[0, i + 1, j + 1] = -9.0
    emap.elevation[0, i, j], emap.elevation[0, i + 1, j], emap.elevation[0, i, j + 1] = 0.3, 0.2, 0.1
    assert at(scan(emap, pose(BASE))[0], 0) == near(0.6)
    emap.validity[0, i, j + 1] = False
    assert at(scan(emap, pose(BASE))[0], 0) == near(0.5)
    emap.validity[0, i : i + 2, j] = False
    values, valid = scan(emap, pose(BASE))
    assert not valid.any() and at(dataclasses.replace(scan, fill="base")(emap, pose(BASE))[0], 0) == near(0.0)


def test_fills_by_hand():
    """Right of x = 0.3 nothing is known, the ground rises along +y, and rays bound one row of what is unknown."""
    emap = ground_map(lambda x, y: 0.1 * y)
    emap.validity[:, 15:] = False
    emap.upper_bound[:, 15], emap.bounded[:, 15] = 0.25, True
    # Cell centres: (0.15, 0.05) known, (0.35, 0.05) bounded, (0.45, 0.05) and (0.95, 0.05) not.
    xy = [(-0.15, 0.25), (0.05, 0.25), (0.15, 0.25), (0.65, 0.25)]
    expected = {
        "ground": (0.195, 0.195, 0.22),  # the last: as under the base, at y = -0.2
        "base": (0.0, 0.0, 0.0),
        "lowest": (0.195,) * 3,
        "upper_bound": (-0.05, 0.0, 0.0),
        "inpaint": (0.195, 0.195, 0.0),
        -0.3: (-0.3, -0.3, -0.3),
    }
    for fill, unknown in expected.items():
        scan = HeightScan.points(xy, alignment="world", fill=fill, nominal_height=0.5, mode="nearest")
        values, valid = scan(emap, pose(BASE))
        assert valid.tolist() == [[True, False, False, False]]
        assert at(values, 0, 1, 2, 3) == near(0.195, *unknown)


def test_inpainting_fills_a_ring_at_a_time():
    known = torch.zeros(1, 7, 7, dtype=torch.bool)
    known[0, 3, 3] = known[0, 3, 5] = True
    heights = torch.full((1, 7, 7), torch.nan).masked_fill(known, 1.0)
    heights[0, 3, 5] = 2.0
    values, found = inpaint((heights, known), (4, 4), 1)
    assert found[0].int().tolist()[2:5] == [[0, 0, 1, 1, 1, 1, 1]] * 3 and found.sum() == 15
    assert values[0, 2, 2:].tolist() == [1.0, 1.0, 1.5, 2.0, 2.0] and values[0, 3, 3] == 1.0
    assert inpaint((heights, known), (4, 4), 3)[1].all() and torch.equal(inpaint((heights, known), (4, 4), 0)[1], known)
    # Only one cell from the centre, and one more for the ring: the corners are left out.
    assert inpaint((torch.ones(1, 8, 8), torch.ones(1, 8, 8, dtype=torch.bool)), (1, 2), 1)[1].sum() == 4 * 6


@given(SEEDS, st.integers(0, 4))
def test_inpainting_agrees_with_loops(seed, rings):
    emap, _ = random_map(seed, 1, known=0.2)
    values, found = inpaint((emap.elevation, emap.validity), (10, 9), rings)
    expected, known = loop_inpaint(emap.elevation[0].numpy(), emap.validity[0].numpy(), rings)
    assert np.array_equal(found[0].numpy(), known)
    np.testing.assert_allclose(values[0].numpy(), expected, atol=1e-12)
