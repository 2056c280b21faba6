"""Overlap clearance by C++ against tensors, where the ground is seen anew."""

import torch

import torchelev as te
from tests.helpers import small_map
from tests.kernels.compare import assert_states_close, by_cpu, by_tensors, clone, inputs_of, require_cpu_backend


def test_bridge_over_known_ground():
    """What the scan hits above the known ground is what the robot stands on; the ground below is another floor."""
    emap = require_cpu_backend(small_map(2, (20, 20), overlap=te.OverlapConfig(height=0.3, base_height=0.0)))
    state = clone(emap.state)
    state.validity.fill_(True), state.elevation.fill_(-0.8), state.time.fill_(1.0)
    state.elevation[1, 8:10, 8:12], state.time[1, 8:10, 8:12] = -0.1, 0.0  # in one of the maps
    T = torch.eye(4, dtype=torch.float64).repeat(2, 1, 1)
    inputs = inputs_of(emap, torch.zeros(2, 1, 3), T, T)
    expected = by_tensors(emap, state, inputs, "clear_other_floors")
    assert expected.statistics.cleared_other_floors.tolist() == [0, 392]
    assert_states_close(by_cpu(emap, state, inputs, "clear_other_floors"), expected, "bridge")
