"""Where the robots of a fleet go, and the world that they walk in."""

import numpy as np
import pytest
import torch

from torchelev.app.fleet.explore import CoarseMap, Explorer, assign, coarsen, find_frontiers
from torchelev.app.fleet.robots import SPEED, Robots, advance
from torchelev.app.fleet.world import World, make_camp

COARSE = 0.5
N = 40  # coarse cells along a side


def ground(known_radius=6.0):
    """Flat ground of 20 x 20 m, known around the middle, with a wall to the east of it."""
    axis = (torch.arange(5 * N) + 0.5) * 0.1 - N * COARSE / 2
    z = torch.zeros(5 * N, 5 * N)
    z[(axis - 2.0).abs() < 0.2] = torch.where((axis.abs() < 3.0), 0.5, 0.0)
    z[torch.hypot(axis[:, None], axis[None]) > known_radius] = torch.nan
    return z


def cell(explorer, x, y):
    return explorer.find_cells(np.array([[x, y]]))[0]


def test_robots_can_walk_where_it_is_known_and_low():
    area, explorer = coarsen(ground(), 0.1), Explorer(1, N * COARSE, COARSE)
    known, free = (value.flatten().numpy() for value in area)
    for (x, y), expected in {(0.2, 0.2): (1, 1), (2.0, 1.0): (1, 0), (2.2, 4.2): (1, 1), (9.0, 0.2): (0, 0)}.items():
        at = cell(explorer, x, y)
        assert (known[at], free[at]) == expected, (x, y)


@pytest.mark.parametrize(("gradient", "is_free"), [(0.5, True), (1.0, False)])
def test_slopes_count_by_their_rise(gradient, is_free):
    x = gradient * torch.arange(50) * 0.1
    assert bool(coarsen(x[:, None].expand(50, 50).contiguous(), 0.1).free.all()) == is_free


def test_frontiers_are_free_cells_beside_unknown_ones():
    known = torch.zeros(N, N, dtype=torch.bool)
    known[:10] = True
    free = known.clone()
    free[9, :5] = False
    gain, is_frontier = find_frontiers(CoarseMap(known, free), COARSE)
    assert is_frontier.nonzero().tolist() == [[9, j] for j in range(5, N)]
    # 13 x 13 cells of 0.25 m^2 are in view, of them 6 rows are unknown
    assert float(gain[9, 20]) == pytest.approx(6 * 13 * 0.25)


def test_robots_get_different_goals_and_keep_theirs():
    centers = np.array([[0.0, 0.0], [0.5, 0.0], [10.0, 0.0]])
    frontiers, worth = np.array([3, 4, 9]), np.array([[5.0, 4.9, 1.0], [4.8, 4.7, 1.0]])
    assert assign(worth, frontiers, centers, np.array([-1, -1])).tolist() == [3, 9]  # 4 shows hardly more than 3
    assert assign(worth, frontiers, centers, np.array([9, -1])).tolist() == [9, 3]
    assert assign(worth[:, :1], frontiers[:1], centers[:1], np.array([-1, -1])).tolist() == [3, -1]
    assert assign(np.zeros((2, 0)), frontiers[:0], centers[:0], np.array([-1, -1])).tolist() == [-1, -1]


def test_paths_lead_through_free_cells_to_different_goals():
    explorer, xy, area = Explorer(6, N * COARSE, COARSE), make_camp(6, 1.0).numpy(), coarsen(ground(), 0.1)
    paths = explorer.plan(area, xy)
    assert len(set(explorer.goals)) == 6 and (explorer.goals >= 0).all()
    free = area.free.flatten().numpy()
    for start, goal, path in zip(xy, explorer.goals, paths, strict=True):
        walk = np.concatenate([start[None], path])
        on_the_way = walk[:-1, None] + np.linspace(0, 1, 20)[:, None] * np.diff(walk, axis=0)[:, None]
        assert free[explorer.find_cells(on_the_way.reshape(-1, 2))].all()
        assert np.hypot(*np.diff(walk, axis=0).T).max() < 2 * COARSE  # from cell to cell
        assert explorer.find_cells(path[-1:])[0] == goal


def test_robots_stay_where_nothing_can_be_reached():
    explorer, area = Explorer(2, N * COARSE, COARSE), coarsen(ground(), 0.1)
    area.free[:] = False
    area.free[30, 30] = True  # an island
    assert [len(path) for path in explorer.plan(area, make_camp(2, 1.0).numpy())] == [0, 0]
    assert explorer.is_done


def test_a_goal_that_shows_nothing_new_is_given_up():
    explorer, xy = Explorer(1, N * COARSE, COARSE), np.zeros((1, 2))
    area = coarsen(ground(1.0), 0.1)
    seen = set()
    while not explorer.is_done:
        path = explorer.plan(area, xy)[0]
        xy = path[-1:] if len(path) else xy
        seen.add(int(explorer.goals[0]))
        assert len(seen) < 50
    assert len(seen) > 2


def test_all_known_is_done():
    explorer, area = Explorer(1, N * COARSE, COARSE), coarsen(torch.zeros(5 * N, 5 * N), 0.1)
    assert len(explorer.plan(area, np.zeros((1, 2)))[0]) == 0 and explorer.is_done


def test_advances_along_a_path():
    path = np.array([[1.0, 0.0], [1.0, 2.0]])
    place, rest = advance(np.zeros(2), path, 1.5)
    assert np.allclose(place, [1.0, 0.5]) and len(rest) == 1
    place, rest = advance(place, rest, 9.0)
    assert np.allclose(place, [1.0, 2.0]) and len(rest) == 0
    assert np.allclose(advance(place, rest, 1.0)[0], place)


@pytest.mark.slow(1)
def test_a_world_repeats_by_its_seed_and_has_a_level_camp():
    xy = (torch.rand(500, 2, generator=torch.Generator().manual_seed(0)).double() - 0.5) * 20
    heights = [World(20.0, 3.0, seed).truth(xy) for seed in (0, 0, 1)]
    assert torch.equal(heights[0], heights[1]) and not torch.equal(heights[0], heights[2])
    in_camp = xy.norm(dim=1) < 2.9
    assert (heights[0][in_camp].abs() < 1e-6).all() and float(heights[0].std()) > 0.03
    steps = World(20.0, 3.0, 0).find_steps(xy, 0.1)
    assert not steps[in_camp].any() and steps.any()


def test_robots_see_the_ground_from_where_they_believe_to_be():
    robots = Robots(World(20.0, 4.0, 0), 4, seed=0)
    robots.follow([np.array([[x, 0.0]]) for x in (9.0, 9.0, -9.0, -9.0)])
    before, first = robots.xy.copy(), robots.sense(0.2)
    assert (first.height_error.abs() <= 0.15).all() and float(first.height_error.std()) > 0.01
    robots.walk(0.2)
    assert np.allclose(np.hypot(*(robots.xy - before).T), 0.2 * SPEED)
    scan = robots.sense(0.2)
    world = scan.points.double() @ scan.T_map_sensor[:, :3, :3].mT + scan.T_map_sensor[:, None, :3, 3]
    is_near = (world[..., :2].norm(dim=-1) < 3.9) & world.isfinite().all(-1)  # on the level camp
    assert is_near.any(1).all()
    for robot in range(4):
        error = world[robot, is_near[robot], 2] - scan.height_error[robot]
        assert abs(float(error.median())) < 0.005
