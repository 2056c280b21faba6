"""Distances to edges, obstacles and unknown ground, and the distance field around the ground."""

import itertools
import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tests.filters.test_geometry import random_layer, terrain, whole
from torchelev.filters.distances import distance
from torchelev.filters.distances.distance import signed_distance, squared_distance
from torchelev.filters.distances.distance_field import FieldConfig, SignedDistanceField
from torchelev.filters.distances.opencv_distance import nearest_seed
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
    opencv = distance._squared_distance_opencv(seeds, reach)
    tensors = distance._squared_distance_tensors(seeds, reach)
    near = opencv <= reach**2
    assert torch.equal(near, tensors <= reach**2) and torch.equal(opencv[near], tensors[near])


def test_distances_are_exact_on_a_large_map():
    rng = np.random.default_rng(0)
    seeds = torch.zeros(2, 300, 200, dtype=torch.bool)
    places = rng.integers(0, (300, 200), (5, 2))
    seeds[0, places[:, 0], places[:, 1]] = True
    i, j = np.indices((300, 200))
    want = np.min([(i - a) ** 2 + (j - b) ** 2 for a, b in places], 0)
    for squared in (squared_distance(seeds, 400), distance._squared_distance_tensors(seeds, 400)):
        np.testing.assert_array_equal(squared[0].numpy(), want)
        assert (squared[1] > 400**2).all()


def test_a_map_without_seeds_is_as_far_away_as_it_is_told():
    seeds = np.zeros((3, 30, 20), bool)
    seeds[1, 3, 4] = True
    away = nearest_seed(seeds, 40.0)
    assert (away[[0, 2]] == 40).all() and away[1, 3, 4] == 0 and away[1, 6, 8] == 5


@pytest.mark.parametrize("uses", [True, False])
def test_the_switch_of_ipp_is_put_back(uses, monkeypatch):
    cv2 = pytest.importorskip("cv2")
    seeds, before, during = np.eye(30, dtype=bool)[None], cv2.ipp.useIPP(), []

    def failing(*args, **settings):
        during.append(cv2.ipp.useIPP())
        raise RuntimeError

    try:
        cv2.ipp.setUseIPP(uses)
        kept = cv2.ipp.useIPP()  # False where OpenCV has no IPP
        nearest_seed(seeds, 40.0)
        assert cv2.ipp.useIPP() == kept
        monkeypatch.setattr(cv2, "distanceTransform", failing)
        with pytest.raises(RuntimeError):
            nearest_seed(seeds, 40.0)
        assert cv2.ipp.useIPP() == kept and during == [False]
    finally:
        cv2.ipp.setUseIPP(before)


def test_without_opencv(monkeypatch):
    layer = random_layer(2)
    want, _ = signed_distance(layer, resolution=0.1)
    monkeypatch.setattr(distance.opencv, "_installed", lambda: False)
    called = []
    tensors = distance._squared_distance_tensors
    monkeypatch.setattr(distance, "_squared_distance_tensors", lambda *a: called.append(1) or tensors(*a))
    result, _ = signed_distance(layer, resolution=0.1)
    assert called and torch.equal(result, want)


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


# The field ------------------------------------------------------------------------------------------------------------

CFG = FieldConfig(below=0.2, height=0.96, spacing=0.08, max_distance=0.45)


def field_of(layer, resolution=0.1, **settings):
    settings.setdefault("cfg", CFG)
    return SignedDistanceField.from_layer(layer, resolution=resolution, **settings)


def reference_field(heights, known, z, reach):
    """Distances of one map at heights z (K,), all in cells: from the ground, less those from the air."""
    field = np.empty((len(z), *heights.shape))
    for k, i, j in np.ndindex(*field.shape):
        gaps = [
            (math.hypot(max(0, abs(a - i) - 0.5), max(0, abs(b - j) - 0.5)), z[k] - heights[a, b])
            for a, b in np.argwhere(known)
        ]
        to_ground = min((math.hypot(d, max(0, gap)) for d, gap in gaps), default=math.inf)
        to_air = min((math.hypot(d, max(0, -gap)) for d, gap in gaps), default=math.inf)
        field[k, i, j] = min(to_ground, reach) - min(to_air, reach)
    return field


@given(SEEDS, st.integers(1, 6), st.integers(1, 6), st.sampled_from([0.4, 0.8, 1.0]), st.floats(0.15, 0.6))
def test_the_field_agrees_with_a_loop(seed, H, W, share, max_distance):
    layer = random_layer(seed, (2, H, W), share)
    cfg = FieldConfig(below=0.2, height=1.0, spacing=0.13, max_distance=max_distance)
    field = field_of(layer, cfg=cfg)
    assert field.values.shape == (2, 9, H, W)
    for b in range(2):
        z = (field.floor[b].item() + 0.13 * np.arange(9)) / 0.1
        want = reference_field(layer[0][b].numpy() / 0.1, layer[1][b].numpy(), z, max_distance / 0.1) * 0.1
        np.testing.assert_allclose(field.values[b].numpy(), want, atol=1e-6)


def test_level_ground_and_a_wall_by_hand():
    """d = z - h over level ground; before a wall the distance to its face, from both sides; around its edge, round."""
    z = torch.zeros(1, 20, 10, dtype=torch.float64)
    z[:, 10:] = 1.0  # the face is at x = 0
    field = field_of(whole(z), cfg=FieldConfig(below=0.2, height=2.0, max_distance=0.5))
    points = torch.tensor(
        [[[-0.85, 0, 0.22], [-0.85, 0.1, -0.05], [-0.27, 0, 0.8], [0.23, 0.2, 0.4], [0.85, 0, 1.3], [-0.35, 0, 1.4]]],
        dtype=torch.float64,
    )
    distance, gradient, valid = field.sample(points)
    want = torch.tensor([[0.22, -0.05, 0.27, -0.23, 0.3, 0.5]], dtype=torch.float64)
    torch.testing.assert_close(distance, want, atol=1e-6, rtol=0)
    towards = torch.tensor([[0, 0, 1], [0, 0, 1], [-1, 0, 0], [-1, 0, 0], [0, 0, 1]], dtype=torch.float64)
    torch.testing.assert_close(gradient[0, :5], towards, atol=1e-5, rtol=0)
    assert valid.all() and gradient[0, 5, 0] <= 0 <= gradient[0, 5, 2]


def test_distances_go_on_to_the_rim_of_the_window():
    """Half a cell beyond the outermost centres, as between the last two."""
    z = torch.zeros(1, 4, 3, dtype=torch.float64)
    z[:, 2:] = 0.6
    points = torch.tensor([[[-0.19, 0.0, 0.3], [-0.19, 0.14, 0.3], [0.19, 0.0, 0.3]]], dtype=torch.float64)
    distance, gradient, valid = field_of(whole(z)).sample(points)
    torch.testing.assert_close(distance, torch.tensor([[0.19, 0.19, -0.19]]).double(), atol=1e-6, rtol=0)
    assert valid.all() and gradient[0, :, 0].tolist() == pytest.approx([-1, -1, -1])


@pytest.mark.parametrize("resolution", [0.02, 0.04, 0.08])
def test_the_field_is_the_same_at_2_4_and_8_cm(resolution):
    """A step to 1 mm where d is linear, its edge to a quarter of a cell, a slope to half a cell times its sine."""
    layer, _, _ = terrain(lambda x, y: 0.3 * (x > 0.16), resolution, 1.6)
    field = field_of(layer, resolution, cfg=FieldConfig(below=0.2, height=0.8, max_distance=0.3))
    x, z = torch.meshgrid(torch.linspace(-0.2, 0.4, 31), torch.linspace(-0.1, 0.5, 31), indexing="ij")
    points = torch.stack([x, torch.zeros_like(x), z], -1).view(1, -1, 3).double()
    distance, _, valid = field.sample(points)
    x, _, z = points[0].unbind(-1)
    over_low, to_face, over_high = z, (0.16 - x), z - 0.3
    outside = torch.where(x > 0.16, over_high, torch.minimum(over_low, torch.hypot(to_face, over_high.clamp(min=0))))
    deep = torch.minimum(torch.where(z < 0, torch.hypot((x - 0.16).clamp(min=0), -z), x - 0.16), 0.3 - z)
    solid = (z < 0) | ((x > 0.16) & (z < 0.3))
    want = torch.where(solid, -deep.abs(), outside).clamp(-0.3, 0.3)
    assert valid.all() and (distance[0] - want).abs().max() < 0.5 * resolution
    slope = 0.5
    layer, _, _ = terrain(lambda x, y: slope * x, resolution, 1.6)
    field = field_of(layer, resolution, cfg=FieldConfig(below=0.2, height=1.4, max_distance=0.3))
    points = torch.stack([x * 0.5, 0 * x, 0.25 * x + z * 0.4], -1)[None]
    distance, _, valid = field.sample(points)
    want = (points[0, :, 2] - slope * points[0, :, 0]) / math.hypot(1, slope)
    short = (want.abs() - distance[0].abs()) * torch.where(want.abs() > resolution, 1.0, 0.0)
    assert valid.all() and short.max() < 0.5 * resolution * slope / math.hypot(1, slope) + 1e-6 and short.min() > -1e-2


def test_at_the_points_of_the_grid_the_sample_is_the_field():
    field = field_of(random_layer(1, (2, 5, 4), 1.0), center=torch.tensor([[3.0, -1.0, 9.0], [0.5, 0.0, 9.0]]).double())
    i, j, k = torch.meshgrid(torch.arange(5), torch.arange(4), torch.arange(13), indexing="ij")
    grid = torch.stack([(i - 2) * 0.1, (j - 1.5) * 0.1, k * 0.08], -1).view(1, -1, 3)
    origin = torch.cat([field.center, field.floor[:, None]], 1)[:, None]
    distance, _, valid = field.sample(grid + origin)
    inner = (k.flatten() > 0) & (k.flatten() < 12)  # the outermost levels may round to outside
    torch.testing.assert_close(distance[:, inner], field.values.permute(0, 2, 3, 1).flatten(1)[:, inner])
    assert valid[:, inner].all()


@pytest.mark.slow(1)
@given(SEEDS)
def test_the_gradient_is_the_derivative(seed):
    """Of the interpolation, exactly, wherever a point lies between grid points."""
    field = field_of(random_layer(seed, (2, 5, 4), 0.8))
    rng = np.random.default_rng(seed)
    cells = rng.integers(-1, (6, 5, 12), (2, 12, 3)) + rng.uniform(0.1, 0.4, (2, 12, 3))
    points = torch.from_numpy((cells - [2, 1.5, 0]) * [0.1, 0.1, 0.08])
    points[..., 2] += field.floor[:, None]
    points.requires_grad_()
    distance, gradient, valid = field.sample(points)
    (slopes,) = torch.autograd.grad(distance.sum(), points, retain_graph=True)
    torch.testing.assert_close(slopes, gradient)
    assert torch.equal(gradient.any(-1), gradient.any(-1) & valid) and valid.any() and not valid.all()
    assert torch.autograd.gradcheck(lambda p: field.sample(p)[:2], (points,), atol=1e-6)


def test_gradients_in_the_heights():
    heights, known = random_layer(2, (1, 3, 3), 0.8)
    points = torch.from_numpy(np.random.default_rng(0).uniform((-0.1, -0.1, -0.2), (0.1, 0.1, 0.3), (1, 8, 3)))
    floor = torch.tensor([-0.5], dtype=torch.float64)

    def at_points(heights):
        return field_of((heights, known), floor=floor).sample(points).distance

    heights.requires_grad_()
    assert torch.autograd.gradcheck(at_points, (heights,))
    (gradient,) = torch.autograd.grad(at_points(heights).sum(), heights)
    assert not gradient[~known].any() and gradient[known].any()


def test_a_batch_of_fields_equals_single_fields():
    heights, known = random_layer(3, (3, 6, 5), 0.8)
    heights = heights + torch.tensor([0.0, 40.0, -300.0])[:, None, None]
    center = torch.tensor([[0.0, 0.0], [5.0, 5.0], [1e4, -3.0]]).double()
    place = torch.rand(3, 20, 3, generator=torch.Generator().manual_seed(0)).double() - 0.5
    points = place * 0.5 + torch.cat([center, torch.tensor([[0.1], [40.1], [-299.9]])], 1)[:, None]
    batch = field_of((heights, known), center=center).sample(points)
    assert batch.valid.any(1).all()
    for b in range(3):
        one = slice(b, b + 1)
        single = field_of((heights[one], known[one]), center=center[one]).sample(points[one])
        for got, want in zip(batch, single, strict=True):
            assert torch.equal(got[one], want)


def test_where_a_sample_is_not_valid():
    """Outside, between few known columns, not finite: 0, and without a gradient."""
    z, known = whole(torch.zeros(1, 4, 4))
    known[:, 2:] = False
    field = field_of((z, known))
    bad = [[0.5, 0, 0.1], [0, -0.21, 0.1], [0, 0, 0.9], [0, 0, -0.3], [0.1, 0, 0.1], [0.01, 0, 0.1]]
    bad += [[torch.nan, 0, 0.1], [0, torch.inf, 0.1], [1e30, 0, -1e30], [-0.1, 0, 0.78], [-0.1, 0, -0.21]]
    good = [[-0.05, 0.05, 0.1], [-0.01, 0, 0.1], [-0.199, 0.199, 0.1], [-0.1, 0, 0.75], [-0.1, 0, -0.19]]
    points = torch.tensor([bad + good]).requires_grad_()
    distance, gradient, valid = field.sample(points)
    assert valid[0].tolist() == [False] * len(bad) + [True] * len(good)
    assert not distance[0, : len(bad)].any() and not gradient[0, : len(bad)].any()
    middle, short, *others = distance[0, len(bad) :].tolist()
    assert [middle, *others] == pytest.approx([0.1, 0.1, 0.45, -0.19], abs=1e-6)
    assert 0.05 < short < 0.1  # the columns beside it are unknown
    (slopes,) = torch.autograd.grad(distance.sum(), points)
    assert torch.isfinite(slopes).all()
    nothing = field_of((z, torch.zeros_like(known))).sample(points)
    assert not nothing.valid.any() and torch.isfinite(nothing.distance).all()


@pytest.mark.parametrize("shape", [(1, 1, 1), (1, 1, 5), (2, 5, 1), (0, 4, 4)])
def test_fields_of_small_maps(shape):
    field = field_of(whole(torch.zeros(shape)))
    sample = field.sample(torch.tensor([[[0.0, 0.0, 0.13]]]).expand(shape[0], 1, 3))
    torch.testing.assert_close(sample.distance, torch.full((shape[0], 1), 0.13))
    assert sample.gradient.tolist() == [[[0, 0, pytest.approx(1, abs=1e-4)]]] * shape[0]


def test_fields_refuse():
    layer = random_layer(0)
    for cfg in (dict(height=0.0), dict(max_distance=math.inf), dict(spacing=-1.0), dict(below=-0.1)):
        with pytest.raises(ValueError, match=next(iter(cfg))):
            FieldConfig(**cfg)
    with pytest.raises(ValueError, match="resolution"):
        field_of(layer, 0.0)
    for name, value in itertools.product(("center", "floor"), (torch.zeros(3, 3), torch.zeros(()))):
        with pytest.raises(ValueError, match=f"{name}: expected"):
            field_of(layer, **{name: value})
    for points in (torch.zeros(2, 5), torch.zeros(1, 5, 3), torch.zeros(2, 5, 2)):
        with pytest.raises(ValueError, match="points: expected"):
            field_of(layer).sample(points)
    with pytest.raises(TypeError, match="points: must be a torch.Tensor, got ndarray"):
        field_of(layer).sample(np.zeros((2, 5, 3)))
    with pytest.raises(ValueError, match="floor: must be a number or a tensor, got nan"):
        field_of(layer, floor=math.nan)
    with pytest.raises(ValueError, match="expected values"):
        field_of((layer[0][0], layer[1][0]))


def test_one_floor_for_all_maps():
    layer = random_layer(0)
    assert torch.equal(field_of(layer, floor=-1).values, field_of(layer, floor=torch.full((2,), -1.0)).values)
