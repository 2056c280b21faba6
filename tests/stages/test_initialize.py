"""A first guess of the ground from the feet."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tests import reference
from tests.helpers import nans, pose, small_map
from torchelev.stages.initialize import interpolate

FEET = torch.tensor([[0.4, 0.3, 0.0], [0.4, -0.3, 0.1], [-0.4, 0.3, 0.2], [-0.4, -0.3, 0.1]])  # on no plane


def random_feet(seed, num_envs=2, number=4):
    rng = np.random.default_rng(seed)
    return np.dstack([rng.uniform(-0.5, 0.5, (num_envs, number, 2)), rng.uniform(-0.2, 0.2, (num_envs, number, 1))])


@pytest.mark.slow(1)
@given(st.integers(0, 10_000), st.integers(1, 6))
def test_nearest_agrees_with_the_reference(seed, number):
    emap = small_map(2)
    feet = random_feet(seed, number=number)
    emap.initialize(torch.from_numpy(feet), method="nearest")
    for b, i, j in np.ndindex(2, 12, 10):
        expected = reference.nearest_foot(*emap.cell_centers()[b, i, j].tolist(), feet[b])
        assert float(emap.elevation[b, i, j]) == pytest.approx(expected, abs=1e-6)
    assert emap.validity.all()


@given(st.integers(0, 10_000), st.floats(-0.5, 0.5), st.floats(-0.5, 0.5))
def test_linear_gives_the_plane_that_the_feet_stand_on(seed, gx, gy):
    emap = small_map(1)
    feet = random_feet(seed, 1)
    feet[..., 2] = gx * feet[..., 0] + gy * feet[..., 1] + 0.1
    emap.initialize(torch.from_numpy(feet))
    x, y = emap.cell_centers()[0].unbind(-1)
    known = emap.validity[0]
    assert known.any()
    span = np.linalg.svd(feet[0, :, :2] - feet[0, :, :2].mean(0))[1]
    if span[1] > 0.1:  # feet near one line do not determine the slope across it
        expected = (gx * x + gy * y + 0.1)[known].float()
        torch.testing.assert_close(emap.elevation[0][known], expected, atol=1e-4, rtol=0)
        at = emap.cell_centers()[0, 6, 5].tolist()
        assert reference.feet_plane(*at, feet[0]) == pytest.approx(gx * at[0] + gy * at[1] + 0.1)


def test_linear_reaches_every_foot_and_stays_between_them():
    height, inside = interpolate(FEET[None, :, :2], FEET[None], "linear", 0.1)
    torch.testing.assert_close(height[0], FEET[:, 2], atol=1e-5, rtol=0)
    places = torch.tensor([[[0.0, 0.0], [0.55, 0.0], [0.45, 0.0], [0.0, -0.45]]])
    assert interpolate(places, FEET[None], "linear", 0.1)[1].tolist() == [[True, False, True, False]]


@pytest.mark.parametrize("number", [1, 2, 3])
@pytest.mark.parametrize("method", ["linear", "nearest"])
def test_few_feet(number, method):
    emap = small_map(2)
    emap.initialize(FEET[None, :number].repeat(2, 1, 1), method=method)
    known = emap.layer("elevation")[emap.validity]
    assert len(known) and known.isfinite().all() and known.min() >= -0.06 and known.max() <= 0.26


def test_only_unknown_cells_are_founded():
    emap = small_map(1)
    emap.validity[:, :6] = True
    emap.elevation[:, :6] = 9.0
    emap.initialize(FEET[None], method="nearest")
    assert (emap.elevation[:, :6] == 9.0).all() and emap.elevation[:, 6:].abs().max() <= 0.3
    assert (emap.variance[:, 6:] == emap.cfg.fusion.max_variance).all()


def test_the_first_measurement_wins():
    emap = small_map(1)
    emap.initialize(FEET[None] * torch.tensor([1, 1, 0]) + torch.tensor([0, 0, 0.04]), method="nearest")
    x, y = np.meshgrid(np.arange(-0.58, 0.6, 0.04), np.arange(-0.48, 0.5, 0.04), indexing="ij")
    cloud = torch.from_numpy(np.column_stack([x.ravel(), y.ravel(), np.full(x.size, -1.0)]))[None]
    emap.update(cloud, pose(), None, 0.1)
    assert emap.layer("elevation").abs().max() < 2e-3


def test_far_from_the_origin():
    emap = small_map(1)
    T = pose((1e5, -1e5, 1.0))
    emap.update(nans(1), T, T, 0.1)
    emap.initialize(FEET[None].double() + torch.tensor([1e5, -1e5, 0.0], dtype=torch.float64))
    near = small_map(1)
    near.initialize(FEET[None].double())
    torch.testing.assert_close(emap.layer("elevation"), near.layer("elevation"), atol=1e-5, rtol=0, equal_nan=True)


@pytest.mark.parametrize(
    "feet, method, named",
    [
        (FEET, "linear", "feet"),
        (FEET[None].repeat(3, 1, 1), "linear", "feet"),
        (FEET[None, :0], "linear", "feet"),
        (FEET[None] * torch.nan, "linear", "feet"),
        (FEET[None], "cubic", "method"),
    ],
)
def test_refuses(feet, method, named):
    emap = small_map(1)
    with pytest.raises(ValueError, match=named):
        emap.initialize(feet, method=method)
    assert not emap.validity.any()


def test_cells_around_a_place_are_forgotten():
    emap = small_map(2)
    emap.initialize(torch.from_numpy(random_feet(0)), method="nearest")
    other = emap.elevation[1].clone()
    emap.clear_around(torch.tensor([[0.1, 0.0], [50.0, 0.0]]), 0.3)
    away = np.linalg.norm(emap.cell_centers()[0].numpy() - [0.1, 0.0], axis=-1)
    assert (emap.validity[0].numpy() == (away > 0.3)).all() and (away <= 0.3).sum() > 10
    assert torch.equal(emap.elevation[1], other) and bool(emap.validity[1].all())
    for name in ("elevation", "traversability", "normal_z", "time"):
        assert bool(torch.isnan(emap.layer(name)[0][torch.from_numpy(away <= 0.3)]).all())


@pytest.mark.parametrize(
    "center, radius, words",
    [
        (torch.zeros(2), 1.0, r"center: expected \(1, 2\), got \(2,\)"),
        (torch.full((1, 2), torch.nan), 1.0, "center: must be finite, got NaN"),
        (torch.zeros(1, 2), 0.0, "radius: must be a positive number, got 0.0"),
        (torch.zeros(1, 2), float("nan"), "radius: must be a positive number"),
    ],
)
def test_places_that_do_not_fit_are_refused(center, radius, words):
    with pytest.raises(ValueError, match=words):
        small_map(1).clear_around(center, radius)
