"""Sorting networks, and the lowest values of windows."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from torchelev.filters.sorting_network import lowest_of_windows, merging, run, sorting


@given(st.integers(1, 12))
def test_sorting(count):
    """A network sorts everything if it sorts all zeros and ones."""
    bits = torch.cartesian_prod(*[torch.arange(2)] * count).view(-1, count).unbind(-1)
    assert torch.equal(torch.stack(run(sorting(count), list(bits))), torch.stack(bits).sort(0).values)


@given(st.integers(1, 14), st.integers(1, 14), st.integers(1, 28))
def test_merging(first, second, keep):
    steps = [torch.arange(n + 1)[:, None] > torch.arange(n) for n in (first, second)]
    pairs = [(a, b) for a in steps[0].int() for b in steps[1].int()]
    inputs = [torch.stack([torch.cat([a.flip(0), b.flip(0)])[k] for a, b in pairs]) for k in range(first + second)]
    expected = torch.stack(inputs).sort(0).values[:keep]
    assert torch.equal(torch.stack(run(merging(first, second, keep), inputs)), expected)


@pytest.mark.parametrize("width, keep", [(1, 1), (3, 5), (5, 13), (7, 49), (9, 41)])
def test_lowest_of_windows(width, keep):
    rimmed = torch.from_numpy(np.random.default_rng(1).normal(size=(2, width + 3, width + 4)))
    windows = rimmed.unfold(1, width, 1).unfold(2, width, 1).flatten(3)
    expected = windows.sort(-1).values[..., :keep].movedim(-1, 0)
    assert torch.equal(torch.stack(lowest_of_windows(rimmed, width, keep)), expected)
