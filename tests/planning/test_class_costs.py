"""Costs by class: the factor by hand, paths around water, why there is none, and what is refused."""

import math

import pytest
import torch
from torch._subclasses.fake_tensor import FakeTensorMode

from torchelev import ChannelConfig, ElevationMap, ElevationMapConfig, GridConfig, TraversabilityConfig
from torchelev.planning.class_costs import rate_classes
from torchelev.planning.limits import Limit
from torchelev.planning.path_reason import Reason
from torchelev.planning.planner import plan
from torchelev.planning.traversal_cost import TraversalCostConfig, traversal_cost

INF = math.inf
GRID = GridConfig(resolution=0.1, length_x=4.0, length_y=3.0)
CHANNELS = {
    "terrain": ChannelConfig(kind="class", names=("grass", "mud", "water"), prior=0.3),
    "wet": ChannelConfig(kind="class_average", size=2),
    "heat": "mean",
}
START, GOAL = torch.tensor([[-1.45, 0.05]]), torch.tensor([[1.45, 0.05]])
STRAIGHT = 2.9  # [m]


def flat_map(terrain=None, wet=None):
    """Flat ground with a point in each cell, and the probabilities of classes that functions of x and y return."""
    emap = ElevationMap(ElevationMapConfig(grid=GRID, channels=CHANNELS, traversability=TraversabilityConfig()))
    x, y = emap.cell_centers()[0].flatten(0, 1).unbind(-1)
    points = torch.stack([x, y, torch.full_like(x, -0.5)], -1)[None]
    given = {"terrain": terrain, "wet": wet}
    T = torch.eye(4)[None]
    T[:, 2, 3] = 0.5
    features = {name: of(x, y)[None] for name, of in given.items() if of is not None}
    emap.update(points, T, T, dt=0.1, features=features)
    return emap


def pond(x, y, gap=0.9):
    """Water over the whole width behind x = 0, but for a strip at y > gap."""
    is_water = ((x.abs() < 0.4) & (y < gap)).float()
    return torch.stack([1 - is_water, 0 * x, is_water], -1)


def probabilities(*values):
    return lambda x, y: torch.tensor(values).expand(len(x), -1)


def cells_of(emap, path):
    """The probability of water below each waypoint."""
    return emap.sample(path.xy, "terrain.water", "nearest")[0][0, : int(path.count)]


# By hand --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("costs, factor, is_forbidden", [
    ({}, 1.0, False),
    ({"mud": 3.0}, 0.6 + 0.3 * 3 + 0.1, False),
    ({"grass": 0.5, "mud": 3.0, "water": 10.0}, 0.3 + 0.9 + 1.0, False),
    ({"mud": 3.0, "water": INF}, (0.6 + 0.9) / 0.9, False),
    ({"mud": INF}, 1.0, True),
    ({"grass": INF, "mud": INF, "water": INF}, 1.0, True),
])  # fmt: skip
def test_the_factor_is_the_expected_one_of_classes_that_are_allowed(costs, factor, is_forbidden):
    """One point of probabilities q and a prior of 0.3: (q + 0.1) / 1.3."""
    emap = flat_map(probabilities(0.68, 0.29, 0.03))
    assert emap.layer("terrain")[0, :, 20, 15].tolist() == pytest.approx([0.6, 0.3, 0.1])
    rating = rate_classes(emap, {"terrain": costs}, 0.29, 1.0)
    assert rating.factor[0, 20, 15].item() == pytest.approx(factor)
    assert rating.is_forbidden[0, 20, 15].item() is is_forbidden


def test_forbidden_classes_count_together():
    emap = flat_map(probabilities(0.68, 0.29, 0.03))  # 0.6, 0.3, 0.1
    for limit, expected in ((0.39, True), (0.41, False)):
        rating = rate_classes(emap, {"terrain": {"mud": INF, "water": INF}}, limit, 1.0)
        assert bool(rating.is_forbidden.all()) is expected


def test_one_forbidden_channel_is_enough():
    emap = flat_map(probabilities(0.0, 0.0, 1.0), probabilities(1.0, 0.0))
    for costs in ({"terrain": {"water": INF}, "wet": {"1": INF}}, {"wet": {"1": INF}, "terrain": {"water": INF}}):
        assert rate_classes(emap, costs, 0.3, 1.0).is_forbidden.all()


def test_costs_are_those_of_the_ground_times_the_factors_of_all_channels():
    emap = flat_map(probabilities(1.0, 0.0, 0.0), probabilities(0.25, 0.75))
    plain = traversal_cost(emap)
    cfg = TraversalCostConfig(class_costs={"terrain": {"grass": 1.3}, "wet": {"1": 5.0}})
    (grass, rest) = (1.1 / 1.3, 0.2 / 1.3)
    expected = plain * (1.3 * grass + rest) * (0.25 + 0.75 * 5)
    torch.testing.assert_close(traversal_cost(emap, cfg), expected)
    assert (plain[:, 2:-2, 2:-2] < 1.01).all()
    same = TraversalCostConfig(class_costs={"terrain": {"grass": 1.0, "mud": 1.0}})
    torch.testing.assert_close(traversal_cost(emap, same), plain)


def test_where_the_class_is_unknown_the_setting_counts():
    emap = flat_map(lambda x, y: torch.where((x < 0)[:, None], torch.nan, pond(x, y, gap=9.0)))
    cfg = TraversalCostConfig(class_costs={"terrain": {"water": INF}}, unknown_class_cost=2.5)
    cost, plain = traversal_cost(emap, cfg)[0], traversal_cost(emap)[0]
    torch.testing.assert_close(cost[:20], 2.5 * plain[:20])
    assert cost[20:24].isinf().all() and plain.isfinite().all()
    torch.testing.assert_close(cost[24:], plain[24:])


def test_forbidden_ground_grows_by_the_inflation_radius():
    emap, costs = flat_map(pond), {"terrain": {"water": INF}}
    for radius, edge in ((0.0, 24), (0.2, 26)):
        cost = traversal_cost(emap, TraversalCostConfig(class_costs=costs, inflation_radius=radius))[0, :, 5]
        assert cost[edge - 1].isinf() and cost[edge].isfinite()


def test_another_state_is_read():
    emap = flat_map(pond)
    cfg = TraversalCostConfig(class_costs={"terrain": {"water": INF}})
    higher = emap.state._replace(elevation=emap.state.elevation + 1.0)  # of other ground no class is known
    assert traversal_cost(emap, cfg, state=higher).isfinite().all() and not traversal_cost(emap, cfg).isfinite().all()


# Paths ----------------------------------------------------------------------------------------------------------------


def test_a_path_goes_around_water_and_straight_without_costs():
    emap = flat_map(pond)
    straight = plan(emap, START, GOAL)
    assert straight.reached.all() and straight.length.item() == pytest.approx(STRAIGHT, abs=1e-3)
    assert cells_of(emap, straight).max() > 0.8
    around = plan(emap, START, GOAL, TraversalCostConfig(class_costs={"terrain": {"water": INF}}))
    assert around.reached.all() and around.length.item() > STRAIGHT + 0.3
    assert cells_of(emap, around).max() < 0.1 and around.xy[0, :, 1].max() > 0.9


def test_a_path_crosses_mud_where_the_way_around_costs_more():
    def mud(x, y):
        return pond(x, y)[:, [0, 2, 1]]

    emap = flat_map(mud)
    for factor, crosses in ((1.5, True), (8.0, False)):
        path = plan(emap, START, GOAL, TraversalCostConfig(class_costs={"terrain": {"mud": factor}}))
        found = emap.sample(path.xy, "terrain.mud", "nearest")[0].max() > 0.5
        assert path.reached.all() and bool(found) is crosses


def test_a_path_that_water_cuts_off_says_so():
    emap = flat_map(lambda x, y: pond(x, y, gap=9.0))
    cfg = TraversalCostConfig(class_costs={"terrain": {"water": INF}})
    path = plan(emap, START, GOAL, cfg)
    assert path.reason.tolist() == [Reason.NO_PATH] and path.limit.tolist() == [Limit.CLASS]
    assert path.explain()[0].endswith("there, the ground is too likely of a class that class_costs forbids")
    into = plan(emap, START, torch.tensor([[0.05, 0.05]]), cfg)
    assert into.reason.tolist() == [Reason.GOAL_IMPASSABLE] and into.limit.tolist() == [Limit.CLASS]
    assert plan(emap, START, GOAL).limit.tolist() == [Limit.NONE]


def test_a_robot_amid_water_is_told_that_it_is_enclosed():
    cfg = TraversalCostConfig(class_costs={"terrain": {"water": INF}})
    path = plan(flat_map(probabilities(0.0, 0.0, 1.0)), START, GOAL, cfg)
    assert path.reason.tolist() == [Reason.GOAL_IMPASSABLE] and path.limit.tolist() == [Limit.CLASS]
    emap = flat_map(lambda x, y: torch.stack([(x > 1.2) * 1.0, 0 * x, (x <= 1.2) * 1.0], -1))
    path = plan(emap, START, GOAL, cfg)
    assert path.reason.tolist() == [Reason.START_IMPASSABLE] and path.limit.tolist() == [Limit.CLASS]


def test_nothing_waits_for_the_device():
    with FakeTensorMode():
        emap = ElevationMap(ElevationMapConfig(grid=GRID, channels=CHANNELS), num_envs=2)
        cfg = TraversalCostConfig(class_costs={"terrain": {"mud": 2.0, "water": INF}})
        assert traversal_cost(emap, cfg).shape == (2, 40, 30)


# What is refused ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("settings, error, words", [
    (dict(class_costs=3), TypeError, r"cost.class_costs: must be a dict, got int; give \{\"terrain\": \{"),
    (dict(class_costs={"terrain": 3}), TypeError, r"cost.class_costs\['terrain'\]: must be a dict, got int"),
    *((dict(class_costs={"terrain": {"mud": wrong}}), ValueError,
       rf"cost.class_costs\['terrain'\]\['mud'\]: must lie in \[0.001, 1000\], or be inf, got {wrong!r}")
      for wrong in (-1.0, 0, 1e-50, 5000.0, math.nan, "high", True, None)),
    (dict(max_forbidden=1.0), ValueError, r"cost.max_forbidden: must lie in \[0, 1\), got 1.0"),
    (dict(max_forbidden=-0.1), ValueError, "cost.max_forbidden: must be at least 0"),
    (dict(unknown_class_cost=0), ValueError, "cost.unknown_class_cost: must be"),
    (dict(unknown_class_cost=INF), ValueError, "cost.unknown_class_cost: must be"),
])  # fmt: skip
def test_bad_costs_are_refused(settings, error, words):
    with pytest.raises(error, match=words):
        TraversalCostConfig(**settings)


@pytest.mark.parametrize("costs, error, words", [
    ({"snow": {"deep": 2.0}}, KeyError,
     "cost.class_costs: must name channels of the map: terrain, wet, heat, got 'snow'"),
    ({"heat": {"hot": 2.0}}, ValueError, "cost.class_costs: must name channels of classes, got 'heat' of kind 'mean'"),
    ({"terrain": {"lava": 2.0}}, KeyError,
     r"cost.class_costs\['terrain'\]: must name classes, got 'lava'; there are grass, mud, water"),
    ({"wet": {"2": 2.0}}, KeyError, r"cost.class_costs\['wet'\]: must name classes, got '2'; there are 0, 1"),
])  # fmt: skip
def test_costs_that_the_map_has_no_channel_for_are_refused(costs, error, words):
    cfg = TraversalCostConfig(class_costs=costs)
    for call in (lambda: traversal_cost(flat_map(), cfg), lambda: plan(flat_map(), START, GOAL, cfg)):
        with pytest.raises(error, match=words):
            call()


def test_costs_are_copied_and_a_config_can_be_hashed():
    costs = {"terrain": {"water": INF}}
    cfg = TraversalCostConfig(class_costs=costs)
    costs["terrain"]["water"] = 1.0
    assert cfg.class_costs == {"terrain": {"water": INF}} and isinstance(hash(cfg), int)
    assert cfg != TraversalCostConfig(class_costs=costs)
