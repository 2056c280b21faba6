"""Sums and extremes by slot, by torch and on a GPU by Triton."""

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
    sums = scatter.add(torch.from_numpy(index).to(device), torch.from_numpy(values).to(device), size)
    np.testing.assert_allclose(sums.cpu(), expected, atol=1e-4)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("find, compare, blank", [(scatter.lowest, min, 0.5), (scatter.highest, max, -np.inf)])
@given(*SIZES[1:], st.integers(1, 90), st.integers(0, 2**32 - 1))
def test_extremes(device, find, compare, blank, rows, number, size, seed):
    index, values = draw(seed, rows, number, size=size)
    expected = np.full((rows, size), blank, np.float32)
    for b, n in np.ndindex(values.shape):
        expected[b, index[b, n]] = compare(expected[b, index[b, n]], values[b, n])
    table = find(torch.from_numpy(index).to(device), torch.from_numpy(values).to(device), size, blank)
    np.testing.assert_array_equal(table.cpu(), expected)


def test_triton_equals_torch():
    """Triton's interpreter runs the kernels where there is no GPU: `TRITON_INTERPRET=1 pytest`."""
    triton = pytest.importorskip("triton")
    device = "cuda" if torch.cuda.is_available() else "cpu"
    if device == "cpu" and not triton.knobs.runtime.interpret:
        pytest.skip("needs a GPU, or TRITON_INTERPRET=1")
    from torchelev.ops import triton_scatter

    index, values = (torch.from_numpy(v).to(device) for v in draw(0, 2, 3, 1000, size=50))
    sums = torch.zeros(2, 3, 50, device=device)
    triton_scatter.add(sums, index, values)
    torch.testing.assert_close(sums, torch.zeros_like(sums).scatter_add_(2, index.expand(values.shape), values))
    for lowest, name, blank in ((True, "amin", 1e4), (False, "amax", -torch.inf)):
        table = torch.full((3, 50), blank, device=device)
        expected = table.scatter_reduce(1, index, values[0], name)
        triton_scatter.keep(table, index, values[0].contiguous(), lowest)
        assert torch.equal(table, expected)
