"""Planes of windows, and which neighbours agree."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tests import reference
from torchelev.planes.local_planes import Limits, fit_local_planes, window_radius

SEEDS = st.integers(0, 10_000)


LIMITS = Limits(slope=0.7, roughness=0.01, distance=0.025, curvature=2.0)


def test_windows_are_in_metres():
    expected = {0.02: 4, 0.04: 2, 0.05: 1, 0.06: 1, 0.1: 1, 0.2: 1}  # 9, 5, 3, ... cells of at most 0.2 m, at least 3
    assert {resolution: window_radius(0.2, resolution) for resolution in expected} == expected


@pytest.mark.slow(1)
@given(SEEDS, st.sampled_from([1, 2]))
def test_local_planes_are_those_of_least_squares(seed, radius):
    rng = np.random.default_rng(seed)
    H, W = 9, 8
    x, y = np.meshgrid(np.arange(H) * 0.1, np.arange(W) * 0.1, indexing="ij")
    z = 0.8 * rng.uniform(-1, 1) * x + 0.5 * rng.uniform(-1, 1) * y + rng.normal(0, 0.008, (H, W)) + 0.1 * (x > 0.5)
    known = rng.uniform(size=(H, W)) < rng.choice([0.5, 0.8, 1.0])
    args = torch.from_numpy(np.where(known, z, np.nan))[None], torch.from_numpy(known)[None], 0.1, radius, LIMITS
    local = fit_local_planes(*args)
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
        assert local.is_planar[0, i, j] == all(limits)
        if all(limits):
            np.testing.assert_allclose(local.gradient_x[0, i, j], g[0], atol=1e-7)
            np.testing.assert_allclose(local.gradient_y[0, i, j], g[1], atol=1e-7)


def test_neighbours_are_joined_unless_step_or_bend():
    """Along x: level, then a sharp crease to a slope of 0.6; a step of 0.3 m between columns."""
    i, j = np.meshgrid(np.arange(20), np.arange(20), indexing="ij")
    z = 0.06 * np.maximum(0, i - 9.0) + 0.3 * (j >= 10)
    loose = LIMITS._replace(roughness=1.0, slope=10.0)
    local = fit_local_planes(torch.from_numpy(z)[None], torch.ones(1, 20, 20, dtype=torch.bool), 0.1, 1, loose)
    assert local.is_planar.all()
    # Slopes along x at i = 8 .. 10: 0, 0.3, 0.6; along y at j = 8 .. 11: 0, 1.5, 1.5, 0, and the step itself between.
    joined = local.is_joined_x[0, :, 3]
    assert joined.tolist() == [k not in (8, 9) for k in range(19)]
    assert local.is_joined_y[0, 3].tolist() == [k not in (8, 9, 10) for k in range(19)]


def test_a_step_between_planar_windows_separates_them():
    """Windows that a gap of unknown cells keeps apart from the step: heights alone disagree."""
    z = np.zeros((1, 2, 9, 9))[0]
    z[:, :, 5:] = 0.04
    known = np.ones((2, 9, 9), bool)
    loose = LIMITS._replace(roughness=1.0, curvature=100.0)
    local = fit_local_planes(torch.from_numpy(z * [[[1]], [[10]]]), torch.from_numpy(known), 0.1, 1, loose)
    assert local.is_joined_y[0].all() and not local.is_joined_y[1, :, 4].any()
