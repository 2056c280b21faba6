"""A state goes into the buffers of a map, and comes back out of their names."""

import numpy as np
import pytest
import torch

from tests.helpers import differences, mapped, random_state, scan, small_map, snapshot
from torchelev import FilterConfig
from torchelev.maps.buffers import name_tensors, state_of, without_shared_memory


def test_tensors_by_name_are_the_buffers_and_make_the_state_again():
    emap = mapped()
    named = name_tensors(emap.state)
    assert named.keys() == dict(emap.named_buffers()).keys() - {"num_resets"}
    assert all(value is emap.get_buffer(name) for name, value in named.items())
    assert differences(state_of(named), emap.state) == []


def test_a_loaded_state_is_copied_and_goes_on_as_its_own_map():
    emap, other = mapped(), small_map(2)
    state = snapshot(emap)
    other.load_state(state)
    state.elevation.fill_(7.0)
    cloud, T = scan(9)
    for m in (emap, other):
        m.update(cloud, T, T, 0.1)
    assert differences(emap.state, other.state) == []


def test_values_are_converted_and_carry_no_gradient():
    emap, double = small_map(2), mapped().double()
    elevation = double.state.elevation.clone().requires_grad_()
    emap.load_state(double.state._replace(elevation=elevation))
    assert emap.elevation.dtype == torch.float32 and not emap.elevation.requires_grad
    torch.testing.assert_close(emap.elevation.double(), double.elevation)


def test_filtered_layers_and_the_diagnosis_are_those_of_the_new_state():
    emap = small_map(2, filters=(FilterConfig(layer="smooth", filter="box"),))
    T = torch.eye(4).repeat(2, 1, 1)
    emap.update(torch.full((2, 50, 3), torch.nan), T, dt=0.1)
    assert not emap.read_layer("smooth")[1].any() and emap.diagnose()
    emap.load_state(mapped().state)
    assert emap.read_layer("smooth")[1].any() and not emap.diagnose()


def test_a_checkpoint_keeps_the_elapsed_time_and_an_older_one_begins_at_zero():
    saved, emap = mapped().state_dict(), small_map(2)
    emap.load_state_dict(saved)
    assert emap.state.elapsed.tolist() == [2 * round(float(torch.tensor(0.3)) * 1e9)] * 2
    del saved["elapsed"]
    emap.load_state_dict(saved)
    assert emap.state.elapsed.tolist() == [0, 0] and emap.validity.any()


@pytest.mark.parametrize("num_envs, cells, name", [(3, (12, 10), "corner"), (2, (12, 11), "elevation")])
def test_refuses_a_state_of_another_size_and_changes_nothing(num_envs, cells, name):
    emap = mapped()
    before = snapshot(emap)
    with pytest.raises(ValueError, match=f"^state.{name}: expected .*; give a state of the same grid"):
        emap.load_state(small_map(num_envs, cells).state)
    assert differences(before, emap.state) == []


def test_a_shared_tensor_is_copied_alone():
    state = mapped().state
    new = state._replace(time=state.time + 1)
    fresh = without_shared_memory(new, (*state[:-1], *state.statistics, None))
    assert fresh.time is new.time and fresh.elevation is not state.elevation
    assert differences(fresh, new) == []


def test_a_rated_state_is_unrated_in_a_map_without_a_head():
    rated, unrated = small_map(2), small_map(2, traversability=None)
    unrated.load_state(random_state(np.random.default_rng(0), rated.cfg.grid, 2))
    assert unrated.layer("elevation").isfinite().any() and unrated.layer("traversability").isnan().all()
