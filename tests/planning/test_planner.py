"""Paths over maps: by hand, over safe occlusions and drops, and what is refused."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch._subclasses.fake_tensor import FakeTensorMode

from benchmarks.quality.occlusion.refine import piece_costs, refine
from benchmarks.quality.occlusion.rules import decide
from benchmarks.quality.occlusion.scenes import abyss, cliff, hump, step_down
from benchmarks.quality.occlusion.walks import VIEWS, views
from tests.devices import NoConstants, OneDevice, unread
from tests.planning.maps import CORNER, NO_LIMITS, RESOLUTION, ground_map, place, random_map
from tests.planning.test_cost_to_go import dijkstra
from torchelev import (
    ElevationMap,
    ElevationMapConfig,
    GridConfig,
    LearnedTraversabilityConfig,
    TraversabilityNet,
)  # fmt: skip
from torchelev.planning.footprint import check_footprint
from torchelev.planning.path_check import check_path
from torchelev.planning.path_reason import Reason
from torchelev.planning.planner import plan
from torchelev.planning.standing import place_footprint
from torchelev.planning.traversal_cost import TraversalCostConfig, traversal_cost

SEEDS = st.integers(0, 10_000)


def test_it_reads_the_learned_heads_confidence(tmp_path):
    TraversabilityNet().save(tmp_path / "head.pt")
    learned = LearnedTraversabilityConfig(weights=str(tmp_path / "head.pt"))
    grid = GridConfig(resolution=0.1, length_x=2.0, length_y=2.0)
    emap = ElevationMap(ElevationMapConfig(grid=grid, traversability=learned))
    emap.validity.fill_(True)
    emap.traversability.fill_(1.0)
    emap.rated.fill_(True)
    confidence = emap.rate().confidence
    assert (confidence < 0.99).any() and torch.equal(traversal_cost(emap), traversal_cost(emap, confidence=confidence))


# By hand --------------------------------------------------------------------------------------------------------------


def test_a_straight_path_by_hand():
    """From the cell of (-0.9, 0.05) to that of (0.9, 0.05), 15 cells on; the row's centres lie at y = 0.0625."""
    path = plan(ground_map(), place(-0.9, 0.05), place(0.9, 0.05))
    assert path.reached.tolist() == [True] and path.xy.shape == (1, 60, 2) and path.xy.dtype == torch.float64
    assert path.xy[0, :16, 0].tolist() == [-0.9375 + 0.125 * k for k in range(16)]
    assert path.xy[0, 15:, 0].eq(0.9375).all() and path.xy[0, :, 1].eq(0.0625).all()
    assert path.length.item() == path.cost.item() == pytest.approx(15 * 0.125)


def test_a_path_goes_around_a_wall():
    emap = ground_map()
    emap.traversability[0, 8, 2:] = 0.0
    path = plan(emap, place(-0.5, 0.5), place(0.5, 0.5))
    cells = torch.floor(path.xy[0] / RESOLUTION).to(torch.int64) - CORNER[0]
    assert path.reached and emap.traversability[0][cells.unbind(-1)].eq(1).all()
    assert path.length.item() == pytest.approx(path.cost.item()) and path.length > 1.5
    emap.traversability[0, 8] = 0.0
    shut = plan(emap, place(-0.5, 0.5), place(0.5, 0.5))
    assert not shut.reached and shut.cost.isinf() and shut.length == 0
    assert shut.xy.eq(shut.xy[:, :1]).all() and (shut.xy[0, 0] - 0.5).abs()[1] < RESOLUTION


def test_dear_ground_is_avoided_and_crossed_if_there_is_no_other():
    emap = ground_map()
    emap.traversability[0, 8, 3:] = 0.4
    around = plan(emap, place(-0.5, 0.0), place(0.5, 0.0), TraversalCostConfig(weight_traversability=40.0))
    over = plan(emap, place(-0.5, 0.0), place(0.5, 0.0))
    assert over.length < 1.1 < around.length and over.cost.item() == pytest.approx(1.0 + 0.125 * 2.4)


def test_ends():
    emap = ground_map()
    same = plan(emap, place(0.1, 0.1), place(0.1, 0.1))
    assert same.reached and same.cost == 0 and same.length == 0 and same.xy.eq(0.0625).all()
    emap.traversability[0, 12, 7] = 0.0
    blocked = plan(emap, place(0.0, 0.0), place(0.5, 0.0))
    assert not blocked.reached and blocked.cost.isinf()
    leaving = plan(emap, place(0.5, 0.0), place(0.0, 0.0))
    assert leaving.reached, "a robot leaves ground that is rated impassable"
    short = plan(emap, place(-0.9, 0.0), place(0.9, 0.0), max_cells=5)
    assert not short.reached and short.xy.shape == (1, 5, 2) and short.cost.isfinite()


def test_the_ground_below_the_robot_need_not_be_known():
    emap = ground_map()
    emap.validity[0, 3:6, 6:9] = False
    emap.traversability[0, 3:6, 6:9] = torch.nan
    start, goal = place(-0.45, 0.05), place(0.5, 0.0)
    assert plan(emap, start, goal).reached
    assert not plan(emap, start, goal, TraversalCostConfig(stand_radius=0.05)).reached


def test_count_and_poses_by_hand():
    """Along x, then aslant: the yaw is that of the chord from 0.2 m behind to 0.2 m ahead, one or two cells."""
    emap = ground_map()
    path = plan(emap, place(-0.9, 0.05), place(0.9, 0.05))
    poses = path.poses()
    assert path.count.tolist() == [16] and poses.shape == (1, 60, 3) and torch.equal(poses[..., :2], path.xy)
    assert poses[..., 2].eq(0).all()
    emap.traversability[0, :6, :7] = emap.traversability[0, 7:, 8:] = emap.traversability[0, 6, 8:] = 0.0
    emap.traversability[0, 6, :6] = 0.0
    turned = plan(emap, place(-0.1, -0.05), place(0.9, -0.8))
    bend, count = turned.poses(chord=0.01)[0], int(turned.count)
    steps = turned.xy[0, 1:count] - turned.xy[0, : count - 1]
    assert turned.reached and steps.ne(0).any(-1).all()
    expected = torch.atan2(*(turned.xy[0, 2:count] - turned.xy[0, : count - 2]).flip(-1).unbind(-1))
    torch.testing.assert_close(bend[1 : count - 1, 2], expected)
    assert bend[count - 1, 2] == math.atan2(steps[-1, 1], steps[-1, 0]) and bend[count:].eq(bend[count - 1]).all()
    with pytest.raises(ValueError, match="chord: must be a positive number"):
        path.poses(chord=0.0)


def test_a_path_of_one_waypoint():
    path = plan(ground_map(), place(0.1, 0.1), place(0.1, 0.1))
    assert path.count.tolist() == [1] and path.poses()[0].eq(torch.tensor([0.0625, 0.0625, 0.0])).all()


# Where the robot stands -----------------------------------------------------------------------------------------------

BODY = torch.tensor([[0.25, 0.125], [-0.25, 0.125], [-0.25, -0.125], [0.25, -0.125]]).double()


@pytest.mark.parametrize("yaw, goal", [(0.0, (0.6, 0.0)), (1.57, (0.6, 0.0)), (0.8, (0.6, 0.4)), (2.0, (0.1, 0.6))])
def test_a_plan_from_a_blind_spot_passes_the_check(yaw, goal):
    """Nothing is known under the robot, all around it is."""
    emap = ground_map()
    here = place_footprint(emap, BODY, torch.tensor([[[-0.3, -0.1, yaw]]]))
    blind = ~check_cells(emap, here)
    emap.validity &= blind
    emap.traversability[~blind] = torch.nan
    path = plan(emap, place(-0.3, -0.1), place(*goal), standing=here[:, 0])
    poses = path.poses()
    assert path.reached and check_path(emap, poses, BODY, standing=here[:, 0]).safe
    assert check_path(emap, poses, BODY).first_unsafe > 0, "the first pose is where the robot stands"
    lost = check_path(emap, poses, BODY, standing=here[:, 0] * math.nan)
    assert lost.first_unsafe.tolist() == [0], "nothing is assumed"
    assert not check_footprint(emap, here).safe and check_footprint(emap, here, standing=here[:, 0]).safe


def check_cells(emap, polygons):
    """The cells whose centres lie in the first polygon, one by one."""
    centers = emap.cell_centers().flatten(1, 2)
    a, b = polygons[0, 0, :, None], polygons[0, 0].roll(-1, 0)[:, None]
    turn = (b - a)[..., 0] * (centers - a)[..., 1] - (b - a)[..., 1] * (centers - a)[..., 0]
    return (turn >= 0).all(0).view(emap.validity.shape) | (turn <= 0).all(0).view(emap.validity.shape)


def test_bad_ground_below_the_robot_is_reported():
    """The plan leaves it; the check reports it, even if the rest is unknown."""
    emap = ground_map()
    here = place_footprint(emap, BODY, torch.tensor([[[-0.3, -0.1, 0.0]]]))
    below = check_cells(emap, here)
    emap.validity[below] = False
    bad = below.nonzero()[3]
    emap.validity[tuple(bad)], emap.traversability[tuple(bad)] = True, 0.0
    path = plan(emap, place(-0.3, -0.1), place(0.6, 0.0), standing=here[:, 0])
    check = check_path(emap, path.poses(), BODY, standing=here[:, 0])
    assert path.reached and check.first_unsafe.tolist() == [0] and check.footprints.unsafe[0, 0] > 0.05
    cost = traversal_cost(emap, standing=here[:, 0])
    assert cost[tuple(bad)].isinf() and cost[below].isfinite().sum() == below.sum() - 1


# Ground of known elevation and unknown traversability -----------------------------------------------------------------


def test_unrated_ground_is_neither_good_nor_bad():
    """It costs what bounded ground of its inclination costs: 2 where it is level."""
    unrated = torch.zeros(1, 16, 14, dtype=torch.bool)
    unrated[0, 8] = True
    ends = place(-0.5, 0.0), place(0.5, 0.0)
    for rating in (0.0, 1.0):
        emap = ground_map()
        emap.rated[unrated] = False
        emap.traversability[unrated] = rating
        assert traversal_cost(emap)[unrated].eq(2).all()
        assert plan(emap, *ends).cost.item() == pytest.approx(1.0 + 0.125)
        strict = plan(emap, *ends, TraversalCostConfig(cross_unknown=False))
        assert strict.reason.tolist() == [Reason.NO_PATH]
        emap.elevation[unrated] = 0.5
        assert plan(emap, *ends).reason.tolist() == [Reason.NO_PATH], "its inclination is known"
        goal = plan(emap, ends[0], place(0.05, 0.0))
        assert goal.reason.tolist() == [Reason.GOAL_UNKNOWN]


def test_rows_along_a_slope_tell_nothing_of_it():
    """Contour lines 25 cm apart on a slope of 50 degrees: level along each line."""
    emap = ground_map()
    emap.rated.fill_(False)
    emap.elevation.copy_((torch.arange(16) * RESOLUTION * math.tan(math.radians(50)))[:, None])
    emap.validity[:, torch.arange(16) % 3 != 0] = False
    assert traversal_cost(emap).isinf().all()


def test_confidence_counts():
    emap = ground_map()
    sure, unsure = torch.ones(1, 16, 14), torch.zeros(1, 16, 14)
    costs = [plan(emap, place(-0.5, 0), place(0.5, 0), confidence=q).cost.item() for q in (None, sure, unsure)]
    assert costs == pytest.approx([1.0, 1.0, 2.0])


# Whatever the map -----------------------------------------------------------------------------------------------------


@given(SEEDS)
def test_the_cost_is_dijkstras_and_the_cells_are_passable(seed):
    emap = random_map(seed, known=0.9)
    cfg = TraversalCostConfig(min_traversability=0.2, max_inclination=1.2)
    start, goal = emap.center[:, :2] - torch.tensor([0.8, 0.6]), emap.center[:, :2] + torch.tensor([0.7, 0.5])
    path = plan(emap, start, goal, cfg)
    first, last = (torch.floor(p / RESOLUTION).long() - CORNER for p in (start, goal))
    cost = traversal_cost(emap, cfg, start=first)
    for b in range(2):
        value = dijkstra(cost[b].numpy(), [tuple(last[b].tolist())]) * RESOLUTION / 0.5  # its cells are 0.5 m wide
        assert path.cost[b].item() == pytest.approx(value[tuple(first[b])])
        assert bool(path.reached[b]) == math.isfinite(value[tuple(first[b])])
        i, j = (torch.floor(path.xy[b] / RESOLUTION).long() - CORNER[b]).unbind(-1)
        assert cost[b, i, j].isfinite().all() and (i[0], j[0]) == tuple(first[b])
        assert not path.reached[b] or (i[-1], j[-1]) == tuple(last[b])


def test_maps_far_away_and_batches():
    emap = random_map(1, known=1.0)
    emap.traversability.clamp_(min=0.4)
    start, goal = emap.center[:, :2] - 0.6, emap.center[:, :2] + 0.6
    both = plan(emap, start, goal)
    assert both.reached.all()
    single = ground_map(head=NO_LIMITS)
    for b in range(2):
        for name, value in emap.state._asdict().items():
            if name != "statistics":
                getattr(single, name).copy_(value[b : b + 1])
        alone = plan(single, start[b : b + 1], goal[b : b + 1])
        assert all(torch.equal(a[0], c[b]) for a, c in zip(alone, both, strict=True))
    emap.corner.add_(800_000)
    far = plan(emap, start + 100_000.0, goal + 100_000.0)
    torch.testing.assert_close(far.xy - 100_000.0, both.xy)
    other = random_map(2)
    assert torch.equal(plan(emap, start, goal, state=other.state).xy, plan(other, start, goal).xy)


# Safe occlusions and drops --------------------------------------------------------------------------------------------


@pytest.mark.slow(1)
@pytest.mark.parametrize("make, goes", [(hump, True), (step_down, True), (cliff, False), (abyss, False)])
def test_the_upper_bound_tells_a_safe_occlusion_from_a_drop(make, goes):
    """Within 1.2 m of the edge; the map has seen nothing of it before the walk of `benchmarks.quality.occlusion`."""
    case = make([0.6, 0.4])
    seen = views(case, torch.Generator().manual_seed(1))
    assert sorted(seen, reverse=True) == list(VIEWS)
    for view in (1.2, 0.8):
        emap, x = seen[view]
        assert decide(emap, x, case)["upper bound"].reached.item() == goes == case.safe


@pytest.mark.slow(1)
def test_a_cautious_planner_stops_before_what_it_does_not_see():
    case = hump([0.6, 0.4])
    emap, x = views(case, torch.Generator().manual_seed(1))[2.0]
    ways = decide(emap, x, case)
    assert ways["upper bound"].reached and not ways["unknown is impassable"].reached


def test_waypoints_descend_through_the_rating():
    """The way over a ridge of bad ground moves to where the ridge is low."""
    emap = ground_map()
    y = emap.cell_centers()[0, 8, :, 1]
    emap.traversability[0, 7:10] = 1 - (0.3 + y.abs()).clamp(max=0.9)
    ends = torch.linspace(-0.8, 0.8, 17, dtype=torch.float64)
    xy = torch.stack([ends, torch.full_like(ends, 0.5)], -1)[None]
    better = refine(emap, xy, steps=60)
    assert torch.equal(better[:, [0, -1]], xy[:, [0, -1]]) and better.isfinite().all()
    assert better[0, 8, 1] < 0.4 and piece_costs(emap, better, 50).sum() < 0.9 * piece_costs(emap, xy, 50).sum()


# Devices, and what is refused -----------------------------------------------------------------------------------------


@pytest.mark.slow(2)
def test_nothing_waits_for_the_device():
    cfg = ground_map().cfg
    with FakeTensorMode():
        emap = ElevationMap(cfg, num_envs=2)
        path = plan(emap, torch.zeros(2, 2), torch.zeros(2, 2))
        assert path.xy.shape == (2, 60, 2) and path.reached.shape == (2,)
        assert path.poses().shape == (2, 60, 3) and path.reason.shape == path.count.shape == (2,)
    emap = ElevationMap(cfg, num_envs=2, device="meta")
    with OneDevice(), NoConstants():
        places = torch.empty(2, 2, device="meta")
        path = plan(emap, places, places, max_cells=9, standing=torch.empty(2, 4, 2, device="meta"))
        assert path.poses().shape == (2, 9, 3)


def test_bad_places_elsewhere_are_not_reached():
    """As on a GPU, where nothing is read."""
    for start, goal in (((9.0, 0.0), (0.0, 0.0)), ((0.0, 0.0), (0.0, math.nan)), ((-math.inf, 0.0), (0.0, 0.0))):
        path = plan(ground_map(), unread(place(*start)), unread(place(*goal)))
        assert not path.reached and path.cost.isinf() and path.xy.isfinite().all()
        outside = math.isfinite(start[0]) and start[0] < 1
        assert path.reason == (Reason.GOAL_OUTSIDE if outside else Reason.START_OUTSIDE)
        assert path.count == outside and path.poses().isnan().all()


@pytest.mark.parametrize(
    "start, goal, error, text",
    [
        (torch.zeros(2), place(0, 0), ValueError, r"start_xy: expected \(1, 2\), got \(2,\)"),
        (place(0, 0), torch.zeros(2, 2), ValueError, r"goal_xy: expected \(1, 2\), got \(2, 2\)"),
        (place(0, 0), torch.zeros(1, 2, dtype=torch.int64), TypeError, "goal_xy: must be float16"),
        ((0.0, 0.0), place(0, 0), TypeError, "start_xy: must be a torch.Tensor"),
        (
            place(0, 0),
            place(1.01, 0),
            ValueError,
            r"goal_xy: must lie in the window, got \[\[1.01, 0.0\]\]; windows are",
        ),
        (place(0, math.nan), place(0, 0), ValueError, "start_xy: must lie in the window"),
    ],
)
def test_bad_places_are_refused(start, goal, error, text):
    with pytest.raises(error, match=text):
        plan(ground_map(), start, goal)


def test_other_bad_arguments_are_refused():
    with pytest.raises(TypeError, match="cfg: must be a TraversalCostConfig"):
        plan(ground_map(), place(0, 0), place(0, 0), 0.5)
    with pytest.raises(ValueError, match="max_cells: must be a positive int"):
        plan(ground_map(), place(0, 0), place(0, 0), max_cells=0)
