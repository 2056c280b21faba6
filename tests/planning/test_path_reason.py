"""Why a plan does not reach its goal."""

import pytest
import torch
from hypothesis import given

from tests.planning.maps import SEEDS, ground_map, place, random_map
from torchelev.planning.path_reason import Reason
from torchelev.planning.planner import plan
from torchelev.planning.traversal_cost import TraversalCostConfig


def changed(**cells):
    """Ground of cells that are rated 0 ("bad"), or not known ("lost"); everything else is rated 1."""
    emap = ground_map()
    for kind, where in cells.items():
        emap.traversability[(0, *where)] = 0.0
        emap.validity[(0, *where)] = kind == "bad"
    return emap


ALL, GOAL = (slice(None), slice(None)), (slice(12, 13), slice(7, 8))
WALL, NEAR = (slice(8, 9), slice(None)), (slice(0, 9), slice(0, 14))


@pytest.mark.parametrize("emap, options, reason", [
    (changed(), {}, Reason.REACHED),
    (changed(bad=GOAL), {}, Reason.GOAL_IMPASSABLE),
    (changed(lost=GOAL), {}, Reason.GOAL_UNKNOWN),
    (changed(bad=WALL), {}, Reason.NO_PATH),
    (changed(lost=WALL), {}, Reason.NO_PATH),
    (changed(lost=NEAR), {}, Reason.START_UNKNOWN),
    (changed(bad=NEAR), {}, Reason.START_IMPASSABLE),
    (changed(lost=ALL), {}, Reason.GOAL_UNKNOWN),
    (changed(), {"max_cells": 5}, Reason.CELL_LIMIT),
    (changed(), {"cfg": TraversalCostConfig(stand_radius=9.0)}, Reason.REACHED),
    (changed(bad=WALL), {"cfg": TraversalCostConfig(stand_radius=9.0)}, Reason.NO_PATH),
])  # fmt: skip
def test_reasons(emap, options, reason):
    path = plan(emap, place(-0.5, 0.05), place(0.55, 0.05), **options)
    assert path.reason.tolist() == [reason] and path.reason.dtype == torch.int64
    assert path.reached.tolist() == [reason == Reason.REACHED]
    assert path.explain() == [reason.sentence] and len(reason.sentence) > 20
    assert path.count.tolist() == [5 if reason == Reason.CELL_LIMIT else 9 if path.reached else 1]


def test_a_search_that_stopped_early_says_so():
    """One round follows no detour: ahead, back, ahead, back ..."""
    emap = ground_map()
    for k, i in enumerate(range(2, 15, 2)):
        emap.traversability[0, i, slice(0, -1) if k % 2 else slice(1, None)] = 0.0
    ends = place(-0.9, 0.0), place(0.9, 0.0)
    assert plan(emap, *ends, rounds=1).reason.tolist() == [Reason.ROUND_LIMIT]
    assert plan(emap, *ends, max_cells=200).reason.tolist() == [Reason.REACHED]


def test_every_reason_has_a_sentence():
    assert len({reason.sentence for reason in Reason}) == len(Reason)


@given(SEEDS)
def test_reached_has_no_other_reason(seed):
    emap = random_map(seed, known=0.8)
    ends = emap.center[:, :2] - torch.tensor([0.8, 0.6]), emap.center[:, :2] + torch.tensor([0.7, 0.5])
    path = plan(emap, *ends, TraversalCostConfig(min_traversability=0.2), max_cells=20)
    assert torch.equal(path.reached, path.reason == Reason.REACHED)
    assert torch.equal(path.cost.isfinite(), (path.reason == Reason.REACHED) | (path.reason == Reason.CELL_LIMIT))
    poses, yaw = path.poses(), path.poses()[..., 2]
    for b, n in enumerate(path.count.tolist()):
        assert (path.xy[b, 1:n] != path.xy[b, : n - 1]).any(-1).all()
        assert poses[b].isnan().all() if path.cost[b].isinf() else poses[b, n:].eq(poses[b, n - 1]).all()
        chord = path.xy[b, min(n - 1, 2)] - path.xy[b, 0]
        ahead = torch.cat([yaw[b, :1].cos(), yaw[b, :1].sin()]) @ chord
        assert n == 1 or ahead > 0, "the robot looks along its path"
