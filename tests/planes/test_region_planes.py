"""Planes of regions against least squares, and the prior."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from tests.planes.surfaces import random_surface
from torchelev.planes.region_planes import distances, fit_planes
from torchelev.planes.sums import find_runs, make_surface, pad_cells, region_moments

SEEDS = st.integers(0, 10_000)


@given(SEEDS)
def test_planes_are_those_of_least_squares(seed):
    labels, surface = random_surface(seed)
    flat = pad_cells(labels, -1).ravel()
    planes = fit_planes(region_moments(surface, find_runs(flat), 4), None, 1e-9)
    cell = np.flatnonzero(flat >= 0)
    above = distances(surface, cell, planes.distance_weights()[flat[cell]])
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
    planes = fit_planes(
        region_moments(surface, find_runs(pad_cells(labels, -1).ravel()), 2), None, surface.window_moment
    )
    np.testing.assert_allclose(planes.gradient_x, [0.3, 0.3], atol=1e-9)
    assert abs(planes.gradient_y[0] + 0.1) < 1e-9 and abs(planes.gradient_y[1] - 0.5) < 0.01
