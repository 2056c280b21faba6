"""Layers from and to values with NaN, window sizes, and what is refused."""

import pytest
import torch

from torchelev.filters import FILTERS, as_layer, as_nan
from torchelev.filters.layer_tools import radius_cells


def test_layers_from_and_to_values_with_nan():
    values = torch.tensor([[[1.0, torch.nan, torch.inf]]])
    layer = as_layer(values)
    assert layer[0].tolist() == [[[1.0, 0.0, 0.0]]] and layer[1].tolist() == [[[True, False, False]]]
    torch.testing.assert_close(as_nan(layer), torch.tensor([[[1.0, torch.nan, torch.nan]]]), equal_nan=True)


def test_windows_in_cells():
    assert [radius_cells(0.1, r) for r in (0.02, 0.04, 0.08, 0.5)] == [5, 2, 1, 1]
    with pytest.raises(ValueError, match="radius: must be a positive number"):
        radius_cells(0.0, 0.1)


def test_a_tensor_is_no_layer():
    with pytest.raises(TypeError, match="gaussian, layer 0: must be a layer .*got Tensor; make one .*as_layer"):
        FILTERS["gaussian"](torch.zeros(2, 3, 3), resolution=0.1)
