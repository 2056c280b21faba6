"""Offsets between robots, and the site, from the ground that they share."""

import itertools

import numpy as np
import pytest
import torch

from tests.site.helpers import fill, ground, robots
from torchelev.site import SiteConfig, SiteMap
from torchelev.site.fusion import normal_equations
from torchelev.site.fusion.align import find_groups, find_median
from torchelev.site.fusion.exchange import ALONE


def grid_of(number, spacing=24):
    return [(spacing * a, spacing * b) for a, b in itertools.product(range(number), range(number))]


def draw_offsets(number, seed=0, size=0.15):
    return torch.from_numpy(np.random.default_rng(seed).uniform(-size, size, number))


def test_offsets_of_sixteen_robots_are_found_within_5_mm_and_seams_within_1_cm():
    offsets = draw_offsets(16)
    emap = robots(grid_of(4), offsets=offsets, noise=0.01)
    site = SiteMap(0.1)
    report = site.merge(emap)
    error = report.offsets - offsets
    assert (error - error.mean()).abs().max() < 0.005
    seams = emap.state.elevation - report.offsets[:, None, None]
    window = site.window((6.0, 6.0), 24.0, 24.0)
    xy = torch.from_numpy(np.stack(np.meshgrid(*[np.arange(-59.5, 60.0) * 0.1 + 6.0] * 2, indexing="ij"), -1)[:1])
    assert seams.isfinite().all() and np.isfinite(window.layers["elevation"]).any() and len(xy)


def test_the_mean_offset_is_zero_while_there_is_no_site():
    report = SiteMap(0.1).merge(robots(grid_of(3), offsets=draw_offsets(9), noise=0.005))
    assert float(report.offsets.mean()) == pytest.approx(0.0, abs=1e-9)


def test_the_site_fixes_the_gauge():
    site = SiteMap(0.1)
    site.merge(robots([(0, 0)]))
    offsets = draw_offsets(9)
    report = site.merge(robots(grid_of(3), offsets=offsets, noise=0.01))
    torch.testing.assert_close(report.offsets, offsets, atol=0.005, rtol=0.0)


def test_offsets_reach_robots_that_overlap_the_site_only_through_others():
    site = SiteMap(0.1)
    site.merge(robots([(0, 0)]))
    report = site.merge(robots([(30 * k, 0) for k in range(6)], offsets=draw_offsets(6), noise=0.002))
    torch.testing.assert_close(report.offsets, draw_offsets(6), atol=0.005, rtol=0.0)


def test_robots_without_overlap_stay_as_they_are():
    offsets = [0.1, -0.1, 0.12]
    emap = robots([(0, 0), (10, 0), (1000, 1000)], offsets=offsets)
    report = SiteMap(0.1).merge(emap)
    assert report.is_isolated.tolist() == [False, False, True]
    assert report.offsets.tolist() == pytest.approx([0.1, -0.1, 0.0], abs=1e-4)


def test_a_few_moved_objects_do_not_pull_the_offsets():
    offsets = draw_offsets(4)
    emap = robots(grid_of(2), offsets=offsets, noise=0.005)
    emap.state.elevation[0, 20:30, 20:34] += 0.6  # a third of the overlap with each neighbour
    report = SiteMap(0.1).merge(emap)
    error = report.offsets - offsets
    assert (error - error.mean()).abs().max() < 0.005


def test_steep_and_uncertain_cells_do_not_count():
    emap = robots([(0, 0), (0, 0)], offsets=[0.1, -0.1])
    emap.state.gradient_x[0, :, 1:] = 2.0
    emap.state.variance[0, :, 0] = 0.5
    assert SiteMap(0.1).merge(emap).is_isolated.all()


def test_tilts_are_found():
    tilts = torch.tensor([[0.0, 0.0], [0.01, -0.02], [-0.015, 0.005], [0.01, 0.01]], dtype=torch.float64)
    site = SiteMap(0.1)
    flat = robots([(-60, -60)], cells=(160, 160), heights=lambda x, y: 0.0 * x)
    site.merge(flat)
    emap = robots(grid_of(2), heights=lambda x, y: 0.0 * x, noise=0.003)
    xy = emap.cell_centers() - emap.center[:, None, None, :2]
    emap.state.elevation.add_((xy * tilts[:, None, None]).sum(-1))
    report = site.merge(emap, tilt=True)
    torch.testing.assert_close(report.tilts, tilts, atol=0.001, rtol=0.0)
    values, valid = site.sample(emap.cell_centers()[3].flatten(0, 1), mode="nearest")
    assert valid.all() and values.abs().max() < 0.01


def test_without_alignment_heights_stay():
    emap = robots([(0, 0), (20, 0)], offsets=[0.02, -0.02])
    site = SiteMap(0.1)
    assert not site.merge(emap, align=False).offsets.any()
    value, _ = site.sample([[0.55, 0.55]], mode="nearest")
    assert float(value[0]) == pytest.approx(float(emap.elevation[0, 5, 5]), abs=1e-6)


@pytest.mark.parametrize("seed", range(3))
def test_groups_are_those_of_a_search(seed):
    rng = np.random.default_rng(seed)
    overlap = torch.from_numpy(rng.random((14, 14)) < 0.08)
    overlap = overlap | overlap.T
    expected = list(range(14))
    for start in range(14):
        queue, seen = [start], {start}
        while queue:
            k = queue.pop()
            new = {int(n) for n in overlap[k].nonzero()} - seen
            seen |= new
            queue += new
        expected[start] = min(seen)
    assert find_groups(overlap).tolist() == expected


@pytest.mark.parametrize("size", [1, 3])
@pytest.mark.parametrize("anchored", [False, True])
def test_iterations_and_a_factorisation_solve_the_same_equations(size, anchored, monkeypatch):
    generator, M = torch.Generator().manual_seed(size), 41
    overlap = torch.zeros(M, M, dtype=torch.bool)
    for k in range(39):  # a ring without one window, and the last one is the site
        overlap[k, (k + 1) % 39] = overlap[k, (k + 4) % 39] = True
    overlap[3, M - 1] = anchored
    overlap = overlap | overlap.T
    ends = overlap.triu(1).nonzero()
    columns = torch.randn(len(ends), 30, 6 if size == 3 else 2, dtype=torch.float64, generator=generator)
    columns[..., 0] = 1.0
    moments = 1e3 * (columns[..., :-1].transpose(1, 2) @ columns)
    groups, before = find_groups(overlap), torch.full((M - 1,), torch.nan, dtype=torch.float64)
    before[[2, 7]] = torch.tensor([0.3, 0.1], dtype=torch.float64)
    found = []
    for dense in (1000, 0):
        monkeypatch.setattr(normal_equations, "_DENSE", dense)
        monkeypatch.setattr(normal_equations, "_factorise", normal_equations._factorise if dense else None)
        edges, start = normal_equations.Edges(ends, M), torch.zeros(M, size, dtype=torch.float64)
        found.append(normal_equations.solve(edges, moments, groups, before, start))
    torch.testing.assert_close(found[0], found[1], rtol=0.0, atol=1e-9)
    assert not found[1][-1].any()
    if not anchored:
        assert float(found[1][[2, 7], 0].mean()) == pytest.approx(0.2, abs=1e-9)


@pytest.mark.parametrize("number", [1, 2, 100, 10_001])
def test_medians_are_found_by_counting(number):
    values = 0.02 * torch.randn(number, dtype=torch.float64, generator=torch.Generator().manual_seed(number))
    assert find_median(values, number, ALONE) == pytest.approx(float(values.abs().median()), rel=1e-3)
    assert find_median(0.0 * values, number, ALONE) == 0.0


def test_the_overlap_must_be_large_enough():
    emap = robots([(0, 0), (39, 33)], offsets=[0.1, -0.1])  # they share 1 x 3 cells
    assert SiteMap(0.1).merge(emap).is_isolated.all()
    assert not SiteMap(0.1, cfg=SiteConfig(min_overlap=3)).merge(emap).is_isolated.any()


def test_thinned_cells_give_the_same_offsets():
    emap = fill(robots(grid_of(3)), grid_of(3), ground, offsets=draw_offsets(9), noise=0.005)
    full, thinned = (SiteMap(0.1, cfg=SiteConfig(max_compared=n)).merge(emap).offsets for n in (100_000, 2000))
    torch.testing.assert_close(full, thinned, atol=0.003, rtol=0.0)
