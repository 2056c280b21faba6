"""Every in-painting filter against loops, by hand, and what they share."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tests.filters.filter_cases import (
    SEEDS,
    SHAPES,
    SHARES,
    assert_batch_is_single,
    assert_gradients,
    assert_never_waits,
    hill,
    random_layer,
    resolution_spread,
)
from tests.filters.inpainting.references import (
    EIGHT,
    around,
    assert_filled,
    diffusion_reference,
    minimum_reference,
    nearest_reference,
)
from torchelev import filters
from torchelev.filters.inpainting.holes import nearest_known
from torchelev.filters.inpainting.inpaint import (
    fill_from,
    inpaint_diffusion,
    inpaint_minimum,
    inpaint_navier_stokes,
    inpaint_nearest,
    inpaint_telea,
)

FILLING = [inpaint_minimum, inpaint_nearest, inpaint_diffusion]


OPENCV = [inpaint_telea, inpaint_navier_stokes]


DTYPES = [torch.float64, torch.float32]  # by tensors; by OpenCV


def minimum_within(values, known, start, steps):
    """The lowest border cell within so many steps through the hole, NaN if there is none."""
    reached, lowest = {start}, np.nan
    for _ in range(steps):
        beside = {c for cell in reached for c in around(known.shape, cell, EIGHT)}
        lowest = (
            np.nanmin([lowest, *(values[c] for c in beside if known[c])]) if any(known[c] for c in beside) else lowest
        )
        reached |= {c for c in beside if not known[c]}
    return lowest


REFERENCES = dict(zip(FILLING, [minimum_reference, nearest_reference, diffusion_reference], strict=True))


@pytest.mark.parametrize("dtype", DTYPES)
@given(SEEDS, SHAPES, SHARES)
def test_minimum_is_the_lowest_of_the_border_of_the_hole(dtype, seed, shape, share):
    layer = random_layer(seed, shape, share, dtype)
    assert_filled(inpaint_minimum(layer), layer, minimum_reference)


@given(SEEDS, SHAPES, SHARES, st.integers(1, 5))
def test_minimum_within_steps(seed, shape, share, steps):
    layer = random_layer(seed, shape, share)

    def reference(values, known):
        out = np.where(known, values, np.nan)
        for cell in map(tuple, np.argwhere(~known)):
            out[cell] = minimum_within(values, known, cell, steps)
        return out

    assert_filled(inpaint_minimum(layer, iterations=steps), layer, reference)


@given(SEEDS, st.sampled_from([0.1, 0.5, 0.9]))
def test_minimum_with_enough_steps_is_that_of_the_whole_hole(seed, share):
    layer = random_layer(seed, (2, 9, 8), share)
    whole, bounded = inpaint_minimum(layer), inpaint_minimum(layer, iterations=72)
    assert torch.equal(whole[0], bounded[0]) and torch.equal(whole[1], bounded[1])


@pytest.mark.parametrize("dtype", DTYPES)
def test_minimum_by_hand(dtype):
    """Two holes that touch by a corner are one; the one at the rim has a border of its own."""
    nan = math.nan
    heights = torch.tensor([[[5.0, nan, 4, 7, nan], [6, 8, nan, 9, nan], [3, 3, 3, 3, 2]]], dtype=dtype)
    expected = torch.tensor([[[5.0, 3, 4, 7, 2], [6, 8, 3, 9, 2], [3, 3, 3, 3, 2]]], dtype=dtype)
    assert torch.equal(inpaint_minimum((heights, torch.isfinite(heights)))[0], expected)
    near, _ = inpaint_minimum((heights, torch.isfinite(heights)), iterations=1)
    expected[0, 0, 1], expected[0, 0, 4] = 4, 7
    assert torch.equal(near, expected)


@given(SEEDS, SHAPES, SHARES)
def test_nearest_is_exact_and_ties_go_to_the_first(seed, shape, share):
    layer = random_layer(seed, shape, share)
    assert_filled(inpaint_nearest(layer), layer, nearest_reference)


@pytest.mark.parametrize("turn", [False, True])
def test_nearest_reaches_across_the_map(turn):
    heights = torch.full((2, 3, 9), torch.nan)
    heights[0, 0, 0], heights[1, 2, 8] = 1.0, 2.0
    heights = heights.mT if turn else heights
    values, known = inpaint_nearest((heights, torch.isfinite(heights)))
    assert known.all() and (values[0] == 1).all() and (values[1] == 2).all()


def test_nearest_of_few_cells_in_a_large_map():
    """Where jump flooding goes wrong."""
    from scipy.ndimage import distance_transform_edt

    rng = np.random.default_rng(0)
    known = rng.random((3, 90, 70)) < np.array([0.001, 0.01, 0.1])[:, None, None]
    nearest = nearest_known(torch.from_numpy(known)).numpy()
    for b in range(3):
        i, j = np.meshgrid(np.arange(90), np.arange(70), indexing="ij")
        distance = np.hypot(nearest[b] // 70 - i, nearest[b] % 70 - j)
        np.testing.assert_allclose(distance, distance_transform_edt(~known[b]), atol=1e-9)
        assert known[b].ravel()[nearest[b]].all()


@given(SEEDS, SHAPES, SHARES)
def test_diffusion_solves_its_equations(seed, shape, share):
    layer = random_layer(seed, shape, share)
    got = inpaint_diffusion(layer, tolerance=1e-9, iterations=100)
    assert_filled(got, layer, diffusion_reference, 1e-8)


@given(SEEDS, st.sampled_from([0.1, 0.5, 0.9]), st.sampled_from(FILLING))
def test_no_filled_height_lies_outside_of_the_known_ones(seed, share, function):
    values, known = random_layer(seed, (1, 9, 8), share)
    filled, _ = function((values, known))
    assert torch.equal(filled[known], values[known])
    if known.any():
        assert filled.min() >= values[known].min() - 1e-3 and filled.max() <= values[known].max() + 1e-3


@pytest.mark.slow(1)
@pytest.mark.parametrize("function", FILLING)
@pytest.mark.parametrize("share", [0.1, 0.6])
def test_batch_is_single_and_gradients(function, share):
    settings = dict(tolerance=1e-12, iterations=100) if function is inpaint_diffusion else {}

    def run(layer):
        return function(layer, **settings)

    layer = random_layer(5, (3, 5, 4), share)
    layer[1][1] = False
    assert_batch_is_single(run, layer, atol=1e-9 if settings else 0.0)
    assert_gradients(run, layer)


def test_gradient_of_bounded_minimum():
    assert_gradients(lambda layer: inpaint_minimum(layer, iterations=2), random_layer(2, (2, 6, 5), 0.3))


@pytest.mark.parametrize("function", FILLING + OPENCV)
@pytest.mark.parametrize("shape", [(1, 1, 1), (2, 1, 9), (1, 9, 1), (2, 2, 2), (1, 5, 4)])
@pytest.mark.parametrize("share", [0.0, 0.4, 1.0])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_becomes_known_wherever_the_map_knows_anything(function, shape, share, dtype):
    layer = random_layer(4, shape, share, dtype)
    settings = dict(resolution=0.04) if function in OPENCV else {}
    values, known = function(layer, **settings)
    assert values.dtype == dtype and torch.isfinite(values).all()
    assert torch.equal(known, layer[1].flatten(1).any(1)[:, None, None].expand(shape))
    assert torch.equal(values[layer[1]], layer[0][layer[1]]) and (values[~known] == 0).all()


@pytest.mark.parametrize("function", OPENCV)
@pytest.mark.parametrize("threads", [1, 2, 3])
def test_opencv_fills_each_map_of_a_batch_as_alone(function, threads):
    torch.set_num_threads(threads)  # until the end of the test, see conftest
    layer = random_layer(6, (7, 12, 11), 0.6, torch.float32)
    layer[1][2], layer[1][4] = False, True
    assert_batch_is_single(lambda layer: function(layer, resolution=0.1), (layer[0].nan_to_num(), layer[1]))


@pytest.mark.slow(1)
@pytest.mark.parametrize("function", OPENCV)
@pytest.mark.parametrize("shape", [(1, 1, 40), (1, 40, 1)])
def test_a_single_line_of_cells_gives_the_same_each_time(function, shape):
    """Of a single line OpenCV reads what lies in memory behind it, so that results differ and are not finite."""
    values, known = random_layer(4, shape, 0.4, torch.float32)
    results = []
    for junk in [math.nan, 1e30] * 300:
        blocks = [np.full(size, junk, np.float32) for size in (16, 33, 64, 128, 200, 300)]
        del blocks  # what OpenCV is given next
        results.append(function((values, known), resolution=0.04))
    assert all(found.all() and torch.equal(filled, results[0][0]) for filled, found in results)


@pytest.mark.parametrize("function", OPENCV)
def test_opencv_is_not_quantised_to_8_bits(function):
    """A hole in a plane: hundreds of different heights within half a metre, at any altitude."""
    x = (torch.arange(60) * 0.04).repeat(60, 1)
    plane = 0.5 * x + 0.3 * x.T
    known = torch.ones(1, 60, 60, dtype=torch.bool)
    known[0, 20:40, 25:35] = False
    filled, _ = function((plane[None], known), resolution=0.04)
    assert (filled[0] - plane)[20:40, 25:35].abs().max() < 0.15
    assert len(filled[~known].unique()) > 150
    high, _ = function((plane[None] + 500, known), resolution=0.04)
    torch.testing.assert_close(high - 500, filled, atol=5e-4, rtol=0)


@pytest.mark.parametrize("function, method", [(inpaint_telea, "INPAINT_TELEA"), (inpaint_navier_stokes, "INPAINT_NS")])
def test_opencv_agrees_with_what_it_gives_for_16_bits(function, method):
    """The same heights in steps of 0.05 mm."""
    import cv2

    layer = hill(0.08, altitude=1.0, hole=True)
    heights = (layer[0][0].numpy() / 5e-5).round().astype(np.uint16)
    holes = (~layer[1][0]).numpy().astype(np.uint8)
    expected = cv2.inpaint(heights, holes, 3, getattr(cv2, method)) * 5e-5
    filled, _ = function(layer, resolution=0.08, radius=0.24)
    np.testing.assert_allclose(filled[0].numpy(), expected, atol=1e-3, rtol=0)


@pytest.mark.parametrize("function", OPENCV)
@pytest.mark.parametrize(
    "where", [np.s_[0, 0], np.s_[:3, :4], np.s_[-3:, 1:2], np.s_[1, 1], np.s_[-2, -2], np.s_[::3, ::3]]
)
def test_opencv_keeps_flat_ground_flat_at_the_rim(function, where):
    known = torch.ones(9, 8, dtype=torch.bool)
    known[where] = False
    filled, _ = function(((known * 0.4)[None], known[None]), resolution=0.04)
    torch.testing.assert_close(filled, torch.full((1, 9, 8), 0.4), atol=1e-4, rtol=0)


@pytest.mark.parametrize("function", OPENCV)
def test_opencv_passes_gradients_of_known_cells_only(function):
    values, known = random_layer(1, (2, 6, 5), 0.6, torch.float32)
    values = torch.where(known, values, 0.0).requires_grad_()
    function((values, known), resolution=0.04)[0].sum().backward()
    assert torch.equal(values.grad, known.float())


@given(SEEDS, SHAPES, SHARES)
def test_fill_from(seed, shape, share):
    (a, a_known), (b, b_known) = random_layer(seed, shape, share), random_layer(seed + 1, shape, 0.5)
    values, known = fill_from((a, a_known), (b, b_known))
    assert torch.equal(known, a_known | b_known)
    expected = torch.where(a_known, a, torch.where(b_known, b, 0.0))
    torch.testing.assert_close(values, expected, atol=0, rtol=0)


def test_gradients_of_fill_from():
    assert_gradients(fill_from, random_layer(1, (2, 4, 3), 0.5), random_layer(2, (2, 4, 3), 0.5))


@pytest.mark.parametrize(
    "function, tolerance",
    [(inpaint_minimum, 0.03), (inpaint_nearest, 0.1), (inpaint_diffusion, 0.01)],
)
def test_resolution_independence(function, tolerance):
    """A hole of about 1 x 1.3 m on slopes of 0.5. Its border moves by half a cell of 8 cm, which is 2 cm in height; and
    where two borders are as near, the nearest may change."""
    assert resolution_spread(lambda layer, r: function(layer), hole=True) < tolerance


@pytest.mark.parametrize("function", OPENCV)
def test_resolution_independence_of_opencv(function):
    """The filled cells of one another make more of them at 2 cm: within 10 cm over a hole of 1 x 1.3 m."""
    assert resolution_spread(lambda layer, r: function(layer, resolution=r, radius=0.24), hole=True) < 0.1


def test_refuses():
    layer = random_layer(1)
    for iterations in (0, -1, 1.5, True):
        with pytest.raises(ValueError, match="iterations: must be a positive int"):
            inpaint_minimum(layer, iterations=iterations)
        with pytest.raises(ValueError, match="iterations: must be a positive int"):
            inpaint_diffusion(layer, iterations=iterations)
    with pytest.raises(ValueError, match="tolerance: must be a positive number"):
        inpaint_diffusion(layer, tolerance=0.0)
    for function in OPENCV:
        with pytest.raises(ValueError, match="radius: must be a positive number"):
            function(layer, resolution=0.04, radius=-1.0)


def test_never_waits():
    for function in FILLING:
        assert_never_waits(function)
    assert_never_waits(lambda layer: inpaint_minimum(layer, iterations=3))
    assert_never_waits(fill_from, 2)


@pytest.mark.parametrize("shape", [(2, 0, 5), (2, 5, 0)])
@pytest.mark.parametrize("name", ["inpaint_telea", "inpaint_navier_stokes", "inpaint_minimum"])
def test_maps_without_cells_come_back(name, shape):
    layer = torch.zeros(shape), torch.zeros(shape, dtype=torch.bool)
    values, known = filters.Filter(name)(layer, resolution=0.1)
    assert values.shape == known.shape == shape
