"""Traversal cost: by hand, against loops, and what is refused."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch._subclasses.fake_tensor import FakeTensorMode

from tests.devices import NoConstants, OneDevice
from tests.helpers import random_state
from tests.planning.maps import NO_LIMITS, RESOLUTION, ground_map, random_map
from torchelev import ElevationMap, ElevationMapConfig
from torchelev.planning.traversal_cost import TraversalCostConfig, cost_of_layers, traversal_cost

SEEDS = st.integers(0, 10_000)
INF = math.inf


def occluded(bound, rows=slice(6, 12)):
    """Level known ground, of which the cells of these rows are only bounded, by bound(x) with x from the first one."""
    emap = ground_map(1.0)
    first = rows.start
    x = (torch.arange(16) - first + 1) * RESOLUTION
    height = torch.as_tensor(bound(x.double()))[None, :, None].expand_as(emap.elevation)
    emap.validity[:, rows] = False
    emap.bounded[:, rows] = True
    emap.elevation[:, rows.stop :] = height[
        :, rows.stop - 1 : rows.stop
    ]  # the bound ends where the ground is seen again
    emap.upper_bound.copy_(height)
    return emap


# By hand --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("rating, confidence, cost", [
    (1.0, None, 1.0), (0.5, None, 3.0), (0.31, None, 3.76), (0.29, None, INF), (0.0, None, INF),
    (1.0, 0.25, 1.75), (0.5, 0.0, 4.0), (1.0, math.nan, 2.0), (1.0, 7.0, 1.0),
])  # fmt: skip
def test_known_ground_by_hand(rating, confidence, cost):
    """1 + 4 (1 - t) + (1 - q)."""
    emap = ground_map(rating)
    q = None if confidence is None else torch.full_like(emap.elevation, confidence)
    assert traversal_cost(emap, confidence=q)[0, 3, 4].item() == pytest.approx(cost)


def test_a_gentle_bound_is_passable_and_a_steep_one_is_not():
    """At 0.2 m per metre: 1 + 1 + a / 0.5, a = atan 0.2. The limit of 0.5 rad is 0.546 m per metre."""
    gentle = traversal_cost(occluded(lambda x: -0.2 * x))[0]
    assert gentle[:6].eq(1).all() and gentle[12:].eq(1).all()
    assert gentle[8, 7].item() == pytest.approx(2 + math.atan(0.2) / 0.5)
    steep = traversal_cost(occluded(lambda x: -0.56 * x))[0]
    assert steep[8].isinf().all() and steep[:6].eq(1).all()
    just = traversal_cost(occluded(lambda x: -0.54 * x))[0]
    assert just[8].isfinite().all() and just[8, 7] > gentle[8, 7]


def test_a_steep_bound_is_impassable_whichever_way_it_goes():
    """A bound that climbs away gives no inclination either: the ground may end below it as well as rise with it."""
    assert traversal_cost(occluded(lambda x: 0.56 * x))[0, 8].isinf().all()


def test_a_low_step_passes_and_a_deep_one_does_not():
    """Unseen cells at a step of 9 cm fall no more than 0.09 / 0.18 over the nearest of the eight places."""
    low, deep = (traversal_cost(occluded(lambda x, d=d: -d + 0 * x, slice(7, 8))) for d in (0.09, 0.11))
    assert low[0, 7].isfinite().all() and deep[0, 7].isinf().all()


def test_unknown_ground_without_a_bound_is_impassable():
    emap = occluded(lambda x: 0 * x)
    assert traversal_cost(emap)[0, 8].eq(2).all()
    assert traversal_cost(emap, TraversalCostConfig(cross_unknown=False))[0, 8].isinf().all()
    emap.bounded[0, 8] = False
    cost = traversal_cost(emap)[0]
    assert cost[8].isinf().all() and cost[7].isfinite().all()


def test_nothing_known():
    emap = ground_map(known=False)
    assert traversal_cost(emap).isinf().all()
    emap.bounded.fill_(True)
    assert traversal_cost(emap).eq(2).all(), "a level bound"
    emap.bounded.fill_(False)
    emap.bounded[0, 8, 7] = True
    assert traversal_cost(emap).isinf().all(), "one cell has no inclination"


def test_inflation():
    emap = ground_map(1.0)
    emap.traversability[0, 5, 6] = 0.0
    cost = traversal_cost(emap, TraversalCostConfig(inflation_radius=0.25))[0]
    assert cost[3:8, 4:9].isinf().all() and cost.isinf().sum() == 25


def test_where_the_robot_stands():
    """Radius 0.26 m is two cells: unknown ground there is passable, known bad ground in its own cell alone."""
    cfg = TraversalCostConfig(stand_radius=0.26)
    none, known = torch.zeros(1, 9, 9, dtype=torch.bool), torch.zeros(1, 9, 9, dtype=torch.bool)
    known[0, 4, 3:6] = True
    bad, start = torch.zeros(1, 9, 9), torch.tensor([[4, 4]])
    found = cost_of_layers((bad, known), (bad, none), RESOLUTION, cfg, start=start)[0]
    assert found[4, 4] == 6.0 and found[4, 3].isinf() and found[4, 2] == 6.0 and found[3, 3] == 6.0
    assert found.isfinite().sum() == 13 - 2 and found[2, 3].isinf()
    kept = cost_of_layers((bad + 0.9, ~none), (bad, none), RESOLUTION, cfg, start=start)
    assert torch.equal(kept, cost_of_layers((bad + 0.9, ~none), (bad, none), RESOLUTION, cfg))


def test_unknown_ground_below_the_robot_does_not_cage_it():
    """It does not grow, but what is unknown farther away does."""
    known = torch.ones(1, 16, 14, dtype=torch.bool)
    known[0, 4:7, 4:7] = known[0, 12, 12] = False
    emap = ground_map(known=known)
    cfg = TraversalCostConfig(inflation_radius=0.25, stand_radius=0.26)
    cost = traversal_cost(emap, cfg, start=torch.tensor([[5, 5]]))[0]
    assert cost[:10, :10].isfinite().all() and cost[10:15, 10:14].isinf().all() and cost.isinf().sum() == 20


# Against loops --------------------------------------------------------------------------------------------------------


def slow_cost(state, b, i, j, cfg, resolution, confidence):
    """The cost of one cell, from scalars."""
    known, bounded = bool(state.validity[b, i, j]), bool(state.bounded[b, i, j])
    if known:
        t = float(state.traversability[b, i, j])
        doubt = cfg.weight_confidence * (1 - float(confidence[b, i, j]))
        return 1 + cfg.weight_traversability * (1 - t) + doubt if t >= cfg.min_traversability else INF
    angle = slow_inclination(state, b, i, j, round(cfg.inclination_distance / resolution), resolution)
    if not bounded or angle is None or angle > cfg.max_inclination:
        return INF
    return 1 + cfg.weight_confidence + cfg.weight_inclination * angle / cfg.max_inclination


def slow_inclination(state, b, i, j, reach, resolution):
    H, W = state.validity.shape[1:]
    aslant, angles, axes = max(1, round(reach / math.sqrt(2))), [], set()
    for di, dj in [(a, c) for a in (-1, 0, 1) for c in (-1, 0, 1) if (a, c) != (0, 0)]:
        n = aslant if di and dj else reach
        k, m = i + n * di, j + n * dj
        if 0 <= k < H and 0 <= m < W and (state.validity[b, k, m] or state.bounded[b, k, m]):
            other = float((state.elevation if state.validity[b, k, m] else state.upper_bound)[b, k, m])
            step = abs(other - float(state.upper_bound[b, i, j]))
            angles.append(math.atan(step / (n * math.hypot(di, dj) * resolution)))
            axes.add(frozenset([(di, dj), (-di, -dj)]))
    pairs = ([(1, 0), (0, 1)], [(1, 1), (1, -1)])  # perpendicular
    spans = any(all(frozenset([(i, j), (-i, -j)]) in axes for i, j in pair) for pair in pairs)
    return max(angles) if spans else None


@pytest.mark.slow(1)
@given(SEEDS)
def test_the_cost_is_that_of_loops(seed):
    """Unknown cells hold NaN: none of it may be read."""
    rng = np.random.default_rng(seed)
    emap = random_map(seed)
    emap.upper_bound[~emap.bounded] = torch.nan
    state = emap.state
    cfg = TraversalCostConfig(
        max_inclination=1.2, min_traversability=0.4, weight_confidence=0.7, weight_inclination=3.0
    )
    confidence = torch.from_numpy(rng.uniform(0, 1, state.elevation.shape))
    cost = traversal_cost(emap, cfg, confidence=torch.where(state.validity, confidence, torch.nan))
    for b, i, j in np.ndindex(*cost.shape):
        expected = slow_cost(state, b, i, j, cfg, RESOLUTION, confidence)
        assert cost[b, i, j].item() == pytest.approx(expected)
    assert cost.isinf().any() and (cost[~state.validity].isfinite()).any()


@given(SEEDS)
def test_turned_mirrored_and_lifted_maps_cost_the_same(seed):
    state = random_state(np.random.default_rng(seed), ground_map().cfg.grid, 2)
    cfg = TraversalCostConfig(max_inclination=1.2)

    def cost(turn=lambda v: v, lift=0.0):
        known, bounded = turn(state.validity), turn(state.bounded)
        bound = turn(torch.where(state.validity, state.elevation, state.upper_bound)) + lift
        return cost_of_layers((turn(state.traversability), known), (bound, known | bounded), RESOLUTION, cfg)

    for turn in (lambda v: v.rot90(1, (1, 2)), lambda v: v.flip(1), lambda v: v.transpose(1, 2)):
        torch.testing.assert_close(cost(turn), turn(cost()))
    torch.testing.assert_close(cost(lift=300.0), cost())


def test_batches_equal_single_maps():
    emap = random_map(5)
    both = traversal_cost(emap)
    state = emap.state
    for b in range(2):
        single = ground_map(head=NO_LIMITS)
        for name, value in state._asdict().items():
            if name != "statistics":
                getattr(single, name).copy_(value[b : b + 1])
        assert torch.equal(traversal_cost(single)[0], both[b])
    other = random_map(6)
    assert torch.equal(traversal_cost(emap, state=other.state), traversal_cost(other))


def test_what_the_same_ground_costs_hardly_depends_on_the_cells():
    """A bound that falls by 0.3 m per metre, on cells of 2, 5 and 10 cm."""
    for resolution in (0.02, 0.05, 0.1):
        x = torch.arange(round(2 / resolution)).double()[None, :, None] * resolution
        bound = (-0.3 * x).expand(1, -1, 40)
        never, always = torch.zeros(bound.shape, dtype=torch.bool), torch.ones(bound.shape, dtype=torch.bool)
        cost = cost_of_layers((bound, never), (bound, always), resolution, TraversalCostConfig())
        torch.testing.assert_close(cost[0, -1, 20].item(), 2 + math.atan(0.3) / 0.5)


# Devices, and what is refused -----------------------------------------------------------------------------------------


@pytest.mark.slow(2)
def test_nothing_waits_for_the_device():
    with FakeTensorMode():
        assert traversal_cost(ElevationMap(num_envs=2), TraversalCostConfig(inflation_radius=0.1)).shape == (
            2,
            250,
            250,
        )
    emap = ElevationMap(num_envs=2, device="meta")
    with OneDevice(), NoConstants():
        confidence = torch.empty(2, 250, 250, device="meta")
        start = torch.empty(2, 2, device="meta", dtype=torch.int64)
        assert traversal_cost(emap, confidence=confidence, start=start).shape == confidence.shape


@pytest.mark.parametrize("settings, text", [
    ({"min_traversability": 1.5}, r"cost.min_traversability: must lie in \[0, 1\]"),
    ({"weight_traversability": -1.0}, "cost.weight_traversability: must be at least 0"),
    ({"weight_confidence": math.nan}, "cost.weight_confidence: must be at least 0"),
    ({"weight_inclination": INF}, "cost.weight_inclination: must be at least 0"),
    ({"stand_radius": "0.4"}, "cost.stand_radius: must be at least 0"),
    ({"max_inclination": 0.0}, "cost.max_inclination: must lie between 0 and pi / 2"),
    ({"max_inclination": 1.6}, "cost.max_inclination: must lie between 0 and pi / 2"),
    ({"inclination_distance": 0.0}, "cost.inclination_distance: must be a positive number"),
    ({"cross_unknown": 1}, "cost.cross_unknown: must be a bool"),
])  # fmt: skip
def test_bad_settings_are_refused(settings, text):
    with pytest.raises(ValueError, match=text):
        TraversalCostConfig(**settings)


def test_bad_arguments_are_refused():
    emap = ground_map()
    with pytest.raises(TypeError, match="cfg: must be a TraversalCostConfig"):
        traversal_cost(emap, 0.5)
    with pytest.raises(ValueError, match=r"confidence: expected \(1, 16, 14\), got \(16, 14\)"):
        traversal_cost(emap, confidence=torch.ones(16, 14))
    with pytest.raises(TypeError, match="confidence: must be float16"):
        traversal_cost(emap, confidence=torch.ones(1, 16, 14, dtype=torch.bool))
    unrated = ElevationMap(dataclasses.replace(ElevationMapConfig(), traversability=None))
    with pytest.raises(ValueError, match="traversability: must not be switched off"):
        traversal_cost(unrated)
