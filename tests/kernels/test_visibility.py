"""Rays in C++: on several threads of one map, and of cameras, which see a part of it."""

import numpy as np
import pytest
import torch

from tests.helpers import random_clouds, random_poses, random_state, small_map
from tests.kernels.compare import assert_states_close, by_cpu, by_tensors, inputs_of, require_cpu_backend, tensors_of


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


def narrow_view(rng, cells, resolution, width):
    """A scan (1, N, 3) of a camera over the map's origin, whose rays lie within `width` [rad]."""
    azimuth = rng.uniform(-np.pi, np.pi) + width * rng.random(60)
    reach = 0.8 * resolution * max(cells) * rng.random(60)
    points = [reach * np.cos(azimuth), reach * np.sin(azimuth), -0.9 + 0.3 * rng.standard_normal(60)]
    return torch.from_numpy(np.stack(points, -1)).float()[None]


@pytest.mark.slow(1)
@pytest.mark.parametrize("resolution", [0.04, 0.25])
@pytest.mark.parametrize("width", [0.0, 0.05, 0.5, 1.5])
def test_a_narrow_view_changes_what_the_definition_changes(width, resolution):
    """C++ looks at the cells in the box of the rays and a little beyond: those that the table widens rays to."""
    for seed in range(10):
        rng = np.random.default_rng(seed)
        cells = tuple(int(size) for size in rng.integers(20, 90, 2))
        emap = require_cpu_backend(small_map(1, cells, resolution=resolution))
        state = random_state(rng, emap.cfg.grid, 1, 0.3, torch.float32)
        T = random_poses(rng, 1)
        T[:, :3, :3], T[:, 2, 3] = torch.eye(3), 0.9
        inputs = inputs_of(emap, narrow_view(rng, cells, resolution, width), T, None)
        expected = by_tensors(emap, state, inputs, "clear_seen_through")
        assert (expected.bounded & ~state.bounded).any()
        assert_states_close(by_cpu(emap, state, inputs, "clear_seen_through"), expected, f"seed {seed}", 1e-5, 0)
