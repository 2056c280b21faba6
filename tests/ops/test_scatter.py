"""Sums and extremes by slot."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from torchelev.ops import scatter

DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.skipif(not torch.cuda.is_available(), reason="needs CUDA"))]
SIZES = st.integers(1, 3), st.integers(1, 4), st.integers(0, 1500)


def draw(seed, *shape, size):
    """Random slots and values, of which a third is 0, and some -0.0."""
    rng = np.random.default_rng(seed)
    values = rng.normal(size=shape).astype(np.float32)
    values[rng.random(shape) < 0.3] = 0.0
    values[rng.random(shape) < 0.05] = -0.0
    return rng.integers(size, size=shape[-2:]), values


@pytest.mark.parametrize("device", DEVICES)
@given(*SIZES, st.integers(1, 90), st.integers(0, 2**32 - 1))
def test_sums(device, columns, rows, number, size, seed):
    index, values = draw(seed, columns, rows, number, size=size)
    expected = np.zeros((columns, rows, size))
    for k, b, n in np.ndindex(values.shape):
        expected[k, b, index[b, n]] += values[k, b, n]
    sums = scatter.cell_sums(torch.from_numpy(index).to(device), torch.from_numpy(values).to(device), size)
    np.testing.assert_allclose(sums.cpu(), expected, atol=1e-4)


@pytest.mark.parametrize("device", DEVICES)
@given(*SIZES[1:], st.integers(1, 90), st.integers(0, 2**32 - 1))
def test_extremes(device, rows, number, size, seed):
    index, values = (torch.from_numpy(drawn).to(device) for drawn in draw(seed, rows, number, size=size))
    found = scatter.lowest(index, values, size, 0.5), scatter.highest_per_cell(index, values, size)
    for table, compare, blank in zip(found, (min, max), (0.5, -np.inf), strict=True):
        expected = np.full((rows, size), blank, np.float32)
        for b, n in np.ndindex(*values.shape):
            expected[b, index[b, n]] = compare(expected[b, index[b, n]], values[b, n].item())
        np.testing.assert_array_equal(table.cpu(), expected)
