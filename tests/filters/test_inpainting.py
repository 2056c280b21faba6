"""In-painting: minimum, nearest, diffusion, OpenCV's two, and another layer."""

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
from torchelev import filters
from torchelev.filters.inpainting.holes import compressed, join, lowest_of_border, nearest_known
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
EIGHT = [(u, v) for u in (-1, 0, 1) for v in (-1, 0, 1) if (u, v) != (0, 0)]
FOUR = [(0, 1), (1, 0), (0, -1), (-1, 0)]


def around(shape, cell, steps):
    cells = [(cell[0] + u, cell[1] + v) for u, v in steps]
    return [(u, v) for u, v in cells if 0 <= u < shape[0] and 0 <= v < shape[1]]


def holes(known):
    """The holes of a map (H, W): lists of cells, by a walk from neighbour to neighbour."""
    found, seen = [], known.copy()
    for start in np.ndindex(*known.shape):
        hole, todo = [], [start] if not seen[start] else []
        while todo:
            cell = todo.pop()
            if not seen[cell]:
                seen[cell] = True
                hole.append(cell)
                todo += around(known.shape, cell, EIGHT)
        found += [hole] if hole else []
    return found


def minimum_reference(values, known):
    out = np.where(known, values, np.nan)
    for hole in holes(known):
        border = [values[c] for cell in hole for c in around(known.shape, cell, EIGHT) if known[c]]
        for cell in hole if border else []:
            out[cell] = min(border)
    return out


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


def nearest_reference(values, known):
    out = np.where(known, values, np.nan)
    cells = np.argwhere(known)  # in the order of i, then j
    for cell in np.argwhere(~known) if len(cells) else []:
        out[tuple(cell)] = values[tuple(cells[((cells - cell) ** 2).sum(1).argmin()])]
    return out


def diffusion_reference(values, known):
    """The linear system, dense."""
    unknown = [tuple(cell) for cell in np.argwhere(~known)]
    if not known.any() or not unknown:
        return np.where(known, values, np.nan)
    number = {cell: k for k, cell in enumerate(unknown)}
    A, right = np.zeros((len(unknown),) * 2), np.zeros(len(unknown))
    for cell, k in number.items():
        for other in around(known.shape, cell, FOUR):
            A[k, k] += 1
            if known[other]:
                right[k] += values[other]
            else:
                A[k, number[other]] -= 1
    out = np.where(known, values, 0.0)
    for cell, height in zip(unknown, np.linalg.solve(A, right), strict=True):
        out[cell] = height
    return out


REFERENCES = dict(zip(FILLING, [minimum_reference, nearest_reference, diffusion_reference], strict=True))


def assert_filled(got, layer, reference, atol=0.0):
    values, known = (part.numpy() for part in layer)
    expected = np.stack([reference(v, k) for v, k in zip(values, known, strict=True)])
    np.testing.assert_array_equal(got[1].numpy(), ~np.isnan(expected))
    np.testing.assert_allclose(got[0].numpy(), np.nan_to_num(expected), atol=atol, rtol=0)


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


def spiral(size):
    """A corridor one cell wide that winds to the middle between walls: the hole with the longest way through it."""
    known = np.ones((size, size), bool)
    i, j, (u, v), turned = 0, 0, (0, 1), 0
    while turned < 2:
        known[i, j] = False
        ahead, beyond = (i + u, j + v), (i + 2 * u, j + 2 * v)
        blocked = not (0 <= ahead[0] < size and 0 <= ahead[1] < size)
        if not blocked and 0 <= beyond[0] < size and 0 <= beyond[1] < size:
            blocked = not known[beyond]
        if blocked:
            u, v, turned = v, -u, turned + 1
        else:
            i, j, turned = *ahead, 0
    return known


@pytest.fixture(params=[True, False])
def stops(request, monkeypatch):
    """As a CPU does, and as a device whose host may not wait."""
    monkeypatch.setattr("torchelev.filters.inpainting.holes._stops", lambda device: request.param)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("mirror", [[], [0], [1], [0, 1]])
def test_the_border_of_a_spiral_is_all_of_it_whatever_its_direction(mirror, dtype, stops):
    """The lowest wall is at its inner end, or outside of its outer one."""
    known = torch.from_numpy(spiral(41)).flip(mirror)
    assert len(holes(known.numpy())) == 1 and 600 < (~known).sum() < 1200
    for cell in (known.nonzero()[0], known.nonzero()[len(known.nonzero()) // 2]):
        heights = torch.where(known, 1.0, 0.0).to(dtype)
        heights[tuple(cell)] = 0.5
        filled, _ = inpaint_minimum((heights[None], known[None]))
        assert (filled[0][~known] == 0.5).all()


@given(SEEDS, st.integers(1, 60), st.floats(0.1, 1.5))
def test_parts_of_graphs(seed, count, edges):
    """Any graph, of which maps make few: each node gets the lowest that is connected to it."""
    rng = np.random.default_rng(seed)
    a, b = torch.from_numpy(rng.integers(0, count, (2, int(edges * count))))
    reach = np.eye(count, dtype=int)
    reach[a, b] = reach[b, a] = 1
    connected = np.linalg.matrix_power(reach.astype(float), count) > 0
    assert join(a, b, count).tolist() == connected.argmax(1).tolist()


@pytest.mark.parametrize("order", ["up", "down", "star", "random"])
def test_parts_of_the_worst_graphs_within_all_steps(order, monkeypatch):
    """A chain in any order, and a star whose middle is the highest: the rounds suffice that never stop early."""
    monkeypatch.setattr("torchelev.filters.inpainting.holes._stops", lambda device: False)
    nodes = {"up": torch.arange(1000), "down": torch.arange(1000).flip(0)}.get(order)
    nodes = torch.randperm(1000, generator=torch.Generator().manual_seed(0)) if nodes is None else nodes
    a, b = (torch.arange(999), torch.full((999,), 999)) if order == "star" else (nodes[1:], nodes[:-1])
    assert (join(a, b, 1000) == 0).all()


def test_a_chain_is_followed_to_its_end(stops):
    assert (compressed(torch.arange(-1, 999).clamp(min=0)) == 0).all()


def test_of_equally_low_border_cells_the_first_is_taken(stops):
    known = torch.tensor([[[True, True, True, True], [True, False, False, True], [True, True, True, True]]])
    heights = torch.tensor([[[2.0, 1, 1, 1], [1, 0, 0, 1], [1, 1, 1, 1]]])
    assert lowest_of_border(heights, known)[0, 1].tolist() == [4, 1, 1, 7]


@pytest.mark.parametrize("share", [0.0, 0.02, 0.4, 0.6, 0.9, 1.0])
def test_all_steps_give_the_same_as_stopping(share, stops):
    layer = random_layer(3, (2, 13, 11), share)
    assert_filled(inpaint_minimum(layer), layer, minimum_reference)
    assert_filled(inpaint_nearest(layer), layer, nearest_reference)


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


LARGE = {
    "few": lambda i, j, random: random < 0.002,
    "speckled": lambda i, j, random: random < 0.3,
    "frame": lambda i, j, random: (i == 0) | (i == 39) | (j == 0) | (j == 35),
    "one side": lambda i, j, random: i == 0,
    "corridors": lambda i, j, random: ((j % 5 == 0) & (random < 0.9)) | ((i == 7) & (j == 7)),
    "a shadow": lambda i, j, random: (abs(i - 20) > 9) | (abs(j - 15) > 12),
}


@pytest.mark.parametrize("case", LARGE)
@pytest.mark.parametrize("dtype, altitude", [(torch.float64, 0.0), (torch.float32, 300.0)])
def test_diffusion_is_right_to_its_tolerance(case, dtype, altitude):
    """At the default tolerance of 1 mm, whatever the shape of the holes, within the default number of steps."""
    i, j = np.meshgrid(np.arange(40), np.arange(36), indexing="ij")
    rng = np.random.default_rng(1)
    known = LARGE[case](i, j, rng.random((40, 36)))
    heights = altitude + 0.03 * i + 0.5 * (j > i) + rng.normal(0, 0.05, known.shape)
    layer = torch.from_numpy(heights)[None].to(dtype), torch.from_numpy(known)[None]
    got, found = inpaint_diffusion(layer)
    error = np.abs(got[0].double().numpy() - diffusion_reference(layer[0][0].double().numpy(), known))
    assert error.max() < 1e-3 and found.all() and 0 < known.sum() < known.size
    assert inpaint_diffusion(layer, iterations=1)[0].sub(got).abs().max() > 0 or error[~known].max() < 1e-9


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


def test_diffusion_of_a_map_does_not_depend_on_the_others():
    """The easy one stands still while the hard one goes on."""
    i, j = np.meshgrid(np.arange(40), np.arange(36), indexing="ij")
    random = np.random.default_rng(1).random((40, 36))
    known = torch.from_numpy(np.stack([LARGE[case](i, j, random) for case in ("a shadow", "few", "one side")]))
    heights = torch.from_numpy(np.stack([0.3 * np.sin(0.3 * i) * np.cos(0.2 * j)] * 3))
    assert_batch_is_single(lambda layer: inpaint_diffusion(layer, tolerance=0.01), (heights, known), atol=1e-12)


def test_gradient_of_diffusion_grows_with_what_comes_in():
    values, known = random_layer(3, (2, 6, 5), 0.4)
    values = torch.where(known, values, 0.0).requires_grad_()
    filled, _ = inpaint_diffusion((values, known), tolerance=1e-9)
    (one,) = torch.autograd.grad(filled.sum(), values, retain_graph=True)
    (many,) = torch.autograd.grad(1000 * filled.sum(), values)
    torch.testing.assert_close(many, 1000 * one, atol=1e-4, rtol=0)
    assert one.sum() == pytest.approx(60, abs=1e-6)  # all cells rise with all known ones


@pytest.mark.parametrize("shape", [(2, 0, 5), (2, 5, 0)])
@pytest.mark.parametrize("name", ["inpaint_telea", "inpaint_navier_stokes", "inpaint_minimum"])
def test_maps_without_cells_come_back(name, shape):
    layer = torch.zeros(shape), torch.zeros(shape, dtype=torch.bool)
    values, known = filters.Filter(name)(layer, resolution=0.1)
    assert values.shape == known.shape == shape
