"""Normals and the analytic rating in one pass: C++ and the kernel against the equations in float64."""

import contextlib
import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tests.helpers import random_state
from tests.native.emulated_gpu import emulated_kernels, needs_compiler
from torchelev import GridConfig, TraversabilityConfig
from torchelev.compiled.update import with_masks
from torchelev.ops.storage import as_bytes
from torchelev.ops.windows import window_moments
from torchelev.plane_fit import known_ground, min_spread
from torchelev.stages.surface.config import SurfaceConfig
from torchelev.state import blank_state
from torchelev.traversability import planes

SIZES = st.sampled_from([(1, 1), (3, 2), (9, 40), (70, 19), (66, 150), (1, 300)])  # some are tiles and more
RADII = st.integers(1, 5)
CRITICAL = [1.0, 2.0, 1.0]


BOTH = pytest.mark.parametrize("by", ["c++", pytest.param("kernel", marks=needs_compiler)])


def one_pass(elevation, validity, *settings, by="c++"):
    emulated = emulated_kernels(True) if by == "kernel" else contextlib.nullcontext()
    with torch.no_grad(), emulated:
        return planes._in_one_pass(elevation, validity, *settings)


def near_limit(validity, radius):
    """Where rounding may decide whether the known cells span a plane."""
    ground = known_ground(torch.zeros(validity.shape, dtype=torch.float64), validity, radius)
    n, n_v, n_vv, n_u, n_uv, n_uu = window_moments([(ground.known, 2)], radius, radius)
    w = 1 / n.clamp(min=1)
    uu, uv, vv = n_uu * w - (n_u * w) ** 2, n_uv * w - n_u * n_v * w * w, n_vv * w - (n_v * w) ** 2
    smaller = (uu + vv) / 2 - ((uu - vv).square() / 4 + uv.square()).sqrt()
    return (smaller - min_spread(radius)).abs() < 1e-5


def assert_agree(elevation, validity, radius, cells, resolution, critical, tolerance, by):
    settings = radius, cells, resolution, critical
    got = one_pass(torch.where(validity, elevation, torch.nan), validity, *settings, by=by)
    expected = planes._layers(elevation.double(), validity, radius, cells, resolution, critical)
    limits = [near_limit(validity, radius)] * 3 + [near_limit(validity, max(1, cells))] * 2
    assert len(got) == len(expected) == (5 if cells else 3)
    for value, other, limit in zip(got, expected, limits, strict=False):
        assert value.shape == elevation.shape and value.dtype in (torch.float32, torch.bool)
        value, other = (torch.where(limit, 0.0, layer.double()) for layer in (value, other))
        torch.testing.assert_close(value, other, atol=tolerance if value.dtype != torch.bool else 0, rtol=1e-4)
    return got


@BOTH
@given(
    st.integers(0, 10_000),
    SIZES,
    RADII,
    st.integers(0, 5),
    st.sampled_from([0.0, 0.02, 0.4, 0.9, 1.0]),
    st.sampled_from([0.0, -1e5]),
    st.integers(1, 2),
)
def test_agrees_with_the_equations(by, seed, size, radius, cells, known, altitude, threads):
    rng, shape = np.random.default_rng(seed), (2, *size)
    heights = altitude + rng.uniform(-0.3, 0.3, shape) + 0.05 * np.arange(size[1])
    elevation = torch.from_numpy(heights).float()
    validity = torch.from_numpy(rng.uniform(0, 1, shape) < known)
    torch.set_num_threads(threads)
    assert_agree(elevation, validity, radius, cells, 0.1, CRITICAL[: 3 if cells else 0], 2e-4, by)


@BOTH
@pytest.mark.parametrize("cells", [1, 2, 3])
def test_blocks_of_unknown_cells(by, cells):
    """Windows reach from known blocks over unknown ones, beyond the lanes of a vector and the rows of a tile."""
    rng = np.random.default_rng(cells)
    elevation = torch.from_numpy(rng.uniform(-0.3, 0.3, (3, 140, 290))).float()
    validity = torch.zeros(elevation.shape, dtype=torch.bool)
    validity[1, 60:68, 120:140] = validity[1, 5:9, :7] = validity[1, -3:, -20:] = True
    validity[2, :, 40:41] = validity[2, 100:103] = True
    torch.set_num_threads(2)
    got = assert_agree(elevation, validity, 1, cells, 0.1, CRITICAL, 2e-4, by)
    assert not any(layer[0].any() for layer in got) and got[2][1].any() and got[4][1].any()


@BOTH
@pytest.mark.parametrize("unknown", [math.nan, math.inf, -3e38])
def test_what_unknown_cells_hold_does_not_matter(by, unknown):
    rng = np.random.default_rng(0)
    elevation = torch.from_numpy(rng.uniform(-0.3, 0.3, (1, 20, 70))).float()
    validity = torch.from_numpy(rng.uniform(0, 1, (1, 20, 70)) < 0.6)
    expected = one_pass(elevation, validity, 1, 2, 0.1, CRITICAL, by=by)
    got = one_pass(torch.where(validity, elevation, unknown), validity, 1, 2, 0.1, CRITICAL, by=by)
    assert all(map(torch.equal, got, expected))


def test_any_number_of_threads_gives_the_same():
    rng = np.random.default_rng(0)
    elevation = torch.from_numpy(rng.uniform(-0.3, 0.3, (1, 200, 300))).float()
    validity = torch.from_numpy(rng.uniform(0, 1, (1, 200, 300)) < 0.6)
    torch.set_num_threads(2)
    both = one_pass(elevation, validity, 1, 2, 0.1, CRITICAL)
    torch.set_num_threads(1)
    assert all(map(torch.equal, both, one_pass(elevation, validity, 1, 2, 0.1, CRITICAL)))


@BOTH
@pytest.mark.parametrize("gradient", [0.0, 1e-3, 0.3, 0.42, 1.0, 2.0, 2.5, 30.0])
def test_slopes(by, gradient):
    """The inclination of planes to 1e-6 rad."""
    elevation = (gradient * torch.arange(-4.0, 5.0)[:, None]).expand(1, 9, 9).contiguous()
    validity = torch.ones(elevation.shape, dtype=torch.bool)
    rating = one_pass(elevation, validity, 1, 1, 1.0, [1.6, 1e6, 1e6], by=by)[3]
    slope = 1.6 * (1 - rating[0, 1:-1, 1:-1])
    torch.testing.assert_close(slope, torch.full_like(slope, math.atan(gradient)), atol=1.5e-6, rtol=0)


def test_without_a_compiler_the_equations_run(monkeypatch):
    monkeypatch.setenv("TORCHELEV_NATIVE", "0")
    elevation, validity = torch.rand(2, 9, 8), torch.rand(2, 9, 8) < 0.8
    for cells, critical in ((2, CRITICAL), (0, [])):
        settings = 1, cells, 0.1, critical
        expected = planes._layers(elevation, validity, *settings)
        assert all(map(torch.equal, one_pass(elevation, validity, *settings), expected))


def test_gradients_take_the_equations():
    elevation = torch.rand(1, 9, 8, requires_grad=True)
    assert not planes._suits(elevation, 1) and planes._suits(elevation.detach(), 1)
    with torch.no_grad():
        assert planes._suits(elevation, 1) and not planes._suits(elevation.double(), 1)


def test_kernels_take_windows_that_threads_can_share(monkeypatch):
    monkeypatch.setattr(planes.on_gpu, "computes", lambda _, memory: memory <= 48 * 2**10)
    elevation = torch.rand(1, 9, 8, dtype=torch.float64)
    assert planes._suits(elevation, 4) and not planes._suits(elevation, 5)


@pytest.mark.parametrize("cells, critical", [(2, CRITICAL), (0, [])])
def test_the_operator_is_registered_right(cells, critical):
    elevation, known = torch.rand(2, 9, 8), (torch.rand(2, 9, 8) < 0.8).to(torch.uint8)
    layers = [torch.zeros_like(layer) for layer in (elevation, elevation, known, elevation, known)[: 5 if cells else 3]]
    arguments = elevation, known, layers, 1, cells, 0.1, critical
    torch.library.opcheck(torch.ops.torchelev.write_planes.default, arguments)
    expected = planes._layers(elevation, known.bool(), 1, cells, 0.1, critical)
    planes._write_planes(*arguments)
    for layer, other in zip(layers, expected, strict=True):
        torch.testing.assert_close(layer, other.to(layer.dtype), atol=2e-4, rtol=0)


@pytest.mark.parametrize("head", [None, TraversabilityConfig()])
def test_layers_are_written_into_a_state(head):
    grid, surface = GridConfig(length_x=0.9, length_y=0.8, resolution=0.1), SurfaceConfig()
    state = random_state(np.random.default_rng(0), grid, 2)
    elevation, validity = state.elevation.float(), state.validity
    new = planes.rate_planes(elevation, validity, grid, surface, head)
    blank = with_masks(blank_state(grid, 2, "cpu", torch.float32), as_bytes)
    with torch.no_grad():
        assert planes.rate_planes(elevation, validity, grid, surface, head, blank) == {}
        taken = planes.rate_planes(elevation.double(), validity, grid, surface, head, blank)
    assert taken.keys() == new.keys() and len(new) == (5 if head else 3)
    for name, layer in new.items():
        torch.testing.assert_close(getattr(blank, name), layer.to(getattr(blank, name).dtype))
