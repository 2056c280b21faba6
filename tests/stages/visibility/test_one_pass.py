"""Rays over cells in one pass of C++, and by tensors: the same numbers."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tests.helpers import assert_close, differences, random_clouds, random_poses, random_state, small_map
from torchelev import RaycastConfig
from torchelev.compiled.update import with_masks
from torchelev.native.library import find_compiler
from torchelev.ops.storage import as_bytes, as_mask
from torchelev.stages.fast_layers import has_one_pass, layers_of, layers_to_change
from torchelev.stages.visibility import one_pass
from torchelev.stages.visibility.lowest_rays import RayBins, View
from torchelev.stages.visibility.polar_table import PolarGrid
from torchelev.stages.visibility.stage import apply_in_one_pass as apply_and_count
from torchelev.stages.visibility.stage import apply_rays, clear_seen_through
from torchelev.state import map_layers

RESOLUTION = 0.1
RULES = [RaycastConfig(min_time=0.5), RaycastConfig(min_time=0.0, min_incidence=0.6, gate=1e4, max_range=1.5)]


@pytest.fixture(autouse=True)
def _no_gradient():
    with torch.no_grad():
        yield


def rays_over(cells, rng, num_envs=1, num_rays=100, reach=1.0, place=0.5, cfg=RULES[0]):
    """What `apply_rays` takes: random layers, rays up to a share of the table's ranges, and a sensor so far off."""
    grid = small_map(1, cells, RESOLUTION).cfg.grid
    state, polar = random_state(rng, grid, num_envs, dtype=torch.float32), PolarGrid.of(grid, cfg)
    size = (num_envs, num_rays)
    last = rng.integers(0, max(1, int(reach * polar.ranges)), size)
    last = np.where(rng.random(size) < 0.8, last, polar.ranges)
    bins = [torch.from_numpy(k.astype(np.int32)) for k in (last, rng.integers(0, polar.azimuths, size))]
    rays = RayBins(*bins, torch.from_numpy(rng.normal(-0.3, 0.2, size)).float())
    sensor = torch.from_numpy(place * RESOLUTION * rng.uniform(-1, 1, (num_envs, 2)) * cells).float()
    x, y = ((torch.arange(n) + 0.5 - n / 2) * RESOLUTION - sensor[:, k, None] for k, n in enumerate(cells))
    z = torch.from_numpy(rng.uniform(0.2, 1.0, (num_envs, 1, 1))).float()
    return state, rays, View(x[:, :, None], y[:, None, :], z), polar, grid, cfg


def apply_in_one_pass(state, *others):
    """The state after; the number of cells cleared is right."""
    known = state.validity.clone()
    after, number = apply_and_count(state, *others)
    assert torch.equal(number, (known & ~after.validity).sum((1, 2)))
    return after


def agree(expected, after):
    """Masks and challengers are the same, and so are upper bounds but for rounding, those that do not count too."""
    assert not differences(expected, after, skip=["upper_bound"])
    torch.testing.assert_close(after.upper_bound, expected.upper_bound, atol=1e-6, rtol=1e-6)


@given(
    seed=st.integers(0, 10_000),
    num_envs=st.integers(1, 9),
    cells=st.tuples(st.integers(1, 50), st.integers(1, 50)),
    num_rays=st.integers(1, 300),
    reach=st.floats(0, 1),
    place=st.floats(0, 2),
    threads=st.integers(1, 2),
    cfg=st.sampled_from(RULES),
)
def test_both_agree(seed, num_envs, cells, num_rays, reach, place, threads, cfg):
    torch.set_num_threads(threads)
    inputs = rays_over(cells, np.random.default_rng(seed), num_envs, num_rays, reach, place, cfg)
    agree(apply_rays(*inputs), apply_in_one_pass(*inputs))


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("cells, num_rays", [((500, 600), 900), ((64, 48), 20_000)])
def test_both_agree_on_large_maps_and_many_rays(cells, num_rays, threads):
    """And the rays do all that they may. Ten times, as threads may share the work otherwise."""
    torch.set_num_threads(threads)
    state, *inputs = rays_over(cells, np.random.default_rng(0), 1, num_rays)
    expected = apply_rays(state, *inputs)
    for _ in range(10):
        after = apply_in_one_pass(state, *inputs)
        agree(expected, after)
    assert (state.validity & ~after.validity).any() and after.validity.any()
    assert (after.validity & (after.challenger_support < state.challenger_support)).any()
    assert (state.bounded & after.bounded & (after.upper_bound < state.upper_bound)).any()


def test_no_ray_leaves_what_is_known_and_bounds_of_what_is_not():
    state, rays, *others = rays_over((20, 33), np.random.default_rng(0))
    rays = rays._replace(range=torch.full_like(rays.range, others[1].ranges))
    after = apply_in_one_pass(state, rays, *others)
    agree(apply_rays(state, rays, *others), after)
    assert torch.equal(after.validity, state.validity) and torch.equal(after.upper_bound, state.upper_bound)
    assert torch.equal(after.bounded, state.bounded & ~state.validity)


def test_rays_without_number_change_nothing():
    state, rays, *others = rays_over((20, 33), np.random.default_rng(0))
    none = RayBins(*(value[:, :0] for value in rays))
    agree(apply_rays(state, none, *others), apply_in_one_pass(state, none, *others))


def test_an_infinite_gate():
    *inputs, cfg = rays_over((30, 40), np.random.default_rng(0))
    cfg = replace(cfg, gate=np.inf, min_incidence=0.9)
    agree(apply_rays(*inputs, cfg), apply_in_one_pass(*inputs, cfg))


@pytest.mark.parametrize("in_place", [False, True])
@pytest.mark.parametrize("with_native", [False, True])
def test_layers_change_where_they_are_stored(monkeypatch, with_native, in_place):
    """With and without C++; the others stay as they were."""
    state, *others = rays_over((12, 31), np.random.default_rng(1), 2)
    if not with_native:
        monkeypatch.setenv("TORCHELEV_NATIVE", "0")
    before, into = map_layers(torch.clone, state), with_masks(map_layers(torch.clone, state), as_bytes)
    after = apply_in_one_pass(with_masks(into, as_mask), *others, into if in_place else None)
    expected = apply_rays(state, *others)
    agree(expected, after)
    if in_place:
        agree(expected, with_masks(into, as_mask))
    else:
        assert not differences(before, with_masks(into, as_mask))


@pytest.mark.parametrize("num_sensors", [1, 3])
def test_the_stage_agrees_with_and_without_gradients(num_sensors):
    """With gradients it takes the tensors."""
    rng, emap = np.random.default_rng(0), small_map(2, (40, 30), RESOLUTION)
    T = torch.stack([random_poses(rng, 2) for _ in range(num_sensors)], 1)
    cloud = torch.stack([random_clouds(rng, T[:, k], 400, cells=(40, 30)) for k in range(num_sensors)], 1)
    state = random_state(rng, emap.cfg.grid, 2, dtype=torch.float32)
    m = emap.measure(cloud, T, None, 0.1)
    fast = clear_seen_through(state, m, emap.cfg.grid, RULES[0])
    assert has_one_pass(state)
    with torch.enable_grad():
        assert not has_one_pass(state)
        slow = clear_seen_through(state, m, emap.cfg.grid, RULES[0])
    assert_close(slow, fast)
    assert (fast.validity != state.validity).any()


def test_double_precision_and_other_devices_have_no_one_pass():
    state = rays_over((3, 4), np.random.default_rng(0))[0]
    assert has_one_pass(state)
    assert not has_one_pass(state._replace(elevation=state.elevation.double()))
    assert not has_one_pass(state._replace(elevation=state.elevation.to("meta")))


def test_it_is_registered_right():
    """Fake shapes, aliasing and compilation, as torch checks them."""
    state, rays, view, polar, grid, cfg = rays_over((6, 5), np.random.default_rng(0), 2)
    layers, changed = layers_of(state, one_pass.READ), layers_to_change(state, one_pass.CHANGED, None)
    settings = [grid.resolution, cfg.min_time, cfg.min_incidence, cfg.gate]
    sizes = polar.ranges, polar.azimuths, polar.bins, list(polar.widen)
    arguments = list(rays), list(view), layers, changed, *sizes, settings
    torch.library.opcheck(torch.ops.torchelev.apply_rays.default, arguments)


@pytest.mark.skipif(find_compiler() is None, reason="needs a C++ compiler")
@pytest.mark.parametrize("azimuth", [-1, 10_000])
@pytest.mark.parametrize("num_envs", [1, 9])
def test_an_azimuth_out_of_range_is_refused(azimuth, num_envs):
    state, rays, *others = rays_over((6, 5), np.random.default_rng(0), num_envs)
    rays = rays._replace(azimuth=torch.full_like(rays.azimuth, azimuth))
    with pytest.raises(IndexError, match="index"):
        apply_in_one_pass(state, rays, *others)
