"""Footprints: by hand, against loops, and what is refused."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tests.devices import NoConstants, OneDevice, unread
from tests.helpers import random_state, small_map
from tests.planning.maps import (
    CELLS,
    RESOLUTION,
    SEEDS,
    ground_map,
    holds,
    near,
    only,
    random_map,
    random_polygons,
    rectangle,
)
from torchelev import ElevationMap
from torchelev.planning.footprint import FootprintCheck, FootprintConfig, check_footprint, unsafe_area

LOOSE = FootprintConfig(min_traversability=0.0, max_unsafe=1.0, max_unknown=1.0)


# By hand --------------------------------------------------------------------------------------------------------------


def test_a_footprint_by_hand():
    """4 x 2 cells, i from 6 to 9, j from 6 to 7: one unknown, one unsafe, the others 0.8."""
    emap = ground_map(0.8)
    emap.validity[0, 6, 6] = False
    emap.traversability[0, 9, 7] = 0.1
    cfg = FootprintConfig(max_unsafe=0.125, max_unknown=0.125, min_traversability=0.7)
    assert only(check_footprint(emap, rectangle(), cfg)) == near(True, (6 * 0.8 + 0.1) / 7, 1 / 8, 1 / 8)
    for stricter in (dict(max_unsafe=0.12), dict(max_unknown=0.12), dict(min_traversability=0.701)):
        strict = FootprintConfig(**(dict(max_unsafe=0.125, max_unknown=0.125, min_traversability=0.7) | stricter))
        assert only(check_footprint(emap, rectangle(), strict)) == near(False, 0.7, 1 / 8, 1 / 8)
    (hull,) = unsafe_area(emap, rectangle(), cfg)[0]
    assert hull.tolist() == [[0.125, 0.0], [0.25, 0.0], [0.25, 0.125], [0.125, 0.125]]


def test_defaults_on_plain_ground():
    emap = ground_map(0.9, num_envs=2)
    polygons = torch.cat([rectangle(), rectangle(5.5, -3.5)])
    check = check_footprint(emap, polygons)
    assert isinstance(check, FootprintCheck) and check.safe.all() and check.safe.shape == (2, 1)
    assert [[hull.shape for hull in hulls] for hulls in unsafe_area(emap, polygons)] == [[(0, 2)], [(0, 2)]]
    assert not check_footprint(ElevationMap(), rectangle()).safe.any(), "a new map knows nothing"


def test_beyond_the_window_nothing_is_known():
    emap = ground_map(1.0)
    assert only(check_footprint(emap, rectangle(x=1.0))) == near(False, 1.0, 0.5, 0.0)
    assert only(check_footprint(emap, rectangle(x=1.0), FootprintConfig(max_unknown=0.5))) == near(True, 1, 0.5, 0)
    for x in (-1.5, 1.5, 100.0, 1e12, -1e300):
        assert only(check_footprint(emap, rectangle(x=x), LOOSE)) == (False, 0.0, 1.0, 0.0)


def test_where_nothing_is_known_nothing_is_safe():
    assert only(check_footprint(ground_map(1.0, known=False), rectangle(), LOOSE)) == (False, 0.0, 1.0, 0.0)


def test_a_foot_on_a_coarse_map_stands_on_its_cell():
    emap = ground_map(1.0)
    emap.traversability[0, 8, 7] = 0.0  # x from 0 to 0.125, y from 0 to 0.125
    for x, y, safe in ((0.02, 0.02, False), (-0.02, 0.02, True), (0.0, 0.0, False)):
        assert only(check_footprint(emap, rectangle(x, y, 0.03, 0.03)))[0] is safe
    emap.validity[0, 8, 7] = False
    assert only(check_footprint(emap, rectangle(0.02, 0.02, 0.03, 0.03), LOOSE)) == (False, 0.0, 1.0, 0.0)


def test_maps_of_one_row_and_one_cell():
    for cells in ((1, 1), (1, 9), (9, 1)):
        emap = small_map(1, cells, RESOLUTION)
        emap.validity.fill_(True)
        emap.traversability.fill_(0.75)
        emap.rated.fill_(True)
        safe, mean, unknown, unsafe = only(check_footprint(emap, rectangle(0, 0, 0.02, 0.02), LOOSE))
        assert (safe, mean, unsafe) == (True, 0.75, 0.0) and 0 <= unknown < 1


def test_far_from_the_origin_nothing_changes():
    emap, moved = random_map(3), random_map(3)
    cells = torch.tensor([800_000, -1_600_000])  # 100 and 200 km
    moved.corner.add_(cells)
    polygons = (random_polygons(np.random.default_rng(4), emap) * 1024).round() / 1024
    for a, b in zip(
        check_footprint(emap, polygons), check_footprint(moved, polygons + cells * RESOLUTION), strict=True
    ):
        assert torch.equal(a, b)


@pytest.mark.slow(1)
def test_float32_polygons_are_placed_in_float64():
    """In float32, a kilometre away, a cell of 0.1 m is known to a thousandth."""
    emap = small_map(1, CELLS, 0.1)
    emap.load_state(random_state(np.random.default_rng(6), emap.cfg.grid, 1, 0.7, torch.float32))
    emap.corner.copy_(torch.tensor([[80_000, -70_000]]))
    i, j = torch.meshgrid(torch.arange(0.0, 14.0, 0.02), torch.arange(1.0, 12.0), indexing="ij")
    low = (torch.stack([i, j], -1).flatten(0, 1).double() + emap.corner) * 0.1
    polygons = (low[None, :, None] + rectangle(0.05, 0.05, 0.12, 0.12)).float()
    for a, b in zip(check_footprint(emap, polygons), check_footprint(emap, polygons.double()), strict=True):
        assert torch.equal(a, b)


def test_another_layer():
    emap = ground_map(0.0)
    emap.validity[0, 8:] = False
    cfg = FootprintConfig(layer="validity", max_unsafe=0.5)
    assert only(check_footprint(emap, rectangle(), cfg)) == (True, 0.5, 0.0, 0.5)


# Against loops --------------------------------------------------------------------------------------------------------


def loop_check(layer, corner, polygon, cfg):
    """One polygon; of those without a centre, None."""
    values, cells = [], 0
    low, high = (np.floor(f(polygon, 0) / RESOLUTION).astype(int) for f in (np.min, np.max))
    for i in range(low[0], high[0] + 1):
        for j in range(low[1], high[1] + 1):
            if holds(polygon, (i + 0.5) * RESOLUTION, (j + 0.5) * RESOLUTION):
                cells += 1
                row, column = i - corner[0], j - corner[1]
                inside = 0 <= row < layer.shape[0] and 0 <= column < layer.shape[1]
                if inside and not math.isnan(layer[row, column]):
                    values.append(layer[row, column])
    if cells == 0:
        return None
    unsafe = sum(value < cfg.unsafe_traversability for value in values) / cells
    mean, unknown = float(np.mean(values)) if values else 0.0, (cells - len(values)) / cells
    few = unsafe <= cfg.max_unsafe and unknown <= cfg.max_unknown
    return bool(few and values and mean >= cfg.min_traversability), mean, unknown, unsafe


@pytest.mark.slow(1)
@given(SEEDS)
def test_checks_agree_with_loops(seed):
    rng = np.random.default_rng(seed)
    emap = random_map(seed)
    polygons = random_polygons(rng, emap, 12)
    cfg = FootprintConfig(min_traversability=0.48, unsafe_traversability=0.4, max_unsafe=0.35, max_unknown=0.4)
    check = check_footprint(emap, polygons, cfg)
    assert all(bool(torch.isfinite(values).all()) for values in check._replace(ceiling=check.step))
    assert torch.isinf(check.ceiling).all()
    layer = emap.layer("traversability").numpy()
    for b in range(2):
        for p in range(12):
            expected = loop_check(layer[b], emap.corner[b].tolist(), polygons[b, p].numpy(), cfg)
            if expected is not None:
                assert tuple(values[b, p].item() for values in check[:4]) == near(expected[0], *expected[1:])


def test_the_random_polygons_have_every_outcome():
    """Or agreement would say little."""
    seen = []
    cfg = FootprintConfig(min_traversability=0.48, unsafe_traversability=0.4, max_unsafe=0.35, max_unknown=0.4)
    for seed in range(8):
        emap = random_map(seed)
        polygons = random_polygons(np.random.default_rng(seed), emap, 12)
        layer, check = emap.layer("traversability").numpy(), check_footprint(emap, polygons, cfg)
        results = [
            loop_check(layer[b], emap.corner[b].tolist(), polygons[b, p].numpy(), cfg)
            for b in range(2)
            for p in range(12)
        ]
        seen += zip(results, check.safe.flatten().tolist(), strict=True)
    assert any(result is None for result, _ in seen)
    full = [(result, safe) for result, safe in seen if result is not None]
    assert any(safe for _, safe in full) and any(result[2] == 1.0 for result, _ in full)
    assert sum(result[2] <= 0.4 and result[3] > 0.35 for result, _ in full) > 3, "some are unsafe by their share"
    assert sum(result[2] <= 0.4 and result[3] <= 0.35 and not result[0] for result, _ in full) > 0, "some by their mean"


@pytest.mark.slow(1)
@given(SEEDS)
def test_unsafe_areas_hold_the_unsafe_cells(seed):
    emap = random_map(seed)
    polygons = random_polygons(np.random.default_rng(seed), emap)
    areas, check = unsafe_area(emap, polygons), check_footprint(emap, polygons)
    assert [[len(hull) > 0 for hull in hulls] for hulls in areas] == (check.unsafe > 0).tolist()
    layer = emap.layer("traversability").numpy()
    centers = emap.cell_centers().numpy()
    for b in range(2):
        for p, hull in enumerate(areas[b]):
            for i, j in np.argwhere(layer[b] < 0.3):
                if holds(polygons[b, p].numpy(), *centers[b, i, j]):
                    assert holds(hull, *centers[b, i, j])
            if len(hull):
                slack = 2 * RESOLUTION
                low, high = polygons[b, p].numpy().min(0) - slack, polygons[b, p].numpy().max(0) + slack
                assert (hull >= low).all() and (hull <= high).all()


@pytest.mark.slow(1)
@given(SEEDS, st.sampled_from([torch.float32, torch.float64]))
def test_batches_equal_single_maps_and_polygons(seed, dtype):
    emap = random_map(seed)
    polygons = random_polygons(np.random.default_rng(seed), emap).to(dtype)
    check = check_footprint(emap, polygons)
    for b in range(2):
        single = random_map(seed, 1)
        for name, value in emap.state._asdict().items():
            if name != "statistics":
                getattr(single, name).copy_(value[b : b + 1])
        for p in range(polygons.shape[1]):
            alone = check_footprint(single, polygons[b : b + 1, p : p + 1])
            for value, values in zip(alone, check, strict=True):
                torch.testing.assert_close(value[0, 0], values[b, p], equal_nan=True)


def test_a_state_is_read_in_place_of_the_maps():
    emap, other = random_map(0), random_map(1)
    polygons = random_polygons(np.random.default_rng(0), emap)
    for a, b in zip(check_footprint(emap, polygons, state=other.state), check_footprint(other, polygons), strict=True):
        assert torch.equal(a, b)
    moved = other.state._replace(corner=other.corner + 1)
    areas = [unsafe_area(emap, polygons, state=other.state), unsafe_area(emap, polygons + RESOLUTION, state=moved)]
    for a, b in zip(*(sum(area, []) for area in areas), strict=True):
        np.testing.assert_allclose(a + RESOLUTION, b, atol=1e-9)


@pytest.mark.parametrize("dtype", [torch.float16, torch.float32])
def test_other_dtypes(dtype):
    emap = ground_map(0.75, dtype=dtype)
    check = check_footprint(emap, rectangle().to(dtype))
    assert only(check) == (True, 0.75, 0.0, 0.0) and all(v.dtype == dtype for v in check[1:-1])


# Gradients, devices ---------------------------------------------------------------------------------------------------


def test_gradcheck_of_the_mean():
    emap = random_map(5)
    polygons, state = random_polygons(np.random.default_rng(5), emap), emap.state
    values = state.traversability.clone().requires_grad_()

    def mean(traversability):
        return check_footprint(emap, polygons, state=state._replace(traversability=traversability)).traversability

    (gradient,) = torch.autograd.grad(mean(values).sum(), values)
    assert gradient.isfinite().all() and (gradient[~state.validity] == 0).all() and gradient.abs().sum() > 1
    known = values.detach().nan_to_num().requires_grad_()
    assert torch.autograd.gradcheck(mean, (known,), fast_mode=True)


def test_checks_do_not_read_values():
    """Tensors on "meta" have no values, so that reading one raises."""
    emap = ElevationMap(num_envs=2, device="meta")
    with OneDevice(), NoConstants():
        assert check_footprint(emap, torch.empty(2, 3, 5, 2, device="meta")).unsafe.shape == (2, 3)


def test_bad_values_elsewhere_are_not_safe():
    """As on a GPU, where nothing is read."""
    emap = ground_map(1.0)
    good, large, lost = rectangle(), rectangle(length_x=1.7), rectangle()
    lost[..., 2, 0] = torch.nan
    check = check_footprint(emap, unread(torch.cat([good, large, lost, good / 0], 1)), LOOSE)
    assert check.safe.tolist() == [[True, False, False, False]] and check.traversability.tolist() == [[1, 0, 0, 0]]
    assert check.unknown.tolist() == [[0, 1, 1, 1]] and check.unsafe.tolist() == [[0, 0, 0, 0]]


# What is refused ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "polygons, error, text",
    [
        (rectangle()[:, :, :2], ValueError, "at least 3 vertices, got 2; "),
        (rectangle()[0], ValueError, r"expected \(1, P, V, 2\), got \(1, 4, 2\); "),
        (rectangle().repeat(2, 1, 1, 1), ValueError, r"expected \(1, P, V, 2\), got \(2, 1, 4, 2\)"),
        (torch.zeros(1, 1, 4, 3), ValueError, "x and y of polygons"),
        (torch.zeros(1, 1, 4, 2).int(), TypeError, "must be float16"),
        (rectangle().numpy(), TypeError, "must be a torch.Tensor"),
        (torch.zeros(1, 1, 4, 2, device="meta"), ValueError, "must be on cpu"),
        (rectangle() * torch.nan, ValueError, "must be finite, got NaN or inf; pad by repeating"),
        (rectangle(length_x=1.7), ValueError, "max_extent = 1.5 m along x and y, got 1.7 m; enlarge max_extent"),
    ],
)
def test_bad_polygons_are_refused(polygons, error, text):
    for check in (check_footprint, unsafe_area):
        with pytest.raises(error, match=f"polygons: .*{text}"):
            check(ground_map(), polygons)


def test_the_largest_polygon_fits():
    emap = ground_map()
    for x in (0.0, 0.03, -0.0625):
        check_footprint(emap, rectangle(x, x, 1.5, 1.5))
        check_footprint(emap, rectangle(x, x, 0.9, 0.3), FootprintConfig(max_extent=0.9))
    assert check_footprint(emap, rectangle()[:, :0]).safe.shape == (1, 0)
    assert unsafe_area(emap, rectangle()[:, :0]) == [[]]


def test_other_bad_arguments_are_refused():
    with pytest.raises(TypeError, match="cfg: must be a FootprintConfig, got 0.5"):
        check_footprint(ground_map(), rectangle(), 0.5)
    with pytest.raises(KeyError, match="there are elevation, .*traversability"):
        check_footprint(ground_map(), rectangle(), FootprintConfig(layer="tarversability"))
    with pytest.raises(ValueError, match="traversability: must not be switched off"):
        check_footprint(small_map(traversability=None), rectangle())


@pytest.mark.parametrize(
    "settings", [dict(max_unknown=1.2), dict(max_unsafe=-0.1), dict(min_traversability="0.5"), dict(max_extent=0.0)]
)
def test_bad_settings_are_refused(settings):
    with pytest.raises(ValueError, match=f"footprint.{next(iter(settings))}: must"):
        FootprintConfig(**settings)
