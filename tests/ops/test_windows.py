"""Sums and maxima over the window around each cell."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from torchelev.ops.windows import (
    gaussian_sum,
    neighbours,
    padded,
    sliding_maximum,
    sliding_minimum,
    sliding_sum,
    window_maximum,
    window_moments,
)

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
    moments = window_moments([(layer, 2), (layer, 0), (layer, 1), (layer, 4)], rim, radius)
    powers = [(a, b) for order in (2, 0, 1, 4) for a in range(order + 1) for b in range(order + 1 - a)]
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


@given(st.integers(1, 17), st.integers(0, 9), st.integers(0, 10_000))
def test_sliding_extrema(width, more, seed):
    values = torch.from_numpy(np.random.default_rng(seed).normal(size=(2, width + more)))
    assert torch.equal(sliding_maximum(values, width, 1), values.unfold(1, width, 1).amax(-1))
    assert torch.equal(sliding_minimum(values, width, 1), values.unfold(1, width, 1).amin(-1))


@given(st.integers(1, 17), st.integers(0, 9), st.integers(0, 10_000))
def test_sliding_sum(width, more, seed):
    values = torch.from_numpy(np.random.default_rng(seed).normal(size=(2, width + more)))
    torch.testing.assert_close(sliding_sum(values, width, 1), values.unfold(1, width, 1).sum(-1), atol=1e-12, rtol=0)


@given(st.integers(1, 6), st.floats(0.3, 4), st.integers(0, 10_000))
def test_gaussian_sum(radius, sigma, seed):
    values = torch.from_numpy(np.random.default_rng(seed).normal(size=(2, 2 * radius + 4)))
    weight = torch.exp(-0.5 * (torch.arange(-radius, radius + 1, dtype=torch.float64) / sigma) ** 2)
    expected = values.unfold(1, 2 * radius + 1, 1) @ weight
    torch.testing.assert_close(gaussian_sum(values, radius, sigma, 1), expected, atol=1e-12, rtol=0)
