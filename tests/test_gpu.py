"""A GPU's host neither waits nor reads back; where there is a GPU: equal to the CPU, deterministic, and captured."""

import numpy as np
import pytest
import torch

from benchmarks.speed.completion import make_maps
from tests.devices import OneDevice
from tests.helpers import pose, random_poses, random_state, small_config, with_completion
from tests.robot_body.bodies import random_body
from tests.site.helpers import known_cells, robots
from torchelev import BodyConfig, CompletionNet, ElevationMap, HeightScan, MapImage, OverlapConfig, SensorConfig
from torchelev.completion.surroundings import count_steps
from torchelev.native import kernels
from torchelev.ops import operators
from torchelev.ops.moving import move_in_place
from torchelev.pipeline import rate
from torchelev.site import SiteMap
from torchelev.stages.fusion import on_gpu as fusion_on_gpu
from torchelev.stages.overlap.stage import clear_other_floors
from torchelev.state import map_layers

in_blocks = pytest.mark.parametrize("in_blocks", [False, True])  # by kernels whose blocks share memory


@pytest.fixture
def _kernels(monkeypatch, in_blocks):
    monkeypatch.setattr(kernels, "suits_blocks", lambda *_: in_blocks)


needs_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
OPERATORS = [
    operators._cell_sums,
    operators._padded,
    operators._running_minimum,
    operators.highest_per_cell,
    operators._lowest_per_cell,
    operators._polar_minimum,
    count_steps,
]


def forbid_reading(monkeypatch):
    """Make what reads or copies values raise: the operators' own code on "meta", and constants made on the host."""
    for operator in OPERATORS:
        monkeypatch.setattr(operator, "_abstract_fn", operator._init_fn)
    for constructor in ("tensor", "as_tensor", "from_numpy"):  # copies a constant, while the host waits
        monkeypatch.setattr(torch, constructor, None)


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


def test_links_are_not_read_back(monkeypatch):
    forbid_reading(monkeypatch)
    body = random_body(np.random.default_rng(0))
    emap = ElevationMap(small_config(sensor=SensorConfig(body=body)), 5, "meta")
    cloud, T = torch.empty(5, 2, 100, 3, device="meta"), torch.empty(5, 2, 4, 4, device="meta")
    links = torch.empty(5, len(body.links), 4, 4, device="meta")
    with OneDevice():
        emap.update(cloud, T, T[:, 0], 0.1, T_base_links=links)


SCAN = HeightScan.isaac_lab(length_x=1.0, length_y=0.5, resolution=0.1, fill="completed")
IMAGE = MapImage(length_x=0.8, length_y=0.8, layers=("completed", "completed_std"))


def completing_map(num_envs, device, **settings):
    parts = with_completion(**settings)
    net = parts.pop("completion_net")
    return ElevationMap(small_config((40, 40), 0.05, **parts), num_envs, device, completion_net=net)


@pytest.mark.parametrize("when", ["read", "update"])
def test_completion_copies_nothing_from_the_host(monkeypatch, when):
    emap = completing_map(5, "meta", when=when)
    read_completed(emap)  # a reader copies its pattern once
    forbid_reading(monkeypatch)
    monkeypatch.setattr(torch.Tensor, "new_tensor", None)
    read_completed(emap)


def test_completion_reads_no_values_back():
    read_completed(completing_map(5, "meta"))


def read_completed(emap):
    B, device = emap.num_envs, emap.device
    cloud, T = torch.empty(B, 100, 3, device=device), torch.empty(B, 4, 4, device=device)
    with OneDevice():
        emap.update(cloud, T, T, 0.1)
        assert emap.layer("completed").shape == emap.layer("completed_std", state=emap.state).shape == (B, 40, 40)
        emap.sample(torch.empty(B, 7, 2, device=device), "completed")
        assert SCAN(emap, T)[0].shape == (B, SCAN.num_points) and IMAGE(emap, T).shape == (B, 2, 16, 16)


def drive(emap, updates=4, seed=0):
    """Fuse a few random scans, made on the CPU so that every device gets the same."""
    generator = torch.Generator().manual_seed(seed)
    for k in range(updates):
        cloud = torch.rand(emap.num_envs, 300, 3, generator=generator) * torch.tensor([2.0, 2.0, 0.3]) - 1
        T = pose((0.05 * k, 0.0, 1.0), num_envs=emap.num_envs)
        emap.update(cloud.to(emap.device), T.to(emap.device), T.to(emap.device), 0.6)
    return emap


@needs_gpu
@in_blocks
@pytest.mark.usefixtures("_kernels")
@pytest.mark.parametrize("compiled, cells, maps", [(False, 40, 3), (False, 115, 3), (True, 40, 3), (True, 40, 64)])
def test_gpu_gives_the_same_map(compiled, cells, maps):
    """115 cells: more than 48 kB in a block; 64 maps move in place."""
    on_cpu, on_gpu = (ElevationMap(small_config((cells, cells), 0.05), maps, device) for device in ("cpu", "cuda"))
    if compiled:
        on_gpu.compile()
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
@in_blocks
@pytest.mark.usefixtures("_kernels")
@pytest.mark.parametrize("many", [0, 2**20])
def test_gpu_gives_the_same_map_where_cells_hold_many_points(monkeypatch, many):
    """A team of threads shares their points, or a warp."""
    monkeypatch.setattr(fusion_on_gpu, "_MANY_POINTS", many)
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
def test_other_floors_and_surfaces_equal_those_of_the_cpu():
    """On maps of two parts and many tiles."""
    cfg = small_config((70, 90), 0.05, overlap=OverlapConfig(radius=1.5, height=0.3, base_height=0.2))
    state = map_layers(single, random_state(np.random.default_rng(0), cfg.grid, 70, known=0.7))
    relief = torch.where(torch.arange(90) < 45, 0.1, 1.0)
    time = state.time * torch.from_numpy(np.random.default_rng(1).random(state.time.shape) < 0.5)
    state = state._replace(elevation=state.elevation * relief, time=time)
    emap, T = ElevationMap(cfg, 70), pose((0.0, 0.0, 0.2), num_envs=70)
    m = emap.measure(torch.full((70, 1, 3), torch.nan), T, T, 0.1)
    with torch.no_grad():
        on_cpu, on_gpu = (
            rate(clear_other_floors(*values, cfg.grid, cfg.overlap), cfg)
            for values in ((state, m), (map_layers(to_gpu, state), type(m)(*map(to_gpu, m))))
        )
    assert on_cpu.statistics.cleared_other_floors.min() > 100 and on_cpu.traversability.mean() > 0.1
    for name in ("validity", "bounded", "challenger_support", "has_normal", "rated"):
        assert (getattr(on_gpu, name).cpu() == getattr(on_cpu, name)).float().mean() > 0.9999, name
    for name in ("gradient_x", "gradient_y", "traversability"):
        difference = (getattr(on_gpu, name).cpu() - getattr(on_cpu, name)).abs()
        assert (difference < 1e-4).float().mean() > 0.9995, name


@needs_gpu
def test_layers_move_in_place():
    """By other steps in each map, in all directions, also out of it; maps have more cells than a block has threads."""
    rng = np.random.default_rng(0)
    shift = torch.from_numpy(rng.integers(-80, 80, (64, 2)) * (rng.random((64, 2)) < 0.8))
    layers = [torch.from_numpy(rng.random((64, 70, 90))).float() for _ in range(3)]
    layers += [layers[0] > 0.5, (100 * layers[1]).byte()]
    expected = [layer.clone() for layer in layers]
    moved = [layer.cuda() for layer in layers]
    move_in_place(expected, shift, [1.0, 0.0, -2.0, 0.0, 0.0])
    move_in_place(moved, shift.cuda(), [1.0, 0.0, -2.0, 0.0, 0.0])
    assert all(torch.equal(layer.cpu(), other) for layer, other in zip(moved, expected, strict=True))


def single(value):
    return value.float() if value.is_floating_point() else value


def to_gpu(value):
    return None if value is None else value.cuda()


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
@pytest.mark.parametrize("compiled", [False, True])
def test_captured_update_equals_plain(compiled):
    plain, captured = (ElevationMap(small_config((40, 40), 0.05), 3, "cuda") for _ in range(2))
    if compiled:
        captured.compile()
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
@pytest.mark.parametrize("when", ["read", "update"])
def test_captured_completion_equals_that_of_the_cpu(when):
    on_cpu, on_gpu = (drive(completing_map(3, device, when=when)) for device in ("cpu", "cuda"))
    cloud, T = torch.rand(3, 300, 3, device="cuda") - 0.5, pose(num_envs=3).cuda()
    graph = torch.cuda.CUDAGraph()
    on_gpu.layer("completed")  # before the capture, so that all is loaded
    with torch.cuda.graph(graph):
        on_gpu.update(cloud, T, T, 0.1)
        completed = on_gpu.layer("completed")
    graph.replay()
    on_cpu.load_state(on_gpu.state)
    torch.testing.assert_close(completed.cpu(), on_cpu.layer("completed"), atol=1e-4, rtol=0)


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


@needs_gpu
@pytest.mark.parametrize("maps, size", [(1, 250), (16, 64)])
def test_completion_compiles(maps, size):
    net = CompletionNet.from_pretrained().requires_grad_(False).cuda()
    layers = [layer.cuda() for layer in make_maps(maps, size)]
    expected, completed = (run(*layers, resolution=0.04) for run in (net, torch.compile(net)))
    for one, other in zip(expected, completed, strict=True):
        torch.testing.assert_close(one, other, atol=1e-4, rtol=0)
