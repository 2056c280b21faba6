"""The two smooth layers of TAMOLS."""

import pytest
import torch
from hypothesis import given

from tests.filters.filter_cases import (
    ALL_OR_NOTHING_KNOWN,
    SEEDS,
    SHARES,
    SMALL_MAPS,
    assert_batch_is_single,
    assert_gradients,
    assert_never_waits,
    assert_runs_on_small_maps,
    random_layer,
    resolution_spread,
)
from torchelev.filters.smoothing import median
from torchelev.filters.virtual_floor import smooth_ground, virtual_floor

FLOORS = [smooth_ground, virtual_floor]


@pytest.mark.parametrize("function, tolerance", [(smooth_ground, 0.005), (virtual_floor, 0.02)])
def test_resolution_independence_of_floors(function, tolerance):
    settings = dict(median_radius=0.08, blur_radius=0.16)
    assert resolution_spread(lambda layer, r: function(layer, resolution=r, **settings)) < tolerance


@pytest.mark.parametrize("altitude", [0.0, 500.0])
def test_the_two_layers_of_the_floor_grow_in_smoothness(altitude):
    """Stepping stones with gaps, and one artifact: the first layer has no artifact, the second no gaps."""
    x = torch.arange(50) * 0.04
    stones = torch.where(torch.remainder(x, 0.48) < 0.32, 0.2, -0.3).repeat(50, 1)
    stones[20, 20] = 3.0
    raw = (stones[None] + altitude, torch.ones(1, 50, 50, dtype=torch.bool))
    layers = [raw[0], *(function(raw, resolution=0.04)[0] for function in FLOORS)]
    inner = [values[0, 8:-8, 8:-8] for values in layers]
    slopes = [float((z[:, 1:] - z[:, :-1]).abs().max()) for z in inner]
    assert slopes[0] > 2 * slopes[1] > 4 * slopes[2]
    assert inner[1].max() < altitude + 0.2 + 1e-3 and inner[1].min() < altitude - 0.1
    assert (inner[2] - altitude - 0.2).abs().max() < 1e-3


@given(SEEDS, SHARES)
def test_the_virtual_floor_lies_nowhere_below_the_median(seed, share):
    layer = random_layer(seed, (2, 9, 8), share)
    floor = virtual_floor(layer, resolution=0.1, dilation_radius=0.2, blur_radius=0.2)[0]
    assert (floor >= median(layer, resolution=0.1, radius=0.1)[0] - 1e-9).all()


@pytest.mark.slow(1)
@pytest.mark.parametrize("function", FLOORS)
def test_batch_is_single_and_gradients(function):
    def run(layer):
        return function(layer, resolution=0.1)

    layer = random_layer(5, (2, 6, 5), 0.7)
    assert_batch_is_single(run, layer, atol=1e-12)  # heights are taken from each map's mean
    assert_gradients(run, layer)


@pytest.mark.parametrize("function", FLOORS)
@SMALL_MAPS
@ALL_OR_NOTHING_KNOWN
def test_windows_larger_than_the_map(function, shape, share):
    assert_runs_on_small_maps(function, shape, share)


@pytest.mark.parametrize("function", FLOORS)
def test_refuses_a_radius_that_is_not_positive(function):
    with pytest.raises(ValueError, match="radius: must be a positive number, got 0"):
        function(random_layer(1), resolution=0.1, blur_radius=0)


@pytest.mark.parametrize("function", FLOORS)
def test_never_waits(function):
    assert_never_waits(lambda layer: function(layer, resolution=0.04))
