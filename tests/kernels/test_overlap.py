"""Overlap clearance by C++ and CUDA against tensors, where the ground is seen anew, or no base is known."""

import math

import pytest
import torch

import torchelev as te
from tests.helpers import pose, small_map
from tests.kernels.compare import BACKENDS, assert_states_close, by_tensors, clone, inputs_of, require_cpu_backend


def bridge_map():
    """A map of known ground, in whose second environment a scan hits something above it."""
    overlap = te.OverlapConfig(radius=0.8, height=0.3, base_height=0.0)
    emap = require_cpu_backend(small_map(2, (20, 20), overlap=overlap))
    state = clone(emap.state)
    state.validity.fill_(True), state.elevation.fill_(-0.8), state.time.fill_(1.0)
    state.elevation[1, 8:10, 8:12], state.time[1, 8:10, 8:12] = -0.1, 0.0
    return emap, state


@pytest.mark.slow(4)
@pytest.mark.parametrize("run", BACKENDS)
@pytest.mark.parametrize("place", [(0.0, 0.0), (0.13, -0.09), (-100_000.03, 70_000.12)])
def test_bridge_over_known_ground(run, place):
    """What the scan hits above the known ground is what the robot stands on; the ground below is another floor."""
    emap, state = bridge_map()
    state.corner.add_(torch.tensor([round(x) * 10 for x in place]))
    T = pose((*place, 0.0), num_envs=2)
    inputs = inputs_of(emap, torch.zeros(2, 1, 3), T, T)
    expected = by_tensors(emap, state, inputs, "clear_other_floors")
    cleared = expected.statistics.cleared_other_floors.tolist()
    assert cleared[0] == 0 and cleared[1] == pytest.approx(math.pi * 8**2 - 8, rel=0.1)  # less those hit
    assert_states_close(run(emap, state, inputs, "clear_other_floors"), expected, "bridge", 0, 0)


@pytest.mark.parametrize("run", BACKENDS)
@pytest.mark.parametrize("base", ["none", "unsound"])
def test_without_a_sound_base_nothing_is_cleared(run, base):
    emap, state = bridge_map()
    state.statistics.cleared_other_floors.fill_(7)
    T = pose((0.0, 0.0, 0.0), num_envs=2)
    inputs = inputs_of(emap, torch.zeros(2, 1, 3), T, None if base == "none" else T)
    if base == "unsound":  # as inputs may be that a compiled graph computes
        inputs = inputs._replace(T_map_base=T.index_fill(0, torch.tensor([1]), torch.nan))
    expected = by_tensors(emap, state, inputs, "clear_other_floors")
    assert expected.validity.all()
    assert expected.statistics.cleared_other_floors.tolist() == ([7, 7] if base == "none" else [0, 0])
    assert_states_close(run(emap, state, inputs, "clear_other_floors"), expected, base, 0, 0)
