"""Maps of walks and of the true heights."""

import math

import numpy as np
import pytest
import torch

from tests.helpers import pose
from tests.training.traversability.small import TINY
from training.traversability.maps.mapping import (
    EXACT_NOISE,
    DataConfig,
    blank_map,
    exact_maps,
    tile_cell_centers,
)
from training.traversability.maps.terrain import (
    make_tiles,
)

SMALL = TINY(looks=(3, 3))


def test_a_cells_true_place_is_the_one_relative_to_the_robot():
    emap = blank_map(0.1, 4.0, 1)
    T_map_base = pose((10.0, 0.0, 3.0))
    T_tile_base = pose((1.0, 2.0, 0.0), yaw=math.pi / 2)
    emap.update(torch.full((1, 1, 3), torch.nan), T_map_base, T_map_base, dt=0.0)
    places = tile_cell_centers(emap, T_tile_base @ torch.linalg.inv(T_map_base))[0].view(-1, 2)
    cells = emap.cell_centers()[0].view(-1, 2)
    at = int(((cells - torch.tensor([11.05, 0.05])).norm(dim=1)).argmin())
    # One metre ahead of the robot, who looks along +y in the tile.
    torch.testing.assert_close(cells[at], torch.tensor([11.05, 0.05], dtype=torch.float64))
    torch.testing.assert_close(places[at], torch.tensor([0.95, 3.05], dtype=torch.float64))


@pytest.mark.parametrize("seed", [0, 1])
def test_exact_maps_know_the_true_heights_to_their_variance(seed):
    field = make_tiles(("boxes", "stairs_up"), np.random.default_rng(seed))
    emap, T_tile_map = exact_maps(field, 0.05, SMALL, np.random.default_rng(seed))
    truth = field.height(torch.arange(2), tile_cell_centers(emap, T_tile_map).float().flatten(1, 2)).view(2, 40, 40)
    errors, state = (emap.state.elevation - truth).std((1, 2)), emap.state
    assert state.validity.all() and (state.variance.amax((1, 2)) == state.variance.amin((1, 2))).all()
    torch.testing.assert_close(errors, state.variance[:, 0, 0].sqrt(), rtol=0.1, atol=1e-5)
    assert (errors < EXACT_NOISE).all() and errors[0] != errors[1]


@pytest.mark.parametrize("bad", [{"num_maps": 0}, {"headings": 0}, {"looks": (3, 2)}, {"looks": (0, 2)}, {"window": 0}])
def test_settings_that_make_no_maps_are_refused(bad):
    with pytest.raises(ValueError, match="must be"):
        DataConfig(**bad)
