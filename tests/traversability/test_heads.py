"""The analytic head."""

import dataclasses

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tests import reference
from tests.helpers import pose, random_state, small_config, small_map, terrain
from torchelev import TraversabilityConfig
from torchelev.pipeline import rate_surface
from torchelev.stages.surface import known_ground
from torchelev.traversability.heads import height_range


@given(st.integers(0, 10_000), st.sampled_from([0.05, 0.1, 0.2]), st.floats(0.2, 1.0), st.floats(1, 10))
def test_agrees_with_the_reference(seed, radius, known, forgiving):
    cfg = TraversabilityConfig(radius=radius, critical_step=0.2 * forgiving, critical_roughness=0.05 * forgiving)
    grid = small_map(1, (7, 6)).cfg.grid
    state = random_state(np.random.default_rng(seed), grid, 2, known)
    after = rate_surface(state, small_config((7, 6), traversability=cfg))
    got = after.traversability
    for b, i, j in np.ndindex(2, 7, 6):
        expected = 0.0
        if state.validity[b, i, j]:
            elevation, validity = state.elevation[b].numpy(), state.validity[b].numpy()
            rated = reference.traversability(elevation, validity, i, j, 0.1, **dataclasses.asdict(cfg))
            assert bool(after.rated[b, i, j]) == (rated is not None)
            expected = rated or 0.0
        assert float(got[b, i, j]) == pytest.approx(expected, abs=1e-4)  # the square roots are clamped


def test_flat_is_traversable_and_a_step_is_not():
    emap = small_map(1, (20, 10))
    state = emap.state._replace(validity=torch.ones_like(emap.validity))
    state.elevation[:, 12:] = 0.3
    result = rate_surface(state, emap.cfg).traversability
    assert result[0, :10].min() > 0.99 and result[0, 11:13].max() == 0 and result[0, 15:].min() > 0.99


@given(st.integers(0, 10_000), st.integers(1, 3))
def test_height_range(seed, radius):
    state = random_state(np.random.default_rng(seed), small_map(1, (6, 5)).cfg.grid)
    ground = known_ground(state.elevation, state.validity, radius)
    got = height_range(ground, radius)
    for i, j in np.ndindex(6, 5):
        cells = reference.window(state.validity[0].numpy(), i, j, radius)
        heights = [float(state.elevation[0, a, b]) for a, b in cells]
        if heights:
            assert float(got[0, i, j]) == pytest.approx(max(heights) - min(heights), abs=1e-6)


def test_a_map_without_the_head_knows_no_traversability():
    emap = small_map(1, traversability=None)
    cloud = torch.from_numpy(terrain(np.random.default_rng(0), 200))[None] - torch.tensor([0, 0, 1])
    emap.update(cloud, pose(), dt=0.0)
    assert emap.layer("elevation").isfinite().any()
    assert emap.layer("traversability").isnan().all()


@pytest.mark.parametrize("name", ["radius", "critical_slope", "critical_step", "critical_roughness"])
def test_refuses(name):
    with pytest.raises(ValueError, match=f"traversability.{name}"):
        TraversabilityConfig(**{name: 0.0})
