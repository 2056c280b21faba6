"""The update in C++ and by CUDA kernels: the same as by tensors."""

from unittest.mock import patch

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tests.helpers import random_poses, random_state, small_map
from tests.native.emulated_gpu import emulated_kernels, needs_compiler
from tests.stages.fusion.test_fuse import CELLS, EDGES, FUSED, steps_and_outliers
from torchelev import EdgeConfig, FusionConfig
from torchelev.compiled.update import with_masks
from torchelev.native.library import find_compiler
from torchelev.ops.storage import as_bytes, as_mask
from torchelev.stages.cells import cells_of
from torchelev.stages.fusion import fuse as stage
from torchelev.stages.fusion import on_gpu
from torchelev.stages.fusion.native import can_update_in_cpp, config_of, numbers
from torchelev.stages.fusion.points import CellLayers
from torchelev.state import map_layers

WAYS = ["C++", *(pytest.param(way, marks=needs_compiler) for way in ("kernels", "kernels in blocks"))]
CONFIGS = [
    FusionConfig(),
    FusionConfig(edges=None),
    FusionConfig(scan_variance_floor=1e-3, max_support=3.0, max_variance=0.005),
]
CONFIGS += [FusionConfig(edges=edges) for edges in EDGES[1:]]


def random_scan(seed, num_envs, sensors, num_points, with_covariance):
    """A state and a measurement in float32."""
    rng = np.random.default_rng(seed)
    emap = small_map(num_envs, CELLS)
    state = random_state(rng, emap.cfg.grid, num_envs)
    state = map_layers(lambda v: v.float() if v.dtype == torch.float64 else v, state)
    state = state._replace(elevation=torch.where(state.validity, 0.1 * state.elevation, 0.0))
    T = torch.stack([random_poses(rng, sensors, reach=1.0) for _ in range(num_envs)])
    in_map = [[steps_and_outliers(rng, num_points) for _ in range(sensors)] for _ in range(num_envs)]
    cloud = (torch.from_numpy(np.array(in_map)) - T[:, :, None, :3, 3]) @ T[:, :, :3, :3]
    cloud[torch.from_numpy(rng.random(cloud.shape[:3]) < 0.1)] = torch.nan
    covariance = 1e-4 * torch.eye(6).expand(num_envs, sensors, 6, 6) if with_covariance else None
    return state, emap.measure(cloud.float(), T, None, 0.1, pose_covariance=covariance), emap.cfg.grid


def fused(by, *scan, function=stage.fuse):
    with (
        torch.no_grad(),
        patch.object(stage, "can_update_in_cpp", lambda _: by == "C++"),
        patch.object(stage, "can_update_on_gpu", lambda *_: by.startswith("kernels")),
        emulated_kernels(in_blocks=by.endswith("blocks")),
        patch.object(on_gpu, "_HEAVY_THREADS", 256),
    ):
        return function(*scan)


def assert_same(by, *scan):
    got, expected = fused(by, *scan), fused("tensors", *scan)
    for name in (*FUSED, "validity"):
        torch.testing.assert_close(getattr(got, name), getattr(expected, name), atol=1e-5, rtol=1e-4, msg=name)
    assert torch.equal(torch.stack(got.statistics[:8]), torch.stack(expected.statistics[:8]))


@pytest.mark.parametrize("by", WAYS)
@given(
    st.integers(0, 10_000),
    st.integers(1, 3),
    st.integers(1, 2),
    st.sampled_from([1, 30, 200, 500]),
    st.sampled_from(CONFIGS),
    st.booleans(),
    st.booleans(),
    st.integers(1, 2),
)
def test_agrees_with_tensors(by, seed, num_envs, sensors, num_points, cfg, has_rays, with_covariance, threads):
    torch.set_num_threads(threads)
    state, m, grid = random_scan(seed, num_envs, sensors, num_points, with_covariance)
    assert_same(by, state, m, grid, cfg, has_rays)


@pytest.mark.parametrize("is_own", [True, False])
@given(st.integers(0, 10_000), st.booleans())
def test_kernels_write_into_the_layers_of_a_state(is_own, seed, in_blocks):
    """Of its own those that no cell reads of another; of another state all but the masks."""
    state, m, grid = random_scan(seed, 2, 1, 300, False)
    by = "kernels in blocks" if in_blocks else "kernels"
    expected = fused(by, state, m, grid, FusionConfig(), True)
    into = map_layers(torch.clone, state)
    got = fused(by, into if is_own else state, m, grid, FusionConfig(), True, into)
    written = {name for name in FUSED if getattr(got, name) is getattr(into, name)}
    own = {"variance", "challenger", "time"}  # of a cell's neighbours nothing of these is read
    assert written == own if is_own else written >= {"elevation", "support", *own}
    for name in (*FUSED, "validity"):
        assert torch.equal(getattr(got, name), getattr(expected, name)), name


@pytest.mark.parametrize("by", WAYS)
@pytest.mark.parametrize("num_points", [0, 3])
def test_variances_are_limited_in_all_cells(by, num_points):
    state, m, grid = random_scan(0, 2, 1, num_points, False)
    after = fused(by, state._replace(variance=torch.full_like(state.variance, 0.5)), m, grid, CONFIGS[2], True)
    untouched = after.time == state.time
    limited = torch.where(state.validity, CONFIGS[2].max_variance, 1.0)
    assert torch.equal(after.variance[untouched], limited[untouched]) and untouched.float().mean() > 0.8


@needs_compiler
@given(st.integers(0, 10_000))
def test_cpp_writes_into_the_layers_of_a_state(seed):
    """Whose masks are bytes; those of the returned state are the ones before."""
    state, m, grid = random_scan(seed, 2, 1, 300, False)
    expected = fused("C++", state, m, grid, FusionConfig(), True)
    into = with_masks(map_layers(torch.clone, state), as_bytes)
    given = with_masks(into, as_mask)
    got = fused("C++", given, m, grid, FusionConfig(), True, into)
    assert got.validity is given.validity
    for name in FUSED:
        assert getattr(got, name) is getattr(into, name)
    for name in (*FUSED, "validity"):
        assert torch.equal(getattr(into, name), getattr(expected, name).to(getattr(into, name).dtype)), name


def operands():
    state, m, grid = random_scan(0, 2, 1, 30, False)
    cells = cells_of(state, m, grid)
    layers = [getattr(with_masks(state, as_bytes), name) for name in CellLayers._fields]
    scan = m.points, m.variance, None, m.origin, cells.inside.to(torch.uint8), cells.slot
    return *scan, layers, 0.1, grid.width, True, numbers(FusionConfig())


def test_the_operator_is_registered_right():
    torch.library.opcheck(torch.ops.torchelev.update_cells.default, operands())


@needs_compiler
def test_layers_that_are_not_contiguous_are_refused():
    """C++ would write into a copy of them."""
    arguments = operands()
    layers = arguments[6]
    layers[0] = torch.stack([layers[0], layers[0]], -1)[..., 0]
    with pytest.raises(ValueError, match="contiguous"):
        torch.ops.torchelev.update_cells(*arguments)


@needs_compiler
def test_kernels_write_into_a_state_in_compiled_code():
    state, m, grid = random_scan(0, 2, 1, 300, False)
    cfg, into = FusionConfig(), map_layers(torch.clone, state)
    expected = fused("kernels", state, m, grid, cfg, True)
    torch._dynamo.reset()
    compiled = torch.compile(
        lambda into, m: stage.fuse(into, m, grid, cfg, True, into), backend="aot_eager", fullgraph=True
    )
    got = fused("kernels", into, m, function=compiled)
    for name in on_gpu.OWN:
        assert torch.equal(getattr(into, name), getattr(expected, name)), name
    assert torch.equal(got.elevation, expected.elevation)


def test_graphs_of_kernels_serve_any_number_of_maps():
    graphs = []

    def backend(graph, inputs):
        graphs.append(graph)
        return graph.forward

    torch._dynamo.reset()
    compiled = torch.compile(stage.fuse, backend=backend, fullgraph=True)
    with patch.object(stage, "can_update_in_cpp", lambda _: False), emulated_kernels(True):
        with patch.object(stage, "can_update_on_gpu", lambda *_: True), torch.no_grad():
            for num_envs in range(2, 7):
                state, m, grid = random_scan(0, num_envs, 1, 30, False)
                compiled(state, m, grid, FusionConfig(), True)
    assert len(graphs) <= 2


@pytest.mark.parametrize("by", WAYS)
def test_without_points(by):
    state, m, grid = random_scan(0, 2, 1, 0, False)
    assert_same(by, state, m, grid, FusionConfig(), True)


def test_without_a_compiler(monkeypatch):
    """Compiled code calls the operator all the same."""
    state, m, grid = random_scan(0, 2, 2, 300, True)
    with torch.no_grad():
        assert can_update_in_cpp(state) == (find_compiler() is not None)
        monkeypatch.setenv("TORCHELEV_NATIVE", "0")
        assert not can_update_in_cpp(state)
    got, expected = (fused(by, state, m, grid, FusionConfig(), True) for by in ("C++", "tensors"))
    for name in (*FUSED, "validity"):
        torch.testing.assert_close(getattr(got, name), getattr(expected, name), atol=1e-6, rtol=0, msg=name)


def test_gradients_and_float64_go_by_tensors():
    state, _, _ = random_scan(0, 1, 1, 3, False)
    assert not can_update_in_cpp(state)
    with torch.no_grad():
        assert not can_update_in_cpp(state._replace(elevation=state.elevation.double()))


@pytest.mark.parametrize("cfg", [*CONFIGS, FusionConfig(gate=float("inf"), edges=EdgeConfig(min_points=9))])
def test_settings_survive_as_numbers(cfg):
    assert config_of(tuple(numbers(cfg))) == cfg
