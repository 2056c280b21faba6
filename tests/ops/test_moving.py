"""Layers moved in place, by whole cells."""

import os
from unittest.mock import patch

import numpy as np
import pytest
import torch
from hypothesis import example, given
from hypothesis import strategies as st

from tests import reference
from tests.native.emulated_gpu import emulated_kernels, needs_compiler
from torchelev.ops import moving, native, on_gpu
from torchelev.ops.moving import move_in_place

SHIFTS = st.lists(st.tuples(st.integers(-6, 6), st.integers(-6, 6)), min_size=1, max_size=3)


def assert_moved(seed, shifts, H, W, kinds):
    numbers = np.random.default_rng(seed).normal(size=(len(kinds), len(shifts), H, W))
    numbers[kinds.index(torch.uint8)] = numbers[kinds.index(torch.uint8)] > 0
    layers = [torch.tensor(values, dtype=kind) for values, kind in zip(numbers, kinds, strict=True)]
    before, blanks = [layer.numpy().copy() for layer in layers], [1.0, -2.0, 0.0]
    move_in_place(layers, torch.tensor(shifts), blanks)
    for layer, old, blank in zip(layers, before, blanks, strict=True):
        for b, shift in enumerate(shifts):
            np.testing.assert_array_equal(layer[b], reference.recenter(old[b], (0, 0), shift, blank))


@given(st.integers(0, 10_000), SHIFTS, st.integers(1, 5), st.integers(1, 5), st.booleans(), st.integers(1, 2))
def test_move_in_place_agrees_with_the_reference(seed, shifts, H, W, with_native, threads):
    torch.set_num_threads(threads)
    with patch.dict(os.environ, {} if with_native else {"TORCHELEV_NATIVE": "0"}):
        assert_moved(seed, shifts, H, W, [torch.float32, torch.float64, torch.uint8])


@needs_compiler
@given(st.integers(0, 10_000), SHIFTS, st.integers(1, 9), st.integers(1, 9))
@example(0, [(-1, 0), (0, -1), (-2, 3), (1, 0), (0, 1), (2, -3)], 7, 9)
def test_kernels_move_in_place(seed, shifts, H, W):
    others = patch.object(native, "move_layers", lambda *_: False), patch.object(moving, "moved", None)
    with emulated_kernels(True), others[0], others[1]:
        assert_moved(seed, shifts, H, W, [torch.float32, torch.float32, torch.uint8])


@pytest.mark.parametrize("maps, gains", [(63, False), (64, True)])
def test_kernels_move_many_maps_alone(maps, gains):
    layer = torch.empty(maps, 2, 2)
    with emulated_kernels(True):
        assert on_gpu.gains_by_moving_in_place(layer) == gains
        assert not on_gpu.gains_by_moving_in_place(layer.double())
