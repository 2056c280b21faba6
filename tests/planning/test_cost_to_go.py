"""The cost to go and the way down: by hand, against Dijkstra's algorithm in loops, and what is refused."""

import heapq
import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch._subclasses.fake_tensor import FakeTensorMode

from torchelev.planning.cost_to_go import cost_to_go, descend

SEEDS = st.integers(0, 10_000)
RESOLUTION, INF = 0.5, math.inf
NEIGHBOURS = [(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if (i, j) != (0, 0)]


def passable(cost, i, j):
    return 0 <= i < cost.shape[0] and 0 <= j < cost.shape[1] and math.isfinite(cost[i, j])


def steps_from(cost, i, j):
    """The cells that a step from (i, j) leads to, and what each costs; no corner is cut."""
    for di, dj in NEIGHBOURS:
        if all(passable(cost, i + a, j + b) for a, b in ((di, dj), (di, 0), (0, dj))):
            yield i + di, j + dj, math.hypot(di, dj) * RESOLUTION * (cost[i, j] + cost[i + di, j + dj]) / 2


def dijkstra(cost, goals):
    """The cost to go (H, W) by a queue, NumPy."""
    value = np.full(cost.shape, INF)
    queue = [(0.0, i, j) for i, j in goals if passable(cost, i, j)]
    for _, i, j in queue:
        value[i, j] = 0.0
    while queue:
        reached, i, j = heapq.heappop(queue)
        if reached > value[i, j]:
            continue
        for k, m, step in steps_from(cost, i, j):
            if reached + step < value[k, m]:
                value[k, m] = reached + step
                heapq.heappush(queue, (value[k, m], k, m))
    return value


def random_case(seed, num_envs=2, walls=0.3, dtype=torch.float64):
    """Costs with walls, and one to three goal cells on each map."""
    rng = np.random.default_rng(seed)
    H, W = rng.integers(1, 14, 2)
    cost = rng.uniform(1, 6, (num_envs, H, W))
    cost[rng.random(cost.shape) < walls] = INF
    goal = np.zeros(cost.shape, dtype=bool)
    for b in range(num_envs):
        for _ in range(rng.integers(1, 4)):
            goal[b, rng.integers(H), rng.integers(W)] = True
    return torch.from_numpy(cost).to(dtype), torch.from_numpy(goal)


def to_go(cost, goal, **options):
    return cost_to_go(cost, goal, resolution=RESOLUTION, **options)


def grid(*rows):
    return torch.tensor([rows], dtype=torch.float64)


def at(like, *cells):
    mask = torch.zeros(like.shape, dtype=torch.bool)
    for i, j in cells:
        mask[:, i, j] = True
    return mask


# By hand --------------------------------------------------------------------------------------------------------------


def test_steps_by_hand():
    """Cells of 0.5 m: a straight step costs 0.5 times the mean of both cells, one aslant sqrt 2 times as much."""
    cost = grid([1.0, 3.0, INF], [1.0, 1.0, 5.0])
    value = to_go(cost, at(cost, (0, 0)))
    aslant = math.sqrt(2) / 2
    assert value[0].tolist() == pytest.approx(np.array([[0, 1, INF], [0.5, aslant, aslant + 1.5]]))


def test_no_corner_is_cut():
    cost = grid([1.0, INF], [1.0, 1.0])
    assert to_go(cost, at(cost, (0, 0)))[0, 1, 1] == 1.0, "two straight steps, not one aslant"
    cost = grid([1.0, INF], [INF, 1.0])
    value = to_go(cost, at(cost, (0, 0)))
    assert value[0, 1, 1] == INF
    way = descend(value, cost, torch.tensor([[1, 1]]), resolution=RESOLUTION, max_cells=5)
    assert not way.reached and (way.cells == 1).all() and way.length == 0


def test_a_way_around_a_wall():
    cost = torch.ones(1, 5, 4, dtype=torch.float64)
    cost[0, 2, :3] = INF
    value = to_go(cost, at(cost, (4, 0)))
    way = descend(value, cost, torch.tensor([[0, 0]]), resolution=RESOLUTION, max_cells=12)
    cells = way.cells[0].tolist()
    assert way.reached and cells[0] == [0, 0] and cells[-1] == [4, 0] and [2, 3] in cells
    length = (6 + 2 * math.sqrt(2)) * RESOLUTION  # two steps aslant, and around the wall's end squarely
    assert way.length.item() == pytest.approx(length) and value[0, 0, 0].item() == pytest.approx(length)
    short = descend(value, cost, torch.tensor([[0, 0]]), resolution=RESOLUTION, max_cells=4)
    assert short.cells[0].tolist() == cells[:4] and not short.reached


def test_start_is_goal_and_goal_is_wall():
    cost = grid([1.0, INF, 1.0])
    value = to_go(cost, at(cost, (0, 0)))
    way = descend(value, cost, torch.tensor([[0, 0]]), resolution=RESOLUTION, max_cells=3)
    assert way.reached and way.length == 0 and (way.cells == 0).all()
    assert to_go(cost, at(cost, (0, 1))).isinf().all(), "a goal that is impassable is none"
    assert to_go(cost, at(cost)).isinf().all()


# Against loops --------------------------------------------------------------------------------------------------------


@given(SEEDS, st.sampled_from([0.0, 0.3, 0.5]))
def test_the_cost_to_go_is_dijkstras(seed, walls):
    cost, goal = random_case(seed, walls=walls)
    value = to_go(cost, goal)
    for b in range(2):
        expected = dijkstra(cost[b].numpy(), np.argwhere(goal[b].numpy()))
        np.testing.assert_allclose(value[b], expected, rtol=1e-12)


@given(SEEDS)
def test_ways_cost_what_they_should(seed):
    cost, goal = random_case(seed)
    value = to_go(cost, goal)
    H, W = cost.shape[1:]
    for i in range(H):
        start = torch.tensor([[i, (7 * i) % W]]).repeat(2, 1)
        way = descend(value, cost, start, resolution=RESOLUTION, max_cells=H * W)
        for b in range(2):
            there = value[b, start[b, 0], start[b, 1]].item()
            assert bool(way.reached[b]) == math.isfinite(there)
            if way.reached[b]:
                costs, length = walked(cost[b].numpy(), way.cells[b].tolist())
                assert costs == pytest.approx(there) and length == pytest.approx(way.length[b].item())


def walked(cost, cells):
    """What a way costs and how long it is, if each of its steps is allowed."""
    total = length = 0.0
    for (i, j), (k, m) in zip(cells[:-1], cells[1:], strict=True):
        if (i, j) != (k, m):
            total += {(a, b): step for a, b, step in steps_from(cost, i, j)}[k, m]
            length += math.hypot(k - i, m - j) * RESOLUTION
    return total, length


def test_a_long_maze():
    """A corridor that winds through all of the map: more turns than a fixed number of rounds follows."""
    cost = torch.ones(1, 41, 9)
    cost[0, 1::4, :-1] = cost[0, 3::4, 1:] = INF
    goal = at(cost, (40, 0))
    value = to_go(cost, goal)
    np.testing.assert_allclose(value[0], dijkstra(cost[0].numpy(), [(40, 0)]), rtol=1e-6)
    assert value[0, 0, 0].isfinite() and to_go(cost, goal, rounds=3)[0, 0, 0].isinf()
    assert torch.equal(to_go(cost, goal, rounds=100), value)


# Batches, symmetry, dtypes, devices -----------------------------------------------------------------------------------


@given(SEEDS)
def test_batches_equal_single_maps(seed):
    cost, goal = random_case(seed, num_envs=3)
    both = to_go(cost, goal)
    assert all(torch.equal(to_go(cost[b : b + 1], goal[b : b + 1])[0], both[b]) for b in range(3))


@given(SEEDS)
def test_turned_and_mirrored_maps_cost_the_same(seed):
    cost, goal = random_case(seed)
    value = to_go(cost, goal)
    for turn in (lambda v: v.rot90(1, (1, 2)), lambda v: v.flip(1), lambda v: v.transpose(1, 2)):
        torch.testing.assert_close(to_go(turn(cost), turn(goal)), turn(value))


def test_dtypes_and_gradients():
    cost, goal = random_case(3)
    for dtype, tolerance in ((torch.float32, 1e-5), (torch.float16, 5e-3), (torch.bfloat16, 5e-2)):
        value = to_go(cost.to(dtype).requires_grad_(), goal)
        assert value.dtype == torch.float32 and not value.requires_grad
        torch.testing.assert_close(value.double(), to_go(cost, goal), rtol=tolerance, atol=0)


@pytest.mark.slow(2)
def test_nothing_waits_for_the_device():
    with FakeTensorMode():
        cost, goal = torch.ones(2, 9, 8), torch.ones(2, 9, 8, dtype=torch.bool)
        value = to_go(cost, goal)
        way = descend(value, cost, torch.zeros(2, 2, dtype=torch.int64), resolution=RESOLUTION, max_cells=7)
    assert value.shape == (2, 9, 8) and way.cells.shape == (2, 7, 2) and way.reached.shape == (2,)


# What is refused ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "cost, goal, options, error, text",
    [
        ([[1.0]], torch.ones(1, 1, 1) > 0, {}, TypeError, "cost: must be a torch.Tensor"),
        (torch.ones(1, 2, 2, dtype=torch.int64), torch.ones(1, 2, 2) > 0, {}, TypeError, "cost: must be floats"),
        (torch.ones(2, 2), torch.ones(2, 2) > 0, {}, ValueError, r"cost: expected \(B, H, W\), got \(2, 2\)"),
        (torch.ones(1, 2, 2), torch.ones(1, 2, 2), {}, TypeError, "goal: must be bool"),
        (torch.ones(1, 2, 2), torch.ones(1, 2, 3) > 0, {}, ValueError, r"goal: expected \(1, 2, 2\), got \(1, 2, 3\)"),
        (torch.ones(1, 2, 2), torch.ones(1, 2, 2) > 0, {"rounds": 0}, ValueError, "rounds: must be a positive int"),
        (torch.ones(1, 2, 2), torch.ones(1, 2, 2) > 0, {"resolution": 0.0}, ValueError, "resolution: must be a pos"),
    ],
)
def test_bad_maps_are_refused(cost, goal, options, error, text):
    with pytest.raises(error, match=text):
        cost_to_go(cost, goal, **{"resolution": RESOLUTION, **options})


def test_bad_starts_are_refused():
    cost, start = torch.ones(2, 3, 4), torch.zeros(2, 2, dtype=torch.int64)
    for value, begin, number, text in (
        (cost[:1], start, 5, r"value: expected \(2, 3, 4\)"),
        (cost, start[:1], 5, r"start: expected \(2, 2\)"),
        (cost, start + 3, 5, r"start: must lie in \[0, 3\)"),
        (cost, start, 0, "max_cells: must be a positive int"),
    ):
        with pytest.raises(ValueError, match=text):
            descend(value, cost, begin, resolution=RESOLUTION, max_cells=number)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision_is_added_up_in_float32(dtype):
    cost, goal = torch.ones(1, 60, 60, dtype=dtype), torch.zeros(1, 60, 60, dtype=torch.bool)
    goal[0, 59, 59] = True
    value = cost_to_go(cost, goal, resolution=0.1)
    assert value[0, 0, 0].item() == pytest.approx(5.9 * 2**0.5, rel=1e-5)
    assert descend(value, cost, torch.tensor([[0, 0]]), resolution=0.1, max_cells=99).length.item() == pytest.approx(
        5.9 * 2**0.5, rel=1e-5
    )


@pytest.mark.parametrize("bad", [math.nan, 0.0, -1.0])
def test_refuses_costs_that_are_not_positive(bad):
    cost = torch.ones(1, 4, 4)
    cost[0, 1, 1] = bad
    with pytest.raises(ValueError, match="cost: must be positive"):
        cost_to_go(cost, torch.ones(1, 4, 4, dtype=torch.bool), resolution=0.1)


def test_no_maps():
    empty = torch.ones(0, 4, 5)
    assert cost_to_go(empty, empty > 0, resolution=0.1).shape == (0, 4, 5)
