"""The distance field around the ground."""

import itertools
import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tests.filters.terrains import random_layer, terrain, whole
from torchelev.filters.distances.distance_field import FieldConfig, SignedDistanceField

SEEDS = st.integers(0, 10_000)


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
