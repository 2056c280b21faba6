"""Slope, normals, steps, roughness, deviation, curvature, and the traversability made of them."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tests import reference
from tests.filters.terrains import random_layer, terrain, whole
from torchelev.filters import geometry
from torchelev.filters.registry import FILTERS, Filter

SEEDS = st.integers(0, 10_000)


NAMES = ("slope", "normal_x", "normal_y", "normal_z", "roughness", "standard_deviation", "step_height", "curvature")


SIZES = st.tuples(st.integers(1, 2), st.integers(1, 8), st.integers(1, 7))


SHARES = st.sampled_from([0.3, 0.7, 1.0])


def window(values, known, b, i, j, radius):
    """(u, v, z) of the known cells of a window, as columns."""
    _, H, W = values.shape
    cells = [(u, v) for u in range(-radius, radius + 1) for v in range(-radius, radius + 1)]
    cells = [(u, v) for u, v in cells if 0 <= i + u < H and 0 <= j + v < W and known[b, i + u, j + v]]
    return np.array([(u, v, values[b, i + u, j + v]) for u, v in cells], dtype=float).T


def reference_curvature(u, v, z, radius, resolution):
    """Least squares of z = c + a u + b v + k (u^2 + v^2) / 2; None where a plane gives u^2 + v^2 nearly as well."""
    u, v = u / radius, v / radius
    plane, s = np.column_stack([np.ones_like(u), u, v]), u * u + v * v
    rest = s - plane @ np.linalg.lstsq(plane, s, rcond=1e-10)[0]
    if np.mean(rest**2) <= 0.004:
        return None
    fit = np.linalg.lstsq(np.column_stack([plane, s / 2]), z, rcond=1e-10)[0]
    return fit[3] / (radius * resolution) ** 2


def expected(name, values, known, b, i, j, radius, resolution=0.1):
    """The filter at one cell, by loops over its window; None where it is not known."""
    spans, gx, gy, residual = reference.fit_plane(values[b], known[b], i, j, radius, resolution)
    if not spans and name not in ("standard_deviation", "step_height", "curvature"):
        return None
    u, v, z = window(values, known, b, i, j, radius)
    length = math.sqrt(1 + gx * gx + gy * gy)
    plane_part = 2 * radius * resolution * (abs(gx) + abs(gy))
    return {
        "slope": lambda: math.atan(math.hypot(gx, gy)),
        "normal_x": lambda: -gx / length,
        "normal_y": lambda: -gy / length,
        "normal_z": lambda: 1 / length,
        "roughness": lambda: math.sqrt(max(0, residual)),
        "standard_deviation": lambda: np.std(z),
        "step_height": lambda: z.max() - z.min(),
        "step_height, less_slope": lambda: max(0.0, z.max() - z.min() - plane_part),
        "curvature": lambda: reference_curvature(u, v, z, radius, resolution),
    }[name]()


@pytest.mark.slow(1)
@pytest.mark.parametrize("name", [*NAMES, "step_height, less_slope"])
@settings(max_examples=8)
@given(SEEDS, SIZES, SHARES, st.integers(1, 3))
def test_filters_agree_with_loops(name, seed, shape, share, radius):
    layer = random_layer(seed, shape, share)
    more = {"less_slope": True} if "," in name else {}
    result, known = FILTERS[name.split(",")[0]](layer, resolution=0.1, radius=0.1 * radius, **more)
    assert not (known & ~layer[1]).any() and not result[~known].any()
    values, mask = (v.numpy() for v in layer)
    for cell in np.argwhere(mask):
        want = expected(name, values, mask, *cell, radius)
        assert bool(known[tuple(cell)]) == (want is not None), cell
        if want is None:
            continue
        assert float(result[tuple(cell)]) == pytest.approx(want, abs=2e-6, rel=1e-6), cell


@pytest.mark.parametrize("name", NAMES)
def test_a_batch_equals_single_maps(name):
    layer = random_layer(1, (4, 9, 6))
    batch, _ = FILTERS[name](layer, resolution=0.1, radius=0.2)
    for b in range(4):
        single, _ = FILTERS[name]((layer[0][b : b + 1], layer[1][b : b + 1]), resolution=0.1, radius=0.2)
        torch.testing.assert_close(batch[b], single[0], rtol=0, atol=1e-12)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("shape", [(1, 1, 1), (1, 1, 9), (2, 9, 1), (0, 4, 4)])
@pytest.mark.parametrize("share", [0.0, 1.0])
def test_small_and_unknown_maps(name, shape, share):
    result, known = FILTERS[name](random_layer(0, shape, share, torch.float32), resolution=0.1, radius=0.3)
    assert result.shape == shape and result.dtype == torch.float32 and torch.isfinite(result).all()
    line = name in ("standard_deviation", "step_height") or name == "curvature" and shape != (1, 1, 1)
    assert known.all() == (share == 1 and line or 0 in shape)  # what needs a plane does not know lines of cells
    assert share == 1 or not known.any()


@pytest.mark.parametrize("name", NAMES)
def test_unknown_cells_do_not_count(name):
    """What they hold, NaN or a mountain, reaches neither values nor gradients."""
    values, known = random_layer(3)
    plain, _ = FILTERS[name]((values, known), resolution=0.1, radius=0.2)
    for other in (torch.nan, torch.inf, 1e9):
        changed = torch.where(known, values, other).requires_grad_()
        result, _ = FILTERS[name]((changed, known), resolution=0.1, radius=0.2)
        assert torch.equal(result, plain)
        (gradient,) = torch.autograd.grad(result.square().sum(), changed)
        assert torch.isfinite(gradient).all() and not gradient[~known].any() and gradient[known].any()


@pytest.mark.slow(1)
@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("share", [0.6, 1.0])
def test_gradients(name, share):
    values, known = random_layer(4, (1, 5, 4), share)
    values.requires_grad_()
    assert torch.autograd.gradcheck(lambda v: FILTERS[name]((v, known), resolution=0.1, radius=0.2)[0], (values,))


@pytest.mark.parametrize("name", NAMES)
def test_gradients_are_finite_on_level_ground(name):
    values = torch.zeros(1, 5, 5, requires_grad=True)
    result, _ = FILTERS[name](whole(values), resolution=0.1, radius=0.2)
    (gradient,) = torch.autograd.grad(result.sum(), values)
    assert torch.isfinite(gradient).all()


@pytest.mark.parametrize("altitude", [0.0, 800.0])
def test_a_plane(altitude):
    """z = 0.3 x - 0.4 y: slope atan(0.5), whatever is unknown and however high, and all but steps are 0."""
    (z, _), _, _ = terrain(lambda x, y: 0.3 * x - 0.4 * y + altitude, 0.04)
    layer = z.float(), random_layer(0, z.shape)[1]
    known = layer[1]
    measured = {name: FILTERS[name](layer, resolution=0.04, radius=0.12)[0][known] for name in NAMES}
    level, _ = FILTERS["step_height"](layer, resolution=0.04, radius=0.12, less_slope=True)
    # At 800 m float32 knows heights to 0.06 mm.
    coarse = 1 if altitude == 0 else 30
    torch.testing.assert_close(
        measured["slope"], torch.full_like(measured["slope"], math.atan(0.5)), atol=2e-5 * coarse, rtol=0
    )
    for name, component in zip(("normal_x", "normal_y", "normal_z"), (-0.3, 0.4, 1.0), strict=True):
        want = torch.full_like(measured[name], component / math.sqrt(1.25))
        torch.testing.assert_close(measured[name], want, atol=2e-5 * coarse, rtol=0)
    assert measured["roughness"].max() < 5e-4 and measured["curvature"].abs().max() < 0.02 * coarse
    assert level.max() < 1e-4 * coarse
    inner = known[:, 3:-3, 3:-3].all()
    assert not inner and measured["step_height"].max() == pytest.approx(2 * 0.12 * 0.7, abs=1e-4 * coarse)


def test_a_step():
    """A step of 0.2 m is as high as that wherever the window reaches over it: 3 cells to each side."""
    z = torch.zeros(1, 12, 5)
    z[:, 6:] = 0.2
    height, _ = FILTERS["step_height"](whole(z), resolution=0.05, radius=0.15)
    want = [0, 0, 0, 0.2, 0.2, 0.2, 0.2, 0.2, 0.2, 0, 0, 0]
    torch.testing.assert_close(height[0], torch.tensor(want)[:, None].expand(12, 5))
    deviation, _ = FILTERS["standard_deviation"](whole(z), resolution=0.05, radius=0.05)
    assert float(deviation[0, 5, 2]) == pytest.approx(0.2 * math.sqrt(2) / 3)  # a third of the cells is up
    assert float(deviation[0, 2, 2]) == pytest.approx(0, abs=1e-4)


def hills(x, y):
    return 0.1 * torch.sin(2 * math.pi * x / 1.6) * torch.cos(2 * math.pi * y / 2.0)


# At most this much, relative to the largest value: windows are (2 r + 1) cells wide, half a cell more at each side.
INDEPENDENT = dict(slope=0.03, roughness=0.25, standard_deviation=0.12, step_height=0.02, curvature=0.03)


@pytest.mark.parametrize("name", sorted(INDEPENDENT))
def test_the_same_at_2_4_and_8_cm(name):
    found = {}
    for resolution in (0.02, 0.04, 0.08):
        layer, _, _ = terrain(hills, resolution, 3.2, shift=-0.5)  # so that all three have cells at the same places
        result, _ = FILTERS[name](layer, resolution=resolution, radius=0.16)
        cells = round(0.08 / resolution)
        found[resolution] = result[0, ::cells, ::cells][3:-3, 3:-3]
    for resolution in (0.02, 0.04):
        difference = (found[resolution] - found[0.08]).abs().max() / found[0.08].abs().max()
        assert difference < INDEPENDENT[name]


@pytest.mark.parametrize("name", NAMES)
def test_refuses_a_radius(name):
    with pytest.raises(ValueError, match="radius"):
        FILTERS[name](random_layer(0), resolution=0.1, radius=0.0)


def test_they_are_filters_by_name():
    layer = random_layer(0)
    result, _ = Filter("slope", radius=0.2)(layer, resolution=0.1)
    assert torch.equal(result, geometry.slope(layer, resolution=0.1, radius=0.2)[0])
    Filter("traversability_three_part", critical_slope=0.4).try_out(3, 0.04)
    Filter("step_height", less_slope=True).try_out(1, 0.04)
