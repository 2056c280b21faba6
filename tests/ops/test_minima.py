"""Sums per cell, running minima and polar tables."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from torchelev.ops.minima import polar_minimum, running_minimum
from torchelev.ops.scatter import cell_sums

DTYPES = st.sampled_from([np.float32, np.float64])


@given(st.integers(0, 10_000), st.integers(1, 2), st.integers(1, 4), st.sampled_from([1, 2, 6, 1500]), DTYPES)
def test_running_minimum(seed, num_envs, blocks, columns, dtype):
    table = np.random.default_rng(seed).normal(size=(num_envs, 8 * blocks, columns)).astype(dtype)
    passed = torch.from_numpy(table.copy())
    expected = np.empty_like(table)
    for k in range(table.shape[1]):
        expected[:, k] = table[:, : k + 1].min(1)
    np.testing.assert_array_equal(running_minimum(passed), expected)
    np.testing.assert_array_equal(passed, table)


@given(st.integers(0, 10_000), st.integers(1, 3), st.integers(0, 40), DTYPES, st.integers(1, 2))
def test_polar_minimum(seed, num_envs, num_values, dtype, threads):
    """Range bins 0 and 1 look at 4 azimuths, 2 and 3 at two, the others at one; out of reach there is nothing."""
    rng, ranges, azimuths, blank = np.random.default_rng(seed), 8, 6, 9.0
    near, index = [4, 4, 2, 2, 1, 1, 1, 1], rng.integers(0, (ranges + 1) * azimuths, (num_envs, num_values))
    values = rng.normal(size=(num_envs, num_values)).astype(dtype)
    expected = np.full((num_envs, 2 * ranges, azimuths), blank, dtype)
    torch.set_num_threads(threads)
    for b, k, a in np.ndindex(num_envs, ranges, azimuths):
        for n in range(num_values):
            reach, azimuth = divmod(index[b, n], azimuths)
            if k <= reach < ranges and (azimuth - a) % azimuths < near[k]:
                expected[b, k, a] = min(expected[b, k, a], values[b, n])
    table = polar_minimum(torch.from_numpy(index), torch.from_numpy(values), azimuths, [4, 2], ranges, blank)
    np.testing.assert_array_equal(table, expected)


@given(st.integers(0, 10_000), st.integers(1, 3), st.integers(1, 3), st.integers(0, 20), DTYPES)
def test_cell_sums(seed, columns, num_envs, num_points, dtype):
    rng = np.random.default_rng(seed)
    index, values = rng.integers(0, 5, (num_envs, num_points)), rng.normal(size=(columns, num_envs, num_points))
    values = values.astype(dtype)
    expected = np.zeros((columns, num_envs, 5), dtype)
    for k, b, n in np.ndindex(*values.shape):
        expected[k, b, index[b, n]] += values[k, b, n]
    np.testing.assert_array_equal(cell_sums(torch.from_numpy(index), torch.from_numpy(values), 5), expected)


@pytest.mark.parametrize("index", [-1, 99])
@pytest.mark.parametrize("num_envs", [1, 3])
def test_an_index_out_of_range_is_refused(index, num_envs):
    slots, values = torch.full((num_envs, 2), index), torch.ones(num_envs, 2)
    with pytest.raises((IndexError, RuntimeError), match="index"):
        cell_sums(slots, values[None], 9)
    with pytest.raises((IndexError, RuntimeError), match="index"):
        polar_minimum(slots, values, 4, [3, 1], 8, 9.0)


def test_unknown_numbers_stay_unknown():
    """NaN, as in torch's own minima and sums, wherever C++ looks at it."""
    table = torch.tensor([3.0, torch.nan, 1.0, 0, 0, 0, 0, 0]).view(1, 8, 1)
    assert running_minimum(table)[0, :, 0].isnan().tolist() == [False] + 7 * [True]
    index, values = torch.tensor([[12, 0]]), torch.tensor([[torch.nan, 1.0]])
    assert polar_minimum(index, values, 4, [3, 1], 8, 9.0)[0, :4, 0].isnan().all()
    assert cell_sums(index, values[None], 13)[0, 0, 12].isnan()


def test_gradient_of_cell_sums():
    index = torch.tensor([[0, 2, 2, 1], [1, 1, 1, 3]])
    values = torch.randn(3, 2, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(0), requires_grad=True)
    assert torch.autograd.gradcheck(lambda v: cell_sums(index, v, 4), (values,))
