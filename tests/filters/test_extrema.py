"""Extrema of windows and of layers, and the virtual floor that is made of them."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tests.filters.filter_cases import (
    ALL_OR_NOTHING_KNOWN,
    SEEDS,
    SHAPES,
    SHARES,
    SMALL_MAPS,
    assert_batch_is_single,
    assert_gradients,
    assert_layer,
    assert_never_waits,
    assert_runs_on_small_maps,
    of_windows,
    random_layer,
    resolution_spread,
)
from torchelev.filters.extrema import closing, dilation, erosion, maximum, minimum, opening

WINDOWED = [dilation, erosion, opening, closing]


def highest(layer, radius):
    return of_windows(layer, radius, lambda heights, _: heights.max())


def lowest(layer, radius):
    return of_windows(layer, radius, lambda heights, _: heights.min())


@given(SEEDS, SHAPES, SHARES, st.integers(1, 4))
def test_dilation_and_erosion_are_extrema_of_the_known_cells(seed, shape, share, radius):
    layer = random_layer(seed, shape, share)
    known = layer[1]
    assert_layer(dilation(layer, resolution=0.1, radius=0.1 * radius), highest(layer, radius), known, 0)
    assert_layer(erosion(layer, resolution=0.1, radius=0.1 * radius), lowest(layer, radius), known, 0)


@given(SEEDS, SHAPES, SHARES, st.integers(1, 3))
def test_opening_and_closing_are_one_after_the_other(seed, shape, share, radius):
    layer = random_layer(seed, shape, share)
    known = layer[1]
    low, high = torch.from_numpy(lowest(layer, radius)), torch.from_numpy(highest(layer, radius))
    assert_layer(opening(layer, resolution=0.1, radius=0.1 * radius), highest((low, known), radius), known, 0)
    assert_layer(closing(layer, resolution=0.1, radius=0.1 * radius), lowest((high, known), radius), known, 0)


@given(SEEDS, SHAPES, SHARES, st.integers(1, 3))
def test_opening_lies_below_closing_above_and_neither_changes_twice(seed, shape, share, radius):
    layer = random_layer(seed, shape, share)
    settings = dict(resolution=0.1, radius=0.1 * radius)
    opened, closed = opening(layer, **settings), closing(layer, **settings)
    known = layer[1]
    assert (opened[0][known] <= layer[0][known]).all() and (closed[0][known] >= layer[0][known]).all()
    assert torch.equal(opening(opened, **settings)[0], opened[0])
    assert torch.equal(closing(closed, **settings)[0], closed[0])


def test_a_wall_is_opened_away_and_a_gap_closed():
    """A window of 3 cells takes what is 2 wide and keeps what is 3 wide."""
    heights = torch.tensor([0.0, 0, 1, 1, 0, 0, 1, 1, 1, 0, 0]).repeat(1, 5, 1)
    opened, _ = opening((heights, torch.ones_like(heights, dtype=torch.bool)), resolution=0.04, radius=0.04)
    assert opened[0, 2].tolist() == [0, 0, 0, 0, 0, 0, 1, 1, 1, 0, 0]
    closed, _ = closing((-heights, torch.ones_like(heights, dtype=torch.bool)), resolution=0.04, radius=0.04)
    assert closed[0, 2].tolist() == [0, 0, 0, 0, 0, 0, -1, -1, -1, 0, 0]


@given(SEEDS, SHAPES, SHARES, st.integers(1, 4))
def test_extrema_of_several_layers(seed, shape, share, count):
    layers = [random_layer(seed + k, shape, share) for k in range(count)]
    stacked = np.stack([values.numpy() for values, _ in layers])
    known = ~np.isnan(stacked).all(0)
    filled = np.where(known, stacked, 0.0)
    assert_layer(maximum(*layers), np.nanmax(filled, 0), known, 0)
    assert_layer(minimum(*layers), np.nanmin(filled, 0), known, 0)


@pytest.mark.slow(1)
@pytest.mark.parametrize("function", WINDOWED)
def test_batch_is_single_and_gradients(function):
    def run(layer):
        return function(layer, resolution=0.1)

    layer = random_layer(5, (2, 6, 5), 0.7)
    assert_batch_is_single(run, layer)
    assert_gradients(run, layer)


@pytest.mark.parametrize("function", [maximum, minimum])
def test_gradients_of_extrema_of_layers(function):
    layers = [random_layer(seed, (2, 4, 3), 0.6) for seed in (1, 2, 3)]
    assert_batch_is_single(function, *layers)
    assert_gradients(function, *layers)


@pytest.mark.parametrize("function", WINDOWED)
@SMALL_MAPS
@ALL_OR_NOTHING_KNOWN
def test_windows_larger_than_the_map(function, shape, share):
    assert_runs_on_small_maps(function, shape, share)


@pytest.mark.parametrize("function", WINDOWED)
def test_refuses_a_radius_that_is_not_positive(function):
    with pytest.raises(ValueError, match="radius: must be a positive number, got 0"):
        function(random_layer(1), resolution=0.1, radius=0)


@pytest.mark.parametrize("function, tolerance", [(dilation, 0.02), (erosion, 0.02), (opening, 0.03), (closing, 0.03)])
def test_resolution_independence(function, tolerance):
    """Within 2 to 3 cm: in whole cells a window of 0.24 m to each side is 0.5 to 0.56 m wide, and slopes are 0.5."""
    assert resolution_spread(lambda layer, r: function(layer, resolution=r, radius=0.24)) < tolerance


def test_never_waits():
    for function in WINDOWED:
        assert_never_waits(lambda layer, function=function: function(layer, resolution=0.04))
    assert_never_waits(maximum, 3)
    assert_never_waits(minimum, 3)
