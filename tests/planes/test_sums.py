"""Local planes and sums over regions, against least squares and loops."""

import numpy as np
import torch
from hypothesis import given
from hypothesis import strategies as st

from tests import reference
from torchelev.planes.fits import Limits, local_planes, window_radius
from torchelev.planes.sums import distances, find_runs, fit_planes, make_surface, region_moments, rimmed

SEEDS = st.integers(0, 10_000)
LIMITS = Limits(slope=0.7, roughness=0.01, distance=0.025, curvature=2.0)


def random_surface(seed, regions=4):
    """Labels (H, W) in blotches, and the surface that they are of."""
    rng = np.random.default_rng(seed)
    H, W = rng.integers(2, 12, 2)
    labels = np.kron(rng.integers(-1, regions, (H, W)), np.ones((1, 2), int))
    z, gx, gy = rng.normal(size=(3, *labels.shape))
    return labels, make_surface(labels >= 0, z, gx, gy, 0.1, 1)


def test_windows_are_in_metres():
    expected = {0.02: 4, 0.04: 2, 0.05: 1, 0.06: 1, 0.1: 1, 0.2: 1}  # 9, 5, 3, ... cells of at most 0.2 m, at least 3
    assert {resolution: window_radius(0.2, resolution) for resolution in expected} == expected


@given(SEEDS, st.sampled_from([1, 2]))
def test_local_planes_are_those_of_least_squares(seed, radius):
    rng = np.random.default_rng(seed)
    H, W = 9, 8
    x, y = np.meshgrid(np.arange(H) * 0.1, np.arange(W) * 0.1, indexing="ij")
    z = 0.8 * rng.uniform(-1, 1) * x + 0.5 * rng.uniform(-1, 1) * y + rng.normal(0, 0.008, (H, W)) + 0.1 * (x > 0.5)
    known = rng.uniform(size=(H, W)) < rng.choice([0.5, 0.8, 1.0])
    args = torch.from_numpy(np.where(known, z, np.nan))[None], torch.from_numpy(known)[None], 0.1, radius, LIMITS
    local = local_planes(*args)
    for i, j in np.ndindex(H, W):
        window = np.s_[max(0, i - radius) : i + radius + 1, max(0, j - radius) : j + radius + 1]
        inside = known[window]
        A = np.column_stack([x[window][inside], y[window][inside], np.ones(inside.sum())])
        g = np.linalg.lstsq(A, z[window][inside], rcond=None)[0] if inside.sum() >= 3 else np.zeros(3)
        rms = np.sqrt(np.mean((A @ g - z[window][inside]) ** 2)) if inside.any() else 0
        steepness = np.hypot(g[0], g[1])
        enough = inside.sum() >= (radius + 1) ** 2
        enough = enough and reference.spans_plane(reference.window(known, i, j, radius), radius)
        limits = known[i, j], enough, steepness < 0.7, rms < 0.01 * np.hypot(1, steepness)
        assert local.planar[0, i, j] == all(limits)
        if all(limits):
            np.testing.assert_allclose(local.gradient_x[0, i, j], g[0], atol=1e-7)
            np.testing.assert_allclose(local.gradient_y[0, i, j], g[1], atol=1e-7)


def test_neighbours_are_joined_unless_step_or_bend():
    """Along x: level, then a sharp crease to a slope of 0.6; a step of 0.3 m between columns."""
    i, j = np.meshgrid(np.arange(20), np.arange(20), indexing="ij")
    z = 0.06 * np.maximum(0, i - 9.0) + 0.3 * (j >= 10)
    loose = LIMITS._replace(roughness=1.0, slope=10.0)
    local = local_planes(torch.from_numpy(z)[None], torch.ones(1, 20, 20, dtype=torch.bool), 0.1, 1, loose)
    assert local.planar.all()
    # Slopes along x at i = 8 .. 10: 0, 0.3, 0.6; along y at j = 8 .. 11: 0, 1.5, 1.5, 0, and the step itself between.
    joined = local.joined_x[0, :, 3]
    assert joined.tolist() == [k not in (8, 9) for k in range(19)]
    assert local.joined_y[0, 3].tolist() == [k not in (8, 9, 10) for k in range(19)]


def test_a_step_between_planar_windows_separates_them():
    """Windows that a gap of unknown cells keeps apart from the step: heights alone disagree."""
    z = np.zeros((1, 2, 9, 9))[0]
    z[:, :, 5:] = 0.04
    known = np.ones((2, 9, 9), bool)
    loose = LIMITS._replace(roughness=1.0, curvature=100.0)
    local = local_planes(torch.from_numpy(z * [[[1]], [[10]]]), torch.from_numpy(known), 0.1, 1, loose)
    assert local.joined_y[0].all() and not local.joined_y[1, :, 4].any()


@given(SEEDS)
def test_moments_are_sums_over_cells(seed):
    labels, surface = random_surface(seed)
    moments = region_moments(surface, find_runs(rimmed(labels, -1).ravel()), 4)
    x, y, z, gx, gy = (v.reshape(labels.shape[0] + 1, -1)[:-1, :-1] for v in surface[2:7])
    for k in range(4):
        mine = labels == k
        a, b, c = x[mine], y[mine], z[mine]
        terms = [np.ones(mine.sum()), a, b, c, a * a, a * b, b * b, a * c, b * c, c * c, gx[mine], gy[mine]]
        np.testing.assert_allclose(moments[:, k], [t.sum() for t in terms], atol=1e-9)


@given(SEEDS)
def test_planes_are_those_of_least_squares(seed):
    labels, surface = random_surface(seed)
    flat = rimmed(labels, -1).ravel()
    planes = fit_planes(region_moments(surface, find_runs(flat), 4), None, 1e-9)
    cell = np.flatnonzero(flat >= 0)
    above = distances(surface, cell, planes.forms()[flat[cell]])
    for k in range(4):
        mine = cell[flat[cell] == k]
        if len(mine) < 4 or np.ptp(surface.x[mine]) == 0 or np.ptp(surface.y[mine]) == 0:
            continue
        A = np.column_stack([surface.x[mine], surface.y[mine], np.ones(len(mine))])
        if np.linalg.matrix_rank(A, tol=1e-3) < 3:
            continue
        g = np.linalg.lstsq(A, surface.z[mine], rcond=None)[0]
        distance = (surface.z[mine] - A @ g) / np.sqrt(1 + g[0] ** 2 + g[1] ** 2)
        np.testing.assert_allclose(above[flat[cell] == k], distance, atol=1e-5)
        np.testing.assert_allclose(planes.roughness[k], np.sqrt(np.mean(distance**2)), atol=1e-5)
        extent = ((A[:, :2] - A[:, :2].mean(0)) ** 2).sum(1).mean()
        np.testing.assert_allclose(planes.extent[k], extent, atol=1e-9)


def test_windows_decide_where_cells_do_not():
    """One cell: its window's gradient. A line along y: the window's along x, its own along y as far as it is long."""
    gx, gy = np.full((3, 30), 0.3), np.full((3, 30), -0.1)
    y = np.tile(np.arange(30) * 0.1, (3, 1))
    surface = make_surface(np.ones((3, 30), bool), 0.5 * y, gx, gy, 0.1, 1)
    labels = np.full((3, 30), -1)
    labels[0, 4], labels[2] = 0, 1
    planes = fit_planes(region_moments(surface, find_runs(rimmed(labels, -1).ravel()), 2), None, surface.weight)
    np.testing.assert_allclose(planes.gradient_x, [0.3, 0.3], atol=1e-9)
    assert abs(planes.gradient_y[0] + 0.1) < 1e-9 and abs(planes.gradient_y[1] - 0.5) < 0.01
