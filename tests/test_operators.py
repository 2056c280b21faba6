"""Sums per cell and window, running minima and pyramids: operators of their own."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from torchelev.operators import azimuth_pyramid, cell_sums, moment_orders, running_minimum, window_moments

SIZES = st.tuples(st.integers(1, 2), st.integers(1, 7), st.integers(1, 6))


@given(st.integers(0, 10_000), SIZES, st.integers(1, 4), st.integers(0, 2))
def test_window_moments_are_sums_over_the_window(seed, shape, radius, order):
    values = np.random.default_rng(seed).normal(size=shape)
    moments = window_moments(torch.from_numpy(values), radius, order)
    offsets = range(-radius, radius + 1)
    for k, (a, b) in enumerate(moment_orders(order)):
        for env, i, j in np.ndindex(*shape):
            near = [
                u**a * v**b * values[env, i + u, j + v]
                for u in offsets
                for v in offsets
                if 0 <= i + u < shape[1] and 0 <= j + v < shape[2]
            ]
            assert float(moments[k, env, i, j]) == pytest.approx(sum(near), abs=1e-9)


@given(st.integers(0, 10_000), SIZES, st.booleans())
def test_running_minimum(seed, shape, from_end):
    table = np.random.default_rng(seed).normal(size=shape)
    passed = torch.from_numpy(table.copy())
    expected = np.empty_like(table)
    for k in range(shape[1]):
        expected[:, k] = (table[:, k:] if from_end else table[:, : k + 1]).min(1)
    np.testing.assert_array_equal(running_minimum(passed, from_end), expected)
    np.testing.assert_array_equal(passed, table)


@given(st.integers(0, 10_000), st.integers(1, 3), st.integers(1, 3), st.integers(0, 20))
def test_cell_sums(seed, columns, num_envs, num_points):
    rng = np.random.default_rng(seed)
    index, values = rng.integers(0, 5, (num_envs, num_points)), rng.normal(size=(columns, num_envs, num_points))
    expected = np.zeros((columns, num_envs, 5))
    for k, b, n in np.ndindex(*values.shape):
        expected[k, b, index[b, n]] += values[k, b, n]
    np.testing.assert_allclose(cell_sums(torch.from_numpy(index), torch.from_numpy(values), 5), expected)


def test_azimuth_pyramid():
    table = torch.tensor([[[5.0, 3.0, 4.0, 1.0, 7.0, 8.0, 9.0, 6.0]]])
    assert azimuth_pyramid(table, 2).tolist() == [[table[0, 0].tolist() + [3, 1, 7, 6] + [1, 6]]]


def test_gradient_of_cell_sums():
    index = torch.tensor([[0, 2, 2, 1], [1, 1, 1, 3]])
    values = torch.randn(3, 2, 4, dtype=torch.float64, generator=torch.Generator().manual_seed(0), requires_grad=True)
    assert torch.autograd.gradcheck(lambda v: cell_sums(index, v, 4), (values,))


@pytest.mark.parametrize("order", [0, 1, 2])
def test_gradient_of_window_moments(order):
    values = torch.randn(2, 4, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0), requires_grad=True)
    assert torch.autograd.gradcheck(lambda v: window_moments(v, 2, order), (values,))


TABLE = torch.linspace(0, 1, 40).view(2, 5, 4)


@pytest.mark.parametrize(
    "operator, arguments",
    [
        ("window_moments", (TABLE, 1, 2)),
        ("running_minimum", (TABLE, True)),
        ("running_minimum", (TABLE, False)),
        ("azimuth_pyramid", (TABLE, 2)),
        ("azimuth_pyramid", (TABLE, 0)),
        ("cell_sums", (torch.tensor([[0, 1], [1, 1]]), torch.ones(3, 2, 2), 2)),
    ],
)
def test_operators_are_registered_right(operator, arguments):
    """Fake shapes, aliasing and compilation, as torch checks them."""
    torch.library.opcheck(getattr(torch.ops.torchelev, operator).default, arguments)
