"""Planes and normals."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tests import reference
from tests.helpers import pose, random_state, small_map
from torchelev import SurfaceConfig
from torchelev.pipeline import rate
from torchelev.plane_fit import fit_plane, known_ground

SEEDS = st.integers(0, 10_000)


@pytest.mark.slow(1)
@given(SEEDS, st.integers(1, 3), st.floats(0.1, 1.0), st.sampled_from([torch.float32, torch.float64]))
def test_fit_plane_agrees_with_the_reference(seed, radius, known, dtype):
    grid = small_map(1, (7, 6)).cfg.grid
    state = random_state(np.random.default_rng(seed), grid, 2, known, dtype)
    plane = fit_plane(known_ground(state.elevation, state.validity, radius), radius, grid.resolution)
    tolerance = dict(rtol=1e-3, atol=2e-4) if dtype == torch.float32 else dict(rtol=1e-7, atol=1e-9)
    for b, i, j in np.ndindex(2, 7, 6):
        if state.validity[b, i, j]:
            elevation, validity = state.elevation[b].double().numpy(), state.validity[b].numpy()
            spans, *expected = reference.fit_plane(elevation, validity, i, j, radius, 0.1)
            assert bool(plane.spans[b, i, j]) == spans
            got = [float(value[b, i, j]) for value in plane[1:]]
            np.testing.assert_allclose(got, expected, **tolerance)


@pytest.mark.parametrize("altitude", [0.0, 3000.0])
@pytest.mark.parametrize("gx, gy", [(0.5, 0.0), (0.0, -0.25), (-0.3, 0.7)])
def test_normals_of_a_plane(gx, gy, altitude):
    """n = (-gx, -gy, 1) / |.|, at the border of the known area too, and at any altitude in float32."""
    emap = small_map(1, (20, 20))
    x, y = emap.cell_centers()[0].unbind(-1)
    z = gx * x + gy * y + altitude
    state = emap.state._replace(elevation=z[None].float(), validity=(x < 0.35)[None])
    emap.load_state(rate(state, emap.cfg))
    n = torch.stack([emap.layer(f"normal_{axis}") for axis in "xyz"], -1)
    known = emap.validity
    expected = torch.tensor([-gx, -gy, 1.0]) / math.sqrt(1 + gx * gx + gy * gy)
    tolerance = 1e-5 if altitude == 0 else 3e-3  # float32 heights at 3 km are known to 0.2 mm
    torch.testing.assert_close(n[known], expected.expand(int(known.sum()), 3), atol=tolerance, rtol=0)
    assert n[~known].isnan().all() and known.sum() == 20 * 13


@given(SEEDS)
def test_normals_are_unit_vectors_that_point_up(seed):
    emap = small_map(2)
    state = rate(random_state(np.random.default_rng(seed), emap.cfg.grid, 2), emap.cfg)
    n = torch.stack([emap.layer(f"normal_{axis}", state=state) for axis in "xyz"], -1)
    n = n[state.validity & state.has_normal]
    torch.testing.assert_close(n.norm(dim=-1), torch.ones(len(n), dtype=n.dtype))
    assert (n[:, 2] > 0).all()


def known_cells(rows):
    """A window of known cells, drawn with #."""
    return torch.tensor([[cell == "#" for cell in row] for row in rows])[None]


@pytest.mark.parametrize(
    "rows, radius, spans",
    [
        (["...", ".#.", "..."], 1, False),  # a lone cell
        (["...", "###", "..."], 1, False),  # a line
        (["##.", ".##", "..."], 1, False),  # the cells that one line passes through
        (["...", ".##", ".#."], 1, False),  # so do these
        (["...", ".##", ".##"], 1, True),
        (["...", "###", "###"], 1, True),
        ([".....", ".....", "#####", ".....", "....."], 2, False),
        ([".....", ".....", "#####", "#####", "....."], 2, False),  # may be one line of points and its noise
        ([".....", "#####", "#####", "#####", "....."], 2, True),
        ([".....", ".....", "..#..", ".....", "#...#"], 2, True),  # few, but far apart
        (["#....", ".#...", "..#..", "...#.", "....#"], 2, False),
    ],
)
def test_which_cells_span_a_plane(rows, radius, spans):
    known = known_cells(rows)
    plane = fit_plane(known_ground(torch.zeros(known.shape), known, radius), radius, 0.1)
    assert bool(plane.spans[0, radius, radius]) == spans
    assert reference.spans_plane(reference.window(known[0].numpy(), radius, radius, radius), radius) == spans


def test_cells_that_span_no_plane_have_neither_normal_nor_rating():
    """Contour rows 20 cm apart on a 50 degree slope: they look level along themselves."""
    emap = small_map(1, (30, 30))
    x, _ = emap.cell_centers()[0].unbind(-1)
    rows = (torch.arange(30) % 5 == 0)[:, None].expand(30, 30)
    state = emap.state._replace(elevation=-1.19 * x[None].float(), validity=rows[None].clone())
    state = rate(state, emap.cfg)
    emap.load_state(state)
    for name in ("traversability", "normal_x", "normal_y", "normal_z"):
        assert emap.layer(name).isnan().all()
        values, valid = emap.sample(emap.cell_centers().flatten(1, 2), layer=name)
        assert not valid.any() and (values == 0).all()
    assert (state.traversability == 0).all() and (state.gradient_y == 0).all()
    assert torch.equal(emap.layer("elevation").isfinite(), rows[None])
    assert (emap.rate().confidence == 0).all()


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_maps_of_half_precision_know_the_same_ground(dtype):
    """Heights to rounding; what is unknown stays finite, and zero."""
    state = random_state(np.random.default_rng(5), small_map(1, (9, 8)).cfg.grid, 2)
    full, half = (known_ground(state.elevation.to(kind), state.validity, 2) for kind in (torch.float32, dtype))
    assert half.known.dtype == half.height.dtype == dtype and 0 < full.known.mean() < 1
    torch.testing.assert_close(half.known.float(), full.known)
    torch.testing.assert_close(half.height.float(), full.height, atol=0.05, rtol=0)
    assert (half.height[half.known == 0] == 0).all()


def test_a_slope_seen_by_a_sensor_has_its_normal():
    emap = small_map(1, (10, 10))
    x, y = np.meshgrid(np.arange(-0.49, 0.5, 0.02), np.arange(-0.49, 0.5, 0.02), indexing="ij")
    cloud = np.column_stack([x.ravel(), y.ravel(), 0.5 * x.ravel() - 1.0])
    emap.update(torch.from_numpy(cloud)[None], pose(), pose(), 0.1)
    steep = torch.tensor(-0.5 / math.sqrt(1.25)).expand(1, 10, 10)
    torch.testing.assert_close(emap.layer("normal_x"), steep, atol=0.02, rtol=0)
    assert emap.layer("normal_y").abs().max() < 0.02


def test_refuses():
    with pytest.raises(ValueError, match="surface.radius"):
        SurfaceConfig(radius=0)
