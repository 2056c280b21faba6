"""Other floors near the robot."""

import numpy as np
import pytest
import reference
import torch
from conftest import nans, pose, random_state, small_map
from hypothesis import given
from hypothesis import strategies as st

from torchelev import OverlapConfig
from torchelev.grid import recenter
from torchelev.overlap import clear_other_floors


@given(st.integers(0, 10_000), st.floats(0.1, 0.8), st.floats(0.05, 0.4))
def test_agrees_with_the_reference(seed, radius, height):
    rng = np.random.default_rng(seed)
    emap = small_map(2, (7, 6), dtype=torch.float64)
    T = torch.cat([pose((*rng.uniform(-2, 2, 2), rng.uniform(-0.3, 0.3))) for _ in range(2)])
    m = emap.measure(nans(2), T, T, 0.1)
    corner = recenter(emap.state, m, emap.cfg.grid).corner
    state = random_state(rng, emap.cfg.grid, 2)._replace(corner=corner)
    after = clear_other_floors(state, m, emap.cfg.grid, OverlapConfig(radius=radius, height=height))
    for b in range(2):
        layers = {n: getattr(state, n)[b].numpy() for n in ("elevation", "upper_bound", "validity", "bounded")}
        args = (T[b, :3, 3].numpy(), corner[b].tolist(), 0.1, radius, height)
        validity, bounded, cleared = reference.clear_other_floors(layers, *args)
        np.testing.assert_array_equal(after.validity[b], validity)
        np.testing.assert_array_equal(after.bounded[b], bounded)
        assert after.statistics.cleared_other_floors[b] == cleared


def upstairs_map():
    """A map at z = 0 of which everything is known, and a robot 3 m above it."""
    emap = small_map(1)
    emap._store(random_state(np.random.default_rng(0), emap.cfg.grid, known=1.0))
    return emap, pose((0, 0, 3.0))


def test_update_clears_the_floor_below():
    emap, T = upstairs_map()
    emap.update(nans(1), T, T, 0.1)
    assert emap.layer("elevation").isnan().all() and emap.statistics.cleared_other_floors.item() == 120


def test_without_a_base_nothing_is_cleared():
    emap, T = upstairs_map()
    emap.update(nans(1), T, None, 0.1)
    assert not emap.layer("elevation").isnan().any() and emap.statistics.cleared_other_floors.item() == 0


def test_the_count_is_that_of_the_last_update():
    emap, T = upstairs_map()
    emap.update(nans(1), T, T, 0.1)
    emap.update(nans(1), T, None, 0.1)
    assert emap.statistics.cleared_other_floors.item() == 0


def test_bounds_that_were_cleared_do_not_count():
    emap, T = upstairs_map()
    emap.validity.fill_(False)
    emap.bounded.fill_(True)
    emap.update(nans(1), T, T, 0.1)
    assert emap.layer("upper_bound").isnan().all() and emap.statistics.cells_bounded.item() == 0


@pytest.mark.parametrize("bad", [dict(radius=0.0), dict(height=-1.0)])
def test_refuses(bad):
    with pytest.raises(ValueError, match=f"overlap.{next(iter(bad))}"):
        OverlapConfig(**bad)
