"""Gaussian, box and median, of the known cells."""

import math

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
    hill,
    of_windows,
    random_layer,
    resolution_spread,
)
from torchelev.filters.smoothing import box, gaussian, median

ALL = [gaussian, box, median]


def gaussian_mean(width):
    """The weighted mean, as a loop over the known cells of a window."""

    def mean(heights, offsets):
        weights = [math.exp(-(u * u + v * v) / (2 * width * width)) for u, v in offsets]
        return sum(w * h for w, h in zip(weights, heights, strict=True)) / sum(weights)

    return mean


@given(SEEDS, SHAPES, SHARES, st.floats(0.35, 1.6))
def test_gaussian_is_the_weighted_mean_of_the_known_cells(seed, shape, share, width):
    layer = random_layer(seed, shape, share)
    expected = of_windows(layer, max(1, round(3 * width)), gaussian_mean(width))
    assert_layer(gaussian(layer, resolution=0.1, sigma=0.1 * width), expected, layer[1], 1e-9)


@given(SEEDS, SHAPES, SHARES, st.integers(1, 4))
def test_box_is_the_mean_of_the_known_cells(seed, shape, share, radius):
    layer = random_layer(seed, shape, share)
    expected = of_windows(layer, radius, lambda heights, _: heights.mean())
    assert_layer(box(layer, resolution=0.1, radius=0.1 * radius), expected, layer[1], 1e-9)


@given(SEEDS, SHAPES, SHARES, st.integers(1, 4))
def test_median_is_the_median_of_the_known_cells(seed, shape, share, radius):
    layer = random_layer(seed, shape, share)
    expected = of_windows(layer, radius, lambda heights, _: np.median(heights))
    assert_layer(median(layer, resolution=0.1, radius=0.1 * radius), expected, layer[1])


def test_literal_values():
    """A peak of 9 in a window of 3 x 3, one cell unknown: the mean of eight, and the middle of eight."""
    heights = torch.tensor([[[1.0, 2, 3], [4, 9, 5], [6, 7, torch.nan]]])
    layer = heights, torch.isfinite(heights)
    assert box(layer, resolution=0.1, radius=0.1)[0][0, 1, 1] == pytest.approx(37 / 8)
    assert median(layer, resolution=0.1, radius=0.1)[0][0, 1, 1] == 4.5
    e, e2 = math.exp(-0.5 / 0.16), math.exp(-1 / 0.16)
    expected = (9 + e * (2 + 4 + 5 + 7) + e2 * (1 + 3 + 6)) / (1 + 4 * e + 3 * e2)
    assert gaussian(layer, resolution=0.1, sigma=0.04)[0][0, 1, 1] == pytest.approx(expected, abs=1e-6)


@pytest.mark.slow(1)
@pytest.mark.parametrize("function", ALL)
def test_batch_is_single_and_gradients(function):
    def run(layer):
        return function(layer, resolution=0.1)

    assert_batch_is_single(run, random_layer(5, (3, 6, 5), 0.7), atol=1e-12)
    assert_gradients(run, random_layer(6, (2, 5, 4), 0.6))


@given(SEEDS, SHARES, st.sampled_from(ALL), st.floats(-0.5, 0.5), st.floats(0.05, 0.5))
def test_flat_ground_stays_flat_and_no_height_is_invented(seed, share, function, height, radius):
    setting = {"sigma" if function is gaussian else "radius": radius}
    heights, known = random_layer(seed, (2, 8, 7), share)
    flat, _ = function((heights * 0 + height, known), resolution=0.1, **setting)
    torch.testing.assert_close(flat, torch.full_like(heights, height) * known, atol=1e-9, rtol=0)
    values, _ = function((heights, known), resolution=0.1, **setting)
    for b in range(2):
        if known[b].any():
            inside = heights[b][known[b]]
            assert (values[b][known[b]] >= inside.min() - 1e-9).all()
            assert (values[b][known[b]] <= inside.max() + 1e-9).all()


@given(SEEDS, SHARES, st.sampled_from(ALL))
def test_mirrored_heights_and_maps_come_out_mirrored(seed, share, function):
    values, known = random_layer(seed, (1, 8, 7), share)
    smooth, _ = function((values, known), resolution=0.1)
    torch.testing.assert_close(function((-values, known), resolution=0.1)[0], -smooth, atol=1e-12, rtol=0)
    turned = function((values.mT.flip(1), known.mT.flip(1)), resolution=0.1)[0]
    torch.testing.assert_close(turned, smooth.mT.flip(1), atol=1e-12, rtol=0)


@pytest.mark.parametrize("function", ALL)
def test_float32_keeps_its_precision_at_500_m(function):
    """Heights there are known to 0.03 mm."""
    low, high = hill(0.04), hill(0.04, altitude=500.0)
    exact = tuple(part.double() if part.is_floating_point() else part for part in high)
    torch.testing.assert_close(
        function(high, resolution=0.04)[0].double(), function(exact, resolution=0.04)[0], atol=5e-5, rtol=0
    )
    assert function(low, resolution=0.04)[0].dtype == torch.float32


@pytest.mark.parametrize("function", ALL)
@SMALL_MAPS
@ALL_OR_NOTHING_KNOWN
def test_windows_larger_than_the_map(function, shape, share):
    assert_runs_on_small_maps(function, shape, share)


@pytest.mark.parametrize("function", ALL)
def test_resolution_independence(function):
    """On slopes of 0.5 within 5 mm, and 1 cm at the border of a hole. In whole cells, windows of 0.16 m differ."""
    setting = {"sigma" if function is gaussian else "radius": 0.16}
    for hole, tolerance in ((False, 0.005), (True, 0.01)):
        assert resolution_spread(lambda layer, r: function(layer, resolution=r, **setting), hole=hole) < tolerance


@pytest.mark.parametrize("setting", [0.0, -1.0, math.nan, math.inf])
@pytest.mark.parametrize("function", ALL)
def test_refuses(function, setting):
    name = "sigma" if function is gaussian else "radius"
    with pytest.raises(ValueError, match=f"{name}: must be a positive number"):
        function(random_layer(1), resolution=0.1, **{name: setting})


def test_never_waits():
    for function in ALL:
        assert_never_waits(lambda layer, function=function: function(layer, resolution=0.04))
