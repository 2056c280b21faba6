"""Updates inside a `torch.compile` of the user's own."""

import copy
import pickle

import numpy as np
import pytest
import torch

from tests.helpers import pose, random_clouds, small_map
from tests.kernels.compare import assert_states_close


@pytest.fixture(autouse=True)
def _fresh_compiler():
    torch._dynamo.reset()
    yield
    torch._dynamo.reset()


@pytest.mark.slow(12)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_an_update_is_part_of_the_users_graph(dtype):
    """No graph break: by an operator where C++ runs, by tensors else."""
    T = pose(num_envs=2)
    cloud = random_clouds(np.random.default_rng(0), T, 300)
    eager, within = (small_map(2, dtype=dtype) for _ in range(2))

    def step(points, dt):
        within.update(2 * points - points, T, T, dt)
        return within.layer("elevation")

    compiled = torch.compile(step, fullgraph=True, backend="aot_eager")
    dt = torch.full((2,), 0.1)
    for _ in range(2):
        eager.update(cloud, T, T, dt)
        torch.testing.assert_close(compiled(cloud, dt), eager.layer("elevation"), equal_nan=True)
    assert_states_close(within.state, eager.state, "compiled")


@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda emap: pickle.loads(pickle.dumps(emap))])
def test_copies_update(duplicate):
    T, emap = pose(num_envs=2), small_map(2)
    cloud = random_clouds(np.random.default_rng(0), T, 300)
    emap.update(cloud, T, T, 0.1)
    other = duplicate(emap)
    for one in (emap, other):
        one.update(cloud, T, T, 0.1)
    assert_states_close(other.state, emap.state, "copy", 0, 0)
