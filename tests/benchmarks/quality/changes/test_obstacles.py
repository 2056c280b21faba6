"""After how many scans obstacles and plates show."""

import pytest
import torch

from benchmarks.quality.changes import obstacles
from benchmarks.quality.changes.world import HALF_CELL, OBSTACLES, SENSORS, World


def world(seeds=2):
    return World(SENSORS["camera 64 x 48"], seeds, compiled=False)


def test_hits_are_counted_in_the_cells_in_which_the_obstacle_stands():
    here = world(1)
    boxes = here.box(torch.tensor([2.65]), torch.zeros(1), OBSTACLES["box"])
    at = torch.tensor([2.55, 0.02, 0.0])
    ground = float(here.field.height(here.tiles, at[None, None, :2]))
    # The box begins at x = 2.5, the centre of the cell of x = 2.51.
    places = [(2.55, 0.02, 0.2), (2.55, 0.02, 0.02), (2.55, 1.0, 0.2), (2.51, 0.02, 0.2), (2.47, 0.02, 0.2)]
    on, below, beside, rim, before = ([x, y, ground + z] for x, y, z in places)
    points = torch.tensor([[on, on, below, beside, rim, before, [torch.nan] * 3]])
    number = obstacles.hits(here, points, boxes)
    assert number.sum() == 3 and number.max() == 2
    center = here.emap.cell_centers()[number == 2][0]
    assert (center - at[:2]).abs().max() <= HALF_CELL
    assert obstacles.hits(here, points, boxes, beside=-0.001).sum() == 2, "the box covers this cell's centre"


def test_an_obstacle_shows():
    how = {"seeds": 2, "settled": 1, "compiled": False, "watched": 3}
    row = obstacles.obstacle_scans(SENSORS["camera 64 x 48"], "wall", 1.0, **how)
    assert row["median"] <= 3 and row["points"] > 0.5
    assert world().above_ground().isnan().all()


def test_scans_are_counted_until_something_first_shows():
    yes, no = torch.tensor([True, False, False]), torch.tensor([False, True, False])
    assert obstacles.scans_until([yes, no, no]) == {"median": 2, "most": 4}


@pytest.mark.slow(5)
def test_a_plate_shows_sooner_where_ground_ages_faster():
    slow, fast = (
        obstacles.plate_scans(SENSORS["camera 120 x 90"], rate, seeds=2, settled=25, compiled=False, watched=12)
        for rate in (0.0, 1e-2)
    )
    assert fast["median"] < slow["median"] and fast["rmse_mm"] > slow["rmse_mm"] > 0
