"""Rays by CUDA kernels: by a block for each map, or by launches over rays and cells; and which ends are accepted."""

import numpy as np
import pytest
import torch

from tests.helpers import random_clouds, random_poses, random_state, small_map
from tests.kernels.compare import assert_states_close, by_cuda, by_tensors, inputs_of, tensors_of
from tests.kernels.emulation.launcher import needs_emulation

pytestmark = needs_emulation


@pytest.mark.slow(2)
@pytest.mark.parametrize("seed", range(3))
def test_blocks_and_launches_agree(seed):
    rng = np.random.default_rng(seed)
    cells = 40, 30
    emap = small_map(2, cells)
    T = torch.stack([random_poses(rng, 2) for _ in range(2)], 1)
    points = torch.stack([random_clouds(rng, T[:, k], 500, cells=cells) for k in range(2)], 1)
    inputs = inputs_of(emap, points, T, None)
    state = random_state(rng, emap.cfg.grid, 2, 0.5, torch.float32)
    names = "clear_seen_through"
    blocks, launches = (by_cuda(emap, state, inputs, names, processors=number) for number in (1, 1000))
    assert blocks.statistics.cleared_seen_through.min() > 0
    for name, value in tensors_of(blocks).items():
        assert torch.equal(value, tensors_of(launches)[name]), name
    assert_states_close(blocks, by_tensors(emap, state, inputs, names), "rays")


@pytest.mark.parametrize("axis", range(2))
def test_ends_beside_supported_cells_and_near_borders(axis):
    """Every fourth row or column is supported, and half of the cells known; some rays leave the window."""
    emap = small_map(2, (40, 44))
    torch.manual_seed(axis)
    state = random_state(np.random.default_rng(0), emap.cfg.grid, 2, 1.0, torch.float32)
    state.elevation.normal_(0, 0.01), state.variance.fill_(1e-4), state.time.fill_(10.0), state.support.zero_()
    (state.support[:, ::4] if axis == 0 else state.support[:, :, ::4]).fill_(9.0)
    state.validity.copy_(torch.rand(state.validity.shape) < 0.5)
    directions = torch.rand(2, 1, 600) * 6.3
    reach = torch.rand(2, 1, 600) * 4
    points = torch.stack([reach * directions.cos(), reach * directions.sin(), torch.rand(2, 1, 600) * 0.3 - 1.1], -1)
    T = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1, 1)
    T[..., 2, 3] = 1.0
    inputs = inputs_of(emap, points, T, None)
    expected = by_tensors(emap, state, inputs, "clear_seen_through")
    assert_states_close(by_cuda(emap, state, inputs, "clear_seen_through"), expected, "rays", share=0.0)
