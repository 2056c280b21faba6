"""Local planes and sums over regions, against least squares and loops."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from tests.planes.surfaces import random_surface
from torchelev.planes.sums import find_runs, pad_cells, region_moments

SEEDS = st.integers(0, 10_000)


@given(SEEDS)
def test_moments_are_sums_over_cells(seed):
    labels, surface = random_surface(seed)
    moments = region_moments(surface, find_runs(pad_cells(labels, -1).ravel()), 4)
    x, y, z, gx, gy = (v.reshape(labels.shape[0] + 1, -1)[:-1, :-1] for v in surface[2:7])
    for k in range(4):
        mine = labels == k
        a, b, c = x[mine], y[mine], z[mine]
        terms = [np.ones(mine.sum()), a, b, c, a * a, a * b, b * b, a * c, b * c, c * c, gx[mine], gy[mine]]
        np.testing.assert_allclose(moments[:, k], [t.sum() for t in terms], atol=1e-9)
