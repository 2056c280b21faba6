"""Rays on several threads of one map."""

import numpy as np
import torch

from tests.helpers import random_clouds, random_poses, random_state, small_map
from tests.kernels.compare import by_cpu, inputs_of, require_cpu_backend, tensors_of


def test_threads_change_no_bit():
    rng = np.random.default_rng(0)
    cells = 200, 200
    emap = require_cpu_backend(small_map(1, cells))
    T = random_poses(rng, 1)
    inputs = inputs_of(emap, random_clouds(rng, T, 20_000, cells=cells)[:, None], T[:, None], None)
    state = random_state(rng, emap.cfg.grid, 1, 0.5, torch.float32)
    results = []
    for threads in (1, 2, 3):
        torch.set_num_threads(threads)
        results.append(tensors_of(by_cpu(emap, state, inputs, "clear_seen_through", "count_bounded")))
    assert results[0]["cells_bounded"] > 1000
    for other in results[1:]:
        assert all(torch.equal(other[name], value) for name, value in results[0].items())
