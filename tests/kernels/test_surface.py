"""Normals and ratings by C++ and CUDA against tensors: windows of all widths, and cells that are no longer known."""

import numpy as np
import pytest
import torch

import torchelev as te
from tests.helpers import random_state, small_map
from tests.kernels.compare import BACKENDS, assert_states_close, by_tensors, clone, inputs_of, require_cpu_backend
from torchelev.stages.surface.kernel import settings
from torchelev.state import map_layers


def rated_by(run, emap, state):
    """The state after `rate_surface`, by tensors of float64 and by other means."""
    T = torch.eye(4, dtype=torch.float64).repeat(emap.num_envs, 1, 1)
    inputs = inputs_of(emap, torch.zeros(emap.num_envs, 1, 3), T, T)
    exact = map_layers(lambda values: values.double() if values.is_floating_point() else values, state)
    return by_tensors(emap, exact, inputs, "rate_surface"), run(emap, state, inputs, "rate_surface")


@pytest.mark.slow(1)
@pytest.mark.parametrize("run", BACKENDS)
def test_forgotten_cells(run):
    """Cells that are no longer known lose normal and rating, in rows without any known cell too."""
    emap = require_cpu_backend(small_map(1, (20, 20)))
    state = clone(emap.state)
    state.validity.fill_(True)
    _, state = rated_by(run, emap, state)
    assert state.has_normal.all() and state.rated.all()
    state.validity[:, 4:] = False
    expected, actual = rated_by(run, emap, state)
    assert not expected.has_normal[:, 4:].any()
    assert_states_close(actual, expected, "forgotten")


@pytest.mark.slow(1)
@pytest.mark.parametrize("run", BACKENDS)
@pytest.mark.parametrize("radius, head", [(1, None), (1, 0.05), (1, 0.1), (2, 0.1), (4, 0.05), (2, 0.25), (44, 0.05)])
def test_windows_of_all_widths(run, radius, head):
    head = None if head is None else te.TraversabilityConfig(radius=head)
    stages = dict(surface=te.SurfaceConfig(radius=radius), traversability=head)
    emap = require_cpu_backend(small_map(2, (40, 41), resolution=0.05, **stages))
    assert (settings(emap.cfg)["tile_memory"] == 0) == (radius == 44)  # too wide for what a GPU's threads share
    state = random_state(np.random.default_rng(radius), emap.cfg.grid, 2, 0.9, torch.float32)
    state.elevation.mul_(0.1).add_(0.3 * emap.cell_centers().float().sin().sum(-1))  # hills
    expected, actual = rated_by(run, emap, state)
    assert expected.has_normal.any() and (head is None or expected.traversability.max() > 0)
    assert_states_close(actual, expected, f"{radius} cells", 1e-5)
