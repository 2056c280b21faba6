"""Layers moved in place, by whole cells."""

import os
from unittest.mock import patch

import numpy as np
import torch
from hypothesis import given
from hypothesis import strategies as st

from tests import reference
from torchelev.ops.moving import move_in_place

SHIFTS = st.lists(st.tuples(st.integers(-6, 6), st.integers(-6, 6)), min_size=1, max_size=3)


@given(st.integers(0, 10_000), SHIFTS, st.integers(1, 5), st.integers(1, 5), st.booleans(), st.integers(1, 2))
def test_move_in_place_agrees_with_the_reference(seed, shifts, H, W, with_native, threads):
    rng = np.random.default_rng(seed)
    torch.set_num_threads(threads)
    numbers = rng.normal(size=(3, len(shifts), H, W))
    layers = [
        torch.tensor(numbers[0], dtype=torch.float32),
        torch.tensor(numbers[1]),
        torch.tensor(numbers[2] > 0).byte(),
    ]
    before, blanks = [layer.numpy().copy() for layer in layers], [1.0, -2.0, 0.0]
    with patch.dict(os.environ, {} if with_native else {"TORCHELEV_NATIVE": "0"}):
        move_in_place(layers, torch.tensor(shifts), blanks)
    for layer, old, blank in zip(layers, before, blanks, strict=True):
        for b, shift in enumerate(shifts):
            np.testing.assert_array_equal(layer[b], reference.recenter(old[b], (0, 0), shift, blank))
