"""Sums and maxima over the window around each cell."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from torchelev.ops.operators import padded
from torchelev.ops.windows import neighbours, window_maximum, window_moments

SIZES = st.tuples(st.integers(1, 2), st.integers(1, 7), st.integers(1, 6))


def around(values, radius, b, i, j):
    """(u, v, value) of the window's cells that lie in the layer."""
    cells = [(u, v) for u in range(-radius, radius + 1) for v in range(-radius, radius + 1)]
    _, H, W = values.shape
    return [(u, v, values[b, i + u, j + v]) for u, v in cells if 0 <= i + u < H and 0 <= j + v < W]


@given(st.integers(0, 10_000), SIZES, st.integers(1, 4))
def test_window_moments_are_sums_over_the_window(seed, shape, radius):
    values = np.random.default_rng(seed).normal(size=shape)
    rim = radius + seed % 2
    layer = padded(torch.from_numpy(values), rim, 0.0)
    moments = window_moments([(layer, 2), (layer, 0), (layer, 1)], rim, radius)
    powers = [(0, 0), (0, 1), (0, 2), (1, 0), (1, 1), (2, 0)] + [(0, 0)] + [(0, 0), (0, 1), (1, 0)]
    assert len(moments) == len(powers)
    for moment, (a, b) in zip(moments, powers, strict=True):
        for cell in np.ndindex(*shape):
            expected = sum(u**a * v**b * value for u, v, value in around(values, radius, *cell))
            assert float(moment[cell]) == pytest.approx(expected, abs=1e-9)


@given(st.integers(0, 10_000), SIZES, st.integers(1, 4))
def test_window_maximum(seed, shape, radius):
    values = np.random.default_rng(seed).normal(size=shape)
    rim = radius + seed % 2
    layers = [padded(torch.from_numpy(v), rim, -torch.inf) for v in (values, -values)]
    highest, minus_lowest = window_maximum(layers, rim, radius)
    for cell in np.ndindex(*shape):
        window = [value for _, _, value in around(values, radius, *cell)]
        assert highest[cell] == max(window) and -minus_lowest[cell] == min(window)


def test_neighbours():
    values = torch.arange(6.0).view(1, 2, 3)
    around = torch.stack(neighbours(values, 9.0), -1)
    assert around[0, 0, 1].tolist() == [9, 9, 9, 0, 2, 3, 4, 5]
    assert around[0, 1, 2].tolist() == [1, 2, 9, 4, 9, 9, 9, 9]


@pytest.mark.parametrize("function", [lambda v: window_moments([(v, 2)], 1, 1), lambda v: window_maximum([v], 1, 1)])
def test_gradients(function):
    values = torch.randn(2, 4, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0), requires_grad=True)
    assert torch.autograd.gradcheck(function, (values,))
