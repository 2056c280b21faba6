"""What people who left leave in the map, and what the map could know of it."""

import torch

from benchmarks.quality.changes import ghosts
from benchmarks.quality.changes.world import PERSON, SENSORS, World


def world(seeds=2):
    return World(SENSORS["camera 64 x 48"], seeds, compiled=False)


def test_ghosts_are_what_stays_above_the_ground():
    crossings = ghosts.Crossings(1, 0.4, after=0.4)
    row = ghosts.ghosts(SENSORS["camera 64 x 48"], 10, seeds=2, compiled=False, crossings=crossings)
    assert row["of"] == 2 and row["environments"] <= 2


def test_who_still_stands_there_is_above_the_ground():
    here = world()
    person = here.box(torch.full((2,), 2.5), torch.zeros(2), PERSON)
    assert ghosts.left_behind(here, [person] * 5, 0.1, scans_after=0)["environments"] == 2


def test_cells_are_seen_through_where_a_ray_passes_below_and_beyond():
    here = world(1)
    T = here.T_map_sensor[0, :3, 3].float()
    here.emap.state.elevation.fill_(float(T[2]) - 0.45)
    centers = here.emap.cell_centers()[0]
    cells = (centers - torch.tensor([1.02, 0.02])).norm(dim=-1)[None] < 0.01
    assert cells.sum() == 1
    for end, number in (
        ((2.0, 0.04), 1),
        ((2.0, 0.1), 0),
        ((1.05, 0.02), 0),
        ((-2.0, 0.0), 0),
        ((3.0, 0.06), 0),
        ((2.15, 0.04), 0),
    ):
        point = torch.tensor([[[*end, float(T[2]) - 1.0]]])  # a ray falls 0.51 m on 1.02 m of 2 m, 0.47 m of 2.15 m
        assert ghosts.seen_through(here, cells, point).tolist() == [number], end
