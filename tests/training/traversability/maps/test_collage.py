"""Collages: ground of random shapes."""

import numpy as np
import torch

from training.traversability.maps import collage
from training.traversability.maps.collage import make_collage
from training.traversability.maps.terrain import COLLAGE, make_tiles

AXIS = (torch.arange(201) - 100) * 0.04


def collages(count=24):
    return torch.stack([make_collage(AXIS, np.random.default_rng(seed)) for seed in range(count)])


def test_a_seed_gives_one_collage_and_another_seed_another():
    first, again = (make_collage(AXIS, np.random.default_rng(1)) for _ in range(2))
    assert torch.equal(first, again) and not torch.equal(first, make_collage(AXIS, np.random.default_rng(2)))


def test_ground_leads_up_and_down_by_steps_of_all_heights():
    ground = collages()
    assert bool(ground.isfinite().all())
    only_up, only_down = ((sign * ground).amin((1, 2)) > -0.3 for sign in (1, -1))
    assert 2 <= int(only_up.sum()) <= 16 and 2 <= int(only_down.sum()) <= 16
    highest = ground.diff(dim=1).abs().amax((1, 2))
    assert float(highest.min()) < 0.5 and float(highest.max()) > 2.0


def test_shapes_stay_where_they_were_laid(monkeypatch):
    """One level rectangle, ellipse or ring: all of it is at one height, the rest at 0, and its size is that drawn."""
    monkeypatch.setattr(collage, "_MOST", 1)
    monkeypatch.setattr(collage, "_LEVEL", 1.0)
    for seed in range(12):
        ground = make_collage(AXIS, np.random.default_rng(seed))
        places = ground.nonzero() * 0.04
        assert len(ground.unique()) <= 2
        if len(places):
            assert float((places.amax(0) - places.amin(0)).max()) <= 2 * 2**0.5 * collage._LARGEST[1]


def test_tiles_may_be_collages():
    field = make_tiles((COLLAGE, "slope"), np.random.default_rng(3))
    assert field.heights.shape == (2, 401, 401) and bool(field.heights.isfinite().all())
