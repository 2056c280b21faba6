"""Reading the map: layers and samples."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tests import reference
from tests.helpers import random_state, small_map
from torchelev.grid import GridConfig
from torchelev.layers import LAYERS, sample_layer

SEEDS = st.integers(0, 10_000)
MODES = st.sampled_from(["bilinear", "nearest"])


def filled(seed=0, num_envs=2, known=0.7, corner=((-7, 3), (1, -6)), dtype=torch.float64):
    """A map with a random state, its windows away from the origin."""
    emap = small_map(num_envs, (7, 6), dtype=dtype)
    state = random_state(np.random.default_rng(seed), emap.cfg.grid, num_envs, known, dtype)
    emap.load_state(state._replace(corner=torch.tensor(corner[:num_envs])))
    return emap


def test_a_cell_beyond_two_to_the_24th_is_that_of_the_point():
    H, W = 17, 999_983
    values, known = torch.zeros(1, H, W), torch.ones(1, 1, 1, dtype=torch.bool).expand(1, H, W)
    values[0, H - 1, W - 2] = 3.0
    point = torch.tensor([[[H - 0.5, W - 1.5]]])
    grid = GridConfig(resolution=1.0, length_x=H, length_y=W)
    for mode in ("bilinear", "nearest"):
        assert sample_layer((values, known), point, grid, mode)[0].item() == 3.0


@given(SEEDS, MODES, st.sampled_from(sorted(LAYERS)))
def test_sample_agrees_with_the_reference(seed, mode, layer):
    emap = filled(seed)
    rng = np.random.default_rng(seed + 1)
    xy = emap.center[:, None, :2].numpy() + rng.uniform(-0.5, 0.5, (2, 40, 2))
    values, valid = emap.sample(torch.from_numpy(xy), layer, mode)
    grid = emap.layer(layer)
    for b in range(2):
        known = grid[b].isfinite().numpy()
        for n in range(40):
            args = (grid[b].numpy(), known, *xy[b, n], emap.corner[b].tolist(), 0.1, mode)
            expected, expected_valid = reference.sample(*args)
            assert bool(valid[b, n]) == expected_valid
            assert float(values[b, n]) == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("mode", ["bilinear", "nearest"])
def test_sample_at_cell_centers_is_the_layer(mode):
    emap = filled(dtype=torch.float32)
    values, valid = emap.sample(emap.cell_centers().flatten(1, 2), mode=mode)
    layer = emap.layer("elevation").flatten(1)
    assert torch.equal(valid, layer.isfinite())
    torch.testing.assert_close(values, layer.nan_to_num(), atol=1e-6, rtol=0)


@pytest.mark.parametrize("dtype", [torch.float16, torch.float32, torch.float64])
def test_sample_of_bad_places_is_not_valid(dtype):
    emap = filled(known=1.0)
    far = 6e4 if dtype == torch.float16 else 1e30
    xy = torch.tensor([[far, 0.0], [-far, far], [torch.nan, 0.0], [0.0, torch.inf]], dtype=dtype).repeat(2, 1, 1)
    for mode in ("bilinear", "nearest"):
        values, valid = emap.sample(xy, mode=mode)
        assert not valid.any() and not values.any()
    assert emap.sample(xy[:, :0])[0].shape == (2, 0)


@pytest.mark.parametrize("mode", ["bilinear", "nearest"])
def test_maps_of_half_precision_are_sampled(mode):
    emap = filled(known=1.0, dtype=torch.float32).half()
    values, valid = emap.sample(emap.cell_centers().flatten(1, 2), mode=mode)
    assert values.dtype == torch.float16 and valid.all()
    torch.testing.assert_close(values, emap.elevation.flatten(1), atol=2e-3, rtol=0)


def test_sample_does_not_bleed_from_unknown_cells():
    """What an unknown cell holds reaches neither values nor gradients."""
    emap = filled(known=0.5)
    xy = emap.center[:, None, :2] + torch.rand(2, 30, 2, generator=torch.Generator().manual_seed(0)) - 0.5
    before = emap.sample(xy)
    emap.elevation[~emap.validity] = torch.nan
    after = emap.sample(xy)
    assert torch.equal(before[0], after[0]) and torch.equal(before[1], after[1])


def test_layers_are_nan_where_unknown():
    emap = filled()
    known, bounded = emap.validity, emap.bounded
    assert known.any() and (~known & bounded).any() and (~known & ~bounded).any()
    for name in ("elevation", "variance", "time", "normal_x", "normal_y", "normal_z", "traversability"):
        assert torch.equal(emap.layer(name).isfinite(), known), name
    bound = emap.layer("upper_bound")
    assert torch.equal(bound.isfinite(), known | bounded)
    assert torch.equal(bound[known], emap.elevation[known])
    assert torch.equal(bound[~known & bounded], emap.upper_bound[~known & bounded])
    assert torch.equal(emap.layer("validity"), known.double())


@pytest.mark.parametrize("name", sorted(LAYERS))
def test_layers_are_fresh(name):
    emap = filled()
    before = {n: v.clone() for n, v in emap.state_dict().items() if isinstance(v, torch.Tensor)}
    emap.layer(name).fill_(7.0)
    emap.sample(emap.cell_centers().flatten(1, 2), name)[0].fill_(7.0)
    emap.cell_centers().fill_(7.0)
    emap.center.fill_(7.0)
    assert all(torch.equal(v, emap.state_dict()[n]) for n, v in before.items())


def test_readers_take_a_state():
    emap, other = filled(0), filled(1)
    for name in LAYERS:
        torch.testing.assert_close(emap.layer(name, state=other.state), other.layer(name), equal_nan=True)
    xy = other.cell_centers().flatten(1, 2)
    assert torch.equal(emap.sample(xy, state=other.state)[0], other.sample(xy)[0])


def test_the_contract_names_these_layers():
    names = "elevation variance validity time upper_bound traversability normal_x normal_y normal_z"
    assert set(names.split()) <= LAYERS.keys()
