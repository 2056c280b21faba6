"""Costs of Nav2 from the traversability."""

import numpy as np
import pytest
import torch

from tests.helpers import small_map
from torchelev.io.occupancy import to_occupancy_grid


def rated(values, corner=(0, 0)):
    """A map with these traversabilities (H, W), NaN where not rated."""
    values = torch.tensor(values)
    emap = small_map(cells=tuple(values.shape), resolution=0.5)
    known = torch.isfinite(values)[None]
    ratings = torch.where(known, values[None], 0.0)
    emap.load_state(
        emap.state._replace(corner=torch.tensor([corner]), validity=known, rated=known, traversability=ratings)
    )
    return emap


def test_costs_by_hand():
    """x grows along rows of the tensor and within rows of the message; 98 (1 - t) / (1 - 0.5)."""
    grid = to_occupancy_grid(rated([[1.0, 0.75], [0.5, 0.49], [0.0, torch.nan]], corner=(20, 40)))
    assert grid.data.tolist() == [0, 98, 100, 49, 100, -1] and grid.data.dtype == np.int8
    assert (grid.info.width, grid.info.height, grid.info.resolution) == (3, 2, 0.5)
    assert grid.info.origin.position[:2] == (10.0, 20.0)


def test_the_threshold():
    values = [[0.9, 0.2]]
    assert to_occupancy_grid(rated(values), min_traversability=0.0).data.tolist() == [10, 78]
    assert to_occupancy_grid(rated(values), min_traversability=0.95).data.tolist() == [100, 100]
    for wrong in (-0.1, 1.0):
        with pytest.raises(ValueError, match="min_traversability: must be at least 0 and less than 1"):
            to_occupancy_grid(rated(values), min_traversability=wrong)
