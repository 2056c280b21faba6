"""Distances to edges, obstacles and unknown ground."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tests.filters.filter_cases import no_opencv
from tests.filters.terrains import random_layer, terrain, whole
from torchelev.filters.distances import distance
from torchelev.filters.distances.distance import signed_distance, squared_distance
from torchelev.filters.distances.distance_field import SignedDistanceField
from torchelev.filters.registry import FILTERS, Filter

SEEDS = st.integers(0, 10_000)


RULES = st.fixed_dictionaries(
    dict(
        step=st.sampled_from([None, 0.2, 0.4]),
        below=st.sampled_from([None, -0.1]),
        above=st.sampled_from([None, 0.2]),
        unknown=st.booleans(),
        max_distance=st.sampled_from([None, 0.25]),
    )
)


def reference(values, known, resolution, *, step, below, above, unknown, max_distance):
    """Signed distances of one map (H, W), cell by cell; NaN where unknown."""
    H, W = values.shape

    def kind(i, j):
        if not (0 <= i < H and 0 <= j < W and known[i, j]):
            return "unknown"
        low = below is not None and values[i, j] < below
        return "obstacle" if low or (above is not None and values[i, j] > above) else "free"

    def border(i, j, k, m):
        kinds = {kind(i, j), kind(k, m)}
        if "unknown" in kinds:
            return unknown
        edge = step is not None and kinds == {"free"} and abs(values[i, j] - values[k, m]) > step
        return len(kinds) == 2 or edge

    sides = [(-1, 0), (1, 0), (0, -1), (0, 1)]
    cells = [cell for cell in np.ndindex(H, W) if known[cell]]
    beside = [(i, j) for i, j in cells if any(border(i, j, i + a, j + b) for a, b in sides)]
    limit = math.hypot(H, W) * resolution if max_distance is None else min(max_distance, math.hypot(H, W) * resolution)
    result = np.full((H, W), np.nan)
    for i, j in cells:
        nearest = min((math.hypot(i - k, j - m) for k, m in beside), default=math.inf)
        result[i, j] = min((nearest + 0.5) * resolution, limit) * (-1 if kind(i, j) == "obstacle" else 1)
    return result


@pytest.mark.parametrize("dtype, error", [(torch.float64, 1e-9), (torch.float32, 1e-6)])  # float32 is OpenCV's
@given(
    SEEDS, st.tuples(st.integers(1, 2), st.integers(1, 9), st.integers(1, 8)), st.sampled_from([0.5, 0.9, 1.0]), RULES
)
def test_agrees_with_a_loop(dtype, error, seed, shape, share, rules):
    layer = random_layer(seed, shape, share, dtype)
    # Smooth, so that cells far from borders exist.
    layer = (torch.cumsum(layer[0], 1) * 0.5).clamp(-0.3, 0.3), layer[1]
    result, known = signed_distance(layer, resolution=0.1, **rules)
    assert torch.equal(known, layer[1]) and not result[~known].any()
    for b in range(shape[0]):
        want = reference(layer[0][b].numpy(), known[b].numpy(), 0.1, **rules)
        np.testing.assert_allclose(result[b].numpy(), np.nan_to_num(want), atol=error)


def test_a_step_by_hand():
    """The edge lies between two cells: half a cell from both. The rim of the map is unknown ground."""
    z = torch.zeros(1, 8, 5)
    z[:, 5:] = 0.15
    edges, _ = signed_distance(whole(z), resolution=0.1, step=0.1, unknown=False)
    want = torch.tensor([0.45, 0.35, 0.25, 0.15, 0.05, 0.05, 0.15, 0.25])
    torch.testing.assert_close(edges[0], want[:, None].expand(8, 5))
    rim, _ = signed_distance(whole(z), resolution=0.1, step=0.1)
    torch.testing.assert_close(rim[0, :, 2], torch.tensor([0.05, 0.15, 0.25, 0.15, 0.05, 0.05, 0.15, 0.05]))
    high, _ = signed_distance(whole(z), resolution=0.1, step=0.2, unknown=False)
    torch.testing.assert_close(high, torch.full_like(z, math.hypot(8, 5) * 0.1))  # no border at all


def test_an_obstacle_by_hand():
    """Traversability below 0.5 from the third to the fifth row: negative there, without edges of its own inside."""
    t = torch.ones(1, 7, 4)
    t[:, 2], t[:, 3], t[:, 4] = 0.4, 0.0, 0.4
    result, _ = signed_distance(whole(t), resolution=0.2, step=0.2, below=0.5, unknown=False)
    want = torch.tensor([0.3, 0.1, -0.1, -0.3, -0.1, 0.1, 0.3])
    torch.testing.assert_close(result[0], want[:, None].expand(7, 4))
    mirrored, _ = signed_distance(whole(-t), resolution=0.2, step=None, above=-0.5, unknown=False)
    torch.testing.assert_close(mirrored, result)


@given(
    SEEDS, st.tuples(st.integers(1, 3), st.integers(1, 40), st.integers(1, 40)), st.floats(0, 0.1), st.integers(1, 60)
)
def test_distances_by_opencv_and_by_tensors_are_the_same(seed, shape, share, reach):
    seeds = torch.from_numpy(np.random.default_rng(seed).uniform(size=shape) < share)
    opencv = squared_distance(seeds, reach)
    tensors = distance.squared_distance_by_tensors(seeds, reach)
    near = opencv <= reach**2
    assert torch.equal(near, tensors <= reach**2) and torch.equal(opencv[near], tensors[near])


def test_distances_are_exact_on_a_large_map():
    rng = np.random.default_rng(0)
    seeds = torch.zeros(2, 300, 200, dtype=torch.bool)
    places = rng.integers(0, (300, 200), (5, 2))
    seeds[0, places[:, 0], places[:, 1]] = True
    i, j = np.indices((300, 200))
    want = np.min([(i - a) ** 2 + (j - b) ** 2 for a, b in places], 0)
    for squared in (squared_distance(seeds, 400), distance.squared_distance_by_tensors(seeds, 400)):
        np.testing.assert_array_equal(squared[0].numpy(), want)
        assert (squared[1] > 400**2).all()


def test_without_opencv():
    layer = random_layer(2)
    want, _ = signed_distance(layer, resolution=0.1)
    with no_opencv():  # its import raises ImportError
        result, _ = signed_distance(layer, resolution=0.1)
    assert torch.equal(result, want)


@pytest.mark.parametrize("threads", [1, 2, 3])
def test_a_batch_equals_single_maps(threads):
    torch.set_num_threads(threads)  # until the end of the test, see conftest
    layer = random_layer(1, (4, 20, 15), 0.97)
    batch, _ = signed_distance(layer, resolution=0.1, step=0.5)
    for b in range(4):
        single, _ = signed_distance((layer[0][b : b + 1], layer[1][b : b + 1]), resolution=0.1, step=0.5)
        assert torch.equal(batch[b], single[0])


@pytest.mark.parametrize("shape", [(1, 1, 1), (1, 1, 9), (2, 9, 1), (0, 4, 4)])
@pytest.mark.parametrize("share", [0.0, 1.0])
def test_small_and_unknown_maps(shape, share):
    result, known = signed_distance(random_layer(0, shape, share, torch.float32), resolution=0.1)
    assert result.shape == shape and result.dtype == torch.float32 and torch.isfinite(result).all()
    assert known.all() == (share == 1 or 0 in shape) and (result[known] > 0).all()


@pytest.mark.parametrize("resolution", [0.02, 0.04, 0.08])
def test_the_same_at_2_4_and_8_cm(resolution):
    """The distance to a straight edge is exact; to a round obstacle, good to half a cell's diagonal."""
    layer, x, y = terrain(lambda x, y: 0.2 * (x > 0.16), resolution, 3.2)
    edges, _ = signed_distance(layer, resolution=resolution, unknown=False)
    torch.testing.assert_close(edges[0], (x - 0.16).abs(), atol=1e-9, rtol=0)
    layer, x, y = terrain(lambda x, y: 1.0 * (torch.hypot(x, y) > 0.5), resolution, 3.2)
    disc, _ = signed_distance(layer, resolution=resolution, step=None, below=0.5, unknown=False)
    assert (disc[0] - (torch.hypot(x, y) - 0.5)).abs().max() < 0.71 * resolution


def test_values_have_no_gradient_and_reach_nothing():
    values = random_layer(0)[0].requires_grad_()
    result, _ = signed_distance(whole(values), resolution=0.1)
    assert not result.requires_grad


def test_runs_without_values():
    """On devices other than the CPU nothing waits for values: "meta" has none."""
    layer = torch.empty(2, 20, 15, device="meta"), torch.empty(2, 20, 15, dtype=torch.bool, device="meta")
    result, known = signed_distance(layer, resolution=0.1, below=0.1, max_distance=0.5)
    assert result.shape == known.shape == (2, 20, 15)
    field = SignedDistanceField.from_layer(layer, resolution=0.1)
    assert field.sample(torch.empty(2, 7, 3, device="meta")).gradient.shape == (2, 7, 3)


@pytest.mark.parametrize("settings", [{"step": 0.0}, {"step": math.nan}, {"max_distance": -1.0}])
def test_refuses(settings):
    with pytest.raises(ValueError, match=next(iter(settings))):
        signed_distance(random_layer(0), resolution=0.1, **settings)


def test_it_is_a_filter_by_name():
    Filter("signed_distance", step=None, below=0.5, max_distance=0.3).try_out(1, 0.04)
    assert "signed_distance" in FILTERS
