"""Sums per cell, borders, running minima and polar tables: operators of their own."""

from unittest.mock import patch

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tests.native.emulated_gpu import emulated_kernels
from torchelev.native.library import find_compiler
from torchelev.ops import native, on_gpu
from torchelev.ops.moving import moved
from torchelev.ops.operators import cell_sums, padded, polar_minimum, running_minimum

DTYPES = st.sampled_from([np.float32, np.float64])  # in C++, where there is a compiler, and by tensors


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


@pytest.mark.skipif(find_compiler() is None, reason="needs a C++ compiler")
@given(
    st.integers(0, 10_000),
    st.integers(1, 3),
    st.integers(0, 40),
    st.sampled_from([[], [4, 2], [9, 5, 3, 1]]),
    st.booleans(),
)
def test_polar_minimum_by_kernels(seed, num_envs, num_values, widen, in_blocks):
    generator = torch.Generator().manual_seed(seed)
    index = torch.randint(10 * 26, (num_envs, num_values), generator=generator)
    values = torch.randn(num_envs, num_values, generator=generator)
    expected = polar_minimum(index, values, 26, widen, 9, 9.0)
    by_tensors, by_kernels = (
        patch.object(native, "polar_minimum", lambda *_: None),
        patch.object(on_gpu, "can_tabulate", lambda *_: True),
    )
    with by_tensors, by_kernels, emulated_kernels(in_blocks):
        assert torch.equal(polar_minimum(index, values, 26, widen, 9, 9.0), expected)


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


@given(
    st.lists(st.tuples(st.integers(-6, 6), st.integers(-6, 6)), min_size=1, max_size=3),
    st.sampled_from([torch.float16, torch.bfloat16, torch.float32, torch.float64]),
)
def test_moved(shifts, dtype):
    layer = torch.arange(12 * len(shifts), dtype=dtype).view(len(shifts), 3, 4)
    floats, masks = moved([layer, layer > 5], torch.tensor(shifts), [-1.0, 0.0])
    assert floats.dtype == dtype and masks.dtype == torch.bool
    for b, i, j in np.ndindex(*layer.shape):
        k, n = i + shifts[b][0], j + shifts[b][1]
        inside = 0 <= k < 3 and 0 <= n < 4
        assert floats[b, i, j] == (layer[b, k, n] if inside else -1.0)
        assert masks[b, i, j] == (layer[b, k, n] > 5 if inside else False)


def test_gradient_of_cell_sums():
    index = torch.tensor([[0, 2, 2, 1], [1, 1, 1, 3]])
    values = torch.randn(3, 2, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(0), requires_grad=True)
    assert torch.autograd.gradcheck(lambda v: cell_sums(index, v, 4), (values,))


def test_gradient_of_padded():
    values = torch.randn(2, 4, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0), requires_grad=True)
    assert torch.autograd.gradcheck(lambda v: padded(v, 2, 1.0), (values,))


TABLE = torch.linspace(0, 1, 64).view(2, 8, 4)
MARKED = torch.tensor([[0, 2, 0, 0], [1, 0, 0, 0]], dtype=torch.uint8)
SLOT = torch.tensor([[1, 1, 2], [0, 3, 0]])
POINTS = [torch.rand(2, 3, generator=torch.Generator().manual_seed(k)) + 0.1 for k in range(6)]  # see ContestedCells
POINTS[3] = (POINTS[3] > 0.5).to(torch.uint8)


@pytest.mark.parametrize(
    "operator, arguments",
    [
        ("padded", (TABLE, 1, 2.0)),
        ("running_minimum", (TABLE,)),
        ("running_minimum", (TABLE.mT.contiguous().mT,)),
        ("polar_minimum", (torch.tensor([[0, 11]]), torch.ones(1, 2), 4, [3, 1], 8, 9.0)),
        ("cell_sums", (torch.tensor([[0, 1], [1, 1]]), torch.ones(3, 2, 2), 2)),
        ("moved", ([TABLE, TABLE > 0.5], torch.tensor([[1, 0], [0, -2]]), [1.0, 0.0])),
        ("moved", ([TABLE[:1]], torch.tensor([[0, 0]]), [1.0])),
        ("pick_out", (MARKED, SLOT, POINTS)),
        ("pick_out", (MARKED[1:], SLOT[1:], [POINTS[3][1:]])),
        ("pick_out", (torch.zeros_like(MARKED), SLOT, POINTS)),
        ("pick_cells", (MARKED,)),
        ("pick_cells", (torch.zeros_like(MARKED),)),
        (
            "put_in",
            ([MARKED, MARKED.float()], torch.tensor([1, 4]), [torch.tensor([7, 8], dtype=torch.uint8), torch.ones(2)]),
        ),
        ("put_in", ([MARKED], torch.zeros(0, dtype=torch.int64), [torch.zeros(0, dtype=torch.uint8)])),
        ("realize", ([TABLE, SLOT],)),
        ("harmonic", ((TABLE > 0.5).float(), TABLE, 1e-3, 4)),
        ("lowest_of_border", (TABLE, TABLE > 0.5)),
        ("nearest_known", (TABLE > 0.5,)),
    ],
)
def test_operators_are_registered_right(operator, arguments):
    """Fake shapes, aliasing and compilation, as torch checks them."""
    torch.library.opcheck(getattr(torch.ops.torchelev, operator).default, arguments)
