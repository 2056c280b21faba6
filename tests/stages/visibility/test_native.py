"""The visibility clean-up in C++ against the same with tensors."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from torchelev import ElevationMap, ElevationMapConfig, GridConfig
from torchelev.frames import transform
from torchelev.native.library import find_compiler
from torchelev.stages.visibility import native
from torchelev.stages.visibility.config import RaycastConfig

pytestmark = pytest.mark.skipif(find_compiler() is None, reason="needs a C++ compiler")


def drive(use_native, seed, num_envs, length_x, length_y, sensors, threads, cfg=None):
    """Return the state after four scans of rough ground, with walls that come and go, long returns and lost points."""
    generator = torch.Generator().manual_seed(seed)
    grid = GridConfig(resolution=0.1, length_x=length_x, length_y=length_y)
    emap = ElevationMap(ElevationMapConfig(grid=grid, raycast=cfg or RaycastConfig()), num_envs)
    torch.set_num_threads(threads)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TORCHELEV_NATIVE", str(int(use_native)))
        for k in range(4):
            shape = num_envs, sensors, 700
            turn, r = (
                2 * math.pi * torch.rand(shape, generator=generator),
                0.3 + 3 * torch.rand(shape, generator=generator),
            )
            z = -0.8 + 0.05 * torch.randn(shape, generator=generator)
            z = torch.where((turn < 1) & (r > 1), z + (k % 2), z) - 0.5 * (
                torch.rand(shape, generator=generator) < 0.05
            )
            points = torch.stack([r * turn.cos(), r * turn.sin(), z], -1)
            points[torch.rand(shape, generator=generator) < 0.05] = torch.nan
            at = 0.3 * torch.rand(num_envs, 3, generator=generator) + torch.tensor([0.2 * k, -0.1 * k, 0.8])
            T_map_base = transform(at, torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(num_envs, 4))
            T_map_sensor = T_map_base[:, None].repeat(1, sensors, 1, 1)
            T_map_sensor[..., :3, 3] += 0.2 * torch.rand(num_envs, sensors, 3, generator=generator)
            emap.update(points, T_map_sensor, T_map_base, dt=0.6)
    return emap.state


@given(
    seed=st.integers(0, 2**16),
    num_envs=st.integers(1, 3),
    length_x=st.sampled_from([1.0, 2.3, 4.0]),
    length_y=st.sampled_from([0.7, 4.1]),
    sensors=st.integers(1, 2),
    threads=st.integers(1, 3),
)
def test_maps_equal_those_of_the_tensors(seed, num_envs, length_x, length_y, sensors, threads):
    sizes = seed, num_envs, length_x, length_y, sensors, threads
    fast, slow = drive(True, *sizes), drive(False, *sizes)
    for name in ("elevation", "variance", "validity", "support", "challenger_support", "bounded"):
        assert torch.equal(getattr(fast, name), getattr(slow, name)), name
    torch.testing.assert_close(fast.upper_bound, slow.upper_bound, rtol=0, atol=2e-6)
    assert torch.equal(fast.statistics.cleared_seen_through, slow.statistics.cleared_seen_through)


def test_the_drive_clears_and_bounds():
    """Or the comparison above would say nothing."""
    state = drive(True, 0, 2, 4.0, 4.1, 1, 1)
    assert int(state.statistics.cleared_seen_through.sum()) > 0 and int(state.bounded.sum()) > 100


@pytest.mark.parametrize("cfg", [RaycastConfig(max_range=1.5, gate=1e9), RaycastConfig(min_time=0.0, min_support=0.0)])
def test_all_settings_count(cfg):
    fast, slow = (drive(use_native, 1, 1, 4.0, 4.1, 1, 2, cfg) for use_native in (True, False))
    assert torch.equal(fast.validity, slow.validity) and torch.equal(fast.bounded, slow.bounded)


def test_gradients_and_doubles_are_left_to_the_tensors():
    emap = ElevationMap(ElevationMapConfig(grid=GridConfig(resolution=0.1, length_x=1.0, length_y=1.0)))
    points, pose = torch.rand(1, 5, 3), torch.eye(4)[None]
    assert native.can_run(emap.state, emap.measure(points, pose, dt=0.1))
    assert not native.can_run(emap.state, emap.measure(points.requires_grad_(True), pose, dt=0.1))
    double = emap.state._replace(elevation=emap.state.elevation.double())
    assert not native.can_run(double, emap.measure(points.detach(), pose, dt=0.1))
