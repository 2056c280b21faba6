"""Choosing and counting by masks."""

import pytest
import torch

from torchelev.ops.masks import NOWHERE, count, where_finite

DTYPES = [torch.float16, torch.bfloat16, torch.float32, torch.float64]
MASK = torch.rand(3, 5, 7, generator=torch.Generator().manual_seed(1)) > 0.5


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("mask", [MASK, MASK[:1], MASK.transpose(0, 1).contiguous().transpose(0, 1)])
def test_where_finite_chooses_to_the_bit(dtype, mask):
    values = torch.randn(3, 5, 7, generator=torch.Generator().manual_seed(0)).to(dtype)
    others = 1e4 * values.flip(0)
    assert torch.equal(where_finite(mask, values, others), torch.where(mask, values, others))
    assert torch.equal(where_finite(mask, values, others[0]), torch.where(mask, values, others[0]))
    assert torch.equal(where_finite(mask, values, 0.1), torch.where(mask, values, 0.1))
    assert where_finite(mask, values, 0.1).dtype == dtype


def test_float16_holds_nowhere():
    assert torch.isfinite(torch.tensor(NOWHERE, dtype=torch.float16))


def test_gradients_of_where_finite_are_those_of_a_choice():
    values = torch.randn(3, 5, 7, dtype=torch.float64, requires_grad=True)
    others = values.detach().clone().requires_grad_()
    where_finite(MASK, values, 3 * others).sum().backward()
    assert torch.equal(values.grad, MASK.double())
    assert torch.equal(others.grad, 3.0 * ~MASK)


def test_count_counts_in_each_environment():
    assert count(MASK).tolist() == [int(part.sum()) for part in MASK]
    assert count(MASK).dtype == torch.int64
