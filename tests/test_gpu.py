"""A GPU's host neither waits nor reads back; where there is a GPU: equal to the CPU, deterministic, and captured."""

import numpy as np
import pytest
import torch

from tests.devices import OneDevice
from tests.helpers import pose, random_poses, small_config
from tests.robot_body.bodies import random_body
from tests.site.helpers import known_cells, robots
from torchelev import BodyConfig, ElevationMap, SensorConfig
from torchelev.site import SiteMap

needs_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")


def forbid_reading(monkeypatch):
    """Make what copies values raise: constants made on the host, for which it waits."""
    for constructor in ("tensor", "as_tensor", "from_numpy"):
        monkeypatch.setattr(torch, constructor, None)


@pytest.mark.slow(2)
def test_host_reads_nothing_back(monkeypatch):
    # Tensors on "meta" have no values, so that reading one raises; all but the CPU takes the GPU's paths.
    forbid_reading(monkeypatch)
    emap = ElevationMap(small_config(sensor=SensorConfig(body=BodyConfig())), 5, "meta")
    cloud, T = torch.empty(5, 2, 100, 3, device="meta"), torch.empty(5, 2, 4, 4, device="meta")
    with OneDevice():
        emap.update(cloud, T, T[:, 0], 0.1)
        emap.update(cloud, T, T[:, 0], torch.empty(5, device="meta"), variance=cloud[..., 0])
        emap.update(cloud[:, :, :0], T, T[:, 0], 0.1)
        emap.sample(torch.empty(5, 7, 2, device="meta"), "upper_bound")
        emap.layer("normal_z")
        emap.initialize(torch.empty(5, 4, 3, device="meta"))
        emap.reset(mask=torch.empty(5, device="meta", dtype=torch.bool))
        emap.reset(torch.empty(3, device="meta", dtype=torch.int64))
        emap.reset()


@pytest.mark.slow(1)
def test_links_are_not_read_back(monkeypatch):
    forbid_reading(monkeypatch)
    body = random_body(np.random.default_rng(0))
    emap = ElevationMap(small_config(sensor=SensorConfig(body=body)), 5, "meta")
    cloud, T = torch.empty(5, 2, 100, 3, device="meta"), torch.empty(5, 2, 4, 4, device="meta")
    links = torch.empty(5, len(body.links), 4, 4, device="meta")
    with OneDevice():
        emap.update(cloud, T, T[:, 0], 0.1, T_base_links=links)


def drive(emap, updates=4, seed=0):
    """Fuse a few random scans, made on the CPU so that every device gets the same."""
    generator = torch.Generator().manual_seed(seed)
    for k in range(updates):
        cloud = torch.rand(emap.num_envs, 300, 3, generator=generator) * torch.tensor([2.0, 2.0, 0.3]) - 1
        T = pose((0.05 * k, 0.0, 1.0), num_envs=emap.num_envs)
        emap.update(cloud.to(emap.device), T.to(emap.device), T.to(emap.device), 0.6)
    return emap


@needs_gpu
@pytest.mark.parametrize("native", ["0", "1"])
@pytest.mark.parametrize("cells, maps", [(40, 3), (115, 3), (40, 64)])
def test_gpu_gives_the_same_map(monkeypatch, native, cells, maps):
    """By tensors and by kernels."""
    monkeypatch.setenv("TORCHELEV_NATIVE", native)
    on_cpu, on_gpu = (ElevationMap(small_config((cells, cells), 0.05), maps, device) for device in ("cpu", "cuda"))
    assert on_gpu.backend.name == ("CUDA" if native == "1" else "TORCH"), on_gpu.backend
    drive(on_cpu), drive(on_gpu)
    assert (on_gpu.validity.cpu() == on_cpu.validity).float().mean() > 0.999
    both = on_gpu.validity.cpu() & on_cpu.validity
    difference = (on_gpu.elevation.cpu() - on_cpu.elevation)[both].abs()
    assert difference.median() < 1e-6 and difference.quantile(0.999) < 1e-4
    for name in ("bounded", "has_normal", "rated", "challenger_support"):
        assert (getattr(on_gpu.state, name).cpu() == getattr(on_cpu.state, name)).float().mean() > 0.998, name
    for name in ("gradient_x", "gradient_y", "traversability"):
        difference = (getattr(on_gpu.state, name).cpu() - getattr(on_cpu.state, name)).abs()
        assert difference.median() < 1e-5 and difference.quantile(0.99) < 1e-3, name


@needs_gpu
def test_gpu_gives_the_same_map_where_cells_hold_many_points():
    on_cpu, on_gpu = (ElevationMap(small_config((20, 20), 0.05), 3, device) for device in ("cpu", "cuda"))
    generator = torch.Generator().manual_seed(0)
    for _ in range(3):
        cloud = torch.rand(3, 20_000, 3, generator=generator) - torch.tensor([0.5, 0.5, 1.0])
        cloud[..., 2] = -0.9 + 0.3 * (cloud[..., 0] > 0.13) + 0.01 * torch.randn(3, 20_000, generator=generator)
        for emap in (on_cpu, on_gpu):
            T = pose((0.0, 0.0, 1.0), num_envs=3).to(emap.device)
            emap.update(cloud.to(emap.device), T, T, 0.1)
    assert torch.equal(on_gpu.validity.cpu(), on_cpu.validity)
    assert (on_gpu.elevation.cpu() - on_cpu.elevation).abs().quantile(0.99) < 1e-4


@needs_gpu
def test_gpu_repeats_to_the_bit_when_told_to():
    torch.use_deterministic_algorithms(True)
    try:
        first, second = (drive(ElevationMap(small_config((40, 40), 0.05), 3, "cuda")) for _ in range(2))
    finally:
        torch.use_deterministic_algorithms(False)
    for name, value in first.state_dict().items():
        if isinstance(value, torch.Tensor):
            assert torch.equal(value, second.state_dict()[name]), name


@needs_gpu
def test_host_never_waits():
    emap = drive(ElevationMap(small_config(), 3, "cuda"))
    cloud, T = torch.rand(3, 50, 3, device="cuda"), pose(num_envs=3).cuda()
    torch.cuda.set_sync_debug_mode("error")
    try:
        emap.update(cloud, T, T, 0.1)
        emap.sample(cloud[..., :2])
        emap.reset(mask=torch.ones(3, dtype=torch.bool, device="cuda"))
    finally:
        torch.cuda.set_sync_debug_mode("default")


@needs_gpu
def test_captured_update_equals_plain():
    plain, captured = (ElevationMap(small_config((40, 40), 0.05), 3, "cuda") for _ in range(2))
    cloud, T = torch.rand(3, 300, 3, device="cuda") - 0.5, pose(num_envs=3).cuda()
    drive(captured)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        captured.update(cloud, T, T, 0.1)
    captured.reset()
    for seed in range(3):
        cloud.copy_(torch.rand(cloud.shape, generator=torch.Generator().manual_seed(seed)) - 0.5)
        T.copy_(random_poses(np.random.default_rng(seed), 3))
        graph.replay()
        plain.update(cloud, T, T, 0.1)
    both = plain.validity & captured.validity
    assert (plain.validity == captured.validity).float().mean() > 0.999
    assert (plain.elevation - captured.elevation)[both].abs().quantile(0.999) < 1e-4


@needs_gpu
@pytest.mark.parametrize("device", ["cpu", "cuda"])
def test_a_site_takes_maps_of_a_gpu_and_gives_back(device):
    maps = [robots([(0, 0), (20, 10)], offsets=[0.1, -0.1], noise=0.003) for _ in range(2)]
    sites = SiteMap(0.1), SiteMap(0.1, device=device)
    reports = [site.merge(emap) for site, emap in zip(sites, (maps[0], maps[1].cuda()), strict=True)]
    torch.testing.assert_close(reports[0].offsets, reports[1].offsets.cpu(), atol=1e-5, rtol=0.0)
    a, b = (known_cells(site) for site in sites)
    assert a == pytest.approx(b, abs=1e-5)
    newcomer = ElevationMap(small_config((20, 20)), 1, "cuda")
    newcomer.initialize_from(sites[1], pose((2.0, 2.0, 0.5)).cuda())
    assert newcomer.state.validity.any()
