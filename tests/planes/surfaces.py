"""Surfaces and labels for the tests of regions."""

import numpy as np
import pytest
from hypothesis import strategies as st

from torchelev.planes.local_planes import Limits
from torchelev.planes.region_planes import fit_planes
from torchelev.planes.sums import find_runs, make_surface, pad_cells, region_moments

pytest.importorskip("cv2")


SEEDS = st.integers(0, 10_000)


def random_surface(seed, regions=4):
    """Labels (H, W) in blotches, and the surface that they are of."""
    rng = np.random.default_rng(seed)
    H, W = rng.integers(2, 12, 2)
    labels = np.kron(rng.integers(-1, regions, (H, W)), np.ones((1, 2), int))
    z, gx, gy = rng.normal(size=(3, *labels.shape))
    return labels, make_surface(labels >= 0, z, gx, gy, 0.1, 1)


SEEDS = st.integers(0, 10_000)


LIMITS = Limits(slope=0.7, roughness=0.01, distance=0.025, curvature=2.0)


RESOLUTION = 0.05


def ground(z):
    """The surface of heights (H, W), with the gradients of central differences."""
    gx, gy = np.gradient(z, RESOLUTION)
    return make_surface(np.ones(z.shape, bool), z - z.mean(), gx, gy, RESOLUTION, 1)


def flat(labels):
    return pad_cells(np.asarray(labels), -1).ravel()


def image(labels, shape):
    return labels.reshape(shape[0] + 1, -1)[:-1, :-1]


def fit(labels, surface):
    return fit_planes(region_moments(surface, find_runs(labels), labels.max() + 1), None, surface.window_moment)


def cells(H, W):
    return np.meshgrid(np.arange(H) * RESOLUTION, np.arange(W) * RESOLUTION, indexing="ij")
