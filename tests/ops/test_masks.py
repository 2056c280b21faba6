"""Masks in arithmetic, against choosing element by element."""

import pytest
import torch

from torchelev.ops.masks import NOWHERE, as_factor, lifted, masked, masked_any, where_finite

DTYPES = [torch.float16, torch.bfloat16, torch.float32, torch.float64]


@pytest.fixture(params=DTYPES)
def values(request):
    return torch.randn(3, 5, 7, generator=torch.Generator().manual_seed(0)).to(request.param)


MASK = torch.rand(3, 5, 7, generator=torch.Generator().manual_seed(1)) > 0.5


@pytest.mark.parametrize("mask", [MASK, MASK[:1], MASK.transpose(0, 1).contiguous().transpose(0, 1)])
def test_masked_and_lifted_choose_to_the_bit(values, mask):
    assert torch.equal(masked(values, mask), torch.where(mask, values, 0.0))
    assert masked(values, mask).dtype == lifted(values, mask).dtype == values.dtype
    assert torch.equal(lifted(values, mask)[~mask.expand(3, 5, 7)], values[~mask.expand(3, 5, 7)])
    assert (lifted(values, mask)[mask.expand(3, 5, 7)] > NOWHERE - 300).all()


@pytest.mark.parametrize("other", [torch.nan, torch.inf, -torch.inf])
def test_masked_any_leaves_nothing_of_other_values(values, other):
    values = torch.where(MASK, values, other).requires_grad_()
    kept = masked_any(values, MASK)
    assert torch.equal(kept, torch.where(MASK, values, 0.0))
    kept.sum().backward()
    assert torch.equal(values.grad, MASK.to(values.dtype))


@pytest.mark.parametrize("mask", [MASK, MASK[:1], MASK.transpose(0, 1).contiguous().transpose(0, 1)])
def test_chosen_chooses_to_the_bit(values, mask):
    others = 1e4 * values.flip(0)
    assert torch.equal(where_finite(mask, values, others), torch.where(mask, values, others))
    assert torch.equal(where_finite(mask, values, others[0]), torch.where(mask, values, others[0]))
    assert torch.equal(where_finite(mask, values, 0.1), torch.where(mask, values, 0.1))
    assert where_finite(mask, values, 0.1).dtype == values.dtype


def test_float16_holds_nowhere():
    assert torch.isfinite(torch.tensor(NOWHERE, dtype=torch.float16))


def test_gradients_are_those_of_a_choice():
    values = torch.randn(3, 5, 7, dtype=torch.float64, requires_grad=True)
    (masked(values, MASK) + lifted(values, MASK) * as_factor(~MASK)).sum().backward()
    assert torch.equal(values.grad, torch.ones_like(values))
    others = values.detach().clone().requires_grad_()
    where_finite(MASK, values, 3 * others).sum().backward()
    assert torch.equal(values.grad, 1.0 + MASK)
    assert torch.equal(others.grad, 3.0 * ~MASK)
