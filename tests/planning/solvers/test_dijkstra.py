"""The cost to go and the descent in C++ against the same with tensors."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tests.planning.test_cost_to_go import RESOLUTION, random_case
from torchelev.kernels.cpu_build import find_compiler
from torchelev.planning.cost_to_go import cost_to_go, descend
from torchelev.planning.solvers import dijkstra

pytestmark = pytest.mark.skipif(find_compiler() is None, reason="needs a C++ compiler")
DTYPES = torch.float32, torch.float64


def by_tensors(function, *args, **options):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TORCHELEV_NATIVE", "0")
        return function(*args, resolution=RESOLUTION, **options)


@given(
    seed=st.integers(0, 10_000),
    walls=st.sampled_from([0.0, 0.3, 0.5]),
    dtype=st.sampled_from(DTYPES),
    even=st.booleans(),
    num_envs=st.integers(0, 3),
)
def test_costs_and_paths_equal_those_of_the_tensors(seed, walls, dtype, even, num_envs):
    """To the last bit; and of paths that cost the same, which even ground is full of, the same one."""
    cost, goal = random_case(seed, num_envs, walls, dtype)
    cost = torch.where(cost.isfinite(), 1.0, cost) if even else cost
    H, W = cost.shape[1:]
    value = dijkstra.find_costs(cost, goal, RESOLUTION)
    assert value.dtype == dtype and torch.equal(value, by_tensors(cost_to_go, cost, goal))
    start = torch.tensor([[seed % H, seed % W]]).repeat(num_envs, 1)
    assert dijkstra.follow(value, cost, start[:, :1] * W + start[:, 1:], RESOLUTION, 30) is not None
    path = descend(value, cost, start, resolution=RESOLUTION, max_cells=30)
    expected = by_tensors(descend, value, cost, start, max_cells=30)
    assert all(torch.equal(actual, same) for actual, same in zip(path, expected, strict=True))


def test_layers_may_be_views():
    cost, goal = random_case(5)
    turned = dijkstra.find_costs(cost.mT, goal.mT, RESOLUTION)
    assert torch.equal(turned.mT.contiguous(), dijkstra.find_costs(cost, goal, RESOLUTION))
    first = torch.zeros(2, 1, dtype=torch.int64)
    assert torch.equal(
        dijkstra.follow(turned.mT, cost, first, RESOLUTION, 9),
        dijkstra.follow(turned.mT.contiguous(), cost, first, RESOLUTION, 9),
    )


def test_rounds_are_left_to_the_tensors():
    """A given number of rounds is a bound, which the algorithm in C++ knows none of."""
    cost, goal = torch.ones(1, 9, 9), torch.zeros(1, 9, 9, dtype=torch.bool)
    cost[0, 1::4, :-1] = cost[0, 3::4, 1:] = torch.inf
    goal[0, 8, 0] = True
    assert cost_to_go(cost, goal, resolution=RESOLUTION)[0, 0, 0].isfinite()
    assert cost_to_go(cost, goal, resolution=RESOLUTION, rounds=1)[0, 0, 0].isinf()


def test_what_is_not_of_one_dtype_is_left_to_the_tensors():
    cost, goal = random_case(7, dtype=torch.float32)
    first = torch.zeros(2, 1, dtype=torch.int64)
    assert dijkstra.follow(cost, cost, first, RESOLUTION, 5) is not None
    assert dijkstra.follow(cost.double(), cost, first, RESOLUTION, 5) is None
    assert dijkstra.follow(cost, cost, first.int(), RESOLUTION, 5) is None
    assert dijkstra.find_costs(cost.half(), goal, RESOLUTION) is None


def test_a_cell_outside_the_map_is_refused():
    with pytest.raises(IndexError, match="out of range"):
        dijkstra.follow(torch.ones(1, 3, 4), torch.ones(1, 3, 4), torch.tensor([[12]]), RESOLUTION, 5)
