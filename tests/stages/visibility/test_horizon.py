"""How steeply rays may fall, by marching along azimuths in C++ and by tensors over the whole window: the same."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tests.helpers import random_clouds, random_poses, random_state, small_map
from torchelev import RaycastConfig
from torchelev.stages.visibility import horizon as stage
from torchelev.stages.visibility.horizon import NO_FALL, SeenRays, directions, horizon, limits_by_tensors
from torchelev.stages.visibility.polar_table import PolarGrid
from torchelev.stages.visibility.rays import sensor_rays

CFG = RaycastConfig(min_time=0.5)
NO_MARGIN = replace(CFG, gate=1e-30)  # too small to change a height


@pytest.fixture(autouse=True)
def _no_gradient():
    with torch.no_grad():
        yield


def seen_by(cells, rng, num_envs=1, num_rays=100, reach=1.0, place=0.5, cfg=CFG, resolution=0.1, known=0.6):
    """What the twin takes: random maps, rays as long as `reach` windows on average, and sensors so far off centre."""
    grid = small_map(1, cells, resolution).cfg.grid
    state, polar = random_state(rng, grid, num_envs, known, dtype=torch.float32), PolarGrid.of(grid, cfg)
    size, length = (num_envs, num_rays), np.array(cells) * resolution
    offset = np.round(rng.uniform(-1, 2, (num_envs, 2)) * cells) * resolution
    sensor = length / 2 + place * length * rng.uniform(-1, 1, (num_envs, 2)) - offset
    origin = np.column_stack([sensor, rng.uniform(0.2, 1.0, num_envs)])
    r, azimuth = rng.exponential(reach * length.max(), size), rng.integers(0, 1001, size) / 1000
    rays = SeenRays(*(torch.from_numpy(value).float() for value in (r, azimuth, origin, offset)))
    return state, rays, directions(polar.azimuths // 2, rays.r), 8 * (polar.ranges // 16 + 1), grid, cfg


def operands(state, rays, ways, ranges, grid, cfg):
    layers = [state.elevation, state.variance, state.time, state.validity.view(torch.uint8)]
    return list(rays), layers, list(ways), ranges, [grid.resolution, cfg.gate, cfg.min_time]


def marched(*inputs):
    return torch.ops.torchelev.horizon(*operands(*inputs))


@given(
    seed=st.integers(0, 10_000),
    num_envs=st.integers(1, 5),
    cells=st.tuples(st.integers(1, 50), st.integers(1, 50)),
    num_rays=st.integers(0, 300),
    reach=st.floats(0, 3),
    place=st.floats(0, 2),
    known=st.sampled_from([0.0, 0.1, 0.6]),
    threads=st.integers(1, 2),
    resolution=st.sampled_from([0.1, 0.04]),
    cfg=st.sampled_from([NO_MARGIN, CFG, replace(CFG, gate=np.inf), replace(CFG, max_range=1.5)]),
)
def test_both_agree(seed, num_envs, cells, num_rays, reach, place, known, threads, resolution, cfg):
    """They meet the same cells, whose heights they take to the bit; roots may be rounded otherwise."""
    torch.set_num_threads(threads)
    rng = np.random.default_rng(seed)
    inputs = seen_by(cells, rng, num_envs, num_rays, reach, place, cfg, resolution, known)
    tolerance = 0 if cfg is NO_MARGIN else 1e-6
    torch.testing.assert_close(marched(*inputs), limits_by_tensors(*inputs), atol=tolerance, rtol=tolerance)


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize(
    "cells, num_rays, reach", [((500, 600), 20_000, 0.1), ((501, 611), 20_000, 0.5), ((64, 48), 20_000, 0.5)]
)
def test_both_agree_on_large_maps_and_many_rays(cells, num_rays, reach, threads):
    """Several threads take rays or cells, or rays outnumber the bins. Ten times: threads share differently."""
    torch.set_num_threads(threads)
    inputs = seen_by(cells, np.random.default_rng(0), 1, num_rays, reach, cfg=NO_MARGIN)
    expected = limits_by_tensors(*inputs)
    assert all(torch.equal(marched(*inputs), expected) for _ in range(10))
    assert ((expected < 10) & (expected > -10)).float().mean() > 0.2  # of ground, not of NO_FALL


def test_rays_that_end_nearby_may_fall_as_they_like():
    inputs = seen_by((20, 33), np.random.default_rng(0), reach=0.0)
    assert torch.equal(marched(*inputs), torch.full((1, 100), NO_FALL))


def test_azimuths_of_a_full_turn_and_endless_rays_have_a_bin():
    state, rays, *others = seen_by((20, 33), np.random.default_rng(0), cfg=NO_MARGIN)
    rays = rays._replace(r=torch.full_like(rays.r, torch.inf), azimuth=torch.ones_like(rays.azimuth))
    assert torch.equal(marched(state, rays, *others), limits_by_tensors(state, rays, *others))


def test_without_cpp_tensors_do_it(monkeypatch):
    inputs = seen_by((12, 31), np.random.default_rng(1), 2)
    monkeypatch.setenv("TORCHELEV_NATIVE", "0")
    assert torch.equal(marched(*inputs), limits_by_tensors(*inputs))


@pytest.mark.parametrize("num_sensors", [1, 3])
def test_gradients_and_double_precision_take_the_tensors(num_sensors, monkeypatch):
    rng, emap = np.random.default_rng(0), small_map(2, (40, 30))
    T = torch.stack([random_poses(rng, 2) for _ in range(num_sensors)], 1)
    cloud = torch.stack([random_clouds(rng, T[:, k], 400, cells=(40, 30)) for k in range(num_sensors)], 1)
    grid, m = emap.cfg.grid, emap.measure(cloud, T, None, 0.1)
    state = random_state(rng, grid, 2, dtype=torch.float32)
    rays = sensor_rays(m, num_sensors - 1)
    fast = horizon(state, m, rays, grid, CFG)
    monkeypatch.setattr(stage, "_horizon", None)
    with torch.enable_grad():
        torch.testing.assert_close(horizon(state, m, rays, grid, CFG), fast, atol=1e-6, rtol=1e-6)
    assert horizon(state._replace(elevation=state.elevation.double()), m, rays, grid, CFG).shape == fast.shape
    assert (fast < NO_FALL).any()


def test_it_takes_float32_whatever_the_default():
    inputs = seen_by((20, 20), np.random.default_rng(0))
    torch.set_default_dtype(torch.float64)
    try:
        got = marched(*inputs)
    finally:
        torch.set_default_dtype(torch.float32)
    torch.testing.assert_close(got, limits_by_tensors(*inputs), atol=1e-6, rtol=1e-6)


def test_it_is_registered_right():
    """Fake shapes, aliasing and compilation, as torch checks them."""
    inputs = seen_by((6, 5), np.random.default_rng(0), 2)
    torch.library.opcheck(torch.ops.torchelev.horizon.default, operands(*inputs))
