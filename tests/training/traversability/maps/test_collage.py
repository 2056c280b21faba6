"""Collages: ground of random shapes."""

import numpy as np
import pytest
import torch

from training.traversability.maps.collage import Shapes, make_collage
from training.traversability.maps.terrain import COLLAGE, make_tiles

AXIS = (torch.arange(201) - 100) * 0.04


def collages(count, **shapes):
    return torch.stack([make_collage(AXIS, np.random.default_rng(seed), Shapes(**shapes)) for seed in range(count)])


@pytest.mark.slow(1)
def test_a_seed_gives_one_collage_and_another_seed_another():
    first, again = (make_collage(AXIS, np.random.default_rng(1)) for _ in range(2))
    assert torch.equal(first, again) and not torch.equal(first, make_collage(AXIS, np.random.default_rng(2)))


@pytest.mark.slow(5)
def test_tiles_lead_up_down_or_both_ways_by_steps_of_many_heights():
    ground = collages(60, level=1.0)
    up, down = (ground > 0).any(2).any(1), (ground < 0).any(2).any(1)
    for chosen, share in ((up & ~down, 0.3), (down & ~up, 0.3), (up & down, 0.4)):
        assert abs(float(chosen.float().mean()) - share) < 0.15
    highest = ground.abs().amax((1, 2))
    assert float(highest.min()) < 0.2 and float(highest.max()) > 2.0


def test_shapes_are_of_one_height_and_of_the_size_drawn():
    found = []
    for ground in collages(40, most=1, level=1.0, smallest=0.5, largest=(0.5, 0.5)):
        places = ground.nonzero() * 0.04
        if len(places):
            assert len(ground.unique()) == 2
            found.append(float((places.amax(0) - places.amin(0)).norm()))
    assert len(found) > 30 and 0.9 < max(found) <= 2 * 2**0.5 + 0.1


def test_tiles_may_be_collages():
    field = make_tiles((COLLAGE, "slope"), np.random.default_rng(3))
    assert field.heights.shape == (2, 401, 401) and bool(field.heights.isfinite().all())
