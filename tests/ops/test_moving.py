"""Layers moved by whole cells."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tests import reference
from torchelev.ops.moving import move_layers

SHIFTS = st.lists(st.tuples(st.integers(-6, 6), st.integers(-6, 6)), min_size=1, max_size=6)


@given(st.integers(0, 10_000), SHIFTS, st.integers(1, 5), st.integers(1, 5), st.booleans())
def test_move_layers_agrees_with_the_reference(seed, shifts, H, W, grad):
    """By copies of few environments without a gradient, by gathering else."""
    kinds = dict(a=torch.float32, b=torch.float64, c=torch.bool, d=torch.uint8, e=torch.bool)
    numbers = np.random.default_rng(seed).normal(size=(len(kinds), len(shifts), H, W))
    layers = {
        name: torch.tensor(values if kind.is_floating_point else values > 0).to(kind)
        for (name, kind), values in zip(kinds.items(), numbers, strict=True)
    }
    blanks = {"a": 1.0, "b": -2.0}
    with torch.set_grad_enabled(grad):
        moved = move_layers(layers, torch.tensor(shifts), blanks)
    for name, layer in layers.items():
        assert moved[name].dtype == layer.dtype
        for b, shift in enumerate(shifts):
            expected = reference.recenter(layer[b].numpy(), (0, 0), shift, blanks.get(name, 0))
            np.testing.assert_array_equal(moved[name][b], expected)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision_moves_to_the_bit(dtype):
    layer = torch.arange(12, dtype=dtype).view(1, 3, 4)
    moved = move_layers({"a": layer}, torch.tensor([[1, -1]]), {"a": 7.0})["a"]
    assert torch.equal(moved[0, :2, 1:], layer[0, 1:, :3]) and (moved[0, 2] == 7).all() and (moved[0, :, 0] == 7).all()
